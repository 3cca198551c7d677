"""Exact smoothing by brute force: every sequence of modes has its own Kalman filter and RTS pass.

Stacked vectors instead of recursions: for one sequence all states of all times are one Gaussian.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product

import numpy as np
from scipy.stats import multivariate_normal


@dataclass
class LinearMode:
    """x' = F (states that are entered replaced) x + noise Q; ``entry`` {state: (mean, variance)}
    counts when the mode is entered from another one."""

    F: np.ndarray
    Q: np.ndarray
    entry: dict[int, tuple[float, float]] = field(default_factory=dict)


def enumerate_sequences(modes, xs, Ps, mu, Pi, H, R, z):
    """Exact mode probabilities (K, M), means (K, n) and covariances (K, n, n).

    Args:
        xs, Ps, mu: what is known at time 0, per mode, its measurement included.
        z: (K - 1, m) measurements at times 1 .. K - 1.
    """
    n, n_modes, K = len(xs[0]), len(modes), len(z) + 1
    H_all = np.kron(np.eye(K, K, 0)[1:], H)
    results = []
    for sequence in product(range(n_modes), repeat=K):
        log_w = np.log(mu[sequence[0]])
        mean = [xs[sequence[0]]]
        cov = np.zeros((K * n, K * n))
        cov[:n, :n] = Ps[sequence[0]]
        for k in range(1, K):
            i, j = sequence[k - 1], sequence[k]
            log_w += np.log(Pi[i, j]) if Pi[i, j] > 0 else -np.inf
            keep, shift, extra = np.eye(n), np.zeros(n), np.zeros((n, n))
            if i != j:
                for s, (value, variance) in modes[j].entry.items():
                    keep[s, s], shift[s], extra[s, s] = 0.0, value, variance
            A = modes[j].F @ keep
            mean.append(A @ mean[-1] + modes[j].F @ shift)
            a, b = (k - 1) * n, k * n
            cov[b : b + n, :b] = A @ cov[a:b, :b]
            cov[:b, b : b + n] = cov[b : b + n, :b].T
            cov[b : b + n, b : b + n] = (
                A @ cov[a:b, a:b] @ A.T + modes[j].F @ extra @ modes[j].F.T + modes[j].Q
            )
        if log_w == -np.inf:
            continue
        x = np.concatenate(mean)
        S = H_all @ cov @ H_all.T + np.kron(np.eye(K - 1), R)
        e = z.ravel() - H_all @ x
        log_w += multivariate_normal.logpdf(e, np.zeros(len(e)), S)
        gain = np.linalg.solve(S, H_all @ cov).T
        results.append((sequence, log_w, x + gain @ e, cov - gain @ H_all @ cov))
    w = np.exp(np.array([r[1] for r in results]) - max(r[1] for r in results))
    w /= w.sum()
    p = np.zeros((K, n_modes))
    mean = sum(a * r[2] for a, r in zip(w, results, strict=True))
    cov = sum(
        a * (r[3] + np.outer(r[2] - mean, r[2] - mean)) for a, r in zip(w, results, strict=True)
    )
    for a, r in zip(w, results, strict=True):
        p[range(K), r[0]] += a
    blocks = [cov[k * n : (k + 1) * n, k * n : (k + 1) * n] for k in range(K)]
    return p, mean.reshape(K, n), np.array(blocks)
