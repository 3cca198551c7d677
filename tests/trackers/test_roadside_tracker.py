"""The life of a roadside track, and whatever lidars may say."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_imm.estimation import ukf
from can_imm.trackers.roadside import IMM_UKF, Motion, RoadsideTracker
from can_imm.types import CanImmError, DetectionScan

PERIOD = 50_000_000
PLACES = {0: (-8.0, -6.0, 0.2), 1: (92.0, -8.0, 2.5)}
SPEED = 12.0


def position(t_ns):
    """Of a vehicle that drives along y = 0 from x = 10 on."""
    return 10.0 + SPEED * t_ns * 1e-9, 0.0


class Road:
    """Makes scans of the two lidars; ``noise`` in units of the lidars' standard deviations."""

    def __init__(self, noise=0.3):
        self.rng = np.random.default_rng(0)
        self.noise = noise
        self.k = 0

    def scan(self, lidars=(0, 1), *, t_ns=None, counter=None, delay=None, shift=None):
        t_ns = self.k * PERIOD if t_ns is None else t_ns
        scan = DetectionScan(len(PLACES), 8)
        scan.t_ns = t_ns
        for row, name in enumerate(lidars):
            x, y, heading = PLACES[name]
            later = (delay or {}).get(name, 0.0)
            px, py = position(t_ns + later * 1e9)
            dx, dy = (shift or {}).get(name, (0.0, 0.0))
            scan.sensor_id[row] = name
            scan.counter[row] = (self.k if counter is None else counter) % 256
            scan.delay[row] = later
            scan.pose[row] = x, y, heading, 0.0, 0.0
            scan.sensor[row] = row
            scan.z[row] = (
                math.hypot(px + dx - x, py + dy - y) + 0.05 * self.noise * self.rng.normal(),
                math.atan2(py + dy - y, px + dx - x)
                - heading
                + 0.05 * self.noise * self.rng.normal(),
                math.nan,
            )
        scan.n = scan.n_sensors = len(lidars)
        self.k += 1
        return scan


def drive(tracker, road, n, **keywords):
    """n scans; the last answer."""
    said = None
    for _ in range(n):
        scan = road.scan(**keywords)
        said = tracker.step(scan.t_ns + 5_000_000, scan)
    return said


def assert_near(said, tolerance=1.0):
    assert said.n == 1
    x, y = position(said.t_ns)
    assert math.hypot(said.z[0, 0] - x, said.z[0, 2] - y) < tolerance
    assert math.hypot(said.z[0, 1] - SPEED, said.z[0, 3]) < 2.0 * tolerance


@pytest.fixture
def tracker():
    return RoadsideTracker()


def test_follows_a_vehicle_and_says_how_well(tracker):
    road = Road(noise=1.0)
    inside = 0
    for k in range(80):
        scan = road.scan()
        said = tracker.step(scan.t_ns, scan)
        assert said.t_ns == scan.t_ns
        assert said.counter == k
        if k >= 40:
            x, y = position(scan.t_ns)
            inside += np.all(np.abs(said.z[0] - [x, SPEED, y, 0.0]) < 3.0 * said.std[0])
    assert_near(said, 0.5)
    assert inside >= 38
    assert said.ids[0] == IMM_UKF.object_id
    assert said.valid[0].all()
    assert tracker.counts.scans == 80
    assert tracker.counts.detections + tracker.counts.extra == 160
    assert (tracker.counts.births, tracker.counts.deaths, tracker.counts.outliers) == (1, 0, 0)


def test_is_reported_from_the_fourth_detection_on_and_is_new_once(tracker):
    road = Road()
    said = [tracker.step(s.t_ns, s) for s in (road.scan(lidars=(0,)) for _ in range(3))]
    assert said[-1].n == 0
    fourth = drive(tracker, road, 1, lidars=(0,))
    assert (fourth.n, bool(fourth.new[0])) == (1, True)
    assert not drive(tracker, road, 1, lidars=(0,)).new[0]


