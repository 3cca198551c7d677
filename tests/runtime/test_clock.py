"""Clocks: steady bus time under slewing and jumps of the wall clock."""

from __future__ import annotations

import pytest

from can_imm.runtime import clock as clocks
from can_imm.runtime.clock import FastClock, PacedClock, WallClock

MS = 1_000_000
UNIX_NS = 1_700_000_000_000_000_000


@pytest.fixture
def machine(monkeypatch):
    """A machine whose two clocks the test sets."""

    class Machine:
        wall_ns = UNIX_NS
        steady_ns = 5_000 * MS

        def pass_ns(self, ns: int, wall_ns: int | None = None) -> None:
            self.steady_ns += ns
            self.wall_ns += ns if wall_ns is None else wall_ns

    machine = Machine()
    monkeypatch.setattr(clocks.time, "time_ns", lambda: machine.wall_ns)
    monkeypatch.setattr(clocks, "steady_ns", lambda: machine.steady_ns)
    return machine


def test_wall_clock_is_unix_time(machine):
    clock = WallClock()
    machine.pass_ns(10 * MS)
    assert clock.now_ns() == UNIX_NS + 10 * MS
    assert clock.remaining_s(UNIX_NS + 15 * MS) == pytest.approx(0.005)
    assert clock.remaining_s(UNIX_NS + 5 * MS) == pytest.approx(-0.005)


def test_wall_clock_follows_slewing(machine):
    clock = WallClock()
    for _ in range(1000):
        machine.pass_ns(10 * MS, wall_ns=10 * MS + 5000)
        clock.now_ns()
    assert clock.now_ns() == machine.wall_ns
    assert clock.jumps == 0


@pytest.mark.parametrize("jump_s", [3600, -3600, 1, -1])
def test_wall_clock_goes_on_when_the_clock_is_set(machine, jump_s):
    clock = WallClock()
    machine.pass_ns(10 * MS)
    before = clock.now_ns()
    machine.pass_ns(10 * MS, wall_ns=10 * MS + jump_s * 1_000_000_000)
    assert clock.now_ns() == before + 10 * MS
    assert clock.jumps == 1
    machine.pass_ns(10 * MS)
    assert clock.now_ns() == before + 20 * MS
    assert clock.jumps == 1


def test_fast_clock_is_always_due_and_never_goes_back():
    clock = FastClock(100)
    assert clock.now_ns() == 100
    assert clock.remaining_s(500) <= 0
    assert clock.remaining_s(300) <= 0
    assert clock.now_ns() == 500


def test_paced_clock_starts_at_the_first_moment_asked_for(machine):
    clock = PacedClock()
    machine.pass_ns(7 * MS)
    assert clock.remaining_s(42 * MS) <= 0
    assert clock.remaining_s(52 * MS) == pytest.approx(0.010)
    machine.pass_ns(4 * MS)
    assert clock.now_ns() == 46 * MS
    assert clock.remaining_s(52 * MS) == pytest.approx(0.006)
