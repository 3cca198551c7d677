"""The detector's frames read back: for monitors, tests, and as a model for other listeners."""

from __future__ import annotations

from typing import NamedTuple

from can_imm.bus.codec import Field, compile_reader, field
from can_imm.bus.encoder import DBC, DIRECTIONS, OUTPUT_IDS, StatusValues, own_dbc
from can_imm.bus.frame import ERROR, EXTENDED, FD, REMOTE, Frame
from can_imm.bus.protection import p01_data_id, p01_guard
from can_imm.types import CUT_IN, CUT_OUT, OVERTAKING_ANOTHER

NAN = float("nan")

_FLAGS = (0, CUT_IN, CUT_OUT, OVERTAKING_ANOTHER)
"""Bit of a report's flags by the value of signal Event."""


class ManoeuvreMessage(NamedTuple):
    """ManoeuvreState; ``manoeuvre`` and ``second`` are values of `Manoeuvre`, ``direction`` is +1
    left, -1 right, 0 none, ``lane`` None if not available, ``flags`` one of the bits of a report's
    or 0; probabilities are 0 to 1, NaN if not available."""

    object_id: int
    coasting: bool
    manoeuvre: int
    second: int
    direction: int
    lane: int | None
    flags: int
    probability: float
    second_probability: float
    age: int


class EstimateMessage(NamedTuple):
    """ObjectEstimate in m and m/s; NaN if not available."""

    object_id: int
    x: float
    vx: float
    y: float
    vy: float


class ManoeuvreDecoder:
    """Decodes frames of the detector; those that fail a check are counted in ``rejected``."""

    ids = OUTPUT_IDS

    def __init__(self) -> None:
        self.rejected = 0
        self._messages = {}
        for frame_id in OUTPUT_IDS:
            message = own_dbc().get_message_by_frame_id(frame_id)
            signals = [s for s in message.signals if s.name not in ("Crc", "AliveCounter")]
            self._messages[frame_id] = (
                message.name,
                p01_guard(p01_data_id(message, DBC)),
                compile_reader(message, signals),
                {signal.name: (k, field(signal)) for k, signal in enumerate(signals)},
            )

    def feed(self, frame: Frame) -> ManoeuvreMessage | EstimateMessage | StatusValues | None:
        """Content of a frame of the detector, None for any other frame."""
        if frame.id not in self._messages:
            return None
        name, guard, read, fields = self._messages[frame.id]
        if frame.flags & (EXTENDED | FD | REMOTE | ERROR) or len(frame.data) != 8:
            self.rejected += 1
            return None
        if not guard.check(frame.data):
            self.rejected += 1
            return None
        raws = read(frame.data)

        def value(signal: str) -> float:
            index, scaling = fields[signal]
            return _physical(raws[index], scaling)

        def number(signal: str) -> int:
            return raws[fields[signal][0]]

        if name == "DetectorStatus":
            return StatusValues(
                number("State"),
                number("ObjectsTracked"),
                number("DeadlineMisses"),
                number("FramesRejected"),
                number("DroppedScans"),
            )
        if name == "ObjectEstimate":
            return EstimateMessage(
                number("ObjectId"),
                value("DistLong"),
                value("VrelLong"),
                value("DistLat"),
                value("VrelLat"),
            )
        direction, lane, event = number("Direction"), value("Lane"), number("Event")
        return ManoeuvreMessage(
            number("ObjectId"),
            bool(number("Coasting")),
            number("Manoeuvre"),
            number("SecondManoeuvre"),
            DIRECTIONS[direction] if direction < len(DIRECTIONS) else 0,
            None if lane != lane else int(lane),
            _FLAGS[event],
            value("Probability") / 100,
            value("SecondProbability") / 100,
            number("TrackAge"),
        )


def _physical(raw: int, scaling: Field) -> float:
    return raw * scaling.scale + scaling.offset if scaling.low <= raw <= scaling.high else NAN
