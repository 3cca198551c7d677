"""Random motorway traffic: who enters, what each vehicle wishes to do, and what it does instead.

`can_imm.sim.plans` sees to it that nobody drives through anybody.
"""

from __future__ import annotations

import numpy as np

from can_imm.sim.motorway_model import AHEAD, BEHIND, Driver, MotorwayScenario
from can_imm.sim.motorway_settings import MotorwaySettings
from can_imm.sim.plans import BEYOND, DT, EGO, Plan, Plans
from can_imm.sim.road import random_road, straight
from can_imm.sim.wishes import Dice, Wishes

_HORIZON = 60.0
"""Plans are tabulated for so long beyond the scenario's end [s]."""
_ENTRY_ROOM = 6.0
"""Somebody enters only if there is so much room beyond the least distance [m]."""
_BEHIND, _AHEAD = BEHIND + 5.0, 220.0
"""Where on the ego's x axis vehicles are given up [m]."""
_CAR = 4.7
"""Length of the ego [m]."""
_MARGIN = 600.0
"""The road goes on for so long before the first and beyond the last vehicle [m]."""
_OSCILLATIONS = 6
"""Number of sines of which the lateral wander consists."""


def random_motorway(rng: np.random.Generator, settings: MotorwaySettings) -> MotorwayScenario:
    """Draw a road and a minute or so of traffic on it; equal generators give equal scenarios.

    `MotorwaySettings` says what is drawn from which range.  A companion of the ego does in turn: it
    keeps its lane, then changes it, recedes or approaches (a gap in the ego's lane down to U(3, 9)
    m in three of four cases, else to U(12, 30) m), each if there is room; when the ego has changed
    its speed, it first adapts its own.  The other vehicles keep their speed and change lane now and
    then, or when they must.  Who leaves the surroundings of the ego is replaced by somebody else
    who comes from behind in another lane or from far ahead.
    """
    return _Traffic(rng, settings).scenario()


