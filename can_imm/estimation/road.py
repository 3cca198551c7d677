"""The road ahead and the ego vehicle's place on it, from its own motion and from the traffic.

Lanes are measured against the ego vehicle, which itself wanders in its lane, changes it, and drives
through bends.  The state of the road:

    offset of the ego from the middle of its lane, to the left [m]
    heading of the ego against the lane, to the left [rad]
    error of the yaw rate sensor [rad/s]
    heading of the radar's axes against the vehicle's [rad]
    width of the lanes [m]
    how far the ego has come from the first knot [m], which is known
    curvature of the road at `N_KNOTS` knots, `SPACING` apart, to the left [1/m].

Between the knots the curvature is linear: the road is a chain of clothoids (Dickmanns and
Mysliwetz, 1992, have one).  The knots stand still on the ground; what the ego has passed is
forgotten, and beyond the last knot the next one is drawn from a curvature that forgets itself along
the road (a Gauss-Markov process).  The middle of lane k, counted from the ego's lane to the left,
is expected at

    y(x) = k width - offset - (heading + mounting) x + int_0^x (x - s) curvature(s) ds.

How it is learnt is told in `estimation.traffic`.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.types import FloatArray

OFFSET, HEADING, BIAS, MOUNTING, WIDTH, WAY, KNOT = range(7)
"""Indices of the state; `KNOT` is that of the first knot."""
N_KNOTS = 12
SPACING = 25.0
"""Between two knots [m].  The last one is at least 250 m ahead."""
N_ROAD = KNOT + N_KNOTS

PARAMETERS = (
    "width",
    "width_std",
    "offset",
    "offset_std",
    "offset_time",
    "heading_std",
    "heading_time",
    "turn_std",
    "turn_time",
    "curvature_std",
    "curvature_length",
    "bias_std",
    "mounting_std",
    "yaw_noise",
    "yaw_noise_unknown",
    "drift",
    "error_weight",
    "error_most",
    "speed_error_weight",
    "speed_error_most",
    "beside_std",
    "beside_spread",
    "beside_spread_all",
    "beside_margin",
    "beside_rate",
    "change_rate",
    "change_steady",
    "settle",
    "false_change",
)
"""Names of the parameters, in their order in the array.

``width``, ``offset`` and their standard deviations [m] before any traffic was seen; ``*_std`` of
heading [rad], turning against the road [rad/s], curvature [1/m], yaw rate error [rad/s] and
mounting [rad]: how large they get; ``*_time`` [s] and ``*_length`` [m]: how long they stay the
same; ``yaw_noise`` [rad/√s] of the heading from the yaw rate, and without it; ``drift`` [m/√s] of
the offset; ``*_weight``: by how much more the variances of this estimate count than those of white
noise, since its errors last; ``*_most`` [m, m/s]: no larger error is added to the measurements'
noise: however little is known of where the lanes are far ahead, that a vehicle moves across them is
seen.

For `estimation.traffic`: ``beside_std`` [m] of a vehicle's place beside its course,
``beside_spread`` of its logarithm among the vehicles of a drive, ``beside_spread_all`` from drive
to drive, ``beside_margin``: what was learnt of it counts times this, ``beside_rate`` [1/s]: how
fast such a place is forgotten; ``change_rate`` [1/s] of lane changes, ``change_steady``: how
probable it is that those of a drive are at a constant rate before any was seen, ``settle`` [s]: so
long after it a lane change may still turn out to be none; ``false_change`` [s]: what one that is
said and does not take place costs, see `relations.hesitate_`.
"""
(
    P_WIDTH, P_WIDTH_STD, P_OFFSET, P_OFFSET_STD, P_OFFSET_TIME, P_HEADING_STD, P_HEADING_TIME,
    P_TURN_STD, P_TURN_TIME, P_CURVATURE_STD, P_CURVATURE_LENGTH, P_BIAS_STD, P_MOUNTING_STD,
    P_YAW_NOISE, P_YAW_NOISE_UNKNOWN, P_DRIFT, P_ERROR_WEIGHT, P_ERROR_MOST,
    P_SPEED_ERROR_WEIGHT, P_SPEED_ERROR_MOST, P_BESIDE_STD, P_BESIDE_SPREAD,
    P_BESIDE_SPREAD_ALL, P_BESIDE_MARGIN, P_BESIDE_RATE,
    P_CHANGE_RATE, P_CHANGE_STEADY, P_SETTLE, P_FALSE_CHANGE,
) = range(len(PARAMETERS))  # fmt: skip

USUAL_SPEED = 25.0
"""Taken for the ego's where it is unknown [m/s]."""

