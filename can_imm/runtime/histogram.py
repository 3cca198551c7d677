"""A histogram of durations for runs of any length."""

from __future__ import annotations

import math

QUANTILES = {"p50_us": 0.5, "p90_us": 0.9, "p99_us": 0.99, "p999_us": 0.999}


class Histogram:
    """Durations in bins 1 % wide, from 0.1 us to 100 s; constant memory for a run of any length.

    Attributes:
        counts: entries by bin.
        max_ns: the longest duration [ns], exactly.
    """

    LEAST_NS = 100.0
    _WIDTH = math.log(1.01)
    BINS = int(math.log(1e11 / LEAST_NS) / _WIDTH) + 1

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all entries."""
        self.counts = [0] * self.BINS
        self.n = 0
        self.max_ns = 0

    def add(self, duration_ns: int) -> None:
        """Enter a duration [ns]."""
        ratio = max(duration_ns / self.LEAST_NS, 1.0)
        self.counts[min(int(math.log(ratio) / self._WIDTH), self.BINS - 1)] += 1
        self.n += 1
        self.max_ns = max(self.max_ns, duration_ns)

    def quantile_ns(self, q: float) -> float:
        """Duration [ns] that a fraction ``q`` does not exceed, to 1 %; 0 if there is none."""
        wanted, seen = q * self.n, 0
        for i, count in enumerate(self.counts):
            seen += count
            if count and seen >= wanted:
                return min(self.edge_ns(i + 1), float(self.max_ns))
        return 0.0

    @classmethod
    def edge_ns(cls, i: int) -> float:
        """Lower edge of bin ``i`` [ns]."""
        return cls.LEAST_NS * math.exp(i * cls._WIDTH)

    def summary(self) -> dict[str, float]:
        """Quantiles and maximum [us]."""
        values = {name: self.quantile_ns(q) / 1e3 for name, q in QUANTILES.items()}
        return {**values, "max_us": self.max_ns / 1e3}