class _Traffic:
    def __init__(self, rng: np.random.Generator, settings: MotorwaySettings) -> None:
        self.dice, self.set = Dice(rng), settings
        self.n_lanes = int(rng.integers(settings.lanes[0], settings.lanes[1] + 1))
        self.lane_width = self.dice.between(settings.lane_width)
        self.plans = Plans(settings.duration + _HORIZON, settings.steady_changes)
        self.wishes = Wishes(self.dice, settings, self.plans, self.n_lanes)
        self.ego = self.new_ego()

    def scenario(self) -> MotorwayScenario:
        """Let everybody decide in turn until the end."""
        settings = self.set
        for _ in range(int(self.dice.rng.integers(settings.vehicles[0], settings.vehicles[1] + 1))):
            self.enter_at_start()
        entries: list[float] = []
        while True:
            plan = min((p for p in self.plans.plans if p.end == np.inf), key=lambda p: p.until)
            entry = min(entries, default=np.inf)
            now = min(plan.until, entry)
            if now >= settings.duration:
                return self.finish()
            if entry <= plan.until:
                entries.remove(entry)
                if not self.enter(now):
                    entries.append(now + self.dice.between((1.0, 4.0)))
            elif plan is not self.ego and not _BEHIND < self.plans.ahead(plan, now) < _AHEAD:
                self.plans.leave(plan, now)
                entries.append(now + self.dice.between((0.5, 4.0)))
            else:
                move = self.wishes.choose(plan, now)
                self.plans.commit(plan, now, move, self.lane_width)
                if move.name == "keep":
                    plan.cruise = self.dice.cruise(settings)

    def finish(self) -> MotorwayScenario:
        """Give up who collides, add road, wander and what is not traffic in our direction."""
        settings, plans = self.set, self.plans
        start = min(p.rows[0][1] for p in plans.plans) - _MARGIN
        end = max(p.state(min(p.end, settings.duration))[0] for p in plans.plans) + _MARGIN
        rng = self.dice.rng
        road = random_road(rng, start, end) if settings.curves else straight(start, end)
        ego, *drivers = (self.driver(plan) for plan in plans.plans)
        colliding = plans.colliding(settings.duration)
        outer = (-0.5 * self.lane_width, (self.n_lanes - 0.5) * self.lane_width)
        return MotorwayScenario(
            duration=settings.duration,
            n_lanes=self.n_lanes,
            lane_width=self.lane_width,
            road=road,
            ego=ego,
            drivers=tuple(d for d in drivers if d.id not in colliding),
            oncoming=self.oncoming(outer[1]) if settings.oncoming else (),
            roadside=self.roadside(outer) if settings.roadside else (),
            noise=settings.noise,
        )

    def driver(self, plan: Plan) -> Driver:
        """The plan with a lateral wander: sines of random periods and phases."""
        rng, n = self.dice.rng, _OSCILLATIONS
        period = rng.uniform(*self.set.wander_time, n)
        amplitude = rng.uniform(0.5, 1.5, n)
        amplitude *= self.dice.between(self.set.wander) * np.sqrt(2.0 / (amplitude**2).sum())
        phase = rng.uniform(0.0, 2.0 * np.pi, n)
        return Driver(
            id=plan.number,
            start=plan.start,
            end=min(plan.end, self.set.duration),
            pieces=np.array(plan.rows),
            d=plan.first_lane * self.lane_width,
            changes=tuple(plan.changes),
            wander=np.stack([amplitude, 2.0 * np.pi / period, phase], axis=1),
            length=plan.length,
        )

    def new_ego(self) -> Plan:
        """The ego enters first."""
        lane = int(self.dice.rng.integers(self.n_lanes))
        plan = Plan(
            number=EGO,
            start=0.0,
            rows=[(0.0, 0.0, self.dice.between(self.set.ego_speed), 0.0)],
            lane=lane,
            first_lane=lane,
            length=_CAR,
            companion=False,
            acceleration=self.set.ego_acceleration[1],
            mix=float(self.dice.rng.random()),
            cruise=0.0,
            until=self.dice.between((1.0, 8.0)),
        )
        self.plans.enter(plan)
        return plan

    def new_length(self) -> float:
        return (
            self.dice.between((8.0, 16.0))
            if self.dice.chance(0.15)
            else self.dice.between((3.9, 5.0))
        )

    def try_to_enter(
        self, t: float, x: float, speed: float, lane: int, *, companion: bool, wait: float
    ) -> bool:
        """Let a vehicle enter at x on the ego's axis unless there is somebody."""
        length = self.new_length()
        station = self.ego.state(t)[0] + self.ego.length + x
        plans = self.plans
        k = plans.column(t)
        columns = slice(k, min(k + int((wait + BEYOND) / DT), plans.columns))
        course = plans.steady(t, station, speed, lane)
        room = plans.room(-1, length, course, columns, plans.others(-1, t))
        if (room < _ENTRY_ROOM).any():
            return False
        plans.enter(
            Plan(
                number=len(plans.plans),
                start=t,
                rows=[(t, station, speed, 0.0)],
                lane=lane,
                first_lane=lane,
                length=length,
                companion=companion,
                acceleration=self.dice.between(self.set.acceleration),
                mix=float(self.dice.rng.random()),
                cruise=self.dice.cruise(self.set),
                until=t + wait,
            )
        )
        return True

    def enter_at_start(self) -> None:
        """Somebody is there from the beginning, if there is room."""
        dice, v_ego = self.dice, self.ego.state(0.0)[1]
        companion = dice.chance(self.set.companions)
        for _ in range(10):
            lane = int(dice.rng.integers(self.n_lanes))
            if companion and dice.chance(0.4):
                lane = self.ego.lane
            if companion:
                x, dv = dice.between((8.0, 60.0)), 0.0
            else:
                x, dv = dice.between((-20.0, 170.0)), dice.pass_speed(self.set, 0.5)
            wait = dice.between(self.set.keep) if companion else dice.between((1.0, 5.0))
            if self.try_to_enter(0.0, x, v_ego + dv, lane, companion=companion, wait=wait):
                return

    def enter(self, t: float) -> bool:
        """Somebody new appears: from behind or alongside if faster, far ahead if slower."""
        dice, v_ego = self.dice, self.ego.state(t)[1]
        companion = dice.chance(self.set.companions)
        lane = int(dice.rng.integers(self.n_lanes))
        if dice.chance(0.6 if companion else 0.5):
            if lane == self.ego.lane:
                return False
            x = dice.between((-22.0, -4.0))
            dv = dice.between(self.set.faster) if companion else dice.pass_speed(self.set, 1.0)
            wait = dice.between((3.0, 9.0))
        else:
            x = dice.between((110.0, 200.0))
            dv = -dice.between(self.set.slower) if companion else dice.pass_speed(self.set, 0.0)
            wait = dice.between((6.0, 18.0))
        return self.try_to_enter(t, x, v_ego + dv, lane, companion=companion, wait=wait)

    def oncoming(self, edge: float) -> tuple[Driver, ...]:
        """Vehicles on two lanes beyond a central reservation of U(3, 8) m; ``edge`` is ours."""
        drivers: list[Driver] = []
        reservation = self.dice.between((3.0, 8.0))
        for lane in range(2):
            d = edge + reservation + (lane + 0.5) * self.lane_width
            speed = -self.dice.between((22.0, 36.0))
            t = self.dice.between((-3.0, 3.0))
            while t < self.set.duration:
                x = AHEAD
                if t < 0.0:
                    x, t = AHEAD * float(self.dice.rng.random()), 0.0
                drivers.append(self.thing(t, x, speed, d, self.new_length()))
                t += self.dice.between((2.0, 12.0))
        return tuple(drivers)

    def roadside(self, outer: tuple[float, float]) -> tuple[Driver, ...]:
        """Posts and signs U(1.5, 6) m beyond either edge of our lanes, every U(40, 200) m."""
        drivers = []
        end = self.ego.state(self.set.duration)[0] + AHEAD
        for edge, side in zip(outer, (-1.0, 1.0), strict=True):
            s = self.dice.between((0.0, 120.0))
            while s < end:
                d = edge + side * self.dice.between((1.5, 6.0))
                drivers.append(self.thing(0.0, s - _CAR, 0.0, d, 0.1))
                s += self.dice.between((40.0, 200.0))
        return tuple(drivers)

    def thing(self, t: float, x: float, speed: float, d: float, length: float) -> Driver:
        """Something that goes straight on; x is on the ego's axis at time t."""
        station = self.ego.state(t)[0] + self.ego.length + x
        wander = np.zeros((1, 3))
        if speed:
            omega = 2.0 * np.pi / self.dice.between(self.set.wander_time)
            amplitude = self.dice.between(self.set.wander) * np.sqrt(2.0)
            wander[0] = amplitude, omega, self.dice.between((0.0, 2.0 * np.pi))
        pieces = np.array([[t, station, speed, 0.0]])
        return Driver(-1, t, self.set.duration, pieces, d, (), wander, length)
