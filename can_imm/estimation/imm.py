"""Interacting multiple model with constrained modes (equations 14 to 20, with the corrections).

One cycle of one object: interact, predict, correct, combine.  All state lies in one structured
record per object, all parameters in one record per mode bank; a kernel call works on all objects.

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
    normal_mass,
    project_,
    truncate_,
)
from can_imm.estimation.kalman import log_normal, predict_, update_row_, update_state_
from can_imm.estimation.noise import NoiseState, load, store_, uniform
from can_imm.estimation.particles import (
    N_COLUMNS,
    PARTICLE_DTYPE,
    cholesky4_,
    enter_,
    moments_,
    propagate_,
    resample_,
    weigh_,
)
from can_imm.types import VX, FloatArray, X

LOG_FLOOR = -1e30

NEGLIGIBLE_WEIGHT = 1e-12
"""A source with a smaller mixing weight does not count."""

UNREACHABLE = 1e-15
"""A mode whose prior probability is smaller is not computed; it gets the floor probability."""

MAX_ROWS = 4
"""Largest number of constraint rows of one kind in one mode."""

SPEED_STEP = 1 << VX
"""Bit of ``entry_sources``: the entry replaces the speed ahead."""

FIXED, LANE = 0, 1
"""What the numbers of a row refer to: zero, or the nearest lane centre in a range of lanes."""


MAX_MODES = 24
"""Largest number of modes in a bank."""

MAX_STATES = 6
"""Largest number of states in a mode."""

MAX_STEPS = 201
"""Length of the tables over elapsed steps: two seconds of 10 ms."""

# The records have one fixed layout for all banks.  That spares a compilation per bank, and it has
# to be so: numba names cached functions after a record's number in the process that compiled them,
# so two layouts compiled in two processes can be taken for each other in a third.

_M, _N, _K = MAX_MODES, MAX_STATES, MAX_ROWS

BANK_DTYPE = np.dtype(
    [
        ("F", np.float64, (MAX_STEPS, _M, _N, _N)),
        ("Q", np.float64, (MAX_STEPS, _M, _N, _N)),
        ("Pi", np.float64, (MAX_STEPS, _M, _M)),
        ("mu0", np.float64, (_M,)),
        ("birth_std", np.float64, (_N,)),
        ("jump_std", np.float64, (4,)),
        ("step_s", np.float64),
        ("mu_floor", np.float64),
        ("var_floor", np.float64),
        ("lane_width", np.float64),
        ("lane_range", np.float64, (2,)),
        ("lane_prior", np.float64),
        ("soft_value", np.float64, (_M, _K)),
        ("soft_lanes", np.float64, (_M, _K, 2)),
        ("soft_r", np.float64, (_M, _K)),
        ("bound_lower", np.float64, (_M, _K)),
        ("bound_upper", np.float64, (_M, _K)),
        ("bound_lanes", np.float64, (_M, _K, 2)),
        ("entry_mean", np.float64, (_M, _N)),
        ("entry_var", np.float64, (_M, _N)),
        ("particle", PARTICLE_DTYPE),
        ("n_modes", np.int64),
        ("n_states", np.int64),
        ("manoeuvre", np.int8, (_M,)),
        ("direction", np.int8, (_M,)),
        ("is_particle", np.int8, (_M,)),
        ("is_projected", np.int8, (_M,)),
        ("n_soft", np.int8, (_M,)),
        ("soft_kind", np.int8, (_M, _K)),
        ("soft_state", np.int8, (_M, _K)),
        ("n_bounds", np.int8, (_M,)),
        ("bound_state", np.int8, (_M, _K)),
        ("bound_kind", np.int8, (_M, _K)),
        ("bound_mass", np.int8, (_M, _K)),
        ("entry_sources", np.int8, (_M, _M)),
    ],
    align=True,
)
"""Parameters of a mode bank as one record.

Tables are indexed by the number of elapsed steps: ``F[m]``, ``Q[m]``, ``Pi[m]`` belong to m steps;
``Pi[m, i, j]`` is the probability of going from mode i to mode j.  Bit s of ``entry_sources[i, j]``
says that state s is replaced when j is entered from i; ``entry_var`` is negative where it never is.
"""

OBJECT_DTYPE = np.dtype(
    [
        ("x", np.float64, (_M, _N)),
        ("P", np.float64, (_M, _N, _N)),
        ("mu", np.float64, (_M,)),
        ("log_l", np.float64, (_M,)),
        ("mean", np.float64, (_N,)),
        ("cov", np.float64, (_N, _N)),
        ("lane_width", np.float64),
        ("lane_scans", np.float64),
    ],
    align=True,
)
"""Estimator state of one object: per mode at its last measurement, and the combined estimate.

