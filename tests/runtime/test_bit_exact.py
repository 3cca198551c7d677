"""The recording of a live run, replayed, gives the same manoeuvre frames byte for byte."""

from __future__ import annotations

import random
import threading
import time
from pathlib import Path

import can
import numpy as np
import pytest

from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.encoder import OUTPUT_IDS, STATUS_ID, ManoeuvreEncoder, RadarEncoder
from can_imm.bus.frame import Frame
from can_imm.bus.sinks import BusSink, LogSink
from can_imm.bus.sources import BusSource, LogSource
from can_imm.detector import Detector
from can_imm.manoeuvres import load_bank
from can_imm.runtime.clock import FastClock, WallClock
from can_imm.runtime.feeds import BusFeed, IdleFeed, LogFeed
from can_imm.runtime.health import Health
from can_imm.runtime.loop import STEP_NS, Loop, run
from can_imm.runtime.nodes import DetectorNode, SenderNode
from can_imm.sim.player import Player
from can_imm.smoothing import FixedLagSmoother
from can_imm.types import Scan

UNIX_NS = 1_700_000_000_000_000_000
MANOEUVRE_IDS = OUTPUT_IDS - {STATUS_ID}
FORMATS = [".log", ".log.gz", ".asc", ".asc.gz", ".blf", ".csv", ".csv.gz", ".trc", ".db", ".mf4"]


def scans(n: int, start_ns: int) -> list[Scan]:
    rng = np.random.default_rng(5)
    found = []
    for k in range(n):
        scan = Scan(3)
        scan.t_ns, scan.n, scan.counter = start_ns + k * 50_000_000, k % 4, k
        scan.ids[:] = (3, 7, 11)
        scan.z[:] = rng.normal(size=(3, 4))
        scan.z[:, 0] += 50.0
        scan.valid[:] = True
        found.append(scan)
    return found


class Keep:
    """A recorder in memory."""

    def __init__(self) -> None:
        self.frames: list[Frame] = []

    def send(self, frame: Frame) -> None:
        self.frames.append(frame)


@pytest.fixture
def bus_pair(request):
    channel = request.node.name
    options = {"interface": "virtual", "channel": channel, "preserve_timestamps": True}
    with can.Bus(**options) as one, can.Bus(**options) as other:
        yield one, other


def manoeuvres(frames) -> list[tuple[int, int, bytes]]:
    """(time from the first frame, id, data) of the manoeuvre frames."""
    frames = list(frames)
    return [(f.t_ns - frames[0].t_ns, f.id, f.data) for f in frames if f.id in MANOEUVRE_IDS]


def replayed(path: Path, make_node) -> list[tuple[int, int, bytes]]:
    health, keep = Health(), Keep()
    with LogSource(path) as source:
        feed = LogFeed(source, FastClock(), health, OUTPUT_IDS)
        node = make_node(health)
        loop = Loop(feed, node, health, recorders=[keep])
        run([loop])
        loop.send_last(node.remaining)
    return manoeuvres(keep.frames)


def fast_run(bus_pair, make_node, *recorders) -> Loop:
    """Sender and detector in lockstep on a virtual bus; returns the detector's loop."""
    clock = FastClock(UNIX_NS)
    sender_bus, detector_bus = bus_pair
    health = Health()
    player = Player(scans(100, UNIX_NS + STEP_NS))
    sender = Loop(
        IdleFeed(clock), SenderNode(player, RadarEncoder()), Health(), [BusSink(sender_bus)]
    )
    feed = BusFeed(BusSource(detector_bus), clock, health)
    detector = Loop(feed, make_node(health), health, [BusSink(detector_bus)], recorders)
    run([sender, detector], stop=lambda: player.done and health.frames >= 100 + 150)
    assert health.late_frames == 0
    return detector


@pytest.mark.parametrize("suffix", FORMATS)
def test_accelerated_run_through_every_log_format(bus_pair, make_node, tmp_path, suffix):
    path = tmp_path / f"run{suffix}"
    keep = Keep()
    with LogSink(path) as log:
        fast_run(bus_pair, make_node, keep, log)
    live = manoeuvres(keep.frames)
    assert len(live) == 2 * 150  # two frames per object
    assert keep.frames[0].id == STATUS_ID
    assert keep.frames[0].t_ns % STEP_NS == 0
    assert replayed(path, make_node) == live


