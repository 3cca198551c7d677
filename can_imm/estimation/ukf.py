"""IMM of unscented Kalman filters for one vehicle seen by lidars at known places.

Every model has the state x, vx, y, vy and the turn rate omega [m, m/s, m, m/s, rad/s].  "Constant
velocity" ignores omega, "constant turn" turns with it.  A lidar measures range and bearing; all
lidars that see the vehicle at one time make one stacked update, so that no order of the lidars is
preferred.  Filter: scaled unscented transform (van der Merwe 2004), sigma points drawn anew after
the time update so that they hold the process noise.  IMM: Bar-Shalom, Li, Kirubarajan (2001),
section 11.6: interact, predict, correct, combine.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.types import VX, VY, FloatArray, X, Y

OMEGA = 4
"""Index of the turn rate [rad/s], positive to the left."""
N = 5
"""Number of states."""
N_POINTS = 2 * N + 1

CV, CT = 0, 1
"""Kinds of models: constant velocity, constant turn."""

MAX_MODELS = 4
MAX_STEPS = 201
"""Length of the table of transition probabilities; longer gaps count as this long."""

SMALL_ANGLE = 1e-4
"""Below this turn per step [rad] two terms of the series are exact to double precision."""

_M = MAX_MODELS

# One fixed layout for all filters, see `can_imm.estimation.imm`.
PARAMETERS_DTYPE = np.dtype(
    [
        ("Pi", np.float64, (MAX_STEPS, _M, _M)),
        ("mu0", np.float64, (_M,)),
        ("q", np.float64, (_M,)),
        ("q_omega", np.float64, (_M,)),
        ("entry_mean", np.float64, (_M,)),
        ("entry_var", np.float64, (_M,)),
        ("mu_floor", np.float64),
        ("step_s", np.float64),
        ("spread", np.float64),
        ("wm0", np.float64),
        ("wc0", np.float64),
        ("wi", np.float64),
        ("n_models", np.int64),
        ("kind", np.int64, (_M,)),
    ],
    align=True,
)
"""Parameters of the filter.

