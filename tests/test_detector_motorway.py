"""The preset motorway on scans made by hand: who stands, who comes, and which lane is whose."""

from __future__ import annotations

import cmath
import dataclasses
import functools
import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_imm.detector import Detector
from can_imm.manoeuvres import ModeBank, load_bank
from can_imm.types import CUT_IN, CUT_OUT, Manoeuvre, Scan

MS = 1_000_000
NAN = math.nan
WIDTH = 3.5
STD = (0.2, 0.15, 0.15, 0.2)
SPEED = 28.0

Vehicle = tuple[float, float, float, float]
OFF_LANE = {Manoeuvre.STATIONARY, Manoeuvre.ONCOMING}


@functools.cache
def bank() -> ModeBank:
    return load_bank("motorway")


def scan(
    k: int,
    vehicles: dict[int, Vehicle],
    speed: float = SPEED,
    yaw_rate: float = 0.0,
    rng: np.random.Generator | None = None,
    polar: bool = False,
) -> Scan:
    """Scan k, one every 100 ms, of vehicles (x, vx, y, vy) by id; with noise if there is an rng."""
    s = Scan(max(len(vehicles), 1))
    s.t_ns, s.n = k * 100 * MS, len(vehicles)
    s.ego_speed, s.ego_yaw_rate = speed, yaw_rate
    for row, (name, z) in enumerate(vehicles.items()):
        s.ids[row], s.z[row], s.std[row], s.valid[row] = name, z, STD, True
        if polar:
            s.angle[row] = angle = math.atan2(z[2], z[0])
            rate = (complex(z[1], z[3]) * cmath.exp(-1j * angle)).real
            distance = math.hypot(z[0], z[2])
            s.z[row] = distance, rate, 0.0, NAN
            s.std[row] = 0.2, 0.15, distance * 0.005, 1.0
            s.valid[row, 3] = False
        if rng is not None:
            s.z[row] += np.where(s.valid[row], rng.normal(0.0, s.std[row]), 0.0)
    return s


Reports = dict[int, Any]


def play(
    vehicles: Callable[[float], dict[int, Vehicle]],
    scans: int,
    *,
    speed: Callable[[float], float] | float = SPEED,
    yaw_rate: float = 0.0,
    seed: int | None = 1,
    polar: bool = False,
    detector: Detector | None = None,
) -> tuple[Detector, list[Reports]]:
    """A drive of so many scans; ``vehicles`` and ``speed`` at time t [s]."""
    detector = Detector(bank(), capacity=128) if detector is None else detector
    rng = None if seed is None else np.random.default_rng(seed)
    said = []
    for k in range(scans):
        t = 0.1 * k
        v = speed(t) if callable(speed) else speed
        s = scan(k, vehicles(t), v, yaw_rate, rng, polar)
        n = detector.step(s.t_ns, s)
        said.append({int(r["object_id"]): r.copy() for r in detector.reports[:n]})
    return detector, said


def content(report: Any) -> list[bytes]:
    """Every field bit for bit; what lies between them does not count."""
    return [np.asarray(report[name]).tobytes() for name in report.dtype.names]


def says(said: Iterable[Reports], name: int) -> list[Manoeuvre]:
    return [Manoeuvre(int(reports[name]["manoeuvre"])) for reports in said if name in reports]


def lane(number: int, x: float, vx: float = 0.0) -> Callable[[float], Vehicle]:
    return lambda t: (x + vx * t, vx, WIDTH * number, 0.0)


FOUR = {
    1: lane(-1, 30.0),
    2: lane(0, 45.0),
    3: lane(1, 60.0),
    4: lane(2, 40.0),
}
"""One vehicle in each lane, as fast as the ego."""


def four(t: float) -> dict[int, Vehicle]:
    return {name: vehicle(t) for name, vehicle in FOUR.items()}


# ---- who stands still, and who comes


