"""The time line of the demonstration: what was true above what was said."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
from rich.text import Text

from can_imm.types import Manoeuvre

if TYPE_CHECKING:
    from can_imm.cli.demo_run import Track
    from can_imm.studies.metrics import Int8Array

COLOURS = {
    Manoeuvre.UNKNOWN: "#a0a0a0",
    Manoeuvre.KEEP_RIGHT: "#5aa5e0",
    Manoeuvre.LANE_CHANGE: "#e69f00",
    Manoeuvre.KEEP_LEFT: "#8fd0f0",
    Manoeuvre.OVERTAKING: "#2fb98e",
    Manoeuvre.RECEDING: "#d99ac0",
    Manoeuvre.APPROACHING: "#e8dc50",
    Manoeuvre.REAR_END: "#f0703c",
    # never true on the road of two lanes, but a motorway's preset may say so
    Manoeuvre.KEEP_LANE: "#8fb2d8",
    Manoeuvre.STATIONARY: "#cfc7bb",
    Manoeuvre.ONCOMING: "#b48fd0",
}
"""The hues of the figures, light enough for black text."""

SHORT = {
    Manoeuvre.KEEP_RIGHT: "KR",
    Manoeuvre.LANE_CHANGE: "LC",
    Manoeuvre.KEEP_LEFT: "KL",
    Manoeuvre.OVERTAKING: "OV",
    Manoeuvre.RECEDING: "RE",
    Manoeuvre.APPROACHING: "AP",
    Manoeuvre.REAR_END: "REAR",
    Manoeuvre.KEEP_LANE: "KEEP",
    Manoeuvre.STATIONARY: "ST",
    Manoeuvre.ONCOMING: "ON",
}
RIGHT, WRONG = "bold green", "bold red"
_NAME = 6
_NONE = -1


def bands(track: Track, at_ns: int, duration_ns: int, width: int) -> list[Text]:
    """Four lines of ``width`` cells: true, said, where they differ, and a scale in seconds.

    What is still to come at scenario time ``at_ns`` [ns] is shown dimly, and of the truth only.
    """
    n = width - _NAME - 1
    edges = np.linspace(0, duration_ns, n + 1)
    first, end = (np.searchsorted(track.t_ns, edge, "left") for edge in (edges[:-1], edges[1:]))
    end[-1] = len(track.t_ns)
    known = track.rows(at_ns)
    middle = np.minimum((first + end) // 2, len(track.t_ns) - 1)
    there = end > first
    true = np.where(there, track.label[middle], _NONE)
    said = np.where(there & (middle < known), track.manoeuvre[middle], _NONE)
    wrong = track.label != track.manoeuvre
    wrong[known:] = False
    differs = [bool(wrong[a:b].any()) for a, b in zip(first, end, strict=True)]

    marks = Text("".ljust(_NAME))
    for c in range(n):
        marks.append("▀" if differs[c] else " ", WRONG)
    return [
        Text("true".ljust(_NAME)) + _band(true, middle < known),
        Text("said".ljust(_NAME)) + _band(said, middle < known),
        marks,
        _scale(n, duration_ns * 1e-9),
    ]


def _band(labels: Int8Array, past: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Text:
    band = Text()
    start = 0
    for label, run in groupby(labels.tolist()):
        size = len(list(run))
        if label == _NONE:
            band.append(" " * size)
        else:
            manoeuvre = Manoeuvre(label)
            colour = COLOURS[manoeuvre]
            for k, letter in enumerate(_fit(manoeuvre, size)):
                done = past[start + k]
                band.append(letter, f"black on {colour}" if done else f"{colour} dim")
        start += size
    return band


def _fit(manoeuvre: Manoeuvre, size: int) -> str:
    """The manoeuvre's name, a short form or nothing in the middle of ``size`` cells."""
    short = SHORT.get(manoeuvre, "")
    text = manoeuvre.name if len(manoeuvre.name) < size else short if len(short) <= size else ""
    return text.center(size)


def _scale(n: int, duration_s: float) -> Text:
    step = next(s for s in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000) if duration_s / s <= n / 8)
    line = [" "] * (_NAME + n + 1)
    for second in range(0, int(duration_s) + 1, step):
        at = _NAME + round(second / duration_s * n)
        text = f"{second}s" if second == 0 else str(second)
        if at + len(text) <= len(line):
            line[at : at + len(text)] = text
    return Text("".join(line), "dim")
