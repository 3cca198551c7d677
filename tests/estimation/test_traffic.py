"""The joint filter of road, ego and vehicles: against a drive through the plane, and against dense
Kalman filters, one for each combination of courses."""

from __future__ import annotations

import itertools
import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from oracles.gaussian import random_covariance, update
from scipy.linalg import expm
from small_roads import USUAL, nothing_but_motion, parameters
from test_road import KNOTS, NAN, SEEDS, curvature, integral, middle, random_road

from can_imm.estimation import lane_changes, road, traffic
from can_imm.estimation.road import (
    BIAS,
    HEADING,
    KNOT,
    MOUNTING,
    N_KNOTS,
    N_ROAD,
    OFFSET,
    SPACING,
    WAY,
    WIDTH,
)
from can_imm.estimation.traffic import EGO, FREE, N_LOCAL, N_PARTIES, NOBODY, N
from can_imm.estimation.wander import NO_LANE

LAST = N_ROAD - 1
LOOSE = {"offset_std": 1e9, "heading_std": 1e9, "turn_std": 1e9}
"""A driver without habits."""


def with_road(x: np.ndarray, P: np.ndarray, par: np.ndarray, t: float = 0.0) -> Any:
    """The filter with that state and covariance of the road, and no vehicles."""
    T = traffic.new_traffic()[0]
    traffic.begin_traffic_(T, par, t, x[WIDTH], P[WIDTH, WIDTH])
    T["x"][:N_ROAD], T["P"][:N_ROAD, :N_ROAD] = x, P
    return T


def moved(
    x: np.ndarray, P: np.ndarray, par: np.ndarray, dt: float, speed: float, yaw_rate: float
) -> tuple[np.ndarray, np.ndarray]:
    """State and covariance of the road after ``dt`` seconds."""
    T = with_road(x, P, par)
    traffic.predict_traffic_(T, par, dt, dt, speed, yaw_rate)
    assert not T["x"][N_ROAD:].any()
    assert not T["P"][N_ROAD:].any()
    return T["x"][:N_ROAD].copy(), T["P"][:N_ROAD, :N_ROAD].copy()


def known_way(P: np.ndarray) -> np.ndarray:
    """The covariance, but how far the ego has come is known."""
    P[WAY] = P[:, WAY] = 0.0
    return P


CERTAIN = np.zeros((N_ROAD, N_ROAD))


class Local(NamedTuple):
    """A course of a party."""

    who: int
    lane: int = 0
    turn: int = 0
    start: float = 0.0
    duration: float = 4.0
    steady: bool = False


def put_(T: Any, locals_: list[Local], choice: list[list[int]], guides: dict[int, float]) -> None:
    """Hypotheses into a filter, by hand: nothing speaks for one or the other yet.

    ``choice``: for each global hypothesis the numbers of local ones, one of each party.
    ``guides``: how far each vehicle that is followed wanders [m].
    """
    T["n"], T["n_global"] = len(locals_), len(choice)
    T["choice"][:] = FREE
    for q, one in enumerate(locals_):
        T["local"][q] = (one.start, one.duration, one.who, one.lane, one.turn, one.steady)
        T["mean"][q] = 0.0
    for g, chosen in enumerate(choice):
        for q in chosen:
            T["choice"][g, locals_[q].who] = q
        T["odds"][g, : len(locals_)] = T["log_w"][g] = 0.0
    for g, beside in guides.items():
        T["party"]["slot"][g], T["party"]["beside"][g] = 3 + g, beside
        T["top"] = max(int(T["top"]), N_ROAD + 2 * g + 2)


PARTIES = {0: 0.3, 2: 0.15}
"""Two vehicles, with a gap between them."""
LOCALS = [Local(who) for who in (EGO, 0, 2, 0, 2, EGO, 0)]
GLOBALS = [[0, 1, 2], [5, 3, 2], [0, 6, 4]]
IN_USE = np.array([*range(N_ROAD), N_ROAD, N_ROAD + 1, N_ROAD + 4, N_ROAD + 5])
"""States of the road and of the two vehicles."""


def crowd(rng: np.random.Generator, par: np.ndarray) -> Any:
    """Seven local and three global hypotheses of two vehicles and the ego, all correlated."""
    root = np.linalg.cholesky(0.05 * random_covariance(rng, len(IN_USE)))
    root[WAY] = 0.0
    P = root @ root.T
    T = with_road(random_road(rng), P[:N_ROAD, :N_ROAD], par)
    put_(T, LOCALS, GLOBALS, PARTIES)
    T["P"][np.ix_(IN_USE, IN_USE)] = P
    T["x"][N_ROAD : T["top"]] = rng.normal(0.0, 0.3, T["top"] - N_ROAD)
    T["x"][N_ROAD + 2 : N_ROAD + 4] = 0.0
    for name, rows, size in (("mean", len(LOCALS), 0.5), ("rest", len(GLOBALS), 0.3)):
        T[name][:rows, IN_USE] = size * rng.normal(size=(rows, len(IN_USE))) @ root.T
    return T


def mean_of(T: Any, g: int, courses: Any) -> np.ndarray:
    """Mean (N,) of a global hypothesis if the parties have these courses."""
    return T["x"] + T["rest"][g] + T["mean"][list(courses)].sum(0)


# ---- courses


def shape(steady: bool) -> Polynomial:
    """Share of the way by the share of the time."""
    if steady:
        return Polynomial([0.0, 1.0])
    return 0.5 * Polynomial([0, 0, 0, 10, -15, 6]) + 0.5 * Polynomial([0, 0, 3, -2])


def where(one: Local, t: float) -> tuple[float, float, float]:
    """Place of a course in lanes, and its derivatives by the time."""
    u = (t - one.start) / one.duration
    if u <= 0.0 or one.turn == 0:
        return one.lane, 0.0, 0.0
    if u >= 1.0:
        return one.lane + one.turn, 0.0, 0.0
    p = shape(one.steady)
    d = one.duration
    place, slope, bend = p(u), p.deriv()(u) / d, p.deriv(2)(u) / d**2
    return one.lane + one.turn * place, one.turn * slope, one.turn * bend


@given(st.floats(-0.5, 1.5), st.booleans())
def test_a_course_and_its_derivatives(u: float, steady: bool) -> None:
    one = Local(EGO, 0, 1, 0.0, 1.0, steady)
    assert traffic.course(u, steady) == pytest.approx(where(one, u), abs=1e-12)
    if u > 0.0:
        assert traffic.course(u, steady)[:2] == lane_changes.course(u, steady)


@given(
    st.floats(-3.0, 9.0), st.integers(-3, 3), st.sampled_from([-1, 0, 1]), st.floats(2.0, 7.0),
    st.booleans(),
)  # fmt: skip
def test_where_a_course_is(t: float, lane: int, turn: int, duration: float, steady: bool) -> None:
    one = Local(3, lane, turn, 1.25, duration, steady)
    T = traffic.new_traffic()[0]
    put_(T, [one], [[0]], {})
    assert traffic.lane_at(T["local"][0], t) == pytest.approx(where(one, t), abs=1e-12)


