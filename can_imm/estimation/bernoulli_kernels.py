"""The Bernoulli particle filter's inner loops.

Particles are columns: ``cloud`` is (4, N) with rows x, vx, y, vy.  The loops work in blocks that
stay in the first-level cache, each of them plain enough for the compiler to vectorise.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.estimation.vector import fast_angle, fast_exp, fast_log
from can_imm.types import FloatArray, IntArray

BLOCK = 512
"""Particles per block."""

OK, LOST = 0, 1
"""What a step returns: LOST means that no finite result exists and that nothing is tracked."""

(
    P_BIRTH, P_SURVIVAL, P_DETECTION, CLUTTER, RANGE_MAX, RATE_SPAN,
    STD_RANGE, STD_BEARING, STD_RATE, STD_TANGENTIAL, DENSITY, UNION,
) = range(12)  # fmt: skip
"""Places in the parameter vector, see `bernoulli.BernoulliModel`."""
N_PARAMETERS = 12

Q_MAX = 1.0 - 1e-12


@numba.njit(nogil=True, cache=True, error_model="numpy")
def birth_density_(
    z: FloatArray, pose: FloatArray, par: FloatArray, mean: FloatArray, cov: FloatArray
) -> None:  # pragma: no cover - compiled
    """Where the object is if it caused a detection: Gaussian in x, vx, y, vy, to first order.

    The range rate gives the radial speed; the tangential one, and the radial one where there is no
    range rate, is the sensor's own up to `STD_TANGENTIAL`.

    Args:
        z: (3,) range, bearing, range rate or NaN.  pose: (5,) of the sensor.  par: parameters.
        mean, cov: (4,), (4, 4), written.
    """
    angle = pose[2] + z[1]
    c, s = math.cos(angle), math.sin(angle)
    rate, var_radial = z[2], par[STD_RATE] ** 2
    if math.isnan(rate):
        rate, var_radial = 0.0, par[STD_TANGENTIAL] ** 2
    mean[0] = pose[0] + z[0] * c
    mean[1] = pose[3] + rate * c
    mean[2] = pose[1] + z[0] * s
    mean[3] = pose[4] + rate * s
    cov[:, :] = 0.0
    along, across = par[STD_RANGE] ** 2, (z[0] * par[STD_BEARING]) ** 2
    tangential = par[STD_TANGENTIAL] ** 2
    cov[0, 0] = along * c * c + across * s * s
    cov[2, 2] = along * s * s + across * c * c
    cov[0, 2] = cov[2, 0] = (along - across) * c * s
    cov[1, 1] = var_radial * c * c + tangential * s * s
    cov[3, 3] = var_radial * s * s + tangential * c * c
    cov[1, 3] = cov[3, 1] = (var_radial - tangential) * c * s


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _moved_factor_(
    mean: FloatArray, cov: FloatArray, dt: float, k: float, m: FloatArray, L: FloatArray
) -> None:  # pragma: no cover - compiled
    """Move a Gaussian by ``dt`` with constant velocity; writes its mean and Cholesky factor."""
    P = np.empty((4, 4))
    F = np.eye(4)
    F[0, 1] = F[2, 3] = dt
    for i in range(4):
        for j in range(4):
            a = 0.0
            for p in range(4):
                for q in range(4):
                    a += F[i, p] * cov[p, q] * F[j, q]
            P[i, j] = a
    for i in (0, 2):
        m[i] = mean[i] + dt * mean[i + 1]
        m[i + 1] = mean[i + 1]
        P[i, i] += k * dt**3 / 3.0
        P[i, i + 1] += k * dt**2 / 2.0
        P[i + 1, i] += k * dt**2 / 2.0
        P[i + 1, i + 1] += k * dt
    for i in range(4):
        for j in range(i + 1):
            a = P[i, j]
            for p in range(j):
                a -= L[i, p] * L[j, p]
            if i == j:
                L[i, i] = math.sqrt(a) if a > 0.0 else 0.0
            else:
                L[i, j] = a / L[j, j] if L[j, j] > 0.0 else 0.0


@numba.njit(nogil=True, cache=True, error_model="numpy")
def draw_births_(
    cloud: FloatArray,
    first: int,
    count: int,
    mean: FloatArray,
    cov: FloatArray,
    dt: float,
    k: float,
    rng: Any,
) -> None:  # pragma: no cover - compiled
    """Columns ``first`` to ``first + count - 1`` from a birth density moved by ``dt``; in pairs
    on opposite sides of its mean."""
    m = np.empty(4)
    L = np.zeros((4, 4))
    _moved_factor_(mean, cov, dt, k, m, L)
    for a in range(first, first + count, 2):
        e0 = rng.standard_normal()
        e1 = rng.standard_normal()
        e2 = rng.standard_normal()
        e3 = rng.standard_normal()
        d0 = L[0, 0] * e0
        d1 = L[1, 0] * e0 + L[1, 1] * e1
        d2 = L[2, 0] * e0 + L[2, 1] * e1 + L[2, 2] * e2
        d3 = L[3, 0] * e0 + L[3, 1] * e1 + L[3, 2] * e2 + L[3, 3] * e3
        cloud[0, a] = m[0] + d0
        cloud[1, a] = m[1] + d1
        cloud[2, a] = m[2] + d2
        cloud[3, a] = m[3] + d3
        if a + 1 < first + count:
            cloud[0, a + 1] = m[0] - d0
            cloud[1, a + 1] = m[1] - d1
            cloud[2, a + 1] = m[2] - d2
            cloud[3, a + 1] = m[3] - d3


@numba.njit(nogil=True, cache=True, error_model="numpy")
def move_(
    particles: FloatArray, cloud: FloatArray, dt: float, k: float, rng: Any
) -> None:  # pragma: no cover - compiled
    """Move all particles by ``dt`` [s] into the first columns of ``cloud``.

    Neighbours, which after resampling are mostly copies of one particle, get opposite noise: each
    still has the noise Σ_m = k [T³/3 T²/2; T²/2 T] per axis, but less of it is left in their mean.
    """
    a11 = math.sqrt(k * dt**3 / 3.0)
    a21 = math.sqrt(k * dt * 0.75)
    a22 = math.sqrt(k * dt * 0.25)
    n = particles.shape[1]
    for a in range(0, n, 2):
        for c in (0, 2):
            e1 = rng.standard_normal()
            e2 = rng.standard_normal()
            d = a11 * e1
            dv = a21 * e1 + a22 * e2
            v = particles[c + 1, a]
            cloud[c, a] = particles[c, a] + dt * v + d
            cloud[c + 1, a] = v + dv
            if a + 1 < n:
                v = particles[c + 1, a + 1]
                cloud[c, a + 1] = particles[c, a + 1] + dt * v - d
                cloud[c + 1, a + 1] = v - dv


@numba.njit(nogil=True, cache=True, error_model="numpy")
def weigh_(
    cloud: FloatArray,
    first: int,
    last: int,
    log_prior: float,
    pose: FloatArray,
    delay: FloatArray,
    starts: IntArray,
    z: FloatArray,
    par: FloatArray,
    log_weight: FloatArray,
    work: FloatArray,
) -> None:  # pragma: no cover - compiled
    """log of weight times ψ for columns ``first`` to ``last - 1`` of equal weight.

    Product update: ψ = Π_s [1 - p_d + p_d Σ_z g(z|x) / (λ c)] over the sensors s; a sensor beyond
    whose range a particle lies has no say in it.  Union (as published): ψ = 1 - p_d + p_d Σ g /
    (λ c) over all detections, with λ the clutter of all sensors.

    Args:
        cloud: (4, N).  log_prior: log weight of each of the columns.
        pose, delay: (S, 5) and (S,), as in `types.DetectionScan`.
        starts: (S + 1,) detections ``starts[s]`` to ``starts[s + 1] - 1`` are those of sensor s.
        z: (n, 3) range, bearing, range rate or NaN.  par: parameters.
        log_weight: (N,), written.  work: (6, BLOCK) scratch.
    """
    pd, union = par[P_DETECTION], par[UNION] != 0.0
    n_sensors = len(starts) - 1
    clutter = par[CLUTTER] * (n_sensors if union else 1)
    scale_polar = pd * par[RANGE_MAX] / (clutter * par[STD_RANGE] * par[STD_BEARING])
    scale_rate = par[RATE_SPAN] / (math.sqrt(2.0 * math.pi) * par[STD_RATE])
    inv_range, inv_bearing = 1.0 / par[STD_RANGE], 1.0 / par[STD_BEARING]
    # beyond so many standard deviations a detection does not change a double
    reach = 2.0 * (math.log(scale_polar * max(scale_rate, 1.0) / (1.0 - pd)) + 42.0)
    reach = math.sqrt(max(reach, 0.0)) * par[STD_RANGE]
    r, ux, uy, rate, ratio, psi = work[0], work[1], work[2], work[3], work[4], work[5]
    for begin in range(first, last, BLOCK):
        n = min(BLOCK, last - begin)
        x = cloud[0, begin : begin + n]
        vx = cloud[1, begin : begin + n]
        y = cloud[2, begin : begin + n]
        vy = cloud[3, begin : begin + n]
        x_low = x_high = x[0]
        y_low = y_high = y[0]
        for i in range(n):
            psi[i] = 1.0
            ratio[i] = 0.0
            x_low, x_high = min(x_low, x[i]), max(x_high, x[i])
            y_low, y_high = min(y_low, y[i]), max(y_high, y[i])
        cx, cy = 0.5 * (x_low + x_high), 0.5 * (y_low + y_high)
        radius = 0.5 * math.hypot(x_high - x_low, y_high - y_low)
        for s in range(n_sensors):
            sx, sy, heading = pose[s, 0], pose[s, 1], pose[s, 2]
            svx, svy, late = pose[s, 3], pose[s, 4], delay[s]
            for i in range(n):
                dx = x[i] + late * vx[i] - sx
                dy = y[i] + late * vy[i] - sy
                d = math.sqrt(dx * dx + dy * dy) + 1e-9
                inverse = 1.0 / d
                r[i] = d
                ux[i] = dx * inverse
                uy[i] = dy * inverse
            for i in range(n):
                rate[i] = (vx[i] - svx) * ux[i] + (vy[i] - svy) * uy[i]
            middle = math.hypot(cx - sx, cy - sy)
            far = radius + reach + late * par[RATE_SPAN]
            for m in range(starts[s], starts[s + 1]):
                zr, zv = z[m, 0], z[m, 2]
                if abs(zr - middle) > far:
                    continue
                cb, sb = math.cos(heading + z[m, 1]), math.sin(heading + z[m, 1])
                scale, inv_rate = scale_polar, 0.0
                if math.isnan(zv):
                    zv = 0.0
                else:
                    scale, inv_rate = scale_polar * scale_rate, 1.0 / par[STD_RATE]
                for i in range(n):
                    er = (r[i] - zr) * inv_range
                    ev = (rate[i] - zv) * inv_rate
                    eb = fast_angle(uy[i] * cb - ux[i] * sb, ux[i] * cb + uy[i] * sb) * inv_bearing
                    ratio[i] += scale * fast_exp(-0.5 * (er * er + eb * eb + ev * ev))
            if not union:
                for i in range(n):
                    seen = r[i] <= par[RANGE_MAX]
                    psi[i] *= (1.0 - pd + ratio[i]) if seen else 1.0
                    ratio[i] = 0.0
        out = log_weight[begin : begin + n]
        if union and n_sensors > 0:
            for i in range(n):
                psi[i] = 1.0 - pd + ratio[i]
        for i in range(n):
            out[i] = log_prior + fast_log(psi[i])


@numba.njit(nogil=True, cache=True, error_model="numpy")
def normalise_(log_weight: FloatArray, n: int) -> float:  # pragma: no cover - compiled
    """Turn the first ``n`` log weights into weights with sum 1; returns the log of their sum."""
    top = -np.inf
    for i in range(n):
        top = max(top, log_weight[i])
    if not math.isfinite(top):
        return top
    for i in range(n):
        log_weight[i] = fast_exp(log_weight[i] - top)
    total = 0.0
    for i in range(n):
        total += log_weight[i]
    inverse = 1.0 / total
    for i in range(n):
        log_weight[i] *= inverse
    return top + math.log(total)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def moments_(
    cloud: FloatArray, n: int, weight: FloatArray, mean: FloatArray, cov: FloatArray
) -> None:  # pragma: no cover - compiled
    """Weighted mean (4,) and covariance (4, 4) of the first ``n`` columns; weights sum to 1."""
    # about a point among them, or the squares of far coordinates would cancel
    o0, o1, o2, o3 = cloud[0, 0], cloud[1, 0], cloud[2, 0], cloud[3, 0]
    s0 = s1 = s2 = s3 = 0.0
    c00 = c01 = c02 = c03 = c11 = c12 = c13 = c22 = c23 = c33 = 0.0
    for i in range(n):
        w = weight[i]
        a, b, c, d = cloud[0, i] - o0, cloud[1, i] - o1, cloud[2, i] - o2, cloud[3, i] - o3
        wa, wb, wc, wd = w * a, w * b, w * c, w * d
        s0 += wa
        s1 += wb
        s2 += wc
        s3 += wd
        c00 += wa * a
        c01 += wa * b
        c02 += wa * c
        c03 += wa * d
        c11 += wb * b
        c12 += wb * c
        c13 += wb * d
        c22 += wc * c
        c23 += wc * d
        c33 += wd * d
    mean[0], mean[1], mean[2], mean[3] = o0 + s0, o1 + s1, o2 + s2, o3 + s3
    cov[0, 0], cov[1, 1], cov[2, 2], cov[3, 3] = (
        c00 - s0 * s0, c11 - s1 * s1, c22 - s2 * s2, c33 - s3 * s3,
    )  # fmt: skip
    cov[0, 1] = cov[1, 0] = c01 - s0 * s1
    cov[0, 2] = cov[2, 0] = c02 - s0 * s2
    cov[0, 3] = cov[3, 0] = c03 - s0 * s3
    cov[1, 2] = cov[2, 1] = c12 - s1 * s2
    cov[1, 3] = cov[3, 1] = c13 - s1 * s3
    cov[2, 3] = cov[3, 2] = c23 - s2 * s3


@numba.njit(nogil=True, cache=True, error_model="numpy")
def resample_(
    cloud: FloatArray, n: int, weight: FloatArray, particles: FloatArray, u: float
) -> None:  # pragma: no cover - compiled
    """Systematic resampling of the first ``n`` columns into ``particles`` (4, M), u in [0, 1)."""
    count = particles.shape[1]
    step = 1.0 / count
    total = weight[0]
    a = 0
    for k in range(count):
        target = (k + u) * step
        while total < target and a < n - 1:
            a += 1
            total += weight[a]
        for c in range(4):
            particles[c, k] = cloud[c, a]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def step_(
    q: float,
    dt: float,
    survival: float,
    particles: FloatArray,
    n_births: int,
    birth_mean: FloatArray,
    birth_cov: FloatArray,
    birth_age: FloatArray,
    max_births: int,
    pose: FloatArray,
    delay: FloatArray,
    starts: IntArray,
    z: FloatArray,
    par: FloatArray,
    cloud: FloatArray,
    log_weight: FloatArray,
    work: FloatArray,
    mean: FloatArray,
    cov: FloatArray,
    rng: Any,
) -> tuple[int, float]:  # pragma: no cover - compiled
    """One recursion: predict, update, estimate, resample; see `bernoulli.BernoulliFilter.step`.

    Args:
        q: existence probability after the last scan.  dt: time since then [s].
        survival: probability to survive ``dt``.
        particles: (4, M), replaced in place.
        n_births: number of birth densities, ``birth_mean`` (n, 4), ``birth_cov`` (n, 4, 4); each
            is ``birth_age[m]`` older [s] than the last scan's time.
        max_births: particles for them all.

    Returns:
        OK or LOST, and the existence probability.
    """
    n_survivors = particles.shape[1] if q * survival > 0.0 else 0
    born = min(max_births, particles.shape[1] * n_births)
    p_birth = par[P_BIRTH] * (1.0 - q) if born else 0.0
    predicted = p_birth + survival * q
    if not predicted > 0.0:
        return OK, 0.0
    used = 0
    if n_survivors:
        move_(particles, cloud, dt, par[DENSITY], rng)
        prior = math.log(survival * q / predicted / n_survivors)
        begin: Any = np.int64(0)  # a plain 0 is a type of its own, and another compilation
        weigh_(cloud, begin, n_survivors, prior, pose, delay, starts, z, par, log_weight, work)
        used = n_survivors
    if p_birth > 0.0:
        prior = math.log(p_birth / predicted / born)
        # of all densities the same number, up to rounding that falls on each of them equally often
        u = rng.random()
        for m in range(n_births):
            count = int((m + 1) * born / n_births + u) - int(m * born / n_births + u)
            if count and used + count <= cloud.shape[1]:
                age = dt + birth_age[m]
                draw_births_(
                    cloud, used, count, birth_mean[m], birth_cov[m], age, par[DENSITY], rng
                )
                weigh_(
                    cloud, used, used + count, prior, pose, delay, starts, z, par, log_weight, work
                )
                used += count
    log_l = normalise_(log_weight, used)
    if not math.isfinite(log_l):
        return LOST, 0.0
    moments_(cloud, used, log_weight, mean, cov)
    if not math.isfinite(mean[0] + mean[1] + mean[2] + mean[3]):
        return LOST, 0.0
    resample_(cloud, used, log_weight, particles, rng.random())
    # 1 - Δ is the mean of ψ, l; q+ = l q- / (1 - q- + l q-)
    odds = math.log(predicted) + log_l
    q = 1.0 / (1.0 + (1.0 - predicted) * math.exp(min(-odds, 700.0)))
    # 1 would be rounding; births then go on, and every step takes the same time
    return OK, min(q, Q_MAX)