``lane_width`` is the distance of the lane centres that this object keeps to, learned in
``lane_scans`` scans.
"""

WORK_DTYPE = np.dtype(
    [
        ("x", np.float64, (_M, _N)),
        ("P", np.float64, (_M, _N, _N)),
        ("c", np.float64, (_M,)),
        ("w", np.float64, (_M,)),
        ("mu", np.float64, (_M,)),
        ("sx", np.float64, (_M, _N)),
        ("tx", np.float64, (_N,)),
        ("tP", np.float64, (_N, _N)),
        ("h", np.float64, (_N,)),
        ("row", np.float64, (_N + 1, _N)),
        ("L", np.float64, (4, 4)),
        ("lower", np.float64, (_K,)),
        ("upper", np.float64, (_K,)),
        ("Pi", np.float64, (_M, _M)),
        ("var", np.float64, (_N,)),
        ("lane_width", np.float64),
        ("source", np.int64, (_M,)),
    ],
    align=True,
)
"""Scratch of the kernels; one record serves all objects."""


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def mix_(
    n: int, bank: Any, obj: Any, work: Any, j: int, m: int
) -> None:  # pragma: no cover - compiled
    """Interaction (15)(16) for target mode j: mixed mean and covariance into work.x[j], work.P[j].

    Where bit s of ``entry_sources[i, j]`` is set, state s of source i is replaced by the mode's
    entry distribution: what a vehicle that starts this manoeuvre does, not what it did before.
    Where that is the speed ahead, the change took place at some instant of the last ``m`` steps,
    all equally likely: x is set back accordingly, with exact first and second moments.  (Sideways
    the same would only blur a lane change, whose speed builds up within the interval.)
    ``work.w`` holds the mixing weights.
    """
    n_modes = bank.n_modes
    tau = m * bank.step_s
    n_sources = 0
    entered = 0  # states that are replaced for any source
    for i in range(n_modes):
        if work.w[i] > 0.0:
            work.source[n_sources] = i
            entered |= bank.entry_sources[i, j]
            n_sources += 1
    for s in range(n):
        v = 0.0
        for k in range(n_sources):
            i = work.source[k]
            d = obj.x[i, s]
            if bank.entry_sources[i, j] >> s & 1:
                d = bank.entry_mean[j, s]
            elif s == X and bank.entry_sources[i, j] & SPEED_STEP:
                d -= 0.5 * tau * (bank.entry_mean[j, VX] - obj.x[i, VX])
            work.sx[k, s] = d
            v += work.w[i] * d
        for k in range(n_sources):
            work.sx[k, s] -= v
        work.x[j, s] = v
    for s in range(n):
        for t in range(s + 1):
            replaced = 1 << s | 1 << t
            v = 0.0
            for k in range(n_sources):
                i = work.source[k]
                p = work.sx[k, s] * work.sx[k, t]
                if not entered & replaced or not bank.entry_sources[i, j] & replaced:
                    p += obj.P[i, s, t]
                elif s == t:
                    p += bank.entry_var[j, s]
                v += work.w[i] * p
            work.P[j, s, t] = v
            work.P[j, t, s] = v
    if not entered & SPEED_STEP:
        return
    for k in range(n_sources):
        i = work.source[k]
        if bank.entry_sources[i, j] & (SPEED_STEP | 1 << X) != SPEED_STEP:
            continue
        # x - a (v_new - v_old), the change a seconds before the end of the interval
        dv = bank.entry_mean[j, VX] - obj.x[i, VX]
        spread = bank.entry_var[j, VX] + obj.P[i, VX, VX]
        p = tau * obj.P[i, X, VX] + tau * tau * (spread / 3.0 + dv * dv / 12.0)
        work.P[j, X, X] += work.w[i] * p
        for s in range(1, n):
            p = 0.0
            if s == VX:
                p = -0.5 * tau * bank.entry_var[j, VX]
            elif not bank.entry_sources[i, j] >> s & 1:
                p = 0.5 * tau * obj.P[i, VX, s]
            work.P[j, s, X] += work.w[i] * p
            work.P[j, X, s] = work.P[j, s, X]


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def transitions_(
    n: int, bank: Any, obj: Any, work: Any, m: int
) -> None:  # pragma: no cover - compiled
    """State-dependent transition probabilities of this cycle into work.Pi.

    A bound with ``mass`` is a region outside of which the mode does not exist.  The probability of
    going from i to j is that of the chain times the mass which source i, moved on by ``m`` steps
    with its own model, has inside j's regions; each row is normalised again, so that a source
    loses nothing to a mode it cannot reach.  States that the entry replaces do not count.
    ``work.mu`` holds the probabilities of the modes that are present.
    """
    n_modes = bank.n_modes
    for i in range(n_modes):
        for j in range(n_modes):
            work.Pi[i, j] = bank.Pi[m, i, j]
        if work.mu[i] == 0.0:
            continue
        done = 0  # bits of the states that have been moved on
        total = 0.0
        for j in range(n_modes):
            log_mass = 0.0
            for c in range(bank.n_bounds[j]):
                s = bank.bound_state[j, c]
                if not bank.bound_mass[j, c] or (bank.entry_sources[i, j] >> s & 1):
                    continue
                if not done >> s & 1:
                    done |= 1 << s
                    v = 0.0
                    q = bank.Q[m, i, s, s]
                    for k in range(n):
                        f = bank.F[m, i, s, k]
                        if f != 0.0:
                            v += f * obj.x[i, k]
                            for t in range(n):
                                q += f * bank.F[m, i, s, t] * obj.P[i, k, t]
                    work.tx[s] = v
                    work.var[s] = q
                base = reference(
                    bank.bound_kind[j, c], bank.bound_lanes[j, c], work.lane_width, work.tx[s]
                )
                sd = math.sqrt(max(work.var[s], bank.var_floor))
                log_mass += normal_mass(
                    (base + bank.bound_lower[j, c] - work.tx[s]) / sd,
                    (base + bank.bound_upper[j, c] - work.tx[s]) / sd,
                )
            if log_mass != 0.0:
                work.Pi[i, j] *= math.exp(log_mass)
            total += work.Pi[i, j]
        for j in range(n_modes):
            work.Pi[i, j] = work.Pi[i, j] / total if total > 1e-30 else bank.Pi[m, i, j]


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def reference(
    kind: int, lanes: FloatArray, width: float, y: float
) -> float:  # pragma: no cover - compiled
    """What a row's numbers count from: 0, or the centre of the lane nearest to ``y``.

    Args:
        lanes: (2,) lowest and highest number of the lanes that count; lane k lies at k times width.
    """
    if kind == FIXED:
        return 0.0
    lane: float = min(max(math.floor(y / width + 0.5), lanes[0]), lanes[1])
    return lane * width


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
        s = bank.soft_state[j, c]
        value = bank.soft_value[j, c] + reference(
            bank.soft_kind[j, c], bank.soft_lanes[j, c], work.lane_width, x[s]
        )
        bad += 0.0 * update_state_(n, x, P, s, value, bank.soft_r[j, c], work.row)[1]
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
    h: FloatArray,
    row: FloatArray,
) -> float:  # pragma: no cover - compiled
    """Measurement update with the valid components of z, in place.

    Args:
        z, r: (4,) measured x, vx, y, vy and their variances.  valid: (4,) bool.
        age: how long before the time of ``x`` the measurement was taken [s]; a position measured
            then is x - age vx + age^2/2 ax now.
        h: (n,) scratch.  row: (>= 2, n) scratch.

    Returns:
        Log density of z; NaN on a numeric failure.
    """
    log_l = 0.0
    for c in range(4):
        if not valid[c]:
            continue
        if age == 0.0:
            e, v = update_state_(n, x, P, c, z[c], r[c], row)
            log_l += log_normal(e, v)
            continue
        for s in range(n):
            h[s] = 0.0
        h[c] = 1.0
        a = 4 + c // 2  # the axis' acceleration state, if the bank has one
        if c == 0 or c == 2:
            h[c + 1] = -age
            if a < n:
                h[a] = 0.5 * age * age
        elif a < n:
            h[a] = -age
        e, v = update_row_(n, x, P, h, z[c], r[c], row)
        log_l += log_normal(e, v)
    return log_l


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
    for s in range(n):
        work.tx[s] = x[s]
        for t in range(n):
            work.tP[s, t] = P[s, t]
    log_mass = 0.0
    last = n_bounds - 1
    for c in range(last):
        log_mass += truncate_(
            n, work.tx, work.tP, state[c], work.lower[c], work.upper[c], floor, work.row
        )
    return log_mass + interval_mass(
        work.tx, work.tP, state[last], work.lower[last], work.upper[last]
    )


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def update_mode_(
    n: int,
    bank: Any,
    work: Any,
    j: int,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    age: float,
) -> float:  # pragma: no cover - compiled
    """Constraint and measurement update of Gaussian mode j in work.x[j], work.P[j]; its log L."""
    x = work.x[j]
    P = work.P[j]
    log_l = constrain_soft_(n, bank, j, x, P, work)
    n_bounds = bank.n_bounds[j]
    prior = 0.0
    for c in range(n_bounds):
        s = bank.bound_state[j, c]
        # The lane is that of the prior, for the posterior too.
        base = reference(bank.bound_kind[j, c], bank.bound_lanes[j, c], work.lane_width, x[s])
        work.lower[c] = base + bank.bound_lower[j, c]
        work.upper[c] = base + bank.bound_upper[j, c]
    prior = mass_(n, x, P, n_bounds, bank.bound_state[j], bank.var_floor, work)
    log_l += correct_(n, x, P, z, r, valid, age, work.h, work.row)
    if prior < LOG_MASS_FLOOR + 1.0:
        return LOG_FLOOR  # the constraint contradicts the past beyond what numbers can tell
    posterior = 0.0
    if bank.is_projected[j]:
        # The mass needs the Gaussian before it is projected.
        posterior = mass_(n, x, P, n_bounds, bank.bound_state[j], bank.var_floor, work)
    for c in range(n_bounds):
        s = bank.bound_state[j, c]
        lower = work.lower[c]
        upper = work.upper[c]
        if not bank.is_projected[j]:
            posterior += truncate_(n, x, P, s, lower, upper, bank.var_floor, work.row)
        elif x[s] < lower:
            project_(n, x, P, s, lower, bank.var_floor, work.row)
        elif x[s] > upper:
            project_(n, x, P, s, upper, bank.var_floor, work.row)
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
    total = particles.shape[0]
    x = work.x[j]
    P = work.P[j]
    # systematic allocation of the particles to the sources
    done = 0
    cumulative = 0.0
    words = load(noise)
    u, words = uniform(words)
    store_(noise, words)
    for i in range(n_modes):
        cumulative += work.w[i]
        upto = min(int(cumulative * total + u), total) if i < n_modes - 1 else total
        count = upto - done
        if count <= 0:
            continue
        if i == j:
            # own particles are equally weighted after resampling: take evenly spaced ones
            for k in range(count):
                a = (k * total) // count
                for c in range(N_COLUMNS):
                    spare[done + k, c] = particles[a, c]
        else:
            cholesky4_(obj.P[i], work.L)
            enter_(spare, done, count, obj.x[i], work.L, bank.particle, noise)
        done = upto
    propagate_(spare, m * bank.step_s, bank.particle, noise)
    log_l = weigh_(spare, weights, z, r, valid, age, bank.particle)
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


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def present_(bank: Any, obj: Any, w: FloatArray) -> None:  # pragma: no cover - compiled
    """Mode probabilities without those at the floor, normalised, into w (M,).

    A mode at the floor is not there and its state may be anything: a mode that ends at x = 10 m
    would widen the covariance of an object at 70 m.  It comes back by transitions from the others.
    """
    total = 0.0
    for j in range(bank.n_modes):
        w[j] = obj.mu[j] if obj.mu[j] > 2.0 * bank.mu_floor else 0.0
        total += w[j]
    for j in range(bank.n_modes):
        w[j] /= total


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def combine_(n: int, bank: Any, obj: Any, work: Any) -> None:  # pragma: no cover - compiled
    """Combined mean and covariance (19)(20) of all modes that are above the floor."""
    n_modes = bank.n_modes
    present_(bank, obj, work.w)
    for s in range(n):
        v = 0.0
        for j in range(n_modes):
            v += work.w[j] * obj.x[j, s]
        obj.mean[s] = v
    for s in range(n):
        for t in range(s + 1):
            v = 0.0
            for j in range(n_modes):
                if work.w[j] > 0.0:
                    v += work.w[j] * (
                        obj.P[j, s, t] + (obj.x[j, s] - obj.mean[s]) * (obj.x[j, t] - obj.mean[t])
                    )
            obj.cov[s, t] = v
            obj.cov[t, s] = v


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def normalise_(
    n: int, mu: FloatArray, log_l: FloatArray, c: FloatArray, floor: float
) -> bool:  # pragma: no cover - compiled
    """mu_j proportional to exp(log_l_j) c_j with the log-sum-exp shift, then the floor.

    ``c`` is used up.

    Returns:
        False if no mode has a finite likelihood (mu untouched).
    """
    top = -np.inf
    for j in range(n):
        c[j] = log_l[j] + (math.log(c[j]) if c[j] > 0.0 else LOG_FLOOR)
        if c[j] > top:
            top = c[j]
    if not (top > LOG_FLOOR / 2 and top < np.inf):
        return False
    s = 0.0
    for j in range(n):
        mu[j] = math.exp(c[j] - top) if c[j] > LOG_FLOOR / 2 else 0.0
        s += mu[j]
    t = 0.0
    for j in range(n):
        mu[j] = max(mu[j] / s, floor)
        t += mu[j]
    for j in range(n):
        mu[j] /= t
    return True


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
            k = reference(LANE, bank.soft_lanes[j, c], 1.0, y / obj.lane_width)
            if k != 0.0:
                obj.lane_scans = min(obj.lane_scans + 1.0, 10.0 * bank.lane_prior)
                gain = 1.0 / (bank.lane_prior + obj.lane_scans)
                width = obj.lane_width + gain * (y / k - obj.lane_width)
                obj.lane_width = min(max(width, bank.lane_range[0]), bank.lane_range[1])


@numba.njit(nogil=True, cache=True, error_model="numpy")
def surprise(
    bank: Any, obj: Any, m: int, z: FloatArray, r: FloatArray, valid: Any, age: float
) -> float:  # pragma: no cover - compiled
    """Squared distance of z from where the object can be, in standard deviations.

    The combined estimate moved on at constant speed, widened by ``jump_std``: how far a vehicle can
    depart from that between two scans.  It knows no modes: a manoeuvre must never be an outlier.
    """
    d = 0.0
    tau = m * bank.step_s - age
    for c in range(4):
        if valid[c]:
            e = z[c] - obj.mean[c]
            if c == 0 or c == 2:
                e -= tau * obj.mean[c + 1]
            d += e * e / (obj.cov[c, c] + r[c] + bank.jump_std[c] ** 2)
    return d


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
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
        bank, obj, work: records of `BANK_DTYPE`, `OBJECT_DTYPE`, `WORK_DTYPE`.
        m: steps since the object's last measurement.
        z, r: (4,) measured x, vx, y, vy and their variances.  valid: (4,) bool.
        age: of the measurement [s].
        gate: z is an outlier if its `surprise` is larger; inf switches the gate off.
        particles: (N, 7) the object's particles; N may be 0 in a bank without a particle mode.
        spare: (N, 7) scratch.  weights: (N,) scratch.
        noise: state of the random numbers, used by the particle mode only.

    Returns:
        OK; OUTLIER or FAILED with the object as it was before (a failed mode alone gets the floor).
    """
    n_modes = bank.n_modes
    if surprise(bank, obj, m, z, r, valid, age) > gate:
        return OUTLIER
    work.lane_width = obj.lane_width
    present_(bank, obj, work.mu)
    transitions_(n, bank, obj, work, m)
    for j in range(n_modes):
        c = 0.0
        for i in range(n_modes):
            work.w[i] = work.Pi[i, j] * work.mu[i]
            c += work.w[i]
        work.c[j] = c
        for i in range(n_modes):
            work.w[i] = work.w[i] / c if work.w[i] > NEGLIGIBLE_WEIGHT * c else 0.0
        log_l = LOG_FLOOR
        if c < UNREACHABLE:
            work.c[j] = 0.0
            keep_combined_(n, obj, work.x[j], work.P[j])
        elif bank.is_particle[j]:
            log_l = update_particles_(
                bank, obj, work, j, m, z, r, valid, age, particles, spare, weights, noise
            )
        else:
            mix_(n, bank, obj, work, j, m)
            predict_(n, work.x[j], work.P[j], bank.F[m, j], bank.Q[m, j], work.row)
            log_l = update_mode_(n, bank, work, j, z, r, valid, age)
        if not log_l > LOG_FLOOR:
            # Also a numeric failure: what is left of its state must not reach the others.
            keep_combined_(n, obj, work.x[j], work.P[j])
            log_l = LOG_FLOOR
        obj.log_l[j] = log_l
    if not normalise_(n_modes, obj.mu, obj.log_l, work.c, bank.mu_floor):
        return FAILED
    for j in range(n_modes):
        for s in range(n):
            obj.x[j, s] = work.x[j, s]
            for t in range(n):
                obj.P[j, s, t] = work.P[j, s, t]
    combine_(n, bank, obj, work)
    learn_lane_(bank, obj)
    return OK


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
    obj.lane_width = bank.lane_width
    obj.lane_scans = 0.0
    work.lane_width = bank.lane_width
    for j in range(n_modes):
        x = work.x[j]
        P = work.P[j]
        for s in range(n):
            x[s] = 0.0
            for t in range(n):
                P[s, t] = 0.0
            P[s, s] = bank.birth_std[s] ** 2
            if s < 4 and s % 2 == 0 and valid[s]:
                x[s] = z[s]
            if bank.entry_var[j, s] >= 0.0:
                x[s] = bank.entry_mean[j, s]
                P[s, s] = bank.entry_var[j, s]
        work.c[j] = bank.mu0[j]
        for c in range(bank.n_bounds[j]):
            s = bank.bound_state[j, c]
            if bank.bound_mass[j, c] and s < 4 and valid[s]:
                base = reference(
                    bank.bound_kind[j, c], bank.bound_lanes[j, c], work.lane_width, z[s]
                )
                sd = math.sqrt(r[s])
                work.c[j] *= math.exp(
                    normal_mass(
                        (base + bank.bound_lower[j, c] - z[s]) / sd,
                        (base + bank.bound_upper[j, c] - z[s]) / sd,
                    )
                )
        log_l = update_mode_(n, bank, work, j, z, r, valid, age)
        if bank.is_particle[j]:
            log_l = LOG_FLOOR  # entered from another mode, never born into
        obj.log_l[j] = log_l if log_l > LOG_FLOOR else LOG_FLOOR
        obj.mu[j] = bank.mu0[j]
    if not normalise_(n_modes, obj.mu, obj.log_l, work.c, bank.mu_floor):
        return FAILED
    for j in range(n_modes):
        for s in range(n):
            obj.x[j, s] = work.x[j, s]
            for t in range(n):
                obj.P[j, s, t] = work.P[j, s, t]
    combine_(n, bank, obj, work)
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
        for s in range(n):
            work.x[j, s] = obj.x[j, s]
            for t in range(n):
                work.P[j, s, t] = obj.P[j, s, t]
        predict_(n, work.x[j], work.P[j], bank.F[m, j], bank.Q[m, j], work.row)
        for s in range(n):
            x[s] += work.c[j] * work.x[j, s]
    for j in range(n_modes):
        for s in range(n):
            for t in range(n):
                P[s, t] += work.c[j] * (
                    work.P[j, s, t] + (work.x[j, s] - x[s]) * (work.x[j, t] - x[t])
                )


