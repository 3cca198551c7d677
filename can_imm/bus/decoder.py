"""Frames to scans: protection first, then the codec, then the assembly of a scan."""

from __future__ import annotations

from dataclasses import dataclass

from can_imm.bus.frame import ERROR, EXTENDED, FD, REMOTE, Frame
from can_imm.bus.layout import HEADER, CompiledMessage, Layout
from can_imm.bus.profile import Profile
from can_imm.types import Scan

_UNSUITABLE = EXTENDED | FD | REMOTE | ERROR

RESYNC_PERIODS = 10
"""After a silence of so many scan periods a sender may have started anew: any counter will do."""


@dataclass
class DecodeCounts:
    """What became of the frames.

    Every frame is counted in ``frames`` and in exactly one of ``unknown`` (an id that is not the
    sensor's), ``bad_kind`` (our id, but an extended, FD, remote or error frame), ``bad_length``,
    ``bad_crc`` (in profile 1 the invalid counter 15, too), ``bad_counter`` (a repeated frame),
    ``out_of_range``, ``stray`` (an object without a scan to belong to), ``duplicates`` (an object
    twice in a scan), ``overflow`` (more objects than there is room for), ``empty`` (right, but
    without an object) and ``used``. Beside that: ``checksums_ok`` frames with a right checksum,
    ``lost`` frames missing by their counters, ``not_available`` single values that the sensor did
    not have, ``scans`` finished, ``incomplete_scans`` of these with an announced object missing or
    rejected, ``lost_scans`` missing by their counter.
    """

    frames: int = 0
    unknown: int = 0
    bad_kind: int = 0
    bad_length: int = 0
    bad_crc: int = 0
    bad_counter: int = 0
    out_of_range: int = 0
    stray: int = 0
    duplicates: int = 0
    overflow: int = 0
    empty: int = 0
    used: int = 0
    checksums_ok: int = 0
    lost: int = 0
    not_available: int = 0
    scans: int = 0
    incomplete_scans: int = 0
    lost_scans: int = 0

    @property
    def rejected(self) -> int:
        """Frames of the sensor that failed a check."""
        return (
            self.bad_kind
            + self.bad_length
            + self.bad_crc
            + self.bad_counter
            + self.out_of_range
            + self.stray
            + self.duplicates
            + self.overflow
        )


