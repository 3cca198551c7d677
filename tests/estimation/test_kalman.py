"""The Kalman kernels against filterpy's KalmanFilter."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.gaussian import random_covariance

from can_imm.estimation.kalman import log_normal, predict_, update_row_, update_state_
from can_imm.estimation.modes import correct_

SEEDS = st.integers(0, 2**32 - 1)
TOLERANCE = {"rtol": 1e-9, "atol": 1e-9}


class Problem:
    """A random Gaussian, motion and measurement; the kernel's arrays are larger than n."""

    def __init__(self, seed: int, n: int | None = None) -> None:
        rng = np.random.default_rng(seed)
        self.rng = rng
        self.n = n = n or int(rng.integers(1, 7))
        self.x = np.full(n + 1, 77.0)
        self.P = np.full((n + 1, n + 1), 77.0)
        self.x[:n] = rng.normal(0.0, 10.0, n)
        self.P[:n, :n] = random_covariance(rng, n)
        self.F = np.full((n + 1, n + 1), 77.0)
        self.F[:n, :n] = rng.normal(size=(n, n))
        self.Q = np.full((n + 1, n + 1), 77.0)
        self.Q[:n, :n] = random_covariance(rng, n)

    def filterpy(self, dim_z: int) -> KalmanFilter:
        n = self.n
        f = KalmanFilter(n, dim_z)
        f.x = self.x[:n].copy()
        f.P = self.P[:n, :n].copy()
        f.F = self.F[:n, :n].copy()
        f.Q = self.Q[:n, :n].copy()
        return f

    def check(self, f: KalmanFilter) -> None:
        n = self.n
        np.testing.assert_allclose(self.x[:n], f.x, **TOLERANCE)
        np.testing.assert_allclose(self.P[:n, :n], f.P, **TOLERANCE)
        np.testing.assert_array_equal(self.P[:n, :n], self.P[:n, :n].T)
        assert self.x[n] == 77.0
        assert np.all(self.P[n] == 77.0)
        assert np.all(self.P[:, n] == 77.0)


@given(SEEDS)
def test_predict(seed: int) -> None:
    p = Problem(seed)
    f = p.filterpy(1)
    f.predict()
    predict_(p.n, p.x, p.P, p.F, p.Q)
    p.check(f)


@given(SEEDS)
def test_row_by_row_equals_the_vector_update(seed: int) -> None:
    p = Problem(seed)
    dim_z = int(p.rng.integers(1, 5))
    f = p.filterpy(dim_z)
    f.H = p.rng.normal(size=(dim_z, p.n))
    f.R = np.diag(p.rng.uniform(0.05, 2.0, dim_z))
    z = f.H @ f.x + p.rng.normal(0.0, 2.0, dim_z)
    f.update(z)
    log_l = 0.0
    for c in range(dim_z):
        h = np.append(f.H[c], 77.0)
        e, s = update_row_(p.n, p.x, p.P, h, z[c], f.R[c, c])
        log_l += log_normal(e, s)
    p.check(f)
    assert log_l == pytest.approx(f.log_likelihood, rel=1e-9, abs=1e-9)


@given(SEEDS)
def test_single_states_equal_the_vector_update(seed: int) -> None:
    p = Problem(seed)
    states = p.rng.permutation(p.n)[: p.rng.integers(1, p.n + 1)]
    f = p.filterpy(len(states))
    f.H = np.eye(p.n)[states]
    f.R = np.diag(p.rng.uniform(0.05, 2.0, len(states)))
    z = f.H @ f.x + p.rng.normal(0.0, 2.0, len(states))
    f.update(z)
    log_l = 0.0
    for c, s in enumerate(states):
        log_l += log_normal(*update_state_(p.n, p.x, p.P, s, z[c], f.R[c, c]))
    p.check(f)
    assert log_l == pytest.approx(f.log_likelihood, rel=1e-9, abs=1e-9)


@given(SEEDS, st.sampled_from([1e-12, 1e-6, 1.0, 1e6]), st.integers(1, 40))
def test_covariance_stays_symmetric_and_positive(seed: int, r: float, times: int) -> None:
    p = Problem(seed)
    for _ in range(times):
        update_state_(p.n, p.x, p.P, int(p.rng.integers(p.n)), 0.0, r)
        P = p.P[: p.n, : p.n]
        np.testing.assert_array_equal(P, P.T)
        assert np.linalg.eigvalsh(P).min() >= -1e-12 * max(1.0, np.trace(P))


@pytest.mark.parametrize(
    ("z", "p00", "r"),
    [(np.nan, 1.0, 1.0), (np.inf, 1.0, 1.0), (0.0, -2.0, 1.0), (0.0, np.nan, 1.0), (0.0, 0.0, 0.0)],
)
def test_a_bad_update_is_flagged_and_touches_nothing(z: float, p00: float, r: float) -> None:
    x, P = np.array([1.0, 2.0]), np.array([[p00, 0.0], [0.0, 1.0]])
    for flag in (
        update_state_(2, x, P, 0, z, r)[1],
        update_row_(2, x, P, np.array([1.0, 0.0]), z, r)[1],
    ):
        assert np.isnan(flag)
        np.testing.assert_array_equal(x, [1.0, 2.0])
        np.testing.assert_array_equal(P, [[p00, 0.0], [0.0, 1.0]])


@settings(max_examples=60)
@given(SEEDS, st.integers(4, 6), st.integers(0, 15), st.sampled_from([0.0, 0.013, 0.2, -0.05]))
def test_measurement_with_missing_components_and_age(
    seed: int, n: int, mask: int, age: float
) -> None:
    p = Problem(seed, n)
    rng = p.rng
    valid = np.array([mask >> c & 1 for c in range(4)], np.bool_)
    H = np.zeros((4, n))
    H[range(4), range(4)] = 1.0
    H[0, 1] = H[2, 3] = -age
    for axis, a in enumerate(range(4, n)):
        H[2 * axis, a] = age**2 / 2
        H[2 * axis + 1, a] = -age
    z = rng.normal(0.0, 10.0, 4)
    r = rng.uniform(0.05, 2.0, 4)
    z[~valid] = np.nan
    f = p.filterpy(max(int(valid.sum()), 1))
    expected = 0.0
    if valid.any():
        f.H, f.R = H[valid], np.diag(r[valid])
        f.update(z[valid])
        expected = f.log_likelihood
    log_l = correct_(n, p.x, p.P, z, r, valid, age, 0.0)
    p.check(f)
    assert log_l == pytest.approx(expected, rel=1e-9, abs=1e-9)
