"""Figures 3 to 8 of the paper and the study's comparisons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from can_imm.plots.style import BAR, COLOURS, STYLE, manoeuvre_name, save
from can_imm.types import VX, FloatArray, Manoeuvre, X

Int8Array = npt.NDArray[np.int8]

MANOEUVRES = tuple(Manoeuvre(value) for value in range(1, 8))
STATES = (("x", "m"), ("vx", "m/s"), ("y", "m"), ("vy", "m/s"))
_TRUE, _FILTERED, _MEASURED = "#000000", "#0072b2", "#9a9a9a"


def _axis_label(name: str, unit: str) -> str:
    pretty = {"x": "$x$", "vx": "$v_x$", "y": "$y$", "vy": "$v_y$"}
    return f"{pretty[name]} [{unit}]"


def _spans(t_s: FloatArray, labels: Int8Array) -> list[tuple[float, float, int]]:
    """(from, to, label) of every stretch of one label; the last one ends with the last frame."""
    at = np.concatenate(([0], 1 + np.flatnonzero(np.diff(labels)), [len(labels) - 1]))
    return [(float(t_s[a]), float(t_s[b]), int(labels[a])) for a, b in pairwise(at)]


def _shade(axes: Any, t_s: FloatArray, labels: Int8Array) -> None:
    for start, end, label in _spans(t_s, labels):
        axes.axvspan(start, end, color=COLOURS[Manoeuvre(label)], alpha=0.18, linewidth=0)


def _manoeuvre_legend(figure: Figure, labels: Int8Array, alpha: float = 1.0) -> None:
    shown = [Manoeuvre(v) for v in np.unique(labels)]
    figure.legend(
        handles=[
            Patch(color=COLOURS[m], alpha=alpha, linewidth=0, label=manoeuvre_name(m))
            for m in shown
        ],
        loc="outside lower center",
        ncols=len(shown),
        fontsize=8,
        handlelength=1.2,
        columnspacing=1.2,
    )


@mpl.rc_context(STYLE)
def controls(
    directory: Path,
    t_s: FloatArray,
    labels: Int8Array,
    speed: FloatArray,
    steer: FloatArray,
    heading: FloatArray,
) -> Path:
    """Fig. 3: the vehicle's speed [m/s], steering angle and heading [rad] over time, all (N,)."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    rows = figure.subplots(3, 1, sharex=True)
    for axes, values, what in (
        (rows[0], speed, "speed [m/s]"),
        (rows[1], np.degrees(steer), "steering angle [°]"),
        (rows[2], np.degrees(heading), "heading [°]"),
    ):
        _shade(axes, t_s, labels)
        axes.plot(t_s, values, color=_TRUE)
        axes.set_ylabel(what)
    rows[0].set_title("Controls of the observed vehicle; background: true manoeuvre")
    rows[-1].set_xlabel("time [s]")
    rows[-1].set_xlim(t_s[0], t_s[-1])
    figure.align_ylabels()
    _manoeuvre_legend(figure, labels, alpha=0.35)
    return save(figure, directory, "fig3_controls")


@mpl.rc_context(STYLE)
def overtaking_profile(
    directory: Path, labels: Int8Array, state: FloatArray, corners: FloatArray
) -> Path:
    """Fig. 4: relative speed over gap while overtaking, and the trapezoid f(x) beside it.

    Args:
        directory: where the file goes.
        labels: (N,) true manoeuvres.
        state: (N, 4) true states.
        corners: (K, 2) corners (gap [m], relative speed [m/s]) of the trapezoid.
    """
    figure = Figure(figsize=(5.5, 3.6), layout="constrained")
    axes = figure.subplots()
    during = labels == Manoeuvre.OVERTAKING
    axes.plot(
        state[during, X],
        state[during, VX],
        color=COLOURS[Manoeuvre.OVERTAKING],
        linewidth=2,
        label="true, while overtaking",
    )
    axes.plot(
        corners[:, 0],
        corners[:, 1],
        "--o",
        color=_TRUE,
        markersize=4,
        label="$f(x)$",
        clip_on=False,
    )
    axes.set_title("Overtaking profile")
    axes.set_xlabel("gap $x$ [m]")
    axes.set_ylabel("relative speed $v_x$ [m/s]")
    axes.set_ylim(bottom=0)
    axes.legend(loc="lower center")
    return save(figure, directory, "fig4_overtaking_profile")


