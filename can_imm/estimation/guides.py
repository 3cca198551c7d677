"""The vehicles of a scan, as `estimation.traffic` follows them."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.estimation.hypotheses import (
    APART,
    add_local_,
    begin_courses_,
    beyond,
    consider_,
    count_first,
    keeping,
    remove_guide_,
    split_,
)
from can_imm.estimation.road import (
    MOUNTING,
    N_ROAD,
    P_BESIDE_RATE,
    USUAL_SPEED,
    WAY,
    WIDTH,
    lane_row_,
    place_and_errors,
    slope_row_,
)
from can_imm.estimation.traffic import (
    BEARING,
    EGO,
    FREE,
    N_GUIDES,
    N_LOCAL,
    N_PARTIES,
    WITH_ERROR,
    best_global,
    first_state,
    lane_at,
    measure_,
    room,
    shares_,
)
from can_imm.estimation.wander import N_USUAL, NO_LANE, forget_wander_, learn_wander_
from can_imm.types import FloatArray, IntArray

SEEN_TO = 250.0
"""Vehicles further away [m] are not followed."""
SEEN_FROM = -50.0
"""Nor are those further behind [m]."""
WIDTH_SEEN_TO, WIDTH_SURE = 100.0, 0.6
"""Vehicles that are further away [m], or so far aside that the middle of their lane is not known
better than that [m], do not tell how wide lanes are: their lane is not sure enough.  That the width
may be wrong is an error of what they tell."""
UNSEEN_S = 1.0
"""A vehicle that was not seen for longer is forgotten [s]."""
OFF = 0.5
"""An object that is not in our direction with a higher probability changes no lanes."""
GATE = 25.0
"""Squared normalised error above which a vehicle is not where it was."""
MAX_OUTLIERS = 4
"""After so many in a row it is another one."""
FEW, MANY = 6, 18
"""Up to so many vehicles are followed as closely as can be.  With more of them the courses of each
begin more seldom, so that there are as many; with many, more seldom still: each costs more."""
ANEW = 2.0
"""After so many times as long as lasting errors last, a measurement has another one."""
CALM = 0.16
"""A vehicle that is less likely to change lanes shows how it wanders."""
MOST_LANES = 5
"""In so many lanes a vehicle may be that is first seen."""
TWIN_AHEAD, TWIN_BESIDE = 3.0, 1.0
"""A second track of a vehicle is no further from the first one along and across the road [m]."""
TWIN_LATER = 3
"""Of two tracks that began so many scans apart the later one is surely a second one."""
TWIN_CLOSE = 3.0
"""Of two that began together each may as well be a vehicle; to be one, they must be nearer by this
factor."""
TWIN_S = 1.0
"""What has been followed for longer [s] is a vehicle of its own."""

NOTE_DTYPE = np.dtype(
    [
        ("x", np.float64),
        ("y", np.float64),
        ("noise", np.float64),
        ("off", np.float64),
        ("age", np.int32),
        ("seen", np.bool_),
        ("new", np.bool_),
    ],
    align=True,
)
"""What a scan said of a slot's object: where it was measured in the vehicle's axes [m] and the
variance of y [m²], how probable it is that it is off the lanes, in how many scans it was until
then, whether it was in this one, and as a new one."""


@numba.njit(nogil=True, cache=True, error_model="numpy")
def straightened(
    along: float, across: float, r_along: float, r_across: float, angle: float
) -> tuple[float, float, float]:  # pragma: no cover - compiled
    """A vector from axes turned by an angle [rad] into the vehicle's: x, y, and the variance of y.

    Args:
        r_along, r_across: variances in the turned axes.
    """
    cos, sin = math.cos(angle), math.sin(angle)
    x = along * cos - across * sin
    y = along * sin + across * cos
    return x, y, r_across * cos * cos + r_along * sin * sin


@numba.njit(nogil=True, cache=True, error_model="numpy")
def position(
    z: FloatArray, r: FloatArray, angle: float
) -> tuple[float, float, float]:  # pragma: no cover - compiled
    """x and y in the vehicle's axes [m], and the variance of y, of a row (4,) of a scan."""
    return straightened(z[0], z[2], r[0], r[2], angle)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def velocity(
    z: FloatArray, r: FloatArray, angle: float
) -> tuple[float, float, float]:  # pragma: no cover - compiled
    """vx and vy in the vehicle's axes [m/s], and the variance of vy, of a row (4,) of a scan."""
    return straightened(z[1], z[3], r[1], r[3], angle)


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
    """Write down what a scan says of where the vehicles are.

    Args:
        notes: (capacity,) of `NOTE_DTYPE`, by slot; written.
        bank, objects: records of the mode bank and of the slots, after this scan's cycle.
        n: rows of the scan.  slot, status: (rows,) as for `imm.process_scan_`.
        age: (capacity,) scans in which the slot's object was seen.
        z, r, valid, angle: (rows, ...) the scan as it was measured.
    """
    for s in range(notes.shape[0]):
        notes[s].seen = notes[s].new = False
    for k in range(n):
        s = slot[k]
        if s < 0:
            continue
        note = notes[s]
        note.age, note.new = age[s], age[s] <= 1
        if status[k] != 0 or not (valid[k, 0] and valid[k, 2]):
            continue
        note.seen = True
        note.x, note.y, note.noise = position(z[k], r[k], angle[k])
        note.off = 0.0
        for j in range(bank[0].n_modes):
            if bank[0].off_lane[j]:
                note.off += objects[s].mu[j]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def leave_(T: Any, guide_of: IntArray, g: int) -> None:  # pragma: no cover - compiled
    """A vehicle is no longer followed, nor is its twin."""
    remove_guide_(T, g)
    for s in range(guide_of.shape[0]):
        if guide_of[s] == g:
            guide_of[s] = FREE


