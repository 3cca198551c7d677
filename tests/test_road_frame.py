"""The axes of the road from scan to scan: silence, the ego's lane, the way back, what is said."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest
from filterpy.common import Q_continuous_white_noise
from filterpy.kalman import KalmanFilter
from hypothesis import example, given, settings
from hypothesis import strategies as st
from small_roads import Traffic, parameters

from can_imm.estimation import road, traffic
from can_imm.reporting import judge_changes_, judge_ramps_
from can_imm.road import LONGEST_S, RoadFrame
from can_imm.types import REPORT_DTYPE, LastingErrors, Manoeuvre, Scan

S = 1_000_000_000
NAN = math.nan
FREE = -1
"""Id of a slot that nobody is in."""
LANE = 3.5


def curvature(state: np.ndarray) -> float:
    """Of the road where the ego is."""
    knots = road.SPACING * np.arange(road.N_KNOTS)
    return float(np.interp(state[road.WAY], knots, state[road.KNOT : road.N_ROAD]))


def driven(seconds: float, speed: float = 30.0, yaw_rate: float = 0.02) -> Traffic:
    """Past no vehicles at all, from second 0.1 on."""
    drive = Traffic(parameters())
    for _ in range(int(seconds * 10) + 1):
        drive.nothing(speed=speed, yaw_rate=yaw_rate)
    return drive


def change(t: float, begin: float, seconds: float) -> tuple[float, float]:
    """Way and speed of a smooth lane change at time t, in lanes."""
    u = (t - begin) / seconds
    if not 0.0 < u < 1.0:
        return float(u >= 1.0), 0.0
    return u * u * (3.0 - 2.0 * u), 6.0 * u * (1.0 - u) / seconds


def lanes_of(drive: Traffic, slots: Any) -> list[float]:
    """In which lanes the vehicles are, or between which."""
    T = drive.filter
    best = T["choice"][traffic.best_global(T)]
    t = drive.t_ns * 1e-9
    return [traffic.lane_at(T["local"][best[drive.guide_of[s]]], t)[0] for s in slots]


def test_making_one_leaves_the_road_as_it_is() -> None:
    """Nothing was driven yet."""
    x, P = road.new_road(parameters())
    frame = RoadFrame(parameters())
    np.testing.assert_array_equal(frame.x, x)
    np.testing.assert_array_equal(frame.P, P)
    assert frame.width == 3.5
    assert frame.false_change == 0.5
    assert math.isnan(frame.speed + frame.yaw_rate + frame.acceleration)


def test_warming_up_is_no_drive() -> None:
    """Neither of the ego, nor past the objects that were there."""
    warm, cold = Traffic(parameters(), capacity=4), Traffic(parameters(), capacity=4)
    warm.objects["mean"][:] = warm.objects["x"][:] = 0.7
    objects, age = warm.objects.copy(), warm.age.copy()
    ids, reports = np.full(4, FREE, np.int32), np.zeros(4, REPORT_DTYPE)
    warm.frame.warm_up(
        warm.bank, warm.objects, np.zeros(1, np.int32), np.zeros(1, np.int8), warm.age,
        ids, reports,
    )  # fmt: skip
    assert warm.objects.tobytes() == objects.tobytes()
    assert warm.age.tobytes() == age.tobytes()
    assert reports.tobytes() == np.zeros(4, REPORT_DTYPE).tobytes()
    assert np.isnan(warm.frame.changing(0.05)).all()
    for drive in (warm, cold):
        drive.scan([0, 2], [[40.0, 0.3], [60.0, -3.0]], speed=30.0, yaw_rate=0.01)
    assert warm.filter.tobytes() == cold.filter.tobytes()
    assert warm.frame.x.tobytes() == cold.frame.x.tobytes()


def test_the_first_scan_begins_with_the_bend_that_the_ego_drives() -> None:
    frame = driven(0.0).frame
    assert curvature(frame.x) > 1e-4
    assert frame.x[road.OFFSET] == 0.0
    straight = RoadFrame(parameters())
    straight.move(0, NAN, NAN)
    np.testing.assert_array_equal(straight.x, road.new_road(parameters())[0][: road.N_ROAD])


def wide(seconds: float, width: float = 4.0) -> Traffic:
    """Past three vehicles in lanes of another width than usual."""
    drive = Traffic(parameters())
    for _ in range(int(seconds * 10)):
        drive.scan(
            [0, 1, 4], [[30.0, -width], [50.0, width], [45.0, 0.0]],
            speed=30.0, yaw_rate=0.0, speeds=False,
        )  # fmt: skip
    return drive


@pytest.mark.parametrize(("silence", "anew"), [(0.9, False), (1.1, True), (3600.0, True)])
def test_after_a_long_silence_only_the_width_is_kept(silence: float, anew: bool) -> None:
    drive = wide(20.0)
    frame, T = drive.frame, drive.filter
    width, variance = frame.width, float(frame.P[road.WIDTH, road.WIDTH])
    assert width == pytest.approx(4.0, abs=0.1), "learnt from the traffic"
    assert variance < 0.5 * 0.25**2
    assert (silence > LONGEST_S) == anew
    assert abs(drive.offset) > 1e-6
    frame.move(drive.t_ns + int(silence * S), NAN, NAN)
    assert frame.width == pytest.approx(width, abs=1e-12 if anew else 0.02)
    assert frame.P[road.WIDTH, road.WIDTH] == pytest.approx(variance, rel=1e-9 if anew else 0.1)
    assert (T["party"]["slot"] == traffic.FREE).all() == anew
    assert (drive.guide_of == traffic.FREE).all() == anew
    assert (T["n_global"] == T["n"] == 1) == anew
    assert np.isnan(frame.changing(drive.t_ns * 1e-9)).all() == anew
    if anew:
        x, P = road.new_road(parameters())
        x[road.WIDTH], P[road.WIDTH, road.WIDTH] = width, variance
        np.testing.assert_allclose(frame.x, x, atol=1e-12)
        np.testing.assert_allclose(frame.P, P, rtol=1e-9)


def test_scans_before_a_silence_are_not_learnt_from_after_it() -> None:
    """All is that of a drive that begins there, in lanes of that width."""
    late, fresh = wide(4.0), Traffic(parameters())
    fresh.t_ns = late.t_ns + 5 * S
    fresh.age[:] = late.age
    fresh.frame.x[road.WIDTH] = late.width
    fresh.frame.P[road.WIDTH, road.WIDTH] = late.frame.P[road.WIDTH, road.WIDTH]
    for k in range(40):
        for one in (late, fresh):
            one.scan(
                [0, 1], [[42.0, 0.1 * k], [50.0, -3.0]],
                dt=5.1 if k == 0 and one is late else 0.1, speed=30.0, yaw_rate=0.0,
                speeds=False,
            )  # fmt: skip
        assert late.t_ns == fresh.t_ns
        for name in ("x", "P", "n", "n_global", "log_w"):
            np.testing.assert_array_equal(late.filter[name], fresh.filter[name])
        np.testing.assert_array_equal(late.frame.x, fresh.frame.x)
        np.testing.assert_array_equal(late.frame.P, fresh.frame.P)
        np.testing.assert_array_equal(late.changing(0), fresh.changing(0))
        np.testing.assert_array_equal(late.guide_of, fresh.guide_of)
    assert late.changing(0)[0] > 0.5
    assert late.width != 3.5


@pytest.mark.parametrize(("speed", "yaw_rate"), [(NAN, NAN), (30.0, NAN), (NAN, 0.02)])
def test_unknown_ego_motion(speed: float, yaw_rate: float) -> None:
    frame = driven(60.0, speed, yaw_rate).frame
    assert np.isfinite(frame.x).all()
    assert np.isfinite(frame.P).all()
    assert not frame.x[road.KNOT :].any(), "a yaw rate or a speed alone tells no bend"
    known = driven(60.0).frame
    assert curvature(known.x) > 1e-4
    assert frame.P[road.HEADING, road.HEADING] > known.P[road.HEADING, road.HEADING]


# ---- the ego changes lanes


class EgoChange:
    """An ego that changes lanes from second 4 on within 4.5 s, among vehicles that keep theirs.

    Args:
        by: lanes to the left.  known: the bus tells how it drives.
    """

    ahead, lanes = np.array([25.0, 40.0, 60.0, 90.0]), np.array([-1, 0, 1, 2])
    speed = 28.0

    def __init__(self, by: int, known: bool = True, seed: int = 1) -> None:
        self.drive = Traffic(parameters(), capacity=6)
        self.slots = [0, 1, 3, 5]
        self._rng = np.random.default_rng(seed)
        self._by, self._known, self._heading, self._k = by, known, 0.0, 0

    def scan(self) -> int:
        """The next one; what `RoadFrame.watch_` returns."""
        way, rate = change(0.1 * self._k, 4.0, 4.5)
        before, self._heading = self._heading, self._by * LANE * rate / self.speed
        self._k += 1
        y = LANE * (self.lanes - self._by * way) - self._heading * self.ahead
        return self.drive.scan(
            self.slots, np.column_stack([self.ahead, y + self._rng.normal(0.0, 0.1, 4)]),
            speed=self.speed if self._known else NAN,
            yaw_rate=(self._heading - before) / 0.1 if self._known else NAN, speeds=False,
        )  # fmt: skip

    @property
    def offset(self) -> float:
        """Of the ego from the middle of the lane that it was in at first [m]."""
        return self._by * LANE * change(0.1 * (self._k - 1), 4.0, 4.5)[0]


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("known", [True, False])
def test_the_ego_is_in_the_next_lane_once_it_is_nearer_to_it(side: int, known: bool) -> None:
    """It is told once, and everybody's lane has another number from then on; they keep theirs."""
    ego = EgoChange(side, known)
    drive = ego.drive
    ids = np.array([7, 8, FREE, 9, FREE, 10], np.int32)
    reports = np.zeros(6, REPORT_DTYPE)
    told, at, p, seen = 0, NAN, [], []
    for k in range(120):
        drive.objects["mean"][:, 2] = drive.objects["x"][:, 1, 2] = 0.7
        moved = ego.scan()
        shift = 0.7 - moved * drive.width
        np.testing.assert_allclose(drive.objects["mean"][:, 2], shift)
        np.testing.assert_allclose(drive.objects["x"][:, 1, 2], shift)
        if moved:
            assert told == 0
            told, at = moved, ego.offset
        assert abs(drive.offset) <= 0.5 * drive.width
        seen.append(drive.offset + told * drive.width - ego.offset)
        assert lanes_of(drive, ego.slots) == pytest.approx((ego.lanes - told).tolist(), abs=0.1)
        reports["p"] = 0.0
        reports["p"][:, KL] = 1.0
        drive.frame.judge_(ids, reports, drive.t_ns)
        if k > 5:
            p.append(reports["p"][:4, LC].max())
    assert told == side
    assert at * side == pytest.approx(0.5 * LANE, abs=0.5)
    assert max(p) < 0.3
    assert np.abs(seen).max() < (0.5 if known else 1.0)
    assert np.abs(seen[-20:]).max() < 0.25


