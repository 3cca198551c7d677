"""Which slot a measurement belongs to, and what becomes of the slots: a detector's bookkeeping.

A slot is free where ``ids`` is -1; ``free[:n_free[0]]`` are the free ones, the next one last.
Behind these, from ``capacity`` on, are the ``n_free[1]`` that were set free lately.  What happens
is counted in ``tally``, in the order of `TALLY`.
"""

from __future__ import annotations

import math
from typing import Any

import numba

from can_imm.estimation.imm import OK, OUTLIER
from can_imm.types import FloatArray

LARGEST = 1e6
"""A measured value, or standard deviation, beyond this is invalid; squares cannot overflow."""

TALLY = (
    "duplicates", "invalid", "overflow", "births", "deaths", "reused_ids", "measurements",
    "outliers", "numeric_failures",
)  # fmt: skip
"""What is counted, by the names of `DetectorCounts`."""
(
    _DUPLICATES, _INVALID, _OVERFLOW, _BIRTHS, _DEATHS, _REUSED_IDS, _MEASUREMENTS, _OUTLIERS,
    _FAILURES,
) = range(len(TALLY))  # fmt: skip


@numba.njit(nogil=True, cache=True, error_model="numpy")
def assign_(
    n: int,
    now: int,
    coast: int,
    scan_ids: Any,
    new: Any,
    scan_z: FloatArray,
    std: FloatArray,
    scan_valid: Any,
    scan_angle: FloatArray,
    variance: FloatArray,
    slot: Any,
    steps: Any,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    angle: FloatArray,
    ids: Any,
    updated: Any,
    age: Any,
    outliers: Any,
    measured: Any,
    free: Any,
    n_free: Any,
    tally: Any,
) -> None:  # pragma: no cover - compiled
    """Give every row of a scan its slot (-1: none) and the steps since its last update; take over
    its values.

    Args:
        n: rows of the scan.  now: number of the step.  coast: longest time without a measurement.
        scan_ids, new, scan_z, std, scan_valid, scan_angle: as in `Scan`.
        variance: (4,) instead of the sensor's own, (0,) for the latter.
        slot, steps, z, r, valid, angle: (N, ...) written, as for `imm.process_scan_`.
        ids, updated, age, outliers, measured: (capacity,) of the slots.
    """
    for s in range(ids.shape[0]):
        measured[s] = False
    for k in range(n):
        slot[k] = -1
        angle[k] = scan_angle[k]
        any_valid = False
        sound = abs(angle[k]) <= LARGEST
        for c in range(4):
            z[k, c] = scan_z[k, c]
            sd = std[k, c]
            valid[k, c] = scan_valid[k, c]
            if valid[k, c]:
                any_valid = True
                if not (abs(z[k, c]) < LARGEST and 0.0 < sd < LARGEST):
                    sound = False
            sd = min(max(sd, 0.0), LARGEST)
            r[k, c] = variance[c] if variance.shape[0] else sd * sd
        name = scan_ids[k]
        seen = False
        for i in range(k):
            if scan_ids[i] == name:
                seen = True
        if seen:
            tally[_DUPLICATES] += 1
            continue
        if not (sound and any_valid):
            tally[_INVALID] += 1
            continue
        own = -1
        for s in range(ids.shape[0]):
            if ids[s] == name:
                own = s
        if own >= 0:
            gone = now - updated[own] > coast
            if new[k]:
                tally[_REUSED_IDS] += 1
            if new[k] or gone:
                end_(own, ids, free, n_free, tally)
                own = -1
        if own < 0:
            if n_free[0] == 0:
                tally[_OVERFLOW] += 1
                continue
            n_free[0] -= 1
            own = free[n_free[0]]
            ids[own] = name
            age[own] = 0
            outliers[own] = 0
            tally[_BIRTHS] += 1
        slot[k] = own
        steps[k] = -1 if age[own] == 0 else now - updated[own]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def straighten_(
    n: int, slot: Any, z: FloatArray, r: FloatArray, valid: Any, angle: FloatArray, turn_r: bool
) -> None:  # pragma: no cover - compiled
    """Measurements in turned axes as ones in the vehicle's, in place: particles know no others.

    Variances go along, the covariance between the axes is dropped.  A pair of which only the first
    value was measured stays as it is: a speed along the line of sight is taken as vx.

    Args:
        slot, z, r, valid, angle: (N, ...) as `assign_` leaves them.
        turn_r: the variances are the sensor's own; otherwise they are those along the vehicle's
            axes.
    """
    for k in range(n):
        if slot[k] < 0 or angle[k] == 0.0:
            continue
        cos, sin = math.cos(angle[k]), math.sin(angle[k])
        angle[k] = 0.0
        for c in range(2):
            if not (valid[k, c] and valid[k, c + 2]):
                continue
            u, w = z[k, c], z[k, c + 2]
            z[k, c], z[k, c + 2] = u * cos - w * sin, u * sin + w * cos
            if turn_r:
                u, w = r[k, c], r[k, c + 2]
                r[k, c] = u * cos * cos + w * sin * sin
                r[k, c + 2] = u * sin * sin + w * cos * cos


@numba.njit(nogil=True, cache=True, error_model="numpy")
def settle_(
    n: int,
    now: int,
    max_outliers: int,
    slot: Any,
    status: Any,
    ids: Any,
    updated: Any,
    age: Any,
    outliers: Any,
    measured: Any,
    free: Any,
    n_free: Any,
    tally: Any,
) -> None:  # pragma: no cover - compiled
    """Act on what became of every measurement; arguments as for `assign_`.

    Args:
        max_outliers: after so many in a row the id is taken to name another object.
        status: (N,) from `imm.process_scan_`.
    """
    for k in range(n):
        s = slot[k]
        if s < 0:
            continue
        if status[k] == OK:
            tally[_MEASUREMENTS] += 1
            updated[s] = now
            age[s] += 1
            outliers[s] = 0
            measured[s] = True
            continue
        if status[k] == OUTLIER:
            tally[_OUTLIERS] += 1
            outliers[s] += 1
            if outliers[s] < max_outliers:
                continue
            tally[_REUSED_IDS] += 1
        else:
            tally[_FAILURES] += 1
        # The id's next measurement begins a new track.
        end_(s, ids, free, n_free, tally)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def bury_(
    now: int, coast: int, ids: Any, updated: Any, free: Any, n_free: Any, tally: Any
) -> int:  # pragma: no cover - compiled
    """End the tracks that coasted for too long; arguments as for `assign_`.

    Returns:
        The first step at which another one may have to end.
    """
    oldest = now
    for s in range(ids.shape[0]):
        if ids[s] < 0:
            continue
        if now - updated[s] > coast:
            end_(s, ids, free, n_free, tally)
        elif updated[s] < oldest:
            oldest = updated[s]
    return oldest + coast + 1


@numba.njit(nogil=True, cache=True, error_model="numpy")
def end_(s: int, ids: Any, free: Any, n_free: Any, tally: Any) -> None:  # pragma: no cover
    """Set slot ``s`` free."""
    ids[s] = -1
    free[n_free[0]] = s
    n_free[0] += 1
    free[ids.shape[0] + n_free[1]] = s
    n_free[1] += 1
    tally[_DEATHS] += 1
