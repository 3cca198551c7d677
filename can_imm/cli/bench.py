"""Measure this package beside its peers on this machine: the same work, in one run.

  can-imm bench                                     estimator, decoder, replay of simulated logs
  can-imm bench --log drive.log --profile toyota    replay a log of your own
  can-imm bench --json bench.json                   and write the figures to a file

Peers are filterpy, cantools and python-can, and Stone Soup where it is installed.  Each time is a
median over rounds in which both sides take turns; the ratio of the two depends far less on the
machine than the times do.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from can_imm.cli.compiling import announced
from can_imm.cli.detection import positive_int

if TYPE_CHECKING:
    from can_imm.studies.bench import Result

PEER_FRAMES = 1200
"""So many frames of the log go through filterpy, which would take minutes for all of it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--rounds", type=positive_int, default=7, metavar="N", help="rounds each (default: 7)")
    add("--only", nargs="+", metavar="NAME", help="only these comparisons")
    add("--log", metavar="LOG", help="the log to replay (default: a simulated one)")
    add("--profile", default="can_imm", metavar="NAME|FILE", help="the sensor in the log")
    add("--preset", default="two-lane", metavar="NAME|FILE", help="the mode bank of the replay")
    add("--json", metavar="FILE", help="write the figures to this file")


def run(args: argparse.Namespace) -> int:
    from rich.console import Console

    from can_imm.types import CanImmError

    console = Console(highlight=False, soft_wrap=True)
    results: list[dict[str, Any]] = []
    with announced():
        from can_imm.bus.profile import load_profile
        from can_imm.bus.sources import LogSource
        from can_imm.manoeuvres import load_bank
        from can_imm.studies import bench

        profile, bank = load_profile(args.profile), load_bank(args.preset)
        with tempfile.TemporaryDirectory() as folder:
            log = Path(args.log or Path(folder) / "simulated.log")
            if args.log is None:
                bench.write_log(log)
            share = min(1.0, PEER_FRAMES / sum(1 for _ in LogSource(log)))
            cases = [
                *bench.estimator_cases(),
                bench.decode_case(),
                *bench.replay_cases(log, profile, bank, share),
                bench.crowd_case(Path(folder) / "crowd.log"),
            ]
            names = [case.name for case in cases]
            unknown = [name for name in args.only or [] if name not in names]
            if unknown:
                raise CanImmError(f"--only {unknown[0]}: no such comparison ({', '.join(names)})")
            for result in bench.measure(
                [case for case in cases if case.name in (args.only or names)], args.rounds
            ):
                console.print(_line(result))
                results.append(result.as_dict())
    if args.json:
        text = json.dumps({"machine": bench.machine(), "results": results}, indent=1)
        Path(args.json).write_text(text + "\n", encoding="utf-8")
    return 0


def _line(result: Result) -> str:
    case = result.case
    sense = "times faster than" if case.faster else "times the cost of"
    target = ""
    if case.target is not None:
        sign = ">=" if case.faster else "<="
        verdict = "[green]reached[/]" if result.reached else "[red]missed[/]"
        target = f"  (target {sign} {case.target:g}: {verdict})"
    return (
        f"[bold]{result.ratio:9.2f}[/] {sense} {case.peer.name}{target}\n"
        f"          [dim]{case.name}: {case.what}; "
        f"{_time(result.median_us)} against {_time(result.peer_median_us)}[/]"
    )


def _time(us: float) -> str:
    return f"{us:,.2f} us" if us < 1000 else f"{us / 1000:,.1f} ms"