# ---- the beginning


def test_a_new_filter_knows_of_nothing_but_the_road() -> None:
    """Whatever was in it before: the ego keeps its lane, and there is nobody else."""
    par = parameters()
    T = crowd(np.random.default_rng(0), par)
    T["odds"][:, :7] = 1.0
    T["log_w"][:3] = -1.0, 0.0, -2.0
    traffic.begin_traffic_(T, par, 12.5, 3.8, 0.01)
    x, P = road.new_road(par)
    x[WIDTH], P[WIDTH, WIDTH] = 3.8, 0.01
    np.testing.assert_array_equal(mean_of(T, 0, [0])[:N_ROAD], x)
    np.testing.assert_array_equal(T["P"][:N_ROAD, :N_ROAD], P)
    assert not T["x"][N_ROAD:].any()
    assert not T["P"][N_ROAD:].any()
    assert (T["n"], T["n_global"], T["top"]) == (1, 1, N_ROAD)
    assert (T["party"]["slot"] == FREE).all()
    assert T["party"]["begun"][EGO] == 12.5
    chosen = np.full(N_PARTIES, FREE)
    chosen[EGO] = 0
    np.testing.assert_array_equal(T["choice"][0], chosen)
    assert T["local"]["who"][0] == EGO
    assert traffic.lane_at(T["local"][0], 20.0) == (0.0, 0.0, 0.0)
    got_x, got_P = summary(T)
    np.testing.assert_array_equal(got_x, x)
    np.testing.assert_array_equal(got_P, P)


# ---- motion


def drive(
    r: np.ndarray, v: float, yaw_rate: float, dt: float, steps: int = 400
) -> tuple[float, float, float]:
    """Offset, heading, way after driving: the ego and the road's middle in the plane."""
    w = yaw_rate - r[BIAS]
    tau = dt / steps
    x, y, heading = 0.0, r[OFFSET], r[HEADING]
    for _ in range(steps):
        mid = heading + 0.5 * w * tau
        x, y, heading = x + v * tau * math.cos(mid), y + v * tau * math.sin(mid), mid
        heading += 0.5 * w * tau
    # the nearest point of the road, walked along in small steps
    ds = v * dt / steps / 4
    px, py, s, direction = 0.0, 0.0, 0.0, 0.0
    while (x - px) * math.cos(direction) + (y - py) * math.sin(direction) > 0.0:
        turn = ds * float(curvature(r, r[WAY] + s + 0.5 * ds))
        mid = direction + 0.5 * turn
        px, py, s = px + ds * math.cos(mid), py + ds * math.sin(mid), s + ds
        direction += turn
    across = (y - py) * math.cos(direction) - (x - px) * math.sin(direction)
    return across, heading - direction, r[WAY] + s


@settings(max_examples=25)
@given(SEEDS, st.floats(5.0, 40.0), st.floats(-0.05, 0.05))
def test_the_ego_drives_along_the_road(seed: int, v: float, yaw_rate: float) -> None:
    before = random_road(np.random.default_rng(seed), bends=2.5e-5)
    offset, heading, way = drive(before, v, yaw_rate, 0.4)
    P = known_way(np.eye(N_ROAD))
    x, _ = moved(before, P, nothing_but_motion(), 0.4, v, yaw_rate)
    assert x[OFFSET] == pytest.approx(offset, abs=4e-3)
    assert x[HEADING] == pytest.approx(heading, abs=4e-4)
    passed = SPACING if way >= SPACING else 0.0
    assert x[WAY] == pytest.approx(before[WAY] + v * 0.4 - passed, abs=1e-9)
    assert curvature(x, x[WAY]) == pytest.approx(curvature(before, way), abs=1e-6)
    before[BIAS] *= math.exp(-0.4 / road.BIAS_TIME)
    unchanged = [BIAS, MOUNTING, WIDTH]
    np.testing.assert_allclose(x[unchanged], before[unchanged], rtol=1e-9)


def test_a_drive_into_a_bend() -> None:
    """Eight seconds in the plane, 200 m: straight, then ever tighter, then a bend of 670 m radius.

    The ego wanders; what it sees of the road is the road's own line in the axes of the ego.
    """
    v, tau, dt = 25.0, 1e-3, 0.01
    profile = np.interp(KNOTS, [75.0, 150.0], [0.0, 1.5e-3])
    s = np.arange(0.0, 400.0, 0.05)
    direction = np.concatenate(([0.0], np.cumsum(0.05 * np.interp(s[:-1] + 0.025, KNOTS, profile))))
    mid = direction[:-1] + 0.5 * np.diff(direction)
    line = np.concatenate(([0.0], np.cumsum(0.05 * np.exp(1j * mid))))
    x, par = np.zeros(N_ROAD), nothing_but_motion()
    x[WIDTH], x[OFFSET], x[HEADING] = 3.5, 0.4, -0.005
    x[KNOT:] = profile
    T = with_road(x, CERTAIN, par)
    at, heading = 0.4j, -0.005
    for k in range(800):
        w = v * float(np.interp(v * (k + 0.5) * dt, KNOTS, profile))
        w += 0.02 * math.cos(0.9 * k * dt)
        for _ in range(round(dt / tau)):
            at += v * tau * np.exp(1j * (heading + 0.5 * w * tau))
            heading += w * tau
        traffic.predict_traffic_(T, par, dt, (k + 1) * dt, v, w)
    seen = (line - at) * np.exp(-1j * heading)
    assert heading > 0.1, "the ego has followed the bend"
    for ahead in (1.0, 30.0, 80.0, 120.0):
        y = float(np.interp(ahead, seen.real, seen.imag))
        assert middle(T["x"], ahead) == pytest.approx(y, abs=0.02 + 0.02 * abs(y))


@settings(max_examples=40)
@given(SEEDS, st.floats(0.5, 60.0))
def test_the_knots_stand_still_on_the_ground(seed: int, s: float) -> None:
    """After s metres all that was ahead is s metres nearer, seen from another pose of the ego."""
    before = random_road(np.random.default_rng(seed))
    v, r = 30.0, before
    for _ in range(3):
        r, _ = moved(r, CERTAIN, nothing_but_motion(), s / 3 / v, v, 0.0)
    assert 0.0 <= r[WAY] < SPACING
    assert (before[WAY] + s - r[WAY]) / SPACING == pytest.approx(
        round((before[WAY] + s - r[WAY]) / SPACING), abs=1e-9
    )
    before[[OFFSET, HEADING, MOUNTING]] = r[[OFFSET, HEADING, MOUNTING]] = 0.0
    turned = integral(before, before[WAY], before[WAY] + s, arm=False)
    aside = integral(before, before[WAY], before[WAY] + s, arm=True)
    for x in (0.0, 5.0, 33.0, 90.0, 150.0, 300.0):
        expected = middle(before, x + s) - aside - turned * x
        assert middle(r, x) == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("speed", [33.0, NAN])
