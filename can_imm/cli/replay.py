"""Run the detector over recorded logs, as fast as possible or in real time.

  can-imm replay drive.log                          what was in it, what happened
  can-imm replay drive.blf --csv drive.csv          one row per object and scan
  can-imm replay drive.log --plot drive.png         a picture of it
  can-imm replay drive.log --smooth --csv drive.csv labelled by hindsight, better than at the time
  can-imm replay a.log b.blf --events drives.json   the events of several recordings
  can-imm replay drive.asc.gz --out answers.log     input and manoeuvre frames in one log
  can-imm replay radar.log --profile toyota         another sensor

Reads .log .asc .blf .trc .mf4 .csv .db, the text formats also as .gz.  The loop is that of
'can-imm detect': the recording of a live run gives the same manoeuvre frames again.  Every log is a
recording of its own; one that cannot be read does not stop the others.
"""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from can_imm.cli.detection import (
    Equipment,
    add_detector_arguments,
    check_detector_arguments,
    print_summary,
    summary_console,
)

if TYPE_CHECKING:
    from can_imm.bus.sources import LogSource
    from can_imm.cli.detection import Detection
    from can_imm.plots.history import History
    from can_imm.runtime.feeds import LogFeed
    from can_imm.runtime.loop import Loop

REFRESH_STEPS = 100
PLOT_SUFFIXES = (".png", ".pdf", ".svg")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", metavar="LOG", nargs="+", help="the log file, or several")
    add_detector_arguments(parser)
    parser.add_argument(
        "--out",
        metavar="LOG",
        help="write input and manoeuvre frames to this log; its ending chooses the format",
    )
    parser.add_argument(
        "--plot",
        metavar="FILE|DIR",
        help="draw lateral position and gap over time, coloured by manoeuvre (.png, .pdf, .svg);"
        " of several logs DIR/<name of the log>.png",
    )
    parser.add_argument(
        "--smooth",
        action="store_true",
        help="CSV, events and picture by hindsight, from a smoother over each whole track;"
        " the frames of --out stay as they are",
    )
    parser.add_argument(
        "--realtime", action="store_true", help="at the speed at which it was recorded"
    )


def run(args: argparse.Namespace) -> int:
    from can_imm.bus.sources import LogSource
    from can_imm.types import CanImmError

    several = len(args.logs) > 1
    _check(args)
    equipment: Equipment | None = None
    status = 0
    with ExitStack() as stack:
        for name in args.logs:
            try:
                source = LogSource(name)
            except CanImmError as error:
                status = _complain(error)
                continue
            with source:
                if equipment is None:
                    # after a log was found, because it replaces files
                    equipment = Equipment(args, several=several)
                    stack.callback(equipment.close)
                try:
                    _replay(args, name, source, equipment)
                except CanImmError as error:
                    status = _complain(error)
    return status


def _check(args: argparse.Namespace) -> None:
    """Refuse what cannot work before anything is read or written."""
    from can_imm.types import CanImmError

    check_detector_arguments(args)
    several = len(args.logs) > 1
    if args.smooth and args.lag is not None:
        args.refuse("--smooth knows the whole recording, --lag a part of it: not both")
    if args.out and several:
        args.refuse(f"--out takes one log, not {len(args.logs)}")
    if args.out and Path(args.out).resolve() == Path(args.logs[0]).resolve():
        raise CanImmError(f"--out {args.out}: this is the log that is read")
    if args.plot and not Path(args.plot).is_dir():
        if several:
            args.refuse(f"--plot {args.plot}: with several logs this must be a directory")
        if Path(args.plot).suffix.lower() not in PLOT_SUFFIXES:
            raise CanImmError(f"--plot {args.plot}: must end in {', '.join(PLOT_SUFFIXES)}")
        if not Path(args.plot).parent.is_dir():
            raise CanImmError(f"--plot {args.plot}: no such directory")


def _complain(error: Exception) -> int:
    print(f"can-imm: error: {error}", file=sys.stderr, flush=True)
    return 1


def _replay(args: argparse.Namespace, name: str, source: LogSource, equipment: Equipment) -> None:
    """Run one log through a fresh detector, and say what was found."""
    from can_imm.bus.encoder import OUTPUT_IDS
    from can_imm.bus.sinks import LogSink
    from can_imm.plots.history import History
    from can_imm.runtime.clock import FastClock, PacedClock
    from can_imm.runtime.feeds import LogFeed
    from can_imm.runtime.loop import Loop
    from can_imm.types import CanImmError

    history = History() if args.plot else None
    detection = equipment.detection(name, history)
    with ExitStack() as stack:
        # last, because it replaces an existing file: what is wrong with the options has been said
        out = LogSink(args.out) if args.out else None
        if out is not None:
            stack.callback(out.close)
        clock = PacedClock() if args.realtime else FastClock()
        feed = LogFeed(source, clock, detection.health, OUTPUT_IDS)
        loop = Loop(feed, detection.node, detection.health, recorders=[out] if out else [])
        began = time.monotonic()
        _run(loop, source)
        loop.send_last(detection.node.remaining)
        took_s = time.monotonic() - began
    detection.finish()
    equipment.keep_events(name, detection)
    print_summary(summary_console(args), detection, name, _figures(source, feed, detection, took_s))
    if history is not None:
        path = Path(args.plot)
        if path.is_dir():
            path /= f"{Path(name).name}.png"
        _draw(path, name, history, detection, equipment)
    if out is not None and out.damage:
        raise CanImmError(out.damage)


def _figures(
    source: LogSource, feed: LogFeed, detection: Detection, took_s: float
) -> list[tuple[str, str]]:
    """Lines of the summary about the log and its time."""
    health = detection.health
    log_s = health.steps * 0.01
    speed = log_s / max(took_s, 1e-3)
    lines = [
        (
            "lines",
            f"{source.bad_lines:,} bad, {source.dropped_frames:,} frames lost by the recorder",
        ),
        ("time", f"{log_s:,.1f} s of log in {took_s:.1f} s ({speed:,.0f} times)"),
    ]
    if feed.n_replaced:
        lines.append(("replaced", f"{feed.n_replaced:,} manoeuvre frames of an earlier detector"))
    if health.late_frames or health.clock_jumps or health.skipped_steps:
        lines.append(
            (
                "clock",
                f"{health.late_frames:,} frames out of order, {health.clock_jumps:,} jumps back, "
                f"{health.skipped_steps * 0.01:,.0f} s of silence skipped",
            )
        )
    if source.damage:
        lines.append(("damage", source.damage))
    return lines


def _draw(
    path: Path, name: str, history: History, detection: Detection, equipment: Equipment
) -> None:
    from can_imm.plots.recording import draw_recording
    from can_imm.types import CanImmError

    data = history.recorded()
    if not len(data.rows):
        raise CanImmError(f"--plot {path}: no objects in {name}, nothing to draw")
    draw_recording(path, Path(name).name, data, detection.events.found, equipment.bank.lane_width)


def _run(loop: Loop, source: LogSource) -> None:
    """Step to the end of the log, with a progress bar on a terminal."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    bar = Progress(console=console, transient=True) if console.is_terminal else None
    with bar or nullcontext():
        task = bar.add_task(source.path.name, total=1.0) if bar else None
        n = 0
        while loop.step():
            n += 1
            if bar and task is not None and n % REFRESH_STEPS == 0:
                bar.update(task, completed=source.progress() or 0.0)
