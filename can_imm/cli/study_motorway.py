"""``can-imm study motorway`` and ``tune-motorway-rules``."""

from __future__ import annotations

import argparse
import sys
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

MAX_TUNING_RUNS = 500
_KINDS = {"full": "", "plain": ", straight road", "published": ", as published"}


def add_arguments(studies: Any) -> None:
    motorway = studies.add_parser(
        "motorway",
        help="random motorway traffic: the preset motorway beside tuned rules",
        description="Random motorway traffic, measured by a profile's radar and read from its "
        "frames: the preset motorway, at once and by hindsight, beside rules on a Kalman filter.",
    )
    motorway.add_argument(
        "--profile",
        action="append",
        metavar="P",
        help="ars408, can_imm, toyota, toyota-tss2 or esr; may be repeated (default: ars408)",
    )
    motorway.add_argument(
        "--runs", type=positive, default=30, metavar="N", help="drives of a minute (default 30)"
    )
    motorway.add_argument(
        "--seed",
        type=not_negative,
        default=1000,
        metavar="S",
        help="first seed (default 1000; nothing was tuned on seeds from 1000 on)",
    )
    motorway.add_argument(
        "--settings",
        choices=("reporting", "tuning"),
        default="reporting",
        help="what the traffic is drawn from (default reporting; everything was tuned on tuning)",
    )
    _add_kinds(motorway)
    motorway.add_argument(
        "--systems",
        nargs="+",
        choices=("motorway", "motorway-smoothed", "rules"),
        metavar="SYSTEM",
        help="some of motorway motorway-smoothed rules (default: all)",
    )
    motorway.add_argument(
        "--preset",
        default="motorway",
        metavar="BANK",
        help="the detector's mode bank: a preset or a TOML file (default: motorway)",
    )
    motorway.add_argument("--json", type=Path, metavar="FILE", help="write all numbers as JSON")
    add_jobs(motorway)
    motorway.set_defaults(study_run=_motorway)

    tune = studies.add_parser(
        "tune-motorway-rules",
        help="tune the rules of the study motorway as their constants were tuned",
        description="Tune the rules for a profile on seeds 0 to N-1 with the settings tuning, "
        "check them on seeds 500 to 499+N, and print the constants.",
    )
    tune.add_argument("--profile", default="ars408", metavar="P", help="(default: ars408)")
    _add_kinds(tune)
    tune.add_argument(
        "--runs", type=_tuning_runs, default=25, metavar="N", help="seeds (default 25)"
    )
    tune.set_defaults(study_run=_tune)


def _add_kinds(parser: argparse.ArgumentParser) -> None:
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument(
        "--plain",
        dest="kind",
        action="store_const",
        const="plain",
        help="a straight road and a constant speed of the ego, nothing but our traffic; detector "
        "and rules know it",
    )
    kinds.add_argument(
        "--published",
        dest="kind",
        action="store_const",
        const="published",
        help="the same, and all move as in the published scenario: without wander, across the road "
        "at a constant rate",
    )
    parser.set_defaults(kind="full")


def _tuning_runs(text: str) -> int:
    # as many seeds again are needed for the check, all of them below 1000
    value = positive(text)
    if value > MAX_TUNING_RUNS:
        raise argparse.ArgumentTypeError(f"{value} is more than {MAX_TUNING_RUNS}")
    return value


def _motorway(args: argparse.Namespace) -> int:
    import json
    import os

    from can_imm.sim.motorway import motorway_settings
    from can_imm.studies.motorway import SYSTEMS, study, to_json

    # refuse now what could not be written after the runs
    if args.json is not None:
        args.json.open("a").close()
    profiles = list(dict.fromkeys(args.profile or ["ars408"]))
    with progress_bar(args.runs * len(profiles)) as advance:
        results = study(
            args.runs,
            args.seed,
            profiles=profiles,
            systems=list(dict.fromkeys(args.systems or SYSTEMS)),
            preset=args.preset,
            settings=motorway_settings(args.settings),
            kind=args.kind,
            jobs=args.jobs or os.cpu_count() or 1,
            progress=advance,
        )
    data = to_json(args.runs, args.seed, results)
    data["settings"] = args.settings
    data["plain"], data["published"] = args.kind != "full", args.kind == "published"
    if args.json is not None:
        args.json.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", "utf-8")
    console = open_console()
    console.print(
        f"{args.runs} drive{'s' if args.runs > 1 else ''} per profile, seeds {args.seed} to "
        f"{args.seed + args.runs - 1}, settings {args.settings}"
        f"{_KINDS[args.kind]};\nstandard errors with --json\n",
        highlight=False,
    )
    for title, columns in _TABLES.items():
        keys = {key for key, _, _ in columns.values()}
        # on a straight road there is nothing but traffic
        if all(result.get(key) is None for result in data["results"] for key in keys):
            continue
        console.print(_table(title, data["results"], columns))
        console.print()
    return 0


# column: (key in the JSON, digits, key within that)
_Columns = dict[str, tuple[str, int, str | None]]
_TABLES: dict[str, _Columns] = {
    "Frames": {
        "accu-\nracy": ("accuracy", 4, None),
        "macro\nF1": ("macro_f1", 3, None),
        "errors/\nrules": ("error_ratio", 2, None),
        "delay\n[s]": ("mean_delay_s", 2, None),
        "ECE": ("ece", 3, None),
        "lane": ("lane_accuracy", 4, None),
    },
    "Lane changes": {
        "all": ("lane_changes", 0, None),
        "found": ("lane_changes_found", 3, None),
        "within\n100 m": ("lane_changes_found_nearby", 3, None),
        "delay\n[s]": ("lane_change_delay_s", 2, None),
        "least\n[s]": ("lane_change_delay_limit_s", 2, None),
        "false\nper h": ("false_lane_changes_per_hour", 1, None),
        "hours": ("object_hours", 2, None),
    },
    "Found of what is not traffic in our direction": {
        "stationary": ("stationary_share", 4, None),
        "oncoming": ("oncoming_share", 4, None),
    },
    "RMSE of the states, and NEES (4 expected)": {
        "x [m]": ("rmse", 3, "x"),
        "vx [m/s]": ("rmse", 3, "vx"),
        "y [m]": ("rmse", 3, "y"),
        "vy [m/s]": ("rmse", 3, "vy"),
        "NEES": ("nees", 1, None),
    },
}


def _table(title: str, results: Sequence[dict[str, Any]], columns: _Columns) -> Table:
    table = new_table(title, ["profile", "system", *columns])
    for profile in dict.fromkeys(result["profile"] for result in results):
        for result in results:
            if result["profile"] != profile:
                continue
            cells = []
            for key, digits, part in columns.values():
                value: Any = result.get(key)
                if part is not None and value is not None:
                    value = value[part]
                cells.append(cell(value, digits))
            table.add_row(profile, result["system"], *cells)
        table.add_section()
    return table


def _tune(args: argparse.Namespace) -> int:
    from can_imm.studies.motorway_tuning import tune

    def progress(best: float) -> None:
        if sys.stderr.isatty():
            print(f"best so far: {best:.4f} wrong frames", file=sys.stderr)

    found = tune(args.profile, args.runs, kind=args.kind, progress=progress)
    print(f'"{args.profile}": {found.rules}')
    for what, wrong in (
        ("these rules, seeds tuned on", found.wrong_tuned),
        ("these rules, other seeds", found.wrong_checked),
        ("the rules in use, other seeds", found.wrong_constants),
    ):
        print(f"wrong frames, {what:30} {wrong:.4f}")
    return 0