def test_how_far_the_ego_has_come_is_known(speed: float) -> None:
    par = parameters()
    T = with_road(*road.new_road(par), par)
    v, way = (road.USUAL_SPEED if math.isnan(speed) else speed), 0.0
    for k in range(50):
        traffic.predict_traffic_(T, par, 0.1, 0.1 * (k + 1), speed, 0.01)
        way += 0.1 * v
        assert T["x"][WAY] == pytest.approx(way % SPACING, abs=1e-9)
        assert not T["P"][WAY].any()
        assert not T["P"][:, WAY].any()


def test_two_knots_may_be_passed_at_once() -> None:
    before = random_road(np.random.default_rng(5))
    before[WAY] = 20.0
    x, _ = moved(before, CERTAIN, nothing_but_motion(), 0.9, 60.0, NAN)
    assert x[WAY] == pytest.approx(20.0 + 54.0 - 2 * SPACING)
    np.testing.assert_allclose(x[KNOT : LAST - 1], before[KNOT + 2 :])
    np.testing.assert_allclose(x[LAST - 1 :], before[LAST])


def test_backwards_no_knot_comes_back() -> None:
    before = random_road(np.random.default_rng(6))
    x, _ = moved(before, CERTAIN, nothing_but_motion(), 0.5, -60.0, NAN)
    assert x[WAY] == 0.0
    np.testing.assert_allclose(x[KNOT:], before[KNOT:])


def test_before_anything_is_seen_every_place_bends_alike() -> None:
    """Passing knots says nothing of how the road bends."""
    par = parameters(curvature_std=0.002, curvature_length=40.0, **LOOSE)
    x, P = road.new_road(par)
    T = with_road(x, P, par)
    for k in range(2 * N_KNOTS + 1):
        traffic.predict_traffic_(T, par, 1.0, k + 1.0, 26.0, NAN)
        np.testing.assert_allclose(
            T["P"][KNOT:N_ROAD, KNOT:N_ROAD], P[KNOT:, KNOT:], rtol=1e-9, atol=1e-18
        )
        assert not T["P"][KNOT:N_ROAD, :KNOT].any()
        assert not T["x"][KNOT:N_ROAD].any()


@pytest.mark.parametrize("bend", [0.0, 0.0005, 0.002])
def test_how_bent_the_road_is_is_learnt_by_driving(bend: float) -> None:
    """And forgotten: what was driven long ago does not count."""
    par = parameters(curvature_length=100.0, **LOOSE)
    T = with_road(*road.new_road(par), par)
    assert traffic.usual_curvature(T, par) == pytest.approx(0.001)
    weights = 0.25 * np.exp(-0.25 / traffic.ROAD_MEMORY * np.arange(400))
    weight = weights.sum() / (weights.sum() + traffic.ROAD_TRUST)
    for kappa in (bend, 0.001):
        for _ in weights:
            T["x"][KNOT], T["P"][KNOT, KNOT] = 0.6 * kappa, (0.8 * kappa) ** 2
            traffic.learn_curvature_(T, 0.25)
        expected = math.sqrt(weight * kappa**2 + (1.0 - weight) * 0.001**2)
        assert traffic.usual_curvature(T, par) == pytest.approx(expected, rel=1e-5)


def test_without_a_yaw_rate_the_bend_says_nothing_of_the_heading() -> None:
    before = random_road(np.random.default_rng(1))
    P, par = known_way(np.eye(N_ROAD)), nothing_but_motion()
    x, _ = moved(before, P, par, 0.2, 30.0, NAN)
    assert x[HEADING] == before[HEADING]
    assert x[OFFSET] == pytest.approx(before[OFFSET] + 6.0 * before[HEADING])
    x, _ = moved(before, P, par, 0.2, NAN, 0.03)
    assert x[HEADING] == before[HEADING]
    assert x[OFFSET] == pytest.approx(before[OFFSET] + 0.2 * road.USUAL_SPEED * before[HEADING])


