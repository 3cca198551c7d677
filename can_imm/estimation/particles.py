"""Constrained bootstrap particle filter for the mode with a speed profile over the gap.

The mode says: the relative speed follows a profile f over the distance gained (the paper's Fig. 4)
and the lateral position lies in a window.  Neither is Gaussian, so the mode is represented by
particles.  A particle carries its own profile: the gap x_e at which it entered the mode, the peak
speed and the length, so that f(x - x_e) needs no prior knowledge of where an overtaking starts.
With ``absolute`` set, x_e is fixed and f is the one curve of the paper.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.estimation.kalman import LOG_2PI
from can_imm.estimation.noise import NoiseState, load, normal, store_, uniform
from can_imm.types import FloatArray

PX, PVX, PY, PVY, ENTRY, PEAK, LENGTH = 0, 1, 2, 3, 4, 5, 6
N_COLUMNS = 7
"""Columns of the particle array: state, then the particle's own profile."""

PARTICLE_DTYPE = np.dtype(
    [
        ("entry", np.float64),
        ("up", np.float64),
        ("down", np.float64),
        ("peak_low", np.float64),
        ("peak_high", np.float64),
        ("length_low", np.float64),
        ("length_high", np.float64),
        ("f_min", np.float64),
        ("y_low", np.float64),
        ("y_high", np.float64),
        ("std_x", np.float64),
        ("std_profile", np.float64),
        ("q_vy", np.float64),
        ("entry_vy_std", np.float64),
        ("absolute", np.int8),
    ],
    align=True,
)
"""Parameters of the mode, one record; lengths in m, speeds in m/s, times in s."""


@numba.njit(nogil=True, cache=True, error_model="numpy")
def profile_speed(
    gained: float, peak: float, length: float, up: float, down: float
) -> float:  # pragma: no cover - compiled
    """Trapezoid in the phase plane: relative speed after ``gained`` metres of ``length``.

    ``up`` and ``down`` are the fractions of the length at which the plateau begins and ends.
    """
    u = gained / length
    if u <= 0.0 or u >= 1.0:
        return 0.0
    if u < up:
        return peak * u / up
    if u > down:
        return peak * (1.0 - u) / (1.0 - down)
    return peak


