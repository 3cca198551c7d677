"""The shape of the road against closed forms and quadrature, and the way into its axes and back."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.gaussian import random_covariance
from small_roads import USUAL, parameters

from can_imm.estimation import guides, road
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

SEEDS = st.integers(0, 2**32 - 1)
NAN = math.nan
KNOTS = SPACING * np.arange(N_KNOTS)
"""Where the knots lie on the ground, from the first one [m]."""


def random_road(rng: np.random.Generator, bends: float = 3e-4) -> np.ndarray:
    """A state; the curvature changes by ``bends`` from knot to knot."""
    x = np.zeros(N_ROAD)
    x[[OFFSET, HEADING, BIAS, MOUNTING]] = rng.normal(0.0, [0.5, 0.02, 5e-3, 5e-3])
    x[WIDTH] = rng.normal(3.5, 0.2)
    x[WAY] = rng.uniform(0.0, SPACING)
    x[KNOT:] = rng.normal(0.0, 1e-3) + np.cumsum(rng.normal(0.0, bends, N_KNOTS))
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


def middle(state: np.ndarray, x: float) -> float:
    """Of the ego's lane at a distance, by quadrature."""
    bend = integral(state, state[WAY], state[WAY] + x, arm=True) if x > 0.0 else 0.0
    return float(-state[OFFSET] - (state[HEADING] + state[MOUNTING]) * x + bend)


def row(function: Any, way: float, x: float) -> np.ndarray:
    h = np.full(N_ROAD + 1, 77.0)
    function(h, way, x)
    assert h[N_ROAD] == 77.0, "of the vehicles it knows nothing"
    return h[:N_ROAD]


# ---- the shape of the road


@given(SEEDS, st.floats(-50.0, 400.0))
def test_the_lane_ahead(seed: int, x: float) -> None:
    r = random_road(np.random.default_rng(seed))
    assert row(road.lane_row_, r[WAY], x) @ r == pytest.approx(middle(r, x), abs=1e-9)


@given(SEEDS, st.floats(-50.0, 400.0))
def test_the_direction_of_the_road_ahead(seed: int, x: float) -> None:
    r = random_road(np.random.default_rng(seed))
    bend = integral(r, r[WAY], r[WAY] + x, arm=False) if x > 0.0 else 0.0
    expected = -r[HEADING] - r[MOUNTING] + bend
    assert row(road.slope_row_, r[WAY], x) @ r == pytest.approx(expected, abs=1e-10)


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


def test_the_road_is_known_as_far_as_vehicles_are_followed() -> None:
    """However far the ego has come from the first knot."""
    assert KNOTS[-1] - SPACING >= guides.SEEN_TO


@pytest.mark.parametrize("way", [0.0, 10.0])
@pytest.mark.parametrize("x", [-30.0, -0.1, 0.1, 14.9, 15.1, 30.0, 100.0, 264.9, 265.1, 300.0])
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
    states = np.array([random_road(rng) for _ in range(20)])
    x = rng.uniform(-50.0, 300.0, 20)
    expected = [middle(r, d) for r, d in zip(states, x, strict=True)]
    np.testing.assert_allclose(road.lane_middles(states, x), expected, atol=1e-9)


# ---- before anything is seen


def test_what_is_thought_of_a_road_that_was_not_seen() -> None:
    """What the parameters say; the road is straight, and where the knots lie is known."""
    par = parameters(width=3.7, width_std=0.2, offset=-0.2, curvature_std=0.002)
    x, P = road.new_road(par)
    expected = np.zeros(N_ROAD)
    expected[[OFFSET, WIDTH]] = -0.2, 3.7
    np.testing.assert_array_equal(x, expected)
    others = [OFFSET, HEADING, BIAS, MOUNTING, WIDTH, WAY]
    np.testing.assert_allclose(
        P[np.ix_(others, others)], np.diag([0.3, 0.01, 0.005, 0.003, 0.2, 0.0]) ** 2, rtol=1e-12
    )
    np.testing.assert_allclose(np.diag(P)[KNOT:], 0.002**2, rtol=1e-12)
    assert not P[KNOT:, :KNOT].any()
    assert not P[:KNOT, KNOT:].any()


def test_the_curvature_forgets_itself_along_the_road() -> None:
    """Oracle: each knot is the one before it, less what is forgotten, and something new."""
    memory = math.exp(-SPACING / 40.0)
    mix = np.zeros((N_KNOTS, N_KNOTS))
    mix[0, 0] = 0.002
    for i in range(1, N_KNOTS):
        mix[i] = memory * mix[i - 1]
        mix[i, i] = 0.002 * math.sqrt(1.0 - memory**2)
    _, P = road.new_road(parameters(curvature_std=0.002, curvature_length=40.0))
    np.testing.assert_allclose(P[KNOT:, KNOT:], mix @ mix.T, rtol=1e-9)