def test_real_time_run_with_jitter_and_late_frames(bus_pair, make_node, tmp_path):
    sender_bus, detector_bus = bus_pair
    path = tmp_path / "run.log"
    health, keep = Health(), Keep()
    clock = WallClock()

    class Stalling:
        """A node that now and then takes longer than its step."""

        def __init__(self, node) -> None:
            self.node = node
            self.steps = 0

        def step(self, t_ns, frames):
            self.steps += 1
            if self.steps % 12 == 0:
                time.sleep(0.03)
            return self.node.step(t_ns, frames)

    def send() -> None:
        encoder, rng = RadarEncoder(), random.Random(3)
        for scan in scans(60, 0):
            for frame in encoder.encode(scan, 0):
                # stamps from 15 ms late to 1 ms early
                stamp = time.time() + rng.uniform(-0.015, 0.001)
                message = can.Message(
                    arbitration_id=frame.id, data=frame.data, is_extended_id=False, timestamp=stamp
                )
                sender_bus.send(message)
                time.sleep(rng.uniform(0.0, 0.006))

    sender = threading.Thread(target=send)
    with LogSink(path) as log:
        feed = BusFeed(BusSource(detector_bus), clock, health)
        node = Stalling(make_node(health))
        loop = Loop(feed, node, health, [BusSink(detector_bus)], [log, keep])
        sender.start()
        run([loop], stop=lambda: not sender.is_alive() and health.steps % 10 == 0)
    sender.join()
    live = manoeuvres(keep.frames)
    assert health.late_frames > 0
    assert health.deadline_misses > 0
    assert len(live) > 100
    assert all(
        a.t_ns < b.t_ns + STEP_NS for a, b in zip(keep.frames, keep.frames[1:], strict=False)
    )
    assert replayed(path, make_node) == live


def test_replaying_a_replay_changes_nothing(bus_pair, make_node, tmp_path):
    first, second = tmp_path / "first.log", tmp_path / "second.log"
    with LogSink(first) as log:
        fast_run(bus_pair, make_node, log)
    health = Health()
    with LogSource(first) as source, LogSink(second) as log:
        feed = LogFeed(source, FastClock(), health, OUTPUT_IDS)
        run([Loop(feed, make_node(health), health, recorders=[log])])
    assert feed.n_replaced > 300
    assert second.read_bytes() == first.read_bytes()


def test_a_shift_by_one_step_would_be_noticed(bus_pair, make_node, tmp_path):
    path = tmp_path / "run.log"
    keep = Keep()
    with LogSink(path) as log:
        fast_run(bus_pair, make_node, keep, log)
    lines = path.read_text().splitlines(keepends=True)
    k = next(i for i, line in enumerate(lines) if i > 200 and " 301#" in line)
    stamp = lines[k][1 : lines[k].index(")")]
    moved = f"({float(stamp) + 0.00001:.6f})" + lines[k][len(stamp) + 2 :]
    path.write_text("".join([*lines[:k], moved, *lines[k + 1 :]]))
    assert replayed(path, make_node) != manoeuvres(keep.frames)


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf"])
def test_the_real_detector_repeats_itself(bus_pair, tmp_path, suffix, profile):
    bank = load_bank("two-lane")

    def make_node(health: Health) -> DetectorNode:
        return DetectorNode(ScanDecoder(profile), Detector(bank), ManoeuvreEncoder(), health)

    path = tmp_path / f"run{suffix}"
    keep = Keep()
    with LogSink(path) as log:
        fast_run(bus_pair, make_node, keep, log)
    live = manoeuvres(keep.frames)
    assert len(live) > 300
    assert replayed(path, make_node) == live


@pytest.mark.parametrize("lag_s", [0.3, 100.0])
def test_lagged_answers_repeat_themselves_to_the_last(bus_pair, tmp_path, profile, lag_s):
    """Those that are said at the end of the live run, too; with 100 s these are all."""
    bank = load_bank("two-lane")
    nodes: list[DetectorNode] = []

    def make_node(health: Health) -> DetectorNode:
        detector = Detector(bank)
        detector.history = smoother = FixedLagSmoother(bank, lag_s)
        nodes.append(
            DetectorNode(
                ScanDecoder(profile), detector, ManoeuvreEncoder(), health, smoother=smoother
            )
        )
        return nodes[-1]

    path, keep = tmp_path / "run.log", Keep()
    with LogSink(path) as log:
        loop = fast_run(bus_pair, make_node, keep, log)
        before = len(manoeuvres(keep.frames))
        loop.send_last(nodes[0].farewell)
    live = manoeuvres(keep.frames)
    assert len(live) > max(300, before)
    assert (before > 0) == (lag_s < 1)
    assert keep.frames[-1].id == STATUS_ID
    assert replayed(path, make_node) == live
