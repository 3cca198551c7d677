"""Scans and reports to the frames of can_imm.dbc."""

from __future__ import annotations

from enum import IntEnum
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from can_imm.bus.codec import compile_packer, field, load_dbc
from can_imm.bus.frame import Frame
from can_imm.bus.profile import dbc_dir
from can_imm.bus.protection import P01_COUNTERS, p01_data_id, p01_protect
from can_imm.bus.reports import ReportPacker, signal_table
from can_imm.types import CUT_IN, CUT_OUT, OVERTAKING_ANOTHER, Scan

DBC = dbc_dir() / "can_imm.dbc"

STATE_ID, ESTIMATE_ID, STATUS_ID = 0x310, 0x311, 0x31F
OUTPUT_IDS = frozenset({STATE_ID, ESTIMATE_ID, STATUS_ID})
"""ManoeuvreState, ObjectEstimate, DetectorStatus."""

DIRECTIONS = (0, 1, -1)
"""Direction of a lane change (+1 left, -1 right) by the value on the bus."""

EVENTS = tuple(
    1 if flags & CUT_IN else 2 if flags & CUT_OUT else 3 if flags & OVERTAKING_ANOTHER else 0
    for flags in range(8)
)
"""Value of signal Event by a report's flags: there is room for one of them."""

_SENSOR_OBJECTS = range(64)


class DetectorState(IntEnum):
    """Signal State of DetectorStatus."""

    STARTING = 0
    RUNNING = 1
    NO_SENSOR = 2
    STOPPING = 3


class StatusValues(NamedTuple):
    """Content of DetectorStatus; the counts are those since the start and saturate at 4095."""

    state: int
    objects_tracked: int
    deadline_misses: int
    frames_rejected: int
    dropped_scans: int


@cache
def own_dbc(path: Path = DBC) -> Any:
    """The cantools database of can_imm.dbc, or of another DBC file of ours."""
    return load_dbc(path)


class MessageEncoder:
    """Packs one message of can_imm.dbc, or of another DBC file of ours, and protects it.

    ``encode`` takes the physical values in the order of ``signals``; a value that is NaN or out of
    range is sent as "not available" where the signal has such a code, otherwise as the end of the
    range.
    """

    def __init__(self, name: str, signals: tuple[str, ...], dbc: Path = DBC) -> None:
        message = own_dbc(dbc).get_message_by_name(name)
        self.id: int = message.frame_id
        self.cycle_ns: int = message.cycle_time * 1_000_000
        self._length: int = message.length
        self._data_id = p01_data_id(message, dbc)
        self._counter = 0
        parts = [message.get_signal_by_name(name) for name in signals]
        assert all(signal.byte_order == "little_endian" for signal in parts)
        self._pack = compile_packer([(signal.start, field(signal)) for signal in parts])

    def encode(self, t_ns: int, *values: float) -> Frame:
        """The next frame of this id."""
        data = bytearray(self._pack(*values).to_bytes(self._length, "little"))
        p01_protect(data, self._data_id, self._counter)
        self._counter = (self._counter + 1) % P01_COUNTERS
        return Frame(t_ns, self.id, bytes(data))


def _signals(name: str, signals: tuple[str, ...]) -> tuple[npt.NDArray[Any], int]:
    """How a kernel packs a message of can_imm.dbc, and the message's data id."""
    message = own_dbc().get_message_by_name(name)
    parts = [message.get_signal_by_name(signal) for signal in signals]
    assert message.length == 8
    assert all(s.byte_order == "little_endian" and not s.is_signed for s in parts)
    return signal_table([(s.start, field(s)) for s in parts]), p01_data_id(message, DBC)


class RadarEncoder:
    """A radar-like sensor's frames: RadarScan, then a RadarObject per object.

    An object whose id does not fit the message (0 to 63) is left out and counted in ``left_out``.
    """

    def __init__(self) -> None:
        self._scan = MessageEncoder("RadarScan", ("ObjectCount", "ScanCounter"))
        self._object = MessageEncoder(
            "RadarObject",
            ("ObjectId", "ObjectValid", "ObjectNew", "DistLong", "VrelLong", "DistLat", "VrelLat"),
        )
        self._scans = 0
        self.left_out = 0

    def encode(self, scan: Scan, t_ns: int) -> list[Frame]:
        """Frames of ``scan``, stamped ``t_ns`` [ns]; components that are not valid are sent as not
        available."""
        n = scan.n
        z = np.where(scan.valid[:n], scan.z[:n], np.nan)
        objects = zip(scan.ids[:n].tolist(), scan.new[:n].tolist(), z.tolist(), strict=True)
        rows = [row for row in objects if row[0] in _SENSOR_OBJECTS]
        self.left_out += n - len(rows)
        frames = [self._scan.encode(t_ns, len(rows), self._scans)]
        self._scans = (self._scans + 1) % 65536
        for object_id, new, states in rows:
            frames.append(self._object.encode(t_ns, object_id, 1, new, *states))
        return frames


class ManoeuvreEncoder:
    """The detector's frames.

    A report whose object id does not fit the messages (0 to 254) is left out and counted in
    ``left_out``.

    Attributes:
        status_period_ns: cycle time of DetectorStatus [ns].
    """

    def __init__(self) -> None:
        state, state_id = _signals(
            "ManoeuvreState",
            ("ObjectId", "Direction", "Lane", "Event", "Probability", "SecondProbability",
             "Coasting", "Manoeuvre", "SecondManoeuvre", "TrackAge"),
        )  # fmt: skip
        estimate, estimate_id = _signals(
            "ObjectEstimate", ("ObjectId", "DistLong", "VrelLong", "DistLat", "VrelLat")
        )
        self._packer = ReportPacker(state, estimate, (state_id, estimate_id), DIRECTIONS, EVENTS)
        self._status = MessageEncoder(
            "DetectorStatus",
            ("State", "ObjectsTracked", "DeadlineMisses", "FramesRejected", "DroppedScans"),
        )
        self.status_period_ns = self._status.cycle_ns
        self.left_out = 0

    def encode(
        self, reports: npt.NDArray[np.void], t_ns: int, channel: str | None = None
    ) -> list[Frame]:
        """ManoeuvreState and ObjectEstimate for each of the reports (REPORT_DTYPE)."""
        data, count = self._packer.pack(reports, states=True)
        self.left_out += len(reports) - count // 2
        frames = []
        for k in range(0, 8 * count, 16):
            frames.append(Frame(t_ns, STATE_ID, data[k : k + 8], channel))
            frames.append(Frame(t_ns, ESTIMATE_ID, data[k + 8 : k + 16], channel))
        return frames

    def estimates(
        self, reports: npt.NDArray[np.void], t_ns: int, channel: str | None = None
    ) -> list[Frame]:
        """ObjectEstimate alone for each of the reports (REPORT_DTYPE)."""
        data, count = self._packer.pack(reports, states=False)
        return [Frame(t_ns, ESTIMATE_ID, data[k : k + 8], channel) for k in range(0, 8 * count, 8)]

    def status(self, t_ns: int, values: StatusValues) -> Frame:
        """DetectorStatus."""
        return self._status.encode(t_ns, *values)
