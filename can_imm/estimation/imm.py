"""Interacting multiple model with constrained modes (equations 14 to 20, with the corrections).

One cycle of one object: interact, predict, correct, combine.  All state lies in one structured
record per object, all parameters in one record per mode bank; a kernel call works on all objects.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.estimation.constraints import interval_probability, normal_mass
from can_imm.estimation.interaction import mix_, nearest_lane, reference, transitions_
from can_imm.estimation.kalman import predict_
from can_imm.estimation.layout import (
    GROUND,
    LANE,
    LOG_FLOOR,
    NEGLIGIBLE_RISE,
    NEGLIGIBLE_WEIGHT,
    UNREACHABLE,
)
from can_imm.estimation.modes import (
    keep_combined_,
    particle_limit,
    region_limit,
    update_mode_,
    update_particles_,
)
from can_imm.estimation.noise import NoiseState
from can_imm.estimation.stack import stack_matrix, stack_vector
from can_imm.types import MAX_STATES, FloatArray

TWO_PI = 2.0 * math.pi


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def present_(bank: Any, obj: Any, w: FloatArray) -> None:  # pragma: no cover - compiled
    """Mode probabilities without those at the floor, normalised, into w (M,).

    A mode at the floor is not there and its state may be anything: a mode that ends at x = 10 m
    would widen the covariance of an object at 70 m.  It comes back by transitions from the others.
    """
    total = 0.0
    for j in range(bank.n_modes):
        if obj.mu[j] > 2.0 * bank.mu_floor:
            total += obj.mu[j]
    for j in range(bank.n_modes):
        w[j] = obj.mu[j] / total if obj.mu[j] > 2.0 * bank.mu_floor else 0.0


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def combine_(n: int, bank: Any, obj: Any, work: Any) -> None:  # pragma: no cover - compiled
    """Combined mean and covariance (19)(20) of all modes that are above the floor."""
    n_modes = bank.n_modes
    present_(bank, obj, work.w)
    mean, cov = stack_vector(MAX_STATES), stack_matrix(MAX_STATES, MAX_STATES)
    d = stack_vector(MAX_STATES)
    for s in range(n):
        mean[s] = 0.0
        for t in range(s + 1):
            cov[s, t] = 0.0
    for j in range(n_modes):
        if work.w[j] > 0.0:
            for s in range(n):
                mean[s] += work.w[j] * obj.x[j, s]
    for j in range(n_modes):
        if work.w[j] > 0.0:
            for s in range(n):
                d[s] = obj.x[j, s] - mean[s]
                for t in range(s + 1):
                    cov[s, t] += work.w[j] * (obj.P[j, s, t] + d[s] * d[t])
    for s in range(n):
        obj.mean[s] = mean[s]
        for t in range(s + 1):
            obj.cov[s, t] = cov[s, t]
            obj.cov[t, s] = cov[s, t]


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def normalise_(
    n: int, mu: FloatArray, log_l: FloatArray, log_c: FloatArray, floor: float
) -> bool:  # pragma: no cover - compiled
    """mu_j proportional to exp(log_l_j + log_c_j) with the log-sum-exp shift, then the floor.

    Returns:
        False if no mode has a finite likelihood (mu untouched).
    """
    top = -np.inf
    for j in range(n):
        top = max(top, log_l[j] + log_c[j])
    if not (top > LOG_FLOOR / 2 and top < np.inf):
        return False
    s = 0.0
    for j in range(n):
        log_mu = log_l[j] + log_c[j]
        mu[j] = math.exp(log_mu - top) if log_mu > LOG_FLOOR / 2 else 0.0
        s += mu[j]
    t = 0.0
    for j in range(n):
        mu[j] = max(mu[j] / s, floor)
        t += mu[j]
    for j in range(n):
        mu[j] /= t
    return True


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def put_(
    n: int, x: FloatArray, P: FloatArray, to_x: FloatArray, to_P: FloatArray
) -> None:  # pragma: no cover - compiled
    """Copy mean x (n,) and covariance P (n, n)."""
    for s in range(n):
        to_x[s] = x[s]
        for t in range(n):
            to_P[s, t] = P[s, t]


OK, OUTLIER, FAILED = 0, 1, 2


@numba.njit(nogil=True, cache=True, error_model="numpy")
def learn_lane_(bank: Any, obj: Any) -> None:  # pragma: no cover - compiled
    """Learn where the lanes lie from where the object keeps to one.

    A mode with a soft lane row that is more likely than not tells the centre of its lane; lane 0
    lies at y = 0 and tells nothing about the width.  The bank's width counts as much as
    ``lane_prior`` scans; 0 switches learning off.
    """
    if bank.lane_prior <= 0.0:
        return
    for j in range(bank.n_modes):
        if obj.mu[j] < 0.5:
            continue
        for c in range(bank.n_soft[j]):
            if bank.soft_kind[j, c] != LANE:
                continue
            y = obj.x[j, bank.soft_state[j, c]]
            k = nearest_lane(y, obj.lane_width, bank.soft_lanes[j, c])
            if k != 0.0:
                obj.lane_scans = min(obj.lane_scans + 1.0, 10.0 * bank.lane_prior)
                gain = 1.0 / (bank.lane_prior + obj.lane_scans)
                width = obj.lane_width + gain * (y / k - obj.lane_width)
                obj.lane_width = min(max(width, bank.lane_range[0]), bank.lane_range[1])


@numba.njit(nogil=True, cache=True, error_model="numpy")
def surprise(
    bank: Any,
    obj: Any,
    m: int,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    age: float,
    angle: float,
) -> float:  # pragma: no cover - compiled
    """Squared distance of z from where the object can be, in standard deviations.

    The combined estimate moved on at constant speed, widened by ``jump_std``: how far a vehicle can
    depart from that between two scans.  It knows no modes: a manoeuvre must never be an outlier.
    """
    d = 0.0
    tau = m * bank.step_s - age
    cos, sin = 1.0, 0.0
    if angle != 0.0:
        cos, sin = math.cos(angle), math.sin(angle)
    for c in range(4):
        if valid[c]:
            # shares of the two axes in the measured component
            f = cos if c < 2 else -sin
            g = sin if c < 2 else cos
            a = c % 2  # 0 a position, 1 a speed
            b = a + 2
            e = z[c] - f * obj.mean[a] - g * obj.mean[b]
            if a == 0:
                e -= tau * (f * obj.mean[1] + g * obj.mean[3])
            v = f * f * (obj.cov[a, a] + bank.jump_std[a] ** 2)
            v += g * g * (obj.cov[b, b] + bank.jump_std[b] ** 2) + 2.0 * f * g * obj.cov[a, b]
            d += e * e / (v + r[c])
    return d


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def order_modes_(bank: Any, obj: Any, work: Any) -> None:  # pragma: no cover - compiled
    """Probabilities of the modes before the measurement into work.c, and into work.order the
    likeliest first, for the others to be held against, and the particles last: they cost most."""
    n_modes = bank.n_modes
    for j in range(n_modes):
        work.c[j] = 0.0
    for i in range(n_modes):
        if work.mu[i] > 0.0:
            for j in range(n_modes):
                work.c[j] += obj.Pi[i, j] * work.mu[i]
    first = -1
    last = n_modes
    for j in range(n_modes):
        if not bank.is_particle[j] and (first < 0 or work.c[j] > work.c[first]):
            first = j
    k = 0
    if first >= 0:
        work.order[0] = first
        k = 1
    for j in range(n_modes):
        if j == first:
            continue
        if bank.is_particle[j]:
            last -= 1
            work.order[last] = j
        else:
            work.order[k] = j
            k += 1


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def peak_density(r: FloatArray, valid: Any) -> float:  # pragma: no cover - compiled
    """Log density of the measurement noise at zero, which no mode's likelihood exceeds."""
    product = 1.0
    for c in range(4):
        if valid[c]:
            product *= TWO_PI * r[c]
    return -0.5 * math.log(product)


