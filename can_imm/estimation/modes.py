"""What a mode does with its constraint and with a measurement, and how likely that makes it.

The mode likelihood is the density of the measurement given the constraint and the past,

    L_j = int N(z; H x, R) phi_j(x) N(x; x_j, P_j) dx / int phi_j(x) N(x; x_j, P_j) dx,

so that modes whose constraints have different dimensions stay comparable.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.estimation.constraints import (
    LOG_MASS_FLOOR,
    interval_mass,
    interval_probability,
    project_,
    truncate_,
)
from can_imm.estimation.interaction import intervals_, reference
from can_imm.estimation.kalman import LOG_2PI, update_row_, update_state_
from can_imm.estimation.layout import LANE, LOG_FLOOR
from can_imm.estimation.noise import NoiseState, load, store_, uniform
from can_imm.estimation.particles import (
    N_COLUMNS,
    cholesky4_,
    enter_,
    moments_,
    moved_,
    propagate_,
    resample_,
    weigh_,
)
from can_imm.estimation.stack import diagonal, element, stack_matrix, stack_vector
from can_imm.types import AX, MAX_STATES, VX, VY, FloatArray, Y

FASTEST, SWIFTEST = 150.0, 20.0
"""No object is faster [m/s], or changes its speed faster [m/s^2], while a measurement ages."""


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def constrain_soft_(
    n: int, bank: Any, j: int, x: FloatArray, P: FloatArray, work: Any
) -> float:  # pragma: no cover - compiled
    """Apply the soft equality rows of mode j as pseudo-measurements (22)(23); 0, or NaN on failure.

    Their own density is not part of the mode likelihood: it would reward a prior that already
    satisfies the constraint, and has another dimension for each mode.
    """
    bad = 0.0
    for c in range(bank.n_soft[j]):
        state = bank.soft_state[j, c]
        value = bank.soft_value[j, c] + reference(
            bank.soft_kind[j, c], bank.soft_lanes[j, c], work, element(n, x, state)
        )
        r = bank.soft_r[j, c]
        if bank.soft_density[j, c]:
            r /= work.elapsed
        for s in range(n):
            if s == state:  # a constant in each branch, see `stack`
                bad += 0.0 * update_state_(n, x, P, s, value, r)[1]
    return bad


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def correct_(
    n: int,
    x: FloatArray,
    P: FloatArray,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    age: float,
    angle: float,
) -> float:  # pragma: no cover - compiled
    """Measurement update with the valid components of z, in place.

    Args:
        z, r: (4,) measured x, vx, y, vy and their variances.  valid: (4,) bool.
        angle: of the axes in which z was measured, against those of ``x`` [rad].
        age: how long before the time of ``x`` the measurement was taken [s]; a position measured
            then is x - age vx + age^2/2 ax now.

    Returns:
        Log density of z; NaN on a numeric failure.
    """
    # one logarithm for all components
    square = 0.0
    product = 1.0
    count = 0
    if age == 0.0 and angle == 0.0:
        for c in range(4):
            if valid[c]:
                e, v = update_state_(n, x, P, c, z[c], r[c])
                square += e * e / v
                product *= v
                count += 1
        return -0.5 * (count * LOG_2PI + math.log(product) + square)
    cos, sin = math.cos(angle), math.sin(angle)
    h = stack_vector(MAX_STATES)
    for c in range(4):
        if not valid[c]:
            continue
        for s in range(n):
            h[s] = 0.0
        for axis in range(2):
            # share of this axis in the measured component
            share = (cos if c < 2 else -sin) if axis == 0 else (sin if c < 2 else cos)
            if share == 0.0:
                continue
            s = 2 * axis
            a = AX + axis  # the axis' acceleration state, if the bank has one
            if c == 0 or c == 2:
                h[s] = share
                h[s + 1] = -age * share
                if a < n:
                    h[a] = 0.5 * age * age * share
            else:
                h[s + 1] = share
                if a < n:
                    h[a] = -age * share
        e, v = update_row_(n, x, P, h, z[c], r[c])
        square += e * e / v
        product *= v
        count += 1
    return -0.5 * (count * LOG_2PI + math.log(product) + square)


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def mass_(
    n: int, x: FloatArray, P: FloatArray, n_bounds: int, state: Any, floor: float, work: Any
) -> float:  # pragma: no cover - compiled
    """Log of the mass of N(x, P) inside all bounds of a mode, one after the other; x, P are kept.

    Args:
        state: (n_bounds,) the bounded states; their intervals are in work.lower and work.upper.
    """
    if n_bounds == 0:
        return 0.0
    left_x, left_P = stack_vector(MAX_STATES), stack_matrix(MAX_STATES, MAX_STATES)
    for s in range(n):
        left_x[s] = x[s]
        for t in range(n):
            left_P[s, t] = P[s, t]
    log_mass = 0.0
    last = n_bounds - 1
    for c in range(last):
        log_mass += truncate_(n, left_x, left_P, state[c], work.lower[c], work.upper[c], floor)
    # nobody needs the moments of the last one
    mean, p = element(n, left_x, state[last]), diagonal(n, left_P, state[last])
    return log_mass + interval_mass(mean, p, work.lower[last], work.upper[last])


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def update_mode_(
    n: int,
    bank: Any,
    work: Any,
    j: int,
    x: FloatArray,
    P: FloatArray,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    age: float,
) -> float:  # pragma: no cover - compiled
    """Constraint and measurement update of Gaussian mode j in x (n,), P (n, n); its log L."""
    log_l = constrain_soft_(n, bank, j, x, P, work)
    n_bounds = bank.n_bounds[j]
    # The lane is that of the prior, for the posterior too.
    intervals_(n, bank, j, x, False, work)
    empty = False
    for c in range(n_bounds):
        empty = empty or not work.lower[c] < work.upper[c]
    prior = 0.0
    if not empty:
        prior = mass_(n, x, P, n_bounds, bank.bound_state[j], bank.var_floor, work)
    log_l += correct_(n, x, P, z, r, valid, age, work.angle)
    if empty or prior < LOG_MASS_FLOOR + 1.0:
        return LOG_FLOOR  # the constraint contradicts the past beyond what numbers can tell
    posterior = 0.0
    if bank.is_projected[j]:
        # The mass needs the Gaussian before it is projected.
        posterior = mass_(n, x, P, n_bounds, bank.bound_state[j], bank.var_floor, work)
    for c in range(n_bounds):
        lower = work.lower[c]
        upper = work.upper[c]
        if lower == -np.inf and upper == np.inf:
            continue  # one interval with another row
        state = bank.bound_state[j, c]
        if not bank.is_projected[j]:
            posterior += truncate_(n, x, P, state, lower, upper, bank.var_floor)
            continue
        mean = element(n, x, state)
        if mean < lower or mean > upper:
            project_(n, x, P, state, lower if mean < lower else upper, bank.var_floor)
    return log_l + posterior - prior


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def keep_combined_(
    n: int, obj: Any, x: FloatArray, P: FloatArray
) -> None:  # pragma: no cover - compiled
    """An impossible mode takes over the combined estimate, so that it can start from there."""
    for s in range(n):
        x[s] = obj.mean[s]
        for t in range(n):
            P[s, t] = obj.cov[s, t]


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def region_limit(
    bank: Any, work: Any, j: int, z: FloatArray, r: FloatArray, valid: Any, age: float
) -> float:  # pragma: no cover - compiled
    """Log of a bound on what mode j can say of z, over the peak density of the measurement.

    Its states lie within its bounds, so that z is no likelier than seen from the nearest point
    there.  Bounds that go with a lane, and axes that are turned, are not looked at.
    """
    limit = 0.0
    if work.angle != 0.0:
        return limit
    for c in range(bank.n_bounds[j]):
        s = bank.bound_state[j, c]
        if s >= 4 or not valid[s] or bank.bound_kind[j, c] == LANE:
            continue
        base = reference(bank.bound_kind[j, c], bank.bound_lanes[j, c], work, 0.0)
        outside = max(base + bank.bound_lower[j, c] - z[s], z[s] - base - bank.bound_upper[j, c])
        outside -= age * (SWIFTEST if s % 2 else FASTEST)
        if outside > 0.0:
            limit = min(limit, -0.5 * outside * outside / r[s])
    return limit


@numba.njit(nogil=True, cache=True, error_model="numpy")
def particle_limit(
    bank: Any,
    obj: Any,
    work: Any,
    j: int,
    m: int,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    age: float,
) -> float:  # pragma: no cover - compiled
    """Log of a bound on what the particles can say, over the peak density of the measurement.

    Their speed is that of the profile, from f_min to the peak; their lateral position is normal
    for each source, and has to lie in the window.  What x and vy say is not looked at.
    ``work.w`` holds the mixing weights.  The measurement's axes must not be turned.
    """
    par = bank.particle
    if work.angle != 0.0:
        return 0.0
    limit = 0.0
    if valid[VX]:
        v = r[VX] + par.std_profile**2
        e = max(par.f_min - z[VX], z[VX] - par.peak_high, 0.0)
        limit = -0.5 * (e * e / v + math.log(v / r[VX]))
    tau = m * bank.step_s
    share = 0.0
    for i in range(bank.n_modes):
        if work.w[i] == 0.0:
            continue
        if i == j:
            share += work.w[i]  # nothing is known of the own particles but that they are inside
            continue
        # y and vy at the end of the step, and y at the measurement, which is y - age vy
        moved_(obj.x[i], obj.P[i], tau, par, work.tx, work.tP)
        y, yy, yv, vv = work.tx[1], work.tP[1, 1], work.tP[2, 1], work.tP[2, 2]
        p = 1.0
        if valid[Y]:
            s = yy - age * (2.0 * yv - age * vv) + r[Y]
            gain = (yy - age * yv) / s
            e = z[Y] - y + age * obj.x[i, VY]
            y += gain * e
            yy -= gain * gain * s
            p = math.exp(-0.5 * e * e / s) * math.sqrt(r[Y] / s)
        yy = max(yy, bank.var_floor)
        share += work.w[i] * p * interval_probability(y, yy, par.y_low, par.y_high)
    return limit + math.log(share)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def update_particles_(
    bank: Any,
    obj: Any,
    work: Any,
    j: int,
    m: int,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    age: float,
    particles: FloatArray,
    spare: FloatArray,
    weights: FloatArray,
    noise: NoiseState,
) -> float:  # pragma: no cover - compiled
    """Whole cycle of the particle mode j: interact by drawing from the sources, move, weigh,
    resample; moments into work.x[j], work.P[j]; log of mean_i[phi_i g_i].

    The mass of the window is part of the likelihood: it is a hard region (a state-dependent
    transition), not a soft overlap.
    """
    n_modes, n = bank.n_modes, bank.n_states
    total = particles.shape[1]
    x = work.x[j]
    P = work.P[j]
    tau = m * bank.step_s
    # systematic allocation of the particles to the sources: the mode itself, then the others
    last = j  # takes what rounding leaves over
    for i in range(n_modes):
        if i != j and work.w[i] > 0.0:
            last = i
    words = load(noise)
    u, words = uniform(words)
    store_(noise, words)
    cumulative = work.w[j]
    done = min(int(cumulative * total + u), total) if last != j else total
    if done > 0:
        # they are equally weighted after resampling: take evenly spaced ones
        spacing = total / done
        for c in range(N_COLUMNS):
            for k in range(done):
                spare[c, k] = particles[c, int(k * spacing)]
        propagate_(spare, spare[N_COLUMNS:], done, tau, bank.particle, noise)
    for i in range(n_modes):
        if i == j or work.w[i] == 0.0:
            continue
        cumulative += work.w[i]
        upto = min(int(cumulative * total + u), total) if i != last else total
        if upto > done:
            moved_(obj.x[i], obj.P[i], tau, bank.particle, work.tx, work.tP)
            cholesky4_(work.tP, work.L)
            enter_(spare, done, upto - done, work.tx, work.L, bank.particle, noise)
            done = upto
    log_l = weigh_(spare, weights, z, r, valid, age, work.angle, bank.particle)
    for s in range(n):
        for t in range(n):
            P[s, t] = 0.0
    if log_l == -np.inf:
        # No particle is feasible; the mode keeps the last moments and the floor probability.
        keep_combined_(n, obj, x, P)
        return LOG_FLOOR
    moments_(spare, weights, x, P)
    for s in range(4):
        P[s, s] += bank.var_floor
    for s in range(4, n):
        x[s] = 0.0
        P[s, s] = bank.birth_std[s] ** 2
    words = load(noise)
    u, words = uniform(words)
    store_(noise, words)
    resample_(spare, weights, particles, total, u)
    return log_l
