"""Feeds give a loop the frames of one step at a time: from a bus, from a log, or none.

Step k lies at ``t_k = k * step`` of the bus clock and owns the frames with
``t_(k-1) < t <= t_k``.  A frame that turns up when its step is over is given the time
``t_(last step) + 1 us``, which makes it the next step's.  The recorder writes that time, so a
replay of the recording deals out the same frames to the same steps.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Protocol

from can_imm.bus.frame import Frame
from can_imm.runtime.clock import JUMP_NS, Clock
from can_imm.runtime.health import Health

LATE_NS = 1000
"""How far after the last step [ns] a late frame is put: the resolution of a candump log."""

GUARD_NS = 2_000_000
"""How long after ``t_k`` [ns] a live step waits for frames that are still on their way."""

REHEARSAL_S = 400e-6
"""What a rehearsal may take [s].  What a step needs is in none of the processor's caches after some
milliseconds of other work, so a live step with frames is rehearsed before it is worked on."""

FRAME_S = 25e-6
"""What it takes about, frame by frame, to do what can be done of a step before it is due [s]."""

AWAKE_S = 150e-6
"""So long before it has something to do the loop stops sleeping [s], for waking up takes time."""

Ahead = Callable[[int, list[Frame]], None]
"""Work before a step is due: called with the step's time [ns] and its frames up to now."""


def _nothing(t_ns: int, frames: list[Frame]) -> None:
    pass


class Feed(Protocol):
    """Frames for a loop, step by step.

    ``rehearse`` and ``prepare``, set by the loop, are called shortly before a live step that has
    frames: first the rehearsal, if there is time (one is also called before the first step), then
    what does as much of the step as these frames allow; that again when more frames come.
    """

    clock: Clock
    guard_ns: int
    rehearse: Ahead
    prepare: Ahead

    def start_ns(self, step_ns: int) -> int:
        """Return the time of the first step [ns], a multiple of ``step_ns``; called once."""

    def collect(self, t_ns: int) -> list[Frame] | None:
        """Wait until step ``t_ns`` is due and return its frames; None when no more will come."""

    def next_ns(self) -> int:
        """Return the earliest time [ns] at which a further step can have anything to do."""


