"""Where everybody on the motorway is going to be, and whether somebody fits in between.

Every vehicle, the ego included, commits itself to one manoeuvre after the other.  A manoeuvre fits
if the vehicle keeps its distance until the manoeuvre's end, and some seconds beyond at its last
speed, from what all others have committed themselves to; those of the others who decide later must
respect it in turn.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from can_imm.sim.motorway_model import LaneChange
from can_imm.types import FloatArray

DT = 0.1
"""Time step of the distance checks [s]."""
BEYOND = 4.0
"""A manoeuvre must leave room for so long after its end [s]."""
MIN_GAP, MIN_EGO_GAP = 6.0, 2.5
"""Least distance between bumpers [m], and that ahead of the ego."""
CHANGE_ROOM, EGO_CHANGE_ROOM = 2.0, 12.0
"""So much more is needed in the lane that a vehicle, or the ego, changes to [m]."""
EGO = 0
"""Number of the ego's plan."""

Piece = tuple[float, float]
"""Duration [s] and acceleration [m/s²]."""
Row = tuple[float, float, float, float]
"""From time t [s] on: station [m], speed [m/s], acceleration [m/s²]; see `Driver.pieces`."""
Int8Array = npt.NDArray[np.int8]


@dataclass
class Plan:
    """A vehicle while its course is being decided.

    Attributes:
        number: place in `Plans.plans`.
        start, end: when it enters and leaves [s]; until then ``end`` is infinite.
        rows: its motion; the last row holds from its time on.
        lane: the one it is in or changing to; ``first_lane`` that at the start.
        length: [m].
        companion: it stays about the ego; otherwise it passes or is passed.
        acceleration: of its speed ramps [m/s²].
        mix: see `LaneChange`.
        cruise: speed minus the ego's that it keeps between manoeuvres [m/s].
        until: time of its next decision [s].
        last: name of its last move.
    """

    number: int
    start: float
    rows: list[Row]
    lane: int
    first_lane: int
    length: float
    companion: bool
    acceleration: float
    mix: float
    cruise: float
    until: float
    end: float = np.inf
    changes: list[LaneChange] = field(default_factory=list)
    last: str = "enter"

    def state(self, t: float) -> tuple[float, float]:
        """Station of its rear [m] and speed [m/s] at a time [s] after its start."""
        row = next((row for row in reversed(self.rows) if row[0] <= t + 1e-9), self.rows[0])
        t0, s, v, a = row
        since = t - t0
        return s + v * since + 0.5 * a * since * since, v + a * since


@dataclass(frozen=True)
class Move:
    """A candidate: speed pieces from now on, and a change to ``lane`` [s] from now, if another."""

    name: str
    pieces: tuple[Piece, ...]
    lane: int
    at: float = 0.0
    time: float = 0.0

    @property
    def duration(self) -> float:
        """[s]"""
        return max(sum(time for time, _ in self.pieces), self.at + self.time)


@dataclass(frozen=True)
class Course:
    """Where a vehicle is in each column: station of its rear [m], lowest and highest lane."""

    station: FloatArray
    low: Int8Array
    high: Int8Array


