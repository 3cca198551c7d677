"""Play a scenario as radar frames onto a bus and/or into a log file.

  can-imm simulate -i udp_multicast                    the published scenario, in real time
  can-imm simulate -i socketcan -c vcan0 --scenario random --seed 7
  can-imm simulate --log drive.log --truth drive.csv   as fast as possible, no bus
  can-imm simulate --scenario mine.toml --log mine.blf
  can-imm simulate --scenario motorway --profile ars408 --log drive.log --truth drive.csv
  can-imm simulate --scenario cooperative -i udp_multicast     detections, for 'can-imm track'

A bus is used when a bus option is given, or when there is no file to write; it plays in real time.
Bus settings that are not given come from python-can's configuration files.  The times in the
truth file are those of the frames: seconds from 0 without a bus, Unix time on a bus.
"""

from __future__ import annotations

import argparse
import csv
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from can_imm.cli.bus_options import add_bus_arguments, bus_name, bus_wanted, open_bus_from

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from can_imm.cli.simulate_motorway import Moment
    from can_imm.runtime.nodes import SenderNode
    from can_imm.sim.scene import SceneRun
    from can_imm.sim.truth import Truth
    from can_imm.types import DetectionScan, Scan

LEAD_NS = 500_000_000
"""On a bus the scenario starts this long [ns] after the command is ready to send."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--scenario",
        default="paper-a",
        metavar="NAME|FILE|random|motorway",
        help="paper-a (default), paper-b, paper-s, random, or a TOML file; motorway: random "
        "traffic around the vehicle; cooperative, roadside or the TOML file of such a scene: "
        "detections of several sensors",
    )
    parser.add_argument(
        "--profile",
        default="can_imm",
        metavar="NAME",
        help="the motorway's radar: can_imm (default), ars408, esr, toyota, toyota-tss2",
    )
    parser.add_argument(
        "--settings",
        default="tuning",
        metavar="NAME",
        help="ranges from which the motorway's traffic is drawn: tuning (default) or reporting",
    )
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="of noise and random scenario (default: 0)"
    )
    parser.add_argument(
        "--missed",
        type=float,
        metavar="P",
        help="probability that an object is missing from a scan (default: 0; "
        "on the motorway the radar's own)",
    )
    parser.add_argument(
        "--dropout",
        type=float,
        metavar="P",
        help="probability that a whole scan is missing (default: 0; on the "
        "motorway the radar's own)",
    )
    parser.add_argument(
        "--log", metavar="FILE", help="write the frames to a log; its ending chooses the format"
    )
    parser.add_argument("--truth", metavar="FILE.csv", help="write what truly happens, every 10 ms")
    add_bus_arguments(parser)


def run(args: argparse.Namespace) -> int:
    import numpy as np

    from can_imm.bus.detections import DetectionEncoder
    from can_imm.bus.encoder import RadarEncoder
    from can_imm.bus.sinks import BusSink, LogSink
    from can_imm.runtime.clock import Clock, FastClock, WallClock
    from can_imm.runtime.feeds import IdleFeed
    from can_imm.runtime.health import Health
    from can_imm.runtime.loop import STEP_NS, Loop
    from can_imm.runtime.loop import run as run_loops
    from can_imm.runtime.nodes import SenderNode
    from can_imm.sim.player import Player
    from can_imm.sim.random import random_scenario
    from can_imm.sim.scenario import load_scenario
    from can_imm.sim.scene import scene_kind
    from can_imm.sim.sensor import SensorModel, measure
    from can_imm.sim.truth import simulate
    from can_imm.types import CanImmError

    if args.seed < 0:
        raise CanImmError(f"--seed must be 0 or more, not {args.seed}")
    rng = np.random.default_rng(args.seed)
    kind = scene_kind(args.scenario)
    played = None
    truths: list[Truth] = []
    motorway = None
    sender: SenderNode[Scan] | SenderNode[DetectionScan] | SenderNode[Moment]
    if args.scenario != "motorway" and args.profile != "can_imm":
        raise CanImmError("--profile: only the motorway is played for other radars")
    if args.scenario == "motorway":
        from can_imm.cli.simulate_motorway import play_motorway

        motorway = play_motorway(rng, args.settings, args.profile, args.missed, args.dropout)
    elif kind is not None:
        if args.missed or args.dropout:
            raise CanImmError("--missed and --dropout: a scene's own table says this")
        played = play(kind, args.scenario, rng)
    else:
        random = args.scenario == "random"
        truths = simulate(random_scenario(rng) if random else load_scenario(args.scenario))
        sensor = SensorModel(missed=args.missed or 0.0, dropout=args.dropout or 0.0)
        scans = measure(truths, sensor, rng)

    with ExitStack() as stack:
        outputs = []
        clock: Clock = FastClock()
        if bus_wanted(args) or not (args.log or args.truth):
            bus = stack.enter_context(open_bus_from(args))
            outputs.append(BusSink(bus))
            clock = WallClock()
            start_ns = -(-(clock.now_ns() + LEAD_NS) // STEP_NS) * STEP_NS
            where = f"on {bus_name(args, bus)}"
        else:
            start_ns = 0
            where = f"into {args.log or args.truth}"
        log = LogSink(args.log) if args.log else None
        if log is not None:
            stack.callback(log.close)
        health = Health()
        if motorway is not None:
            from can_imm.cli.simulate_motorway import write_motorway_truth

            if args.truth:
                write_motorway_truth(args.truth, motorway.truth, start_ns)
            moments = Player(motorway.moments, start_ns)
            done, sender = lambda: moments.done, SenderNode(moments, motorway.encoder)
            what = f"{len(motorway.truth.objects)} objects, {motorway.n_scans} scans"
        elif played is not None:
            if args.truth:
                write_scene_truth(args.truth, played, start_ns)
            detections = Player(played.scans, start_ns)
            done, sender = lambda: detections.done, SenderNode(detections, DetectionEncoder())
            what = f"{len(played.scans)} scans of several sensors"
        else:
            if args.truth:
                write_truth(args.truth, truths, start_ns)
            player = Player(scans, start_ns)
            done, sender = lambda: player.done, SenderNode(player, RadarEncoder())
            what = f"{len(truths)} objects, {len(scans)} scans"
        loop = Loop(IdleFeed(clock), sender, health, outputs, [log] if log else [])
        _say(f"playing {args.scenario} {where}: {what}")
        run_loops([loop], stop=done)
    if log is not None and log.damage:
        raise CanImmError(log.damage)
    _say(f"sent {health.sent:,} frames, {health.deadline_misses:,} deadlines missed")
    return 0


def play(kind: str, name_or_path: str, rng: np.random.Generator) -> SceneRun:
    """Play a scene of several sensors."""
    if kind == "cooperative":
        from can_imm.sim import cooperative

        return cooperative.play_scene(cooperative.load_scene(name_or_path), rng)
    from can_imm.sim import roadside

    return roadside.play_scene(roadside.load_scene(name_or_path), rng)


def write_scene_truth(path: str, played: SceneRun, start_ns: int) -> None:
    """Write one row per scan of a scene with one object, while it is there."""
    from can_imm.cli.reports import STATES, seconds

    with Path(path).open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["time_s", *STATES])
        for t_ns, state in zip(played.t_ns.tolist(), played.state.tolist(), strict=True):
            if all(value == value for value in state):
                writer.writerow([seconds(start_ns + t_ns), *(f"{value:.4f}" for value in state)])


def write_truth(path: str, truths: Sequence[Truth], start_ns: int) -> None:
    """Write one row per object and 10 ms; ``start_ns`` is the bus time of the scenario's time 0."""
    from can_imm.cli.reports import DIRECTION, STATES, seconds
    from can_imm.types import Manoeuvre

    with Path(path).open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["time_s", "object_id", "manoeuvre", "lane", "direction", *STATES])
        for truth in truths:
            for t_ns, label, lane, direction, state in zip(
                truth.t_ns, truth.label, truth.lane, truth.direction, truth.state, strict=True
            ):
                writer.writerow(
                    [
                        seconds(start_ns + int(t_ns)),
                        truth.object_id,
                        Manoeuvre(label).name,
                        lane,
                        DIRECTION[int(direction)],
                        *(f"{value:.4f}" for value in state),
                    ]
                )


def _say(text: str) -> None:
    print(f"can-imm: {text}", file=sys.stderr, flush=True)
