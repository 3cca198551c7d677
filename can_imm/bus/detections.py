"""Sensor poses and detections to the frames of tracking.dbc and back; tracked objects to frames.

One gateway sends the scans of all sensors.  A sensor's part of a scan is SensorScan, SensorPose,
SensorMotion and then as many Detections as SensorScan announced.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from can_imm.bus.codec import Field, compile_reader, field
from can_imm.bus.encoder import MessageEncoder, own_dbc
from can_imm.bus.frame import ERROR, EXTENDED, FD, REMOTE, Frame
from can_imm.bus.profile import dbc_dir
from can_imm.bus.protection import p01_data_id, p01_guard
from can_imm.types import DetectionScan, Scan

TRACKING_DBC = dbc_dir() / "tracking.dbc"

SCAN, POSE, MOTION, DETECTION = 0x320, 0x321, 0x322, 0x323
DETECTION_IDS = frozenset({SCAN, POSE, MOTION, DETECTION})
TRACKED_IDS = frozenset({0x330, 0x331})
"""TrackedScan, TrackedObject."""

MAX_SENSORS = 15
"""Sensor ids are 0 to 14."""

WINDOW_NS = 25_000_000
"""Parts that begin within this time [ns] of the first belong to one scan."""

_NS_PER_MS = 1_000_000
_RESYNC_NS = 1_000_000_000
_UNSUITABLE = EXTENDED | FD | REMOTE | ERROR
_SIGNALS = {
    SCAN: ("SensorScan", ("SensorId", "DetectionCount", "ScanCounter", "Age")),
    POSE: ("SensorPose", ("SensorId", "PosX", "PosY")),
    MOTION: ("SensorMotion", ("SensorId", "Heading", "VelX", "VelY")),
    DETECTION: (
        "Detection", ("SensorId", "ScanCounterLow", "Range", "Bearing", "RangeRate"),
    ),
}  # fmt: skip


class DetectionEncoder:
    """The gateway's frames.  Detections beyond the 62 that a sensor may announce are left out and
    counted in ``left_out``."""

    LIMIT = 62

    def __init__(self) -> None:
        self._messages = {
            frame_id: MessageEncoder(name, signals, TRACKING_DBC)
            for frame_id, (name, signals) in _SIGNALS.items()
        }
        self.left_out = 0

    def encode(self, scan: DetectionScan, t_ns: int) -> list[Frame]:
        """Frames of ``scan``, stamped ``t_ns`` [ns], all sensors' parts one after the other; as
        their age they get that of their measurements relative to the scan's last one."""
        frames = []
        messages = self._messages
        delays = scan.delay[: scan.n_sensors].tolist()
        for row in range(scan.n_sensors):
            sensor, counter = int(scan.sensor_id[row]), int(scan.counter[row]) % 256
            x, y, heading, vx, vy = scan.pose[row].tolist()
            found = scan.z[: scan.n][scan.sensor[: scan.n] == row].tolist()
            self.left_out += max(len(found) - self.LIMIT, 0)
            found = found[: self.LIMIT]
            age_ms = 1e3 * (max(delays) - delays[row])
            frames += [
                messages[SCAN].encode(t_ns, sensor, len(found), counter, age_ms),
                messages[POSE].encode(t_ns, sensor, x, y),
                messages[MOTION].encode(t_ns, sensor, _degrees(heading), vx, vy),
            ]
            for distance, bearing, rate in found:
                frames.append(
                    messages[DETECTION].encode(
                        t_ns, sensor, counter % 16, distance, _degrees(bearing), rate
                    )
                )
        return frames


def _degrees(angle: float) -> float:
    """Degrees in -180 to 180; NaN for what is not finite."""
    return math.degrees(math.remainder(angle, math.tau)) if math.isfinite(angle) else math.nan


class TrackedEncoder:
    """A tracker's frames: TrackedScan, then a TrackedObject per object.  An object whose id does
    not fit the message (0 to 3) is left out and counted in ``left_out``."""

    def __init__(self) -> None:
        self._scan = MessageEncoder("TrackedScan", ("ObjectCount", "ScanCounter"), TRACKING_DBC)
        self._object = MessageEncoder(
            "TrackedObject",
            ("ObjectId", "ObjectNew", "Existence", "DistLong", "VrelLong", "DistLat", "VrelLat"),
            TRACKING_DBC,
        )
        self._scans = 0
        self.left_out = 0

    def encode(self, scan: Scan, t_ns: int) -> list[Frame]:
        """Frames of ``scan``, stamped ``t_ns`` [ns]."""
        rows = [k for k in range(scan.n) if 0 <= scan.ids[k] < 4]
        self.left_out += scan.n - len(rows)
        frames = [self._scan.encode(t_ns, len(rows), self._scans)]
        self._scans = (self._scans + 1) % 65536
        for k in rows:
            states = [
                value if there else math.nan
                for value, there in zip(scan.z[k].tolist(), scan.valid[k].tolist(), strict=True)
            ]
            frames.append(
                self._object.encode(
                    t_ns, int(scan.ids[k]), scan.new[k], 100.0 * scan.existence[k], *states
                )
            )
        return frames


