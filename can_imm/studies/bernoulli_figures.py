"""The Bernoulli study's figures: the paper's histograms and scaling plots, and the run time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from can_imm.plots import bernoulli as plots
from can_imm.studies.bernoulli import (
    BINS,
    PRODUCT,
    SYSTEMS,
    Study,
    linearity,
    sweep_means,
)
from can_imm.studies.bernoulli_runtime import PERIOD_S

READINGS = {"std": "$\\sigma_{err}$, std about the mean [m]", "rmse": "RMS error [m]"}
_SWEEPS = {
    "period": ("time between scans", "$T_s$ [s]", "$T_s$ = {:g} s"),
    "particles": ("number of particles", "$N_p$", "$N_p$ = {:g}"),
    "k_s": ("measurement noise", "$k_s$", "$k_s$ = {:g}"),
    "k_m": ("process noise", "$k_m$", "$k_m$ = {:g}"),
}


def figures(directory: Path, done: Study, runtime: Sequence[dict[str, Any]]) -> list[Path]:
    """Draw everything; returns the files."""
    drawn = []
    for sweep, (title, axis, label) in _SWEEPS.items():
        for reading, what in READINGS.items():
            panels = [
                (label.format(point.value), getattr(point, reading))
                for point in done.points
                if point.sweep == sweep and point.system == PRODUCT
            ]
            drawn.append(
                plots.histograms(
                    directory,
                    f"bernoulli_histogram_{sweep}_{reading}",
                    f"Error over {title}, {done.runs} runs each",
                    what,
                    panels,
                    BINS,
                )
            )
        panels_by_reading = [
            (what, [plots.Curve(s, *sweep_means(done, s, sweep, reading)) for s in SYSTEMS])
            for reading, what in READINGS.items()
        ]
        drawn.append(
            plots.scaling(
                directory,
                f"bernoulli_{sweep}",
                f"Error over {title}",
                axis,
                panels_by_reading,
                logarithmic=sweep in ("period", "particles"),
            )
        )
    drawn.append(_over_root(directory, done))
    drawn.append(plots.runtime(directory, runtime, 1e3 * PERIOD_S))
    return drawn


def _over_root(directory: Path, done: Study) -> Path:
    """The error over √k_s, which is the factor of the standard deviations."""
    readings, lines = [], []
    for reading, what in READINGS.items():
        curves = []
        for system in SYSTEMS:
            k_s, mean, error = sweep_means(done, system, "k_s", reading)
            curves.append(plots.Curve(system, np.sqrt(k_s), mean, error))
        readings.append((what, curves))
        lines.append(linearity(curves[0].values, curves[0].mean)[:2])
    return plots.scaling(
        directory,
        "bernoulli_root_k_s",
        "Error over the factor of the noise's standard deviations",
        "$\\sqrt{k_s}$",
        readings,
        logarithmic=False,
        lines=lines,
    )
