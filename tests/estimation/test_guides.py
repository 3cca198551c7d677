"""The vehicles of a scan: who is followed, for how long, and what is taken in of them."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.gaussian import random_covariance
from small_roads import KEEP, LEFT, STILL, Traffic, parameters

from can_imm.estimation import guides, layout
from can_imm.estimation import traffic as tr
from can_imm.estimation.road import (
    HEADING,
    MOUNTING,
    N_ROAD,
    OFFSET,
    WAY,
    WIDTH,
    lane_row_,
    slope_row_,
)
from can_imm.estimation.wander import NO_LANE

NAN = math.nan
FREE = tr.FREE
SEEDS = st.integers(0, 2**32 - 1)
EGO_SPEED = 25.0


def scan(traffic: Traffic, places: dict[int, tuple[float, float]], **options: Any) -> None:
    """Vehicles by slot, as seen from an ego that drives straight on."""
    options = {"speed": EGO_SPEED, "yaw_rate": 0.0, **options}
    traffic.scan([*places], [*places.values()], **options)


def followed(traffic: Traffic) -> list[int]:
    """Slots of those that are followed."""
    slots = traffic.filter["party"]["slot"]
    return sorted(slots[slots != FREE].tolist())


def is_clean(traffic: Traffic) -> bool:
    """Nothing is left of those that are not followed."""
    T = traffic.filter
    gone = np.flatnonzero(T["party"]["slot"][: tr.N_GUIDES] == FREE)
    states = np.concatenate((N_ROAD + 2 * gone, N_ROAD + 2 * gone + 1))
    who = T["local"]["who"][: T["n"]]
    return bool(
        not T["x"][states].any()
        and not T["P"][states].any()
        and not T["P"][:, states].any()
        and not T["mean"][: T["n"], states].any()
        and not np.isin(who, gone).any()
        and (T["choice"][: T["n_global"], gone] == FREE).all()
    )


# ---- what a scan says


def test_what_a_scan_says_is_written_down() -> None:
    """By slot, in the vehicle's axes; what was not measured, not believed or not kept is not."""
    rng = np.random.default_rng(8)
    traffic = Traffic(parameters(), capacity=7)
    traffic.objects["mu"][:, :3] = rng.dirichlet([1.0, 1.0, 1.0], 7)
    slot = np.array([4, -1, 2, 0, 6, 1], np.int32)
    status = np.array([0, 0, 0, 1, 0, 0], np.int8)
    age = np.array([9, 1, 1, 1, 2, 9, 1], np.int32)
    z, r = rng.normal(0.0, 20.0, (6, 4)), rng.uniform(0.01, 1.0, (6, 4))
    valid = np.ones((6, 4), np.bool_)
    valid[4, 0] = valid[5, 2] = False
    valid[0, [1, 3]] = False  # speeds are not needed
    angle = rng.uniform(-1.0, 1.0, 6)
    notes = np.zeros(7, guides.NOTE_DTYPE)
    notes["seen"] = notes["new"] = True
    record = traffic.bank.record
    guides.note_(notes, record, traffic.objects, 6, slot, status, age, z, r, valid, angle)
    assert np.flatnonzero(notes["seen"]).tolist() == [2, 4]
    # slot 3 is not in the scan; 1 and 6 are, though where they are was not measured
    assert np.flatnonzero(notes["new"]).tolist() == [1, 2, 6]
    for k, s in ((0, 4), (2, 2)):
        turn = np.exp(1j * angle[k])
        at = (z[k, 0] + 1j * z[k, 2]) * turn
        R = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
        cov = R @ np.diag(r[k, [0, 2]]) @ R.T
        expected = [at.real, at.imag, cov[1, 1], traffic.objects["mu"][s, STILL]]
        got = [notes[name][s] for name in ("x", "y", "noise", "off")]
        np.testing.assert_allclose(got, expected, rtol=1e-12)


