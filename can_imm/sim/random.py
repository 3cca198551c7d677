"""Randomised scenarios like the published one."""

from __future__ import annotations

from math import ceil, sqrt

import numpy as np

from can_imm.sim.model import LEFT, RIGHT, Scenario, ScenarioObject, Segment, Vehicle
from can_imm.types import Manoeuvre

_KMH = 3.6
_RECEDING, _APPROACHING, _OVERTAKING = 10.0 / _KMH, 15.0 / _KMH, 7.6 / _KMH
"""Peaks of the published scenario [m/s]."""
_CHANGE_TIMES = (2.0, 4.0)
"""Times of the published lane changes, for a lane of 3 m [s]."""
_NEAR, _FAR = 20.0, 75.0
"""Gaps [m] below which nothing but receding begins, and above which no receding does."""
_TICK = 0.01
"""All times are multiples of it [s]."""


def random_scenario(rng: np.random.Generator) -> Scenario:
    """Draw a drive of roughly 60 to 85 s (rarely longer) with one object on a road with two lanes.

    What is random, and how (U is the uniform distribution):

    - lane width U(3, 3.75) m, speed ramps U(1.4, 2.6) m/s² (one driver, one value), start gap
      U(30, 70) m, start in the right lane with probability 0.7;
    - keeping the lane lasts U(2, 8) s, and stands between any two other manoeuvres;
    - the next manoeuvre is drawn from those possible in the lane and at the gap.  From the right
      lane: lane change .25, overtaking .3, receding .25, approaching .2; from the left lane: lane
      change .6, receding .2, approaching .2.  No receding starts above 75 m or near
      the end; below 20 m nothing but receding does;
    - a lane change takes the published 2 s or 4 s for 3 m, its lateral speed scaled by U(.7, 1.3);
    - overtaking pulls out and in in U(1, 1.4) s each for a lane of 3 m (in proportion for a wider
      one), with U(.5, 1.2) s between; its peak is that of truth A scaled by U(.7, 1.3), or what two
      ramps reach in the time if that is less;
    - receding lasts U(5, 10) s, its peak of 10 km/h scaled by U(.7, 1.3);
    - approaching has its peak of 15 km/h scaled by U(.7, 1.3) and breaks off at a gap drawn from
      U(3, 9) m in half of the cases, so that its last part is REAR_END, else from U(12, 25) m (but
      by 8 m at least); its peak is lower where two ramps leave no room for it;
    - from an end drawn from U(57, 73) s on no manoeuvre begins.  With probability 0.6 the drive
      ends with an approach until the gap is 0, which starts early enough to close the gap around
      that time; otherwise the vehicle keeps its lane until then.

    All times are multiples of 10 ms.  The gap stays above 0 until the end.

    Args:
        rng: the only source of randomness; equal generators give equal scenarios.

    Returns:
        a scenario named ``random``.
    """
    return _Driver(rng).drive()


