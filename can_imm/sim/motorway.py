"""Random motorway traffic seen from a vehicle in its midst, and the truth about every object.

`can_imm.sim.traffic` decides who drives where on the road; here everybody's motion is computed
every 10 ms and given labels.

The labels follow the true motion along the road.  Let dv be the object's speed along the road minus
the ego's.  In order of precedence:

- ONCOMING: it moves against our direction (all of its life); STATIONARY: it does not move;
- LANE_CHANGE: from the start to the end of the object's own movement from one lane to the next;
- REAR_END: an APPROACHING object in the ego's lane, x <= 10 m;
- RECEDING, APPROACHING: dv is above 0.5 m/s (below -0.5 m/s) and reaches 1 m/s in that stretch,
  extended over the rest of the ramps at both its ends: as long as |dv| keeps growing there before
  the stretch, and keeps falling after it.  It does not matter who accelerates, the object or the
  ego;
- KEEP_LANE otherwise.

Flags: CUT_IN and CUT_OUT during a lane change into or out of the lane in which the ego then is;
OVERTAKING_ANOTHER after a change to the left (from its start, for 20 s, but not beyond the start of
its next change) while a vehicle in the lane that it left is at least 0.5 m/s slower and up to 40 m
ahead or 10 m behind.

Velocities are v_object - v_ego in the ego's axes; they contain no term from the turning of those
axes, so that in a bend, or while the ego's heading changes, vy is not the rate of change of y.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from can_imm.sim.motorway_model import (
    AHEAD,
    BEHIND,
    Driver,
    Int8Array,
    Int64Array,
    LaneChange,
    MotorwayScenario,
)
from can_imm.sim.motorway_settings import (
    FULL,
    KINDS,
    PLAIN,
    PUBLISHED,
    REPORTING,
    TUNING,
    VARIANTS,
    MotorwaySettings,
    motorway_settings,
    plain,
    published,
)
from can_imm.sim.road import Road
from can_imm.sim.traffic import random_motorway
from can_imm.types import (
    CUT_IN,
    CUT_OUT,
    OVERTAKING_ANOTHER,
    VX,
    VY,
    FloatArray,
    Manoeuvre,
    X,
    Y,
)

__all__ = [
    "FULL",
    "KINDS",
    "PLAIN",
    "PUBLISHED",
    "REPORTING",
    "TUNING",
    "VARIANTS",
    "Driver",
    "EgoTruth",
    "LaneChange",
    "MotorwayScenario",
    "MotorwaySettings",
    "MotorwayTruth",
    "ObjectTruth",
    "drive",
    "motorway_settings",
    "plain",
    "published",
    "random_motorway",
]

DT_NS = 10_000_000
"""Time between samples [ns]."""
_DT = DT_NS * 1e-9
REAR_END_GAP = 10.0
"""[m], see the module's text."""
STEADY, PEAK = 0.5, 1.0
"""Thresholds of dv [m/s], see the module's text."""
_OVERTAKING_TIME, _OVERTAKING_AHEAD, _OVERTAKING_BEHIND = 20.0, 40.0, 10.0
"""[s, m, m], see the module's text."""
MAX_LANE = 7
"""Lanes further away than that count as this one."""


@dataclass(frozen=True, eq=False, slots=True)
class EgoTruth:
    """The ego's motion, every 10 ms from 0 on; (N,) each.

    Attributes:
        station, d: of the middle of the front bumper [m].
        speed: over ground [m/s].
        heading: [rad], against the road at its first station.
        yaw_rate: [rad/s].
        lane: counted from the right, 0 to n_lanes - 1.
        direction: of the ego's own lane change, +1 left, -1 right, else 0.
        x, y, vx, vy: place and velocity over ground [m, m/s].
    """

    station: FloatArray
    d: FloatArray
    speed: FloatArray
    heading: FloatArray
    yaw_rate: FloatArray
    lane: Int8Array
    direction: Int8Array
    x: FloatArray
    y: FloatArray
    vx: FloatArray
    vy: FloatArray


