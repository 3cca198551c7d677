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
import numpy.typing as npt

from can_imm.estimation.constraints import project_, truncate_
from can_imm.estimation.kalman import log_normal, predict_, update_row_, update_state_
from can_imm.estimation.particles import (
    N_COLUMNS,
    cholesky4_,
    enter_,
    moments_,
    particle_dtype,
    propagate_,
    resample_,
    weigh_,
)
from can_imm.types import FloatArray

LOG_FLOOR = -1e30

MAX_ROWS = 4
"""Largest number of constraint rows of one kind in one mode."""

FIXED, LANE = 0, 1
"""Where the value of a soft row comes from: a number, or the nearest lane centre in a range."""


def bank_dtype(n_modes: int, n_states: int, n_steps: int) -> np.dtype[np.void]:
    """Parameters of a mode bank as one record.

    Tables are indexed by the number of elapsed steps: ``F[m]``, ``Q[m]``, ``Pi[m]`` belong to m
    steps, 0 <= m < n_steps.  ``Pi[m, i, j]`` is the probability of going from mode i to mode j.
    """
    m, n, k = n_modes, n_states, MAX_ROWS
    return np.dtype(
        [
            ("F", np.float64, (n_steps, m, n, n)),
            ("Q", np.float64, (n_steps, m, n, n)),
            ("Pi", np.float64, (n_steps, m, m)),
            ("mu0", np.float64, (m,)),
            ("birth_std", np.float64, (n,)),
            ("step_s", np.float64),
            ("mu_floor", np.float64),
            ("var_floor", np.float64),
            ("lane_width", np.float64),
            ("manoeuvre", np.int8, (m,)),
            ("is_particle", np.int8, (m,)),
            ("is_projected", np.int8, (m,)),
            ("n_soft", np.int8, (m,)),
            ("soft_kind", np.int8, (m, k)),
            ("soft_state", np.int8, (m, k)),
            ("soft_value", np.float64, (m, k)),
            ("soft_upper", np.float64, (m, k)),
            ("soft_r", np.float64, (m, k)),
            ("n_bounds", np.int8, (m,)),
            ("bound_state", np.int8, (m, k)),
            ("bound_lower", np.float64, (m, k)),
            ("bound_upper", np.float64, (m, k)),
            ("bound_mass", np.int8, (m, k)),
            ("n_entry", np.int8, (m,)),
            ("entry_state", np.int8, (m, k)),
            ("entry_mean", np.float64, (m, k)),
            ("entry_var", np.float64, (m, k)),
            ("entry_sources", np.int8, (m, m)),
            ("particle", particle_dtype()),
        ]
    )


def object_dtype(n_modes: int, n_states: int, n_particles: int) -> np.dtype[np.void]:
    """Estimator state of one object.

    ``x``, ``P``, ``mu`` per mode at the last measurement; ``mean``, ``cov`` the combined estimate;
    ``p`` unused rows of the particle array are those of a bank without particles.
    """
    return np.dtype(
        [
            ("x", np.float64, (n_modes, n_states)),
            ("P", np.float64, (n_modes, n_states, n_states)),
            ("mu", np.float64, (n_modes,)),
            ("log_l", np.float64, (n_modes,)),
            ("mean", np.float64, (n_states,)),
            ("cov", np.float64, (n_states, n_states)),
            ("nis", np.float64),
            ("particles", np.float64, (n_particles, N_COLUMNS)),
        ]
    )


def work_dtype(n_modes: int, n_states: int, n_particles: int) -> np.dtype[np.void]:
    """Scratch of the kernels; one record serves all objects."""
    return np.dtype(
        [
            ("x", np.float64, (n_modes, n_states)),
            ("P", np.float64, (n_modes, n_states, n_states)),
            ("c", np.float64, (n_modes,)),
            ("w", np.float64, (n_modes,)),
            ("sx", np.float64, (n_modes, n_states)),
            ("tx", np.float64, (n_states,)),
            ("tP", np.float64, (n_states, n_states)),
            ("h", np.float64, (n_states,)),
            ("row", np.float64, (n_states + 1, n_states)),
            ("L", np.float64, (4, 4)),
            ("particles", np.float64, (n_particles, N_COLUMNS)),
            ("pw", np.float64, (n_particles,)),
        ]
    )