@numba.njit(nogil=True, cache=True, error_model="numpy")
def later(one: Any, other: Any) -> bool:  # pragma: no cover - compiled
    """Whether the track of a note began when there was the other's already."""
    return bool(one.age + TWIN_LATER <= other.age)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def together(one: Any, other: Any, nearer: float) -> bool:  # pragma: no cover - compiled
    """Whether two notes are of places as near as those of one vehicle, or nearer by a factor."""
    return bool(
        abs(one.x - other.x) < TWIN_AHEAD / nearer and abs(one.y - other.y) < TWIN_BESIDE / nearer
    )


@numba.njit(nogil=True, cache=True, error_model="numpy")
def twin_of(T: Any, notes: Any, s: int) -> int:  # pragma: no cover - compiled
    """The party that slot s is a second track of, `FREE` for none.

    It may have begun together with one only in its own first scan.
    """
    for g in range(N_GUIDES):
        other = T.party[g].slot
        if other == s or other == FREE or not notes[other].seen:  # noqa: SIM109 - unknown to numba
            continue
        follows = later(notes[s], notes[other])
        if not (follows or notes[s].new):
            continue
        if together(notes[s], notes[other], 1.0 if follows else TWIN_CLOSE):
            return g
    return FREE


@numba.njit(nogil=True, cache=True, error_model="numpy")
def still_twin(T: Any, notes: Any, s: int, g: int) -> bool:  # pragma: no cover - compiled
    """Whether slot s may still be a second track of party g."""
    other = T.party[g].slot
    if not notes[other].seen:
        return later(notes[s], notes[other])
    return together(notes[s], notes[other], 1.0)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def listen_(T: Any, usual: FloatArray) -> None:  # pragma: no cover - compiled
    """Log evidence (N_USUAL,) of all vehicles for how much is usual to wander, written."""
    for k in range(N_USUAL):
        usual[k] = T.gone[k]
        for g in range(N_GUIDES):
            usual[k] += T.party[g].told[k]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def meet_(
    T: Any, par: FloatArray, guide_of: IntArray, notes: Any, s: int, t: float
) -> int:  # pragma: no cover - compiled
    """Follow the vehicle in slot s from now on; its party, `FREE` if there is no room.

    It is in the lane that is nearest, in the next one, or between two.  Of a crowd some are only
    met in the next scans, when most of the others' courses are given up.
    """
    g, end = 0, room(T)
    while g < end and T.party[g].slot != FREE:
        g += 1
    if g == end:
        return FREE
    # where the road leads, and so in which lane it is, each global hypothesis says for itself
    lane_row_(T.h, T.x[WAY], notes[s].x)
    places = np.empty(T.n_global)
    for k in range(T.n_global):
        y = notes[s].y
        for i in range(N_ROAD):
            y -= T.h[i] * (T.x[i] + beyond(T, k, i))
        places[k] = y / (T.x[WIDTH] + beyond(T, k, WIDTH))
    middle = math.floor(places[best_global(T)] + 0.5)
    lanes, n_lanes, courses = np.empty(MOST_LANES, np.int64), 0, 0
    for aside in range(MOST_LANES):
        lane = middle + aside - MOST_LANES // 2
        if np.abs(places - lane).min() <= 1.5:
            lanes[n_lanes] = lane
            n_lanes += 1
            courses += 1 + count_first(places, lane)
    if T.n + courses > N_LOCAL:
        return FREE
    party = T.party[g]
    party.slot, party.unseen, party.outliers, party.since = s, 0.0, 0, t
    guide_of[s] = g
    a = first_state(T, g)
    T.top = max(T.top, a + T.stride)
    usual = np.empty(N_USUAL)
    listen_(T, usual)
    forget_wander_(party, usual, par)
    T.P[a, a] = party.beside**2
    T.P[a + 1, a + 1] = (par[P_BESIDE_RATE] * party.beside) ** 2
    if T.stride == WITH_ERROR:
        T.P[a + 2, a + 2] = T.lasting_std**2 + (T.new_std * notes[s].x) ** 2
    for lane in lanes[:n_lanes]:
        q = add_local_(T, g, lane, 0, False, 0.0, 0.0, -1)
        for k in range(T.n_global):
            T.odds[k, q] = 0.0
            if lane == lanes[0] or (
                abs(places[k] - lane) < abs(places[k] - T.local[T.choice[k, g]].lane)
            ):
                T.choice[k, g] = q
    begin_courses_(T, g, t, par, places)
    return g


