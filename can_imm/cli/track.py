"""Make objects of the detections of several sensors, on a bus or in a log.

  can-imm track cooperative -i udp_multicast        until Ctrl-C; objects go out as frames
  can-imm track roadside drive.log --out objects.log
  can-imm track cooperative drive.log --csv objects.csv --update union

cooperative: vehicles with radars around one object, a Bernoulli particle filter.  roadside: lidars
beside a road, an IMM of unscented Kalman filters.  The detector reads the objects as it does a
radar's: 'can-imm detect --profile tracking', 'can-imm replay --profile tracking'.
"""

from __future__ import annotations

import argparse
import gc
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from can_imm.cli.bus_options import add_bus_arguments, bus_name, bus_wanted, open_bus_from
from can_imm.cli.detection import positive_int

if TYPE_CHECKING:
    from can_imm.runtime.health import Health
    from can_imm.runtime.tracking import TrackerNode
    from can_imm.trackers import Tracker
    from can_imm.types import Scan

SYSTEMS = ("cooperative", "roadside")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("system", choices=SYSTEMS, metavar="SYSTEM", help=" or ".join(SYSTEMS))
    parser.add_argument("input", nargs="?", metavar="LOG", help="a log file; without one, a bus")
    parser.add_argument(
        "--out",
        metavar="LOG",
        help="write all frames, read and sent; its ending chooses the format",
    )
    parser.add_argument("--csv", metavar="FILE", help="write one row per object and scan")
    parser.add_argument(
        "--particles",
        type=positive_int,
        metavar="N",
        help="cooperative: N_p, 6 N_p in all with those that are born (default: 1000)",
    )
    parser.add_argument(
        "--update",
        choices=("product", "union"),
        help="cooperative: over the sensors (default), or the published one over the union of "
        "their detections",
    )
    parser.add_argument(
        "--ego", type=int, metavar="ID", help="cooperative: the observing vehicle's sensor (0)"
    )
    parser.add_argument("--seed", type=int, metavar="N", help="cooperative: of the particles (0)")
    parser.add_argument(
        "--duration", type=float, metavar="S", help="on a bus: stop after so many seconds"
    )
    add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    from can_imm.types import CanImmError

    if args.system != "cooperative":
        for option in ("particles", "update", "ego", "seed"):
            if getattr(args, option) is not None:
                raise CanImmError(f"--{option} is an option of the cooperative tracker")
    if args.ego is not None and not 0 <= args.ego <= 14:
        raise CanImmError(f"--ego must be a sensor id, 0 to 14, not {args.ego}")
    if args.seed is not None and args.seed < 0:
        raise CanImmError(f"--seed must be 0 or more, not {args.seed}")
    if args.input is None:
        return _on_bus(args)
    if bus_wanted(args) or args.duration is not None:
        raise CanImmError(f"{args.input}: bus options and --duration do not go with a log")
    return _on_log(args)


def build_tracker(args: argparse.Namespace) -> Tracker:
    """Build the tracker that the options ask for."""
    if args.system == "roadside":
        from can_imm.trackers.roadside import RoadsideTracker

        return RoadsideTracker()
    from can_imm.estimation.bernoulli import BernoulliModel
    from can_imm.trackers.cooperative import CooperativeTracker

    return CooperativeTracker(
        BernoulliModel(union=args.update == "union"),
        ego=args.ego or 0,
        particles=args.particles or 1000,
        seed=args.seed or 0,
    )


def _build(args: argparse.Namespace, stack: ExitStack) -> TrackerNode:
    from can_imm.cli.compiling import announced

    with announced():
        from can_imm.bus.detections import DetectionDecoder, TrackedEncoder
        from can_imm.runtime.tracking import TrackerNode

        csv = None
        if args.csv:
            csv = ObjectCsv(args.csv)
            stack.callback(csv.close)
        tracker = build_tracker(args)
        return TrackerNode(DetectionDecoder(), tracker, TrackedEncoder(), [csv] if csv else [])


class ObjectCsv:
    """Writes the tracker's objects, one row per object and scan."""

    def __init__(self, path: str) -> None:
        self._file = Path(path).open("w", encoding="ascii", newline="\n")  # noqa: SIM115
        self._file.write("time_s,object_id,existence,x,vx,y,vy\n")

    def __call__(self, t_ns: int, scan: Scan) -> None:
        from can_imm.cli.reports import seconds

        for k in range(scan.n):
            states = ",".join(f"{value:.4f}" for value in scan.z[k])
            self._file.write(
                f"{seconds(scan.t_ns)},{scan.ids[k]},{scan.existence[k]:.4f},{states}\n"
            )

    def close(self) -> None:
        self._file.close()


