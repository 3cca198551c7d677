"""Frames to scans: protection first, then the codec, then the assembly of a scan."""

from __future__ import annotations

from typing import Any

from can_imm.bus.codec import EMPTY, USABLE
from can_imm.bus.counts import DecodeCounts
from can_imm.bus.ego import EGO, EgoReader
from can_imm.bus.frame import ERROR, EXTENDED, FD, REMOTE, Frame
from can_imm.bus.layout import CompiledMessage, Layout
from can_imm.bus.measurement import ObjectList
from can_imm.bus.profile_parts import Profile
from can_imm.types import Scan

__all__ = ["DecodeCounts", "ScanDecoder"]

_UNSUITABLE = EXTENDED | FD | REMOTE | ERROR

RESYNC_PERIODS = 10
"""After a silence of so many scan periods a sender may have started anew: any counter will do."""

FORGET_SCANS = 3
"""A message that did not come in so many scans is not waited for any more."""

NO_OBJECT = -1
"""Number of an object of which a frame came, but not one to be used."""


class ScanDecoder:
    """Collects the frames of a sensor into scans.

    A scan ends when all its frames have come, when the next one begins, or `Profile.timeout_ns`
    after its first frame. An object is used only if every check of its frame passes; a component
    that is not available is left out of the validity mask. Bad frames are counted in ``counts`` and
    survived.

    Messages that a sensor may send of each object besides the first are waited for if it sent them
    in its last scans. The first sensor that is heard is the one that counts, if the profile allows
    several and names none.

    Attributes:
        ids: the frame ids it listens to.
        counts: `DecodeCounts`.
        sensor: number of the sensor that counts, None as long as none was heard.
    """

    def __init__(self, profile: Profile, capacity: int = 64) -> None:
        self.counts = DecodeCounts()
        self._layout = layout = Layout(profile)
        self._ego = EgoReader(profile)
        self._messages: dict[int, CompiledMessage] = {}
        for ids in layout.messages.values():
            self._messages.update(ids)
        self._of_others: frozenset[int] = frozenset()
        self.sensor: int | None = None
        if len(profile.sensors.possible) == 1:
            self._choose(profile.sensors.possible[0])
        else:
            self._messages.update(self._ego.messages)
        self.ids = frozenset(self._messages)
        self._period_ns, self._timeout_ns = profile.period_ns, profile.timeout_ns
        self._latency_ns = profile.latency_ns
        self._resync_ns = RESYNC_PERIODS * profile.period_ns

        self._objects = ObjectList(profile, layout, capacity)
        self._scan = Scan(capacity)
        self._objects.prepare(self._scan)

        self._open = False
        self._start_ns = self._deadline_ns = 0
        self._counter = self._expected = self._arrived = self._awaited = 0
        self._damaged = False
        self._numbers: dict[int, int] = {}
        self._seen: set[tuple[int, int]] = set()
        # of the messages that may come of each object: how many have in this scan, and for how
        # many scans none has; at first they are waited for once
        self._came = [0] * layout.also
        self._silent = [FORGET_SCANS - 1] * layout.also
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
            if frame.id in self._of_others:
                counts.other_sensor += 1
            else:
                counts.unknown += 1
            return None
        t_ns, data = frame.t_ns, frame.data
        if not self._passes(message, frame):
            return None
        slot = message.slot
        if message.take is None:
            assert message.read is not None
            raws = message.read(data[: message.length])
            if slot == EGO:
                self._ego.take(frame.id, t_ns, raws)
                counts.ego += 1
                return None
            finished = self.flush(t_ns)
            finished = self._take_header(t_ns, message.sensor, raws) or finished
        else:
            finished = self.flush(t_ns)
            row = message.take(data[: message.length])
            if self._layout.slots:
                if self._is_stale(t_ns, row[1]):
                    counts.stray += 1
                    return finished
                if self._open and row[1] != self._counter:
                    finished = self._finish()
                if not self._open:
                    self._begin(t_ns, row[1], self._layout.slots)
                if slot in self._numbers:
                    counts.duplicates += 1
                    return finished
                self._take_object(slot, row)
            elif not self._open:
                counts.stray += 1
                if slot:  # the sensor sends such messages, so the next scan waits for them
                    self._silent[slot - 1] = 0
                return finished
            elif slot:
                self._complete_object(slot, row)
            elif self._arrived == self._expected:
                counts.stray += 1
                return finished
            else:
                self._take_object(row[1], row)
        if self._open and not self._awaited and finished is None:
            finished = self._finish()
        return finished

    def flush(self, t_ns: int) -> Scan | None:
        """Give up a scan that is overdue at ``t_ns`` [ns]; call it in every step."""
        if self._open and (not self._awaited or t_ns > self._deadline_ns):
            return self._finish()
        return None

    def _choose(self, sensor: int) -> None:
        """From now on this sensor's frames count, and only these."""
        self.sensor = sensor
        of_all = self._layout.messages
        self._messages = {**self._ego.of_sensor(sensor), **of_all[sensor]}
        others = frozenset(frame_id for ids in of_all.values() for frame_id in ids)
        self._of_others = others - frozenset(self._messages)

    def _passes(self, message: CompiledMessage, frame: Frame) -> bool:
        """Kind, length, checksum and counter; counts what fails."""
        counts = self.counts
        if frame.flags & _UNSUITABLE:
            counts.bad_kind += 1
            return False
        data = frame.data
        if not message.length <= len(data) <= message.longest:
            if message.slot == EGO:
                counts.unknown += 1  # another message that happens to have the id
            else:
                counts.bad_length += 1
            return False
        guard = message.guard
        if guard is None:
            return True
        if not guard.check(data):
            counts.bad_crc += 1
            return False
        counts.checksums_ok += 1
        if not guard.modulus:
            return True
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

    def _take_header(self, t_ns: int, sensor: int, raws: tuple[int, ...]) -> Scan | None:
        finished = self._finish() if self._open else None
        count, (low, high) = raws[0], self._layout.count_range
        if not low <= count <= high:
            self.counts.out_of_range += 1
            return finished
        if self.sensor is None:
            self._choose(sensor)
        self.counts.used += 1
        self._begin(t_ns, raws[1], count)
        return finished

    def _take_object(self, key: int, row: tuple[Any, ...]) -> None:
        """The first frame of an object of the open scan; all of it, or nothing but a count."""
        counts = self.counts
        self._arrived += 1
        self._awaited -= 1
        numbers = self._numbers
        if row[0] != USABLE:
            numbers.setdefault(key, NO_OBJECT)
            if row[0] == EMPTY:
                counts.empty += 1
            else:
                self._reject("out_of_range")
            return
        if numbers.get(key, NO_OBJECT) != NO_OBJECT:
            self._reject("duplicates")
            return
        counts.not_available += row[3]
        objects = self._objects
        number = len(objects.ids)
        if number == self._scan.capacity:
            numbers[key] = NO_OBJECT
            self._reject("overflow")
            return
        numbers[key] = number
        counts.used += 1
        objects.add(key, row)

    def _complete_object(self, slot: int, row: tuple[Any, ...]) -> None:
        """A further frame of an object of the open scan."""
        counts, key = self.counts, row[1]
        number = self._numbers.get(key)
        if number is None:
            counts.stray += 1
            return
        if (slot, key) in self._seen:
            counts.duplicates += 1
            return
        self._seen.add((slot, key))
        which = slot - 1
        if self._silent[which] >= FORGET_SCANS and not self._came[which]:
            self._awaited += self._expected
        self._came[which] += 1
        self._awaited -= 1
        if row[0] != USABLE or number == NO_OBJECT:
            counts.empty += 1
            if number != NO_OBJECT:
                self._objects.drop(number)
            return
        counts.used += 1
        self._objects.complete(number, slot, row)

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
        self._awaited = expected * (1 + sum(scans < FORGET_SCANS for scans in self._silent))
        self._came = [0] * len(self._came)
        self._damaged = False
        self._numbers, self._seen = {}, set()
        self._objects.clear()

    def _finish(self) -> Scan:
        """Close the open scan and write it to the buffer."""
        scan = self._scan
        scan.t_ns = self._start_ns - self._latency_ns
        scan.counter = self._counter
        scan.incomplete = self._damaged or self._arrived < self._expected
        scan.ego_speed, scan.ego_yaw_rate = self._ego.at(self._start_ns)
        self._objects.write(scan)
        if self._expected:
            self._silent = [
                0 if came else scans + 1
                for came, scans in zip(self._came, self._silent, strict=True)
            ]
        self._open = False
        self._ended_counter, self._ended_ns = self._counter, self._start_ns
        self.counts.scans += 1
        self.counts.incomplete_scans += scan.incomplete
        return scan