@numba.njit(nogil=True, cache=True, error_model="numpy")
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
    age: float,
    gate: float,
    particles: FloatArray,
    spare: FloatArray,
    weights: FloatArray,
    noise: NoiseState,
    status: Any,
) -> None:  # pragma: no cover - compiled
    """One scan: the cycle, or the birth, of all its objects in one call.

    Args:
        bank, work: (1,) arrays of records.  objects: (capacity,) records, one per slot.
        n: rows in use.  slot: (N,) int32, -1 for none.
        steps: (N,) int32, steps since the slot's last measurement; -1 for a birth.
        z, r: (N, 4) measured values and variances.  valid: (N, 4) bool.
        age, gate, spare, weights, noise: as for `cycle_`.
        particles: (capacity, n_particles, 7).
        status: (N,) int8, written: OK, OUTLIER or FAILED.
    """
    for k in range(n):
        s = slot[k]
        if s < 0:
            continue
        if steps[k] < 0:
            status[k] = birth_(bank[0], objects[s], work[0], z[k], r[k], valid[k], age)
        elif bank[0].n_states == 4:
            # The number of states as a constant lets the compiler unroll everything.
            status[k] = cycle_(
                4,
                bank[0],
                objects[s],
                work[0],
                steps[k],
                z[k],
                r[k],
                valid[k],
                age,
                gate,
                particles[s],
                spare,
                weights,
                noise,
            )
        elif bank[0].n_states == 5:
            status[k] = cycle_(
                5,
                bank[0],
                objects[s],
                work[0],
                steps[k],
                z[k],
                r[k],
                valid[k],
                age,
                gate,
                particles[s],
                spare,
                weights,
                noise,
            )
        else:
            status[k] = cycle_(
                bank[0].n_states,
                bank[0],
                objects[s],
                work[0],
                steps[k],
                z[k],
                r[k],
                valid[k],
                age,
                gate,
                particles[s],
                spare,
                weights,
                noise,
            )
