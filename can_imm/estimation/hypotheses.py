"""Hypotheses of `estimation.traffic`: how they begin, split, merge and end, and what they say."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.estimation.lane_changes import SPREAD, STEADY_TIME, USUAL, add_logs
from can_imm.estimation.road import (
    N_ROAD,
    P_CHANGE_RATE,
    P_CHANGE_STEADY,
    P_SETTLE,
)
from can_imm.estimation.traffic import (
    FREE,
    N_GLOBAL,
    N_LOCAL,
    N_PARTIES,
    best_global,
    first_state,
    global_weights_,
    shares_,
)
from can_imm.estimation.wander import N_USUAL
from can_imm.types import FloatArray, IntArray

N_DURATIONS = 11
"""Durations of lane changes that are followed, and as many of those at a constant rate."""
_DURATION = np.geomspace(2.5, 7.0, N_DURATIONS)
_LOG_P = -0.5 * np.square(np.log(_DURATION / USUAL) / SPREAD)
LASTS: FloatArray = np.concatenate((_DURATION, STEADY_TIME * _DURATION))
LOG_P: FloatArray = np.tile(_LOG_P - np.log(np.sum(np.exp(_LOG_P))), 2)
"""Durations of the courses [s], and logarithms of their prior probabilities; from `N_DURATIONS` on
such at a constant rate."""
N_BEGUN = 6
"""Lane changes that had begun before a vehicle was first seen are tried from so many beginnings."""
FOR_NEW = 1400
"""Room for so many courses is left to vehicles that are first seen: for one in any of
`guides.MOST_LANES` lanes."""
APART = 0.06
"""Courses begin so long one after the other [s], and longer where many vehicles are followed.  It
is less than between the scans of a radar at 14 Hz, of which rounding would leave out some."""
IMPOSSIBLE = 13.5
"""What is less likely than the best by this, as a logarithm, is given up."""
STEADY_SHARES = np.array([0.04, 0.5, 0.96])
MIXED = 0.1
"""Shares of the lane changes of a drive at a constant rate that are told apart; that there are both
kinds is so probable.  It is little: people's are all smooth, simulated ones often all at a constant
rate."""
ONE_ENDED = 0.9
"""When so much of a lane change has ended, as a probability, it counts as one."""
LEAST_HABIT = 1e-3
"""Nothing that was seen makes a share less likely than this against another one: habits change."""
RARE = 7.0
"""What is less likely by this begins no courses."""
SPLIT = 4.0
"""A local hypothesis that makes a global one less likely by no more than this makes another one."""
BETTER = 0.3
"""And one of the same kind takes the place of the one chosen if it is likelier by this."""
LATE = 20.0
"""A global hypothesis that is less likely than the best by this is given up."""
SAME = 1e-6
"""What is likelier by no more is as likely: rounding decides nothing."""
SPLITS = 3
"""Most global hypotheses that are made at a time."""
ANYBODY = -1
"""The courses of all parties count."""
OTHER_ROAD = 0.5
"""Roads that are further apart than so many standard deviations are told apart."""


@numba.njit(nogil=True, cache=True, error_model="numpy")
def keeping(one: Any, t: float) -> bool:  # pragma: no cover - compiled
    """Whether a course keeps a lane at time t."""
    if one.turn == 0:
        return True
    return bool(not 0.0 <= t - one.start < one.duration)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def add_local_(
    T: Any, who: int, lane: int, turn: int, steady: bool, start: float, duration: float, like: int
) -> int:  # pragma: no cover - compiled
    """Another local hypothesis, with the mean of the one named ``like`` or with none; its number.
    Room for it and its odds are the caller's to see to."""
    q = int(T.n)
    one = T.local[q]
    one.who, one.lane, one.turn, one.steady = who, lane, turn, steady
    one.start, one.duration = start, duration
    for i in range(T.mean.shape[1]):
        T.mean[q, i] = T.mean[like, i] if like >= 0 else 0.0
    T.n += 1
    return q


