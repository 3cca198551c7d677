"""The road ahead and the ego vehicle's place on it, from its own motion and from the traffic.

Lanes are measured against the ego vehicle, which itself wanders in its lane, changes it, and drives
through bends.  A Kalman filter keeps apart what the traffic does and what the ego does.  Its state:

    offset of the ego from the middle of its lane, to the left [m]
    heading of the ego against the lane, to the left [rad]
    curvature of the road at the ego, positive to the left [1/m], and its change along the road [1/m²]
    error of the yaw rate sensor [rad/s]
    heading of the radar's axes against the vehicle's [rad]
    width of the lanes [m]

The middle of lane k, counted from the ego's lane to the left, is expected at

    y(x) = k width - offset - (heading + mounting) x + curvature x²/2 + change x³/6.

The clothoid model is that of Dickmanns and Mysliwetz (1992); here the lanes are seen through the vehicles
that keep to them, whose wander in their lane counts as noise that lasts for seconds.
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

PARAMETERS = (
    "width",
    "width_std",
    "offset",
    "offset_std",
    "offset_time",
    "heading_std",
    "heading_time",
    "curvature_std",
    "curvature_length",
    "change_std",
    "change_length",
    "bias_std",
    "mounting_std",
    "yaw_noise",
    "yaw_noise_unknown",
    "drift",
    "wander_std",
    "wander_time",
    "error_weight",
)
"""Names of the parameters, in their order in the array.

``width``, ``offset`` and their standard deviations [m] before any traffic was seen; ``*_std`` of heading
[rad], curvature [1/m], its change [1/m²], yaw rate error [rad/s], mounting [rad]: how large they get;
``*_time`` [s] and ``*_length`` [m]: how long they stay the same; ``yaw_noise`` [rad/√s] of the heading
from the yaw rate, and without it; ``drift`` [m/√s] of the offset; ``wander_std`` [m] and
``wander_time`` [s] of a vehicle in its lane; ``error_weight`` by how much the variance of this
estimate counts more than that of white noise, since it stays for long.
"""
(
    P_WIDTH, P_WIDTH_STD, P_OFFSET, P_OFFSET_STD, P_OFFSET_TIME, P_HEADING_STD, P_HEADING_TIME,
    P_CURVATURE_STD, P_CURVATURE_LENGTH, P_CHANGE_STD, P_CHANGE_LENGTH, P_BIAS_STD, P_MOUNTING_STD,
    P_YAW_NOISE, P_YAW_NOISE_UNKNOWN, P_DRIFT, P_WANDER_STD, P_WANDER_TIME, P_ERROR_WEIGHT,
) = range(len(PARAMETERS))  # fmt: skip

USUAL_SPEED = 25.0
"""Taken for the ego's where it is unknown [m/s]."""

FAR = 180.0
"""Beyond this distance [m] the cubic says nothing any more: the road is taken to end there."""


def new_road(par: FloatArray) -> tuple[FloatArray, FloatArray]:
    """State (7,) and covariance (7, 7) before anything was seen."""
    x = np.zeros(N_ROAD)
    x[OFFSET], x[WIDTH] = par[P_OFFSET], par[P_WIDTH]
    std = [
        par[k]
        for k in (
            P_OFFSET_STD, P_HEADING_STD, P_CURVATURE_STD, P_CHANGE_STD, P_BIAS_STD,
            P_MOUNTING_STD, P_WIDTH_STD,
        )
    ]  # fmt: skip
    return x, np.diag(np.square(std))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def scalar_update_(
    x: FloatArray, P: FloatArray, h: FloatArray, z: float, r: float, gate: float
) -> bool:  # pragma: no cover - compiled
    """Kalman update of all states by one value z = h x + noise of variance r, in place.

    Returns:
        False, and nothing changed, if its squared normalised innovation is above ``gate``.
    """
    n = x.shape[0]
    e, s = z, r
    k = np.empty(N_ROAD)
    for i in range(n):
        e -= h[i] * x[i]
        v = 0.0
        for j in range(n):
            v += P[i, j] * h[j]
        k[i] = v
        s += h[i] * v
    if not (s > 0.0 and e * e <= gate * s):
        return False
    for i in range(n):
        x[i] += k[i] * e / s
    for i in range(n):
        for j in range(n):
            P[i, j] -= k[i] * k[j] / s
    for i in range(n):
        for j in range(i):
            v = 0.5 * (P[i, j] + P[j, i])
            P[i, j] = v
            P[j, i] = v
    return True