@mpl.rc_context(STYLE)
def mode_probabilities(directory: Path, t_s: FloatArray, labels: Int8Array, p: FloatArray) -> Path:
    """Fig. 5: probability of every manoeuvre over time; ``p`` (N, 8) by `Manoeuvre` value."""
    figure = Figure(figsize=(8, 6), layout="constrained")
    rows = figure.subplots(len(MANOEUVRES), 1, sharex=True)
    for axes, manoeuvre in zip(rows, MANOEUVRES, strict=True):
        for start, end, label in _spans(t_s, labels):
            if label == manoeuvre:
                axes.axvspan(start, end, color="#e0e0e0", linewidth=0)
        axes.fill_between(t_s, p[:, manoeuvre], color=COLOURS[manoeuvre], linewidth=0, alpha=0.75)
        axes.plot(t_s, p[:, manoeuvre], color="#404040", linewidth=0.6)
        axes.set_ylim(0, 1.05)
        axes.set_yticks([0, 1])
        axes.grid(visible=False)
        axes.set_ylabel(manoeuvre_name(manoeuvre), rotation=0, ha="right", va="center")
    rows[0].set_title("Probability of each manoeuvre; grey: when it is true")
    rows[-1].set_xlabel("time [s]")
    rows[-1].set_xlim(t_s[0], t_s[-1])
    return save(figure, directory, "fig5_mode_probabilities")


@mpl.rc_context(STYLE)
def manoeuvre_bands(directory: Path, t_s: FloatArray, labels: Int8Array, said: Int8Array) -> Path:
    """Fig. 6: true and detected manoeuvres over time as bands of colour, both (N,)."""
    figure = Figure(figsize=(8, 2.4), layout="constrained")
    axes = figure.subplots()
    wrong = np.where(said == labels, 0, 1).astype(np.int8)
    for row, values in ((2, labels), (1, said)):
        for start, end, label in _spans(t_s, values):
            axes.broken_barh(
                [(start, end - start)],
                (row - 0.4, 0.8),
                color=COLOURS[Manoeuvre(label)],
                linewidth=0,
            )
    for start, end, differs in _spans(t_s, wrong):
        if differs:
            axes.broken_barh([(start, end - start)], (0.25, 0.25), color=_TRUE, linewidth=0)
    axes.set_yticks([2, 1, 0.375], ["true", "detected", "differs"])
    axes.grid(visible=False)
    axes.set_xlabel("time [s]")
    axes.set_xlim(t_s[0], t_s[-1])
    axes.set_title("Manoeuvres")
    _manoeuvre_legend(figure, np.concatenate((labels, said)))
    return save(figure, directory, "fig6_manoeuvres")


@mpl.rc_context(STYLE)
def states(
    directory: Path, t_s: FloatArray, state: FloatArray, z: FloatArray, x: FloatArray
) -> Path:
    """Fig. 7: true, measured and filtered states over time, each (N, 4)."""
    figure = Figure(figsize=(8, 7), layout="constrained")
    rows = figure.subplots(4, 1, sharex=True)
    for i, (axes, (name, unit)) in enumerate(zip(rows, STATES, strict=True)):
        axes.plot(t_s, z[:, i], ".", color=_MEASURED, markersize=2.5, label="measured")
        axes.plot(t_s, x[:, i], color=_FILTERED, label="filtered")
        axes.plot(t_s, state[:, i], "--", color=_TRUE, linewidth=1, label="true")
        axes.set_ylabel(_axis_label(name, unit))
    rows[0].set_title("State relative to the observer")
    rows[-1].set_xlabel("time [s]")
    rows[-1].set_xlim(t_s[0], t_s[-1])
    figure.align_ylabels()
    handles, names = rows[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, markerscale=3)
    return save(figure, directory, "fig7_states")


@mpl.rc_context(STYLE)
def errors(
    directory: Path, t_s: FloatArray, state: FloatArray, x: FloatArray, cov: FloatArray
) -> Path:
    """Fig. 8: errors of the filtered states (N, 4) in ±2σ of their covariance (N, 4, 4)."""
    figure = Figure(figsize=(8, 7), layout="constrained")
    rows = figure.subplots(4, 1, sharex=True)
    error = x - state
    for i, (axes, (name, unit)) in enumerate(zip(rows, STATES, strict=True)):
        two_sigma = 2 * np.sqrt(cov[:, i, i])
        axes.fill_between(
            t_s, -two_sigma, two_sigma, color=_FILTERED, alpha=0.2, linewidth=0, label="±2σ"
        )
        axes.plot(t_s, error[:, i], color=_FILTERED, linewidth=0.9, label="error")
        axes.set_ylabel(_axis_label(name, unit))
        rmse = np.sqrt(np.nanmean(error[:, i] ** 2))
        axes.set_title(f"RMSE {rmse:.3f} {unit}", loc="right", fontsize=8)
    rows[0].set_title("Errors of the filtered state")
    rows[-1].set_xlabel("time [s]")
    rows[-1].set_xlim(t_s[0], t_s[-1])
    figure.align_ylabels()
    handles, names = rows[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=2)
    return save(figure, directory, "fig8_errors")


