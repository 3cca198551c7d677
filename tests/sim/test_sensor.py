"""The abstract sensor: noise, gaps, and what each scan says of itself."""

from typing import Any

import numpy as np
import pytest

from can_imm.sim.model import RIGHT, Scenario, ScenarioObject, Segment
from can_imm.sim.scenario import load_scenario
from can_imm.sim.sensor import SensorModel, measure
from can_imm.sim.truth import Truth, simulate
from can_imm.types import CanImmError, Manoeuvre, Scan


def keeping(duration: float, *ids: int) -> list[Truth]:
    segments = (Segment(0.0, Manoeuvre.KEEP_RIGHT),)
    objects = tuple(ScenarioObject(i, 10.0 + i, RIGHT, segments) for i in ids)
    return simulate(Scenario("mine", duration, objects))


def noise(scans: list[Scan], truth: Truth) -> np.ndarray:
    step = scans[1].t_ns - scans[0].t_ns
    return np.array([s.z[0] for s in scans]) - truth.state[:: step // truth.dt_ns]


def test_a_scan_every_period_from_zero_on() -> None:
    truths = simulate(load_scenario("paper-a"))
    scans = measure(truths, SensorModel(), np.random.default_rng(1))
    assert [s.t_ns for s in scans] == [k * 100_000_000 for k in range(697)]
    assert [s.counter for s in scans] == list(range(697))
    for scan in scans:
        assert scan.n == 1
        assert scan.ids[0] == 1
        assert scan.std[0].tolist() == [0.1, 0.3, 0.2, 0.3]
        assert scan.valid[0].all()
        assert not scan.incomplete
    assert [bool(s.new[0]) for s in scans] == [True] + [False] * 696


def test_noise_has_the_stated_deviations_and_is_white() -> None:
    (truth,) = keeping(3000.0, 1)
    sensor = SensorModel(std=(0.5, 0.3, 0.2, 0.1))
    error = noise(measure([truth], sensor, np.random.default_rng(2)), truth) / sensor.std
    n = len(error)
    assert n == 30_001
    # five standard errors each
    assert np.abs(error.mean(axis=0)).max() < 5 / np.sqrt(n)
    assert np.abs((error**2).mean(axis=0) - 1).max() < 5 * np.sqrt(2 / n)
    together = np.hstack([error[1:], error[:-1]])
    correlation = np.corrcoef(together.T) - np.eye(8)
    assert np.abs(correlation).max() < 5 / np.sqrt(n)


def test_equal_seeds_give_equal_scans_and_others_do_not() -> None:
    truths = keeping(5.0, 1, 2)
    sensor = SensorModel(missed=0.2, dropout=0.2)
    first, again, other = (
        [
            (s.t_ns, s.ids[: s.n].tolist(), s.z[: s.n].tolist())
            for s in measure(truths, sensor, np.random.default_rng(seed))
        ]
        for seed in (3, 3, 4)
    )
    assert first == again
    assert first != other


def test_losses_do_not_change_the_noise_of_the_rest() -> None:
    truths = keeping(20.0, 1)
    whole = measure(truths, SensorModel(), np.random.default_rng(5))
    lossy = measure(truths, SensorModel(missed=0.3, dropout=0.3), np.random.default_rng(5))
    assert 0 < len(lossy) < len(whole)
    for scan in lossy:
        if scan.n:
            assert np.array_equal(scan.z[0], whole[scan.counter].z[0])


def test_missed_objects_and_dropped_scans_come_at_their_rates() -> None:
    truths = keeping(2000.0, 1, 2)
    sensor = SensorModel(missed=0.1, dropout=0.25)
    scans = measure(truths, sensor, np.random.default_rng(6))
    due = 20_001
    assert len(scans) / due == pytest.approx(0.75, abs=5 * np.sqrt(0.75 * 0.25 / due))
    seen = sum(scan.n for scan in scans) / (2 * len(scans))
    assert seen == pytest.approx(0.9, abs=5 * np.sqrt(0.09 / (2 * len(scans))))
    # the objects are missed independently, so that both are missing at times
    both = sum(scan.n == 0 for scan in scans) / len(scans)
    assert both == pytest.approx(0.01, abs=5 * np.sqrt(0.01 / len(scans)))
    assert [s.t_ns for s in scans] == [s.counter * 100_000_000 for s in scans]
    assert {tuple(s.ids[: s.n]) for s in scans} == {(), (1,), (2,), (1, 2)}


def test_new_marks_an_objects_first_scan_only() -> None:
    truths = keeping(20.0, 1, 2)
    for seed in range(20):
        scans = measure(truths, SensorModel(missed=0.6), np.random.default_rng(seed))
        for object_id in (1, 2):
            flags = [bool(s.new[i]) for s in scans for i in range(s.n) if s.ids[i] == object_id]
            assert flags == [True] + [False] * (len(flags) - 1)


def test_an_object_at_its_end_is_no_longer_seen() -> None:
    long, short = keeping(10.0, 1)[0], keeping(4.0, 2)[0]
    scans = measure([short, long], SensorModel(), np.random.default_rng(7))
    assert [s.ids[: s.n].tolist() for s in scans] == [[2, 1]] * 41 + [[1]] * 60


def test_another_period() -> None:
    scans = measure(keeping(1.0, 1), SensorModel(period_ns=250_000_000), np.random.default_rng(8))
    assert [s.t_ns for s in scans] == [0, 250_000_000, 500_000_000, 750_000_000, 1_000_000_000]


def test_no_objects_no_scans() -> None:
    assert measure([], SensorModel(), np.random.default_rng(9)) == []


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"std": (0.1, 0.3, 0.2)}, "std must be four numbers above 0"),
        ({"std": (0.1, 0.3, 0.0, 0.3)}, "std must be four numbers above 0"),
        ({"std": (0.1, 0.3, float("nan"), 0.3)}, "std must be four numbers above 0"),
        ({"period_ns": 0}, "period_ns must be above 0"),
        ({"missed": -0.1}, "missed must be a probability below 1"),
        ({"missed": float("nan")}, "missed must be a probability below 1"),
        ({"dropout": 1.0}, "dropout must be a probability below 1"),
    ],
)
def test_an_impossible_sensor_is_refused(keys: dict[str, Any], message: str) -> None:
    with pytest.raises(CanImmError, match=f"sensor: {message}"):
        SensorModel(**keys)


def test_a_period_between_the_samples_is_refused() -> None:
    with pytest.raises(CanImmError, match="sensor: period_ns must be a multiple of 10000000"):
        measure(keeping(1.0, 1), SensorModel(period_ns=15_000_000), np.random.default_rng(0))
