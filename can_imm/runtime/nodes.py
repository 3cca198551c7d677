"""The nodes: a sender that plays scans, and the detector that answers to them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import numpy.typing as npt

from can_imm.bus.encoder import DetectorState, ManoeuvreEncoder, StatusValues
from can_imm.bus.frame import Frame
from can_imm.runtime.health import Health
from can_imm.types import DetectionScan, Scan

if TYPE_CHECKING:
    from can_imm.bus.decoder import ScanDecoder
    from can_imm.detector import Detector
    from can_imm.sim.player import Player, Timed

SENSOR_TIMEOUT_NS = 1_000_000_000
"""After so long without a scan [ns] the heartbeat says that there is no sensor."""

MAX_WAITING = 8
"""Scans that are kept when several come at once: one for this step, one for each of the next."""

REHEARSED = 4
"""So many frames of a step are rehearsed."""

S = TypeVar("S", Scan, DetectionScan)
T = TypeVar("T", bound="Timed")
S_contra = TypeVar("S_contra", contravariant=True)

Reports = npt.NDArray[Any]
"""Structured array of `can_imm.types.REPORT_DTYPE`."""

Listener = Callable[[int, Reports], None]
"""Called after each scan with the step's time [ns] and the detector's reports.  The array is the
detector's own buffer and holds good until the next step."""


class Smoother(Protocol):
    """What goes back over the detector's tracks, see `can_imm.smoothing`."""

    def due(self, t_ns: int) -> Iterable[tuple[int, Reports]]:
        """Give out the scans of which all is known at the step of ``t_ns``: time and reports."""

    def finish(self) -> Iterable[tuple[int, Reports]]:
        """Give out what is left."""


class Waiting(Generic[S]):
    """Scans that wait for their step, in copies: a decoder reuses its scan, and a node takes one
    per step.

    Args:
        copies: buffers for the scans; more than these cannot wait.

    Attributes:
        dropped: scans for which no copy was free.
    """

    def __init__(self, copies: list[S]) -> None:
        self._free: list[S] = copies
        self._queue: deque[S] = deque()
        self.dropped = 0

    def put(self, scan: S | None) -> None:
        """Copy a scan, if there is one, to the end of the queue."""
        if scan is None:
            return
        if not self._free:
            self.dropped += 1
            return
        copy = self._free.pop()
        copy.copy_from(scan)
        self._queue.append(copy)

    def take(self) -> S | None:
        """Give out the first scan, if any waits; `done` takes it back."""
        return self._queue.popleft() if self._queue else None

    def done(self, scan: S) -> None:
        """Take a scan back: another may be copied over it."""
        self._free.append(scan)


class ScanEncoder(Protocol[S_contra]):
    """Writes scans of one kind as frames."""

    def encode(self, scan: S_contra, t_ns: int, /) -> list[Frame]:
        """Frames of ``scan``, stamped ``t_ns`` [ns]."""


class SenderNode(Generic[T]):
    """Sends the scans of a player as frames, when they are due."""

    def __init__(self, player: Player[T], encoder: ScanEncoder[T]) -> None:
        self._player: Player[T] = player
        self._encoder: ScanEncoder[T] = encoder

    def step(self, t_ns: int, frames: list[Frame]) -> list[Frame]:
        scan = self._player.step(t_ns)
        return [] if scan is None else self._encoder.encode(scan, t_ns)


