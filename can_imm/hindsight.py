"""What each object did, by hindsight: labels of a recording on the road that the ego drove later.

The road is where the ego's own path went (`ego_road`); across it, whole lane changes are
weighed against keeping the lane (`estimation.lane_changes`), along it, paths of the speed are drawn
(`estimation.speed_paths`).  Where the ego's motion is not known, the road is that of the detector's
filter at the time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from can_imm.ego_road import (
    AHEAD_STEP_S,
    Ego,
    EgoHistory,
    RoadAtTheTime,
    RoadDriven,
    ahead_cov,
    learn_ahead,
)
from can_imm.estimation.lane_changes import find_lane_changes_
from can_imm.estimation.noise import noise_state
from can_imm.estimation.road import P_CURVATURE_STD, WIDTH
from can_imm.estimation.speed_paths import draw_speeds_, judge_speeds_
from can_imm.reporting import decide_, rear_end_share
from can_imm.road import RoadFrame
from can_imm.smoothing_rows import COASTING, Rows
from can_imm.types import VX, VY, FloatArray, Manoeuvre, X, Y

LOOK_AHEAD_S = 10.0
"""A track's road is known when the ego has driven on for so long [s]."""
N_PATHS = 64
"""Paths of the speed that are drawn for each object."""
EGO_SPEED_STD = 0.06
"""Of the ego's speed as the bus tells it [m/s]."""
OURS = 0.01
"""An object that is not in our direction with less than this probability is labelled."""

