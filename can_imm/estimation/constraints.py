"""State constraints: projection, truncation to intervals, Gaussian interval masses.

Soft equality constraints need no kernel of their own: a row with value d and variance r is a
pseudo-measurement, `kalman.update_state_`.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from can_imm.estimation.stack import diagonal, element, stack_vector
from can_imm.types import MAX_STATES, FloatArray

SQRT_2 = math.sqrt(2.0)
LOG_SQRT_2PI = 0.5 * math.log(2.0 * math.pi)
SQRT_1_2PI = 1.0 / math.sqrt(2.0 * math.pi)
LOG_MASS_FLOOR = -700.0
"""Smallest log mass that is told apart: a tail of exp(-700) begins 37 sigma away."""
FAR = 9.0
"""What lies so many sigma away is less than rounding."""
FURTHER = 80.0
"""Where b^2 - a^2 is larger, the tail beyond b is less than rounding beside that beyond a."""
NARROW = 0.05
"""Below this width of an interval differences of tails lose digits: quadrature takes over."""
_NODES, _WEIGHTS = (tuple(map(float, column)) for column in np.polynomial.legendre.leggauss(6))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def log_upper_tail(a: float) -> float:  # pragma: no cover - compiled
    """log P(u > a) of a standard normal u, accurate in both tails."""
    if a < 25.0:
        return math.log(0.5 * math.erfc(a / SQRT_2))
    # Asymptotic series of the Mills ratio; relative error below 1e-12 from a = 25 on.
    b = 1.0 / (a * a)
    series = 1.0 - b * (1.0 - 3.0 * b * (1.0 - 5.0 * b * (1.0 - 7.0 * b * (1.0 - 9.0 * b))))
    return -0.5 * a * a - LOG_SQRT_2PI - math.log(a) + math.log(series)


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def _moments(
    lower: float, upper: float
) -> tuple[float, float, float]:  # pragma: no cover - compiled
    """Log mass, mean and variance of a standard normal restricted to [lower, upper].

    Either bound may be infinite.  Below a log mass of `LOG_MASS_FLOOR` the log mass is clipped
    there and the moments are those of the point of the interval that is nearest to 0.
    """
    flip = False
    if lower > -np.inf and (upper == np.inf or lower + upper > 0.0):
        a, b = lower, upper
    else:
        a, b = -upper, -lower
        flip = True
    # Now the interval lies to the right of 0 or covers it, and a is the nearer bound.
    if a < -FAR:
        return 0.0, 0.0, 1.0
    width = b - a
    middle = 0.5 * (a + b)
    s0 = 0.0
    s1 = 0.0
    s2 = 0.0
    two_sided = b * b - a * a < FURTHER
    mass = 0.0
    if width < NARROW:
        # Gauss-Legendre around the middle, where the density is a constant times
        # exp(-t (middle + t / 2)); relative error below 1e-10 while the mass is above the floor.
        for k in range(len(_NODES)):
            t = 0.5 * width * _NODES[k]
            v = 0.5 * _WEIGHTS[k] * math.exp(-t * (middle + 0.5 * t))
            s0 += v
            s1 += v * t
            s2 += v * t * t
        log_mass = math.log(s0) + math.log(width) - 0.5 * middle * middle - LOG_SQRT_2PI
    elif a < 25.0:
        mass = 0.5 * math.erfc(a / SQRT_2)
        if two_sided:
            mass -= 0.5 * math.erfc(b / SQRT_2)
        log_mass = math.log(mass)
    else:
        log_mass = log_upper_tail(a)
        if two_sided:
            log_mass += math.log(-math.expm1(log_upper_tail(b) - log_mass))
    if not log_mass > LOG_MASS_FLOOR:
        point = max(a, 0.0)
        mean = -point if flip else point
        return LOG_MASS_FLOOR, mean, 0.0
    if width < NARROW:
        mean = s1 / s0
        variance = max(s2 / s0 - mean * mean, 0.0)
        mean += middle
        return log_mass, -mean if flip else mean, variance
    if a < 25.0:
        pa = math.exp(-0.5 * a * a) * SQRT_1_2PI / mass
    else:
        pa = math.exp(-0.5 * a * a - LOG_SQRT_2PI - log_mass)
    mean = pa
    second = a * pa
    if two_sided:
        pb = pa * math.exp(0.5 * (a * a - b * b))
        mean -= pb
        second -= b * pb
    variance = max(1.0 + second - mean * mean, 0.0)
    return log_mass, -mean if flip else mean, variance


@numba.njit(nogil=True, cache=True, error_model="numpy")
def truncated_normal(
    lower: float, upper: float
) -> tuple[float, float, float]:  # pragma: no cover - compiled
    """Log mass, mean and variance of a standard normal restricted to [lower, upper].

    Either bound may be infinite.  Below a log mass of `LOG_MASS_FLOOR` the log mass is clipped
    there and the moments are those of the point of the interval that is nearest to 0.
    """
    return _moments(lower, upper)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def normal_mass(lower: float, upper: float) -> float:  # pragma: no cover - compiled
    """The log mass of `truncated_normal` alone; the compiler leaves out the moments."""
    return _moments(lower, upper)[0]


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def interval_probability(
    mean: float, variance: float, lower: float, upper: float
) -> float:  # pragma: no cover - compiled
    """Probability of [lower, upper] under N(mean, variance), right to 1e-16 (not relatively)."""
    below, above = mean - lower, upper - mean
    # what is far needs no root
    far = FAR * FAR * variance
    if below > 0.0 and above > 0.0 and below * below > far and above * above > far:
        return 1.0
    if (below < 0.0 and below * below > far) or (above < 0.0 and above * above > far):
        return 0.0
    scale = 1.0 / (SQRT_2 * math.sqrt(variance))
    # the nearer bound, to the right of the mean or the interval covers it, and the further one
    a, b = (-below, above) if above > below else (-above, below)
    p = 0.5 * math.erfc(a * scale)
    return p - 0.5 * math.erfc(b * scale) if b * b - a * a < FURTHER * variance else p


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def interval_mass(
    mean: float, p: float, lower: float, upper: float
) -> float:  # pragma: no cover - compiled
    """The log mass of `truncated` alone."""
    if not (p > 0.0 and p < np.inf):
        return np.nan
    sd = math.sqrt(p)
    return normal_mass((lower - mean) / sd, (upper - mean) / sd)


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def truncated(
    mean: float, p: float, lower: float, upper: float, floor: float
) -> tuple[float, float, float]:  # pragma: no cover - compiled
    """Log mass, mean and variance of N(mean, p) restricted to [lower, upper].

    The log mass is clipped at `LOG_MASS_FLOOR`, the variance at ``floor``; if p is not positive and
    finite, the log mass is NaN and the moments are those given.
    """
    if not (p > 0.0 and p < np.inf):
        return np.nan, mean, p
    sd = math.sqrt(p)
    log_mass, shift, share = truncated_normal((lower - mean) / sd, (upper - mean) / sd)
    return log_mass, mean + shift * sd, p * min(max(share, floor / p), 1.0)


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def set_marginal_(
    n: int, x: FloatArray, P: FloatArray, i0: int, mean: float, variance: float
) -> None:  # pragma: no cover - compiled
    """Give state ``i0`` another mean and variance, in place.

    The other states follow by their regression on it (Simon 2006, section 7.5.4).

    Args:
        n: number of states; the arrays may be larger, what lies beyond is left alone.
        x: (n,) mean.  P: (n, n) covariance; P[i0, i0] must be positive and finite.
    """
    slope = stack_vector(MAX_STATES)
    shift = mean - x[i0]
    change = variance - P[i0, i0]
    scale = 1.0 / P[i0, i0]
    for i in range(n):
        slope[i] = P[i, i0] * scale
        x[i] += slope[i] * shift
    for i in range(n):
        for j in range(i + 1):
            v = P[i, j] + slope[i] * slope[j] * change
            P[i, j] = v
            P[j, i] = v
    for i in range(n):
        P[i, i0] = slope[i] * variance
        P[i0, i] = slope[i] * variance
    x[i0] = mean
    P[i0, i0] = variance


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def truncate_(
    n: int, x: FloatArray, P: FloatArray, i0: int, lower: float, upper: float, floor: float
) -> float:  # pragma: no cover - compiled
    """Restrict state ``i0`` to [lower, upper]: exact truncated moments, in place.

    Args:
        n, x, P: as for `set_marginal_`.
        floor: smallest variance that is left to state ``i0``.

    Returns:
        Log of the mass that the Gaussian had inside, clipped at `LOG_MASS_FLOOR`; NaN (and x, P
        untouched) if the state's variance is not positive or not finite.
    """
    log_mass, mean, variance = truncated(element(n, x, i0), diagonal(n, P, i0), lower, upper, floor)
    if log_mass < 0.0:
        for s in range(n):
            if s == i0:  # a constant in each branch, see `stack`
                set_marginal_(n, x, P, s, mean, variance)
    return log_mass


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def project_(
    n: int, x: FloatArray, P: FloatArray, i0: int, d: float, floor: float
) -> bool:  # pragma: no cover - compiled
    """Project onto the hyperplane x[i0] = d with W = P^-1, in place ((24) to (28), corrected).

    x <- x - P D'(D P D')^-1 (D x - d) and P <- (I - G D) P (I - G D)' + floor on state ``i0``.
    Several rows one after the other give the same result as all at once.

    Returns:
        False (and x, P untouched) if the state's variance is not positive or not finite.
    """
    p = diagonal(n, P, i0)
    if not (p > 0.0 and p < np.inf):
        return False
    for s in range(n):
        if s == i0:
            set_marginal_(n, x, P, s, d, 0.0)
            P[s, s] = floor
    return True
