"""Road, ego and vehicles, told apart together: one Kalman filter, and hypotheses of lane changes.

A vehicle that begins to change lanes looks like a road that begins to bend, and an ego that changes
lanes like all the others doing so.  So all are estimated at once.  The state is that of the road
(`estimation.road`), and for each vehicle its place beside the course that it follows, and the rate
of that place [m, m/s]: it wanders about its course (Matern covariance of order 3/2).  Where the
sensor has errors that last for longer than a scan, these are states as well (as Bryson and
Johansen, 1965, do with coloured noise): one of each vehicle's place, and one of the bearing that
all share.

A course leads along the middle of a lane, or from there to the middle of the next one.  Given
everybody's course all is linear and Gaussian, and since a course only adds what is known to what is
expected, all hypotheses have one covariance in common and differ in their means: a hypothesis costs
a vector, not a matrix.  As in multiple hypothesis tracking (Reid, 1979; Blackman, 2004) there are

- local hypotheses: a course of one party (a vehicle or the ego), and what it does to the mean;
- global hypotheses: a course for each party.  The mean is a sum over the parties.  For each one it
  is kept how much likelier it would be if one party had another course.

A local hypothesis that makes a global one likelier, or nearly as likely, becomes another global
one; only the best are kept (`estimation.hypotheses`).
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.estimation import lane_changes
from can_imm.estimation.lane_changes import fading
from can_imm.estimation.road import (
    BIAS,
    BIAS_TIME,
    HEADING,
    KNOT,
    N_ROAD,
    OFFSET,
    P_BESIDE_RATE,
    P_BIAS_STD,
    P_CURVATURE_LENGTH,
    P_CURVATURE_STD,
    P_DRIFT,
    P_HEADING_STD,
    P_HEADING_TIME,
    P_OFFSET,
    P_OFFSET_STD,
    P_OFFSET_TIME,
    P_TURN_STD,
    P_TURN_TIME,
    P_YAW_NOISE,
    P_YAW_NOISE_UNKNOWN,
    SPACING,
    USUAL_SPEED,
    WAY,
    WIDTH,
    bend_row_,
    new_road,
)
from can_imm.estimation.wander import N_USUAL, NO_LANE, WANDER_FIELDS
from can_imm.types import FloatArray, LastingErrors

N_GUIDES = 24
"""Most vehicles that are followed."""
EGO = N_GUIDES
"""Number of the ego among the parties; those before it are the vehicles."""
N_PARTIES = N_GUIDES + 1
BEARING = N_ROAD
"""Index of the sensor's lasting error of the bearing, where it has lasting errors."""
WITHOUT_ERROR, WITH_ERROR = 2, 3
"""States of a vehicle: its place beside its course and the rate; and the lasting error of where it
is measured."""
N = N_ROAD + 1 + WITHOUT_ERROR * N_GUIDES
"""Greatest length of the state.  With lasting errors it has room for fewer vehicles, `room`."""
N_LOCAL = 6144
"""Most local hypotheses, of all parties together."""
N_GLOBAL = 12
"""Most global hypotheses."""
FREE = -1
"""``slot`` of a party, or its course in a global hypothesis, that is not in use."""
NOBODY = -1
"""What is measured is nobody's."""

