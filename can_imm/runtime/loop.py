"""The fixed-step loop: collect the frames of a step, let the node work, send, record.

Live, replay and demonstration run this loop; only the feed, the sinks and the clock differ.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from can_imm.bus.frame import Frame
from can_imm.runtime.feeds import Feed
from can_imm.runtime.health import Health

STEP_NS = 10_000_000
"""The step of every loop [ns]."""

IDLE_NS = 60_000_000_000
"""After this long without a frame [ns] steps are skipped: every object has long been given up."""


class Node(Protocol):
    """What a loop drives."""

    def step(self, t_ns: int, frames: list[Frame]) -> list[Frame]:
        """Take in the frames of the step at ``t_ns`` and return the frames to send."""


class Sink(Protocol):
    """Where frames go."""

    def send(self, frame: Frame) -> None:
        """Take one frame; trouble is counted by the sink, not raised."""


class Output(Sink, Protocol):
    """A sink whose frames somebody waits for: a bus."""

    def rehearse(self, frame: Frame) -> None:
        """Do what is done to send a frame, as far as nobody notices."""


class Loop:
    """A node's life in steps of `STEP_NS`.

    Args:
        feed: where a step's frames come from.
        node: what to do with them.
        health: counters to keep; shared with the feed (and with a node that publishes them).
        outputs: sinks for the node's frames (a bus).
        recorders: sinks for all frames, received and sent, in the order of the steps (a log).
    """

    def __init__(
        self,
        feed: Feed,
        node: Node,
        health: Health,
        outputs: Sequence[Output] = (),
        recorders: Sequence[Sink] = (),
    ) -> None:
        self._feed = feed
        self._node = node
        # not every node has something to do before a step is due
        feed.prepare = getattr(node, "prepare", feed.prepare)
        self._rehearse_node = getattr(node, "rehearse", None)
        if self._rehearse_node is not None:
            feed.rehearse = self._rehearse
        self._health = health
        self._outputs = outputs
        self._recorders = recorders
        self._t_ns: int | None = None

    def step(self) -> bool:
        """Execute the next step; False when the feed has ended and nothing was done."""
        if self._t_ns is None:
            t_ns = self._feed.start_ns(STEP_NS)
        else:
            t_ns = self._t_ns + STEP_NS
            idle_ns = self._feed.next_ns() - t_ns
            if idle_ns > IDLE_NS:
                skipped = idle_ns // STEP_NS
                self._health.skipped_steps += skipped
                t_ns += skipped * STEP_NS
        frames = self._feed.collect(t_ns)
        if frames is None:
            return False
        self._t_ns = t_ns
        answers = self._node.step(t_ns, frames)
        self._send(frames, answers)
        self._account(t_ns, len(frames), len(answers))
        return True

    def send_last(self, frames_at: Callable[[int], list[Frame]]) -> None:
        """Send a node's last words, ``frames_at(t_ns)`` at the time of the last step."""
        if self._t_ns is not None:
            answers = frames_at(self._t_ns)
            self._send([], answers)
            self._health.sent += len(answers)

    def _rehearse(self, t_ns: int, frames: list[Frame]) -> None:
        """Do a step that leaves no trace, and all but send the answers."""
        assert self._rehearse_node is not None
        for frame in self._rehearse_node(t_ns, frames):
            for output in self._outputs:
                output.rehearse(frame)

    def _send(self, frames: list[Frame], answers: list[Frame]) -> None:
        for output in self._outputs:
            for frame in answers:
                output.send(frame)
        for sink in self._recorders:
            for frame in frames:
                sink.send(frame)
            for frame in answers:
                sink.send(frame)

    def _account(self, t_ns: int, received: int, sent: int) -> None:
        health = self._health
        health.steps += 1
        health.frames += received
        health.sent += sent
        late_ns = self._feed.clock.now_ns() - t_ns
        if late_ns > STEP_NS + self._feed.guard_ns:
            health.deadline_misses += 1
        if sent:
            health.response.add(late_ns - self._feed.guard_ns)


def run(loops: Sequence[Loop], stop: Callable[[], bool] = lambda: False) -> None:
    """Step ``loops`` in turn (several share one fast clock) until one ends or ``stop()``.

    Senders come before those who listen to them: they work on the same step.
    """
    while not stop():
        for loop in loops:
            if not loop.step():
                return
