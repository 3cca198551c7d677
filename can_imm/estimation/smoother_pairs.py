"""One mode at the end of an interval and one before it: what the end tells of the beginning."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.estimation.kalman import predict_
from can_imm.estimation.layout import MAX_MODES, SPEED_STEP
from can_imm.types import AX, MAX_STATES, VX, VY, FloatArray, X, Y

LEAST_INFORMATION = 1e-9
"""What a component is taken to be told in any case, relative to what its prediction knew."""

_M, _N = MAX_MODES, MAX_STATES

SMOOTHER_DTYPE = np.dtype(
    [
        ("x", np.float64, (2, _M, _N)),
        ("P", np.float64, (2, _M, _N, _N)),
        ("mu", np.float64, (2, _M)),
        ("present", np.float64, (_M,)),
        ("w", np.float64, (_M,)),
        ("log_l", np.float64, (_M,)),
        ("px", np.float64, (_M, _N)),
        ("pP", np.float64, (_M, _N, _N)),
        ("C", np.float64, (_M, _N, _N)),
        ("dx", np.float64, (_M, _N)),
        ("sP", np.float64, (_M, _N, _N)),
        ("mean", np.float64, (_N,)),
        ("A", np.float64, (_N, _N)),
        ("B", np.float64, (_N, _N)),
        ("V", np.float64, (_N, _N)),
        ("h", np.float64, (_N, _N)),
        ("z", np.float64, (_N,)),
        ("r", np.float64, (_N,)),
        ("e", np.float64, (_N,)),
        ("g", np.float64, (_N,)),
    ],
    align=True,
)
"""Scratch of the backward pass, one layout for all banks; see `layout`.

