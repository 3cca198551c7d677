"""The detector's work done with filterpy: what `bench` compares with.

Written as a user of filterpy would write it: `IMMEstimator` over filters that apply their
constraints in `update`, and a bootstrap filter in numpy with filterpy's resampling.  All numbers
come from a mode bank.  What `IMMEstimator` has no place for is left out, in the peer's favour:
entry distributions, state-dependent transitions, birth, gating, learning of the lanes.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from filterpy.kalman import IMMEstimator, KalmanFilter
from filterpy.monte_carlo import systematic_resample
from scipy.special import log_ndtr

from can_imm.estimation.layout import LANE
from can_imm.manoeuvres import ModeBank
from can_imm.types import FloatArray

LEAST_LIKELIHOOD = 1e-30
"""filterpy turns a mode of probability zero into NaN."""


class Constraint:
    """What one Gaussian mode asks for: soft rows before the measurement, bounds after it.

    Args:
        bank: mode bank.
        j: number of the mode.

    Attributes:
        soft_state: (K,) indices of the states that have a soft row.  soft_variance: (K,).
    """

    def __init__(self, bank: ModeBank, j: int) -> None:
        record = bank.record[0]
        self._width = bank.lane_width
        m = record["n_soft"][j]
        self.soft_state = record["soft_state"][j, :m].copy()
        self.soft_variance: FloatArray = record["soft_r"][j, :m].copy()
        self._soft_value = record["soft_value"][j, :m].copy()
        self._soft_lane = _lane_row(record["soft_kind"][j, :m], record["soft_lanes"][j])
        m = record["n_bounds"][j]
        names = ("bound_state", "bound_lower", "bound_upper")
        self._bounds = list(zip(*(record[name][j, :m].tolist() for name in names), strict=True))
        kinds = record["bound_kind"][j, :m]
        self._bound_lane = _lane_row(kinds, record["bound_lanes"][j])
        self._projects = bool(record["is_projected"][j])
        self._var_floor = float(record["var_floor"])

    def soft(self, x: FloatArray) -> FloatArray:
        """(K,) what the soft rows ask of x (n,)."""
        d: FloatArray = self._soft_value
        if self._soft_lane is not None:
            d = d.copy()
            row, lanes = self._soft_lane
            d[row] += self._centre(x[self.soft_state[row]], lanes)
        return d

    def bounds(self, x: FloatArray) -> list[tuple[int, float, float]]:
        """State, lower and upper bound of each row, around x (n,)."""
        bounds = self._bounds
        if self._bound_lane is not None:
            row, lanes = self._bound_lane
            state, lower, upper = bounds[row]
            base = self._centre(x[state], lanes)
            bounds = [*bounds]
            bounds[row] = (state, base + lower, base + upper)
        return bounds

    def truncated(
        self, x: FloatArray, P: FloatArray, bounds: list[tuple[int, float, float]]
    ) -> tuple[FloatArray, FloatArray, float]:
        """Moments of N(x, P) within the bounds and the log of its mass there."""
        log_mass = 0.0
        for bound in bounds:
            x, P, part = self._truncated(x, P, *bound)
            log_mass += part
        return x, P, log_mass

    def applied(
        self, x: FloatArray, P: FloatArray, bounds: list[tuple[int, float, float]]
    ) -> tuple[FloatArray, FloatArray, float]:
        """N(x, P) truncated, or projected, and the log of its mass within the bounds."""
        inside_x, inside_P, log_mass = self.truncated(x, P, bounds)
        if not self._projects:
            return inside_x, inside_P, log_mass
        for bound in bounds:
            x, P = self._projected(x, P, *bound)
        return x, P, log_mass

    def _centre(self, y: float, lanes: FloatArray) -> float:
        k = min(max(math.floor(y / self._width + 0.5), lanes[0]), lanes[1])
        return float(k * self._width)

    def _truncated(
        self, x: FloatArray, P: FloatArray, state: int, lower: float, upper: float
    ) -> tuple[FloatArray, FloatArray, float]:
        """Truncated moments (Simon 2006, section 7.5.4) and the log of the mass inside."""
        p = P[state, state]
        sd = math.sqrt(p)
        a, b = (lower - x[state]) / sd, (upper - x[state]) / sd
        log_a, log_b = (log_ndtr(-a), log_ndtr(-b)) if a > 0.0 else (log_ndtr(b), log_ndtr(a))
        log_mass = max(log_a + math.log1p(-min(math.exp(log_b - log_a), 1.0 - 1e-16)), -700.0)
        pa = math.exp(-0.5 * a * a - log_mass) / math.sqrt(2.0 * math.pi)
        pb = math.exp(-0.5 * b * b - log_mass) / math.sqrt(2.0 * math.pi)
        mean = pa - pb
        second = (a * pa if pa else 0.0) - (b * pb if pb else 0.0)
        variance = min(max(1.0 + second - mean * mean, self._var_floor / p), 1.0)
        k = P[:, state] / p
        return x + k * mean * sd, P + np.outer(k, k) * p * (variance - 1.0), float(log_mass)

    def _projected(
        self, x: FloatArray, P: FloatArray, state: int, lower: float, upper: float
    ) -> tuple[FloatArray, FloatArray]:
        """Onto the violated bound, with W = P^-1 (Simon and Chia 2002)."""
        value = min(max(x[state], lower), upper)
        if value == x[state]:
            return x, P
        k = P[:, state] / P[state, state]
        x = x - k * (x[state] - value)
        P = P - np.outer(k, P[state])
        P[state, state] = self._var_floor
        return x, P


class ConstrainedFilter(KalmanFilter):  # type: ignore[misc]
    """One Gaussian mode: soft rows before the measurement, truncation or projection after it.

    Args:
        bank: mode bank.
        j: number of the mode.
        steps: steps of the loop from one measurement to the next.
        seen: (K,) indices of the measured states.
        variance: (K,) of the measurement.
    """

    def __init__(
        self, bank: ModeBank, j: int, steps: int, seen: list[int], variance: FloatArray
    ) -> None:
        record, n = bank.record[0], bank.n_states
        super().__init__(dim_x=n, dim_z=len(seen))
        self.x: FloatArray
        self.P: FloatArray
        self.F = record["F"][steps, j, :n, :n].copy()
        self.Q = record["Q"][steps, j, :n, :n].copy()
        self.H = np.eye(n)[seen]
        self.R = np.diag(variance)
        self._constraint = Constraint(bank, j)
        self._soft_H = np.eye(n)[self._constraint.soft_state]
        self._soft_R = np.diag(self._constraint.soft_variance)
        self._log_ratio = 0.0

    def update(self, z: Any, R: Any = None, H: Any = None) -> None:
        """Soft rows as pseudo-measurements, the measurement, the bounds."""
        constraint = self._constraint
        if len(self._soft_H):
            super().update(constraint.soft(self.x), R=self._soft_R, H=self._soft_H)
        bounds = constraint.bounds(self.x)
        before = constraint.truncated(self.x, self.P, bounds)[2]
        super().update(z)
        self.x, self.P, after = constraint.applied(self.x, self.P, bounds)
        self._log_ratio = after - before

    @property
    def likelihood(self) -> float:
        """Density of the measurement given the constraint."""
        return max(math.exp(self.log_likelihood + self._log_ratio), LEAST_LIKELIHOOD)


class ParticleFilter:
    """The particle mode with the interface that `IMMEstimator` uses.

    It starts every cycle from the mixed mean and covariance, because that is all it is given.
    """

    def __init__(
        self, bank: ModeBank, steps: int, seen: list[int], variance: FloatArray, rng: Any
    ) -> None:
        self._par = bank.record[0]["particle"]
        self._tau = steps * bank.step_ns * 1e-9
        self._n, self._count = bank.n_states, bank.n_particles
        self._seen, self._variance = seen, variance
        self._rng = rng
        self.x, self.P = np.zeros(self._n), np.eye(self._n)
        self.likelihood = 1.0

    def predict(self, u: Any = None) -> None:
        """Draw from the mixed Gaussian and move: x with its speed, vx onto the profile."""
        par, rng, n = self._par, self._rng, self._count
        spread = np.linalg.cholesky(self.P[:4, :4] + 1e-9 * np.eye(4))
        p = self.x[:4] + rng.standard_normal((n, 4)) @ spread.T
        if par["absolute"]:
            self._entry, self._peak = par["entry"], par["peak_low"]
            self._length = par["length_low"]
        else:
            self._peak = rng.uniform(par["peak_low"], par["peak_high"], n)
            self._length = self._peak * rng.uniform(par["length_low"], par["length_high"], n)
            begin = par["up"] * par["f_min"] / self._peak
            self._entry = p[:, 0] - rng.uniform(begin, par["down"]) * self._length
        noise = rng.standard_normal((n, 3))
        w = math.sqrt(par["q_vy"] * self._tau) * noise[:, 0]
        p[:, 0] += self._tau * p[:, 1] + par["std_x"] * math.sqrt(self._tau) * noise[:, 1]
        p[:, 1] = self._profile(p[:, 0]) + par["std_profile"] * noise[:, 2]
        p[:, 2] += self._tau * (p[:, 3] + 0.5 * w)
        p[:, 3] += w
        self.particles = p

    def update(self, z: FloatArray) -> None:
        """Weigh by constraint and measurement, resample, moments."""
        par, p = self._par, self.particles
        f = self._profile(p[:, 0])
        inside = (f >= par["f_min"]) & (p[:, 2] >= par["y_low"]) & (p[:, 2] <= par["y_high"])
        e = z - p[:, self._seen]
        log_w = -0.5 * (e * e / self._variance + np.log(2.0 * np.pi * self._variance)).sum(1)
        w = np.exp(log_w) * inside
        self.likelihood = max(w.mean(), LEAST_LIKELIHOOD)
        if w.sum() < LEAST_LIKELIHOOD:
            return
        p = p[systematic_resample(w / w.sum())]
        self.x[:4] = p.mean(0)
        self.P[:4, :4] = np.cov(p.T) + 1e-6 * np.eye(4)

    def _profile(self, x: FloatArray) -> FloatArray:
        par = self._par
        u = (x - self._entry) / self._length
        v = np.where(u < par["up"], u / par["up"], (1.0 - u) / (1.0 - par["down"]))
        return np.asarray(self._peak * np.clip(v, 0.0, 1.0))


def imm_peer(
    bank: ModeBank, steps: int, seen: list[int], variance: FloatArray, x: FloatArray, seed: int = 0
) -> Any:
    """Return an `IMMEstimator` with the bank's modes; ``predict()``, then ``update(z)``.

    Args:
        steps: steps of the loop from one measurement to the next.
        seen: (K,) indices of the measured states.  variance: (K,) of the measurement.
        x: (n_states,) where it starts.
    """
    record, m, n = bank.record[0], len(bank.modes), bank.n_states
    filters: list[Any] = []
    for j in range(m):
        if record["is_particle"][j]:
            rng = np.random.default_rng(seed)
            filters.append(ParticleFilter(bank, steps, seen, variance, rng))
        else:
            filters.append(ConstrainedFilter(bank, j, steps, seen, variance))
        filters[-1].x = x.copy()
        filters[-1].P = np.diag(record["birth_std"][:n] ** 2)
    return IMMEstimator(filters, record["mu0"][:m] + 1e-3, record["Pi"][steps, :m, :m])


def _lane_row(kinds: Any, lanes: Any) -> tuple[int, FloatArray] | None:
    """The one row that counts from a lane's centre, and of which lanes; None without one."""
    rows = np.flatnonzero(kinds == LANE)
    return (int(rows[0]), lanes[rows[0]].copy()) if len(rows) else None
