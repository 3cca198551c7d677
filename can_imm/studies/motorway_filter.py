"""The filter under the rules of the study motorway: one per track, on a road made straight.

It is given lateral positions as they would be on a straight road: the road's curvature is the
low-passed yaw rate over the speed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from can_imm.studies.motorway_runs import MotorwayRun
from can_imm.types import VX, VY, BoolArray, FloatArray, IntArray, X, Y

LONGEST_GAP = 0.5
"""After a longer one an id names another object [s]."""
GATE = 36.0
"""Of the squared distance along one axis; what lies beyond begins a new track."""
VELOCITY_STD = (30.0, 1.0)
"""What is known of a new track's velocity without a measurement, along and across [m/s]."""
POSITION_STD = 1000.0
"""And of its position [m]."""
SLOWEST = 5.0
"""Below this speed of the ego the yaw rate says nothing about the road [m/s]."""
LEAST_TRAFFIC = 3
"""See `level`."""


class Frames(NamedTuple):
    """F rows of scans, in order of time within each run.

    Attributes:
        run: (F,) number of the run, ascending.
        t: (F,) [s].
        id: (F,).
        new: (F,) the sensor says that the id is new.
        z, std, valid: (F, 4) see `Scan`.
        angle: (F,) see `Scan` [rad].
        speed, yaw_rate: (F,) of the ego [m/s, rad/s], NaN where unknown.
    """

    run: IntArray
    t: FloatArray
    id: IntArray
    new: BoolArray
    z: FloatArray
    std: FloatArray
    valid: BoolArray
    angle: FloatArray
    speed: FloatArray
    yaw_rate: FloatArray


def frames_of(runs: Sequence[MotorwayRun]) -> Frames:
    """All rows of several runs."""

    def rows(name: str) -> npt.NDArray[Any]:
        return np.concatenate([getattr(scan, name)[: scan.n] for scan in scans])

    def of_scan(values: Sequence[float]) -> FloatArray:
        return np.repeat(np.array(values, np.float64), counts)

    scans = [scan for run in runs for scan in run.scans]
    counts = [scan.n for scan in scans]
    number = [k for k, run in enumerate(runs) for _ in run.scans]
    return Frames(
        run=np.repeat(np.array(number, np.int32), counts),
        t=of_scan([scan.t_ns * 1e-9 for scan in scans]),
        id=rows("ids"),
        new=rows("new"),
        z=rows("z"),
        std=rows("std"),
        valid=rows("valid"),
        angle=rows("angle"),
        speed=of_scan([scan.ego_speed for scan in scans]),
        yaw_rate=of_scan([scan.ego_yaw_rate for scan in scans]),
    )


@njit(cache=True)
def curvature_of(f: Frames, yaw_tau: float) -> FloatArray:
    """The road's curvature (F,) by the yaw rate [1/m]; 0 where the ego's motion is not known."""
    out = np.zeros(len(f.t))
    low = math.nan
    for k in range(len(f.t)):
        fresh = k == 0 or f.run[k] != f.run[k - 1]
        if fresh:
            low = math.nan
        if not (math.isnan(f.yaw_rate[k]) or math.isnan(f.speed[k])):
            if math.isnan(low):
                low = f.yaw_rate[k]
            elif not fresh and f.t[k] > f.t[k - 1]:
                low += (1.0 - math.exp(-(f.t[k] - f.t[k - 1]) / yaw_tau)) * (f.yaw_rate[k] - low)
            if f.speed[k] > SLOWEST:
                out[k] = low / f.speed[k]
    return out


@njit(cache=True)
def _bend(curvature: float, speed: float, x: float, vx: float, out: FloatArray) -> None:
    """What a bend adds to the state of an object at x, vx; ``out`` (4,) is overwritten."""
    turned = curvature * x
    v = speed + vx
    out[X] = 0.0
    out[VX] = -0.5 * v * turned**2
    out[Y] = 0.5 * curvature * x**2
    out[VY] = v * turned


@njit(cache=True)
def _predict(x: FloatArray, P: FloatArray, dt: float, q_along: float, q_across: float) -> None:
    """Constant velocity over ``dt``, in place."""
    for p, v, q in ((X, VX, q_along), (Y, VY, q_across)):
        x[p] += dt * x[v]
        for j in range(4):
            P[p, j] += dt * P[v, j]
        for i in range(4):
            P[i, p] += dt * P[i, v]
        P[p, p] += q * dt**3 / 3.0
        P[p, v] += q * dt**2 / 2.0
        P[v, p] += q * dt**2 / 2.0
        P[v, v] += q * dt


