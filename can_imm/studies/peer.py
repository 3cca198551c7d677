"""The detector's work done with filterpy: what `bench` compares with.

Written as a user of filterpy would write it: `IMMEstimator` over `KalmanFilter` objects that apply
their constraints in `update`, and a bootstrap filter in numpy with filterpy's resampling.  All of
it is taken from a mode bank's record, so that both sides do the same work.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from filterpy.kalman import IMMEstimator, KalmanFilter
from filterpy.monte_carlo import systematic_resample
from scipy.special import log_ndtr

from can_imm.estimation.imm import FIXED
from can_imm.manoeuvres import ModeBank
from can_imm.types import FloatArray


class ConstrainedFilter(KalmanFilter):  # type: ignore[misc]
    """One Gaussian mode: soft rows before the measurement, truncation or projection after it.

    Args:
        bank: mode bank with fixed (not lane-relative) constraints.
        j: number of the mode.
        steps: steps of the loop from one measurement to the next.
    """

    def __init__(self, bank: ModeBank, j: int, steps: int) -> None:
        record, n = bank.record[0], bank.n_states
        super().__init__(dim_x=n, dim_z=4)
        self.F = record["F"][steps, j, :n, :n].copy()
        self.Q = record["Q"][steps, j, :n, :n].copy()
        self.H = np.eye(4, n)
        rows = range(record["n_soft"][j])
        self._soft_H = np.eye(n)[[record["soft_state"][j, c] for c in rows]]
        self._soft_z = record["soft_value"][j, : len(rows)].copy()
        self._soft_R = np.diag(record["soft_r"][j, : len(rows)])
        self._bounds = [
            (
                int(record["bound_state"][j, c]),
                float(record["bound_lower"][j, c]),
                float(record["bound_upper"][j, c]),
            )
            for c in range(record["n_bounds"][j])
        ]
        kinds = (record["soft_kind"][j], record["bound_kind"][j])
        if any((kind != FIXED).any() for kind in kinds):
            raise ValueError(f"mode {bank.modes[j]} counts from lanes, which the peer does not do")
        self._projects = bool(record["is_projected"][j])
        self._var_floor = float(record["var_floor"])
        self._log_ratio = 0.0

    def update(self, z: Any, R: Any = None, H: Any = None) -> None:
        """Soft rows as pseudo-measurements, the measurement, the bounds."""
        if len(self._soft_z):
            super().update(self._soft_z, R=self._soft_R, H=self._soft_H)
        x, P = self.x, self.P
        prior = 0.0
        for bound in self._bounds:
            x, P, log_mass = self._truncated(x, P, *bound)
            prior += log_mass
        super().update(z)
        x, P = self.x, self.P
        posterior = 0.0
        for bound in self._bounds:
            x, P, log_mass = self._truncated(x, P, *bound)
            posterior += log_mass
        if self._projects:
            for bound in self._bounds:
                self._project(*bound)
        else:
            self.x, self.P = x, P
        self._log_ratio = posterior - prior

    @property
    def likelihood(self) -> float:
        """Density of the measurement given the constraint."""
        return max(math.exp(self.log_likelihood + self._log_ratio), 2.3e-308)

    def _truncated(
        self, x: FloatArray, P: FloatArray, state: int, lower: float, upper: float
    ) -> tuple[FloatArray, FloatArray, float]:
        """Truncated moments (Simon 2006, section 7.5.4) and the log of the mass inside."""
        p = P[state, state]
        sd = math.sqrt(p)
        a, b = (lower - x[state]) / sd, (upper - x[state]) / sd
        if a > 0.0:
            log_mass = log_ndtr(-a) + math.log1p(-math.exp(log_ndtr(-b) - log_ndtr(-a)))
        else:
            log_mass = log_ndtr(b) + math.log1p(-math.exp(log_ndtr(a) - log_ndtr(b)))
        pa = math.exp(-0.5 * a * a - log_mass) / math.sqrt(2.0 * math.pi)
        pb = math.exp(-0.5 * b * b - log_mass) / math.sqrt(2.0 * math.pi)
        mean = pa - pb
        second = (a * pa if pa else 0.0) - (b * pb if pb else 0.0)
        variance = min(max(1.0 + second - mean * mean, self._var_floor / p), 1.0)
        k = P[:, state] / p
        return x + k * mean * sd, P + np.outer(k, k) * p * (variance - 1.0), float(log_mass)

    def _project(self, state: int, lower: float, upper: float) -> None:
        """Onto the violated bound, with W = P^-1 (Simon and Chia 2002)."""
        value = min(max(self.x[state], lower), upper)
        if value == self.x[state]:
            return
        k = self.P[:, state] / self.P[state, state]
        self.x = self.x - k * (self.x[state] - value)
        self.P = self.P - np.outer(k, self.P[state])
        self.P[state, state] = self._var_floor
