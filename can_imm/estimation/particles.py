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
from can_imm.estimation.vector import fast_exp
from can_imm.types import FloatArray

PX, PVX, PY, PVY, ENTRY, PEAK, LENGTH = 0, 1, 2, 3, 4, 5, 6
N_COLUMNS = 7
"""Rows of the particle array: state, then the particle's own profile."""

N_SCRATCH = N_COLUMNS + 3
"""Rows of the array in which particles are moved: three normal deviates beside them."""

_INFEASIBLE = -1e300

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


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def profile_speed(
    gained: float, peak: float, length: float, up: float, down: float
) -> float:  # pragma: no cover - compiled
    """Trapezoid in the phase plane: relative speed after ``gained`` metres of ``length``.

    ``up`` and ``down`` are the fractions of the length at which the plateau begins and ends.
    """
    u = gained / length
    # without a branch, for the compiler to vectorise
    return peak * max(min(u * (1.0 / up), (1.0 - u) * (1.0 / (1.0 - down)), 1.0), 0.0)


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
def moved_(
    x: FloatArray, P: FloatArray, tau: float, par: Any, mean: FloatArray, cov: FloatArray
) -> None:  # pragma: no cover - compiled
    """Where a vehicle of N(x, P) that enters the mode is ``tau`` seconds later, as `propagate_`
    would move it: mean and lower half of the covariance of x, y, vy then, and of x now.

    Args:
        x: (>= 4,).  P: (>= 4, >= 4).  mean: (4,), cov: (4, 4) written.
    """
    q = par.q_vy * tau
    vv = P[3, 3] + par.entry_vy_std**2
    mean[0] = x[0] + tau * x[1]
    mean[1] = x[2] + tau * x[3]
    mean[2] = x[3]
    mean[3] = x[0]
    cov[0, 0] = P[0, 0] + tau * (2.0 * P[0, 1] + tau * P[1, 1] + par.std_x**2)
    cov[1, 0] = P[0, 2] + tau * (P[0, 3] + P[1, 2] + tau * P[1, 3])
    cov[1, 1] = P[2, 2] + tau * (2.0 * P[2, 3] + tau * (vv + 0.25 * q))
    cov[2, 0] = P[0, 3] + tau * P[1, 3]
    cov[2, 1] = P[2, 3] + tau * (vv + 0.5 * q)
    cov[2, 2] = vv + q
    cov[3, 0] = P[0, 0] + tau * P[0, 1]
    cov[3, 1] = P[0, 2] + tau * P[0, 3]
    cov[3, 2] = P[0, 3]
    cov[3, 3] = P[0, 0]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def enter_(
    p: FloatArray,
    first: int,
    count: int,
    mean: FloatArray,
    L: FloatArray,
    par: Any,
    noise: NoiseState,
) -> None:  # pragma: no cover - compiled
    """Draw ``count`` particles that entered the mode and moved on.

    To draw where they are, instead of where they were and how they moved, takes half as many
    normal deviates.

    Args:
        p: (7, N) particles; columns first .. first + count - 1 are written.
        mean: (4,), L: (4, 4) of `moved_`, the latter as lower Cholesky factor.
        par: record of `PARTICLE_DTYPE`.
        noise: state of the random numbers.
    """
    s = load(noise)
    x, y, vy, before = mean[0], mean[1], mean[2], mean[3]
    l00, l10, l11, l20, l21, l22 = L[0, 0], L[1, 0], L[1, 1], L[2, 0], L[2, 1], L[2, 2]
    l30, l31, l32, l33 = L[3, 0], L[3, 1], L[3, 2], L[3, 3]
    up, down, f_min, sv = par.up, par.down, par.f_min, par.std_profile
    peak, length, entry = par.peak_low, par.length_low, par.entry
    peak_range, ratio_range = par.peak_high - peak, par.length_high - length
    absolute = par.absolute != 0
    for a in range(first, first + count):
        e0, s = normal(s)
        e1, s = normal(s)
        e2, s = normal(s)
        e3, s = normal(s)
        if not absolute:
            e4, s = normal(s)
            u0, s = uniform(s)
            u1, s = uniform(s)
            u2, s = uniform(s)
            peak = par.peak_low + peak_range * u0
            length = peak * (par.length_low + ratio_range * u1)
            # The mode is feasible from f_min on: enter between there and the end of the plateau, so
            # that a speed step is an entry as well as a ramp.
            begin = up * f_min / peak
            u = begin + (down - begin) * u2
            entry = before + l30 * e0 + l31 * e1 + l32 * e2 + l33 * e4 - u * length
        px = x + l00 * e0
        p[PX, a] = px
        p[PVX, a] = profile_speed(px - entry, peak, length, up, down) + sv * e3
        p[PY, a] = y + l10 * e0 + l11 * e1
        p[PVY, a] = vy + l20 * e0 + l21 * e1 + l22 * e2
        p[ENTRY, a] = entry
        p[PEAK, a] = peak
        p[LENGTH, a] = length
    store_(noise, s)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def propagate_(
    p: FloatArray, e: FloatArray, n: int, tau: float, par: Any, noise: NoiseState
) -> None:  # pragma: no cover - compiled
    """Move particles by ``tau`` seconds: x with its speed, vx onto the profile, y and vy freely.

    Args:
        p: (7, N) particles, of which the first n are moved.  e: (3, N) scratch.
    """
    s = load(noise)
    for a in range(n):
        e[0, a], s = normal(s)
        e[1, a], s = normal(s)
        e[2, a], s = normal(s)
    store_(noise, s)
    x, vx, y, vy = p[PX], p[PVX], p[PY], p[PVY]
    entry, peak, length = p[ENTRY], p[PEAK], p[LENGTH]
    e0, e1, e2 = e[0], e[1], e[2]
    sx = par.std_x * math.sqrt(tau)
    sv = par.std_profile
    sy = math.sqrt(par.q_vy * tau)
    up, down = par.up, par.down
    # One output per loop: with more the compiler gives up on telling the arrays apart.
    for a in range(n):
        x[a] += tau * vx[a] + sx * e1[a]
    for a in range(n):
        f = profile_speed(x[a] - entry[a], peak[a], length[a], up, down)
        vx[a] = f + sv * e2[a]
    for a in range(n):
        y[a] += tau * (vy[a] + 0.5 * sy * e0[a])
    for a in range(n):
        vy[a] += sy * e0[a]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def weigh_(
    p: FloatArray,
    w: FloatArray,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    age: float,
    angle: float,
    par: Any,
) -> float:  # pragma: no cover - compiled
    """Weights of constraint times measurement density.

    Args:
        p: (7, N) particles.  w: (N,) written, sums to 1.
        z, r: (4,) measured values and variances.  valid: (4,) bool.
        age: of the measurement [s].  angle: of the axes in which it was made [rad].

    Returns:
        log of mean_i[phi_i g_i]; -inf if no particle is feasible.
    """
    n = p.shape[1]
    log_peak = 0.0
    for c in range(4):
        if valid[c]:
            log_peak -= 0.5 * (LOG_2PI + math.log(r[c]))
    h0 = -0.5 / r[0] if valid[0] else 0.0
    h1 = -0.5 / r[1] if valid[1] else 0.0
    h2 = -0.5 / r[2] if valid[2] else 0.0
    h3 = -0.5 / r[3] if valid[3] else 0.0
    # what is not valid may be no number
    z0 = z[0] if valid[0] else 0.0
    z1 = z[1] if valid[1] else 0.0
    z2 = z[2] if valid[2] else 0.0
    z3 = z[3] if valid[3] else 0.0
    cos, sin = math.cos(angle), math.sin(angle)
    x, vx, y, vy = p[PX], p[PVX], p[PY], p[PVY]
    entry, peak, length = p[ENTRY], p[PEAK], p[LENGTH]
    up, down, f_min, y_low, y_high = par.up, par.down, par.f_min, par.y_low, par.y_high
    for a in range(n):
        f = profile_speed(x[a] - entry[a], peak[a], length[a], up, down)
        px = x[a] - age * vx[a]
        py = y[a] - age * vy[a]
        d0 = z0 - cos * px - sin * py
        d1 = z1 - cos * vx[a] - sin * vy[a]
        d2 = z2 + sin * px - cos * py
        d3 = z3 + sin * vx[a] - cos * vy[a]
        q = h0 * d0 * d0 + h1 * d1 * d1 + h2 * d2 * d2 + h3 * d3 * d3
        w[a] = q if (f >= f_min) & (y[a] >= y_low) & (y[a] <= y_high) else _INFEASIBLE
    # Four chains, so that the comparisons, and the sums, run beside one another.
    blocks = n // 4 * 4
    m0 = m1 = m2 = m3 = _INFEASIBLE
    for a in range(0, blocks, 4):
        m0 = max(m0, w[a])
        m1 = max(m1, w[a + 1])
        m2 = max(m2, w[a + 2])
        m3 = max(m3, w[a + 3])
    for a in range(blocks, n):
        m0 = max(m0, w[a])
    top = max(m0, m1, m2, m3)
    if top == _INFEASIBLE:
        return -np.inf
    for a in range(n):
        d = w[a] - top
        g = fast_exp(d)
        w[a] = g if d > -700.0 else 0.0
    m0 = m1 = m2 = m3 = 0.0
    for a in range(0, blocks, 4):
        m0 += w[a]
        m1 += w[a + 1]
        m2 += w[a + 2]
        m3 += w[a + 3]
    for a in range(blocks, n):
        m0 += w[a]
    s = (m0 + m1) + (m2 + m3)
    scale = 1.0 / s
    for a in range(n):
        w[a] *= scale
    return log_peak + top + math.log(s / n)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def moments_(
    p: FloatArray, w: FloatArray, x: FloatArray, P: FloatArray
) -> None:  # pragma: no cover - compiled
    """Weighted mean and covariance of the four states of particles p (7, N); ``w`` sums to 1."""
    n = p.shape[1]
    x0, x1, x2, x3 = p[PX], p[PVX], p[PY], p[PVY]
    # The sums run beside one another and not after one another.  Counted from any particle they
    # lose no digits to the distance from the origin.
    c0, c1, c2, c3 = x0[n // 2], x1[n // 2], x2[n // 2], x3[n // 2]
    m0 = m1 = m2 = m3 = 0.0
    for a in range(n):
        m0 += w[a] * (x0[a] - c0)
        m1 += w[a] * (x1[a] - c1)
        m2 += w[a] * (x2[a] - c2)
        m3 += w[a] * (x3[a] - c3)
    c0 += m0
    c1 += m1
    c2 += m2
    c3 += m3
    p00 = p10 = p11 = p20 = p21 = p22 = p30 = p31 = p32 = p33 = 0.0
    for a in range(n):
        d0, d1, d2, d3 = x0[a] - c0, x1[a] - c1, x2[a] - c2, x3[a] - c3
        v = w[a] * d0
        p00 += v * d0
        p10 += v * d1
        p20 += v * d2
        p30 += v * d3
        v = w[a] * d1
        p11 += v * d1
        p21 += v * d2
        p31 += v * d3
        v = w[a] * d2
        p22 += v * d2
        p32 += v * d3
        p33 += w[a] * d3 * d3
    x[0], x[1], x[2], x[3] = c0, c1, c2, c3
    P[0, 0], P[1, 1], P[2, 2], P[3, 3] = p00, p11, p22, p33
    P[1, 0], P[2, 0], P[2, 1], P[3, 0], P[3, 1], P[3, 2] = p10, p20, p21, p30, p31, p32
    P[0, 1], P[0, 2], P[1, 2], P[0, 3], P[1, 3], P[2, 3] = p10, p20, p21, p30, p31, p32


@numba.njit(nogil=True, cache=True, error_model="numpy")
def resample_(
    p: FloatArray, w: FloatArray, out: FloatArray, count: int, u: float
) -> None:  # pragma: no cover - compiled
    """Systematic resampling of ``count`` columns of ``p`` into ``out``; ``u`` uniform in [0, 1).

    ``w`` sums to 1 up to rounding; the last particle with weight takes what rounding leaves over.
    """
    n = w.shape[0]
    total = w[0] * count
    a = 0
    for k in range(count):
        while total < k + u and a < n - 1:
            a += 1
            total += w[a] * count
        for c in range(N_COLUMNS):
            out[c, k] = p[c, a]