class DetectorNode:
    """Frames in, manoeuvre frames out: decodes scans, steps the detector, encodes its reports.

    Args:
        decoder: finds the scans in the frames.
        detector: judges them.
        encoder: writes the answers; one per node, for its alive counters.
        health: the loop's counters, published in DetectorStatus.
        listeners: called with the reports after each scan.
        capacity: objects that a scan of the decoder can hold.
        every_step: send the predicted ObjectEstimate at the steps between the scans, too.
        smoother: the detector's history.  Sent, and told to the listeners, are its reports instead
            of the detector's, in the step in which they are due.
        watchers: called with the detector's own reports after each scan, smoother or not.
    """

    def __init__(
        self,
        decoder: ScanDecoder,
        detector: Detector,
        encoder: ManoeuvreEncoder,
        health: Health,
        listeners: Sequence[Listener] = (),
        capacity: int = 64,
        *,
        every_step: bool = False,
        smoother: Smoother | None = None,
        watchers: Sequence[Listener] = (),
    ) -> None:
        self._every_step = every_step
        self._smoother = smoother
        self._watchers = watchers
        self.decoder = decoder
        self.detector = detector
        self._encoder = encoder
        self._health = health
        self._listeners = listeners
        self._understudy: DetectorNode | None = None
        # of the step that is being prepared: frames taken in, reports of its scan, their frames
        self._taken = 0
        self._reported: int | None = None
        self._answers: list[Frame] = []
        # the first of several scans need not wait
        self._waiting = Waiting([Scan(capacity) for _ in range(MAX_WAITING - 1)])
        # answers go where the sensor's frames came from
        self._channel: str | None = None
        self._seen_ns: int | None = None
        self._status_ns: int | None = None

    @property
    def dropped_scans(self) -> int:
        """Scans that the detector never saw, because too many came at once."""
        return self._waiting.dropped

    def step(self, t_ns: int, frames: list[Frame]) -> list[Frame]:
        self.prepare(t_ns, frames)
        overdue = self.decoder.flush(t_ns)
        if overdue is not None:
            self._take(t_ns, overdue)
        if self._reported is None:
            self.detector.step(t_ns, None)
        answers, n = self._answers, self._reported or 0
        self._taken, self._reported, self._answers = 0, None, []
        if self._smoother is not None:
            for scan_t_ns, reports in self._smoother.due(t_ns):
                answers += self._say(t_ns, scan_t_ns, reports)
        if self._every_step and n == 0:
            predicted = self.detector.predicted[: self.detector.predict(t_ns)]
            answers += self._encoder.estimates(predicted, t_ns, self._channel)
        if self._status_ns is None or t_ns >= self._status_ns + self._encoder.status_period_ns:
            self._status_ns = t_ns
            status = self._encoder.status(t_ns, self._status(t_ns))
            answers.append(status._replace(channel=self._channel))
        return answers

    def prepare(self, t_ns: int, frames: list[Frame]) -> None:
        """Do all of the step at ``t_ns`` that its first frames allow.

        Any number of times before `step`, which does the rest, with all of the step's frames and
        the same result as if there had been no calls: the first scan to be complete is the step's,
        whatever comes after it, and the reports hold for the step's time.
        """
        if self._reported is None and (waiting := self._waiting.take()) is not None:
            self._judge(t_ns, waiting)
            self._waiting.done(waiting)
        for frame in frames[self._taken :]:
            scan = self.decoder.feed(frame)
            if scan is not None:
                self._channel = frame.channel
                self._take(t_ns, scan)
        self._taken = len(frames)

    def _take(self, t_ns: int, scan: Scan) -> None:
        """Judge the step's first scan; others wait for the next steps."""
        if self._reported is None:
            self._judge(t_ns, scan)
        else:
            self._waiting.put(scan)

    def _judge(self, t_ns: int, scan: Scan) -> None:
        """Step the detector and prepare the answer."""
        self._reported = n = self.detector.step(t_ns, scan)
        self._seen_ns = t_ns
        reports = self.detector.reports[:n]
        for watcher in self._watchers:
            watcher(t_ns, reports)
        if self._smoother is None:
            self._answers += self._say(t_ns, t_ns, reports)

    def rehearse(self, t_ns: int, frames: list[Frame]) -> list[Frame]:
        """Do a step on copies of everything and forget it: shortly before the real one that
        fetches code and tables into the processor's caches.  The first call makes the copies.

        Returns:
            Frames like those of the step, not to be sent.
        """
        understudy = getattr(self.detector, "understudy", None)
        if understudy is None:
            return []  # a stand-in for a detector
        if self._understudy is None:
            self._understudy = DetectorNode(
                deepcopy(self.decoder), understudy(), ManoeuvreEncoder(), Health()
            )
        return self._understudy.step(t_ns, frames[:REHEARSED])

    def _say(self, t_ns: int, scan_t_ns: int, reports: Reports) -> list[Frame]:
        """Return the frames of a scan, stamped ``t_ns`` [ns], and tell the listeners of it."""
        frames = self._encoder.encode(reports, t_ns, self._channel)
        for listener in self._listeners:
            listener(scan_t_ns, reports)
        return frames

    def remaining(self, t_ns: int) -> list[Frame]:
        """Return what a smoother still has to say when no more scans will come; once."""
        answers: list[Frame] = []
        if self._smoother is not None:
            for scan_t_ns, reports in self._smoother.finish():
                answers += self._say(t_ns, scan_t_ns, reports)
        return answers

    def farewell(self, t_ns: int) -> list[Frame]:
        """Return the last frames of a detector that ends: what remains to be said, and
        DetectorStatus, state Stopping."""
        answers = self.remaining(t_ns)
        values = self._status(t_ns)._replace(state=DetectorState.STOPPING)
        return [*answers, self._encoder.status(t_ns, values)._replace(channel=self._channel)]

    def _status(self, t_ns: int) -> StatusValues:
        if self._seen_ns is None:
            state = DetectorState.STARTING
        elif t_ns - self._seen_ns > SENSOR_TIMEOUT_NS:
            state = DetectorState.NO_SENSOR
        else:
            state = DetectorState.RUNNING
        counts = self.decoder.counts
        return StatusValues(
            state=state,
            objects_tracked=self.detector.n_tracked,
            deadline_misses=self._health.deadline_misses,
            frames_rejected=counts.rejected,
            dropped_scans=self.dropped_scans
            + counts.incomplete_scans
            + counts.lost_scans
            + self.detector.counts.late_scans,
        )
