"""Events out of reports."""

from __future__ import annotations

from collections import Counter
from itertools import groupby, pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_imm.events import Event, EventCollector
from can_imm.types import (
    CUT_IN,
    CUT_OUT,
    OVERTAKING_ANOTHER,
    REPORT_DTYPE,
    Manoeuvre,
)

MS = 1_000_000
M = Manoeuvre
KL, LC = M.KEEP_LANE, M.LANE_CHANGE


class Stream:
    """Feeds a collector a scan every 100 ms; objects age by themselves."""

    def __init__(self) -> None:
        self.collector = EventCollector()
        self.t_ms = 0
        self.age: Counter[int] = Counter()

    def scan(self, *said: dict[str, Any]) -> None:
        """One report per dictionary of fields; ``id`` and ``m`` for object and manoeuvre."""
        reports = np.zeros(len(said), REPORT_DTYPE)
        reports["change"] = np.nan
        reports["duplicate_of"] = -1
        reports["ego_speed"] = np.nan
        for row, fields in zip(reports, said, strict=True):
            fields = {"id": 1, **fields}
            object_id = fields.pop("id")
            self.age[object_id] += 1
            row["t_ns"], row["object_id"], row["age"] = (
                self.t_ms * MS,
                object_id,
                self.age[object_id],
            )
            row["manoeuvre"] = fields.pop("m")
            row["probability"] = fields.pop("probability", 0.9)
            row["x"][:2] = fields.pop("gap", 50.0), fields.pop("speed", 0.0)
            for name, value in fields.items():
                row[name] = value
        self.collector(self.t_ms * MS, reports)
        self.t_ms += 100

    def scans(self, n: int, *said: dict[str, Any]) -> None:
        for _ in range(n):
            self.scan(*said)

    def found(self) -> list[Event]:
        self.collector.finish()
        return self.collector.found