BIAS_TIME = 120.0
"""How long the error of the yaw rate sensor stays the same [s]."""


def new_road(par: FloatArray) -> tuple[FloatArray, FloatArray]:
    """State (N_ROAD,) and covariance (N_ROAD, N_ROAD) before anything was seen."""
    x = np.zeros(N_ROAD)
    x[OFFSET], x[WIDTH] = par[P_OFFSET], par[P_WIDTH]
    P = np.zeros((N_ROAD, N_ROAD))
    for i, k in (
        (OFFSET, P_OFFSET_STD),
        (HEADING, P_HEADING_STD),
        (BIAS, P_BIAS_STD),
        (MOUNTING, P_MOUNTING_STD),
        (WIDTH, P_WIDTH_STD),
    ):
        P[i, i] = par[k] ** 2
    knots = SPACING * np.arange(N_KNOTS)
    apart = np.abs(knots[:, None] - knots)
    P[KNOT:, KNOT:] = par[P_CURVATURE_STD] ** 2 * np.exp(-apart / par[P_CURVATURE_LENGTH])
    return x, P


@numba.njit(nogil=True, cache=True, error_model="numpy")
def bend_row_(
    h: FloatArray, way: float, x: float, arm: bool
) -> None:  # pragma: no cover - compiled
    """Row h of the knots for the integral of the curvature from 0 to x [m] ahead of the ego.

    Args:
        way: state `WAY` [m].
        arm: the curvature counts times its distance from x: a lateral position, not a direction.
    """
    for i in range(KNOT, N_ROAD):
        h[i] = 0.0
    if x <= 0.0:
        return
    to = way + x
    for i in range(N_KNOTS):
        begin = max(i * SPACING, way)
        end = min((i + 1) * SPACING, to) if i < N_KNOTS - 1 else to
        if end <= begin:
            continue
        # Simpson's rule is exact: the curvature is linear here, and so is the arm
        for place in range(3):
            s = begin + 0.5 * place * (end - begin)
            weight = (4.0 if place == 1 else 1.0) * (end - begin) / 6.0
            if arm:
                weight *= to - s
            share = s / SPACING - i if i < N_KNOTS - 1 else 0.0
            h[KNOT + i] += (1.0 - share) * weight
            if share > 0.0:
                h[KNOT + i + 1] += share * weight


@numba.njit(nogil=True, cache=True, error_model="numpy")
def lane_row_(h: FloatArray, way: float, x: float) -> None:  # pragma: no cover - compiled
    """Row h (>= N_ROAD,): h @ state is the lateral position of the ego's lane at distance x [m].

    Args:
        way: state `WAY` [m].
    """
    h[OFFSET] = -1.0
    h[HEADING] = -x
    h[BIAS] = 0.0
    h[MOUNTING] = -x
    h[WIDTH] = 0.0
    h[WAY] = 0.0
    bend_row_(h, way, x, True)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def slope_row_(h: FloatArray, way: float, x: float) -> None:  # pragma: no cover - compiled
    """The derivative of `lane_row_` by x: direction of the road there [rad]."""
    h[OFFSET] = 0.0
    h[HEADING] = -1.0
    h[BIAS] = 0.0
    h[MOUNTING] = -1.0
    h[WIDTH] = 0.0
    h[WAY] = 0.0
    bend_row_(h, way, x, False)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def variance(P: FloatArray, h: FloatArray) -> float:  # pragma: no cover - compiled
    """h P h' of the road's states."""
    v = 0.0
    for i in range(N_ROAD):
        for j in range(N_ROAD):
            v += h[i] * P[i, j] * h[j]
    return v


@numba.njit(nogil=True, cache=True, error_model="numpy")
def value(x: FloatArray, h: FloatArray) -> float:  # pragma: no cover - compiled
    """h x of the road's states."""
    v = 0.0
    for i in range(N_ROAD):
        v += h[i] * x[i]
    return v


