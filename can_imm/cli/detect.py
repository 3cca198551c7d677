"""Listen on a bus and answer with manoeuvre frames, until Ctrl-C or SIGTERM.

  can-imm detect -i udp_multicast                      with 'can-imm simulate' in another terminal
  can-imm detect -i socketcan -c can0 --log drive.blf  and record everything
  can-imm detect -i socketcan -c can0 --profile toyota --csv drive.csv
  can-imm detect -i socketcan -c can0 --lag 0.5        better answers, half a second later

A line on standard error says when it listens; another tells of trouble on the bus (link down,
frames lost by the kernel).  Bus settings that are not given come from python-can's configuration
files.  Ending it by Ctrl-C or SIGTERM is its normal end: totals are printed, the status is 0.
"""

from __future__ import annotations

import argparse
import gc
import signal
import sys
from contextlib import ExitStack
from types import FrameType
from typing import TYPE_CHECKING

from can_imm.cli.bus_options import add_bus_arguments, bus_name, open_bus_from
from can_imm.cli.detection import (
    Equipment,
    add_detector_arguments,
    check_detector_arguments,
    print_summary,
    summary_console,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from can_imm.bus.overflow import QueueWatch
    from can_imm.bus.sinks import BusSink
    from can_imm.bus.sources import BusSource
    from can_imm.runtime.health import Health

NAME = "can-imm detect"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_detector_arguments(parser)
    parser.add_argument(
        "--log",
        metavar="FILE",
        help="record all frames, received and sent; its ending chooses the format",
    )
    parser.add_argument(
        "--duration", type=float, metavar="S", help="stop by itself after so many seconds"
    )
    parser.add_argument(
        "--realtime",
        action="store_true",
        help="ask for SCHED_FIFO, a core of its own and locked memory, and say what was granted",
    )
    add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    from can_imm.bus.overflow import QueueWatch
    from can_imm.bus.sinks import BusSink, LogSink
    from can_imm.bus.sources import BusGone, BusSource
    from can_imm.runtime import realtime
    from can_imm.runtime.clock import WallClock
    from can_imm.runtime.echo import EchoFilter
    from can_imm.runtime.feeds import BusFeed
    from can_imm.runtime.loop import Loop
    from can_imm.runtime.loop import run as run_loops
    from can_imm.types import CanImmError

    check_detector_arguments(args)
    with ExitStack() as stack:
        bus = stack.enter_context(open_bus_from(args))
        source, sink = BusSource(bus), BusSink(bus)
        equipment = Equipment(args)
        stack.callback(equipment.close)
        detection = equipment.detection(NAME)
        # last, because it replaces an existing file: what is wrong with the options has been said
        log = LogSink(args.log) if args.log else None
        if log is not None:
            stack.callback(log.close)
        health = detection.health
        # What came while the estimators were made ready is old.
        while source.recv(0.0) is not None:
            pass
        queue = QueueWatch(bus)
        stack.callback(queue.close)
        own = EchoFilter(source, sink, health)
        clock = WallClock()
        feed = BusFeed(own, clock, health)
        loop = Loop(feed, detection.node, health, [own], [log] if log else [])
        trouble = Trouble(health, source, sink, queue)
        stop = until_told(args.duration, health)

        # What exists now stays; a full collection would stop the loop for tens of milliseconds.
        if args.realtime:
            realtime.ask_process()
            realtime.ask_thread()
            # for days on end; what is frozen is not looked at, so it takes microseconds
            gc.enable()
            _say(f"granted: {realtime.in_words(realtime.granted())}")
        else:
            gc.collect()
            gc.freeze()
        _say(f"listening on {bus_name(args, bus)}; Ctrl-C ends it")
        gone = None
        try:
            run_loops([loop], stop=lambda: trouble.check() or stop())
            loop.send_last(detection.node.farewell)
        except BusGone as error:
            gone = error
        finally:
            gc.unfreeze()
        dropped = queue.drops()
        detection.finish()
        equipment.keep_events(NAME, detection)

    response = health.response
    more = [
        ("sent", f"{health.sent:,} frames, {sink.lost:,} not sent"),
        ("lost", f"{dropped:,} frames at a full receive queue, {source.errors:,} failed reads"),
        (
            "steps",
            f"{health.steps:,}, {health.deadline_misses:,} deadlines missed, "
            f"{health.late_frames:,} late frames, {health.clock_jumps + clock.jumps:,} clock jumps",
        ),
        (
            "response",
            f"half within {response.quantile_ns(0.5) / 1e6:.2f} ms, 99 % within "
            f"{response.quantile_ns(0.99) / 1e6:.2f} ms, worst {response.max_ns / 1e6:.2f} ms",
        ),
    ]
    print_summary(summary_console(args), detection, NAME, more)
    if gone is not None:
        raise gone
    if log is not None and log.damage:
        raise CanImmError(log.damage)
    return 0


class Trouble:
    """Says once on standard error what goes wrong on the bus, and when it is over."""

    EVERY_STEPS = 100

    def __init__(self, health: Health, source: BusSource, sink: BusSink, queue: QueueWatch) -> None:
        self._health = health
        self._source = source
        self._sink = sink
        self._queue = queue
        self._next_step = 0
        self._failures = 0
        self._drops = 0
        self._down = False

    def check(self) -> bool:
        """Look after the bus once a second; always False, so that it can stand in a stop test."""
        if self._health.steps < self._next_step:
            return False
        self._next_step = self._health.steps + self.EVERY_STEPS
        failures = self._source.errors + self._sink.lost
        if (failures > self._failures) != self._down:
            self._down = not self._down
            _say("bus: reading or sending fails (link down?), waiting for it" if self._down
                 else "bus: works again")  # fmt: skip
        self._failures = failures
        drops = self._queue.drops()
        if drops > self._drops:
            _say(f"bus: {drops - self._drops} frames lost, the receive queue was full")
        self._drops = drops
        return False


def until_told(duration_s: float | None, health: Health) -> Callable[[], bool]:
    """Return a test whether to stop: by SIGINT, SIGTERM or the time that was given."""
    told = False

    def tell(number: int, frame: FrameType | None) -> None:
        nonlocal told
        if told:  # it does not listen: the hard way
            raise KeyboardInterrupt
        told = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, tell)
    last_step = None if duration_s is None else round(duration_s * 100)
    return lambda: told or (last_step is not None and health.steps >= last_step)


def _say(text: str) -> None:
    print(f"can-imm: {text}", file=sys.stderr, flush=True)
