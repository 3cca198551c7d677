"""The detector says to the logs of replay/ what it said when they were recorded.

A change of behaviour that is meant: ``python tests/record.py``, then review ``git diff replay``.
"""

from __future__ import annotations

import pytest
from record import AS_WRITTEN, CASES, DECIMALS, REPLAY, Case, answers, read_rows, record

TOLERANCE = 1.01 * 10**-DECIMALS
"""One unit of the last recorded digit: half is rounding, the other half far more than another
machine's arithmetic changes; 1.01 because 0.44 - 0.43 is not 0.01 in binary."""

ACCURACY_FLOOR = 0.93
MOTORWAY_FLOOR = 0.85

NEAR_M = 4.0
"""A report means the true object that is so near, ahead as well as to the side, if any is [m]."""

SHOWN = 12

EXACT = ("lane", "flags", "duplicate_of")
"""Columns in which the least difference counts; not all answers have them."""

SIZE_LIMIT = 750_000

DAMAGE_SAID = {
    # 121 scans of 3 frames. Gone: 3 where the recorder dropped frames, 1 object's, the cut last
    # one; added: one repeated, one of another sender.
    "frames": "360 read, 356 used, 0 empty, 1 unknown",
    "checksums": "357 right, 1 wrong",
    "rejected": "3 (1 wrong length, 1 wrong checksum, 1 wrong counter)",
    # The scan that the end of the log cuts off is never answered.
    "scans": "116 complete, 3 incomplete, 1 lost, 0 late, 0 dropped",
    "objects": "2 seen, 2 still there, 0 outliers, 0 without a slot",
    "lines": "3 bad, 3 frames lost by the recorder",
}


def differences(expected: list[dict[str, str]], got: list[dict[str, str]]) -> list[str]:
    """What differs, a line per row: when, which object, which columns, recorded and present."""
    said = []
    recorded = {(row["time_s"], row["object_id"]): row for row in expected}
    present = {(row["time_s"], row["object_id"]): row for row in got}
    for key in sorted(recorded | present):
        where = f"t = {key[0]} s, object {key[1]}: "
        if key not in present:
            said.append(where + "recorded, but not there now")
        elif key not in recorded:
            said.append(where + "not recorded, but there now")
        elif columns := differing_columns(recorded[key], present[key]):
            old, new = recorded[key], present[key]
            said.append(where + ", ".join(f"{c} {old[c]!r} -> {new[c]!r}" for c in columns))
    return said


def differing_columns(expected: dict[str, str], got: dict[str, str]) -> list[str]:
    numbers = [name for name in expected if name not in AS_WRITTEN]
    columns = [n for n in numbers if abs(float(expected[n]) - float(got[n])) > TOLERANCE]
    columns += [n for n in EXACT if expected.get(n) != got.get(n)]
    named = [n for n in ("manoeuvre", "direction") if expected[n] != got[n]]
    if "manoeuvre" in named and a_tie(expected, got):
        return columns
    return named + columns


def a_tie(expected: dict[str, str], got: dict[str, str]) -> bool:
    """Whether the recorded and the present manoeuvre are as probable to the last digit."""
    names = [f"p_{row['manoeuvre'].lower()}" for row in (expected, got)]
    if not set(names) <= expected.keys():
        return False  # UNKNOWN
    return all(
        abs(float(row[names[0]]) - float(row[names[1]])) <= TOLERANCE for row in (expected, got)
    )


def report(log: str, expected: list[dict[str, str]], got: list[dict[str, str]]) -> str:
    """A message for people if the answers differ, an empty one if they do not."""
    lines = differences(expected, got)
    if not lines:
        return ""
    more = [f"... and {len(lines) - SHOWN} more rows"] if len(lines) > SHOWN else []
    return "\n  ".join(
        [
            f"replay/{log}: {len(lines)} of {len(expected)} rows differ (recorded -> now)",
            *lines[:SHOWN],
            *more,
            "If this is meant: python tests/record.py, then review git diff replay",
        ]
    )


@pytest.fixture(scope="module", params=CASES, ids=lambda case: case.name)
def replayed(request):
    """Return a case, and what the detector answers now."""
    case = request.param
    return case, answers(case, REPLAY / case.log)[0]


def test_answers_are_the_recorded_ones(replayed):
    case, got = replayed
    expected = read_rows(REPLAY / f"{case.name}.csv")
    assert list(got[0]) == list(expected[0])
    if message := report(case.log, expected, got):
        pytest.fail(message, pytrace=False)


def test_answers_are_mostly_true(replayed):
    case, got = replayed
    truth = read_rows(REPLAY / f"{case.name}.truth.csv")
    placed = case.every > 1
    matched, right, turned_wrong = 0, 0, []
    for row in got:
        true = object_near(row, truth) if placed else object_named(row, truth)
        matched += true is not None
        if true is not None and row["manoeuvre"] == true["manoeuvre"]:
            right += 1
            if row["manoeuvre"] == "LANE_CHANGE" and row["direction"] != true["direction"]:
                turned_wrong.append(row["time_s"])
    assert matched / len(got) >= (0.95 if placed else 1.0)
    assert right / len(got) >= (MOTORWAY_FLOOR if placed else ACCURACY_FLOOR)
    assert turned_wrong == []


