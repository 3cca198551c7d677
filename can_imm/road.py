"""The axes of the road: from the sensor's axes into them and back, scan by scan."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np

from can_imm.estimation import guides, road
from can_imm.estimation.changing import (
    CHANGES_DTYPE,
    follow_all_,
    shift_changes_,
    tell_changes_,
    tell_times_,
)
from can_imm.reporting import doubt_, globalise_, judge_changes_, judge_ramps_
from can_imm.types import VY, FloatArray, IntArray, Scan

if TYPE_CHECKING:
    from can_imm.manoeuvres import ModeBank

SCANS = 64
"""So many scans at most wait to be learnt from."""

SHORTEST_S = 0.001
"""[s]; the first scan after a silence has no time before it."""

SPEED_STD, RATE_STD = 0.06, 0.3
"""Of the ego's speed on the bus [m/s], and of its acceleration before it is known [m/s²]."""
JERK = 0.3
"""How fast the acceleration changes: spectral density of its noise [m²/s⁵]."""

LONGEST_S = 1.0
"""After a longer silence [s] the ego has moved on unseen: the road is a new one."""


class RoadFrame:
    """Keeps `estimation.road`'s filter, and what belongs to the scan in hand.

    In the road's axes y counts from the middle of the ego's lane at the same distance, so that
    lane k lies at k times the width whatever the ego and the road do.

    Args:
        par: `estimation.road.PARAMETERS`.

    Attributes:
        x, P: (N_ROAD,), (N_ROAD, N_ROAD) state and covariance of the filter at the last scan,
            without the guides.
        speed, yaw_rate, acceleration: of the ego at the last scan [m/s, rad/s, m/s²], NaN where
            unknown.
        doubtful: lateral speeds were measured in the last scan, and the ego's motion is known: lane
            changes are to be doubted by them, see `reporting.doubt_`.
    """

    def __init__(self, par: FloatArray) -> None:
        self._par = par
        self._guide_slot = np.full(road.N_GUIDES, road.FREE, np.int32)
        self._guide_unseen = np.zeros(road.N_GUIDES)
        self._notes: np.ndarray[Any, np.dtype[np.void]] = np.zeros((SCANS, 0), guides.NOTE_DTYPE)
        self._changes: np.ndarray[Any, np.dtype[np.void]] = np.zeros(0, CHANGES_DTYPE)
        self._p: FloatArray = np.zeros((0, 2))
        # the filter as of the last scan that was learnt from; the ego's motion of those since
        self._past, self._P_past = road.new_road(par)
        self._motion: deque[tuple[float, float, float]] = deque()
        self._first = 0
        self.x, self.P = self._past[: road.N_ROAD].copy(), self._without_guides()
        self._t_ns = -1
        self.speed = math.nan
        self.yaw_rate = math.nan
        self.acceleration = math.nan
        self._pace, self._pace_cov = np.zeros(2), np.zeros((2, 2))
        self.doubtful = False
        self._h = np.zeros(road.N_ROAD + 1)

    @property
    def width(self) -> float:
        """Of the lanes [m]."""
        return float(self.x[road.WIDTH])

    @property
    def sure(self) -> float:
        """How probable a lane change must be to be said; see `relations.hesitate_`."""
        return float(self._par[road.P_SURE])

    def _without_guides(self) -> FloatArray:
        return self._P_past[: road.N_ROAD, : road.N_ROAD].copy()

    def warm_up(
        self, bank: ModeBank, objects: Any, slot: Any, status: Any, age: Any,
        ids: IntArray, memory: Any, reports: np.ndarray[Any, Any],
    ) -> None:  # fmt: skip
        """Compile, or load from the cache, all that a scan needs: by a drive of another ego past
        nobody.  No slot may be in use."""
        other, scan = RoadFrame(self._par), Scan(1)
        for t_ns in (0, 100_000_000):
            other.move(t_ns, 20.0, 0.0)
            other.localise_(scan, scan.z, scan.std)
            other.watch_(bank, objects, scan, slot, status, age)
            other.doubtful = True
            other.judge_(ids, memory, reports, t_ns)
            other.globalise_(reports, 0)
        for x, P in ((other.x, other.P), (other._past, other._P_past)):
            guides.change_lane_(x, P, other._guide_slot, 0, other.width)
        shift_changes_(other._changes, 1)
        guides.shift_objects_(bank.record, objects, 0.0)

    def move(self, t_ns: int, speed: float, yaw_rate: float) -> None:
        """Move the ego on to the time of the next scan.

        Args:
            t_ns: of the scan [ns], later than that of the last one.
            speed, yaw_rate: of the ego [m/s, rad/s], NaN where unknown, else finite.
        """
        dt = (t_ns - self._t_ns) * 1e-9
        if self._t_ns < 0 or dt > LONGEST_S:
            width, var = self._past[road.WIDTH], self._P_past[road.WIDTH, road.WIDTH]
            self._past, self._P_past = road.new_road(self._par)
            self._past[road.WIDTH], self._P_past[road.WIDTH, road.WIDTH] = width, var
            self._guide_slot[:] = road.FREE
            self._motion.clear()
            road.turn_with_road_(self._past, self._P_past, self._par, speed, yaw_rate, 1.0)
            dt = 0.0
        self._motion.append((dt, speed, yaw_rate))
        self.x, self.P = self._past[: road.N_ROAD].copy(), self._without_guides()
        for passed in self._motion:
            self._pass(self.x, self.P, *passed)
        self._follow_speed((t_ns - self._t_ns) * 1e-9, speed)
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

    def _pass(self, x: FloatArray, P: FloatArray, dt: float, speed: float, yaw_rate: float) -> None:
        if dt > 0.0:
            road.predict_road_(x, P, self._par, dt, speed, yaw_rate)

    def localise_(self, scan: Scan, z: FloatArray, r: FloatArray) -> None:
        """Measurements z, r (N, 4) of the scan into the road's axes, in place."""
        r[: scan.n, 2] += np.square(scan.lasting[: scan.n])
        road.localise_(self.x, self.P, self._par, scan.n, z, r, scan.valid, scan.angle, self.speed)

    def watch_(
        self, bank: ModeBank, objects: Any, scan: Scan, slot: Any, status: Any, age: Any
    ) -> int:
        """Learn of the road by the traffic; see `estimation.guides`.

        Returns:
            By how many lanes the ego has moved to the left (+1, -1 or 0).  The road's offset and
            the objects' lateral positions have been changed accordingly.
        """
        if self._notes.shape[1] != len(objects):
            self._notes = np.zeros((SCANS, len(objects)), guides.NOTE_DTYPE)
            self._changes = np.zeros(len(objects), CHANGES_DTYPE)
            self._changes["since"] = self._changes["t"] = np.nan
            self._p = np.zeros((len(objects), 2))
        with np.errstate(over="ignore"):  # a row that is not used may say anything
            r = np.square(scan.std)
            r[:, 2] += np.square(scan.lasting)
        last = (self._first + len(self._motion) - 1) % SCANS
        guides.note_(
            self._notes[last], bank.record, objects, scan.n, slot, status, age,
            scan.z, r, scan.valid, scan.angle,
        )  # fmt: skip
        measured = bool(scan.valid[: scan.n, VY].any())
        self.doubtful = measured and not math.isnan(self.speed)
        self._learn(measured)
        moved = 0
        if abs(self.x[road.OFFSET]) > 0.5 * self.width:
            moved = 1 if self.x[road.OFFSET] > 0.0 else -1
            width = self.width
            guides.change_lane_(self.x, self.P, self._guide_slot, moved, width)
            guides.change_lane_(self._past, self._P_past, self._guide_slot, moved, width)
            guides.shift_objects_(bank.record, objects, moved * width)
            shift_changes_(self._changes, moved)
        follow_all_(
            self._changes, self.x, self.P, self._par, scan.t_ns * 1e-9, self.speed,
            self._notes[last], scan.n, slot, scan.z, r, scan.valid, scan.angle,
        )  # fmt: skip
        return moved

    def _learn(self, soon: bool) -> None:
        """From the scans that lie far enough back; from all if waiting is of no use.

        Without the ego's motion it is not known where it has gone meanwhile.

        Args:
            soon: lane changes are recognised soon, for the radar measures lateral speeds.
        """
        speed, yaw_rate = self._motion[-1][1:]
        known = not (math.isnan(speed) or math.isnan(yaw_rate))
        wait = self._par[road.P_HINDSIGHT] if soon and known else -math.inf
        since = sum(dt for dt, _, _ in self._motion) - self._motion[0][0]
        while self._motion and (since >= wait or len(self._motion) == SCANS):
            motion = self._motion.popleft()
            self._pass(self._past, self._P_past, *motion)
            guides.learn_(
                self._past, self._P_past, self._par, self._guide_slot, self._guide_unseen,
                self._notes, self._first, len(self._motion), max(motion[0], SHORTEST_S),
            )  # fmt: skip
            self._first = (self._first + 1) % SCANS
            if self._motion:
                since -= self._motion[0][0]
        if not self._motion:
            self.x, self.P = self._past[: road.N_ROAD].copy(), self._without_guides()

    def judge_(
        self, ids: IntArray, memory: Any, reports: np.ndarray[Any, np.dtype[np.void]], t_ns: int
    ) -> None:
        """Say in the reports of all slots in use who changed lanes at a time [ns], and who
        approaches or recedes since the ego changes its speed, in place.

        Without the ego's motion nothing is known of the road, and it is taken to be straight.
        """
        n = int((ids >= 0).sum())
        tell_changes_(self._changes, ids, t_ns * 1e-9, self._p)
        judge_changes_(self._p, reports, n)
        tell_times_(self._changes, ids, reports)
        if self.doubtful:
            doubtful = self._par[road.P_DOUBTFUL]
            doubt_(self.x, self.P, doubtful, self.speed, self._h, ids, memory, reports)
        if not math.isnan(self.acceleration):
            judge_ramps_(self.acceleration, reports, n)

    def changing(self, t: float) -> FloatArray:
        """How probable it is that the objects were changing lanes at a time t [s]: (capacity, 2) by
        slot, to the left and to the right; NaN where nothing is known."""
        p = np.empty((len(self._changes), 2))
        tell_changes_(self._changes, np.zeros(len(p), np.int32), t, p)
        return p

    def globalise_(self, reports: np.ndarray[Any, np.dtype[np.void]], n: int) -> None:
        """The first n reports from the road's axes into the sensor's, in place."""
        globalise_(self.x, self._h, reports, n, self.speed)