@numba.njit(nogil=True, cache=True, error_model="numpy")
def steady_share(T: Any, par: FloatArray) -> float:  # pragma: no cover - compiled
    """Share of the lane changes that are at a constant rate, by those that have ended."""
    mean = total = 0.0
    for k in range(len(STEADY_SHARES)):
        prior = MIXED
        if k != 1:
            prior = par[P_CHANGE_STEADY] if k == 2 else 1.0 - par[P_CHANGE_STEADY]
            prior *= 1.0 - MIXED
        w = prior * T.habits[k]
        total += w
        mean += w * STEADY_SHARES[k]
    return float(mean / total)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def learn_habit_(T: Any, who: int, par: FloatArray) -> None:  # pragma: no cover - compiled
    """A lane change of a party has ended: what it was like; in place.

    It counts by how much likelier what was measured is under one kind than under the other, not by
    which kind is likelier: that would confirm what was thought before.
    """
    smooth, steady = T.party[who].ended
    share = steady_share(T, par)
    T.party[who].ended[:] = 0.0
    smooth /= 1.0 - share
    steady /= share
    most = 0.0
    for k in range(len(STEADY_SHARES)):
        T.habits[k] *= STEADY_SHARES[k] * steady + (1.0 - STEADY_SHARES[k]) * smooth
        most = max(most, T.habits[k])
    for k in range(len(STEADY_SHARES)):
        T.habits[k] = max(T.habits[k] / most, LEAST_HABIT)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def passes(places: FloatArray, lane: int, turn: int) -> bool:  # pragma: no cover - compiled
    """Whether a vehicle that is first seen at ``places``, in lanes, may be on its way there."""
    return bool(np.abs(places - (lane + 0.5 * turn)).min() <= 1.0)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def count_first(places: FloatArray, lane: int) -> int:  # pragma: no cover - compiled
    """How many courses from a lane `begin_courses_` adds at most for a vehicle that is first seen
    at ``places``."""
    sides = int(passes(places, lane, -1)) + int(passes(places, lane, 1))
    return sides * len(LASTS) * N_BEGUN


@numba.njit(nogil=True, cache=True, error_model="numpy")
def done(T: Any, q: int, who: int, t: float) -> bool:  # pragma: no cover - compiled
    """Whether local hypothesis q is one of a party that has reached its lane at time t."""
    return bool(T.local[q].who == who and keeping(T.local[q], t))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def join_(
    T: Any, who: int, lane: int, t: float, odds: FloatArray
) -> int:  # pragma: no cover - compiled
    """The likeliest of the courses that have brought a party to a lane until time t.

    Args:
        odds: (N_GLOBAL,) written: those of all of them together.
    """
    best, likeliest = best_global(T), -1
    odds[:] = -np.inf
    for q in range(T.n):
        if done(T, q, who, t) and T.local[q].lane + T.local[q].turn == lane:
            for g in range(T.n_global):
                odds[g] = add_logs(odds[g], T.odds[g, q])
            if likeliest < 0 or T.odds[best, q] > T.odds[best, likeliest]:
                likeliest = q
    return likeliest


