"""The road filter against closed forms, dense matrix algebra, and a drive through the plane."""

from __future__ import annotations

import math
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
    CHANGE,
    CURVATURE,
    FAR,
    FREE,
    HEADING,
    MOUNTING,
    N_GUIDES,
    N_ROAD,
    OFFSET,
    WIDTH,
    N,
)

SEEDS = st.integers(0, 2**32 - 1)
NAN = math.nan


def random_road(rng: np.random.Generator) -> np.ndarray:
    x = np.zeros(N)
    x[:N_ROAD] = rng.normal(0.0, [0.5, 0.02, 1e-3, 5e-6, 5e-3, 5e-3, 0.2])
    x[WIDTH] += 3.5
    return x


def row(function: Any, x: float) -> np.ndarray:
    h = np.full(N_ROAD + 1, 77.0)
    function(h, x)
    assert h[N_ROAD] == 77.0, "of the guides it knows nothing"
    return h[:N_ROAD]


# ---- the shape of the road


def bend(x: float, curvature: float, change: float) -> float:
    """Twice the integral of the curvature, which sets in at 0 and changes up to `FAR`."""
    total = 0.0
    for low, high in ((0.0, min(x, FAR)), (FAR, x)):
        if high > low:
            nodes, weights = np.polynomial.legendre.leggauss(8)
            s = 0.5 * (high - low) * nodes + 0.5 * (high + low)
            kappa = curvature + change * np.minimum(s, FAR)
            total += 0.5 * (high - low) * float(weights @ ((x - s) * kappa))
    return total


@given(SEEDS, st.floats(-50.0, 250.0))
def test_the_lane_ahead(seed: int, x: float) -> None:
    r = random_road(np.random.default_rng(seed))
    expected = -r[OFFSET] - (r[HEADING] + r[MOUNTING]) * x + bend(x, r[CURVATURE], r[CHANGE])
    assert row(road.lane_row_, x) @ r[:N_ROAD] == pytest.approx(expected, abs=1e-9)


def test_the_clothoid_of_the_textbook() -> None:
    for x in (0.0, 17.0, 60.0, FAR):
        expected = np.array([-1.0, -x, x**2 / 2, x**3 / 6, 0.0, -x, 0.0])
        np.testing.assert_allclose(row(road.lane_row_, x), expected, rtol=1e-12)