# A kernel within kernels is compiled once by itself and again in each that it is part of; this one
# and `process_scan_` are put in before anything is compiled, which spares a third of the time.
@numba.njit(inline="always", error_model="numpy")
def cycle_(
    n: int,
    bank: Any,
    obj: Any,
    work: Any,
    m: int,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    age: float,
    gate: float,
    particles: FloatArray,
    spare: FloatArray,
    weights: FloatArray,
    noise: NoiseState,
) -> int:  # pragma: no cover - compiled
    """One IMM cycle of one object, in place.

    Args:
        bank, obj, work: records of `BANK_DTYPE`, `OBJECT_DTYPE`, `WORK_DTYPE`; work.angle and
            work.ground are given, too.
        m: steps since the object's last measurement.
        z, r: (4,) measured x, vx, y, vy and their variances.  valid: (4,) bool.
        age: of the measurement [s].
        gate: z is an outlier if its `surprise` is larger; inf switches the gate off.
        particles: (7, N) the object's particles; N may be 0 in a bank without a particle mode.
        spare: (10, N) scratch.  weights: (N,) scratch.
        noise: state of the random numbers, used by the particle mode only.

    Returns:
        OK; OUTLIER or FAILED with the object as it was before (a failed mode alone gets the floor).
    """
    n_modes = bank.n_modes
    if surprise(bank, obj, m, z, r, valid, age, work.angle) > gate:
        return OUTLIER
    work.lane_width = obj.lane_width
    work.elapsed = m * bank.step_s
    present_(bank, obj, work.mu)
    transitions_(n, bank, obj, work, m)
    order_modes_(bank, obj, work)
    peak = peak_density(r, valid)
    worth = math.log(bank.mu_floor * NEGLIGIBLE_RISE)  # -inf without a floor
    best = -np.inf
    x, P = stack_vector(MAX_STATES), stack_matrix(MAX_STATES, MAX_STATES)
    for k in range(n_modes):
        j = work.order[k]
        c = work.c[j]
        reachable = c >= UNREACHABLE
        log_c = math.log(c) if reachable else LOG_FLOOR
        work.log_c[j] = log_c
        log_l = LOG_FLOOR
        limit = log_c + peak + region_limit(bank, work, j, z, r, valid, age)
        if reachable and limit > best + worth:
            for i in range(n_modes):
                p = obj.Pi[i, j] * work.mu[i]
                work.w[i] = p / c if p > NEGLIGIBLE_WEIGHT * c else 0.0
            if not bank.is_particle[j]:
                mix_(n, bank, obj, work, j, m, x, P)
                predict_(n, x, P, bank.F[m, j], bank.Q[m, j])
                log_l = update_mode_(n, bank, work, j, x, P, z, r, valid, age)
                put_(n, x, P, work.x[j], work.P[j])
                best = max(best, log_c + log_l)
            elif limit + particle_limit(bank, obj, work, j, m, z, r, valid, age) > best + worth:
                log_l = update_particles_(
                    bank, obj, work, j, m, z, r, valid, age, particles, spare, weights, noise
                )
        if not log_l > LOG_FLOOR:
            # Also a numeric failure: what is left of its state must not reach the others.
            keep_combined_(n, obj, work.x[j], work.P[j])
            log_l = LOG_FLOOR
        obj.log_l[j] = log_l
    if not normalise_(n_modes, obj.mu, obj.log_l, work.log_c, bank.mu_floor):
        return FAILED
    for j in range(n_modes):
        put_(n, work.x[j], work.P[j], obj.x[j], obj.P[j])
    combine_(n, bank, obj, work)
    learn_lane_(bank, obj)
    remember_peak_(bank, obj)
    return OK


