"""The road ahead and the ego vehicle's place on it, from its own motion and from the traffic.

Lanes are measured against the ego vehicle, which itself wanders in its lane, changes it, and drives
through bends.  One Kalman filter keeps apart what the road, the ego and the others do.  Its state:

    offset of the ego from the middle of its lane, to the left [m]
    heading of the ego against the lane, to the left [rad]
    curvature of the road at the ego, to the left [1/m], and its change along the road [1/m²]
    error of the yaw rate sensor [rad/s]
    heading of the radar's axes against the vehicle's [rad]
    width of the lanes [m]
    and for each of up to `N_GUIDES` vehicles its lateral place on the road [m].

The middle of lane k, counted from the ego's lane to the left, is expected at

    y(x) = k width - offset - (heading + mounting) x + curvature x²/2 + change x³/6

(the clothoid of Dickmanns and Mysliwetz, 1992).  The vehicles' places hardly change, and in the
long run they are the middles of lanes; what all of them do at once the road or the ego has done.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.types import FloatArray

OFFSET, HEADING, CURVATURE, CHANGE, BIAS, MOUNTING, WIDTH = range(7)
"""Indices of the state."""
N_ROAD = 7
N_GUIDES = 24
"""Most vehicles that the road is seen by."""
N = N_ROAD + N_GUIDES

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
    "change_std",
    "change_length",
    "far_curvature",
    "bias_std",
    "mounting_std",
    "yaw_noise",
    "yaw_noise_unknown",
    "drift",
    "wander_std",
    "wander_time",
    "freedom",
    "freedom_changing",
    "error_weight",
    "error_most",
    "speed_error_weight",
    "speed_error_most",
    "doubtful",
    "unrest_change",
    "unrest_curvature",
)
"""Names of the parameters, in their order in the array.

``width``, ``offset`` and their standard deviations [m] before any traffic was seen; ``*_std`` of
heading [rad], turning against the road [rad/s], curvature [1/m], its change [1/m²], yaw rate error
[rad/s] and mounting [rad]: how large they get; ``*_time`` [s] and ``*_length`` [m]: how long they
stay the same; ``yaw_noise`` [rad/√s] of the heading from the yaw rate, and without it; ``drift``
[m/√s] of the offset; ``wander_std`` [m] and ``wander_time`` [s] of a vehicle in its lane;
``freedom`` [m/√s] of its place, and while it changes lanes; ``far_curvature`` [1/m]: how
differently the road may bend beyond `FAR`; ``*_weight``: by how much more the variances of this
estimate count than those of white noise, since its errors last;
``*_most`` [m, m/s]: no larger error is added to the measurements' noise: however little is known of
where the lanes are far ahead, that a vehicle moves across them is seen; ``doubtful`` [m]: see
`reporting.doubt_`; ``unrest_*`` [1/m²/√s, 1/m/√s]: see `follow_bend_`.
"""
(
    P_WIDTH, P_WIDTH_STD, P_OFFSET, P_OFFSET_STD, P_OFFSET_TIME, P_HEADING_STD, P_HEADING_TIME,
    P_TURN_STD, P_TURN_TIME, P_CURVATURE_STD, P_CURVATURE_LENGTH, P_CHANGE_STD, P_CHANGE_LENGTH,
    P_FAR_CURVATURE, P_BIAS_STD, P_MOUNTING_STD, P_YAW_NOISE, P_YAW_NOISE_UNKNOWN, P_DRIFT,
    P_WANDER_STD, P_WANDER_TIME, P_FREEDOM, P_FREEDOM_CHANGING, P_ERROR_WEIGHT, P_ERROR_MOST,
    P_SPEED_ERROR_WEIGHT, P_SPEED_ERROR_MOST, P_DOUBTFUL, P_UNREST_CHANGE, P_UNREST_CURVATURE,
) = range(len(PARAMETERS))  # fmt: skip

USUAL_SPEED = 25.0
"""Taken for the ego's where it is unknown [m/s]."""

FAR = 100.0
"""Beyond this distance [m] the curvature is taken to change no more."""

BIAS_TIME = 120.0
"""How long the error of the yaw rate sensor stays the same [s]."""

FREE = -1
"""Entry of ``guide_slot`` that is not in use."""


