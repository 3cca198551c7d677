"""The study of motorway traffic: short runs of the real thing, its JSON and its command."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from can_imm.bus.profile import load_profile
from can_imm.cli.main import build_parser, main
from can_imm.manoeuvres import load_bank
from can_imm.sim.motorway import PLAIN, PUBLISHED, REPORTING, TUNING, VARIANTS, plain, published
from can_imm.sim.radar import RADARS
from can_imm.studies import motorway_tuning
from can_imm.studies.motorway import (
    SYSTEMS,
    detector_says,
    rules_say,
    study,
    to_json,
)
from can_imm.studies.motorway_metrics import score
from can_imm.studies.motorway_rules import PLAIN_RULES, PUBLISHED_RULES, RULES, START, rules_for
from can_imm.studies.motorway_runs import TRAFFIC, play_motorway
from can_imm.studies.paper import study as paper_study
from can_imm.studies.paper import to_json as paper_json
from can_imm.studies.runs import FIRST_SEED
from can_imm.types import CanImmError, Manoeuvre

SHORT = replace(TUNING, duration=20.0)
QUOTIENTS = {
    "lane_changes_found",
    "lane_changes_found_nearby",
    "false_lane_changes_per_hour",
    "lane_change_delay_s",
    "lane_change_delay_limit_s",
    "lane_accuracy",
    "stationary_share",
    "oncoming_share",
    "error_ratio",
}
LSB = {
    "can_imm": (0.02, 0.1, 0.05, 0.1),
    "ars408": (0.2, 0.25, 0.2, 0.25),
    "toyota": (0.04, 0.025, 0.04, None),
    "toyota-tss2": (0.04, 0.025, 0.04, None),
    "esr": (0.1, 0.01, None, None),
}
"""Of the signals, or coarser [m, m/s, m, m/s]."""


@pytest.mark.parametrize("profile", list(RADARS))
def test_what_the_frames_say_is_near_the_truth(profile):
    run = play_motorway(profile, 900, SHORT)
    radar, scans = RADARS[profile], run.scans
    assert len(run.t_ns) == run.first[-1] == sum(scan.n for scan in scans)
    assert len(scans) > 0.97 * 20.0 / radar.period
    assert all(scan.t_ns % 10_000_000 == 0 for scan in scans)
    assert np.isfinite([scan.ego_speed for scan in scans[1:]]).all()
    np.testing.assert_array_equal(run.t_ns, np.repeat([s.t_ns for s in scans], np.diff(run.first)))
    assert sorted(np.concatenate(run.tracks).tolist()) == list(range(len(run.t_ns)))
    ids = np.concatenate([scan.ids[: scan.n] for scan in scans])
    for track in run.tracks:
        assert len(set(run.object[track])) == len(set(run.second[track])) == 1
        assert len(set(ids[track])) == 1
        assert (np.diff(run.t_ns[track]) > 0).all()
    z, angle = (
        np.concatenate([getattr(scan, name)[: scan.n] for scan in scans]) for name in ("z", "angle")
    )
    cos, sin = np.cos(angle), np.sin(angle)
    x, vx, y, vy = run.state.T
    true = np.column_stack([cos * x + sin * y, cos * vx + sin * vy, cos * y - sin * x, vy])
    # a velocity beyond its signal's range is sent as the end of the range
    once = ~run.second & (vx > -50.0)
    std = np.nan_to_num(np.array([*radar.std, 1.0][:4]), nan=1.0)
    for c, lsb in enumerate(LSB[profile]):
        if lsb is not None:
            error = z[once, c] - true[once, c]
            limit = np.hypot(std[c], lsb / 2) + (radar.wander[c // 2] if c in (0, 2) else 0.0)
            assert np.sqrt(np.mean(error**2)) < 1.3 * limit
            assert np.abs(np.mean(error)) < 0.3 * limit + 0.02


def test_label_lane_and_direction_are_those_of_the_truth():
    run = play_motorway("ars408", 900, SHORT)
    for frame in range(0, len(run.t_ns), 97):
        target = run.truth.objects[run.object[frame]]
        sample = target.sample(int(run.t_ns[frame]))
        for name in ("label", "direction", "lane"):
            assert getattr(run, name)[frame] == getattr(target, name)[sample]
        np.testing.assert_allclose(run.state[frame], target.state[sample])


def test_all_profiles_see_the_same_drive():
    runs = [play_motorway(profile, 901, SHORT) for profile in ("can_imm", "esr")]
    ours, other = (run.truth for run in runs)
    assert len(ours.objects) == len(other.objects)
    for one, two in zip(ours.objects, other.objects, strict=True):
        np.testing.assert_array_equal(one.state, two.state)


@pytest.mark.parametrize("profile", ["can_imm", "ars408", "toyota", "esr"])
def test_two_short_drives(profile):
    results = study(2, 900, profiles=[profile], settings=SHORT)
    assert [result.system for result in results] == list(SYSTEMS)
    data = to_json(2, 900, results)
    for result in data["results"]:
        assert result["profile"] == profile
        assert result["accuracy"] > 0.6
        assert result["lane_accuracy"] > 0.6
        assert result["rmse"]["x"] < 0.5
        assert result["object_hours"] > 0.005
    frames = [one.metrics.confusion.sum() for one in results[0].scores]
    for result in results:
        assert [one.metrics.confusion.sum() for one in result.scores] == frames
        assert [one.hours for one in result.scores] == [one.hours for one in results[0].scores]


def test_json_is_that_of_the_paper_study_and_more():
    results = study(2, 902, profiles=["can_imm"], settings=SHORT)
    data = to_json(2, 902, results)
    like = paper_json(1, 0, paper_study(1, 0, systems=["rules"], truths=["A"]))
    assert set(like) <= set(data)
    assert (data["runs"], data["seed"]) == (2, 902)
    extra = QUOTIENTS | {"profile", "lane_changes", "object_hours"}
    for result in data["results"]:
        assert set(result) == set(like["results"][0]) | extra
        assert set(result["se"]) == set(like["results"][0]["se"]) | QUOTIENTS
        assert result["truth"] == "motorway"
    json.dumps(data, allow_nan=False)
    by_system = {result["system"]: result for result in data["results"]}
    assert set(by_system) == set(SYSTEMS)
    rules, ours = by_system["rules"], by_system["motorway"]
    assert rules["error_ratio"] is None
    assert rules["ece"] is None
    assert ours["error_ratio"] == pytest.approx(
        (1 - ours["accuracy"]) / (1 - rules["accuracy"]), rel=1e-4
    )
    alone = to_json(2, 902, study(2, 902, profiles=["can_imm"], systems=["rules"], settings=SHORT))
    assert alone["results"][0] == rules


def test_the_result_does_not_depend_on_the_number_of_processes():
    arguments = {"profiles": ["can_imm", "esr"], "settings": replace(SHORT, duration=8.0)}
    one, two = (to_json(2, 5, study(2, 5, jobs=jobs, **arguments)) for jobs in (1, 2))
    assert one == two


def test_every_frame_gets_a_report_and_those_without_one_are_wrong():
    run = play_motorway("can_imm", 903, SHORT)
    at_once, later = detector_says(run, load_bank("motorway"), 0)
    assert np.mean(at_once.manoeuvre == Manoeuvre.UNKNOWN) < 0.002
    for said in (at_once, later):
        known = said.manoeuvre != Manoeuvre.UNKNOWN
        assert np.isfinite(said.x[known]).all()
        np.testing.assert_allclose(said.p[known].sum(axis=1), 1.0)
    assert not np.array_equal(at_once.p, later.p)
    before = score(run, at_once).metrics
    of = np.isin(run.label, TRAFFIC)
    lost = np.flatnonzero(of & (at_once.manoeuvre == run.label))[:10]
    at_once.manoeuvre[lost] = Manoeuvre.UNKNOWN
    after = score(run, at_once).metrics
    assert after.accuracy == pytest.approx(before.accuracy - 10 / np.count_nonzero(of))


@pytest.mark.parametrize(
    ("kind", "drawn", "rules"),
    [(PLAIN, plain, PLAIN_RULES), (PUBLISHED, published, PUBLISHED_RULES)],
)
def test_each_kind_of_traffic_has_rules_of_its_own(kind, drawn, rules, monkeypatch):
    monkeypatch.setitem(rules, "can_imm", START._replace(receding=100.0))
    results = study(1, 904, profiles=["can_imm"], systems=["rules"], settings=SHORT, kind=kind)
    confusion = results[0].scores[0].metrics.confusion
    assert confusion[:, Manoeuvre.RECEDING].sum() == 0
    run = play_motorway("can_imm", 904, drawn(SHORT))
    said = rules_say(run, rules_for("can_imm", kind))
    of = np.isin(run.label, TRAFFIC)
    assert results[0].scores[0].metrics.accuracy == pytest.approx(
        np.mean(said.manoeuvre[of] == run.label[of])
    )
    assert np.ptp(run.truth.ego.speed) < 1e-3


def test_there_are_rules_for_every_radar():
    assert set(RULES) == set(PLAIN_RULES) == set(PUBLISHED_RULES) == set(RADARS)
    for name in RADARS:
        assert load_profile(name).name == name


def test_the_tuned_rules_are_better_than_where_the_search_began():
    for profile in ("ars408", "toyota"):
        objective = motorway_tuning.Objective(
            motorway_tuning.collect(profile, range(602, 605), TUNING)
        )
        assert objective(RULES[profile]) < objective(START)


def test_the_search_is_for_what_the_study_measures(monkeypatch):
    monkeypatch.setattr(motorway_tuning, "_STEPS", (0.3,))
    monkeypatch.setattr(motorway_tuning, "TUNING", SHORT)
    seen = []
    found = motorway_tuning.tune("can_imm", 2, starts=2, progress=seen.append)
    assert seen == sorted(seen, reverse=True)
    assert found.wrong_tuned <= seen[-1] + 0.01
    done = study(2, 500, profiles=["can_imm"], systems=["rules"], settings=SHORT)
    wrong = 1.0 - np.mean([one.metrics.accuracy for one in done[0].scores])
    assert found.wrong_constants == pytest.approx(wrong)


def test_seeds_for_reporting_are_refused():
    with pytest.raises(ValueError, match="for reporting"):
        motorway_tuning.collect("can_imm", [FIRST_SEED], SHORT)


def test_unknown_names_are_refused():
    with pytest.raises(CanImmError, match="no-such"):
        study(1, 0, profiles=["no-such"])
    with pytest.raises(CanImmError, match="no-such"):
        study(1, 0, profiles=["can_imm"], preset="no-such")


def test_command_prints_tables_and_writes_json(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(VARIANTS, "reporting", replace(REPORTING, duration=10.0))
    file = tmp_path / "out.json"
    profiles = ["--profile", "can_imm", "--profile", "toyota-tss2"]
    arguments = ["--runs", "2", "--seed", "7", "--jobs", "1", "--plain", "--json", str(file)]
    assert main(["study", "motorway", *profiles, *arguments]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "\x1b" not in out
    assert "2 drives per profile, seeds 7 to 8, settings reporting, straight road" in out
    assert max(map(len, out.splitlines())) <= 80
    assert "…" not in out
    assert "oncoming" not in out
    data = json.loads(file.read_text())
    assert (data["settings"], data["plain"], data["published"]) == ("reporting", True, False)
    found = {(r["profile"], r["system"]): r for r in data["results"]}
    assert set(found) == {(p, s) for p in profiles[1::2] for s in SYSTEMS}
    rows = [line.split() for line in out.splitlines()]
    for key, result in found.items():
        mine = [row for row in rows if tuple(row[:2]) == key]
        assert len(mine) == 3
        assert mine[0][2] == f"{result['accuracy']:.4f}"
        assert mine[1][2] == str(result["lane_changes"])


def test_tune_command_prints_constants_as_code(monkeypatch, capsys):
    asked = []

    def tune(profile, runs, *, kind, progress):
        asked.append((profile, runs, kind))
        progress(0.5)
        return motorway_tuning.Tuning(START, 0.1, 0.2, 0.3)

    monkeypatch.setattr(motorway_tuning, "tune", tune)
    command = ["study", "tune-motorway-rules", "--profile", "esr", "--runs", "3", "--plain"]
    assert main(command) == 0
    out, err = capsys.readouterr()
    assert asked == [("esr", 3, "plain")]
    assert err == ""
    assert f'"esr": {START}' in out


def test_errors_are_one_line(tmp_path, capsys):
    file = tmp_path / "missing" / "out.json"
    for arguments in (
        ["--profile", "no-such"],
        ["--preset", "no-such"],
        ["--runs", "1000000", "--json", str(file)],
    ):
        assert main(["study", "motorway", *arguments]) == 1
        out, err = capsys.readouterr()
        assert out == ""
        assert err.count("\n") == 1
        assert arguments[-1] in err


def test_what_the_parser_knows_without_importing_the_study_is_right():
    parser = build_parser(["study"])
    args = parser.parse_args(["study", "motorway"])
    assert args.seed == FIRST_SEED
    assert args.settings == "reporting"
    assert parser.parse_args(["study", "motorway", "--systems", *SYSTEMS]).systems == list(SYSTEMS)
    for name in VARIANTS:
        assert parser.parse_args(["study", "motorway", "--settings", name]).settings == name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("profile", "ratio", "accuracy"),
    [("can_imm", 0.92, 0.91), ("ars408", 0.92, 0.91), ("toyota", 0.95, 0.9), ("esr", 0.9, 0.91)],
)
def test_the_figures_hold(profile, ratio, accuracy):
    """What was reached, with some room for chance; more is wanted of lane changes."""
    data = to_json(30, FIRST_SEED, study(30, FIRST_SEED, profiles=[profile], jobs=2))
    found = {result["system"]: result for result in data["results"]}
    ours = found["motorway"]
    assert ours["error_ratio"] <= ratio
    assert ours["accuracy"] >= accuracy
    assert ours["ece"] <= 0.06
    assert ours["stationary_share"] >= 0.99
    assert ours["oncoming_share"] >= 0.98