@given(SEEDS, st.floats(-math.pi, math.pi))
def test_from_turned_axes(seed: int, angle: float) -> None:
    rng = np.random.default_rng(seed)
    z, r = rng.normal(0.0, 20.0, 4), rng.uniform(0.01, 4.0, 4)
    c, s = math.cos(angle), math.sin(angle)
    R = np.array([[c, -s], [s, c]])
    for function, of in ((guides.position, [0, 2]), (guides.velocity, [1, 3])):
        expected = [*(R @ z[of]), (R @ np.diag(r[of]) @ R.T)[1, 1]]
        np.testing.assert_allclose(function(z, r, angle), expected, rtol=1e-9, atol=1e-9)


def test_it_does_not_matter_in_which_axes_it_was_measured() -> None:
    told = []
    for angle in (0.0, 0.4, -1.0):
        traffic = Traffic(parameters())
        for k in range(28):
            places = {0: (40.0, 0.1 * k), 1: (30.0 + k, -3.5)}
            scan(traffic, places, angle=angle, speeds=False)
        told.append(traffic.frame.changing(1e-9 * traffic.t_ns)[:2])
    assert told[0][0, 0] > 0.9
    np.testing.assert_allclose(told[0], told[1], atol=1e-4)
    np.testing.assert_allclose(told[0], told[2], atol=1e-4)


# ---- one value


def one_guide(seed: int) -> tuple[Any, np.random.Generator]:
    """A filter with one vehicle in lane 1, as party 2, amid a road of which anything is known."""
    rng = np.random.default_rng(seed)
    traffic = Traffic(parameters(change_rate=1e-9))
    for _ in range(3):
        scan(traffic, {5: (40.0, 3.5), 1: (60.0, 0.0), 0: (80.0, 3.5)})
    T = traffic.filter
    top = int(T["top"])
    assert (T["n_global"], top) == (1, N_ROAD + 6)
    assert T["party"]["slot"][2] == 0
    x = 0.01 * rng.normal(size=top)
    x[WIDTH], x[WAY] = 3.4, 11.0
    P = random_covariance(rng, top)
    P *= min(1.0, 0.9 * guides.WIDTH_SURE**2 / P[WIDTH, WIDTH])
    T["x"][:top], T["P"][:top, :top] = x, P
    T["mean"][: T["n"]], T["rest"][0] = 0.0, 0.0
    return T, rng


@pytest.mark.parametrize("what", ["place", "speed"])
@settings(max_examples=15)
@given(SEEDS)
def test_what_is_seen_of_a_vehicle_is_seen_of_the_road(what: str, seed: int) -> None:
    """An update in matrix form by the place in its lane, or by the speed across the road."""
    T, rng = one_guide(seed)
    top, a = int(T["top"]), N_ROAD + 4
    x, P = T["x"][:top].copy(), T["P"][:top, :top].copy()
    ahead, vx, noise = 50.0, -3.0, 0.3
    H, h = np.zeros(top), np.zeros(N_ROAD + 1)
    if what == "place":
        lane_row_(h, x[WAY], ahead)
        H[:N_ROAD] = h[:N_ROAD]
        H[WIDTH], H[a] = 1.0, 1.0
    else:
        slope_row_(h, x[WAY], ahead)
        H[:N_ROAD] = (EGO_SPEED + vx) * h[:N_ROAD]
        H[MOUNTING] += EGO_SPEED
        H[a + 1] = 1.0
    S = H @ P @ H + noise
    z = H @ x + rng.normal() * math.sqrt(S)
    if what == "place":
        assert guides.see_place_(T, 2, ahead, z, noise, 0.3)
    else:
        guides.see_speed_(T, 2, ahead, vx, z, noise, EGO_SPEED, 0.3)
    gain = P @ H / S
    np.testing.assert_allclose(T["x"][:top], x + gain * (z - H @ x), rtol=1e-9, atol=1e-9)
    expected = P - np.outer(gain, gain) * S
    np.testing.assert_allclose(T["P"][:top, :top], expected, rtol=1e-8, atol=1e-8)


