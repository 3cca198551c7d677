"""Reports by hindsight: a smoother between the detector and those who listen to it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from can_imm.runtime.nodes import Listener, Reports, Smoother


class Smoothed:
    """A listener that passes on smoothed reports instead of those that it hears.

    Args:
        smoother: the detector's history.
        listeners: called with the smoothed reports, in the order of time.
    """

    def __init__(self, smoother: Smoother, listeners: Sequence[Listener]) -> None:
        self._smoother = smoother
        self._listeners = listeners

    def __call__(self, t_ns: int, reports: Reports) -> None:
        self._pass_on(self._smoother.due(t_ns))

    def finish(self) -> None:
        """Pass on what is left: no more scans will come."""
        self._pass_on(self._smoother.finish())

    def _pass_on(self, scans: Iterable[tuple[int, Reports]]) -> None:
        for t_ns, reports in scans:
            for listener in self._listeners:
                listener(t_ns, reports)
