"""What each vehicle on the motorway wishes to do next, and its ways out where there is no room."""

from __future__ import annotations

from functools import partial

import numpy as np

from can_imm.sim.motorway_settings import MotorwaySettings, Range
from can_imm.sim.plans import EGO, Move, Plan, Plans, ramp

_NEAR, _FAR = 15.0, 90.0
"""Gaps [m] below which companions rather recede and above which they rather approach."""
_HARD = 3.0
"""Acceleration of who must adapt its speed at once [m/s²]."""


class Dice:
    """Draws, from a generator that is the only source of randomness."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def between(self, pair: Range) -> float:
        """Uniform within a range."""
        return float(self.rng.uniform(*pair))

    def chance(self, probability: float) -> bool:
        """True with this probability."""
        return bool(self.rng.random() < probability)

    def pass_speed(self, settings: MotorwaySettings, faster: float) -> float:
        """Speed minus the ego's [m/s] of who passes, or else (1 - ``faster``) is passed."""
        return self.between(settings.passing) * (1.0 if self.chance(faster) else -1.0)

    def cruise(self, settings: MotorwaySettings) -> float:
        """A companion's speed minus the ego's [m/s]."""
        return self.between(settings.cruise) if self.chance(0.5) else 0.0


class Wishes:
    """Candidates for a vehicle's next move, the best first."""

    def __init__(self, dice: Dice, settings: MotorwaySettings, plans: Plans, n_lanes: int) -> None:
        self.dice, self.set, self.plans, self.n_lanes = dice, settings, plans, n_lanes

    @property
    def ego(self) -> Plan:
        """The ego's plan."""
        return self.plans.plans[EGO]

    def choose(self, plan: Plan, t: float) -> Move:
        """The first move that fits, of the vehicle's wishes and then of its ways out."""
        if plan.number == EGO:
            wishes = [self.ego_wish(plan, t)]
        elif plan.companion:
            wishes = [self.companion_wish(plan, t) for _ in range(4)]
        else:
            wishes = [self.passing_wish(plan, t)]
        for move in [*wishes, *self.ways_out(plan, t)]:
            if self.plans.fits(plan, t, move):
                return move
        return self.least_evil(plan, t)

    def ego_wish(self, plan: Plan, t: float) -> Move:
        """Mostly to keep lane and speed."""
        settings = self.set
        time = self.dice.between((6.0, 14.0))
        closing = any(
            p.last == "approach" and p.lane == plan.lane and p.until > t for p in self.plans.plans
        )
        if closing and self.dice.chance(0.8):
            # whoever lets the gap shrink may do so to the end
            return Move("keep", ((time, 0.0),), plan.lane)
        if settings.ego_lane_changes and self.dice.chance(10.0 * settings.ego_change_rate):
            lane = self.neighbour(plan)
            return Move("change", (), lane, 0.0, self.dice.between(settings.change_time))
        if settings.ego_ramps and self.dice.chance(0.25):
            v = plan.state(t)[1]
            to = v + self.dice.between(settings.ego_ramp) * (1.0 if self.dice.chance(0.5) else -1.0)
            low, high = settings.ego_speed
            to = min(max(to, low), high)
            a = self.dice.between(settings.ego_acceleration)
            return Move("ramp", (ramp(v, to, a), (time, 0.0)), plan.lane)
        return Move("keep", ((time, 0.0),), plan.lane)

    def neighbour(self, plan: Plan) -> int:
        """A lane next to the vehicle's, or its own if there is only one."""
        lanes = [n for n in (plan.lane - 1, plan.lane + 1) if 0 <= n < self.n_lanes]
        return int(self.dice.rng.choice(lanes)) if lanes else plan.lane

    def change(self, plan: Plan) -> Move:
        return Move(
            "change", (), self.neighbour(plan), 0.0, self.dice.between(self.set.change_time)
        )

    def passing_wish(self, plan: Plan, t: float) -> Move:
        """Keep one's own speed, and sometimes change lane; get back to a speed once given up."""
        dv = plan.state(t)[1] - self.ego.state(t)[1]
        if plan.last != "change" and self.dice.chance(0.3):
            return self.change(plan)
        if abs(dv) < self.set.passing[0]:
            dv_to = self.dice.pass_speed(self.set, 0.5)
            to_cruise = ramp(dv, dv_to, plan.acceleration)
            return Move("pass", (to_cruise, (self.dice.between((3.0, 6.0)), 0.0)), plan.lane)
        return Move("keep", ((self.dice.between((2.0, 6.0)), 0.0),), plan.lane)

    def companion_wish(self, plan: Plan, t: float) -> Move:
        """See `can_imm.sim.traffic.random_motorway`."""
        dv = plan.state(t)[1] - self.ego.state(t)[1]
        x = self.plans.ahead(plan, t)
        if abs(dv) > 0.5 and (plan.last != "change" or self.dice.chance(0.5)):
            return self.adapt(plan, dv, plan.cruise)
        if plan.last != "keep" and (plan.last == "change" or self.dice.chance(0.9)):
            time = self.dice.between(self.set.keep)
            to_cruise = ramp(dv, plan.cruise, plan.acceleration)
            return Move("keep", (to_cruise, (time, 0.0)), plan.lane)
        if x < _NEAR:
            weights = (0.25, 0.75, 0.0)
        elif x > _FAR:
            weights = (0.3, 0.0, 0.7)
        else:
            weights = (0.4, 0.25, 0.35)
        if plan.lane == self.ego.lane and x >= _NEAR:
            weights = (0.15, 0.15, 0.7)
        kind = self.dice.rng.choice(3, p=weights)
        if kind == 0:
            return self.change(plan)
        move = self.recede(plan, dv) if kind == 1 else self.approach(plan, dv, x)
        if self.dice.chance(self.set.change_while_ramping):
            at = self.dice.between((0.0, 0.5)) * move.duration
            lane, time = self.neighbour(plan), self.dice.between(self.set.change_time)
            return Move(move.name, move.pieces, lane, at, time)
        return move

    def adapt(self, plan: Plan, dv: float, to: float) -> Move:
        """Take on the ego's speed, or one a little beside it."""
        return Move("adapt", (ramp(dv, to, plan.acceleration),), plan.lane)

    def recede(self, plan: Plan, dv: float) -> Move:
        """Let the gap grow for a while."""
        peak = self.dice.between(self.set.faster)
        up, down = ramp(dv, peak, plan.acceleration), ramp(peak, plan.cruise, plan.acceleration)
        return Move("recede", (up, (self.dice.between((1.0, 7.0)), 0.0), down), plan.lane)

    def approach(self, plan: Plan, dv: float, x: float) -> Move:
        """Let the gap shrink; in the ego's lane mostly until REAR_END."""
        if plan.lane != self.ego.lane:
            to = self.dice.between((-8.0, max(x - 8.0, 0.0)))
        else:
            to = self.dice.between((3.0, 9.0) if self.dice.chance(0.75) else (12.0, 30.0))
        to = min(to, x - 4.0)
        peak = -self.dice.between(self.set.slower)
        for _ in range(8):
            down, up = (
                ramp(dv, peak, plan.acceleration),
                ramp(peak, plan.cruise, plan.acceleration),
            )
            left = to - x - 0.5 * down[0] * (dv + peak) - 0.5 * up[0] * (peak + plan.cruise)
            if left <= 0.0:
                break
            peak *= 0.8
        return Move("approach", (down, (max(left / peak, 0.0), 0.0), up), plan.lane)

    # -- when there is no room for wishes -----------------------------------------------------

    def ways_out(self, plan: Plan, t: float) -> list[Move]:
        """Carry on, change lane, take on the speed of somebody nearby; the first that fits."""
        v = plan.state(t)[1]
        moves = [Move("keep", ((time, 0.0),), plan.lane) for time in (3.0, 1.0)]
        if plan.number != EGO or self.set.ego_lane_changes:
            moves += [
                Move("change", (), lane, 0.0, self.dice.between(self.set.change_time))
                for lane in (plan.lane + 1, plan.lane - 1)
                if 0 <= lane < self.n_lanes
            ]
        s = plan.state(t)[0]
        near = []
        for number in self.plans.others(plan.number, t):
            other = self.plans.plans[number]
            if plan.lane in (other.lane, self.plans.low[number, self.plans.column(t)]):
                s_other, v_other = other.state(t)
                near.append((abs(s_other - s), v_other))
        for _, v_other in sorted(near)[:3]:
            for a in (plan.acceleration, _HARD):
                moves.append(Move("adapt", (ramp(v, v_other, a),), plan.lane))
        return moves

    def least_evil(self, plan: Plan, t: float) -> Move:
        """Of braking, keeping speed and accelerating what leaves the most room."""
        v = plan.state(t)[1]
        moves = [
            Move("adapt", (ramp(v, max(v + dv, 5.0), _HARD),), plan.lane)
            for dv in (0.0, -3.0, -6.0, 3.0, 6.0)
        ]
        return max(moves, key=partial(self.plans.least_room, plan, t))
