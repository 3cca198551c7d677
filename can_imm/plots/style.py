"""What all figures have in common: their style and colours, and how they are written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from can_imm.types import Manoeuvre

STYLE: Any = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "figure.dpi": 150,
    "font.size": 9,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
}
"""For ``matplotlib.rc_context``."""

COLOURS = {
    Manoeuvre.UNKNOWN: "#c8c8c8",
    Manoeuvre.KEEP_RIGHT: "#0072b2",
    Manoeuvre.LANE_CHANGE: "#e69f00",
    Manoeuvre.KEEP_LEFT: "#56b4e9",
    Manoeuvre.OVERTAKING: "#009e73",
    Manoeuvre.RECEDING: "#cc79a7",
    Manoeuvre.APPROACHING: "#f0e442",
    Manoeuvre.REAR_END: "#d55e00",
    Manoeuvre.KEEP_LANE: "#6a8fb5",
    Manoeuvre.STATIONARY: "#b8b0a4",
    Manoeuvre.ONCOMING: "#7a5195",
}
"""One colour per manoeuvre in every figure (Okabe and Ito, told apart by the colour-blind)."""

BAR = "#6f8fb0"


def manoeuvre_name(manoeuvre: int) -> str:
    """The manoeuvre's name as words in lower case."""
    return Manoeuvre(manoeuvre).name.replace("_", " ").lower()


def save(figure: Figure, directory: Path, name: str) -> Path:
    """Write the figure as a PNG file into the directory, which is made if need be."""
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"{name}.png"
    figure.savefig(path)
    return path
