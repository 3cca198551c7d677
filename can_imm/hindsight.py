"""What each object did, by hindsight: labels of a recording on the road that the ego drove later.

The road is where the ego's own path went (`estimation.ego_path`); across it, whole lane changes are
weighed against keeping the lane (`estimation.lane_changes`), along it, paths of the speed are drawn
(`estimation.speed_paths`).  Where the ego's motion is not known, the road is that of the detector's
filter at the time.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from can_imm.estimation import road
from can_imm.estimation.ego_path import reckon_, straighten_rows_
from can_imm.estimation.lane_changes import find_lane_changes_
from can_imm.estimation.noise import noise_state
from can_imm.estimation.road import BIAS, MOUNTING, N_ROAD, OFFSET, WIDTH
from can_imm.estimation.speed_paths import draw_speeds_, judge_speeds_
from can_imm.reporting import decide_, rear_end_share
from can_imm.road import LONGEST_S, RoadFrame
from can_imm.smoothing_rows import COASTING, Rows
from can_imm.types import FloatArray, IntArray, Manoeuvre, X, Y

LOOK_AHEAD_S = 10.0
"""A track's road is known when the ego has driven on for so long [s]."""
N_PATHS = 64
"""Paths of the speed that are drawn for each object."""
BESIDE = 0.2
"""Standard deviation of vehicles' places beside the middle of their lanes [m]."""
DRIFT = 0.0017
"""And that of what is thought of the lanes' place, per metre ahead of the ego [m/m]."""
EGO_SPEED_STD = 0.06
"""Of the ego's speed as the bus tells it [m/s]."""
LEAST_STEP = 1.0
"""Points of the road's line are so far apart [m]."""
LINE_END, LINE_STEP = 300.0, 4.0
"""Beyond the ego's last place the road is that of the filter, up to here [m]."""
OURS = 0.01
"""An object that is not in our direction with less than this probability is labelled."""

_LANE_CHANGE = int(Manoeuvre.LANE_CHANGE)
_APPROACHING = int(Manoeuvre.APPROACHING)
_REAR_END = int(Manoeuvre.REAR_END)
_RECEDING = int(Manoeuvre.RECEDING)
_KEEP_LANE = int(Manoeuvre.KEEP_LANE)
_STATIONARY = int(Manoeuvre.STATIONARY)
_ONCOMING = int(Manoeuvre.ONCOMING)

