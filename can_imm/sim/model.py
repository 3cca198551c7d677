"""What a scenario is: frozen dataclasses that cannot hold an impossible scenario.

Units are SI (s, m, m/s, m/s²).  Constructing a `Scenario` checks everything that its numbers must
fulfil, whether they come from a TOML file, from `random_scenario` or from a caller's own code.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import radians, sin

from can_imm.types import CanImmError, Manoeuvre

RIGHT, LEFT = 0, 1
"""Lanes: y = 0 and y = lane width."""

MAX_ID = 63
"""Largest object id that a radar frame carries."""
MAX_PATH_ANGLE = radians(30.0)
"""Steepest path across the lanes [rad] that the steering controller is asked to follow."""

SPEED_LABELS = (Manoeuvre.OVERTAKING, Manoeuvre.RECEDING, Manoeuvre.APPROACHING)
"""Manoeuvres in which the vehicle's speed differs from the ego's."""


@dataclass(frozen=True, slots=True)
class Segment:
    """One row of the scenario table (Table 1); it lasts until the next row starts.

    Attributes:
        start: time at which the manoeuvre begins [s].
        label: what the vehicle does; never UNKNOWN or REAR_END (the gap decides that one).
        peak: greatest difference from the ego's speed [m/s], positive whichever its direction.
        direction: of a lane change, +1 left, -1 right, else 0.
        pull_out, pull_in: seconds that an overtaking vehicle takes to the left lane at the start
            and back to the right lane at the end.
    """

    start: float
    label: Manoeuvre
    peak: float = 0.0
    direction: int = 0
    pull_out: float = 0.0
    pull_in: float = 0.0


@dataclass(frozen=True)
class Vehicle:
    """Kinematic bicycle with a Stanley controller, the same for all objects.

    Attributes:
        wheelbase: [m].
        stanley_gain: gain k of the cross-track error [1/s].
        acceleration: of the speed ramps [m/s²]; infinite for steps.
    """

    wheelbase: float = 2.7
    stanley_gain: float = 2.5
    acceleration: float = 2.0


@dataclass(frozen=True, slots=True)
class ScenarioObject:
    """One target vehicle: its id, its distance ahead at the start [m], its lane, what it does."""

    id: int
    gap: float
    lane: int
    segments: tuple[Segment, ...]


@dataclass(frozen=True)
class Scenario:
    """A drive behind one or more vehicles on a road with two lanes.

    Attributes:
        name: for messages and file names.
        duration: the run's end [s], unless an object's gap closes before.
        ego_speed: constant speed of the observing vehicle [m/s].
        lane_width: distance of the lanes' centre lines [m].
        rear_end_gap: an approach counts as REAR_END from this gap down [m].
        vehicle: how the objects are steered.
        objects: at least one.

    Raises:
        CanImmError: an impossible scenario; the message names object, segment and key.
    """

    name: str
    duration: float
    objects: tuple[ScenarioObject, ...]
    ego_speed: float = 60.0 / 3.6
    lane_width: float = 3.0
    rear_end_gap: float = 10.0
    vehicle: Vehicle = Vehicle()

    def __post_init__(self) -> None:
        _check(self)


def windows(scenario: Scenario, target: ScenarioObject) -> Iterator[tuple[Segment, float]]:
    """The object's segments, each with its end [s]."""
    ends = [segment.start for segment in target.segments[1:]] + [scenario.duration]
    return zip(target.segments, ends, strict=True)


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise CanImmError(message)


def _within(value: float, low: float, high: float, unit: str, where: str) -> None:
    """Refuse what is likelier a slip of the pen than a wish; not-a-number is never within."""
    _require(
        low <= value <= high,
        f"{where} must lie between {low:g} and {high:g}{unit}, not {value:g}",
    )