@numba.njit(nogil=True, cache=True, error_model="numpy")
def see_place_(
    T: Any, g: int, x: float, y: float, noise: float, t: float
) -> bool:  # pragma: no cover - compiled
    """Take in where vehicle g is: at x, y [m] in the ego's axes, y with a variance; in place.

    Returns:
        False, and nothing changed, if it can't be there.
    """
    h, at = T.h, T.at
    lane_row_(h, T.x[WAY], x)
    width = T.x[WIDTH]
    ours = T.choice[best_global(T), g]
    lane, _, _ = lane_at(T.local[ours], t)
    off = lane**2 * T.P[WIDTH, WIDTH]
    if x < WIDTH_SEEN_TO and off < WIDTH_SURE**2:
        h[WIDTH] = lane
    else:
        h[WIDTH] = 0.0
        y -= lane * width
        noise += off
    m = 0
    for i in range(N_ROAD):
        if h[i] != 0.0:
            h[m], at[m] = h[i], i
            m += 1
    a = first_state(T, g)
    h[m], at[m] = 1.0, a
    m += 1
    if T.stride == WITH_ERROR:
        h[m], at[m] = x, BEARING
        h[m + 1], at[m + 1] = 1.0, a + 2
        m += 2
    for q in range(T.n):
        if T.local[q].who == g:
            other, _, _ = lane_at(T.local[q], t)
            T.shift[q] = (other - lane) * width
    return measure_(T, m, y, noise, g, GATE)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def see_speed_(
    T: Any, g: int, x: float, vx: float, vy: float, noise: float, speed: float, t: float
) -> None:  # pragma: no cover - compiled
    """Take in how fast vehicle g moves across; in place.

    Args:
        x: where it is ahead [m].  vx, vy: its velocity against the ego's, in the ego's axes
            [m/s].  noise: variance of vy.  speed: of the ego [m/s].
    """
    h, at = T.h, T.at
    slope_row_(h, T.x[WAY], x)
    width = T.x[WIDTH]
    ours = T.choice[best_global(T), g]
    _, rate, _ = lane_at(T.local[ours], t)
    m = 0
    for i in range(N_ROAD):
        v = h[i] * (speed + vx)
        if i == MOUNTING:
            v += speed
        if v != 0.0:
            h[m], at[m] = v, i
            m += 1
    h[m], at[m] = 1.0, first_state(T, g) + 1
    for q in range(T.n):
        if T.local[q].who == g:
            _, other, _ = lane_at(T.local[q], t)
            T.shift[q] = (other - rate) * width
    measure_(T, m + 1, vy - rate * width, noise, g, GATE)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def see_(
    T: Any, guide_of: IntArray, note: Any, g: int, speed: float, t: float,
    z: FloatArray, r: FloatArray, valid: Any, angle: float,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Take in what a scan says of vehicle g; one that can't be it too often is followed no longer;
    in place.

    Args:
        note: of `NOTE_DTYPE`.  speed: of the ego [m/s].
        z, r, valid: (4,) and angle, the row as it was measured.
    """
    party = T.party[g]
    party.unseen = 0.0
    if not see_place_(T, g, note.x, note.y, note.noise, t):
        party.outliers += 1
        if party.outliers == MAX_OUTLIERS:
            leave_(T, guide_of, g)
        return
    party.outliers = 0
    if valid[1] and valid[3]:
        vx, vy, noise = velocity(z, r, angle)
        see_speed_(T, g, note.x, vx, vy, noise, speed, t)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def watch_(
    T: Any,
    par: FloatArray,
    guide_of: IntArray,
    notes: Any,
    t: float,
    dt: float,
    speed: float,
    n: int,
    slot: Any,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    angle: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Take in the vehicles of a scan; in place.

    Args:
        T: record of `traffic.TRAFFIC_DTYPE`, at the scan's time.  par: `road.PARAMETERS`.
        guide_of: (capacity,) party of each slot, `FREE` for none.
        notes: (capacity,) of `NOTE_DTYPE`, of this scan.
        t: time of the scan, dt: since the one before it [s].
        speed: of the ego [m/s], NaN where unknown.
        n: rows of the scan.  slot, z, r, valid, angle: (rows, ...) as it was measured.
    """
    v = speed if speed == speed else USUAL_SPEED
    for g in range(N_GUIDES):
        s = T.party[g].slot
        if s == FREE:
            continue
        T.party[g].unseen += dt
        gone = notes[s].seen and (notes[s].off > OFF or not SEEN_FROM < notes[s].x < SEEN_TO)
        if gone or notes[s].new or T.party[g].unseen > UNSEEN_S:
            leave_(T, guide_of, g)
        elif notes[s].seen and t - T.party[g].since <= TWIN_S:
            twin = twin_of(T, notes, s)
            if twin != FREE:
                leave_(T, guide_of, g)
                guide_of[s] = twin
    crowd = (T.top - T.first) / float(T.stride * FEW)
    apart = APART * max(1.0, crowd, crowd * (crowd * FEW / MANY) ** 2)
    nowhere = np.empty(0)
    new, n_new = np.empty(n, np.int64), 0
    for k in range(n):
        s = slot[k]
        if s < 0 or not notes[s].seen or notes[s].off > OFF:
            continue
        if not SEEN_FROM < notes[s].x < SEEN_TO:
            continue
        g = guide_of[s]
        if g != FREE and T.party[g].slot != s:
            if not notes[s].new and still_twin(T, notes, s, g):
                continue
            g = guide_of[s] = FREE
        if g == FREE:
            new[n_new] = k
            n_new += 1
            continue
        if t - T.party[g].begun >= apart:
            begin_courses_(T, g, t, par, nowhere)
        see_(T, guide_of, notes[s], g, v, t, z[k], r[k], valid[k], angle[k])
    # the nearest first: they show where the others' lanes are
    for k in new[np.argsort(np.array([abs(notes[slot[k]].x) for k in new[:n_new]]))]:
        s = slot[k]
        guide_of[s] = g = twin_of(T, notes, s)
        if g != FREE:
            continue
        g = meet_(T, par, guide_of, notes, s, t)
        if g != FREE:
            see_(T, guide_of, notes[s], g, v, t, z[k], r[k], valid[k], angle[k])
            split_(T)
    if t - T.party[EGO].begun >= apart:
        begin_courses_(T, EGO, t, par, nowhere)
    consider_(T, t, par)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def learn_habits_(
    T: Any,
    par: FloatArray,
    guide_of: IntArray,
    notes: Any,
    road: FloatArray,
    P: FloatArray,
    t: float,
    speed: float,
    n: int,
    slot: Any,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    angle: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Learn from a scan how the vehicles that keep their lanes wander there; in place.

    Args:
        road, P: (N_ROAD,), (N_ROAD, N_ROAD) state of the road and its covariance, by this scan.
        The others as for `watch_`.
    """
    share, changing = T.error, np.zeros(N_PARTIES)
    h = np.zeros(N_ROAD + 1)
    v = speed if speed == speed else USUAL_SPEED
    best = best_global(T)
    shares_(T, best, share, np.empty((N_PARTIES, 2)))
    usual, others = np.empty(N_USUAL), np.empty(N_USUAL)
    listen_(T, usual)
    for q in range(T.n):
        if not keeping(T.local[q], t):
            changing[T.local[q].who] += share[q]
    for k in range(n):
        s = slot[k]
        if s < 0 or not notes[s].seen or guide_of[s] == FREE:
            continue
        party = T.party[guide_of[s]]
        if party.slot != s or party.unseen > 0.0 or party.outliers > 0:
            continue
        ours = T.local[T.choice[best, guide_of[s]]]
        if changing[guide_of[s]] > CALM or not keeping(ours, t):
            party.kept = NO_LANE
            continue
        lane = ours.lane + (ours.turn if t >= ours.start else 0)
        if lane == party.kept and t - party.learnt < ANEW * T.lasting_s:
            continue
        note = notes[s]
        vx, vy, rv = 0.0, 0.0, np.inf
        if valid[k, 1]:
            vx = z[k, 1] * math.cos(angle[k])
        if valid[k, 1] and valid[k, 3]:
            vx, vy, rv = velocity(z[k], r[k], angle[k])
        y, its_vy, of_place, of_direction = place_and_errors(road, P, h, note.x, vx, v)
        if rv < np.inf:
            rv += of_direction * (v + vx) ** 2
        for i in range(N_USUAL):
            others[i] = usual[i] - party.told[i]
        noise = note.noise
        if T.stride == WITH_ERROR:
            y += T.x[BEARING] * note.x
            noise += T.lasting_std**2 + T.P[BEARING, BEARING] * note.x**2
        learn_wander_(
            party, lane, t, note.y - y - lane * road[WIDTH], noise, vy - its_vy, rv,
            of_place, par[P_BESIDE_RATE], others, par,
        )  # fmt: skip


@numba.njit(nogil=True, cache=True, error_model="numpy")
def shift_objects_(bank: Any, objects: Any, shift: float) -> None:  # pragma: no cover - compiled
    """Lateral positions of all objects ``shift`` less [m], in place."""
    for s in range(objects.shape[0]):
        objects[s].mean[2] -= shift
        for j in range(bank[0].n_modes):
            objects[s].x[j, 2] -= shift