@pytest.mark.parametrize("x", [-30.0, -0.1, 0.1, 30.0, FAR - 0.1, FAR + 0.1, 180.0])
def test_the_slope_is_the_derivative(x: float) -> None:
    d = 1e-3
    expected = (row(road.lane_row_, x + d) - row(road.lane_row_, x - d)) / (2 * d)
    np.testing.assert_allclose(row(road.slope_row_, x), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("x", [0.0, FAR])
@pytest.mark.parametrize("function", [road.lane_row_, road.slope_row_])
def test_no_step_where_the_formula_changes(x: float, function: Any) -> None:
    np.testing.assert_allclose(row(function, x - 1e-9), row(function, x + 1e-9), atol=1e-4)


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
    """Offset, heading, curvature after driving: the ego and the road's middle in the plane."""
    w = yaw_rate - r[BIAS]
    tau = dt / steps
    x, y, heading = 0.0, r[OFFSET], r[HEADING]
    for _ in range(steps):
        middle = heading + 0.5 * w * tau
        x, y, heading = x + v * tau * math.cos(middle), y + v * tau * math.sin(middle), middle
        heading += 0.5 * w * tau
    # the nearest point of the road, walked along in small steps
    ds = v * dt / steps / 4
    px, py, s = 0.0, 0.0, 0.0
    while True:
        direction = r[CURVATURE] * s + 0.5 * r[CHANGE] * s * s
        along = (x - px) * math.cos(direction) + (y - py) * math.sin(direction)
        if along <= 0.0:
            break
        half = s + 0.5 * ds
        middle = r[CURVATURE] * half + 0.5 * r[CHANGE] * half * half
        px, py, s = px + ds * math.cos(middle), py + ds * math.sin(middle), s + ds
    across = (y - py) * math.cos(direction) - (x - px) * math.sin(direction)
    return across, heading - direction, r[CURVATURE] + r[CHANGE] * s


@settings(max_examples=25)
@given(SEEDS, st.floats(5.0, 40.0), st.floats(-0.05, 0.05))
def test_the_ego_drives_along_the_road(seed: int, v: float, yaw_rate: float) -> None:
    x = random_road(np.random.default_rng(seed))
    x[CHANGE] *= 0.2
    P = np.eye(N)
    offset, heading, curvature = drive(x, v, yaw_rate, 0.4)
    still = x.copy()
    road.predict_road_(x, P, nothing_but_motion(), 0.4, v, yaw_rate)
    assert x[OFFSET] == pytest.approx(offset, abs=4e-3)
    assert x[HEADING] == pytest.approx(heading, abs=4e-4)
    assert x[CURVATURE] == pytest.approx(curvature, abs=1e-6)
    still[BIAS] *= math.exp(-0.4 / road.BIAS_TIME)
    np.testing.assert_allclose(x[[CHANGE, BIAS, MOUNTING, WIDTH]], still[[3, 4, 5, 6]], rtol=1e-9)


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
@given(SEEDS, st.booleans())
def test_the_covariance_moves_with_the_state(seed: int, known: bool) -> None:
    """F P F' with the derivatives of the closed-form motion, guides and their correlations too."""
    rng = np.random.default_rng(seed)
    P = random_covariance(rng, N)
    v, dt, w = 30.0, 0.1, 0.02
    F = np.eye(N)
    F[OFFSET, HEADING] = v * dt
    F[BIAS, BIAS] = math.exp(-dt / road.BIAS_TIME)
    F[CURVATURE, CHANGE] = v * dt
    if known:
        F[HEADING, CURVATURE], F[HEADING, BIAS] = -v * dt, -dt
        F[OFFSET, CURVATURE], F[OFFSET, BIAS] = -0.5 * (v * dt) ** 2, -0.5 * v * dt**2
    expected = F @ P @ F.T
    road.predict_road_(np.zeros(N), P, nothing_but_motion(), dt, v, w if known else NAN)
    np.testing.assert_allclose(P, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("known", [True, False])
def test_noise_of_the_motion(known: bool) -> None:
    """From certainty: what the yaw rate and the driver add in a tenth of a second."""
    par = parameters(offset_std=1e9, heading_std=1e9, turn_std=1e9)
    P = np.zeros((N, N))
    road.predict_road_(np.zeros(N), P, par, 0.1, 20.0, 0.0 if known else NAN)
    assert P[HEADING, HEADING] == pytest.approx((1e-3 if known else 1e-2) ** 2 * 0.1, rel=1e-6)
    assert P[OFFSET, OFFSET] == pytest.approx(0.05**2 * 0.1, rel=1e-6)
    assert P[CURVATURE, CURVATURE] > 0.0
    assert P[CHANGE, CHANGE] > 0.0
    assert P[MOUNTING, MOUNTING] == P[WIDTH, WIDTH] == 0.0
    assert not P[N_ROAD:, N_ROAD:].any()


@pytest.mark.parametrize("yaw_rate", [0.0, NAN])
def test_without_traffic_nothing_grows_beyond_what_it_can_be(yaw_rate: float) -> None:
    par = parameters()
    x, P = road.new_road(par)
    for _ in range(6000):
        road.predict_road_(x, P, par, 0.1, 30.0, yaw_rate)
    assert np.isfinite(x).all()
    std = np.sqrt(np.diag(P)[:N_ROAD])
    assert (std < [5.0, 0.1, 0.02, 1e-4, 0.05, 0.01, 0.3]).all()
    assert np.linalg.eigvalsh(P).min() > -1e-12


def test_a_bend_is_learned_from_the_egos_own_yaw_rate() -> None:
    par = parameters()
    x, P = road.new_road(par)
    for _ in range(300):
        road.predict_road_(x, P, par, 0.1, 30.0, 0.03)
    assert x[CURVATURE] == pytest.approx(0.03 / 30.0, rel=0.3)
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
    road.lane_row_(h, 40.0)
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


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("known", ["speed and yaw rate", "speed", "nothing"])
@pytest.mark.parametrize("angle", [0.0, 0.3])
def test_the_egos_lane_change(side: int, known: str, angle: float) -> None:
    """Everybody seems to move: it is said once, and the road and all objects count anew."""
    traffic = Traffic(parameters())
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


def test_the_covariance_follows_when_the_lanes_are_counted_anew() -> None:
    """The new lane is as uncertain as the old one and the width between them."""
    rng = np.random.default_rng(0)
    traffic = Traffic(parameters())
    traffic.scan([], np.zeros((0, 2)))
    traffic.guide_slot[3] = 9
    traffic.P[:] = 0.01 * random_covariance(rng, N)
    traffic.x[OFFSET] = 2.0
    x, P = traffic.x.copy(), traffic.P.copy()
    moved = guides.watch_traffic_(
        traffic.x, traffic.P, traffic.par, traffic.guide_slot, traffic.guide_unseen, np.ones(1),
        traffic.bank, traffic.objects, 0, np.zeros(0, np.int32), np.zeros(0, np.int8),
        traffic.age, np.zeros((0, 4)), np.zeros((0, 4)), np.zeros((0, 4), np.bool_),
        np.zeros(0), 0.1,
    )  # fmt: skip
    assert moved == 1
    F = np.eye(N)
    F[OFFSET, WIDTH] = F[N_ROAD + 3, WIDTH] = -1.0
    np.testing.assert_allclose(traffic.x, F @ x, rtol=1e-12)
    np.testing.assert_allclose(traffic.P, F @ P @ F.T, rtol=1e-9, atol=1e-15)


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
        h = row(road.lane_row_, 80.0)
        assert abs(h @ traffic.x[:N_ROAD]) < 1.2
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
        traffic.scan([], np.zeros((0, 2)))
    assert traffic.guide_slot[0] == 0
    for _ in range(2):
        traffic.scan([], np.zeros((0, 2)))
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
@given(STEPS)
def test_whatever_is_seen_the_covariance_stays_one(script: list[Any]) -> None:
    traffic = Traffic(parameters(), capacity=8)
    for seed, n, dt, speed, yaw_rate, angle in script:
        rng = np.random.default_rng(seed)
        slots = rng.permutation(8)[:n]
        traffic.age[rng.random(8) < 0.1] = 0
        traffic.objects["mu"][:, :3] = rng.dirichlet([0.3, 0.3, 0.1], 8)
        xy = np.column_stack([rng.uniform(-10.0, 160.0, n), rng.normal(0.0, 5.0, n)])
        moved = traffic.scan(slots, xy, dt=dt, speed=speed, yaw_rate=yaw_rate, angle=angle)
        assert moved in (-1, 0, 1)
        assert np.isfinite(traffic.x).all()
        np.testing.assert_allclose(traffic.P, traffic.P.T, rtol=1e-12, atol=1e-15)
        eigenvalues = np.linalg.eigvalsh(traffic.P)
        assert eigenvalues.min() > -1e-9 * max(eigenvalues.max(), 1.0)
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
    # what the road is uncertain by, split among the axes; beyond `FAR` by another bend, too
    beyond = max(x - FAR, 0.0)
    H = row(road.lane_row_, x)
    variance = H @ P[:N_ROAD, :N_ROAD] @ H + (3e-4 * beyond**2 / 2) ** 2
    error = min(3.0 * variance, 0.5**2)
    share = np.array([math.sin(angle), math.cos(angle)]) ** 2
    np.testing.assert_allclose(r[0, [0, 2]], 0.04 + error * share, rtol=1e-9)
    H = row(road.slope_row_, x)
    variance = H @ P[:N_ROAD, :N_ROAD] @ H + (3e-4 * beyond) ** 2
    error = min(10.0 * variance * (speed + seen_vx) ** 2, 2.0**2)
    expected = 0.04 + (0.0 if math.isnan(speed) else error) * share
    np.testing.assert_allclose(r[0, [1, 3]], expected, rtol=1e-9)


@pytest.mark.parametrize("speed", [10.0, 30.0])
def test_a_vehicle_that_follows_the_lane(speed: float) -> None:
    """Two instants of a drive through a bend, in the plane: its velocity over ground against the
    ego's, seen in the ego's axes, and its place."""
    radius, ahead, mounting = 800.0, 50.0, 0.01
    state = np.zeros(N)
    state[CURVATURE], state[MOUNTING], state[WIDTH] = 1 / radius, mounting, 3.5
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
