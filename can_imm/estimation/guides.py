"""The vehicles that show where the road is: what all of them do at once, it has done or the ego.

A vehicle that begins to change lanes looks like a road that begins to bend, until more is known.
So the road is learnt from the vehicles with hindsight: from each scan only some time later, when it
is known which of them were changing lanes.  The road stands still meanwhile, and the ego's own
motion is known.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.estimation.road import (
    FREE,
    N_GUIDES,
    N_ROAD,
    OFFSET,
    P_FREEDOM,
    P_FREEDOM_CHANGING,
    P_WANDER_STD,
    P_WANDER_TIME,
    WAY,
    WIDTH,
    N,
    lane_row_,
    scalar_update_,
    value,
    variance,
)
from can_imm.types import FloatArray, IntArray

SEEN_TO = 200.0
"""Vehicles further away [m] do not guide."""

LANE_KNOWN = 0.2
"""Share of the lane's width: a guide whose place is less sure does not tell where the lanes are."""

NOTE_DTYPE = np.dtype(
    [
        ("x", np.float64),
        ("y", np.float64),
        ("noise", np.float64),
        ("changing", np.float64),
        ("off", np.float64),
        ("seen", np.bool_),
        ("new", np.bool_),
    ],
    align=True,
)
"""What a scan said of a slot's object: where it was measured in the vehicle's axes [m] and the
variance of y [m²], and how probable it is that it changes lanes, and that it is off the lanes."""

GATE = 16.0
"""Squared normalised innovation above which a guide is not where it was."""


@numba.njit(nogil=True, cache=True, error_model="numpy")
def free_guide_(P: FloatArray, x: FloatArray, g: int) -> None:  # pragma: no cover - compiled
    """Forget guide g."""
    a = N_ROAD + g
    x[a] = 0.0
    for i in range(N):
        P[a, i] = 0.0
        P[i, a] = 0.0


@numba.njit(nogil=True, cache=True, error_model="numpy")
def begin_guide_(
    x: FloatArray, P: FloatArray, h: FloatArray, g: int, y: float, r: float
) -> None:  # pragma: no cover - compiled
    """Guide g is first seen at y: its place is y minus the lane's, and as uncertain as both."""
    a = N_ROAD + g
    x[a] = y - value(x, h)
    for i in range(N):
        v = 0.0
        for j in range(N_ROAD):
            v -= h[j] * P[j, i]
        P[a, i] = v
        P[i, a] = v
    P[a, a] = variance(P, h) + r


@numba.njit(nogil=True, cache=True, error_model="numpy")
def add_width_(P: FloatArray, a: int, times: float) -> None:  # pragma: no cover - compiled
    """What becomes of the covariance when so many widths are added to state a."""
    for i in range(P.shape[0]):
        P[a, i] += times * P[WIDTH, i]
    for i in range(P.shape[0]):
        P[i, a] += times * P[i, WIDTH]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def position(
    z: FloatArray, r: FloatArray, angle: float
) -> tuple[float, float, float]:  # pragma: no cover - compiled
    """x and y in the vehicle's axes [m], and the variance of y, of a row (4,) of a scan."""
    cos, sin = math.cos(angle), math.sin(angle)
    x = z[0] * cos - z[2] * sin
    y = z[0] * sin + z[2] * cos
    return x, y, r[2] * cos * cos + r[0] * sin * sin


