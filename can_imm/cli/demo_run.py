"""The demonstration's run: sender, detector and a listener on one virtual bus, in one process."""

from __future__ import annotations

import time
import uuid
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack

import numpy as np

from can_imm.bus.buses import open_bus
from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.encoder import ManoeuvreEncoder, RadarEncoder
from can_imm.bus.frame import Frame
from can_imm.bus.listener import EstimateMessage, ManoeuvreDecoder, ManoeuvreMessage
from can_imm.bus.profile import load_profile
from can_imm.bus.sinks import BusSink
from can_imm.bus.sources import BusSource
from can_imm.detector import Detector
from can_imm.manoeuvres import load_bank
from can_imm.runtime.clock import FastClock
from can_imm.runtime.feeds import BusFeed
from can_imm.runtime.health import Health, LatencyLog
from can_imm.runtime.loop import STEP_NS, Loop, Node
from can_imm.runtime.loop import run as run_loops
from can_imm.runtime.nodes import DetectorNode, Reports, SenderNode
from can_imm.sim.player import Player
from can_imm.sim.random import random_scenario
from can_imm.sim.scenario import load_scenario
from can_imm.sim.sensor import SensorModel, measure
from can_imm.sim.truth import simulate
from can_imm.studies.metrics import Int8Array
from can_imm.studies.runs import Observation, observe
from can_imm.studies.systems import Answer, Collector
from can_imm.types import FloatArray

START_NS = 10 * STEP_NS
"""Bus time at which the scenario's time 0 lies [ns]."""

STALL_S = 0.1
"""A process that was held up for longer than this [s] does not hurry to catch up."""


class Tap:
    """Hears every frame on the bus, as any other node would, and reads the detector's.

    Attributes:
        counts: frames by id.
        latest: the last frame of each id.
        states: last ManoeuvreState by object, with its time [ns].
        estimates: last ObjectEstimate by object.
    """

    def __init__(self) -> None:
        self._decoder = ManoeuvreDecoder()
        self.counts: Counter[int] = Counter()
        self.latest: dict[int, Frame] = {}
        self.states: dict[int, tuple[int, ManoeuvreMessage]] = {}
        self.estimates: dict[int, EstimateMessage] = {}

    @property
    def rejected(self) -> int:
        """Frames of the detector that failed a check."""
        return self._decoder.rejected

    def send(self, frame: Frame) -> None:
        """Take one frame."""
        self.counts[frame.id] += 1
        self.latest[frame.id] = frame
        content = self._decoder.feed(frame)
        if isinstance(content, ManoeuvreMessage):
            self.states[content.object_id] = frame.t_ns, content
        elif isinstance(content, EstimateMessage):
            self.estimates[content.object_id] = content


class Track:
    """One object: what was true, measured and said, one row per scan; `rows` of them are known."""

    def __init__(self, seen: Observation, said: Answer) -> None:
        assert said.manoeuvre is not None
        assert said.p is not None
        self.object_id = seen.truth.object_id
        self.t_ns = seen.t_ns
        self.label: Int8Array = seen.label
        self.state: FloatArray = seen.state
        self.z = seen.z
        self.manoeuvre = said.manoeuvre
        self.p = said.p
        self.x = said.x

    def rows(self, at_ns: int) -> int:
        """Number of scans of this object up to scenario time ``at_ns`` [ns]."""
        return int(np.searchsorted(self.t_ns, at_ns, side="right"))