@settings(max_examples=15)
@given(SEEDS)
def test_far_ahead_the_width_of_lanes_is_a_source_of_error(seed: int) -> None:
    """What is seen there says as much of the rest of the road as if it told of the width, too."""
    T, rng = one_guide(seed)
    top, a = int(T["top"]), N_ROAD + 4
    rest = np.arange(top) != WIDTH
    for matrix in (T["P"], T["P"].T):
        matrix[WIDTH, :top] *= ~rest
    x, P = T["x"][:top].copy(), T["P"][:top, :top].copy()
    ahead, noise = guides.WIDTH_SEEN_TO + 5.0, 0.3
    h = np.zeros(N_ROAD + 1)
    lane_row_(h, x[WAY], ahead)
    H = np.zeros(top)
    H[:N_ROAD] = h[:N_ROAD]
    H[WIDTH], H[a] = 1.0, 1.0
    S = H @ P @ H + noise
    z = H @ x + rng.normal() * math.sqrt(S)
    assert guides.see_place_(T, 2, ahead, z, noise, 0.3)
    gain = P @ H / S
    moved, cov = x + gain * (z - H @ x), P - np.outer(gain, gain) * S
    np.testing.assert_allclose(T["x"][:top][rest], moved[rest], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        T["P"][:top, :top][np.ix_(rest, rest)], cov[np.ix_(rest, rest)], rtol=1e-8, atol=1e-8
    )
    assert (T["x"][WIDTH], T["P"][WIDTH, WIDTH]) == (x[WIDTH], P[WIDTH, WIDTH])


@pytest.mark.parametrize("seed", range(4))
def test_who_can_not_be_there_is_not_taken_in(seed: int) -> None:
    T, _ = one_guide(seed)
    before = T.tobytes()
    where, at = T["x"].copy(), T["P"].copy()
    assert not guides.see_place_(T, 2, 50.0, 2e4, 0.3, 0.3)
    guides.see_speed_(T, 2, 50.0, 0.0, 1e4, 0.3, EGO_SPEED, 0.3)
    assert len(before) == len(T.tobytes())
    np.testing.assert_array_equal(T["x"], where)
    np.testing.assert_array_equal(T["P"], at)


# ---- who is followed


@pytest.mark.parametrize("seen", [0.2, -3.0, 5.0, 1.75])
def test_who_is_met_is_in_the_nearest_lane_or_the_next_or_between(seen: float) -> None:
    traffic = Traffic(parameters())
    scan(traffic, {3: (40.0, seen)})
    T = traffic.filter
    assert followed(traffic) == [3]
    assert traffic.guide_of[3] == 0
    local = T["local"][: T["n"]]
    local = local[local["who"] == 0]
    nearest = round(seen / 3.5 + 1e-9)
    keeps = local["lane"][local["turn"] == 0]
    assert {nearest} <= set(keeps.tolist()) <= {nearest - 1, nearest, nearest + 1}
    changes = local[local["turn"] != 0]
    between = changes["lane"] + 0.5 * changes["turn"]
    assert len(changes) > 20
    assert (abs(between - seen / 3.5) < 1.0 + 1e-9).all()
    assert (changes["start"] < 0.1).all()
    assert (changes["start"] + changes["duration"] > 0.1).all()
    assert traffic.changing(3).max() < (0.7 if seen == 1.75 else 0.3)
    if seen == 1.75:
        assert traffic.changing(3).min() > 0.1, "between two lanes it may do anything"


def test_who_is_followed() -> None:
    """Who is not off the lanes, not too far, and not too far behind."""
    traffic = Traffic(parameters())
    traffic.objects["mu"][3, [KEEP, STILL]] = 1.0 - guides.OFF - 0.01, guides.OFF + 0.01
    traffic.objects["mu"][4, [KEEP, STILL]] = 1.0 - guides.OFF + 0.01, guides.OFF - 0.01
    places = {
        0: (40.0, 0.0), 1: (guides.SEEN_TO + 5.0, 0.0), 2: (guides.SEEN_FROM - 5.0, 3.5),
        3: (60.0, 7.0), 4: (80.0, 3.5), 5: (guides.SEEN_FROM + 5.0, 3.5),
    }  # fmt: skip
    for _ in range(3):
        scan(traffic, places)
        assert followed(traffic) == [0, 4, 5]
    p = traffic.frame.changing(1e-9 * traffic.t_ns)
    assert np.isfinite(p[[0, 4, 5]]).all()
    assert np.isnan(p[[1, 2, 3]]).all()
    traffic.objects["mu"][0, [KEEP, STILL]] = 0.1, 0.9
    places[4] = guides.SEEN_TO + 1.0, 3.5
    places[5] = guides.SEEN_FROM - 1.0, 3.5
    scan(traffic, places)
    assert followed(traffic) == []
    assert is_clean(traffic)
    assert traffic.filter["top"] == N_ROAD
    assert np.isnan(traffic.frame.changing(1e-9 * traffic.t_ns)).all()