@numba.njit(nogil=True, cache=True, error_model="numpy")
def mix_(bank: Any, obj: Any, work: Any, j: int) -> None:  # pragma: no cover - compiled
    """Interaction (15)(16) for target mode j: mixed mean and covariance into work.x[j], work.P[j].

    A source i for which ``entry_sources[i, j]`` holds has its entry states replaced by the mode's
    entry distribution: what a vehicle that starts this manoeuvre does, not what it did before.
    ``work.w`` holds the mixing weights.
    """
    n_modes, n = obj.x.shape
    xj = work.x[j]
    Pj = work.P[j]
    for s in range(n):
        xj[s] = 0.0
        for t in range(n):
            Pj[s, t] = 0.0
    for i in range(n_modes):
        if work.w[i] <= 0.0:
            continue
        for s in range(n):
            work.sx[i, s] = obj.x[i, s]
        if bank.entry_sources[i, j]:
            for e in range(bank.n_entry[j]):
                work.sx[i, bank.entry_state[j, e]] = bank.entry_mean[j, e]
        for s in range(n):
            xj[s] += work.w[i] * work.sx[i, s]
    for i in range(n_modes):
        wi = work.w[i]
        if wi <= 0.0:
            continue
        entered = bank.entry_sources[i, j] and bank.n_entry[j] > 0
        for s in range(n):
            ds = work.sx[i, s] - xj[s]
            for t in range(s + 1):
                Pj[s, t] += wi * ds * (work.sx[i, t] - xj[t])
        if not entered:
            for s in range(n):
                for t in range(s + 1):
                    Pj[s, t] += wi * obj.P[i, s, t]
        else:
            for s in range(n):
                vs = -1.0
                for e in range(bank.n_entry[j]):
                    if bank.entry_state[j, e] == s:
                        vs = bank.entry_var[j, e]
                if vs >= 0.0:
                    Pj[s, s] += wi * vs
                    continue
                for t in range(s + 1):
                    free = True
                    for e in range(bank.n_entry[j]):
                        if bank.entry_state[j, e] == t:
                            free = False
                    if free:
                        Pj[s, t] += wi * obj.P[i, s, t]
    for s in range(n):
        for t in range(s):
            Pj[t, s] = Pj[s, t]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def lane_centre(y: float, low: float, high: float, width: float) -> float:  # pragma: no cover
    """Centre of the lane nearest to ``y`` among the lanes ``low`` .. ``high`` (0 is y = 0)."""
    return min(max(math.floor(y / width + 0.5), low), high) * width


@numba.njit(nogil=True, cache=True, error_model="numpy")
def constrain_soft_(
    bank: Any, j: int, x: FloatArray, P: FloatArray, row: FloatArray
) -> float:  # pragma: no cover - compiled
    """Apply the soft equality rows of mode j as pseudo-measurements (22)(23); 0, or NaN on failure.

    Their own density is not part of the mode likelihood: it would reward a prior that already
    satisfies the constraint, and has another dimension for each mode.
    """
    bad = 0.0
    for c in range(bank.n_soft[j]):
        s = bank.soft_state[j, c]
        value = bank.soft_value[j, c]
        if bank.soft_kind[j, c] == LANE:
            value = lane_centre(x[s], value, bank.soft_upper[j, c], bank.lane_width)
        bad += 0.0 * update_state_(x, P, s, value, bank.soft_r[j, c], row)[1]
    return bad


