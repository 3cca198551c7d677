"""Measure how long the answer to a scan takes on a bus, stage by stage.

  can-imm latency                                  on a virtual bus inside this process
  can-imm latency -i socketcan -c vcan0            on any other bus
  can-imm latency --realtime --duration 600        ask for real-time scheduling, for ten minutes
  can-imm latency --json latency.json --plot latency.png

Sends scans, waits for their manoeuvre frames, and bounces frames off a bare echo node on the same
bus in between: the floor.  'processing' (the last frame of a scan read to the last frame of its
answer handed over) and 'response' (the whole way) are less the wait for the next fixed step, and to
be compared with the echo; 'work' is all that the node does, in that wait or after it.
"""

from __future__ import annotations

import argparse
import json
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from can_imm.cli.bus_options import add_bus_arguments, bus_name, bus_wanted, open_bus_from
from can_imm.cli.compiling import announced
from can_imm.cli.detection import positive_int

if TYPE_CHECKING:
    import can

    from can_imm.cli.latency_parties import Measured, Subject

CHANNEL = "can-imm-latency"

COMPARED = ("processing", "response", "work")
"""Stages that are set beside the echo."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--duration", type=float, default=10.0, metavar="S", help="how long (default: 10)")
    add(
        "--objects",
        type=positive_int,
        default=1,
        metavar="N",
        help="objects in a scan (default: 1)",
    )
    add("--preset", default="two-lane", metavar="NAME|FILE", help="the mode bank")
    add("--realtime", action="store_true",
        help="ask for SCHED_FIFO, a core, locked memory and a frozen collector")  # fmt: skip
    add("--json", metavar="FILE", help="write the figures to this file")
    add("--plot", metavar="FILE", help="draw the distributions to this PNG file")
    add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    from can_imm.types import CanImmError

    if not args.duration > 0:
        raise CanImmError(f"--duration {args.duration:g}: must be above 0")
    if args.objects > 64:
        raise CanImmError(f"--objects {args.objects}: the sensor's messages have room for 64")
    from can_imm.bus.buses import in_one_process
    from can_imm.cli.latency_parties import Subject, measure_in_processes, measure_in_threads
    from can_imm.detector import Detector
    from can_imm.manoeuvres import load_bank
    from can_imm.runtime import realtime

    with ExitStack() as stack:
        bus = stack.enter_context(_open(args))
        with announced():
            detector = Detector(load_bank(args.preset))
        subject = Subject(bus, detector, wants_realtime=args.realtime, duration_s=args.duration)
        if args.realtime:
            realtime.ask_process()
        stack.enter_context(subject.running())
        if not in_one_process(bus):
            measured = measure_in_processes(subject, args, args.objects, args.duration)
        else:
            peer_bus, echo_bus = (stack.enter_context(_open(args)) for _ in range(2))
            measured = measure_in_threads(subject, peer_bus, echo_bus, args.objects, args.duration)
    figures = _figures(subject, measured)
    _print(bus_name(args, bus), figures)
    if args.json:
        Path(args.json).write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    if args.plot:
        from can_imm.plots.latency import latency_figure

        latency_figure(Path(args.plot), {**measured.stages, "echo": measured.echo})
    return 0


def _open(args: argparse.Namespace) -> can.BusABC:
    if bus_wanted(args):
        return open_bus_from(args)
    from can_imm.bus.buses import open_bus

    return open_bus("virtual", CHANNEL)


def _figures(subject: Subject, measured: Measured) -> dict[str, Any]:
    """As in the JSON file."""
    echo = measured.echo.summary()
    stages = {name: histogram.summary() for name, histogram in measured.stages.items()}

    def ratio(stage: str, quantile: str) -> float:
        return stages[stage][quantile] / echo[quantile] if echo[quantile] else 0.0

    return {
        "stages": stages,
        "echo": echo,
        "ratios": {
            f"{stage}_{quantile}": ratio(stage, f"{quantile}_us")
            for stage in COMPARED
            for quantile in ("p50", "p99")
        },
        "lateness": subject.probe.lateness.summary(),
        "deadline": subject.deadline(),
        "rounds": {"answered": measured.stages["end_to_end"].n, "lost": measured.lost},
        "memory_kib": subject.memory_kib,
        "granted": subject.granted,
    }


def _print(name: str, figures: dict[str, Any]) -> None:
    from rich.console import Console

    from can_imm.runtime.realtime import in_words

    console = Console(highlight=False, soft_wrap=True)
    console.print(f"[bold]{name}[/]: {figures['rounds']['answered']:,} scans answered, "
                  f"{figures['rounds']['lost']:,} lost")  # fmt: skip
    console.print(f"  [dim]{'[us]':<12}{'p50':>9}{'p90':>9}{'p99':>9}{'p99.9':>9}{'max':>9}[/]")
    rows = {**figures["stages"], "echo": figures["echo"], "lateness": figures["lateness"]}
    for stage, values in rows.items():
        cells = "".join(f"{value:9.0f}" for value in values.values())
        console.print(f"  {stage.replace('_', ' '):<12}{cells}")
    ratios = figures["ratios"]
    compared = ", ".join(
        f"{stage} {ratios[f'{stage}_p50']:.2f} (p99 {ratios[f'{stage}_p99']:.2f})"
        for stage in COMPARED
    )
    console.print(f"  of the echo: {compared}")
    deadline, memory = figures["deadline"], figures["memory_kib"]
    console.print(f"  {deadline['steps']:,} steps, {deadline['missed']:,} deadlines missed; memory "
                  f"{memory[0]:,} KiB at first, {memory[-1]:,} KiB at last")  # fmt: skip
    console.print(f"  [dim]granted: {in_words(figures['granted'])}[/]")