@pytest.mark.parametrize("polar", [False, True])
@pytest.mark.parametrize("y", [0.0, -6.0])
def test_what_stands_still_is_said_at_once(polar: bool, y: float) -> None:
    _, said = play(lambda t: {**four(t), 9: (120.0 - SPEED * t, -SPEED, y, 0.0)}, 35, polar=polar)
    assert says(said[2:], 9) == [Manoeuvre.STATIONARY] * 33
    assert said[0][9]["p"][Manoeuvre.STATIONARY] > 0.3


@pytest.mark.parametrize("polar", [False, True])
def test_oncoming_is_said_at_once(polar: bool) -> None:
    _, said = play(
        lambda t: {**four(t), 9: (180.0 - (SPEED + 25.0) * t, -SPEED - 25.0, 10.0, 0.0)},
        30,
        polar=polar,
    )
    assert says(said[2:], 9) == [Manoeuvre.ONCOMING] * 28


@pytest.mark.parametrize("closing", [SPEED, SPEED + 25.0, 5.0, 2.0])
def test_without_the_egos_speed_nobody_stands_or_comes(closing: float) -> None:
    _, said = play(
        lambda t: {**four(t), 9: (150.0 - closing * t, -closing, 0.0, 0.0)}, 30, speed=NAN
    )
    for reports in said:
        for report in reports.values():
            assert report["p"][list(OFF_LANE)].max() < 1e-4
            assert math.isnan(report["ego_speed"])
    for reports in said[10:]:
        assert reports[9]["manoeuvre"] in (Manoeuvre.APPROACHING, Manoeuvre.REAR_END)


def test_the_ego_stands() -> None:
    """Standing next to what stands: relative speeds are those over ground."""
    _, said = play(
        lambda t: {1: lane(0, 8.0)(t), 2: (20.0 + 10 * t, 10.0, WIDTH, 0.0)}, 30, speed=0.0
    )
    assert set(says(said[3:], 1)) == {Manoeuvre.STATIONARY}
    assert set(says(said[3:], 2)) == {Manoeuvre.RECEDING}


def test_an_ego_speed_that_comes_and_goes() -> None:
    """Known, unknown, known: said, not said, said again; no track ends by it."""

    def speed(t: float) -> float:
        return NAN if 2.0 <= t < 4.0 else 10.0

    detector, said = play(
        lambda t: {
            1: lane(0, 60.0)(t),
            8: (160.0 - 10.0 * t, -10.0, -6.0, 0.0),
            9: (220.0 - 25.0 * t, -25.0, 7.0, 0.0),
        },
        60,
        speed=speed,
    )
    assert detector.counts.numeric_failures == detector.counts.deaths == 0
    for name, manoeuvre in ((8, Manoeuvre.STATIONARY), (9, Manoeuvre.ONCOMING)):
        told = says(said, name)
        assert set(told[5:20]) == {manoeuvre}
        assert not set(told[20:40]) & OFF_LANE
        assert set(told[48:]) == {manoeuvre}
    assert not set(says(said, 1)) & OFF_LANE


# ---- lanes


@pytest.mark.parametrize("speed", [SPEED, NAN])
@pytest.mark.parametrize("polar", [False, True])
def test_numbers_of_the_lanes(speed: float, polar: bool) -> None:
    detector, said = play(
        four, 60, speed=speed, yaw_rate=0.0 if speed == speed else NAN, polar=polar
    )
    for reports in said[5:]:
        assert [int(reports[name]["lane"]) for name in FOUR] == [-1, 0, 1, 2]
    for name in FOUR:
        assert set(says(said[10:], name)) == {Manoeuvre.KEEP_LANE}
    assert detector.road is not None
    assert detector.road.width == pytest.approx(WIDTH, abs=0.15)
    assert not any(report["flags"] for reports in said for report in reports.values())


def test_rear_end_is_near_and_in_the_egos_lane() -> None:
    _, said = play(lambda t: {**four(t), 8: lane(0, 32.0, -4.0)(t), 9: lane(1, 32.0, -4.0)(t)}, 70)
    assert Manoeuvre.REAR_END not in says(said, 9)
    for k, reports in enumerate(said):
        gap = 32.0 - 0.4 * k
        if k > 12 and gap > 12.0:
            assert reports[8]["manoeuvre"] == Manoeuvre.APPROACHING
        if gap < 8.5:
            assert reports[8]["manoeuvre"] == Manoeuvre.REAR_END
    assert set(says(said[15:60], 9)) == {Manoeuvre.APPROACHING}


