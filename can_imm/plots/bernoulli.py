"""Figures of the Bernoulli study, as PNG files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from can_imm.plots.style import STYLE, save
from can_imm.types import FloatArray

COLOURS = {"bernoulli-product": "#0072b2", "bernoulli-union": "#d55e00", "ekf": "#555555"}
"""One colour per system in every figure."""
_LINE, _BAR, _FIT = "#000000", "#6f8fb0", "#d55e00"


@dataclass(frozen=True)
class Curve:
    """Means over a sweep with standard errors: all (K,)."""

    system: str
    values: FloatArray
    mean: FloatArray
    error: FloatArray


@mpl.rc_context(STYLE)
def histograms(
    directory: Path,
    name: str,
    title: str,
    what: str,
    panels: Sequence[tuple[str, FloatArray]],
    bins: int,
) -> Path:
    """A histogram per panel (label, values (R,)) with a fitted normal curve; its maximum is marked,
    as it is the figure that the paper reports."""
    figure = Figure(figsize=(2.4 * len(panels), 2.6), layout="constrained")
    cells = np.atleast_1d(figure.subplots(1, len(panels)))
    for axes, (label, values) in zip(cells, panels, strict=True):
        known = values[np.isfinite(values)]
        axes.hist(known, bins=bins, color=_BAR)
        mean, std = float(known.mean()), float(known.std(ddof=1)) if len(known) > 1 else 0.0
        if std > 0.0:
            x = np.linspace(mean - 4 * std, mean + 4 * std, 200)
            width = np.ptp(known) / bins
            y = len(known) * width * np.exp(-0.5 * ((x - mean) / std) ** 2)
            axes.plot(x, y / (std * np.sqrt(2 * np.pi)), color=_FIT)
        axes.axvline(mean, color=_LINE, linewidth=0.8, linestyle="--")
        axes.set_title(f"{label}: {mean:.3f}", fontsize=9)
        axes.set_xlabel(what)
        axes.grid(visible=False)
    cells[0].set_ylabel("runs")
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    return save(figure, directory, name)


@mpl.rc_context(STYLE)
def scaling(
    directory: Path,
    name: str,
    title: str,
    what: str,
    readings: Sequence[tuple[str, Sequence[Curve]]],
    *,
    logarithmic: bool,
    lines: Sequence[tuple[float, float]] = (),
) -> Path:
    """Errors over a sweep, a panel per reading of the error (label, curves).

    Args:
        directory, name, title: of the figure.  what: label of the sweep's axis.
        readings: panels.  logarithmic: axes.
        lines: slope and intercept of a straight line through the first curve of each panel.
    """
    figure = Figure(figsize=(4.2 * len(readings), 3.2), layout="constrained")
    cells = np.atleast_1d(figure.subplots(1, len(readings)))
    for number, (axes, (label, curves)) in enumerate(zip(cells, readings, strict=True)):
        for curve in curves:
            axes.errorbar(
                curve.values,
                curve.mean,
                yerr=2 * np.nan_to_num(curve.error),
                marker="o",
                markersize=3.5,
                capsize=2,
                color=COLOURS[curve.system],
                label=curve.system,
            )
        if lines:
            slope, intercept = lines[number]
            x = np.asarray(curves[0].values)
            axes.plot(x, slope * x + intercept, "--", color=_LINE, linewidth=0.8, label="line")
        if logarithmic:
            axes.set_xscale("log")
            axes.set_yscale("log")
        else:
            axes.set_ylim(bottom=0)
        axes.set_xlabel(what)
        axes.set_ylabel(label)
    cells[0].legend()
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    return save(figure, directory, name)


@mpl.rc_context(STYLE)
def runtime(directory: Path, rows: Sequence[dict[str, Any]], period_ms: float) -> Path:
    """Time of a step over the number of particles, ours and numpy's, under the scan period."""
    figure = Figure(figsize=(5.5, 3.6), layout="constrained")
    axes = figure.subplots()
    for key, label, colour in (
        ("median_ms", "can_imm", COLOURS["bernoulli-product"]),
        ("numpy_median_ms", "numpy", COLOURS["ekf"]),
    ):
        known = [(row["particles"], row[key]) for row in rows if key in row]
        axes.plot(*zip(*known, strict=True), "o-", color=colour, markersize=3.5, label=label)
    axes.axhline(period_ms, color=_LINE, linestyle="--", linewidth=0.8, label="scan period")
    axes.axvline(42_000, color=_FIT, linestyle=":", linewidth=0.8, label="paper: real time up to")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("particles")
    axes.set_ylabel("time of a step [ms]")
    axes.set_title("Five sensors, one core")
    axes.legend()
    return save(figure, directory, "bernoulli_runtime")
