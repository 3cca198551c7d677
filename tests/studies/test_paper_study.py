"""The Monte Carlo study: what it is fed, what it adds up, what it writes."""

from __future__ import annotations

import dataclasses
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from can_imm.sim.scenario import load_scenario
from can_imm.sim.sensor import SensorModel, measure
from can_imm.sim.truth import simulate
from can_imm.studies import systems
from can_imm.studies.paper import score, study, to_json
from can_imm.studies.runs import observe, play
from can_imm.types import N_MANOEUVRES, REPORT_DTYPE, CanImmError, Scan


def scan(t_ns, *objects):
    one = Scan(max(1, len(objects)))
    one.t_ns, one.n = t_ns, len(objects)
    for row, (object_id, x) in enumerate(objects):
        one.ids[row], one.z[row], one.std[row] = object_id, x, 0.5
    return one


@pytest.fixture(scope="module")
def truth():
    return simulate(load_scenario("paper-a"))[0]


def test_observation_starts_when_the_object_is_seen_and_bridges_gaps(truth):
    other, this = truth.object_id + 1, truth.object_id
    scans = [
        scan(0, (other, 1.0)),
        scan(100_000_000, (other, 1.0), (this, 2.0)),
        scan(200_000_000, (other, 1.0)),
        scan(400_000_000, (this, 3.0)),
        scan(int(truth.t_ns[-1]) + 10_000_000, (this, 4.0)),
    ]
    seen = observe(truth, scans)
    assert seen.t_ns.tolist() == [100_000_000, 200_000_000, 400_000_000]
    assert seen.seen.tolist() == [True, False, True]
    assert seen.z[:, 0].tolist() == [2.0, 2.0, 3.0]
    assert seen.std.tolist() == [0.5] * 4
    np.testing.assert_array_equal(seen.state, truth.state[[10, 20, 40]])
    np.testing.assert_array_equal(seen.label, truth.label[[10, 20, 40]])
    with pytest.raises(ValueError, match="never seen"):
        observe(truth, scans[:1])


def test_play_repeats_itself_and_differs_by_seed():
    scans, (seen,) = play("A", 3)
    assert len(scans) == len(seen.z)
    np.testing.assert_array_equal(seen.z, play("A", 3)[1][0].z)
    assert not np.array_equal(seen.z, play("A", 4)[1][0].z)
    assert len({len(play("random", seed)[1][0].truth.t_ns) for seed in range(5)}) > 1


def test_measurement_is_as_wrong_as_its_noise_says():
    _, (seen,) = play("A", 0)
    m = score(seen, systems.answer("measurement", [], [seen], 0)[0])
    assert (m.rmse_x, m.rmse_vx, m.rmse_y, m.rmse_vy) == pytest.approx(
        (0.1, 0.3, 0.2, 0.3), rel=0.1
    )
    assert m.nees == pytest.approx(4.0, abs=0.4)
    assert math.isnan(m.accuracy)


def test_kalman_halves_the_noise_and_rules_name_manoeuvres():
    _, (seen,) = play("A", 0)
    m = score(seen, systems.answer("kalman", [], [seen], 0)[0])
    assert m.rmse_x < 0.06
    assert m.rmse_vy < 0.25
    assert math.isnan(m.accuracy)
    m = score(seen, systems.answer("rules", [], [seen], 0)[0])
    assert m.accuracy > 0.93
    assert math.isnan(m.brier)


class EchoDetector:
    """Says the measurement of every object back, one report per row in reversed order."""

    def __init__(self, bank, *, capacity, seed):
        self.reports = np.zeros(capacity, REPORT_DTYPE)
        self.times = []

    def step(self, t_ns, scan):
        self.times.append(t_ns)
        assert np.all(np.diff(self.times) == 10_000_000)
        if scan is None:
            return 0
        for report, row in zip(self.reports, reversed(range(scan.n)), strict=False):
            report["t_ns"], report["object_id"] = scan.t_ns, scan.ids[row]
            report["x"], report["cov"] = scan.z[row], np.diag(scan.std[row])
            report["manoeuvre"] = 2 + scan.ids[row]
            report["p"] = scan.ids[row] / 10
        return scan.n


