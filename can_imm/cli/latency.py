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
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from can_imm.cli.bus_options import add_bus_arguments, bus_name, bus_wanted, open_bus_from
from can_imm.cli.compiling import announced
from can_imm.cli.detection import positive_int

if TYPE_CHECKING:
    from collections.abc import Callable

    import can

    from can_imm.runtime.health import Health
    from can_imm.runtime.latency import Probe, Rounds
    from can_imm.types import Scan

CHANNEL = "can-imm-latency"

COMPARED = ("processing", "response", "work")
"""Stages that are set beside the echo."""

WARM_UP_ROUNDS = 10
"""Rounds before those that count."""


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
    with ExitStack() as stack:
        buses = [stack.enter_context(_open(args)) for _ in range(3)]
        name = bus_name(args, buses[0])
        with announced():
            measurement = _Measurement(args, buses)
        measurement.run()
    figures = measurement.figures()
    _print(name, figures)
    if args.json:
        Path(args.json).write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    if args.plot:
        from can_imm.plots.latency import latency_figure

        rounds = measurement.rounds
        latency_figure(Path(args.plot), {**rounds.stages, "echo": rounds.echo})
    return 0


def _open(args: argparse.Namespace) -> can.BusABC:
    if bus_wanted(args):
        return open_bus_from(args)
    from can_imm.bus.buses import open_bus

    return open_bus("virtual", CHANNEL)


class _Measurement:
    """A sender in this thread, a detector and an echo node in two others, each on its own bus."""

    def __init__(self, args: argparse.Namespace, buses: list[can.BusABC]) -> None:
        from can_imm.bus.decoder import ScanDecoder
        from can_imm.bus.encoder import ManoeuvreEncoder, RadarEncoder
        from can_imm.bus.profile import load_profile
        from can_imm.bus.sinks import BusSink
        from can_imm.bus.sources import BusSource
        from can_imm.detector import Detector
        from can_imm.manoeuvres import load_bank
        from can_imm.runtime.clock import WallClock
        from can_imm.runtime.echo import EchoFilter
        from can_imm.runtime.feeds import BusFeed
        from can_imm.runtime.health import Health
        from can_imm.runtime.latency import Probe, Rounds
        from can_imm.runtime.loop import Loop
        from can_imm.runtime.nodes import DetectorNode

        self._duration_s: float = args.duration
        self._realtime: bool = args.realtime
        self._objects: int = args.objects
        self._encoder = RadarEncoder()
        own, theirs, self._echo_bus = buses
        self.health: Health = Health()
        clock = WallClock()
        decoder = ScanDecoder(load_profile("can_imm"))
        detector = Detector(load_bank(args.preset))
        ends = EchoFilter(BusSource(theirs), BusSink(theirs), self.health)
        # the feed needs the probe's source, the probe the feed's guard
        guard_ns = BusFeed(ends, clock, self.health).guard_ns
        self.probe: Probe = Probe(clock, guard_ns, decoder.ids)
        feed = BusFeed(self.probe.source(ends), clock, self.health, guard_ns)
        node = DetectorNode(decoder, self.probe.detector(detector), ManoeuvreEncoder(), self.health)
        self._loop = Loop(feed, self.probe.node(node), self.health, [self.probe.sink(ends)])
        self.rounds: Rounds = Rounds(BusSource(own), BusSink(own), self.probe)
        self._done = threading.Event()
        self._failure: BaseException | None = None
        self._granted: dict[str, Any] = {}
        self._memory: list[int] = []
        self._before = 0, 0

    def run(self) -> None:
        """Measure until the time is over."""
        import numpy as np

        from can_imm.bus.echo import answer_echoes
        from can_imm.runtime import realtime
        from can_imm.types import Scan

        if self._realtime:
            realtime.ask_process()
        threads = [
            self._thread(self._step_forever),
            self._thread(lambda: self._until_done(lambda: answer_echoes(self._echo_bus, 0.1))),
        ]
        rng = np.random.default_rng(0)
        scan = Scan(self._objects)
        scan.n = self._objects
        scan.ids[:] = range(self._objects)
        scan.valid[:] = True
        scan.z[:] = [40.0, 0.0, 0.0, 0.0]
        self._warm_up(scan)
        began = time.monotonic()
        sample_s = self._duration_s / 20
        try:
            while (now := time.monotonic() - began) < self._duration_s and self._failure is None:
                # at any phase of the step
                time.sleep(0.01 + 0.01 * rng.random())
                frames = self._encoder.encode(scan, time.time_ns() // 1000 * 1000)
                self.rounds.scan(frames, 2 * self._objects)
                self.rounds.bounce()
                if now >= len(self._memory) * sample_s:
                    self._memory.append(realtime.resident_kib())
        finally:
            self._done.set()
            for thread in threads:
                thread.join()
        self._memory.append(realtime.resident_kib())
        if self._failure is not None:
            raise self._failure

    def _warm_up(self, scan: Scan) -> None:
        """Let everything happen once, threads and tracks begin; then count from zero."""
        for _ in range(WARM_UP_ROUNDS):
            frames = self._encoder.encode(scan, time.time_ns() // 1000 * 1000)
            self.rounds.scan(frames, 2 * self._objects)
            self.rounds.bounce()
        self.rounds.reset()
        self.probe.lateness.reset()
        self._before = self.health.steps, self.health.deadline_misses

    def figures(self) -> dict[str, Any]:
        """As in the JSON file."""
        rounds, health = self.rounds, self.health
        echo = rounds.echo.summary()
        stages = {name: histogram.summary() for name, histogram in rounds.stages.items()}

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
            "lateness": self.probe.lateness.summary(),
            "deadline": {
                "steps": health.steps - self._before[0],
                "missed": health.deadline_misses - self._before[1],
            },
            "rounds": {"answered": rounds.stages["end_to_end"].n, "lost": rounds.lost},
            "memory_kib": self._memory,
            "granted": self._granted,
        }

    def _step_forever(self) -> None:
        from can_imm.runtime import realtime

        if self._realtime:
            realtime.ask_thread()
        self._granted = realtime.granted()
        self._until_done(self._loop.step)

    def _until_done(self, work: Callable[[], object]) -> None:
        try:
            while not self._done.is_set():
                work()
        except BaseException as error:  # the main thread raises it
            self._failure = error

    @staticmethod
    def _thread(target: Callable[[], None]) -> threading.Thread:
        thread = threading.Thread(target=target, daemon=True)
        thread.start()
        return thread


def _print(name: str, figures: dict[str, Any]) -> None:
    from rich.console import Console

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
    granted = ", ".join(
        f"{key.replace('_', ' ')} {value}" for key, value in figures["granted"].items()
    )
    console.print(f"  [dim]granted: {granted}[/]")
