"""How long an answer takes, stage by stage: stamps around a node's own parts.

All stamps are `time.perf_counter_ns`.  A round is one scan: sent, read, answered, handed over::

    sent -receive-> read -wait-> due -late-> start -send-> over

-decode-> -estimate-> -encode-> lies in the wait, as far as that is long enough, else before send;
``work`` is all that the node does from the scan's last frame on, decode to send, whenever it does
it.  ``processing`` is the way from read to over, ``response`` the one from sent back to the sender,
both less the wait for the next fixed step, to be compared with a bare echo node's round trip.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from can_imm.bus.echo import ECHO_ANSWER, ECHO_REQUEST
from can_imm.bus.encoder import OUTPUT_IDS, STATUS_ID
from can_imm.bus.frame import Frame
from can_imm.runtime.clock import Clock
from can_imm.runtime.feeds import FrameSource
from can_imm.runtime.histogram import Histogram
from can_imm.runtime.loop import Node, Output, Sink

if TYPE_CHECKING:
    from can_imm.detector import Detector
    from can_imm.runtime.nodes import DetectorNode
    from can_imm.types import Scan

T = TypeVar("T")

STAGES = ("receive", "wait", "late", "decode", "estimate", "encode", "send", "work",
          "processing", "end_to_end", "response")  # fmt: skip

TIMEOUT_S = 1.0
"""What has not come by then [s] is lost."""


class Stamps(NamedTuple):
    """When what happened to one scan in the node [ns].

    ``start`` is the begin of the step, ``begun`` of the work on the scan, which may be earlier.
    """

    read: int
    due: int
    start: int
    begun: int
    decoded: int
    estimated: int
    encoded: int
    sent: int


class Probe:
    """Stamps a detector node from outside: wrap its source, detector, node and sink.

    Attributes:
        lateness: of every step's begin.
    """

    def __init__(self, clock: Clock, guard_ns: int, sensor_ids: frozenset[int]) -> None:
        self._finished: deque[Stamps] = deque(maxlen=64)
        self.lateness = Histogram()
        self._clock = clock
        self._guard_ns = guard_ns
        self._sensor_ids = sensor_ids
        self._latest_read = self._read = self._due = self._start = self._sent = 0
        self._begun = self._decoded = self._estimated = self._encoded = 0
        self._has_scan = self._over = False

    def source(self, source: FrameSource) -> FrameSource:
        """Stamp the sensor's frames when they are read."""
        return _Source(self, source)

    def detector(self, detector: Detector) -> Any:
        """Stamp begin and end of the detector's work; everything else passes through."""
        return _Detector(self, detector)

    def node(self, node: DetectorNode) -> Node:
        """Stamp begin and end of a step, and of what is done ahead of it."""
        return _Node(self, node)

    def sink(self, sink: Output) -> Output:
        """Stamp every frame that was handed over."""
        return _Sink(self, sink)

    def frame_read(self, frame: Frame) -> None:
        if frame.id in self._sensor_ids:
            self._latest_read = time.perf_counter_ns()

    def work(self, part: Callable[[int, list[Frame]], T], t_ns: int, frames: list[Frame]) -> T:
        """Let the node do a part of a step."""
        self._close()
        had_scan, begun = self._has_scan, time.perf_counter_ns()
        result = part(t_ns, frames)
        if self._has_scan and not had_scan:
            self._begun, self._encoded = begun, time.perf_counter_ns()
        return result

    def step_begins(self, t_ns: int) -> None:
        self._close()
        late_ns = self._clock.now_ns() - t_ns - self._guard_ns
        self._start = time.perf_counter_ns()
        self._due = self._start - late_ns
        self.lateness.add(late_ns)

    def step_ends(self) -> None:
        self._over = True

    def detector_begins(self, scan: Scan | None) -> None:
        if scan is not None:
            self._has_scan = True
            self._read, self._decoded = self._latest_read, time.perf_counter_ns()

    def detector_ends(self) -> None:
        self._estimated = time.perf_counter_ns()

    def frame_sent(self, frame: Frame) -> None:
        if frame.id != STATUS_ID:
            self._sent = time.perf_counter_ns()

    def stamps_of(self, sent: int) -> Stamps | None:
        """Stamps of the scan that was sent at ``sent`` [ns]; they come with the node's next step,
        which is waited for."""
        end = time.perf_counter() + TIMEOUT_S
        while time.perf_counter() < end:
            while self._finished:
                stamps = self._finished.popleft()
                if stamps.read >= sent:
                    return stamps
            time.sleep(0.002)
        return None

    def _close(self) -> None:
        """The last frame of a step is known when work on the next one begins."""
        if self._over and self._has_scan:
            self._has_scan = False
            self._finished.append(
                Stamps(self._read, self._due, self._start, self._begun, self._decoded,
                       self._estimated, self._encoded, self._sent)
            )  # fmt: skip
        self._over = False