def test_the_detector_is_stepped_every_10_ms_and_its_reports_go_to_their_objects(
    monkeypatch, truth
):
    monkeypatch.setattr(systems, "Detector", EchoDetector)
    scans = [
        scan(0, (1, 10.0)),
        scan(100_000_000, (1, 11.0), (2, 20.0)),
        scan(300_000_000, (2, 21.0)),
    ]
    truths = [dataclasses.replace(truth, object_id=i) for i in (1, 2)]
    seen = [observe(one, scans) for one in truths]
    first, second = systems._detect(SimpleNamespace(step_ns=10_000_000), scans, seen, seed=0)
    # the echo says nothing of an object that it misses: unknown
    assert first.manoeuvre.tolist() == [3, 3, 0]
    assert first.x[:, 0] == pytest.approx([10.0, 11.0, math.nan], nan_ok=True)
    assert second.manoeuvre.tolist() == [4, 4]
    assert second.x[:, 0].tolist() == [20.0, 21.0]
    assert second.p.tolist() == [[0.2] * N_MANOEUVRES] * 2
    assert second.cov[1].tolist() == np.diag([0.5] * 4).tolist()


@pytest.fixture(scope="module")
def small():
    return study(2, 700, systems=("rules", "measurement"), truths=("A", "random"))


def test_a_study_is_the_runs_of_its_seeds(small):
    assert [(r.system, r.truth, len(r.metrics)) for r in small] == [
        ("rules", "A", 2),
        ("measurement", "A", 2),
        ("rules", "random", 2),
        ("measurement", "random", 2),
    ]
    truths = simulate(load_scenario("paper-a"))
    for k, seed in enumerate((700, 701)):
        scans = measure(truths, SensorModel(), np.random.default_rng(seed))
        z = np.array([one.z[0] for one in scans])
        state = truths[0].state[::10][: len(z)]
        assert small[1].metrics[k].rmse_y == pytest.approx(
            np.sqrt(np.mean((z[:, 2] - state[:, 2]) ** 2))
        )


def test_processes_change_nothing_but_the_time(small):
    calls = []
    parallel = study(
        2,
        700,
        systems=("rules", "measurement"),
        truths=("A", "random"),
        jobs=2,
        progress=lambda: calls.append(1),
    )
    assert to_json(2, 700, parallel) == to_json(2, 700, small)
    assert len(calls) == 4


def test_a_missing_preset_is_refused_before_the_first_run():
    def progress():
        raise AssertionError("a run was made")

    with pytest.raises(CanImmError, match="no-such-preset"):
        study(1, 0, systems=("rules", "no-such-preset"), truths=("A",), progress=progress)


def test_json_has_the_promised_fields_and_no_nan(small):
    data = to_json(2, 700, small)
    assert json.loads(json.dumps(data, allow_nan=False)) == data
    assert (data["runs"], data["seed"]) == (2, 700)
    fields = {
        "accuracy",
        "macro_f1",
        "accuracy_tol_0_3",
        "accuracy_tol_0_5",
        "mean_delay_s",
        "missed_segments",
        "switches",
        "brier",
        "ece",
        "rmse",
        "nees",
    }
    for result in data["results"]:
        assert set(result) == fields | {"system", "truth", "se"}
        assert set(result["se"]) == fields
        assert set(result["rmse"]) == set(result["se"]["rmse"]) == {"x", "vx", "y", "vy"}
    rules, measurement = data["results"][:2]
    assert rules["brier"] is rules["ece"] is rules["se"]["brier"] is None
    assert measurement["accuracy"] is measurement["switches"] is None
    accuracies = [m.accuracy for m in small[0].metrics]
    assert rules["accuracy"] == pytest.approx(np.mean(accuracies), abs=1e-6)
    assert rules["se"]["accuracy"] == pytest.approx(abs(np.diff(accuracies)[0]) / 2, abs=1e-6)


def test_one_run_has_no_standard_error():
    result = study(1, 0, systems=("measurement",), truths=("A",))
    data = to_json(1, 0, result)["results"][0]
    assert data["se"]["rmse"] == {"x": None, "vx": None, "y": None, "vy": None}
    assert data["nees"] is not None


@pytest.mark.parametrize("system", ["two-lane", "paper"])
def test_a_preset_runs(system):
    scans, seen = play("A", 5)
    m = score(seen[0], systems.answer(system, scans, seen, 5)[0])
    assert m.accuracy > 0.5
    assert m.rmse_y < 0.2
    assert np.isfinite(m.nees)
