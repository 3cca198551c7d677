"""Clocks: what time it is on the bus, and how long until a step is due.

All of them count integer nanoseconds of bus time, which does not jump; on a live bus that is the
wall clock (Unix time) as it was when the run began, carried on steadily.
"""

from __future__ import annotations

import time
from typing import Protocol

JUMP_NS = 200_000_000
"""A clock that moves by more than this [ns] against another one has jumped, not drifted."""

# Unlike CLOCK_MONOTONIC this one goes on while the machine sleeps, as the world outside does.
_STEADY = getattr(time, "CLOCK_BOOTTIME", None)


def steady_ns() -> int:
    """Nanoseconds of a clock that nobody sets."""
    return time.monotonic_ns() if _STEADY is None else time.clock_gettime_ns(_STEADY)


class Clock(Protocol):
    """Bus time for a loop."""

    jumps: int

    def now_ns(self) -> int:
        """Bus time [ns]."""

    def remaining_s(self, t_ns: int) -> float:
        """Seconds from now until bus time ``t_ns``; zero or less once that is due."""


class WallClock:
    """Bus time is Unix time.  Slow corrections (NTP slewing) are followed, as the kernel's frame
    timestamps follow them; when somebody sets the clock, bus time goes on as if nobody had
    (counted in ``jumps``)."""

    def __init__(self) -> None:
        self.jumps = 0
        self._shift_ns = 0
        self._ahead_ns = time.time_ns() - steady_ns()

    def now_ns(self) -> int:
        wall_ns = time.time_ns()
        ahead_ns = wall_ns - steady_ns()
        moved_ns = ahead_ns - self._ahead_ns
        self._ahead_ns = ahead_ns
        if abs(moved_ns) > JUMP_NS:
            self.jumps += 1
            self._shift_ns -= moved_ns
        return wall_ns + self._shift_ns

    def remaining_s(self, t_ns: int) -> float:
        return (t_ns - self.now_ns()) * 1e-9


class PacedClock:
    """Real time, from the first moment that is asked for: to watch a log at the speed of life."""

    def __init__(self) -> None:
        self.jumps = 0
        self._shift_ns: int | None = None

    def now_ns(self) -> int:
        return steady_ns() + (self._shift_ns or 0)

    def remaining_s(self, t_ns: int) -> float:
        if self._shift_ns is None:
            self._shift_ns = t_ns - steady_ns()
        return (t_ns - self.now_ns()) * 1e-9


class FastClock:
    """As fast as possible: whatever is asked for is due now."""

    def __init__(self, origin_ns: int = 0) -> None:
        self.jumps = 0
        self._now_ns = origin_ns

    def now_ns(self) -> int:
        return self._now_ns

    def remaining_s(self, t_ns: int) -> float:
        self._now_ns = max(self._now_ns, t_ns)
        return 0.0
