"""The road as the ego's motion tells it: where it drove later, or what its filter knew at the time.

Both kinds of road say where on it something was: `place` of K measurements of one object, each in
one of the scans of ``ego``, gives an array (K, 4) of way and speed along the road and of place and
speed across it [m, m/s], 0 in the middle of the lane in which the ego began its journey; and the
standard deviation (K,) of a vehicle's place beside the middle of its lane [m].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from can_imm.estimation import road
from can_imm.estimation.ego_path import reckon_, straighten_rows_
from can_imm.estimation.road import BIAS, MOUNTING, N_ROAD, OFFSET, WAY
from can_imm.road import LONGEST_S, RoadFrame
from can_imm.types import VX, VY, FloatArray, X, Y

Int64Array = npt.NDArray[np.int64]
Ego = npt.NDArray[Any]
"""Structured array of `EGO_DTYPE`, one record per scan."""

EGO_DTYPE = np.dtype(
    [
        ("t", np.float64),
        ("speed", np.float64),
        ("yaw_rate", np.float64),
        ("x", np.float64, (N_ROAD,)),
        ("P", np.float64, (N_ROAD, N_ROAD)),
        ("shift", np.float64),
        ("journey", np.int64),
    ],
    align=True,
)
"""``t`` [s]; ``speed``, ``yaw_rate`` of the ego [m/s, rad/s], NaN where unknown; ``x``, ``P`` of
`estimation.road`; ``shift`` by how much the ego's lane has moved to the left since the beginning
[m]; ``journey`` number of the stretch without long silences."""

BESIDE = 0.35
"""Standard deviation of vehicles' places beside the middle of their lanes [m]."""
DRIFT = 0.0035
"""And that of what is thought of the lanes' place, per metre ahead of the ego [m/m]."""
LEAST_STEP = 1.0
"""Points of the road's line are so far apart [m]."""
AHEAD: FloatArray = np.arange(4.0, 304.0, 4.0)
"""Beyond the ego's last place the line goes on for so long [m]."""
AHEAD_STDS = 0.002, 3e-4, 1.5e-6
"""How wrong the filter may be about the road ahead: direction [rad], curvature [1/m], and the
change of that [1/m²]."""
AHEAD_STEP_S = 0.5
"""Places of one vehicle in one such interval [s] count as one."""
AHEAD_STD = 0.25
"""Its standard deviation [m]."""


def ahead_rows(distance: FloatArray) -> FloatArray:
    """Rows (K, 3): place of the road at a distance ahead [m] by its direction and curvature."""
    return np.stack([distance, distance**2 / 2.0, distance**3 / 6.0], axis=1)


def ahead_cov(bends: float) -> FloatArray:
    """Covariance (3, 3) of what the filter has wrong about the road ahead, see `AHEAD_STDS`.

    Args:
        bends: standard deviation of the road's curvature [1/m]; less is wrong of a straight one.
    """
    direction, curvature, change = AHEAD_STDS
    share = min(bends / curvature, 1.0)
    return np.diag(np.square([direction, share * curvature, share * change]))


