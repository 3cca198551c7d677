"""The picture of a recording: where everybody drove, and what it was taken for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from can_imm.events import Event
from can_imm.plots.history import Recorded
from can_imm.plots.style import COLOURS, STYLE, manoeuvre_name
from can_imm.types import FloatArray, Manoeuvre

BREAK_NS = 300_000_000
"""Without a report for longer than this [ns] an object's line is broken."""

SHORTEST_NS = 1_000_000_000
"""A track that was seen for less than this [ns] is drawn pale: most of them are noise."""

MOST_NAMED = 40
"""More lane changes than this are marked, but no longer named."""

_PALE = (Manoeuvre.STATIONARY, Manoeuvre.ONCOMING, Manoeuvre.UNKNOWN)
# a yellow line on white cannot be seen
_LINE_COLOURS = {**COLOURS, Manoeuvre.APPROACHING: "#b3a100"}
_ARROW = {1: "↑", -1: "↓", 0: ""}
_EGO: dict[str, Any] = {"color": "black", "linewidth": 0.9, "dashes": (1, 1.5)}
_HALO = [withStroke(linewidth=2.5, foreground="white")]


def lane_lines(
    rows: npt.NDArray[Any], width: float, origin: float | None = None
) -> dict[float, float]:
    """Lateral positions [m] of the lines between the lanes, from the lanes that were said.

    Args:
        rows: of `can_imm.plots.history.HISTORY_DTYPE`.
        width: of a lane [m].
        origin: middle of lane 0 [m], if it is known.

    Returns:
        Position by number, ascending: 0.5 is the line between the lanes 0 and 1.  There are lines
        around all lanes that hold at least 1 % of the rows.
    """
    lanes, n = np.unique(rows["lane"], return_counts=True)
    lanes = lanes[n >= 0.01 * len(rows)]
    if not len(lanes):
        return {}
    at = {int(k): rows["y"][rows["lane"] == k] for k in lanes}
    if origin is None:
        # The line between two neighbours: where as much of the one lies beyond as of the other.
        origins = [
            0.5 * float(np.quantile(y, 0.995) + np.quantile(at[k + 1], 0.005)) - width * (k + 0.5)
            for k, y in at.items()
            if k + 1 in at
        ]
        if not origins:
            origins = [float(np.median(y)) - width * k for k, y in at.items()]
        origin = float(np.median(origins))
    numbers = [float(k) - 0.5 for k in range(int(lanes[0]), int(lanes[-1]) + 2)]
    return {k: origin + width * k for k in numbers}


@mpl.rc_context(STYLE)
def draw_recording(
    path: Path, title: str, recorded: Recorded, events: Sequence[Event], lane_width: float
) -> Path:
    """Draw lateral position and gap over time, coloured by manoeuvre, lane changes marked.

    Below them stands the ego's speed if it is known.  Stationary and oncoming objects are pale,
    duplicate tracks thin.

    Args:
        path: the file; its ending chooses the format.
        title: of the figure.
        recorded: with at least one row.
        events: of the same recording.
        lane_width: [m], for a recording without a road.
    """
    rows = recorded.rows
    start_ns = int(rows["t_ns"].min())
    t_s = (rows["t_ns"] - start_ns) / 1e9
    length_s = max(float(t_s.max()), 1.0)
    speed = rows["ego_speed"]
    with_speed = bool(np.isfinite(speed).any())
    heights = [3.2, 2.0, 0.8] if with_speed else [3.2, 2.0]
    size = (min(max(11.0, length_s / 8), 40.0), 7.6 if with_speed else 6.8)
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    traffic = _traffic(rows)
    drivers = rows[traffic] if traffic.any() else rows
    if recorded.on_road:
        drivers = drivers.copy()
        lane_width = recorded.width
        drivers["lane"] = np.clip(np.round(drivers["y"] / lane_width), -99, 99)
        origin: float | None = 0.0
    else:
        origin = None
    lines = lane_lines(drivers, lane_width, origin)

    _draw_tracks(panels[0], rows, t_s, "y")
    panels[0].set_ylim(_lateral_limits(rows["y"][traffic], list(lines.values()), lane_width))
    _draw_lanes(panels[0], lines, lane_width)
    panels[0].set_ylabel("across the road [m]" if recorded.on_road else "lateral position [m]")
    if recorded.on_road:
        ego_s = (recorded.ego_t_ns - start_ns) / 1e9
        panels[0].plot(ego_s, recorded.ego_y, zorder=6, **_EGO)
    panels[0].set_title(title)
    _mark_changes(panels[0], rows, t_s, start_ns, events)

    _draw_tracks(panels[1], rows, t_s, "x")
    farthest = np.quantile(rows["x"][traffic] if traffic.any() else rows["x"], 0.995)
    panels[1].set_ylim(min(0.0, float(rows["x"].min())), 1.05 * float(farthest) + 1.0)
    panels[1].set_ylabel("gap [m]")
    if with_speed:
        known = np.isfinite(speed)
        panels[2].plot(t_s[known], speed[known], color="#303030", linewidth=1.0)
        panels[2].set_ylim(bottom=min(0.0, float(speed[known].min())))
        panels[2].set_ylabel("own speed\n[m/s]")
    panels[-1].set_xlabel(f"time [s] since {start_ns / 1e9:.3f} s of the bus clock")
    panels[-1].set_xlim(0, length_s)
    figure.align_ylabels()
    _legend(figure, rows, recorded.on_road)
    figure.savefig(path)
    return path