_LANE_CHANGE = int(Manoeuvre.LANE_CHANGE)
_APPROACHING = int(Manoeuvre.APPROACHING)
_REAR_END = int(Manoeuvre.REAR_END)
_RECEDING = int(Manoeuvre.RECEDING)
_KEEP_LANE = int(Manoeuvre.KEEP_LANE)
_STATIONARY = int(Manoeuvre.STATIONARY)
_ONCOMING = int(Manoeuvre.ONCOMING)


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
    """Labels the tracks of a recording.

    Args:
        bank: (1,) record of `layout.BANK_DTYPE`.
        road: `estimation.road.PARAMETERS`.
    """

    def __init__(self, bank: Any, road: FloatArray) -> None:
        self._bank = bank
        self._step_s = float(bank["step_s"][0])
        self._ego = EgoHistory()
        self._noise = noise_state(np.random.default_rng(0))
        self._ahead_cov = ahead_cov(float(road[P_CURVATURE_STD]))
        self._ahead_of = 0
        self._ahead: tuple[FloatArray, FloatArray] = np.zeros(3), self._ahead_cov

    def add(self, now: int, frame: RoadFrame, shift: float) -> int:
        """Remember a scan, and return its number; see `EgoHistory.add`."""
        return self._ego.add(now * self._step_s, frame, shift)

    def forget(self, scan: int) -> None:
        """Nothing will be asked of what was before this scan."""
        self._ego.forget(scan)

    def label_(self, rows: Rows, first: int, last: int, reports: npt.NDArray[Any]) -> None:
        """Say of the rows first .. last - 1 of a track what by hindsight was true, in place.

        Args:
            rows: the track's; what comes before and after is looked at as well.
            reports: (last - first,) smoothed.
        """
        measured = _measured(rows)
        others = reports["p"][:, _STATIONARY] + reports["p"][:, _ONCOMING]
        if not len(measured) or not (others < 1.0 - OURS).any():
            return
        scan = rows.scan[measured]
        begin = int(scan[0])
        ego = self._ego.journey(begin, int(scan[-1]), LOOK_AHEAD_S)
        scan -= begin
        z, r = rows.z[measured], rows.r[measured]
        if not (r[:, Y] < np.inf).any():
            return
        ego_speed, ego_rate = self._ego_speeds(ego)
        way = self._road(begin, ego, ego_speed.mean(axis=1))
        place, beside = way.place(scan, z, r)
        t, width = ego["t"][scan], float(ego["x"][-1, WIDTH])
        speeds, changes = np.zeros((2, len(measured), 2))
        # along the road
        along, rate = np.zeros((2, len(measured), N_PATHS))
        seen = np.where(r < np.inf, place, np.nan)
        draw_speeds_(
            t, seen[:, X].copy(), seen[:, VX].copy(), r[:, :2].copy(), self._noise, along, rate
        )
        judge_speeds_(along - ego_speed[scan], rate - ego_rate[scan], speeds)
        # across it
        lane = width * round(float(np.nanmedian(seen[:, Y])) / width)
        find_lane_changes_(
            t, place[:, Y] - lane, r[:, Y].copy(), place[:, VY].copy(), r[:, VY].copy(), beside,
            width, changes,
        )  # fmt: skip
        # the track was smoothed on the road as it was known then
        then = RoadAtTheTime(ego, ego_speed.mean(axis=1)).lane(scan, z[:, X])
        correction = place[:, Y] - ego["shift"][scan] - (z[:, Y] - then)
        now, known = rows.now[first:last], rows.now[measured]
        columns = (*changes.T, *speeds.T)
        p = np.stack([np.interp(now, known, column) for column in columns], axis=1)
        lateral = reports["x"][:, Y] + np.interp(now, known, correction)
        label_(self._bank, width, p, lateral, reports)

    def look_ahead(self, tracks: Iterable[Rows]) -> None:
        """Learn of the road ahead of the ego's last place from those who drive there.

        Args:
            tracks: all that were seen in the last `LOOK_AHEAD_S`.
        """
        end = self._ego.end
        if not end:
            return
        begin = self._ego.since(LOOK_AHEAD_S)
        ego = self._ego.journey(begin, end - 1, 0.0)
        way = self._road(begin, ego, self._ego_speeds(ego)[0].mean(axis=1))
        if not isinstance(way, RoadDriven):
            return
        distances, places = [], []
        for rows in tracks:
            measured = _measured(rows)
            measured = measured[rows.scan[measured] >= begin]
            measured = measured[(rows.r[measured][:, [X, Y]] < np.inf).all(axis=1)]
            scan = rows.scan[measured] - begin
            place = way.straighten(scan, rows.z[measured], rows.r[measured])
            beyond = way.beyond(place[:, X])
            if not (beyond > 0.0).any():
                continue
            _, bins = np.unique((ego["t"][scan] / AHEAD_STEP_S).astype(int), return_inverse=True)
            count = np.bincount(bins)
            distances.append(np.bincount(bins, beyond) / count)
            places.append(np.bincount(bins, place[:, Y]) / count)
        if places:
            self._ahead_of, self._ahead = end, learn_ahead(distances, places, self._ahead_cov)

    def _road(self, begin: int, ego: Ego, speed: FloatArray) -> RoadDriven | RoadAtTheTime:
        """The road of the scans from number ``begin`` on."""
        if not (np.isfinite(ego["speed"]).any() and np.isfinite(ego["yaw_rate"]).all()):
            return RoadAtTheTime(ego, speed)
        if begin + len(ego) == self._ahead_of:
            return RoadDriven(ego, speed, *self._ahead)
        return RoadDriven(ego, speed, np.zeros(3), self._ahead_cov)

    def _ego_speeds(self, ego: Ego) -> tuple[FloatArray, FloatArray]:
        """Paths of the ego's speed and its rate, (K, N); 0 if nothing is known of it."""
        speed, rate = np.zeros((2, len(ego), N_PATHS))
        if np.isfinite(ego["speed"]).any():
            way = np.full(len(ego), np.nan)
            r = np.full((len(ego), 2), EGO_SPEED_STD**2)
            draw_speeds_(ego["t"].copy(), way, ego["speed"].copy(), r, self._noise, speed, rate)
        return speed, rate


def _measured(rows: Rows) -> npt.NDArray[np.int64]:
    """Numbers of the rows that were measured."""
    return np.flatnonzero(rows.steps[: rows.n] != COASTING)
