"""What reports of several objects and scans say together: cut-ins, overtaking, twins."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from can_imm.types import CUT_IN, CUT_OUT, OVERTAKING_ANOTHER, Manoeuvre

NO_LANE = -128

MEMORY_DTYPE = np.dtype(
    [
        ("left_ns", np.int64),
        ("told_ns", np.int64),
        ("twin", np.int32),
        ("twin_scans", np.int32),
        ("kept", np.int16),
        ("left", np.int16),
        ("changing", np.bool_),
        ("unsaid", np.float64),
    ],
    align=True,
)
"""What is remembered of a slot: ``changing`` a lane change was said of it, ``unsaid`` what it
has cost that one was not said yet [s], ``told_ns`` when that was last looked at; ``kept`` the lane
it kept last, ``left`` the lane that it left to the left at ``left_ns`` (lanes by number, `NO_LANE`
for none); ``twin`` slot of an object that has been in the same place for ``twin_scans`` scans."""

LONGEST_NS = 100_000_000
"""What was said counts for no longer than this [ns]."""
OVERTAKING_NS = 20_000_000_000
"""So long after a lane change to the left [ns] passing the other lane's vehicles is overtaking."""
AHEAD_M, BEHIND_M, FASTER = 40.0, 10.0, 0.5
"""An object overtakes one that is up to so far ahead or behind [m] and so much slower [m/s]."""
TWIN_M, TWIN_WIDTH_M, TWIN_SPEED = 3.0, 1.0, 1.0
"""No two vehicles are so near along and across the road [m] at the same speed [m/s]."""
TWIN_SCANS = 3

_LANE_CHANGE = int(Manoeuvre.LANE_CHANGE)
_STATIONARY = int(Manoeuvre.STATIONARY)
_ONCOMING = int(Manoeuvre.ONCOMING)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def hesitate_(
    ids: Any, memory: Any, price: float, reports: Any, n: int
) -> None:  # pragma: no cover - compiled
    """Say that a lane change has begun only when that pays, in place.

    Most of what is a lane change by a narrow margin or for a moment is none: a vehicle wanders in
    its lane, or one measurement is far off.  One that is said and does not take place counts as
    much as ``price`` seconds of another wrong manoeuvre, so to say it costs that times the
    probability that it does not.  Not to say it costs, over the time, by how much less probable the
    second most probable manoeuvre is, which is said instead.  It is said when this has added up to
    that, as somebody who does not know for how long he will ski buys skis when the rent paid has
    reached their price (A. R. Karlin et al., "Competitive snoopy caching", Algorithmica 3, 1988).
    One that was said stays until another manoeuvre is more probable.  Other arguments as
    for `relate_`.
    """
    k = 0
    for s in range(ids.shape[0]):
        if ids[s] < 0:
            continue
        report, m = reports[k], memory[s]
        k += 1
        dt = min(report.t_ns - m.told_ns, LONGEST_NS) * 1e-9
        m.told_ns = report.t_ns
        if report.age <= 1:
            m.changing = False
            m.unsaid = dt = 0.0
        changing = report.manoeuvre == _LANE_CHANGE
        if not changing or m.changing:
            m.unsaid = 0.0
        else:
            p = report.probability
            m.unsaid += (p - report.second_probability) * dt
            if m.unsaid < price * (1.0 - p):
                changing = False
                report.manoeuvre, report.second = report.second, report.manoeuvre
                report.probability = report.second_probability
                report.second_probability = p
                report.direction = 0
        m.changing = changing