@numba.njit(nogil=True, cache=True, error_model="numpy")
def remember_peak_(bank: Any, obj: Any) -> None:  # pragma: no cover - compiled
    """Whether the object has been as fast as who recedes or approaches is at some time."""
    if bank.peak_speed <= 0.0:
        return
    variance = max(obj.cov[1, 1], bank.var_floor)
    for side in range(2):
        speed = obj.mean[1] if side == 0 else -obj.mean[1]
        # the greatest of many estimates is too great
        peak = bank.peak_speed + math.sqrt(variance)
        now = interval_probability(speed, variance, peak, np.inf)
        # until it is about as fast as the ego again
        still = interval_probability(speed, variance, 0.25 * bank.peak_speed, np.inf)
        obj.reached[side] = max(still * obj.reached[side], now)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def birth_(
    bank: Any, obj: Any, work: Any, z: FloatArray, r: FloatArray, valid: Any, age: float
) -> int:  # pragma: no cover - compiled
    """Initialise one object from its first measurement; arguments as for `cycle_`.

    Every mode starts from a prior as wide as traffic gets, centred on the measured position and on
    zero speed, with its entry distribution and its constraints applied; so the first probabilities
    are honest ones.  Regions count with the mass that the measurement alone gives them.
    """
    n_modes, n = bank.n_modes, bank.n_states
    cos, sin = math.cos(work.angle), math.sin(work.angle)
    obj.lane_scans = 0.0
    work.lane_width = obj.lane_width
    work.elapsed = 0.1
    x, P = stack_vector(MAX_STATES), stack_matrix(MAX_STATES, MAX_STATES)
    for j in range(n_modes):
        for s in range(n):
            x[s] = 0.0
            for t in range(n):
                P[s, t] = 0.0
            P[s, s] = bank.birth_std[s] ** 2
            if s == 0 and valid[s]:
                x[s] = z[0] * cos - (z[2] * sin if valid[2] else 0.0)
            elif s == 2 and valid[s]:
                x[s] = z[2] * cos + (z[0] * sin if valid[0] else 0.0)
            if bank.entry_var[j, s] >= 0.0:
                x[s] = bank.entry_mean[j, s]
                P[s, s] = bank.entry_var[j, s]
        log_c = math.log(bank.mu0[j])
        for c in range(bank.n_bounds[j]):
            s = bank.bound_state[j, c]
            if s >= 4:
                continue  # an acceleration, which nobody measures
            # Of a speed that is not measured the prior says enough to tell what stands still.
            known = valid[s] or bank.bound_kind[j, c] == GROUND
            if bank.bound_mass[j, c] and known:
                # Turned axes: a speed along the line of sight is taken as one along the road.
                v = z[s] if s % 2 == 1 and valid[s] else x[s]
                base = reference(bank.bound_kind[j, c], bank.bound_lanes[j, c], work, v)
                sd = math.sqrt(r[s]) if valid[s] else bank.birth_std[s]
                log_c += normal_mass(
                    (base + bank.bound_lower[j, c] - v) / sd,
                    (base + bank.bound_upper[j, c] - v) / sd,
                )
        work.log_c[j] = log_c
        log_l = update_mode_(n, bank, work, j, x, P, z, r, valid, age)
        put_(n, x, P, work.x[j], work.P[j])
        if bank.is_particle[j]:
            log_l = LOG_FLOOR  # entered from another mode, never born into
        obj.log_l[j] = log_l if log_l > LOG_FLOOR else LOG_FLOOR
        obj.mu[j] = bank.mu0[j]
    if not normalise_(n_modes, obj.mu, obj.log_l, work.log_c, bank.mu_floor):
        return FAILED
    for j in range(n_modes):
        put_(n, work.x[j], work.P[j], obj.x[j], obj.P[j])
    combine_(n, bank, obj, work)
    obj.reached[:] = 0.0
    remember_peak_(bank, obj)
    return OK