class _Source:
    def __init__(self, probe: Probe, source: FrameSource) -> None:
        self._probe, self._source = probe, source

    def recv(self, timeout_s: float) -> Frame | None:
        frame = self._source.recv(timeout_s)
        if frame is not None:
            self._probe.frame_read(frame)
        return frame


class _Detector:
    def __init__(self, probe: Probe, detector: Detector) -> None:
        self._probe, self._detector = probe, detector
        self.reports, self.counts = detector.reports, detector.counts

    @property
    def n_tracked(self) -> int:
        return self._detector.n_tracked

    def understudy(self) -> Detector:
        return self._detector.understudy()

    def step(self, t_ns: int, scan: Scan | None) -> int:
        self._probe.detector_begins(scan)
        n = self._detector.step(t_ns, scan)
        self._probe.detector_ends()
        return n


class _Node:
    def __init__(self, probe: Probe, node: DetectorNode) -> None:
        self._probe, self._node = probe, node
        self.rehearse = node.rehearse

    def prepare(self, t_ns: int, frames: list[Frame]) -> None:
        self._probe.work(self._node.prepare, t_ns, frames)

    def step(self, t_ns: int, frames: list[Frame]) -> list[Frame]:
        self._probe.step_begins(t_ns)
        answers = self._probe.work(self._node.step, t_ns, frames)
        self._probe.step_ends()
        return answers


class _Sink:
    def __init__(self, probe: Probe, sink: Output) -> None:
        self._probe, self._sink = probe, sink
        self.rehearse = sink.rehearse

    def send(self, frame: Frame) -> None:
        self._sink.send(frame)
        self._probe.frame_sent(frame)


class Rounds:
    """Sends scans and echo requests, waits for the answers, keeps the durations.

    Args:
        source, sink: its end of the bus.
        stamps_of: `Probe.stamps_of` of the node.

    Attributes:
        stages: `Histogram` by name of `STAGES`.
        echo: round trips of the echo node.
        lost: rounds without a complete answer in time.
    """

    def __init__(
        self, source: FrameSource, sink: Sink, stamps_of: Callable[[int], Stamps | None]
    ) -> None:
        self.stages = {name: Histogram() for name in STAGES}
        self.echo = Histogram()
        self.lost = 0
        self._source, self._sink, self._stamps_of = source, sink, stamps_of

    def reset(self) -> None:
        """Forget all rounds."""
        for histogram in (*self.stages.values(), self.echo):
            histogram.reset()
        self.lost = 0

    def scan(self, frames: Sequence[Frame], answers: int) -> None:
        """One round: ``answers`` frames beside DetectorStatus are the complete answer."""
        for frame in frames[:-1]:
            self._sink.send(frame)
        sent = time.perf_counter_ns()
        self._sink.send(frames[-1])
        back = self._wait(OUTPUT_IDS - {STATUS_ID}, answers)
        stamps = self._stamps_of(sent)
        if not back or stamps is None:
            self.lost += 1
            return
        s = stamps
        # A scan that comes while its step is already late waits for nothing.
        waited = max(s.due - s.read, 0)
        sending = s.sent - max(s.start, s.encoded)
        durations = (
            s.read - sent, waited, max(s.start - max(s.due, s.read), 0), s.decoded - s.begun,
            s.estimated - s.decoded, s.encoded - s.estimated, sending,
            s.encoded - s.begun + sending, s.sent - s.read - waited, back - sent,
            back - sent - waited,
        )  # fmt: skip
        for name, duration in zip(STAGES, durations, strict=True):
            self.stages[name].add(duration)

    def bounce(self) -> None:
        """One round trip of the echo node."""
        sent = time.perf_counter_ns()
        self._sink.send(Frame(0, ECHO_REQUEST, bytes(8)))
        back = self._wait(frozenset({ECHO_ANSWER}), 1)
        if back:
            self.echo.add(back - sent)
        else:
            self.lost += 1

    def _wait(self, ids: frozenset[int], count: int) -> int:
        """When the last of ``count`` frames arrived [ns], 0 after the timeout."""
        end = time.perf_counter() + TIMEOUT_S
        while (left := end - time.perf_counter()) > 0:
            frame = self._source.recv(left)
            now = time.perf_counter_ns()
            if frame is not None and frame.id in ids:
                count -= 1
                if count == 0:
                    return now
        return 0
