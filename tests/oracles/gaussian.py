"""Slow textbook operations on Gaussians: matrix form, plain numpy and scipy."""

from __future__ import annotations

import numpy as np
from scipy.stats import norm, truncnorm


def random_covariance(rng: np.random.Generator, n: int, low: float = 0.05) -> np.ndarray:
    """A well-conditioned covariance with random correlations, (n, n)."""
    A = rng.normal(size=(n, n))
    scale = np.diag(rng.uniform(0.3, 2.0, n))
    P = scale @ (A @ A.T / n + low * np.eye(n)) @ scale
    return 0.5 * (P + P.T)


def selection(n: int, states: list[int]) -> np.ndarray:
    """The matrix D that selects ``states`` out of n, (len(states), n)."""
    return np.eye(n)[states]


def update(x, P, H, R, z):
    """Kalman update in matrix form; returns mean, covariance, innovation and its covariance."""
    S = H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T
    e = z - H @ x
    A = np.eye(len(x)) - K @ H
    return x + K @ e, A @ P @ A.T + K @ R @ K.T, e, S


def project(x, P, D, d):
    """Equations (24) to (28) with W = P^-1, all rows at once."""
    W = np.linalg.inv(P)
    G = np.linalg.inv(W) @ D.T @ np.linalg.inv(D @ np.linalg.inv(W) @ D.T)
    A = np.eye(len(x)) - G @ D
    return x - G @ (D @ x - d), A @ P @ A.T


def truncate(x, P, s, low, high):
    """Moments of N(x, P) restricted to low <= x[s] <= high; returns them and the log mass."""
    sd = np.sqrt(P[s, s])
    a, b = (low - x[s]) / sd, (high - x[s]) / sd
    mean, variance = truncnorm.stats(a, b, moments="mv")
    log_mass = _log_difference(a, b) if a + b > 0 else _log_difference(-b, -a)
    k = P[:, s] / P[s, s]
    return (
        x + k * sd * mean,
        P + np.outer(k, k) * P[s, s] * (variance - 1.0),
        log_mass,
    )


def _log_difference(a, b):
    """Log of the mass in [a, b] from the upper tails."""
    la, lb = norm.logsf(a), norm.logsf(b)
    return la + np.log1p(-np.exp(lb - la))


def grid(low: float, high: float, count: int = 160) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights on [low, high]."""
    u, w = np.polynomial.legendre.leggauss(count)
    return 0.5 * (high - low) * u + 0.5 * (high + low), 0.5 * (high - low) * w


def log_density(points: np.ndarray, x: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Log of N(x, P) at points (..., n)."""
    e = points - x
    q = ((e @ np.linalg.inv(P)) * e).sum(-1)
    return -0.5 * (q + np.linalg.slogdet(2 * np.pi * P)[1])


def integrate_2d(x, P, factor, low=(-np.inf, -np.inf), high=(np.inf, np.inf), reach=10.0):
    """Moments of factor(p) N(p; x, P) over a box by brute force, in two dimensions.

    ``factor`` maps points (..., 2) to values.  Returns mass, mean (2,) and covariance (2, 2).
    """
    sd = np.sqrt(np.diag(P))
    axes = [
        grid(max(low[i], x[i] - reach * sd[i]), min(high[i], x[i] + reach * sd[i]))
        for i in range(2)
    ]
    points = np.stack(np.meshgrid(axes[0][0], axes[1][0], indexing="ij"), -1)
    points = points.reshape(-1, 2)
    weights = np.outer(axes[0][1], axes[1][1]).ravel() * factor(points)
    weights *= np.exp(log_density(points, x, P))
    mass = weights.sum()
    mean = weights @ points / mass
    e = points - mean
    return mass, mean, (weights[:, None] * e).T @ e / mass