@numba.njit(nogil=True, cache=True, error_model="numpy")
def extrapolate_(
    bank: Any, obj: Any, m: int, x: FloatArray, P: FloatArray, mu: FloatArray, work: Any
) -> None:
    """Combined estimate and mode probabilities ``m`` steps after the last measurement.

    Nothing is mixed and nothing of ``obj`` changes: each mode is predicted on its own, mu moves
    with Pi(m).  Writes x (n,), P (n, n), mu (n_modes,).
    """
    n_modes, n = bank.n_modes, bank.n_states
    present_(bank, obj, work.c)
    for s in range(n):
        x[s] = 0.0
        for t in range(n):
            P[s, t] = 0.0
    for j in range(n_modes):
        v = 0.0
        for i in range(n_modes):
            v += bank.Pi[m, i, j] * obj.mu[i]
        mu[j] = v
        put_(n, obj.x[j], obj.P[j], work.x[j], work.P[j])
        predict_(n, work.x[j], work.P[j], bank.F[m, j], bank.Q[m, j])
        for s in range(n):
            x[s] += work.c[j] * work.x[j, s]
    for j in range(n_modes):
        for s in range(n):
            for t in range(n):
                P[s, t] += work.c[j] * (
                    work.P[j, s, t] + (work.x[j, s] - x[s]) * (work.x[j, t] - x[t])
                )


