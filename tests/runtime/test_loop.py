"""The fixed-step loop: order of work, accounting, skipping of silence."""

from __future__ import annotations

from can_imm.bus.frame import Frame
from can_imm.runtime.clock import FastClock
from can_imm.runtime.feeds import IdleFeed, LogFeed
from can_imm.runtime.health import Health, LatencyLog
from can_imm.runtime.loop import IDLE_NS, STEP_NS, Loop, run

MS = 1_000_000


class Answer:
    """Answers each step that has frames with one frame, and remembers the steps."""

    def __init__(self) -> None:
        self.steps: list[tuple[int, int]] = []

    def step(self, t_ns: int, frames: list[Frame]) -> list[Frame]:
        self.steps.append((t_ns, len(frames)))
        return [Frame(t_ns, 0x310, bytes([len(frames)]))] if frames else []


class Keep:
    def __init__(self) -> None:
        self.frames: list[Frame] = []

    def send(self, frame: Frame) -> None:
        self.frames.append(frame)


def frames_at(*times_ms: float) -> list[Frame]:
    return [Frame(round(t * MS), 0x300, bytes(8)) for t in times_ms]


def log_loop(frames, **sinks):
    health, node = Health(), Answer()
    return Loop(LogFeed(frames, FastClock(), health), node, health, **sinks), node, health


def test_every_step_is_executed_once_with_its_own_time():
    loop, node, health = log_loop(frames_at(0, 3, 10, 41))
    run([loop])
    assert node.steps == [
        (0, 1),
        (10 * MS, 2),
        (20 * MS, 0),
        (30 * MS, 0),
        (40 * MS, 0),
        (50 * MS, 1),
    ]
    assert (health.steps, health.frames, health.sent) == (6, 4, 3)


def test_a_rehearsal_goes_up_to_the_outputs_and_no_further():
    class Bus(Keep):
        def __init__(self) -> None:
            super().__init__()
            self.rehearsed: list[Frame] = []

        def rehearse(self, frame: Frame) -> None:
            self.rehearsed.append(frame)

    class Rehearsing(Answer):
        rehearse = Answer.step

    bus, log, health = Bus(), Keep(), Health()
    feed = LogFeed([], FastClock(), health)
    Loop(feed, Rehearsing(), health, [bus], [log])
    feed.rehearse(20 * MS, frames_at(11, 12))
    assert bus.rehearsed == [Frame(20 * MS, 0x310, b"\2")]
    assert bus.frames == log.frames == []
    assert health == Health(response=health.response)


def test_recorder_gets_everything_outputs_only_the_answers():
    bus, log = Keep(), Keep()
    received = frames_at(1, 2)
    loop, _, _ = log_loop(received, outputs=[bus], recorders=[log])
    run([loop])
    answer = Frame(10 * MS, 0x310, b"\x02")
    assert bus.frames == [answer]
    assert log.frames == [*received, answer]


def test_last_words_carry_the_time_of_the_last_step():
    bus, log = Keep(), Keep()
    loop, _, health = log_loop(frames_at(0, 10), outputs=[bus], recorders=[log])
    run([loop])
    loop.send_last(lambda t_ns: [Frame(t_ns, 0x31F, b"")])
    assert bus.frames[-1] == log.frames[-1] == Frame(10 * MS, 0x31F, b"")
    assert health.sent == 3


def test_no_last_words_before_the_first_step():
    bus = Keep()
    loop, _, _ = log_loop([], outputs=[bus])
    run([loop])
    loop.send_last(lambda t_ns: [Frame(t_ns, 0x31F, b"")])
    assert bus.frames == []


def test_long_silence_is_skipped_on_the_grid():
    year = 365 * 86_400_000
    loop, node, health = log_loop(frames_at(0, year + 3))
    run([loop])
    assert len(node.steps) == health.steps < 5
    assert node.steps[-1] == ((year + 10) * MS, 1)
    assert health.skipped_steps + health.steps == year // 10 + 2


def test_shorter_silence_is_lived_through():
    loop, node, health = log_loop(frames_at(0, IDLE_NS // MS))
    run([loop])
    assert len(node.steps) == IDLE_NS // STEP_NS + 1
    assert health.skipped_steps == 0


def test_stop_is_asked_before_every_step():
    loop, node, _ = log_loop(frames_at(0, 1000))
    run([loop], stop=lambda: len(node.steps) == 3)
    assert len(node.steps) == 3


def test_loops_step_in_turn():
    clock = FastClock()
    order = []

    class Say:
        def __init__(self, name: str) -> None:
            self.name = name

        def step(self, t_ns, frames):
            order.append((t_ns, self.name))
            return []

    loops = [Loop(IdleFeed(clock), Say(name), Health()) for name in "ab"]
    run(loops, stop=lambda: len(order) >= 4)
    assert order == [(0, "a"), (0, "b"), (STEP_NS, "a"), (STEP_NS, "b")]


class SlowNode:
    """Takes a given time per step on a clock that only it moves."""

    jumps = 0

    def __init__(self, costs_ns) -> None:
        self.costs_ns = list(costs_ns)
        self.time_ns = 0
        self.started: list[tuple[int, int]] = []

    def now_ns(self) -> int:
        return self.time_ns

    def remaining_s(self, t_ns: int) -> float:
        self.time_ns = max(self.time_ns, t_ns)
        return 0.0

    def step(self, t_ns, frames):
        self.started.append((t_ns, self.time_ns))
        self.time_ns += self.costs_ns.pop(0)
        return [Frame(t_ns, 0x310, b"")]


def test_an_overrun_is_counted_and_caught_up_with_never_stretched():
    slow = SlowNode([1 * MS, 35 * MS, 1 * MS, 1 * MS, 1 * MS, 1 * MS, 1 * MS])
    health = Health()
    run([Loop(IdleFeed(slow), slow, health)], stop=lambda: not slow.costs_ns)
    assert [t for t, _ in slow.started] == [k * STEP_NS for k in range(7)]
    assert [at // MS for _, at in slow.started] == [0, 10, 45, 46, 47, 50, 60]
    # the long step and the two that followed it ended when the next was already due
    assert health.deadline_misses == 3
    assert health.response.max_ns == 35 * MS


def test_latency_quantiles_bound_the_entries():
    log = LatencyLog()
    assert log.quantile_ns(0.5) == 0
    for us in range(1, 1001):
        log.add(us * 1000)
    assert 500_000 <= log.quantile_ns(0.5) <= 1_024_000
    assert log.quantile_ns(1.0) == log.max_ns == 1_000_000
    log.add(-5)
    assert log.n == 1001
    assert log.max_ns == 1_000_000
