"""Feeds: which step a frame belongs to, live and from a log."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from can_imm.bus.frame import Frame
from can_imm.runtime.clock import JUMP_NS, FastClock
from can_imm.runtime.feeds import AWAKE_S, FRAME_S, REHEARSAL_S, BusFeed, IdleFeed, LogFeed
from can_imm.runtime.health import Health

STEP = 10_000_000
US = 1000
UNIX = 1_700_000_000_000_000_000


def frame(t_ns: int, number: int = 0, frame_id: int = 0x300) -> Frame:
    return Frame(t_ns, frame_id, number.to_bytes(8, "little"))


class FakeBus:
    """Frames that arrive at given times of a simulated clock, which is also the feed's clock.

    ``arrivals``: (time of arrival [ns], frame) in order.  Waiting costs no time.
    """

    jumps = 0

    def __init__(self, now_ns: int, arrivals=()) -> None:
        self.time_ns = now_ns
        self.arrivals = list(arrivals)

    def now_ns(self) -> int:
        return self.time_ns

    def remaining_s(self, t_ns: int) -> float:
        return (t_ns - self.time_ns) * 1e-9

    def recv(self, timeout_s: float) -> Frame | None:
        until = self.time_ns + round(timeout_s * 1e9)
        if self.arrivals and self.arrivals[0][0] <= until:
            at, received = self.arrivals.pop(0)
            self.time_ns = max(self.time_ns, at)
            return received
        # to look takes a moment, too
        self.time_ns = max(until, self.time_ns + US)
        return None


def live(now_ns: int, *arrivals) -> tuple[BusFeed, FakeBus, Health]:
    bus = FakeBus(now_ns, arrivals)
    health = Health()
    return BusFeed(bus, bus, health, guard_ns=2_000_000), bus, health


def times(frames) -> list[int]:
    return [f.t_ns for f in frames]


class TestBusFeed:
    def test_starts_on_a_multiple_of_the_step_in_the_past(self):
        feed, _, _ = live(UNIX + 12_345_678)
        assert feed.start_ns(STEP) == UNIX + STEP

    def test_a_step_owns_what_lies_between_the_last_one_and_itself(self):
        t0 = UNIX
        stamps = [t0 + US, t0 + STEP, t0 + STEP + US, t0 + 2 * STEP - US, t0 + 2 * STEP]
        feed, _, health = live(t0, *((t + 5 * US, frame(t)) for t in stamps))
        feed.start_ns(STEP)
        assert feed.collect(t0) == []
        assert times(feed.collect(t0 + STEP)) == stamps[:2]
        assert times(feed.collect(t0 + 2 * STEP)) == stamps[2:]
        assert health.late_frames == 0

    def test_a_step_is_executed_after_the_guard_time(self):
        feed, bus, _ = live(UNIX)
        feed.start_ns(STEP)
        feed.collect(UNIX + STEP)
        assert 0 <= bus.time_ns - (UNIX + STEP + 2_000_000) <= US

    def test_a_step_with_frames_is_rehearsed_and_prepared_before_it_is_due(self):
        stamp = UNIX + STEP - US
        feed, bus, _ = live(UNIX, (stamp, frame(stamp)))
        said = []
        feed.rehearse = lambda t_ns, frames: said.append((t_ns, times(frames), bus.time_ns))
        feed.start_ns(STEP)
        assert said.pop() == (0, [], UNIX), "the first time is before the start"
        feed.prepare = feed.rehearse
        for k in (1, 2):
            assert len(feed.collect(UNIX + k * STEP)) == (k == 1)
        rehearsal, preparation = said
        assert rehearsal == preparation
        due = UNIX + STEP + 2_000_000
        ahead_ns = (AWAKE_S + REHEARSAL_S + FRAME_S) * 1e9
        assert rehearsal[:2] == (UNIX + STEP, [stamp])
        assert due - ahead_ns - US <= rehearsal[2] < due - ahead_ns + 2 * US

    def test_frames_that_come_after_a_preparation_are_prepared_when_they_come(self):
        due = UNIX + STEP + 2_000_000
        stamps = [UNIX + STEP - 3 * US, UNIX + STEP - 2 * US, UNIX + STEP + US, UNIX + STEP - US]
        at = [due - 1_000_000, due - 300_000, due - 200_000, due - 2_000]
        feed, bus, _ = live(UNIX, *zip(at, map(frame, stamps), strict=True))
        said, prepared = [], []
        feed.start_ns(STEP)
        feed.rehearse = lambda t_ns, frames: said.append(t_ns)
        feed.prepare = lambda t_ns, frames: prepared.append((bus.time_ns, frames))
        mine = feed.collect(UNIX + STEP)
        assert times(mine) == [stamps[0], stamps[1], stamps[3]]
        assert said == [UNIX + STEP]
        # each time they are the first frames of the step, in its order
        assert [frames for _, frames in prepared] == [mine[:1], mine[:2], mine[:2], mine]
        assert [t_ns for t_ns, _ in prepared][1:] == at[1:]
        assert prepared[0][0] < at[1]

    def test_a_step_that_is_nearly_due_is_only_prepared_and_a_late_one_neither(self):
        stamp = UNIX + STEP - US
        for to_go_us, prepares in ((100, 1), (-100, 0)):
            feed, bus, _ = live(UNIX, (stamp, frame(stamp)))
            feed.start_ns(STEP)
            rehearsed, prepared = [], []
            feed.rehearse = lambda t_ns, frames, said=rehearsed: said.append(t_ns)
            feed.prepare = lambda t_ns, frames, said=prepared: said.append(t_ns)
            bus.time_ns = UNIX + STEP + 2_000_000 - to_go_us * US
            assert len(feed.collect(UNIX + STEP)) == 1
            assert rehearsed == []
            assert len(prepared) == prepares

    def test_a_frame_that_is_late_within_the_guard_time_is_not_late(self):
        stamp = UNIX + STEP - US
        feed, _, health = live(UNIX, (UNIX + STEP + 1_500_000, frame(stamp)))
        feed.start_ns(STEP)
        assert times(feed.collect(UNIX + STEP)) == [stamp]
        assert health.late_frames == 0

    def test_a_late_frame_becomes_the_next_steps_first(self):
        late, other = frame(UNIX + STEP - US, 1), frame(UNIX + STEP + 3_000_000, 2)
        feed, _, health = live(
            UNIX, (UNIX + STEP + 2_500_000, late), (UNIX + STEP + 3_100_000, other)
        )
        feed.start_ns(STEP)
        assert feed.collect(UNIX + STEP) == []
        got = feed.collect(UNIX + 2 * STEP)
        assert got == [late._replace(t_ns=UNIX + STEP + US), other]
        assert health.late_frames == 1

    def test_what_was_on_the_bus_before_the_start_does_not_precede_the_start(self):
        feed, _, _ = live(UNIX + 5_000_000, (UNIX, frame(UNIX - 3 * STEP)))
        start = feed.start_ns(STEP)
        assert feed.collect(start) == []
        assert times(feed.collect(start + STEP)) == [start + US]

    def test_after_an_overrun_each_step_gets_its_own_frames(self):
        stamps = [UNIX + k * STEP + 5_000_000 for k in range(20)]
        feed, bus, health = live(UNIX, *((t + US, frame(t)) for t in stamps))
        feed.start_ns(STEP)
        feed.collect(UNIX)
        bus.time_ns = UNIX + 15 * STEP  # something else had the processor
        for k in range(1, 20):
            assert times(feed.collect(UNIX + k * STEP)) == [stamps[k - 1]]
        assert health.late_frames == 0

    def test_hardware_time_is_mapped_to_bus_time_by_the_first_frame(self):
        # the adapter counts from its own start and its clock is 100 ppm slow
        stamps = [1_000_000 + k * 999_900 for k in range(2000)]
        arrivals = [UNIX + STEP + k * 1_000_000 for k in range(2000)]
        feed, _, health = live(UNIX, *zip(arrivals, map(frame, stamps), strict=True))
        feed.start_ns(STEP)
        got = [f for k in range(210) for f in feed.collect(UNIX + k * STEP)]
        assert len(got) == 2000
        assert all(abs(f.t_ns - at) < 2_000 for f, at in zip(got, arrivals, strict=True))
        assert health.late_frames == 0
        assert health.clock_jumps == 0

    def test_frames_stamped_by_a_clock_that_was_set_go_on(self):
        # bus time goes on steadily while the stamps are an hour ahead from the second on
        hour = 3600 * 1_000_000_000
        arrivals = [UNIX + k * 1_000_000 for k in range(1, 1000)]
        stamps = [t if k < 500 else t + hour for k, t in enumerate(arrivals)]
        feed, _, health = live(UNIX, *zip(arrivals, map(frame, stamps), strict=True))
        feed.start_ns(STEP)
        got = [f for k in range(110) for f in feed.collect(UNIX + k * STEP)]
        assert times(got) == arrivals
        assert health.late_frames == 0

    def test_times_stay_whole_microseconds(self):
        feed, _, _ = live(UNIX + 123, (UNIX + 4_567_891, frame(77_000)))
        feed.start_ns(STEP)
        [got] = feed.collect(UNIX + STEP)
        assert got.t_ns % US == 0

    @given(
        st.lists(
            st.tuples(st.integers(1, 100_000), st.integers(-20_000, 20_000)),
            min_size=1,
            max_size=60,
        )
    )
    def test_no_frame_is_lost_and_a_log_of_them_falls_into_the_same_steps(self, raw):
        # (time of arrival, stamp minus arrival), both in us
        raw.sort()
        arrivals = [
            (UNIX + at * US, frame(UNIX + (at + off) * US, i)) for i, (at, off) in enumerate(raw)
        ]
        feed, _, _ = live(UNIX, *arrivals)
        start = feed.start_ns(STEP)
        steps = range(start, start + 14 * STEP, STEP)
        dealt = {t: got for t in steps if (got := feed.collect(t))}
        recorded = [f for got in dealt.values() for f in got]
        assert sorted(f.data for f in recorded) == sorted(f.data for _, f in arrivals)
        for t, got in dealt.items():
            assert all(t - STEP < f.t_ns <= t for f in got)

        # the recording begins with the detector's own frame on the first step
        log = [frame(start, frame_id=0x31F), *recorded]
        replay = LogFeed(log, FastClock(), Health(), frozenset({0x31F}))
        assert replay.start_ns(STEP) == start
        again = {t: got for t in steps if (got := replay.collect(t))}
        assert again == dealt


class TestLogFeed:
    def test_starts_on_the_step_at_or_before_the_first_frame(self):
        for first, start in ((0, 0), (STEP, STEP), (STEP + US, STEP), (2 * STEP - US, STEP)):
            assert LogFeed([frame(first)], FastClock(), Health()).start_ns(STEP) == start

    def test_ends_after_the_last_frame(self):
        feed = LogFeed([frame(0), frame(25_000_000)], FastClock(), Health())
        feed.start_ns(STEP)
        got = [feed.collect(k * STEP) for k in range(5)]
        assert [None if g is None else times(g) for g in got] == [[0], [], [], [25_000_000], None]

    def test_an_empty_log_has_no_step(self):
        feed = LogFeed([], FastClock(), Health())
        assert feed.collect(feed.start_ns(STEP)) is None

    def test_a_frame_out_of_order_goes_to_the_step_that_is_due(self):
        health = Health()
        feed = LogFeed(
            [frame(0), frame(2 * STEP), frame(STEP), frame(3 * STEP)], FastClock(), health
        )
        feed.start_ns(STEP)
        got = [times(feed.collect(k * STEP)) for k in range(4)]
        assert got == [[0], [], [2 * STEP, STEP + US], [3 * STEP]]
        assert health.late_frames == 1

    def test_two_logs_in_one_go_on(self):
        stamps = [0, 50 * STEP, 0, STEP, 2 * STEP]
        health = Health()
        feed = LogFeed(map(frame, stamps), FastClock(), health)
        feed.start_ns(STEP)
        got = [t for k in range(60) for t in times(feed.collect(k * STEP) or [])]
        base = 49 * STEP + US
        assert got == [0, 50 * STEP, base, base + STEP, base + 2 * STEP]
        assert health.clock_jumps == 1
        assert JUMP_NS < 50 * STEP

    def test_replaced_frames_are_left_out_but_time_passes(self):
        log = [frame(0), frame(STEP, frame_id=0x310), frame(3 * STEP, frame_id=0x310)]
        feed = LogFeed(log, FastClock(), Health(), frozenset({0x310}))
        feed.start_ns(STEP)
        got = [feed.collect(k * STEP) for k in range(5)]
        assert got == [[log[0]], [], [], [], None]
        assert feed.n_replaced == 2


def test_idle_feed_only_waits():
    feed = IdleFeed(FastClock(STEP // 2))
    assert feed.start_ns(STEP) == STEP
    assert feed.collect(STEP) == []
    assert feed.next_ns() == STEP
