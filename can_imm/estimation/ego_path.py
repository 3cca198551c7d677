"""Where the road went, by hindsight: the ego has driven there meanwhile.

The ego's path by its speed and yaw rate, and its place in its lane, make the middle of a lane a
line on the ground; an object's place on the road is its distance from that line.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.types import FloatArray

STANDING = 0.5
"""Below this speed [m/s] the ego does not turn, whatever its yaw rate sensor says."""


@numba.njit(nogil=True, cache=True, error_model="numpy")
def reckon_(
    t: FloatArray, speed: FloatArray, yaw_rate: FloatArray, pose: FloatArray
) -> None:  # pragma: no cover - compiled
    """Dead reckoning from (0, 0, 0).

    Args:
        t, speed, yaw_rate: (K,) [s, m/s, rad/s].
        pose: (K, 3) written: x, y [m] and heading [rad].
    """
    pose[0] = 0.0
    for k in range(1, len(t)):
        dt = t[k] - t[k - 1]
        way = 0.5 * (speed[k] + speed[k - 1]) * dt
        turn = 0.5 * (yaw_rate[k] + yaw_rate[k - 1]) * dt if way > STANDING * dt else 0.0
        middle = pose[k - 1, 2] + 0.5 * turn
        pose[k, 0] = pose[k - 1, 0] + way * math.cos(middle)
        pose[k, 1] = pose[k - 1, 1] + way * math.sin(middle)
        pose[k, 2] = pose[k - 1, 2] + turn


@numba.njit(nogil=True, cache=True, error_model="numpy")
def project(
    line: FloatArray, station: FloatArray, at: int, x: float, y: float
) -> tuple[int, float, float, float]:  # pragma: no cover - compiled
    """A point against a line of straight pieces.

    Args:
        line: (N, 2) its points, no two alike.  station: (N,) way along it [m].
        at: where to begin the search.

    Returns:
        Number of the piece, station and distance to the left [m], direction of the line [rad].
    """
    last = len(line) - 2
    while True:
        dx, dy = line[at + 1, 0] - line[at, 0], line[at + 1, 1] - line[at, 1]
        length = station[at + 1] - station[at]
        along = ((x - line[at, 0]) * dx + (y - line[at, 1]) * dy) / length
        if along > length and at < last:
            at += 1
            continue
        if along < 0.0 and at > 0:
            # outside a corner a point is beyond one piece and before the next
            px, py = line[at, 0] - line[at - 1, 0], line[at, 1] - line[at - 1, 1]
            if (x - line[at, 0]) * px + (y - line[at, 1]) * py < 0.0:
                at -= 1
                continue
        across = ((y - line[at, 1]) * dx - (x - line[at, 0]) * dy) / length
        return at, station[at] + along, across, math.atan2(dy, dx)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def straighten_rows_(
    z: FloatArray,
    r: FloatArray,
    scan: Any,
    pose: FloatArray,
    speed: FloatArray,
    mounting: float,
    line: FloatArray,
    station: FloatArray,
    out: FloatArray,
) -> None:  # pragma: no cover - compiled
    """What was measured of one object, along and across the road.

    Args:
        z: (K, 4) in the sensor's axes.  r: (K, 4) variances, infinite where not measured.
        scan: (K,) the scan in which each was measured: row of ``pose`` (N, 3) and ``speed`` (N,).
        mounting: heading of the sensor's axes against the vehicle's [rad].
        line, station: the middle of lane 0, see `project`.
        out: (K, 4) written: way and speed along the road, distance from the line and speed across.
    """
    at = 0
    for k in range(len(z)):
        i = scan[k]
        heading = pose[i, 2] + mounting
        cos, sin = math.cos(heading), math.sin(heading)
        x = pose[i, 0] + cos * z[k, 0] - sin * z[k, 2]
        y = pose[i, 1] + sin * z[k, 0] + cos * z[k, 2]
        at, out[k, 0], out[k, 2], direction = project(line, station, at, x, y)
        turn = direction - heading
        known = r[k, 3] < np.inf
        along = speed[i] * math.cos(mounting) + z[k, 1]
        across = z[k, 3] - speed[i] * math.sin(mounting) if known else along * math.tan(turn)
        out[k, 1] = along * math.cos(turn) + across * math.sin(turn)
        out[k, 3] = across * math.cos(turn) - along * math.sin(turn)