@numba.njit(nogil=True, cache=True, error_model="numpy")
def correct_(
    x: FloatArray,
    P: FloatArray,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    age: float,
    h: FloatArray,
    row: FloatArray,
) -> tuple[float, float]:  # pragma: no cover - compiled
    """Measurement update with the valid components of z, in place.

    Args:
        z, r: (4,) measured x, vx, y, vy and their variances.  valid: (4,) bool.
        age: how long before the time of ``x`` the measurement was taken [s]; a position measured
            then is x - age vx + age^2/2 ax now.
        h: (n,) scratch.  row: (>= 2, n) scratch.

    Returns:
        Log density of z, and its normalised innovation squared; NaN on a numeric failure.
    """
    n = x.shape[0]
    log_l = 0.0
    nis = 0.0
    for c in range(4):
        if not valid[c]:
            continue
        if age == 0.0:
            e, v = update_state_(x, P, c, z[c], r[c], row)
            log_l += log_normal(e, v)
            nis += e * e / v
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
        e, v = update_row_(x, P, h, z[c], r[c], row)
        log_l += log_normal(e, v)
        nis += e * e / v
    return log_l, nis


@numba.njit(nogil=True, cache=True, error_model="numpy")
def update_mode_(
    bank: Any,
    work: Any,
    j: int,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    age: float,
) -> tuple[float, float]:  # pragma: no cover - compiled
    """Constraint and measurement update of Gaussian mode j in work.x[j], work.P[j].

    Returns:
        Log of the mode likelihood, and the normalised innovation squared.
    """
    x = work.x[j]
    P = work.P[j]
    n = x.shape[0]
    log_l = constrain_soft_(bank, j, x, P, work.row)
    n_bounds = bank.n_bounds[j]
    prior = 0.0
    if n_bounds > 0:
        for s in range(n):
            work.tx[s] = x[s]
            for t in range(n):
                work.tP[s, t] = P[s, t]
        for c in range(n_bounds):
            mass = truncate_(
                work.tx,
                work.tP,
                bank.bound_state[j, c],
                bank.bound_lower[j, c],
                bank.bound_upper[j, c],
                bank.var_floor,
                work.row,
            )
            if not bank.bound_mass[j, c]:
                prior += mass
    log_z, nis = correct_(x, P, z, r, valid, age, work.h, work.row)
    posterior = 0.0
    if n_bounds > 0 and bank.is_projected[j]:
        # The mass needs the Gaussian before it is projected.
        for s in range(n):
            work.tx[s] = x[s]
            for t in range(n):
                work.tP[s, t] = P[s, t]
    for c in range(n_bounds):
        s = bank.bound_state[j, c]
        lower = bank.bound_lower[j, c]
        upper = bank.bound_upper[j, c]
        if bank.is_projected[j]:
            posterior += truncate_(work.tx, work.tP, s, lower, upper, bank.var_floor, work.row)
            if x[s] < lower:
                project_(x, P, s, lower, bank.var_floor, work.row)
            elif x[s] > upper:
                project_(x, P, s, upper, bank.var_floor, work.row)
        else:
            posterior += truncate_(x, P, s, lower, upper, bank.var_floor, work.row)
    return log_l + log_z + posterior - prior, nis


@numba.njit(nogil=True, cache=True, error_model="numpy")
def keep_combined_(obj: Any, x: FloatArray, P: FloatArray) -> None:  # pragma: no cover - compiled
    """An impossible mode takes over the combined estimate, so that it can start from there."""
    n = x.shape[0]
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
    rng: Any,
) -> float:  # pragma: no cover - compiled
    """Whole cycle of the particle mode j: interact by drawing from the sources, move, weigh,
    resample; moments into work.x[j], work.P[j]; log of mean_i[phi_i g_i].

    The mass of the window is part of the likelihood: it is a hard region (a state-dependent
    transition), not a soft overlap.
    """
    n_modes, n = obj.x.shape
    total = obj.particles.shape[0]
    x = work.x[j]
    P = work.P[j]
    # Systematic allocation of the particles to the sources; nothing is drawn for a window that
    # no source can reach within this cycle.
    done = 0
    cumulative = 0.0
    u = rng.random()
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
                    work.particles[done + k, c] = obj.particles[a, c]
        else:
            cholesky4_(obj.P[i], work.L)
            enter_(work.particles, done, count, obj.x[i], work.L, bank.particle, rng)
        done = upto
    propagate_(work.particles, m * bank.step_s, bank.particle, rng)
    log_l = weigh_(work.particles, work.pw, z, r, valid, age, bank.particle)
    for s in range(n):
        for t in range(n):
            P[s, t] = 0.0
    if log_l == -np.inf:
        # No particle is feasible; the mode keeps the last moments and the floor probability.
        keep_combined_(obj, x, P)
        return LOG_FLOOR
    moments_(work.particles, work.pw, x, P)
    for s in range(4):
        P[s, s] += bank.var_floor
    for s in range(4, n):
        x[s] = 0.0
        P[s, s] = bank.birth_std[s] ** 2
    resample_(work.particles, work.pw, obj.particles, total, rng.random())
    return log_l