def test_rows_that_are_not_believed_are_not_seen() -> None:
    traffic = Traffic(parameters())
    scan(traffic, {0: (40.0, 0.0)}, status=1)
    assert followed(traffic) == []
    scan(traffic, {0: (40.0, 0.0)})
    scan(traffic, {0: (40.0, 0.0)}, status=1)
    assert traffic.filter["party"]["unseen"][0] == pytest.approx(0.1)
    scan(traffic, {-1: (40.0, 0.0)})
    assert followed(traffic) == [0]


def test_who_is_not_seen_for_long_is_forgotten() -> None:
    traffic = Traffic(parameters())
    for _ in range(3):
        scan(traffic, {0: (40.0, 0.0), 1: (60.0, 3.5)})
    for k in range(9):
        scan(traffic, {1: (60.0, 3.5)})
        assert traffic.filter["party"]["unseen"][0] == pytest.approx(0.1 * (k + 1))
    assert followed(traffic) == [0, 1]
    for _ in range(2):
        scan(traffic, {1: (60.0, 3.5)})
    assert followed(traffic) == [1]
    assert traffic.guide_of[0] == FREE
    assert is_clean(traffic)


def test_who_is_seen_again_in_time_is_the_same() -> None:
    traffic = Traffic(parameters())
    for _ in range(3):
        scan(traffic, {0: (40.0, 0.0)})
    for _ in range(9):
        traffic.nothing(speed=EGO_SPEED, yaw_rate=0.0)
    scan(traffic, {0: (40.0, 0.0)})
    party = traffic.filter["party"][0]
    assert party["unseen"] == 0.0
    assert party["since"] == pytest.approx(0.1)


def test_another_object_in_a_slot_is_another_vehicle() -> None:
    traffic = Traffic(parameters())
    for k in range(25):
        scan(traffic, {0: (40.0, 0.1 * k)}, speeds=False)
    assert traffic.changing(0)[0] > 0.5
    traffic.age[0] = 0
    scan(traffic, {0: (40.0, 3.5)}, speeds=False)
    t = 1e-9 * traffic.t_ns
    assert traffic.filter["party"]["since"][0] == pytest.approx(t)
    assert traffic.changing(0)[0] < 0.2
    assert np.isnan(traffic.frame.changing(t - 0.05)[0]).all()
    assert is_clean(traffic)


def test_four_outliers_in_a_row_are_another_vehicle() -> None:
    """Fewer are none."""
    traffic = Traffic(parameters())
    for _ in range(20):
        scan(traffic, {0: (40.0, 0.0), 1: (60.0, 3.5)})
    for n in (guides.MAX_OUTLIERS - 1, guides.MAX_OUTLIERS):
        for k in range(n):
            assert traffic.filter["party"]["outliers"][0] == k
            scan(traffic, {0: (40.0, 14.0), 1: (60.0, 3.5)})
        assert (followed(traffic) == [1]) == (n == guides.MAX_OUTLIERS)
        if n < guides.MAX_OUTLIERS:
            scan(traffic, {0: (40.0, 0.0), 1: (60.0, 3.5)})
            assert traffic.filter["party"]["outliers"][0] == 0
    assert is_clean(traffic)
    scan(traffic, {0: (40.0, 14.0), 1: (60.0, 3.5)})
    T = traffic.filter
    assert T["local"]["lane"][T["choice"][0, 0]] == 4
    assert abs(traffic.offset) < 0.1
    assert traffic.changing(0).max() < 0.2