@numba.njit(nogil=True, cache=True, error_model="numpy")
def begin_courses_(
    T: Any, who: int, t: float, par: FloatArray, places: FloatArray
) -> None:  # pragma: no cover - compiled
    """Add the courses of a party that may begin now; those from a lane all or, where there is no
    room, none.  However the party came to the lane, they begin as after the likeliest way there.

    Args:
        places: (n_global,) where it is, in lanes, by each global hypothesis if it is seen for the
            first time: then those under way that pass there are added; else (0,).
    """
    first = len(places) > 0
    at_constant_rate = steady_share(T, par)
    odds = np.empty(N_GLOBAL)
    since = t - T.party[who].begun
    T.party[who].begun = t
    n = T.n
    reached, n_reached = np.empty(n, np.int64), 0
    for p in range(n):
        lane = T.local[p].lane + T.local[p].turn
        if not done(T, p, who, t) or (reached[:n_reached] == lane).any():
            continue
        reached[n_reached] = lane
        n_reached += 1
        like = join_(T, who, lane, t, odds)
        if not odds[: T.n_global].max() > -RARE:
            continue
        more = count_first(places, lane) if first else 2 * len(LASTS) + FOR_NEW
        if T.n + more > N_LOCAL:
            return
        for turn in (-1, 1):
            if first and not passes(places, lane, turn):
                continue
            for i in range(len(LASTS)):
                steady = i >= N_DURATIONS
                share = at_constant_rate if steady else 1.0 - at_constant_rate
                for b in range(N_BEGUN if first else 1):
                    span = LASTS[i] / N_BEGUN if first else since
                    log_w = math.log(0.5 * par[P_CHANGE_RATE] * span * share) + LOG_P[i]
                    if log_w < -IMPOSSIBLE:
                        continue
                    q = add_local_(T, who, lane, turn, steady, t - (b + 0.5) * span, LASTS[i], like)
                    for g in range(T.n_global):
                        T.odds[g, q] = odds[g] + log_w


@numba.njit(nogil=True, cache=True, error_model="numpy")
def total_odds(T: Any, g: int, who: int) -> float:  # pragma: no cover - compiled
    """Odds in global hypothesis g of all courses of a party together."""
    total = -np.inf
    for q in range(T.n):
        if T.local[q].who == who:
            total = add_logs(total, T.odds[g, q])
    return float(total)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def settle_(T: Any, who: int, t: float, par: FloatArray) -> None:  # pragma: no cover - compiled
    """A course that ended `P_SETTLE` seconds ago is one with the lane that it led to; in place."""
    ended, settle = T.party[who].ended, par[P_SETTLE]
    best, total = best_global(T), np.nan
    for q in range(T.n):
        one = T.local[q]
        if one.who != who:
            continue
        if one.turn != 0 and t - one.start >= one.duration + settle:
            one.lane += one.turn
            one.turn = 0
            if total != total:
                total = total_odds(T, best, who)
            ended[1 if one.steady else 0] += math.exp(T.odds[best, q] - total)
        if one.turn == 0 and merge_alike_(T, q):
            total = np.nan  # odds count from what is chosen
    if ended[0] + ended[1] >= ONE_ENDED:
        learn_habit_(T, who, par)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def merge_(T: Any, p: int, q: int) -> None:  # pragma: no cover - compiled
    """Local hypothesis p takes in q, of the same party, which is impossible from then on."""
    who = T.local[p].who
    best = best_global(T)
    total = add_logs(T.odds[best, p], T.odds[best, q])
    w = math.exp(T.odds[best, q] - total) if total > -np.inf else 0.0
    for i in range(T.top):
        T.mean[p, i] += w * (T.mean[q, i] - T.mean[p, i])
    for g in range(T.n_global):
        T.odds[g, p] = add_logs(T.odds[g, p], T.odds[g, q])
        T.odds[g, q] = -np.inf
        if T.choice[g, who] == q:
            T.choice[g, who] = p
        if T.choice[g, who] == p:
            rechoose_(T, g, who, p)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def merge_alike_(T: Any, q: int) -> bool:  # pragma: no cover - compiled
    """The first course of a party that leads from and to the same lanes as q takes q in, if there
    is one before q; returns whether there is."""
    for p in range(q):
        if T.local[p].who == T.local[q].who and alike(T, p, q):
            merge_(T, p, q)
            return True
    return False


@numba.njit(nogil=True, cache=True, error_model="numpy")
def rechoose_(T: Any, g: int, who: int, q: int) -> None:  # pragma: no cover - compiled
    """In global hypothesis g the party takes course q; in place."""
    gained = T.odds[g, q]
    T.choice[g, who] = q
    T.log_w[g] += gained
    for p in range(T.n):
        if T.local[p].who == who:
            T.odds[g, p] -= gained


