"""Random motorway traffic as the frames of a profile's radar and of the vehicle that carries it."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from can_imm.bus.frame import Frame
from can_imm.bus.profile import load_profile
from can_imm.bus.radar_encoder import ProfileEncoder
from can_imm.cli.reports import DIRECTION, STATES, seconds
from can_imm.runtime.loop import STEP_NS
from can_imm.sim.motorway import MotorwayTruth, drive, motorway_settings, random_motorway
from can_imm.sim.radar import ego_messages, observe, radar_model
from can_imm.types import CUT_IN, CUT_OUT, OVERTAKING_ANOTHER, Manoeuvre, Scan

if TYPE_CHECKING:
    from can_imm.bus.profile_parts import Profile

EVENTS = {CUT_IN: "CUT_IN", CUT_OUT: "CUT_OUT", OVERTAKING_ANOTHER: "OVERTAKING"}


@dataclass(eq=False, slots=True)
class Moment:
    """What is sent at a time [ns]: the ego's motion (speed [m/s], yaw rate [rad/s]), a scan."""

    t_ns: int
    ego: tuple[float, float] | None
    scan: Scan | None


class MotorwayEncoder:
    """The frames of a moment; the ego's motion goes first."""

    def __init__(self, profile: Profile) -> None:
        self._encoder = ProfileEncoder(profile)

    @property
    def left_out(self) -> int:
        """Objects that did not fit into the messages."""
        return self._encoder.left_out

    def encode(self, moment: Moment, t_ns: int) -> list[Frame]:
        """All frames, stamped ``t_ns`` [ns]."""
        frames = [] if moment.ego is None else self._encoder.encode_ego(*moment.ego, t_ns)
        if moment.scan is not None:
            frames += self._encoder.encode(moment.scan, t_ns)
        return frames


@dataclass(frozen=True, eq=False, slots=True)
class MotorwayRun:
    """A drive: what is sent when, by which encoder, and the truth."""

    moments: list[Moment]
    encoder: MotorwayEncoder
    truth: MotorwayTruth
    n_scans: int


def play_motorway(
    rng: np.random.Generator,
    settings: str,
    profile_name: str,
    missed: float | None,
    dropout: float | None,
) -> MotorwayRun:
    """Draw a drive and measure it.

    The scans' times are multiples of the loop's step, so that the frames leave when they are due.

    Args:
        settings: name of the `MotorwaySettings`.
        profile_name: of one of the radars that `can_imm.sim.radar` knows.
        missed, dropout: instead of the radar's own, unless None.

    Raises:
        CanImmError: no such settings, profile or radar; an impossible probability.
    """
    profile = load_profile(profile_name)
    radar = replace(radar_model(profile.name), tick=STEP_NS * 1e-9)
    if missed is not None:
        radar = replace(radar, missed=missed)
    if dropout is not None:
        radar = replace(radar, dropout=dropout)
    truth = drive(random_motorway(rng, motorway_settings(settings)))
    scans = {scan.t_ns: scan for scan in observe(truth, radar, rng).scans}
    ego = {t: (speed, yaw_rate) for t, speed, yaw_rate in ego_messages(truth, rng)}
    moments = [Moment(t, ego.get(t), scans.get(t)) for t in sorted({*ego, *scans})]
    return MotorwayRun(moments, MotorwayEncoder(profile), truth, len(scans))


def write_motorway_truth(path: str, truth: MotorwayTruth, start_ns: int) -> None:
    """Write one row per object and 10 ms, in order of time; ``start_ns`` is the bus time of 0.

    ``object_id`` numbers the true objects; it is not the radar's.
    """
    with Path(path).open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(
            ["time_s", "object_id", "manoeuvre", "lane", "direction", "event", *STATES, "speed"]
        )
        for number, t_ns in enumerate(truth.t_ns.tolist()):
            time = seconds(start_ns + t_ns)
            for target in truth.objects:
                i = number - target.first
                if not 0 <= i < len(target.label):
                    continue
                events = [name for bit, name in EVENTS.items() if target.flags[i] & bit]
                writer.writerow(
                    [
                        time,
                        target.object_id,
                        Manoeuvre(target.label[i]).name,
                        target.lane[i],
                        DIRECTION[int(target.direction[i])],
                        " ".join(events),
                        *(f"{value:.4f}" for value in target.state[i]),
                        f"{target.speed[i]:.4f}",
                    ]
                )