def test_a_crowd_is_met_as_there_is_room_for_its_courses() -> None:
    """The nearest first; all of them soon, and each with courses to both sides."""
    n = tr.N_GUIDES
    traffic = Traffic(parameters(), capacity=n)
    ahead = np.random.default_rng(3).permutation(np.linspace(10.0, 200.0, n))
    xy = np.column_stack([ahead, 3.5 * (np.arange(n) % 3 - 1)])
    T, met = traffic.filter, []
    for _ in range(12):
        traffic.scan(range(n), xy, speed=EGO_SPEED, yaw_rate=0.0)
        met.append(len(followed(traffic)))
        assert T["n"] <= tr.N_LOCAL
        assert ahead[followed(traffic)].max() == np.sort(ahead)[met[-1] - 1]
    assert 3 <= met[0] < n
    assert met[-1] == n
    local = T["local"][: T["n"]]
    for g in range(n):
        assert {-1, 0, 1} <= set(local["turn"][local["who"] == g].tolist())
    assert traffic.frame.changing(1e-9 * traffic.t_ns).max() < 0.2


def test_more_vehicles_than_can_be_followed() -> None:
    traffic = Traffic(parameters(), capacity=40)
    xy = np.column_stack([np.linspace(10.0, 240.0, 40), 3.5 * (np.arange(40) % 3 - 1)])
    for _ in range(12):
        assert traffic.scan(range(40), xy, speed=EGO_SPEED, yaw_rate=0.0) == 0
    first = followed(traffic)
    assert len(first) == tr.N_GUIDES
    p = traffic.frame.changing(1e-9 * traffic.t_ns)
    assert p[first].max() < 0.2
    others = np.setdiff1d(range(40), first)
    assert np.isnan(p[others]).all()
    assert abs(traffic.offset) < 0.1
    # where one leaves, another one is followed
    slots = [s for s in range(40) if s != first[7]]
    for _ in range(12):
        traffic.scan(slots, xy[slots], speed=EGO_SPEED, yaw_rate=0.0)
    assert followed(traffic) == sorted({*first, others[0]} - {first[7]})


# ---- second tracks


def alone_first(scans: int = guides.TWIN_LATER) -> Traffic:
    """A vehicle that has been seen for some scans."""
    traffic = Traffic(parameters())
    for _ in range(scans):
        scan(traffic, {0: (40.0, 0.0)})
    return traffic


def test_a_second_track_of_a_vehicle_says_what_the_first_does() -> None:
    """And nothing is taken in of it."""
    one, both = Traffic(parameters()), Traffic(parameters())
    for k in range(28):
        first, second = (40.0, 0.1 * k), (42.0, 0.1 * k - 0.7)
        alone, begun = {0: first, 5: (70.0, 3.5)}, k >= guides.TWIN_LATER
        scan(one, alone, speeds=False)
        scan(both, {**alone, 2: second} if begun else alone, speeds=False)
        assert followed(both) == [0, 5]
        assert both.guide_of[0] == 0
        assert both.guide_of[2] == (0 if begun else FREE)
        for name in ("x", "P", "log_w", "n"):
            np.testing.assert_array_equal(one.filter[name], both.filter[name])
    assert one.changing(0)[0] > 0.9
    np.testing.assert_array_equal(both.changing(2), one.changing(0))
    np.testing.assert_array_equal(both.changing(0), one.changing(0))


@pytest.mark.parametrize("other", [(43.5, 0.0), (36.5, 0.0), (40.0, 1.5), (40.0, -1.5)])
def test_who_is_further_away_is_no_second_track(other: tuple[float, float]) -> None:
    traffic = alone_first()
    for _ in range(5):
        scan(traffic, {0: (40.0, 0.0), 1: other})
        assert followed(traffic) == [0, 1]


@pytest.mark.parametrize(
    ("other", "twin"), [((40.5, 0.2), True), ((41.5, 0.2), False), ((40.5, 0.5), False)]
)
def test_of_two_that_begin_together_one_is_a_second_track_if_they_are_very_near(
    other: tuple[float, float], twin: bool
) -> None:
    """And only for as long as both are seen: they may as well be two vehicles."""
    traffic = Traffic(parameters())
    for _ in range(6):
        scan(traffic, {0: (40.0, 0.0), 1: other})
        assert followed(traffic) == ([0] if twin else [0, 1])
    scan(traffic, {1: other})
    for _ in range(6):
        scan(traffic, {0: (40.0, 0.0), 1: other})
        assert followed(traffic) == [0, 1]