@numba.njit(nogil=True, cache=True, error_model="numpy")
def combine_(obj: Any) -> None:  # pragma: no cover - compiled
    """Combined mean and covariance (19)(20) of all modes."""
    n_modes, n = obj.x.shape
    for s in range(n):
        v = 0.0
        for j in range(n_modes):
            v += obj.mu[j] * obj.x[j, s]
        obj.mean[s] = v
    for s in range(n):
        for t in range(s + 1):
            v = 0.0
            for j in range(n_modes):
                v += obj.mu[j] * (
                    obj.P[j, s, t]
                    + (obj.x[j, s] - obj.mean[s]) * (obj.x[j, t] - obj.mean[t])
                )
            obj.cov[s, t] = v
            obj.cov[t, s] = v


@numba.njit(nogil=True, cache=True, error_model="numpy")
def normalise_(mu: FloatArray, log_l: FloatArray, c: FloatArray, floor: float) -> bool:
    """mu_j proportional to exp(log_l_j) c_j with the log-sum-exp shift, then the floor.

    Returns:
        False if no mode has a finite likelihood (mu untouched).
    """
    n = mu.shape[0]
    top = -np.inf
    for j in range(n):
        v = log_l[j] + (math.log(c[j]) if c[j] > 0.0 else LOG_FLOOR)
        if v > top:
            top = v
    if not (top > LOG_FLOOR / 2 and top < np.inf):
        return False
    s = 0.0
    for j in range(n):
        v = log_l[j] + (math.log(c[j]) if c[j] > 0.0 else LOG_FLOOR)
        mu[j] = math.exp(v - top) if v > LOG_FLOOR / 2 else 0.0
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
def cycle_(
    bank: Any,
    obj: Any,
    work: Any,
    m: int,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    age: float,
    gate: float,
    rng: Any,
) -> int:  # pragma: no cover - compiled
    """One IMM cycle of one object, in place.

    Args:
        bank, obj, work: records of `bank_dtype`, `object_dtype`, `work_dtype`.
        m: steps since the object's last measurement.
        z, r: (4,) measured x, vx, y, vy and their variances.  valid: (4,) bool.
        age: of the measurement [s].
        gate: z is an outlier if its Mahalanobis distance squared is larger than this in every
            Gaussian mode; inf switches the gate off.
        rng: numpy Generator, used by particle modes only.

    Returns:
        OK; OUTLIER or FAILED with the object as it was before (a failed mode alone gets the floor).
    """
    n_modes, n = obj.x.shape
    for j in range(n_modes):
        s = 0.0
        for i in range(n_modes):
            s += bank.Pi[m, i, j] * obj.mu[i]
        work.c[j] = s
    nearest = np.inf
    for kind in range(2):  # Gaussian modes first: they decide about outliers
        for j in range(n_modes):
            if bank.is_particle[j] != kind:
                continue
            for i in range(n_modes):
                w = bank.Pi[m, i, j] * obj.mu[i] / work.c[j] if work.c[j] > 0.0 else 0.0
                work.w[i] = w if w > 1e-12 else 0.0
            log_l = LOG_FLOOR
            if work.c[j] <= 0.0:
                keep_combined_(obj, work.x[j], work.P[j])
            elif bank.is_particle[j]:
                log_l = update_particles_(bank, obj, work, j, m, z, r, valid, age, rng)
            else:
                mix_(bank, obj, work, j)
                predict_(work.x[j], work.P[j], bank.F[m, j], bank.Q[m, j], work.row)
                log_l, nis = update_mode_(bank, work, j, z, r, valid, age)
                nearest = min(nearest, nis)
            obj.log_l[j] = log_l if log_l > LOG_FLOOR else LOG_FLOOR
        if nearest > gate:
            return OUTLIER
    if not normalise_(obj.mu, obj.log_l, work.c, bank.mu_floor):
        return FAILED
    for j in range(n_modes):
        for s in range(n):
            obj.x[j, s] = work.x[j, s]
            for t in range(n):
                obj.P[j, s, t] = work.P[j, s, t]
    combine_(obj)
    return OK


