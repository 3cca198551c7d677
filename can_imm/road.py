"""The axes of the road: from the sensor's axes into them and back, scan by scan."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from can_imm.estimation import road
from can_imm.estimation.guides import NOTE_DTYPE, learn_habits_, note_, shift_objects_, watch_
from can_imm.estimation.hypotheses import tell_changes_, tell_times_, weigh_
from can_imm.estimation.traffic import (
    FREE,
    N_LOCAL,
    begin_traffic_,
    change_lane_,
    expect_errors_,
    new_traffic,
    predict_traffic_,
    summarise_,
    turn_with_road_,
)
from can_imm.reporting import globalise_, judge_changes_, judge_ramps_
from can_imm.types import FloatArray, IntArray, Scan

if TYPE_CHECKING:
    from can_imm.manoeuvres import ModeBank

SHORTEST_S = 0.001
"""[s]; the first scan after a silence has no time before it."""

SPEED_STD, RATE_STD = 0.06, 0.3
"""Of the ego's speed on the bus [m/s], and of its acceleration before it is known [m/s²]."""
JERK = 0.3
"""How fast the acceleration changes: spectral density of its noise [m²/s⁵]."""

LONGEST_S = 1.0
"""After a longer silence [s] the ego has moved on unseen: the road is a new one."""