@numba.njit(nogil=True, cache=True, error_model="numpy")
def alike(T: Any, p: int, q: int) -> bool:  # pragma: no cover - compiled
    """Whether two courses of a party lead from and to the same lanes."""
    if p == q:
        return True
    if p == FREE or q == FREE:
        return False
    one, other = T.local[p], T.local[q]
    return bool(one.lane == other.lane and one.turn == other.turn)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def beyond(T: Any, g: int, i: int) -> float:  # pragma: no cover - compiled
    """By how much state i of global hypothesis g is more than ``x``."""
    v = T.rest[g, i]
    for p in range(N_PARTIES):
        if T.choice[g, p] != FREE:
            v += T.mean[T.choice[g, p], i]
    return float(v)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def same_road(T: Any, g: int, other: int) -> bool:  # pragma: no cover - compiled
    """Whether two global hypotheses are of the same road, by what is known of it."""
    for i in range(N_ROAD):
        if abs(beyond(T, g, i) - beyond(T, other, i)) > OTHER_ROAD * math.sqrt(T.P[i, i]):
            return False
    return True


@numba.njit(nogil=True, cache=True, error_model="numpy")
def agree(T: Any, g: int, other: int, but: int) -> bool:  # pragma: no cover - compiled
    """Whether two global hypotheses have courses alike for all parties but one (-1: for all)."""
    for p in range(N_PARTIES):
        if p != but and not alike(T, T.choice[other, p], T.choice[g, p]):
            return False
    return True


@numba.njit(nogil=True, cache=True, error_model="numpy")
def find_global(T: Any, g: int, who: int, q: int) -> int:  # pragma: no cover - compiled
    """The global hypothesis like g but for the course q of a party; -1 if there is none."""
    for other in range(T.n_global):
        if alike(T, T.choice[other, who], q) and agree(T, g, other, who):
            return other
    return -1


@numba.njit(nogil=True, cache=True, error_model="numpy")
def split_(T: Any) -> None:  # pragma: no cover - compiled
    """Make the likeliest alternatives global hypotheses of their own; in place."""
    for g in range(T.n_global):
        for q in range(T.n):
            who = T.local[q].who
            if T.odds[g, q] > BETTER and alike(T, T.choice[g, who], q):
                rechoose_(T, g, who, q)
    promote_(T, SPLIT, ANYBODY)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def promote_(T: Any, least: float, of: int) -> None:  # pragma: no cover - compiled
    """Make the likeliest alternatives to the courses that are chosen global hypotheses; in place.

    Args:
        least: those that make a global hypothesis less likely than the best by more are left.
        of: party whose courses count, or `ANYBODY`.
    """
    n_before = T.n_global
    for _ in range(SPLITS):
        best = T.log_w[best_global(T)]
        value, g, q = best - least, -1, -1
        for one in range(n_before):
            for p in range(T.n):
                v = T.log_w[one] + T.odds[one, p]
                who = T.local[p].who
                if v <= value + SAME or (of != ANYBODY and who != of):
                    continue
                if alike(T, T.choice[one, who], p):
                    continue
                if find_global(T, one, who, p) < 0:
                    value, g, q = v, one, p
        if g < 0:
            return
        if T.n_global < N_GLOBAL:
            to = T.n_global
            T.n_global += 1
        else:
            to = 0
            for one in range(1, N_GLOBAL):
                if T.log_w[one] < T.log_w[to]:
                    to = one
            if T.log_w[to] >= value or to == g:
                return
        copy_global_(T, g, to)
        rechoose_(T, to, T.local[q].who, q)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def drop_globals_(T: Any) -> None:  # pragma: no cover - compiled
    """Give up the unlikely global hypotheses, and the second of two alike on the same road;
    logarithms of weights count from the best one; in place."""
    best = T.log_w[best_global(T)]
    kept = 0
    for g in range(T.n_global):
        T.log_w[g] -= best
        keep = T.log_w[g] >= -LATE
        other = 0
        while keep and other < kept:
            if agree(T, g, other, -1) and same_road(T, g, other):
                keep = False
                if T.log_w[g] > T.log_w[other] + SAME:
                    copy_global_(T, g, other)
            other += 1
        if keep:
            copy_global_(T, g, kept)
            kept += 1
    T.n_global = kept