@numba.njit(nogil=True, cache=True, error_model="numpy")
def place(
    road: FloatArray, h: FloatArray, x: float, vx: float, speed: float
) -> tuple[float, float]:  # pragma: no cover - compiled
    """Lateral position and speed against the ego of a vehicle that follows the ego's lane.

    Args:
        road: (N_ROAD,) state.  h: (N_ROAD + 1,) scratch.
        x, vx: where it is ahead of the ego [m], and how much faster [m/s].
        speed: of the ego [m/s], NaN where unknown.
    """
    lane_row_(h, road[WAY], x)
    y = value(road, h)
    vy = 0.0
    if speed == speed:
        slope_row_(h, road[WAY], x)
        vy = (speed + vx) * value(road, h) + speed * road[MOUNTING]
    return y, vy


@numba.njit(nogil=True, cache=True, error_model="numpy")
def place_and_errors(
    road: FloatArray, P: FloatArray, h: FloatArray, x: float, vx: float, speed: float
) -> tuple[float, float, float, float]:  # pragma: no cover - compiled
    """What `place` says, and the variances of the lateral position [m²] and of the road's direction
    there [rad²]; the latter 0 where the ego's speed is unknown.

    Args:
        P: (N_ROAD, N_ROAD) covariance of the state.  The rest as of `place`.
    """
    lane_row_(h, road[WAY], x)
    y, of_place = value(road, h), variance(P, h)
    vy = of_direction = 0.0
    if speed == speed:
        slope_row_(h, road[WAY], x)
        vy = (speed + vx) * value(road, h) + speed * road[MOUNTING]
        of_direction = variance(P, h)
    return y, vy, of_place, of_direction


@numba.njit(nogil=True, cache=True, error_model="numpy")
def lane_middles(roads: FloatArray, x: FloatArray) -> FloatArray:  # pragma: no cover - compiled
    """Lateral positions (M,) [m] of the middle of the ego's lane at the distances x (M,) [m].

    Args:
        roads: (M, N_ROAD) a state of the road for each.
    """
    y = np.zeros(len(x))
    h = np.zeros(N_ROAD + 1)
    for k in range(len(x)):
        lane_row_(h, roads[k, WAY], x[k])
        y[k] = value(roads[k], h)
    return y


@numba.njit(nogil=True, cache=True, error_model="numpy")
def localise_(
    road: FloatArray,
    P: FloatArray,
    par: FloatArray,
    n: int,
    z: FloatArray,
    r: FloatArray,
    valid: Any,
    angle: FloatArray,
    speed: float,
) -> None:  # pragma: no cover - compiled
    """Measurements from the vehicle's axes to those of the road, in place.

    In the road's axes y counts from the middle of the ego's lane at the same distance, and vy is
    the speed across the lane.  The uncertainty of the road adds to the variances.

    Args:
        road: (N_ROAD,).  P: (N_ROAD, N_ROAD).  par: `PARAMETERS`.
        n: rows in use.  z, r: (rows, 4) values and variances.  valid: (rows, 4).
        angle: (rows,) [rad].
        speed: of the ego [m/s], NaN where unknown.
    """
    h = np.zeros(N_ROAD + 1)
    for k in range(n):
        if not valid[k, 0]:
            continue
        cos, sin = math.cos(angle[k]), math.sin(angle[k])
        x = z[k, 0] * cos - (z[k, 2] * sin if valid[k, 2] else 0.0)
        vx = z[k, 1] * cos if valid[k, 1] else 0.0
        if not (abs(x) < 1e4 and abs(vx) < 1e4):
            continue
        y, vy, of_place, of_direction = place_and_errors(road, P, h, x, vx, speed)
        error = par[P_ERROR_WEIGHT] * of_place
        error = min(error, par[P_ERROR_MOST] ** 2)
        z[k, 0] -= y * sin
        z[k, 2] -= y * cos
        r[k, 0] += error * sin * sin
        r[k, 2] += error * cos * cos
        if speed == speed:
            error = par[P_SPEED_ERROR_WEIGHT] * of_direction * (speed + vx) ** 2
            error = min(error, par[P_SPEED_ERROR_MOST] ** 2)
            z[k, 1] -= vy * sin
            z[k, 3] -= vy * cos
            r[k, 1] += error * sin * sin
            r[k, 3] += error * cos * cos
