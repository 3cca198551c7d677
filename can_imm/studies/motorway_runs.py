"""One motorway drive as a study sees it: scans from a profile's frames, and the truth of each row.

The drive is measured by the profile's radar, written as its frames, and read again, so that the
systems see its quantisation and the ends of its ranges.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.profile import load_profile
from can_imm.bus.radar_encoder import ProfileEncoder
from can_imm.runtime.loop import STEP_NS
from can_imm.sim.motorway import (
    MotorwaySettings,
    MotorwayTruth,
    drive,
    random_motorway,
)
from can_imm.sim.radar import Measured, ego_messages, observe, radar_model
from can_imm.studies.runs import Int8Array, Int64Array
from can_imm.types import BoolArray, FloatArray, Manoeuvre, Scan

CAPACITY = 128
"""Objects in a scan."""

TRAFFIC = (
    Manoeuvre.KEEP_LANE,
    Manoeuvre.LANE_CHANGE,
    Manoeuvre.RECEDING,
    Manoeuvre.APPROACHING,
    Manoeuvre.REAR_END,
)
"""What vehicles in our direction do; accuracy is that over these."""


@dataclass(frozen=True, eq=False)
class MotorwayRun:
    """A drive.  A *frame* is a row of a scan: there are F of them, in the order of the scans.

    A *track* is an id from its first row on the object to the last one.

    Attributes:
        truth: what was true, every 10 ms.
        scans: as decoded; their times are multiples of the loop's step.
        first: (scans + 1,) frame of each scan's first row, and F.
        t_ns: (F,) time of the scan [ns].
        object: (F,) index into ``truth.objects``.
        second: (F,) the frame belongs to a second track on a vehicle.
        label, direction, lane: (F,) true values, as in `sim.motorway.ObjectTruth`.
        state: (F, 4) true x, vx, y, vy [m, m/s, m, m/s].
        tracks: frames (N,) of each track, in order of time.
    """

    truth: MotorwayTruth
    scans: list[Scan]
    first: Int64Array
    t_ns: Int64Array
    object: Int64Array
    second: BoolArray
    label: Int8Array
    direction: Int8Array
    lane: Int8Array
    state: FloatArray
    tracks: list[Int64Array]


def play_motorway(profile: str, seed: int, settings: MotorwaySettings) -> MotorwayRun:
    """Simulate, measure, encode and decode one drive; the same drive for every profile.

    Raises:
        CanImmError: no such profile, or none whose radar is simulated.
    """
    rng = np.random.default_rng(seed)
    # what is simulated reaches the bus at once, in the step in which it was measured
    spoken = replace(load_profile(profile), latency_ns=0)
    radar = replace(radar_model(spoken.name), tick=STEP_NS * 1e-9)
    truth = drive(random_motorway(rng, settings))
    measured = observe(truth, radar, rng)
    ego = ego_messages(truth, rng)
    encoder, decoder = ProfileEncoder(spoken), ScanDecoder(spoken, CAPACITY)
    collected = _Rows(truth)
    said = 0
    for number, scan in enumerate(measured.scans):
        while said < len(ego) and ego[said][0] <= scan.t_ns:
            t_ns, speed, yaw_rate = ego[said]
            for frame in encoder.encode_ego(speed, yaw_rate, t_ns):
                decoder.feed(frame)
            said += 1
        found = None
        for frame in encoder.encode(scan, scan.t_ns):
            found = decoder.feed(frame) or found
        found = found or decoder.flush(scan.t_ns + spoken.timeout_ns + 1)
        collected.watch(measured, number)
        if found is not None:
            collected.add(found, measured, number)
    return collected.run()


class _Rows:
    """Collects the rows of a run."""

    def __init__(self, truth: MotorwayTruth) -> None:
        self.truth = truth
        self.scans: list[Scan] = []
        self.first = [0]
        self.rows: list[tuple[int, int, int, bool]] = []
        self.states: list[FloatArray] = []
        self.tracks: list[list[int]] = []
        self.track_of: dict[int, list[int]] = {}

    def watch(self, measured: Measured, number: int) -> None:
        """Begin the tracks that are new in a scan, whether or not it can be read again."""
        scan = measured.scans[number]
        for name in scan.ids[: scan.n][scan.new[: scan.n]].tolist():
            self.track_of[name] = []
            self.tracks.append(self.track_of[name])

    def add(self, scan: Scan, measured: Measured, number: int) -> None:
        sent = measured.scans[number]
        row_of = {name: row for row, name in enumerate(sent.ids[: sent.n].tolist())}
        copy = Scan(max(scan.n, 1))
        copy.copy_from(scan)
        self.scans.append(copy)
        for name in scan.ids[: scan.n].tolist():
            row = row_of[name]
            self.track_of[name].append(len(self.rows))
            self.rows.append(
                (
                    scan.t_ns,
                    int(measured.objects[number][row]),
                    int(measured.samples[number][row]),
                    bool(measured.second[number][row]),
                )
            )
            self.states.append(measured.states[number][row])
        self.first.append(len(self.rows))

    def run(self) -> MotorwayRun:
        rows = np.array(self.rows, np.int64).reshape(-1, 4)
        objects = self.truth.objects
        pairs = list(zip(rows[:, 1].tolist(), rows[:, 2].tolist(), strict=True))
        label, direction, lane = (
            np.array([getattr(objects[number], name)[sample] for number, sample in pairs], np.int8)
            for name in ("label", "direction", "lane")
        )
        return MotorwayRun(
            truth=self.truth,
            scans=self.scans,
            first=np.array(self.first, np.int64),
            t_ns=rows[:, 0],
            object=rows[:, 1],
            second=rows[:, 3].astype(np.bool_),
            label=label,
            direction=direction,
            lane=lane,
            state=np.array(self.states).reshape(-1, 4),
            tracks=[np.array(track, np.int64) for track in self.tracks if track],
        )