@njit(cache=True)
def _axes(c: int, angle: float, h: FloatArray) -> None:
    """Component ``c`` measured in turned axes is h @ state."""
    h[:] = 0.0
    along, across = math.cos(angle), math.sin(angle)
    if c < Y:
        h[c], h[c + Y] = along, across
    else:
        h[c], h[c - Y] = along, -across


@njit(cache=True)
def follow(
    f: Frames, q_along: float, q_across: float, curvature: FloatArray, keep_cov: bool
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """One constant-velocity Kalman filter per track.

    Args:
        curvature: (F,) [1/m].
        keep_cov: return covariances.

    Returns:
        Means (F, 4) as they would be on a straight road [m, m/s, m, m/s]; covariances (F, 4, 4), or
        (0, 4, 4); (F,) a track begins.
    """
    n = len(f.t)
    out = np.empty((n, 4))
    covs = np.empty((n if keep_cov else 0, 4, 4))
    begins = np.zeros(n, np.bool_)
    slots = f.id.max() + 1 if n else 0
    xs, Ps = np.zeros((slots, 4)), np.zeros((slots, 4, 4))
    last = np.full(slots, -np.inf)
    h, Ph, add = np.empty(4), np.empty(4), np.zeros(4)
    for k in range(n):
        if k and f.run[k] != f.run[k - 1]:
            last[:] = -np.inf
        i = f.id[k]
        x, P = xs[i], Ps[i]
        z, angle = f.z[k], f.angle[k]
        begin = f.new[k] or f.t[k] - last[i] > LONGEST_GAP
        if not begin:
            _predict(x, P, f.t[k] - last[i], q_along, q_across)
        last[i] = f.t[k]
        along, across = math.cos(angle), math.sin(angle)
        add[:] = 0.0
        if curvature[k] != 0.0:
            _bend(
                curvature[k], f.speed[k], along * z[X] - across * z[Y],
                along * z[VX] if f.valid[k, VX] else 0.0, add,
            )  # fmt: skip
        for _attempt in range(2):
            if begin:
                begins[k] = True
                x[:] = 0.0
                P[:] = 0.0
                P[X, X] = P[Y, Y] = POSITION_STD**2
                P[VX, VX], P[VY, VY] = VELOCITY_STD[0] ** 2, VELOCITY_STD[1] ** 2
            for c in range(4):
                if not f.valid[k, c]:
                    continue
                _axes(c, angle, h)
                nu, s = z[c], f.std[k, c] ** 2
                for a in range(4):
                    Ph[a] = 0.0
                    for b in range(4):
                        Ph[a] += P[a, b] * h[b]
                    nu -= h[a] * (x[a] + add[a])
                    s += h[a] * Ph[a]
                if not begin and c in (X, Y) and nu * nu > GATE * s:
                    begin = True
                    break
                for a in range(4):
                    x[a] += Ph[a] * nu / s
                    for b in range(4):
                        P[a, b] -= Ph[a] * Ph[b] / s
            if begins[k] or not begin:
                break
        out[k] = x
        if keep_cov:
            covs[k] = P
    return out, covs, begins


@njit(cache=True)
def bent(f: Frames, x: FloatArray, curvature: FloatArray) -> FloatArray:
    """States (F, 4) from those on a straight road."""
    out = x.copy()
    add = np.zeros(4)
    for k in range(len(x)):
        if curvature[k] != 0.0:
            _bend(curvature[k], f.speed[k], x[k, X], x[k, VX], add)
            out[k] += add
    return out


@njit(cache=True)
def level(f: Frames, x: FloatArray, common: float) -> FloatArray:
    """States (F, 4) turned by ``common`` times the median direction of the traffic in their scan.

    Scans with fewer than `LEAST_TRAFFIC` vehicles in our direction stay as they are.
    """
    out = x.copy()
    if common == 0.0:
        return out
    directions = np.empty(len(x))
    first = 0
    while first < len(x):
        end, n = first, 0
        while end < len(x) and f.run[end] == f.run[first] and f.t[end] == f.t[first]:
            v = f.speed[end] + x[end, VX]
            if v > SLOWEST:
                directions[n] = x[end, VY] / v
                n += 1
            end += 1
        if n >= LEAST_TRAFFIC:
            turn = common * np.median(directions[:n])
            for k in range(first, end):
                out[k, VY] -= turn * (f.speed[k] + x[k, VX])
                out[k, Y] -= turn * x[k, X]
        first = end
    return out
