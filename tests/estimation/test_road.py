"""The road filter against closed forms, dense matrix algebra, and a drive through the plane."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.gaussian import random_covariance, update
from small_roads import KEEP, LEFT, STILL, Traffic, nothing_but_motion, parameters

from can_imm.estimation import guides, road
from can_imm.estimation.road import (
    BIAS,
    FREE,
    HEADING,
    KNOT,
    MOUNTING,
    N_GUIDES,
    N_KNOTS,
    N_ROAD,
    OFFSET,
    SPACING,
    WAY,
    WIDTH,
    N,
)

SEEDS = st.integers(0, 2**32 - 1)
NAN = math.nan


KNOTS = SPACING * np.arange(N_KNOTS)
"""Where the knots lie on the ground, from the first one [m]."""
LAST = N_ROAD - 1


def random_road(rng: np.random.Generator, bends: float = 3e-4) -> np.ndarray:
    """A state without guides; the curvature changes by ``bends`` from knot to knot."""
    x = np.zeros(N)
    x[[OFFSET, HEADING, BIAS, MOUNTING]] = rng.normal(0.0, [0.5, 0.02, 5e-3, 5e-3])
    x[WIDTH] = rng.normal(3.5, 0.2)
    x[WAY] = rng.uniform(0.0, SPACING)
    x[KNOT:N_ROAD] = rng.normal(0.0, 1e-3) + np.cumsum(rng.normal(0.0, bends, N_KNOTS))
    return x


def curvature(state: np.ndarray, ground: Any) -> Any:
    """Of the road so far from the first knot [m]: linear from knot to knot, then constant."""
    return np.interp(ground, KNOTS, state[KNOT:N_ROAD])


def integral(state: np.ndarray, low: float, high: float, arm: bool) -> float:
    """Of the curvature, or of the curvature times the distance to ``high``, by quadrature."""
    inner = KNOTS[(low < KNOTS) & (high > KNOTS)]
    edges = np.array([low, *inner, high])
    nodes, weights = np.polynomial.legendre.leggauss(6)
    total = 0.0
    for begin, end in pairwise(edges):
        s = 0.5 * (end - begin) * nodes + 0.5 * (end + begin)
        f = curvature(state, s) * ((high - s) if arm else 1.0)
        total += 0.5 * (end - begin) * float(weights @ f)
    return total


def row(function: Any, way: float, x: float) -> np.ndarray:
    h = np.full(N_ROAD + 1, 77.0)
    function(h, way, x)
    assert h[N_ROAD] == 77.0, "of the guides it knows nothing"
    return h[:N_ROAD]


def shift() -> np.ndarray:
    """Every knot takes the next one's curvature; the last one keeps its own."""
    A = np.eye(N)
    for i in range(KNOT, LAST):
        A[i, i], A[i, i + 1] = 0.0, 1.0
    return A


# ---- the shape of the road


@given(SEEDS, st.floats(-50.0, 400.0))
def test_the_lane_ahead(seed: int, x: float) -> None:
    r = random_road(np.random.default_rng(seed))
    bend = integral(r, r[WAY], r[WAY] + x, arm=True) if x > 0.0 else 0.0
    expected = -r[OFFSET] - (r[HEADING] + r[MOUNTING]) * x + bend
    assert row(road.lane_row_, r[WAY], x) @ r[:N_ROAD] == pytest.approx(expected, abs=1e-9)


@given(SEEDS, st.floats(-50.0, 400.0))
def test_the_direction_of_the_road_ahead(seed: int, x: float) -> None:
    r = random_road(np.random.default_rng(seed))
    bend = integral(r, r[WAY], r[WAY] + x, arm=False) if x > 0.0 else 0.0
    expected = -r[HEADING] - r[MOUNTING] + bend
    assert row(road.slope_row_, r[WAY], x) @ r[:N_ROAD] == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize("way", [0.0, 6.0, SPACING - 1e-9])
def test_the_clothoid_of_the_textbook(way: float) -> None:
    """A curvature that changes steadily from the ego on, as far as the knots reach."""
    r = np.zeros(N_ROAD)
    at_the_ego, change = 4e-4, -7e-6
    r[KNOT:] = at_the_ego + change * (KNOTS - way)
    for x in (0.0, 17.0, 60.0, 140.0, KNOTS[-1] - way):
        expected = at_the_ego * x**2 / 2 + change * x**3 / 6
        assert row(road.lane_row_, way, x) @ r == pytest.approx(expected, abs=1e-12)


def test_what_the_ego_is_seen_by() -> None:
    """Straight ahead: a place further left or turned to the left moves the lane to the right."""
    expected = np.zeros(N_ROAD)
    expected[[OFFSET, HEADING, MOUNTING]] = -1.0, -40.0, -40.0
    np.testing.assert_array_equal(row(road.lane_row_, 3.0, 40.0)[:KNOT], expected[:KNOT])
    expected[[OFFSET, HEADING, MOUNTING]] = 0.0, -1.0, -1.0
    np.testing.assert_array_equal(row(road.slope_row_, 3.0, 40.0)[:KNOT], expected[:KNOT])


def test_the_road_is_known_as_far_as_vehicles_guide() -> None:
    """However far the ego has come from the first knot."""
    assert KNOTS[-1] - SPACING >= guides.SEEN_TO