@numba.njit(nogil=True, cache=True, error_model="numpy")
def predict_road_(
    x: FloatArray, P: FloatArray, par: FloatArray, dt: float, speed: float, yaw_rate: float
) -> None:  # pragma: no cover - compiled
    """Move the ego on by ``dt`` seconds, in place.

    Args:
        x: (7,).  P: (7, 7).  par: `PARAMETERS`.
        speed, yaw_rate: of the ego [m/s, rad/s]; NaN where unknown.
    """
    known = speed == speed and yaw_rate == yaw_rate
    v = speed if speed == speed else USUAL_SPEED
    F = np.eye(N_ROAD)
    F[CURVATURE, CURVATURE] = math.exp(-abs(v) * dt / par[P_CURVATURE_LENGTH])
    F[CURVATURE, CHANGE] = v * dt
    F[CHANGE, CHANGE] = math.exp(-abs(v) * dt / par[P_CHANGE_LENGTH])
    turned = 0.0
    if known:
        F[OFFSET, HEADING] = v * dt
        F[OFFSET, CURVATURE] = -0.5 * v * v * dt * dt
        F[OFFSET, BIAS] = -0.5 * v * dt * dt
        F[HEADING, CURVATURE] = -v * dt
        F[HEADING, BIAS] = -dt
        turned = yaw_rate * dt
    y = F @ x
    y[HEADING] += turned
    y[OFFSET] += 0.5 * v * dt * turned
    x[:] = y
    P[:] = F @ P @ F.T
    yaw = par[P_YAW_NOISE] if known else par[P_YAW_NOISE_UNKNOWN]
    P[HEADING, HEADING] += yaw**2 * dt
    P[OFFSET, OFFSET] += par[P_DRIFT] ** 2 * dt
    if not known:
        P[OFFSET, OFFSET] += (par[P_HEADING_STD] * v) ** 2 * dt
    P[CURVATURE, CURVATURE] += (
        par[P_CURVATURE_STD] ** 2 * (1.0 - F[CURVATURE, CURVATURE] ** 2) * 0.1
    )
    P[CHANGE, CHANGE] += par[P_CHANGE_STD] ** 2 * (1.0 - F[CHANGE, CHANGE] ** 2)
    # The bias wanders by its own size in ten minutes.
    P[BIAS, BIAS] += par[P_BIAS_STD] ** 2 * dt / 600.0
    # A driver keeps to the lane and along it; slow, because he does so for a while at a time.
    h = np.zeros(N_ROAD)
    h[HEADING] = 1.0
    r = par[P_HEADING_STD] ** 2 * max(par[P_HEADING_TIME] / dt, 1.0)
    scalar_update_(x, P, h, 0.0, r, np.inf)
    h[HEADING] = 0.0
    h[OFFSET] = 1.0
    r = par[P_OFFSET_STD] ** 2 * max(par[P_OFFSET_TIME] / dt, 1.0)
    scalar_update_(x, P, h, par[P_OFFSET], r, np.inf)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def lane_row_(h: FloatArray, x: float, lane: float) -> None:  # pragma: no cover - compiled
    """Row h (7,) with h @ state = lateral position of the middle of a lane at distance x [m]."""
    far = min(max(x, 0.0), FAR)
    h[OFFSET] = -1.0
    h[HEADING] = -x
    h[CURVATURE] = far * (x - 0.5 * far)
    h[CHANGE] = 0.5 * far * far * (x - far / 1.5)
    h[BIAS] = 0.0
    h[MOUNTING] = -x
    h[WIDTH] = lane


@numba.njit(nogil=True, cache=True, error_model="numpy")
def slope_row_(h: FloatArray, x: float) -> None:  # pragma: no cover - compiled
    """The derivative of `lane_row_` by x: direction of the road there [rad]."""
    far = min(max(x, 0.0), FAR)
    h[OFFSET] = 0.0
    h[HEADING] = -1.0
    h[CURVATURE] = far
    h[CHANGE] = 0.5 * far * far
    h[BIAS] = 0.0
    h[MOUNTING] = -1.0
    h[WIDTH] = 0.0


@numba.njit(nogil=True, cache=True, error_model="numpy")
def variance(P: FloatArray, h: FloatArray) -> float:  # pragma: no cover - compiled
    """h P h'."""
    v = 0.0
    for i in range(N_ROAD):
        for j in range(N_ROAD):
            v += h[i] * P[i, j] * h[j]
    return v