def test_every_parameter_has_its_place() -> None:
    for k, name in enumerate(road.PARAMETERS):
        assert getattr(road, f"P_{name.upper()}") == k
    assert set(USUAL) == set(road.PARAMETERS)


# ---- into the road's axes and back


def turned(along: float, across: float, angle: float) -> tuple[float, float]:
    """A vector's components in axes turned by ``angle``."""
    c = (along + 1j * across) * np.exp(-1j * angle)
    return c.real, c.imag


@settings(max_examples=40)
@given(SEEDS, st.floats(-1.5, 1.5), st.sampled_from([NAN, 0.0, 25.0]))
def test_into_the_axes_of_the_road_and_back(seed: int, angle: float, speed: float) -> None:
    rng = np.random.default_rng(seed)
    par, state, P = parameters(), random_road(rng), 1e-4 * random_covariance(rng, N_ROAD)
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
    variance = H @ P @ H
    error = min(3.0 * variance, 0.5**2)
    share = np.array([math.sin(angle), math.cos(angle)]) ** 2
    np.testing.assert_allclose(r[0, [0, 2]], 0.04 + error * share, rtol=1e-9)
    H = row(road.slope_row_, state[WAY], x)
    variance = H @ P @ H
    error = min(10.0 * variance * (speed + seen_vx) ** 2, 2.0**2)
    expected = 0.04 + (0.0 if math.isnan(speed) else error) * share
    np.testing.assert_allclose(r[0, [1, 3]], expected, rtol=1e-9)


@settings(max_examples=30)
@given(SEEDS, st.floats(-40.0, 300.0), st.sampled_from([NAN, 0.0, 25.0]))
def test_a_place_and_how_well_it_is_known(seed: int, x: float, speed: float) -> None:
    """Many roads drawn from the covariance: their mean and spread by the root of it."""
    rng = np.random.default_rng(seed)
    state, P, vx = random_road(rng), 1e-4 * random_covariance(rng, N_ROAD), rng.normal()
    h = np.zeros(N_ROAD + 1)
    got = road.place_and_errors(state, P, h, x, vx, speed)
    assert got[:2] == road.place(state, h, x, vx, speed)
    # sideways by each column of the root, where the road itself stays where it is on the ground
    root = np.linalg.cholesky(P)
    root[WAY] = 0.0
    y = [middle(state + column, x) - middle(state, x) for column in root.T]
    assert got[2] == pytest.approx(np.square(y).sum(), rel=1e-6)
    if math.isnan(speed):
        assert got[1] == got[3] == 0.0
        return
    d = 1e-3
    turns = [
        (middle(state + c, x + d) - middle(state + c, x - d) - middle(state, x + d)
         + middle(state, x - d)) / (2 * d)
        for c in root.T
    ]  # fmt: skip
    assert got[3] == pytest.approx(np.square(turns).sum(), rel=1e-3)


@pytest.mark.parametrize("speed", [10.0, 30.0])
def test_a_vehicle_that_follows_the_lane(speed: float) -> None:
    """Two instants of a drive through a bend, in the plane: its velocity over ground against the
    ego's, seen in the ego's axes, and its place."""
    radius, ahead, mounting = 800.0, 50.0, 0.01
    state = np.zeros(N_ROAD)
    state[KNOT:], state[MOUNTING], state[WIDTH], state[WAY] = 1 / radius, mounting, 3.5, 13.0
    phi = ahead / radius
    vx, vy = turned(speed * math.cos(phi) - speed, speed * math.sin(phi), mounting)
    x, y = turned(radius * math.sin(phi), radius * (1 - math.cos(phi)), mounting)
    got_y, got_vy = road.place(state, np.zeros(N_ROAD + 1), x, vx, speed)
    assert got_y == pytest.approx(y, abs=0.01)
    assert got_vy == pytest.approx(vy, abs=0.01)


def test_rows_without_a_distance_stay_as_they_are() -> None:
    rng = np.random.default_rng(0)
    state, P = random_road(rng), np.eye(N_ROAD)
    z = np.array([[NAN, 1.0, 2.0, 3.0], [20.0, 1.0, 2.0, 3.0], [1e5, 1.0, 2.0, 3.0]])
    r, valid = np.full((3, 4), 0.04), np.ones((3, 4), np.bool_)
    valid[0, 0] = False
    before = z.copy()
    road.localise_(state, P, parameters(), 3, z, r, valid, np.array([0.0, NAN, 0.0]), 20.0)
    np.testing.assert_array_equal(z, before)
    assert (r == 0.04).all()
