"""The demonstration of a tracker: sensors, tracker and detector on one virtual bus."""

from __future__ import annotations

import uuid
from collections import Counter
from contextlib import ExitStack
from typing import TYPE_CHECKING

import numpy as np

from can_imm.bus.buses import open_bus
from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.detections import DETECTION_IDS, DetectionDecoder, DetectionEncoder, TrackedEncoder
from can_imm.bus.encoder import OUTPUT_IDS, ManoeuvreEncoder
from can_imm.bus.profile import load_profile
from can_imm.bus.sinks import BusSink
from can_imm.bus.sources import BusSource
from can_imm.cli.demo_run import START_NS, Timed, pacer
from can_imm.cli.simulate import play
from can_imm.detector import Detector
from can_imm.manoeuvres import load_bank
from can_imm.runtime.clock import FastClock
from can_imm.runtime.feeds import BusFeed
from can_imm.runtime.health import Health, LatencyLog
from can_imm.runtime.loop import STEP_NS, Loop
from can_imm.runtime.loop import run as run_loops
from can_imm.runtime.nodes import DetectorNode, Reports, SenderNode
from can_imm.runtime.tracking import TrackerNode
from can_imm.sim.player import Player
from can_imm.types import Manoeuvre, Scan, X, Y

if TYPE_CHECKING:
    from can_imm.bus.frame import Frame
    from can_imm.runtime.loop import Node
    from can_imm.trackers import Tracker

EVERY_NS = 1_000_000_000
"""A line is due after so long [ns], and whenever the manoeuvre changes."""


class TrackingDemo:
    """One scene, played through real frames; prints a line when there is something to say.

    Args:
        system: ``cooperative`` or ``roadside``.
        scene: name or file.
        preset: the detector's mode bank.
        seed: of noise and particles.

    Raises:
        CanImmError: a scene or preset that does not exist or is refused.
    """

    def __init__(self, system: str, scene: str, preset: str, seed: int) -> None:
        self._title = f"{system}, scene {scene}, seed {seed}, preset {preset}"
        self._played = play(system, scene, np.random.default_rng(seed))
        self.frames: Counter[str] = Counter()
        self.health = Health()
        self.tracker_work, self.detector_work = LatencyLog(), LatencyLog()
        self.tracker = TrackerNode(
            DetectionDecoder(), _tracker(system, seed), TrackedEncoder(), [self._tracked]
        )
        self.detector = DetectorNode(
            ScanDecoder(load_profile("tracking")),
            Detector(load_bank(preset), seed=seed),
            ManoeuvreEncoder(),
            self.health,
            [self._reported],
        )
        self._truth = dict(
            zip((self._played.t_ns + START_NS).tolist(), self._played.state, strict=True)
        )
        self.errors: list[float] = []
        self._object = ""
        self._said: int | None = None
        self._line_ns = 0

    def send(self, frame: Frame) -> None:
        """Hear a frame, as any other node on the bus would."""
        kind = "sensors" if frame.id in DETECTION_IDS else "tracker"
        self.frames["detector" if frame.id in OUTPUT_IDS else kind] += 1

    def play(self, rate: float | None) -> None:
        """Run to the end, ``rate`` times as fast as real time; None is as fast as possible."""
        print(f"can-imm demo: {self._title}")
        print("    time       x       y  existence   error  manoeuvre     probability", flush=True)
        channel = uuid.uuid4().hex  # nobody else's, whatever runs in this process
        clock = FastClock()
        sender = SenderNode(Player(self._played.scans, START_NS), DetectionEncoder())
        nodes: list[tuple[Node, Health]] = [
            (sender, Health()),
            (Timed(self.tracker, self.tracker_work), Health()),
            (Timed(self.detector, self.detector_work), self.health),
        ]
        with ExitStack() as stack:
            loops: list[Loop] = []
            for node, health in nodes:
                bus = stack.enter_context(
                    open_bus("virtual", channel, preserve_timestamps=True, ignore_config=True)
                )
                # the sender's side hears everything on the bus
                recorders = [] if loops else [self]
                feed = BusFeed(BusSource(bus), clock, health)
                loops.append(Loop(feed, node, health, [BusSink(bus)], recorders))
            steps = (START_NS + self._played.scans[-1].t_ns) // STEP_NS + 5
            pace = pacer(rate)
            run_loops(loops, stop=lambda: nodes[0][1].steps >= steps or pace())

    def summary(self) -> None:
        """Print how the run went so far."""
        counts = self.tracker.tracker.counts
        print(f"\n{len(self._played.scans)} scans, {counts.detections:,} detections used")
        if self.errors:
            rms = float(np.sqrt(np.mean(np.square(self.errors))))
            print(f"position of the object: RMS error {rms:.3f} m over {len(self.errors)} scans")
        sent = ", ".join(f"{n:,} of the {name}" for name, n in self.frames.items())
        rejected = self.tracker.decoder.counts.rejected + self.detector.decoder.counts.rejected
        print(f"frames: {sent}; {rejected} rejected")
        for name, log in (("tracker", self.tracker_work), ("detector", self.detector_work)):
            print(
                f"{name}: 99 % of its steps with frames within {log.quantile_ns(0.99) / 1e6:.2f} ms"
            )

    def _tracked(self, t_ns: int, scan: Scan) -> None:
        """The tracker's answer; the detector's follows in the same step."""
        self._object = "no object"
        if not scan.n:
            return
        truth = self._truth.get(scan.t_ns)
        text = "    -"
        if truth is not None and np.isfinite(truth).all():
            error = float(np.hypot(scan.z[0, X] - truth[X], scan.z[0, Y] - truth[Y]))
            self.errors.append(error)
            text = f"{error:5.2f}"
        x, _, y, _ = scan.z[0]
        self._object = f"{x:6.2f}m {y:6.2f}m  {scan.existence[0]:9.3f}  {text}m"

    def _reported(self, t_ns: int, reports: Reports) -> None:
        if not len(reports):
            return
        said = int(reports["manoeuvre"][0])
        if said == self._said and t_ns - self._line_ns < EVERY_NS:
            return
        self._said, self._line_ns = said, t_ns
        name, p = Manoeuvre(said).name, float(reports["probability"][0])
        print(f"{(t_ns - START_NS) * 1e-9:7.1f}s {self._object}  {name:12}  {p:11.3f}", flush=True)


def _tracker(system: str, seed: int) -> Tracker:
    if system == "cooperative":
        from can_imm.trackers.cooperative import CooperativeTracker

        return CooperativeTracker(seed=seed)
    from can_imm.trackers.roadside import RoadsideTracker

    return RoadsideTracker()
