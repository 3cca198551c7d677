"""The figure of `can-imm latency`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import matplotlib as mpl
from matplotlib.figure import Figure

from can_imm.plots.style import BAR, STYLE


class Distribution(Protocol):
    """A histogram of durations, as `can_imm.runtime.histogram.Histogram`."""

    counts: list[int]
    n: int

    def edge_ns(self, i: int) -> float:
        """Lower edge of bin ``i`` [ns]."""


def latency_figure(path: Path, stages: Mapping[str, Distribution]) -> Path:
    """Distributions of durations over a logarithmic axis, one row per stage."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.0, 0.6 * len(stages) + 1.0))
        axes = figure.subplots(len(stages), 1, sharex=True, squeeze=False)[:, 0]
        for ax, (name, stage) in zip(axes, stages.items(), strict=True):
            # four bins of 1 % to one that can be seen
            counts = [sum(stage.counts[i : i + 4]) for i in range(0, len(stage.counts), 4)]
            edges = [stage.edge_ns(4 * i) / 1e3 for i in range(len(counts) + 1)]
            share = [100.0 * count / max(stage.n, 1) for count in counts]
            ax.stairs(share, edges, fill=True, color=BAR)
            ax.set_xscale("log")
            ax.set_xlim(1.0, 1e5)
            ax.set_yticks([])
            ax.set_ylabel(name.replace("_", " "), rotation=0, ha="right", va="center")
        axes[-1].set_xlabel("duration [us]")
        figure.tight_layout()
        figure.savefig(path)
    return path
