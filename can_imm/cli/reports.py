"""What ``detect`` and ``replay`` write of the detector's reports: rows per scan, and events."""

from __future__ import annotations

import csv
import json
import math
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TextIO

from can_imm.events import Event, EventCollector
from can_imm.runtime.nodes import Reports
from can_imm.types import CUT_IN, CUT_OUT, OVERTAKING_ANOTHER, CanImmError, Manoeuvre

MODES = [Manoeuvre(value) for value in range(1, 8)]
MOTORWAY_MODES = [Manoeuvre.KEEP_LANE, Manoeuvre.STATIONARY, Manoeuvre.ONCOMING]
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
MOTORWAY_COLUMNS = [
    *(f"p_{mode.name.lower()}" for mode in MOTORWAY_MODES),
    "flags",
    "duplicate_of",
]
EVENT_COLUMNS = {
    "log": "",
    "object_id": "",
    "manoeuvre": "",
    "event": "",
    "direction": "",
    "from_s": ".6f",
    "to_s": ".6f",
    "duration_s": ".6f",
    "mean_probability": ".4f",
    "lane_from": "",
    "lane_to": "",
    "gap_m": ".2f",
    "speed_mps": ".2f",
    "min_gap_m": ".2f",
    "abs_speed_mps": ".2f",
}
"""Columns of the events' CSV, and keys in JSON, with their formats."""

DIRECTION = {-1: "right", 0: "", 1: "left"}
FLAGS = {CUT_IN: "CUT_IN", CUT_OUT: "CUT_OUT", OVERTAKING_ANOTHER: "OVERTAKING"}


def seconds(t_ns: int) -> str:
    """``t_ns`` as seconds with microseconds, without the rounding of a float."""
    sign = "-" if t_ns < 0 else ""
    whole, rest = divmod(abs(t_ns) // 1000, 1_000_000)
    return f"{sign}{whole}.{rest:06d}"


def flag_names(flags: int) -> str:
    """The flags of a report as text, empty if none is up."""
    return "|".join(name for bit, name in FLAGS.items() if flags & bit)


class ReportCsv:
    """Writes one row per object and scan to a file, or to standard output if ``path`` is ``-``.

    Args:
        path: the file; what it held is lost.
        motorway: add the columns of banks that know KEEP_LANE.
        with_log: add a last column ``log``, whose value is `log` at the time of writing.
    """

    def __init__(self, path: str, *, motorway: bool = False, with_log: bool = False) -> None:
        self.log = ""
        self._motorway = motorway
        self._with_log = with_log
        self._stack = ExitStack()
        file: TextIO = sys.stdout
        if path != "-":
            file = self._stack.enter_context(Path(path).open("w", newline=""))  # noqa: SIM115
        self._writer = csv.writer(file, lineterminator="\n")
        more = MOTORWAY_COLUMNS if motorway else []
        self._writer.writerow([*COLUMNS, *more, *(["log"] if with_log else [])])

    def __call__(self, t_ns: int, reports: Reports) -> None:
        for report in reports:
            x, p = report["x"], report["p"]
            row = [
                seconds(int(report["t_ns"])),
                report["object_id"],
                Manoeuvre(report["manoeuvre"]).name,
                f"{report['probability']:.4f}",
                report["lane"],
                DIRECTION[int(report["direction"])],
                *(f"{value:.4f}" for value in x),
                *(f"{p[mode]:.4f}" for mode in MODES),
            ]
            if self._motorway:
                older = int(report["duplicate_of"])
                row += [f"{p[mode]:.4f}" for mode in MOTORWAY_MODES]
                row += [flag_names(int(report["flags"])), older if older >= 0 else ""]
            if self._with_log:
                row.append(self.log)
            self._writer.writerow(row)

    def close(self) -> None:
        self._stack.close()


class EventFile:
    """Writes the events of one or several recordings as CSV or JSON; the ending chooses.

    CSV has one row per event.  JSON has one object per recording, ``{"log": ..., "objects": n,
    "time_share": {manoeuvre: share}, "events": [...]}``, in a list if there are ``several``; a
    number that is not known is null.

    Raises:
        CanImmError: another ending.
        OSError: the file cannot be written.
    """

    def __init__(self, path: str, *, several: bool = False) -> None:
        suffix = Path(path).suffix.lower()
        if suffix not in (".csv", ".json"):
            raise CanImmError(f"--events {path}: the name must end in .csv or .json")
        self._several = several
        self._logs: list[dict[str, Any]] = []
        self._file = Path(path).open("w", newline="")  # noqa: SIM115
        self._csv = csv.writer(self._file, lineterminator="\n") if suffix == ".csv" else None
        if self._csv is not None:
            self._csv.writerow(EVENT_COLUMNS)

    def add(self, log: str, events: EventCollector) -> None:
        """Write what was found in one recording."""
        rows = [_row(log, event) for event in events.found]
        if self._csv is not None:
            self._csv.writerows(row.values() for row in rows)
            return
        for row in rows:
            del row["log"]
            row.update(
                (name, float(row[name]) if row[name] else None)
                for name, form in EVENT_COLUMNS.items()
                if form
            )
        share = {m.name: round(value, 4) for m, value in events.share().items()}
        self._logs.append(
            {"log": log, "objects": events.objects, "time_share": share, "events": rows}
        )

    def close(self) -> None:
        """Finish and close the file."""
        if self._csv is None and not self._file.closed and (self._several or self._logs):
            json.dump(self._logs if self._several else self._logs[0], self._file, indent=1)
            self._file.write("\n")
        self._file.close()


def _row(log: str, event: Event) -> dict[str, Any]:
    """The event's values by column, numbers with a fraction as text; empty what is not known."""
    values: tuple[Any, ...] = (
        log,
        event.object_id,
        event.manoeuvre.name,
        event.event,
        DIRECTION[event.direction],
        event.from_ns / 1e9,
        event.to_ns / 1e9,
        (event.to_ns - event.from_ns) / 1e9,
        event.probability,
        event.lane_from,
        event.lane_to,
        event.gap,
        event.speed,
        event.min_gap,
        event.abs_speed,
    )
    return {
        name: value if not form else format(value, form) if math.isfinite(value) else ""
        for (name, form), value in zip(EVENT_COLUMNS.items(), values, strict=True)
    }