``x``, ``P``, ``mu`` are smoothed, at the two ends of an interval in turn.  For one mode j at the
end and each source i before it: ``w`` weight, ``px``, ``pP`` the end as predicted, ``C`` covariance
of the beginning (rows) with the end (columns), ``dx``, ``sP`` what smoothing adds to the
beginning's mean and makes of its covariance.
"""


@numba.njit(nogil=True, cache=True, error_model="numpy")
def factor_(n: int, A: FloatArray) -> bool:  # pragma: no cover - compiled
    """Lower Cholesky factor of A in place (what lies above is left); False if it has none."""
    for s in range(n):
        scale = A[s, s]
        for t in range(s + 1):
            v = A[s, t]
            for k in range(t):
                v -= A[s, k] * A[t, k]
            if s == t:
                if not (v > 1e-14 * scale and v < np.inf):
                    return False
                A[s, s] = math.sqrt(v)
            else:
                A[s, t] = v / A[t, t]
    return True


@numba.njit(nogil=True, cache=True, error_model="numpy")
def eigen_(n: int, A: FloatArray, V: FloatArray) -> None:  # pragma: no cover - compiled
    """Eigenvalues of the symmetric A onto its diagonal, eigenvectors into the columns of V.

    Jacobi's rotations; what they leave beside the diagonal is nothing.
    """
    for s in range(n):
        for t in range(n):
            V[s, t] = 1.0 if s == t else 0.0
    for _ in range(12):
        off = 0.0
        size = 0.0
        for s in range(n):
            size += A[s, s] * A[s, s]
            for t in range(s):
                off += A[s, t] * A[s, t]
        if not off > 1e-28 * size:
            return
        for s in range(n - 1):
            for t in range(s + 1, n):
                if A[s, t] == 0.0:
                    continue
                theta = 0.5 * (A[t, t] - A[s, s]) / A[s, t]
                tan = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    tan = -tan
                cos = 1.0 / math.sqrt(tan * tan + 1.0)
                sin = tan * cos
                for k in range(n):
                    a = A[k, s]
                    b = A[k, t]
                    A[k, s] = cos * a - sin * b
                    A[k, t] = sin * a + cos * b
                for k in range(n):
                    a = A[s, k]
                    b = A[t, k]
                    A[s, k] = cos * a - sin * b
                    A[t, k] = sin * a + cos * b
                    a = V[k, s]
                    b = V[k, t]
                    V[k, s] = cos * a - sin * b
                    V[k, t] = sin * a + cos * b


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def enter_pair_(
    n: int, bank: Any, x: FloatArray, P: FloatArray, i: int, j: int, tau: float, work: Any
) -> None:  # pragma: no cover - compiled
    """What source i brings into mode j at the beginning of an interval: `interaction.mix_` alone.

    Writes mean and covariance into work.px[i], work.pP[i] and the covariance of the source's state
    (rows) with them (columns) into work.C[i]; what an entry replaces knows nothing of the source.
    Particles that enter their mode get a speed anywhere within the profile, and their first step is
    done with the old one; their acceleration is no more than a wide guess.
    """
    px = work.px[i]
    A = work.pP[i]
    C = work.C[i]
    replaced: int = bank.entry_sources[i, j]
    speed = bank.entry_mean[j, VX]
    speed_var = bank.entry_var[j, VX]
    first = 0.5 * tau
    second = tau * tau / 3.0
    particle = bank.is_particle[j] != 0
    if particle:
        replaced = (1 << n) - (1 << AX)
        if i != j:
            replaced |= SPEED_STEP
            low = bank.particle.f_min
            high = bank.particle.peak_high
            speed = 0.5 * (low + high)
            speed_var = (high - low) ** 2 / 12.0
            first = tau
            second = tau * tau
    for s in range(n):
        new = replaced >> s & 1
        px[s] = x[s]
        for t in range(n):
            C[t, s] = 0.0 if new else P[t, s]
            A[s, t] = 0.0 if replaced & (1 << s | 1 << t) else P[s, t]
        if new and s == VX:
            px[s] = speed
            A[s, s] = speed_var
        elif new:
            px[s] = 0.0 if particle else bank.entry_mean[j, s]
            A[s, s] = bank.birth_std[s] ** 2 if particle else bank.entry_var[j, s]
    if replaced & (SPEED_STEP | 1 << X) != SPEED_STEP:
        return
    # x - a (v_new - v_old), the change a seconds before the end of the interval
    dv = speed - x[VX]
    px[X] -= first * dv
    A[X, X] += 2.0 * first * P[X, VX] + second * (speed_var + P[VX, VX])
    A[X, X] += (second - first * first) * dv * dv
    C[X, X] += first * P[X, VX]
    for s in range(1, n):
        C[s, X] += first * P[s, VX]
        if s == VX:
            A[s, X] = -first * speed_var
        elif not replaced >> s & 1:
            A[s, X] += first * P[VX, s]
        A[X, s] = A[s, X]


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def move_pair_(
    n: int, bank: Any, i: int, j: int, m: int, work: Any
) -> None:  # pragma: no cover - compiled
    """Move work.px[i], work.pP[i] and work.C[i] on by ``m`` steps of mode j, in place."""
    px = work.px[i]
    A = work.pP[i]
    C = work.C[i]
    F = bank.F[m, j]
    predict_(n, px, A, F, bank.Q[m, j])
    for s in range(n):
        for t in range(n):
            work.e[t] = 0.0
            for k in range(n):
                if F[t, k] != 0.0:
                    work.e[t] += C[s, k] * F[t, k]
        for t in range(n):
            C[s, t] = work.e[t]
    if bank.is_particle[j]:
        # what particles do in a step, as a Gaussian
        tau = m * bank.step_s
        par = bank.particle
        q = par.q_vy * tau
        A[X, X] += par.std_x**2 * tau
        A[Y, Y] += 0.25 * tau * tau * q
        A[Y, VY] += 0.5 * tau * q
        A[VY, Y] += 0.5 * tau * q
        A[VY, VY] += q
        if i == j:
            # the noise of both speeds, and the slope of the profile
            slope = 2.0 * px[VX] / (par.up * (par.length_low + par.length_high))
            A[VX, VX] += 2.0 * par.std_profile**2 + (slope * tau) ** 2
        else:
            A[VY, VY] += par.entry_vy_std**2


@numba.njit(nogil=True, cache=True, error_model="numpy")
def evidence_(n: int, n_modes: int, j: int, to: int, work: Any) -> bool:  # pragma: no cover
    """What has become known of the end in mode j since its prediction, as n scalar measurements.

    Prediction N(mean, A), all sources mixed, and smoothed end N(x, P) differ by the factor
    N(x, P) / N(mean, A).  In axes in which A is the unit matrix and P diagonal (w) that factor is a
    measurement of each component on its own, with variance 1 / (1 / w - 1).  A component that got
    wider carries no such information, only its shift.

    Reads work.w, work.px, work.pP of the sources; writes rows work.h, values work.z (of the
    difference from work.mean) and variances work.r.

    Returns:
        False if the prediction has no density.
    """
    total = 0.0
    for s in range(n):
        work.mean[s] = 0.0
        for t in range(n):
            work.A[s, t] = 0.0
    for i in range(n_modes):
        total += work.w[i]
        if work.w[i] > 0.0:
            for s in range(n):
                work.mean[s] += work.w[i] * work.px[i, s]
    for s in range(n):
        work.mean[s] /= total
    for i in range(n_modes):
        if work.w[i] > 0.0:
            q = work.w[i] / total
            for s in range(n):
                d = work.px[i, s] - work.mean[s]
                for t in range(s + 1):
                    work.A[s, t] += q * (work.pP[i, s, t] + d * (work.px[i, t] - work.mean[t]))
    if not factor_(n, work.A):
        return False
    A = work.A
    B = work.B
    # e = L^-1 (x - mean), B = L^-1 P L^-T
    for s in range(n):
        v = work.x[to, j, s] - work.mean[s]
        for k in range(s):
            v -= A[s, k] * work.e[k]
        work.e[s] = v / A[s, s]
        for t in range(n):
            v = work.P[to, j, s, t]
            for k in range(s):
                v -= A[s, k] * B[k, t]
            B[s, t] = v / A[s, s]
    for s in range(n):
        for t in range(n):
            v = B[s, t]
            for k in range(t):
                v -= A[t, k] * B[s, k]
            B[s, t] = v / A[t, t]
    for s in range(n):
        for t in range(s):
            B[t, s] = B[s, t]
    eigen_(n, B, work.V)
    for a in range(n):
        w = max(B[a, a], 1e-12)
        shift = 0.0
        for s in range(n):
            shift += work.V[s, a] * work.e[s]
        work.r[a] = 1.0 / max(1.0 / w - 1.0, LEAST_INFORMATION)
        work.z[a] = work.r[a] * shift / w
        # row a: column a of L^-T V
        for b in range(n):
            s = n - 1 - b
            v = work.V[s, a]
            for k in range(s + 1, n):
                v -= A[k, s] * work.h[a, k]
            work.h[a, s] = v / A[s, s]
        if not (abs(work.z[a]) < np.inf and abs(B[a, a]) < np.inf):
            return False
    return True


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def learn_pair_(n: int, i: int, P: FloatArray, work: Any) -> float:  # pragma: no cover - compiled
    """Let source i know of the evidence at the end: its smoothed state, and how likely that was.

    The change of its mean goes into work.dx[i], the covariance into work.sP[i]; work.px[i],
    work.pP[i], work.C[i] are used up.

    Args:
        P: (n, n) filtered covariance of the source.

    Returns:
        Log density of the evidence given the source.
    """
    px = work.px[i]
    A = work.pP[i]
    C = work.C[i]
    dx = work.dx[i]
    sP = work.sP[i]
    log_l = 0.0
    for s in range(n):
        dx[s] = 0.0
        for t in range(n):
            sP[s, t] = P[s, t]
    for a in range(n):
        h = work.h[a]
        e = work.z[a]
        S = work.r[a]
        for s in range(n):
            v = 0.0
            c = 0.0
            for t in range(n):
                v += A[s, t] * h[t]
                c += C[s, t] * h[t]
            work.e[s] = v
            work.g[s] = c
            e -= h[s] * (px[s] - work.mean[s])
            S += h[s] * v
        gain = e / S
        log_l -= 0.5 * (e * gain + math.log(S))
        for s in range(n):
            px[s] += work.e[s] * gain
            dx[s] += work.g[s] * gain
            for t in range(n):
                A[s, t] -= work.e[s] * work.e[t] / S
                C[s, t] -= work.g[s] * work.e[t] / S
                sP[s, t] -= work.g[s] * work.g[t] / S
    return log_l
