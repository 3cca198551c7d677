"""Motion models and transition probabilities as tables over the number of elapsed steps."""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm, logm

from can_imm.types import FloatArray


def discretise(A: FloatArray, W: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
    """Exact F and Q of dx = A x dt + dw with spectral density W over ``dt`` seconds.

    Van Loan (1978).  A, W: (n, n).  Returns (F, Q), each (n, n).
    """
    n = len(A)
    M = np.zeros((2 * n, 2 * n))
    M[:n, :n] = -A
    M[:n, n:] = W
    M[n:, n:] = A.T
    E = expm(M * dt)
    F = E[n:, n:].T
    Q = F @ E[:n, n:]
    return F, 0.5 * (Q + Q.T)


def repeat(F: FloatArray, Q: FloatArray, n_steps: int) -> tuple[FloatArray, FloatArray]:
    """Tables F[m], Q[m], 0 <= m < n_steps, of m applications of the one-step F, Q."""
    n = len(F)
    Fs = np.zeros((n_steps, n, n))
    Qs = np.zeros((n_steps, n, n))
    Fs[0] = np.eye(n)
    for m in range(1, n_steps):
        Fs[m] = F @ Fs[m - 1]
        Qs[m] = F @ Qs[m - 1] @ F.T + Q
    return Fs, Qs


def generator_from_dwell(dwell_s: FloatArray, weights: FloatArray) -> FloatArray:
    """Generator of a Markov chain in continuous time.

    Args:
        dwell_s: (M,) mean time spent in each mode [s], > 0.
        weights: (M, M) relative frequency of the next mode, row = from; diagonal ignored.

    Returns:
        G (M, M) with rows that sum to 0 [1/s]; Pi(dt) = expm(G dt).
    """
    W = np.array(weights, float)
    np.fill_diagonal(W, 0.0)
    G: FloatArray = W / W.sum(axis=1, keepdims=True) / np.asarray(dwell_s, float)[:, None]
    np.fill_diagonal(G, -G.sum(axis=1))
    return G


def generator_from_matrix(Pi: FloatArray, period_s: float) -> FloatArray:
    """Generator whose expm over ``period_s`` is close to Pi: clipped and renormalised.

    A printed transition matrix need not be embeddable: logm may have negative off-diagonal rates.
    They are clipped, and the other rates of the row scaled so that the mode is left as often as
    before; for the paper's Table 2 no entry of the result is wrong by more than 0.008.
    """
    G: FloatArray = np.real(logm(np.asarray(Pi, float))) / period_s
    leaving = np.maximum(-np.diag(G), 0.0)
    np.fill_diagonal(G, 0.0)
    G = np.maximum(G, 0.0)
    total = G.sum(axis=1)
    G *= np.divide(leaving, total, out=np.zeros_like(total), where=total > 0.0)[:, None]
    np.fill_diagonal(G, -G.sum(axis=1))
    return G


def transition_table(G: FloatArray, step_s: float, n_steps: int) -> FloatArray:
    """Pi[m] = expm(G m step_s), (n_steps, M, M); Pi[m, i, j] is the transition from i to j."""
    step = np.maximum(expm(G * step_s), 0.0)
    table = np.zeros((n_steps, len(G), len(G)))
    table[0] = np.eye(len(G))
    for m in range(1, n_steps):
        table[m] = table[m - 1] @ step
        table[m] /= table[m].sum(axis=1, keepdims=True)
    return table


def stationary(Pi: FloatArray) -> FloatArray:
    """Stationary distribution (M,) of a transition matrix with one recurrent class."""
    n = len(Pi)
    A = np.vstack([Pi.T - np.eye(n), np.ones(n)])
    b = np.append(np.zeros(n), 1.0)
    mu = np.maximum(np.linalg.lstsq(A, b, rcond=None)[0], 0.0)
    return np.asarray(mu / mu.sum())
