"""A bare echo node: the least that any node on a bus can do, and so the floor of its latency."""

from __future__ import annotations

import can

ECHO_REQUEST, ECHO_ANSWER = 0x7F0, 0x7F1


def answer_echoes(bus: can.BusABC, timeout_s: float) -> None:
    """Wait for one frame; if it is a request, send it back under the answer's id."""
    message = bus.recv(timeout_s)
    if message is not None and message.arbitration_id == ECHO_REQUEST:
        message.arbitration_id = ECHO_ANSWER
        bus.send(message)