@numba.njit(nogil=True, cache=True, error_model="numpy")
def place(
    road: FloatArray, h: FloatArray, x: float, vx: float, speed: float
) -> tuple[float, float]:  # pragma: no cover - compiled
    """Lateral position and lateral speed against the ego of a vehicle that follows the ego's lane.

    Args:
        road: (7,) state.  h: (7,) scratch.  x, vx: where it is ahead of the ego, and how much faster.
        speed: of the ego [m/s], NaN where unknown.
    """
    lane_row_(h, x, 0.0)
    y = 0.0
    for i in range(N_ROAD):
        y += h[i] * road[i]
    vy = 0.0
    if speed == speed:
        slope_row_(h, x)
        direction = 0.0
        for i in range(N_ROAD):
            direction += h[i] * road[i]
        vy = (speed + vx) * direction + speed * road[MOUNTING]
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

    In the road's axes y counts from the middle of the ego's lane at the same distance, and vy is the
    speed across the lane.  The uncertainty of the road adds to the variances.

    Args:
        road: (7,).  P: (7, 7).  par: `PARAMETERS`.
        n: rows in use.  z, r: (N, 4) values and variances.  valid: (N, 4).  angle: (N,) [rad].
        speed: of the ego [m/s], NaN where unknown.
    """
    h = np.zeros(N_ROAD)
    for k in range(n):
        if not valid[k, 0]:
            continue
        cos, sin = math.cos(angle[k]), math.sin(angle[k])
        x = z[k, 0] * cos - (z[k, 2] * sin if valid[k, 2] else 0.0)
        vx = z[k, 1] * cos if valid[k, 1] else 0.0
        if not abs(x) < 1e4:
            continue
        y, vy = place(road, h, x, vx, speed)
        lane_row_(h, x, 0.0)
        error = variance(P, h) * par[P_ERROR_WEIGHT]
        z[k, 0] -= y * sin
        z[k, 2] -= y * cos
        r[k, 0] += error * sin * sin
        r[k, 2] += error * cos * cos
        if speed == speed:
            slope_row_(h, x)
            error = variance(P, h) * par[P_ERROR_WEIGHT] * (speed + vx) ** 2
            z[k, 1] -= vy * sin
            z[k, 3] -= vy * cos
            r[k, 1] += error * sin * sin
            r[k, 3] += error * cos * cos


@numba.njit(nogil=True, cache=True, error_model="numpy")
def watch_traffic_(
    road: FloatArray,
    P: FloatArray,
    par: FloatArray,
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
    """Update the road by the vehicles that keep to their lanes, in place.

    Args:
        road, P, par: as for `localise_`.
        bank, objects: records of the mode bank and of the slots, after this scan's cycle.
        n: rows of the scan.  slot, status: (N,) as for `imm.process_scan_`.
        age: (capacity,) scans in which the slot's object was seen.
        z, r, valid, angle: (N, ...) the scan as it was measured.
        dt: since the scan before [s].

    Returns:
        By how many lanes the ego has moved to the left (+1, -1 or 0).  The road's offset and the
        objects' lateral positions have been changed accordingly.
    """
    h = np.zeros(N_ROAD)
    wander = par[P_WANDER_STD] ** 2 * max(par[P_WANDER_TIME] / dt, 1.0)
    for k in range(n):
        s = slot[k]
        if s < 0 or status[k] != 0 or age[s] < 5 or not (valid[k, 0] and valid[k, 2]):
            continue
        obj = objects[s]
        moving = 0.0
        for j in range(bank[0].n_modes):
            if bank[0].direction[j] != 0 or bank[0].off_lane[j] != 0:
                moving += obj.mu[j]
        width = road[WIDTH]
        lane = math.floor(obj.mean[2] / width + 0.5)
        if moving > 0.2 or abs(lane) > 6.0 or abs(obj.mean[2] - lane * width) > 0.3 * width:
            continue
        cos, sin = math.cos(angle[k]), math.sin(angle[k])
        x = z[k, 0] * cos - z[k, 2] * sin
        y = z[k, 0] * sin + z[k, 2] * cos
        if not 0.0 < x < FAR:
            continue
        lane_row_(h, x, lane)
        scalar_update_(road, P, h, y, wander + r[k, 2] * cos * cos + r[k, 0] * sin * sin, 9.0)
    moved = 0
    if road[OFFSET] > 0.5 * road[WIDTH]:
        moved = 1
    elif road[OFFSET] < -0.5 * road[WIDTH]:
        moved = -1
    if moved != 0:
        shift = moved * road[WIDTH]
        road[OFFSET] -= shift
        for s in range(objects.shape[0]):
            objects[s].mean[2] -= shift
            for j in range(bank[0].n_modes):
                objects[s].x[j, 2] -= shift
    return moved