TRAFFIC_DTYPE = np.dtype(
    [
        ("x", np.float64, (N,)),
        ("P", np.float64, (N, N)),
        ("n", np.int64),
        ("top", np.int64),
        ("first", np.int64),
        ("stride", np.int64),
        ("lasting_std", np.float64),
        ("lasting_s", np.float64),
        ("bearing_std", np.float64),
        ("bearing_s", np.float64),
        ("new_std", np.float64),
        ("new_s", np.float64),
        (
            "local",
            [
                ("start", np.float64),
                ("duration", np.float64),
                ("who", np.int32),
                ("lane", np.int32),
                ("turn", np.int8),
                ("steady", np.bool_),
            ],
            (N_LOCAL,),
        ),
        ("mean", np.float64, (N_LOCAL, N)),
        ("habits", np.float64, (3,)),
        ("bends", np.float64),
        ("driven", np.float64),
        ("gone", np.float64, (N_USUAL,)),
        ("n_global", np.int64),
        ("log_w", np.float64, (N_GLOBAL,)),
        ("choice", np.int32, (N_GLOBAL, N_PARTIES)),
        ("rest", np.float64, (N_GLOBAL, N)),
        ("odds", np.float64, (N_GLOBAL, N_LOCAL)),
        (
            "party",
            [
                ("slot", np.int32),
                ("outliers", np.int32),
                ("unseen", np.float64),
                ("begun", np.float64),
                ("since", np.float64),
                ("ended", np.float64, (2,)),
                *WANDER_FIELDS,
            ],
            (N_PARTIES,),
        ),
        ("F", np.float64, (N_ROAD, N_ROAD)),
        ("h", np.float64, (N,)),
        ("at", np.int64, (N,)),
        ("gain", np.float64, (N,)),
        ("shift", np.float64, (N_LOCAL,)),
        ("error", np.float64, (N_LOCAL,)),
    ],
    align=True,
)
"""The filter.  Mean of a global hypothesis g: ``x`` + ``rest[g]`` + the sum of ``mean[q]`` over the
local hypotheses q = ``choice[g]`` of all parties; ``P`` covariance of all.

``n`` local hypotheses are in use: party ``who`` changes from ``lane`` (0 the ego's) by ``turn`` (+1
left, -1 right, 0 none) from ``start`` on within ``duration`` [s], at a constant rate if ``steady``.
``habits``: how likely each of `hypotheses.STEADY_SHARES` is by the lane changes that have ended;
``bends`` and ``driven``: see `learn_curvature_`; ``gone``: log evidence (`wander`) by the vehicles
that have left.  ``log_w`` logarithms of the weights of the ``n_global`` global hypotheses, ``odds``
what is to be added if one party had another course.

Of a party: the detector's ``slot``, `FREE` for none; so many ``outliers`` in a row; for how long it
is ``unseen``, when courses have ``begun`` last, ``since`` when it is followed [s]; so much has
``ended`` of a lane change, smooth and at a constant rate; and how it wanders (`wander`).

``top``: states in use; the vehicles' begin with the ``first``, and each has ``stride`` of them,
`WITH_ERROR` or `WITHOUT_ERROR`.  The sensor's lasting errors, as in `types.LastingErrors`.  The
rest is scratch: a measurement's row ``h`` for the states ``at``, ``shift`` by which a party's
courses change what is expected, their ``error``."""


@numba.njit(nogil=True, cache=True, error_model="numpy")
def course(u: float, steady: bool) -> tuple[float, float, float]:  # pragma: no cover - compiled
    """How much of the way is done at the share u of the time, and its derivatives by u.

    As `lane_changes.course`, with the second derivative, and for u below 0 as well.
    """
    if u <= 0.0:
        return 0.0, 0.0, 0.0
    if u >= 1.0:
        return 1.0, 0.0, 0.0
    done, slope = lane_changes.course(u, steady)
    bend = 0.0 if steady else 3.0 * (1.0 - 2.0 * u) * (10.0 * u * (1.0 - u) + 1.0)
    return done, slope, bend


@numba.njit(nogil=True, cache=True, error_model="numpy")
def lane_at(one: Any, t: float) -> tuple[float, float, float]:  # pragma: no cover - compiled
    """Where a course is at time t [s], in lanes, and its derivatives by the time."""
    if one.turn == 0:
        return float(one.lane), 0.0, 0.0
    done, slope, bend = course((t - one.start) / one.duration, one.steady)
    return (
        one.lane + one.turn * done,
        one.turn * slope / one.duration,
        one.turn * bend / (one.duration * one.duration),
    )


def new_traffic() -> np.ndarray[Any, np.dtype[np.void]]:
    """(1,) of `TRAFFIC_DTYPE`; `begin_traffic_` begins it."""
    return np.zeros(1, TRAFFIC_DTYPE)