@dataclass(frozen=True, eq=False, slots=True)
class ObjectTruth:
    """One object's motion in N samples from the scenario's sample ``first`` on.

    Attributes:
        object_id: number of the true object, the same as its place in `MotorwayTruth.objects`.
        t_ns: (N,) [ns].
        state: (N, 4) x, vx, y, vy of its rear's middle, from the ego's front [m, m/s, m, m/s].
        label: (N,) value of `Manoeuvre`.
        direction: (N,) during a lane change +1 left, -1 right, else 0.
        lane: (N,) 0 the ego's, +1 the next to the left.
        flags: (N,) bits `CUT_IN`, `CUT_OUT`, during such a lane change.
        speed: (N,) over ground along the road [m/s], negative against our direction.
        station, d: (N,) where on the road [m].
        driver: its course.
    """

    object_id: int
    first: int
    t_ns: Int64Array
    state: FloatArray
    label: Int8Array
    direction: Int8Array
    lane: Int8Array
    flags: Int8Array
    speed: FloatArray
    station: FloatArray
    d: FloatArray
    driver: Driver
    dt_ns: int = DT_NS

    def sample(self, t_ns: int) -> int:
        """Index of the sample at or before a time; -1 if the object is not there then."""
        i = (t_ns - int(self.t_ns[0])) // DT_NS
        return i if 0 <= i < len(self.t_ns) else -1


@dataclass(frozen=True, eq=False, slots=True)
class MotorwayTruth:
    """What truly happens, every 10 ms; ``t_ns`` (N,) are the ego's times."""

    scenario: MotorwayScenario
    t_ns: Int64Array
    ego: EgoTruth
    objects: tuple[ObjectTruth, ...]


def drive(scenario: MotorwayScenario) -> MotorwayTruth:
    """Compute everybody's motion."""
    n = int(scenario.duration / _DT + 1e-6) + 1
    t = np.arange(n, dtype=np.float64) * _DT
    ego, ego_rate = _ego(scenario, t)
    objects: list[ObjectTruth] = []
    traffic: list[ObjectTruth] = []
    for drivers, label in (
        (scenario.drivers, None),
        (scenario.oncoming, Manoeuvre.ONCOMING),
        (scenario.roadside, Manoeuvre.STATIONARY),
    ):
        for driver in drivers:
            truth = _object(scenario, driver, t, ego, ego_rate, label, len(objects))
            if truth is not None:
                objects.append(truth)
                if label is None:
                    traffic.append(truth)
    for truth in traffic:
        _overtaking_flags(scenario, truth, [other for other in traffic if other is not truth])
    return MotorwayTruth(scenario, np.arange(n, dtype=np.int64) * DT_NS, ego, tuple(objects))


def _ego(scenario: MotorwayScenario, t: FloatArray) -> tuple[EgoTruth, tuple[FloatArray, ...]]:
    s, v, a = scenario.ego.along(t)
    s = s + scenario.ego.length
    d, across = scenario.ego.across(t)
    x, y, vx, vy = _place(scenario.road, s, v, d, across)
    heading = np.arctan2(vy, vx)
    heading = np.unwrap(heading)
    lane = np.clip(np.rint(d / scenario.lane_width), 0, scenario.n_lanes - 1).astype(np.int8)
    truth = EgoTruth(
        station=s,
        d=d,
        speed=np.hypot(vx, vy),
        heading=heading,
        yaw_rate=np.gradient(heading, _DT),
        lane=lane,
        direction=scenario.ego.changing(t),
        x=x,
        y=y,
        vx=vx,
        vy=vy,
    )
    return truth, (v, a)