class RoadFrame:
    """Keeps `estimation.traffic`'s filter, and what belongs to the scan in hand.

    In the road's axes y counts from the middle of the ego's lane at the same distance, so that
    lane k lies at k times the width whatever the ego and the road do.

    Args:
        par: `estimation.road.PARAMETERS`.

    Attributes:
        x, P: (N_ROAD,), (N_ROAD, N_ROAD) state of the road and its covariance at the last scan.
        speed, yaw_rate, acceleration: of the ego at the last scan [m/s, rad/s, m/s²], NaN where
            unknown.
    """

    def __init__(self, par: FloatArray) -> None:
        self._par = par
        self._traffic = new_traffic()[0]
        self._guide_of: IntArray = np.full(0, FREE, np.int32)
        self._notes: np.ndarray[Any, np.dtype[np.void]] = np.zeros(0, NOTE_DTYPE)
        self._p: FloatArray = np.zeros((0, 2))
        self._weight: FloatArray = np.zeros(N_LOCAL)
        self.x: FloatArray = np.zeros(road.N_ROAD)
        self.P: FloatArray = np.zeros((road.N_ROAD, road.N_ROAD))
        self._begin(0.0, float(par[road.P_WIDTH]), float(par[road.P_WIDTH_STD]) ** 2)
        self._t_ns = -1
        self._dt = SHORTEST_S
        self.speed = math.nan
        self.yaw_rate = math.nan
        self.acceleration = math.nan
        self._pace, self._pace_cov = np.zeros(2), np.zeros((2, 2))
        self._h = np.zeros(road.N_ROAD + 1)

    @property
    def width(self) -> float:
        """Of the lanes [m]."""
        return float(self.x[road.WIDTH])

    @property
    def false_change(self) -> float:
        """What a false lane change costs [s]; see `relations.hesitate_`."""
        return float(self._par[road.P_FALSE_CHANGE])

    def _begin(self, t: float, width: float, width_var: float) -> None:
        """Forget all but the lanes' width."""
        begin_traffic_(self._traffic, self._par, t, width, width_var)
        self._guide_of[:] = FREE
        summarise_(self._traffic, self.x, self.P)
        weigh_(self._traffic, self._weight)

    def _fit(self, capacity: int) -> None:
        """Room for a detector's slots; happens once, before the first scan."""
        if len(self._notes) != capacity:
            self._guide_of = np.full(capacity, FREE, np.int32)
            self._notes = np.zeros(capacity, NOTE_DTYPE)
            self._p = np.zeros((capacity, 2))

    def warm_up(
        self, bank: ModeBank, objects: Any, slot: Any, status: Any, age: Any,
        ids: IntArray, reports: np.ndarray[Any, Any],
    ) -> None:  # fmt: skip
        """Compile, or load from the cache, all that a scan needs: by a drive of another ego past
        nobody.  No slot may be in use."""
        self._fit(len(objects))
        other, scan = RoadFrame(self._par), Scan(1)
        for t_ns in (0, 100_000_000):
            other.move(t_ns, 20.0, 0.0)
            other.localise_(scan, scan.z, scan.std)
            other.watch_(bank, objects, scan, slot, status, age)
            other.judge_(ids, reports, t_ns)
            other.globalise_(reports, 0)
        other._change_lane(bank, objects, 0)

    def move(self, t_ns: int, speed: float, yaw_rate: float) -> None:
        """Move the ego on to the time of the next scan.

        Args:
            t_ns: of the scan [ns], later than that of the last one.
            speed, yaw_rate: of the ego [m/s, rad/s], NaN where unknown, else finite.
        """
        t, dt = t_ns * 1e-9, (t_ns - self._t_ns) * 1e-9
        if self._t_ns < 0 or dt > LONGEST_S:
            self._begin(t, self.width, float(self.P[road.WIDTH, road.WIDTH]))
            turn_with_road_(self._traffic, self._par, speed, yaw_rate)
            self._dt = SHORTEST_S
        else:
            predict_traffic_(self._traffic, self._par, dt, t, speed, yaw_rate)
            self._dt = max(dt, SHORTEST_S)
        summarise_(self._traffic, self.x, self.P)
        self._follow_speed(dt, speed)
        self._t_ns = t_ns
        self.speed = speed
        self.yaw_rate = yaw_rate

    def _follow_speed(self, dt: float, speed: float) -> None:
        """A Kalman filter of the ego's speed and acceleration."""
        if math.isnan(speed) or not 0.0 < dt <= LONGEST_S or math.isnan(self.acceleration):
            self._pace, self._pace_cov = np.array([speed, 0.0]), np.diag([SPEED_STD, RATE_STD]) ** 2
            self.acceleration = 0.0 if speed == speed else math.nan
            return
        F = np.array([[1.0, dt], [0.0, 1.0]])
        P = F @ self._pace_cov @ F.T
        P += JERK * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
        x = F @ self._pace
        gain = P[:, 0] / (P[0, 0] + SPEED_STD**2)
        self._pace, self._pace_cov = x + gain * (speed - x[0]), P - np.outer(gain, P[0])
        self.acceleration = float(self._pace[1])

    def localise_(self, scan: Scan, z: FloatArray, r: FloatArray) -> None:
        """Measurements z, r (N, 4) of the scan into the road's axes, in place."""
        if scan.lasting is not None:
            r[: scan.n, 2] += scan.lasting.as_white(scan.z[: scan.n, 0])
        road.localise_(self.x, self.P, self._par, scan.n, z, r, scan.valid, scan.angle, self.speed)

    def watch_(
        self, bank: ModeBank, objects: Any, scan: Scan, slot: Any, status: Any, age: Any
    ) -> int:
        """Learn of the road and of who changes lanes by the traffic; see `estimation.guides`.

        Returns:
            By how many lanes the ego has moved to the left (+1, -1 or 0).  The road's offset and
            the objects' lateral positions have been changed accordingly.
        """
        self._fit(len(objects))
        with np.errstate(over="ignore"):  # a row that is not used may say anything
            r = np.square(scan.std)
        if scan.lasting is not None and self._traffic["top"] == road.N_ROAD:
            expect_errors_(self._traffic, scan.lasting)
        note_(
            self._notes, bank.record, objects, scan.n, slot, status, age,
            scan.z, r, scan.valid, scan.angle,
        )  # fmt: skip
        watch_(
            self._traffic, self._par, self._guide_of, self._notes, scan.t_ns * 1e-9, self._dt,
            self.speed, scan.n, slot, scan.z, r, scan.valid, scan.angle,
        )  # fmt: skip
        summarise_(self._traffic, self.x, self.P)
        learn_habits_(
            self._traffic, self._par, self._guide_of, self._notes, self.x, self.P,
            scan.t_ns * 1e-9, self.speed, scan.n, slot, scan.z, r, scan.valid, scan.angle,
        )  # fmt: skip
        weigh_(self._traffic, self._weight)
        moved = 0
        if abs(self.x[road.OFFSET]) > 0.5 * self.width:
            moved = 1 if self.x[road.OFFSET] > 0.0 else -1
            self._change_lane(bank, objects, moved)
        return moved

    def _change_lane(self, bank: ModeBank, objects: Any, moved: int) -> None:
        shift_objects_(bank.record, objects, moved * self.width)
        change_lane_(self._traffic, moved)
        summarise_(self._traffic, self.x, self.P)

    def judge_(self, ids: IntArray, reports: np.ndarray[Any, np.dtype[np.void]], t_ns: int) -> None:
        """Say in the reports of all slots in use who changed lanes at a time [ns], and who
        approaches or recedes since the ego changes its speed, in place.

        Without the ego's motion nothing is known of the road, and it is taken to be straight.
        """
        n = int((ids >= 0).sum())
        traffic, weight, guide_of, t = self._traffic, self._weight, self._guide_of, t_ns * 1e-9
        tell_changes_(traffic, weight, guide_of, ids, t, self._p)
        judge_changes_(self._p, reports, n)
        tell_times_(traffic, weight, guide_of, ids, t, reports)
        if not math.isnan(self.acceleration):
            judge_ramps_(self.acceleration, reports, n)

    def changing(self, t: float) -> FloatArray:
        """How probable it is that the objects were changing lanes at a time t [s]: (capacity, 2) by
        slot, to the left and to the right; NaN where nothing is known."""
        p = np.empty((len(self._notes), 2))
        ids = np.zeros(len(p), np.int32)
        tell_changes_(self._traffic, self._weight, self._guide_of, ids, t, p)
        return p

    def globalise_(self, reports: np.ndarray[Any, np.dtype[np.void]], n: int) -> None:
        """The first n reports from the road's axes into the sensor's, in place."""
        globalise_(self.x, self._h, reports, n, self.speed)
