"""The axes of the road from scan to scan: what is learnt when, silence, and the way back."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest
from filterpy.common import Q_continuous_white_noise
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm
from small_roads import KEEP, LEFT, Traffic, parameters

from can_imm.estimation import guides, road
from can_imm.relations import MEMORY_DTYPE
from can_imm.reporting import WANDER_SPEED, doubt_, judge_changes_, judge_ramps_
from can_imm.road import LONGEST_S, SCANS, RoadFrame
from can_imm.types import REPORT_DTYPE, Manoeuvre, Scan

S = 1_000_000_000
NAN = math.nan
FREE = -1
"""Id of a slot that nobody is in."""


def curvature(state: np.ndarray) -> float:
    """Of the road where the ego is."""
    knots = road.SPACING * np.arange(road.N_KNOTS)
    return float(np.interp(state[road.WAY], knots, state[road.KNOT : road.N_ROAD]))


def driven(seconds: float, speed: float = 30.0, yaw_rate: float = 0.02) -> Traffic:
    """Past no vehicles at all, from second 0.1 on."""
    traffic = Traffic(parameters())
    for _ in range(int(seconds * 10) + 1):
        traffic.nothing(speed=speed, yaw_rate=yaw_rate)
    return traffic


def test_making_one_leaves_the_road_as_it_is() -> None:
    """Compiling must not drive."""
    x, P = road.new_road(parameters())
    frame = RoadFrame(parameters())
    np.testing.assert_array_equal(frame.x, x[: road.N_ROAD])
    np.testing.assert_array_equal(frame.P, P[: road.N_ROAD, : road.N_ROAD])
    assert frame.width == 3.5
    fresh = RoadFrame(parameters())
    for one in (frame, fresh):
        one.move(S, 30.0, 0.01)
    np.testing.assert_array_equal(frame._past, fresh._past)


def test_the_first_scan_begins_with_the_bend_that_the_ego_drives() -> None:
    frame = driven(0.0).frame
    assert curvature(frame.x) > 1e-4
    assert frame.x[road.OFFSET] == 0.0
    straight = RoadFrame(parameters())
    straight.move(0, NAN, NAN)
    np.testing.assert_array_equal(straight.x, road.new_road(parameters())[0][: road.N_ROAD])


@pytest.mark.parametrize(("silence", "anew"), [(0.9, False), (1.1, True), (3600.0, True)])
def test_after_a_long_silence_only_the_width_is_kept(silence: float, anew: bool) -> None:
    traffic = driven(10.0)
    frame = traffic.frame
    traffic.x[[road.WIDTH, road.OFFSET]] = 3.8, 1.0
    traffic.P[road.WIDTH, road.WIDTH] = 0.001
    traffic.guide_slot[4] = 2
    assert (silence > LONGEST_S) == anew
    frame.move(traffic.t_ns + int(silence * S), NAN, NAN)
    assert frame.width == pytest.approx(3.8)
    assert frame.P[road.WIDTH, road.WIDTH] == pytest.approx(0.001)
    assert (frame.x[road.OFFSET] == 0.0) == anew
    assert (traffic.guide_slot == road.FREE).all() == anew
    if anew:
        others = np.arange(road.N) != road.WIDTH
        x, P = road.new_road(parameters())
        np.testing.assert_array_equal(traffic.x[others], x[others])
        np.testing.assert_array_equal(traffic.P[others], P[others])
        np.testing.assert_array_equal(frame.x, traffic.x[: road.N_ROAD])
        np.testing.assert_array_equal(frame.P, traffic.P[: road.N_ROAD, : road.N_ROAD])


def test_scans_before_a_silence_are_not_learnt_from_after_it() -> None:
    """The road after it is that of a drive that begins there."""
    late, fresh = Traffic(parameters()), Traffic(parameters())
    for _ in range(7):
        late.scan([0, 1], [[40.0, 1.0], [50.0, -2.5]], speed=30.0, yaw_rate=0.02)
    fresh.t_ns = late.t_ns + 5 * S
    fresh.age[:] = late.age
    fresh.x[road.WIDTH] = late.x[road.WIDTH]
    fresh.P[road.WIDTH, road.WIDTH] = late.P[road.WIDTH, road.WIDTH]
    for k in range(9):
        for traffic in (late, fresh):
            traffic.scan(
                [0, 1], [[42.0, 0.2 * k], [50.0, -3.0]],
                dt=5.1 if k == 0 and traffic is late else 0.1, speed=30.0, yaw_rate=0.0,
            )  # fmt: skip
        assert late.t_ns == fresh.t_ns
        np.testing.assert_array_equal(late.x, fresh.x)
        np.testing.assert_array_equal(late.P, fresh.P)
        np.testing.assert_array_equal(late.frame.x, fresh.frame.x)
    assert late.offset != 0.0


@pytest.mark.parametrize(("speed", "yaw_rate"), [(NAN, NAN), (30.0, NAN), (NAN, 0.02)])
def test_unknown_ego_motion(speed: float, yaw_rate: float) -> None:
    frame = driven(60.0, speed, yaw_rate).frame
    assert np.isfinite(frame.x).all()
    assert np.isfinite(frame.P).all()
    assert not frame.x[road.KNOT :].any(), "a yaw rate or a speed alone tells no bend"
    known = driven(60.0).frame
    assert curvature(known.x) > 1e-4
    assert frame.P[road.HEADING, road.HEADING] > known.P[road.HEADING, road.HEADING]


# ---- what is learnt when


class Diary:
    """The same by a list of all scans: what is far enough back was learnt from, in its order.

    The present road is predicted from what was learnt up to the scan before, as the new one's
    objects are put into it before they are learnt from; unless nothing is left to predict.
    """

    def __init__(self, par: np.ndarray, hindsight: float) -> None:
        self.par, self.hindsight = par, hindsight
        self.x, self.P = road.new_road(par)
        self.slots = np.full(road.N_GUIDES, road.FREE, np.int32)
        self.unseen = np.zeros(road.N_GUIDES)
        self.scans: list[tuple[float, float, float, Any]] = []
        self.t, self.learnt = 0.0, 0

    def _predict(self, x: np.ndarray, P: np.ndarray, k: int) -> float:
        t, speed, yaw_rate, _ = self.scans[k]
        if k == 0:
            road.turn_with_road_(x, P, self.par, speed, yaw_rate, 1.0)
            return 0.001
        dt = t - self.scans[k - 1][0]
        road.predict_road_(x, P, self.par, dt, speed, yaw_rate)
        return dt

    def scan(
        self, t: float, speed: float, yaw_rate: float, notes: Any
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns the present road and its covariance."""
        self.scans.append((t, speed, yaw_rate, notes))
        now = len(self.scans) - 1
        x, P = self.x.copy(), self.P.copy()
        for k in range(self.learnt, now + 1):
            self._predict(x, P, k)
        everything = math.isnan(speed + yaw_rate) or not notes["seen"].any()
        while self.learnt <= now and (
            everything
            or t - self.scans[self.learnt][0] >= self.hindsight
            or now - self.learnt >= SCANS - 1
        ):
            dt = self._predict(self.x, self.P, self.learnt)
            ring = np.concatenate([s[3] for s in self.scans])
            guides.learn_(
                self.x, self.P, self.par, self.slots, self.unseen,
                ring, self.learnt, now - self.learnt, dt,
            )  # fmt: skip
            self.learnt += 1
        if self.learnt > now:
            x, P = self.x.copy(), self.P.copy()
        return x[: road.N_ROAD], P[: road.N_ROAD, : road.N_ROAD]