def spans(events: list[Event]) -> list[tuple[int, str, int, int]]:
    return [(e.object_id, e.manoeuvre.name, e.from_ns // MS, e.to_ns // MS) for e in events]


def test_a_lane_change_with_everything_that_is_known_of_it():
    """The label begins before the border is crossed and ends .2 s before it is crossed."""
    s = Stream()
    s.scans(5, {"m": KL, "lane": 1, "gap": 60.0})
    for k in range(10):
        s.scan({
            "m": LC, "direction": -1, "lane": 1, "flags": CUT_IN if k > 3 else 0,
            "gap": 40.0 - k, "speed": -2.0 - k, "probability": 0.5 if k % 2 else 0.9,
            "ego_speed": 25.0,
        })  # fmt: skip
    s.scans(2, {"m": KL, "lane": 1})
    s.scans(10, {"m": KL, "lane": 0, "gap": 5.0})
    (event,) = s.found()
    assert event == Event(
        1, LC, "CUT_IN", -1, 500 * MS, 1400 * MS, pytest.approx(0.7), 1, 0, 40.0, -2.0, 31.0, 23.0
    )
    assert event.middle_ns == 950 * MS


def test_a_lane_change_lasts_from_when_it_began_to_when_it_ended_as_far_as_that_is_told():
    """By what was told of it at last, and not beyond what was seen of the object."""
    s = Stream()
    s.scans(10, {"m": KL, "lane": 0})
    s.scans(10, {"m": LC, "direction": 1, "lane": 0, "change": (0.8, 4.0)})
    s.scans(10, {"m": LC, "direction": 1, "lane": 1, "change": (0.3, 3.5)})
    s.scans(3, {"m": KL, "lane": 1, "change": (0.4, 2.85)})
    s.scans(2, {"m": KL, "lane": 1})
    s.scans(10, {"m": KL, "lane": 1, "change": (9.0, 9.5)})  # another one, later
    (event,) = s.found()
    assert (event.from_ns, event.to_ns) == (400 * MS, 2850 * MS)
    assert (event.gap, event.lane_from, event.lane_to) == (50.0, 0, 1)


def test_a_lane_change_does_not_last_beyond_its_object():
    s = Stream()
    s.scans(2, {"m": KL, "id": 2})
    s.scans(8, {"m": LC, "direction": -1, "change": (-1.0, 7.0)})
    (event,) = s.found()
    assert (event.from_ns, event.to_ns) == (200 * MS, 900 * MS)


def test_other_events_do_not_last_as_long_as_a_lane_change():
    s = Stream()
    s.scans(5, {"m": M.APPROACHING, "change": (-1.0, 7.0)})
    (event,) = s.found()
    assert (event.from_ns, event.to_ns) == (0, 400 * MS)


def test_the_lane_before_is_that_of_half_a_second_before():
    s = Stream()
    s.scans(8, {"m": KL, "lane": 0})
    s.scans(2, {"m": KL, "lane": 1})  # said late: the border is behind it
    s.scans(10, {"m": LC, "direction": 1, "lane": 1})
    s.scans(20, {"m": KL, "lane": 1})
    s.scans(10, {"m": KL, "lane": 2})  # has nothing to do with it
    (event,) = s.found()
    assert (event.lane_from, event.lane_to) == (0, 1)


def test_other_events_have_the_lanes_in_which_they_are_said():
    s = Stream()
    s.scans(5, {"m": KL, "lane": 0})
    s.scans(10, {"m": M.APPROACHING, "lane": 1})
    s.scans(5, {"m": KL, "lane": 2})
    (event,) = s.found()
    assert (event.lane_from, event.lane_to) == (1, 1)
    assert np.isnan(event.abs_speed)


@pytest.mark.parametrize(("scans", "n"), [(3, 0), (4, 1)])
def test_an_event_lasts_for_three_tenths_at_least(scans, n):
    s = Stream()
    s.scans(5, {"m": KL})
    s.scans(scans, {"m": M.RECEDING})
    s.scans(5, {"m": KL})
    assert len(s.found()) == n


def test_flicker_is_no_event():
    s = Stream()
    for _ in range(20):
        s.scan({"m": KL})
        s.scan({"m": M.APPROACHING})
    assert s.found() == []


@pytest.mark.parametrize(("scans", "n"), [(4, 1), (5, 2)])
def test_short_interruptions_do_not_split(scans, n):
    s = Stream()
    s.scans(6, {"m": M.RECEDING, "gap": 30.0})
    s.scans(scans, {"m": LC, "direction": 1})
    s.scans(6, {"m": M.RECEDING, "gap": 20.0})
    events = [e for e in s.found() if e.manoeuvre is M.RECEDING]
    assert len(events) == n
    assert events[-1].to_ns == (11 + scans) * 100 * MS
    assert events[-1].min_gap == 20.0


def test_directions_and_objects_are_told_apart():
    s = Stream()
    s.scans(5, {"m": LC, "direction": 1}, {"id": 2, "m": LC, "direction": -1})
    s.scans(5, {"m": LC, "direction": -1}, {"id": 2, "m": LC, "direction": -1})
    events = s.found()
    assert spans(events) == [
        (1, "LANE_CHANGE", 0, 400),
        (2, "LANE_CHANGE", 0, 900),
        (1, "LANE_CHANGE", 500, 900),
    ]
    assert [e.direction for e in events] == [1, -1, -1]


@pytest.mark.parametrize("how", ["gone for a scan", "younger", "as old"])
def test_an_id_that_is_reused_is_another_object(how):
    s = Stream()
    s.scans(1 if how == "as old" else 5, {"m": M.RECEDING})
    if how == "gone for a scan":
        s.scan({"id": 2, "m": KL})
    else:
        s.age[1] = 0
    s.scans(5, {"m": M.RECEDING})
    events = s.found()
    assert len(events) == (1 if how == "as old" else 2)
    assert events[-1].from_ns == {"gone for a scan": 600, "younger": 500, "as old": 100}[how] * MS
    assert s.collector.objects == (3 if how == "gone for a scan" else 2)


@pytest.mark.parametrize(("scans", "n"), [(4, 1), (6, 2)])
def test_a_scan_without_any_report_ends_nothing_at_once(scans, n):
    """The detector says nothing of a scan that it does not use: a late or a repeated one."""
    s = Stream()
    s.scans(5, {"m": M.RECEDING})
    s.scans(scans)
    s.scans(5, {"m": M.RECEDING})
    assert len(s.found()) == s.collector.objects == n


def test_a_coasting_object_is_the_same_one():
    s = Stream()
    s.scans(5, {"m": M.RECEDING})
    s.age[1] -= 1
    s.scan({"m": M.RECEDING, "coasting": True})
    s.scans(5, {"m": M.RECEDING})
    assert spans(s.found()) == [(1, "RECEDING", 0, 1000)]


def test_cut_outs_and_flags_that_flicker():
    s = Stream()
    for flags in [0] * 5 + [CUT_OUT] * 5:
        s.scan({"m": LC, "direction": 1, "flags": flags})
    s.scans(10, {"m": KL, "lane": 1})
    for flags in [0] * 9 + [CUT_IN]:
        s.scan({"m": LC, "direction": -1, "flags": flags, "lane": 1})
    s.scans(10, {"m": KL, "lane": 0})
    assert [e.event for e in s.found()] == ["CUT_OUT", ""]


@pytest.mark.parametrize(("after", "name"), [(20, ""), (1, "CUT_IN")])
def test_a_cut_in_that_is_given_up_is_none_but_one_that_is_lost_sight_of_is(after, name):
    s = Stream()
    s.scans(10, {"m": LC, "direction": 1, "flags": CUT_IN, "lane": -1})
    s.scans(after, {"m": KL, "lane": -1})
    (event,) = s.found()
    assert event.event == name


def test_overtaking_another_is_an_event_across_the_manoeuvres():
    s = Stream()
    s.scans(5, {"m": LC, "direction": 1, "lane": 0, "flags": OVERTAKING_ANOTHER})
    s.scans(8, {"m": M.RECEDING, "lane": 1, "flags": OVERTAKING_ANOTHER})
    s.scans(5, {"m": LC, "direction": -1, "lane": 0, "flags": OVERTAKING_ANOTHER})
    events = s.found()
    assert [(e.manoeuvre.name, e.event, e.from_ns // MS, e.to_ns // MS) for e in events] == [
        ("LANE_CHANGE", "", 0, 400),
        ("OVERTAKING", "OVERTAKING", 0, 1700),
        ("RECEDING", "", 500, 1200),
        ("LANE_CHANGE", "", 1300, 1700),
    ]


def test_two_lanes_know_overtaking_as_a_manoeuvre_and_keeping_as_none():
    s = Stream()
    s.scans(5, {"m": M.KEEP_RIGHT, "lane": 0})
    s.scans(6, {"m": M.OVERTAKING, "lane": 0})
    s.scans(5, {"m": M.KEEP_LEFT, "lane": 1})
    (event,) = s.found()
    assert (event.manoeuvre, event.event) == (M.OVERTAKING, "OVERTAKING")
    assert (event.lane_from, event.lane_to) == (0, 1)


def test_what_stands_or_comes_towards_us_is_only_counted():
    s = Stream()
    stands, comes = {"m": M.STATIONARY}, {"id": 2, "m": M.ONCOMING}
    for _ in range(3):
        s.scans(5, stands, comes, {"id": 3, "m": KL})
        s.scans(8, {"m": M.APPROACHING}, comes)
    events = s.found()
    assert {e.manoeuvre for e in events} == {M.APPROACHING}
    assert s.collector.counted == {M.STATIONARY: 1, M.ONCOMING: 1}
    assert s.collector.objects == 5  # object 3 went twice


def test_shares_are_of_the_time_without_duplicates_and_unknown():
    s = Stream()
    s.scans(3, {"m": M.UNKNOWN}, {"id": 2, "m": KL, "duplicate_of": 1})
    s.scans(6, {"m": KL}, {"id": 2, "m": M.RECEDING, "duplicate_of": 1})
    s.scans(2, {"m": LC, "direction": 1}, {"id": 2, "m": M.RECEDING, "duplicate_of": 1})
    s.found()
    assert s.collector.objects == 1
    assert s.collector.share() == {KL: pytest.approx(0.75), LC: pytest.approx(0.25)}


def test_a_duplicate_makes_no_event_of_its_own():
    s = Stream()
    change = {"m": LC, "direction": 1}
    s.scans(2, {"m": KL}, {"id": 2, "m": KL})
    s.scans(4, change, {"id": 2, **change})  # not yet recognised
    s.scans(8, change, {"id": 2, **change, "duplicate_of": 1})
    s.scans(8, {"m": KL}, {"id": 2, "m": KL, "duplicate_of": 1})
    assert spans(s.found()) == [(1, "LANE_CHANGE", 200, 1300)]


def test_a_duplicate_carries_on_what_the_older_track_began():
    s = Stream()
    s.scans(2, {"m": M.APPROACHING, "gap": 60.0})
    s.scans(5, {"m": M.APPROACHING}, {"id": 2, "m": M.APPROACHING, "duplicate_of": 1})
    s.scans(5, {"id": 2, "m": M.APPROACHING, "gap": 10.0})
    (event,) = s.found()
    assert spans([event]) == [(1, "APPROACHING", 0, 1100)]
    assert (event.gap, event.min_gap) == (60.0, 10.0)
    assert s.collector.objects == 1


LABELS = [KL, M.APPROACHING, M.REAR_END, M.STATIONARY, M.UNKNOWN]


@given(st.lists(st.sampled_from(LABELS), max_size=60))
def test_what_is_said_for_long_is_found_once(labels):
    """Every stretch of .4 s and more lies in exactly one event; no event is out of the air."""
    s = Stream()
    for label in labels:
        s.scan({"m": label})
    events = s.found()
    at = 0
    for label, run in groupby(labels):
        n = len(list(run))
        if n >= 4 and label in (M.APPROACHING, M.REAR_END):
            inside = [
                e
                for e in events
                if e.manoeuvre is label
                and e.from_ns <= at * 100 * MS
                and e.to_ns >= (at + n - 1) * 100 * MS
            ]
            assert len(inside) == 1
        at += n
    for event in events:
        first, last = event.from_ns // MS // 100, event.to_ns // MS // 100
        assert labels[first] is event.manoeuvre is labels[last]
        inside = "".join(".x"[label is event.manoeuvre] for label in labels[first : last + 1])
        assert "....." not in inside  # .6 s between two of them
        assert inside.count("xx") >= 1
    for kind in (M.APPROACHING, M.REAR_END):
        mine = [e for e in events if e.manoeuvre is kind]
        assert all(b.from_ns - a.to_ns > 500 * MS for a, b in pairwise(mine))