@pytest.mark.parametrize("side", [1, -1])
def test_another_lane_of_the_ego_changes_numbers_and_nothing_else(
    side: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lane k of those before is lane k - 1, or k + 1, of those now, and as well known."""
    ego = EgoChange(side)
    frames: list[RoadFrame] = []
    count = RoadFrame._change_lane

    def remember(self: RoadFrame, bank: Any, objects: Any, moved: int) -> None:
        frames.append(copy.deepcopy(self))
        count(self, bank, objects, moved)

    monkeypatch.setattr(RoadFrame, "_change_lane", remember)
    lanes: list[float] = []
    while not ego.scan():
        lanes = lanes_of(ego.drive, ego.slots)
    (before,), now = frames, ego.drive.frame
    assert before.width == now.width
    assert lanes_of(ego.drive, ego.slots) == pytest.approx([k - side for k in lanes], abs=0.01)
    for x in (0.0, 40.0, 120.0):
        for k in (-1, 0, 2):
            places, variances = [], []
            for frame, lane in ((before, k), (now, k - side)):
                h = np.zeros(road.N_ROAD + 1)
                road.lane_row_(h, frame.x[road.WAY], x)
                h[road.WIDTH] = lane
                places.append(road.value(frame.x, h))
                variances.append(road.variance(frame.P, h))
            assert places[1] == pytest.approx(places[0], abs=1e-9)
            # hypotheses that differ by the width are not told apart to the last digit
            assert variances[1] == pytest.approx(variances[0], rel=1e-3)
    t = ego.drive.t_ns * 1e-9
    np.testing.assert_array_equal(now.changing(t), before.changing(t))


# ---- into the road's axes and back


def test_what_the_bus_stops_telling_is_forgotten() -> None:
    drive = driven(5.0)
    frame = drive.frame
    scan = Scan(1)
    scan.n, scan.valid[0], scan.z[0] = 1, True, (40.0, 0.0, 3.5, 0.0)
    for speed, expected in ((30.0, True), (NAN, False)):
        drive.nothing(speed=speed, yaw_rate=0.02)
        z, r = scan.z.copy(), np.full((1, 4), 0.01)
        frame.localise_(scan, z, r)
        assert (z[0, 2] != scan.z[0, 2]).all()
        assert (z[0, 3] != scan.z[0, 3]) == expected, "lateral speeds are those against the ego"


def test_reports_go_back_to_the_sensors_axes() -> None:
    frame = driven(5.0).frame
    scan = Scan(3)
    scan.n = 3
    scan.valid[:] = True
    scan.z[:] = [(20.0, 1.0, 0.0, 0.1), (50.0, -5.0, 3.5, 0.0), (90.0, 0.0, -3.0, -0.5)]
    z, r = scan.z.copy(), np.full((3, 4), 0.01)
    frame.localise_(scan, z, r)
    assert np.abs(z[:, 2] - scan.z[:, 2]).min() > 0.01
    reports = np.zeros(3, REPORT_DTYPE)
    reports["x"] = z
    frame.globalise_(reports, 2)
    np.testing.assert_allclose(reports["x"][:2], scan.z[:2], atol=1e-9)
    np.testing.assert_array_equal(reports["x"][2], z[2], "only the first n")
    assert reports["ego_speed"].tolist() == [30.0, 30.0, 0.0]


def test_errors_that_last_count_across_the_line_of_sight() -> None:
    """They add to the variance of y, and of nothing else; the road's own error does as well."""
    frame = driven(5.0).frame
    scan = Scan(2)
    scan.n, scan.valid[:] = 2, True
    scan.z[:] = (40.0, 0.0, 3.5, 0.0)
    added = []
    lasting = LastingErrors(0.2, 0.4, 0.004, 1.0, 0.01, 1.0, period_s=0.05)
    for scan.lasting in (None, lasting):
        z, r = scan.z.copy(), np.full((2, 4), 0.01)
        frame.localise_(scan, z, r)
        np.testing.assert_array_equal(z[0], z[1])
        assert (r[:, 2:] > 0.01).all()
        added.append(r)
    of_y = 8 * 0.2**2 + 20 * (0.004 * 40.0) ** 2
    np.testing.assert_allclose(added[1] - added[0], [[0.0, 0.0, of_y, 0.0]] * 2, atol=1e-12)
    seldom = lasting._replace(period_s=2.0)
    assert seldom.as_white(np.array([0.0, 40.0])) == pytest.approx([0.04, 0.04 + 0.16**2])


# ---- who changes lanes

LC, KL = Manoeuvre.LANE_CHANGE, Manoeuvre.KEEP_LANE
RELATIVE = [m for m in Manoeuvre if m > 0 and m not in (Manoeuvre.STATIONARY, Manoeuvre.ONCOMING)]
OTHERS = [m for m in RELATIVE if m != LC]
SHARES = st.floats(0.0, 1.0)


def judged(p: Any, sides: tuple[float, float], vx: float = 0.0, direction: int = 1) -> Any:
    """The report that is made of one with these probabilities."""
    reports = np.zeros(2, REPORT_DTYPE)
    reports["p"] = p
    reports["x"][:, 1] = vx
    reports["direction"] = direction
    untouched = reports.copy()
    judge_changes_(np.array([sides, sides]), reports, 1)
    for name in REPORT_DTYPE.names or ():
        np.testing.assert_array_equal(reports[name][1], untouched[name][1], "only the first n")
    return reports[0]


@given(st.lists(SHARES, min_size=len(Manoeuvre) - 1, max_size=len(Manoeuvre) - 1), SHARES, SHARES)
def test_who_changes_lanes_is_said_by_the_filter_and_the_rest_by_the_modes(
    shares: list[float], change: float, left: float
) -> None:
    p = np.array([0.0, *shares])
    p[1:] += 0.01
    p /= p.sum()
    report = judged(p, (change * left, change - change * left))
    ours = p[RELATIVE].sum()
    expected = p.copy()
    expected[OTHERS] *= ours * (1.0 - change) / p[OTHERS].sum()
    expected[LC] = ours * change
    np.testing.assert_allclose(report["p"], expected, atol=1e-12)
    np.testing.assert_array_equal(report["p"][[Manoeuvre.STATIONARY, Manoeuvre.ONCOMING]],
                                  p[[Manoeuvre.STATIONARY, Manoeuvre.ONCOMING]])  # fmt: skip
    assert report["probability"] == report["p"][1:].max() == report["p"][report["manoeuvre"]]
    assert report["second_probability"] == np.sort(report["p"][1:])[-2]
    if report["manoeuvre"] != LC:
        assert report["direction"] == 0
    elif abs(left - 0.5) > 1e-6:
        assert report["direction"] == (1 if left > 0.5 else -1)


@pytest.mark.parametrize(
    ("vx", "expected"),
    [
        (0.0, KL), (0.5, KL), (-0.5, KL),
        (0.7, Manoeuvre.RECEDING), (-0.7, Manoeuvre.APPROACHING),
    ],
)  # fmt: skip
@pytest.mark.parametrize("rest", [0.0, 1e-5])
def test_where_the_modes_know_of_nothing_else_the_speed_tells(
    vx: float, expected: int, rest: float
) -> None:
    p = np.zeros(REPORT_DTYPE["p"].shape)
    p[[LC, Manoeuvre.KEEP_LEFT]] = 0.9 - rest, rest
    p[Manoeuvre.ONCOMING] = 0.1
    report = judged(p, (0.1, 0.2), vx)
    assert report["p"][LC] == pytest.approx(0.9 * 0.3)
    assert report["p"][expected] == pytest.approx(0.9 * 0.7)
    assert report["p"].sum() == pytest.approx(1.0, abs=1e-9)
    assert report["manoeuvre"] == expected
    assert report["direction"] == 0


def test_of_whom_nothing_is_known_the_modes_have_their_say() -> None:
    p = np.zeros(REPORT_DTYPE["p"].shape)
    p[[LC, KL]] = 0.7, 0.3
    report = judged(p, (NAN, NAN), direction=-1)
    np.testing.assert_array_equal(report["p"], p)
    assert report["direction"] == -1


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("angle", [0.0, 0.05])
def test_vehicles_are_followed_in_the_axes_of_the_road(side: int, angle: float) -> None:
    """In a bend that the ego and all others drive, up to 10 m to the side of where it looks; one of
    them leaves its lane to the outside."""
    bent, speed = 0.002 * side, 30.0
    drive = Traffic(parameters(), capacity=6)
    ids = np.array([7, 8, FREE, 9, 10, 11], np.int32)
    reports = np.zeros(6, REPORT_DTYPE)
    first = np.array([80.0, 85.0, 90.0, 95.0, 100.0])
    lanes = np.array([1.0, -1.0, 0.0, 1.0, -1.0])
    said = []
    for k in range(140):
        u = min(max((0.1 * k - 10.0) / 4.0, 0.0), 1.0)
        x = first - 0.4 * k
        y = 3.5 * lanes + 0.5 * bent * x**2
        y[2] -= side * 3.5 * u * u * (3.0 - 2.0 * u)
        drive.scan(
            [0, 1, 3, 4, 5], np.column_stack([x, y]),
            speed=speed, yaw_rate=bent * speed, angle=angle, speeds=False,
        )  # fmt: skip
        reports["p"] = 0.0
        reports["p"][:, [KL, LC]] = 0.5
        drive.frame.judge_(ids, reports, drive.t_ns)
        said.append(reports[:5].copy())
    p = np.array(said)["p"][:, :, LC]
    keepers = [0, 1, 3, 4]
    assert p[20:, keepers].max() < 0.3, "they follow the road"
    assert p[20:100, 2].max() < 0.3
    assert p[100:, 2].max() > 0.99
    turned = said[100 + int(p[100:, 2].argmax())][2]
    assert turned["manoeuvre"] == LC
    assert turned["direction"] == -side
    # told by slot of a time that has passed
    then = drive.frame.changing(12.0)
    assert then[3, 0 if side < 0 else 1] > 0.99
    assert np.nanmax(then[[0, 1, 4, 5]]) < 0.1
    assert np.isnan(then[2]).all(), "nobody is there"
    assert np.isnan(drive.frame.changing(0.05)).all(), "before the first scan"


# ---- the past


def one_leaves(t: float) -> list[list[float]]:
    """Three vehicles, of which the second changes to the left from second 3 on within 4 s."""
    return [[30.0, -LANE], [45.0, LANE * change(t, 3.0, 4.0)[0]], [60.0, LANE]]


def test_a_lane_change_is_seen_to_have_begun_before_it_was_said() -> None:
    """Asked about the same moment, the filter says more of it the more it has seen."""
    drive = Traffic(parameters(), capacity=5)
    at_once, later = [], []
    for k in range(60):
        drive.scan([0, 2, 4], one_leaves(0.1 * k), speed=28.0, yaw_rate=0.0, speeds=False)
        at_once.append(drive.changing(2))
        later.append(drive.frame.changing((drive.t_ns - 8 * S // 10) * 1e-9)[2])
    left, later_left = np.array(at_once)[:, 0], np.array(later)[8:, 0]
    assert np.isnan(np.array(later)[:8]).all(), "nothing was seen then"
    # one row each for the same moment
    left = left[: len(later_left)]
    t = 0.1 * np.arange(len(left))
    assert later_left[t < 2.5].max() < 0.1
    begun = [t[np.argmax(one > 0.5)] for one in (left, later_left)]
    assert begun[0] - begun[1] > 0.35
    assert begun[1] == pytest.approx(3.4, abs=0.3)
    told = drive.frame.changing(drive.t_ns * 1e-9)
    assert np.isnan(told[[1, 3]]).all(), "nobody is there"
    assert np.nanmax(told[[0, 4]]) < 0.1


def test_of_the_present_moment_it_is_what_is_said() -> None:
    """In the reports of the slots in use, in their order, and with the times of the change."""
    drive = Traffic(parameters(), capacity=5)
    ids = np.array([11, FREE, 12, FREE, 13], np.int32)
    for k in range(52):
        drive.scan([0, 2, 4], one_leaves(0.1 * k), speed=28.0, yaw_rate=NAN, speeds=False)
    reports = np.zeros(5, REPORT_DTYPE)
    reports["p"][:, KL] = 1.0
    untouched = reports.copy()
    drive.frame.judge_(ids, reports, drive.t_ns)
    known = drive.frame.changing(drive.t_ns * 1e-9)[[0, 2, 4]]
    np.testing.assert_allclose(reports["p"][:3, LC], known.sum(axis=1), atol=1e-12)
    assert reports["manoeuvre"][:3].tolist() == [KL, LC, KL]
    assert reports["direction"][:3].tolist() == [0, 1, 0]
    assert np.isnan(reports["change"][[0, 2]]).all()
    # the first scan is at 0.1 s
    assert reports["change"][1] == pytest.approx([3.1, 7.1], abs=0.6)
    for name in REPORT_DTYPE.names or ():
        np.testing.assert_array_equal(reports[name][3:], untouched[name][3:])


# ---- nothing to be seen, nothing known, and the same again


def test_a_scan_of_nothing() -> None:
    """Of the first one, and of some amid the traffic."""
    drive = Traffic(parameters(), capacity=3)
    ids, reports = np.full(3, FREE, np.int32), np.zeros(3, REPORT_DTYPE)
    assert drive.scan([], [], speed=28.0, yaw_rate=0.0) == 0
    drive.frame.judge_(ids, reports, drive.t_ns)
    drive.frame.globalise_(reports, 0)
    assert reports.tobytes() == np.zeros(3, REPORT_DTYPE).tobytes()
    assert drive.frame.changing(0.1).shape == (3, 2)
    assert np.isnan(drive.frame.changing(0.1)).all()
    places = [[30.0, 0.1], [45.0, 3.4]]
    drive.scan([0, 2], places, speed=28.0, yaw_rate=0.0)
    for _ in range(4):
        drive.scan([0, 2], places, speed=28.0, yaw_rate=0.0)
        for seconds, followed in ((0.1, True), (0.9, True), (1.1, False)):
            later = copy.deepcopy(drive)
            for _ in range(round(10 * seconds)):
                assert later.scan([], [], speed=28.0, yaw_rate=0.0) == 0
            assert (later.guide_of[[0, 2]] >= 0).all() == followed
            assert np.isfinite(later.frame.x).all()
            assert np.isnan(later.changing(0)).all() == (not followed)


class Random:
    """A long drive past many: they come and go and change lanes; the ego does, too, on a road that
    winds, and what the bus tells of it is lost now and then."""

    def __init__(self, seed: int, capacity: int = 12) -> None:
        self.drive = Traffic(parameters(), capacity)
        self._rng = rng = np.random.default_rng(seed)
        self._x = rng.uniform(5.0, 200.0, capacity)
        self._there = np.ones(capacity, np.bool_)
        # by vehicle, and last the ego: the lane, and the next one from when on
        self._lane = np.append(rng.integers(-2, 3, capacity), 0)
        self._next, self._from = self._lane.copy(), np.full(capacity + 1, -9.0)
        self._bend, self._wave = rng.uniform(0.0, 6e-4), 1.0 / rng.uniform(100.0, 300.0)
        self._s, self._t, self._heading, self._speed = 0.0, 0.0, 0.0, 30.0
        self._lost, self.lane = 0, 0.0

    def _road(self, x: Any) -> Any:
        """Where it is x ahead, if it winds like a sine."""
        at, across = self._wave * self._s, self._bend / self._wave
        bent = (np.sin(at + self._wave * x) - math.sin(at)) / self._wave
        return across * (x * math.cos(at) - bent)

    def scan(self) -> int:
        """The next one; what `RoadFrame.watch_` returns."""
        rng, n = self._rng, len(self._x)
        dt = float(rng.choice([0.02, 0.07, 0.1, 0.1, 0.3]))
        self._t += dt
        self._s += self._speed * dt
        self._speed = float(np.clip(self._speed + rng.normal(0.0, 0.5) * dt, 20.0, 40.0))
        begins = (rng.random(n + 1) < 0.03 * dt) & (self._t - self._from > 6.0)
        self._lane[begins], self._from[begins] = self._next[begins], self._t
        aside = np.clip(self._lane + rng.choice([-1, 1], n + 1), [-2] * n + [-1], [2] * n + [1])
        self._next[begins] = aside[begins]
        ways = [change(self._t, begin, 4.5) for begin in self._from]
        lanes = self._lane + (self._next - self._lane) * np.array(ways)[:, 0]
        self.lane, before = lanes[-1], self._heading
        self._heading = LANE * (self._next - self._lane)[-1] * ways[-1][1] / self._speed
        others = rng.random(n) < 0.03 * dt
        self.drive.age[others] = 0
        self._x[others] = rng.uniform(5.0, 200.0, n)[others]
        self._there ^= rng.random(n) < 0.2 * dt
        if rng.random() < 0.1 * dt:
            self._lost = int(rng.integers(4))
        seen = np.flatnonzero(self._there)
        x = self._x[seen]
        y = LANE * (lanes[seen] - self.lane) - self._heading * x + self._road(x)
        turning = self._bend * self._speed * math.sin(self._wave * self._s)
        turning += (self._heading - before) / dt
        return self.drive.scan(
            seen, np.column_stack([x, y + rng.normal(0.0, 0.15, len(seen))]), dt=dt,
            speed=NAN if self._lost in (1, 3) else self._speed,
            yaw_rate=NAN if self._lost in (2, 3) else turning, speeds=False,
        )  # fmt: skip


KEPT = ("x", "P", "n", "n_global", "log_w", "choice", "rest", "mean", "odds")
"""Of the filter."""


def assert_is_covariance(P: Any) -> None:
    """Symmetric, and positive but for what is known without a doubt and for rounding."""
    assert np.isfinite(P).all()
    np.testing.assert_allclose(P, P.T, rtol=1e-11, atol=1e-18)
    known = P.diagonal() == 0.0
    assert not P[known].any()
    std = np.sqrt(P.diagonal()[~known])
    correlation = P[np.ix_(~known, ~known)] / np.outer(std, std)
    assert np.linalg.eigvalsh(correlation).min() > -1e-9


@settings(max_examples=4)
@given(st.integers(0, 2**32 - 1))
@example(12)
@example(13)
def test_on_a_long_drive_the_covariance_stays_one_and_the_road_where_it_is(seed: int) -> None:
    """Of the road, and of the road and all vehicles together."""
    drive = Random(seed)
    frame, T = drive.drive.frame, drive.drive.filter
    lanes = 0
    for k in range(320):
        lanes += drive.scan()
        if k % 20:
            continue
        top = int(T["top"])
        assert_is_covariance(T["P"][:top, :top])
        assert not T["P"][top:].any()
        assert_is_covariance(frame.P)
        assert np.isfinite(frame.x).all()
        assert 0.0 <= frame.x[road.WAY] < road.SPACING
        assert abs(frame.x[road.OFFSET]) <= 0.5 * frame.width
        assert frame.width == pytest.approx(LANE, abs=0.3)
        assert frame.x[road.OFFSET] == pytest.approx(LANE * (drive.lane - lanes), abs=1.2)
        p = frame.changing(drive.drive.t_ns * 1e-9)
        known = drive.drive.guide_of != traffic.FREE
        assert np.isnan(p[~known]).all()
        assert p[known].min() >= 0.0
        assert p[known].sum(axis=1).max() <= 1.0 + 1e-9


def test_the_same_scans_say_the_same_bit_for_bit() -> None:
    """Of two filters, and of one copied on the way."""
    one, two = Random(3, 6), Random(3, 6)
    for k in range(160):
        if k == 80:
            two = copy.deepcopy(one)
        assert one.scan() == two.scan()
        t = one.drive.t_ns * 1e-9
        for a, b in (
            *((one.drive.filter[name], two.drive.filter[name]) for name in KEPT),
            (one.drive.frame.x, two.drive.frame.x),
            (one.drive.frame.P, two.drive.frame.P),
            (one.drive.frame.changing(t), two.drive.frame.changing(t)),
        ):
            assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


@pytest.mark.parametrize("swapped", [False, True])
def test_a_second_track_of_a_vehicle_is_said_to_do_the_same(swapped: bool) -> None:
    """Whichever slot the older one has; the road is the same as without the second."""
    alone, both = Traffic(parameters(), capacity=5), Traffic(parameters(), capacity=5)
    older, twin = (3, 0) if swapped else (0, 3)
    ids = np.array([7, 8, FREE, 9, 10], np.int32)
    reports = np.zeros(5, REPORT_DTYPE)
    for k in range(60):
        at = one_leaves(0.1 * k)
        alone.scan([1, older, 4], at, speed=28.0, yaw_rate=0.0, speeds=False)
        second = [[at[1][0] + 1.5, at[1][1] + 0.3]] if k >= 10 else []
        slots = [1, older, 4, twin][: 3 + len(second)]
        both.scan(slots, [*at, *second], speed=28.0, yaw_rate=0.0, speeds=False)
        np.testing.assert_array_equal(both.frame.x, alone.frame.x)
        np.testing.assert_array_equal(both.frame.P, alone.frame.P)
        if not second:
            continue
        reports["p"] = 0.0
        reports["p"][:, KL] = 1.0
        both.frame.judge_(ids, reports, both.t_ns)
        # rows of the slots 0 and 3
        for name in ("p", "manoeuvre", "direction", "change"):
            np.testing.assert_array_equal(reports[name][0], reports[name][2])
        if k == 50:
            assert reports["manoeuvre"][:4].tolist() == [LC, KL, LC, KL]
    assert (both.filter["party"]["slot"] != traffic.FREE).sum() == 3


@pytest.mark.parametrize(("speed", "yaw_rate"), [(NAN, NAN), (28.0, NAN), (NAN, 0.0)])
def test_what_is_said_without_the_egos_motion(speed: float, yaw_rate: float) -> None:
    """Who changes lanes all the same; who approaches since the ego is faster is not known."""
    drive = Traffic(parameters(), capacity=3)
    ids, reports = np.array([7, 8, 9], np.int32), np.zeros(3, REPORT_DTYPE)
    said = []
    for k in range(110):
        # at last it speeds up, as far as the bus tells
        v = speed + 0.07 * max(k - 80, 0)
        drive.scan([0, 1, 2], one_leaves(0.1 * k), speed=v, yaw_rate=yaw_rate, speeds=False)
        reports["p"] = 0.0
        reports["p"][:, KL] = 1.0
        reports["x"][:, 1] = -0.4
        drive.frame.judge_(ids, reports, drive.t_ns)
        said.append(reports.copy())
    told = np.array(said)
    p, t = told["p"], 0.1 * np.arange(110)
    assert p[(t > 4.8) & (t < 6.3), 1, LC].min() > 0.9
    assert p[(t > 1.0) & (t < 3.0), 1, LC].max() < 0.1
    assert p[t > 8.0, 1, LC].max() < 0.1
    assert p[t > 1.0][:, [0, 2], LC].max() < 0.3
    assert (told["direction"][told["manoeuvre"] == LC] == 1).all()
    approach = p[:, 0, Manoeuvre.APPROACHING]
    assert approach[t < 7.9].max() < 0.02
    assert math.isnan(drive.frame.acceleration) == math.isnan(speed)
    assert (approach[-1] > 0.5) == (not math.isnan(speed))
    assert math.isnan(speed) == (not approach.any())


# ---- the ego changes its speed


def test_the_egos_acceleration_is_that_of_a_kalman_filter() -> None:
    rng = np.random.default_rng(5)
    frame, kf = RoadFrame(parameters()), KalmanFilter(2, 1)
    times = np.cumsum(rng.uniform(0.03, 0.1, 80))
    kf.x, kf.P, kf.R[:] = np.array([[20.0], [0.0]]), np.diag([0.06**2, 0.3**2]), 0.06**2
    kf.H[:] = 1.0, 0.0
    frame.move(0, 20.0, 0.0)
    assert frame.acceleration == 0.0
    before = 0
    for t in times.tolist():
        t_ns = round(t * 1e9)
        dt = (t_ns - before) * 1e-9
        before = t_ns
        speed = 20.0 + 0.8 * max(t - 2.0, 0.0) + rng.normal(0.0, 0.06)
        frame.move(t_ns, speed, 0.0)
        kf.F = np.array([[1.0, dt], [0.0, 1.0]])
        kf.Q = Q_continuous_white_noise(2, dt, 0.3)
        kf.predict()
        kf.update(speed)
        assert frame.acceleration == pytest.approx(kf.x[1, 0], abs=1e-9)
    assert frame.acceleration == pytest.approx(0.8, abs=0.25)
    frame.move(before + S // 10, NAN, 0.0)
    assert math.isnan(frame.acceleration)
    frame.move(before + S // 5, 23.0, 0.0)
    assert frame.acceleration == 0.0


@pytest.mark.parametrize("slower", [True, False])
def test_who_keeps_their_speed_approaches_as_soon_as_the_ego_is_faster(slower: bool) -> None:
    a, (to, other) = 0.7, (Manoeuvre.APPROACHING, Manoeuvre.RECEDING)
    if slower:
        a, to, other = -a, other, to
    reports = np.zeros(5, REPORT_DTYPE)
    reports["x"][:, 1] = np.array([-0.3, 0.0, 0.3, -0.3, 0.0]) * np.sign(a)
    reports["p"][:, KL], reports["p"][:, LC] = 0.9, 0.1
    reports["p"][3] = np.eye(len(Manoeuvre))[LC]
    reports["manoeuvre"] = KL
    before = reports["p"].copy()
    judge_ramps_(a, reports, 4)
    np.testing.assert_allclose(reports["p"].sum(axis=1), before.sum(axis=1), rtol=1e-12)
    share = reports["p"][:3, to] / 0.9
    assert share[0] > 0.8, "it is slower already"
    assert share[0] > share[1] > share[2]
    assert share[2] < 0.2, "it goes along"
    np.testing.assert_array_equal(reports["p"][:, other], before[:, other])
    np.testing.assert_array_equal(reports["p"][3:], before[3:], "keeps no lane; beyond n")
    assert reports["manoeuvre"][:4].tolist() == [to, to if share[1] > 0.5 else KL, KL, LC]
    calm = reports.copy()
    judge_ramps_(0.05 * a, calm, 3)
    np.testing.assert_allclose(calm["p"], reports["p"], atol=0.01)
