"""The log likelihood of every kind of mode against numerical integration of its definition.

L = int N(z; H x, R) phi(x) N(x; x-, P-) dx / int phi(x) N(x; x-, P-) dx
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from oracles import gaussian
from oracles.gaussian import random_covariance
from scipy.stats import norm
from small_banks import add_bound, add_soft, blank

from can_imm.estimation import imm, layout, modes

INF = math.inf
VALID_2 = np.array([True, True, False, False])


def log_likelihood(bank, x, P, z, r, valid=VALID_2, age=0.0, lane_width=3.0):
    """Of mode 0 by the kernel; also the updated mean and covariance."""
    n = int(bank[0]["n_states"])
    work = np.zeros(1, layout.WORK_DTYPE)
    work[0]["lane_width"] = lane_width
    x, P = x.copy(), P.copy()
    log_l = imm.update_mode_(n, bank[0], work[0], 0, x, P, z, r, valid, age)
    return log_l, x, P


def soft_factor(rows: list[tuple[int, float, float]]) -> Callable[[np.ndarray], np.ndarray]:
    """phi of soft rows (state, value, r), up to a constant."""
    return lambda p: np.exp(-sum((p[..., s] - d) ** 2 / (2.0 * r) for s, d, r in rows))


def definition(x, P, z, r, H, phi, low, high):
    """Log L, mean and covariance by brute force over the box low, high."""

    def both(p: np.ndarray) -> np.ndarray:
        e = z - p @ H.T
        g = np.exp(-0.5 * (e**2 / r).sum(-1)) / np.sqrt(np.prod(2.0 * np.pi * r))
        return phi(p) * g

    mass, mean, cov = gaussian.integrate_2d(x, P, both, low, high)
    return math.log(mass / gaussian.integrate_2d(x, P, phi, low, high)[0]), mean, cov


X = np.array([0.4, -0.3])
COV = np.array([[0.8, 0.35], [0.35, 0.6]])
Z, R = np.array([0.9, 0.2]), np.array([0.3, 0.25])

CASES = {
    "nothing": ([], []),
    "one soft row": ([(1, 0.5, 0.3)], []),
    "two soft rows": ([(0, -0.2, 0.4), (1, 0.5, 0.3)], []),
    "bound below": ([], [(1, 0.3, INF)]),
    "bound above": ([], [(0, -INF, 0.1)]),
    "interval": ([], [(0, 0.2, 0.9)]),
    "narrow interval": ([], [(0, 0.6, 0.61)]),
    "interval far from the prior": ([], [(1, 3.0, 4.0)]),
    "soft row, then interval": ([(0, 0.7, 0.2)], [(0, -0.1, 0.8)]),
    "soft row on the other state": ([(0, 0.7, 0.2)], [(1, 0.1, INF)]),
    "two soft rows, interval": ([(0, 0.7, 0.2), (1, -0.4, 0.5)], [(1, -0.5, 0.2)]),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("mass", [False, True])
@pytest.mark.parametrize("age", [0.0, 0.2])
def test_likelihood_and_moments(case: str, mass: bool, age: float) -> None:
    """A ``mass`` bound counts in the transition and so is divided by here like any other."""
    soft, bounds = CASES[case]
    bank = blank(1, 2)
    low, high = [-INF, -INF], [INF, INF]
    for row in soft:
        add_soft(bank, 0, *row)
    for s, a, b in bounds:
        add_bound(bank, 0, s, a, b, mass=mass)
        low[s], high[s] = a, b
    H = np.array([[1.0, -age], [0.0, 1.0]])
    expected, mean, cov = definition(X, COV, Z, R, H, soft_factor(soft), low, high)
    z, r = np.append(Z, [np.nan, np.nan]), np.append(R, [1.0, 1.0])
    log_l, x, P = log_likelihood(bank, X, COV, z, r, age=age)
    assert log_l == pytest.approx(expected, rel=1e-6, abs=1e-6)
    np.testing.assert_allclose(x, mean, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(P, cov, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("low", "high"), [(0.3, INF), (-INF, -0.2), (0.6, 0.9), (-0.5, 0.2)])
def test_projected_bounds(low: float, high: float) -> None:
    """The likelihood is that of the interval; the estimate is projected where it lies outside."""
    bank = blank(1, 2)
    bank[0]["is_projected"][0] = 1
    add_bound(bank, 0, 1, low, high)
    box = [-INF, low], [INF, high]
    expected, _, _ = definition(X, COV, Z, R, np.eye(2), soft_factor([]), *box)
    z, r = np.append(Z, [0.0, 0.0]), np.append(R, [1.0, 1.0])
    log_l, x, P = log_likelihood(bank, X, COV, z, r)
    assert log_l == pytest.approx(expected, rel=1e-6)
    free_x, free_P, _, _ = gaussian.update(X, COV, np.eye(2), np.diag(R), Z)
    if low <= free_x[1] <= high:
        expected_x, expected_P = free_x, free_P
    else:
        D = gaussian.selection(2, [1])
        edge = [low if free_x[1] < low else high]
        expected_x, expected_P = gaussian.project(free_x, free_P, D, np.array(edge))
    np.testing.assert_allclose(x, expected_x, rtol=1e-9)
    np.testing.assert_allclose(P, expected_P, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("project", [False, True])
def test_all_kinds_on_independent_axes(project: bool) -> None:
    """Four states, a soft row and a bound on each axis: the product of two integrals."""
    bank = blank(1, 4)
    bank[0]["is_projected"][0] = project
    add_soft(bank, 0, 0, 0.3, 0.5)
    add_soft(bank, 0, 3, 0.1, 0.2)
    add_bound(bank, 0, 1, 0.2, INF, mass=True)
    add_bound(bank, 0, 2, -0.4, 0.7)
    other_x, other_P = np.array([-0.1, 0.5]), np.array([[0.5, -0.2], [-0.2, 0.9]])
    other_z, other_r = np.array([0.3, -0.2]), np.array([0.2, 0.6])
    P = np.zeros((4, 4))
    P[:2, :2], P[2:, 2:] = COV, other_P
    log_l, *_ = log_likelihood(
        bank,
        np.append(X, other_x),
        P,
        np.append(Z, other_z),
        np.append(R, other_r),
        np.ones(4, np.bool_),
    )
    H = np.eye(2)
    low, high = [-INF, 0.2], [INF, INF]
    along, _, _ = definition(X, COV, Z, R, H, soft_factor([(0, 0.3, 0.5)]), low, high)
    low, high = [-0.4, -INF], [0.7, INF]
    phi = soft_factor([(1, 0.1, 0.2)])
    across, _, _ = definition(other_x, other_P, other_z, other_r, H, phi, low, high)
    expected = along + across
    assert log_l == pytest.approx(expected, rel=1e-6)


def test_modes_with_other_constraints_stay_comparable() -> None:
    """A constraint that says nothing must not change the likelihood: no units, no dimensions."""
    z, r = np.append(Z, [0.0, 0.0]), np.append(R, [1.0, 1.0])
    free, *_ = log_likelihood(blank(1, 2), X, COV, z, r)
    bank = blank(1, 2)
    add_soft(bank, 0, 0, 50.0, 1e12)
    add_bound(bank, 0, 1, -1e3, 1e3)
    assert log_likelihood(bank, X, COV, z, r)[0] == pytest.approx(free, abs=1e-8)


@pytest.mark.parametrize(
    ("y", "lanes", "centre"),
    [
        (0.2, (0, 1), 0.0), (1.7, (0, 1), 0.0), (1.8, (0, 1), 3.5), (9.0, (0, 1), 3.5),
        (-4.0, (0, 1), 0.0), (-4.0, (-1, 1), -3.5), (0.0, (1, 3), 3.5), (8.0, (1, 3), 7.0),
    ],
)  # fmt: skip
def test_rows_count_from_the_nearest_lane(y: float, lanes: tuple[int, int], centre: float) -> None:
    """Lanes of 3.5 m: the border between lanes 0 and 1 lies at 1.75 m."""
    x = np.array([0.0, 0.0, y, 0.0])
    z, r, valid = x.copy(), np.full(4, 0.3), np.ones(4, np.bool_)
    logs = []
    for shift, where in ((0.0, lanes), (centre, None)):
        bank = blank(1, 4)
        add_soft(bank, 0, 2, shift + 0.2, 0.1, where)
        add_bound(bank, 0, 2, shift - 0.6, shift + 0.5, lanes=where)
        logs.append(log_likelihood(bank, x, np.eye(4), z, r, valid, lane_width=3.5))
    assert logs[0][0] == pytest.approx(logs[1][0], abs=1e-12)
    np.testing.assert_allclose(logs[0][1], logs[1][1], atol=1e-12)


def test_missing_components_drop_out_of_the_density() -> None:
    x, P = np.array([1.0, 2.0, 3.0, 4.0]), np.diag([1.0, 2.0, 3.0, 4.0])
    z, r = np.array([1.5, np.nan, 2.0, np.nan]), np.full(4, 0.5)
    log_l, *_ = log_likelihood(blank(1, 4), x, P, z, r, np.array([True, False, True, False]))
    expected = norm.logpdf(0.5, scale=math.sqrt(1.5)) + norm.logpdf(1.0, scale=math.sqrt(3.5))
    assert log_l == pytest.approx(expected, rel=1e-12)


def test_a_bound_out_of_reach_makes_the_mode_impossible() -> None:
    bank = blank(1, 2)
    add_bound(bank, 0, 0, 1e4, 2e4)
    z, r = np.append(Z, [0.0, 0.0]), np.append(R, [1.0, 1.0])
    log_l, x, P = log_likelihood(bank, X, COV, z, r)
    assert log_l == layout.LOG_FLOOR
    assert np.isfinite(x).all()
    assert np.linalg.eigvalsh(P).min() > -1e-9


def test_a_numeric_failure_is_a_nan() -> None:
    P = COV.copy()
    P[0, 0] = -5.0
    z, r = np.append(Z, [0.0, 0.0]), np.append(R, [1.0, 1.0])
    assert np.isnan(log_likelihood(blank(1, 2), X, P, z, r)[0])
    bank = blank(1, 2)
    add_soft(bank, 0, 0, 0.0, 1.0)
    assert np.isnan(log_likelihood(bank, X, P, z, r)[0])


# ---- what a mode can say at most


def limit(bank, z, r, valid, age=0.0, angle=0.0) -> float:
    """Of mode 0, over the peak density of the measurement."""
    work = np.zeros(1, layout.WORK_DTYPE)
    work[0]["lane_width"], work[0]["angle"] = 3.0, angle
    return modes.region_limit(bank[0], work[0], 0, z, r, valid, age)


@settings(max_examples=200)
@given(
    st.integers(0, 2**32 - 1), st.integers(4, 6), st.booleans(), st.sampled_from([0.0, 0.02, 0.1])
)
def test_no_mode_says_more_than_its_bounds_allow(
    seed: int, n: int, projected: bool, age: float
) -> None:
    rng = np.random.default_rng(seed)
    bank = blank(1, n)
    bank[0]["is_projected"][0] = projected
    low, width = rng.normal(0.0, 10.0), rng.choice([0.5, 5.0, INF])
    low, high = (low, low + width) if rng.random() < 0.5 else (low - width, low)
    add_bound(bank, 0, int(rng.integers(n)), low, high)
    add_soft(bank, 0, int(rng.integers(4)), rng.normal(0.0, 5.0), 0.5)
    x, P = rng.normal(0.0, 5.0, n), random_covariance(rng, n)
    z, r = rng.normal(0.0, 15.0, 4), rng.uniform(0.05, 2.0, 4)
    valid = rng.random(4) < 0.8
    valid[rng.integers(4)] = True
    at_most = limit(bank, z, r, valid, age)
    assume(at_most > -300.0)  # masses are clipped at exp(-700)
    peak = -0.5 * np.log(2.0 * np.pi * r[valid]).sum()
    log_l, _, _ = log_likelihood(bank, x, P, z, r, valid, age)
    assert log_l <= peak + at_most + 1e-9


def test_the_limit_is_the_distance_from_the_bounds() -> None:
    """In standard deviations of the measurement; what may have moved meanwhile does not count."""
    z, r, all_valid = np.array([50.0, 1.0, 0.0, 0.0]), np.full(4, 0.25), np.ones(4, np.bool_)
    bank = blank(1, 4)
    assert limit(bank, z, r, all_valid) == 0.0
    add_bound(bank, 0, 1, 4.0, INF)
    assert limit(bank, z, r, all_valid) == pytest.approx(-0.5 * 3.0**2 / 0.25)
    assert limit(bank, z, r, all_valid, age=0.05) == pytest.approx(-0.5 * 2.0**2 / 0.25)
    assert limit(bank, z, r, np.array([True, False, True, True])) == 0.0
    assert limit(bank, z, r, all_valid, angle=0.1) == 0.0
    add_bound(bank, 0, 0, -INF, 45.0)
    assert limit(bank, z, r, all_valid) == pytest.approx(-0.5 * 5.0**2 / 0.25)
    assert limit(bank, z, r, all_valid, age=0.02) == pytest.approx(-0.5 * 2.6**2 / 0.25)
    lane = blank(1, 4)
    add_bound(lane, 0, 2, 1.0, 1.5, lanes=(0, 1))
    assert limit(lane, z, r, all_valid) == 0.0