@numba.njit(nogil=True, cache=True, error_model="numpy")
def copy_global_(T: Any, g: int, to: int) -> None:  # pragma: no cover - compiled
    """Global hypothesis g in the place of another."""
    if g == to:
        return
    T.log_w[to] = T.log_w[g]
    T.rest[to] = T.rest[g]
    T.choice[to] = T.choice[g]
    for q in range(T.n):
        T.odds[to, q] = T.odds[g, q]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def drop_locals_(T: Any, gone: int) -> None:  # pragma: no cover - compiled
    """Give up the impossible local hypotheses, and all of a party that is gone; in place.

    What the courses of a party that is gone did to the means stays.

    Args:
        gone: number of the party, -1 for none.
    """
    to = np.full(T.n, FREE, np.int32)
    if gone >= 0:
        for g in range(T.n_global):
            q = T.choice[g, gone]
            if q != FREE:
                for i in range(T.top):
                    T.rest[g, i] += T.mean[q, i]
                T.choice[g, gone] = FREE
    least = T.log_w[best_global(T)] - IMPOSSIBLE
    kept = 0
    for q in range(T.n):
        who = T.local[q].who
        if who == gone:
            continue
        keep = False
        for g in range(T.n_global):
            keep |= T.log_w[g] + T.odds[g, q] >= least or T.choice[g, who] == q
        if not keep:
            continue
        to[q] = kept
        if kept < q:
            T.local[kept] = T.local[q]
            T.mean[kept] = T.mean[q]
            for g in range(T.n_global):
                T.odds[g, kept] = T.odds[g, q]
        kept += 1
    T.n = kept
    for g in range(T.n_global):
        for p in range(N_PARTIES):
            if T.choice[g, p] != FREE:
                T.choice[g, p] = to[T.choice[g, p]]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def centre_(T: Any) -> None:  # pragma: no cover - compiled
    """Let ``x`` be the mean of the likeliest global hypothesis, and the others count from it; in
    place.

    No hypothesis changes.  What is not linear, the width times a course, is so linearised where
    that hypothesis is.
    """
    best = best_global(T)
    for i in range(T.top):
        v = beyond(T, best, i)
        T.x[i] += v
        for g in range(T.n_global):
            T.rest[g, i] -= v