def test_turns_are_told_from_straights():
    left, right = RoadsideTracker(), RoadsideTracker()
    for tracker, side in ((left, 1.0), (right, -1.0)):
        road, turning = Road(), []
        for k in range(100):
            scan = road.scan(lidars=(0,))
            angle = max(0.0, (k - 60) * 0.05 * 0.5)
            bend = SPEED / 0.5
            x = 10.0 + SPEED * 0.05 * min(k, 60) + bend * math.sin(angle)
            y = side * bend * (1.0 - math.cos(angle))
            px, py, heading = PLACES[0]
            scan.z[0, :2] = math.hypot(x - px, y - py), math.atan2(y - py, x - px) - heading
            tracker.step(scan.t_ns, scan)
            turning.append(tracker.turning)
        assert np.mean(turning[40:60]) < 0.2
        assert np.mean(turning[80:]) > 0.9
        assert tracker.track["mean"][ukf.OMEGA] == pytest.approx(side * 0.5, abs=0.1)


def test_a_vehicle_that_brakes_is_not_lost(tracker):
    road, errors = Road(noise=1.0), []
    for k in range(100):
        scan = road.scan()
        t = k * 0.05
        braking = min(max(t - 2.0, 0.0), 2.5)
        way = SPEED * t - 1.5 * braking**2 - 7.5 * max(t - 4.5, 0.0)
        for row, (x, y, _) in enumerate(PLACES.values()):
            scan.z[row, 0] += math.hypot(10.0 + way - x, y) - math.hypot(
                position(scan.t_ns)[0] - x, y
            )
            old = math.atan2(-y, position(scan.t_ns)[0] - x)
            scan.z[row, 1] += math.atan2(-y, 10.0 + way - x) - old
        said = tracker.step(scan.t_ns, scan)
        if k >= 40:
            errors.append(math.hypot(said.z[0, 0] - 10.0 - way, said.z[0, 2]))
    # 0.39 m without the model for everything else
    assert np.sqrt(np.mean(np.square(errors))) < 0.25
    assert (tracker.counts.outliers, tracker.counts.deaths) == (0, 0)


def test_without_a_scan_nothing_is_said_and_with_an_empty_one_the_track_moves_on(tracker):
    road = Road()
    drive(tracker, road, 40)
    assert tracker.step(road.k * PERIOD, None) is None
    before = tracker.track["cov"][0, 0]
    for _ in range(10):
        scan = road.scan()
        scan.n = 0
        said = tracker.step(scan.t_ns, scan)
    assert_near(said)
    assert said.std[0, 0] ** 2 > 2.0 * before


def test_lidars_that_vanish_are_missed_and_those_that_come_back_are_used(tracker):
    road = Road()
    drive(tracker, road, 30)
    assert_near(drive(tracker, road, 10, lidars=(1,)))
    assert_near(drive(tracker, road, 10, lidars=(0,)))
    assert_near(drive(tracker, road, 5), 0.5)
    assert tracker.counts.deaths == 0


def test_a_track_that_nobody_sees_ends_and_another_begins(tracker):
    road = Road()
    drive(tracker, road, 30)
    last = (road.k - 1) * PERIOD
    assert tracker.step(last + 1_000_000_000, None) is None
    assert tracker.alive
    tracker.step(last + 1_010_000_000, None)
    assert not tracker.alive
    assert (tracker.counts.resets, tracker.counts.deaths) == (1, 1)
    road.k += 60
    assert_near(drive(tracker, road, 30))
    assert tracker.counts.births == 2


def test_repeated_scans_are_counted_and_change_nothing(tracker):
    road = Road()
    drive(tracker, road, 30)
    before = tracker.track.copy()
    scan = road.scan()
    tracker.step(scan.t_ns, scan)
    assert not np.array_equal(tracker.track, before)
    after = tracker.track.copy()
    assert tracker.step(scan.t_ns, scan) is None
    scan.t_ns += PERIOD  # the same measurement with a new time stamp
    assert tracker.step(scan.t_ns, scan) is None
    assert tracker.counts.repeated_sensors == 4
    assert tracker.counts.late_scans == 2
    assert np.array_equal(tracker.track, after)