def _check(scenario: Scenario) -> None:
    vehicle = scenario.vehicle
    _within(scenario.duration, 0.1, 3600.0, " s", "duration")
    _within(scenario.ego_speed * 3.6, 10.0, 250.0, " km/h", "ego_speed_kmh")
    _within(scenario.lane_width, 2.0, 6.0, " m", "lane_width")
    _within(scenario.rear_end_gap, 0.1, 250.0, " m", "rear_end_gap")
    _within(vehicle.wheelbase, 1.0, 10.0, " m", "vehicle: wheelbase")
    _within(vehicle.stanley_gain, 0.1, 20.0, " 1/s", "vehicle: stanley_gain")
    _require(
        vehicle.acceleration > 0,
        f"vehicle: acceleration must be above 0 m/s², not {vehicle.acceleration:g}",
    )
    _require(len(scenario.objects) > 0, "object: at least one is needed")
    seen: set[int] = set()
    for number, target in enumerate(scenario.objects, start=1):
        where = f"object {number}"
        _within(target.id, 0, MAX_ID, "", f"{where}: id")
        _require(target.id not in seen, f"{where}: id {target.id} is already taken")
        seen.add(target.id)
        _within(target.gap, 0.1, 250.0, " m", f"{where}: gap")
        _check_segments(scenario, target, where)


def _check_segments(scenario: Scenario, target: ScenarioObject, where: str) -> None:
    _require(len(target.segments) > 0, f"{where}: segments: at least one is needed")
    first = target.segments[0].start
    _require(first == 0.0, f"{where}, segment 1: start must be 0, not {first:g}")
    lane = target.lane
    for number, (segment, end) in enumerate(windows(scenario, target), start=1):
        here = f"{where}, segment {number} ({segment.label.name})"
        last = number == len(target.segments)
        bound = "the run's duration" if last else f"the start of segment {number + 1}"
        _require(
            end > segment.start,
            f"{here}: start {segment.start:g} s is not before {bound}, {end:g} s",
        )
        lane = _check_lane(scenario, segment, end, lane, here)
        if segment.label in SPEED_LABELS:
            _check_speed(scenario, segment, end, here)


def _check_lane(scenario: Scenario, segment: Segment, end: float, lane: int, here: str) -> int:
    """Check where the segment takes the vehicle from ``lane``; return its lane afterwards."""
    name = "right" if lane == RIGHT else "left"
    match segment.label:
        case Manoeuvre.KEEP_RIGHT:
            _require(lane == RIGHT, f"{here}: label: the vehicle is in the left lane")
        case Manoeuvre.KEEP_LEFT:
            _require(lane == LEFT, f"{here}: label: the vehicle is in the right lane")
        case Manoeuvre.LANE_CHANGE:
            _require(
                segment.direction == (+1 if lane == RIGHT else -1),
                f"{here}: direction: the vehicle is in the {name} lane already",
            )
            _check_path(scenario, end - segment.start, "start", here)
            return 1 - lane
        case Manoeuvre.OVERTAKING:
            _require(lane == RIGHT, f"{here}: label: overtaking starts in the right lane")
            _check_path(scenario, segment.pull_out, "pull_out", here)
            _check_path(scenario, segment.pull_in, "pull_in", here)
            _require(
                segment.pull_out + segment.pull_in <= end - segment.start + 1e-9,
                f"{here}: pull_out and pull_in take {segment.pull_out + segment.pull_in:g} s, "
                f"the segment has {end - segment.start:g} s",
            )
        case Manoeuvre.RECEDING | Manoeuvre.APPROACHING:
            pass
        case Manoeuvre.REAR_END:
            raise CanImmError(
                f"{here}: label: write APPROACHING; it becomes REAR_END at the gap 'rear_end_gap'"
            )
        case _:
            raise CanImmError(f"{here}: label: not a manoeuvre to drive")
    return lane


def _check_path(scenario: Scenario, time: float, key: str, here: str) -> None:
    _require(time > 0, f"{here}: {key} must be above 0 s, not {time:g}")
    steepest = scenario.ego_speed * sin(MAX_PATH_ANGLE) * time
    _require(
        scenario.lane_width <= steepest,
        f"{here}: {key}: {scenario.lane_width:g} m sideways in {time:g} s is too steep at "
        f"{scenario.ego_speed * 3.6:g} km/h",
    )


def _check_speed(scenario: Scenario, segment: Segment, end: float, here: str) -> None:
    _within(segment.peak * 3.6, 0.1, 100.0, " km/h", f"{here}: peak_kmh")
    if segment.label is Manoeuvre.APPROACHING:
        _require(
            segment.peak < scenario.ego_speed,
            f"{here}: peak_kmh: {segment.peak * 3.6:g} km/h slower than the ego is not forwards",
        )
    ramps = 2.0 * segment.peak / scenario.vehicle.acceleration
    _require(
        ramps <= end - segment.start + 1e-9,
        f"{here}: peak_kmh: two speed ramps take {ramps:.3g} s, the segment has "
        f"{end - segment.start:.3g} s",
    )