class FrameSource(Protocol):
    """A live bus to receive from."""

    def recv(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None after ``timeout_s`` seconds."""


class BusFeed:
    """Frames of a live bus.

    Frame times are taken as they come where they agree with the clock (socketcan, udp_multicast
    and virtual stamp with Unix time).  Where they do not - hardware that counts from its own start,
    or a clock that was set - the difference is taken from the first such frame and then follows
    the fastest frames, rising by 1 us per frame so that two drifting clocks stay together.

    Args:
        source: the bus.
        clock: bus time.
        health: counters to keep.
        guard_ns: how long after a step's time to wait for frames on their way [ns].
    """

    def __init__(
        self, source: FrameSource, clock: Clock, health: Health, guard_ns: int = GUARD_NS
    ) -> None:
        self.clock = clock
        self.rehearse: Ahead = _nothing
        self.prepare: Ahead = _nothing
        self._source = source
        self._health = health
        self.guard_ns = guard_ns
        self._pending: deque[Frame] = deque()
        self._done_ns = 0
        self._offset_ns = 0
        self._foreign = False

    def start_ns(self, step_ns: int) -> int:
        self.rehearse(0, [])
        self._done_ns = self.clock.now_ns() // step_ns * step_ns
        return self._done_ns

    def collect(self, t_ns: int) -> list[Frame]:
        due_ns = t_ns + self.guard_ns
        prepared = 0
        while True:
            remaining_s = timeout_s = self.clock.remaining_s(due_ns)
            if remaining_s > 0 and self._pending and self._pending[0].t_ns <= t_ns:
                ahead_s = AWAKE_S
                if prepared < len(self._pending):
                    ahead_s += REHEARSAL_S + FRAME_S * len(self._pending)
                if remaining_s > ahead_s:
                    timeout_s -= ahead_s
                elif prepared < len(self._pending):
                    mine = [frame for frame in self._pending if frame.t_ns <= t_ns]
                    if not prepared and remaining_s > REHEARSAL_S:
                        self.rehearse(t_ns, mine)
                    self.prepare(t_ns, mine)
                    prepared = len(self._pending)
                    continue
                else:
                    timeout_s = 0.0
            frame = self._source.recv(max(timeout_s, 0.0))
            if frame is None:
                if remaining_s <= 0:
                    break
                continue
            frame = self._on_bus_time(frame)
            self._pending.append(frame)
            # When late, read on only as far as this step goes: what follows is later still.
            if remaining_s <= 0 and frame.t_ns > t_ns:
                break
        self._done_ns = t_ns
        mine = [frame for frame in self._pending if frame.t_ns <= t_ns]
        if mine:
            self._pending = deque(frame for frame in self._pending if frame.t_ns > t_ns)
        return mine

    def next_ns(self) -> int:
        return self._pending[0].t_ns if self._pending else self.clock.now_ns()

    def _on_bus_time(self, frame: Frame) -> Frame:
        now_ns = self.clock.now_ns() // 1000 * 1000
        t_ns = frame.t_ns + self._offset_ns
        if not self._done_ns - JUMP_NS <= t_ns <= now_ns + JUMP_NS:
            if self._foreign:
                self._health.clock_jumps += 1
            self._foreign = True
            self._offset_ns = now_ns - frame.t_ns
            t_ns = now_ns
        elif self._foreign:
            self._offset_ns = min(now_ns - frame.t_ns, self._offset_ns + 1000)
            t_ns = frame.t_ns + self._offset_ns
        t_ns = min(t_ns, now_ns)
        if t_ns <= self._done_ns:
            self._health.late_frames += 1
            t_ns = self._done_ns + LATE_NS
        return frame if t_ns == frame.t_ns else frame._replace(t_ns=t_ns)


class LogFeed:
    """Frames of a log, in the log's own time.

    Time that runs backwards by more than a drift (two logs in one file) continues where it was.

    Args:
        frames: the log.
        clock: `FastClock` or `PacedClock`.
        health: counters to keep.
        replaced: ids whose frames are left out, because the loop makes them anew; they still count
            as time that passed.
    """

    def __init__(
        self,
        frames: Iterable[Frame],
        clock: Clock,
        health: Health,
        replaced: frozenset[int] = frozenset(),
    ) -> None:
        self.clock = clock
        self.rehearse: Ahead = _nothing
        self.prepare: Ahead = _nothing
        self.guard_ns = 0
        self.n_replaced = 0
        self._frames = iter(frames)
        self._health = health
        self._replaced = replaced
        self._offset_ns = 0
        self._next = next(self._frames, None)
        self._earliest_ns = 0 if self._next is None else self._next.t_ns

    def start_ns(self, step_ns: int) -> int:
        self._earliest_ns = self._earliest_ns // step_ns * step_ns
        return self._earliest_ns

    def collect(self, t_ns: int) -> list[Frame] | None:
        if self._next is None:
            return None
        while (remaining_s := self.clock.remaining_s(t_ns)) > 0:
            time.sleep(remaining_s)
        mine = []
        frame: Frame | None = self._next
        frames, replaced = self._frames, self._replaced
        while frame is not None and frame.t_ns <= t_ns:
            if frame.id in replaced:
                self.n_replaced += 1
            else:
                mine.append(frame)
            frame = next(frames, None)
            if frame is not None and (self._offset_ns or frame.t_ns < self._earliest_ns):
                frame = self._in_order(frame)
        self._next = frame
        self._earliest_ns = t_ns + LATE_NS
        return mine

    def next_ns(self) -> int:
        return 0 if self._next is None else self._next.t_ns

    def _in_order(self, frame: Frame) -> Frame:
        """The frame with a time that does not run backwards."""
        t_ns = frame.t_ns + self._offset_ns
        if t_ns < self._earliest_ns - JUMP_NS:
            self._health.clock_jumps += 1
            self._offset_ns += self._earliest_ns - t_ns
            t_ns = self._earliest_ns
        elif t_ns < self._earliest_ns:
            self._health.late_frames += 1
            t_ns = self._earliest_ns
        return frame if t_ns == frame.t_ns else frame._replace(t_ns=t_ns)


class IdleFeed:
    """No frames, only the passing of time: for a node that sends and does not listen."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.rehearse: Ahead = _nothing
        self.prepare: Ahead = _nothing
        self.guard_ns = 0

    def start_ns(self, step_ns: int) -> int:
        return -(-self.clock.now_ns() // step_ns) * step_ns

    def collect(self, t_ns: int) -> list[Frame]:
        while (remaining_s := self.clock.remaining_s(t_ns)) > 0:
            time.sleep(remaining_s)
        return []

    def next_ns(self) -> int:
        return self.clock.now_ns()
