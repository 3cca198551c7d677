"""``can-imm study bernoulli``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from can_imm.cli.study_common import (
    add_jobs,
    cell,
    new_table,
    not_negative,
    open_console,
    positive,
    progress_bar,
)

if TYPE_CHECKING:
    from rich.table import Table


def add_arguments(studies: Any) -> None:
    parser = studies.add_parser(
        "bernoulli",
        help="cooperative radars: the Bernoulli filter's parameter study and run time",
        description="Five vehicles with radars around one object: the published sweeps of time "
        "step, particles, measurement and process noise, for both updates and an extended Kalman "
        "filter; how fast an object is found and lost; run time over the number of particles.",
    )
    parser.add_argument(
        "--runs", type=positive, metavar="N", help="seeds per setting (default 50; quick 8)"
    )
    parser.add_argument(
        "--seed",
        type=not_negative,
        default=1000,
        metavar="S",
        help="first seed (default 1000; nothing was tuned on seeds from 1000 on)",
    )
    parser.add_argument(
        "--quick", action="store_true", help="few runs, without the longest settings"
    )
    parser.add_argument(
        "--resume",
        type=Path,
        metavar="FILE",
        help="keep finished runs in this file, and do not repeat those it holds",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers as JSON")
    parser.add_argument(
        "--plots", type=Path, metavar="DIR", help="draw histograms and scaling plots as PNG"
    )
    add_jobs(parser)
    parser.set_defaults(study_run=_bernoulli)


def _bernoulli(args: argparse.Namespace) -> int:
    import json
    import os

    from can_imm.studies.bernoulli import (
        QUICK_SWEEPS,
        SWEEPS,
        number_of_jobs,
        study,
        to_json,
    )
    from can_imm.studies.bernoulli_runtime import QUICK_SIZES, SIZES, measure

    # refuse now what could not be written after the runs
    if args.json is not None:
        args.json.open("a").close()
    if args.plots is not None:
        args.plots.mkdir(parents=True, exist_ok=True)
    sweeps = QUICK_SWEEPS if args.quick else SWEEPS
    runs = args.runs or (8 if args.quick else 50)
    with progress_bar(number_of_jobs(runs, sweeps)) as advance:
        done = study(
            runs,
            args.seed,
            sweeps=sweeps,
            jobs=args.jobs or os.cpu_count() or 1,
            store=args.resume,
            progress=advance,
        )
    # after the runs, when nothing else of ours needs the processors
    runtime = measure(QUICK_SIZES if args.quick else SIZES)
    data = to_json(done, runtime)
    if args.json is not None:
        args.json.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", "utf-8")
    console = open_console()
    console.print(
        f"{runs} run{'s' if runs > 1 else ''} per setting, seeds {args.seed} to "
        f"{args.seed + runs - 1}; in brackets standard errors of the last digits\n",
        highlight=False,
    )
    tables = (
        _errors(data["results"]),
        _trends(data["trends"]),
        _existence(data["existence"]),
        _runtime(runtime),
    )
    for table in tables:
        console.print(table)
        console.print()
    if args.plots is not None:
        from can_imm.studies.bernoulli_figures import figures

        drawn = figures(args.plots, done, runtime)
        console.print(f"{len(drawn)} figures in {args.plots}", highlight=False)
    return 0


def _with_error(result: dict[str, Any], key: str, digits: int) -> str:
    """The mean, and in brackets its standard error in units of the last digit."""
    value, error = result[key], result["se"][key]
    text = cell(value, digits)
    if value is None or error is None:
        return text
    return f"{text}({round(error * 10**digits)})".removeprefix("0")


def _errors(results: Sequence[dict[str, Any]]) -> Table:
    from can_imm.studies.bernoulli import SYSTEMS

    short = {system: system.removeprefix("bernoulli-") for system in SYSTEMS}
    columns = [f"{name}\n{reading}" for name in short.values() for reading in ("std", "RMS")]
    table = new_table("Position error in m: std about the mean, and RMS", ["", "", *columns])
    rows: dict[tuple[str, float], list[str]] = {}
    for result in results:
        sweep = result["setting"]["sweep"]
        cells = rows.setdefault((sweep, result["setting"][sweep]), [])
        cells += [_with_error(result, "std", 4), _with_error(result, "rmse", 4)]
    last = None
    for (sweep, value), cells in rows.items():
        if last not in (None, sweep):
            table.add_section()
        last = sweep
        name = {"period": "T_s", "particles": "N_p"}.get(sweep, sweep)
        table.add_row(name, f"{value:g}", *cells)
    return table


def _trends(trends: dict[str, Any]) -> Table:
    table = new_table(
        "Trends", ["system", "error", "R² over √k_s", "R² over k_s", "effect of k_m [%]"]
    )
    for system, readings in trends.items():
        for reading, row in readings.items():
            table.add_row(
                system,
                {"std": "std", "rmse": "RMS"}[reading],
                cell(row["r2_sqrt_k_s"], 4),
                cell(row["r2_k_s"], 4),
                cell(100 * row["k_m_effect"], 1),
            )
    return table


def _existence(results: Sequence[dict[str, Any]]) -> Table:
    columns = ["mean", "worst", "mean", "worst"]
    table = new_table(
        "Scans until an object is found (q > .99) and lost (q < .1); p_d = .9, λ = 5",
        ["system", "", *columns],
    )
    for result in results:
        table.add_row(
            result["system"],
            "",
            _with_error(result, "scans_to_appear", 2),
            str(result["worst_to_appear"]),
            _with_error(result, "scans_to_vanish", 2),
            str(result["worst_to_vanish"]),
        )
    return table


def _runtime(rows: Sequence[dict[str, Any]]) -> Table:
    table = new_table(
        "Time of a step in ms, five sensors, one core",
        ["particles", "", "median", "best", "% of T_s", "numpy", "times faster"],
    )
    for row in rows:
        numpy_ms = row.get("numpy_median_ms")
        table.add_row(
            f"{row['particles']:,}",
            "",
            cell(row["median_ms"], 3),
            cell(row["best_ms"], 3),
            cell(100 * row["share_of_period"], 2),
            cell(numpy_ms, 2),
            cell(None if numpy_ms is None else numpy_ms / row["median_ms"], 1),
        )
    return table