class DemoRun:
    """One scenario, played through real frames.

    The sender's and the detector's loop take turns on a clock that is always due, so what is said
    does not depend on how fast it is played: pacing happens between their rounds.

    Attributes:
        lane_width: [m].
        scans: what the sensor measures.
        observations: per object that is ever measured, what was true and measured.
        tracks: the same with what is said, growing while it runs.
        at_ns: scenario time of the last scan that was answered [ns], -1 before.
        tap: a listener on the bus.
        health: of the detector's loop.
        work: how long the detector takes for each scan, from frames to frames.
        node: the detector.
        on_scan: called after each scan, when everything else here is up to date.

    Args:
        scenario: name, file or ``random``.
        preset: name or file of the mode bank.
        seed: of noise, random scenario and particles; means the same as in a study.

    Raises:
        CanImmError: a scenario or preset that does not exist or is refused.
    """

    def __init__(self, scenario: str, preset: str, seed: int) -> None:
        rng = np.random.default_rng(seed)
        played = random_scenario(rng) if scenario == "random" else load_scenario(scenario)
        self.lane_width = played.lane_width
        truths = simulate(played)
        self.scans = measure(truths, SensorModel(), rng)
        self.observations = [observe(truth, self.scans) for truth in truths]
        self._collect = Collector(self.observations, START_NS)
        self.tracks = [
            Track(seen, said)
            for seen, said in zip(self.observations, self._collect.answers, strict=True)
        ]
        self.at_ns = -1
        self.tap = Tap()
        self.health = Health()
        self.work = LatencyLog()
        self.on_scan: Callable[[], None] = lambda: None
        n = len(truths)
        profile = load_profile("can_imm")
        assert profile.header is not None
        # without the ego's motion, of which the scenario says nothing
        self.radar_ids = [m.frame_id for m in (profile.header.message, *profile.messages)]
        self.node = DetectorNode(
            ScanDecoder(profile, n),
            Detector(load_bank(preset), capacity=n, seed=seed),
            ManoeuvreEncoder(),
            self.health,
            [self._collect, self._note],
            n,
        )

    @property
    def duration_ns(self) -> int:
        """Scenario time of the last scan [ns]."""
        return self.scans[-1].t_ns

    def play(self, rate: float | None) -> None:
        """Run to the end, ``rate`` times as fast as real time; None is as fast as possible."""
        channel = uuid.uuid4().hex  # nobody else's, whatever runs in this process
        with ExitStack() as stack:
            near, far = (
                stack.enter_context(
                    open_bus("virtual", channel, preserve_timestamps=True, ignore_config=True)
                )
                for _ in range(2)
            )
            clock, health = FastClock(), Health()
            sender = Loop(
                BusFeed(BusSource(near), clock, health),
                SenderNode(Player(self.scans, START_NS), RadarEncoder()),
                health,
                [BusSink(near)],
                [self.tap],
            )
            detector = Loop(
                BusFeed(BusSource(far), clock, self.health),
                Timed(self.node, self.work),
                self.health,
                [BusSink(far)],
            )
            # one step more, in which the sender's side hears the last answer
            steps = (START_NS + self.duration_ns) // STEP_NS + 2
            pace = pacer(rate)
            run_loops([sender, detector], stop=lambda: health.steps >= steps or pace())

    def so_far(self) -> tuple[list[Observation], list[Answer]]:
        """The objects that were reported, with their rows up to the last answered scan."""
        scans = [scan for scan in self.scans if scan.t_ns <= self.at_ns]
        seen, said = [], []
        for one, answer in zip(self.observations, self._collect.answers, strict=True):
            if one.t_ns[0] <= self.at_ns:
                seen.append(observe(one.truth, scans))
                said.append(_first_rows(answer, len(seen[-1].t_ns)))
        return seen, said

    def _note(self, t_ns: int, reports: Reports) -> None:
        self.at_ns = t_ns - START_NS
        self.on_scan()


class Timed:
    """A node whose work is timed when there are frames for it."""

    def __init__(self, node: Node, log: LatencyLog) -> None:
        self._node = node
        self._log = log

    def step(self, t_ns: int, frames: list[Frame]) -> list[Frame]:
        began = time.perf_counter_ns()
        answers = self._node.step(t_ns, frames)
        if frames:
            self._log.add(time.perf_counter_ns() - began)
        return answers


def _first_rows(said: Answer, n: int) -> Answer:
    assert said.manoeuvre is not None
    assert said.p is not None
    return Answer(said.manoeuvre[:n], said.p[:n], said.x[:n], said.cov[:n])


def pacer(rate: float | None) -> Callable[[], bool]:
    """Return a function that sleeps until the next round of steps is due; it returns False."""
    due_s = time.monotonic()

    def pace() -> bool:
        nonlocal due_s
        if rate is None:
            return False
        due_s = max(due_s + STEP_NS * 1e-9 / rate, time.monotonic() - STALL_S)
        time.sleep(max(0.0, due_s - time.monotonic()))
        return False

    return pace