def new_road(par: FloatArray) -> tuple[FloatArray, FloatArray]:
    """State (31,) and covariance (31, 31) before anything was seen."""
    x = np.zeros(N)
    x[OFFSET], x[WIDTH] = par[P_OFFSET], par[P_WIDTH]
    std = np.zeros(N)
    std[:N_ROAD] = [
        par[k]
        for k in (
            P_OFFSET_STD, P_HEADING_STD, P_CURVATURE_STD, P_CHANGE_STD, P_BIAS_STD,
            P_MOUNTING_STD, P_WIDTH_STD,
        )
    ]  # fmt: skip
    return x, np.diag(np.square(std))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def scalar_update_(
    x: FloatArray, P: FloatArray, h: FloatArray, g: int, z: float, r: float, gate: float
) -> bool:  # pragma: no cover - compiled
    """Kalman update by one value z = h x + noise of variance r, in place.

    Args:
        x: (31,).  P: (31, 31).  h: (8,) row: the road's states, and that of guide g.
        g: number of the guide, `FREE` for none.

    Returns:
        False, and nothing changed, if its squared normalised innovation is above ``gate``.
    """
    e, s = z, r
    k = np.zeros(N)
    for j in range(N_ROAD + 1):
        c = j if j < N_ROAD else N_ROAD + g
        if h[j] == 0.0 or (j == N_ROAD and g < 0):
            continue
        e -= h[j] * x[c]
        for i in range(N):
            k[i] += P[i, c] * h[j]
    for j in range(N_ROAD + 1):
        if j < N_ROAD or g >= 0:
            s += h[j] * k[j if j < N_ROAD else N_ROAD + g]
    if not (s > 0.0 and e * e <= gate * s):
        return False
    for i in range(N):
        if k[i] == 0.0:
            continue
        x[i] += k[i] * e / s
        for j in range(i + 1):
            v = P[i, j] - k[i] * k[j] / s
            P[i, j] = v
            P[j, i] = v
    return True


@numba.njit(nogil=True, cache=True, error_model="numpy")
def predict_road_(
    x: FloatArray, P: FloatArray, par: FloatArray, dt: float, speed: float, yaw_rate: float
) -> None:  # pragma: no cover - compiled
    """Move the ego on by ``dt`` seconds, in place.

    Args:
        x: (31,).  P: (31, 31).  par: `PARAMETERS`.
        speed, yaw_rate: of the ego [m/s, rad/s]; NaN where unknown.
    """
    known = speed == speed and yaw_rate == yaw_rate
    v = speed if speed == speed else USUAL_SPEED
    F = np.eye(N_ROAD)
    F[CURVATURE, CURVATURE] = math.exp(-abs(v) * dt / par[P_CURVATURE_LENGTH])
    F[CURVATURE, CHANGE] = v * dt
    F[CHANGE, CHANGE] = math.exp(-abs(v) * dt / par[P_CHANGE_LENGTH])
    F[BIAS, BIAS] = math.exp(-dt / BIAS_TIME)
    F[OFFSET, HEADING] = v * dt
    turned = 0.0
    if known:
        F[OFFSET, CURVATURE] = -0.5 * v * v * dt * dt
        F[OFFSET, BIAS] = -0.5 * v * dt * dt
        F[HEADING, CURVATURE] = -v * dt
        F[HEADING, BIAS] = -dt
        turned = yaw_rate * dt
    y = np.zeros(N_ROAD)
    for i in range(N_ROAD):
        for j in range(N_ROAD):
            y[i] += F[i, j] * x[j]
    y[HEADING] += turned
    y[OFFSET] += 0.5 * v * dt * turned
    x[:N_ROAD] = y
    P[:N_ROAD, :] = F @ P[:N_ROAD, :].copy()
    P[:, :N_ROAD] = P[:, :N_ROAD].copy() @ F.T
    yaw = par[P_YAW_NOISE] if known else par[P_YAW_NOISE_UNKNOWN]
    P[HEADING, HEADING] += yaw**2 * dt
    P[OFFSET, OFFSET] += par[P_DRIFT] ** 2 * dt
    P[CURVATURE, CURVATURE] += (
        par[P_CURVATURE_STD] ** 2 * (1.0 - F[CURVATURE, CURVATURE] ** 2) * 0.1
    )
    P[CHANGE, CHANGE] += par[P_CHANGE_STD] ** 2 * (1.0 - F[CHANGE, CHANGE] ** 2)
    P[BIAS, BIAS] += par[P_BIAS_STD] ** 2 * (1.0 - F[BIAS, BIAS] ** 2)
    # A driver keeps to the lane and along it, for a while at a time; what the ego turns is mostly
    # the road's bend.
    h = np.zeros(N_ROAD + 1)
    h[HEADING] = 1.0
    r = par[P_HEADING_STD] ** 2 * max(par[P_HEADING_TIME] / dt, 1.0)
    scalar_update_(x, P, h, FREE, 0.0, r, np.inf)
    h[HEADING] = 0.0
    h[OFFSET] = 1.0
    r = par[P_OFFSET_STD] ** 2 * max(par[P_OFFSET_TIME] / dt, 1.0)
    scalar_update_(x, P, h, FREE, par[P_OFFSET], r, np.inf)
    if known:
        turn_with_road_(x, P, par, speed, yaw_rate, max(par[P_TURN_TIME] / dt, 1.0))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def turn_with_road_(
    x: FloatArray, P: FloatArray, par: FloatArray, speed: float, yaw_rate: float, weight: float
) -> None:  # pragma: no cover - compiled
    """The ego turns as the road does, with ``weight`` times the usual variance; in place."""
    if speed == speed and yaw_rate == yaw_rate:
        h = np.zeros(N_ROAD + 1)
        h[BIAS] = 1.0
        h[CURVATURE] = speed
        scalar_update_(x, P, h, FREE, yaw_rate, par[P_TURN_STD] ** 2 * weight, np.inf)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def lane_row_(h: FloatArray, x: float) -> None:  # pragma: no cover - compiled
    """Row h (>= 7,): h @ state is the lateral position of the ego's lane at distance x [m]."""
    far = min(max(x, 0.0), FAR)
    h[OFFSET] = -1.0
    h[HEADING] = -x
    beyond = max(x, 0.0) - far
    h[CURVATURE] = 0.5 * (far + beyond) ** 2
    h[CHANGE] = far * (far * far / 6.0 + 0.5 * beyond * (far + beyond))
    h[BIAS] = 0.0
    h[MOUNTING] = -x
    h[WIDTH] = 0.0


