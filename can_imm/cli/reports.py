"""What ``detect`` and ``replay`` keep of the detector's reports: CSV rows and lane changes."""

from __future__ import annotations

import csv
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from can_imm.runtime.nodes import Reports
from can_imm.types import Manoeuvre

MODES = [Manoeuvre(value) for value in range(1, 8)]
STATES = ["x", "vx", "y", "vy"]
COLUMNS = [
    "time_s",
    "object_id",
    "manoeuvre",
    "probability",
    "lane",
    "direction",
    *STATES,
    *(f"p_{mode.name.lower()}" for mode in MODES),
]

_LANE_CHANGE = int(Manoeuvre.LANE_CHANGE)

DIRECTION = {-1: "right", 0: "", 1: "left"}


def seconds(t_ns: int) -> str:
    """``t_ns`` as seconds with microseconds, without the rounding of a float."""
    sign = "-" if t_ns < 0 else ""
    whole, rest = divmod(abs(t_ns) // 1000, 1_000_000)
    return f"{sign}{whole}.{rest:06d}"


class ReportCsv:
    """Writes one row per object and scan to a file, or to standard output if ``path`` is ``-``."""

    def __init__(self, path: str) -> None:
        self._stack = ExitStack()
        file: TextIO = sys.stdout
        if path != "-":
            file = self._stack.enter_context(Path(path).open("w", newline=""))  # noqa: SIM115
        self._writer = csv.writer(file, lineterminator="\n")
        self._writer.writerow(COLUMNS)

    def __call__(self, t_ns: int, reports: Reports) -> None:
        for report in reports:
            x = report["x"]
            self._writer.writerow(
                [
                    seconds(int(report["t_ns"])),
                    report["object_id"],
                    Manoeuvre(report["manoeuvre"]).name,
                    f"{report['probability']:.4f}",
                    report["lane"],
                    DIRECTION[int(report["direction"])],
                    *(f"{value:.4f}" for value in x),
                    *(f"{report['p'][mode]:.4f}" for mode in MODES),
                ]
            )

    def close(self) -> None:
        self._stack.close()


@dataclass
class LaneChange:
    """A lane change of one object; times are those of the first and last scan that say so [ns]."""

    object_id: int
    first_ns: int
    last_ns: int
    direction: int


class LaneChanges:
    """Collects the lane changes out of the reports.

    LANE_CHANGE of one object and direction is one lane change also when it is interrupted for up to
    `GAP_NS`.
    """

    GAP_NS = 1_000_000_000

    def __init__(self) -> None:
        self.found: list[LaneChange] = []
        self._latest: dict[tuple[int, int], LaneChange] = {}

    def __call__(self, t_ns: int, reports: Reports) -> None:
        for report in reports[reports["manoeuvre"] == _LANE_CHANGE]:
            at_ns = int(report["t_ns"])
            key = int(report["object_id"]), int(report["direction"])
            change = self._latest.get(key)
            if change is None or at_ns - change.last_ns > self.GAP_NS:
                change = LaneChange(key[0], at_ns, at_ns, key[1])
                self._latest[key] = change
                self.found.append(change)
            change.last_ns = at_ns