@dataclass
class DetectionCounts:
    """What became of the frames.

    Every frame is counted in ``frames`` and in exactly one of ``unknown`` (not the gateway's),
    ``bad_kind``, ``bad_length``, ``bad_crc``, ``bad_counter`` (a repeated frame),
    ``out_of_range`` (an impossible or missing value), ``stray`` (without a SensorScan to belong
    to), ``overflow`` (no room) and ``used``.  Beside that: ``checksums_ok``, ``lost`` frames
    missing by the alive counters, ``scans`` finished, ``parts`` of them (one per sensor),
    ``incomplete_parts`` with less than announced, ``dropped_parts`` without a pose, ``late_parts``
    measured before the last finished scan, ``repeated_parts`` whose counter came twice.
    """

    frames: int = 0
    unknown: int = 0
    bad_kind: int = 0
    bad_length: int = 0
    bad_crc: int = 0
    bad_counter: int = 0
    out_of_range: int = 0
    stray: int = 0
    overflow: int = 0
    used: int = 0
    checksums_ok: int = 0
    lost: int = 0
    scans: int = 0
    parts: int = 0
    incomplete_parts: int = 0
    dropped_parts: int = 0
    late_parts: int = 0
    repeated_parts: int = 0

    @property
    def rejected(self) -> int:
        """Frames of the gateway that failed a check."""
        return (
            self.bad_kind + self.bad_length + self.bad_crc + self.bad_counter
            + self.out_of_range + self.stray + self.overflow
        )  # fmt: skip


class _Message:
    """Reader, checks and scalings of one message."""

    def __init__(self, name: str, signals: tuple[str, ...]) -> None:
        message = own_dbc(TRACKING_DBC).get_message_by_name(name)
        found = [message.get_signal_by_name(signal) for signal in signals]
        self.length: int = message.length
        self.read = compile_reader(message, found)
        self.fields: list[Field] = [field(signal) for signal in found]
        self.guard = p01_guard(p01_data_id(message, TRACKING_DBC))
        self.last_counter = -1
        self.last_ns = 0


class _Part:
    """One sensor's scan as far as it has come."""

    __slots__ = ("announced", "arrived", "counter", "motion", "pose", "t_ns", "z")

    def __init__(self, t_ns: int, announced: int, counter: int) -> None:
        self.t_ns = t_ns
        self.announced = announced
        self.arrived = 0
        self.counter = counter
        self.pose: tuple[float, ...] | None = None
        self.motion: tuple[float, ...] | None = None
        self.z: list[tuple[float, float, float]] = []

    @property
    def complete(self) -> bool:
        placed = self.pose is not None and self.motion is not None
        return placed and self.arrived == self.announced


