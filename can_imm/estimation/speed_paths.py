"""How fast a vehicle went, by hindsight: paths of its speed, drawn from all that may have been.

A vehicle holds its speed, or speeds up or slows down at a rate that hardly changes meanwhile.  The
three modes' filter (an interacting multiple model: Blom and Bar-Shalom, 1988) is followed forwards;
then whole paths are drawn backwards through it (Godsill, Doucet and West, 2004).  What is said of a
vehicle may depend on the whole path, such as how fast it will have been: the share of the paths
of which it is true is its probability.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.estimation.noise import load, normal, store_, uniform
from can_imm.types import FloatArray

N_MODES = 3
"""Hold, speed up, slow down."""
BEGIN, END, TURN = 0.15, 0.45, 0.1
"""Rates at which ramps begin, end, and turn into the opposite [1/s]."""
RAMP, RAMP_STD = 1.4, 0.8
"""Acceleration in a ramp [m/s²], its sign aside."""
WEAKEST = 0.2
"""Ramps are about so strong at least [m/s²]."""
RESTLESS, RESTLESS_RAMP, JERK = 0.0002, 0.0004, 0.003
"""Densities of the noise of the speed, that in ramps [m²/s³], and of a ramp's rate [m²/s⁵]."""
OUTLIER = 16.0
"""Squared normalised error of a measurement counts as this at most."""
FARTHEST = 4.0
"""A path's step back is that of a path no further from what was predicted [standard deviations]."""
_TINY = 1e-8
_S, _V, _A = 0, 1, 2


@numba.njit(nogil=True, cache=True, error_model="numpy")
def models_(
    dt: float, F: FloatArray, Q: FloatArray, Pi: FloatArray
) -> None:  # pragma: no cover - compiled
    """F (3, 3), Q (M, 3, 3) and Pi (M, M) of an interval [s], written."""
    F[:] = np.eye(3)
    F[_S, _V] = F[_V, _A] = dt
    F[_S, _A] = 0.5 * dt * dt
    for j in range(N_MODES):
        q = RESTLESS if j == 0 else RESTLESS_RAMP
        Q[j] = 0.0
        Q[j, _S, _S] = q * dt**3 / 3.0 + 1e-5 * dt
        Q[j, _S, _V] = Q[j, _V, _S] = 0.5 * q * dt * dt
        Q[j, _V, _V] = q * dt
        Q[j, _A, _A] = _TINY if j == 0 else JERK * dt
    begin, end = 1.0 - math.exp(-BEGIN * dt), 1.0 - math.exp(-END * dt)
    turn = 1.0 - math.exp(-TURN * dt)
    Pi[0, 0], Pi[0, 1], Pi[0, 2] = 1.0 - begin, 0.5 * begin, 0.5 * begin
    for j in (1, 2):
        Pi[j, 0], Pi[j, j], Pi[j, 3 - j] = end, 1.0 - end - turn, turn


@numba.njit(nogil=True, cache=True, error_model="numpy")
def enter_(
    i: int, j: int, x: FloatArray, P: FloatArray, to_x: FloatArray, to_P: FloatArray
) -> None:  # pragma: no cover - compiled
    """What source i brings into mode j: another mode's acceleration is not kept."""
    to_x[:] = x
    to_P[:] = P
    if i != j:
        to_P[_A, :] = 0.0
        to_P[:, _A] = 0.0
        to_x[_A] = (0.0, RAMP, -RAMP)[j]
        to_P[_A, _A] = _TINY if j == 0 else RAMP_STD**2


