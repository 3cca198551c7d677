"""Sender and detector node: scans in time, heartbeat, bursts."""

from __future__ import annotations

import numpy as np
import pytest

from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.encoder import DetectorState, ManoeuvreEncoder, RadarEncoder, StatusValues
from can_imm.bus.frame import Frame
from can_imm.bus.listener import EstimateMessage, ManoeuvreDecoder, ManoeuvreMessage
from can_imm.detector import Detector
from can_imm.manoeuvres import load_bank
from can_imm.runtime.health import Health
from can_imm.runtime.nodes import MAX_WAITING, DetectorNode, SenderNode
from can_imm.sim.player import Player
from can_imm.smoothing import FixedLagSmoother
from can_imm.types import REPORT_DTYPE, Scan

STEP = 10_000_000
PERIOD = 100_000_000


def scan_of(*objects: tuple[int, float], t_ns: int = 0) -> Scan:
    scan = Scan(max(len(objects), 1))
    scan.t_ns = t_ns
    scan.n = len(objects)
    scan.valid[:] = True
    for i, (object_id, x) in enumerate(objects):
        scan.ids[i] = object_id
        scan.z[i] = (x, 0.0, 0.0, 0.0)
    return scan


def decoded(frames: list[Frame]) -> list:
    reader = ManoeuvreDecoder()
    return [reader.feed(frame) for frame in frames]


def statuses(frames) -> list[StatusValues]:
    return [m for m in decoded(frames) if isinstance(m, StatusValues)]


def test_sender_sends_each_scan_when_it_is_due():
    scans = [scan_of((1, 50.0), t_ns=k * PERIOD) for k in range(3)]
    node = SenderNode(Player(scans, start_ns=2 * STEP), RadarEncoder())
    sent = {k: frames for k in range(40) if (frames := node.step(k * STEP, []))}
    assert list(sent) == [2, 12, 22]
    assert [f.id for f in sent[12]] == [0x300, 0x301]
    assert {f.t_ns for f in sent[12]} == {12 * STEP}


def test_detector_answers_in_the_step_in_which_the_scan_is_complete(make_node):
    node = make_node()
    frames = RadarEncoder().encode(scan_of((4, 50.0), (9, 20.0)), 0)
    assert [f.id for f in node.step(0, frames[:2])] == [0x31F]
    answers = node.step(STEP, frames[2:])
    assert [f.id for f in answers] == [0x310, 0x311, 0x310, 0x311]
    assert {f.t_ns for f in answers} == {STEP}
    reports = [m for m in decoded(answers) if isinstance(m, ManoeuvreMessage)]
    assert [m.object_id for m in reports] == [4, 9]


def test_an_incomplete_scan_is_used_when_its_time_is_up(make_node):
    node = make_node()
    frames = RadarEncoder().encode(scan_of((4, 50.0), (9, 20.0)), 0)
    node.step(0, frames[:2])
    answered = [k for k in range(1, 12) if 0x310 in {f.id for f in node.step(k * STEP, [])}]
    assert len(answered) == 1
    assert node.decoder.counts.incomplete_scans == 1


def test_heartbeat_every_100_ms_from_the_first_step(make_node):
    node = make_node()
    start = 7 * STEP
    beats = [k for k in range(50) if any(f.id == 0x31F for f in node.step(start + k * STEP, []))]
    assert beats == [0, 10, 20, 30, 40]


def test_heartbeat_tells_the_state(make_node):
    health = Health(deadline_misses=3)
    node = make_node(health)
    encoder = RadarEncoder()
    seen = []
    for k in range(400):
        frames = (
            encoder.encode(scan_of((1, 50.0)), k * STEP) if 100 <= k < 200 and k % 10 == 0 else []
        )
        seen += [(k, s) for s in statuses(node.step(k * STEP, frames))]
    states = {k: s.state for k, s in seen}
    assert all(states[k] == DetectorState.STARTING for k in range(0, 100, 10))
    assert all(states[k] == DetectorState.RUNNING for k in range(100, 290, 10))
    assert all(states[k] == DetectorState.NO_SENSOR for k in range(300, 400, 10))
    assert {s.deadline_misses for _, s in seen} == {3}
    [last] = statuses(node.farewell(400 * STEP))
    assert last.state == DetectorState.STOPPING


def test_rejected_frames_show_in_the_heartbeat(make_node):
    node = make_node()
    frames = RadarEncoder().encode(scan_of((1, 50.0)), 0)
    broken = frames[0]._replace(data=b"\xff" + frames[0].data[1:])
    [status] = statuses(node.step(0, [broken]))
    assert status.frames_rejected == 1


def test_scans_that_come_together_are_taken_one_per_step_unmixed(make_node):
    node = make_node()
    encoder = RadarEncoder()
    burst = [f for k in range(3) for f in encoder.encode(scan_of((k, 10.0 * k)), 1000 * k)]
    ids = []
    for k in range(5):
        answers = decoded(node.step(k * STEP, burst if k == 0 else []))
        ids.append([m.object_id for m in answers if isinstance(m, ManoeuvreMessage)])
    assert ids == [[0], [1], [2], [], []]


def test_more_scans_than_can_wait_are_counted(make_node):
    node = make_node()
    encoder = RadarEncoder()
    n = MAX_WAITING + 3
    node.step(0, [f for k in range(n) for f in encoder.encode(scan_of((1, 50.0)), k * 1000)])
    for k in range(1, 20):
        node.step(k * STEP, [])
    assert len(node.detector.scans) == MAX_WAITING
    assert node.dropped_scans == 3
    # and all places are free again
    node.step(20 * STEP, encoder.encode(scan_of((1, 50.0)), 20 * STEP))
    assert len(node.detector.scans) == MAX_WAITING + 1


