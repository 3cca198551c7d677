"""Record the logs of replay/ and what the detector says to them: ``python tests/record.py``.

Everything comes out of ``can-imm simulate`` and ``can-imm replay`` with fixed seeds, so a second
run changes nothing; after a change of the detector, ``git diff replay`` shows what it says now.
`test_recordings` compares the detector with these files.
"""

from __future__ import annotations

import contextlib
import csv
import gzip
import io
import sys
import tempfile
from collections.abc import Callable, Iterable
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

from can_imm.bus.sinks import LogSink
from can_imm.bus.sources import LogSource
from can_imm.cli.main import main as can_imm

REPLAY = Path(__file__).parent.parent / "replay"

EPOCH_S = 1_700_000_000
"""Bus time of the scenario's time 0 [s]: real logs carry Unix time, which no float32 can hold."""

DECIMALS = 2
"""Of every number in the expected answers: another machine's last digits do not show."""

AS_WRITTEN = ("time_s", "object_id", "manoeuvre", "lane", "direction", "flags", "duplicate_of")
"""Columns of the answers that are not rounded."""

TRUTH_COLUMNS = ("time_s", "object_id", "manoeuvre", "direction")
PLACE_COLUMNS = ("x", "y")


class Case(NamedTuple):
    """One log.

    Attributes:
        name: in replay/.
        options: of ``simulate``.
        damage: what befalls the log.
        replay: options of ``replay``.
        until_s: the log is cut off after this time [s].
        every: the answers to the other scans are left out.  The log is packed then.  The truth is
            that at the scans which are left, with the objects' places, since its ids are not those
            of the sensor.
    """

    name: str
    options: tuple[str, ...]
    damage: Callable[[str], str] | None = None
    replay: tuple[str, ...] = ()
    until_s: int = 3600
    every: int = 1

    @property
    def log(self) -> str:
        """Name of the log file."""
        return f"{self.name}.log.gz" if self.every > 1 else f"{self.name}.log"


def damaged(log: str) -> str:
    """A log of `two-cars.toml` as a bad recorder, a bad cable and a full disk would leave it."""
    lines = log.splitlines(keepends=True)
    scans = [lines[i : i + 3] for i in range(0, len(lines), 3)]  # RadarScan and two RadarObjects
    head, _, data = scans[30][1].partition("#")
    scans[20][:0] = ["# battery changed here\n", scans[20][0][:28] + "\n"]  # garbage, a cut line
    scans[30][1] = f"{head}#{int(data, 16) ^ 0x10_0000:016X}\n"  # one wrong bit: wrong CRC
    scans[40] = ["DROPCOUNT: dropped 3 CAN frames on 'can0' socket (total drops 3)\n"]
    del scans[50][2]  # the second object's frame is missing
    scans[60].append(scans[60][2])  # a frame twice
    scans[70].insert(1, scans[70][0].partition(" ")[0] + " can0 7DF#02010D\n")  # someone else's
    scans[80][2] = scans[80][2][:-3] + "\n"  # a byte short
    return "".join(line for scan in scans for line in scan)[:-8]  # ends within the last line


CASES = [
    Case("paper-a", ("--scenario", "paper-a", "--seed", "1000")),
    Case("random-1002", ("--scenario", "random", "--seed", "1002")),
    Case("random-1003", ("--scenario", "random", "--seed", "1003")),
    Case(
        "random-1006",
        ("--scenario", "random", "--seed", "1006", "--missed", "0.02", "--dropout", "0.01"),
    ),
    Case(
        "motorway-ars408",
        ("--scenario", "motorway", "--seed", "1010", "--profile", "ars408"),
        replay=("--profile", "ars408", "--preset", "motorway"),
        until_s=12,
        every=7,
    ),
    Case("damaged", ("--scenario", str(REPLAY / "two-cars.toml"), "--seed", "1008"), damaged),
]


def record(case: Case, directory: Path) -> None:
    """Write NAME.log, NAME.truth.csv and NAME.csv, the expected answers, into ``directory``."""
    log = directory / case.log
    with tempfile.TemporaryDirectory() as scratch:
        played, moved = Path(scratch, "played.log"), Path(scratch, "moved.log")
        truth = Path(scratch, "truth.csv")
        run("simulate", *case.options, "--log", played, "--truth", truth)
        with LogSource(played) as source, LogSink(moved) as sink:
            for frame in source:
                if frame.t_ns <= case.until_s * 1_000_000_000:
                    sink.send(frame._replace(t_ns=frame.t_ns + EPOCH_S * 1_000_000_000))
        log.write_bytes(finished(case, moved.read_text()))
        happened = read_rows(truth)
    rows, _ = answers(case, log)
    write_rows(directory / f"{case.name}.csv", rows[0].keys(), map(rounded, rows))
    for row in happened:
        row["time_s"] = f"{Decimal(row['time_s']) + EPOCH_S:.6f}"
    if case.every == 1:
        columns, happened = TRUTH_COLUMNS, label_changes(happened)
    else:
        columns, times = (*TRUTH_COLUMNS, *PLACE_COLUMNS), {row["time_s"] for row in rows}
        kept = [row for row in happened if row["time_s"] in times]
        happened = [rounded({name: row[name] for name in columns}) for row in kept]
    write_rows(directory / f"{case.name}.truth.csv", columns, happened)


def finished(case: Case, log: str) -> bytes:
    """Content of a log file; a packed one does not say when or where it was packed."""
    data = (log if case.damage is None else case.damage(log)).encode()
    return gzip.compress(data, mtime=0) if case.log.endswith(".gz") else data


def run(*arguments: object) -> str:
    """Run ``can-imm`` and return what it prints to standard output."""
    with contextlib.redirect_stdout(io.StringIO()) as said:
        status = can_imm([str(argument) for argument in arguments])
    if status != 0:
        sys.exit(f"can-imm {arguments[0]} ended with status {status}")
    return said.getvalue()


def answers(case: Case, log: Path) -> tuple[list[dict[str, str]], str]:
    """Replay a case's log; return the rows of ``--csv`` that count, and the summary."""
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch, "answers.csv")
        summary = run("replay", log, *case.replay, "--csv", path)
        rows = read_rows(path)
    times = {time_s: k for k, time_s in enumerate(dict.fromkeys(row["time_s"] for row in rows))}
    return [row for row in rows if times[row["time_s"]] % case.every == 0], summary


def rounded(row: dict[str, str]) -> dict[str, str]:
    """A row to `DECIMALS`; adding 0 makes a zero of -0, whose sign is noise."""
    return {
        name: text if name in AS_WRITTEN else f"{round(float(text), DECIMALS) + 0.0:.{DECIMALS}f}"
        for name, text in row.items()
    }


def label_changes(truth: Iterable[dict[str, str]]) -> list[dict[str, str]]:
    """Rows of ``simulate --truth`` in which an object begins something else."""
    before: dict[str, str] = {}
    changes = []
    for row in truth:
        if before.get(row["object_id"]) != row["manoeuvre"]:
            before[row["object_id"]] = row["manoeuvre"]
            changes.append({name: row[name] for name in TRUTH_COLUMNS})
    return changes


def read_rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write_rows(path: Path, columns: Iterable[str], rows: Iterable[dict[str, str]]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(columns), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    for case in CASES:
        record(case, REPLAY)
    print(f"recorded {len(CASES)} logs in {REPLAY}; 'git diff' there shows what is new")
