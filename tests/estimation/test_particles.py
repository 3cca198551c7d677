"""The particle mode: kernels against brute force, its likelihood against integration."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import gaussian
from scipy import integrate
from scipy.stats import multivariate_normal, norm
from small_banks import Runner, blank

from can_imm.estimation import imm, layout, particles
from can_imm.estimation.noise import noise_state
from can_imm.estimation.particles import (
    ENTRY,
    LENGTH,
    N_COLUMNS,
    PARTICLE_DTYPE,
    PEAK,
    PVX,
    PX,
    PY,
    enter_,
    profile_speed,
    weigh_,
)

SEEDS = st.integers(0, 2**32 - 1)
VALID = np.ones(4, np.bool_)


def parameters(**changes: float) -> Any:
    """The published profile (corners at 50, 51.1, 52.6, 53.75 m), as a record."""
    record = np.zeros(1, PARTICLE_DTYPE)[0]
    values: dict[str, float] = {
        "entry": 50.0, "up": 1.1 / 3.75, "down": 2.6 / 3.75, "peak_low": 2.1, "peak_high": 2.1,
        "length_low": 3.75, "length_high": 3.75, "f_min": 0.4, "y_low": 0.5, "y_high": 3.5,
        "std_x": 0.05, "std_profile": 0.3, "q_vy": 1.0, "entry_vy_std": 0.0, "absolute": 1,
    }  # fmt: skip
    for key, value in {**values, **changes}.items():
        record[key] = value
    return record


def trapezoid(x: np.ndarray | float) -> Any:
    """f(x) of truth A, from its corners."""
    return np.interp(x, [50.0, 51.1, 52.6, 53.75], [0.0, 2.1, 2.1, 0.0])


@given(st.floats(-2.0, 6.0))
def test_profile(gained: float) -> None:
    value = profile_speed(gained, 2.1, 3.75, 1.1 / 3.75, 2.6 / 3.75)
    assert value == pytest.approx(trapezoid(50.0 + gained), abs=1e-12)


@given(SEEDS, st.sampled_from([0.0, 0.03]), st.integers(0, 15))
def test_weights_are_constraint_times_density(seed: int, age: float, mask: int) -> None:
    rng = np.random.default_rng(seed)
    n = 40
    p = np.zeros((n, N_COLUMNS))
    p[:, :4] = rng.normal([52.0, 2.0, 2.0, 0.0], 1.0, (n, 4))
    p[:, ENTRY], p[:, PEAK], p[:, LENGTH] = 50.0, 2.1, 3.75
    p[0, PX], p[0, PY] = 52.0, 2.0  # at least one is feasible
    z, r = np.array([52.1, 1.8, 2.2, 0.1]), np.array([0.2, 0.3, 0.5, 0.4])
    valid = np.array([mask >> c & 1 for c in range(4)], np.bool_)
    phi = (trapezoid(p[:, PX]) >= 0.4) & (p[:, PY] >= 0.5) & (p[:, PY] <= 3.5)
    seen = p[:, :4] - age * p[:, [1, 1, 3, 3]] * [1.0, 0.0, 1.0, 0.0]
    g = norm.pdf(z, seen, np.sqrt(r))[:, valid].prod(axis=1)
    w = np.empty(n)
    log_l = weigh_(p.T.copy(), w, z, r, valid, age, 0.0, parameters())
    assert log_l == pytest.approx(math.log(np.mean(phi * g)), rel=1e-10)
    np.testing.assert_allclose(w, phi * g / (phi * g).sum(), rtol=1e-9, atol=1e-300)


def test_no_feasible_particle() -> None:
    p = np.zeros((5, N_COLUMNS))
    p[:, LENGTH] = 1.0
    log_l = weigh_(p.T.copy(), np.empty(5), np.zeros(4), np.ones(4), VALID, 0.0, 0.0, parameters())
    assert log_l == -np.inf


def test_weights_of_an_extreme_measurement_do_not_underflow() -> None:
    p = np.tile([52.0, 2.0, 2.0, 0.0, 50.0, 2.1, 3.75], (4, 1))
    p[1, PX] = 52.5
    w = np.empty(4)
    z, r = np.array([100.0, 2.0, 2.0, 0.0]), np.full(4, 0.1)
    log_l = weigh_(p.T.copy(), w, z, r, VALID, 0.0, 0.0, parameters())
    assert log_l < -1000.0
    assert w == pytest.approx([0.0, 1.0, 0.0, 0.0], abs=1e-9)


@given(SEEDS)
def test_moments(seed: int) -> None:
    rng = np.random.default_rng(seed)
    p, w = rng.normal(3.0, 2.0, (30, N_COLUMNS)), rng.dirichlet(np.ones(30))
    x, P = np.empty(4), np.empty((4, 4))
    particles.moments_(p.T.copy(), w, x, P)
    np.testing.assert_allclose(x, np.average(p[:, :4], axis=0, weights=w), rtol=1e-12)
    expected = np.cov(p[:, :4].T, aweights=w, bias=True)
    np.testing.assert_allclose(P, expected, rtol=1e-9, atol=1e-12)


@given(SEEDS, st.floats(0.0, 1.0, exclude_max=True))
def test_resampling_is_systematic(seed: int, u: float) -> None:
    """Every particle is taken floor or ceil of N times its weight."""
    rng = np.random.default_rng(seed)
    n, count = 20, 50
    p = np.repeat(np.arange(float(n))[:, None], N_COLUMNS, axis=1)
    w = rng.dirichlet(np.full(n, 0.3))
    out = np.empty((N_COLUMNS, count))
    particles.resample_(p.T.copy(), w, out, count, u)
    taken = np.bincount(out[0].astype(int), minlength=n)
    assert (np.abs(taken - count * w) < 1.0 + 1e-9).all()
    assert (np.diff(out[0]) >= 0).all()
    assert (out == out[0]).all()


def test_resampling_survives_weights_that_sum_to_less_than_one() -> None:
    p = np.repeat(np.arange(3.0)[:, None], N_COLUMNS, axis=1)
    out = np.empty((N_COLUMNS, 4))
    particles.resample_(p.T.copy(), np.array([0.5, 0.5 - 1e-9, 0.0]), out, 4, 1.0 - 1e-16)
    assert np.isin(out[0], [0.0, 1.0, 2.0]).all()


ENTERING = {"absolute": 0, "peak_low": 1.0, "peak_high": 3.0, "length_low": 1.2,
            "length_high": 2.4, "entry_vy_std": 0.5}  # fmt: skip


def entered(x: np.ndarray, P: np.ndarray, tau: float, par: Any, n: int) -> np.ndarray:
    """(7, n) particles that entered from N(x, P) and moved on for ``tau`` seconds."""
    p = np.full((N_COLUMNS, n + 2), 77.0)
    mean, cov, L = np.zeros(4), np.zeros((4, 4)), np.zeros((4, 4))
    particles.moved_(x, P, tau, par, mean, cov)
    particles.cholesky4_(cov, L)
    np.testing.assert_allclose(L @ L.T, np.tril(cov) + np.tril(cov, -1).T, rtol=1e-12)
    enter_(p, 1, n, mean, L, par, noise_state(np.random.default_rng(0)))
    assert (p[:, [0, -1]] == 77.0).all()
    return p[:, 1:-1]


@pytest.mark.parametrize("absolute", [0, 1])
def test_entering_draws_from_the_source_moved_on(absolute: int) -> None:
    x = np.array([50.0, 1.0, 0.5, 0.3])
    P = gaussian.random_covariance(np.random.default_rng(0), 4)
    tau, par = 0.4, parameters(**{**ENTERING, "absolute": absolute})
    p = entered(x, P, tau, par, 40_000)
    P[3, 3] += 0.25
    F = np.eye(4)
    F[0, 1] = F[2, 3] = tau
    G = np.array([0.0, 0.0, 0.5 * tau, 1.0])
    cov = F @ P @ F.T + np.outer(G, G) * 1.0 * tau + np.diag([0.05**2 * tau, 0.0, 0.0, 0.0])
    seen = [0, 2, 3]
    np.testing.assert_allclose(p[seen].mean(axis=1), (F @ x)[seen], atol=0.04)
    np.testing.assert_allclose(np.cov(p[seen]), cov[np.ix_(seen, seen)], atol=0.06)
    residual = p[PVX] - [profile_speed(a[PX] - a[ENTRY], a[PEAK], a[LENGTH], par["up"], par["down"])
                         for a in p.T]  # fmt: skip
    assert residual.mean() == pytest.approx(0.0, abs=0.01)
    assert residual.std() == pytest.approx(0.3, rel=0.03)


def test_where_it_enters() -> None:
    """On the profile, where that is feasible and still rising or flat; its speed there is its own,
    and in ``tau`` it has gained what its old speed made it gain."""
    x, P = np.array([50.0, 1.5, 0.5, 0.3]), np.diag([4.0, 1e-12, 1.0, 1.0])
    tau, par = 0.4, parameters(**ENTERING, std_x=0.0)
    p = entered(x, P, tau, par, 40_000)
    assert p[PEAK].min() >= 1.0
    assert p[PEAK].max() <= 3.0
    ratio = p[LENGTH] / p[PEAK]
    assert ratio.min() >= 1.2 - 1e-12
    assert ratio.max() <= 2.4 + 1e-12
    gained = p[PX] - tau * 1.5 - p[ENTRY]
    f = [
        profile_speed(g, a[PEAK], a[LENGTH], par["up"], par["down"])
        for g, a in zip(gained, p.T, strict=True)
    ]
    assert min(f) >= 0.4 - 1e-5
    assert (gained / p[LENGTH]).max() <= par["down"] + 1e-5


def test_the_factor_of_a_singular_covariance_is_finite() -> None:
    L = np.full((4, 4), 7.0)
    P = np.zeros((4, 4))
    P[:2, :2] = 1.0
    P[3, 3] = -1e-18
    particles.cholesky4_(P, L)
    expected = np.zeros((4, 4))
    expected[:2, 0] = 1.0
    np.testing.assert_allclose(np.tril(L), expected, atol=1e-12)


def test_motion() -> None:
    """x by its speed, the speed onto the profile at the new place, y and vy by white noise."""
    rng = np.random.default_rng(0)
    tau, n = 0.1, 40_000
    p = np.tile([51.0, 1.5, 1.0, 0.8, 50.0, 2.1, 3.75], (n, 1))
    par = parameters()
    columns = p.T.copy()
    particles.propagate_(columns, np.empty((3, n)), n, tau, par, noise_state(rng))
    p = columns.T
    assert p[:, PX].mean() == pytest.approx(51.15, abs=1e-3)
    assert p[:, PX].var() == pytest.approx(0.05**2 * tau, rel=0.05)
    residual = p[:, PVX] - trapezoid(p[:, PX])
    assert residual.mean() == pytest.approx(0.0, abs=0.01)
    assert residual.std() == pytest.approx(0.3, rel=0.03)
    np.testing.assert_allclose(p[:, 2:4].mean(axis=0), [1.08, 0.8], atol=0.01)
    # one step of piecewise constant acceleration: y gets half of what vy gets
    q = 1.0 * tau
    np.testing.assert_allclose(
        np.cov(p[:, 2:4].T), [[q * tau**2 / 4, q * tau / 2], [q * tau / 2, q]], rtol=0.05
    )
    np.testing.assert_array_equal(p[:, 4:], np.tile([50.0, 2.1, 3.75], (n, 1)))


# ---- the mode's likelihood

X0 = np.array([51.0, 1.6, 0.6, 1.2])
P0 = np.array(
    [[0.04, 0.01, 0.0, 0.0], [0.01, 0.09, 0.0, 0.0], [0.0, 0.0, 0.05, 0.02], [0.0, 0.0, 0.02, 0.2]]
)
Z, R = np.array([51.4, 2.0, 0.5, 1.0]), np.array([0.01, 0.09, 0.04, 0.09])


def particle_bank() -> np.ndarray[Any, Any]:
    """Mode 0 is Gaussian, mode 1 is made of particles and always entered from mode 0."""
    bank = blank(2, 4)
    bank[0]["is_particle"][1] = 1
    bank[0]["particle"] = parameters()
    bank[0]["Pi"][:, 0, :2] = [0.5, 0.5]
    bank[0]["Pi"][:, 1, :2] = [0.5, 0.5]
    bank[0]["mu_floor"] = 1e-6
    return bank


def in_mode_0(runner: Runner) -> Any:
    obj = runner.objects[0]
    obj["mu"][:2] = [1.0, 0.0]
    obj["x"][0, :4], obj["P"][0, :4, :4] = X0, P0
    obj["mean"][:4], obj["cov"][:4, :4] = X0, P0
    obj["log_l"][:2] = [0.0, layout.LOG_FLOOR]
    return obj


def exact_log_likelihood() -> float:
    """int N(z; H x, R) phi(x) p(x) dx by one-dimensional integrals.

    After one step x is normal, vx normal around f(x); y and vy are jointly normal.
    """
    tau = 0.1
    mean = X0[0] + tau * X0[1]
    var = P0[0, 0] + 2.0 * tau * P0[0, 1] + tau**2 * P0[1, 1] + 0.05**2 * tau

    def along(x: float) -> float:
        f = trapezoid(x)
        if f < 0.4:
            return 0.0
        return (
            norm.pdf(x, mean, math.sqrt(var))
            * norm.pdf(Z[0], x, math.sqrt(R[0]))
            * norm.pdf(Z[1], f, math.sqrt(R[1] + 0.3**2))
        )

    corners = [50.0 + 1.1 * 0.4 / 2.1, 51.1, 52.6]
    first = integrate.quad(along, 49.0, 54.0, points=corners, epsrel=1e-10, limit=200)[0]
    F = np.array([[1.0, tau], [0.0, 1.0]])
    G = np.array([0.5 * tau, 1.0])
    y, C = F @ X0[2:], F @ P0[2:, 2:] @ F.T + np.outer(G, G) * 1.0 * tau
    post, cov, e, S = gaussian.update(y, C, np.eye(2), np.diag(R[2:]), Z[2:])
    inside = norm.cdf([0.5, 3.5], post[0], math.sqrt(cov[0, 0]))
    second = multivariate_normal.pdf(e, np.zeros(2), S) * (inside[1] - inside[0])
    return math.log(first * second)


def test_likelihood_of_many_particles_converges_to_the_integral() -> None:
    expected = exact_log_likelihood()
    errors = []
    for n in (1000, 100_000):
        runner = Runner(particle_bank(), 1, n, seed=1)
        obj = in_mode_0(runner)
        assert runner.scan([0], [10], Z, R)[0] == imm.OK
        errors.append(abs(obj["log_l"][1] - expected))
    assert errors[0] < 0.2
    assert errors[1] < 0.02


def test_moments_of_the_mode_are_those_of_its_particles() -> None:
    runner = Runner(particle_bank(), 1, 20_000, seed=1)
    obj = in_mode_0(runner)
    runner.scan([0], [10], Z, R)
    p = runner.particles[0].T
    np.testing.assert_allclose(obj["x"][1, :4], p[:, :4].mean(axis=0), atol=0.005)
    np.testing.assert_allclose(obj["P"][1, :4, :4], np.cov(p[:, :4].T), atol=0.005)
    assert (p[:, PY] >= 0.5).all()
    assert (p[:, PY] <= 3.5).all()
    assert (trapezoid(p[:, PX]) >= 0.4).all()


def test_an_infeasible_particle_mode_gets_the_floor_and_starts_afresh() -> None:
    runner = Runner(particle_bank(), 1, 200)
    obj = in_mode_0(runner)
    obj["x"][0, 2] = obj["mean"][2] = -5.0  # two metres outside of any window
    z = Z - [0.0, 0.0, 5.5, 0.0]
    assert runner.scan([0], [10], z, R)[0] == imm.OK
    assert obj["mu"][1] == pytest.approx(1e-6, rel=1e-3)
    assert np.isfinite(obj["x"][:2]).all()
    assert obj["x"][1, 0] == pytest.approx(X0[0], abs=0.5)


@pytest.mark.parametrize("left_over", [0.0, 51.4])
def test_what_a_slot_held_before_does_not_matter(left_over: float) -> None:
    """Particles of an earlier object in the slot, or none yet, are no source of the mode."""
    logs = []
    for value in (left_over, 1e6):
        runner = Runner(particle_bank(), 1, 2000, seed=3)
        row = np.array([value, 2.1, 0.6, 0.0, value - 2.0, 2.1, 3.75])
        runner.particles[:] = row[:, None]
        assert runner.scan([0], [-1], X0, R)[0] == imm.OK
        runner.scan([0], [10], Z, R)
        logs.append(runner.objects[0]["log_l"][1])
        assert logs[-1] > layout.LOG_FLOOR
    assert logs[0] == logs[1]


@settings(max_examples=10)
@given(SEEDS)
def test_the_particle_mode_is_deterministic(seed: int) -> None:
    results = []
    for _ in range(2):
        runner = Runner(particle_bank(), 1, 100, seed=seed)
        in_mode_0(runner)
        for _ in range(3):
            runner.scan([0], [10], Z, R)
        results.append(runner.objects.tobytes() + runner.particles.tobytes())
    assert results[0] == results[1]
