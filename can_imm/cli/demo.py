"""Watch the detector follow the published scenario, then read how well it did.

  can-imm demo                                 a simulated radar and the detector on a virtual bus
  can-imm demo --realtime                      at the speed of life
  can-imm demo --scenario random --seed 7      another drive
  can-imm demo --plot figures                  and the paper's figures 3 to 8 of this run
  can-imm demo cooperative                     radars of five vehicles, a tracker, the detector
  can-imm demo roadside                        lidars beside a road, a tracker, the detector

The radar's frames are encoded, sent, received and decoded as on a real bus; only time is faster.
Without a terminal there is a plain line per change of manoeuvre, as fast as possible.  Ctrl-C ends
it with the summary so far.
"""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

    from can_imm.cli.demo_run import DemoRun

WATCH_S = 9.0
"""How long an accelerated run takes on a terminal, unless that is slower than real time."""

PLAIN_WIDTH = 80


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "system",
        nargs="?",
        choices=("cooperative", "roadside"),
        metavar="cooperative|roadside",
        help="several sensors and a tracker instead of one radar",
    )
    parser.add_argument(
        "--scenario",
        metavar="NAME|FILE|random",
        help="paper-a (default), paper-b, paper-s, random, or a TOML file; with a tracker the TOML "
        "file of a scene",
    )
    parser.add_argument(
        "--seed",
        type=_seed,
        default=1000,
        metavar="N",
        help="of noise and random scenario (default: 1000; nothing was tuned on 1000 and above)",
    )
    parser.add_argument(
        "--preset",
        default="two-lane",
        metavar="NAME|FILE",
        help="the mode bank: two-lane (default), paper, or a TOML file",
    )
    parser.add_argument(
        "--realtime", action="store_true", help="by the clock on the wall, not accelerated"
    )
    parser.add_argument(
        "--plot", type=Path, metavar="DIR", help="draw the paper's figures 3 to 8 of this run"
    )


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be a whole number from 0 up, not {text!r}")
    return int(text)


def run(args: argparse.Namespace) -> int:
    if args.system is not None:
        return _track(args)
    args.scenario = args.scenario or "paper-a"
    from rich.console import Console

    from can_imm.cli.compiling import announced

    if args.plot is not None:
        args.plot.mkdir(parents=True, exist_ok=True)  # refuse now what could not be drawn later
    with announced():
        from can_imm.cli.demo_run import DemoRun

        show = DemoRun(args.scenario, args.preset, args.seed)

    terminal = sys.stdout.isatty()
    # without a terminal: no colours, and lines as long as the table needs
    console = Console(highlight=False) if terminal else Console(width=PLAIN_WIDTH, highlight=False)
    title = f"{args.scenario}, seed {args.seed}, preset {args.preset}"
    interrupted = False
    try:
        _play(show, console, title, args.realtime)
    except KeyboardInterrupt:
        interrupted = True
    _conclude(show, console, title, args.preset)
    if interrupted:
        return 128 + signal.SIGINT
    if args.plot is not None:
        from can_imm.studies.figures import paper_figures

        seen, said = show.so_far()
        drawn = paper_figures(args.plot, seen[0], said[0])
        console.print(f"\n{len(drawn)} figures in {args.plot}", markup=False)
    return 0


def _track(args: argparse.Namespace) -> int:
    from can_imm.cli.compiling import announced
    from can_imm.types import CanImmError

    if args.plot is not None:
        raise CanImmError(f"--plot: 'can-imm study' draws the figures of {args.system} tracking")
    with announced():
        from can_imm.cli.demo_tracking import TrackingDemo

        show = TrackingDemo(args.system, args.scenario or args.system, args.preset, args.seed)
    interrupted = False
    try:
        show.play(1.0 if args.realtime else None)
    except KeyboardInterrupt:
        interrupted = True
    show.summary()
    return 128 + signal.SIGINT if interrupted else 0


def _play(show: DemoRun, console: Console, title: str, realtime: bool) -> None:
    from can_imm.cli.demo_lines import PlainLines
    from can_imm.cli.demo_view import LiveView, fits

    real_rate = 1.0 if realtime else None
    if not fits(console):
        show.on_scan = PlainLines(show, title)
        show.play(real_rate)
        return
    rate = real_rate or max(1.0, show.duration_ns * 1e-9 / WATCH_S)
    with LiveView(show, console, title, rate):
        show.play(rate)


def _conclude(show: DemoRun, console: Console, title: str, preset: str) -> None:
    from can_imm.cli.demo_lines import print_summary

    if show.at_ns < 0:
        console.print("ended before the first scan")
        return
    print_summary(show, console, title, preset)
