"""The vehicles that show where the road is: what all of them do at once, it has done or the ego."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.estimation.road import (
    CHANGE,
    CURVATURE,
    FREE,
    N_GUIDES,
    N_ROAD,
    OFFSET,
    P_FREEDOM,
    P_FREEDOM_CHANGING,
    P_UNREST_CHANGE,
    P_UNREST_CURVATURE,
    P_WANDER_STD,
    P_WANDER_TIME,
    WIDTH,
    N,
    lane_row_,
    scalar_update_,
    value,
    variance,
)
from can_imm.types import FloatArray, IntArray

SEEN_TO = 150.0
"""Vehicles further away [m] do not guide."""

LANE_KNOWN = 0.2
"""Share of the lane's width: a guide whose place is less sure does not tell where the lanes are."""

UNREST_TIME = 1.0
"""[s], see `follow_bend_`."""

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
    for i in range(N):
        P[a, i] += times * P[WIDTH, i]
    for i in range(N):
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
def follow_bend_(
    road: FloatArray,
    P: FloatArray,
    par: FloatArray,
    guide_of: Any,
    unrest: FloatArray,
    n: int,
    slot: Any,
    status: Any,
    age: Any,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    angle: FloatArray,
    dt: float,
) -> None:  # pragma: no cover - compiled
    """Let the road bend faster while the guides are off to the same side, in place.

    A road bends rarely, and then more than a stiff filter expects.  ``unrest`` (1,) is the squared
    sum of the guides' normalised innovations over their number, a mean over `UNREST_TIME`; it is
    about 1 while the road is known.  Other arguments as for `watch_traffic_`.
    """
    h = np.zeros(N_ROAD + 1)
    total = 0.0
    count = 0
    for k in range(n):
        s = slot[k]
        if s < 0 or status[k] != 0 or age[s] <= 3 or not (valid[k, 0] and valid[k, 2]):
            continue
        g = guide_of[s]
        if g == FREE:
            continue
        x, y, noise = position(z[k], r[k], angle[k])
        a = N_ROAD + g
        lane_row_(h, x)
        v = variance(P, h) + P[a, a] + noise
        for i in range(N_ROAD):
            v += 2.0 * h[i] * P[i, a]
        if v > 0.0:
            total += min(max((y - value(road, h) - road[a]) / math.sqrt(v), -3.0), 3.0)
            count += 1
    if count < 2:
        return
    gain = min(dt / UNREST_TIME, 1.0)
    unrest[0] += gain * (total * total / count - unrest[0])
    extra = min(max(unrest[0] - 1.5, 0.0), 10.0) * dt
    P[CHANGE, CHANGE] += extra * par[P_UNREST_CHANGE] ** 2
    P[CURVATURE, CURVATURE] += extra * par[P_UNREST_CURVATURE] ** 2


@numba.njit(nogil=True, cache=True, error_model="numpy")
def watch_traffic_(
    road: FloatArray,
    P: FloatArray,
    par: FloatArray,
    guide_slot: IntArray,
    guide_unseen: FloatArray,
    unrest: FloatArray,
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
    dt: float,
) -> int:  # pragma: no cover - compiled
    """Update the road by the vehicles on it, in place.

    Args:
        road, P, par: as for `localise_`.
        guide_slot: (24,) slot of each guide, `FREE` for none.
        guide_unseen: (24,) for how long it was not measured [s].
        unrest: (1,) see `follow_bend_`; written.
        bank, objects: records of the mode bank and of the slots, after this scan's cycle.
        n: rows of the scan.  slot, status: (N,) as for `imm.process_scan_`.
        age: (capacity,) scans in which the slot's object was seen.
        z, r, valid, angle: (N, ...) the scan as it was measured.
        dt: since the scan before [s].

    Returns:
        By how many lanes the ego has moved to the left (+1, -1 or 0).  The road's offset and the
        objects' lateral positions have been changed accordingly.
    """
    h = np.zeros(N_ROAD + 1)
    wander = par[P_WANDER_STD] ** 2 * max(par[P_WANDER_TIME] / dt, 1.0)
    guide_of = np.full(objects.shape[0], FREE)
    for g in range(N_GUIDES):
        if guide_slot[g] == FREE:
            continue
        guide_unseen[g] += dt
        if guide_unseen[g] > 1.0:
            guide_slot[g] = FREE
            free_guide_(P, road, g)
        else:
            guide_of[guide_slot[g]] = g
    follow_bend_(road, P, par, guide_of, unrest, n, slot, status, age, z, r, valid, angle, dt)
    for k in range(n):
        s = slot[k]
        if s < 0 or status[k] != 0 or not (valid[k, 0] and valid[k, 2]):
            continue
        x, y, noise = position(z[k], r[k], angle[k])
        moving = 0.0
        off = 0.0
        for j in range(bank[0].n_modes):
            if bank[0].direction[j] != 0:
                moving += objects[s].mu[j]
            if bank[0].off_lane[j]:
                off += objects[s].mu[j]
        g = guide_of[s]
        lane_row_(h, x)
        if g == FREE or age[s] <= 1 or off > 0.5 or not 0.0 < x < SEEN_TO:
            if g != FREE:
                guide_slot[g] = FREE
                free_guide_(P, road, g)
            if off > 0.5 or not 0.0 < x < SEEN_TO:
                continue
            if g == FREE:
                for other in range(N_GUIDES):
                    if guide_slot[other] == FREE:
                        g = other
                        break
            if g != FREE:
                guide_slot[g] = s
                guide_unseen[g] = 0.0
                begin_guide_(road, P, h, g, y, noise)
            continue
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
    moved = 0
    if road[OFFSET] > 0.5 * road[WIDTH]:
        moved = 1
    elif road[OFFSET] < -0.5 * road[WIDTH]:
        moved = -1
    if moved != 0:
        shift = moved * road[WIDTH]
        road[OFFSET] -= shift
        add_width_(P, OFFSET, -moved)
        for g in range(N_GUIDES):
            if guide_slot[g] != FREE:
                road[N_ROAD + g] -= shift
                add_width_(P, N_ROAD + g, -moved)
        for s in range(objects.shape[0]):
            objects[s].mean[2] -= shift
            for j in range(bank[0].n_modes):
                objects[s].x[j, 2] -= shift
    return moved
