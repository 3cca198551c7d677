"""Measure the detector by Monte Carlo, beside a Kalman filter, rules and the raw measurement.

  can-imm study paper                          table for the published scenario and random ones
  can-imm study paper --json out.json --plots figures
  can-imm study tune-rules                     how the baselines' constants were found
  can-imm study bernoulli                      cooperative radars: errors over the parameters
  can-imm study roadside                       lidars beside the road: IMM-UKF and single models
  can-imm study tune-roadside                  how their constants were found
  can-imm study motorway --profile ars408      motorway traffic: the preset motorway and rules
  can-imm study tune-motorway-rules            how the rules' constants were found

Studies report on seeds from 1000 on; everything was tuned on seeds below.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from can_imm.cli import study_bernoulli, study_motorway, study_roadside
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

    from can_imm.studies.paper import Result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    studies = parser.add_subparsers(dest="study", required=True, metavar="STUDY")

    paper = studies.add_parser(
        "paper",
        help="every metric for the presets and the baselines; the paper's figures",
        description="Every metric for the presets and the baselines, on the published scenario "
        "(readings A, B and S) and on random scenarios.",
    )
    paper.add_argument(
        "--runs", type=positive, default=100, metavar="N", help="seeds per truth (default 100)"
    )
    paper.add_argument(
        "--seed",
        type=not_negative,
        default=1000,
        metavar="S",
        help="first seed (default 1000; nothing was tuned on seeds from 1000 on)",
    )
    paper.add_argument("--json", type=Path, metavar="FILE", help="write all numbers as JSON")
    paper.add_argument(
        "--plots", type=Path, metavar="DIR", help="draw figures 3 to 8 and comparisons as PNG"
    )
    paper.add_argument(
        "--systems",
        nargs="+",
        metavar="SYSTEM",
        help="presets, TOML files with a mode bank, or kalman, rules, measurement "
        "(default: two-lane paper kalman rules measurement)",
    )
    paper.add_argument(
        "--truths",
        nargs="+",
        choices=("A", "B", "S", "random"),
        metavar="TRUTH",
        help="some of A B S random (default: all)",
    )
    add_jobs(paper)
    paper.set_defaults(study_run=_paper)

    tune = studies.add_parser(
        "tune-rules",
        help="tune the baselines as their constants were tuned",
        description="Tune the Kalman filter and the rules on truths A, B, S and random scenarios "
        "(seeds 0 to N-1), check them on seeds 500 to 499+N, and print the constants.",
    )
    tune.add_argument(
        "--runs", type=_half, default=150, metavar="N", help="seeds per truth (default 150)"
    )
    tune.set_defaults(study_run=_tune)

    study_bernoulli.add_arguments(studies)
    study_roadside.add_arguments(studies)
    study_motorway.add_arguments(studies)


def run(args: argparse.Namespace) -> int:
    status: int = args.study_run(args)
    return status


def _half(text: str) -> int:
    # as many seeds again are needed for the check, all of them below 1000
    value = positive(text)
    if value > 500:
        raise argparse.ArgumentTypeError(f"{value} is more than 500")
    return value


def _paper(args: argparse.Namespace) -> int:
    import json
    import os

    from can_imm.studies.paper import SYSTEMS, study, to_json
    from can_imm.studies.runs import TRUTHS
    from can_imm.studies.systems import BASELINES

    # refuse now what could not be written after the runs
    if args.json is not None:
        args.json.open("a").close()
    if args.plots is not None:
        args.plots.mkdir(parents=True, exist_ok=True)
    systems = list(dict.fromkeys(args.systems or SYSTEMS))
    truths = list(dict.fromkeys(args.truths or TRUTHS))
    with progress_bar(args.runs * len(truths)) as advance:
        results = study(
            args.runs,
            args.seed,
            systems=systems,
            truths=truths,
            jobs=args.jobs or os.cpu_count() or 1,
            progress=advance,
        )
    data = to_json(args.runs, args.seed, results)
    if args.json is not None:
        args.json.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", "utf-8")
    console = open_console()
    console.print(
        f"{args.runs} run{'s' if args.runs > 1 else ''} per truth, seeds {args.seed} to "
        f"{args.seed + args.runs - 1}; standard errors with --json\n",
        highlight=False,
    )
    console.print(_manoeuvre_table(data["results"]))
    console.print()
    console.print(_state_table(data["results"]))
    if args.plots is not None:
        detectors = [system for system in systems if system not in BASELINES]
        drawn = _draw(args.plots, args, detectors[:1], truths[0], results)
        console.print(f"{len(drawn)} figures in {args.plots}", highlight=False)
    return 0


def _draw(
    directory: Path,
    args: argparse.Namespace,
    detectors: Sequence[str],
    truth: str,
    results: Sequence[Result],
) -> list[Path]:
    from can_imm.studies.figures import comparisons, one_run

    drawn = [path for system in detectors for path in one_run(directory, system, truth, args.seed)]
    return drawn + comparisons(directory, args.runs, results)


def _manoeuvre_table(results: Sequence[dict[str, Any]]) -> Table:
    columns = {
        "accu-\nracy": ("accuracy", 4),
        "macro\nF1": ("macro_f1", 3),
        "±0.3s": ("accuracy_tol_0_3", 3),
        "±0.5s": ("accuracy_tol_0_5", 3),
        "delay\n[s]": ("mean_delay_s", 2),
        "mis-\nsed": ("missed_segments", 2),
        "swit-\nches": ("switches", 1),
        "Brier": ("brier", 3),
        "ECE": ("ece", 3),
    }
    table = new_table("Manoeuvres", ["truth", "system", *columns])
    for truth in dict.fromkeys(result["truth"] for result in results):
        for result in results:
            if result["truth"] == truth and result["accuracy"] is not None:
                cells = [cell(result[key], digits) for key, digits in columns.values()]
                table.add_row(truth, result["system"], *cells)
        table.add_section()
    return table


def _state_table(results: Sequence[dict[str, Any]]) -> Table:
    from can_imm.studies.paper import TABLE_6

    units = {"x": "m", "vx": "m/s", "y": "m", "vy": "m/s"}
    columns = [f"{state} [{unit}]" for state, unit in units.items()]
    table = new_table(
        "RMSE of the states, and NEES (4 expected)", ["truth", "system", *columns, "NEES"]
    )
    for truth in dict.fromkeys(result["truth"] for result in results):
        for result in results:
            if result["truth"] == truth:
                cells = [cell(result["rmse"][state], 4) for state in units]
                table.add_row(truth, result["system"], *cells, cell(result["nees"], 2))
        if truth != "random":
            table.add_row(truth, "paper, Table 6", *(cell(TABLE_6[s], 4) for s in units), "-")
        table.add_section()
    return table


def _tune(args: argparse.Namespace) -> int:
    from can_imm.studies.tuning import tune

    def progress(best: float) -> None:
        if sys.stderr.isatty():
            print(f"best so far: {best:.4f} wrong frames", file=sys.stderr)

    found = tune(args.runs, progress)
    print(f"KALMAN_NOISE = {found.noise}")
    print(f"RULES = {found.rules}")
    print("wrong frames by truth:")
    for what, wrong in (
        ("these rules, seeds tuned on", found.wrong_tuned),
        ("these rules, other seeds", found.wrong_checked),
        ("the rules in use, other seeds", found.wrong_constants),
    ):
        print(f"  {what:30}", *(f"{truth} {value:.4f}" for truth, value in wrong.items()))
    return 0