class Plans:
    """All plans, and tables of their courses: a row per vehicle, a column per 0.1 s.

    Args:
        duration: how far the tables reach [s].
        steady_changes: lane changes go at a constant rate.
    """

    def __init__(self, duration: float, steady_changes: bool = False) -> None:
        self.steady_changes = steady_changes
        self.columns = int(duration / DT) + 1
        self.plans: list[Plan] = []
        self.station: FloatArray = np.empty((0, self.columns))
        self.low: Int8Array = np.empty((0, self.columns), np.int8)
        self.high: Int8Array = np.empty((0, self.columns), np.int8)
        self.length: FloatArray = np.empty(0)

    def column(self, t: float) -> int:
        """The column at or before a time [s]."""
        return int(t / DT + 1e-6)

    def others(self, number: int, t: float) -> list[int]:
        """Numbers of all but this one who have not left at a time [s]."""
        return [p.number for p in self.plans if p.number != number and p.end > t]

    def ahead(self, plan: Plan, t: float) -> float:
        """x of the plan's rear from the ego's front [m]."""
        ego = self.plans[EGO]
        return plan.state(t)[0] - ego.state(t)[0] - ego.length

    def steady(self, t: float, station: float, speed: float, lane: int) -> Course:
        """The course of who keeps lane and speed from a time on."""
        k = self.column(t)
        lanes = np.full(self.columns, lane, np.int8)
        course = Course(np.full(self.columns, np.nan), lanes, lanes.copy())
        course.station[k:] = station + speed * (np.arange(k, self.columns) * DT - t)
        return course

    def enter(self, plan: Plan) -> None:
        """Add a plan, as it stands at its start."""
        t, station, speed, _ = plan.rows[0]
        course = self.steady(t, station, speed, plan.lane)
        self.plans.append(plan)
        self.station = np.vstack([self.station, course.station])
        self.low = np.vstack([self.low, course.low])
        self.high = np.vstack([self.high, course.high])
        self.length = np.append(self.length, plan.length)

    def leave(self, plan: Plan, t: float) -> None:
        """End a plan."""
        plan.end = t
        self.station[plan.number, self.column(t) + 1 :] = np.nan

    def room(
        self, number: int, length: float, course: Course, columns: slice, others: list[int]
    ) -> FloatArray:
        """(others, columns) distance to each other one in the same lane beyond the least one [m],
        infinite where the lanes differ; ``number`` is that of who takes the course, -1 for none."""
        along = self.station[others, columns] - course.station[columns]
        behind = np.where(along > 0.0, length, self.length[others][:, None])
        least = np.full(along.shape, MIN_GAP)
        if number == EGO:
            least[along > 0.0] = MIN_EGO_GAP
        elif EGO in others:
            row = others.index(EGO)
            least[row, along[row] < 0.0] = MIN_EGO_GAP
        same = (self.low[others, columns] <= course.high[columns]) & (
            self.high[others, columns] >= course.low[columns]
        )
        room = np.abs(along) - behind - least
        return np.where(same & np.isfinite(along), room, np.inf)

    def least_room(self, plan: Plan, t: float, move: Move) -> float:
        """The least room that a move leaves [m], see `room`."""
        columns, course = self.course(plan, t, move)
        others = self.others(plan.number, t)
        room = self.room(plan.number, plan.length, course, columns, others)
        return float(room.min(initial=np.inf))

    def fits(self, plan: Plan, t: float, move: Move) -> bool:
        """Is there room for a move that begins at a time?"""
        columns, course = self.course(plan, t, move)
        others = self.others(plan.number, t)
        room = self.room(plan.number, plan.length, course, columns, others)
        if (room < 0.0).any():
            return False
        if move.lane == plan.lane:
            return True
        begin, end = self.column(t + move.at), self.column(t + move.at + move.time)
        during = slice(max(begin - columns.start, 0), end - columns.start)
        # only those of the lane to come: from the others it goes away
        there = (self.low[others, columns] <= move.lane) & (self.high[others, columns] >= move.lane)
        extra = EGO_CHANGE_ROOM if plan.number == EGO else CHANGE_ROOM
        return not ((room < extra) & there)[:, during].any()

    def course(self, plan: Plan, t: float, move: Move) -> tuple[slice, Course]:
        """The columns in which a move needs room, and the plan's course with it."""
        k = self.column(t) + 1
        stop = min(self.column(t + move.duration + BEYOND) + 1, self.columns)
        station = self.station[plan.number].copy()
        low, high = self.low[plan.number].copy(), self.high[plan.number].copy()
        station[k:] = _stations(
            _rows(plan, t, move), np.arange(k, self.columns, dtype=np.float64) * DT
        )
        low[k:] = high[k:] = plan.lane
        if move.lane != plan.lane:
            begin = max(self.column(t + move.at), k)
            end = self.column(t + move.at + move.time) + 1
            low[begin:] = high[begin:] = move.lane
            low[begin:end] = min(plan.lane, move.lane)
            high[begin:end] = max(plan.lane, move.lane)
        return slice(k, max(stop, k + 1)), Course(station, low, high)

    def commit(self, plan: Plan, t: float, move: Move, lane_width: float) -> None:
        """Make a move part of the plan."""
        _, course = self.course(plan, t, move)
        i = plan.number
        self.station[i], self.low[i], self.high[i] = course.station, course.low, course.high
        rows = _rows(plan, t, move)
        plan.rows = [row for row in plan.rows if row[0] < t - 1e-9] + rows
        if move.lane != plan.lane:
            shift = (move.lane - plan.lane) * lane_width
            start, steady = t + move.at, self.steady_changes
            plan.changes.append(LaneChange(start, move.time, shift, plan.mix, steady))
            plan.lane = move.lane
        plan.until = t + max(move.duration, 0.5)
        plan.last = move.name

    def colliding(self, end: float) -> set[int]:
        """Who came too near to an earlier one until ``end`` [s], where there was no way out."""
        found: set[int] = set()
        columns = slice(0, self.column(end) + 1)
        for plan in self.plans[1:]:
            i = plan.number
            others = [j for j in range(i) if j not in found]
            course = Course(self.station[i], self.low[i], self.high[i])
            if (self.room(i, plan.length, course, columns, others) < 0.0).any():
                found.add(i)
        return found


def ramp(v: float, to: float, acceleration: float) -> Piece:
    """From one speed to another, in a time rounded up to 10 ms."""
    time = np.ceil(abs(to - v) / acceleration * 100.0 - 1e-6) / 100.0
    return (float(time), (to - v) / float(time)) if time > 0.0 else (0.0, 0.0)


def _rows(plan: Plan, t: float, move: Move) -> list[Row]:
    s, v = plan.state(t)
    rows = []
    for time, a in move.pieces:
        if time > 0.0:
            rows.append((t, s, v, a))
            s, v, t = s + v * time + 0.5 * a * time**2, v + a * time, t + time
    return [*rows, (t, s, v, 0.0)]


def _stations(rows: list[Row], t: FloatArray) -> FloatArray:
    table = np.array(rows)
    i = np.maximum(np.searchsorted(table[:, 0], t + 1e-9, side="right") - 1, 0)
    since = t - table[i, 0]
    return np.asarray(table[i, 1] + (table[i, 2] + 0.5 * table[i, 3] * since) * since)