@numba.njit(nogil=True, cache=True, error_model="numpy")
def note_(
    notes: Any,
    bank: Any,
    objects: Any,
    n: int,
    slot: Any,
    status: Any,
    age: Any,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    angle: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Write down what a scan says of where the vehicles are and of what they do.

    Args:
        notes: (capacity,) of `NOTE_DTYPE`, by slot; written.
        bank, objects: records of the mode bank and of the slots, after this scan's cycle.
        n: rows of the scan.  slot, status: (rows,) as for `imm.process_scan_`.
        age: (capacity,) scans in which the slot's object was seen.
        z, r, valid, angle: (rows, ...) the scan as it was measured.
    """
    for s in range(notes.shape[0]):
        notes[s].seen = False
        notes[s].new = age[s] <= 1
    for k in range(n):
        s = slot[k]
        if s < 0 or status[k] != 0 or not (valid[k, 0] and valid[k, 2]):
            continue
        note = notes[s]
        note.seen = True
        note.x, note.y, note.noise = position(z[k], r[k], angle[k])
        note.changing = 0.0
        note.off = 0.0
        for j in range(bank[0].n_modes):
            if bank[0].direction[j] != 0:
                note.changing += objects[s].mu[j]
            if bank[0].off_lane[j]:
                note.off += objects[s].mu[j]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def learn_(
    road: FloatArray,
    P: FloatArray,
    par: FloatArray,
    guide_slot: IntArray,
    guide_unseen: FloatArray,
    notes: Any,
    first: int,
    later: int,
    dt: float,
) -> None:  # pragma: no cover - compiled
    """Update the road by the vehicles of one scan, knowing what became of them; in place.

    Args:
        road, P, par: as for `road.predict_road_`, at the time of the scan.
        guide_slot: (24,) slot of each guide, `FREE` for none.
        guide_unseen: (24,) for how long it was not measured [s].
        notes: (E, capacity) of `NOTE_DTYPE`, a ring of scans.
        first: the scan.  later: so many scans after it are known.
        dt: since the scan before it [s].
    """
    h = np.zeros(N_ROAD + 1)
    wander = par[P_WANDER_STD] ** 2 * max(par[P_WANDER_TIME] / dt, 1.0)
    guide_of = np.full(notes.shape[1], FREE)
    for g in range(N_GUIDES):
        if guide_slot[g] == FREE:
            continue
        guide_unseen[g] += dt
        if guide_unseen[g] > 1.0:
            guide_slot[g] = FREE
            free_guide_(P, road, g)
        else:
            guide_of[guide_slot[g]] = g
    for s in range(notes.shape[1]):
        note = notes[first, s]
        g = guide_of[s]
        if note.new and g != FREE:
            guide_slot[g] = FREE
            free_guide_(P, road, g)
            g = FREE
        if not note.seen:
            continue
        x, y, noise = note.x, note.y, note.noise
        if note.off > 0.5 or not 0.0 < x < SEEN_TO:
            if g != FREE:
                guide_slot[g] = FREE
                free_guide_(P, road, g)
            continue
        lane_row_(h, road[WAY], x)
        if g == FREE:
            for other in range(N_GUIDES):
                if guide_slot[other] == FREE:
                    guide_slot[other] = s
                    guide_unseen[other] = 0.0
                    begin_guide_(road, P, h, other, y, noise)
                    break
            continue
        moving = note.changing
        for k in range(1, later + 1):
            after = notes[(first + k) % notes.shape[0], s]
            if after.new:
                break  # the slot has another object
            if after.seen:
                moving = max(moving, after.changing)
        guide_unseen[g] = 0.0
        a = N_ROAD + g
        free = par[P_FREEDOM] * (1.0 - moving) + par[P_FREEDOM_CHANGING] * moving
        P[a, a] += free * free * dt
        h[N_ROAD] = 1.0
        if not scalar_update_(road, P, h, g, y, noise, GATE):
            free_guide_(P, road, g)
            h[N_ROAD] = 0.0
            begin_guide_(road, P, h, g, y, noise)
            continue
        # In the long run vehicles drive where the lanes are; but not those between them.
        lane = math.floor(road[a] / road[WIDTH] + 0.5)
        between = 2.0 * (road[a] / road[WIDTH] - lane)
        known_lane = P[a, a] < (LANE_KNOWN * road[WIDTH]) ** 2
        if moving > 0.5 or abs(lane) > 6.0 or abs(between) > 0.8 or not known_lane:
            continue
        for i in range(N_ROAD):
            h[i] = 0.0
        h[WIDTH] = -lane
        doubt = 1.0 + 5.0 * (moving + between**4)
        scalar_update_(road, P, h, g, 0.0, doubt * wander, np.inf)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def change_lane_(
    road: FloatArray, P: FloatArray, guide_slot: IntArray, moved: int, width: float
) -> None:  # pragma: no cover - compiled
    """The ego's lane is another one now, ``moved`` lanes to the left; in place.

    Args:
        road, P: (N,), (N, N), or (N_ROAD,) without the guides.
        width: of the lanes [m].
    """
    shift = moved * width
    road[OFFSET] -= shift
    add_width_(P, OFFSET, -moved)
    if road.shape[0] > N_ROAD:
        for g in range(N_GUIDES):
            if guide_slot[g] != FREE:
                road[N_ROAD + g] -= shift
                add_width_(P, N_ROAD + g, -moved)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def shift_objects_(bank: Any, objects: Any, shift: float) -> None:  # pragma: no cover - compiled
    """Lateral positions of all objects ``shift`` less [m], in place."""
    for s in range(objects.shape[0]):
        objects[s].mean[2] -= shift
        for j in range(bank[0].n_modes):
            objects[s].x[j, 2] -= shift