class ScanDecoder:
    """Collects the frames of a sensor into scans.

    A scan ends when all its frames have come, when the next one begins, or `Profile.timeout_ns`
    after its first frame. An object is used only if every check of its frame passes; a component
    that is not available is left out of the validity mask. Bad frames are counted in ``counts`` and
    survived.

    Attributes:
        ids: the frame ids it listens to.
        counts: `DecodeCounts`.
    """

    def __init__(self, profile: Profile, capacity: int = 64) -> None:
        self.counts = DecodeCounts()
        self._layout = Layout(profile)
        self._messages = self._layout.messages
        self.ids = frozenset(self._messages)
        self._period_ns, self._timeout_ns = profile.period_ns, profile.timeout_ns
        self._latency_ns = profile.latency_ns
        self._resync_ns = RESYNC_PERIODS * profile.period_ns

        self._scan = Scan(capacity)
        for state, part in enumerate(profile.state):
            if part is not None:
                self._scan.std[:, state] = part.std
        self._mask = tuple(part is not None for part in profile.state)

        self._open = False
        self._start_ns = self._deadline_ns = 0
        self._counter = self._expected = self._arrived = 0
        self._damaged = False
        self._seen: set[int] = set()
        self._ids: list[int] = []
        self._new: list[bool] = []
        self._z: list[list[float]] = []
        self._valid: list[tuple[bool, ...]] = []
        # of the scan before the open one
        self._ended_counter, self._ended_ns = -1, 0

    def feed(self, frame: Frame) -> Scan | None:
        """Take a frame in; gives the scan that it finishes, if any.

        The scan is a buffer of the decoder, valid until the next one is finished.
        """
        counts = self.counts
        counts.frames += 1
        message = self._messages.get(frame.id)
        if message is None:
            counts.unknown += 1
            return None
        t_ns, data = frame.t_ns, frame.data
        if not self._passes(message, frame):
            return None
        finished = self.flush(t_ns)
        raws = message.read(data)
        if message.slot == HEADER:
            finished = self._take_header(t_ns, raws) or finished
        elif not self._layout.slots:
            if not self._open:
                counts.stray += 1
                return finished
            self._take_object(raws[0], raws)
        else:
            if self._is_stale(t_ns, raws[0]):
                counts.stray += 1
                return finished
            if self._open and raws[0] != self._counter:
                finished = self._finish()
            if not self._open:
                self._begin(t_ns, raws[0], self._layout.slots)
            if message.slot in self._seen:
                counts.duplicates += 1
                return finished
            self._seen.add(message.slot)
            self._take_object(message.slot, raws)
        if self._open and self._arrived == self._expected and finished is None:
            finished = self._finish()
        return finished

    def flush(self, t_ns: int) -> Scan | None:
        """Give up a scan that is overdue at ``t_ns`` [ns]; call it in every step."""
        if self._open and (self._arrived == self._expected or t_ns > self._deadline_ns):
            return self._finish()
        return None

    def _passes(self, message: CompiledMessage, frame: Frame) -> bool:
        """Kind, length, checksum and counter; counts what fails."""
        counts = self.counts
        if frame.flags & _UNSUITABLE:
            counts.bad_kind += 1
            return False
        data = frame.data
        if len(data) != message.length:
            counts.bad_length += 1
            return False
        guard = message.guard
        if guard is None:
            return True
        if not guard.check(data):
            counts.bad_crc += 1
            return False
        counts.checksums_ok += 1
        counter = guard.counter(data)
        last = message.last_counter
        if last >= 0 and abs(frame.t_ns - message.last_ns) <= self._resync_ns:
            step = (counter - last) % guard.modulus
            if step == 0:
                counts.bad_counter += 1
                return False
            counts.lost += step - 1
        message.last_counter, message.last_ns = counter, frame.t_ns
        return True

    def _is_stale(self, t_ns: int, counter: int) -> bool:
        """Without a header: does the frame belong to the scan before this one?"""
        return (
            counter == self._ended_counter
            and not (self._open and counter == self._counter)
            and t_ns - self._ended_ns < self._period_ns
        )

    def _take_header(self, t_ns: int, raws: tuple[int, ...]) -> Scan | None:
        finished = self._finish() if self._open else None
        count, (low, high) = raws[0], self._layout.count_range
        if not low <= count <= high:
            self.counts.out_of_range += 1
            return finished
        self.counts.used += 1
        self._begin(t_ns, raws[1], count)
        return finished

    def _take_object(self, key: int, raws: tuple[int, ...]) -> None:
        """One object frame of the open scan; all of it, or nothing but a count."""
        counts = self.counts
        self._arrived += 1
        layout = self._layout
        for index, holds in layout.conditions:
            if not holds(raws[index]):
                counts.empty += 1
                return
        values = [0.0, 0.0, 0.0, 0.0]
        missing = []
        for index, state, scale, offset, low, high, absent, sign, shift in layout.components:
            raw = raws[index]
            if raw == absent:
                missing.append(state)
            elif low <= raw <= high:
                values[state] = (raw * scale + offset) * sign + shift
            else:
                self._reject("out_of_range")
                return
        if not layout.slots:
            if not layout.key_range[0] <= key <= layout.key_range[1]:
                self._reject("out_of_range")
                return
            if key in self._seen:
                self._reject("duplicates")
                return
            self._seen.add(key)
        counts.not_available += len(missing)
        if len(missing) == len(layout.components):
            counts.empty += 1
            return
        if len(self._ids) == self._scan.capacity:
            self._reject("overflow")
            return
        mask = self._mask
        if missing:
            mask = tuple(there and state not in missing for state, there in enumerate(mask))
        counts.used += 1
        self._ids.append(key)
        self._new.append(layout.new is not None and raws[layout.new] != 0)
        self._z.append(values)
        self._valid.append(mask)

    def _reject(self, reason: str) -> None:
        setattr(self.counts, reason, getattr(self.counts, reason) + 1)
        self._damaged = True

    def _begin(self, t_ns: int, counter: int, expected: int) -> None:
        if self._ended_counter >= 0 and abs(t_ns - self._ended_ns) <= self._resync_ns:
            step = (counter - self._ended_counter) % self._layout.scan_modulus
            # a larger step is that of a sender that has started anew
            if 1 < step <= RESYNC_PERIODS:
                self.counts.lost_scans += step - 1
        self._open = True
        self._start_ns, self._deadline_ns = t_ns, t_ns + self._timeout_ns
        self._counter, self._expected, self._arrived = counter, expected, 0
        self._damaged = False
        self._seen, self._ids, self._new, self._z, self._valid = set(), [], [], [], []

    def _finish(self) -> Scan:
        """Close the open scan and write it to the buffer."""
        scan, n = self._scan, len(self._ids)
        scan.t_ns = self._start_ns - self._latency_ns
        scan.counter = self._counter
        scan.incomplete = self._damaged or self._arrived < self._expected
        scan.n = n
        if n:
            scan.ids[:n] = self._ids
            scan.new[:n] = self._new
            scan.z[:n] = self._z
            scan.valid[:n] = self._valid
        self._open = False
        self._ended_counter, self._ended_ns = self._counter, self._start_ns
        self.counts.scans += 1
        self.counts.incomplete_scans += scan.incomplete
        return scan
