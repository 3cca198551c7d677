"""``can-imm study roadside`` and ``tune-roadside``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from can_imm.cli.study_common import (
    cell,
    new_table,
    not_negative,
    open_console,
    positive,
    progress_bar,
)

if TYPE_CHECKING:
    from rich.table import Table

MAX_TUNING_RUNS = 500


def add_arguments(studies: Any) -> None:
    roadside = studies.add_parser(
        "roadside",
        help="roadside lidars: the IMM-UKF beside two constant-velocity filters",
        description="Three lidars beside a road with a bend: an IMM-UKF beside a constant-velocity "
        "filter with almost no process noise, as the paper has it, and beside a tuned one.",
    )
    roadside.add_argument(
        "--runs", type=positive, default=100, metavar="N", help="seeds (default 100)"
    )
    roadside.add_argument(
        "--seed",
        type=not_negative,
        default=1000,
        metavar="S",
        help="first seed (default 1000; nothing was tuned on seeds from 1000 on)",
    )
    roadside.add_argument(
        "--scene", default="roadside", metavar="SCENE", help="a TOML file (default: roadside)"
    )
    roadside.add_argument("--json", type=Path, metavar="FILE", help="write all numbers as JSON")
    roadside.add_argument("--plots", type=Path, metavar="DIR", help="draw the figures as PNG")
    roadside.set_defaults(study_run=_roadside)

    tune = studies.add_parser(
        "tune-roadside",
        help="tune the roadside filters as their constants were tuned",
        description="Tune the constant-velocity filter and the IMM-UKF on seeds 0 to N-1, check "
        "them on seeds 500 to 499+N, and print the constants.",
    )
    tune.add_argument(
        "--runs", type=_tuning_runs, default=60, metavar="N", help="seeds (default 60)"
    )
    tune.set_defaults(study_run=_tune)


def _tuning_runs(text: str) -> int:
    value = positive(text)
    if value > MAX_TUNING_RUNS:
        raise argparse.ArgumentTypeError(f"{value} is more than {MAX_TUNING_RUNS}")
    return value


def _roadside(args: argparse.Namespace) -> int:
    import json

    from can_imm.sim.roadside import load_scene
    from can_imm.studies.roadside import study, to_json

    scene = load_scene(args.scene)
    # refuse now what could not be written after the runs
    if args.json is not None:
        args.json.open("a").close()
    if args.plots is not None:
        args.plots.mkdir(parents=True, exist_ok=True)
    with progress_bar(args.runs) as advance:
        done = study(args.runs, args.seed, scene=scene, progress=advance)
    data = to_json(done)
    if args.json is not None:
        args.json.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", "utf-8")
    console = open_console()
    console.print(
        f"{args.runs} run{'s' if args.runs > 1 else ''}, seeds {args.seed} to "
        f"{args.seed + args.runs - 1}; ± standard errors; first second not judged\n",
        highlight=False,
    )
    for table in (_errors(data["results"]), _bend(data["results"]), _reductions(data["results"])):
        console.print(table)
        console.print()
    seen = done.run.visible.sum(axis=1)
    shares = ", ".join(f"{n} in {100 * (seen == n).mean():.1f} %" for n in range(seen.max() + 1))
    console.print(f"lidars that see the vehicle: {shares} of the scans", highlight=False)
    if args.plots is not None:
        from can_imm.studies.roadside_figures import figures

        console.print(f"{len(figures(args.plots, done))} figures in {args.plots}", highlight=False)
    return 0


def _with_error(result: dict[str, Any], path: Sequence[str], digits: int, scale: float = 1) -> str:
    value: Any = result
    error: Any = result["se"]
    for key in path:
        value, error = value.get(key), error.get(key)
        if value is None:
            return "-"
    text = cell(value * scale, digits)
    return text if error is None else f"{text} ±{error * scale:.{digits}f}"


def _errors(results: Sequence[dict[str, Any]]) -> Table:
    from can_imm.studies.roadside import PUBLISHED

    table = new_table("RMSE", ["system", "", "position [m]", "|v| [m/s]", "velocity [m/s]"])
    for result in results:
        cells = [_with_error(result, ("rmse", e), 3) for e in ("position", "speed", "velocity")]
        table.add_row(result["system"], "", *cells)
    for name, what in (("cv", "paper, single CV"), ("imm", "paper, IMM")):
        position, speed = PUBLISHED[name]
        table.add_row(what, "", f"{position:.2f}", f"{speed:.2f} (speed", "or velocity)")
    return table


def _bend(results: Sequence[dict[str, Any]]) -> Table:
    columns = {
        "P(CT) bend": ("p_turn_bend", 3),
        "straights": ("p_turn_straight", 3),
        "delay [s]": ("delay_s", 3),
        "missed": ("missed", 3),
        "false alarms": ("false_alarms", 3),
    }
    table = new_table("The bend", ["system", "", *columns])
    for result in results:
        if "p_turn_straight" in result:
            cells = [_with_error(result, (key,), digits) for key, digits in columns.values()]
            table.add_row(result["system"], "", *cells)
    return table


def _reductions(results: Sequence[dict[str, Any]]) -> Table:
    from can_imm.studies.roadside import PUBLISHED

    columns = ["position", "|v|", "velocity"]
    table = new_table("RMSE smaller by [%]", ["system", "against", *columns])
    for result in results:
        for other in result["reduction"]:
            cells = [
                _with_error(result, ("reduction", other, e), 1, 100)
                for e in ("position", "speed", "velocity")
            ]
            table.add_row(result["system"], other, *cells)
    position, speed = PUBLISHED["reduction"]
    table.add_row(
        "paper, IMM", "single CV", f"{100 * position:.1f}", f"{100 * speed:.1f} (or", "velocity)"
    )
    return table


def _tune(args: argparse.Namespace) -> int:
    from can_imm.studies.roadside_tuning import tune

    def progress(best: float) -> None:
        if sys.stderr.isatty():
            print(f"best so far: {best:.4f}", file=sys.stderr)

    found = tune(args.runs, progress)
    print(f"constant velocity: q = {found.q}")
    print(f"IMM: {found.imm.models}")
    print(f"     transitions = {found.imm.transitions}")
    print("what is minimised:")
    for what, value in (
        ("these, seeds tuned on", found.cost_tuned),
        ("these, other seeds", found.cost_checked),
        ("those in use, other seeds", found.cost_constants),
    ):
        print(f"  {what:28} {value:.4f}")
    return 0
