"""Own frames that a bus hands back."""

from __future__ import annotations

from collections import deque

from can_imm.bus.frame import Frame
from can_imm.runtime.feeds import FrameSource
from can_imm.runtime.health import Health
from can_imm.runtime.loop import Output

REMEMBERED = 1024


class EchoFilter:
    """A source and a sink in one, which keeps a node from hearing itself.

    udp_multicast delivers what one sends to oneself as well, socketcan does on request.  Such a
    frame has been recorded when it was sent; it is counted here and goes no further.
    """

    def __init__(self, source: FrameSource, sink: Output, health: Health) -> None:
        self._source = source
        self._sink = sink
        self._health = health
        self._sent: deque[tuple[int, bytes]] = deque(maxlen=REMEMBERED)
        self._ids: set[int] = set()

    def send(self, frame: Frame) -> None:
        self._ids.add(frame.id)
        self._sent.append((frame.id, frame.data))
        self._sink.send(frame)

    def rehearse(self, frame: Frame) -> None:
        self._sink.rehearse(frame)

    def recv(self, timeout_s: float) -> Frame | None:
        while True:
            frame = self._source.recv(timeout_s)
            if frame is None or frame.id not in self._ids:
                return frame
            key = (frame.id, frame.data)
            if key not in self._sent:
                return frame
            self._sent.remove(key)
            self._health.echoes += 1
            timeout_s = 0.0