@pytest.mark.parametrize("late", [False, True])
def test_a_second_track_may_only_be_seen_to_be_one_a_little_later(late: bool) -> None:
    traffic = alone_first()
    for _ in range(12 if late else 5):
        scan(traffic, {0: (40.0, 0.0), 1: (41.0, 1.2)})
        assert followed(traffic) == [0, 1]
    scan(traffic, {0: (40.0, 0.0), 1: (41.0, 0.7)})
    assert followed(traffic) == ([0, 1] if late else [0])
    assert is_clean(traffic)
    assert (traffic.changing(1) == traffic.changing(0)).all() != late


def test_a_second_track_that_goes_its_own_way_is_a_vehicle() -> None:
    traffic = alone_first(8)
    for _ in range(3):
        scan(traffic, {0: (40.0, 0.0), 1: (41.0, 0.2)})
    assert followed(traffic) == [0]
    # as long as the first one is not seen it may be anywhere
    scan(traffic, {1: (44.0, 0.2)})
    assert followed(traffic) == [0]
    scan(traffic, {0: (40.0, 0.0), 1: (44.0, 0.2)})
    assert followed(traffic) == [0, 1]
    assert traffic.guide_of[1] == 1


def test_where_the_first_track_ends_the_second_is_followed() -> None:
    traffic = alone_first()
    for _ in range(3):
        scan(traffic, {0: (40.0, 0.0), 1: (41.0, 0.2)})
    traffic.objects["mu"][0, [KEEP, STILL]] = 0.1, 0.9
    scan(traffic, {0: (40.0, 0.0), 1: (41.0, 0.2)})
    assert followed(traffic) == [1]
    assert traffic.guide_of[0] == FREE
    assert np.isfinite(traffic.changing(1)).all()


# ---- nothing to be seen, nothing known


def test_scans_of_nothing() -> None:
    traffic = Traffic(parameters())
    traffic.nothing(speed=EGO_SPEED, yaw_rate=0.0)
    for _ in range(20):
        scan(traffic, {0: (40.0, 0.0)})
    for _ in range(300):
        traffic.nothing(speed=EGO_SPEED, yaw_rate=0.0)
        assert np.isnan(traffic.frame.changing(1e-9 * traffic.t_ns)).all() or (
            traffic.filter["party"]["unseen"][0] <= guides.UNSEEN_S
        )
    assert followed(traffic) == []
    assert is_clean(traffic)
    T = traffic.filter
    assert T["local"]["who"][: T["n"]].tolist() == [tr.EGO] * int(T["n"])
    assert abs(traffic.offset) < 0.2
    assert np.linalg.eigvalsh(traffic.frame.P).min() > -1e-12


@pytest.mark.parametrize("speed", [NAN, EGO_SPEED])
def test_without_the_egos_motion_who_changes_lanes_is_seen_all_the_same(speed: float) -> None:
    traffic = Traffic(parameters())
    p = []
    for k in range(80):
        u = min(max((0.1 * k - 3.0) / 4.0, 0.0), 1.0)
        y = 3.5 * u * u * (3.0 - 2.0 * u)
        places = {0: (30.0, y), 1: (45.0, 0.0), 2: (60.0, 3.5)}
        scan(traffic, places, speeds=False, speed=speed, yaw_rate=NAN)
        p.append(traffic.frame.changing(1e-9 * traffic.t_ns)[:3])
    told = np.array(p)
    assert np.isfinite(traffic.frame.x).all()
    assert (told[45:65, 0, 0] > 0.9).all()
    assert told[:25, 0].max() < 0.1
    assert told[-1, 0].max() < 0.1
    assert told[:, 1:].max() < 0.2


# ---- habits


