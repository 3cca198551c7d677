"""Stamps and histograms against clocks that are set by hand; the command on a virtual bus."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_imm.bus.encoder import OUTPUT_IDS, STATUS_ID
from can_imm.bus.frame import Frame
from can_imm.cli.main import main
from can_imm.runtime import latency
from can_imm.runtime.histogram import Histogram
from can_imm.runtime.latency import STAGES, Probe, Rounds


@given(st.lists(st.integers(100, 10**10), min_size=1), st.sampled_from([0.5, 0.9, 0.99, 1.0]))
def test_quantiles_are_right_to_one_percent(durations, q):
    histogram = Histogram()
    for duration in durations:
        histogram.add(duration)
    exact = np.quantile(durations, q, method="inverted_cdf")
    assert histogram.quantile_ns(q) == pytest.approx(exact, rel=0.0101)
    assert histogram.max_ns == max(durations)


def test_a_histogram_takes_anything_and_stays_small():
    histogram = Histogram()
    for duration in (-5, 0, 1, 10**15):
        histogram.add(duration)
    assert sum(histogram.counts) == histogram.n == 4
    assert len(histogram.counts) == Histogram.BINS
    assert Histogram().summary()["p99_us"] == 0.0


class Node:
    """Everything around a detector node, on a clock that every part moves on by its own time."""

    ANSWER = min(OUTPUT_IDS - {STATUS_ID})

    def __init__(self, monkeypatch) -> None:
        self.now = 1_000
        self.jumps = 0
        monkeypatch.setattr(latency.time, "perf_counter_ns", lambda: self.now)
        self.reports, self.counts, self.n_tracked = None, None, 0
        self.frames = [Frame(0, 0x300, b""), Frame(0, 0x301, b"")]
        self.probe = Probe(self, 2_000, frozenset({0x300, 0x301}))

    def now_ns(self) -> int:
        return self.now

    def remaining_s(self, t_ns: int) -> float:
        raise AssertionError("not asked by a probe")

    def take(self, duration: int) -> None:
        self.now += duration

    def answer(self, *, ahead: bool) -> None:
        """One step at 20,000 with a guard of 2,000 that begins 300 late, and the next one."""
        outer = self

        class Parts:
            reports = counts = None
            n_tracked = 1
            judged = False

            def recv(self, timeout_s):
                outer.take(50)
                return outer.frames.pop(0)

            def rehearse(self, what, frames=()):
                raise AssertionError("not asked by a probe")

            def send(self, frame):
                outer.take(11)

            def prepare(self, t_ns, frames):
                if frames:
                    outer.take(5)  # decode
                if len(frames) == 2 and not self.judged:
                    self.judged = True
                    detector.step(t_ns, object())
                    outer.take(3)  # encode

            def step(self, t_ns, frames):
                self.prepare(t_ns, frames)
                if t_ns > 20_000:
                    detector.step(t_ns, None)
                outer.take(2)  # status
                return [Frame(0, outer.ANSWER, b""), Frame(0, STATUS_ID, b"")]

        class Estimator(Parts):
            def step(self, t_ns, scan):
                outer.take(70)
                return 1

        parts = Parts()
        detector = self.probe.detector(Estimator())
        source, sink = self.probe.source(parts), self.probe.sink(parts)
        node = self.probe.node(parts)
        frames = [source.recv(0.0), source.recv(0.0)]
        if ahead:
            self.now = 21_000
            node.prepare(20_000, frames[:1])
            self.now = 21_500
            node.prepare(20_000, frames)
        for t_ns in (20_000, 30_000):
            if t_ns > 20_000 and ahead:
                node.prepare(t_ns, [])
            self.now = t_ns + 2_000 + 300
            for frame in node.step(t_ns, frames if t_ns == 20_000 else []):
                sink.send(frame)


# what is done ahead is done in the wait
@pytest.mark.parametrize(
    ("ahead", "measured"),
    [
        (False, {"encode": 5, "send": 11, "work": 91, "processing": 300 + 91}),
        # decoding once more finds nothing new but takes its time, and then the status is made
        (True, {"encode": 3, "send": 18, "work": 96, "processing": 300 + 18}),
    ],
)
def test_every_stage_is_measured_where_it_happens(monkeypatch, ahead, measured):
    node = Node(monkeypatch)

    class Bus:
        def send(self, frame):
            pass

        def recv(self, timeout_s):
            node.answer(ahead=ahead)
            node.now = 23_000
            return Frame(0, Node.ANSWER, b"")

    rounds = Rounds(Bus(), Bus(), node.probe.stamps_of)
    rounds.scan(list(node.frames), 1)
    assert rounds.lost == 0
    assert {name: rounds.stages[name].max_ns for name in STAGES} == {
        "receive": 100, "wait": 20_900, "late": 300, "decode": 5, "estimate": 70,
        "end_to_end": 22_000, "response": 1_100, **measured,
    }  # fmt: skip
    assert node.probe.lateness.n == 2
    assert node.probe.lateness.max_ns == 300


def test_a_round_without_an_answer_is_lost(monkeypatch):
    node = Node(monkeypatch)
    monkeypatch.setattr(latency, "TIMEOUT_S", 0.01)

    class Bus:
        def send(self, frame):
            pass

        def recv(self, timeout_s):
            return None

    rounds = Rounds(Bus(), Bus(), node.probe.stamps_of)
    rounds.scan(node.frames, 1)
    rounds.bounce()
    assert rounds.lost == 2
    assert rounds.echo.n == rounds.stages["end_to_end"].n == 0


def test_command_on_a_virtual_bus(tmp_path, capsys):
    figures, picture = tmp_path / "latency.json", tmp_path / "latency.png"
    arguments = ["--duration", "0.6", "--objects", "2", "--json", figures, "--plot", picture]
    assert main(["latency", *map(str, arguments)]) == 0
    data = json.loads(figures.read_text())
    assert set(data["stages"]) == set(STAGES)
    assert data["rounds"]["answered"] > 3
    assert data["rounds"]["lost"] == 0
    assert set(data["echo"]) == {"p50_us", "p90_us", "p99_us", "p999_us", "max_us"}
    assert 0 < data["echo"]["p50_us"] < data["stages"]["end_to_end"]["p50_us"]
    assert data["deadline"]["steps"] > 40
    assert data["deadline"]["missed"] < data["deadline"]["steps"]
    assert {"scheduler", "affinity", "collector", "switch_interval_s"} <= set(data["granted"])
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "response" in capsys.readouterr().out


@pytest.mark.parametrize("wrong", [["--duration", "0"], ["--objects", "65"]])
def test_senseless_options_are_refused(wrong, capsys):
    assert main(["latency", *wrong]) == 1
    assert f"{wrong[0]} {wrong[1]}" in capsys.readouterr().err