``Pi[m, i, j]`` is the probability of going from model i to j in m steps of ``step_s``.  ``q`` is
the spectral density of the acceleration [m²/s³], ``q_omega`` that of the turn rate's derivative
[rad²/s³].  Whoever enters a model from another one gets a turn rate with ``entry_mean`` and
``entry_var`` [rad/s, rad²/s²].  Sigma points lie ``spread`` standard deviations out, with weights
``wm0`` (mean) and ``wc0`` (covariance) in the centre and ``wi`` for each of the others:
`set_spread_`.
"""

TRACK_DTYPE = np.dtype(
    [
        ("x", np.float64, (_M, N)),
        ("P", np.float64, (_M, N, N)),
        ("mu", np.float64, (_M,)),
        ("mean", np.float64, (N,)),
        ("cov", np.float64, (N, N)),
    ],
    align=True,
)
"""One vehicle: mean and covariance per model, model probabilities, the combined estimate."""

SCRATCH_DTYPE = np.dtype(
    [
        ("x", np.float64, (_M, N)),
        ("P", np.float64, (_M, N, N)),
        ("from_x", np.float64, (_M, N)),
        ("from_P", np.float64, (_M, N, N)),
        ("w", np.float64, (_M,)),
        ("prior", np.float64, (_M,)),
        ("log_l", np.float64, (_M,)),
        ("points", np.float64, (N_POINTS, N)),
        ("L", np.float64, (N, N)),
    ],
    align=True,
)
"""Working memory of the kernels that does not depend on the number of lidars."""


def set_spread_(par: Any, alpha: float = 1.0, beta: float = 0.0, kappa: float = 0.0) -> None:
    """Choose the sigma points of a record of `PARAMETERS_DTYPE` (van der Merwe's scaled set).

    The default is the cubature rule: no weight in the centre, none negative, so that the
    covariances stay positive definite.
    """
    scale = alpha * alpha * (N + kappa)
    par["spread"] = math.sqrt(scale)
    par["wm0"] = 1.0 - N / scale
    par["wc0"] = par["wm0"] + 1.0 - alpha * alpha + beta
    par["wi"] = 0.5 / scale


@numba.njit(nogil=True, cache=True, error_model="numpy")
def wrap(angle: float) -> float:  # pragma: no cover - compiled
    """The same angle in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@numba.njit(nogil=True, cache=True, error_model="numpy")
def turn_(p: FloatArray, dt: float) -> None:  # pragma: no cover - compiled
    """Move a state (5,) on by ``dt`` seconds in a constant turn, in place."""
    u = p[OMEGA] * dt
    c = math.cos(u)
    s = math.sin(u)
    if abs(u) < SMALL_ANGLE:
        along = dt * (1.0 - u * u / 6.0)
        across = dt * u * (0.5 - u * u / 24.0)
    else:
        half = math.sin(0.5 * u)
        along = dt * s / u
        across = dt * 2.0 * half * half / u  # 1 - cos u without its cancellation
    vx, vy = p[VX], p[VY]
    p[X] += vx * along - vy * across
    p[Y] += vx * across + vy * along
    p[VX] = vx * c - vy * s
    p[VY] = vx * s + vy * c


@numba.njit(nogil=True, cache=True, error_model="numpy")
def move_(kind: int, p: FloatArray, dt: float) -> None:  # pragma: no cover - compiled
    """Move a state (5,) on by ``dt`` seconds as the model says, in place; omega stays."""
    if kind == CT:
        turn_(p, dt)
    else:
        p[X] += p[VX] * dt
        p[Y] += p[VY] * dt


@numba.njit(nogil=True, cache=True, error_model="numpy")
def cholesky_(n: int, A: FloatArray, L: FloatArray) -> bool:  # pragma: no cover - compiled
    """Lower triangle L of A = L L'; False where A (n, n) is not positive definite and finite."""
    for i in range(n):
        for j in range(i + 1):
            s = A[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not (s > 0.0 and s < np.inf):
                    return False
                L[i, i] = math.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    return True


@numba.njit(nogil=True, cache=True, error_model="numpy")
def sigma_points_(
    x: FloatArray, P: FloatArray, spread: float, points: FloatArray, L: FloatArray
) -> bool:  # pragma: no cover - compiled
    """Sigma points (11, 5) of N(x, P): x, x ± spread L[:, k]; False: P has no root L."""
    if not cholesky_(N, P, L):
        return False
    for i in range(N):
        points[0, i] = x[i]
        for k in range(N):
            d = spread * L[i, k] if k <= i else 0.0
            points[1 + k, i] = x[i] + d
            points[1 + N + k, i] = x[i] - d
    return True


@numba.njit(nogil=True, cache=True, error_model="numpy")
def predict_(
    par: Any, j: int, x: FloatArray, P: FloatArray, dt: float, points: FloatArray, L: FloatArray
) -> bool:  # pragma: no cover - compiled
    """Unscented time update of model j by ``dt`` seconds, in place; False if P has no root.

    Noise: white acceleration in both axes, and a random walk of omega.
    """
    if not sigma_points_(x, P, par.spread, points, L):
        return False
    for k in range(N_POINTS):
        move_(par.kind[j], points[k], dt)
    for i in range(N):
        s = par.wm0 * points[0, i]
        for k in range(1, N_POINTS):
            s += par.wi * points[k, i]
        x[i] = s
    for i in range(N):
        for m in range(i + 1):
            s = par.wc0 * (points[0, i] - x[i]) * (points[0, m] - x[m])
            for k in range(1, N_POINTS):
                s += par.wi * (points[k, i] - x[i]) * (points[k, m] - x[m])
            P[i, m] = s
            P[m, i] = s
    q = par.q[j]
    for i in (X, Y):
        P[i, i] += q * dt * dt * dt / 3.0
        P[i, i + 1] += q * dt * dt / 2.0
        P[i + 1, i] += q * dt * dt / 2.0
        P[i + 1, i + 1] += q * dt
    P[OMEGA, OMEGA] += par.q_omega[j] * dt
    return True


@numba.njit(nogil=True, cache=True, error_model="numpy")
def observe_(
    par: Any,
    n_lidars: int,
    places: FloatArray,
    points: FloatArray,
    seen: FloatArray,
    mean: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Range and bearing of every sigma point from every lidar, as deviations from their mean.

    Bearings are averaged around that of the central point, so that it does not matter where an
    angle wraps.

    Args:
        par: parameters, for the weights.
        n_lidars: number of rows of ``places`` in use.
        places: (n_lidars, >= 2) x and y of the lidars [m].
        points: (11, 5) sigma points.
        seen: (11, 2 n_lidars) deviations; columns 2k range [m], 2k + 1 bearing [rad].
        mean: (2 n_lidars,) predicted measurement.
    """
    for s in range(n_lidars):
        r, b = 2 * s, 2 * s + 1
        centre = 0.0
        mean_range = 0.0
        mean_bearing = 0.0
        for k in range(N_POINTS):
            dx, dy = points[k, X] - places[s, 0], points[k, Y] - places[s, 1]
            seen[k, r] = math.hypot(dx, dy)
            bearing = math.atan2(dy, dx)
            if k == 0:
                centre = bearing
            seen[k, b] = wrap(bearing - centre)
            w = par.wm0 if k == 0 else par.wi
            mean_range += w * seen[k, r]
            mean_bearing += w * seen[k, b]
        mean[r] = mean_range
        mean[b] = wrap(centre + mean_bearing)
        for k in range(N_POINTS):
            seen[k, r] -= mean_range
            seen[k, b] -= mean_bearing


@numba.njit(nogil=True, cache=True, error_model="numpy")
def surprise_(
    par: Any,
    x: FloatArray,
    P: FloatArray,
    n: int,
    places: FloatArray,
    z: FloatArray,
    r: FloatArray,
    d2: FloatArray,
    points: FloatArray,
    L: FloatArray,
    seen: FloatArray,
    mean: FloatArray,
) -> bool:  # pragma: no cover - compiled
    """Squared Mahalanobis distance d2 (n,) of each detection by itself; False if P has no root.

    Arguments as in `correct_`.  Chi-square with 2 degrees of freedom if the prediction is right.
    """
    if not sigma_points_(x, P, par.spread, points, L):
        return False
    observe_(par, n, places, points, seen, mean)
    for s in range(n):
        a, b = 2 * s, 2 * s + 1
        saa = r[s, 0]
        sab = 0.0
        sbb = r[s, 1]
        for k in range(N_POINTS):
            w = par.wc0 if k == 0 else par.wi
            saa += w * seen[k, a] * seen[k, a]
            sab += w * seen[k, a] * seen[k, b]
            sbb += w * seen[k, b] * seen[k, b]
        ea = z[s, 0] - mean[a]
        eb = wrap(z[s, 1] - mean[b])
        determinant = saa * sbb - sab * sab
        d2[s] = (ea * ea * sbb - 2.0 * ea * eb * sab + eb * eb * saa) / determinant
    return True


@numba.njit(nogil=True, cache=True, error_model="numpy")
def correct_(
    par: Any,
    x: FloatArray,
    P: FloatArray,
    n: int,
    places: FloatArray,
    z: FloatArray,
    r: FloatArray,
    points: FloatArray,
    L: FloatArray,
    seen: FloatArray,
    mean: FloatArray,
    S: FloatArray,
    C: FloatArray,
) -> float:  # pragma: no cover - compiled
    """Unscented update by n detections at once, in place.

    Args:
        par: parameters, for the sigma points.
        x: (5,) mean.  P: (5, 5) covariance.
        n: number of detections, >= 1; what lies beyond in the arrays is left alone.
        places: (n, >= 2) where each detection was made from [m].
        z: (n, 2) range [m] and bearing [rad] against the x axis.
        r: (n, 2) their variances, > 0.
        points, L, seen, mean: scratch (11, 5), (5, 5), (11, 2n), (2n,).
        S: scratch (2n, 2n); holds the root of the innovation covariance afterwards.
        C: scratch (5, 2n).

    Returns:
        Log likelihood of the detections; NaN (and x, P untouched) if a covariance has no root.
    """
    if not sigma_points_(x, P, par.spread, points, L):
        return np.nan
    observe_(par, n, places, points, seen, mean)
    nz = 2 * n
    for a in range(nz):
        for b in range(a + 1):
            s = par.wc0 * seen[0, a] * seen[0, b]
            for k in range(1, N_POINTS):
                s += par.wi * seen[k, a] * seen[k, b]
            S[a, b] = s
        S[a, a] += r[a // 2, a % 2]
    for i in range(N):
        for a in range(nz):
            s = par.wc0 * (points[0, i] - x[i]) * seen[0, a]
            for k in range(1, N_POINTS):
                s += par.wi * (points[k, i] - x[i]) * seen[k, a]
            C[i, a] = s
    if not cholesky_(nz, S, S):
        return np.nan
    # With S = L L': e <- L^-1 e and C <- C L^-T, so that x += C e and P -= C C'.
    log_l = -0.5 * nz * math.log(2.0 * math.pi)
    for a in range(nz):
        e = z[a // 2, a % 2] - mean[a]
        if a % 2:
            e = wrap(e)
        for b in range(a):
            e -= S[a, b] * mean[b]
        mean[a] = e / S[a, a]
        log_l -= math.log(S[a, a]) + 0.5 * mean[a] * mean[a]
        for i in range(N):
            s = C[i, a]
            for b in range(a):
                s -= C[i, b] * S[a, b]
            C[i, a] = s / S[a, a]
    if not abs(log_l) < np.inf:
        return np.nan
    for i in range(N):
        for a in range(nz):
            x[i] += C[i, a] * mean[a]
        for j in range(i + 1):
            s = P[i, j]
            for a in range(nz):
                s -= C[i, a] * C[j, a]
            P[i, j] = s
            P[j, i] = s
    return log_l


@numba.njit(nogil=True, cache=True, error_model="numpy")
def mixture_(
    n_models: int,
    w: FloatArray,
    total: float,
    xs: FloatArray,
    Ps: FloatArray,
    x: FloatArray,
    P: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Mean and covariance of the mixture of N(xs[i], Ps[i]) with weights w[i] / total."""
    for a in range(N):
        s = 0.0
        for i in range(n_models):
            s += w[i] * xs[i, a]
        x[a] = s / total
    for a in range(N):
        for b in range(a + 1):
            s = 0.0
            for i in range(n_models):
                s += w[i] * (Ps[i, a, b] + (xs[i, a] - x[a]) * (xs[i, b] - x[b]))
            P[a, b] = s / total
            P[b, a] = s / total


@numba.njit(nogil=True, cache=True, error_model="numpy")
def interact_(par: Any, track: Any, work: Any, m: int) -> None:  # pragma: no cover - compiled
    """Mixing over m steps: every model begins from what all models say, weighted by Pi.

    Who changes the model gets the turn rate of those who enter it.  The mixed moments go back into
    ``track.x``, ``track.P``; ``track.mu`` becomes the prediction.
    """
    n_models = par.n_models
    for j in range(n_models):
        c = 0.0
        for i in range(n_models):
            work.w[i] = par.Pi[m, i, j] * track.mu[i]
            c += work.w[i]
            enters = i != j
            for a in range(N):
                work.from_x[i, a] = track.x[i, a]
                for b in range(N):
                    replaced = enters and (a == OMEGA or b == OMEGA)
                    work.from_P[i, a, b] = 0.0 if replaced else track.P[i, a, b]
            if enters:
                work.from_x[i, OMEGA] = par.entry_mean[j]
                work.from_P[i, OMEGA, OMEGA] = par.entry_var[j]
        work.prior[j] = c
        mixture_(n_models, work.w, c, work.from_x, work.from_P, work.x[j], work.P[j])
    for j in range(n_models):
        track.mu[j] = work.prior[j]
        for a in range(N):
            track.x[j, a] = work.x[j, a]
            for b in range(N):
                track.P[j, a, b] = work.P[j, a, b]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def advance_(par: Any, track: Any, work: Any, dt: float) -> bool:  # pragma: no cover - compiled
    """Interact and predict by ``dt`` seconds; the combined estimate follows.  False: failure."""
    m = min(int(dt / par.step_s + 0.5), MAX_STEPS - 1)
    interact_(par, track, work, m)
    for j in range(par.n_models):
        if not predict_(par, j, track.x[j], track.P[j], dt, work.points, work.L):
            return False
    mixture_(par.n_models, track.mu, 1.0, track.x, track.P, track.mean, track.cov)
    return True


@numba.njit(nogil=True, cache=True, error_model="numpy")
def gate_(
    par: Any,
    track: Any,
    work: Any,
    n: int,
    places: FloatArray,
    z: FloatArray,
    r: FloatArray,
    d2: FloatArray,
    one: FloatArray,
    seen: FloatArray,
    mean: FloatArray,
) -> bool:  # pragma: no cover - compiled
    """Distance d2 (n,) of each detection from the model that expects it most.  False: failure.

    ``one`` (n,) is scratch, the others as in `correct_`.
    """
    for s in range(n):
        d2[s] = np.inf
    for j in range(par.n_models):
        x, P = track.x[j], track.P[j]
        if not surprise_(par, x, P, n, places, z, r, one, work.points, work.L, seen, mean):
            return False
        for s in range(n):
            d2[s] = min(d2[s], one[s])
    return True


@numba.njit(nogil=True, cache=True, error_model="numpy")
def update_(
    par: Any,
    track: Any,
    work: Any,
    n: int,
    places: FloatArray,
    z: FloatArray,
    r: FloatArray,
    seen: FloatArray,
    mean: FloatArray,
    S: FloatArray,
    C: FloatArray,
) -> bool:  # pragma: no cover - compiled
    """Correct every model by all n >= 1 detections and combine.  False: failure.

    Arguments as in `correct_`.  A model whose probability would fall below ``mu_floor`` keeps it.
    """
    best = -np.inf
    for j in range(par.n_models):
        log_l = correct_(
            par, track.x[j], track.P[j], n, places, z, r, work.points, work.L, seen, mean, S, C
        )
        if not abs(log_l) < np.inf:
            return False
        work.log_l[j] = log_l + math.log(track.mu[j])
        best = max(best, work.log_l[j])
    total = 0.0
    for j in range(par.n_models):
        track.mu[j] = math.exp(work.log_l[j] - best)
        total += track.mu[j]
    floored = 0.0
    for j in range(par.n_models):
        track.mu[j] = max(track.mu[j] / total, par.mu_floor)
        floored += track.mu[j]
    for j in range(par.n_models):
        track.mu[j] /= floored
    mixture_(par.n_models, track.mu, 1.0, track.x, track.P, track.mean, track.cov)
    return True


@numba.njit(nogil=True, cache=True, error_model="numpy")
def begin_(
    par: Any, track: Any, place: FloatArray, z: FloatArray, r: FloatArray, speed_var: float
) -> None:  # pragma: no cover - compiled
    """Begin a track at one detection: position from it, velocity 0, the models' entry turn rates.

    Position covariance: across the ray the bearing's noise as an arc, along it the range's noise
    and the arc's sagitta.

    Args:
        par: parameters.  track: record of `TRACK_DTYPE`.
        place: (>= 2,) where the lidar stands [m].
        z: (2,) range [m] and bearing [rad].  r: (2,) their variances.
        speed_var: variance of each component of the velocity [m²/s²].
    """
    c, s = math.cos(z[1]), math.sin(z[1])
    across = z[0] * z[0] * r[1]
    along = r[0] + 0.5 * across * r[1]
    for j in range(par.n_models):
        track.mu[j] = par.mu0[j]
        for a in range(N):
            track.x[j, a] = 0.0
            for b in range(N):
                track.P[j, a, b] = 0.0
        track.x[j, X] = place[0] + z[0] * c
        track.x[j, Y] = place[1] + z[0] * s
        track.P[j, X, X] = along * c * c + across * s * s
        track.P[j, Y, Y] = along * s * s + across * c * c
        track.P[j, X, Y] = (along - across) * c * s
        track.P[j, Y, X] = track.P[j, X, Y]
        track.P[j, VX, VX] = speed_var
        track.P[j, VY, VY] = speed_var
        track.x[j, OMEGA] = par.entry_mean[j]
        track.P[j, OMEGA, OMEGA] = par.entry_var[j]
    mixture_(par.n_models, track.mu, 1.0, track.x, track.P, track.mean, track.cov)