@pytest.mark.parametrize("side", [1, -1])
def test_who_changes_lanes_keeps_none_meanwhile(side: int) -> None:
    """From the middle of its lane to that of the next one, where it is kept at once."""
    traffic = Traffic(parameters(settle=3.0))
    kept, beside = [], []
    for k in range(120):
        u = min(max((0.1 * k - 4.0) / 4.0, 0.0), 1.0)
        y = side * 3.5 * u * u * (3.0 - 2.0 * u)
        places = {0: (30.0, y), 1: (45.0, 0.0), 2: (60.0, 3.5)}
        scan(traffic, places, speeds=False)
        kept.append(int(traffic.filter["party"]["kept"][0]))
        beside.append(float(traffic.filter["party"]["beside"][0]))
        assert traffic.filter["party"]["kept"][1:3].tolist() == [0, 1]
    assert [lane for lane, _ in itertools.groupby(kept)] == [0, NO_LANE, side]
    assert kept.index(side) < 95, "before that is settled"
    assert beside[-1] < 1.2 * beside[40]
    away = kept.index(NO_LANE)
    assert len(set(beside[away : kept.index(side)])) == 1, "meanwhile nothing is learnt"


# ---- objects


def test_objects_count_from_another_lane() -> None:
    rng = np.random.default_rng(0)
    traffic = Traffic(parameters(), capacity=3)
    objects = traffic.objects
    for name in ("mean", "x"):
        objects[name] = rng.normal(size=objects[name].shape)
    before = objects.copy()
    guides.shift_objects_(traffic.bank.record, objects, 3.4)
    np.testing.assert_allclose(objects["mean"][:, 2], before["mean"][:, 2] - 3.4)
    modes = traffic.bank.record[0]["n_modes"]
    assert modes > LEFT
    np.testing.assert_allclose(objects["x"][:, :modes, 2], before["x"][:, :modes, 2] - 3.4)
    objects["mean"][:, 2], objects["x"][:, :modes, 2] = 0.0, 0.0
    before["mean"][:, 2], before["x"][:, :modes, 2] = 0.0, 0.0
    assert objects.tobytes() == before.tobytes()
    assert objects.dtype == layout.OBJECT_DTYPE


# ---- whatever is seen

STEPS = st.lists(
    st.tuples(
        SEEDS,
        st.integers(0, 8),
        st.sampled_from([0.02, 0.1, 0.1, 0.9, 1.5]),
        st.sampled_from([NAN, 0.0, 5.0, 30.0, -3.0, 60.0]),
        st.sampled_from([NAN, 0.0, 0.1, -1.0]),
        st.sampled_from([0.0, 0.4, -1.2]),
    ),
    max_size=25,
)


@settings(max_examples=25)
@given(STEPS)
def test_whatever_is_seen_the_covariance_stays_one(script: list[Any]) -> None:
    traffic = Traffic(parameters(), capacity=8)
    for seed, n, dt, speed, yaw_rate, angle in script:
        rng = np.random.default_rng(seed)
        slots = rng.permutation(8)[:n]
        traffic.age[rng.random(8) < 0.1] = 0
        traffic.objects["mu"][:, :3] = rng.dirichlet([0.3, 0.3, 0.1], 8)
        xy = np.column_stack([rng.uniform(-70.0, 270.0, n), rng.normal(0.0, 5.0, n)])
        moved = traffic.scan(slots, xy, dt=dt, speed=speed, yaw_rate=yaw_rate, angle=angle)
        assert moved in (-1, 0, 1)
        T = traffic.filter
        for P in (T["P"], traffic.frame.P):
            assert np.isfinite(P).all()
            np.testing.assert_allclose(P, P.T, rtol=1e-9, atol=1e-12)
            eigenvalues = np.linalg.eigvalsh(P)
            assert eigenvalues.min() > -1e-9 * max(eigenvalues.max(), 1.0)
        assert np.isfinite(T["x"]).all()
        assert np.isfinite(traffic.frame.x[[OFFSET, HEADING, WIDTH]]).all()
        assert is_clean(traffic)
        used = followed(traffic)
        assert len(set(used)) == len(used)
        for s, g in enumerate(traffic.guide_of):
            assert g == FREE or T["party"]["slot"][g] != FREE
            assert s not in used or T["party"]["slot"][g] == s
