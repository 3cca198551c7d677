"""The backward pass against filterpy's smoother and against the exact one by enumeration."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.gaussian import random_covariance
from oracles.imm import Imm, enter
from oracles.smoother import LinearMode, enumerate_sequences
from small_banks import Runner, add_bound, add_soft, blank, copy_state, random_pair

from can_imm.estimation import imm
from can_imm.estimation.smoother import smooth_
from can_imm.estimation.smoother_pairs import (
    SMOOTHER_DTYPE,
    eigen_,
    enter_pair_,
    factor_,
    move_pair_,
)

SEEDS = st.integers(0, 2**32 - 1)
R = np.array([0.3, 0.2, 0.4, 0.5])
STEPS = 5


class Recorder:
    """What the filter thinks of the object in slot 0, time by time."""

    def __init__(self, runner: Runner) -> None:
        self.runner = runner
        record = runner.bank[0]
        self.shape = int(record["n_modes"]), int(record["n_states"])
        self.rows: list[tuple[Any, ...]] = []
        self.take(-1)

    def take(self, steps: int) -> None:
        m, n = self.shape
        obj = self.runner.objects[0]
        arrays = obj["x"][:m, :n], obj["P"][:m, :n, :n], obj["mu"][:m], obj["Pi"][:m, :m]
        mean = obj["mean"][:n], obj["cov"][:n, :n]
        self.rows.append((*(a.copy() for a in (*arrays, *mean)), steps))

    def scan(self, z: Any, r: Any = R, valid: Any = None) -> None:
        assert self.runner.scan([0], [STEPS], z, r, valid)[0] == imm.OK
        self.take(STEPS)

    def coast(self) -> None:
        """A row without a measurement; what stands there must not matter."""
        self.rows.append((*(np.full_like(a, np.nan) for a in self.rows[-1][:-1]), 0))

    def smooth(self, trust: float = 1.0) -> tuple[Any, Any, Any]:
        """Smoothed p (K, M), mean (K, n), cov (K, n, n)."""
        m, n = self.shape
        count = len(self.rows)
        x, P, mu, Pi = (np.array([row[k] for row in self.rows]) for k in range(4))
        steps = np.array([row[6] for row in self.rows], np.int32)
        mean, cov, p = np.zeros((count, n)), np.zeros((count, n, n)), np.zeros((count, m))
        work = np.zeros(1, SMOOTHER_DTYPE)
        work.view(np.uint8)[:] = 0x5A  # scratch carries nothing over
        smooth_(self.runner.bank, 0, count, x, P, mu, Pi, steps, trust, mean, cov, p, work)
        return p, mean, cov


# ---- one mode


@settings(max_examples=15)
@given(SEEDS, st.integers(4, 6), st.sampled_from([0.0, 0.3, 1.0]))
def test_one_mode_equals_filterpy(seed: int, n: int, trust: float) -> None:
    _, runner, oracle = random_pair(seed, 1, n)
    mode = oracle.modes[0]
    f = KalmanFilter(n, 4)
    f.x, f.P, f.F, f.Q = oracle.x[0].copy(), oracle.P[0].copy(), mode.F, mode.Q
    f.H, f.R = np.eye(n)[:4], np.diag(R)
    xs, Ps = [f.x.copy()], [f.P.copy()]
    recorder = Recorder(runner)
    rng = np.random.default_rng(seed + 1)
    for _ in range(30):
        z = rng.normal(0.0, 2.0, 4)
        recorder.scan(z)
        f.predict()
        f.update(z)
        xs.append(f.x.copy())
        Ps.append(f.P.copy())
    expected_x, expected_P, _, _ = f.rts_smoother(np.array(xs), np.array(Ps))
    p, mean, cov = recorder.smooth(trust)
    np.testing.assert_array_equal(p, 1.0)
    np.testing.assert_allclose(mean, expected_x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(cov, expected_P, rtol=1e-9, atol=1e-9)


@settings(max_examples=15)
@given(SEEDS, st.integers(4, 6))
def test_one_mode_never_knows_less_afterwards(seed: int, n: int) -> None:
    _, runner, _ = random_pair(seed, 1, n)
    recorder = Recorder(runner)
    rng = np.random.default_rng(seed + 1)
    for _ in range(20):
        valid = rng.random(4) < 0.7
        valid[rng.integers(4)] = True
        recorder.scan(rng.normal(0.0, 2.0, 4), valid=valid)
    _, _, cov = recorder.smooth()
    filtered = np.array([row[5] for row in recorder.rows])
    traces = np.trace(cov, axis1=1, axis2=2), np.trace(filtered, axis1=1, axis2=2)
    assert (traces[0] <= traces[1] * (1.0 + 1e-12)).all()


def test_rows_without_a_measurement_are_left_out() -> None:
    _, one, _ = random_pair(3, 3, 4)
    _, two, _ = random_pair(3, 3, 4)
    plain, gaps = Recorder(one), Recorder(two)
    rng = np.random.default_rng(0)
    for k in range(6):
        z = rng.normal(0.0, 1.0, 4)
        plain.scan(z)
        if k in (2, 3):
            gaps.coast()
        gaps.scan(z)
    gaps.coast()
    for a, b in zip(plain.smooth(), gaps.smooth(), strict=True):
        np.testing.assert_array_equal(a, b[[0, 1, 2, 4, 6, 7, 8]])


# ---- several modes


def switching(seed: int, n_modes: int, count: int) -> tuple[Recorder, Any]:
    """A random walk through quiet, wild and half wild modes that begin with speeds of their own,
    filtered; and the exact answer."""
    rng = np.random.default_rng(seed)
    tau, r = 0.5, 0.3 * R**2
    F = np.eye(4)
    F[0, 1] = F[2, 3] = tau
    bank = blank(n_modes, 4)
    record = bank[0]
    modes = []
    entries = ((0.0, 0.04), (3.0, 0.3), (-3.0, 0.3))
    for j, q in enumerate((0.02, 4.0, 0.5)[:n_modes]):
        block = q * np.array([[tau**3 / 3, tau**2 / 2], [tau**2 / 2, tau]])
        Q = np.kron(np.eye(2), block)
        record["F"][STEPS, j, :4, :4], record["Q"][STEPS, j, :4, :4] = F, Q
        record["entry_mean"][j, 3], record["entry_var"][j, 3] = entries[j]
        for i in range(n_modes):
            record["entry_sources"][i, j] = 0 if i == j else 1 << 3
        modes.append(LinearMode(F, Q, {3: entries[j]}))
    Pi = np.full((n_modes, n_modes), 0.1 / (n_modes - 1))
    np.fill_diagonal(Pi, 0.9)
    record["Pi"][STEPS, :n_modes, :n_modes] = Pi
    xs = [np.array([10.0, 0.0, 0.0, entry[0]]) for entry in entries[:n_modes]]
    Ps = [0.1 * np.eye(4)] * n_modes
    mu = np.full(n_modes, 1.0 / n_modes)
    j = int(rng.integers(n_modes))
    x, z = rng.multivariate_normal(xs[j], Ps[j]), []
    for _ in range(count - 1):
        i, j = j, int(rng.choice(n_modes, p=Pi[j]))
        if i != j:
            x[3] = rng.normal(entries[j][0], np.sqrt(entries[j][1]))
        x = F @ x + rng.multivariate_normal(np.zeros(4), modes[j].Q)
        z.append(x + rng.normal(size=4) * np.sqrt(r))
    runner = Runner(bank, 1)
    copy_state(Imm([], xs, Ps, mu), runner.objects[0])
    recorder = Recorder(runner)
    for one in z:
        recorder.scan(one, r)
    return recorder, enumerate_sequences(modes, xs, Ps, mu, Pi, np.eye(4), np.diag(r), np.array(z))


@pytest.mark.parametrize("n_modes", [2, 3])
def test_several_modes_are_near_the_exact_mixture(n_modes: int) -> None:
    """All sequences of modes, 2^6 and 3^6.

    The filter replaces a mixture by one Gaussian per mode, and so does the smoother; the modes are
    so different that this hardly matters.  Over these runs the largest error of a probability is
    0.008, without weighing the evidence (trust 0) it is 0.87.
    """
    errors, filtered, states = [], [], []
    for seed in range(20 if n_modes == 2 else 8):
        recorder, (p_exact, mean_exact, cov_exact) = switching(seed, n_modes, 6)
        p, mean, cov = recorder.smooth()
        errors.append(np.abs(p - p_exact).max())
        mu = np.array([row[2] for row in recorder.rows])
        filtered.append(np.abs(mu - p_exact).max())
        sd = np.sqrt(np.diagonal(cov_exact, axis1=1, axis2=2))
        states.append((np.abs(mean - mean_exact) / sd).max())
        np.testing.assert_allclose(cov, cov_exact, atol=0.15)
    assert max(errors) < 0.02
    assert np.mean(errors) < 0.002
    assert np.mean(filtered) > 0.2, "the filter alone is far from it"
    assert max(states) < 0.15


def test_without_trust_only_the_transitions_count() -> None:
    """Kim (1994): mu(i) = mu_k(i) sum_j Pi_ij mu_N(j) / c_j."""
    recorder, _ = switching(1, 3, 5)
    p, _, _ = recorder.smooth(0.0)
    mus, Pis = [row[2] for row in recorder.rows], [row[3] for row in recorder.rows]
    expected = mus[-1]
    for k in range(len(mus) - 1, 0, -1):
        np.testing.assert_allclose(p[k], expected, atol=1e-4)
        expected = mus[k - 1] * (Pis[k] @ (expected / (Pis[k].T @ mus[k - 1])))
    np.testing.assert_allclose(p[0], expected, atol=1e-4)


@settings(max_examples=25)
@given(SEEDS, st.integers(1, 5), st.integers(4, 6), st.sampled_from([0.3, 1.0]))
def test_invariants(seed: int, n_modes: int, n: int, trust: float) -> None:
    """Constraints, entries, missing components, modes at the floor: all stays a distribution."""
    rng = np.random.default_rng(seed)
    _, runner, _ = random_pair(seed, n_modes, n)
    record = runner.bank[0]
    record["mu_floor"] = 1e-6
    for j in range(n_modes):
        kind = rng.integers(4)
        if kind == 0:
            add_soft(runner.bank, j, int(rng.integers(4)), rng.normal(), 0.01)
        elif kind == 1:
            add_bound(runner.bank, j, 2, -0.5, 0.5, mass=bool(rng.integers(2)))
        elif kind == 2:
            s = int(rng.integers(n))
            record["entry_mean"][j, s], record["entry_var"][j, s] = rng.normal(), 0.2
            record["entry_sources"][:n_modes, j] = 1 << s
            record["entry_sources"][j, j] = 0
    recorder = Recorder(runner)
    for _ in range(15):
        valid = rng.random(4) < 0.8
        valid[rng.integers(4)] = True
        recorder.scan(rng.normal(0.0, 2.0, 4), valid=valid)
    p, mean, cov = recorder.smooth(trust)
    assert (p >= 0.0).all()
    np.testing.assert_allclose(p.sum(axis=1), 1.0, rtol=1e-12)
    assert np.isfinite(mean).all()
    np.testing.assert_array_equal(cov, np.swapaxes(cov, 1, 2))
    eigenvalues = np.linalg.eigvalsh(cov)
    assert (eigenvalues[:, 0] >= -1e-9 * eigenvalues[:, -1]).all()
    np.testing.assert_array_equal(mean[-1], recorder.rows[-1][4])  # nothing came afterwards


def test_a_prediction_without_density_leaves_what_was_filtered() -> None:
    _, runner, _ = random_pair(0, 2, 4)
    recorder = Recorder(runner)
    for _ in range(4):
        recorder.scan(np.zeros(4))
    runner.bank[0]["F"][STEPS, :2] = 0.0
    runner.bank[0]["Q"][STEPS, :2] = 0.0
    p, mean, cov = recorder.smooth()
    np.testing.assert_allclose(p.sum(axis=1), 1.0)
    assert np.isfinite(mean).all()
    assert (np.diagonal(cov, axis1=1, axis2=2) > 0.0).all()


# ---- one pair


@settings(max_examples=20)
@given(SEEDS, st.integers(4, 6), st.sets(st.integers(0, 3), max_size=3))
def test_a_pair_is_one_source_of_the_interaction(seed: int, n: int, entered: set[int]) -> None:
    """The end as predicted, and its covariance with the beginning (by the oracle's linear map)."""
    rng = np.random.default_rng(seed)
    _, runner, oracle = random_pair(seed, 2, n)
    record, obj = runner.bank[0], runner.objects[0]
    entry = {s: (float(rng.normal()), float(rng.uniform(0.1, 1.0))) for s in entered}
    for s, (mean, variance) in entry.items():
        record["entry_mean"][1, s], record["entry_var"][1, s] = mean, variance
        record["entry_sources"][0, 1] |= 1 << s
    tau = STEPS * 0.01
    work = np.zeros(1, SMOOTHER_DTYPE)
    enter_pair_(n, record, obj["x"][0], obj["P"][0], 0, 1, tau, work[0])
    move_pair_(n, record, 0, 1, STEPS, work[0])
    F, x, P = oracle.modes[1].F, oracle.x[0], oracle.P[0]
    mean, cov = enter(x, P, entry, tau)
    np.testing.assert_allclose(work[0]["px"][0, :n], F @ mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        work[0]["pP"][0, :n, :n], F @ cov @ F.T + oracle.modes[1].Q, rtol=1e-9, atol=1e-9
    )
    zero = enter(np.zeros(n), P, entry, tau)[0]
    slope = np.column_stack([enter(e, P, entry, tau)[0] - zero for e in np.eye(n)])
    np.testing.assert_allclose(work[0]["C"][0, :n, :n], P @ (F @ slope).T, rtol=1e-9, atol=1e-9)


@given(SEEDS, st.integers(1, 6), st.sampled_from([0.05, 1e-6]))
def test_eigenvalues_and_factor(seed: int, n: int, low: float) -> None:
    A = random_covariance(np.random.default_rng(seed), n, low)
    L, D, V = A.copy(), A.copy(), np.zeros((n, n))
    assert factor_(n, L)
    np.testing.assert_allclose(np.tril(L) @ np.tril(L).T, A, rtol=1e-12, atol=1e-12)
    eigen_(n, D, V)
    np.testing.assert_allclose(V @ V.T, np.eye(n), atol=1e-12)
    np.testing.assert_allclose(V @ np.diag(np.diag(D)) @ V.T, A, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("A", [np.diag([1.0, -1.0]), np.zeros((2, 2)), np.full((2, 2), np.nan)])
def test_what_is_not_definite_has_no_factor(A: Any) -> None:
    assert not factor_(2, A.copy())
