"""What a loop counts about itself, and how long its answers take."""

from __future__ import annotations

from dataclasses import dataclass, field


class LatencyLog:
    """Histogram of durations with bins that double; constant memory, nothing allocated per entry.

    Bin ``i`` holds durations below ``2**i`` microseconds; quantiles are upper bin edges, so they
    are right to within a factor of two, which is what a glance at a summary needs.
    """

    BINS = 32

    def __init__(self) -> None:
        self.counts = [0] * self.BINS
        self.n = 0
        self.max_ns = 0

    def add(self, duration_ns: int) -> None:
        """Enter a duration [ns]; a negative one counts as zero."""
        duration_ns = max(duration_ns, 0)
        self.counts[min((duration_ns // 1000).bit_length(), self.BINS - 1)] += 1
        self.n += 1
        self.max_ns = max(self.max_ns, duration_ns)

    def quantile_ns(self, q: float) -> int:
        """Return a bound [ns] that a fraction ``q`` of the entries does not exceed; 0 if empty."""
        wanted, seen = q * self.n, 0
        for i, count in enumerate(self.counts):
            seen += count
            if count and seen >= wanted:
                return min(1000 << i, self.max_ns)
        return 0


@dataclass
class Health:
    """Counters of one loop.

    Attributes:
        steps: steps executed.
        deadline_misses: steps that ended after the next one was due; the missed ones are executed
            at once, each with its own time.
        skipped_steps: steps left out because nothing happened on the bus for a long time.
        late_frames: frames that came after their step was executed; the next step got them.
        clock_jumps: times that the bus's or the machine's clock was set.
        echoes: own frames that the bus handed back.
        frames: frames received.
        sent: frames sent.
        response: from the moment a step is due until its frames are sent.
    """

    steps: int = 0
    deadline_misses: int = 0
    skipped_steps: int = 0
    late_frames: int = 0
    clock_jumps: int = 0
    echoes: int = 0
    frames: int = 0
    sent: int = 0
    response: LatencyLog = field(default_factory=LatencyLog)