@numba.njit(nogil=True, cache=True, error_model="numpy")
def consider_(T: Any, t: float, par: FloatArray) -> None:  # pragma: no cover - compiled
    """After all measurements of a scan at time t [s]: settle, split, give up; in place."""
    for who in range(N_PARTIES):
        settle_(T, who, t, par)
    split_(T)
    drop_globals_(T)
    drop_locals_(T, -1)
    centre_(T)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def part_(T: Any, who: int) -> None:  # pragma: no cover - compiled
    """What a party that leaves may have done instead becomes global hypotheses; in place.

    Those that come there later may tell which it was: whether it changed lanes far ahead, or the
    road bends there.  Courses from and to the same lanes are made one first, with the odds of all.
    """
    for q in range(T.n):
        if T.local[q].who == who:
            merge_alike_(T, q)
    promote_(T, RARE, who)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def remove_guide_(T: Any, g: int) -> None:  # pragma: no cover - compiled
    """A vehicle is no longer followed; what it has shown of the road stays known."""
    T.party[g].slot = FREE
    for k in range(N_USUAL):
        T.gone[k] += T.party[g].told[k]
        T.party[g].told[k] = 0.0
    T.party[g].ended[:] = 0.0
    part_(T, g)
    drop_locals_(T, g)
    for a in range(first_state(T, g), first_state(T, g + 1)):
        T.x[a] = 0.0
        for q in range(T.n):
            T.mean[q, a] = 0.0
        for k in range(T.n_global):
            T.rest[k, a] = 0.0
        for i in range(T.P.shape[0]):
            T.P[a, i] = 0.0
            T.P[i, a] = 0.0
    top = 0
    for k in range(N_PARTIES - 1):
        if T.party[k].slot != FREE:
            top = k + 1
    T.top = first_state(T, top)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def weigh_(T: Any, weight: FloatArray) -> None:  # pragma: no cover - compiled
    """Probabilities (N_LOCAL,) of the local hypotheses over all global ones, written."""
    w, total = np.empty(N_GLOBAL), np.empty((N_PARTIES, 2))
    share = T.error
    weight[: T.n] = 0.0
    global_weights_(T, w)
    for g in range(T.n_global):
        shares_(T, g, share, total)
        for q in range(T.n):
            weight[q] += w[g] * share[q]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def tell_changes_(
    T: Any, weight: FloatArray, guide_of: IntArray, ids: Any, t: float, p: FloatArray
) -> None:  # pragma: no cover - compiled
    """How probable it is by what was measured until now that vehicles were changing lanes at t.

    Args:
        T: record of `traffic.TRAFFIC_DTYPE`.  weight: see `weigh_`.
        guide_of: (capacity,) party of each slot, `FREE` for none.
        ids: (capacity,) object id of each slot, -1 for a free one.
        t: [s], not longer ago than the time to settle.
        p: (N, 2) written for each slot in use, in their order: changing to the left, to the right;
            NaN where nothing was known then.
    """
    sides = np.zeros((N_PARTIES, 2))
    for q in range(T.n):
        one = T.local[q]
        if not keeping(one, t):
            sides[one.who, 0 if one.turn > 0 else 1] += weight[q]
    row = 0
    for s in range(ids.shape[0]):
        if ids[s] < 0:
            continue
        who = guide_of[s]
        known = who != FREE and t >= T.party[who].since
        for side in range(2):
            p[row, side] = sides[who, side] if known else np.nan
        row += 1


@numba.njit(nogil=True, cache=True, error_model="numpy")
def tell_times_(
    T: Any, weight: FloatArray, guide_of: IntArray, ids: Any, now: float, reports: Any
) -> None:  # pragma: no cover - compiled
    """When the lane changes that are under way or have just ended begin and end: ``change`` of the
    reports of all slots in use, in their order; NaN where there is probably none.

    Args:
        weight, guide_of, ids: as for `tell_changes_`.  now: time of the last scan [s].
        reports: (N,) of `REPORT_DTYPE`.
    """
    # by party and side: weight, beginning and end from now on
    found = np.zeros((N_PARTIES, 2, 3))
    for q in range(T.n):
        one = T.local[q]
        if one.turn == 0:
            continue
        of = found[one.who, 0 if one.turn > 0 else 1]
        of[0] += weight[q]
        of[1] += weight[q] * (one.start - now)
        of[2] += weight[q] * (one.start - now + one.duration)
    row = 0
    for s in range(ids.shape[0]):
        if ids[s] < 0:
            continue
        report = reports[row]
        row += 1
        report.change[0] = report.change[1] = np.nan
        if guide_of[s] == FREE:
            continue
        of = found[guide_of[s]]
        side = 0 if of[0, 0] > of[1, 0] else 1
        if of[side, 0] > 0.5:
            report.change[0] = now + of[side, 1] / of[side, 0]
            report.change[1] = now + of[side, 2] / of[side, 0]