@pytest.mark.parametrize("lost", [False, True])
@settings(max_examples=15)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.0041, 0.0497, 0.2603, 0.6208, 0.9304]),
    st.sampled_from([0.01, 0.1, 0.5]),
)
def test_the_present_is_the_past_moved_on(
    lost: bool, seed: int, hindsight: float, longest: float
) -> None:
    """However many scans there are in the hindsight; now and then the ego's motion is lost."""
    rng = np.random.default_rng(seed)
    par = parameters(hindsight=hindsight)
    traffic, diary = Traffic(par, capacity=4), Diary(par, hindsight)
    x, lanes = np.array([30.0, 45.0, 60.0, 90.0]), np.array([-1.0, 0.0, 1.0, 2.0])
    speed, yaw_rate, passed = 28.0, 0.01, 0.0
    for _ in range(150):
        dt = longest if longest == 0.01 else round(rng.uniform(0.02, longest), 3)
        if rng.random() < 0.05:
            speed = NAN if lost and rng.random() < 0.5 else rng.uniform(0.0, 40.0)
            yaw_rate = rng.normal(0.0, 0.02)
            changing = rng.uniform(0.0, 1.0, 4)
            traffic.objects["mu"][:, KEEP], traffic.objects["mu"][:, LEFT] = 1 - changing, changing
            traffic.age[rng.integers(0, 4)] = 0
        seen = np.flatnonzero(rng.random(4) < 0.8)
        y = 3.5 * lanes + rng.normal(0.0, 0.1, 4)
        note = np.zeros((1, 4), guides.NOTE_DTYPE)
        note["seen"][0, seen] = True
        age = traffic.age.copy()
        age[seen] += 1
        note["new"] = age <= 1
        note["x"], note["y"], note["noise"] = x, y, 0.1**2
        note["changing"] = traffic.objects["mu"][:, LEFT]
        moved = traffic.scan(
            seen, np.column_stack([x, y])[seen], dt=dt, speed=speed, yaw_rate=yaw_rate
        )
        passed += dt
        present, P = diary.scan(passed, speed, yaw_rate, note)
        if moved:
            width = present[road.WIDTH]
            guides.change_lane_(diary.x, diary.P, diary.slots, moved, width)
            guides.change_lane_(present, P, diary.slots, moved, width)
        np.testing.assert_allclose(traffic.frame.x, present, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(traffic.frame.P, P, rtol=1e-6, atol=1e-12)
        if diary.learnt:
            np.testing.assert_allclose(traffic.x, diary.x, rtol=1e-6, atol=1e-9)
        np.testing.assert_array_equal(traffic.guide_slot, diary.slots)


def test_hindsight_reaches_back_no_further_than_there_is_room() -> None:
    """At 100 Hz, with a hindsight of more scans than are kept, the oldest is learnt from early."""
    traffic = Traffic(parameters(hindsight=2.0))
    for k in range(3 * SCANS):
        assert (traffic.guide_slot == 0).any() == (k >= SCANS)
        traffic.scan([0], [[40.0, 0.5]], dt=0.01, speed=30.0, yaw_rate=0.0)
    assert traffic.x[road.N_ROAD] < 1.0
    # what is learnt from is the oldest scan that is kept, and not the newest in its place
    traffic.scan([0], [[40.0, 3.5]], dt=0.01, speed=30.0, yaw_rate=0.0)
    for _ in range(SCANS - 2):
        traffic.scan([0], [[40.0, 0.5]], dt=0.01, speed=30.0, yaw_rate=0.0)
        assert traffic.x[road.N_ROAD] < 1.0
    traffic.scan([0], [[40.0, 0.5]], dt=0.01, speed=30.0, yaw_rate=0.0)
    assert traffic.x[road.N_ROAD] > 2.5


def test_when_nothing_moves_it_does_not_matter_when_it_is_learnt() -> None:
    roads = []
    xy = [[60.0, -3.3], [20.0, 0.3], [40.0, 3.9], [30.0, -3.3]]
    for hindsight in (1e-9, 0.05, 0.5, 2.0):
        traffic = Traffic(parameters(hindsight=hindsight))
        for _ in range(300):
            assert traffic.scan(range(4), xy, speed=0.0, yaw_rate=0.0) == 0
        x = traffic.frame.x
        ahead = road.lane_middles(np.tile(x, (3, 1)), np.array([0.0, 30.0, 60.0]))
        roads.append([*ahead, traffic.width, traffic.offset])
    np.testing.assert_allclose(roads[1:], np.tile(roads[0], (3, 1)), atol=0.02)
    assert roads[0][-2] == pytest.approx(3.6, abs=0.05)
    assert roads[0][1] == pytest.approx(0.3, abs=0.1)


@pytest.mark.parametrize(("speed", "yaw_rate"), [(NAN, NAN), (30.0, NAN), (NAN, 0.02)])
@pytest.mark.parametrize("dt", [0.1, 0.07, 0.013])
def test_without_the_egos_motion_it_is_learnt_at_once(
    speed: float, yaw_rate: float, dt: float
) -> None:
    """Also what has been waiting, in the first such scan."""
    xy = [[30.0, 0.5]]
    traffic = Traffic(parameters())
    traffic.scan([0], xy, dt=dt, speed=speed, yaw_rate=yaw_rate)
    assert traffic.guide_slot[0] == 0
    for waiting in range(12):
        traffic = Traffic(parameters())
        for _ in range(waiting):
            traffic.scan([0], xy, dt=dt, speed=30.0, yaw_rate=0.0)
        traffic.scan([0, 1], [*xy, [50.0, 3.5]], dt=dt, speed=speed, yaw_rate=yaw_rate)
        assert traffic.guide_slot[:2].tolist() == [0, 1]
        np.testing.assert_array_equal(traffic.frame.x, traffic.x[: road.N_ROAD])
        np.testing.assert_array_equal(traffic.frame.P, traffic.P[: road.N_ROAD, : road.N_ROAD])


def test_without_lateral_speeds_it_is_learnt_at_once() -> None:
    """Such a radar shows lane changes too late for any hindsight."""
    for speeds in (True, False):
        traffic = Traffic(parameters())
        for k in range(3):
            xy = [[30.0, 0.5], [50.0, 3.5]]
            traffic.scan([0, 1], xy, speed=30.0, yaw_rate=0.0, speeds=speeds)
            assert (traffic.guide_slot[:2].tolist() == [0, 1]) == (not speeds)
            assert (traffic.x[road.WAY] == 3.0 * k) == (not speeds or k == 0)


@pytest.mark.parametrize("offset", [1.9, -1.9])
@pytest.mark.parametrize("hindsight", [0.05, 0.5])
def test_past_and_present_count_the_lanes_alike(offset: float, hindsight: float) -> None:
    """When the ego is nearer to the next lane; all objects count from there, too."""
    traffic = Traffic(parameters(hindsight=hindsight))
    side = 1 if offset > 0 else -1
    xy = [[30.0, 0.0], [50.0, 3.5]]
    for _ in range(10):
        traffic.scan([0, 1], xy, speed=25.0, yaw_rate=0.0)
    places = slice(road.N_ROAD, road.N_ROAD + 2)
    traffic.x[road.OFFSET] += offset
    traffic.x[places] += offset  # the vehicles are seen where they were
    past = traffic.x.copy()
    traffic.objects["mean"][:, 2] = traffic.objects["x"][:, 1, 2] = 0.7
    frame = copy.deepcopy(traffic.frame)
    frame.move(traffic.t_ns + S // 10, 25.0, 0.0)
    present = frame.x.copy()
    lanes = traffic.frame._changes["log_w"][:2].argmax(axis=1)
    assert traffic.scan([0, 1], xy, speed=25.0, yaw_rate=0.0) == side
    width = traffic.width
    seen = traffic.frame._changes["log_w"][:2].argmax(axis=1)
    np.testing.assert_array_equal(seen, lanes - side)
    np.testing.assert_allclose(traffic.objects["mean"][:, 2], 0.7 - side * width)
    np.testing.assert_allclose(traffic.objects["x"][:, 1, 2], 0.7 - side * width)
    assert traffic.offset == pytest.approx(present[road.OFFSET] - side * width, abs=1e-9)
    assert traffic.x[road.OFFSET] == pytest.approx(past[road.OFFSET] - side * width, abs=0.05)
    np.testing.assert_allclose(traffic.x[places], past[places] - side * width, atol=0.05)
    before = traffic.offset
    assert traffic.scan([0, 1], xy, speed=25.0, yaw_rate=0.0) == 0
    assert traffic.offset == pytest.approx(before, abs=0.3)


# ---- into the road's axes and back


def test_what_the_bus_stops_telling_is_forgotten() -> None:
    traffic = driven(5.0)
    frame = traffic.frame
    scan = Scan(1)
    scan.n, scan.valid[0], scan.z[0] = 1, True, (40.0, 0.0, 3.5, 0.0)
    for speed, expected in ((30.0, True), (NAN, False)):
        traffic.nothing(speed=speed, yaw_rate=0.02)
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


# ---- who changes lanes

LC, KL = Manoeuvre.LANE_CHANGE, Manoeuvre.KEEP_LANE
RELATIVE = [m for m in Manoeuvre if m > 0 and m not in (Manoeuvre.STATIONARY, Manoeuvre.ONCOMING)]
OTHERS = [m for m in RELATIVE if m != LC]
SHARES = st.floats(0.0, 1.0)


def judged(p: Any, change: tuple[float, float], vx: float = 0.0, direction: int = 1) -> Any:
    """The report that is made of one with these probabilities."""
    reports = np.zeros(2, REPORT_DTYPE)
    reports["p"] = p
    reports["x"][:, 1] = vx
    reports["direction"] = direction
    untouched = reports.copy()
    judge_changes_(np.array([change, change]), reports, 1)
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
    curvature, speed = 0.002 * side, 30.0
    traffic = Traffic(parameters(), capacity=6)
    ids = np.array([7, 8, FREE, 9, 10, 11], np.int32)
    reports = np.zeros(6, REPORT_DTYPE)
    first = np.array([80.0, 85.0, 90.0, 95.0, 100.0])
    lanes = np.array([1.0, -1.0, 0.0, 1.0, -1.0])
    said = []
    for k in range(140):
        u = min(max((0.1 * k - 10.0) / 4.0, 0.0), 1.0)
        x = first - 0.4 * k
        y = 3.5 * lanes + 0.5 * curvature * x**2
        y[2] -= side * 3.5 * u * u * (3.0 - 2.0 * u)
        # its modes know, too, so that it does not guide
        traffic.objects["mu"][3, [KEEP, LEFT]] = float(u == 0.0), float(u > 0.0)
        traffic.scan(
            [0, 1, 3, 4, 5], np.column_stack([x, y]),
            speed=speed, yaw_rate=curvature * speed, angle=angle, speeds=False,
        )  # fmt: skip
        reports["p"] = 0.0
        reports["p"][:, [KL, LC]] = 0.5
        traffic.frame.judge_(ids, np.zeros(len(ids), MEMORY_DTYPE), reports, traffic.t_ns)
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
    then = traffic.frame.changing(12.0)
    assert then[3, 0 if side < 0 else 1] > 0.99
    assert np.nanmax(then[[0, 1, 4, 5]]) < 0.1
    assert np.isnan(then[2]).all(), "nobody is there"
    assert np.isnan(traffic.frame.changing(0.05)).all(), "before the first scan"


# ---- how far the road is known


def doubted(frame: RoadFrame, ids: Any, memory: Any, reports: Any) -> None:
    doubt_(frame.x, frame.P, 0.5, 30.0, np.zeros(road.N_ROAD + 1), ids, memory, reports)


def lane_changes(p: float) -> np.ndarray[Any, Any]:
    """At 20 to 150 m, as fast as the ego but for the second and the third."""
    reports = np.zeros(4, REPORT_DTYPE)
    reports["x"] = [(20, 0.5, 0, 1.8), (90, -2, 0, -0.9), (90, 2, 0, 0.9), (150, 0, 0, 0.05)]
    reports["p"][:, LC], reports["p"][:, KL] = p, 1.0 - p
    reports["manoeuvre"], reports["second"], reports["direction"] = LC, KL, -1
    return reports


@pytest.mark.parametrize("way", [0.0, 20.0])
def test_lane_changes_are_trusted_no_further_than_the_road_is_known(way: float) -> None:
    """A road that bends unseen explains a lateral speed by the uncertainty of its direction, and
    that times the vehicle's speed; of the direction by quadrature of the bends."""
    frame = driven(3.0).frame
    frame.x[road.WAY] = way
    frame.P /= 25.0
    reports = lane_changes(0.8)
    doubted(frame, np.arange(4, dtype=np.int32), np.zeros(4, MEMORY_DTYPE), reports)
    knots = road.SPACING * np.arange(road.N_KNOTS)
    shares = []
    for x, vx, _, vy in lane_changes(0.8)["x"].tolist():
        u = way + (np.arange(20000) + 0.5) * x / 20000
        h = np.zeros(road.N_ROAD)
        h[[road.HEADING, road.MOUNTING]] = -1.0
        for i in range(road.N_KNOTS):
            h[road.KNOT + i] = np.interp(u, knots, np.eye(road.N_KNOTS)[i]).mean() * x
        std = math.hypot(WANDER_SPEED, (30.0 + vx) * math.sqrt(h @ frame.P @ h))
        shares.append(1.0 / (1.0 + 0.5 * math.sqrt(2.0 * math.pi) * norm.pdf(vy, 0.0, std)))
    assert shares[0] > 0.9
    assert shares[3] < 0.7
    rest = [KL, int(Manoeuvre.APPROACHING), int(Manoeuvre.RECEDING), KL]
    expected = np.zeros_like(reports["p"])
    expected[:, KL] = 0.2
    expected[np.arange(4), rest] += 0.8 * (1.0 - np.array(shares))
    expected[:, LC] = 0.8 * np.array(shares)
    np.testing.assert_allclose(reports["p"], expected, rtol=1e-4, atol=1e-9)
    np.testing.assert_array_equal(reports["manoeuvre"], expected[:, 1:].argmax(axis=1) + 1)
    assert (reports["direction"] == np.where(reports["manoeuvre"] == LC, -1, 0)).all()
    assert len(set(reports["manoeuvre"].tolist())) > 1, "some were doubted away, some not"


def test_what_is_hardly_a_lane_change_and_what_nobody_is_in_is_not_doubted() -> None:
    frame = driven(3.0).frame
    for p, first in ((0.009, 0), (0.8, FREE)):
        reports = lane_changes(p)
        ids = np.full(4, first, np.int32)
        doubted(frame, ids, np.zeros(4, MEMORY_DTYPE), reports)
        np.testing.assert_array_equal(reports, lane_changes(p))


def test_a_lane_change_that_was_trusted_stays_so_until_it_is_over() -> None:
    """It ends slowly, and then looks like a bend; another one is to be trusted anew."""
    frame = driven(3.0).frame
    ids, memory = np.array([FREE, 7], np.int32), np.zeros(2, MEMORY_DTYPE)

    def trusted(vy: float, p: float = 0.8) -> float:
        reports = lane_changes(p)[:1]
        reports["x"][0, 3], reports["age"] = vy, 5
        doubted(frame, ids, memory, reports)
        return float(reports["p"][0, LC] / p)

    at_first = trusted(0.05)
    assert at_first < 0.5
    fast = trusted(1.8)
    assert fast > 0.9
    assert trusted(0.05) == pytest.approx(fast)
    trusted(0.05, p=0.1)
    assert trusted(0.05) == pytest.approx(at_first)


@pytest.mark.parametrize(("speeds", "speed"), [(True, 30.0), (False, 30.0), (True, NAN)])
def test_only_measured_lateral_speeds_on_a_known_road_give_rise_to_doubt(
    speeds: bool, speed: float
) -> None:
    traffic = Traffic(parameters())
    for k in range(5):
        traffic.scan([0], np.array([[60.0 - k, 0.0]]), speed=speed, yaw_rate=0.0, speeds=speeds)
    assert traffic.frame.doubtful == (speeds and speed == 30.0)


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
