"""Scans handed out when their time has come."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic, Protocol, TypeVar


class Timed(Protocol):
    """A scan of any kind; ``t_ns`` is its time [ns]."""

    t_ns: int


S = TypeVar("S", bound=Timed)


class Player(Generic[S]):
    """Hands out scans in order of time, for the sender's fixed-step loop.

    Args:
        scans: sorted by time.
        start_ns: time on the caller's clock at which the scans' time 0 lies [ns].
    """

    def __init__(self, scans: Sequence[S], start_ns: int = 0) -> None:
        self._scans = scans
        self._start_ns = start_ns
        self._next = 0

    @property
    def done(self) -> bool:
        """All scans have been handed out."""
        return self._next == len(self._scans)

    def step(self, t_ns: int) -> S | None:
        """The next scan if it is due by ``t_ns`` on the caller's clock, else None.

        At most one scan per step; with steps longer than the sensor's period the scans come late
        but none is lost.
        """
        if self.done or self._scans[self._next].t_ns + self._start_ns > t_ns:
            return None
        self._next += 1
        return self._scans[self._next - 1]