def _place(
    road: Road, s: FloatArray, v: FloatArray, d: FloatArray, across: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Place and velocity over ground of what moves with v along and ``across`` the road."""
    curvature, heading, x, y = road.at(s)
    cos, sin = np.cos(heading), np.sin(heading)
    along = v * (1.0 - curvature * d)
    return x - d * sin, y + d * cos, along * cos - across * sin, along * sin + across * cos


def _object(
    scenario: MotorwayScenario,
    driver: Driver,
    all_t: FloatArray,
    ego: EgoTruth,
    ego_rate: tuple[FloatArray, ...],
    fixed_label: Manoeuvre | None,
    number: int,
) -> ObjectTruth | None:
    first = max(int(np.ceil(driver.start / _DT - 1e-6)), 0)
    last = min(int(driver.end / _DT + 1e-6), len(all_t) - 1)
    s, v, a = driver.along(all_t[first : last + 1])
    there = np.flatnonzero(
        (s - ego.station[first : last + 1] > BEHIND) & (s - ego.station[first : last + 1] < AHEAD)
    )
    if len(there) < 2:
        return None
    # one uninterrupted stay: what leaves and returns counts as gone at its first leaving
    stop = np.flatnonzero(np.diff(there) > 1)
    there = there[: stop[0] + 1] if len(stop) else there
    first, s, v, a = first + int(there[0]), s[there], v[there], a[there]
    span = slice(first, first + len(there))
    t = all_t[span]
    d, across = driver.across(t)
    x, y, vx, vy = _place(scenario.road, s, v, d, across)
    cos, sin = np.cos(ego.heading[span]), np.sin(ego.heading[span])
    dx, dy = x - ego.x[span], y - ego.y[span]
    dvx, dvy = vx - ego.vx[span], vy - ego.vy[span]
    state = np.empty((len(t), 4))
    state[:, X], state[:, Y] = cos * dx + sin * dy, cos * dy - sin * dx
    state[:, VX], state[:, VY] = cos * dvx + sin * dvy, cos * dvy - sin * dvx
    centre = ego.lane[span] * scenario.lane_width
    lane = np.rint((d - centre) / scenario.lane_width)
    lane = np.clip(lane, -MAX_LANE, MAX_LANE).astype(np.int8)
    direction = driver.changing(t)
    flags = np.zeros(len(t), np.int8)
    if fixed_label is not None:
        label = np.full(len(t), fixed_label, np.int8)
    else:
        ego_v, ego_a = ego_rate
        label = _speed_labels(v - ego_v[span], a - ego_a[span])
        near = (lane == 0) & (state[:, X] <= REAR_END_GAP)
        label[near & (label == Manoeuvre.APPROACHING)] = Manoeuvre.REAR_END
        label[direction != 0] = Manoeuvre.LANE_CHANGE
        _cut_flags(scenario, driver, t, ego.lane[span], flags)
    return ObjectTruth(
        object_id=number,
        first=first,
        t_ns=np.arange(first, first + len(t), dtype=np.int64) * DT_NS,
        state=state,
        label=label,
        direction=direction,
        lane=lane,
        flags=flags,
        speed=np.copysign(np.hypot(vx, vy), v),
        station=s,
        d=d,
        driver=driver,
    )


def _speed_labels(dv: FloatArray, rate: FloatArray) -> Int8Array:
    """KEEP_LANE, RECEDING and APPROACHING by the rule in the module's text.

    Args:
        dv: (N,) speed minus the ego's [m/s].
        rate: (N,) its rate of change [m/s²].
    """
    label = np.full(len(dv), Manoeuvre.KEEP_LANE, np.int8)
    for sign, name in ((1.0, Manoeuvre.RECEDING), (-1.0, Manoeuvre.APPROACHING)):
        above = np.concatenate(([False], sign * dv > STEADY, [False]))
        edges = np.flatnonzero(np.diff(above))
        grown = (sign * dv >= -1e-9) & (sign * dv <= STEADY)
        for begin, end in edges.reshape(-1, 2).tolist():
            if np.max(sign * dv[begin:end]) < PEAK:
                continue
            while begin > 0 and sign * rate[begin - 1] > 1e-9 and grown[begin - 1]:
                begin -= 1
            while end < len(dv) and sign * rate[end] < -1e-9 and grown[end]:
                end += 1
            label[begin:end] = name
    return label


def _cut_flags(
    scenario: MotorwayScenario,
    driver: Driver,
    t: FloatArray,
    ego_lane: Int8Array,
    flags: Int8Array,
) -> None:
    """Set `CUT_IN` and `CUT_OUT` during lane changes into and out of the ego's lane."""
    d = driver.d
    for change in driver.changes:
        before, after = (round(at / scenario.lane_width) for at in (d, d + change.shift))
        d += change.shift
        during = (t >= change.start - 1e-9) & (t < change.start + change.time - 1e-9)
        flags[during & (ego_lane == after)] |= CUT_IN
        flags[during & (ego_lane == before)] |= CUT_OUT


def _overtaking_flags(
    scenario: MotorwayScenario, truth: ObjectTruth, others: list[ObjectTruth]
) -> None:
    """Set `OVERTAKING_ANOTHER` by the rule in the module's text."""
    width, driver = scenario.lane_width, truth.driver
    d = driver.d
    ends = [change.start for change in driver.changes[1:]] + [np.inf]
    for change, end in zip(driver.changes, ends[: len(driver.changes)], strict=True):
        left_lane = round(d / width)
        d += change.shift
        if change.shift < 0.0:
            continue
        until = min(change.start + _OVERTAKING_TIME, scenario.duration + 1.0, end)
        for other in others:
            first = max(truth.first, other.first, int(np.ceil(change.start / _DT - 1e-6)))
            stop = min(
                truth.first + len(truth.t_ns),
                other.first + len(other.t_ns),
                int(np.ceil(until / _DT - 1e-6)),
            )
            if first >= stop:
                continue
            mine = slice(first - truth.first, stop - truth.first)
            its = slice(first - other.first, stop - other.first)
            gap = other.station[its] - truth.station[mine]
            flagged = (
                (np.rint(other.d[its] / width) == left_lane)
                & (truth.speed[mine] - other.speed[its] >= STEADY)
                & (gap < _OVERTAKING_AHEAD)
                & (gap > -_OVERTAKING_BEHIND)
            )
            truth.flags[mine][flagged] |= OVERTAKING_ANOTHER