@pytest.mark.parametrize("vx", [4.0, -4.0])
def test_faster_and_slower(vx: float) -> None:
    _, said = play(lambda t: {**four(t), 9: lane(1, 40.0 - 3.0 * vx, vx)(t)}, 60)
    expected = Manoeuvre.RECEDING if vx > 0 else Manoeuvre.APPROACHING
    assert set(says(said[15:], 9)) == {expected}


def sideways(t: float, begin: float, seconds: float) -> tuple[float, float]:
    """Lateral way and speed of a smooth lane change to the left."""
    u = min(max((t - begin) / seconds, 0.0), 1.0)
    way = WIDTH * (u - math.sin(2 * math.pi * u) / (2 * math.pi))
    return way, WIDTH / seconds * (1.0 - math.cos(2 * math.pi * u)) if 0.0 < u < 1.0 else 0.0


@pytest.mark.parametrize(
    ("start", "side", "flag"),
    [(1, -1, CUT_IN), (-1, 1, CUT_IN), (0, 1, CUT_OUT), (1, 1, 0)],
)
@pytest.mark.parametrize("polar", [False, True])
def test_a_lane_change(start: int, side: int, flag: int, polar: bool) -> None:
    """From 3.0 s to 7.5 s; said with its direction while it crosses the line, not by others."""

    def vehicles(t: float) -> dict[int, Vehicle]:
        way, vy = sideways(t, 3.0, 4.5)
        return {**four(t), 9: (25.0, 0.0, WIDTH * start + side * way, side * vy)}

    _, said = play(vehicles, 120, polar=polar)
    for k, reports in enumerate(said):
        t, report = 0.1 * k, reports[9]
        # without a lateral speed it takes longer to be seen
        if (4.8 if polar else 4.4) <= t <= 6.5:
            assert report["manoeuvre"] == Manoeuvre.LANE_CHANGE
            assert report["direction"] == side
            assert report["flags"] & (CUT_IN | CUT_OUT) == flag
        elif 1.0 < t < 2.8 or t > 9.0:
            assert report["manoeuvre"] != Manoeuvre.LANE_CHANGE
            assert report["direction"] == 0
            assert report["flags"] & (CUT_IN | CUT_OUT) == 0
            assert report["lane"] == start + (side if t > 9.0 else 0)
    for name in FOUR:
        assert Manoeuvre.LANE_CHANGE not in says(said[10:], name)


# ---- the ego's own motion


@pytest.mark.parametrize("polar", [False, True])
@pytest.mark.parametrize("side", [1, -1])
def test_in_a_bend_nobody_changes_lane(side: int, polar: bool) -> None:
    """A circle of 1000 m: y is metres away from k widths, and vy from 0."""
    radius = 1000.0 * side

    def vehicles(t: float) -> dict[int, Vehicle]:
        out = {}
        for name, vehicle in FOUR.items():
            x, _, y, _ = vehicle(t)
            turn = x / radius
            at = (radius - y) * complex(math.sin(turn), -math.cos(turn)) + 1j * radius
            over_ground = SPEED * cmath.exp(1j * turn)
            out[name] = (at.real, over_ground.real - SPEED, at.imag, over_ground.imag)
        return out

    _, said = play(vehicles, 80, yaw_rate=SPEED / radius, polar=polar)
    for reports in said[8:]:
        for name, (x, vx, y, vy) in vehicles(0.0).items():
            report = reports[name]
            assert report["manoeuvre"] == Manoeuvre.KEEP_LANE
            assert report["lane"] == name - 2
            np.testing.assert_allclose(report["x"], (x, vx, y, vy), atol=0.6)
    assert abs(y - WIDTH * 2) > 0.7


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("side", [1, -1])
def test_the_egos_lane_change_is_not_theirs(side: int, known: bool) -> None:
    before = 0.0
    detector = Detector(bank(), capacity=16)
    rng = np.random.default_rng(2)
    said: list[Reports] = []
    for k in range(130):
        way, vy = sideways(0.1 * k, 4.0, 4.5)
        heading = side * vy / SPEED
        yaw_rate, before = (heading - before) / 0.1, heading
        seen = {}
        for name, vehicle in FOUR.items():
            x, _, y, _ = vehicle(0.0)
            at = complex(x, y - side * way) * cmath.exp(-1j * heading)
            v = SPEED * cmath.exp(-1j * heading) - SPEED
            seen[name] = (at.real, v.real, at.imag, v.imag)
        motion = (SPEED, yaw_rate) if known else (NAN, NAN)
        s = scan(k, seen, *motion, rng)
        n = detector.step(s.t_ns, s)
        said.append({int(r["object_id"]): r.copy() for r in detector.reports[:n]})
    for name in FOUR:
        assert Manoeuvre.LANE_CHANGE not in says(said[10:], name)
    for reports, shift in ((said[30], 0), (said[-1], side)):
        assert [int(reports[name]["lane"]) for name in FOUR] == [
            number - shift for number in (-1, 0, 1, 2)
        ]


