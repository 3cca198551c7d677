"""What is written of the reports, and which events the table keeps."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from can_imm.cli.detection import weightiest
from can_imm.cli.reports import MOTORWAY_COLUMNS, EventFile, ReportCsv, seconds
from can_imm.events import Event, EventCollector
from can_imm.types import CUT_IN, OVERTAKING_ANOTHER, REPORT_DTYPE, CanImmError, Manoeuvre

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


def reports(*said: dict[str, object]) -> np.ndarray:
    rows = np.zeros(len(said), REPORT_DTYPE)
    rows["change"] = np.nan
    rows["duplicate_of"] = -1
    for row, fields in zip(rows, said, strict=True):
        for name, value in fields.items():
            row[name] = value
    return rows


def test_motorway_columns_follow_the_others_and_the_log_comes_last(tmp_path):
    plain, more = tmp_path / "plain.csv", tmp_path / "more.csv"
    rows = reports(
        {"manoeuvre": Manoeuvre.LANE_CHANGE, "flags": CUT_IN | OVERTAKING_ANOTHER, "lane": -2},
        {"manoeuvre": Manoeuvre.ONCOMING, "duplicate_of": 0},
    )
    rows["p"][:, 8:] = [[0.5, 0.25, 0.125], [0, 0, 1]]
    without, with_all = ReportCsv(str(plain)), ReportCsv(str(more), motorway=True, with_log=True)
    with_all.log = "a.log"
    for listener in (without, with_all):
        listener(0, rows)
        listener.close()
    before, after = ([*csv.reader(path.read_text().splitlines())] for path in (plain, more))
    assert [row[: len(before[0])] for row in after] == before
    assert [row[len(before[0]) :] for row in after] == [
        ["p_keep_lane", "p_stationary", "p_oncoming", "flags", "duplicate_of", "log"],
        ["0.5000", "0.2500", "0.1250", "CUT_IN|OVERTAKING", "", "a.log"],
        ["0.0000", "0.0000", "1.0000", "", "0", "a.log"],
    ]
    assert len(MOTORWAY_COLUMNS) == 5


def collected() -> EventCollector:
    """A cut-in by object 7 from 1.0 to 1.4 s, at 0.9 +- 0."""
    events = EventCollector()
    for k in range(5):
        change = {
            "t_ns": 1000 * MS + 100 * k * MS, "object_id": 7, "age": 1 + k, "direction": -1,
            "manoeuvre": Manoeuvre.LANE_CHANGE, "probability": 0.9, "flags": CUT_IN,
            "lane": 1 if k < 3 else 0, "x": (40.004 - k, -2.5, 0, 0), "ego_speed": np.nan,
        }  # fmt: skip
        events(0, reports(change))
    events.finish()
    return events


def test_events_as_csv(tmp_path):
    path = tmp_path / "events.csv"
    file = EventFile(str(path))
    file.add("a.log", collected())
    file.close()
    assert path.read_text().splitlines() == [
        "log,object_id,manoeuvre,event,direction,from_s,to_s,duration_s,mean_probability,lane_from,"
        "lane_to,gap_m,speed_mps,min_gap_m,abs_speed_mps",
        "a.log,7,LANE_CHANGE,CUT_IN,right,1.000000,1.400000,0.400000,0.9000,1,0,40.00,-2.50,36.00,",
    ]


@pytest.mark.parametrize("several", [False, True])
def test_events_as_json(tmp_path, several):
    path = tmp_path / "events.json"
    file = EventFile(str(path), several=several)
    file.add("a.log", collected())
    if several:
        file.add("b.log", EventCollector())
    file.close()
    event = {
        "object_id": 7, "manoeuvre": "LANE_CHANGE", "event": "CUT_IN", "direction": "right",
        "from_s": 1.0, "to_s": 1.4, "duration_s": 0.4, "mean_probability": 0.9, "lane_from": 1,
        "lane_to": 0, "gap_m": 40.0, "speed_mps": -2.5, "min_gap_m": 36.0, "abs_speed_mps": None,
    }  # fmt: skip
    first = {"log": "a.log", "objects": 1, "time_share": {"LANE_CHANGE": 1.0}, "events": [event]}
    second = {"log": "b.log", "objects": 0, "time_share": {}, "events": []}
    assert json.loads(path.read_text()) == ([first, second] if several else first)


def test_events_in_another_format_are_refused(tmp_path):
    with pytest.raises(CanImmError, match=r"x\.xml: the name must end in \.csv or \.json"):
        EventFile(str(tmp_path / "x.xml"))
    assert not (tmp_path / "x.xml").exists()


def event(from_s: int, manoeuvre: Manoeuvre, name: str = "", length_s: int = 1) -> Event:
    start = from_s * 1000 * MS
    end = start + length_s * 1000 * MS
    return Event(1, manoeuvre, name, 0, start, end, 1.0, 0, 0, 9.0, 0.0, 9.0, 9.0)


def test_a_long_table_keeps_what_weighs_most_in_the_order_of_time():
    events = [
        event(0, Manoeuvre.RECEDING),
        event(1, Manoeuvre.APPROACHING, length_s=9),
        event(2, Manoeuvre.APPROACHING),
        event(3, Manoeuvre.LANE_CHANGE),
        event(4, Manoeuvre.REAR_END),
        event(5, Manoeuvre.OVERTAKING, "OVERTAKING"),
        event(6, Manoeuvre.LANE_CHANGE, "CUT_IN"),
    ]
    starts = [[e.from_ns // (1000 * MS) for e in weightiest(events, n)] for n in range(8)]
    assert starts == [
        [], [6], [5, 6], [3, 5, 6], [3, 4, 5, 6], [1, 3, 4, 5, 6], [1, 2, 3, 4, 5, 6],
        [0, 1, 2, 3, 4, 5, 6],
    ]  # fmt: skip
