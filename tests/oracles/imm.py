"""The interacting multiple model as the textbook writes it: lists of Gaussians, matrix algebra.

Blom and Bar-Shalom (1988); equation numbers are the paper's, with (14) divided by c_j and (18)
read with mu of the step before.  Slow, and shares nothing with the package.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from oracles.gaussian import truncate, update
from scipy.stats import multivariate_normal


@dataclass
class Mode:
    """One mode: motion over one cycle, soft rows D x = d, one interval, an entry distribution."""

    F: np.ndarray
    Q: np.ndarray
    D: np.ndarray | None = None
    d: np.ndarray | None = None
    D_noise: np.ndarray | None = None
    interval: tuple[int, float, float] | None = None
    keep_mass: bool = False
    entry: dict[int, tuple[float, float]] = field(default_factory=dict)
    entry_from: frozenset[int] = frozenset()


def enter(x, P, entry: dict[int, tuple[float, float]], tau: float):
    """Mean and covariance of a source whose entry states are replaced.

    A new speed (state 1) began a seconds before the end of the interval, a uniform in (0, tau); the
    position, which the prediction moves on at the new speed for all of tau, is set back by that:
    x' = x + (tau - b)(v_old - v_new) with b uniform as well.  Moments by the linear map A0 + b' A1.
    """
    n = len(x)
    new = sorted(entry)
    mean = np.concatenate([x, [entry[s][0] for s in new]])
    cov = np.zeros((len(mean), len(mean)))
    cov[:n, :n] = P
    cov[n:, n:] = np.diag([entry[s][1] for s in new])
    A0 = np.eye(n, len(mean))
    for k, s in enumerate(new):
        A0[s] = 0.0
        A0[s, n + k] = 1.0
    A1 = np.zeros_like(A0)
    if 1 in entry and 0 not in entry:
        A1[0, 1], A1[0, n + new.index(1)] = 1.0, -1.0
    first, second = tau / 2, tau**2 / 3
    step = A1 @ mean
    P = A0 @ cov @ A0.T + first * (A0 @ cov @ A1.T + A1 @ cov @ A0.T) + second * A1 @ cov @ A1.T
    P += (second - first**2) * np.outer(step, step)
    return A0 @ mean + first * step, P


@dataclass
class Imm:
    """The estimate: one Gaussian per mode and the mode probabilities.

    With a ``floor``, a mode whose probability is at most twice the floor is not there: it counts
    neither as a source nor in the combined estimate.
    """

    modes: list[Mode]
    x: list[np.ndarray]
    P: list[np.ndarray]
    mu: np.ndarray
    floor: float = 0.0
    tau: float = 0.05

    def mixed(self, j: int, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(15)(16), with the entry states replaced for the sources that enter the mode."""
        xs, Ps = [], []
        for i, (x, P) in enumerate(zip(self.x, self.P, strict=True)):
            if i in self.modes[j].entry_from:
                x, P = enter(x, P, self.modes[j].entry, self.tau)
            xs.append(x)
            Ps.append(P)
        return mixture(weights, xs, Ps)

    def cycle(self, Pi: np.ndarray, H: np.ndarray, R: np.ndarray, z: np.ndarray) -> None:
        """One cycle with Pi[i, j] from i to j."""
        mu = self.present()
        c = Pi.T @ mu
        priors = [self.mixed(j, Pi[:, j] * mu / c[j]) for j in range(len(self.modes))]
        log_mu = np.zeros(len(self.modes))
        for j, (mode, (x, P)) in enumerate(zip(self.modes, priors, strict=True)):
            x, P = mode.F @ x, mode.F @ P @ mode.F.T + mode.Q
            if mode.D is not None:
                x, P, _, _ = update(x, P, mode.D, mode.D_noise, mode.d)
            before = 0.0
            if mode.interval and not mode.keep_mass:
                before = truncate(x, P, *mode.interval)[2]
            x, P, e, S = update(x, P, H, R, z)
            log_mu[j] = np.log(c[j]) + multivariate_normal.logpdf(e, np.zeros(len(e)), S) - before
            if mode.interval:
                x, P, mass = truncate(x, P, *mode.interval)
                log_mu[j] += mass
            self.x[j], self.P[j] = x, P
        mu = np.exp(log_mu - log_mu.max())
        mu = np.maximum(mu / mu.sum(), self.floor)
        self.mu = mu / mu.sum()

    def combined(self) -> tuple[np.ndarray, np.ndarray]:
        """(19)(20)."""
        return mixture(self.present(), self.x, self.P)

    def present(self) -> np.ndarray:
        w = np.where(self.mu > 2.0 * self.floor, self.mu, 0.0)
        return w / w.sum()

    def extrapolated(self, Pi, Fs, Qs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Every mode moved on by itself; the chain moved on by Pi."""
        xs = [F @ x for F, x in zip(Fs, self.x, strict=True)]
        Ps = [F @ P @ F.T + Q for F, P, Q in zip(Fs, self.P, Qs, strict=True)]
        return *mixture(self.present(), xs, Ps), Pi.T @ self.mu


def mixture(weights, xs, Ps):
    """Mean and covariance of a Gaussian mixture."""
    mean = sum(w * x for w, x in zip(weights, xs, strict=True))
    P = sum(w * (P + np.outer(x - mean, x - mean)) for w, x, P in zip(weights, xs, Ps, strict=True))
    return mean, P
