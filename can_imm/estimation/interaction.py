"""Interaction: state-dependent transitions between the modes, and mixing (equations 14 to 16)."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.estimation.constraints import interval_probability
from can_imm.estimation.layout import FIXED, GROUND, SPEED_STEP
from can_imm.estimation.stack import element, stack_matrix, stack_vector
from can_imm.types import MAX_STATES, VX, FloatArray, X


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def enter_(
    n: int, bank: Any, obj: Any, i: int, j: int, tau: float, m: FloatArray, A: FloatArray
) -> None:  # pragma: no cover - compiled
    """What source i brings into mode j: mean into m (n,), lower half of the covariance into A.

    Where bit s of ``entry_sources[i, j]`` is set, state s is replaced by the mode's entry
    distribution: what a vehicle that starts this manoeuvre does, not what it did before.  Where
    that is the speed ahead, the change took place at some instant of the last ``tau`` seconds, all
    equally likely: x is set back accordingly, with exact first and second moments.  (Sideways the
    same would only blur a lane change, whose speed builds up within the interval.)
    """
    for s in range(n):
        m[s] = obj.x[i, s]
        for t in range(s + 1):
            A[s, t] = obj.P[i, s, t]
    replaced = bank.entry_sources[i, j]
    if not replaced:
        return
    for s in range(n):
        if replaced >> s & 1:
            m[s] = bank.entry_mean[j, s]
        for t in range(s + 1):
            if replaced & (1 << s | 1 << t):
                A[s, t] = bank.entry_var[j, s] if s == t else 0.0
    if replaced & (SPEED_STEP | 1 << X) != SPEED_STEP:
        return
    # x - a (v_new - v_old), the change a seconds before the end of the interval
    dv = bank.entry_mean[j, VX] - obj.x[i, VX]
    spread = bank.entry_var[j, VX] + obj.P[i, VX, VX]
    m[X] -= 0.5 * tau * dv
    A[X, X] += tau * obj.P[i, X, VX] + tau * tau * (spread / 3.0 + dv * dv / 12.0)
    A[VX, X] = -0.5 * tau * bank.entry_var[j, VX]
    for s in range(VX + 1, n):
        if not replaced >> s & 1:
            A[s, X] += 0.5 * tau * obj.P[i, VX, s]


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def mix_(
    n: int, bank: Any, obj: Any, work: Any, j: int, m: int, x: FloatArray, P: FloatArray
) -> None:  # pragma: no cover - compiled
    """Interaction (15)(16) for target mode j: mixed mean into x (n,), covariance into P (n, n).

    ``work.w`` holds the mixing weights; ``m`` is the number of steps since the last measurement.
    """
    tau = m * bank.step_s
    from_x, from_P = stack_vector(MAX_STATES), stack_matrix(MAX_STATES, MAX_STATES)
    d = stack_vector(MAX_STATES)
    for s in range(n):
        x[s] = 0.0
        for t in range(s + 1):
            P[s, t] = 0.0
    for i in range(bank.n_modes):
        if work.w[i] > 0.0:
            # covariances are of no use here, and the compiler leaves them out
            enter_(n, bank, obj, i, j, tau, from_x, from_P)
            for s in range(n):
                x[s] += work.w[i] * from_x[s]
    for i in range(bank.n_modes):
        if work.w[i] > 0.0:
            enter_(n, bank, obj, i, j, tau, from_x, from_P)
            for s in range(n):
                d[s] = from_x[s] - x[s]
                for t in range(s + 1):
                    P[s, t] += work.w[i] * (from_P[s, t] + d[s] * d[t])
    for s in range(n):
        for t in range(s):
            P[t, s] = P[s, t]


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def transitions_(
    n: int, bank: Any, obj: Any, work: Any, m: int
) -> None:  # pragma: no cover - compiled
    """State-dependent transition probabilities of this cycle into obj.Pi.

    A bound with ``mass`` is a region outside of which the mode does not exist.  The probability of
    going from i to j is that of the chain times the mass which source i, moved on by ``m`` steps
    with its own model, has inside j's regions; each row is normalised again, so that a source
    loses nothing to a mode it cannot reach.  States that the entry replaces do not count.
    ``work.mu`` holds the probabilities of the modes that are present.
    """
    n_modes = bank.n_modes
    for i in range(n_modes):
        if work.mu[i] == 0.0:
            for j in range(n_modes):
                obj.Pi[i, j] = bank.Pi[m, i, j]
            continue
        done = 0  # bits of the states that have been moved on
        total = 0.0
        for j in range(n_modes):
            p = bank.Pi[m, i, j]
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
                    work.var[s] = max(q, bank.var_floor)
            intervals_(n, bank, j, work.tx, True, work)
            for c in range(bank.n_bounds[j]):
                s = bank.bound_state[j, c]
                if not bank.bound_mass[j, c] or (bank.entry_sources[i, j] >> s & 1):
                    continue
                if not work.lower[c] < work.upper[c]:
                    p = 0.0
                    break
                if work.lower[c] > -np.inf or work.upper[c] < np.inf:
                    p *= interval_probability(work.tx[s], work.var[s], work.lower[c], work.upper[c])
            obj.Pi[i, j] = p
            total += p
        if total > 1e-30:
            scale = 1.0 / total
            for j in range(n_modes):
                obj.Pi[i, j] *= scale
        else:
            for j in range(n_modes):
                obj.Pi[i, j] = bank.Pi[m, i, j]


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def intervals_(
    n: int, bank: Any, j: int, x: FloatArray, only_mass: bool, work: Any
) -> None:  # pragma: no cover - compiled
    """The intervals of mode j's bounds around x into work.lower, work.upper.

    Rows that bound the same state are one interval, written to the first of them; the others get
    all numbers.  Where they contradict each other, lower is not below upper.

    Args:
        only_mass: rows without ``mass`` do not count.
    """
    for c in range(bank.n_bounds[j]):
        work.lower[c] = -np.inf
        work.upper[c] = np.inf
        if only_mass and not bank.bound_mass[j, c]:
            continue
        s = bank.bound_state[j, c]
        base = reference(bank.bound_kind[j, c], bank.bound_lanes[j, c], work, element(n, x, s))
        first = c
        for d in range(c - 1, -1, -1):
            if bank.bound_state[j, d] == s and (bank.bound_mass[j, d] or not only_mass):
                first = d
        work.lower[first] = max(work.lower[first], base + bank.bound_lower[j, c])
        work.upper[first] = min(work.upper[first], base + bank.bound_upper[j, c])


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def reference(
    kind: int, lanes: FloatArray, work: Any, y: float
) -> float:  # pragma: no cover - compiled
    """What a row's numbers count from: 0, the centre of the lane nearest to ``y``, or the ground.

    Args:
        lanes: (2,) lowest and highest number of the lanes that count; lane k lies at k times the
            width.
        work: ``lane_width`` [m] and ``ground``, the speed of the ground against the ego [m/s].
    """
    if kind == FIXED:
        return 0.0
    if kind == GROUND:
        ground: float = work.ground
        return ground
    centre: float = nearest_lane(y, work.lane_width, lanes) * work.lane_width
    return centre


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def nearest_lane(y: float, width: float, lanes: FloatArray) -> float:  # pragma: no cover - compiled
    """Number of the lane nearest to ``y`` [m], of those from lanes[0] to lanes[1]."""
    lane: float = min(max(math.floor(y / width + 0.5), lanes[0]), lanes[1])
    return lane
