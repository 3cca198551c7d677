"""What random motorway traffic is drawn from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

from can_imm.types import CanImmError

MAX_LANES = 7
"""In our direction."""
Range = tuple[float, float]


@dataclass(frozen=True)
class MotorwaySettings:
    """What random traffic is drawn from; a pair is the range of a uniform distribution.

    Attributes:
        duration: [s].
        lanes: fewest and most lanes in our direction.
        lane_width: [m].
        ego_speed: [m/s]; its ramps stay within it.
        vehicles: fewest and most vehicles kept around the ego.
        companions: share of the vehicles that stay about the ego and do one manoeuvre after the
            other; the rest keeps a speed of its own and passes or is passed.
        keep: a companion keeps its lane for so long between two manoeuvres [s].
        cruise: its speed minus the ego's meanwhile [m/s]; exactly 0 in half of the cases.
        faster, slower: greatest speed difference of receding and approaching [m/s].
        acceleration: of the speed ramps, one value per vehicle [m/s²].
        change_time: duration of a lane change [s].
        steady_changes: lane changes go at a constant rate instead of smoothly.
        change_while_ramping: probability that a companion changes lane within receding/approaching.
        passing: speed difference of those that keep their own speed [m/s], either sign.
        wander: standard deviation of the lateral wander, one value per vehicle [m].
        wander_time: periods of the wander's oscillations [s].
        ego_change_rate: wish of the ego for a lane change [1/s].
        ego_ramp: change of the ego's speed by one ramp [m/s], either sign.
        ego_acceleration: of the ego's ramps [m/s²].
        curves, ego_lane_changes, ego_ramps, oncoming, roadside: switches.
        noise: factor on the standard deviations of the radar and of the measured ego motion.
    """

    duration: float = 60.0
    lanes: tuple[int, int] = (2, 4)
    lane_width: Range = (3.4, 3.8)
    ego_speed: Range = (20.0, 36.0)
    vehicles: tuple[int, int] = (4, 10)
    companions: float = 0.6
    keep: Range = (4.0, 14.0)
    cruise: Range = (-0.2, 0.2)
    faster: Range = (1.5, 6.0)
    slower: Range = (1.5, 5.0)
    acceleration: Range = (1.0, 2.6)
    change_time: Range = (3.0, 6.0)
    steady_changes: bool = False
    change_while_ramping: float = 0.1
    passing: Range = (1.2, 9.0)
    wander: Range = (0.10, 0.30)
    wander_time: Range = (5.0, 25.0)
    ego_change_rate: float = 1.0 / 60.0
    ego_ramp: Range = (1.5, 4.0)
    ego_acceleration: Range = (0.3, 1.0)
    curves: bool = True
    ego_lane_changes: bool = True
    ego_ramps: bool = True
    oncoming: bool = True
    roadside: bool = True
    noise: float = 1.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, tuple) and not value[0] <= value[1]:
                raise CanImmError(f"motorway: {field.name}: {value[0]} is above {value[1]}")
        if not 1.0 <= self.duration <= 3600.0:
            raise CanImmError(f"motorway: duration must be 1 s to 3600 s, not {self.duration:g}")
        if not 1 <= self.lanes[0] <= self.lanes[1] <= MAX_LANES:
            raise CanImmError(f"motorway: lanes must be 1 to {MAX_LANES}")


TUNING = MotorwaySettings()
"""Traffic on which parameters are chosen."""
REPORTING = MotorwaySettings(
    lanes=(2, 3),
    lane_width=(3.5, 3.75),
    ego_speed=(22.0, 34.0),
    vehicles=(5, 9),
    companions=0.55,
    keep=(3.5, 12.0),
    cruise=(-0.15, 0.25),
    faster=(1.7, 5.0),
    slower=(1.7, 4.5),
    acceleration=(1.2, 2.2),
    change_time=(3.4, 5.6),
    change_while_ramping=0.15,
    passing=(1.5, 8.0),
    wander=(0.10, 0.28),
    wander_time=(5.0, 20.0),
    ego_change_rate=1.0 / 45.0,
    ego_ramp=(1.2, 3.5),
    ego_acceleration=(0.4, 0.9),
    noise=1.1,
)
"""Traffic on which accuracy is reported: nothing is tuned on it."""
VARIANTS = {"tuning": TUNING, "reporting": REPORTING}
FULL, PLAIN, PUBLISHED = "full", "plain", "published"
"""Names of `KINDS`."""


def motorway_settings(name: str) -> MotorwaySettings:
    """The settings of that name.

    Raises:
        CanImmError: there are none.
    """
    if name not in VARIANTS:
        raise CanImmError(f"no motorway settings '{name}'; there are {', '.join(VARIANTS)}")
    return VARIANTS[name]


def plain(settings: MotorwaySettings) -> MotorwaySettings:
    """The same on a straight road, at a constant ego speed, without anything but our traffic."""
    return replace(
        settings,
        curves=False,
        ego_lane_changes=False,
        ego_ramps=False,
        oncoming=False,
        roadside=False,
    )


def published(settings: MotorwaySettings) -> MotorwaySettings:
    """The same, and everybody moves as in the published scenario: lanes are kept without wander and
    changed at a constant rate.  The radar has its usual noise."""
    return replace(
        plain(settings),
        change_time=(2.0, 4.0),
        steady_changes=True,
        wander=(0.0, 0.0),
        noise=1.0,
    )


KINDS: dict[str, Callable[[MotorwaySettings], MotorwaySettings]] = {
    FULL: lambda settings: settings,
    PLAIN: plain,
    PUBLISHED: published,
}
"""Kinds of traffic that can be drawn from settings."""