def begin_traffic_(T: Any, par: FloatArray, t: float, width: float, width_var: float) -> None:
    """Nothing is known but the lanes' width [m] and its variance [m²]; the ego keeps its lane.

    Args:
        T: record of `TRAFFIC_DTYPE`.  par: `road.PARAMETERS`.  t: [s].
    """
    T["x"][:] = 0.0
    T["P"][:] = 0.0
    T["x"][:N_ROAD], T["P"][:N_ROAD, :N_ROAD] = new_road(par)
    T["x"][WIDTH], T["P"][WIDTH, WIDTH] = width, width_var
    T["first"] = T["top"] = N_ROAD
    T["stride"] = WITHOUT_ERROR
    for name in ("lasting_std", "lasting_s", "bearing_std", "bearing_s", "new_std", "new_s"):
        T[name] = 0.0
    T["party"]["slot"] = FREE
    T["party"]["begun"][EGO] = t
    T["choice"][:] = FREE
    T["choice"][0, EGO] = 0
    T["rest"][:] = 0.0
    T["log_w"][:] = 0.0
    T["habits"] = 1.0
    T["gone"][:] = T["bends"] = T["driven"] = 0.0
    T["party"]["told"] = T["party"]["ended"] = 0.0
    T["n_global"] = T["n"] = 1
    T["local"][0] = (0.0, 0.0, EGO, 0, 0, False)
    T["mean"][0] = 0.0
    T["odds"][0, 0] = 0.0


def expect_errors_(T: Any, errors: LastingErrors) -> None:
    """The sensor has lasting errors; said while nobody is followed yet."""
    T["first"] = T["top"] = BEARING + 1
    T["stride"] = WITH_ERROR
    T["lasting_std"], T["lasting_s"] = errors.std, errors.lasting_s
    T["bearing_std"], T["bearing_s"] = errors.bearing_std, errors.bearing_s
    T["new_std"], T["new_s"] = errors.new_std, errors.new_s
    T["P"][BEARING, BEARING] = errors.bearing_std**2