def _traffic(rows: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """Which rows are of vehicles in our direction."""
    pale = np.isin(rows["manoeuvre"], np.array(_PALE, np.int8))
    return np.asarray(~pale & ~rows["duplicate"], np.bool_)


def _draw_lanes(axes: Any, lines: dict[float, float], width: float) -> None:
    """Dashed lines between the lanes, and the lanes' numbers at the right edge."""
    axes.grid(visible=False, axis="y")
    for y in lines.values():
        axes.axhline(y, color="#8a8a8a", linewidth=0.7, dashes=(8, 6), zorder=1)
    for number, y in list(lines.items())[:-1]:
        axes.text(
            1.004,
            y + 0.5 * width,
            f"lane {number + 0.5:.0f}",
            transform=axes.get_yaxis_transform(),
            fontsize=8,
            color="#606060",
            va="center",
        )


def _lateral_limits(y: FloatArray, lines: list[float], width: float) -> tuple[float, float]:
    """Room for the lanes and for most of the traffic, but not for what lies far off the road."""
    ends = [*lines, *(np.quantile(y, [0.005, 0.995]) if len(y) else (-width, width))]
    return min(ends) - 0.5 * width, max(ends) + 0.5 * width


def _pieces(rows: npt.NDArray[Any]) -> list[npt.NDArray[np.intp]]:
    """Indices of the rows of each track, in order of time; an id that is reused makes two."""
    pieces = []
    for object_id in np.unique(rows["object_id"]):
        mine = np.flatnonzero(rows["object_id"] == object_id)
        gap = np.diff(rows["t_ns"][mine]) > BREAK_NS
        again = np.diff(rows["age"][mine]) < ~rows["coasting"][mine[1:]]
        pieces += np.split(mine, 1 + np.flatnonzero(gap | again))
    return pieces


def _draw_tracks(axes: Any, rows: npt.NDArray[Any], t_s: FloatArray, column: str) -> None:
    """One line per track, piecewise in the colours of its manoeuvres; the traffic on top."""
    layers: dict[int, tuple[list[Any], list[Any], list[float]]] = {}
    for mine in _pieces(rows):
        points = np.column_stack((t_s[mine], rows[column][mine]))
        short = rows["t_ns"][mine[-1]] - rows["t_ns"][mine[0]] < SHORTEST_NS
        labels, doubles = rows["manoeuvre"][mine], rows["duplicate"][mine]
        cuts = 1 + np.flatnonzero((np.diff(labels) != 0) | (np.diff(doubles) != 0))
        for a, b in zip([0, *cuts], [*cuts, len(mine)], strict=True):
            manoeuvre = Manoeuvre(labels[a])
            if manoeuvre in _PALE:
                order, width, alpha = 2, 0.8, 0.55
            elif short or doubles[a]:
                order, width, alpha = 3, 0.5, 0.5
            elif manoeuvre is Manoeuvre.LANE_CHANGE:
                order, width, alpha = 5, 2.6, 1.0
            else:
                order, width, alpha = 4, 1.6, 1.0
            segments, colours, widths = layers.setdefault(order, ([], [], []))
            segments.append(points[a : b + 1])
            colours.append(to_rgba(_LINE_COLOURS[manoeuvre], alpha))
            widths.append(width)
    for order, (segments, colours, widths) in layers.items():
        axes.add_collection(
            LineCollection(
                segments, colors=colours, linewidths=widths, capstyle="round", zorder=order
            )
        )


def _mark_changes(
    axes: Any,
    rows: npt.NDArray[Any],
    t_s: FloatArray,
    start_ns: int,
    events: Sequence[Event],
) -> None:
    """An arrow at the middle of each lane change, with the object's number beside it."""
    changes = [event for event in events if event.manoeuvre is Manoeuvre.LANE_CHANGE]
    low, high = axes.get_ylim()
    taken: list[tuple[float, float]] = []
    apart_s, apart_m = 0.018 * float(t_s.max()), 0.045 * (high - low)
    for event in changes:
        mine = np.flatnonzero(rows["object_id"] == event.object_id)
        at = mine[np.argmin(np.abs(rows["t_ns"][mine] - event.middle_ns))]
        t, y = (event.middle_ns - start_ns) / 1e9, float(rows["y"][at])
        if not low < y < high:
            continue
        axes.plot(
            t,
            y,
            marker="^" if event.direction > 0 else "v",
            color="black",
            markersize=5,
            markeredgecolor="white",
            markeredgewidth=0.6,
            zorder=7,
        )
        if len(changes) > MOST_NAMED:
            continue
        # beside the arrow, if there is room on the free side of the line
        side = 1 if t < 0.93 * float(t_s.max()) else -1
        free = -0.6 * apart_m * side * (1 if event.direction > 0 else -1)
        places = [free * k for k in (1, -1, 2, -2, 3, -3)]
        off = next((o for o in places if not _in_the_way(taken, t, y + o, apart_s, apart_m)), free)
        taken.append((t, y + off))
        text = f"{event.object_id}{_ARROW[event.direction]}"
        if event.event:
            text += f" {event.event.replace('_', '-').lower()}"
        axes.text(
            t + 0.4 * apart_s * side,
            y + off,
            text,
            ha="left" if side > 0 else "right",
            fontsize=8,
            va="center",
            zorder=8,
            path_effects=_HALO,
            clip_on=True,
        )


def _in_the_way(
    taken: list[tuple[float, float]], t: float, y: float, apart_s: float, apart_m: float
) -> bool:
    return any(abs(t - a) < 3.5 * apart_s and abs(y - b) < apart_m for a, b in taken)


def _legend(figure: Figure, rows: npt.NDArray[Any], on_road: bool) -> None:
    """The manoeuvres in the picture, with their share of the objects' time."""
    counted = rows[~rows["duplicate"]]
    present, n = np.unique(counted["manoeuvre"], return_counts=True)
    share = {Manoeuvre(m): 100 * k / len(counted) for m, k in zip(present, n, strict=True)}
    handles = []
    for m in sorted(share, key=lambda m: (m in _PALE, -share[m])):
        pale = m in _PALE
        name = f"{manoeuvre_name(m)} {share[m]:.0f} %" if m else "not yet known"
        handles.append(
            Line2D(
                [], [], color=_LINE_COLOURS[m], label=name,
                linewidth=1.2 if pale else 2.6, alpha=0.7 if pale else 1.0,
            )
        )  # fmt: skip
    if rows["duplicate"].any():
        handles.append(Line2D([], [], color="#606060", linewidth=0.5, label="duplicate track"))
    handles.append(
        Line2D([], [], color="black", marker="^", linestyle="", markersize=5, label="lane change")
    )
    if on_road:
        handles.append(Line2D([], [], label="own vehicle", **_EGO))
    figure.legend(handles=handles, loc="outside lower center", ncols=min(len(handles), 6))