_EGO_DTYPE = np.dtype(
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


@numba.njit(nogil=True, cache=True, error_model="numpy")
def label_(
    bank: Any, width: float, p: FloatArray, lateral: FloatArray, reports: Any
) -> None:  # pragma: no cover - compiled
    """Probabilities of a track's reports by what is known of its lane changes and its speed.

    Args:
        bank: (1,) records.  width: of the lanes [m].
        p: (K, 4) of a lane change to the left, to the right, of receding, of approaching.
        lateral: (K,) place on the road [m], 0 in the middle of the ego's lane.
        reports: (K,) in place; they keep what they say of objects not in our direction.
    """
    for k in range(len(reports)):
        report = reports[k]
        ours = 1.0 - report.p[_STATIONARY] - report.p[_ONCOMING]
        change = min(p[k, 0] + p[k, 1], 1.0)
        keep = 1.0 - change
        near = rear_end_share(bank[0].rear_end_gap, width, report.x[X], lateral[k], report.cov)
        for i in range(len(report.p)):
            if i != _STATIONARY and i != _ONCOMING:
                report.p[i] = 0.0
        report.p[_LANE_CHANGE] = ours * change
        report.p[_RECEDING] = ours * keep * p[k, 2]
        report.p[_APPROACHING] = ours * keep * p[k, 3] * (1.0 - near)
        report.p[_REAR_END] = ours * keep * p[k, 3] * near
        report.p[_KEEP_LANE] = ours * keep * (1.0 - p[k, 2] - p[k, 3])
        report.direction = 0
        if decide_(report) == _LANE_CHANGE:
            report.direction = 1 if p[k, 0] > p[k, 1] else -1
        report.lane = min(max(math.floor(lateral[k] / width + 0.5), -100), 100)


class Hindsight:
    """Remembers the ego's motion and what its filter thought of the road, scan by scan.

    Args:
        bank: (1,) record of `layout.BANK_DTYPE`.
        par: `estimation.road.PARAMETERS`.
    """

    def __init__(self, bank: Any, par: FloatArray) -> None:
        self._bank = bank
        self._par = par
        self._step_s = float(bank["step_s"][0])
        self._ego = np.zeros(256, _EGO_DTYPE)
        self._base = 0  # scans that were forgotten
        self._n = 0
        self._noise = noise_state(np.random.default_rng(0))
        self._h: FloatArray = np.zeros(N_ROAD + 1)

    def add(self, now: int, frame: RoadFrame, shift: float) -> int:
        """Remember a scan.

        Args:
            now: number of its step.
            frame: of the road, as it is after the scan.
            shift: by how much the ego's lane has moved to the left since the beginning [m].

        Returns:
            The number of the scan.
        """
        if self._n == len(self._ego):
            self._ego = np.concatenate((self._ego, np.zeros_like(self._ego)))
        ego, k = self._ego[self._n], self._n
        ego["t"] = now * self._step_s
        ego["speed"], ego["yaw_rate"] = frame.speed, frame.yaw_rate
        ego["x"], ego["P"] = frame.x[:N_ROAD], frame.P[:N_ROAD, :N_ROAD]
        ego["shift"] = shift
        ego["journey"] = 0
        if k > 0:
            before = self._ego[k - 1]
            ego["journey"] = before["journey"] + (ego["t"] - before["t"] > LONGEST_S)
        self._n = k + 1
        return self._base + k

    def forget(self, scan: int) -> None:
        """Nothing will be asked of what was before this scan."""
        count = scan - self._base
        if 2 * count >= len(self._ego):
            self._ego[: self._n - count] = self._ego[count : self._n]
            self._n -= count
            self._base = scan

    def label_(self, rows: Rows, first: int, last: int, reports: npt.NDArray[Any]) -> None:
        """Say of the rows first .. last - 1 of a track what by hindsight was true, in place.

        Args:
            rows: the track's; what comes before and after is looked at as well.
            reports: (last - first,) smoothed.
        """
        measured = np.flatnonzero(rows.steps[: rows.n] != COASTING)
        p_other = reports["p"][:, [_STATIONARY, _ONCOMING]].sum(axis=1)
        if not len(measured) or not (p_other < 1.0 - OURS).any():
            return
        scan = rows.scan[measured] - self._base
        begin, end = int(scan[0]), self._journey_end(int(scan[-1]))
        ego = self._ego[begin:end]
        scan -= begin
        z, r = rows.z[measured], rows.r[measured]
        ego_speed, ego_rate = self._ego_speeds(ego)
        if np.isfinite(ego["speed"]).any() and np.isfinite(ego["yaw_rate"]).all():
            place, beside = self._on_later_road(ego, ego_speed.mean(axis=1), scan, z, r)
        else:
            place, beside = self._on_road_at_the_time(ego, ego_speed.mean(axis=1), scan, z)
        place[r == np.inf] = np.nan
        t, width = ego["t"][scan], float(ego["x"][-1, WIDTH])
        p = np.zeros((len(measured), 4))
        speed, rate = np.zeros((2, len(measured), N_PATHS))
        draw_speeds_(
            t, place[:, 0].copy(), place[:, 1].copy(), r[:, :2].copy(), self._noise, speed, rate
        )
        p[:, 2:] = self._judged(speed - ego_speed[scan], rate - ego_rate[scan])
        lanes = width * round(float(np.nanmedian(place[:, 2])) / width)
        changes = np.zeros((len(measured), 2))
        find_lane_changes_(
            t, place[:, 2] - lanes, r[:, 2].copy(), place[:, 3].copy(), r[:, 3].copy(), beside,
            width, changes,
        )  # fmt: skip
        p[:, :2] = changes
        # from the axes in which the track was smoothed
        road_then = self._lane_then(ego, scan, z[:, 0])
        correction = place[:, 2] - ego["shift"][scan] - (z[:, 2] - road_then)
        wanted, known = rows.now[first:last], rows.now[measured]
        p = np.stack([np.interp(wanted, known, column) for column in p.T], axis=1)
        lateral = reports["x"][:, Y] + np.interp(wanted, known, correction)
        label_(self._bank, width, p, lateral, reports)

    def _journey_end(self, scan: int) -> int:
        """The scan after the last one that tells of the road at this one."""
        ego = self._ego[scan : self._n]
        there = (ego["t"] <= ego["t"][0] + LOOK_AHEAD_S) & (ego["journey"] == ego["journey"][0])
        return scan + int(np.count_nonzero(there))

    def _ego_speeds(self, ego: npt.NDArray[Any]) -> tuple[FloatArray, FloatArray]:
        """Paths of the ego's speed and its rate, (K, N); 0 if nothing is known of it."""
        speed, rate = np.zeros((2, len(ego), N_PATHS))
        if np.isfinite(ego["speed"]).any():
            nowhere = np.full(len(ego), np.nan)
            r = np.full((len(ego), 2), EGO_SPEED_STD**2)
            draw_speeds_(
                ego["t"].copy(), nowhere, ego["speed"].copy(), r, self._noise, speed, rate
            )
        return speed, rate

    def _judged(self, speed: FloatArray, rate: FloatArray) -> FloatArray:
        p = np.zeros((len(speed), 2))
        judge_speeds_(speed, rate, p)
        return p

    def _lane_then(self, ego: npt.NDArray[Any], scan: IntArray, x: FloatArray) -> FloatArray:
        """Where at distances x (K,) the filter had the ego's lane then (K,) [m]."""
        out = np.zeros(len(x))
        for k, i in enumerate(scan):
            road.lane_row_(self._h, x[k])
            out[k] = road.value(ego["x"][i], self._h)
        return out

    def _on_road_at_the_time(
        self, ego: npt.NDArray[Any], speed: FloatArray, scan: IntArray, z: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Along and across the road as the filter knew it then; see `_on_later_road`."""
        out = z.copy()
        beside = np.zeros(len(z))
        way = np.concatenate(([0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(ego["t"]))))
        out[:, 0] += way[scan]
        out[:, 1] += speed[scan]
        for k, i in enumerate(scan):
            y, vy = road.place(ego["x"][i], self._h, z[k, 0], z[k, 1], float(ego["speed"][i]))
            out[k, 2] += ego["shift"][i] - y
            out[k, 3] -= vy
            road.lane_row_(self._h, z[k, 0])
            beside[k] = math.sqrt(BESIDE**2 + road.variance(ego["P"][i], self._h))
        return out, beside

    def _on_later_road(
        self,
        ego: npt.NDArray[Any],
        speed: FloatArray,
        scan: IntArray,
        z: FloatArray,
        r: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Along and across the road that the ego drove later.

        Returns:
            (K, 4) way and speed along the road, place and speed across it, 0 in the middle of the
            ego's first lane; (K,) standard deviation of places beside the middles of lanes.
        """
        last = ego[-1]
        pose = np.zeros((len(ego), 3))
        reckon_(ego["t"].copy(), speed, ego["yaw_rate"] - last["x"][BIAS], pose)
        offset = ego["x"][:, OFFSET] + ego["shift"]
        line = pose[:, :2] + offset[:, None] * np.stack(
            [np.sin(pose[:, 2]), -np.cos(pose[:, 2])], axis=1
        )
        way = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(pose[:, :2], axis=0).T))))
        # a point for every metre, and the road ahead of the last one
        kept = np.searchsorted(way, np.arange(0.0, way[-1], LEAST_STEP))
        line = line[np.unique(np.append(kept, len(way) - 1))]
        ahead = np.arange(LINE_STEP, LINE_END, LINE_STEP)
        across = self._lane_then(ego, np.full(len(ahead), len(ego) - 1, np.int32), ahead)
        across += last["x"][MOUNTING] * ahead - last["shift"]
        cos, sin = math.cos(pose[-1, 2]), math.sin(pose[-1, 2])
        beyond = np.stack([cos * ahead - sin * across, sin * ahead + cos * across], axis=1)
        line = np.concatenate((line, pose[-1, :2] + beyond))
        station = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
        out = np.zeros_like(z)
        straighten_rows_(
            z, r, scan, pose, speed, float(last["x"][MOUNTING]), line, station, out
        )
        beside = np.hypot(BESIDE, DRIFT * z[:, 0])
        unseen = out[:, 0] - (station[-1] - LINE_END)
        for k in np.flatnonzero(unseen > 0.0):
            road.lane_row_(self._h, unseen[k])
            far = max(unseen[k] - road.FAR, 0.0)
            bend = 0.5 * self._par[road.P_FAR_CURVATURE] * far**2
            beside[k] = math.sqrt(
                beside[k] ** 2 + road.variance(last["P"], self._h) + bend**2
            )
        return out, beside
