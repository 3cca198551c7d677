"""What the reports of several objects and scans say together."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from can_imm.relations import (
    MEMORY_DTYPE,
    NO_LANE,
    OVERTAKING_NS,
    TWIN_SCANS,
    hesitate_,
    relate_,
    shift_lanes_,
)
from can_imm.types import CUT_IN, CUT_OUT, OVERTAKING_ANOTHER, REPORT_DTYPE, Manoeuvre

S = 1_000_000_000
KEEP, CHANGE = Manoeuvre.KEEP_LANE, Manoeuvre.LANE_CHANGE


class Road:
    """Reports of vehicles scan by scan, each in the slot of its id."""

    def __init__(self, slots: int = 6) -> None:
        self.memory = np.zeros(slots, MEMORY_DTYPE)
        self.ids = np.full(slots, -1, np.int32)
        self.age = np.zeros(slots, np.int32)
        self.t_ns = 0

    def scan(self, vehicles: dict[int, dict[str, Any]], seconds: float = 0.1) -> dict[int, Any]:
        """Reports by slot; an object id is 10 plus its slot."""
        self.t_ns += int(seconds * S)
        reports = np.zeros(len(self.ids), REPORT_DTYPE)
        reports["duplicate_of"] = -1
        for s in range(len(self.ids)):
            self.age[s] = self.age[s] + 1 if s in vehicles else 0
            self.ids[s] = 10 + s if s in vehicles else -1
        for row, (s, what) in enumerate(sorted(vehicles.items())):
            fields = {"manoeuvre": KEEP, "x": (30.0 + 20.0 * s, 0.0, 0.0, 0.0), **what}
            fields.setdefault("lane", round(fields["x"][2] / 3.5))
            for name, value in fields.items():
                reports[row][name] = value
            reports[row]["t_ns"], reports[row]["object_id"] = self.t_ns, 10 + s
            if "age" not in what:
                reports[row]["age"] = self.age[s]
        relate_(self.ids, self.memory, reports, len(vehicles))
        return {int(s): reports[row] for row, s in enumerate(sorted(vehicles))}


def at(lane: int, x: float = 40.0, vx: float = 0.0, y: float = 0.0, **what: Any) -> dict[str, Any]:
    """A vehicle that is y to the left of the middle of a lane."""
    return {"lane": lane, "x": (x, vx, 3.5 * lane + y, 0.0), **what}


def changing(direction: int, lane: int, **what: Any) -> dict[str, Any]:
    return at(lane, manoeuvre=CHANGE, direction=direction, **what)


# ---- when a lane change is said


def test_a_lane_change_is_said_when_that_pays_and_until_it_is_over() -> None:
    memory, ids = np.zeros(3, MEMORY_DTYPE), np.array([-1, 4, 5], np.int32)

    def said(p: float, age: int = 9, dt: float = 0.1) -> tuple[int, int, int]:
        reports = np.zeros(2, REPORT_DTYPE)
        reports["age"], reports["direction"] = age, -1
        best, second = (CHANGE, KEEP) if p >= 0.5 else (KEEP, CHANGE)
        reports["manoeuvre"], reports["second"] = best, second
        reports["probability"], reports["second_probability"] = max(p, 1 - p), min(p, 1 - p)
        reports[0]["manoeuvre"], reports[0]["second"] = KEEP, Manoeuvre.RECEDING
        reports["t_ns"] = memory["told_ns"][1] + round(dt * S)
        hesitate_(ids, memory, 1.0, reports, 2)
        assert reports[0]["manoeuvre"] == KEEP
        one = reports[1]
        assert one["probability"] == pytest.approx(p if one["manoeuvre"] == CHANGE else 1 - p)
        assert one["second_probability"] == pytest.approx(1 - one["probability"])
        return one["manoeuvre"], one["second"], one["direction"]

    assert said(0.8) == (KEEP, CHANGE, 0), "to say it costs 0.2 s, not to say it 0.06 s"
    assert said(0.9) == (CHANGE, KEEP, -1), "0.1 s, and now 0.06 + 0.08 s"
    assert said(0.51) == (CHANGE, KEEP, -1), "still"
    assert said(0.49)[0] == KEEP
    assert said(0.9)[0] == KEEP, "that would be another one, 0.1 s and 0.08 s"
    assert said(0.4)[0] == KEEP
    assert said(0.9)[0] == KEEP, "it was something else meanwhile"
    assert said(0.9)[0] == CHANGE
    assert said(0.2)[0] == KEEP
    assert said(0.92)[0] == CHANGE, "0.08 s and 0.084 s: at once"
    assert said(0.95, age=1)[0] == KEEP, "another object in this slot"
    assert said(0.9)[0] == KEEP, "of which nothing was held back before"
    assert said(0.9)[0] == CHANGE
    assert said(0.2)[0] == KEEP
    assert [said(0.85, dt=0.05)[0] for _ in range(5)] == 4 * [KEEP] + [CHANGE], "twice as often"
    assert said(0.2)[0] == KEEP
    assert said(0.85, dt=0.6)[0] == KEEP, "0.15 s: who was not heard for long counts 0.1 s"


# ---- lanes


def test_the_lane_that_an_object_kept() -> None:
    road = Road()
    road.scan({0: at(1)})
    assert road.memory[0]["kept"] == 1
    for lane in (1, 2):
        road.scan({0: changing(1, lane)})
        assert road.memory[0]["kept"] == 1, "until it arrives"
    road.scan({0: at(2)})
    assert (road.memory[0]["kept"], road.memory[0]["left"]) == (2, 1)
    road.scan({0: at(1)})
    assert (road.memory[0]["kept"], road.memory[0]["left"]) == (1, NO_LANE)


def test_who_is_said_late_to_change_lanes_leaves_the_lane_it_was_in_before() -> None:
    """It may have crossed the line by then."""
    road = Road()
    road.scan({0: at(0), 1: at(1)})
    road.memory["unsaid"][:2] = 0.05
    reports = road.scan({0: at(-1), 1: at(0)})
    assert [reports[s]["flags"] for s in (0, 1)] == [0, 0]
    reports = road.scan({0: changing(-1, -1), 1: changing(-1, 0)})
    assert [reports[s]["flags"] for s in (0, 1)] == [CUT_OUT, CUT_IN]
    road.memory["unsaid"] = 0.0
    road.scan({0: at(-1), 1: at(0)})
    assert road.memory["kept"][:2].tolist() == [-1, 0]


@pytest.mark.parametrize("other", [Manoeuvre.STATIONARY, Manoeuvre.ONCOMING])
def test_who_does_not_drive_along_keeps_no_lane(other: Manoeuvre) -> None:
    road = Road()
    road.scan({0: at(1, manoeuvre=other)})
    assert road.memory[0]["kept"] == NO_LANE
    assert road.scan({0: changing(-1, 1)})[0]["flags"] == 0


@pytest.mark.parametrize(
    ("kept", "direction", "flags"),
    [
        (1, -1, CUT_IN),
        (-1, 1, CUT_IN),
        (0, 1, CUT_OUT),
        (0, -1, CUT_OUT),
        (1, 1, 0),
        (2, -1, 0),
        (-2, 1, 0),
        (-1, -1, 0),
    ],
)
def test_into_and_out_of_the_egos_lane(kept: int, direction: int, flags: int) -> None:
    """All along the lane change, wherever the vehicle is by now; not before, and not after it."""
    road = Road()
    assert road.scan({0: at(kept)})[0]["flags"] == 0
    for lane in (kept, kept, kept + direction):
        assert road.scan({0: changing(direction, lane)})[0]["flags"] == flags
    assert road.scan({0: at(kept + direction)})[0]["flags"] == 0


def test_a_lane_change_that_nobody_saw_begin() -> None:
    """Where it comes from is not known, so it is neither a cut-in nor a cut-out."""
    road = Road()
    for _ in range(3):
        assert road.scan({0: changing(-1, 1)})[0]["flags"] == 0


def test_a_new_object_in_the_slot_knows_nothing() -> None:
    road = Road()
    road.scan({0: at(1)})
    road.scan({})
    assert road.scan({0: changing(-1, 1)})[0]["flags"] == 0
    assert road.memory[0]["kept"] == NO_LANE


def test_lanes_are_counted_anew() -> None:
    """The ego went to the left: what was lane 1 is lane 0; what is not known stays unknown."""
    road = Road()
    road.scan({0: at(1), 1: at(-1)})
    road.scan({0: changing(1, 1)})
    assert (road.memory[0]["kept"], road.memory[0]["left"]) == (1, 1)
    road.memory[2]["kept"] = road.memory[2]["left"] = NO_LANE
    shift_lanes_(road.memory, 1)
    assert (road.memory[0]["kept"], road.memory[0]["left"]) == (0, 0)
    assert (road.memory[2]["kept"], road.memory[2]["left"]) == (NO_LANE, NO_LANE)
    assert road.scan({0: changing(1, 0)})[0]["flags"] == CUT_OUT
    shift_lanes_(road.memory, -1)
    assert road.memory[0]["kept"] == 1


# ---- overtaking


def overtaking(road: Road, x: float, vx: float, slow: dict[str, Any], **what: Any) -> int:
    return int(road.scan({0: at(1, x, vx, **what), 1: slow})[0]["flags"])


def pulled_out() -> Road:
    """Vehicle 0 has just left lane 0 to the left."""
    road = Road()
    road.scan({0: at(0, 20.0, 2.0)})
    road.scan({0: changing(1, 0, x=20.0, vx=2.0)})
    return road


def test_overtaking_another() -> None:
    road = pulled_out()
    for x in (21.0, 40.0, 60.0, 69.0):
        assert overtaking(road, x, 3.0, at(0, 60.0)) == OVERTAKING_ANOTHER
    assert overtaking(road, 75.0, 3.0, at(0, 60.0)) == 0, "past it"


def test_already_while_it_pulls_out() -> None:
    road = pulled_out()
    reports = road.scan({0: changing(1, 0, x=30.0, vx=3.0, y=1.5), 1: at(0, 50.0)})
    assert reports[0]["flags"] & OVERTAKING_ANOTHER
    assert reports[0]["flags"] & CUT_OUT
    assert reports[1]["flags"] == 0


def test_when_it_pulls_in_again_it_has_overtaken() -> None:
    road = pulled_out()
    assert overtaking(road, 40.0, 3.0, at(0, 60.0)) == OVERTAKING_ANOTHER
    reports = road.scan({0: changing(-1, 1, x=60.0, vx=3.0), 1: at(0, 60.0)})
    assert reports[0]["flags"] == CUT_IN


@pytest.mark.parametrize(
    "slow",
    [
        at(0, 60.0, 2.8),
        at(1, 60.0),
        at(-1, 60.0),
        at(0, 75.0),
        at(0, 60.0, -20.0, manoeuvre=Manoeuvre.STATIONARY),
        at(0, 60.0, -50.0, manoeuvre=Manoeuvre.ONCOMING),
        {"lane": 0, "x": (34.0, 0.0, 3.3, 0.0)},
    ],
    ids=["as fast", "its own lane", "another lane", "far", "stands", "oncoming", "same place"],
)
def test_what_is_not_overtaking(slow: dict[str, Any]) -> None:
    assert overtaking(pulled_out(), 30.0, 3.0, slow) & OVERTAKING_ANOTHER == 0


def test_passing_without_a_lane_change_or_long_after_is_not_overtaking() -> None:
    road = Road()
    road.scan({0: at(1)})
    assert overtaking(road, 40.0, 3.0, at(0, 60.0)) == 0
    road = pulled_out()
    assert overtaking(road, 40.0, 3.0, at(0, 60.0), age=30) == OVERTAKING_ANOTHER
    road.t_ns += OVERTAKING_NS
    assert overtaking(road, 45.0, 3.0, at(0, 60.0), age=31) == 0


# ---- twins


def pair(dx: float = 1.0, dvx: float = 0.2, dy: float = 0.3) -> dict[int, dict[str, Any]]:
    """An old object in slot 2 and a younger one at the same place in slot 0."""
    return {
        0: {"x": (40.0 + dx, 1.0 + dvx, 3.5 + dy, 0.0)},
        2: {"x": (40.0, 1.0, 3.5, 0.0), "age": 100},
    }


def test_twins_after_some_scans_and_no_more_when_they_part() -> None:
    road = Road()
    for k in range(1, 6):
        reports = road.scan(pair())
        assert reports[0]["duplicate_of"] == (12 if k >= TWIN_SCANS else -1)
        assert reports[2]["duplicate_of"] == -1, "the older one is the vehicle"
    assert road.scan(pair(dx=5.0))[0]["duplicate_of"] == -1
    for k in range(1, TWIN_SCANS + 1):
        expected = 12 if k == TWIN_SCANS else -1
        assert road.scan(pair())[0]["duplicate_of"] == expected, "and from the beginning again"


@pytest.mark.parametrize("apart", [{"dx": 3.1}, {"dx": -3.1}, {"dvx": 1.1}, {"dy": 1.1}])
def test_two_vehicles_are_no_twins(apart: dict[str, float]) -> None:
    road = Road()
    for _ in range(10):
        reports = road.scan(pair(**apart))
        assert (reports[0]["duplicate_of"], reports[2]["duplicate_of"]) == (-1, -1)


def test_of_three_at_one_place_two_are_twins_of_the_oldest() -> None:
    road = Road()
    vehicles = {s: {"x": (40.0, 0.0, 0.0, 0.0), "age": 10 + s} for s in (1, 3, 5)}
    for _ in range(TWIN_SCANS):
        for what in vehicles.values():
            what["age"] += 1
        reports = road.scan(vehicles)
    said = {s: int(report["duplicate_of"]) for s, report in reports.items()}
    assert said[5] == -1
    assert said[1] in (15, 13)
    assert said[3] == 15


def test_equally_old_twins_name_one() -> None:
    road = Road()
    for _ in range(TWIN_SCANS):
        reports = road.scan({s: {"x": (40.0, 0.0, 0.0, 0.0)} for s in (1, 4)})
    assert (reports[1]["duplicate_of"], reports[4]["duplicate_of"]) == (-1, 11)


def test_a_track_that_coasts_is_nobodys_twin() -> None:
    road = Road()
    for _ in range(10):
        vehicles = pair()
        vehicles[2]["coasting"] = True
        assert road.scan(vehicles)[0]["duplicate_of"] == -1


def test_another_twin_counts_from_its_own_beginning() -> None:
    road = Road()
    for _ in range(TWIN_SCANS - 1):
        road.scan(pair())
    vehicles = pair()
    vehicles[4] = {**vehicles.pop(2)}
    assert road.scan(vehicles)[0]["duplicate_of"] == -1


def test_nobody_there() -> None:
    assert Road().scan({}) == {}
