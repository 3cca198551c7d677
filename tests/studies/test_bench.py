"""Both sides of the bench do the same work, and its figures are what they say they are."""

from __future__ import annotations

import json

import numpy as np
import pytest

from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.profile import load_profile
from can_imm.cli.main import main
from can_imm.manoeuvres import load_bank
from can_imm.studies import bench, peer
from can_imm.studies.crowd import crowd
from can_imm.studies.runs import play


def sides(ours: list[float], peer_s: list[float], *, faster: bool, target: float | None):
    """A case whose sides take the given times, round by round."""

    def side(times: list[float]) -> bench.Side:
        left = iter(times)

        class Fixed(bench.Side):
            def seconds(self) -> float:
                return next(left)

        return Fixed("fixed", lambda: None, 1)

    return bench.Case("case", "work", side(ours), side(peer_s), faster, target)


@pytest.mark.parametrize(
    ("faster", "target", "ratio", "reached"),
    [(True, 5.0, 5.0, True), (True, 5.1, 5.0, False), (False, 0.2, 0.2, True),
     (False, 0.1, 0.2, False), (True, None, 5.0, None)],
)  # fmt: skip
def test_ratio_is_that_of_the_medians_without_the_first_round(faster, target, ratio, reached):
    case = sides([9.0, 1.0, 2.0, 70.0], [9.0, 10.0, 3.0, 11.0], faster=faster, target=target)
    (result,) = bench.measure([case], 3)
    assert result.median_us == pytest.approx(2e6)
    assert result.ratio == pytest.approx(ratio)
    assert result.reached is reached


def test_six_filters_are_the_published_bank_without_its_particles():
    six, published = bench.six_filters(), load_bank("paper")
    assert six.n_particles == 0
    assert six.n_states == 4
    assert set(published.modes) - set(six.modes) == {"OVERTAKING"}
    Pi = six.record[0]["Pi"][10, :6, :6]
    assert Pi.sum(1) == pytest.approx(1.0)
    assert Pi[0, 1] == pytest.approx(0.02)
    assert Pi[1, 0] == pytest.approx(0.01 / 0.92)


def test_filterpy_comes_to_the_same_conclusions():
    """Same modes most of the time, and near estimates: it is the same work."""
    bank = bench.six_filters()
    observation = play("A", 1000)[1][0]
    variance = bank.measurement_variance
    estimator = bench.Estimator(bank, 1)
    theirs = peer.imm_peer(bank, bench.STEPS, [0, 1, 2, 3], variance, observation.z[0])
    obj = estimator.objects
    same, distance = [], []
    steps = estimator.steps()
    next(steps)
    for z in steps:
        theirs.predict()
        theirs.update(z[0])
        same.append(np.argmax(obj["mu"][0, :6]) == np.argmax(theirs.mu))
        distance.append(np.abs(obj["mean"][0, :4] - theirs.x))
    assert np.mean(same) > 0.9
    assert np.median(distance, axis=0).max() < 0.15


