"""A smoother in the chain of listeners."""

from __future__ import annotations

from collections import deque

import numpy as np

from can_imm.runtime.smoothed import Smoothed
from can_imm.types import REPORT_DTYPE


class Later:
    """Says of each scan when the one after the next is there what it was, with one object more."""

    def __init__(self) -> None:
        self.known: deque[int] = deque()

    def due(self, t_ns: int):
        self.known.append(t_ns)
        while len(self.known) > 2:
            yield self.say()

    def finish(self):
        while self.known:
            yield self.say()

    def say(self):
        t_ns = self.known.popleft()
        return t_ns, np.zeros(t_ns + 1, REPORT_DTYPE)


def test_every_listener_hears_the_smoother_and_not_the_detector():
    heard: list[tuple[str, int, int]] = []
    listeners = [
        lambda t_ns, reports, name=name: heard.append((name, t_ns, len(reports))) for name in "ab"
    ]
    smoothed = Smoothed(Later(), listeners)
    for t_ns in range(4):
        smoothed(t_ns, np.zeros(t_ns, REPORT_DTYPE))
    assert heard == [("a", 0, 1), ("b", 0, 1), ("a", 1, 2), ("b", 1, 2)]
    smoothed.finish()
    assert heard[4:] == [("a", 2, 3), ("b", 2, 3), ("a", 3, 4), ("b", 3, 4)]
