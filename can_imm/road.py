"""The axes of the road: from the sensor's axes into them and back, scan by scan."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from can_imm.estimation import guides, road
from can_imm.reporting import doubt_, globalise_
from can_imm.types import FloatArray, Scan

if TYPE_CHECKING:
    from can_imm.manoeuvres import ModeBank

LONGEST_S = 1.0
"""After a longer silence [s] the ego has moved on unseen: the road is a new one."""


class RoadFrame:
    """Keeps `estimation.road`'s filter, and what belongs to the scan in hand.

    In the road's axes y counts from the middle of the ego's lane at the same distance, so that
    lane k lies at k times the width whatever the ego and the road do.

    Args:
        par: `estimation.road.PARAMETERS`.

    Attributes:
        x, P: (31,), (31, 31) state and covariance of the filter.
        speed, yaw_rate: of the ego at the last scan [m/s, rad/s], NaN where unknown.
    """

    def __init__(self, par: FloatArray) -> None:
        self._par = par
        self._guide_slot = np.full(road.N_GUIDES, road.FREE, np.int32)
        self._guide_unseen = np.zeros(road.N_GUIDES)
        self._unrest = np.ones(1)
        self.x, self.P = road.new_road(par)
        self._t_ns = -1
        self._dt = 0.1
        self.speed = math.nan
        self.yaw_rate = math.nan
        self._h = np.zeros(road.N_ROAD + 1)
        self._warm_up()

    @property
    def width(self) -> float:
        """Of the lanes [m]."""
        return float(self.x[road.WIDTH])

    def _warm_up(self) -> None:
        """Compile, or load from the cache."""
        x, P = self.x.copy(), self.P.copy()
        scan = Scan(1)
        road.predict_road_(x, P, self._par, 0.1, 20.0, 0.0)
        road.localise_(x, P, self._par, 0, scan.z, scan.std, scan.valid, scan.angle, 20.0)
        road.turn_with_road_(x, P, self._par, 20.0, 0.0, 1.0)
        road.place(x, self._h, 0.0, 0.0, 20.0)

    def move(self, t_ns: int, speed: float, yaw_rate: float) -> None:
        """Move the ego on to the time of the next scan.

        Args:
            t_ns: of the scan [ns], later than that of the last one.
            speed, yaw_rate: of the ego [m/s, rad/s], NaN where unknown, else finite.
        """
        dt = (t_ns - self._t_ns) * 1e-9
        if self._t_ns < 0 or dt > LONGEST_S:
            width, var = self.x[road.WIDTH], self.P[road.WIDTH, road.WIDTH]
            self.x, self.P = road.new_road(self._par)
            self.x[road.WIDTH], self.P[road.WIDTH, road.WIDTH] = width, var
            self._guide_slot[:] = road.FREE
            road.turn_with_road_(self.x, self.P, self._par, speed, yaw_rate, 1.0)
        else:
            self._dt = dt
            road.predict_road_(self.x, self.P, self._par, dt, speed, yaw_rate)
        self._t_ns = t_ns
        self.speed = speed
        self.yaw_rate = yaw_rate

    def localise_(self, scan: Scan, z: FloatArray, r: FloatArray) -> None:
        """Measurements z, r (N, 4) of the scan into the road's axes, in place."""
        r[: scan.n, 2] += np.square(scan.lasting[: scan.n])
        road.localise_(self.x, self.P, self._par, scan.n, z, r, scan.valid, scan.angle, self.speed)

    def watch_(
        self, bank: ModeBank, objects: Any, scan: Scan, slot: Any, status: Any, age: Any
    ) -> int:
        """Update the road by the traffic; see `estimation.guides.watch_traffic_`."""
        with np.errstate(over="ignore"):  # a row that is not used may say anything
            r = np.square(scan.std)
            r[:, 2] += np.square(scan.lasting)
        return int(
            guides.watch_traffic_(
                self.x, self.P, self._par, self._guide_slot, self._guide_unseen, self._unrest,
                bank.record, objects, scan.n, slot, status, age,
                scan.z, r, scan.valid, scan.angle, self._dt,
            )
        )  # fmt: skip

    def doubt_(self, reports: np.ndarray[Any, np.dtype[np.void]], n: int) -> None:
        """Trust lane changes no further than the road is known; see `reporting.doubt_`.

        Without the ego's motion nothing is known of the road, and it is taken to be straight.
        """
        if math.isnan(self.speed):
            return
        doubt_(self.P, self._par[road.P_DOUBTFUL], self._h, reports, n)

    def globalise_(self, reports: np.ndarray[Any, np.dtype[np.void]], n: int) -> None:
        """The first n reports from the road's axes into the sensor's, in place."""
        globalise_(self.x, self._h, reports, n, self.speed)