@numba.njit(nogil=True, cache=True, error_model="numpy")
def room(T: Any) -> int:  # pragma: no cover - compiled
    """How many vehicles can be followed."""
    return int(min((N - T.first) // T.stride, N_GUIDES))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def first_state(T: Any, g: int) -> int:  # pragma: no cover - compiled
    """Index of vehicle g's place; its rate follows, and its lasting error where there are such."""
    return int(T.first + T.stride * g)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def best_global(T: Any) -> int:  # pragma: no cover - compiled
    """Number of the likeliest global hypothesis."""
    best = 0
    for g in range(1, T.n_global):
        if T.log_w[g] > T.log_w[best]:
            best = g
    return best


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def seen(h: FloatArray, at: Any, m: int, state: FloatArray) -> float:  # pragma: no cover - compiled
    """h[:m] times the states at[:m].  In four sums: one would wait for itself."""
    a = b = c = d = 0.0
    i = 0
    while i + 4 <= m:
        a += h[i] * state[at[i]]
        b += h[i + 1] * state[at[i + 1]]
        c += h[i + 2] * state[at[i + 2]]
        d += h[i + 3] * state[at[i + 3]]
        i += 4
    while i < m:
        a += h[i] * state[at[i]]
        i += 1
    return (a + b) + (c + d)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def measure_(
    T: Any, m: int, z: float, r: float, who: int, gate: float
) -> bool:  # pragma: no cover - compiled
    """Update by one value z = h x + noise of variance r, in place.

    Args:
        T: record of `TRAFFIC_DTYPE`; the row is ``h[:m]`` for the states ``at[:m]``, and under the
            local hypothesis q of party ``who`` the value is ``shift[q]`` larger.
        who: `NOBODY` if no course changes what is expected.
        gate: a value whose squared normalised error is larger, whatever the party does, is none.

    Returns:
        False, and nothing changed, if it is none.
    """
    h, at, gain, error = T.h, T.at, T.gain, T.error
    x, P, mean, rest, local = T.x, T.P, T.mean, T.rest, T.local
    log_w, odds, choice = T.log_w, T.odds, T.choice
    n, top, n_global = T.n, T.top, T.n_global
    gain[:top] = 0.0
    e, s = z, r
    for a in range(m):
        c, w = at[a], h[a]
        e -= w * x[c]
        for i in range(top):
            gain[i] += w * P[c, i]
    for a in range(m):
        s += h[a] * gain[at[a]]
    whose, others = np.empty(n, np.int32), np.empty(N_PARTIES)
    for q in range(n):
        whose[q] = local[q].who
        error[q] = -seen(h, at, m, mean[q])
        if whose[q] == who:
            error[q] -= T.shift[q]
    errors = np.empty(N_GLOBAL)
    least = np.inf
    best = best_global(T)
    for g in range(n_global):
        v = e - seen(h, at, m, rest[g])
        for p in range(N_PARTIES):
            if choice[g, p] != FREE:
                v += error[choice[g, p]]
        errors[g] = v
        if log_w[g] > log_w[best] - LIKELY:
            least = min(least, v * v)
    if who != NOBODY:
        v = errors[best] - error[choice[best, who]]
        for q in range(n):
            if whose[q] == who and odds[best, q] > -LIKELY:
                least = min(least, (v + error[q]) ** 2)
    if not (s > 0.0 and least <= gate * s):
        return False
    precision = 1.0 / s
    for g in range(n_global):
        lost = min(errors[g] ** 2 * precision, MOST_LOST)
        log_w[g] -= 0.5 * lost
        for p in range(N_PARTIES):
            others[p] = errors[g]
            if choice[g, p] != FREE:
                others[p] -= error[choice[g, p]]
        for q in range(n):
            v = others[whose[q]] + error[q]
            v *= v * precision
            odds[g, q] -= 0.5 * ((v if v < MOST_LOST else MOST_LOST) - lost)
        v = -seen(h, at, m, rest[g]) * precision
        if v != 0.0:
            for i in range(top):
                rest[g, i] += gain[i] * v
    for q in range(n):
        if error[q] * error[q] > TINY * s:
            v = error[q] * precision
            for i in range(top):
                mean[q, i] += gain[i] * v
    for i in range(top):
        k = gain[i] * precision
        x[i] += k * e
        for j in range(i + 1):
            P[i, j] -= k * gain[j]
            P[j, i] = P[i, j]
    return True


LIKELY = 14.0
"""What is less likely than the best by this, as a logarithm, does not tell what an outlier is."""
TINY = 1e-7
"""A smaller squared normalised error moves no mean: most hypotheses have nothing to do with most
measurements."""
LEAST_SHARE = 1e-4
"""A hypothesis that is less probable does not count for the road."""
SPREADS = 0.01
"""Nor do within a global one that is less probable the differences between a party's courses count
for what is known of the road."""
ROAD_TRUST, ROAD_MEMORY = 0.5, 8.0
"""How bent roads usually are counts as much as what is seen of a road of the first length, and what
was seen counts for the second, both in units of how long the curvature stays the same."""
NEW_TIMES = 3.0
"""A track is new for so many times as long as its first error lasts."""
GONE_S = 300.0
"""So long it counts how vehicles have wandered that are followed no longer [s]."""
MOST_LOST = 40.0
"""A squared normalised error counts as this at most."""


@numba.njit(nogil=True, cache=True, error_model="numpy")
def carry_road_(rows: FloatArray, n: int, F: FloatArray) -> None:  # pragma: no cover - compiled
    """The road's states of the first n rows, in place, by the transition matrix F, which changes
    offset, heading and the sensor's error only."""
    for q in range(n):
        offset = heading = 0.0
        for j in range(N_ROAD):
            offset += F[OFFSET, j] * rows[q, j]
            heading += F[HEADING, j] * rows[q, j]
        rows[q, BIAS] *= F[BIAS, BIAS]
        rows[q, OFFSET], rows[q, HEADING] = offset, heading


@numba.njit(nogil=True, cache=True, error_model="numpy")
def carry_guide_(
    rows: FloatArray, n: int, a: int, f: tuple[float, float, float, float]
) -> None:  # pragma: no cover - compiled
    """Place and rate, states a and a + 1, of the first n rows, in place, by the transition f."""
    for q in range(n):
        place, rate = rows[q, a], rows[q, a + 1]
        rows[q, a] = f[0] * place + f[1] * rate
        rows[q, a + 1] = f[2] * place + f[3] * rate


@numba.njit(nogil=True, cache=True, error_model="numpy")
def forget_error_(T: Any, i: int, fade: float, come: float) -> None:  # pragma: no cover - compiled
    """``fade`` is left of a lasting error, state i, and its variance grows by what has ``come``; in
    place."""
    T.x[i] *= fade
    for q in range(T.n):
        T.mean[q, i] *= fade
    for g in range(T.n_global):
        T.rest[g, i] *= fade
    for j in range(T.top):
        T.P[i, j] *= fade
    for j in range(T.top):
        T.P[j, i] *= fade
    T.P[i, i] += come


@numba.njit(nogil=True, cache=True, error_model="numpy")
def pass_knot_(rows: FloatArray, n: int, memory: float) -> None:  # pragma: no cover - compiled
    """The ego passes the second knot: the first n rows forget the first one, and get another far
    ahead, where ``memory`` is left of the curvature of the one before; in place."""
    last = N_ROAD - 1
    for q in range(n):
        for i in range(KNOT, last):
            rows[q, i] = rows[q, i + 1]
        rows[q, last] = memory * rows[q, last - 1]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def learn_curvature_(T: Any, driven: float) -> None:  # pragma: no cover - compiled
    """Take in the curvature at the first knot, which the ego passes: ``driven`` sums up lengths of
    road, ``bends`` them times the squares of the curvature there [1/m²]; in place.

    Args:
        driven: since the knot before, in units of how long the curvature stays the same.
    """
    fade = math.exp(-driven / ROAD_MEMORY)
    T.driven = fade * T.driven + driven
    T.bends = fade * T.bends + driven * (T.x[KNOT] ** 2 + T.P[KNOT, KNOT])


@numba.njit(nogil=True, cache=True, error_model="numpy")
def usual_curvature(T: Any, par: FloatArray) -> float:  # pragma: no cover - compiled
    """Standard deviation of the road's curvature [1/m], by the road that was driven."""
    squares = ROAD_TRUST * par[P_CURVATURE_STD] ** 2 + T.bends
    return float(math.sqrt(squares / (ROAD_TRUST + T.driven)))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def predict_traffic_(
    T: Any, par: FloatArray, dt: float, t: float, speed: float, yaw_rate: float
) -> None:  # pragma: no cover - compiled
    """Move all on by ``dt`` seconds to time t [s], in place.

    Args:
        T: record of `TRAFFIC_DTYPE`.  par: `road.PARAMETERS`.
        speed, yaw_rate: of the ego [m/s, rad/s]; NaN where unknown.
    """
    x, P, F = T.x, T.P, T.F
    n, n_global, top = T.n, T.n_global, T.top
    known = speed == speed and yaw_rate == yaw_rate
    v = speed if speed == speed else USUAL_SPEED
    F[:] = 0.0
    for i in range(N_ROAD):
        F[i, i] = 1.0
    F[BIAS, BIAS] = math.exp(-dt / BIAS_TIME)
    F[OFFSET, HEADING] = v * dt
    turned = 0.0
    if known:
        bend_row_(F[OFFSET], x[WAY], v * dt, True)
        bend_row_(F[HEADING], x[WAY], v * dt, False)
        for i in range(KNOT, N_ROAD):
            F[OFFSET, i] = -F[OFFSET, i]
            F[HEADING, i] = -F[HEADING, i]
        F[OFFSET, BIAS] = -0.5 * v * dt * dt
        F[HEADING, BIAS] = -dt
        turned = yaw_rate * dt
    carry_road_(x.reshape(1, N), 1, F)
    x[HEADING] += turned
    x[OFFSET] += 0.5 * v * dt * turned
    carry_road_(T.mean, n, F)
    carry_road_(T.rest, n_global, F)
    carry_road_(P, top, F)
    carry_road_(P.T, top, F)
    yaw = par[P_YAW_NOISE] if known else par[P_YAW_NOISE_UNKNOWN]
    P[HEADING, HEADING] += yaw**2 * dt
    P[OFFSET, OFFSET] += par[P_DRIFT] ** 2 * dt
    P[BIAS, BIAS] += par[P_BIAS_STD] ** 2 * (1.0 - F[BIAS, BIAS] ** 2)
    come = 0.0
    if T.stride == WITH_ERROR:
        come = T.bearing_std**2 * (1.0 - math.exp(-2.0 * dt / T.bearing_s))
        forget_error_(T, BEARING, math.exp(-dt / T.bearing_s), come)
        come = T.lasting_std**2 * (1.0 - math.exp(-2.0 * dt / T.lasting_s))
    hurry = par[P_BESIDE_RATE]
    f = fading(hurry, dt)
    for g in range(N_GUIDES):
        if T.party[g].slot == FREE:
            continue
        a = first_state(T, g)
        if T.stride == WITH_ERROR:
            lasts = T.lasting_s
            if t - T.party[g].since < NEW_TIMES * T.new_s:
                lasts = T.new_s
            forget_error_(T, a + 2, math.exp(-dt / lasts), come)
        carry_guide_(x.reshape(1, N), 1, a, f)
        carry_guide_(T.mean, n, a, f)
        carry_guide_(T.rest, n_global, a, f)
        carry_guide_(P, top, a, f)
        carry_guide_(P.T, top, a, f)
        # what is lost of the stationary covariance comes anew
        beside = T.party[g].beside
        s00, s11 = beside**2, (hurry * beside) ** 2
        P[a, a] += s00 - f[0] * f[0] * s00 - f[1] * f[1] * s11
        P[a, a + 1] -= f[0] * f[2] * s00 + f[1] * f[3] * s11
        P[a + 1, a] = P[a, a + 1]
        P[a + 1, a + 1] += s11 - f[2] * f[2] * s00 - f[3] * f[3] * s11
    x[WAY] = max(x[WAY] + v * dt, 0.0)
    while x[WAY] >= SPACING:
        x[WAY] -= SPACING
        driven = SPACING / par[P_CURVATURE_LENGTH]
        learn_curvature_(T, driven)
        memory = math.exp(-driven)
        pass_knot_(x.reshape(1, N), 1, memory)
        pass_knot_(T.mean, n, memory)
        pass_knot_(T.rest, n_global, memory)
        pass_knot_(P, top, memory)
        pass_knot_(P.T, top, memory)
        last = N_ROAD - 1
        P[last, last] += usual_curvature(T, par) ** 2 * (1.0 - memory**2)
    drive_(T, par, dt, t, v, yaw_rate if known else np.nan)
    fade = math.exp(-dt / GONE_S)
    for k in range(N_USUAL):
        T.gone[k] *= fade


@numba.njit(nogil=True, cache=True, error_model="numpy")
def drive_(
    T: Any, par: FloatArray, dt: float, t: float, speed: float, yaw_rate: float
) -> None:  # pragma: no cover - compiled
    """How people drive, as measurements: the ego keeps to its course and along it, for a while at a
    time, and what it turns beside its course's bend is mostly the road's; in place.

    Args:
        dt: a habit lasts for so long as the parameters say, a measurement for so long [s].
        speed: of the ego [m/s].  yaw_rate: [rad/s], NaN where unknown.
    """
    h, at, local = T.h, T.at, T.local
    width = T.x[WIDTH]
    ours = local[T.choice[best_global(T), EGO]]
    lane, slope, bend = lane_at(ours, t)
    for habit in range(3):
        m = 1
        h[0] = 1.0
        if habit == 0:
            at[0] = HEADING
            z = slope * width / speed if speed > 0.0 else 0.0
            r = par[P_HEADING_STD] ** 2 * max(par[P_HEADING_TIME] / dt, 1.0)
        elif habit == 1:
            at[0] = OFFSET
            z = par[P_OFFSET] + lane * width
            r = par[P_OFFSET_STD] ** 2 * max(par[P_OFFSET_TIME] / dt, 1.0)
        else:
            if yaw_rate != yaw_rate:
                return
            z = yaw_rate - (bend * width / speed if speed > 0.0 else 0.0)
            r = par[P_TURN_STD] ** 2 * max(par[P_TURN_TIME] / dt, 1.0)
            m = turn_row_(T, speed)
        for q in range(T.n):
            if local[q].who == EGO:
                its_lane, its_slope, its_bend = lane_at(local[q], t)
                if habit == 1:
                    T.shift[q] = (lane - its_lane) * width
                elif not speed > 0.0:
                    T.shift[q] = 0.0
                elif habit == 0:
                    T.shift[q] = (slope - its_slope) * width / speed
                else:
                    T.shift[q] = (its_bend - bend) * width / speed
        measure_(T, m, z, r, EGO, np.inf)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def turn_row_(T: Any, speed: float) -> int:  # pragma: no cover - compiled
    """The row of what the yaw rate sensor says where the ego turns as the road does; its length."""
    here = T.x[WAY] / SPACING
    T.h[0], T.at[0] = 1.0, BIAS
    T.h[1], T.at[1] = speed * (1.0 - here), KNOT
    T.h[2], T.at[2] = speed * here, KNOT + 1
    return 3


@numba.njit(nogil=True, cache=True, error_model="numpy")
def turn_with_road_(
    T: Any, par: FloatArray, speed: float, yaw_rate: float
) -> None:  # pragma: no cover - compiled
    """The ego turns as the road does; in place."""
    if speed == speed and yaw_rate == yaw_rate:
        m = turn_row_(T, speed)
        measure_(T, m, yaw_rate, par[P_TURN_STD] ** 2, NOBODY, np.inf)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def shares_(
    T: Any, g: int, share: FloatArray, total: FloatArray
) -> None:  # pragma: no cover - compiled
    """How probable the local hypotheses are, given what all others do in global hypothesis g.

    Args:
        share: (N_LOCAL,) written.  total: (N_PARTIES, 2) scratch.
    """
    odds, local = T.odds, T.local
    total[:, 0] = -np.inf
    total[:, 1] = 0.0
    for q in range(T.n):
        total[local[q].who, 0] = max(total[local[q].who, 0], odds[g, q])
    for q in range(T.n):
        share[q] = math.exp(odds[g, q] - total[local[q].who, 0])
        total[local[q].who, 1] += share[q]
    for q in range(T.n):
        share[q] /= total[local[q].who, 1]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def global_weights_(T: Any, w: FloatArray) -> None:  # pragma: no cover - compiled
    """Probabilities (N_GLOBAL,) of the global hypotheses."""
    best = T.log_w[best_global(T)]
    total = 0.0
    for g in range(T.n_global):
        w[g] = math.exp(T.log_w[g] - best)
        total += w[g]
    for g in range(T.n_global):
        w[g] /= total


@numba.njit(nogil=True, cache=True, error_model="numpy")
def summarise_(T: Any, road: FloatArray, P: FloatArray) -> None:  # pragma: no cover - compiled
    """Mean (N_ROAD,) and covariance (N_ROAD, N_ROAD) of the road over all hypotheses."""
    w = np.empty(N_GLOBAL)
    means = np.zeros((N_GLOBAL, N_ROAD))
    part = np.empty((N_PARTIES, N_ROAD))
    share, total = T.error, np.empty((N_PARTIES, 2))
    global_weights_(T, w)
    P[:, :] = T.P[:N_ROAD, :N_ROAD]
    for g in range(T.n_global):
        if w[g] < LEAST_SHARE:
            w[g] = 0.0
            continue
        shares_(T, g, share, total)
        part[:, :] = 0.0
        spreads = w[g] >= SPREADS
        for q in range(T.n):
            if share[q] < LEAST_SHARE:
                continue
            who, mean = T.local[q].who, T.mean[q]
            for i in range(N_ROAD):
                part[who, i] += share[q] * mean[i]
            if not spreads:
                continue
            for i in range(N_ROAD):
                u = w[g] * share[q] * mean[i]
                for j in range(i + 1):
                    P[i, j] += u * mean[j]
        for i in range(N_ROAD):
            means[g, i] = T.rest[g, i]
        for p in range(N_PARTIES):
            if T.choice[g, p] == FREE:
                continue
            for i in range(N_ROAD):
                means[g, i] += part[p, i]
                if spreads:
                    for j in range(i + 1):
                        P[i, j] -= w[g] * part[p, i] * part[p, j]
    for i in range(N_ROAD):
        road[i] = 0.0
        for g in range(T.n_global):
            road[i] += w[g] * means[g, i]
    for i in range(N_ROAD):
        for j in range(i + 1):
            for g in range(T.n_global):
                P[i, j] += w[g] * (means[g, i] - road[i]) * (means[g, j] - road[j])
            P[j, i] = P[i, j]
    for i in range(N_ROAD):
        road[i] += T.x[i]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def change_lane_(T: Any, moved: int) -> None:  # pragma: no cover - compiled
    """The ego's lane is another one now, ``moved`` lanes to the left; in place."""
    T.x[OFFSET] -= moved * T.x[WIDTH]
    for q in range(T.n):
        T.mean[q, OFFSET] -= moved * T.mean[q, WIDTH]
        T.local[q].lane -= moved
    for g in range(T.n_global):
        T.rest[g, OFFSET] -= moved * T.rest[g, WIDTH]
    for p in range(N_GUIDES):
        if T.party[p].kept != NO_LANE:
            T.party[p].kept -= moved
    for i in range(T.top):
        T.P[OFFSET, i] -= moved * T.P[WIDTH, i]
    for i in range(T.top):
        T.P[i, OFFSET] -= moved * T.P[i, WIDTH]