def test_answers_go_to_the_channel_of_the_sensor(make_node):
    node = make_node()
    frames = RadarEncoder().encode(scan_of((1, 50.0)), 0)
    answers = node.step(0, [f._replace(channel="vcan1") for f in frames])
    assert {f.channel for f in answers} == {"vcan1"}


def test_listeners_hear_of_every_scan(make_node):
    heard = []
    node = make_node(
        listeners=[lambda t, reports: heard.append((t, reports["object_id"].tolist()))]
    )
    node.step(0, RadarEncoder().encode(scan_of((5, 1.0), (6, 2.0)), 0))
    node.step(STEP, [])
    assert heard == [(0, [5, 6])]


@pytest.mark.parametrize("n", [0, 1, 64])
def test_scans_of_any_size_pass(make_node, n):
    node = make_node()
    frames = RadarEncoder().encode(scan_of(*((k, float(k)) for k in range(n))), 0)
    answers = node.step(0, frames)
    assert sum(f.id == 0x310 for f in answers) == n
    assert np.all(node.detector.reports["object_id"][:n] == np.arange(n))


class Later:
    """Says of every scan, three steps later, that there was object 7, as many scans old as the
    scan's number."""

    def __init__(self) -> None:
        self.scans: list[int] = []

    def hear(self, t_ns: int, reports) -> None:
        self.scans.append(t_ns)

    def due(self, t_ns: int):
        while self.scans and self.scans[0] + 3 * STEP <= t_ns:
            yield self.say()

    def finish(self):
        while self.scans:
            yield self.say()

    def say(self):
        t_ns = self.scans.pop(0)
        reports = np.zeros(1, REPORT_DTYPE)
        reports["object_id"], reports["age"] = 7, t_ns // STEP
        return t_ns, reports


@pytest.mark.parametrize("rehearses", [False, True])
def test_what_a_smoother_says_is_sent_and_told_when_it_is_known(make_node, rehearses):
    later, told, watched = Later(), [], []
    node = make_node(
        listeners=[lambda t, reports: told.append((t // STEP, reports["age"].tolist()))],
        watchers=[later.hear, lambda t, reports: watched.append((t // STEP, len(reports)))],
        smoother=later,
    )
    node.detector.understudy = lambda: node.detector.__class__()
    encoder, said = RadarEncoder(), {}
    for k in range(14):
        scan = scan_of((4, 50.0), (9, 20.0))
        frames = encoder.encode(scan, k * STEP) if k in (1, 2, 6, 12, 13) else []
        if rehearses:
            node.rehearse(k * STEP, frames)
        answers = node.step(k * STEP, [f._replace(channel="vcan1") for f in frames])
        assert all(f.t_ns == k * STEP for f in answers)
        if of_objects := [f for f in answers if f.id != 0x31F]:
            assert [(f.id, f.channel) for f in of_objects] == [(0x310, "vcan1"), (0x311, "vcan1")]
            [message, _] = decoded(of_objects)
            said[k] = message.object_id, message.age
    assert said == {4: (7, 1), 5: (7, 2), 9: (7, 6)}
    assert told == [(1, [1]), (2, [2]), (6, [6])]
    assert watched == [(1, 2), (2, 2), (6, 2), (12, 2), (13, 2)]
    # no more will come: the rest, and then that it stops
    *rest, status = node.farewell(13 * STEP)
    assert [f.id for f in rest] == [0x310, 0x311] * 2
    assert {f.t_ns for f in rest} == {13 * STEP}
    assert [m.age for m in decoded(rest) if isinstance(m, ManoeuvreMessage)] == [12, 13]
    assert decoded([status])[0].state == DetectorState.STOPPING
    assert told[3:] == [(12, [12]), (13, [13])]
    assert node.remaining(13 * STEP) == []


def test_lagged_frames_are_those_of_the_fixed_lag_smoother(profile):
    """Beside the node runs a detector of our own, whose smoother is asked at every step."""
    bank = load_bank("two-lane")
    decoder, detector = ScanDecoder(profile), Detector(bank)
    detector.history = smoother = FixedLagSmoother(bank, 0.25)
    inner = Detector(bank)
    inner.history = lag = FixedLagSmoother(bank, 0.25)
    node = DetectorNode(ScanDecoder(profile), inner, ManoeuvreEncoder(), Health(), smoother=lag)
    encoder, steps, scans = RadarEncoder(), [], 0
    for k in range(100):
        frames = []
        if k % 10 == 2 and k < 90:
            scan = scan_of((4, 50.0 - 0.2 * k), (9, 20.0 + 0.1 * k))
            scan.z[:2, 1] = -20.0, 10.0
            frames = encoder.encode(scan, k * STEP)
        said = decoded(node.step(k * STEP, frames))
        complete = [s for f in frames if (s := decoder.feed(f)) is not None]
        scans += len(complete)
        detector.step(k * STEP, complete[0] if complete else None)
        expected = [report.copy() for _, reports in smoother.due(k * STEP) for report in reports]
        states = [m for m in said if isinstance(m, ManoeuvreMessage)]
        places = [m for m in said if isinstance(m, EstimateMessage)]
        for message, place, report in zip(states, places, expected, strict=True):
            assert (message.object_id, message.manoeuvre, message.age, message.lane) == tuple(
                report[name] for name in ("object_id", "manoeuvre", "age", "lane")
            )
            assert message.probability == pytest.approx(report["probability"], abs=0.01)
            assert place.object_id == report["object_id"]
            assert place[1:] == pytest.approx(report["x"], abs=0.05)
        if states:
            steps.append(k)
    assert scans == 9
    assert steps == [k + 25 for k in range(2, 73, 10)]
    assert len([f for f in node.farewell(99 * STEP) if f.id == 0x310]) == 2
