"""Whether a vehicle is changing lanes, scan by scan.

The causal half of `lane_changes`, whose model this is: a vehicle keeps to the middle of a lane, and
now and then follows a smooth course to the middle of the next one; beside all that it wanders, and
the road is not quite where it is thought to be.  All courses that may be under way are followed at
once.  They differ in their means only, so that a course costs no more than a few products.

How much a vehicle wanders is learnt while it keeps its lane: `LEVELS` of it are weighed by how well
each foretells where the vehicle is.  Who drives calmly is sooner seen to leave.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.estimation.lane_changes import (
    EDGE,
    LASTS,
    LOG_P,
    N_BEGUN,
    N_DURATIONS,
    N_LANES,
    UNKNOWN,
    add_logs,
    carried,
    correct,
    course,
    fading,
    gains,
    spread,
)
from can_imm.estimation.road import (
    P_BESIDE_ERROR,
    P_BESIDE_RATE,
    P_BESIDE_SPEED_ERROR,
    P_BESIDE_SPREAD,
    P_BESIDE_STD,
    P_CHANGE_RATE,
    P_CHANGE_STEADY,
    P_SETTLE,
    WIDTH,
    place_and_errors,
)
from can_imm.types import FloatArray

N_COURSES = 1024
"""Most courses that are followed of one vehicle."""
APART = 0.06
"""Courses begin so long one after the other [s]."""
IMPOSSIBLE = 14.0
"""A course whose log weight is so much lower than that of the best one is given up."""
OUTLIER = 39.0
"""Squared normalised error of a measurement counts as this at most."""
LEVELS = np.array([0.1, 0.16, 0.25, 0.4, 0.6])
"""Standard deviations of places beside the middle of a lane that are told apart [m]."""
N_LEVELS = len(LEVELS)
MEMORY_S = 35.0
"""So long it counts how a vehicle has wandered [s]."""
CALM = 0.16
"""A vehicle that is less likely to change lanes shows how it wanders."""
SURPRISE = 9.0
"""Squared normalised error of a measurement counts as this at most for how a vehicle wanders."""
ROAD_ERROR = 1.0
"""Variance that counts at most of where the road is thought to be [m²]: however little is known of
the lanes far ahead, a vehicle that does not move across them does not change them."""
OFF = 0.99
"""An object that is not in our direction with a higher probability changes no lanes."""
LONGEST_S = 1.0
"""What was thought of a vehicle that was not seen for longer is of no use any more."""

CHANGES_DTYPE = np.dtype(
    [
        ("since", np.float64),
        ("t", np.float64),
        ("begun", np.float64),
        ("cov", np.float64, (3,)),
        ("log_w", np.float64, (N_LANES,)),
        ("place", np.float64, (N_LANES,)),
        ("rate", np.float64, (N_LANES,)),
        ("kept", np.int64),
        ("evidence", np.float64, (N_LEVELS,)),
        ("level_cov", np.float64, (N_LEVELS, 3)),
        ("level_place", np.float64, (N_LEVELS,)),
        ("level_rate", np.float64, (N_LEVELS,)),
        ("n", np.int64),
        (
            "course",
            [
                ("start", np.float64),
                ("duration", np.float64),
                ("log_w", np.float64),
                ("place", np.float64),
                ("rate", np.float64),
                ("lane", np.int8),
                ("turn", np.int8),
                ("steady", np.bool_),
            ],
            (N_COURSES,),
        ),
    ],
    align=True,
)
"""What is thought of one vehicle: ``since`` and ``t``, times of its first and its last measurement
[s], NaN before; ``begun`` when courses began last; ``cov`` covariance of place and rate beside the
course (P00, P01, P11).  By lane (0 to `N_LANES` - 1, `EDGE` the ego's): log weight of keeping it,
place and rate [m, m/s].  ``kept``: the lane that it keeps, -1 while that is not sure; by level of
wander: log ``evidence`` for it, and covariance, place and rate if it were the true one.  The first
``n`` courses that may be under way: see `lane_changes.COURSE_DTYPE`."""


@numba.njit(nogil=True, cache=True, error_model="numpy")
def forget_changes_(one: Any) -> None:  # pragma: no cover - compiled
    """Nothing is known of the vehicle."""
    one.since = one.t = np.nan
    one.n = 0
    one.kept = -1
    one.evidence[:] = 0.0


@numba.njit(nogil=True, cache=True, error_model="numpy")
def begin_courses_(
    one: Any, t: float, y: float, width: float, par: FloatArray
) -> None:  # pragma: no cover - compiled
    """Add the courses that may begin now, or with the first measurement those under way."""
    first = one.n == 0 and one.t != one.t
    for lane in range(1, N_LANES - 1):
        if not first and one.log_w[lane] < -IMPOSSIBLE:
            continue
        for turn in (-1, 1):
            if first and abs(y / width - (lane - EDGE + 0.5 * turn)) > 1.0:
                continue
            for i in range(2 * N_DURATIONS):
                steady = i >= N_DURATIONS
                share = par[P_CHANGE_STEADY] if steady else 1.0 - par[P_CHANGE_STEADY]
                lasts = LASTS[i]
                for b in range(N_BEGUN if first else 1):
                    span = lasts / N_BEGUN if first else t - one.begun
                    log_w = math.log(0.5 * par[P_CHANGE_RATE] * span * share)
                    log_w += LOG_P[i] + (0.0 if first else one.log_w[lane])
                    if one.n == N_COURSES or log_w < -IMPOSSIBLE:
                        continue
                    c = one.course[one.n]
                    one.n += 1
                    c.start = t - (b + 0.5) * span
                    c.duration = lasts
                    c.lane, c.turn, c.steady = lane, turn, steady
                    c.log_w = log_w
                    c.place = 0.0 if first else one.place[lane]
                    c.rate = 0.0 if first else one.rate[lane]
    one.begun = t


@numba.njit(nogil=True, cache=True, error_model="numpy")
def follow_(
    one: Any,
    t: float,
    y: float,
    r: float,
    vy: float,
    rv: float,
    road_error: float,
    width: float,
    par: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Take in a measurement of one vehicle.

    Args:
        one: record of `CHANGES_DTYPE`.
        t: [s].
        y, vy: place and speed across the road [m, m/s], 0 in the middle of the ego's lane.
        r, rv: their variances, infinite where not measured.
        road_error: variance of where the road is thought to be [m²].
        width: of the lanes [m].
        par: `road.PARAMETERS`.
    """
    hurry, settle = par[P_BESIDE_RATE], par[P_SETTLE]
    dt = t - one.t
    if not dt <= LONGEST_S:
        forget_changes_(one)
        begin_courses_(one, t, y, width, par)
        one.since = t
        one.log_w[:] = 0.0
        one.place[:] = 0.0
        one.rate[:] = 0.0
        beside = math.sqrt(wander_variance(one, par) + road_error)
        P = beside**2, 0.0, (hurry * beside) ** 2
    else:
        if t - one.begun >= APART:
            begin_courses_(one, t, y, width, par)
        f = fading(hurry, dt)
        beside = math.sqrt(wander_variance(one, par) + road_error)
        P = spread((one.cov[0], one.cov[1], one.cov[2]), f, hurry, beside)
        stay = math.log1p(-min(par[P_CHANGE_RATE] * dt, 0.5))
        for lane in range(N_LANES):
            one.log_w[lane] += stay
            one.place[lane], one.rate[lane] = carried(one.place[lane], one.rate[lane], f)
        for q in range(one.n):
            c = one.course[q]
            c.place, c.rate = carried(c.place, c.rate, f)
    one.t = t
    P, of_place, of_speed = gains(P, r, rv)
    one.cov[0], one.cov[1], one.cov[2] = P
    best = -np.inf
    kept = 0
    for q in range(one.n):
        c = one.course[q]
        if t - c.start >= c.duration + settle:
            # it is one with its new lane
            to = c.lane + c.turn
            total = add_logs(one.log_w[to], c.log_w)
            w = math.exp(c.log_w - total)
            one.place[to] += w * (c.place - one.place[to])
            one.rate[to] += w * (c.rate - one.rate[to])
            one.log_w[to] = total
            continue
        done, slope = course((t - c.start) / c.duration, c.steady)
        off = y - (c.lane - EDGE + c.turn * done) * width
        speed = vy - c.turn * slope * width / c.duration
        c.place, c.rate, lost = correct(c.place, c.rate, off, speed, of_place, of_speed, OUTLIER)
        c.log_w -= 0.5 * lost
        best = max(best, c.log_w)
        if kept < q:
            one.course[kept] = c
        kept += 1
    one.n = kept
    for lane in range(N_LANES):
        if one.log_w[lane] > -np.inf:
            off = y - (lane - EDGE) * width
            one.place[lane], one.rate[lane], lost = correct(
                one.place[lane], one.rate[lane], off, vy, of_place, of_speed, OUTLIER
            )
            one.log_w[lane] -= 0.5 * lost
            best = max(best, one.log_w[lane])
    give_up_(one, best)
    left, right = probabilities(one, t)
    if left + right > CALM or not r < UNKNOWN:
        one.kept = -1
    else:
        learn_wander_(one, dt, y, r, vy, rv, road_error, width, hurry)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def wander_variance(one: Any, par: FloatArray) -> float:  # pragma: no cover - compiled
    """Mean square of the vehicle's place beside the middle of its lane [m²], by what it showed."""
    most = -np.inf
    log_w = np.empty(N_LEVELS)
    for i in range(N_LEVELS):
        apart = math.log(LEVELS[i] / par[P_BESIDE_STD]) / par[P_BESIDE_SPREAD]
        log_w[i] = one.evidence[i] - 0.5 * apart**2
        most = max(most, log_w[i])
    mean = total = 0.0
    for i in range(N_LEVELS):
        w = math.exp(log_w[i] - most)
        total += w
        mean += w * LEVELS[i] ** 2
    return mean / total


@numba.njit(nogil=True, cache=True, error_model="numpy")
def learn_wander_(
    one: Any,
    dt: float,
    y: float,
    r: float,
    vy: float,
    rv: float,
    road_error: float,
    width: float,
    hurry: float,
) -> None:  # pragma: no cover - compiled
    """Weigh the levels of wander by a measurement of a vehicle that keeps its lane; see `follow_`.

    Args:
        dt: since the measurement before it [s].
    """
    # a course that has come to its end is a lane that is kept, too
    w = np.zeros(N_LANES)
    for other in range(N_LANES):
        w[other] = math.exp(one.log_w[other])
    for q in range(one.n):
        c = one.course[q]
        if one.t - c.start >= c.duration:
            w[c.lane + c.turn] += math.exp(c.log_w)
    lane = np.argmax(w)
    begins = lane != one.kept
    one.kept = lane
    off = y - (lane - EDGE) * width
    memory = math.exp(-dt / MEMORY_S) if dt <= LONGEST_S else 0.0
    most = -np.inf
    for i in range(N_LEVELS):
        beside = math.sqrt(LEVELS[i] ** 2 + road_error)
        if begins:
            P = beside**2, 0.0, (hurry * beside) ** 2
            place = rate = 0.0
        else:
            f = fading(hurry, dt)
            cov = one.level_cov[i]
            P = spread((cov[0], cov[1], cov[2]), f, hurry, beside)
            place, rate = carried(one.level_place[i], one.level_rate[i], f)
        P, of_place, of_speed = gains(P, r, rv)
        one.level_cov[i, 0], one.level_cov[i, 1], one.level_cov[i, 2] = P
        one.level_place[i], one.level_rate[i], lost = correct(
            place, rate, off, vy, of_place, of_speed, SURPRISE
        )
        lost += math.log(of_place[0]) + math.log(of_speed[0])
        one.evidence[i] = memory * one.evidence[i] - 0.5 * lost
        most = max(most, one.evidence[i])
    for i in range(N_LEVELS):
        one.evidence[i] -= most


@numba.njit(nogil=True, cache=True, error_model="numpy")
def give_up_(one: Any, best: float) -> None:  # pragma: no cover - compiled
    """Give up what has become impossible; the log weights count from the best one."""
    for lane in range(N_LANES):
        one.log_w[lane] -= best
        if one.log_w[lane] < -IMPOSSIBLE:
            one.log_w[lane] = -np.inf
    kept = 0
    for q in range(one.n):
        c = one.course[q]
        c.log_w -= best
        if c.log_w >= -IMPOSSIBLE:
            if kept < q:
                one.course[kept] = c
            kept += 1
    one.n = kept


@numba.njit(nogil=True, cache=True, error_model="numpy")
def tell_changes_(
    changes: Any, ids: Any, t: float, p: FloatArray
) -> None:  # pragma: no cover - compiled
    """How probable it is by what was measured until now that vehicles were changing lanes at t.

    Args:
        changes: (capacity,) of `CHANGES_DTYPE`, by slot.
        ids: (capacity,) object id of each slot, -1 for a free one.
        t: [s], not longer ago than the time to settle.
        p: (N, 2) written for each slot in use, in their order: changing to the left, to the right;
            NaN where nothing was known then.
    """
    row = 0
    for s in range(ids.shape[0]):
        if ids[s] < 0:
            continue
        p[row, 0], p[row, 1] = probabilities(changes[s], t)
        row += 1


@numba.njit(nogil=True, cache=True, error_model="numpy")
def probabilities(one: Any, t: float) -> tuple[float, float]:  # pragma: no cover - compiled
    """Of a change to the left and to the right at time t [s]; NaN if nothing was known then."""
    if not t >= one.since:
        return np.nan, np.nan
    left = right = keep = 0.0
    for lane in range(N_LANES):
        keep += math.exp(one.log_w[lane])
    for q in range(one.n):
        c = one.course[q]
        w = math.exp(c.log_w)
        if not 0.0 <= t - c.start < c.duration:
            keep += w
        elif c.turn > 0:
            left += w
        else:
            right += w
    total = left + right + keep
    return left / total, right / total


@numba.njit(nogil=True, cache=True, error_model="numpy")
def tell_times_(changes: Any, ids: Any, reports: Any) -> None:  # pragma: no cover - compiled
    """When the lane changes that are under way or have just ended began and end: ``change`` of the
    reports of all slots in use, in their order; NaN where there is probably none.

    Args:
        changes: (capacity,) of `CHANGES_DTYPE`, by slot.
        ids: (capacity,) object id of each slot, -1 for a free one.
        reports: (N,) of `REPORT_DTYPE`.
    """
    row = 0
    weight, begin, end = np.zeros(2), np.zeros(2), np.zeros(2)
    for s in range(ids.shape[0]):
        if ids[s] < 0:
            continue
        report, one = reports[row], changes[s]
        row += 1
        report.change[0] = report.change[1] = np.nan
        if one.t != one.t:
            continue
        weight[:] = 0.0
        begin[:] = 0.0
        end[:] = 0.0
        total = 0.0
        for lane in range(N_LANES):
            total += math.exp(one.log_w[lane])
        for q in range(one.n):
            c = one.course[q]
            w = math.exp(c.log_w)
            side = 0 if c.turn > 0 else 1
            weight[side] += w
            begin[side] += w * (c.start - one.t)
            end[side] += w * (c.start - one.t + c.duration)
            total += w
        side = 0 if weight[0] > weight[1] else 1
        if weight[side] > 0.5 * total:
            report.change[0] = one.t + begin[side] / weight[side]
            report.change[1] = one.t + end[side] / weight[side]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def follow_all_(
    changes: Any,
    road: FloatArray,
    P: FloatArray,
    par: FloatArray,
    t: float,
    speed: float,
    notes: Any,
    n: int,
    slot: Any,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    angle: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Take in the vehicles of a scan.

    Args:
        changes: (capacity,) of `CHANGES_DTYPE`, by slot.
        road, P, par: state, covariance and parameters of `estimation.road`.
        t: time of the scan [s].  speed: of the ego [m/s], NaN where unknown.
        notes: (capacity,) of `guides.NOTE_DTYPE`: what this scan said of the slots.
        n: rows of the scan.  slot: (rows,) slot of each row, -1 for none.
        z, r, valid, angle: (rows, ...) the scan as it was measured.
    """
    h = np.zeros(road.shape[0] + 1)
    for s in range(changes.shape[0]):
        # what was noted of one that was not seen is old
        if notes[s].new or (notes[s].seen and notes[s].off > OFF):
            forget_changes_(changes[s])
    for k in range(n):
        s = slot[k]
        if s < 0 or not notes[s].seen or notes[s].off > OFF:
            continue
        note = notes[s]
        cos, sin = math.cos(angle[k]), math.sin(angle[k])
        vx = z[k, 1] / cos if valid[k, 1] else 0.0
        vy, rv = 0.0, np.inf
        if valid[k, 1] and valid[k, 3]:
            vx = z[k, 1] * cos - z[k, 3] * sin
            vy = z[k, 1] * sin + z[k, 3] * cos
            rv = r[k, 3] * cos * cos + r[k, 1] * sin * sin
        to_lane, to_speed, of_place, of_direction = place_and_errors(
            road, P, h, note.x, vx, speed
        )  # fmt: skip
        if speed == speed:
            rv += par[P_BESIDE_SPEED_ERROR] * of_direction * (speed + vx) ** 2
        road_error = min(par[P_BESIDE_ERROR] * of_place, ROAD_ERROR)
        follow_(
            changes[s], t, note.y - to_lane, note.noise, vy - to_speed, rv, road_error,
            road[WIDTH], par,
        )  # fmt: skip


@numba.njit(nogil=True, cache=True, error_model="numpy")
def shift_changes_(changes: Any, moved: int) -> None:  # pragma: no cover - compiled
    """The ego has moved ``moved`` lanes to the left (+1, -1): every lane has another number."""
    for s in range(changes.shape[0]):
        one = changes[s]
        for q in range(N_LANES):
            lane = q if moved > 0 else N_LANES - 1 - q
            before = lane + moved
            known = 0 <= before < N_LANES
            one.log_w[lane] = one.log_w[before] if known else -np.inf
            one.place[lane] = one.place[before] if known else 0.0
            one.rate[lane] = one.rate[before] if known else 0.0
        if one.kept >= 0:
            one.kept -= moved
        kept = 0
        for q in range(one.n):
            c = one.course[q]
            c.lane -= moved
            if 0 < c.lane < N_LANES - 1:
                if kept < q:
                    one.course[kept] = c
                kept += 1
        one.n = kept
        if kept == 0 and np.max(one.log_w) == -np.inf:
            # it was in none of the lanes that are left
            forget_changes_(one)