def _on_log(args: argparse.Namespace) -> int:
    from can_imm.bus.detections import TRACKED_IDS
    from can_imm.bus.sinks import LogSink
    from can_imm.bus.sources import LogSource
    from can_imm.runtime.clock import FastClock
    from can_imm.runtime.feeds import LogFeed
    from can_imm.runtime.health import Health
    from can_imm.runtime.loop import Loop
    from can_imm.runtime.loop import run as run_loops
    from can_imm.types import CanImmError

    for option in ("out", "csv"):
        path = getattr(args, option)
        if path and Path(path).resolve() == Path(args.input).resolve():
            raise CanImmError(f"--{option} {path}: this is the log that is read")
    with ExitStack() as stack:
        source = stack.enter_context(LogSource(args.input))
        node, health = _build(args, stack), Health()
        # last, because it replaces an existing file: what is wrong with the options has been said
        out = LogSink(args.out) if args.out else None
        if out is not None:
            stack.callback(out.close)
        feed = LogFeed(source, FastClock(), health, TRACKED_IDS)
        run_loops([Loop(feed, node, health, recorders=[out] if out else [])])
    more = []
    if source.bad_lines or source.dropped_frames:
        more.append(f"log: {source.bad_lines:,} bad lines, {source.dropped_frames:,} frames lost")
    if feed.n_replaced:
        more.append(f"replaced: {feed.n_replaced:,} frames of an earlier tracker")
    if source.damage:
        more.append(source.damage)
    _summary(f"{args.system}, {args.input}", node, health, more)
    if out is not None and out.damage:
        raise CanImmError(out.damage)
    return 0


def _on_bus(args: argparse.Namespace) -> int:
    from can_imm.bus.overflow import QueueWatch
    from can_imm.bus.sinks import BusSink, LogSink
    from can_imm.bus.sources import BusGone, BusSource
    from can_imm.cli.detect import Trouble, until_told
    from can_imm.runtime.clock import WallClock
    from can_imm.runtime.echo import EchoFilter
    from can_imm.runtime.feeds import BusFeed
    from can_imm.runtime.health import Health
    from can_imm.runtime.loop import Loop
    from can_imm.runtime.loop import run as run_loops
    from can_imm.types import CanImmError

    with ExitStack() as stack:
        bus = stack.enter_context(open_bus_from(args))
        source, sink, health = BusSource(bus), BusSink(bus), Health()
        node = _build(args, stack)
        out = LogSink(args.out) if args.out else None
        if out is not None:
            stack.callback(out.close)
        # What came while the tracker was made ready is old.
        while source.recv(0.0) is not None:
            pass
        queue = QueueWatch(bus)
        stack.callback(queue.close)
        own = EchoFilter(source, sink, health)
        feed = BusFeed(own, WallClock(), health)
        loop = Loop(feed, node, health, [own], [out] if out else [])
        trouble = Trouble(health, source, sink, queue)
        stop = until_told(args.duration, health)
        gc.collect()
        gc.freeze()
        print(
            f"can-imm: tracking on {bus_name(args, bus)}; Ctrl-C ends it",
            file=sys.stderr,
            flush=True,
        )
        gone = None
        try:
            run_loops([loop], stop=lambda: trouble.check() or stop())
        except BusGone as error:
            gone = error
        finally:
            gc.unfreeze()
    response = health.response
    more = [
        f"steps: {health.steps:,}, {health.deadline_misses:,} deadlines missed, "
        f"{health.late_frames:,} late frames",
        f"response: half within {response.quantile_ns(0.5) / 1e6:.2f} ms, 99 % within "
        f"{response.quantile_ns(0.99) / 1e6:.2f} ms",
    ]
    _summary(f"{args.system}, {bus_name(args, bus)}", node, health, more)
    if gone is not None:
        raise gone
    if out is not None and out.damage:
        raise CanImmError(out.damage)
    return 0


def _summary(title: str, node: TrackerNode, health: Health, more: list[str]) -> None:
    read, found = node.decoder.counts, node.tracker.counts
    print(f"can-imm track {title}")
    print(
        f"  frames: {health.frames:,} read, {read.used:,} used, {read.unknown:,} unknown, "
        f"{read.rejected:,} rejected ({read.bad_crc:,} wrong checksum, {read.out_of_range:,} "
        f"impossible value), {health.sent:,} sent"
    )
    print(
        f"  scans: {read.scans:,} of {read.parts / max(read.scans, 1):.1f} sensors, "
        f"{found.scans:,} used, {node.dropped_scans + found.late_scans:,} not; sensors: "
        f"{read.late_parts + found.late_sensors:,} late, "
        f"{read.repeated_parts + found.repeated_sensors:,} repeated, "
        f"{read.incomplete_parts:,} incomplete"
    )
    print(
        f"  detections: {found.detections:,} used, {found.invalid:,} impossible; objects: "
        f"{found.births:,} appeared, {found.deaths:,} disappeared"
    )
    for line in more:
        print(f"  {line}")
