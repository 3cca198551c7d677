"""Figures of the roadside study, as PNG files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Wedge

from can_imm.plots.style import STYLE, save
from can_imm.types import BoolArray, FloatArray, X, Y

COLOURS = {"cv-strawman": "#d55e00", "cv-tuned": "#e69f00", "imm-ukf": "#0072b2"}
"""One colour per system in every figure; others are grey."""
_TRUE, _BEND, _SEEN = "#000000", "#dddddd", "#9a9a9a"
_LIDARS = "#009e73"


@dataclass(frozen=True)
class LidarView:
    """Where a lidar stands [m], where it looks [rad], its whole angle [rad] and range [m]."""

    x: float
    y: float
    heading: float
    field_of_view: float
    range: float


def _colour(system: str) -> str:
    return COLOURS.get(system, "#7f7f7f")


def _shade(axes: Any, t_s: FloatArray, bend: BoolArray) -> None:
    edges = np.flatnonzero(np.diff(np.concatenate(([False], bend, [False])).astype(int)))
    last = len(t_s) - 1
    for start, end in edges.reshape(-1, 2):
        axes.axvspan(t_s[start], t_s[min(end, last)], color=_BEND, linewidth=0, zorder=0)


@mpl.rc_context(STYLE)
def trajectory(
    directory: Path,
    lidars: Sequence[LidarView],
    truth: FloatArray,
    detections: FloatArray,
    systems: dict[str, FloatArray],
) -> Path:
    """The scene from above: what is true, detected and estimated in one run.

    Args:
        directory: where the file goes.
        lidars: with their fields of view.
        truth: (N, 4) true states.
        detections: (K, 2) x and y.
        systems: estimated states (N, 4) by name.
    """
    figure = Figure(figsize=(8, 7), layout="constrained")
    axes = figure.subplots()
    for lidar in lidars:
        middle, half = np.degrees(lidar.heading), np.degrees(lidar.field_of_view) / 2
        axes.add_patch(
            Wedge(
                (lidar.x, lidar.y),
                lidar.range,
                middle - half,
                middle + half,
                color=_LIDARS,
                alpha=0.07,
                linewidth=0,
            )
        )
    places = np.array([(lidar.x, lidar.y) for lidar in lidars])
    axes.plot(*places.T, "^", color=_LIDARS, markersize=8, label="lidar, field of view")
    axes.plot(*detections.T, ".", color=_SEEN, markersize=2.5, label="detections")
    for name, x in systems.items():
        axes.plot(x[:, X], x[:, Y], color=_colour(name), label=name)
    axes.plot(truth[:, X], truth[:, Y], "--", color=_TRUE, linewidth=1, label="true")
    low = np.minimum(truth[:, [X, Y]].min(axis=0), places.min(axis=0)) - 8
    high = np.maximum(truth[:, [X, Y]].max(axis=0), places.max(axis=0)) + 8
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_xlabel("$x$ [m]")
    axes.set_ylabel("$y$ [m]")
    axes.set_title("One run from above")
    axes.legend(loc="upper left", frameon=True, framealpha=0.9, markerscale=1.5)
    return save(figure, directory, "roadside_trajectory")


@mpl.rc_context(STYLE)
def errors(
    directory: Path,
    title: str,
    t_s: FloatArray,
    bend: BoolArray,
    seen_by: FloatArray,
    systems: dict[str, tuple[FloatArray, ...]],
) -> Path:
    """RMS errors over time, logarithmic, above the number of lidars that see the vehicle.

    Args:
        directory: where the file goes.
        title: of the figure.
        t_s: (N,) times [s].
        bend: (N,) the vehicle turns.
        seen_by: (N,) number of lidars.
        systems: by name three (N,): position [m], |v| and velocity [m/s].
    """
    figure = Figure(figsize=(8, 6.5), layout="constrained")
    rows = figure.subplots(4, 1, sharex=True, height_ratios=(3, 3, 3, 1))
    labels = ("position [m]", "$|v|$ [m/s]", "velocity vector [m/s]")
    for i, (axes, label) in enumerate(zip(rows, labels, strict=False)):
        _shade(axes, t_s, bend)
        for name, values in systems.items():
            axes.semilogy(t_s, values[i], color=_colour(name), label=name)
        axes.set_ylabel(label)
    _shade(rows[3], t_s, bend)
    rows[3].fill_between(t_s, seen_by, step="mid", color=_LIDARS, alpha=0.6, linewidth=0)
    rows[3].set_yticks(range(int(seen_by.max()) + 1))
    rows[3].set_ylabel("lidars")
    rows[3].set_xlabel("time [s]")
    rows[3].set_xlim(t_s[0], t_s[-1])
    rows[0].set_title(title)
    figure.align_ylabels()
    handles, names = rows[0].get_legend_handles_labels()
    figure.legend(
        [*handles, Patch(color=_BEND)],
        [*names, "bend"],
        loc="outside lower center",
        ncols=len(names) + 1,
    )
    return save(figure, directory, "roadside_errors")


@mpl.rc_context(STYLE)
def turn_probability(
    directory: Path,
    title: str,
    t_s: FloatArray,
    bend: BoolArray,
    p_turn: FloatArray,
    threshold: float,
) -> Path:
    """Probability of constant turn (R, N) over time: mean, the middle 80 % of runs, one run."""
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    axes = figure.subplots()
    _shade(axes, t_s, bend)
    colour = _colour("imm-ukf")
    low, high = np.quantile(p_turn, (0.1, 0.9), axis=0)
    axes.fill_between(
        t_s, low, high, color=colour, alpha=0.25, linewidth=0, label="80 % of the runs"
    )
    axes.plot(t_s, p_turn.mean(axis=0), color=colour, linewidth=1.6, label="mean")
    axes.plot(t_s, p_turn[0], color=_TRUE, linewidth=0.7, label="first run")
    axes.axhline(threshold, color="#606060", linewidth=0.8, linestyle=":", label="detection")
    axes.set_ylim(0, 1.02)
    axes.set_xlim(t_s[0], t_s[-1])
    axes.set_xlabel("time [s]")
    axes.set_ylabel("P(constant turn)")
    axes.set_title(title)
    handles, names = axes.get_legend_handles_labels()
    figure.legend(
        [*handles, Patch(color=_BEND)], [*names, "bend"], loc="outside lower center", ncols=5
    )
    return save(figure, directory, "roadside_turn_probability")


@mpl.rc_context(STYLE)
def reductions(
    directory: Path, title: str, rows: Sequence[tuple[str, Sequence[float], Sequence[float]]]
) -> Path:
    """How much smaller an RMSE is, as bars with two standard errors.

    Args:
        directory: where the file goes.
        title: of the figure.
        rows: name, reductions and standard errors of position, |v|, velocity; NaN: none exists.
    """
    figure = Figure(figsize=(8, 3.0), layout="constrained")
    cells = figure.subplots(1, 3, sharey=True)
    at = np.arange(len(rows))
    for i, (axes, what) in enumerate(
        zip(cells, ("position", "$|v|$", "velocity vector"), strict=True)
    ):
        value = 100 * np.array([row[1][i] for row in rows])
        error = 200 * np.nan_to_num([row[2][i] for row in rows])
        known = np.isfinite(value)
        axes.barh(at[known], value[known], xerr=error[known], color="#6f8fb0", height=0.6)
        for k in at[known]:
            axes.annotate(f" {value[k]:.1f} %", (value[k] + error[k], k), va="center", fontsize=8)
        axes.set_title(what)
        axes.set_xlim(0, 130)
        axes.set_xticks([0, 50, 100])
        axes.grid(visible=False, axis="y")
    cells[0].set_yticks(at, [row[0] for row in rows])
    cells[0].set_ylim(len(rows) - 0.4, -0.6)
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    return save(figure, directory, "roadside_reductions")