@numba.njit(nogil=True, cache=True, error_model="numpy")
def birth_(
    bank: Any, obj: Any, work: Any, z: FloatArray, r: FloatArray, valid: Any, age: float
) -> int:  # pragma: no cover - compiled
    """Initialise one object from its first measurement; arguments as for `cycle_`.

    Every mode starts from a prior as wide as traffic gets, centred on the measured position and on
    zero speed, with its entry distribution and its constraints applied; so the first probabilities
    are honest ones.
    """
    n_modes, n = obj.x.shape
    for j in range(n_modes):
        x = work.x[j]
        P = work.P[j]
        for s in range(n):
            x[s] = 0.0
            for t in range(n):
                P[s, t] = 0.0
            P[s, s] = bank.birth_std[s] ** 2
        for c in range(0, 4, 2):
            if valid[c]:
                x[c] = z[c]
        for e in range(bank.n_entry[j]):
            s = bank.entry_state[j, e]
            x[s] = bank.entry_mean[j, e]
            P[s, s] = bank.entry_var[j, e]
        work.c[j] = bank.mu0[j]
        log_l = update_mode_(bank, work, j, z, r, valid, age)[0]
        if bank.is_particle[j]:
            log_l = LOG_FLOOR  # entered from another mode, never born into
        obj.log_l[j] = log_l if log_l > LOG_FLOOR else LOG_FLOOR
        obj.mu[j] = bank.mu0[j]
    if not normalise_(obj.mu, obj.log_l, work.c, bank.mu_floor):
        return FAILED
    for j in range(n_modes):
        for s in range(n):
            obj.x[j, s] = work.x[j, s]
            for t in range(n):
                obj.P[j, s, t] = work.P[j, s, t]
    for a in range(obj.particles.shape[0]):
        for c in range(N_COLUMNS):
            obj.particles[a, c] = 0.0
    combine_(obj)
    return OK


@numba.njit(nogil=True, cache=True, error_model="numpy")
def extrapolate_(bank: Any, obj: Any, m: int, x: FloatArray, P: FloatArray, mu: FloatArray, work: Any) -> None:
    """Combined estimate and mode probabilities ``m`` steps after the last measurement.

    Nothing is mixed and nothing of ``obj`` changes: each mode is predicted on its own, mu moves
    with Pi(m).  Writes x (n,), P (n, n), mu (n_modes,).
    """
    n_modes, n = obj.x.shape
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
        predict_(work.x[j], work.P[j], bank.F[m, j], bank.Q[m, j], work.row)
        for s in range(n):
            x[s] += obj.mu[j] * work.x[j, s]
    for j in range(n_modes):
        for s in range(n):
            for t in range(n):
                P[s, t] += obj.mu[j] * (
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
    rng: Any,
    status: Any,
) -> None:  # pragma: no cover - compiled
    """One scan: the cycle, or the birth, of all its objects in one call.

    Args:
        bank, work: (1,) arrays of records.  objects: (capacity,) records, one per slot.
        n: rows in use.  slot: (N,) int32, -1 for none.
        steps: (N,) int32, steps since the slot's last measurement; -1 for a birth.
        z, r: (N, 4) measured values and variances.  valid: (N, 4) bool.
        age, gate, rng: as for `cycle_`.
        status: (N,) int8, written: OK, OUTLIER or FAILED.
    """
    for k in range(n):
        s = slot[k]
        if s < 0:
            continue
        if steps[k] < 0:
            status[k] = birth_(bank[0], objects[s], work[0], z[k], r[k], valid[k], age)
        else:
            status[k] = cycle_(
                bank[0], objects[s], work[0], steps[k], z[k], r[k], valid[k], age, gate, rng
            )