@numba.njit(nogil=True, cache=True, error_model="numpy")
def filter_speeds_(
    t: FloatArray,
    s: FloatArray,
    v: FloatArray,
    r: FloatArray,
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Forwards; x (K, M, 3), P (K, M, 3, 3), mu (K, M) written, the rest as for `draw_speeds_`."""
    F, Q, Pi = np.eye(3), np.zeros((N_MODES, 3, 3)), np.zeros((N_MODES, N_MODES))
    a, A = np.zeros(3), np.zeros((3, 3))
    log_mu = np.zeros(N_MODES)
    for k in range(len(t)):
        if k > 0:
            models_(t[k] - t[k - 1], F, Q, Pi)
        for j in range(N_MODES):
            prior = 1.0 / N_MODES
            if k == 0:
                A[:] = np.diag(np.array([1e4, 30.0**2, 1.0]))
                a[:] = 0.0
                a[_S] = s[0] if s[0] == s[0] else 0.0
                a[_V] = v[0] if v[0] == v[0] else 0.0
                enter_(-1, j, a, A, x[0, j], P[0, j])
            else:
                prior = 0.0
                mean, cov = np.zeros(3), np.zeros((3, 3))
                for i in range(N_MODES):
                    prior += Pi[i, j] * mu[k - 1, i]
                for i in range(N_MODES):
                    enter_(i, j, x[k - 1, i], P[k - 1, i], a, A)
                    w = Pi[i, j] * mu[k - 1, i] / prior
                    mean += w * a
                    cov += w * (A + np.outer(a, a))
                cov -= np.outer(mean, mean)
                x[k, j] = F @ mean
                P[k, j] = F @ cov @ F.T + Q[j]
            log_mu[j] = math.log(prior)
            for c in (_S, _V):
                z = s[k] if c == _S else v[k]
                if math.isnan(z):
                    continue
                e = z - x[k, j, c]
                var = P[k, j, c, c] + r[k, c]
                log_mu[j] -= 0.5 * (min(e * e / var, OUTLIER) + math.log(var))
                gain = P[k, j, :, c] / var
                x[k, j] += gain * e
                P[k, j] -= np.outer(gain, gain) * var
            if j > 0:
                up = x[k, j, _A] if j == 1 else -x[k, j, _A]
                deviation = (WEAKEST - up) / math.sqrt(2.0 * max(P[k, j, _A, _A], _TINY))
                log_mu[j] += math.log(max(0.5 * math.erfc(deviation), 1e-9))
        top = np.max(log_mu)
        total = 0.0
        for j in range(N_MODES):
            mu[k, j] = math.exp(log_mu[j] - top) + 1e-9
            total += mu[k, j]
        mu[k] /= total


@numba.njit(nogil=True, cache=True, error_model="numpy")
def root_(A: FloatArray, L: FloatArray) -> None:  # pragma: no cover - compiled
    """Lower Cholesky factor of A (3, 3); what rounding made negative counts as nothing."""
    for s in range(3):
        for t in range(s + 1):
            v = A[s, t]
            for k in range(t):
                v -= L[s, k] * L[t, k]
            L[s, t] = math.sqrt(max(v, 1e-14)) if s == t else v / L[t, t]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def draw_speeds_(
    t: FloatArray,
    s: FloatArray,
    v: FloatArray,
    r: FloatArray,
    noise: Any,
    speed: FloatArray,
    rate: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Draw N paths of a vehicle's speed.

    Args:
        t: (K,) ascending [s].
        s, v: (K,) measured way and speed [m, m/s], NaN where there is none.
        r: (K, 2) variances of both.
        noise: state of the random numbers, see `noise`.
        speed, rate: (K, N) written [m/s, m/s²]; the rate is 0 where the path holds its speed.
    """
    n_rows, n_paths = speed.shape
    x, P = np.zeros((n_rows, N_MODES, 3)), np.zeros((n_rows, N_MODES, 3, 3))
    mu = np.zeros((n_rows, N_MODES))
    filter_speeds_(t, s, v, r, x, P, mu)
    F, Q, Pi = np.eye(3), np.zeros((N_MODES, 3, 3)), np.zeros((N_MODES, N_MODES))
    at, mode = np.zeros((n_paths, 3)), np.zeros(n_paths, np.int8)
    # of source i and mode j: predicted end, inverse of its covariance, log of source's weight,
    # gain of the source by the end, root of the covariance that is left
    px, Si = np.zeros((N_MODES, N_MODES, 3)), np.zeros((N_MODES, N_MODES, 3, 3))
    log_w = np.zeros((N_MODES, N_MODES))
    G, L = np.zeros((N_MODES, N_MODES, 3, 3)), np.zeros((N_MODES, N_MODES, 3, 3))
    a, A, e, w = np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros(N_MODES)
    words = load(noise)
    for b in range(n_rows):
        k = n_rows - 1 - b
        if b > 0:
            models_(t[k + 1] - t[k], F, Q, Pi)
        for i in range(N_MODES):
            if b == 0:
                root_(P[k, i], L[i, 0])
                continue
            for j in range(N_MODES):
                enter_(i, j, x[k, i], P[k, i], a, A)
                px[i, j] = F @ a
                S = F @ A @ F.T + Q[j]
                Si[i, j] = np.linalg.inv(S)
                log_w[i, j] = math.log(Pi[i, j] * mu[k, i]) - 0.5 * math.log(np.linalg.det(S))
                A[:] = P[k, i]
                if i != j:
                    A[:, _A] = 0.0
                G[i, j] = A @ F.T @ Si[i, j]
                root_(P[k, i] - G[i, j] @ S @ G[i, j].T, L[i, j])
        for n in range(n_paths):
            j = int(mode[n]) if b > 0 else 0
            top = -np.inf
            for i in range(N_MODES):
                w[i] = math.log(mu[k, i])
                if b > 0:
                    e[:] = at[n] - px[i, j]
                    w[i] = log_w[i, j]
                    for c in range(3):
                        for d in range(3):
                            w[i] -= 0.5 * e[c] * Si[i, j, c, d] * e[d]
                top = max(top, w[i])
            total = 0.0
            for i in range(N_MODES):
                w[i] = math.exp(w[i] - top)
                total += w[i]
            u, words = uniform(words)
            u *= total
            i = 0
            while i < N_MODES - 1 and u >= w[i]:
                u -= w[i]
                i += 1
            if b > 0:
                e[:] = at[n] - px[i, j]
                d2 = 0.0
                for c in range(3):
                    for d in range(3):
                        d2 += e[c] * Si[i, j, c, d] * e[d]
                # no path leads there by the filter, whose modes are Gaussians: back to it
                e *= min(1.0, FARTHEST / math.sqrt(max(d2, _TINY)))
            for c in range(3):
                at[n, c] = x[k, i, c]
                if b > 0:
                    for d in range(3):
                        at[n, c] += G[i, j, c, d] * e[d]
            for d in range(3):
                u, words = normal(words)
                for c in range(d, 3):
                    at[n, c] += L[i, j, c, d] * u
            mode[n] = i
            speed[k, n] = at[n, _V]
            rate[k, n] = at[n, _A] if i else 0.0
    store_(noise, words)


STEADY, PEAK = 0.5, 1.0
"""A vehicle recedes or approaches while its speed differs by more than the first [m/s], if it comes
to differ by the second."""
FLAT = 1e-3
"""A smaller rate of change [m/s²] is none."""


@numba.njit(nogil=True, cache=True, error_model="numpy")
def judge_speeds_(
    speed: FloatArray, rate: FloatArray, p: FloatArray
) -> None:  # pragma: no cover - compiled
    """In how many of the paths a vehicle recedes or approaches.

    It does where its speed differs by more than `STEADY` from the ego's, in a stretch that reaches
    `PEAK`; before and after, it does as long as the difference grows there, or shrinks.

    Args:
        speed, rate: (K, N) minus those of the ego.
        p: (K, 2) written: shares of paths receding and approaching.
    """
    n_rows, n_paths = speed.shape
    p[:] = 0.0
    for n in range(n_paths):
        for c in range(2):
            sign = 1.0 - 2.0 * c
            k = 0
            while k < n_rows:
                begin, peak = k, 0.0
                while k < n_rows and sign * speed[k, n] > STEADY:
                    peak = max(peak, sign * speed[k, n])
                    k += 1
                end = k
                if peak >= PEAK:
                    while (
                        begin > 0
                        and sign * rate[begin - 1, n] > FLAT
                        and 0.0 <= sign * speed[begin - 1, n] <= STEADY
                    ):
                        begin -= 1
                    while (
                        end < n_rows
                        and sign * rate[end, n] < -FLAT
                        and 0.0 <= sign * speed[end, n] <= STEADY
                    ):
                        end += 1
                    p[begin:end, c] += 1.0 / n_paths
                k += 1