def test_late_scans_are_counted_and_change_nothing(tracker):
    road = Road()
    drive(tracker, road, 10)
    late = road.scan()
    drive(tracker, road, 20)
    before = tracker.track.copy()
    assert tracker.step(road.k * PERIOD, late) is None
    assert (tracker.counts.late_scans, tracker.counts.late_sensors) == (1, 2)
    assert np.array_equal(tracker.track, before)
    assert_near(drive(tracker, road, 1))


def test_one_late_lidar_does_not_hold_the_other_up(tracker):
    road = Road()
    drive(tracker, road, 20)
    scan = road.scan(delay={1: 0.03})
    tracker.step(scan.t_ns + 40_000_000, scan)
    behind = road.scan(t_ns=scan.t_ns + 20_000_000, delay={1: 0.02})
    used = tracker.counts.detections
    said = tracker.step(behind.t_ns + 40_000_000, behind)
    assert tracker.counts.late_sensors == 1
    assert tracker.counts.detections == used + 1
    assert_near(said)


def test_lidars_with_different_times_are_used_at_their_own(tracker):
    road = Road(noise=0.05)
    said = drive(tracker, road, 60, delay={0: 0.02, 1: 0.0})
    assert said.t_ns == (road.k - 1) * PERIOD + 20_000_000
    assert_near(said, 0.2)
    # as if both had measured at once: the vehicle drives a quarter of a metre in between
    wrong = RoadsideTracker()
    road = Road(noise=0.05)
    for _ in range(60):
        scan = road.scan(delay={0: 0.02})
        scan.delay[:] = 0.0
        said_wrong = wrong.step(scan.t_ns, scan)
    x, _ = position(said_wrong.t_ns)
    assert abs(said_wrong.z[0, 0] - x) > abs(said.z[0, 0] - position(said.t_ns)[0])


def test_of_two_lidars_that_contradict_each_other_the_likely_one_is_believed(tracker):
    road = Road()
    drive(tracker, road, 40)
    said = drive(tracker, road, 20, shift={1: (15.0, 3.0)})
    assert_near(said)
    assert tracker.counts.outliers == 20
    assert tracker.counts.deaths == 0


def test_a_track_where_nothing_is_gives_way_to_what_the_lidars_see(tracker):
    road = Road()
    drive(tracker, road, 20, shift={0: (0.0, 40.0), 1: (0.0, 40.0)})
    said = drive(tracker, road, 40)
    assert_near(said)
    assert tracker.counts.outliers > 0
    assert (tracker.counts.births, tracker.counts.deaths) == (2, 1)


def test_of_two_detections_of_one_lidar_the_likeliest_is_used(tracker):
    road = Road()
    drive(tracker, road, 40)
    used = tracker.counts.detections
    for _ in range(20):
        scan = road.scan()
        scan.n = 4
        scan.sensor[:4] = 0, 0, 1, 1
        near, far = scan.z[0].copy(), scan.z[1].copy()
        scan.z[:4] = near + np.array([0.15, 0.0, 0.0]), near, far, far - np.array([0.15, 0.0, 0.0])
        said = tracker.step(scan.t_ns, scan)
    assert_near(said, 0.6)
    assert tracker.counts.detections == used + 40
    assert tracker.counts.extra + tracker.counts.outliers >= 40


IMPOSSIBLE = [
    ("z", (0, 0), math.nan),
    ("z", (0, 0), math.inf),
    ("z", (0, 0), -1.0),
    ("z", (0, 0), 1e300),
    ("z", (0, 1), math.nan),
    ("z", (0, 1), -math.inf),
    ("z", (0, 1), 1e9),
    ("pose", (0, 0), math.nan),
    ("pose", (0, 1), math.inf),
    ("pose", (0, 2), math.nan),
    ("delay", (0,), math.nan),
    ("delay", (0,), -0.1),
    ("delay", (0,), 1e12),
]


