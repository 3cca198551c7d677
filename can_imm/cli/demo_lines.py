"""The demonstration in plain lines, and its summary."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from rich import box
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from can_imm.bus.encoder import OUTPUT_IDS
from can_imm.cli.demo_bands import bands
from can_imm.studies.metrics import evaluate, summarise
from can_imm.studies.paper import TABLE_6, score
from can_imm.studies.systems import answer
from can_imm.types import Manoeuvre

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import Console

    from can_imm.cli.demo_run import DemoRun, Track

SWITCHES = "switches\n{:.3g} true"
COLUMNS = {
    "accu-\nracy": ("accuracy", 3),
    "\n±0.5s": ("accuracy_tol_0_5", 3),
    "macro\nF1": ("macro_f1", 3),
    "delay\ns": ("mean_delay_s", 2),
    SWITCHES: ("switches", 0),
    "RMSE\nx m": ("rmse_x", 4),
    "RMSE\nvx m/s": ("rmse_vx", 4),
    "RMSE\ny m": ("rmse_y", 4),
    "RMSE\nvy m/s": ("rmse_vy", 4),
}
"""Column of the summary -> metric and decimals."""


class PlainLines:
    """Prints a line for each change of what is true or said; call it after each scan."""

    def __init__(self, show: DemoRun, title: str) -> None:
        self._show = show
        self._last: dict[int, tuple[int, int]] = {}
        print(f"can-imm demo: {title}", flush=True)
        print("    time     gap  object  true          said          probability", flush=True)

    def __call__(self) -> None:
        at_ns = self._show.at_ns
        for track in self._show.tracks:
            k = track.rows(at_ns) - 1
            if k < 0 or track.t_ns[k] != at_ns:
                continue
            labels = int(track.label[k]), int(track.manoeuvre[k])
            if self._last.get(track.object_id) != labels:
                self._last[track.object_id] = labels
                print(_line(track, k), flush=True)


def _line(track: Track, k: int) -> str:
    true, said = Manoeuvre(track.label[k]), Manoeuvre(track.manoeuvre[k])
    return (
        f"{track.t_ns[k] * 1e-9:7.1f}s {track.x[k, 0]:6.2f}m {track.object_id:7}  "
        f"{true.name:12}  {said.name:12}  {track.p[k, said]:11.3f}"
        f"{'' if true == said else '  wrong'}"
    )


def print_summary(show: DemoRun, console: Console, title: str, preset: str) -> None:
    """Print how the run went so far, the preset beside the baselines and the paper's Table 6."""
    seen, said = show.so_far()
    scans = [scan for scan in show.scans if scan.t_ns <= show.at_ns]
    rows: dict[str, Mapping[str, tuple[float, float]]] = {
        preset: summarise([score(*pair) for pair in zip(seen, said, strict=True)])
    }
    for system in ("rules", "kalman", "measurement"):
        answers = answer(system, scans, seen, 0)
        rows[system] = summarise([score(*pair) for pair in zip(seen, answers, strict=True)])
    rows["Table 6"] = {f"rmse_{state}": (rmse, 0.0) for state, rmse in TABLE_6.items()}
    truth = summarise(
        [evaluate(one.t_ns, one.label, one.state, one.label, None, None, None) for one in seen]
    )

    objects = f", mean over {len(seen)} objects" if len(seen) > 1 else ""
    console.print(f"[bold]can-imm demo[/]  {escape(title)}")
    console.print(f"{show.at_ns * 1e-9:.1f} s, {len(scans)} scans{objects}")
    if console.is_terminal:
        console.print()
        for line in bands(show.tracks[0], show.at_ns, show.duration_ns, console.width):
            console.print(line)
    console.print()
    console.print(_table(rows, truth["switches"][0]))
    console.print()
    console.print(_bus_lines(show))
    console.print("kalman: one Kalman filter; rules: thresholds on one; Table 6: the paper's RMSE.")
    console.print("One run is one run: 'can-imm study paper' has the statistics of many.")


def _table(rows: Mapping[str, Mapping[str, tuple[float, float]]], switches: float) -> Table:
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, collapse_padding=True)
    table.add_column("\nsystem", no_wrap=True)
    for column in COLUMNS:
        table.add_column(escape(column.format(switches)), justify="right", no_wrap=True)
    for number, (system, values) in enumerate(rows.items()):
        cells = [_cell(values.get(name), digits) for name, digits in COLUMNS.values()]
        table.add_row(escape(system), *cells, style="bold" if number == 0 else None)
    return table


def _cell(value: tuple[float, float] | None, digits: int) -> str:
    if value is None or not np.isfinite(value[0]):
        return "-"
    text = f"{value[0]:.{digits}f}"
    return text.removeprefix("0") if digits else text


def _bus_lines(show: DemoRun) -> Text:
    counts, decoded = show.tap.counts, show.node.decoder.counts
    answers = sum(counts[i] for i in OUTPUT_IDS)
    lines = {
        "radar": f"{decoded.frames:,} frames, {decoded.rejected:,} rejected",
        "detector": f"{answers:,} frames, {show.tap.rejected:,} rejected",
        "loop": f"{show.health.steps:,} steps of 10 ms, {show.health.late_frames:,} late frames; "
        f"answers: half within {show.work.quantile_ns(0.5) / 1e6:.2f} ms",
    }
    text = Text()
    for name, what in lines.items():
        text.append(f"{name:<10}", "dim").append(f"{what}\n")
    return text
