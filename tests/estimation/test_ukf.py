"""IMM-UKF kernels against filterpy's UKF, a plain-numpy IMM, and the motions' own equations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles import textbook_ukf as book
from oracles.gaussian import random_covariance
from scipy.integrate import solve_ivp

from can_imm.estimation import ukf

TOLERANCE = 1e-9


def parameters(kinds=(ukf.CV, ukf.CT), Pi=((0.97, 0.03), (0.1, 0.9)), **spread):
    par = np.zeros(1, ukf.PARAMETERS_DTYPE)[0]
    n = len(kinds)
    par["n_models"], par["kind"][:n] = n, kinds
    par["q"][:n] = np.array([0.3, 0.7, 0.2])[:n]
    par["q_omega"][:n] = np.array([0.01, 0.2, 0.1])[:n]
    par["entry_mean"][:n] = np.array([0.0, 0.5, -0.5])[:n]
    par["entry_var"][:n] = np.array([0.001, 0.04, 0.03])[:n]
    par["mu0"][:n] = 1 / n
    par["mu_floor"], par["step_s"] = 1e-9, 0.01
    # one matrix for every number of steps: which is taken is tested apart
    par["Pi"][:, :n, :n] = Pi
    ukf.set_spread_(par, **spread)
    return par


def scratch(n):
    """points, L, seen, mean, S, C as `ukf.correct_` wants them."""
    m = 2 * n
    return (
        np.zeros((11, 5)),
        np.zeros((5, 5)),
        np.zeros((11, m)),
        np.zeros(m),
        np.zeros((m, m)),
        np.zeros((5, m)),
    )


def random_state(rng):
    x = rng.normal(size=5) * [20.0, 8.0, 20.0, 8.0, 0.5]
    return x, random_covariance(rng, 5) * 0.2


def random_places(rng, n):
    return rng.uniform(-60.0, 60.0, (n, 2))


# The motion


@pytest.mark.parametrize("omega", [0.0, 1e-12, 1e-6, 1.9e-3, 2.1e-3, 0.03, -0.6, 2.0])
def test_a_constant_turn_solves_its_differential_equation(omega):
    start = np.array([3.0, 11.0, -2.0, 4.0, omega])

    def rate(_, p):
        return [p[1], -p[4] * p[3], p[3], p[4] * p[1], 0.0]

    expected = solve_ivp(rate, (0.0, 0.8), start, rtol=1e-12, atol=1e-12).y[:, -1]
    p = start.copy()
    ukf.turn_(p, 0.8)
    np.testing.assert_allclose(p, expected, rtol=0, atol=1e-9)


@given(st.floats(-3.0, 3.0), st.floats(0.001, 2.0), st.floats(-20.0, 20.0), st.floats(-20.0, 20.0))
def test_a_constant_turn_matches_the_chord_and_can_be_undone(omega, dt, vx, vy):
    start = np.array([1.0, vx, 2.0, vy, omega])
    p = start.copy()
    ukf.turn_(p, dt)
    np.testing.assert_allclose(p, book.ct(start, dt), rtol=0, atol=1e-10)
    assert np.hypot(p[1], p[3]) == pytest.approx(np.hypot(vx, vy), abs=1e-12)
    ukf.turn_(p, -dt)
    np.testing.assert_allclose(p, start, rtol=0, atol=1e-10)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_series_meets_the_formula_where_it_takes_over(sign):
    ways = []
    for factor in (1.0 - 1e-9, 1.0 + 1e-9):
        p = np.array([0.0, 10.0, 0.0, 0.0, sign * ukf.SMALL_ANGLE * factor])
        ukf.turn_(p, 1.0)
        ways.append(p)
    np.testing.assert_allclose(ways[0][:4], ways[1][:4], rtol=0, atol=1e-11)
    assert ways[0][2] == pytest.approx(sign * 10.0 * ukf.SMALL_ANGLE / 2, rel=1e-8)


# Angles


@given(st.floats(-3.0, 3.0), st.integers(-5, 5))
def test_wrap_takes_off_whole_turns(angle, turns):
    assert ukf.wrap(angle + 2.0 * np.pi * turns) == pytest.approx(angle, abs=1e-12)


def test_wrap_at_half_a_turn():
    assert ukf.wrap(np.pi) == -np.pi
    assert ukf.wrap(-np.pi) == -np.pi
    assert ukf.wrap(3.14159) == pytest.approx(3.14159)


def corrected(par, x, P, places, z, r):
    n = len(places)
    x, P = x.copy(), P.copy()
    log_l = ukf.correct_(par, x, P, n, places, z, r, *scratch(n))
    return x, P, log_l


@pytest.mark.parametrize("turn", [0.3, 1.57, 2.9, 3.1, 3.14159, -2.2])
def test_turning_the_whole_scene_turns_the_answer(turn):
    """Behind the lidar the bearing jumps by a whole turn between one side and the other."""
    par = parameters()
    rng = np.random.default_rng(4)
    x = np.array([30.0, 3.0, 0.5, 12.0, 0.1])
    P = random_covariance(rng, 5) * 0.01
    places = np.array([[0.0, 0.0], [55.0, 1.0]])
    z = book.measure(x, places).reshape(2, 2) + rng.normal(size=(2, 2)) * 0.05
    r = np.full((2, 2), 0.05**2)
    x1, P1, log_1 = corrected(par, x, P, places, z, r)

    c, s = np.cos(turn), np.sin(turn)
    T = np.eye(5)
    T[np.ix_([0, 2], [0, 2])] = T[np.ix_([1, 3], [1, 3])] = [[c, -s], [s, c]]
    z2 = z + np.array([0.0, turn])
    z2[:, 1] = book.wrapped(z2[:, 1])
    # sigma points of a turned covariance are not turned sigma points: equal up to third moments
    x2, P2, log_2 = corrected(par, T @ x, T @ P @ T.T, places @ T[np.ix_([0, 2], [0, 2])].T, z2, r)
    np.testing.assert_allclose(x2, T @ x1, rtol=0, atol=1e-4)
    np.testing.assert_allclose(P2, T @ P1 @ T.T, rtol=0, atol=1e-4)
    assert log_2 == pytest.approx(log_1, abs=0.01)


def test_a_bearing_may_be_given_with_any_number_of_turns():
    par = parameters()
    rng = np.random.default_rng(5)
    x, P = random_state(rng)
    places = random_places(rng, 2)
    z = book.measure(x, places).reshape(2, 2) + 0.01
    r = np.full((2, 2), 0.0025)
    there = corrected(par, x, P, places, z, r)
    again = corrected(par, x, P, places, z + np.array([0.0, 2.0 * np.pi]), r)
    np.testing.assert_allclose(again[0], there[0], rtol=0, atol=1e-9)


# One filter


@pytest.mark.parametrize("lidars", [0, 1, 2, 3, 7])
@pytest.mark.parametrize("kind", [ukf.CV, ukf.CT])
@pytest.mark.parametrize(
    "spread", [(1.0, 0.0, 0.0), (0.5, 2.0, 1.0), (1.0, 0.0, -2.0)], ids=["cubature", "scaled", "3"]
)
def test_one_step_is_filterpys(kind, lidars, spread):
    alpha, beta, kappa = spread
    par = parameters((kind,), ((1.0,),), alpha=alpha, beta=beta, kappa=kappa)
    rng = np.random.default_rng(100 * lidars + kind)
    for _ in range(5):
        x, P = random_state(rng)
        places = random_places(rng, lidars)
        truth = rng.multivariate_normal(x, P)
        z = book.measure(truth, places).reshape(-1, 2) + rng.normal(size=(lidars, 2)) * 0.05
        r = rng.uniform(0.001, 0.01, (lidars, 2))
        f = book.cv if kind == ukf.CV else book.ct
        expected = book.filterpy_step(
            x, P, f, book.noise(0.3, 0.01, 0.1), 0.1, places, z, r, spread
        )
        points, L, *rest = scratch(lidars)
        assert ukf.predict_(par, 0, x, P, 0.1, points, L)
        if lidars:
            log_l = ukf.correct_(par, x, P, lidars, places, z, r, points, L, *rest)
            assert log_l == pytest.approx(expected[2], abs=1e-7)
        np.testing.assert_allclose(x, expected[0], rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(P, expected[1], rtol=0, atol=TOLERANCE)
        assert np.array_equal(P, P.T)


def test_the_order_of_the_lidars_does_not_matter():
    par = parameters()
    rng = np.random.default_rng(6)
    x, P = random_state(rng)
    places = random_places(rng, 4)
    z = book.measure(x, places).reshape(4, 2) + rng.normal(size=(4, 2)) * 0.05
    r = rng.uniform(0.001, 0.01, (4, 2))
    one = corrected(par, x, P, places, z, r)
    order = [2, 0, 3, 1]
    other = corrected(par, x, P, places[order], z[order], r[order])
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-9)


@pytest.mark.parametrize("broken", ["covariance", "nan", "inf"])
def test_what_has_no_root_is_refused_and_left_alone(broken):
    par = parameters()
    x, P = random_state(np.random.default_rng(7))
    if broken == "covariance":
        P[2, 2] = -1.0
    else:
        P[3, 3] = float(broken)
    before = x.copy(), P.copy()
    places, z, r = np.zeros((1, 2)), np.array([[10.0, 0.1]]), np.full((1, 2), 0.01)
    points, L, *rest = scratch(1)
    assert np.isnan(ukf.correct_(par, x, P, 1, places, z, r, points, L, *rest))
    assert not ukf.predict_(par, 0, x, P, 0.1, points, L)
    assert np.array_equal(x, before[0])
    assert np.array_equal(P, before[1], equal_nan=True)


def test_a_measurement_that_is_not_finite_is_refused_and_left_alone():
    par = parameters()
    x, P = random_state(np.random.default_rng(8))
    before = x.copy()
    z = np.array([[np.nan, 0.1]])
    assert np.isnan(
        ukf.correct_(par, x, P, 1, np.zeros((1, 2)), z, np.full((1, 2), 0.01), *scratch(1))
    )
    assert np.array_equal(x, before)


def test_distances_are_chi_square_where_the_prediction_is_right():
    par = parameters()
    rng = np.random.default_rng(9)
    x = np.array([20.0, 10.0, 20.0, 0.0, 0.0])
    P = random_covariance(rng, 5) * 0.05
    places = np.array([[0.0, 0.0], [50.0, 0.0]])
    r = np.full((2, 2), 0.05**2)
    points, L, seen, mean, _, _ = scratch(2)
    found = []
    for truth in rng.multivariate_normal(x, P, 2000):
        z = book.measure(truth, places).reshape(2, 2) + rng.normal(size=(2, 2)) * 0.05
        d2 = np.zeros(2)
        assert ukf.surprise_(par, x, P, 2, places, z, r, d2, points, L, seen, mean)
        found.append(d2)
    np.testing.assert_allclose(np.mean(found, axis=0), 2.0, atol=0.15)
    np.testing.assert_allclose(np.mean(np.array(found) > 9.21, axis=0), 0.01, atol=0.007)


# The IMM

PI = ((0.9, 0.07, 0.03), (0.2, 0.75, 0.05), (0.04, 0.16, 0.8))
KINDS = (ukf.CV, ukf.CT, ukf.CT)


@pytest.mark.parametrize("lidars", [0, 1, 3])
def test_a_chain_of_cycles_is_the_textbooks(lidars):
    par = parameters(KINDS, PI)
    rng = np.random.default_rng(10 + lidars)
    track, work = np.zeros(1, ukf.TRACK_DTYPE)[0], np.zeros(1, ukf.SCRATCH_DTYPE)[0]
    mu = np.array([0.5, 0.3, 0.2])
    xs, Ps = [], []
    start, _ = random_state(rng)
    for j in range(3):
        xs.append(start + 0.2 * rng.normal(size=5))
        Ps.append(random_covariance(rng, 5) * 0.2)
        track["x"][j], track["P"][j], track["mu"][j] = xs[j], Ps[j], mu[j]
    entries = list(zip(par["entry_mean"], par["entry_var"], strict=True))
    _, _, *rest = scratch(lidars)
    places = random_places(rng, lidars)
    truth = start
    for _ in range(6):
        truth = book.ct(truth, 0.1)
        z = book.measure(truth, places).reshape(-1, 2) + rng.normal(size=(lidars, 2)) * 0.05
        r = np.full((lidars, 2), 0.05**2)

        def step(j, z=z, r=r):
            f = book.cv if KINDS[j] == ukf.CV else book.ct
            Q = book.noise(par["q"][j], par["q_omega"][j], 0.1)
            return lambda x, P: book.filterpy_step(x, P, f, Q, 0.1, places, z, r)

        xs, Ps, mu, (mean, cov) = book.imm_cycle(xs, Ps, mu, PI, entries, [*map(step, range(3))])
        assert ukf.advance_(par, track, work, 0.1)
        if lidars:
            assert ukf.update_(par, track, work, lidars, places, z, r, *rest)
        np.testing.assert_allclose(track["mu"][:3], mu, rtol=0, atol=1e-8)
        np.testing.assert_allclose(track["mean"], mean, rtol=0, atol=1e-8)
        np.testing.assert_allclose(track["cov"], cov, rtol=0, atol=1e-8)


def test_the_table_is_read_at_the_elapsed_steps_from_i_to_j():
    par = parameters((ukf.CV, ukf.CV), ((1.0, 0.0), (0.0, 1.0)))
    par["Pi"][7, :2, :2] = [[0.9, 0.1], [0.0, 1.0]]
    par["Pi"][ukf.MAX_STEPS - 1, :2, :2] = [[0.25, 0.75], [0.0, 1.0]]
    track, work = np.zeros(1, ukf.TRACK_DTYPE)[0], np.zeros(1, ukf.SCRATCH_DTYPE)[0]
    for dt, expected in ((0.0, 1.0), (0.03, 1.0), (0.0701, 0.9), (0.0699, 0.9), (60.0, 0.25)):
        ukf.begin_(par, track, np.zeros(2), np.array([9.0, 1.0]), np.full(2, 0.01), 4.0)
        track["mu"][:2] = 1.0 - 1e-12, 1e-12
        assert ukf.advance_(par, track, work, dt)
        assert track["mu"][0] == pytest.approx(expected, abs=1e-6)


def test_a_model_keeps_the_floor_of_its_probability():
    par = parameters()
    par["q"][:2] = 1e-6
    par["mu_floor"] = 1e-3
    track, work = np.zeros(1, ukf.TRACK_DTYPE)[0], np.zeros(1, ukf.SCRATCH_DTYPE)[0]
    place, r = np.zeros((1, 2)), np.full((1, 2), 1e-6)
    ukf.begin_(par, track, place[0], np.array([20.0, 0.0]), r[0], 1e-4)
    track["x"][1, 0] += 5.0
    track["P"][1] = np.eye(5) * 1e-6
    _, _, *rest = scratch(1)
    assert ukf.update_(par, track, work, 1, place, np.array([[20.0, 0.0]]), r, *rest)
    assert track["mu"][1] == pytest.approx(1e-3 / (1.0 + 1e-3), rel=1e-6)
    assert track["mu"][:2].sum() == pytest.approx(1.0)


def test_a_track_begins_where_many_noisy_detections_lie():
    par = parameters()
    track = np.zeros(1, ukf.TRACK_DTYPE)[0]
    place, z, r = np.array([3.0, -4.0]), np.array([50.0, 2.2]), np.array([0.3, 0.05]) ** 2
    ukf.begin_(par, track, place, z, r, 100.0)
    rng = np.random.default_rng(11)
    distance = z[0] + 0.3 * rng.normal(size=200_000)
    bearing = z[1] + 0.05 * rng.normal(size=200_000)
    cloud = np.stack([place[0] + distance * np.cos(bearing), place[1] + distance * np.sin(bearing)])
    np.testing.assert_allclose(track["mean"][[0, 2]], cloud.mean(axis=1), atol=0.08)
    np.testing.assert_allclose(
        track["cov"][np.ix_([0, 2], [0, 2])], np.cov(cloud), rtol=0.03, atol=0.05
    )
    assert np.diagonal(track["cov"])[[1, 3]] == pytest.approx(100.0)
    assert track["mean"][1] == track["mean"][3] == 0.0