def test_stone_soup_does_what_filterpy_does():
    """The same filters by other hands: what differs is rounding."""
    pytest.importorskip("stonesoup")
    from can_imm.studies.peer_stonesoup import SoupImm

    bank, z = bench.six_filters(), bench._measurements()
    start = (bank, bench.STEPS, [0, 1, 2, 3], bank.measurement_variance, z[0])
    filterpy, soup = peer.imm_peer(*start), SoupImm(*start)
    for row in z[1:]:
        for one in (filterpy, soup):
            one.predict()
            one.update(row)
        np.testing.assert_allclose(soup.mu, filterpy.mu, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(soup.x, filterpy.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(soup.P, filterpy.P, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("installed", [False, True])
def test_stone_soup_is_a_peer_where_it_is_installed(installed, monkeypatch):
    if installed:
        pytest.importorskip("stonesoup")
    else:
        monkeypatch.setattr(bench, "find_spec", lambda name: None)
    cases = [case for case in bench.estimator_cases() if case.name == "imm6_stonesoup"]
    assert len(cases) == installed
    assert ("stonesoup" in bench.machine()) == installed
    for case in cases:
        case.peer.run()


def test_filterpy_finds_the_objects_of_a_log(tmp_path):
    log = tmp_path / "short.log"
    bench.write_log(log, seconds=1, objects=2)
    seen = []
    original = bench.imm_peer
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "imm_peer", lambda *a: seen.append(a[4].copy()) or original(*a))
        bench._replay_filterpy(log, load_profile("can_imm"), load_bank("paper"), 10_000)
    assert len(seen) == 2
    assert seen[0][0] == pytest.approx(50.0, abs=3.0)


def test_command_writes_the_figures(tmp_path, capsys):
    file = tmp_path / "bench.json"
    names = ["imm6", "decode"]
    assert main(["bench", "--rounds", "1", "--only", *names, "--json", str(file)]) == 0
    figures = json.loads(file.read_text())
    assert figures["machine"]["filterpy"].startswith("2")
    assert [result["name"] for result in figures["results"]] == names
    for result in figures["results"]:
        assert {"name", "median_us", "peer", "peer_median_us", "ratio"} <= set(result)
        assert result["ratio"] == pytest.approx(result["peer_median_us"] / result["median_us"])
    assert "imm6" in capsys.readouterr().out


def test_all_names_are_there(tmp_path):
    log = tmp_path / "short.log"
    bench.write_log(log, seconds=1)
    cases = [
        *bench.estimator_cases(),
        bench.decode_case(),
        *bench.replay_cases(log, load_profile("can_imm"), load_bank("two-lane"), 0.5),
    ]
    assert {
        "imm6", "imm7_pf500", "objects_64", "particles_5000", "decode", "replay_reader",
        "replay_filterpy",
    } <= {case.name for case in cases}  # fmt: skip
    scaled = cases[-1].peer
    assert scaled.units == pytest.approx(0.5, abs=0.1)
    assert "scaled" in scaled.name


def test_a_crowd_is_as_many_objects_as_the_radar_sends():
    """In all scans; vehicles are those of the simulation, and posts stand still beside the road."""
    profile = load_profile("ars408")
    decoder = ScanDecoder(profile, 128)
    scans, posts = 0, {}
    for frame in crowd(2.0):
        scan = decoder.feed(frame)
        if scan is None:
            continue
        scans += 1
        assert scan.n == 100
        assert len(set(scan.ids[:100].tolist())) == 100
        assert np.isfinite(scan.ego_speed)
        still = np.abs(scan.z[:100, 1] + scan.ego_speed) < 0.5
        assert 60 <= np.count_nonzero(still) < 95
        for name, (x, _, y, _) in zip(
            scan.ids[:100][still].tolist(), scan.z[:100][still].tolist(), strict=True
        ):
            posts.setdefault(name, []).append((x + scan.ego_speed * scan.t_ns * 1e-9, y))
    assert scans >= 27
    assert decoder.counts.rejected == decoder.counts.incomplete_scans == 0
    seen_long = [np.array(places) for places in posts.values() if len(places) > 20]
    assert len(seen_long) > 40
    for places in seen_long:
        assert np.ptp(places[:, 0]) < 1.0
        assert np.ptp(places[:, 1]) < 0.3


def test_the_share_of_a_core(tmp_path):
    """The log is written when it is needed, and its time is that of the bus."""
    log = tmp_path / "crowd.log"
    case = bench.crowd_case(log, seconds=2.0)
    assert not log.exists()
    (result,) = bench.measure([case], 1)
    assert log.exists()
    assert result.peer_median_us == pytest.approx(2e6)
    assert 0.005 < result.ratio < 2.0
    assert not case.faster


def test_unknown_comparison_is_refused(capsys):
    assert main(["bench", "--only", "imm99"]) == 1
    assert "--only imm99: no such comparison" in capsys.readouterr().err