class _Driver:
    """Appends segments and keeps track of time, lane and nominal gap."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.lane_width = self.between(3.0, 3.75)
        self.acceleration = self.between(1.4, 2.6)
        self.start_gap = self.gap = self.between(30.0, 70.0)
        self.start_lane = self.lane = RIGHT if rng.random() < 0.7 else LEFT
        self.time = 0.0
        self.segments: list[Segment] = []

    def between(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def around(self, value: float) -> float:
        return value * self.between(0.7, 1.3)

    def drive(self) -> Scenario:
        end = self.between(57.0, 73.0)
        closes_gap = self.rng.random() < 0.6
        last_peak = self.around(_APPROACHING)
        last_approach = 0.0
        while True:
            self.keep(self.between(2.0, 8.0))
            if closes_gap:
                last_approach = self.time_for(self.gap, last_peak)
            too_near = closes_gap and self.gap < _NEAR
            if self.time + last_approach >= end and not too_near:
                break
            # receding costs time twice where the gap must be closed again
            self.manoeuvre(may_recede=self.time + last_approach + 22.0 < end)
        if closes_gap:
            # the window reaches beyond gap 0, so that the run ends at full speed, as published
            window = last_approach + 2.0 * last_peak / self.acceleration
            self.add(Manoeuvre.APPROACHING, window, peak=last_peak)
        target = ScenarioObject(1, self.start_gap, self.start_lane, tuple(self.segments))
        return Scenario(
            name="random",
            duration=self.time,
            lane_width=self.lane_width,
            vehicle=Vehicle(acceleration=self.acceleration),
            objects=(target,),
        )

    def manoeuvre(self, *, may_recede: bool) -> None:
        """Append one of the manoeuvres that the lane and the gap allow."""
        if self.gap < _NEAR:
            self.recede()
            return
        change, overtake, recede = (0.25, 0.3, 0.25) if self.lane == RIGHT else (0.6, 0.0, 0.2)
        weights = np.array(
            [change, overtake, recede if may_recede and self.gap <= _FAR else 0.0, 0.2]
        )
        choice = self.rng.choice(4, p=weights / weights.sum())
        (self.change_lane, self.overtake, self.recede, self.approach)[choice]()

    def keep(self, time: float) -> None:
        self.add(Manoeuvre.KEEP_RIGHT if self.lane == RIGHT else Manoeuvre.KEEP_LEFT, time)

    def change_lane(self) -> None:
        rate = self.around(3.0 / float(self.rng.choice(_CHANGE_TIMES)))
        time = self.lane_width / rate
        self.add(Manoeuvre.LANE_CHANGE, time, direction=+1 if self.lane == RIGHT else -1)
        self.lane = 1 - self.lane
        self.gap -= self.detour(time)

    def overtake(self) -> None:
        pull_out, pull_in = (self.lane_width / 3.0 * self.between(1.0, 1.4) for _ in range(2))
        time = pull_out + pull_in + self.between(0.5, 1.2)
        peak = min(self.around(_OVERTAKING), 0.49 * time * self.acceleration)
        self.add(Manoeuvre.OVERTAKING, time, peak=peak, pull_out=pull_out, pull_in=pull_in)
        self.gap += self.distance_in(time, peak) - self.detour(pull_out) - self.detour(pull_in)

    def recede(self) -> None:
        peak = self.around(_RECEDING)
        time = self.between(max(5.0, 2.05 * peak / self.acceleration), 10.0)
        self.add(Manoeuvre.RECEDING, time, peak=peak)
        self.gap += self.distance_in(time, peak)

    def approach(self) -> None:
        to = self.between(3.0, 9.0) if self.rng.random() < 0.5 else self.between(12.0, 25.0)
        to = min(to, self.gap - 8.0)
        peak = min(self.around(_APPROACHING), sqrt(0.9 * (self.gap - to) * self.acceleration))
        self.add(Manoeuvre.APPROACHING, self.time_for(self.gap - to, peak), peak=peak)
        self.gap = to

    def add(
        self,
        label: Manoeuvre,
        time: float,
        *,
        peak: float = 0.0,
        direction: int = 0,
        pull_out: float = 0.0,
        pull_in: float = 0.0,
    ) -> None:
        self.segments.append(Segment(self.time, label, peak, direction, pull_out, pull_in))
        # up, so that what fits into the time still does
        self.time = round(self.time + _TICK * ceil(time / _TICK), 6)

    def distance_in(self, time: float, peak: float) -> float:
        """What a speed trapezoid with this peak gains in a time [m]."""
        return peak * (time - peak / self.acceleration)

    def time_for(self, distance: float, peak: float) -> float:
        """Time that a speed trapezoid with this peak takes for a distance [s]."""
        return distance / peak + peak / self.acceleration

    def detour(self, time: float) -> float:
        """What changing lanes in a time costs along the road [m], at about the ego's speed."""
        return self.lane_width**2 / (2.0 * Scenario.ego_speed * time)
