"""Run the detector over a recorded log, as fast as possible or in real time.

  can-imm replay drive.log                          what was in it, which lane changes were found
  can-imm replay drive.blf --csv drive.csv          one row per object and scan
  can-imm replay drive.asc.gz --out answers.log     input and manoeuvre frames in one log
  can-imm replay radar.log --profile toyota         another sensor

Reads .log .asc .blf .trc .mf4 .csv .db, the text formats also as .gz.  The loop is that of
'can-imm detect': the recording of a live run gives the same manoeuvre frames again.
"""

from __future__ import annotations

import argparse
import time
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from can_imm.cli.detection import add_detector_arguments, build, print_summary, summary_console

if TYPE_CHECKING:
    from can_imm.bus.sources import LogSource
    from can_imm.runtime.loop import Loop

REFRESH_STEPS = 100


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", metavar="LOG", help="the log file")
    add_detector_arguments(parser)
    parser.add_argument(
        "--out",
        metavar="LOG",
        help="write input and manoeuvre frames to this log; its ending chooses the format",
    )
    parser.add_argument(
        "--realtime", action="store_true", help="at the speed at which it was recorded"
    )


def run(args: argparse.Namespace) -> int:
    from can_imm.bus.encoder import OUTPUT_IDS
    from can_imm.bus.sinks import LogSink
    from can_imm.bus.sources import LogSource
    from can_imm.runtime.clock import FastClock, PacedClock
    from can_imm.runtime.feeds import LogFeed
    from can_imm.runtime.loop import Loop
    from can_imm.types import CanImmError

    if args.out and Path(args.out).resolve() == Path(args.log).resolve():
        raise CanImmError(f"--out {args.out}: this is the log that is read")
    with ExitStack() as stack:
        source = stack.enter_context(LogSource(args.log))
        detection = build(args)
        stack.callback(detection.close)
        # last, because it replaces an existing file: what is wrong with the options has been said
        out = LogSink(args.out) if args.out else None
        if out is not None:
            stack.callback(out.close)
        clock = PacedClock() if args.realtime else FastClock()
        feed = LogFeed(source, clock, detection.health, OUTPUT_IDS)
        loop = Loop(feed, detection.node, detection.health, recorders=[out] if out else [])
        began = time.monotonic()
        _run(loop, source)
        took_s = time.monotonic() - began

    health = detection.health
    log_s = health.steps * 0.01
    speed = log_s / max(took_s, 1e-3)
    more = [
        (
            "lines",
            f"{source.bad_lines:,} bad, {source.dropped_frames:,} frames lost by the recorder",
        ),
        ("time", f"{log_s:,.1f} s of log in {took_s:.1f} s ({speed:,.0f} times)"),
    ]
    if feed.n_replaced:
        more.append(("replaced", f"{feed.n_replaced:,} manoeuvre frames of an earlier detector"))
    if health.late_frames or health.clock_jumps or health.skipped_steps:
        more.append(
            (
                "clock",
                f"{health.late_frames:,} frames out of order, {health.clock_jumps:,} jumps back, "
                f"{health.skipped_steps * 0.01:,.0f} s of silence skipped",
            )
        )
    if source.damage:
        more.append(("damage", source.damage))
    print_summary(summary_console(args), detection, args.log, more)
    if out is not None and out.damage:
        raise CanImmError(out.damage)
    return 0


def _run(loop: Loop, source: LogSource) -> None:
    """Step to the end of the log, with a progress bar on a terminal."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    bar = Progress(console=console, transient=True) if console.is_terminal else None
    with bar or nullcontext():
        task = bar.add_task("replay", total=1.0) if bar else None
        n = 0
        while loop.step():
            n += 1
            if bar and task is not None and n % REFRESH_STEPS == 0:
                bar.update(task, completed=source.progress() or 0.0)
