"""CSV times and the collection of lane changes."""

from __future__ import annotations

import numpy as np
import pytest

from can_imm.cli.reports import LaneChanges, seconds
from can_imm.types import REPORT_DTYPE, Manoeuvre

MS = 1_000_000


@pytest.mark.parametrize(
    ("t_ns", "text"),
    [
        (0, "0.000000"),
        (1_700_000_000_123_456_000, "1700000000.123456"),
        (10_000_000, "0.010000"),
        (-10_000_000, "-0.010000"),
    ],
)
def test_seconds_are_exact(t_ns, text):
    assert seconds(t_ns) == text


def feed(collector: LaneChanges, t_ms: int, *said: tuple[int, Manoeuvre, int]) -> None:
    reports = np.zeros(len(said), REPORT_DTYPE)
    for row, (object_id, manoeuvre, direction) in zip(reports, said, strict=True):
        row["t_ns"], row["object_id"] = t_ms * MS, object_id
        row["manoeuvre"], row["direction"] = manoeuvre, direction
    collector(t_ms * MS, reports)


def found(collector: LaneChanges) -> list[tuple[int, int, int, int]]:
    return [(c.object_id, c.first_ns // MS, c.last_ns // MS, c.direction) for c in collector.found]


LC, KR = Manoeuvre.LANE_CHANGE, Manoeuvre.KEEP_RIGHT


def test_a_stretch_is_one_lane_change():
    changes = LaneChanges()
    for t in range(0, 3000, 100):
        feed(changes, t, (1, LC if 1000 <= t < 2000 else KR, 1 if 1000 <= t < 2000 else 0))
    assert found(changes) == [(1, 1000, 1900, 1)]


def test_objects_and_directions_are_told_apart():
    changes = LaneChanges()
    feed(changes, 0, (1, LC, 1), (2, LC, -1))
    feed(changes, 100, (1, LC, -1), (2, LC, -1))
    assert found(changes) == [(1, 0, 0, 1), (2, 0, 100, -1), (1, 100, 100, -1)]


def test_a_short_interruption_does_not_make_two():
    changes = LaneChanges()
    for t in (0, 100, 1000, 1100):
        feed(changes, t, (1, LC, 1))
    feed(changes, 2200, (1, LC, 1))
    assert found(changes) == [(1, 0, 1100, 1), (1, 2200, 2200, 1)]
