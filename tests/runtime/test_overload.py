"""A step takes too long: nothing is lost silently, the estimate stays right, status says so."""

from __future__ import annotations

from itertools import islice

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.encoder import STATUS_ID, ManoeuvreEncoder, RadarEncoder, StatusValues
from can_imm.bus.listener import ManoeuvreDecoder
from can_imm.detector import Detector
from can_imm.manoeuvres import load_bank
from can_imm.runtime.clock import FastClock
from can_imm.runtime.feeds import GUARD_NS, BusFeed, LogFeed
from can_imm.runtime.health import Health
from can_imm.runtime.loop import STEP_NS, Loop
from can_imm.runtime.nodes import MAX_WAITING, DetectorNode
from can_imm.types import Scan

START_NS = 1_000 * STEP_NS


class SimulatedTime:
    """A clock that the node's work moves on, and the bus of a sensor that does not care."""

    def __init__(self, frames) -> None:
        self.jumps = 0
        self.now = START_NS
        self._frames = frames

    def now_ns(self) -> int:
        return self.now

    def remaining_s(self, t_ns: int) -> float:
        return (t_ns - self.now) * 1e-9

    def recv(self, timeout_s: float):
        end = self.now + round(timeout_s * 1e9)
        if self._frames and self._frames[0].t_ns <= end:
            frame = self._frames.pop(0)
            self.now = max(self.now, frame.t_ns)
            return frame
        self.now = max(end, self.now + 1000)  # to look takes a moment, too
        return None