def matern(beside: float, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition and noise of a place beside a course and its rate (Van Loan)."""
    a = USUAL["beside_rate"]
    A = np.array([[0.0, 1.0], [-(a**2), -2.0 * a]])
    block = np.zeros((4, 4))
    block[:2, :2], block[2:, 2:] = -A, A.T
    block[1, 3] = 4.0 * a**3 * beside**2
    e = expm(block * dt)
    F = e[2:, 2:].T
    return F, F @ e[:2, 2:]


def driven_by(T: Any, knots: int, length: float) -> float:
    """Standard deviation of the curvature when the ego has passed so many knots more: the mean of
    the squares of those passed, the longer ago the less, and of what is usual."""
    ago = SPACING / length * np.arange(knots)[::-1]
    fade = np.exp(-ago / traffic.ROAD_MEMORY)
    passed = np.arange(KNOT, KNOT + knots)
    squares = T["x"][passed] ** 2 + np.diag(T["P"])[passed]
    older = math.exp(-knots * SPACING / length / traffic.ROAD_MEMORY)
    weights = np.array([
        traffic.ROAD_TRUST, older * T["driven"], *(SPACING / length * fade)
    ])  # fmt: skip
    known = T["bends"] / T["driven"] if T["driven"] > 0.0 else 0.0
    return math.sqrt(np.average([USUAL["curvature_std"] ** 2, known, *squares], weights=weights))


def motion(
    T: Any, dt: float, speed: float, yaw_rate: float, guides: dict[int, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """F (N, N), u (N,) and Q (N, N): the state becomes F x + u, and Q is its noise."""
    way, passed = T["x"][WAY], 0
    known = not math.isnan(speed + yaw_rate)
    v = road.USUAL_SPEED if math.isnan(speed) else speed
    F, u, Q = np.eye(N), np.zeros(N), np.zeros((N, N))
    F[OFFSET, HEADING] = v * dt
    F[BIAS, BIAS] = math.exp(-dt / road.BIAS_TIME)
    if known:
        for knot in range(KNOT, N_ROAD):
            one = np.zeros(N)
            one[knot] = 1.0
            F[HEADING, knot] = -integral(one, way, way + v * dt, arm=False)
            F[OFFSET, knot] = -integral(one, way, way + v * dt, arm=True)
        F[HEADING, BIAS], F[OFFSET, BIAS] = -dt, -0.5 * v * dt**2
        u[HEADING], u[OFFSET] = yaw_rate * dt, 0.5 * v * dt * yaw_rate * dt
    yaw = USUAL["yaw_noise"] if known else USUAL["yaw_noise_unknown"]
    Q[HEADING, HEADING] = yaw**2 * dt
    Q[OFFSET, OFFSET] = USUAL["drift"] ** 2 * dt
    Q[BIAS, BIAS] = USUAL["bias_std"] ** 2 * (1.0 - F[BIAS, BIAS] ** 2)
    for g, beside in guides.items():
        a = slice(N_ROAD + 2 * g, N_ROAD + 2 * g + 2)
        F[a, a], Q[a, a] = matern(beside, dt)
    u[WAY] = v * dt
    memory = math.exp(-SPACING / USUAL["curvature_length"])
    while way + u[WAY] >= SPACING:
        A = np.eye(N)
        for i in range(KNOT, LAST):
            A[i, i], A[i, i + 1] = 0.0, 1.0
        A[LAST, LAST] = memory
        F, u, Q = A @ F, A @ u, A @ Q @ A.T
        u[WAY] -= SPACING
        passed += 1
        std = driven_by(T, passed, USUAL["curvature_length"])
        Q[LAST, LAST] += std**2 * (1.0 - memory**2)
    return F, u, Q


@settings(max_examples=25)
@given(SEEDS, st.booleans(), st.sampled_from([0.0, 7.0, 24.0]), st.sampled_from([0.02, 0.1, 2.0]))
def test_the_covariance_moves_with_the_state(seed: int, known: bool, way: float, dt: float) -> None:
    """F P F' + Q with the derivatives of the closed-form motion; vehicles that wander, and their
    correlations, too."""
    par = parameters(**LOOSE)
    T = crowd(np.random.default_rng(seed), par)
    T["x"][WAY] = way
    yaw_rate = 0.02 if known else NAN
    F, u, Q = motion(T, dt, 30.0, yaw_rate, PARTIES)
    expected = [F @ mean_of(T, g, chosen) + u for g, chosen in enumerate(GLOBALS)]
    expected_P = F @ T["P"] @ F.T + Q
    traffic.predict_traffic_(T, par, dt, dt, 30.0, yaw_rate)
    for g, chosen in enumerate(GLOBALS):
        np.testing.assert_allclose(mean_of(T, g, chosen), expected[g], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(T["P"], expected_P, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("way", [5.0, 24.0])
def test_noise_of_the_motion(known: bool, way: float) -> None:
    """From certainty: what the yaw rate and the driver add in a tenth of a second, and the road
    where it comes into view."""
    x = np.zeros(N_ROAD)
    x[WAY] = way
    _, P = moved(x, CERTAIN, parameters(**LOOSE), 0.1, 20.0, 0.0 if known else NAN)
    assert P[HEADING, HEADING] == pytest.approx((1e-3 if known else 1e-2) ** 2 * 0.1, rel=1e-6)
    assert P[OFFSET, OFFSET] == pytest.approx(0.05**2 * 0.1, rel=1e-6)
    new = 0.0
    if way + 2.0 > SPACING:
        straight = SPACING / 1000.0
        usual = 0.001**2 * traffic.ROAD_TRUST / (traffic.ROAD_TRUST + straight)
        new = usual * (1.0 - math.exp(-2.0 * SPACING / 1000.0))
    assert P[LAST, LAST] == pytest.approx(new, rel=1e-6)
    assert P[BIAS, BIAS] == pytest.approx(0.005**2 * (1.0 - math.exp(-0.2 / 120.0)), rel=1e-6)
    assert P[MOUNTING, MOUNTING] == P[WIDTH, WIDTH] == P[WAY, WAY] == 0.0
    assert not P[KNOT:LAST, KNOT:LAST].any()


def test_a_vehicle_that_is_not_seen_wanders_as_vehicles_do() -> None:
    """Whatever was known of it is forgotten, and nothing else begins."""
    par = parameters(**LOOSE)
    T = crowd(np.random.default_rng(3), par)
    a = N_ROAD + 4
    for k in range(60):
        traffic.predict_traffic_(T, par, 0.5, 0.5 * (k + 1), 20.0, 0.0)
    covariance = np.diag([0.15, 0.15 * USUAL["beside_rate"]]) ** 2
    np.testing.assert_allclose(T["P"][a : a + 2, a : a + 2], covariance, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(mean_of(T, 1, GLOBALS[1])[a : a + 2], 0.0, atol=1e-4)
    assert not T["P"][N_ROAD + 2 : N_ROAD + 4].any(), "nobody is there"


@pytest.mark.parametrize("yaw_rate", [0.0, NAN])
def test_without_traffic_nothing_grows_beyond_what_it_can_be(yaw_rate: float) -> None:
    par = parameters()
    T = with_road(*road.new_road(par), par)
    for k in range(6000):
        traffic.predict_traffic_(T, par, 0.1, 0.1 * (k + 1), 30.0, yaw_rate)
    assert np.isfinite(T["x"]).all()
    P = T["P"][:N_ROAD, :N_ROAD]
    std = np.sqrt(np.diag(P))
    most = np.full(N_ROAD, 0.001001)
    most[[OFFSET, HEADING, BIAS, MOUNTING, WIDTH, WAY]] = 5.0, 0.1, 0.0051, 0.01, 0.3, 1e-12
    assert (std < most).all()
    assert np.linalg.eigvalsh(P).min() > -1e-12


def test_a_bend_is_learned_from_the_egos_own_yaw_rate() -> None:
    par = parameters()
    T = with_road(*road.new_road(par), par)
    for k in range(300):
        traffic.predict_traffic_(T, par, 0.1, 0.1 * (k + 1), 30.0, 0.03)
    assert curvature(T["x"], T["x"][WAY]) == pytest.approx(0.03 / 30.0, rel=0.3)
    assert abs(T["x"][OFFSET]) < 0.5


# ---- one value


def row_(T: Any, H: np.ndarray) -> int:
    """The row H (N,) into the filter: its entries that are not 0, in any order; their number."""
    at = np.flatnonzero(H)[::-1]
    T["h"][: len(at)], T["at"][: len(at)] = H[at], at
    return len(at)


def random_row(rng: np.random.Generator) -> np.ndarray:
    H = np.zeros(N)
    H[IN_USE] = rng.normal(size=len(IN_USE)) * (rng.random(len(IN_USE)) < 0.4)
    H[OFFSET], H[WAY] = 1.0, 0.0
    return H


def everything(T: Any) -> bytes:
    """What an update may change."""
    names = ("x", "P", "mean", "rest", "log_w", "odds", "choice", "n", "n_global")
    return b"".join(T[name].tobytes() for name in names)


@settings(max_examples=30)
@given(SEEDS, st.booleans())
def test_one_value_updates_like_a_matrix(seed: int, accepted: bool) -> None:
    rng = np.random.default_rng(seed)
    T = crowd(rng, parameters())
    put_(T, LOCALS[:3], GLOBALS[:1], PARTIES)
    T["rest"][:] = 0.0
    H, z, r = random_row(rng), rng.normal(0.0, 3.0), 0.4
    new_x, new_P, e, S = update(
        T["x"].copy(), T["P"].copy(), H[None], np.array([[r]]), np.array([z])
    )
    distance = e[0] ** 2 / S[0, 0]
    before = everything(T)
    T["shift"][:3] = 5.0  # nobody's
    gate = distance * (1.001 if accepted else 0.999)
    assert traffic.measure_(T, row_(T, H), z, r, NOBODY, gate) == accepted
    if not accepted:
        assert everything(T) == before
        return
    np.testing.assert_allclose(mean_of(T, 0, GLOBALS[0]), new_x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(T["P"], new_P, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(T["P"], T["P"].T)
    assert T["log_w"][0] == pytest.approx(-0.5 * min(distance, 40.0))
    np.testing.assert_allclose(T["odds"][0, :3], 0.0, atol=1e-12)


@pytest.mark.parametrize("bad", [NAN, math.inf, -math.inf])
def test_a_value_that_is_no_number_changes_nothing(bad: float) -> None:
    rng = np.random.default_rng(1)
    T = crowd(rng, parameters())
    before = everything(T)
    m = row_(T, random_row(rng))
    T["shift"][:7] = rng.normal(size=7)
    for who in (NOBODY, EGO, 0):
        assert not traffic.measure_(T, m, bad, 0.1, who, 16.0)
        traffic.measure_(T, m, 0.0, bad, who, 16.0)
    assert everything(T) == before


def of_a_vehicle(par: np.ndarray) -> Any:
    """Vehicle 0 keeps its lane or changes to the next one, and 2 too; of a known road."""
    x, _ = road.new_road(par)
    T = with_road(x, CERTAIN, par)
    put_(T, [Local(EGO), Local(0), Local(0, 1), Local(2), Local(2, 1)], [[0, 1, 3]], PARTIES)
    for g in PARTIES:
        T["P"][N_ROAD + 2 * g, N_ROAD + 2 * g] = 0.04
    T["shift"][:5] = 0.0, 0.0, 3.5, 0.0, 0.0
    T["h"][0], T["at"][0] = 1.0, N_ROAD
    return T


def test_an_outlier_is_what_no_course_explains() -> None:
    par = parameters()
    assert traffic.measure_(of_a_vehicle(par), 1, 0.1, 0.01, 0, 16.0)
    assert traffic.measure_(of_a_vehicle(par), 1, 3.4, 0.01, 0, 16.0), "it has changed lanes"
    assert not traffic.measure_(of_a_vehicle(par), 1, 1.8, 0.01, 0, 16.0)
    assert not traffic.measure_(of_a_vehicle(par), 1, 3.4, 0.01, 2, 16.0), "but it is another's"
    assert not traffic.measure_(of_a_vehicle(par), 1, 3.4, 0.01, NOBODY, 16.0)


@pytest.mark.parametrize(("log_p", "counts"), [(-13.0, True), (-15.0, False)])
def test_what_is_too_unlikely_does_not_explain_an_outlier(log_p: float, counts: bool) -> None:
    par = parameters()
    T = of_a_vehicle(par)
    T["odds"][0, 2] = log_p
    assert traffic.measure_(T, 1, 3.4, 0.01, 0, 16.0) == counts
    T = of_a_vehicle(par)
    put_(T, [Local(EGO), Local(0), Local(0, 1)], [[0, 1], [0, 2]], PARTIES)
    T["odds"][:2, 1:3] = [[0.0, -100.0], [-100.0, 0.0]]
    T["log_w"][:2] = 0.0, log_p
    assert traffic.measure_(T, 1, 3.4, 0.01, 0, 16.0) == counts


def test_a_surprise_counts_only_so_much() -> None:
    """Against the one that it speaks against: squared errors of 40 and more are all alike."""
    T = of_a_vehicle(parameters())
    assert traffic.measure_(T, 1, 3.5, 0.01, 0, np.inf)
    distance = 3.5**2 / 0.05
    assert distance > 40.0
    assert T["log_w"][0] == pytest.approx(-20.0)
    np.testing.assert_allclose(T["odds"][0, :5], [0.0, 0.0, 20.0, 0.0, 0.0], atol=1e-9)
    T = of_a_vehicle(parameters())
    assert traffic.measure_(T, 1, 0.1, 0.01, 0, np.inf)
    assert T["log_w"][0] == pytest.approx(-0.5 * 0.1**2 / 0.05)
    assert T["odds"][0, 2] == pytest.approx(-20.0 + 0.5 * 0.1**2 / 0.05)


@pytest.mark.parametrize(("error", "moves"), [(2e-4, False), (5e-4, True)])
def test_what_a_course_has_next_to_nothing_to_do_with_does_not_move_it(
    error: float, moves: bool
) -> None:
    T = of_a_vehicle(parameters())
    T["shift"][2] = error * math.sqrt(0.05)
    assert traffic.measure_(T, 1, 0.1, 0.01, 0, 16.0)
    assert T["mean"][2].any() == moves


def test_the_ego_turns_as_the_road_does() -> None:
    """The sensor says what the road's bend at the ego makes of its speed, and its own error."""
    rng = np.random.default_rng(2)
    par = parameters()
    T = crowd(rng, par)
    H = np.zeros(N)
    here = T["x"][WAY] / SPACING
    H[[BIAS, KNOT, KNOT + 1]] = 1.0, 25.0 * (1.0 - here), 25.0 * here
    expected = [
        update(mean_of(T, g, c), T["P"].copy(), H[None], np.array([[0.01**2]]), np.array([0.02]))
        for g, c in enumerate(GLOBALS)
    ]
    before = everything(T)
    for speed, yaw_rate in ((NAN, 0.02), (25.0, NAN), (NAN, NAN)):
        traffic.turn_with_road_(T, par, speed, yaw_rate)
    assert everything(T) == before
    traffic.turn_with_road_(T, par, 25.0, 0.02)
    for g, chosen in enumerate(GLOBALS):
        np.testing.assert_allclose(mean_of(T, g, chosen), expected[g][0], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(T["P"], expected[0][1], rtol=1e-9, atol=1e-11)


# ---- many hypotheses, one covariance


class Dense:
    """A Kalman filter that knows everybody's course."""

    def __init__(self, x: np.ndarray, P: np.ndarray) -> None:
        self.x, self.P, self.log_l = x, P.copy(), 0.0

    def predict(self, F: np.ndarray, u: np.ndarray, Q: np.ndarray) -> None:
        self.x, self.P = F @ self.x + u, F @ self.P @ F.T + Q

    def error(self, H: np.ndarray, z: float, r: float) -> float:
        """Normalised."""
        return float((z - H @ self.x) / math.sqrt(H @ self.P @ H + r))

    def see(self, H: np.ndarray, z: float, r: float) -> None:
        self.x, self.P, e, S = update(self.x, self.P, H[None], np.array([[r]]), np.array([z]))
        self.log_l -= 0.5 * float(e[0] ** 2 / S[0, 0] + np.log(2.0 * np.pi * S[0, 0]))


def replaced(chosen: list[int], q: int) -> tuple[int, ...]:
    """The same courses, but q for that of its party."""
    return tuple(q if LOCALS[p].who == LOCALS[q].who else p for p in chosen)


class Both:
    """The filter, and a dense one for each global hypothesis and each that differs by a course."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng, self.par, self.t = rng, parameters(**LOOSE), 0.0
        self.T = crowd(rng, self.par)
        self.T["log_w"][:3] = rng.normal(size=3)
        self.T["odds"][:3, :7] = rng.normal(size=(3, 7))
        for g, chosen in enumerate(GLOBALS):
            self.T["odds"][g, chosen] = 0.0
        self.log_w = self.T["log_w"][:3].copy()
        self.odds = self.T["odds"][:3, :7].copy()
        self.dense = {
            (g, courses): Dense(mean_of(self.T, g, courses), self.T["P"])
            for g, chosen in enumerate(GLOBALS)
            for courses in {replaced(chosen, q) for q in range(7)}
        }

    def predict(self) -> None:
        dt = self.rng.choice([0.03, 0.1, 0.5])
        speed, yaw_rate = self.rng.choice([NAN, 5.0, 30.0]), self.rng.choice([NAN, 0.0, 0.02])
        self.t += dt
        F, u, Q = motion(self.T, dt, speed, yaw_rate, PARTIES)
        traffic.predict_traffic_(self.T, self.par, dt, self.t, speed, yaw_rate)
        for one in self.dense.values():
            one.predict(F, u, Q)

    def measure(self) -> None:
        """A value that nobody's course makes an outlier, nor next to nothing to do with: those are
        said to be handled otherwise."""
        T, rng = self.T, self.rng
        who = rng.choice([NOBODY, EGO, *PARTIES])
        for _ in range(200):
            H, r = random_row(rng), rng.uniform(0.01, 0.2)
            s = math.sqrt(H @ T["P"] @ H + r)
            shift = s * rng.uniform(0.2, 1.0, 7) * rng.choice([-1.0, 1.0], 7)
            z = H @ mean_of(T, 0, GLOBALS[0]) + s * rng.normal()
            mine = np.where([one.who == who for one in LOCALS], shift, 0.0)
            values = {key: z - mine[list(key[1])].sum() for key in self.dense}
            errors = [one.error(H, values[key], r) for key, one in self.dense.items()]
            pull = (T["mean"][:7] @ H + mine) / s
            if np.square(errors).max() < 39.0 and np.square(pull).min() > 1.1e-7:
                break
        else:
            pytest.fail("no such value")
        T["shift"][:7] = shift
        assert traffic.measure_(T, row_(T, H), z, r, who, np.inf)
        for key, one in self.dense.items():
            one.see(H, values[key], r)

    def agree(self) -> None:
        T = self.T
        first = self.dense[0, tuple(GLOBALS[0])]
        np.testing.assert_allclose(T["P"], first.P, rtol=1e-7, atol=1e-9)
        for g, chosen in enumerate(GLOBALS):
            one = self.dense[g, tuple(chosen)]
            gained = one.log_l - first.log_l
            before = self.log_w[g] - self.log_w[0]
            assert T["log_w"][g] - T["log_w"][0] == pytest.approx(before + gained, abs=1e-6)
            for q in range(7):
                courses = replaced(chosen, q)
                other = self.dense[g, courses]
                np.testing.assert_allclose(mean_of(T, g, courses), other.x, rtol=1e-6, atol=1e-7)
                gained = other.log_l - one.log_l
                assert T["odds"][g, q] == pytest.approx(self.odds[g, q] + gained, abs=1e-6)


@settings(max_examples=12)
@given(SEEDS)
def test_every_hypothesis_is_a_filter_of_its_own(seed: int) -> None:
    both = Both(np.random.default_rng(seed))
    both.agree()
    for _ in range(20):
        if both.rng.random() < 0.3:
            both.predict()
        else:
            both.measure()
    both.agree()
    spread = [one.log_l for one in both.dense.values()]
    assert np.ptp(spread) > 1.0, "they do differ"


def test_a_party_that_nothing_is_measured_of_keeps_its_odds() -> None:
    """Nothing of it, nor of what is correlated with it."""
    T = of_a_vehicle(parameters())
    T["odds"][0, 3:5] = 0.0, -2.0
    for z in (0.1, 0.3, -0.2):
        assert traffic.measure_(T, 1, z, 0.01, 0, 16.0)
    assert T["odds"][0, 2] < -10.0
    np.testing.assert_allclose(T["odds"][0, 3:5], [0.0, -2.0], atol=1e-12)


# ---- what all hypotheses say together


def summary(T: Any) -> tuple[np.ndarray, np.ndarray]:
    x, P = np.full(N_ROAD, 77.0), np.full((N_ROAD, N_ROAD), 77.0)
    traffic.summarise_(T, x, P)
    return x, P


def softmax(a: np.ndarray) -> np.ndarray:
    w = np.exp(a - a.max())
    return w / w.sum()


def doubts(rng: np.random.Generator) -> Any:
    """Hypotheses some of which are likely, and some out of the question."""
    T = crowd(rng, parameters())
    T["log_w"][:3] = rng.normal(size=3) - 300.0
    T["odds"][:3, :7] = rng.normal(size=(3, 7))
    if rng.random() < 0.5:
        T["log_w"][rng.integers(3)] -= 60.0
    if rng.random() < 0.5:
        T["odds"][rng.integers(3), rng.integers(7)] -= 60.0
    if rng.random() < 0.5:
        T["odds"][:3, rng.choice([3, 4, 5])] = -np.inf
    return T


def shares(T: Any, g: int) -> np.ndarray:
    """How probable each course is given what all others do in g."""
    p = np.zeros(len(LOCALS))
    for who in (EGO, *PARTIES):
        of = [q for q, one in enumerate(LOCALS) if one.who == who]
        p[of] = softmax(T["odds"][g, of])
    return p


@settings(max_examples=40)
@given(SEEDS)
def test_probabilities(seed: int) -> None:
    T = doubts(np.random.default_rng(seed))
    w, share = np.full(traffic.N_GLOBAL, 77.0), np.full(N_LOCAL, 77.0)
    assert traffic.best_global(T) == np.argmax(T["log_w"][:3])
    traffic.global_weights_(T, w)
    np.testing.assert_allclose(w[:3], softmax(T["log_w"][:3]), rtol=1e-9)
    for g in range(3):
        traffic.shares_(T, g, share, np.empty((N_PARTIES, 2)))
        np.testing.assert_allclose(share[:7], shares(T, g), rtol=1e-9)


@settings(max_examples=40)
@given(SEEDS)
def test_the_road_is_the_mean_of_all_that_may_be(seed: int) -> None:
    """The mixture written out: each global hypothesis, and in it each combination of courses."""
    T = doubts(np.random.default_rng(seed))
    parties = [[q for q, one in enumerate(LOCALS) if one.who == who] for who in (EGO, *PARTIES)]
    terms = [
        (w * shares(T, g)[list(courses)].prod(), mean_of(T, g, courses)[:N_ROAD])
        for g, w in enumerate(softmax(T["log_w"][:3]))
        for courses in itertools.product(*parties)
    ]
    weights = np.array([w for w, _ in terms])
    means = np.array([x for _, x in terms])
    assert weights.sum() == pytest.approx(1.0)
    expected = weights @ means
    e = means - expected
    expected_P = T["P"][:N_ROAD, :N_ROAD] + (weights[:, None] * e).T @ e
    assert np.abs(expected_P - T["P"][:N_ROAD, :N_ROAD]).max() > 1e-3, "they do differ"
    before = everything(T)
    x, P = summary(T)
    np.testing.assert_allclose(x, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(P, expected_P, rtol=1e-9, atol=1e-9)
    assert everything(T) == before


# ---- the lanes are counted anew


@cache
def lane_ahead(way: float, x: float) -> tuple[float, ...]:
    """The row (N,) of the middle of the ego's lane at a distance, state by state."""
    H = np.zeros(N)
    for i in range(N_ROAD):
        if i != WAY:
            one = np.zeros(N_ROAD)
            one[[i, WAY]] = 1.0, way
            H[i] = middle(one, x)
    return tuple(H)


def seen_at(T: Any, g: int, courses: Any, who: int, x: float, t: float) -> tuple[float, float]:
    """Where a vehicle at distance x is expected under these courses, and the variance of that."""
    state = mean_of(T, g, courses)
    course = next(T["local"][q] for q in courses if T["local"]["who"][q] == who)
    lane = where(Local(*(course[name] for name in Local._fields)), t)[0]
    H = np.array(lane_ahead(float(state[WAY]), x))
    H[WIDTH], H[N_ROAD + 2 * who] = lane, 1.0
    return float(H @ state), float(H @ T["P"] @ H)


@settings(max_examples=10)
@given(SEEDS, st.sampled_from([1, -1, 2]))
def test_in_another_lane_everything_is_seen_where_it_was(seed: int, by: int) -> None:
    """Under every hypothesis: only the numbers of the lanes are others."""
    rng = np.random.default_rng(seed)
    par = parameters()
    T = crowd(rng, par)
    for q, one in enumerate(LOCALS):
        lane, turn = rng.integers(-2, 3), rng.integers(-1, 2)
        T["local"][q] = (rng.uniform(0.0, 3.0), 4.0, one.who, lane, turn, rng.random() < 0.5)
    T["party"]["kept"][:] = NO_LANE
    T["party"]["kept"][2] = 1
    cases = [
        (g, courses, who, x, t)
        for g, chosen in enumerate(GLOBALS)
        for courses in {replaced(chosen, q) for q in range(7)}
        for who, x in ((0, 40.0), (2, -15.0))
        for t in (0.0, 2.0)
    ]
    offset = {g: mean_of(T, g, c)[[OFFSET, WIDTH]] for g, c in enumerate(GLOBALS)}
    lanes = T["local"]["lane"][:7].copy()
    before = [seen_at(T, *case) for case in cases]
    traffic.change_lane_(T, by)
    np.testing.assert_allclose([seen_at(T, *case) for case in cases], before, rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(T["local"]["lane"][:7], lanes - by)
    for g, chosen in enumerate(GLOBALS):
        after = mean_of(T, g, chosen)
        assert after[WIDTH] == offset[g][1]
        assert after[OFFSET] == pytest.approx(offset[g][0] - by * after[WIDTH], abs=1e-12)
    assert T["party"]["kept"][2] == 1 - by
    assert (np.delete(T["party"]["kept"], 2) == NO_LANE).all()


def test_the_covariance_follows_when_the_lanes_are_counted_anew() -> None:
    """The new lane is as uncertain as the old one and the width between them."""
    T = crowd(np.random.default_rng(0), parameters())
    F = np.eye(N)
    F[OFFSET, WIDTH] = -1.0
    expected = F @ T["P"] @ F.T
    before = T["P"].copy()
    traffic.change_lane_(T, 1)
    np.testing.assert_allclose(T["P"], expected, rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(T["P"], T["P"].T)
    traffic.change_lane_(T, -1)
    np.testing.assert_allclose(T["P"], before, rtol=1e-9, atol=1e-12)


# ---- the ego's habits


HABITS = {
    "offset": 0.2, "offset_std": 1.2, "offset_time": 1.2,
    "heading_std": 0.03, "heading_time": 0.7, "turn_std": 0.02, "turn_time": 1.0,
}  # fmt: skip
"""Where this ego is used to drive, how strictly, and for how long at a time: some scans are further
apart."""


def habits(
    one: Local, t: float, dt: float, v: float, yaw_rate: float, way: float, width: float
) -> list[tuple[np.ndarray, float, float]]:
    """Row, value and variance of what an ego on this course does: it heads along it, is
    beside its middle as usual, and turns as it and the road do."""
    lane, slope, bend = where(one, t)
    heading, offset, turn = np.zeros((3, N))
    heading[HEADING] = offset[OFFSET] = turn[BIAS] = 1.0
    turn[KNOT : KNOT + 2] = v * (1.0 - way / SPACING), v * way / SPACING
    if v == 0.0:
        slope = bend = 0.0
    per = 1.0 if v == 0.0 else width / v
    return [
        (heading, slope * per, 0.03**2 * max(0.7 / dt, 1.0)),
        (offset, 0.2 + lane * width, 1.2**2 * max(1.2 / dt, 1.0)),
        *([] if math.isnan(yaw_rate) else [
            (turn, yaw_rate - bend * per, 0.02**2 * max(1.0 / dt, 1.0))
        ]),
    ]  # fmt: skip


EGOS = [
    Local(EGO), Local(EGO, 0, 1, 0.4, 4.0), Local(EGO, 0, -1, 0.4, 4.0),
    Local(EGO, 0, 1, 1.0, 3.0, True), Local(EGO, 1),
]  # fmt: skip


@pytest.mark.parametrize("chosen", range(len(EGOS)))
@pytest.mark.parametrize(("speed", "yaw_rate"), [(28.0, 0.004), (28.0, NAN), (0.0, 0.0)])
@pytest.mark.parametrize("dt", [0.1, 1.3])
def test_the_egos_habits(chosen: int, speed: float, yaw_rate: float, dt: float) -> None:
    """Like a filter that is told them, for each course that it may be on; whichever the chosen
    one is.  Up to what moves no mean."""
    par = parameters(**HABITS)
    T = with_road(*road.new_road(par), par)
    put_(T, EGOS, [[chosen]], {})
    dense = [Dense(T["x"].copy(), T["P"]) for _ in EGOS]
    t = 0.0
    for _ in range(round(2.6 / dt)):
        t += dt
        F, u, Q = motion(T, dt, speed, yaw_rate, {})
        traffic.predict_traffic_(T, par, dt, t, speed, yaw_rate)
        for one, filt in zip(EGOS, dense, strict=True):
            filt.predict(F, u, Q)
            for H, z, r in habits(one, t, dt, speed, yaw_rate, filt.x[WAY], 3.5):
                assert abs(filt.error(H, z, r)) < 6.3, "no outlier"
                filt.see(H, z, r)
    np.testing.assert_allclose(T["P"], dense[0].P, rtol=1e-7, atol=1e-12)
    std = np.sqrt(np.diag(T["P"])[:N_ROAD]) + 1e-9
    for q, filt in enumerate(dense):
        off = (mean_of(T, 0, [q]) - filt.x)[:N_ROAD] / std
        np.testing.assert_allclose(off, 0.0, atol=1e-3)
        gained = filt.log_l - dense[chosen].log_l
        assert T["odds"][0, q] == pytest.approx(gained, abs=2e-3)
    assert np.ptp([filt.log_l for filt in dense]) > 0.5, "they do differ"


def driven(turn: int, seed: int = 0) -> np.ndarray:
    """Log odds of an ego that keeps its lane, goes to the left, to the right; it does ``turn``.

    It sees where the lanes lie ahead.
    """
    par, v, dt, rng = parameters(), 28.0, 0.1, np.random.default_rng(seed)
    T = with_road(*road.new_road(par), par)
    courses = [Local(EGO), Local(EGO, 0, 1, 1.0, 4.5), Local(EGO, 0, -1, 1.0, 4.5)]
    put_(T, courses, [[0]], {})
    does = Local(EGO, 0, turn, 1.0, 4.5)
    for k in range(65):
        t = (k + 1) * dt
        heading, before = (3.5 * where(does, s)[1] / v for s in (t, t - dt))
        traffic.predict_traffic_(T, par, dt, t, v, (heading - before) / dt)
        for x in (20.0, 60.0):
            H = np.array(lane_ahead(float(T["x"][WAY]), x))
            y = -3.5 * where(does, t)[0] - heading * x + rng.normal(0.0, 0.1)
            assert traffic.measure_(T, row_(T, H), y, 0.01, NOBODY, np.inf)
    assert mean_of(T, 0, [0])[OFFSET] == pytest.approx(3.5 * turn, abs=0.3)
    return T["odds"][0, :3].copy()


@pytest.mark.parametrize("turn", [0, 1, -1])
def test_how_the_ego_drives_tells_whether_it_changes_lanes(turn: int) -> None:
    odds = driven(turn)
    others = np.delete(odds, turn)  # -1 is the last one, to the right
    assert odds[turn] > others.max() + 5.0


# ---- whatever happens


def mirrored(T: Any) -> tuple[Any, np.ndarray]:
    """The same world in a mirror, and the signs (N,) of its states."""
    sign = np.ones(N)
    sign[[OFFSET, HEADING, BIAS, MOUNTING]] = -1.0
    sign[KNOT:] = -1.0
    M = T.copy()
    for name in ("x", "mean", "rest"):
        M[name] *= sign
    M["P"][:] = T["P"] * np.outer(sign, sign)
    for name in ("lane", "turn"):
        M["local"][name] *= -1
    return M, sign


@settings(max_examples=15)
@given(SEEDS)
def test_in_a_mirror_everything_is_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    par = parameters()
    T = crowd(rng, par)
    for q, one in enumerate(LOCALS):
        T["local"][q] = (0.3 * q, 3.0, one.who, rng.integers(-1, 2), q % 3 - 1, q == 5)
    M, sign = mirrored(T)
    for k in range(10):
        yaw_rate = rng.choice([NAN, 0.01, -0.03])
        H, z, shift = random_row(rng), rng.normal(), rng.normal(size=7)
        by = rng.integers(-1, 2)
        for record, flip, s in ((T, 1.0, np.ones(N)), (M, -1.0, sign)):
            traffic.predict_traffic_(record, par, 0.2, 0.2 * (k + 1), 25.0, flip * yaw_rate)
            record["shift"][:7] = flip * shift
            assert traffic.measure_(record, row_(record, flip * H * s), flip * z, 0.3, 0, np.inf)
            traffic.change_lane_(record, int(flip) * by)
    expected, _ = mirrored(M)
    for name in ("x", "P", "mean", "rest", "log_w", "odds"):
        np.testing.assert_allclose(T[name], expected[name], rtol=1e-7, atol=1e-9)
    assert (T["local"]["lane"] == expected["local"]["lane"]).all()


STEPS = st.lists(
    st.tuples(
        SEEDS,
        st.sampled_from([0.02, 0.1, 0.1, 0.9]),
        st.sampled_from([NAN, 0.0, 5.0, 30.0, -3.0, 60.0]),
        st.sampled_from([NAN, 0.0, 0.1, -1.0]),
        st.sampled_from([NOBODY, EGO, 0, 2]),
        st.sampled_from([0, 0, 1, -1]),
    ),
    max_size=30,
)


@settings(max_examples=25)
@given(SEEDS, STEPS)
def test_whatever_is_seen_the_covariance_stays_one(seed: int, script: list[Any]) -> None:
    par, t = parameters(), 0.0
    T = crowd(np.random.default_rng(seed), par)
    for seed, dt, speed, yaw_rate, who, by in script:
        rng, t = np.random.default_rng(seed), t + dt
        traffic.predict_traffic_(T, par, dt, t, speed, yaw_rate)
        T["shift"][:7] = rng.normal(0.0, 4.0, 7)
        m = row_(T, random_row(rng))
        traffic.measure_(T, m, rng.normal(0.0, 5.0), 10.0 ** rng.uniform(-6, 1), who, 25.0)
        traffic.change_lane_(T, by)
        for x, P in ((T["x"], T["P"]), summary(T)):
            assert np.isfinite(x).all()
            np.testing.assert_allclose(P, P.T, rtol=1e-12, atol=1e-15)
            eigenvalues = np.linalg.eigvalsh(P)
            assert eigenvalues.min() > -1e-9 * max(eigenvalues.max(), 1.0)
            assert not P[WAY].any()
        for g, chosen in enumerate(GLOBALS):
            assert np.isfinite(T["log_w"][g])
            np.testing.assert_allclose(T["odds"][g, chosen], 0.0, atol=1e-9)
