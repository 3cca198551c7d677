"""The two smoothers behind a detector, on simulated drives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from can_imm import smoothing
from can_imm.detector import Detector
from can_imm.estimation.road import P_SETTLE, WIDTH
from can_imm.manoeuvres import load_bank
from can_imm.road import RoadFrame
from can_imm.smoothing import FixedIntervalSmoother, FixedLagSmoother
from can_imm.smoothing_rows import fill_gap_
from can_imm.studies.metrics import Metrics, evaluate
from can_imm.studies.runs import Observation, play
from can_imm.studies.systems import Collector
from can_imm.types import REPORT_DTYPE, CanImmError, Manoeuvre, Scan

BANK = load_bank("two-lane")
STEP = BANK.step_ns
Stream = list[tuple[int, Any]]
SAME = ("t_ns", "object_id", "age", "coasting")


def drive(
    scans: list[Scan],
    smoother: Any,
    until: int = 0,
    history: Callable[[Any], Any] = lambda smoother: smoother,
) -> tuple[Stream, Stream, list[int]]:
    """What the detector said and what the smoother says, scan by scan, and when it said so [ns]
    (-1: at the end)."""
    detector = Detector(BANK, capacity=8)
    detector.history = history(smoother)
    causal: Stream = []
    smoothed: Stream = []
    when = []
    due = {scan.t_ns: scan for scan in scans}
    for t_ns in range(0, max(max(due), until) + 1, STEP):
        n = detector.step(t_ns, due.get(t_ns))
        if t_ns in due:
            causal.append((t_ns, detector.reports[:n].copy()))
        for at, reports in smoother.due(t_ns):
            smoothed.append((at, reports.copy()))
            when.append(t_ns)
    for at, reports in smoother.finish():
        smoothed.append((at, reports.copy()))
        when.append(-1)
    return causal, smoothed, when


def assert_same_rows(causal: Stream, smoothed: Stream) -> None:
    """The same scans with the same objects in the same order."""
    assert [t for t, _ in causal] == [t for t, _ in smoothed]
    for (_, a), (_, b) in zip(causal, smoothed, strict=True):
        for name in SAME:
            np.testing.assert_array_equal(a[name], b[name])


def assert_equal(one: Any, two: Any) -> None:
    """The same reports; their fields one by one, since NaN is not equal within a record."""
    for name in REPORT_DTYPE.names or ():
        np.testing.assert_array_equal(one[name], two[name])


def of(stream: Stream, name: int) -> Any:
    """All reports of one object."""
    rows = [reports[reports["object_id"] == name] for _, reports in stream]
    return np.concatenate(rows)


def judge(observation: Observation, stream: Stream) -> Metrics:
    collect = Collector([observation])
    for t_ns, reports in stream:
        collect(t_ns, reports)
    said, o = collect.answers[0], observation
    return evaluate(o.t_ns, o.label, o.state, said.manoeuvre, said.p, said.x, said.cov)


def vehicle(name: int, start: int, stop: int, *, missing: tuple[int, ...] = ()) -> Any:
    """(k, row) of a vehicle that is 30 m ahead, brakes at scan 20, in scans of 100 ms."""
    rng = np.random.default_rng(name)
    for k in range(start, stop):
        if k in missing:
            continue
        t = 0.1 * k
        brakes = np.clip(t - 2.0, 0.0, 1.0)
        x = 30.0 - 1.0 * brakes**2 - 2.0 * max(t - 3.0, 0.0)
        state = [x, -2.0 * brakes, 0.0, 0.0]
        yield k, name, state + rng.normal(0.0, [0.05, 0.1, 0.05, 0.1])


def scans_of(*vehicles: Any, count: int = 0) -> list[Scan]:
    rows: dict[int, list[tuple[int, Any]]] = {k: [] for k in range(count)}
    for one in vehicles:
        for k, name, z in one:
            rows.setdefault(k, []).append((name, z))
    scans = []
    for k in sorted(rows):
        scan = Scan(max(len(rows[k]), 1))
        scan.t_ns, scan.n = k * 10 * STEP, len(rows[k])
        for i, (name, z) in enumerate(rows[k]):
            scan.ids[i], scan.z[i], scan.valid[i] = name, z, True
            scan.std[i] = [0.05, 0.1, 0.05, 0.1]
        scans.append(scan)
    return scans


# ---- what it is good for


def test_smoothed_is_better_than_causal() -> None:
    """Random drives: 0.96 of all frames right without, 0.98 with what comes afterwards."""
    causal, interval, lagged = [], [], []
    for seed in range(1000, 1010):
        scans, observations = play("random", seed)
        a, b, _ = drive(scans, FixedIntervalSmoother(BANK))
        _, c, _ = drive(scans, FixedLagSmoother(BANK, 0.5))
        for stream, results in ((a, causal), (b, interval), (c, lagged)):
            results.append(judge(observations[0], stream))

    def mean(results: list[Metrics], name: str) -> float:
        return float(np.mean([getattr(one, name) for one in results]))

    assert mean(interval, "accuracy") > 0.978
    assert mean(lagged, "accuracy") > 0.978
    assert mean(interval, "accuracy") > mean(causal, "accuracy") + 0.012
    for name in ("rmse_x", "rmse_vx", "rmse_y", "rmse_vy", "brier", "mean_delay_s"):
        assert mean(interval, name) < 0.85 * mean(causal, name), name
        assert mean(lagged, name) < 0.9 * mean(causal, name), name
    assert 2.5 < mean(interval, "nees") < 6.0, "and it knows how good it is"


# ---- the two smoothers, and the order of what they say


def test_the_same_rows_in_the_order_of_time() -> None:
    """Tracks that begin, end, and begin again under the same id."""
    vehicles = vehicle(3, 0, 50), vehicle(9, 5, 20), vehicle(4, 10, 60), vehicle(9, 40, 55)
    scans = scans_of(*vehicles, count=70)
    for smoother in (FixedIntervalSmoother(BANK), FixedLagSmoother(BANK, 0.7)):
        causal, smoothed, _ = drive(scans, smoother)
        assert_same_rows(causal, smoothed)
        assert len(smoothed) == 70
        for _, reports in smoothed:
            np.testing.assert_allclose(reports["p"].sum(axis=1), 1.0)


def test_a_lag_longer_than_the_drive_is_the_whole_interval() -> None:
    scans = scans_of(vehicle(3, 0, 50, missing=(20, 31, 32)), vehicle(9, 5, 20), vehicle(4, 10, 60))
    _, interval, _ = drive(scans, FixedIntervalSmoother(BANK))
    _, lagged, when = drive(scans, FixedLagSmoother(BANK, 100.0))
    assert set(when) == {-1}
    assert_same_rows(interval, lagged)
    for (_, a), (_, b) in zip(interval, lagged, strict=True):
        assert_equal(a, b)


def test_a_lag_is_kept() -> None:
    scans = scans_of(vehicle(3, 0, 50))
    causal, smoothed, when = drive(scans, FixedLagSmoother(BANK, 0.25), until=49 * 10 * STEP)
    assert_same_rows(causal, smoothed)
    for (t_ns, _), said in zip(smoothed, when, strict=True):
        assert said in (t_ns + 250_000_000, -1)
    assert when.count(-1) == 3


def test_what_is_said_knows_only_the_lag() -> None:
    """A drive that is cut 0.5 s after a scan says the same of that scan."""
    scans = scans_of(vehicle(3, 0, 50))
    _, whole, _ = drive(scans, FixedLagSmoother(BANK, 0.5))
    for k in (10, 24):
        _, cut, _ = drive(scans[: k + 6], FixedIntervalSmoother(BANK))
        assert_equal(whole[k][1], cut[k][1])


@pytest.mark.parametrize("lag", [0.0, -1.0, 0.001, float("nan"), float("inf")])
def test_a_lag_that_is_none(lag: float) -> None:
    with pytest.raises(CanImmError, match="lag"):
        FixedLagSmoother(BANK, lag)


def test_long_tracks_go_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    scans = scans_of(vehicle(3, 0, 200), vehicle(4, 3, 90))
    _, whole, when = drive(scans, FixedIntervalSmoother(BANK))
    assert set(when) == {-1}
    monkeypatch.setattr(smoothing, "BLOCK", 80)
    monkeypatch.setattr(smoothing, "OVERLAP", 50)
    causal, blocks, when = drive(scans, FixedIntervalSmoother(BANK))
    assert when[2:4] == [79 * 10 * STEP, 82 * 10 * STEP], "when all its objects' blocks are full"
    assert_same_rows(causal, blocks)
    for (_, a), (_, b) in zip(whole, blocks, strict=True):
        np.testing.assert_allclose(a["x"], b["x"], atol=1e-3)
        np.testing.assert_allclose(a["p"], b["p"], atol=1e-2)


def test_a_smoother_with_nothing_to_say() -> None:
    for smoother in (FixedIntervalSmoother(BANK), FixedLagSmoother(BANK, 0.1)):
        assert list(smoother.due(10**12)) == []
        assert list(smoother.finish()) == []


def test_the_detector_says_the_same_with_a_smoother() -> None:
    scans, _ = play("random", 3)
    with_one, _, _ = drive(scans, FixedLagSmoother(BANK, 0.2))
    detector = Detector(BANK, capacity=8)
    due = {scan.t_ns: scan for scan in scans}
    for t_ns in range(0, max(due) + 1, STEP):
        n = detector.step(t_ns, due.get(t_ns))
        if t_ns in due:
            assert_equal(detector.reports[:n], with_one.pop(0)[1])


# ---- scans in which an object was missed


def test_a_gap_is_filled_from_both_sides() -> None:
    """Braking while it is hidden: the detector moves it on at constant speed."""
    hidden = (21, 22, 23, 24)
    scans = scans_of(vehicle(3, 0, 60, missing=hidden), vehicle(4, 0, 60))
    causal, smoothed, _ = drive(scans, FixedIntervalSmoother(BANK))
    a, b = of(causal, 3), of(smoothed, 3)
    np.testing.assert_array_equal(np.flatnonzero(b["coasting"]), hidden)
    truth = np.array([30.0 - (0.1 * k - 2.0) ** 2 for k in hidden])
    worst = [np.abs(one["x"][list(hidden), 0] - truth).max() for one in (a, b)]
    assert worst[1] < 0.1 < worst[0]
    assert b["manoeuvre"][30] == Manoeuvre.APPROACHING


def test_after_the_last_measurement_the_detector_has_the_last_word() -> None:
    scans = scans_of(vehicle(3, 0, 20), vehicle(4, 0, 40))
    causal, smoothed, _ = drive(scans, FixedIntervalSmoother(BANK))
    a, b = of(causal, 3), of(smoothed, 3)
    assert a["coasting"][20:].all()
    assert len(a) > 20
    np.testing.assert_array_equal(a[19:]["x"], b[19:]["x"])
    assert_equal(a[20:], b[20:])


def test_a_gap_lies_on_the_cubic() -> None:
    t = np.array([0.0, 0.3, 1.0])
    mean = np.column_stack([t**3 - t, 3 * t**2 - 1, 2.0 - t**2, -2 * t, t])
    expected = mean[1].copy()
    mean[1] = np.nan
    cov = np.stack([np.eye(5), np.full((5, 5), np.nan), 3.0 * np.eye(5)])
    p = np.array([[1.0, 0.0], [np.nan, np.nan], [0.0, 1.0]])
    fill_gap_(0, 2, 1, 0.3, 1.0, mean, cov, p)
    np.testing.assert_allclose(mean[1, [0, 2, 4]], expected[[0, 2, 4]], atol=1e-12)
    np.testing.assert_allclose(cov[1], 1.6 * np.eye(5))
    np.testing.assert_allclose(p[1], [0.7, 0.3])


# ---- the road


class LaneChange:
    """Between detector and smoother: from scan 30 on the ego drives one lane further left, so that
    all lateral positions count from there."""

    def __init__(self, smoother: Any) -> None:
        self._smoother = smoother
        self._count = 0
        par = load_bank("motorway").road
        assert par is not None
        self._road = RoadFrame(par)
        self._road.x[:] = 0.0
        self._road.x[WIDTH] = 3.5
        self._road.speed = 20.0

    def scan(
        self, now: int, objects: Any, ids: Any, measured: Any, reports: Any,
        road: Any, moved: int, scan: Scan, slot: Any,
    ) -> None:  # fmt: skip
        assert road is None
        objects, reports = objects.copy(), reports.copy()
        if self._count >= 30:
            objects["x"][:, :, 2] -= 3.5
            objects["mean"][:, 2] -= 3.5
            reports["x"][:, 2] -= 3.5
        moved = int(self._count == 30)
        self._smoother.scan(now, objects, ids, measured, reports, self._road, moved, scan, slot)
        self._count += 1

    def end(self, slot: int) -> None:
        self._smoother.end(slot)


@pytest.mark.parametrize("lag", [0.4, 100.0])
def test_a_lane_change_of_the_ego_is_no_motion_of_the_others(lag: float) -> None:
    scans = scans_of(vehicle(3, 0, 60, missing=(29, 30, 40)), vehicle(4, 0, 60))
    _, plain, _ = drive(scans, FixedLagSmoother(BANK, lag))
    _, moved, _ = drive(scans, FixedLagSmoother(BANK, lag), history=LaneChange)
    for k, ((_, a), (_, b)) in enumerate(zip(plain, moved, strict=True)):
        expected = a["x"].copy()
        expected[:, 2] -= 3.5 * (k >= 30)
        np.testing.assert_allclose(b["x"], expected, atol=1e-9)
        np.testing.assert_allclose(b["p"], a["p"], atol=1e-9)
        np.testing.assert_array_equal(b["ego_speed"], 20.0)
        assert b.dtype == REPORT_DTYPE


# ---- lane changes on a motorway

MOTORWAY = load_bank("motorway")
assert MOTORWAY.road is not None
SETTLE_S = float(MOTORWAY.road[P_SETTLE])
TURN_S = 2.0


def motorway(seconds: float) -> list[Scan]:
    """Scans of 100 ms: two keep their lanes, one changes to the left from `TURN_S` on."""
    rng = np.random.default_rng(7)
    scans = []
    for k in range(round(10 * seconds)):
        t = 0.1 * k
        u = min(max((t - TURN_S) / 4.0, 0.0), 1.0)
        scan = Scan(3)
        scan.t_ns, scan.n = k * 100_000_000, 3
        scan.ego_speed, scan.ego_yaw_rate = 28.0, 0.0
        scan.ids[:] = 1, 2, 3
        scan.std[:], scan.valid[:] = (0.2, 0.15, 0.1, 0.15), True
        scan.z[:] = [(40, 0, -3.5, 0), (50, 0, 3.5, 0), (30, 0, 0, 0)]
        scan.z[2, 2] += 3.5 * u * u * (3 - 2 * u)
        scan.z[2, 3] = 3.5 * 6 * u * (1 - u) / 4.0
        scan.z += rng.normal(0.0, scan.std)
        scans.append(scan)
    return scans


def on_the_motorway(scans: list[Scan], lag: float | None) -> tuple[Detector, Stream, list[int]]:
    """The detector after all of them, and what a smoother says, or without a lag the detector."""
    detector = Detector(MOTORWAY, capacity=8)
    smoother = detector.history = None if lag is None else FixedLagSmoother(MOTORWAY, lag)
    said: Stream = []
    when: list[int] = []
    for scan in scans:
        n = detector.step(scan.t_ns, scan)
        answers = (
            [(scan.t_ns, detector.reports[:n])] if smoother is None else smoother.due(scan.t_ns)
        )
        for at, reports in answers:
            said.append((at, reports.copy()))
            when.append(scan.t_ns)
    if smoother is not None:
        for at, reports in smoother.finish():
            said.append((at, reports.copy()))
            when.append(-1)
    return detector, said, when


def share(report: Any) -> float:
    """Of lane changes in what is in our direction."""
    p = report["p"]
    return float(p[Manoeuvre.LANE_CHANGE] / (1.0 - p[Manoeuvre.STATIONARY] - p[Manoeuvre.ONCOMING]))


def test_scans_of_nothing() -> None:
    scans = motorway(2.0)
    for scan in (*scans[:3], *scans[10:13]):
        scan.n = 0
    _, said, _ = on_the_motorway(scans, 0.3)
    assert [len(reports) for _, reports in said[:4]] == [0, 0, 0, 3]
    assert len(said) == len(scans)


@pytest.mark.parametrize("lag", [0.05, 0.5, 1.2])
def test_a_lag_knows_of_lane_changes_what_the_filter_knows_then(lag: float) -> None:
    """By the drive until then: another detector that is asked about the past.  A longer lag knows
    no more than the filter did before it settled that."""
    scans = motorway(8.0)
    _, said, when = on_the_motorway(scans, lag)
    probed = 0
    for k in range(15, 66, 4):
        at, reports = said[k]
        known = [scan for scan in scans if scan.t_ns <= when[k]]
        cut = [scan for scan in known if scan.t_ns - at <= round(SETTLE_S * 1e9)]
        detector, _, _ = on_the_motorway(cut, None)
        assert detector.road is not None
        for report in reports:
            (slot,) = np.flatnonzero(detector._id == report["object_id"])
            expected = detector.road.changing(at * 1e-9)[slot]
            assert share(report) == pytest.approx(sum(expected), abs=1e-6)
            if report["manoeuvre"] == Manoeuvre.LANE_CHANGE:
                assert report["direction"] == (1 if expected[0] > expected[1] else -1)
                probed += 1
    assert probed > 5


def onset(stream: Stream) -> float:
    """When the lane change of object 3 began [s]."""
    return min(t_ns * 1e-9 for t_ns, r in stream for one in r if one["object_id"] == 3
               and one["manoeuvre"] == Manoeuvre.LANE_CHANGE)  # fmt: skip


def test_with_a_lag_a_lane_change_is_said_to_have_begun_when_it_did() -> None:
    scans = motorway(8.0)
    causal, lagged = (on_the_motorway(scans, lag)[1] for lag in (None, 1.0))
    assert onset(causal) > onset(lagged) + 0.2
    assert onset(lagged) == pytest.approx(TURN_S, abs=0.4)


def test_a_long_lag_does_not_forget_lane_changes() -> None:
    """The filter does, some time after they have ended."""
    scans = motorway(14.0)
    short, long = (of(on_the_motorway(scans, lag)[1], 3) for lag in (SETTLE_S, 6.0))
    assert sum(share(report) for report in short) > 30.0
    assert [share(r) for r in long] == pytest.approx([share(r) for r in short], abs=0.02)


@pytest.mark.parametrize("reused", [False, True])
@pytest.mark.parametrize("unseen", [False, True])
def test_what_is_pending_when_a_track_ends(reused: bool, unseen: bool) -> None:
    """It is what was known then, and nothing of another object's that has the slot at once."""
    end = 34
    scans, whole = motorway(6.0), motorway(6.0)
    for scan in scans[end:]:
        if reused:
            scan.new[2] = scan is scans[end]
            scan.z[2] = 60.0, 0.0, 0.0, 0.0
        else:
            scan.n = 2
    # where it is is not known at last
    for one in (scans, whole):
        one[end - 1].valid[2, 2] = not unseen
    _, said, _ = on_the_motorway(scans, 1.0)
    last, _, _ = on_the_motorway(whole[:end], None)
    assert last.road is not None
    (slot,) = np.flatnonzero(last._id == 3)
    for at, reports in said[end - 9 : end]:
        (report,) = reports[reports["object_id"] == 3]
        expected = sum(last.road.changing(at * 1e-9)[slot])
        assert share(report) == pytest.approx(expected, abs=1e-6)
    assert share(report) > 0.8
    _, reports = said[end + 3]
    assert (share(reports[reports["object_id"] == 3][0]) < 0.5) == reused