class SlowNode:
    """A detector node whose steps take the given time once and then none."""

    def __init__(self, node: DetectorNode, time: SimulatedTime, slow: dict[int, int]) -> None:
        self._node, self._time, self._slow = node, time, slow
        self.taken: list[tuple[int, int]] = []

    def step(self, t_ns, frames):
        self.taken += [(t_ns, frame.t_ns) for frame in frames]
        answers = self._node.step(t_ns, frames)
        self._time.now += self._slow.pop((t_ns - START_NS) // STEP_NS, 0)
        return answers


class Log(list):
    def send(self, frame) -> None:
        self.append(frame)


def sensor_frames(scans: int):
    encoder, scan, frames = RadarEncoder(), Scan(2), []
    rng = np.random.default_rng(0)
    scan.n = 2
    scan.ids[:] = 3, 4
    scan.valid[:] = True
    for k in range(1, scans + 1):
        scan.t_ns = START_NS + k * 5 * STEP_NS + 1_234_000
        scan.z[:] = np.array([[40.0, 0, 0, 0], [60.0, 0, 3, 0]]) + rng.normal(0, 0.1, (2, 4))
        frames += encoder.encode(scan, scan.t_ns)
    return frames


def detector_node(profile, health: Health) -> DetectorNode:
    detector = Detector(load_bank("two-lane"), capacity=8)
    return DetectorNode(ScanDecoder(profile), detector, ManoeuvreEncoder(), health)


def run_live(profile, slow: dict[int, int], steps: int = 200):
    health, frames = Health(), sensor_frames(30)
    n_frames, time = len(frames), SimulatedTime(frames)
    node = detector_node(profile, health)
    slow_node, sent, log = SlowNode(node, time, slow), Log(), Log()
    loop = Loop(BusFeed(time, time, health), slow_node, health, [sent], [log])
    for _ in range(steps):
        loop.step()
    assert health.frames == n_frames
    return health, node, slow_node, sent, log


def states(frames) -> list[tuple[int, bytes]]:
    """The answers without DetectorStatus, whose counters tell of the overload."""
    return [(f.t_ns, f.data) for f in frames if 0x310 <= f.id < STATUS_ID]


def test_one_slow_step_delays_answers_and_changes_none_of_them(profile):
    _, _, _, calm, _ = run_live(profile, {})
    health, node, slow_node, sent, _ = run_live(profile, {45: 37_000_000})
    assert states(sent) == states(calm)
    assert len(states(calm)) == 30 * 4
    # steps 45 to 47 end after their successor was due; the fourth has caught up
    assert health.deadline_misses == 3
    assert health.late_frames == health.skipped_steps == 0
    assert all(t_ns - STEP_NS < frame_ns <= t_ns for t_ns, frame_ns in slow_node.taken)
    assert node.dropped_scans == 0


def test_the_status_frame_says_so(profile):
    _, _, _, sent, _ = run_live(profile, {45: 37_000_000})
    listener = ManoeuvreDecoder()
    status = [m for m in map(listener.feed, sent) if isinstance(m, StatusValues)]
    assert status[0].deadline_misses == 0
    assert status[-1].deadline_misses == 3


def test_a_long_stall_is_worked_off_step_by_step(profile):
    """A second at a standstill: ten times the sensor's period, and every scan is still used."""
    _, _, _, calm, _ = run_live(profile, {})
    health, node, _, sent, _ = run_live(profile, {20: 1_000_000_000})
    assert states(sent) == states(calm)
    assert node.detector.counts.scans == 30
    assert health.deadline_misses > 90


def test_constant_overload_loses_no_frame(profile):
    health, node, slow_node, _, _ = run_live(profile, dict.fromkeys(range(200), 14_000_000))
    assert len(slow_node.taken) == 90
    assert health.deadline_misses == 200
    assert node.decoder.counts.scans == node.detector.counts.scans == 30


def test_the_recording_of_an_overloaded_run_gives_the_same_answers(profile):
    _, _, _, sent, log = run_live(profile, {31: 55_000_000, 60: 23_000_000})
    health, again = Health(), Log()
    received = [frame for frame in log if frame.id < 0x310 or frame.id == STATUS_ID]
    feed = LogFeed(received, FastClock(), health, frozenset({STATUS_ID}))
    loop = Loop(feed, detector_node(profile, health), health, [again])
    while loop.step():
        pass
    assert states(again) == states(sent)


def test_more_scans_at_once_than_may_wait_are_counted(profile):
    """Late scans of one step: eight wait for their turn, what exceeds them is counted."""
    node = detector_node(profile, Health())
    frames = sensor_frames(MAX_WAITING + 3)
    node.step(START_NS + 100 * STEP_NS, frames)
    assert node.dropped_scans == 3
    assert GUARD_NS < STEP_NS


def test_rehearsals_change_no_answer(profile):
    answers = []
    for rehearses in (False, True):
        node, said = detector_node(profile, Health()), []
        if rehearses:
            node.rehearse(0, [])
        for frame in sensor_frames(30):
            if rehearses:
                node.rehearse(frame.t_ns, [frame])
            said += node.step(frame.t_ns // STEP_NS * STEP_NS + STEP_NS, [frame])
        assert len(said) > 60
        answers.append(said)
    assert answers[0] == answers[1]


@given(st.data())
def test_what_is_prepared_changes_no_answer(make_node, data):
    """Steps with none to many scans, cut off and whole, dealt out in any portions."""
    frames = iter(sensor_frames(40))
    nodes = make_node(), make_node()
    for k in range(12):
        t_ns = START_NS + k * STEP_NS
        number = data.draw(st.integers(0, 25 if k == 3 else 7))
        # what a frame's time is does not matter here, but in order they must be
        mine = [
            f._replace(t_ns=t_ns - STEP_NS + (n + 1) * 1000, channel=f"vcan{n % 2}")
            for n, f in enumerate(islice(frames, number))
            if data.draw(st.integers(0, 9))
        ]
        for end in sorted(data.draw(st.lists(st.integers(0, len(mine)), max_size=4))):
            nodes[0].prepare(t_ns, mine[:end])
        assert nodes[0].step(t_ns, mine) == nodes[1].step(t_ns, mine)
    assert nodes[0].detector.scans == nodes[1].detector.scans
    assert nodes[0].dropped_scans == nodes[1].dropped_scans
    assert nodes[0].decoder.counts == nodes[1].decoder.counts


def test_a_scan_is_judged_when_it_is_complete_and_answered_in_its_step(make_node):
    told = []
    node = make_node(listeners=[lambda t_ns, reports: told.append(t_ns)])
    frames = sensor_frames(2)
    node.prepare(START_NS, frames[:2])
    assert told == node.detector.scans == []
    node.prepare(START_NS, frames[:3])
    assert told == [START_NS]
    node.prepare(START_NS, frames)
    assert len(node.detector.scans) == 1, "a step has one scan, the next waits"
    assert sum(f.id == 0x310 for f in node.step(START_NS, frames)) == 2
    assert sum(f.id == 0x310 for f in node.step(START_NS + STEP_NS, [])) == 2
    assert [t_ns for t_ns, _ in node.detector.scans] == told == [START_NS, START_NS + STEP_NS]