@dataclass(frozen=True)
class Run:
    """One object's run: the true one every 10 ms (length M), and what was said per scan (N)."""

    truth_t_s: FloatArray
    truth_label: Int8Array
    truth_state: FloatArray
    speed: FloatArray
    steer: FloatArray
    heading: FloatArray
    t_s: FloatArray
    label: Int8Array
    state: FloatArray
    z: FloatArray
    said: Int8Array
    p: FloatArray
    x: FloatArray
    cov: FloatArray


def paper_figures(directory: Path, run: Run, corners: FloatArray) -> list[Path]:
    """Draw figures 3 to 8 of one run; ``corners`` as in `overtaking_profile`."""
    return [
        controls(directory, run.truth_t_s, run.truth_label, run.speed, run.steer, run.heading),
        overtaking_profile(directory, run.truth_label, run.truth_state, corners),
        mode_probabilities(directory, run.t_s, run.label, run.p),
        manoeuvre_bands(directory, run.t_s, run.label, run.said),
        states(directory, run.t_s, run.state, run.z, run.x),
        errors(directory, run.t_s, run.state, run.x, run.cov),
    ]


@mpl.rc_context(STYLE)
def confusion(directory: Path, name: str, title: str, counts: npt.NDArray[np.int64]) -> Path:
    """Confusion in percent of each true class; ``counts`` (8, 8), rows true, columns said."""
    rows = [m for m in Manoeuvre if counts[m].any()]
    columns = [m for m in Manoeuvre if counts[:, m].any() or m in rows]
    part = counts[np.ix_(rows, columns)]
    share = 100 * part / part.sum(axis=1, keepdims=True)
    figure = Figure(figsize=(5.6, 4.8), layout="constrained")
    axes = figure.subplots()
    axes.imshow(share, cmap="Blues", vmin=0, vmax=100, aspect="auto")
    for (i, j), value in np.ndenumerate(share):
        if part[i, j]:
            colour = "white" if value > 55 else "black"
            axes.text(j, i, f"{value:.1f}", ha="center", va="center", color=colour, fontsize=8)
    axes.set_xticks(
        range(len(columns)), [manoeuvre_name(m) for m in columns], rotation=35, ha="right"
    )
    axes.set_yticks(range(len(rows)), [manoeuvre_name(m) for m in rows])
    axes.grid(visible=False)
    axes.set_xlabel("detected")
    axes.set_ylabel("true")
    axes.set_title(title)
    return save(figure, directory, name)


@mpl.rc_context(STYLE)
def comparison(
    directory: Path,
    name: str,
    title: str,
    systems: Sequence[str],
    error_rate: FloatArray,
    error_rate_se: FloatArray,
    rmse: FloatArray,
    rmse_se: FloatArray,
) -> Path:
    """Error rate (S,) and RMSE (S, 4) of the systems with two standard errors; NaN: none exists."""
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    cells = figure.subplots(1, 5)
    panels = [("wrong frames [%]", 100 * error_rate, 100 * error_rate_se, 1)] + [
        (f"RMSE {_axis_label(*STATES[i])}", rmse[:, i], rmse_se[:, i], 3) for i in range(4)
    ]
    where = np.arange(len(systems))
    for axes, (what, value, error, digits) in zip(cells, panels, strict=True):
        known = np.isfinite(value)
        axes.barh(
            where[known],
            value[known],
            xerr=2 * np.nan_to_num(error[known]),
            color=BAR,
            error_kw={"elinewidth": 0.8, "capsize": 2},
        )
        axes.set_title(what, fontsize=9)
        axes.set_yticks(where, systems if axes is cells[0] else [""] * len(systems))
        axes.set_ylim(len(systems) - 0.4, -0.6)
        axes.grid(visible=False, axis="y")
        for i in where[known]:
            axes.annotate(
                f" {value[i]:.{digits}f}",
                (value[i] + 2 * np.nan_to_num(error)[i], i),
                va="center",
                fontsize=7,
            )
        axes.margins(x=0.28)
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    return save(figure, directory, name)
