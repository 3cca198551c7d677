"""Scans are handed out at their time, in order, and none is lost."""

from hypothesis import given
from hypothesis import strategies as st

from can_imm.sim.player import Player
from can_imm.types import Scan

MS = 1_000_000


def scans(*times_ms: int) -> list[Scan]:
    made = []
    for t in times_ms:
        scan = Scan(1)
        scan.t_ns = t * MS
        made.append(scan)
    return made


def test_a_scan_comes_with_the_first_step_at_or_after_its_time() -> None:
    due = scans(0, 100, 205)
    player = Player(due)
    got = {t: player.step(t * MS) for t in range(0, 300, 10)}
    assert {t: scan for t, scan in got.items() if scan} == {0: due[0], 100: due[1], 210: due[2]}
    assert player.done


def test_time_zero_of_the_scans_may_lie_anywhere_on_the_clock() -> None:
    due = scans(0, 100)
    player = Player(due, start_ns=5000 * MS)
    assert player.step(4990 * MS) is None
    assert player.step(5000 * MS) is due[0]
    assert player.step(5090 * MS) is None
    assert not player.done
    assert player.step(5100 * MS) is due[1]


def test_nothing_to_play() -> None:
    player = Player([])
    assert player.done
    assert player.step(0) is None


@given(st.lists(st.integers(0, 1000), max_size=20), st.lists(st.integers(0, 1500), min_size=1))
def test_order_and_time_hold_for_any_steps(times: list[int], steps: list[int]) -> None:
    due = scans(*sorted(times))
    player = Player(due)
    got = []
    for t in sorted(steps):
        scan = player.step(t * MS)
        if scan is None:
            assert len(got) == len(due) or due[len(got)].t_ns > t * MS
        else:
            assert scan.t_ns <= t * MS
            got.append(scan)
    assert got == due[: len(got)]
