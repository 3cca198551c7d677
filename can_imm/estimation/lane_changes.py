"""When a vehicle changed lanes, by hindsight: whole lane changes weighed against keeping the lane.

A semi-Markov chain (Yu, "Hidden semi-Markov models", 2010): a vehicle keeps to the middle of a
lane, and now and then moves to the middle of the next one within a few seconds, along a smooth
course.  Beside the course it wanders, and what is thought of the road is not quite right; both
together are a Gaussian process with the Matern covariance of order 3/2 (state: place beside the
course and its rate), known through a Kalman filter.  All courses have the same covariance in it,
only the means differ, so that many courses can be followed at little cost.  Some time after a
course ended in a lane, it is merged with the others that are in that lane by then.  Who does not
wait so long until the next lane change is in the lane *in passing*: a state of its own, which
courses lead to as soon as they end.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.types import FloatArray

RATE = 0.03
"""Lane changes of a vehicle [1/s]."""
SHORTEST, LONGEST = 2.5, 7.5
N_DURATIONS = 11
"""Durations of lane changes that are tried [s]."""
USUAL, SPREAD = 4.3, 0.24
"""Median of the durations [s], and standard deviation of their logarithm."""
STEADY, STEADY_TIME = 0.1, 0.6
"""Share of the lane changes at a constant rate, as in the published scenario, and how long they
last in units of the usual durations."""
_DURATION = np.geomspace(SHORTEST, LONGEST, N_DURATIONS)
_LOG_P = -0.5 * np.square(np.log(_DURATION / USUAL) / SPREAD)
LASTS: FloatArray = np.concatenate((_DURATION, STEADY_TIME * _DURATION))
LOG_P: FloatArray = np.tile(_LOG_P - np.log(np.sum(np.exp(_LOG_P))), 2)
"""Durations of the courses that are tried [s], and logarithms of their prior probabilities: smooth
ones, and from `N_DURATIONS` on such at a constant rate."""
HURRY = 0.5
"""How fast the place beside the course is forgotten [1/s]: rate of the Matern process."""
IMPOSSIBLE = 18.0
"""A course whose log weight is so much lower than that of the best one is given up."""
OUTLIER = 16.0
"""Squared normalised error of a measurement counts as this at most."""
SETTLE = 1.0
"""So long after its end [s] a course is still followed on its own: whether it ended too early shows
only then."""
AGAIN, AGAIN_TIME = 0.05, 0.5
"""Share of the lane changes that are followed by another one at once, and how soon [s]."""
EDGE = 12
"""Lanes are numbered from -EDGE to EDGE."""
N_LANES = 2 * EDGE + 1
N_STATES = 2 * N_LANES
"""States a vehicle may be in: in a lane, and from `N_LANES` on in a lane in passing."""
N_BEGUN = 8
"""Courses that had begun before the first measurement are tried from so many beginnings."""
UNKNOWN = 1e6
"""A measurement with a larger variance is none."""

Three = tuple[float, float, float]
Four = tuple[float, float, float, float]

COURSE_DTYPE = np.dtype(
    [
        ("first", np.int64),
        ("end", np.int64),
        ("merged", np.int64),
        ("start", np.float64),
        ("duration", np.float64),
        ("lane", np.int64),
        ("passing", np.bool_),
        ("turn", np.int64),
        ("steady", np.bool_),
        ("log_prior", np.float64),
        ("log_before", np.float64),
        ("log_like", np.float64),
        ("log_end", np.float64),
        ("place", np.float64),
        ("rate", np.float64),
    ],
    align=True,
)
"""A lane change that may have been: rows ``first`` to ``end`` - 1 lie in it, from ``merged`` on it
is one with its new lane; it began at ``start`` and lasted ``duration`` [s], from ``lane`` (0 to
`N_LANES` - 1), where it was in ``passing``, to that + ``turn``, at a constant rate if ``steady``.
Logarithms of its prior probability where it begins, of the weight of what led there, and of the
likelihood of what was measured during it (backwards: from its beginning to the track's end) and
before its end.  ``place``, ``rate`` beside the course [m, m/s]."""


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def course(u: float, steady: bool) -> tuple[float, float]:  # pragma: no cover - compiled
    """How much of the way is done at the share u of the time (0 or more), and its derivative by u.

    At a constant rate, or between a quintic polynomial and a cubic, which differ by 4 % of the way;
    half a cosine wave lies between them.
    """
    if u >= 1.0:
        return 1.0, 0.0
    if steady:
        return u, 1.0
    u2, rest = u * u, 1.0 - u
    quintic = u2 * u * (10.0 - 15.0 * u + 6.0 * u2)
    cubic = u2 * (3.0 - 2.0 * u)
    slope = 3.0 * u * rest * (5.0 * u * rest + 1.0)
    return 0.5 * (quintic + cubic), slope


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def fading(hurry: float, dt: float) -> Four:  # pragma: no cover - compiled
    """Transition matrix of place and rate beside a course, row by row, over ``dt`` [s]."""
    fade = math.exp(-hurry * dt)
    return (
        (1.0 + hurry * dt) * fade,
        dt * fade,
        -hurry * hurry * dt * fade,
        (1.0 - hurry * dt) * fade,
    )


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def carried(
    place: float, rate: float, f: Four
) -> tuple[float, float]:  # pragma: no cover - compiled
    """Place and rate beside a course after the transition f."""
    return f[0] * place + f[1] * rate, f[2] * place + f[3] * rate


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def spread(P: Three, f: Four, hurry: float, beside: float) -> Three:  # pragma: no cover - compiled
    """Covariance (P00, P01, P11) of place and rate beside a course after the transition f.

    F (P - S) F' + S, S the stationary covariance.
    """
    s00, s11 = beside**2, (hurry * beside) ** 2
    d00, d11 = P[0] - s00, P[2] - s11
    g00, g01 = f[0] * d00 + f[1] * P[1], f[0] * P[1] + f[1] * d11
    g10, g11 = f[2] * d00 + f[3] * P[1], f[2] * P[1] + f[3] * d11
    return (
        g00 * f[0] + g01 * f[1] + s00,
        g00 * f[2] + g01 * f[3],
        g10 * f[2] + g11 * f[3] + s11,
    )


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def gains(
    P: Three, r: float, rv: float
) -> tuple[Three, Three, Three]:  # pragma: no cover - compiled
    """Kalman gains of a measured place and then of a measured speed.

    Args:
        P: covariance before.  r, rv: variances, above `UNKNOWN` where not measured.

    Returns:
        The covariance after; variance of the place's innovation and its gains; the same of the
        speed, with gains of 0 and a variance of 1 where not measured.
    """
    of_place, of_speed = (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)
    if r < UNKNOWN:
        v = P[0] + r
        k0, k1 = P[0] / v, P[1] / v
        of_place = v, k0, k1
        P = P[0] - k0 * P[0], P[1] - k0 * P[1], P[2] - k1 * P[1]
    if rv < UNKNOWN:
        v = P[2] + rv
        k0, k1 = P[1] / v, P[2] / v
        of_speed = v, k0, k1
        P = P[0] - k0 * P[1], P[1] - k0 * P[2], P[2] - k1 * P[2]
    return P, of_place, of_speed


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def correct(
    place: float, rate: float, e: float, ev: float, of_place: Three, of_speed: Three, outlier: float
) -> Three:  # pragma: no cover - compiled
    """Place and rate beside a course after a measurement, and minus twice its log likelihood.

    Args:
        e, ev: place and speed measured, minus the course's.  of_place, of_speed: as of `gains`.
        outlier: the squared normalised error counts as this at most.
    """
    e -= place
    place += of_place[1] * e
    rate += of_place[2] * e
    ev -= rate
    lost = 0.0
    if of_place[1] > 0.0:
        lost += min(e * e / of_place[0], outlier)
    if of_speed[2] > 0.0:
        lost += min(ev * ev / of_speed[0], outlier)
        place += of_speed[1] * ev
        rate += of_speed[2] * ev
    return place, rate, lost


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def add_logs(a: float, b: float) -> float:  # pragma: no cover - compiled
    """log(exp(a) + exp(b))"""
    if a < b:
        a, b = b, a
    return a + math.log1p(math.exp(b - a)) if b > -np.inf else a


@numba.njit(nogil=True, cache=True, error_model="numpy")
def grown(courses: Any) -> Any:  # pragma: no cover - compiled
    """The same courses with twice the room."""
    more = np.zeros(2 * len(courses), COURSE_DTYPE)
    for c in range(len(courses)):
        more[c] = courses[c]
    return more


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def begin_(
    course: Any,
    first: int,
    end: int,
    start: float,
    duration: float,
    state: int,
    turn: int,
    steady: bool,
) -> None:  # pragma: no cover - compiled
    """Where and when a course runs; the rest is 0."""
    course.first, course.end, course.merged = first, end, end
    course.start, course.duration = start, duration
    course.lane, course.passing = state % N_LANES, state >= N_LANES
    course.turn, course.steady = turn, steady
    course.log_prior = course.log_before = course.log_like = course.log_end = 0.0
    course.place = course.rate = 0.0


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def leaves(state: int, dt: float) -> float:  # pragma: no cover - compiled
    """Probability that a lane change begins within ``dt`` [s]."""
    return 1.0 - math.exp(-dt / AGAIN_TIME) if state >= N_LANES else min(RATE * dt, 0.5)


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def stays(dt: float) -> tuple[float, float]:  # pragma: no cover - compiled
    """Logarithms of the probability that none does: in a lane, and there in passing."""
    return math.log1p(-leaves(0, dt)), math.log1p(-leaves(N_LANES, dt))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def find_lane_changes_(
    t: FloatArray,
    y: FloatArray,
    r: FloatArray,
    vy: FloatArray,
    rv: FloatArray,
    beside: FloatArray,
    width: float,
    p: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Probability that a vehicle was changing lanes, by all that was measured of it.

    Args:
        t: (K,) ascending [s].
        y, vy: (K,) place and speed across the road [m, m/s]; the middles of lanes lie at multiples
            of the width.  r, rv: (K,) variances, infinite where not measured.
        beside: (K,) standard deviation of the place beside the course [m].
        width: of the lanes [m].
        p: (K, 2) written: changing to the left, to the right.
    """
    n = len(t)
    # logarithms: weight of a state by what was measured until then, likelihood of the measurement
    # there, likelihood of all that was measured afterwards
    alpha = np.zeros((n, N_STATES))
    like = np.zeros((n, N_STATES))
    beta = np.zeros((n, N_STATES))
    place, rate = np.zeros(N_STATES), np.zeros(N_STATES)
    alpha[0, N_LANES:] = -np.inf
    courses = np.zeros(4096, COURSE_DTYPE)
    active = np.zeros(4096, np.int64)
    count = n_active = 0
    P = beside[0] ** 2, 0.0, (HURRY * beside[0]) ** 2
    f = 1.0, 0.0, 0.0, 1.0
    best = 0.0
    for k in range(n):
        # what may begin
        dt = t[k] - t[max(k - 1, 0)]
        for state in range(N_STATES):
            lane = state % N_LANES
            if lane in (0, N_LANES - 1) or alpha[max(k - 1, 0), state] < best - IMPOSSIBLE:
                continue
            begins = leaves(state, dt)
            for turn in (-1, 1):
                # at first only what passes the place where the vehicle is
                off = y[k] / width - (lane - EDGE + 0.5 * turn)
                if k == 0 and abs(off) > 1.0:
                    continue
                for i in range(2 * N_DURATIONS):
                    steady = i >= N_DURATIONS
                    lasts = LASTS[i]
                    share = math.log(STEADY if steady else 1.0 - STEADY)
                    for b in range(1 if k > 0 else N_BEGUN):
                        if count == len(courses):
                            courses = grown(courses)
                            active = np.concatenate((active, np.zeros_like(active)))
                        start = t[k] - 0.5 * dt
                        if k == 0:
                            start = t[0] - (b + 0.5) / N_BEGUN * lasts
                            begins = RATE * lasts / N_BEGUN
                        c = courses[count]
                        begin_(c, k, n, start, lasts, state, turn, steady)
                        c.log_prior = math.log(0.5 * begins) + LOG_P[i] + share
                        if k > 0:
                            c.log_before = alpha[k - 1, state]
                            c.place, c.rate = place[state], rate[state]
                        active[n_active] = count
                        n_active += 1
                        count += 1
        # on to this row
        if k > 0:
            f = fading(HURRY, dt)
            P = spread(P, f, HURRY, beside[k])
            stay = stays(dt)
            for state in range(N_STATES):
                alpha[k, state] = alpha[k - 1, state] + stay[state // N_LANES]
                place[state], rate[state] = carried(place[state], rate[state], f)
        kept = 0
        for q in range(n_active):
            c = courses[active[q]]
            c.place, c.rate = carried(c.place, c.rate, f)
            since = t[k] - c.start - c.duration
            if since >= 0.0 and c.end == n:
                c.end, c.log_end = k, c.log_like
                merge_(c, math.log(AGAIN), N_LANES, alpha[k], place, rate)
            if since < SETTLE:
                active[kept] = active[q]
                kept += 1
                continue
            c.merged = k
            merge_(c, 0.0, 0, alpha[k], place, rate)
        n_active = kept
        # the measurement
        P, of_place, of_speed = gains(P, r[k], rv[k])
        scale = -0.5 * (math.log(of_place[0]) + math.log(of_speed[0]))
        best = -np.inf
        for state in range(N_STATES):
            off = y[k] - (state % N_LANES - EDGE) * width
            place[state], rate[state], lost = correct(
                place[state], rate[state], off, vy[k], of_place, of_speed, OUTLIER
            )
            like[k, state] = scale - 0.5 * lost
            alpha[k, state] += like[k, state]
            best = max(best, alpha[k, state])
        for q in range(n_active):
            c = courses[active[q]]
            done, slope = course((t[k] - c.start) / c.duration, c.steady)
            off = y[k] - (c.lane - EDGE + c.turn * done) * width
            speed = vy[k] - c.turn * slope * width / c.duration
            c.place, c.rate, lost = correct(
                c.place, c.rate, off, speed, of_place, of_speed, OUTLIER
            )
            c.log_like += scale - 0.5 * lost
            best = max(best, c.log_before + c.log_prior + c.log_like)
        kept = 0
        for q in range(n_active):
            c = courses[active[q]]
            if c.log_before + c.log_prior + c.log_like < best - IMPOSSIBLE:
                c.log_like = -np.inf
            else:
                active[kept] = active[q]
                kept += 1
        n_active = kept
    look_back_(t, alpha, like, beta, courses, count, p)


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def merge_(
    course: Any, share: float, passing: int, alpha: FloatArray, place: FloatArray, rate: FloatArray
) -> None:  # pragma: no cover - compiled
    """Let a course, or a share of it (its logarithm), be one with the lane it leads to.

    Args:
        passing: `N_LANES` if it is there in passing, else 0.
        alpha, place, rate: (N_STATES,) in place.
    """
    to = passing + course.lane + course.turn
    log_w = course.log_before + course.log_prior + course.log_like + share
    total = add_logs(alpha[to], log_w)
    w = math.exp(log_w - total)
    place[to] += w * (course.place - place[to])
    rate[to] += w * (course.rate - rate[to])
    alpha[to] = total


@numba.njit(nogil=True, cache=True, error_model="numpy")
def look_back_(
    t: FloatArray,
    alpha: FloatArray,
    like: FloatArray,
    beta: FloatArray,
    courses: Any,
    count: int,
    p: FloatArray,
) -> None:  # pragma: no cover - compiled
    """The backward half of `find_lane_changes_`; see there."""
    n = len(t)
    total = -np.inf
    c = count - 1
    for q in range(n):
        # courses are in the order of their first rows
        k = n - 1 - q
        if k < n - 1:
            stay = stays(t[k + 1] - t[k])
            for state in range(N_STATES):
                after = like[k + 1, state] + beta[k + 1, state]
                beta[k, state] = stay[state // N_LANES] + after
        while c >= 0 and courses[c].first > k:
            one = courses[c]
            add_rest_(one, n, like, beta)
            at = one.lane + (N_LANES if one.passing else 0)
            beta[k, at] = add_logs(beta[k, at], one.log_prior + one.log_like)
            c -= 1
    for lane in range(N_LANES):
        total = add_logs(total, alpha[0, lane] + beta[0, lane])
    while c >= 0:
        add_rest_(courses[c], n, like, beta)
        total = add_logs(total, courses[c].log_prior + courses[c].log_like)
        c -= 1
    p[:] = 0.0
    for c in range(count):
        one = courses[c]
        log_w = one.log_before + one.log_prior + one.log_like - total
        if log_w > -IMPOSSIBLE:
            side = 0 if one.turn > 0 else 1
            for k in range(one.first, one.end):
                p[k, side] += math.exp(log_w)


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def add_rest_(
    course: Any, n: int, like: FloatArray, beta: FloatArray
) -> None:  # pragma: no cover - compiled
    """Add what was measured after a course became one with its lane, and what if that was in
    passing."""
    to = course.lane + course.turn
    if course.merged < n:
        course.log_like += like[course.merged, to] + beta[course.merged, to]
    if course.end < n:
        to += N_LANES
        rest = math.log(AGAIN) + like[course.end, to] + beta[course.end, to]
        course.log_like = add_logs(course.log_like, course.log_end + rest)