@pytest.mark.parametrize(("what", "where", "value"), IMPOSSIBLE)
def test_impossible_values_are_counted_and_the_other_lidar_is_used(tracker, what, where, value):
    road = Road()
    for k in range(60):
        scan = road.scan()
        if k >= 20:
            getattr(scan, what)[where] = value
        said = tracker.step(scan.t_ns, scan)
    assert_near(said)
    assert tracker.counts.invalid == 40
    assert tracker.counts.numeric_failures == 0
    assert tracker.counts.deaths == 0


def test_a_time_stamp_in_the_future_does_not_stop_the_tracker(tracker):
    road = Road()
    drive(tracker, road, 20)
    broken = road.scan(t_ns=10**15)
    assert tracker.step(road.k * PERIOD, broken) is None
    assert tracker.counts.invalid == 2
    assert_near(drive(tracker, road, 5))


def test_a_numeric_failure_is_counted_and_the_track_begins_anew(tracker):
    road = Road()
    drive(tracker, road, 20)
    tracker.track["P"][0, 0, 0] = -1.0
    said = drive(tracker, road, 1)
    assert said.n == 0
    assert (tracker.counts.numeric_failures, tracker.counts.deaths) == (1, 1)
    assert_near(drive(tracker, road, 40))


def test_what_there_is_no_room_for_is_counted():
    tracker = RoadsideTracker(sensors=1, capacity=1)
    road = Road()
    drive(tracker, road, 30)
    assert tracker.counts.overflow == 30
    scan = road.scan(lidars=(0,))
    scan.n = 3
    scan.sensor[:3] = 0
    scan.z[1:3] = scan.z[0]
    assert_near(tracker.step(scan.t_ns, scan))
    assert tracker.counts.overflow == 32


number = st.floats(allow_nan=True, allow_infinity=True, width=64)


@settings(max_examples=20)
@given(st.lists(st.tuples(number, number, number, number, st.integers(0, 3)), max_size=25))
def test_survives_any_numbers(rows):
    tracker, road = RoadsideTracker(), Road()
    drive(tracker, road, 10)
    for value, other, third, fourth, kind in rows:
        scan = road.scan()
        if kind == 0:
            scan.z[0] = value, other, third
        elif kind == 1:
            scan.pose[1, :4] = value, other, third, fourth
        elif kind == 2:
            scan.delay[:] = value, other
        else:
            scan.z[:2, 0] = abs(value), abs(other)
        said = tracker.step(scan.t_ns, scan)
        if said is not None and said.n:
            assert np.isfinite(said.z[0]).all()
            assert (said.std[0] > 0.0).all()
    road.k += 30
    assert drive(tracker, road, 12).n == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"models": ()}, "models"),
        ({"models": (Motion(ukf.CV, 0.0, 1.0, (0.0, 1.0)),) * 4}, "q"),
        ({"models": (Motion(ukf.CV, 1.0, 1.0, (0.0, 0.0)),) * 4}, "turn"),
        ({"transitions": ((1.0,),)}, "transitions"),
        ({"transitions": ((0.5, 0.5, 0.1, 0.0),) * 4}, "sum to 1"),
        ({"birth": (0.5, 0.5)}, "birth"),
        ({"birth": (0.5, 0.6, 0.1, 0.1)}, "birth"),
        ({"range_std": 0.0}, "range_std"),
        ({"gate": math.nan}, "gate"),
    ],
)
def test_impossible_settings_are_refused(change, message):
    with pytest.raises(CanImmError, match=message):
        RoadsideTracker(replace(IMM_UKF, **change))


def test_no_room_is_refused():
    with pytest.raises(CanImmError, match="room"):
        RoadsideTracker(capacity=0)