@pytest.mark.parametrize("way", [0.0, 10.0])
@pytest.mark.parametrize("x", [-30.0, -0.1, 0.1, 14.9, 15.1, 30.0, 100.0, 214.9, 215.1, 300.0])
def test_the_slope_is_the_derivative(way: float, x: float) -> None:
    d = 1e-3
    expected = (row(road.lane_row_, way, x + d) - row(road.lane_row_, way, x - d)) / (2 * d)
    np.testing.assert_allclose(row(road.slope_row_, way, x), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("x", [0.0, 15.0, 40.0, KNOTS[-1] - 10.0])
@pytest.mark.parametrize("function", [road.lane_row_, road.slope_row_])
def test_no_step_where_the_formula_changes(x: float, function: Any) -> None:
    before, after = row(function, 10.0, x - 1e-9), row(function, 10.0, x + 1e-9)
    np.testing.assert_allclose(before, after, atol=1e-6)


def test_the_middles_of_lanes() -> None:
    """Of another state each."""
    rng = np.random.default_rng(2)
    states = np.array([random_road(rng)[:N_ROAD] for _ in range(20)])
    x = rng.uniform(-50.0, 300.0, 20)
    expected = [
        -r[OFFSET]
        - (r[HEADING] + r[MOUNTING]) * d
        + (integral(r, r[WAY], r[WAY] + d, arm=True) if d > 0.0 else 0.0)
        for r, d in zip(states, x, strict=True)
    ]
    np.testing.assert_allclose(road.lane_middles(states, x), expected, atol=1e-9)


# ---- one value


@settings(max_examples=40)
@given(SEEDS, st.integers(-1, N_GUIDES - 1), st.booleans())
def test_one_value_updates_like_a_matrix(seed: int, g: int, accepted: bool) -> None:
    rng = np.random.default_rng(seed)
    x, P = rng.normal(size=N), random_covariance(rng, N)
    h = rng.normal(size=N_ROAD + 1) * (rng.random(N_ROAD + 1) < 0.6)
    h[0] = 1.0
    H = np.zeros((1, N))
    H[0, :N_ROAD] = h[:N_ROAD]
    if g != FREE:
        H[0, N_ROAD + g] = h[N_ROAD]
    z, r = rng.normal(0.0, 3.0), 0.4
    new_x, new_P, e, S = update(x, P, H, np.array([[r]]), np.array([z]))
    distance = e[0] ** 2 / S[0, 0]
    got_x, got_P = x.copy(), P.copy()
    gate = distance * (1.001 if accepted else 0.999)
    assert road.scalar_update_(got_x, got_P, h, g, z, r, gate) == accepted
    if not accepted:
        np.testing.assert_array_equal(got_x, x)
        np.testing.assert_array_equal(got_P, P)
        return
    np.testing.assert_allclose(got_x, new_x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(got_P, new_P, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(got_P, got_P.T)


@pytest.mark.parametrize("bad", [NAN, math.inf])
def test_a_value_that_is_no_number_changes_nothing(bad: float) -> None:
    x, P = road.new_road(parameters())
    h = np.zeros(N_ROAD + 1)
    h[OFFSET] = 1.0
    before = x.tobytes() + P.tobytes()
    assert not road.scalar_update_(x, P, h, FREE, bad, 0.1, 16.0)
    assert x.tobytes() + P.tobytes() == before


# ---- motion


def drive(
    r: np.ndarray, v: float, yaw_rate: float, dt: float, steps: int = 400
) -> tuple[float, float, float]:
    """Offset, heading, way after driving: the ego and the road's middle in the plane."""
    w = yaw_rate - r[BIAS]
    tau = dt / steps
    x, y, heading = 0.0, r[OFFSET], r[HEADING]
    for _ in range(steps):
        middle = heading + 0.5 * w * tau
        x, y, heading = x + v * tau * math.cos(middle), y + v * tau * math.sin(middle), middle
        heading += 0.5 * w * tau
    # the nearest point of the road, walked along in small steps
    ds = v * dt / steps / 4
    px, py, s, direction = 0.0, 0.0, 0.0, 0.0
    while (x - px) * math.cos(direction) + (y - py) * math.sin(direction) > 0.0:
        turn = ds * float(curvature(r, r[WAY] + s + 0.5 * ds))
        middle = direction + 0.5 * turn
        px, py, s = px + ds * math.cos(middle), py + ds * math.sin(middle), s + ds
        direction += turn
    across = (y - py) * math.cos(direction) - (x - px) * math.sin(direction)
    return across, heading - direction, r[WAY] + s


@settings(max_examples=25)
@given(SEEDS, st.floats(5.0, 40.0), st.floats(-0.05, 0.05))
def test_the_ego_drives_along_the_road(seed: int, v: float, yaw_rate: float) -> None:
    x = random_road(np.random.default_rng(seed), bends=2.5e-5)
    P = np.eye(N)
    P[WAY] = P[:, WAY] = 0.0
    offset, heading, way = drive(x, v, yaw_rate, 0.4)
    still = x.copy()
    road.predict_road_(x, P, nothing_but_motion(), 0.4, v, yaw_rate)
    assert x[OFFSET] == pytest.approx(offset, abs=4e-3)
    assert x[HEADING] == pytest.approx(heading, abs=4e-4)
    passed = SPACING if way >= SPACING else 0.0
    assert x[WAY] == pytest.approx(still[WAY] + v * 0.4 - passed, abs=1e-9)
    assert curvature(x, x[WAY]) == pytest.approx(curvature(still, way), abs=1e-6)
    still[BIAS] *= math.exp(-0.4 / road.BIAS_TIME)
    unchanged = [BIAS, MOUNTING, WIDTH]
    np.testing.assert_allclose(x[unchanged], still[unchanged], rtol=1e-9)


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
    x, P, par = np.zeros(N), np.zeros((N, N)), nothing_but_motion()
    x[WIDTH], x[OFFSET], x[HEADING] = 3.5, 0.4, -0.005
    x[KNOT:N_ROAD] = profile
    at, heading = 0.4j, -0.005
    for k in range(800):
        w = v * float(np.interp(v * (k + 0.5) * dt, KNOTS, profile))
        w += 0.02 * math.cos(0.9 * k * dt)
        for _ in range(round(dt / tau)):
            at += v * tau * np.exp(1j * (heading + 0.5 * w * tau))
            heading += w * tau
        road.predict_road_(x, P, par, dt, v, w)
    seen = (line - at) * np.exp(-1j * heading)
    assert heading > 0.1, "the ego has followed the bend"
    for ahead in (1.0, 30.0, 80.0, 120.0):
        y = float(np.interp(ahead, seen.real, seen.imag))
        got = row(road.lane_row_, x[WAY], ahead) @ x[:N_ROAD]
        assert got == pytest.approx(y, abs=0.02 + 0.02 * abs(y))


@settings(max_examples=40)
@given(SEEDS, st.floats(0.5, 60.0))
def test_the_knots_stand_still_on_the_ground(seed: int, s: float) -> None:
    """After s metres all that was ahead is s metres nearer, seen from another pose of the ego."""
    r = random_road(np.random.default_rng(seed))
    before = r.copy()
    v, par = 30.0, nothing_but_motion()
    for _ in range(3):
        road.predict_road_(r, np.zeros((N, N)), par, s / 3 / v, v, 0.0)
    assert 0.0 <= r[WAY] < SPACING
    assert (before[WAY] + s - r[WAY]) / SPACING == pytest.approx(
        round((before[WAY] + s - r[WAY]) / SPACING), abs=1e-9
    )
    before[[OFFSET, HEADING, MOUNTING]] = r[[OFFSET, HEADING, MOUNTING]] = 0.0
    turned = integral(before, before[WAY], before[WAY] + s, arm=False)
    aside = integral(before, before[WAY], before[WAY] + s, arm=True)
    for x in (0.0, 5.0, 33.0, 90.0, 150.0, 300.0):
        expected = row(road.lane_row_, before[WAY], x + s) @ before[:N_ROAD] - aside - turned * x
        assert row(road.lane_row_, r[WAY], x) @ r[:N_ROAD] == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("speed", [33.0, NAN])
def test_how_far_the_ego_has_come_is_known(speed: float) -> None:
    par = parameters()
    x, P = road.new_road(par)
    v, way = (road.USUAL_SPEED if math.isnan(speed) else speed), 0.0
    for _ in range(50):
        road.predict_road_(x, P, par, 0.1, speed, 0.01)
        way += 0.1 * v
        assert x[WAY] == pytest.approx(way % SPACING, abs=1e-9)
        assert not P[WAY].any()
        assert not P[:, WAY].any()


def test_two_knots_may_be_passed_at_once() -> None:
    par = nothing_but_motion()
    x = random_road(np.random.default_rng(5))
    before, x[WAY] = x.copy(), 20.0
    road.predict_road_(x, np.zeros((N, N)), par, 0.9, 60.0, NAN)
    assert x[WAY] == pytest.approx(20.0 + 54.0 - 2 * SPACING)
    np.testing.assert_allclose(x[KNOT : LAST - 1], before[KNOT + 2 : N_ROAD])
    np.testing.assert_allclose(x[LAST - 1 :][:2], before[LAST])


def test_backwards_no_knot_comes_back() -> None:
    x = random_road(np.random.default_rng(6))
    before = x.copy()
    road.predict_road_(x, np.zeros((N, N)), nothing_but_motion(), 0.5, -60.0, NAN)
    assert x[WAY] == 0.0
    np.testing.assert_allclose(x[KNOT:N_ROAD], before[KNOT:N_ROAD])


@settings(max_examples=20)
@given(SEEDS, st.booleans())
def test_passing_a_knot(seed: int, guided: bool) -> None:
    """A x and A P A' + Q of the shifted curvatures; the new one remembers the one before it."""
    rng = np.random.default_rng(seed)
    n = N if guided else N_ROAD
    x, P, par = rng.normal(size=n), random_covariance(rng, n), parameters()
    memory = math.exp(-SPACING / 1000.0)
    A = shift()[:n, :n]
    A[LAST, LAST] = memory
    Q = np.zeros((n, n))
    Q[LAST, LAST] = 0.001**2 * (1.0 - memory**2)
    expected_x, expected_P = A @ x, A @ P @ A.T + Q
    expected_x[WAY] -= SPACING
    road.pass_knot_(x, P, par)
    np.testing.assert_allclose(x, expected_x, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(P, expected_P, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(P, P.T)


def test_before_anything_is_seen_every_place_bends_alike() -> None:
    """The curvature forgets itself along the road; passing knots says nothing of it.

    Oracle: each knot is the one before it, less what is forgotten, and something new.
    """
    par = parameters(curvature_std=0.002, curvature_length=40.0)
    memory = math.exp(-SPACING / 40.0)
    mix = np.zeros((N_KNOTS, N_KNOTS))
    mix[0, 0] = 0.002
    for i in range(1, N_KNOTS):
        mix[i] = memory * mix[i - 1]
        mix[i, i] = 0.002 * math.sqrt(1.0 - memory**2)
    x, P = road.new_road(par)
    for _ in range(2 * N_KNOTS + 1):
        np.testing.assert_allclose(P[KNOT:N_ROAD, KNOT:N_ROAD], mix @ mix.T, rtol=1e-9)
        assert not P[KNOT:N_ROAD, :KNOT].any()
        assert not x[KNOT:].any()
        road.pass_knot_(x, P, par)
    others = np.diag(P)[[OFFSET, HEADING, BIAS, MOUNTING, WIDTH, WAY]]
    expected = np.array([0.3, 0.01, 0.005, 0.003, 0.25, 0.0]) ** 2
    np.testing.assert_allclose(others, expected, rtol=1e-12)
    assert not P[N_ROAD:].any()


@settings(max_examples=20)
@given(SEEDS, st.sampled_from([NAN, 30.0]), st.sampled_from([-1, 0, 1]))
def test_the_road_does_without_its_guides(seed: int, speed: float, moved: int) -> None:
    """What the ego does to the road is the same whether or not the guides are carried along."""
    rng = np.random.default_rng(seed)
    x, P, par = random_road(rng), random_covariance(rng, N), parameters()
    x[WAY] = 24.0
    P[WAY] = P[:, WAY] = 0.0
    x[N_ROAD:] = rng.normal(size=N_GUIDES)
    small_x, small_P = x[:N_ROAD].copy(), P[:N_ROAD, :N_ROAD].copy()
    slots = np.full(N_GUIDES, FREE, np.int32)
    slots[:7] = np.arange(7)
    for a, b in ((x, P), (small_x, small_P)):
        road.predict_road_(a, b, par, 0.1, speed, 0.02)
        road.turn_with_road_(a, b, par, speed, 0.02, 3.0)
        guides.change_lane_(a, b, slots, moved, 3.3)
    np.testing.assert_allclose(small_x, x[:N_ROAD], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(small_P, P[:N_ROAD, :N_ROAD], rtol=1e-9, atol=1e-12)


def test_without_a_yaw_rate_the_bend_says_nothing_of_the_heading() -> None:
    x = random_road(np.random.default_rng(1))
    before = x.copy()
    road.predict_road_(x, np.eye(N), nothing_but_motion(), 0.2, 30.0, NAN)
    assert x[HEADING] == before[HEADING]
    assert x[OFFSET] == pytest.approx(before[OFFSET] + 6.0 * before[HEADING])
    y = before.copy()
    road.predict_road_(y, np.eye(N), nothing_but_motion(), 0.2, NAN, 0.03)
    assert y[HEADING] == before[HEADING]
    assert y[OFFSET] == pytest.approx(before[OFFSET] + 0.2 * road.USUAL_SPEED * before[HEADING])


@settings(max_examples=20)
@given(SEEDS, st.booleans(), st.sampled_from([0.0, 7.0, 24.0]))
def test_the_covariance_moves_with_the_state(seed: int, known: bool, way: float) -> None:
    """F P F' with the derivatives of the closed-form motion, guides and their correlations too."""
    rng = np.random.default_rng(seed)
    P = random_covariance(rng, N)
    v, dt, w = 30.0, 0.1, 0.02
    F = np.eye(N)
    F[OFFSET, HEADING] = v * dt
    F[BIAS, BIAS] = math.exp(-dt / road.BIAS_TIME)
    if known:
        for knot in range(KNOT, N_ROAD):
            one = np.zeros(N)
            one[knot] = 1.0
            F[HEADING, knot] = -integral(one, way, way + v * dt, arm=False)
            F[OFFSET, knot] = -integral(one, way, way + v * dt, arm=True)
        F[HEADING, BIAS], F[OFFSET, BIAS] = -dt, -0.5 * v * dt**2
    if way + v * dt > SPACING:
        F = shift() @ F
    expected = F @ P @ F.T
    x = np.zeros(N)
    x[WAY] = way
    road.predict_road_(x, P, nothing_but_motion(), dt, v, w if known else NAN)
    np.testing.assert_allclose(P, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("way", [5.0, 24.0])
def test_noise_of_the_motion(known: bool, way: float) -> None:
    """From certainty: what the yaw rate and the driver add in a tenth of a second, and the road
    where it comes into view."""
    par = parameters(offset_std=1e9, heading_std=1e9, turn_std=1e9)
    x, P = np.zeros(N), np.zeros((N, N))
    x[WAY] = way
    road.predict_road_(x, P, par, 0.1, 20.0, 0.0 if known else NAN)
    assert P[HEADING, HEADING] == pytest.approx((1e-3 if known else 1e-2) ** 2 * 0.1, rel=1e-6)
    assert P[OFFSET, OFFSET] == pytest.approx(0.05**2 * 0.1, rel=1e-6)
    new = 0.001**2 * (1.0 - math.exp(-2.0 * SPACING / 1000.0)) if way + 2.0 > SPACING else 0.0
    assert P[LAST, LAST] == pytest.approx(new, rel=1e-6)
    assert P[BIAS, BIAS] == pytest.approx(0.005**2 * (1.0 - math.exp(-0.2 / 120.0)), rel=1e-6)
    assert P[MOUNTING, MOUNTING] == P[WIDTH, WIDTH] == P[WAY, WAY] == 0.0
    assert not P[KNOT:LAST, KNOT:LAST].any()
    assert not P[N_ROAD:, N_ROAD:].any()


@pytest.mark.parametrize("yaw_rate", [0.0, NAN])
def test_without_traffic_nothing_grows_beyond_what_it_can_be(yaw_rate: float) -> None:
    par = parameters()
    x, P = road.new_road(par)
    for _ in range(6000):
        road.predict_road_(x, P, par, 0.1, 30.0, yaw_rate)
    assert np.isfinite(x).all()
    std = np.sqrt(np.diag(P)[:N_ROAD])
    most = np.full(N_ROAD, 0.001001)
    most[[OFFSET, HEADING, BIAS, MOUNTING, WIDTH, WAY]] = 5.0, 0.1, 0.0051, 0.01, 0.3, 1e-12
    assert (std < most).all()
    assert np.linalg.eigvalsh(P).min() > -1e-12


def test_a_bend_is_learned_from_the_egos_own_yaw_rate() -> None:
    par = parameters()
    x, P = road.new_road(par)
    for _ in range(300):
        road.predict_road_(x, P, par, 0.1, 30.0, 0.03)
    assert curvature(x, x[WAY]) == pytest.approx(0.03 / 30.0, rel=0.3)
    assert abs(x[OFFSET]) < 0.5


# ---- guides


@settings(max_examples=20)
@given(SEEDS, st.integers(0, N_GUIDES - 1))
def test_a_guide_begins_as_uncertain_as_its_measurement_and_the_road(seed: int, g: int) -> None:
    """As the augmented state: place = y - lane, y measured with variance r."""
    rng = np.random.default_rng(seed)
    x, P = rng.normal(size=N), random_covariance(rng, N)
    guides.free_guide_(P, x, g)
    h = np.zeros(N_ROAD + 1)
    road.lane_row_(h, 12.0, 40.0)
    y, r, a = 3.1, 0.2, N_ROAD + g
    G = np.eye(N)
    G[a] = 0.0
    G[a, :N_ROAD] = -h[:N_ROAD]
    expected_P = G @ P @ G.T
    expected_P[a, a] += r
    expected_x = G @ x
    expected_x[a] += y
    guides.begin_guide_(x, P, h, g, y, r)
    np.testing.assert_allclose(x, expected_x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(P, expected_P, rtol=1e-9, atol=1e-9)
    # it agrees with the measurement it comes from
    e = y - h[:N_ROAD] @ x[:N_ROAD] - x[a]
    assert e == pytest.approx(0.0, abs=1e-9)


def test_a_guide_is_forgotten() -> None:
    rng = np.random.default_rng(3)
    x, P = rng.normal(size=N), random_covariance(rng, N)
    before = P.copy()
    guides.free_guide_(P, x, 5)
    a = N_ROAD + 5
    assert x[a] == 0.0
    assert not P[a].any()
    assert not P[:, a].any()
    others = np.arange(N) != a
    np.testing.assert_array_equal(P[np.ix_(others, others)], before[np.ix_(others, others)])


# ---- traffic

AHEAD = np.array([30.0, 45.0, 60.0, 40.0])
LANES = np.array([-1.0, 0.0, 1.0, 2.0])


def lane_change(t: float, begin: float, seconds: float, width: float) -> tuple[float, float]:
    """Lateral way and speed of a smooth lane change to the left."""
    u = min(max((t - begin) / seconds, 0.0), 1.0)
    way = width * (u - math.sin(2 * math.pi * u) / (2 * math.pi))
    return way, width / seconds * (1.0 - math.cos(2 * math.pi * u)) if 0.0 < u < 1.0 else 0.0


def lane_at(traffic: Traffic, x: float) -> float:
    """Where the present road has the middle of the ego's lane."""
    state = traffic.frame.x
    return float(row(road.lane_row_, state[WAY], x) @ state)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("known", ["speed and yaw rate", "speed", "nothing"])
@pytest.mark.parametrize("angle", [0.0, 0.3])
@pytest.mark.parametrize("hindsight", [0.05, 0.5, 1.5])
def test_the_egos_lane_change(side: int, known: str, angle: float, hindsight: float) -> None:
    """Everybody seems to move: it is said once, and the road and all objects count anew."""
    traffic = Traffic(parameters(hindsight=hindsight))
    v, dt, before = 28.0, 0.1, 0.0
    moves = []
    for k in range(140):
        way, vy = lane_change(k * dt, 5.0, 4.5, 3.5)
        heading = side * vy / v
        yaw_rate, before = (heading - before) / dt, heading
        y = 3.5 * LANES - side * way - heading * AHEAD
        traffic.objects["mean"][:, 2] = traffic.objects["x"][:, 1, 2] = 0.7
        moved = traffic.scan(
            range(4), np.column_stack([AHEAD, y]), angle=angle,
            speed=NAN if known == "nothing" else v,
            yaw_rate=yaw_rate if known == "speed and yaw rate" else NAN,
        )  # fmt: skip
        if moved:
            moves.append(moved)
            width = traffic.width
            np.testing.assert_allclose(traffic.objects["mean"][:, 2], 0.7 - moved * width)
            np.testing.assert_allclose(traffic.objects["x"][:, 1, 2], 0.7 - moved * width)
            assert abs(traffic.offset) < 0.6 * width
    assert moves == [side]
    assert traffic.offset == pytest.approx(0.0, abs=0.5)
    assert traffic.width == pytest.approx(3.5, abs=0.2)
    places = traffic.x[N_ROAD : N_ROAD + 4]
    np.testing.assert_allclose(places, 3.5 * (LANES - side), atol=0.5)


@pytest.mark.parametrize("moved", [1, -1])
def test_the_covariance_follows_when_the_lanes_are_counted_anew(moved: int) -> None:
    """The new lane is as uncertain as the old one and the width between them."""
    rng = np.random.default_rng(0)
    x, P = rng.normal(size=N), random_covariance(rng, N)
    slots = np.full(N_GUIDES, FREE, np.int32)
    slots[3] = 9
    F = np.eye(N)
    F[OFFSET, WIDTH] = F[N_ROAD + 3, WIDTH] = -moved
    expected_x, expected_P = x.copy(), F @ P @ F.T
    expected_x[[OFFSET, N_ROAD + 3]] -= moved * 3.4
    guides.change_lane_(x, P, slots, moved, 3.4)
    np.testing.assert_allclose(x, expected_x, rtol=1e-12)
    np.testing.assert_allclose(P, expected_P, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("recognised", [False, True])
def test_one_vehicle_that_changes_lane_does_not_move_the_road(recognised: bool) -> None:
    traffic = Traffic(parameters())
    for k in range(140):
        way, vy = lane_change(0.1 * k, 5.0, 4.5, 3.5)
        y = 3.5 * LANES
        y[1] += way
        if recognised:
            changing = float(abs(vy) > 0.2)
            traffic.objects["mu"][1, [KEEP, LEFT]] = 1.0 - changing, changing
        assert traffic.scan(range(4), np.column_stack([AHEAD, y]), speed=28.0, yaw_rate=0.0) == 0
        assert abs(traffic.offset) < 0.6
        assert abs(lane_at(traffic, 80.0)) < 1.2
    assert traffic.x[N_ROAD + 1] == pytest.approx(3.5, abs=0.4)
    assert traffic.offset == pytest.approx(0.0, abs=0.3)


@pytest.mark.parametrize("width", [3.25, 3.75])
def test_the_width_is_learned(width: float) -> None:
    traffic = Traffic(parameters())
    rng = np.random.default_rng(4)
    for _ in range(400):
        y = width * LANES + rng.normal(0.0, 0.1, 4)
        traffic.scan(range(4), np.column_stack([AHEAD, y]), speed=28.0, yaw_rate=0.0)
    assert traffic.width == pytest.approx(width, abs=0.1)
    assert math.sqrt(traffic.P[WIDTH, WIDTH]) < 0.2


def test_the_offset_is_learned() -> None:
    """The ego drives on the left of its lane; the others do not."""
    traffic = Traffic(parameters(offset_std=0.5))
    for _ in range(300):
        traffic.scan(
            range(4), np.column_stack([AHEAD, 3.5 * LANES - 0.6]), speed=28.0, yaw_rate=0.0
        )
    assert 0.2 < traffic.offset < 0.8


def test_who_guides() -> None:
    """From the second scan on which it is seen, ahead, near, and neither oncoming nor standing."""
    traffic = Traffic(parameters())
    traffic.objects["mu"][3, [KEEP, STILL]] = 0.1, 0.9
    xy = [[40.0, 0.0], [guides.SEEN_TO + 5.0, 0.0], [-5.0, 3.5], [40.0, 7.0]]
    traffic.scan(range(4), xy)
    assert traffic.guide_slot[0] == 0
    assert (traffic.guide_slot[1:] == FREE).all()
    traffic.scan([0], [[40.0, 0.0]], status=1)
    assert traffic.guide_unseen[0] == pytest.approx(0.1), "an outlier was not seen"
    traffic.objects["mu"][0, [KEEP, STILL]] = 0.1, 0.9
    traffic.scan([0], [[40.0, 0.0]])
    assert (traffic.guide_slot == FREE).all()
    assert not traffic.P[N_ROAD:].any()


def test_a_guide_that_is_not_seen_for_long_is_forgotten() -> None:
    traffic = Traffic(parameters())
    for _ in range(3):
        traffic.scan([0], [[40.0, 0.0]])
    for _ in range(9):
        traffic.nothing()
    assert traffic.guide_slot[0] == 0
    for _ in range(2):
        traffic.nothing()
    assert traffic.guide_slot[0] == FREE
    assert not traffic.P[N_ROAD:].any()


def test_a_guide_that_jumps_begins_anew() -> None:
    """Another vehicle under the same name says nothing of the road."""
    traffic = Traffic(parameters())
    for _ in range(20):
        traffic.scan([0], [[40.0, 0.0]])
    traffic.scan([0], [[40.0, 7.0]])
    assert abs(traffic.offset) < 0.1
    assert traffic.x[N_ROAD] == pytest.approx(7.0, abs=0.3)


def test_a_slot_that_is_used_again_begins_anew() -> None:
    traffic = Traffic(parameters())
    for _ in range(20):
        traffic.scan([0], [[40.0, 0.0]])
    assert traffic.x[N_ROAD] == pytest.approx(0.0, abs=0.05)
    traffic.age[0] = 0
    traffic.scan([0], [[40.0, 1.0]])
    assert abs(traffic.offset) < 0.1
    assert traffic.x[N_ROAD] == pytest.approx(1.0, abs=0.2)


def test_more_vehicles_than_guides() -> None:
    traffic = Traffic(parameters(), capacity=40)
    xy = np.column_stack([np.linspace(10.0, 140.0, 40), 3.5 * (np.arange(40) % 3 - 1)])
    for _ in range(10):
        assert traffic.scan(range(40), xy) == 0
    assert sorted(traffic.guide_slot) == list(range(N_GUIDES))
    assert abs(traffic.offset) < 0.1


# ---- hindsight


def test_what_a_scan_says_is_written_down() -> None:
    """By slot, in the vehicle's axes; what was not measured, not believed or not kept is not."""
    rng = np.random.default_rng(8)
    traffic = Traffic(parameters(), capacity=7)
    traffic.objects["mu"][:, :3] = rng.dirichlet([1.0, 1.0, 1.0], 7)
    slot = np.array([4, -1, 2, 0, 6, 1], np.int32)
    status = np.array([0, 0, 0, 1, 0, 0], np.int8)
    age = np.array([9, 9, 1, 9, 2, 9, 9], np.int32)
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
    assert notes["new"][[2, 4]].tolist() == [True, False]
    for k, s in ((0, 4), (2, 2)):
        at = (z[k, 0] + 1j * z[k, 2]) * np.exp(1j * angle[k])
        turn = np.exp(1j * angle[k])
        R = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
        cov = R @ np.diag(r[k, [0, 2]]) @ R.T
        expected = [at.real, at.imag, cov[1, 1]]
        expected += traffic.objects["mu"][s, [LEFT, STILL]].tolist()
        got = [notes[name][s] for name in ("x", "y", "noise", "changing", "off")]
        np.testing.assert_allclose(got, expected, rtol=1e-12)


class Ring:
    """Four guides that are known, and scans in which one of them is off to the left."""

    def __init__(self) -> None:
        self.traffic = Traffic(parameters())
        for _ in range(20):
            self.traffic.scan(range(4), np.column_stack([AHEAD, 3.5 * LANES]))
        assert sorted(self.traffic.guide_slot)[-4:] == [0, 1, 2, 3]
        self.notes = np.zeros((5, 32), guides.NOTE_DTYPE)
        self.notes["x"][:, :4] = AHEAD
        self.notes["y"][:, :4] = 3.5 * LANES + [0.0, 0.4, 0.0, 0.0]
        self.notes["noise"], self.notes["seen"][:, :4] = 0.01, True

    def learn(self, first: int, later: int) -> bytes:
        """What the road becomes; the ring stays as it is."""
        traffic = self.traffic
        x, P = traffic.x.copy(), traffic.P.copy()
        slots, unseen = traffic.guide_slot.copy(), traffic.guide_unseen.copy()
        guides.learn_(x, P, parameters(), slots, unseen, self.notes, first, later, 0.1)
        self.offset, self.slots = x[OFFSET], slots
        return x.tobytes() + P.tobytes() + slots.tobytes() + unseen.tobytes()


def test_what_a_vehicle_turns_out_to_do_it_was_doing() -> None:
    """As if it had been known in the scan itself, wherever in the ring that is."""
    ring = Ring()
    unknown = ring.learn(0, 0)
    moved = abs(ring.offset)
    ring.notes["changing"][0, 1] = 0.9
    known = ring.learn(0, 0)
    assert abs(ring.offset) < 0.5 * moved, "it does not take the road along"
    ring.notes["changing"][0, 1] = 0.0
    for first in range(5):
        for after in (1, 2, 4):
            ring.notes["changing"][(first + after) % 5, 1] = 0.9
            assert ring.learn(first, after) == known
            assert ring.learn(first, 4) == known
            assert ring.learn(first, after - 1) == unknown, "that scan is not there yet"
            ring.notes["changing"] = 0.0
    ring.notes["changing"][0, 1], ring.notes["changing"][2, 1] = 0.9, 0.3
    assert ring.learn(0, 4) == known, "the surest it ever was"
    ring.notes["changing"][0, 1], ring.notes["changing"][1, 1] = 0.0, 0.9
    ring.notes["seen"][1, 1] = False
    assert ring.learn(0, 1) == unknown, "what is written there is an older scan's"


def test_another_object_in_the_slot_tells_nothing_of_the_one_before() -> None:
    ring = Ring()
    unknown = ring.learn(0, 0)
    ring.notes["changing"][2:4, 1] = 0.9
    assert ring.learn(0, 4) != unknown
    ring.notes["new"][2, 1] = True
    assert ring.learn(0, 4) == unknown
    ring.notes["new"][2, 1], ring.notes["new"][1, 1] = False, True
    assert ring.learn(0, 4) == unknown, "nor after its first scan"
    ring.notes["new"][1, 1], ring.notes["new"][0, 1] = False, True
    ring.learn(0, 4)
    assert 1 in ring.slots, "the object that is new in the scan itself begins as a guide"


def late_lane_change(hindsight: float, dt: float) -> float:
    """How far off the lane 60 m ahead gets while a vehicle there moves over, seen 1.8 s late."""
    traffic = Traffic(parameters(hindsight=hindsight))
    worst = 0.0
    for k in range(round(12.0 / dt)):
        t = k * dt
        way, _ = lane_change(t, 5.0, 4.5, 3.5)
        changing = float(6.8 < t < 9.5)
        traffic.objects["mu"][0, [KEEP, LEFT]] = 1.0 - changing, changing
        xy = [[60.0, way], [40.0, 3.5], [30.0, -3.5]]
        assert traffic.scan(range(3), xy, dt=dt, speed=28.0, yaw_rate=0.0) == 0
        worst = max(worst, abs(lane_at(traffic, 60.0)))
    return worst


def test_a_vehicle_that_turns_out_to_change_lanes_does_not_bend_the_road() -> None:
    assert late_lane_change(0.05, 0.1) > 0.6
    assert late_lane_change(1.5, 0.1) < 0.3


STEPS = st.lists(
    st.tuples(
        SEEDS,
        st.integers(0, 6),
        st.sampled_from([0.02, 0.1, 0.1, 0.9]),
        st.sampled_from([NAN, 0.0, 5.0, 30.0, -3.0, 60.0]),
        st.sampled_from([NAN, 0.0, 0.1, -1.0]),
        st.sampled_from([0.0, 0.4, -1.2]),
    ),
    max_size=30,
)


@settings(max_examples=40)
@given(STEPS, st.sampled_from([0.05, 0.3, 1.5]))
def test_whatever_is_seen_the_covariance_stays_one(script: list[Any], hindsight: float) -> None:
    traffic = Traffic(parameters(hindsight=hindsight), capacity=8)
    for seed, n, dt, speed, yaw_rate, angle in script:
        rng = np.random.default_rng(seed)
        slots = rng.permutation(8)[:n]
        traffic.age[rng.random(8) < 0.1] = 0
        traffic.objects["mu"][:, :3] = rng.dirichlet([0.3, 0.3, 0.1], 8)
        xy = np.column_stack([rng.uniform(-10.0, 160.0, n), rng.normal(0.0, 5.0, n)])
        moved = traffic.scan(slots, xy, dt=dt, speed=speed, yaw_rate=yaw_rate, angle=angle)
        assert moved in (-1, 0, 1)
        for x, P in ((traffic.x, traffic.P), (traffic.frame.x, traffic.frame.P)):
            assert np.isfinite(x).all()
            np.testing.assert_allclose(P, P.T, rtol=1e-12, atol=1e-15)
            eigenvalues = np.linalg.eigvalsh(P)
            assert eigenvalues.min() > -1e-9 * max(eigenvalues.max(), 1.0)
            assert not P[WAY].any()
        used = traffic.guide_slot[traffic.guide_slot != FREE]
        assert len(set(used.tolist())) == len(used)


# ---- into the road's axes and back


def turned(along: float, across: float, angle: float) -> tuple[float, float]:
    """A vector's components in axes turned by ``angle``."""
    c = (along + 1j * across) * np.exp(-1j * angle)
    return c.real, c.imag


@settings(max_examples=40)
@given(SEEDS, st.floats(-1.5, 1.5), st.sampled_from([NAN, 0.0, 25.0]))
def test_into_the_axes_of_the_road_and_back(seed: int, angle: float, speed: float) -> None:
    rng = np.random.default_rng(seed)
    par, state, P = parameters(), random_road(rng), 1e-4 * random_covariance(rng, N)
    x, y, vx, vy = rng.uniform(1.0, 120.0), rng.normal(0.0, 4.0), rng.normal(), rng.normal()
    (z0, z2), (z1, z3) = turned(x, y, angle), turned(vx, vy, angle)
    z = np.array([[z0, z1, z2, z3]])
    r = np.full((1, 4), 0.04)
    valid = np.ones((1, 4), np.bool_)
    # the speed along the line of sight stands for vx
    seen_vx = z1 * math.cos(angle)
    road.localise_(state, P, par, 1, z, r, valid, np.array([angle]), speed)
    back_x, back_y = turned(z[0, 0], z[0, 2], -angle)
    back_vx, back_vy = turned(z[0, 1], z[0, 3], -angle)
    assert back_x == pytest.approx(x, abs=1e-9)
    assert back_vx == pytest.approx(vx, abs=1e-9)
    h = np.zeros(N_ROAD + 1)
    lane_y, lane_vy = road.place(state, h, x, seen_vx, speed)
    assert back_y + lane_y == pytest.approx(y, abs=1e-9)
    assert back_vy + lane_vy == pytest.approx(vy, abs=1e-9)
    # what the road is uncertain by, split among the axes
    H = row(road.lane_row_, state[WAY], x)
    variance = H @ P[:N_ROAD, :N_ROAD] @ H
    error = min(3.0 * variance, 0.5**2)
    share = np.array([math.sin(angle), math.cos(angle)]) ** 2
    np.testing.assert_allclose(r[0, [0, 2]], 0.04 + error * share, rtol=1e-9)
    H = row(road.slope_row_, state[WAY], x)
    variance = H @ P[:N_ROAD, :N_ROAD] @ H
    error = min(10.0 * variance * (speed + seen_vx) ** 2, 2.0**2)
    expected = 0.04 + (0.0 if math.isnan(speed) else error) * share
    np.testing.assert_allclose(r[0, [1, 3]], expected, rtol=1e-9)


@pytest.mark.parametrize("speed", [10.0, 30.0])
def test_a_vehicle_that_follows_the_lane(speed: float) -> None:
    """Two instants of a drive through a bend, in the plane: its velocity over ground against the
    ego's, seen in the ego's axes, and its place."""
    radius, ahead, mounting = 800.0, 50.0, 0.01
    state = np.zeros(N)
    state[KNOT:N_ROAD], state[MOUNTING], state[WIDTH], state[WAY] = 1 / radius, mounting, 3.5, 13.0
    phi = ahead / radius
    vx, vy = turned(speed * math.cos(phi) - speed, speed * math.sin(phi), mounting)
    x, y = turned(radius * math.sin(phi), radius * (1 - math.cos(phi)), mounting)
    got_y, got_vy = road.place(state, np.zeros(N_ROAD + 1), x, vx, speed)
    assert got_y == pytest.approx(y, abs=0.01)
    assert got_vy == pytest.approx(vy, abs=0.01)


def test_rows_without_a_distance_stay_as_they_are() -> None:
    rng = np.random.default_rng(0)
    state, P = random_road(rng), np.eye(N)
    z = np.array([[NAN, 1.0, 2.0, 3.0], [20.0, 1.0, 2.0, 3.0], [1e5, 1.0, 2.0, 3.0]])
    r, valid = np.full((3, 4), 0.04), np.ones((3, 4), np.bool_)
    valid[0, 0] = False
    before = z.copy()
    road.localise_(state, P, parameters(), 3, z, r, valid, np.array([0.0, NAN, 0.0]), 20.0)
    np.testing.assert_array_equal(z, before)
    assert (r == 0.04).all()
