"""Trackers: detections of several sensors in, objects out, for the detector like a radar's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from can_imm.types import DetectionScan, Scan


@dataclass
class TrackerCounts:
    """What became of the scans and detections, as plain numbers.

    Attributes:
        scans: scans that were used.
        late_scans: scans of which no sensor's part could be used.
        late_sensors: parts of a scan that lay before one already used, and were left out.
        repeated_sensors: parts of a scan that were left out, because the sensor sent the same
            counter twice.
        detections: detections that were used.
        invalid: detections and poses that are impossible: not finite, or a negative range.
        overflow: detections for which there was no room.
        resets: tracks that were given up after too long a silence.
        numeric_failures: steps without a finite result; the track starts anew.
        births, deaths: objects reported for the first time, and no longer.
    """

    scans: int = 0
    late_scans: int = 0
    late_sensors: int = 0
    repeated_sensors: int = 0
    detections: int = 0
    invalid: int = 0
    overflow: int = 0
    resets: int = 0
    numeric_failures: int = 0
    births: int = 0
    deaths: int = 0


class Tracker(Protocol):
    """One call per step of the loop; survives whatever the sensors say."""

    @property
    def counts(self) -> TrackerCounts:
        """What became of everything so far."""

    def step(self, t_ns: int, detections: DetectionScan | None) -> Scan | None:
        """Take in the scan that came in the step at ``t_ns`` [ns], if any.

        Returns:
            After a scan that was used, the objects (none, if there is none) in the axes that the
            detector expects, with `Scan.existence` and `Scan.new` set: a buffer of the tracker,
            valid until the next call.  Otherwise None.
        """