def object_named(row: dict[str, str], truth: list[dict[str, str]]) -> dict[str, str]:
    """What the object with this id last began; times are equally long, and compare as text."""
    so_far = (true for true in truth if true["time_s"] <= row["time_s"])
    return [true for true in so_far if true["object_id"] == row["object_id"]][-1]


def object_near(row: dict[str, str], truth: list[dict[str, str]]) -> dict[str, str] | None:
    """What the nearest object does at that time, None if it is not `NEAR_M`."""

    def away(true: dict[str, str]) -> float:
        return max(abs(float(true[axis]) - float(row[axis])) for axis in "xy")

    nearest = min((true for true in truth if true["time_s"] == row["time_s"]), key=away)
    return nearest if away(nearest) < NEAR_M else None


def case_named(name: str) -> Case:
    return next(case for case in CASES if case.name == name)


def test_every_damage_is_counted():
    _, summary = answers(case_named("damaged"), REPLAY / "damaged.log")
    lines = (line.split(maxsplit=1) for line in summary.splitlines() if line.startswith("  "))
    said = {words[0]: words[1] for words in lines}
    assert {name: said.get(name) for name in DAMAGE_SAID} == DAMAGE_SAID


def test_recordings_are_complete_and_small():
    assert {path.name for path in REPLAY.glob("*.log*")} == {case.log for case in CASES}
    assert sum(path.stat().st_size for path in REPLAY.iterdir()) < SIZE_LIMIT


@pytest.mark.parametrize("name", ["damaged", "motorway-ars408"])
def test_recording_is_repeatable(tmp_path, name):
    case = case_named(name)
    contents = []
    for directory in (tmp_path / "first", tmp_path / "second"):
        directory.mkdir()
        record(case, directory)
        contents.append({path.name: path.read_bytes() for path in directory.iterdir()})
    assert contents[0] == contents[1]
    assert set(contents[0]) == {case.log, f"{name}.csv", f"{name}.truth.csv"}
    # a packed log has no time of packing: bytes 4 to 7 of its head
    assert not case.log.endswith(".gz") or contents[0][case.log][4:8] == bytes(4)


ROW = {
    "time_s": "1700000000.100000", "object_id": "1", "manoeuvre": "LANE_CHANGE",
    "probability": "0.49", "lane": "0", "direction": "left", "x": "49.96", "vx": "-0.02",
    "y": "0.70", "vy": "0.60", "p_keep_right": "0.10", "p_lane_change": "0.49",
    "p_keep_left": "0.03", "p_overtaking": "0.38", "p_receding": "0.00", "p_approaching": "0.00",
    "p_rear_end": "0.00",
}  # fmt: skip
TIE = {"p_lane_change": "0.44", "p_overtaking": "0.43", "probability": "0.44"}


@pytest.mark.parametrize(
    ("before", "now", "named"),
    [
        ({}, {"x": "49.9651", "p_overtaking": "0.3849"}, []),
        ({}, {"manoeuvre": "OVERTAKING", "direction": ""}, ["manoeuvre", "direction"]),
        ({}, {"manoeuvre": "UNKNOWN"}, ["manoeuvre"]),
        ({}, {"direction": "right"}, ["direction"]),
        ({}, {"lane": "1"}, ["lane"]),
        ({"flags": ""}, {"flags": "CUT_IN"}, ["flags"]),
        ({"duplicate_of": "3"}, {"duplicate_of": ""}, ["duplicate_of"]),
        ({}, {"vy": "0.6150"}, ["vy"]),
        ({}, {"p_keep_right": "0.1150"}, ["p_keep_right"]),
        (TIE, {**TIE, "manoeuvre": "OVERTAKING", "direction": ""}, []),
        (TIE, {**TIE, "manoeuvre": "OVERTAKING", "direction": "", "lane": "1"}, ["lane"]),
        (TIE, {**TIE, "direction": "right"}, ["direction"]),
        ({}, {"time_s": "1700000000.200000"}, ["1700000000.100000", "1700000000.200000"]),
        ({}, {"object_id": "2"}, ["object 1", "object 2"]),
    ],
)
def test_a_difference_is_named(before, now, named):
    message = report("drive.log", [ROW | before], [ROW | now])
    assert bool(message) == bool(named)
    for text in named:
        assert f"{text} " in message or f"{text}:" in message
    if named:
        assert "replay/drive.log" in message
        assert "t = 1700000000.100000 s, object 1: " in message


def test_a_long_difference_is_cut():
    rows = [ROW | {"time_s": f"1700000000.{i:06d}"} for i in range(30)]
    message = report("drive.log", rows, [row | {"y": "1.70"} for row in rows])
    assert "30 of 30 rows" in message
    assert message.count("y '0.70' -> '1.70'") == SHOWN
    assert "and 18 more rows" in message
