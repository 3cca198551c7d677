"""Own frames that the bus hands back are not heard."""

from __future__ import annotations

from collections import deque

from can_imm.bus.frame import Frame
from can_imm.runtime.echo import EchoFilter
from can_imm.runtime.health import Health


class Mirror:
    """A bus that hands back what one sends, among the frames of others."""

    def __init__(self) -> None:
        self.queue: deque[Frame] = deque()

    def send(self, frame: Frame) -> None:
        self.queue.append(frame._replace(t_ns=frame.t_ns + 1000))

    def recv(self, timeout_s: float) -> Frame | None:
        return self.queue.popleft() if self.queue else None


def test_own_frames_are_counted_and_skipped():
    bus, health = Mirror(), Health()
    own = EchoFilter(bus, bus, health)
    other = Frame(5000, 0x300, b"abc")
    same_id = Frame(6000, 0x310, b"of another detector")
    own.send(Frame(0, 0x310, b"mine"))
    own.send(Frame(0, 0x311, b"mine too"))
    bus.queue += [other, same_id]
    assert own.recv(0.0) == other
    assert own.recv(0.0) == same_id
    assert own.recv(0.0) is None
    assert health.echoes == 2


def test_each_sent_frame_excuses_one_echo():
    bus, health = Mirror(), Health()
    own = EchoFilter(bus, bus, health)
    mine = Frame(0, 0x310, b"mine")
    own.send(mine)
    assert own.recv(0.0) is None
    bus.queue.append(mine)
    assert own.recv(0.0) == mine
