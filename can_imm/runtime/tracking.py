"""The tracker's node: detection frames in, object frames out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from can_imm.bus.frame import Frame
from can_imm.runtime.nodes import MAX_WAITING, Waiting
from can_imm.types import DetectionScan, Scan

if TYPE_CHECKING:
    from can_imm.bus.detections import DetectionDecoder, TrackedEncoder
    from can_imm.trackers import Tracker

Listener = Callable[[int, Scan], None]
"""Called after each scan with the step's time [ns] and the objects, a buffer of the tracker."""


class TrackerNode:
    """Decodes detections, steps the tracker, encodes its objects."""

    def __init__(
        self,
        decoder: DetectionDecoder,
        tracker: Tracker,
        encoder: TrackedEncoder,
        listeners: Sequence[Listener] = (),
        *,
        sensors: int = 15,
        capacity: int = 256,
    ) -> None:
        self.decoder = decoder
        self.tracker = tracker
        self._encoder = encoder
        self._listeners = listeners
        self._waiting = Waiting([DetectionScan(sensors, capacity) for _ in range(MAX_WAITING)])
        # answers go where the sensors' frames came from
        self._channel: str | None = None

    @property
    def dropped_scans(self) -> int:
        """Scans that the tracker never saw, because too many came at once."""
        return self._waiting.dropped

    def step(self, t_ns: int, frames: list[Frame]) -> list[Frame]:
        for frame in frames:
            scan = self.decoder.feed(frame)
            if scan is not None:
                self._channel = frame.channel
                self._waiting.put(scan)
        self._waiting.put(self.decoder.flush(t_ns))
        detections = self._waiting.take()
        objects = self.tracker.step(t_ns, detections)
        if detections is not None:
            self._waiting.done(detections)
        if objects is None:
            return []
        for listener in self._listeners:
            listener(t_ns, objects)
        answers = self._encoder.encode(objects, t_ns)
        if self._channel is not None:
            answers = [frame._replace(channel=self._channel) for frame in answers]
        return answers
