"""The detector: tracks are born, coast, die; everything that comes in is counted."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_imm.detector import Detector
from can_imm.manoeuvres import ModeBank, bank_from_dict, load_bank
from can_imm.sim.random import random_scenario
from can_imm.sim.scenario import load_scenario
from can_imm.sim.sensor import SensorModel, measure
from can_imm.sim.truth import simulate
from can_imm.types import CanImmError, Manoeuvre, Scan

MS = 1_000_000
STD = (0.1, 0.3, 0.2, 0.3)
HERE = (30.0, 1.0, 0.0, 0.0)
"""x, vx, y, vy of an object."""


def motion(q: float) -> dict[str, Any]:
    return {"model": "constant-velocity", "q": q}


def preset(*modes: dict[str, Any], matrix: list[list[float]]) -> dict[str, Any]:
    return {
        "name": "test",
        "states": ["x", "vx", "y", "vy"],
        "birth_std": [10.0, 5.0, 3.0, 2.0],
        "jump_std": [1.0, 4.0, 1.0, 2.0],
        "lanes": {"width": 3.0},
        "transition": {"matrix": matrix, "period_s": 0.1},
        "mode": list(modes),
    }


@pytest.fixture(scope="module")
def single() -> ModeBank:
    """One mode without constraints: a Kalman filter."""
    mode = {"name": "K", "manoeuvre": "KEEP_RIGHT", "x": motion(0.3), "y": motion(0.2)}
    return bank_from_dict(preset(mode, matrix=[[1.0]]), "single")


@pytest.fixture(scope="module")
def double() -> ModeBank:
    """Keeping (slow) and changing lanes to the left (vy above 0.5 m/s)."""
    keep = {
        "name": "KEEP", "manoeuvre": "KEEP_RIGHT", "x": motion(0.1), "y": motion(0.01),
        "soft": [{"state": "vy", "value": 0.0, "r": 0.05}],
    }  # fmt: skip
    change = {
        "name": "LEFT", "manoeuvre": "LANE_CHANGE", "direction": "left",
        "x": motion(0.1), "y": motion(0.3), "bounds": [{"state": "vy", "min": 0.5}],
    }  # fmt: skip
    return bank_from_dict(preset(keep, change, matrix=[[0.95, 0.05], [0.1, 0.9]]), "double")


@functools.cache
def _two_lane() -> ModeBank:
    return load_bank("two-lane")


@pytest.fixture(scope="module")
def two_lane() -> ModeBank:
    return _two_lane()


Row = tuple[int, Sequence[float]]


def scan(t_ms: float, *rows: Row, counter: int = -1, std: Sequence[float] = STD) -> Scan:
    s = Scan(max(len(rows), 1))
    s.t_ns, s.counter, s.n = int(t_ms * MS), counter, len(rows)
    for k, (name, z) in enumerate(rows):
        s.ids[k], s.z[k], s.std[k], s.valid[k] = name, z, std, True
    return s


def run(detector: Detector, *scans: Scan) -> int:
    n = 0
    for s in scans:
        n = detector.step(s.t_ns, s)
    return n


def total(detector: Detector) -> dict[str, int]:
    """The counts that are not zero."""
    return {k: v for k, v in dataclasses.asdict(detector.counts).items() if v}


# ---- birth, coasting, death


def test_birth(double: ModeBank) -> None:
    detector = Detector(double, capacity=4)
    assert detector.n_tracked == 0
    assert run(detector, scan(100, (7, HERE), (3, (60.0, -2.0, 3.0, 0.0)))) == 2
    assert detector.n_tracked == 2
    reports = detector.reports[:2]
    assert sorted(reports["object_id"]) == [3, 7]
    first = reports[reports["object_id"] == 7][0]
    assert first["t_ns"] == 100 * MS
    assert first["age"] == 1
    assert not first["coasting"]
    assert first["x"] == pytest.approx(HERE, abs=0.3)
    assert first["p"].sum() == pytest.approx(1.0)
    assert first["p"][Manoeuvre.UNKNOWN] == 0.0
    assert total(detector) == {"scans": 1, "measurements": 2, "births": 2}


def test_what_a_report_says(double: ModeBank) -> None:
    detector = Detector(double)
    for k in range(20):
        y = 0.0 if k < 10 else 0.12 * (k - 9)
        vy = 0.0 if k < 10 else 1.2
        run(detector, scan(100 * k, (1, (30.0, 0.0, y, vy))))
        report = detector.reports[0]
        assert report["age"] == k + 1
        assert report["probability"] == report["p"][report["manoeuvre"]] == report["p"].max()
        assert report["second_probability"] == report["p"][report["second"]]
        assert report["second"] != report["manoeuvre"]
        if k == 9:
            assert report["manoeuvre"] == Manoeuvre.KEEP_RIGHT
            assert (report["direction"], report["lane"]) == (0, 0)
    assert report["manoeuvre"] == Manoeuvre.LANE_CHANGE
    assert report["second"] == Manoeuvre.KEEP_RIGHT
    assert report["direction"] == 1
    for k in range(3):
        run(detector, scan(2000 + 100 * k, (1, (30.0, 0.0, 1.7 + 0.12 * k, 1.2))))
    assert detector.reports[0]["lane"] == 1


def transition(tau: float) -> tuple[np.ndarray, np.ndarray]:
    """F and Q of the bank ``single`` over ``tau`` seconds, closed form."""
    F, Q = np.eye(4), np.zeros((4, 4))
    F[0, 1] = F[2, 3] = tau
    unit = np.array([[tau**3 / 3, tau**2 / 2], [tau**2 / 2, tau]])
    Q[:2, :2], Q[2:, 2:] = 0.3 * unit, 0.2 * unit
    return F, Q


def test_the_whole_detector_is_a_kalman_filter_when_there_is_one_mode(single: ModeBank) -> None:
    rng = np.random.default_rng(0)
    detector = Detector(single, gate=math.inf)
    x, P = np.zeros(4), np.diag([10.0, 5.0, 3.0, 2.0]) ** 2
    R = np.diag(STD) ** 2
    z = rng.normal(HERE, STD)
    x[[0, 2]] = z[[0, 2]]
    t = 0
    for k in range(30):
        if k:
            gap = int(rng.choice([50, 100, 130, 300]))
            t += gap
            F, Q = transition(gap / 1000)
            x, P = F @ x, F @ P @ F.T + Q
            z = rng.normal(HERE, STD)
        K = P @ np.linalg.inv(P + R)
        x, P = x + K @ (z - x), P - K @ P
        run(detector, scan(t, (1, z)))
        np.testing.assert_allclose(detector.reports[0]["x"], x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(detector.reports[0]["cov"], P, rtol=1e-8, atol=1e-10)


def test_coasting_is_a_prediction(single: ModeBank) -> None:
    detector = Detector(single)
    for k in range(5):
        run(detector, scan(100 * k, (1, HERE), (2, HERE)))
    last = detector.reports[:2].copy()
    for gap in (100, 200, 300):
        n = run(detector, scan(400 + gap, (2, HERE)))
        assert n == 2
        one, two = detector.reports[:2]
        F, Q = transition(gap / 1000)
        assert one["coasting"]
        assert not two["coasting"]
        assert one["t_ns"] == (400 + gap) * MS
        assert (one["age"], two["age"]) == (5, 5 + gap // 100)
        np.testing.assert_allclose(one["x"], F @ last[0]["x"], rtol=1e-10)
        np.testing.assert_allclose(one["cov"], F @ last[0]["cov"] @ F.T + Q, rtol=1e-9, atol=1e-12)
    run(detector, scan(800, (1, HERE), (2, HERE)))
    assert not detector.reports[0]["coasting"]
    assert detector.reports[0]["age"] == 6


def test_predictions_at_every_step(single: ModeBank) -> None:
    detector = Detector(single)
    assert detector.predict(0) == 0
    for k in range(4):
        run(detector, scan(100 * k, (1, HERE), (5, HERE)))
    last = detector.reports[:2].copy()
    for t in range(310, 400, 10):
        assert detector.step(t * MS, None) == 0
        assert detector.predict(t * MS) == 2
        F, _ = transition((t - 300) / 1000)
        for k in range(2):
            assert detector.predicted[k]["object_id"] == last[k]["object_id"]
            assert detector.predicted[k]["t_ns"] == t * MS
            np.testing.assert_allclose(detector.predicted[k]["x"], F @ last[k]["x"], rtol=1e-10)


@pytest.mark.parametrize("with_empty_scans", [False, True])
def test_death_after_coasting(double: ModeBank, with_empty_scans: bool) -> None:
    detector = Detector(double, coast_s=0.5)
    run(detector, scan(0, (1, HERE)))
    for t in range(10, 501, 10):
        n = detector.step(t * MS, scan(t) if with_empty_scans else None)
        assert n == with_empty_scans
        assert detector.n_tracked == 1, t
    detector.step(510 * MS, scan(510) if with_empty_scans else None)
    assert detector.n_tracked == 0
    assert detector.counts.deaths == 1
    assert run(detector, scan(600, (1, HERE))) == 1
    assert detector.reports[0]["age"] == 1
    assert (detector.counts.births, detector.counts.reused_ids) == (2, 0)


def test_a_measurement_after_the_coasting_time_begins_a_new_track(double: ModeBank) -> None:
    """Even when no step in between has ended the old one."""
    detector = Detector(double, coast_s=0.5)
    run(detector, scan(0, (1, HERE)), scan(100, (1, HERE)))
    run(detector, scan(700, (1, HERE)))
    assert detector.reports[0]["age"] == 1
    assert (detector.counts.births, detector.counts.deaths) == (2, 1)


@pytest.mark.parametrize("coast_s", [1.9, 2.0, 60.0])
def test_coasting_never_outruns_the_tables(double: ModeBank, coast_s: float) -> None:
    detector = Detector(double, coast_s=coast_s)
    run(detector, scan(0, (1, HERE)))
    alive = 0
    for t in range(100, 3000, 100):
        if detector.step(t * MS, scan(t)):
            alive = t
            assert np.isfinite(detector.reports[0]["cov"]).all()
    assert alive == min(coast_s, 2.0) * 1000 // 100 * 100


def test_an_id_that_names_another_object(double: ModeBank) -> None:
    detector = Detector(double)
    for k in range(5):
        run(detector, scan(100 * k, (1, HERE), (2, HERE)))
    other = scan(500, (1, (80.0, -3.0, 3.0, 0.0)), (2, HERE))
    other.new[0] = True
    run(detector, other)
    reports = {r["object_id"]: r for r in detector.reports[:2]}
    assert reports[1]["age"] == 1
    assert reports[1]["x"] == pytest.approx([80.0, -3.0, 3.0, 0.0], abs=0.5)
    assert reports[2]["age"] == 6
    assert detector.counts.reused_ids == 1
    assert (detector.counts.births, detector.counts.deaths) == (3, 1)


def test_a_new_flag_on_an_unknown_id_is_a_plain_birth(double: ModeBank) -> None:
    detector = Detector(double)
    first = scan(0, (1, HERE))
    first.new[0] = True
    run(detector, first)
    assert total(detector) == {"scans": 1, "measurements": 1, "births": 1}


def test_duplicate_ids_in_one_scan(double: ModeBank) -> None:
    one, two = Detector(double), Detector(double)
    run(one, scan(0, (1, HERE), (1, (99.0, 0.0, 0.0, 0.0)), (1, HERE)))
    run(two, scan(0, (1, HERE)))
    assert one.counts.duplicates == 2
    assert one.n_tracked == 1
    assert one.reports[:1].tobytes() == two.reports[:1].tobytes()


def test_overflow_of_the_slots(double: ModeBank) -> None:
    detector = Detector(double, capacity=2)
    rows = [(name, (10.0 * name, 0.0, 0.0, 0.0)) for name in (1, 2, 3, 4)]
    assert run(detector, scan(0, *rows)) == 2
    assert detector.counts.overflow == 2
    assert detector.n_tracked == 2
    for t in range(100, 800, 100):
        run(detector, scan(t, *rows[1:]))
    assert sorted(detector.reports[:2]["object_id"]) == [2, 3], "3 took the place of 1"
    assert detector.counts.births == 3


def test_slots_are_used_again(double: ModeBank) -> None:
    detector = Detector(double, capacity=3)
    t = 0
    for name in range(20):
        for _ in range(2):
            t += 100
            run(detector, scan(t, (name, HERE)))
        t += 600
    assert detector.counts.overflow == 0
    assert (detector.counts.births, detector.counts.deaths) == (20, 19)


# ---- measurements that are wrong


def test_outliers_coast_and_then_begin_a_new_track(double: ModeBank) -> None:
    detector = Detector(double, max_outliers=3)
    for k in range(5):
        run(detector, scan(100 * k, (1, HERE)))
    far = (95.0, 0.0, 0.0, 0.0)
    for k in (1, 2):
        assert run(detector, scan(400 + 100 * k, (1, far))) == 1
        report = detector.reports[0]
        assert report["coasting"]
        assert report["x"][0] == pytest.approx(HERE[0], abs=1.0)
        assert detector.counts.outliers == k
    assert run(detector, scan(700, (1, far))) == 0
    assert detector.counts.reused_ids == 1
    run(detector, scan(800, (1, far)))
    assert detector.reports[0]["x"][0] == pytest.approx(95.0, abs=0.3)
    assert detector.reports[0]["age"] == 1
    assert (detector.counts.outliers, detector.counts.births, detector.counts.deaths) == (3, 2, 1)


def test_one_outlier_is_forgotten(double: ModeBank) -> None:
    detector = Detector(double, max_outliers=2)
    far = (95.0, 0.0, 0.0, 0.0)
    for k in range(12):
        run(detector, scan(100 * k, (1, far if k % 3 == 2 else HERE)))
    assert detector.counts.outliers == 4
    assert (detector.counts.births, detector.counts.deaths) == (1, 0)


@pytest.mark.parametrize("component", range(4))
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", ["z", "std"])
def test_values_that_are_not_finite(
    double: ModeBank, component: int, bad: float, where: str
) -> None:
    detector = Detector(double)
    run(detector, scan(0, (1, HERE)))
    s = scan(100, (1, HERE), (2, HERE))
    getattr(s, where)[0, component] = bad
    run(detector, s)
    assert detector.counts.invalid == 1
    reports = detector.reports[:2]
    assert reports["coasting"].tolist() == [True, False]
    assert np.isfinite(reports["x"]).all()


@pytest.mark.parametrize("std", [0.0, -0.1, 1e200])
def test_a_standard_deviation_that_is_none(double: ModeBank, std: float) -> None:
    detector = Detector(double)
    run(detector, scan(0, (1, HERE), std=(0.1, std, 0.2, 0.3)))
    assert total(detector) == {"scans": 1, "invalid": 1}


def test_an_extreme_value_is_an_outlier(double: ModeBank) -> None:
    detector = Detector(double)
    run(detector, scan(0, (1, HERE)), scan(100, (1, (9e5, 0.0, 0.0, 0.0))))
    assert detector.counts.outliers == 1
    run(detector, scan(200, (1, (1e200, 0.0, 0.0, 0.0))))
    assert detector.counts.invalid == 1, "no number on a road: its square would overflow"
    assert np.isfinite(detector.reports[0]["x"]).all()


def test_a_numeric_failure_ends_the_track_and_nothing_else(double: ModeBank) -> None:
    detector = Detector(double)
    run(detector, scan(0, (1, HERE), (2, HERE)))
    # nothing that a sensor says leads there any more
    detector._objects["P"][detector._id == 1] = math.nan
    n = run(detector, scan(100, (1, HERE), (2, HERE)))
    assert detector.counts.numeric_failures == 1
    assert n == 1
    assert detector.reports[0]["object_id"] == 2
    run(detector, scan(200, (1, HERE), (2, HERE)))
    assert detector.n_tracked == 2


def test_a_component_that_is_not_measured(single: ModeBank) -> None:
    """Its value means nothing, not even NaN; y alone still gives vy in time."""
    one, two = Detector(single), Detector(single)
    for k in range(40):
        for detector, rubbish in ((one, math.nan), (two, 1e9)):
            s = scan(100 * k, (1, (30.0 + 0.1 * k, 1.0, 0.05 * k, rubbish)))
            s.valid[0, 3] = False
            assert run(detector, s) == 1
    assert one.reports[0].tobytes() == two.reports[0].tobytes()
    assert one.counts.invalid == 0
    assert one.reports[0]["x"][3] == pytest.approx(0.5, abs=0.05)


def test_nothing_measured_at_all(double: ModeBank) -> None:
    detector = Detector(double)
    s = scan(0, (1, HERE))
    s.valid[0] = False
    assert run(detector, s) == 0
    assert total(detector) == {"scans": 1, "invalid": 1}


# ---- scans that are wrong


def test_empty_scans(double: ModeBank) -> None:
    detector = Detector(double)
    assert run(detector, scan(0), scan(100)) == 0
    assert total(detector) == {"scans": 2}


def test_late_and_repeated_scans(double: ModeBank) -> None:
    detector, clean = Detector(double), Detector(double)
    for d in (detector, clean):
        run(d, scan(0, (1, HERE), counter=0), scan(100, (1, HERE), counter=1))
    before = detector.reports.tobytes()
    assert detector.step(110 * MS, scan(100, (1, HERE), counter=1)) == 0
    assert detector.counts.repeated_scans == 1
    assert detector.step(120 * MS, scan(100, (1, HERE), counter=2)) == 0
    assert detector.step(130 * MS, scan(50, (1, HERE), counter=3)) == 0
    assert detector.counts.late_scans == 2
    assert detector.reports.tobytes() == before
    for d in (detector, clean):
        run(d, scan(200, (1, HERE), counter=2))
    assert detector.reports.tobytes() == clean.reports.tobytes()


def test_a_scan_counter_that_stands_still(double: ModeBank) -> None:
    """The same counter again is the same data again, until the sensor was silent for long."""
    detector = Detector(double, coast_s=0.5)
    run(detector, scan(0, (1, HERE), counter=7), scan(100, (1, HERE), counter=7))
    assert total(detector) == {"scans": 1, "repeated_scans": 1, "measurements": 1, "births": 1}
    assert run(detector, scan(700, (1, HERE), counter=7)) == 1
    detector = Detector(double)
    run(detector, scan(0, (1, HERE)), scan(100, (1, HERE)))
    assert detector.counts.scans == 2, "a sensor without a counter"


def test_a_scan_older_than_the_tables_is_late(double: ModeBank) -> None:
    detector = Detector(double, coast_s=0.5)
    assert detector.step(1000 * MS, scan(490, (1, HERE))) == 0
    assert detector.counts.late_scans == 1
    assert detector.step(1010 * MS, scan(600, (1, HERE))) == 1


def test_the_age_of_a_scan(single: ModeBank) -> None:
    """A scan that comes 30 ms after it was taken: the report is about now."""
    detector, fresh = Detector(single), Detector(single)
    for k in range(60):
        t = 100 * k
        z = (HERE[0] + 0.001 * t * HERE[1], *HERE[1:])
        run(fresh, scan(t, (1, z)))
        detector.step((t + 30) * MS, scan(t, (1, z)))
    assert detector.reports[0]["t_ns"] == fresh.reports[0]["t_ns"] + 30 * MS
    now, then = detector.reports[0]["x"], fresh.reports[0]["x"]
    assert now[0] - then[0] == pytest.approx(0.03 * HERE[1], abs=2e-3)


def test_the_bank_may_know_the_noise_better_than_the_sensor() -> None:
    data = preset(
        {"name": "K", "manoeuvre": "KEEP_RIGHT", "x": motion(0.3), "y": motion(0.2)},
        matrix=[[1.0]],
    )
    data["measurement_variance"] = [0.01, 0.09, 0.04, 0.09]
    bank = bank_from_dict(data, "noise")
    results = []
    for std in (STD, (5.0, 5.0, 5.0, 5.0)):
        detector = Detector(bank)
        run(detector, scan(0, (1, HERE), std=std), scan(100, (1, HERE), std=std))
        results.append(detector.reports[0].tobytes())
    assert results[0] == results[1]


@pytest.mark.parametrize("capacity", [0, -3])
def test_a_detector_without_slots_is_refused(single: ModeBank, capacity: int) -> None:
    with pytest.raises(CanImmError, match="at least one object slot"):
        Detector(single, capacity=capacity)


def test_a_scan_may_hold_more_rows_than_there_are_slots(double: ModeBank) -> None:
    detector = Detector(double, capacity=2)
    run(detector, scan(0, *[(i, HERE) for i in range(200)]))
    assert (detector.counts.measurements, detector.counts.overflow) == (2, 198)


# ---- properties of whole runs

VALUES = st.one_of(
    st.floats(-5.0, 60.0), st.floats(-5.0, 60.0), st.sampled_from([math.nan, math.inf, 1e200, -1e9])
)
ROWS = st.tuples(
    st.integers(0, 5),
    st.tuples(VALUES, VALUES, VALUES, VALUES),
    st.sampled_from([0.1, 0.1, 0.3, 0.0, -1.0, 1e200, -1e200, 1e-200, math.nan]),
    st.integers(0, 15),
    st.booleans(),
)
SCANS = st.tuples(
    st.sampled_from([100, 100, 100, 10, 0, -50, 450, 2500]),
    st.integers(-1, 15),
    st.sampled_from([0, 0, 0, 30, 600]),
    st.lists(ROWS, max_size=8),
)


@settings(max_examples=60)
@given(st.lists(SCANS, max_size=15))
def test_everything_is_counted_once_and_survived(script: list[Any]) -> None:
    """Whatever a sensor says: every scan and every row ends in exactly one count."""
    detector = Detector(_two_lane(), capacity=4)
    t, now, used_rows = 1000, 0, 0
    for given_scans, (gap, counter, age, rows) in enumerate(script, 1):
        t += gap
        s = scan(t, *[(name, z) for name, z, *_ in rows], counter=counter)
        for k, (_, _, std, mask, new) in enumerate(rows):
            s.std[k], s.new[k] = std, new
            s.valid[k] = [mask >> c & 1 for c in range(4)]
        now = max(now, t + age)
        before = detector.counts.scans
        n = detector.step(now * MS, s)
        used_rows += len(rows) if detector.counts.scans > before else 0
        c = detector.counts
        assert c.scans + c.late_scans + c.repeated_scans == given_scans
        assert used_rows == (
            c.measurements + c.outliers + c.invalid + c.numeric_failures + c.overflow + c.duplicates
        )
        assert c.births - c.deaths == detector.n_tracked <= 4
        if n:
            reports = detector.reports[:n]
            assert n == detector.n_tracked
            assert len(set(reports["object_id"])) == n
            assert np.isfinite(reports["x"]).all()
            assert np.isfinite(reports["cov"]).all()
            np.testing.assert_allclose(reports["p"].sum(axis=1), 1.0, rtol=1e-9)


def random_scans(seed: int) -> list[Scan]:
    rng = np.random.default_rng(seed)
    truths = simulate(random_scenario(rng))
    sensor = SensorModel(missed=0.05, dropout=0.02)
    return measure(truths, sensor, rng)[:150]


def play(bank: ModeBank, scans: list[Scan], *, seed: int = 0, predict: bool = False) -> bytes:
    detector = Detector(bank, seed=seed)
    said = []
    for s in scans:
        n = detector.step(s.t_ns, s)
        said.append(detector.reports[:n].tobytes())
        if predict:
            for k in range(1, 10):
                detector.step(s.t_ns + k * 10 * MS, None)
                detector.predict(s.t_ns + k * 10 * MS)
    return b"".join(said)


def test_the_same_input_gives_the_same_reports_bit_for_bit(two_lane: ModeBank) -> None:
    scans = random_scans(1)
    first = play(two_lane, scans)
    assert first == play(load_bank("two-lane"), scans)
    assert first != play(two_lane, random_scans(2))


def test_predictions_change_nothing(two_lane: ModeBank) -> None:
    scans = random_scans(3)
    assert play(two_lane, scans) == play(two_lane, scans, predict=True)


def test_the_order_of_the_rows_does_not_matter_without_particles(double: ModeBank) -> None:
    rows = [(i, (20.0 + 5.0 * i, 0.1 * i, 0.5 * i, 0.0)) for i in range(5)]
    answers = []
    for order in (1, -1):
        detector = Detector(double)
        for k in range(10):
            run(detector, scan(100 * k, *rows[::order]))
        reports = detector.reports[:5]
        answers.append(reports[np.argsort(reports["object_id"])])
    for name in answers[0].dtype.names:
        np.testing.assert_array_equal(answers[0][name], answers[1][name])


def test_accuracy_on_truth_a(two_lane: ModeBank) -> None:
    """A smoke test on two seeds that nothing was tuned on; the study measures it properly."""
    truth = simulate(load_scenario("paper-a"))[0]
    labels = dict(zip(truth.t_ns.tolist(), truth.label.tolist(), strict=True))
    right = []
    for seed in (987_001, 987_002):
        detector = Detector(two_lane, seed=seed)
        for s in measure([truth], SensorModel(), np.random.default_rng(seed)):
            assert detector.step(s.t_ns, s) == 1
            right.append(detector.reports[0]["manoeuvre"] == labels[s.t_ns])
        assert detector.counts.deaths == 0
        assert detector.counts.outliers == 0
    assert np.mean(right) > 0.93
