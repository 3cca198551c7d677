"""Kalman filter kernels: in place, allocation-free, one measured component at a time.

Every measurement and every pseudo-measurement of the system has a diagonal noise covariance, so
the vector update is done as a sequence of scalar ones.  That is algebraically the same (Bar-Shalom,
Li, Kirubarajan 2001, section 7.2), needs no matrix inverse and skips a missing component for free.
P stays symmetric by construction.

Scratch is on the stack (`stack`).  Given the number of states as a constant, and x and P on the
stack, too, the compiler unrolls everything and keeps it in registers.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from can_imm.estimation.stack import stack_matrix, stack_vector
from can_imm.types import MAX_STATES, FloatArray

LOG_2PI = math.log(2.0 * math.pi)
HUGE = 1e300
"""What is larger is a numeric failure (to compare with infinity takes the compiler far longer)."""


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def log_normal(e: float, s: float) -> float:  # pragma: no cover - compiled
    """Log density of a normal deviate ``e`` with variance ``s``."""
    return -0.5 * (LOG_2PI + math.log(s) + e * e / s)


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def predict_(
    n: int, x: FloatArray, P: FloatArray, F: FloatArray, Q: FloatArray
) -> None:  # pragma: no cover - compiled
    """Time update in place: x <- F x, P <- F P F' + Q.

    Args:
        n: number of states; every array may be larger, what lies beyond is left alone.
        x: (n,) mean.  P: (n, n) covariance.
        F: (n, n) transition.  Q: (n, n) process noise.
    """
    Fx, FP = stack_vector(MAX_STATES), stack_matrix(MAX_STATES, MAX_STATES)
    # F is mostly zeros: to look is cheaper than to multiply.
    for i in range(n):
        for j in range(n):
            FP[i, j] = 0.0
        s = 0.0
        for k in range(n):
            f = F[i, k]
            if f != 0.0:
                s += f * x[k]
                for j in range(n):
                    FP[i, j] += f * P[k, j]
        Fx[i] = s
    for i in range(n):
        x[i] = Fx[i]
    for j in range(n):
        for i in range(j, n):
            P[i, j] = Q[i, j]
        for k in range(n):
            f = F[j, k]
            if f != 0.0:
                for i in range(j, n):
                    P[i, j] += FP[i, k] * f
        for i in range(j, n):
            P[j, i] = P[i, j]


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def update_row_(
    n: int, x: FloatArray, P: FloatArray, h: FloatArray, z: float, r: float
) -> tuple[float, float]:  # pragma: no cover - compiled
    """Scalar measurement z = h x + v, v ~ N(0, r), in place.

    Args:
        n: number of states, as in `predict_`.
        x: (n,) mean.  P: (n, n) covariance.
        h: (n,) measurement row.  z: measured value.  r: its variance, >= 0.

    Returns:
        Innovation z - h x and its variance h P h' + r; the variance is NaN (and x, P untouched) if
        it would not be positive and finite.
    """
    Ph, gain = stack_vector(MAX_STATES), stack_vector(MAX_STATES)
    s = r
    e = z
    for i in range(n):
        Ph[i] = 0.0
    # A row has two or three entries.
    for k in range(n):
        if h[k] != 0.0:
            e -= h[k] * x[k]
            for i in range(n):
                Ph[i] += P[i, k] * h[k]
    for i in range(n):
        s += h[i] * Ph[i]
    if not (0.0 < s < HUGE and abs(e) < HUGE):
        return e, np.nan
    g = 1.0 / s
    for i in range(n):
        gain[i] = Ph[i] * g
        x[i] += gain[i] * e
    for i in range(n):
        for j in range(i + 1):
            v = P[i, j] - gain[i] * Ph[j]
            P[i, j] = v
            P[j, i] = v
    return e, s


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def update_state_(
    n: int, x: FloatArray, P: FloatArray, i0: int, z: float, r: float
) -> tuple[float, float]:  # pragma: no cover - compiled
    """`update_row_` for a row that selects the single state ``i0``; several times cheaper.

    The row of the state itself is scaled by r / s, which is where the Joseph form's digits matter.
    """
    column, gain = stack_vector(MAX_STATES), stack_vector(MAX_STATES)
    s = P[i0, i0] + r
    e = z - x[i0]
    if not (0.0 < s < HUGE and abs(e) < HUGE):
        return e, np.nan
    g = 1.0 / s
    for i in range(n):
        column[i] = P[i, i0]
        gain[i] = P[i, i0] * g
        x[i] += gain[i] * e
    for i in range(n):
        for j in range(i + 1):
            # in this order no more than two operations wait for the division
            v = P[i, j] - column[i] * column[j] * g
            P[i, j] = v
            P[j, i] = v
    for i in range(n):
        v = gain[i] * r
        P[i, i0] = v
        P[i0, i] = v
    return e, s