class DetectionDecoder:
    """Collects the frames of all sensors into scans.

    A scan ends when every sensor of the scan before has given its part, when one of them begins
    its next part, or `WINDOW_NS` after its first frame: a sensor that vanishes delays one scan.
    What is wrong is counted in ``counts`` and survived.

    Attributes:
        ids: the frame ids it listens to.
        counts: `DetectionCounts`.

    Args:
        capacity: detections of a scan, of all sensors.
    """

    ids = DETECTION_IDS

    def __init__(self, capacity: int = 256) -> None:
        self.counts = DetectionCounts()
        self._messages = {i: _Message(*content) for i, content in _SIGNALS.items()}
        self._scan = DetectionScan(MAX_SENSORS, capacity)
        self._capacity = capacity
        self._parts: dict[int, _Part] = {}
        self._began_ns = 0
        self._expected: frozenset[int] = frozenset()
        self._ended_ns: int | None = None
        self._last: dict[int, tuple[int, int]] = {}  # counter and time of each sensor's last part

    def feed(self, frame: Frame) -> DetectionScan | None:
        """Take a frame in; gives the scan that it finishes, if any.

        The scan is a buffer of the decoder, valid until the next one is finished.
        """
        counts = self.counts
        counts.frames += 1
        message = self._messages.get(frame.id)
        if message is None:
            counts.unknown += 1
            return None
        if not self._passes(message, frame):
            return None
        finished = self.flush(frame.t_ns)
        raws = message.read(frame.data)
        values = [
            _physical(raw, scaling) for raw, scaling in zip(raws, message.fields, strict=True)
        ]
        # a range rate may be missing, nothing else
        needed = values[:4] if frame.id == DETECTION else values
        rate_raw, rate = raws[-1], message.fields[-1]
        broken = frame.id == DETECTION and math.isnan(values[4]) and rate_raw != rate.missing
        part = self._parts.get(raws[0])
        if broken or not all(value == value for value in needed):
            counts.out_of_range += 1
            if frame.id == DETECTION and part is not None:
                part.arrived += 1
        elif frame.id == SCAN:
            counts.used += 1
            finished = self._begin(frame.t_ns, values) or finished
        elif part is None:
            counts.stray += 1
        elif frame.id == POSE:
            counts.used += 1
            part.pose = values[1], values[2]
        elif frame.id == MOTION:
            counts.used += 1
            part.motion = math.radians(values[1]), values[2], values[3]
        elif raws[1] != part.counter % 16 or part.arrived == part.announced:
            counts.stray += 1
        else:
            counts.used += 1
            part.arrived += 1
            part.z.append((values[2], math.radians(values[3]), values[4]))
        if finished is None and self._all_there():
            finished = self._finish()
        return finished

    def flush(self, t_ns: int) -> DetectionScan | None:
        """Give up waiting for parts that are overdue at ``t_ns`` [ns]; call it in every step."""
        if self._parts and t_ns - self._began_ns > WINDOW_NS:
            return self._finish()
        return None

    def _passes(self, message: _Message, frame: Frame) -> bool:
        """Kind, length, checksum and alive counter; counts what fails."""
        counts = self.counts
        if frame.flags & _UNSUITABLE:
            counts.bad_kind += 1
            return False
        if len(frame.data) != message.length:
            counts.bad_length += 1
            return False
        if not message.guard.check(frame.data):
            counts.bad_crc += 1
            return False
        counts.checksums_ok += 1
        counter = message.guard.counter(frame.data)
        if message.last_counter >= 0 and abs(frame.t_ns - message.last_ns) <= _RESYNC_NS:
            step = (counter - message.last_counter) % message.guard.modulus
            if step == 0:
                counts.bad_counter += 1
                return False
            counts.lost += step - 1
        message.last_counter, message.last_ns = counter, frame.t_ns
        return True

    def _begin(self, t_ns: int, values: list[float]) -> DetectionScan | None:
        """A sensor's part begins; gives the scan that this ends."""
        sensor, announced, counter = int(values[0]), int(values[1]), int(values[2])
        measured_ns = t_ns - round(values[3]) * _NS_PER_MS
        last_counter, last_ns = self._last.get(sensor, (-1, 0))
        if counter == last_counter and abs(t_ns - last_ns) < _RESYNC_NS:
            self.counts.repeated_parts += 1
            return None
        finished = self._finish() if sensor in self._parts else None
        if (
            self._ended_ns is not None
            and self._ended_ns - _RESYNC_NS < measured_ns <= self._ended_ns
        ):
            self.counts.late_parts += 1
            # a sensor that is new here, or always slow: the next scan waits for it
            self._expected |= {sensor}
            return finished
        self._last[sensor] = counter, t_ns
        if not self._parts:
            self._began_ns = t_ns
        self._parts[sensor] = _Part(measured_ns, announced, counter)
        return finished

    def _all_there(self) -> bool:
        parts = self._parts
        return (
            bool(parts)
            and self._expected <= parts.keys()
            and bool(self._expected)
            and all(part.complete for part in parts.values())
        )

    def _finish(self) -> DetectionScan | None:
        """Close the open scan and write it to the buffer; None if no part of it is of use."""
        counts, scan = self.counts, self._scan
        parts = dict(sorted(self._parts.items()))
        self._parts = {}
        self._expected = frozenset(parts)
        usable = {s: p for s, p in parts.items() if p.pose is not None and p.motion is not None}
        counts.dropped_parts += len(parts) - len(usable)
        if not usable:
            return None
        scan.t_ns = min(part.t_ns for part in usable.values())
        self._ended_ns = max(part.t_ns for part in usable.values())
        scan.n_sensors, n = len(usable), 0
        for row, (sensor, part) in enumerate(usable.items()):
            assert part.pose is not None
            assert part.motion is not None
            counts.parts += 1
            counts.incomplete_parts += not part.complete
            scan.sensor_id[row] = sensor
            scan.counter[row] = part.counter
            scan.delay[row] = (part.t_ns - scan.t_ns) * 1e-9
            scan.pose[row] = (*part.pose, *part.motion)
            room = self._capacity - n
            counts.overflow += max(len(part.z) - room, 0)
            for z in part.z[:room]:
                scan.sensor[n] = row
                scan.z[n] = z
                n += 1
        scan.n = n
        counts.scans += 1
        return scan


def _physical(raw: int, scaling: Field) -> float:
    return raw * scaling.scale + scaling.offset if scaling.low <= raw <= scaling.high else math.nan