class RoadAtTheTime:
    """The road as the filter knew it in each scan.

    Args:
        ego: (N,) scans.  speed: (N,) of the ego [m/s], 0 where it is unknown.
    """

    def __init__(self, ego: Ego, speed: FloatArray) -> None:
        self._ego = ego
        self._speed = speed
        way = np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(ego["t"]))
        self._way: FloatArray = np.concatenate(([0.0], way))
        self._h: FloatArray = np.zeros(N_ROAD + 1)

    def lane(self, scan: Int64Array, x: FloatArray) -> FloatArray:
        """Where in scan k, at distance x [m], the ego's lane was taken to be [m]; (K,) each."""
        out = np.zeros(len(x))
        for k, i in enumerate(scan):
            road.lane_row_(self._h, self._ego["x"][i, WAY], x[k])
            out[k] = road.value(self._ego["x"][i], self._h)
        return out

    def place(
        self, scan: Int64Array, z: FloatArray, r: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """See the module's text.

        Args:
            scan: (K,) index of the scan.  z: (K, 4) x, vx, y, vy measured.  r: (K, 4) variances.
        """
        out, beside = z.copy(), np.zeros(len(z))
        out[:, X] += self._way[scan]
        out[:, VX] += self._speed[scan]
        for k, i in enumerate(scan):
            ego = self._ego[i]
            y, vy = road.place(ego["x"], self._h, z[k, X], z[k, VX], float(ego["speed"]))
            out[k, Y] += ego["shift"] - y
            out[k, VY] -= vy
            road.lane_row_(self._h, ego["x"][WAY], z[k, X])
            beside[k] = math.sqrt(BESIDE**2 + road.variance(ego["P"], self._h))
        return out, beside


class RoadDriven:
    """The road as the ego has driven it, and beyond its last place as the filter expects it.

    Args:
        ego: (N,) scans; the yaw rate is known.  speed: (N,) of the ego [m/s].
        correction: what to add ahead of the last scan: direction [rad], curvature [1/m] and change
            of that [1/m²].
        cov: (3, 3) its covariance.
    """

    def __init__(
        self, ego: Ego, speed: FloatArray, correction: FloatArray, cov: FloatArray
    ) -> None:
        self._speed = speed
        self._cov = cov
        self._mounting = float(ego["x"][-1, MOUNTING])
        pose = np.zeros((len(ego), 3))
        reckon_(ego["t"].copy(), speed, ego["yaw_rate"] - ego["x"][-1, BIAS], pose)
        self._pose = pose
        offset = (ego["x"][:, OFFSET] + ego["shift"])[:, None]
        line = pose[:, :2] + offset * np.stack([np.sin(pose[:, 2]), -np.cos(pose[:, 2])], axis=1)
        way = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(pose[:, :2], axis=0).T))))
        kept = np.searchsorted(way, np.arange(0.0, way[-1], LEAST_STEP))
        line = line[np.unique(np.append(kept, len(way) - 1))]
        last = np.full(len(AHEAD), len(ego) - 1)
        across = RoadAtTheTime(ego, speed).lane(last, AHEAD) - ego["shift"][-1]
        across += self._mounting * AHEAD + ahead_rows(AHEAD) @ correction
        cos, sin = math.cos(pose[-1, 2]), math.sin(pose[-1, 2])
        ahead = np.stack([cos * AHEAD - sin * across, sin * AHEAD + cos * across], axis=1)
        self._line = np.concatenate((line, pose[-1, :2] + ahead))
        steps = np.hypot(*np.diff(self._line, axis=0).T)
        self._station: FloatArray = np.concatenate(([0.0], np.cumsum(steps)))

    def straighten(self, scan: Int64Array, z: FloatArray, r: FloatArray) -> FloatArray:
        """What `place` gives first."""
        out = np.zeros_like(z)
        straighten_rows_(
            z, r, scan, self._pose, self._speed, self._mounting, self._line, self._station, out
        )
        return out

    def beyond(self, way: FloatArray) -> FloatArray:
        """How far ways (K,) along the road lie beyond the ego's last place [m], 0 for the rest."""
        return np.asarray(np.maximum(way - self._station[-len(AHEAD) - 1], 0.0))

    def place(
        self, scan: Int64Array, z: FloatArray, r: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """See the module's text.

        Args:
            scan: (K,) index of the scan.  z: (K, 4) x, vx, y, vy measured.  r: (K, 4) variances.
        """
        out = self.straighten(scan, z, r)
        rows = ahead_rows(self.beyond(out[:, X]))
        error = np.einsum("ki,ij,kj->k", rows, self._cov, rows)
        beside: FloatArray = np.sqrt(BESIDE**2 + (DRIFT * z[:, X]) ** 2 + error)
        return out, beside


def learn_ahead(
    distances: Sequence[FloatArray], places: Sequence[FloatArray], cov: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What is wrong about the road ahead, by the vehicles that drive there.

    A vehicle's place on the road rarely changes: what the places of most of them do alike, the
    road has done.  Least squares with weights after Cauchy, for vehicles that do change lanes.

    Args:
        distances, places: of each vehicle (K,): how far beyond the ego's last place it was [m], and
            where across the road [m].

    Returns:
        Correction (3,) and its covariance (3, 3), see `RoadDriven`.
    """
    count = [len(one) for one in places]
    n = len(count)
    own = np.repeat(np.eye(n), count, axis=0)
    design = np.concatenate((ahead_rows(np.concatenate(distances)), own), axis=1)
    y = np.concatenate(places)
    prior = np.zeros((3 + n, 3 + n))
    prior[:3, :3] = np.linalg.inv(cov)
    x = np.zeros(3 + n)
    x[3:] = [np.median(one) for one in places]
    for _ in range(10):
        weight = 1.0 / (1.0 + np.square((y - design @ x) / AHEAD_STD))
        weighted = design.T * weight / AHEAD_STD**2
        left: FloatArray = np.asarray(np.linalg.inv(weighted @ design + prior), np.float64)
        x = left @ weighted @ y
    return x[:3], left[:3, :3]


class EgoHistory:
    """The ego's motion, and what its filter thought of the road, scan by scan."""

    def __init__(self) -> None:
        self._scans: Ego = np.zeros(256, EGO_DTYPE)
        self._base = 0  # scans that were forgotten
        self._n = 0

    @property
    def end(self) -> int:
        """Number of scans so far."""
        return self._base + self._n

    def add(self, t: float, frame: RoadFrame, shift: float) -> int:
        """Remember a scan.

        Args:
            t: [s].  frame: of the road, as it is after the scan.  shift: see `EGO_DTYPE`.

        Returns:
            The number of the scan.
        """
        k = self._n
        if k == len(self._scans):
            self._scans = np.concatenate((self._scans, np.zeros_like(self._scans)))
        ego = self._scans[k]
        ego["t"] = t
        ego["speed"], ego["yaw_rate"] = frame.speed, frame.yaw_rate
        ego["x"], ego["P"] = frame.x, frame.P
        ego["shift"] = shift
        ego["journey"] = 0
        if k > 0:
            before = self._scans[k - 1]
            ego["journey"] = before["journey"] + (t - before["t"] > LONGEST_S)
        self._n = k + 1
        return self.end - 1

    def forget(self, scan: int) -> None:
        """Nothing will be asked of what was before this scan."""
        count = scan - self._base
        if 2 * count >= len(self._scans):
            self._scans[: self._n - count] = self._scans[count : self._n].copy()
            self._n -= count
            self._base = scan

    def journey(self, first: int, last: int, longer_s: float) -> Ego:
        """Scans from ``first`` on to so long after ``last`` [s], in the same journey as that."""
        scans = self._scans[first - self._base : self._n]
        at = scans[last - first]
        there = (scans["t"] <= at["t"] + longer_s) & (scans["journey"] == at["journey"])
        return scans[: int(np.flatnonzero(there)[-1]) + 1]

    def since(self, longer_s: float) -> int:
        """The first scan that is no longer ago than this [s] and in the last journey."""
        scans = self._scans[: self._n]
        there = (scans["t"] >= scans["t"][-1] - longer_s) & (
            scans["journey"] == scans["journey"][-1]
        )
        return self._base + int(np.flatnonzero(there)[0])
