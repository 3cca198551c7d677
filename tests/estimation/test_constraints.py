"""Soft rows, projection and truncation against matrix forms, scipy and brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import gaussian
from scipy import integrate
from scipy.stats import norm

from can_imm.estimation.constraints import (
    LOG_MASS_FLOOR,
    log_upper_tail,
    project_,
    truncate_,
    truncated_normal,
)
from can_imm.estimation.kalman import update_state_

SEEDS = st.integers(0, 2**32 - 1)
TOLERANCE = {"rtol": 1e-9, "atol": 1e-9}


def problem(seed: int) -> tuple[np.random.Generator, int, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 7))
    return (
        rng,
        n,
        rng.normal(0.0, 3.0, n),
        gaussian.random_covariance(rng, n),
    )


@given(SEEDS)
def test_soft_rows_equal_rows_appended_to_the_measurement(seed: int) -> None:
    """Equations (22)(23): the pseudo-measurements stacked under z in one update."""
    rng, n, x, P = problem(seed)
    measured = rng.permutation(n)[: rng.integers(1, n + 1)].tolist()
    soft = rng.permutation(n)[: rng.integers(1, n + 1)].tolist()
    states = measured + soft
    f = KalmanFilter(n, len(states))
    f.x, f.P = x.copy(), P.copy()
    f.H = gaussian.selection(n, states)
    f.R = np.diag(rng.uniform(0.05, 2.0, len(states)))
    z = rng.normal(0.0, 3.0, len(states))
    f.update(z)
    for c in [*range(len(measured), len(states)), *range(len(measured))]:
        update_state_(n, x, P, states[c], z[c], f.R[c, c])
    np.testing.assert_allclose(x, f.x, **TOLERANCE)
    np.testing.assert_allclose(P, f.P, **TOLERANCE)


@given(SEEDS)
def test_projection_of_several_rows_is_the_closed_form(seed: int) -> None:
    """Equations (24) to (28) with W = P^-1."""
    rng, n, x, P = problem(seed)
    states = rng.permutation(n)[: rng.integers(1, n)].tolist()
    d = rng.normal(0.0, 3.0, len(states))
    expected_x, expected_P = gaussian.project(x, P, gaussian.selection(n, states), d)
    for s, value in zip(states, d, strict=True):
        assert project_(n, x, P, s, value, 0.0)
    np.testing.assert_allclose(x, expected_x, **TOLERANCE)
    np.testing.assert_allclose(P, expected_P, **TOLERANCE)
    np.testing.assert_array_equal(x[states], d)
    np.testing.assert_array_equal(P, P.T)


@given(SEEDS)
def test_projection_is_conditioning_on_a_noiseless_row(seed: int) -> None:
    rng, n, x, P = problem(seed)
    s, d = int(rng.integers(n)), float(rng.normal())
    y, C = x.copy(), P.copy()
    update_state_(n, y, C, s, d, 0.0)
    project_(n, x, P, s, d, 0.25)
    assert P[s, s] == 0.25, "the floor"
    P[s, s] = 0.0
    np.testing.assert_allclose(x, y, **TOLERANCE)
    np.testing.assert_allclose(P, C, **TOLERANCE)


@pytest.mark.parametrize("p", [0.0, -1.0, np.nan, np.inf])
def test_a_variance_that_is_none_is_flagged_and_touches_nothing(p: float) -> None:
    x, P = np.ones(2), np.array([[p, 0.0], [0.0, 1.0]])
    assert not project_(2, x, P, 0, 5.0, 1e-8)
    assert np.isnan(truncate_(2, x, P, 0, 2.0, 3.0, 1e-8))
    np.testing.assert_array_equal(x, [1.0, 1.0])
    np.testing.assert_array_equal(P, [[p, 0.0], [0.0, 1.0]])


def moments(a: float, b: float) -> tuple[float, float, float]:
    """Log mass, mean and variance of a standard normal in [a, b] by adaptive quadrature.

    Shifted to the end nearest to 0 and scaled to the density there, so that nothing cancels.
    """
    if a == -np.inf or (b < np.inf and a + b < 0):
        log_mass, mean, variance = moments(-b, -a)
        return log_mass, -mean, variance
    start, reach = (a, min(b - a, 40.0 / max(a, 1.0))) if a > 0 else (a, min(b, 12.0) - a)

    def density(t: float) -> float:
        return math.exp(-t * (start + 0.5 * t)) if a > 0 else math.exp(-0.5 * (start + t) ** 2)

    def integral(power: int, centre: float = 0.0) -> float:
        def f(u: float) -> float:
            return (u - centre) ** power * density(u * reach)

        return integrate.quad(f, 0.0, 1.0, epsabs=0.0, epsrel=1e-12, limit=400)[0]

    mass = integral(0)
    u = integral(1) / mass
    variance = integral(2, u) / mass * reach**2
    log_mass = math.log(mass * reach / math.sqrt(2.0 * math.pi))
    return log_mass - (0.5 * a * a if a > 0 else 0.0), start + u * reach, variance


ENDS = [
    -np.inf,
    -9.0,
    -5.0,
    -2.0,
    -0.3,
    0.0,
    0.7,
    1.9,
    4.99,
    5.0,
    5.01,
    6.5,
    10.0,
    15.0,
    30.0,
    36.0,
    np.inf,
]
INTERVALS = [(a, b) for a in ENDS for b in ENDS if a < b and (np.isfinite(a) or np.isfinite(b))]


@pytest.mark.parametrize(("a", "b"), INTERVALS)
def test_truncated_normal(a: float, b: float) -> None:
    expected = moments(a, b)
    log_mass, mean, variance = truncated_normal(a, b)
    assert log_mass == pytest.approx(expected[0], rel=1e-9, abs=1e-9)
    assert mean == pytest.approx(expected[1], rel=1e-9, abs=1e-9)
    assert variance == pytest.approx(expected[2], rel=1e-6)


def test_truncated_normal_without_bounds_is_the_normal() -> None:
    assert truncated_normal(-np.inf, np.inf) == (0.0, 0.0, 1.0)


@pytest.mark.parametrize("width", [1e-9, 1e-6, 1e-4, 1e-3, 1e-2, 0.03, 0.1, 0.5])
@pytest.mark.parametrize("a", [-35.0, -10.0, -4.0, -0.01, 0.0, 0.5, 3.0, 7.0, 20.0, 37.0])
def test_truncated_normal_in_narrow_intervals(a: float, width: float) -> None:
    b = a + width
    width = b - a
    log_mass, mean, variance = truncated_normal(a, b)
    expected = moments(a, b)
    assert log_mass == pytest.approx(max(expected[0], LOG_MASS_FLOOR), rel=1e-8, abs=1e-8)
    assert a <= mean <= b
    if log_mass == LOG_MASS_FLOOR:
        return
    assert mean - a == pytest.approx(expected[1] - a, abs=1e-5 * width)
    assert variance == pytest.approx(expected[2], rel=1e-5)


@pytest.mark.parametrize("a", [38.0, 60.0, 200.0])
@pytest.mark.parametrize("width", [1e-3, 1.0, np.inf])
def test_truncated_normal_beyond_the_floor(a: float, width: float) -> None:
    """So far out the mass is clipped and the point nearest to 0 stands for the interval."""
    assert truncated_normal(a, a + width) == (LOG_MASS_FLOOR, a, 0.0)
    assert truncated_normal(-a - width, -a) == (LOG_MASS_FLOOR, -a, 0.0)
    # what it stands for is near
    assert abs(moments(a, a + width)[1] - a) < 0.03


@given(st.floats(-300.0, 300.0), st.floats(0.0, 600.0, exclude_min=True) | st.just(np.inf))
def test_truncated_normal_is_always_sane(a: float, width: float) -> None:
    b = a + width
    if not a < b:
        return
    log_mass, mean, variance = truncated_normal(a, b)
    assert LOG_MASS_FLOOR <= log_mass <= 0.0
    assert a <= mean <= b
    assert 0.0 <= variance <= min(1.0, (b - a) ** 2 / 12.0 * (1.0 + 1e-6))
    mirrored = truncated_normal(-b, -a)
    assert mirrored == pytest.approx((log_mass, -mean, variance), rel=1e-12, abs=1e-300)


@pytest.mark.parametrize("a", [-40.0, -8.0, 0.0, 4.999, 5.0, 5.001, 12.0, 37.0, 39.0, 200.0, 1e5])
def test_log_upper_tail(a: float) -> None:
    assert log_upper_tail(a) == pytest.approx(norm.logsf(a), rel=1e-11, abs=1e-15)


@settings(max_examples=40)
@given(SEEDS)
def test_truncation_equals_brute_force_in_two_dimensions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, P = rng.normal(0.0, 2.0, 2), gaussian.random_covariance(rng, 2)
    s = int(rng.integers(2))
    low = x[s] + math.sqrt(P[s, s]) * rng.uniform(-3.0, 3.0)
    high = low + math.sqrt(P[s, s]) * rng.uniform(0.1, 3.0)
    if rng.random() < 0.3:
        high = np.inf
    box = [-np.inf, -np.inf], [np.inf, np.inf]
    box[0][s], box[1][s] = low, high
    mass, mean, cov = gaussian.integrate_2d(x, P, lambda p: np.ones(p.shape[:-1]), *box)
    log_mass = truncate_(2, x, P, s, low, high, 1e-12)
    assert log_mass == pytest.approx(math.log(mass), rel=1e-6, abs=1e-6)
    np.testing.assert_allclose(x, mean, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(P, cov, rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(P, P.T)


def test_truncation_keeps_the_floor() -> None:
    x, P = np.zeros(2), np.array([[1.0, 0.9], [0.9, 1.0]])
    assert truncate_(2, x, P, 0, 40.0, 41.0, 0.01) == LOG_MASS_FLOOR
    assert x == pytest.approx([40.0, 36.0])
    assert P[0, 0] == pytest.approx(0.01)
    assert np.linalg.eigvalsh(P).min() > 0.0


@given(SEEDS, st.floats(-60.0, 60.0), st.floats(1e-3, 60.0))
def test_truncation_leaves_a_covariance(seed: int, low: float, width: float) -> None:
    rng, n, x, P = problem(seed)
    s = int(rng.integers(n))
    truncate_(n, x, P, s, low, low + width, 1e-8)
    assert np.isfinite(x).all()
    np.testing.assert_array_equal(P, P.T)
    assert np.linalg.eigvalsh(P).min() >= -1e-12 * np.trace(P)