@numba.njit(nogil=True, cache=True, error_model="numpy")
def relate_(ids: Any, memory: Any, reports: Any, n: int) -> None:  # pragma: no cover - compiled
    """Set ``flags`` and ``duplicate_of`` of the reports, in place.

    Args:
        ids: (capacity,) object id of each slot, -1 for a free one.
        memory: (capacity,) of `MEMORY_DTYPE`.
        reports: (capacity,) of REPORT_DTYPE in the order of the slots in use, positions in the axes
            of the road.  n: number of them.
    """
    rows = np.empty(n, np.int64)
    k = 0
    for s in range(ids.shape[0]):
        if ids[s] >= 0:
            rows[k] = s
            k += 1
    for k in range(n):
        _remember_lane_(memory[rows[k]], reports[k])
    for k in range(n):
        _find_twin_(memory, rows, reports, n, k)
    for k in range(n):
        m = memory[rows[k]]
        report = reports[k]
        if m.left == NO_LANE or report.t_ns - m.left_ns > OVERTAKING_NS:
            continue
        if report.manoeuvre == _LANE_CHANGE:
            if report.direction < 0:
                continue
        elif report.lane != m.left + 1:
            continue
        for other in range(n):
            o = reports[other]
            if (
                other != k
                and o.lane == m.left
                and o.manoeuvre != _STATIONARY
                and o.manoeuvre != _ONCOMING
                and report.x[1] - o.x[1] > FASTER
                and -BEHIND_M < o.x[0] - report.x[0] < AHEAD_M
                and abs(o.x[2] - report.x[2]) > TWIN_WIDTH_M
            ):
                report.flags |= OVERTAKING_ANOTHER


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _remember_lane_(m: Any, report: Any) -> None:  # pragma: no cover - compiled
    """Which lane the object kept, and the flags of a lane change.

    While a lane change is held back by `hesitate_` the lane that was kept before it counts.
    """
    if report.age <= 1:
        m.kept = NO_LANE
        m.left = NO_LANE
        m.twin = -1
        m.twin_scans = 0
    if report.manoeuvre == _STATIONARY or report.manoeuvre == _ONCOMING:
        return
    if report.manoeuvre != _LANE_CHANGE:
        if m.unsaid > 0.0 and m.kept != NO_LANE:
            return
        if m.kept != NO_LANE and report.lane > m.kept:
            m.left = m.kept
            m.left_ns = report.t_ns
        elif m.kept != NO_LANE and report.lane < m.kept:
            m.left = NO_LANE
        m.kept = report.lane
        return
    if m.kept == NO_LANE:
        return
    if report.direction > 0:
        m.left = m.kept
        m.left_ns = report.t_ns
    if m.kept + report.direction == 0:
        report.flags |= CUT_IN
    elif m.kept == 0:
        report.flags |= CUT_OUT


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _find_twin_(
    memory: Any, rows: Any, reports: Any, n: int, k: int
) -> None:  # pragma: no cover - compiled
    """An older object at the same place, for some scans: the same vehicle under another id."""
    report = reports[k]
    m = memory[rows[k]]
    twin = -1
    for other in range(n):
        o = reports[other]
        older = o.age > report.age or (o.age == report.age and other < k)
        if (
            older
            and not o.coasting
            and o.duplicate_of < 0
            and abs(o.x[0] - report.x[0]) < TWIN_M
            and abs(o.x[1] - report.x[1]) < TWIN_SPEED
            and abs(o.x[2] - report.x[2]) < TWIN_WIDTH_M
        ):
            twin = other
            break
    if twin < 0:
        m.twin = -1
        m.twin_scans = 0
        return
    if m.twin != rows[twin]:
        m.twin = rows[twin]
        m.twin_scans = 0
    m.twin_scans += 1
    if m.twin_scans >= TWIN_SCANS:
        report.duplicate_of = reports[twin].object_id


@numba.njit(nogil=True, cache=True, error_model="numpy")
def shift_lanes_(memory: Any, moved: int) -> None:  # pragma: no cover - compiled
    """The ego has moved ``moved`` lanes to the left: every lane has another number."""
    for s in range(memory.shape[0]):
        if memory[s].kept != NO_LANE:
            memory[s].kept -= moved
        if memory[s].left != NO_LANE:
            memory[s].left -= moved