@pytest.mark.parametrize("width", [3.3, 3.75])
def test_a_broad_road_seen_from_its_edge(width: float) -> None:
    """Lanes are wider or narrower than was thought: six lanes aside that is more than half of one.
    Two vehicles in each of seven lanes wander, and so does the ego."""
    rng = np.random.default_rng(3)
    cars = {
        n: (-(n // 2), rng.uniform(15.0, 110.0), rng.uniform(0.2, 0.4), rng.uniform(0.3, 0.8))
        for n in range(14)
    }

    def aside(size: float, pace: float, t: float) -> tuple[float, float]:
        return size * math.sin(pace * t + 9.0 * size), size * pace * math.cos(pace * t + 9.0 * size)

    def vehicles(t: float) -> dict[int, Vehicle]:
        ours, our_rate = aside(0.28, 0.42, t)
        out = {}
        for name, (number, x, size, pace) in cars.items():
            place, rate = aside(size, pace, t)
            out[name] = (x, 0.0, width * number + place - ours, rate - our_rate)
        return out

    _, said = play(vehicles, 200)
    right = [reports[n]["lane"] == cars[n][0] for reports in said[20:] for n in reports]
    assert np.mean(right) > 0.99


# ---- many, twice, and rubbish


def test_a_hundred_objects() -> None:
    def vehicles(t: float) -> dict[int, Vehicle]:
        return {i: (10.0 + 1.8 * i, 0.0, WIDTH * (i % 3 - 1), 0.0) for i in range(100)}

    detector, said = play(vehicles, 12)
    assert all(len(reports) == 100 for reports in said)
    assert detector.counts.overflow == detector.counts.outliers == 0
    assert [int(said[-1][i]["lane"]) for i in range(30)] == [i % 3 - 1 for i in range(30)]


def test_one_vehicle_under_two_names() -> None:
    def vehicles(t: float) -> dict[int, Vehicle]:
        out = four(t)
        if t > 1.0:
            out[9] = (46.0, 0.1, 0.2, 0.0)
        return out

    _, said = play(vehicles, 40)
    assert [int(reports[9]["duplicate_of"]) for reports in said[25:]] == [2] * 15
    assert all(int(reports[2]["duplicate_of"]) == -1 for reports in said)
    assert said[11][9]["duplicate_of"] == -1, "one scan says nothing"


@pytest.mark.parametrize("speed", [math.inf, -math.inf, 1e300, 151.0])
def test_an_ego_speed_that_no_vehicle_has_is_unknown(speed: float) -> None:
    detector, said = play(
        lambda t: {**four(t), 9: (90.0 - 20 * t, -20.0, 0.0, 0.0)}, 25, speed=speed
    )
    unknown, same = play(lambda t: {**four(t), 9: (90.0 - 20 * t, -20.0, 0.0, 0.0)}, 25, speed=NAN)
    assert detector.counts.ego_invalid == detector.counts.scans == 25
    assert unknown.counts.ego_invalid == 0
    for one, two in zip(said, same, strict=True):
        assert one.keys() == two.keys()
        for name, report in one.items():
            assert content(report) == content(two[name])


@pytest.mark.parametrize("yaw_rate", [math.inf, -1e200, 40.0])
def test_a_yaw_rate_that_no_vehicle_has_is_unknown(yaw_rate: float) -> None:
    detector, said = play(four, 20, yaw_rate=yaw_rate)
    assert detector.counts.ego_invalid == 20
    assert [int(said[-1][name]["lane"]) for name in FOUR] == [-1, 0, 1, 2]


@pytest.mark.parametrize("angle", [NAN, math.inf, 1e300])
def test_an_angle_that_is_none(angle: float) -> None:
    detector, _ = play(four, 10)
    s = scan(10, four(1.0))
    s.angle[1] = angle
    assert detector.step(s.t_ns, s) == 4
    assert detector.counts.invalid == 1
    assert detector.counts.numeric_failures == 0
    assert detector.reports["coasting"][:4].tolist() == [False, True, False, False]


NUMBERS = st.sampled_from([NAN, math.inf, -math.inf, 1e300, -1e9, 0.0, 30.0, -2.0, 149.0])
ROWS = st.tuples(
    st.integers(0, 9),
    st.tuples(*[st.one_of(st.floats(-60.0, 160.0), NUMBERS)] * 4),
    st.sampled_from([0.1, 0.1, 0.5, 0.0, 1e200, NAN]),
    st.integers(0, 15),
    st.sampled_from([0.0, 0.0, 0.3, -2.0, NAN, math.inf, 1e18]),
)
SCANS = st.lists(
    st.tuples(
        st.sampled_from([100, 100, 50, 700, 1500]), NUMBERS, NUMBERS, st.lists(ROWS, max_size=6)
    ),
    max_size=15,
)


@settings(max_examples=40)
@given(SCANS)
def test_whatever_a_bus_says_is_survived(script: list[Any]) -> None:
    detector = Detector(bank(), capacity=4)
    t, rows_given = 0, 0
    for gap, speed, yaw_rate, rows in script:
        t += gap
        s = Scan(max(len(rows), 1))
        s.t_ns, s.n, s.ego_speed, s.ego_yaw_rate = t * MS, len(rows), speed, yaw_rate
        for k, (name, z, std, mask, angle) in enumerate(rows):
            s.ids[k], s.z[k], s.std[k], s.angle[k] = name, z, std, angle
            s.valid[k] = [mask >> c & 1 for c in range(4)]
        rows_given += len(rows)
        n = detector.step(s.t_ns, s)
        reports = detector.reports[:n]
        assert np.isfinite(reports["x"]).all()
        assert np.isfinite(reports["cov"]).all()
        np.testing.assert_allclose(reports["p"].sum(axis=1), 1.0, rtol=1e-9)
        road = detector.road
        assert road is not None
        assert np.isfinite(road.x).all()
        assert np.isfinite(road.P).all()
        assert 2.0 < road.width < 6.0
    c = detector.counts
    assert rows_given == (
        c.measurements + c.outliers + c.invalid + c.numeric_failures + c.overflow + c.duplicates
    )
    assert c.births - c.deaths == detector.n_tracked


def test_the_same_input_gives_the_same_reports_bit_for_bit() -> None:
    one, two = play(four, 30)[1], play(four, 30)[1]
    for first, second in zip(one, two, strict=True):
        assert {k: content(r) for k, r in first.items()} == {
            k: content(r) for k, r in second.items()
        }


# ---- particles in turned axes


@pytest.fixture(scope="module")
def two_lane() -> ModeBank:
    return load_bank("two-lane")


def test_a_polar_sensor_and_particles(two_lane: ModeBank) -> None:
    detector, said = play(
        lambda t: {
            1: (30.0, 0.0, 0.0, 0.0),
            2: (40.0, 0.0, 3.0, 0.0),
            3: (90.0 - 5 * t, -5.0, 0.0, 0.0),
        },
        60,
        polar=True,
        detector=Detector(two_lane),
    )
    assert set(says(said[20:], 1)) == {Manoeuvre.KEEP_RIGHT}
    assert set(says(said[20:], 2)) == {Manoeuvre.KEEP_LEFT}
    assert set(says(said[20:], 3)) == {Manoeuvre.APPROACHING}
    counts = dataclasses.asdict(detector.counts)
    assert counts["outliers"] == counts["numeric_failures"] == counts["invalid"] == 0
    assert said[-1][2]["x"][2] == pytest.approx(3.0, abs=0.2)


def test_who_is_far_away_changes_lanes_on_a_road_that_is_known_to_be_straight():
    """A polar radar, 150 m: half a metre of noise.  A bend that begins there looks the same."""

    def vehicles(t: float) -> dict[int, Vehicle]:
        done = min(max((t - 8.0) / 3.0, 0.0), 1.0)
        vy = WIDTH / 3.0 if 8.0 < t < 11.0 else 0.0
        return {1: (30.0, 0.0, 0.0, 0.0), 2: (150.0, 0.0, WIDTH * done, vy)}

    straight = load_bank("motorway", straight_road=True)
    found = {}
    for name, modes in (("learned", bank()), ("straight", straight)):
        found[name] = 0
        for seed in range(4):
            detector = Detector(modes, capacity=8)
            _, said = play(vehicles, 160, seed=seed, polar=True, detector=detector)
            found[name] += Manoeuvre.LANE_CHANGE in says(said[80:130], 2)
            assert says(said[20:80], 2).count(Manoeuvre.LANE_CHANGE) == 0
            assert Manoeuvre.LANE_CHANGE not in says(said, 1)
    assert found["straight"] == 4
    assert found["learned"] < 2


def drifting(peak: float, rest: float) -> Callable[[float], dict[int, Vehicle]]:
    """A vehicle beside another one: from 4 s on faster than the ego, by the first speed [m/s] for
    four seconds, and then by the second."""

    def vehicles(t: float) -> dict[int, Vehicle]:
        knots = [4.0, 4.0 + peak / 1.5, 8.0 + peak / 1.5, 8.0 + peak / 1.5 + (peak - rest) / 1.5]
        times = np.linspace(0.0, t, 200)
        speeds = np.interp(times, knots, [0.0, peak, peak, rest])
        return {
            1: (40.0 + float(np.trapezoid(speeds, times)), float(speeds[-1]), -WIDTH, 0.0),
            2: (30.0, 0.0, WIDTH, 0.0),
        }

    return vehicles


@pytest.mark.parametrize("seed", range(3))
def test_who_drifts_away_slowly_keeps_its_lane(seed: int) -> None:
    _, said = play(drifting(0.7, 0.7), 200, seed=seed)
    manoeuvres = says(said, 1)
    assert manoeuvres[70:].count(Manoeuvre.KEEP_LANE) > 0.85 * 130  # none without a peak speed
    assert says(said, 2).count(Manoeuvre.KEEP_LANE) > 190


@pytest.mark.parametrize("seed", range(3))
def test_who_was_faster_before_recedes_until_it_is_as_fast_as_the_ego(seed: int) -> None:
    _, said = play(drifting(3.0, 0.75), 180, seed=seed)
    manoeuvres = says(said, 1)
    assert manoeuvres[55:].count(Manoeuvre.RECEDING) > 0.95 * 125
    _, said = play(drifting(3.0, 0.0), 180, seed=seed)
    assert says(said, 1)[130:].count(Manoeuvre.KEEP_LANE) == 50


@pytest.mark.parametrize("speed", [-1.4, 1.4])
def test_who_is_faster_or_slower_by_more_does_it_all_the_time(speed: float) -> None:
    _, said = play(lambda t: {1: (60.0 + speed * t, speed, WIDTH, 0.0)}, 150)
    manoeuvre = Manoeuvre.RECEDING if speed > 0.0 else Manoeuvre.APPROACHING
    assert says(said, 1)[20:].count(manoeuvre) > 125