# Within `entry`, which knows its arrays by address alone, nobody counts references to them.
@numba.njit(inline="always", error_model="numpy")
def process_scan_(
    bank: Any,
    objects: Any,
    work: Any,
    n: int,
    slot: Any,
    steps: Any,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    angle: FloatArray,
    ground: float,
    lane_width: float,
    age: float,
    gate: float,
    particles: FloatArray,
    spare: FloatArray,
    weights: FloatArray,
    noise: NoiseState,
    status: Any,
) -> None:  # pragma: no cover - compiled
    """One scan: the cycle, or the birth, of all its objects in one call; through `entry.Processor`.

    Args:
        bank, work: (1,) arrays of records.  objects: (capacity,) records, one per slot.
        n: rows in use.  slot: (N,) int32, -1 for none.
        steps: (N,) int32, steps since the slot's last measurement; -1 for a birth.
        z, r: (N, 4) measured values and variances.  valid: (N, 4) bool.
        angle: (N,) of the axes in which they were measured [rad].
        ground: speed of the ground against the ego vehicle, or `UNKNOWN_GROUND` [m/s].
        lane_width: of the road [m]; 0 leaves it to each object.
        age, gate, spare, weights, noise: as for `cycle_`.
        particles: (capacity, 7, n_particles).
        status: (N,) int8, written: OK, OUTLIER or FAILED.
    """
    work[0].ground = ground
    for k in range(n):
        s = slot[k]
        if s < 0:
            continue
        work[0].angle = angle[k]
        if lane_width > 0.0:
            objects[s].lane_width = lane_width
        elif steps[k] < 0:
            objects[s].lane_width = bank[0].lane_width
        if steps[k] < 0:
            status[k] = birth_(bank[0], objects[s], work[0], z[k], r[k], valid[k], age)
            continue
        # The number of states as a constant lets the compiler unroll everything; in a call with a
        # starred tuple it would be none.
        if bank[0].n_states == 4:
            status[k] = cycle_(4, bank[0], objects[s], work[0], steps[k], z[k], r[k], valid[k], age,
                               gate, particles[s], spare, weights, noise)  # fmt: skip
        elif bank[0].n_states == 5:
            status[k] = cycle_(5, bank[0], objects[s], work[0], steps[k], z[k], r[k], valid[k], age,
                               gate, particles[s], spare, weights, noise)  # fmt: skip
        else:
            status[k] = cycle_(6, bank[0], objects[s], work[0], steps[k], z[k], r[k], valid[k], age,
                               gate, particles[s], spare, weights, noise)  # fmt: skip