@numba.njit(nogil=True, cache=True, error_model="numpy")
def cholesky4_(P: FloatArray, L: FloatArray) -> None:  # pragma: no cover - compiled
    """Lower factor of the leading 4 x 4 block; a pivot that is not positive becomes zero."""
    for i in range(4):
        for j in range(i + 1):
            s = P[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                L[i, i] = math.sqrt(s) if s > 0.0 else 0.0
            else:
                L[i, j] = s / L[j, j] if L[j, j] > 0.0 else 0.0


@numba.njit(nogil=True, cache=True, error_model="numpy")
def enter_(
    p: FloatArray, first: int, count: int, x: FloatArray, L: FloatArray, par: Any, noise: NoiseState
) -> None:  # pragma: no cover - compiled
    """Draw ``count`` particles that enter the mode from a Gaussian N(x, L L').

    Args:
        p: (N, 7) particles; rows first .. first + count - 1 are written.
        x: (>= 4,) mean.  L: (4, 4) lower Cholesky factor.
        par: record of `PARTICLE_DTYPE`.
        noise: state of the random numbers.
    """
    s = load(noise)
    # two independent normal terms of vy in one draw
    vy3 = math.sqrt(L[3, 3] ** 2 + par.entry_vy_std**2)
    for a in range(first, first + count):
        e0, s = normal(s)
        e1, s = normal(s)
        e2, s = normal(s)
        e3, s = normal(s)
        p[a, PX] = x[0] + L[0, 0] * e0
        p[a, PVX] = x[1] + L[1, 0] * e0 + L[1, 1] * e1
        p[a, PY] = x[2] + L[2, 0] * e0 + L[2, 1] * e1 + L[2, 2] * e2
        p[a, PVY] = x[3] + L[3, 0] * e0 + L[3, 1] * e1 + L[3, 2] * e2 + vy3 * e3
        if par.absolute:
            p[a, ENTRY] = par.entry
            p[a, PEAK] = par.peak_low
            p[a, LENGTH] = par.length_low
        else:
            u0, s = uniform(s)
            u1, s = uniform(s)
            u2, s = uniform(s)
            peak = par.peak_low + (par.peak_high - par.peak_low) * u0
            ratio = par.length_low + (par.length_high - par.length_low) * u1
            length = peak * ratio
            # The mode is feasible from f_min on: enter between there and the end of the plateau, so
            # that a speed step is an entry as well as a ramp.
            begin = par.up * par.f_min / peak
            u = begin + (par.down - begin) * u2
            p[a, PEAK] = peak
            p[a, LENGTH] = length
            p[a, ENTRY] = p[a, PX] - u * length
    store_(noise, s)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def propagate_(
    p: FloatArray, tau: float, par: Any, noise: NoiseState
) -> None:  # pragma: no cover - compiled
    """Move particles by ``tau`` seconds: x with its speed, vx onto the profile, y and vy freely."""
    sx = par.std_x * math.sqrt(tau)
    sv = par.std_profile
    sy = math.sqrt(par.q_vy * tau)
    s = load(noise)
    for a in range(p.shape[0]):
        e0, s = normal(s)
        e1, s = normal(s)
        e2, s = normal(s)
        w = sy * e0
        p[a, PX] += tau * p[a, PVX] + sx * e1
        f = profile_speed(p[a, PX] - p[a, ENTRY], p[a, PEAK], p[a, LENGTH], par.up, par.down)
        p[a, PVX] = f + sv * e2
        p[a, PY] += tau * (p[a, PVY] + 0.5 * w)
        p[a, PVY] += w
    store_(noise, s)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def weigh_(
    p: FloatArray, logw: FloatArray, z: FloatArray, r: FloatArray, valid: Any, age: float, par: Any
) -> float:  # pragma: no cover - compiled
    """Log weights of constraint times measurement density.

    Args:
        p: (N, 7) particles.  logw: (N,) written.
        z, r: (4,) measured values and variances.  valid: (4,) bool.  age: of the measurement [s].

    Returns:
        log of mean_i[phi_i g_i]; -inf if no particle is feasible.
    """
    n = p.shape[0]
    log_r = math.log(r[0]), math.log(r[1]), math.log(r[2]), math.log(r[3])
    top = -np.inf
    for a in range(n):
        f = profile_speed(p[a, PX] - p[a, ENTRY], p[a, PEAK], p[a, LENGTH], par.up, par.down)
        lw = -np.inf
        if f >= par.f_min and par.y_low <= p[a, PY] <= par.y_high:
            lw = 0.0
            for c in range(4):
                if valid[c]:
                    e = z[c] - p[a, c]
                    if c == 0 or c == 2:
                        e += age * p[a, c + 1]
                    lw -= 0.5 * (e * e / r[c] + log_r[c] + LOG_2PI)
        logw[a] = lw
        top = max(top, lw)
    if top == -np.inf:
        return top
    s = 0.0
    for a in range(n):
        logw[a] = math.exp(logw[a] - top) if logw[a] > -np.inf else 0.0
        s += logw[a]
    for a in range(n):
        logw[a] /= s
    return top + math.log(s / n)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def moments_(
    p: FloatArray, w: FloatArray, x: FloatArray, P: FloatArray
) -> None:  # pragma: no cover - compiled
    """Weighted mean and covariance of the four states; ``w`` sums to 1."""
    # One pass each, so that the sums run beside one another and not after one another.
    for c in range(4):
        x[c] = 0.0
        for d in range(4):
            P[c, d] = 0.0
    m0 = m1 = m2 = m3 = 0.0
    for a in range(p.shape[0]):
        m0 += w[a] * p[a, 0]
        m1 += w[a] * p[a, 1]
        m2 += w[a] * p[a, 2]
        m3 += w[a] * p[a, 3]
    x[0], x[1], x[2], x[3] = m0, m1, m2, m3
    for a in range(p.shape[0]):
        if w[a] == 0.0:
            continue
        for c in range(4):
            wc = w[a] * (p[a, c] - x[c])
            for d in range(c + 1):
                P[c, d] += wc * (p[a, d] - x[d])
    for c in range(4):
        for d in range(c):
            P[d, c] = P[c, d]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def resample_(
    p: FloatArray, w: FloatArray, out: FloatArray, count: int, u: float
) -> None:  # pragma: no cover - compiled
    """Systematic resampling of ``count`` rows of ``p`` into ``out``; ``u`` uniform in [0, 1).

    ``w`` sums to 1 up to rounding; the last particle with weight takes what rounding leaves over.
    """
    n = p.shape[0]
    total = w[0]
    a = 0
    for k in range(count):
        target = (k + u) / count
        while total < target and a < n - 1:
            a += 1
            total += w[a]
        for c in range(p.shape[1]):
            out[k, c] = p[a, c]