@numba.njit(nogil=True, cache=True, error_model="numpy")
def slope_row_(h: FloatArray, x: float) -> None:  # pragma: no cover - compiled
    """The derivative of `lane_row_` by x: direction of the road there [rad]."""
    far = min(max(x, 0.0), FAR)
    h[OFFSET] = 0.0
    h[HEADING] = -1.0
    beyond = max(x, 0.0) - far
    h[CURVATURE] = far + beyond
    h[CHANGE] = far * (0.5 * far + beyond)
    h[BIAS] = 0.0
    h[MOUNTING] = -1.0
    h[WIDTH] = 0.0


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
        road: (31,) state.  h: (8,) scratch.
        x, vx: where it is ahead of the ego [m], and how much faster [m/s].
        speed: of the ego [m/s], NaN where unknown.
    """
    lane_row_(h, x)
    y = value(road, h)
    vy = 0.0
    if speed == speed:
        slope_row_(h, x)
        vy = (speed + vx) * value(road, h) + speed * road[MOUNTING]
    return y, vy


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
        road: (31,).  P: (31, 31).  par: `PARAMETERS`.
        n: rows in use.  z, r: (N, 4) values and variances.  valid: (N, 4).  angle: (N,) [rad].
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
        y, vy = place(road, h, x, vx, speed)
        lane_row_(h, x)
        # Further on the road may bend in another way.
        beyond = max(x - FAR, 0.0)
        bend = 0.5 * par[P_FAR_CURVATURE] * beyond**2
        error = par[P_ERROR_WEIGHT] * (variance(P, h) + bend**2)
        error = min(error, par[P_ERROR_MOST] ** 2)
        z[k, 0] -= y * sin
        z[k, 2] -= y * cos
        r[k, 0] += error * sin * sin
        r[k, 2] += error * cos * cos
        if speed == speed:
            slope_row_(h, x)
            bend = par[P_FAR_CURVATURE] * beyond
            error = par[P_SPEED_ERROR_WEIGHT] * (variance(P, h) + bend**2) * (speed + vx) ** 2
            error = min(error, par[P_SPEED_ERROR_MOST] ** 2)
            z[k, 1] -= vy * sin
            z[k, 3] -= vy * cos
            r[k, 1] += error * sin * sin
            r[k, 3] += error * cos * cos
