"""Scenario files: what they say, and how a bad one is refused."""

from pathlib import Path

import pytest

from can_imm.sim.model import LEFT, RIGHT
from can_imm.sim.scenario import (
    Scenario,
    ScenarioObject,
    Segment,
    Vehicle,
    builtin_scenarios,
    load_scenario,
)
from can_imm.types import CanImmError, Manoeuvre

GOOD = """
duration = 40.0
ego_speed_kmh = 90
lane_width = 3.5
rear_end_gap = 12.0

[vehicle]
wheelbase = 3.0
stanley_gain = 2.0
acceleration = 1.5

[[object]]
id = 7
gap = 30.0
lane = "right"
segments = [
    { start = 0, label = "KEEP_RIGHT" },
    { start = 4.0, label = "OVERTAKING", peak_kmh = 7.2, pull_out = 1.2, pull_in = 1.4 },
    { start = 8.0, label = "LANE_CHANGE", direction = "left" },
    { start = 11.0, label = "RECEDING", peak_kmh = 9.0 },
]

[[object]]
id = 9
gap = 60.0
lane = "left"
segments = [
    { start = 0.0, label = "KEEP_LEFT" },
    { start = 5.0, label = "APPROACHING", peak_kmh = 18.0 },
]
"""


def load(tmp_path: Path, text: str) -> Scenario:
    path = tmp_path / "mine.toml"
    path.write_text(text, "utf-8")
    return load_scenario(str(path))


def test_a_users_own_file_says_everything(tmp_path: Path) -> None:
    scenario = load(tmp_path, GOOD)
    assert scenario.name == "mine"
    assert scenario.duration == 40.0
    assert scenario.ego_speed == pytest.approx(25.0)
    assert scenario.lane_width == 3.5
    assert scenario.rear_end_gap == 12.0
    assert (scenario.vehicle.wheelbase, scenario.vehicle.stanley_gain) == (3.0, 2.0)
    assert scenario.vehicle.acceleration == 1.5
    first, second = scenario.objects
    assert (first.id, first.gap, first.lane) == (7, 30.0, RIGHT)
    assert [s.label.name for s in first.segments] == [
        "KEEP_RIGHT",
        "OVERTAKING",
        "LANE_CHANGE",
        "RECEDING",
    ]
    assert [s.start for s in first.segments] == [0.0, 4.0, 8.0, 11.0]
    assert [s.peak for s in first.segments] == pytest.approx([0.0, 2.0, 0.0, 2.5])
    assert first.segments[1].pull_out == 1.2
    assert first.segments[1].pull_in == 1.4
    assert first.segments[2].direction == +1
    assert (second.id, second.gap, second.lane) == (9, 60.0, LEFT)
    assert second.segments[1].peak == pytest.approx(5.0)


def test_what_a_file_leaves_out_is_the_papers(tmp_path: Path) -> None:
    head, objects = GOOD.split("[[object]]", 1)
    assert "wheelbase" in head
    scenario = load(tmp_path, "duration = 40.0\n[[object]]" + objects)
    assert scenario.ego_speed == pytest.approx(60 / 3.6)
    assert scenario.lane_width == 3.0
    assert scenario.rear_end_gap == 10.0
    assert scenario.vehicle.wheelbase == 2.7
    assert scenario.vehicle.stanley_gain == 2.5
    assert scenario.vehicle.acceleration == 2.0


def test_the_built_in_ones_load_by_name() -> None:
    assert builtin_scenarios() == ["paper-a", "paper-b", "paper-s"]
    for name in builtin_scenarios():
        assert load_scenario(name).name == name


REFUSED = [
    # not TOML, or not the right tables and types
    ("duration = 40.0", "duration = 40.0.0", "not valid TOML: .* line 2"),
    ("duration = 40.0", "", "'duration' is missing"),
    ("duration = 40.0", "duration = '40'", "'duration' must be a number, not '40'"),
    ("duration = 40.0", "duration = true", "'duration' must be a number, not True"),
    ("duration = 40.0", "duration = 40.0\nlenght = 3", "unknown key 'lenght'"),
    ("[vehicle]", "[vehicle]\nmass = 3", "vehicle: unknown key 'mass'"),
    ("[vehicle]", "[[vehicle]]", "'vehicle' must be a table, not"),
    ("id = 7", "id = 7.0", "object 1: 'id' must be a whole number, not 7.0"),
    ("id = 9", "", "object 2: 'id' is missing"),
    ("id = 9", "id = 9\ncolour = 1", "object 2: unknown key 'colour'"),
    ("[[object]]\nid = 9", "[[objekt]]\nid = 9", "unknown key 'objekt'"),
    (
        'lane = "left"',
        'lane = "middle"',
        "object 2: 'lane' must be one of right, left, not 'middle'",
    ),
    ('lane = "left"', "lane = 1", "object 2: 'lane' must be one of right, left, not 1"),
    ('"KEEP_LEFT" }', '"KEEP_LEFT", peak_kmh = 2 }', "object 2, segment 1: unknown key 'peak_kmh'"),
    (
        '"KEEP_LEFT"',
        '"PARKING"',
        "object 2, segment 1: 'label' must be one of KEEP_RIGHT, .*'PARKING'",
    ),
    ('"KEEP_LEFT"', '"UNKNOWN"', "object 2, segment 1: 'label' must be one of"),
    ('direction = "left"', 'direction = "up"', "segment 3: 'direction' must be one of left, right"),
    (', direction = "left"', "", "object 1, segment 3: 'direction' is missing"),
    (", peak_kmh = 18.0", "", "object 2, segment 2: 'peak_kmh' is missing"),
    (", pull_out = 1.2", "", "object 1, segment 2: 'pull_out' is missing"),
    (", pull_in = 1.4", "", "object 1, segment 2: 'pull_in' is missing"),
    ("{ start = 0.0,", "{", "object 2, segment 1: 'start' is missing"),
    ('{ start = 0.0, label = "KEEP_LEFT" }', "3", "object 2, segment 1: must be a table, not 3"),
    # numbers that cannot be
    ("duration = 40.0", "duration = 0", "duration must lie between"),
    ("duration = 40.0", "duration = nan", "'duration' must be a number, not nan"),
    ("duration = 40.0", "duration = 1e9", "duration must lie between"),
    ("ego_speed_kmh = 90", "ego_speed_kmh = -5", "ego_speed_kmh must lie between .*, not -5"),
    ("lane_width = 3.5", "lane_width = 20", "lane_width must lie between"),
    ("rear_end_gap = 12.0", "rear_end_gap = -1", "rear_end_gap must lie between"),
    ("wheelbase = 3.0", "wheelbase = 0", "vehicle: wheelbase must lie between"),
    ("stanley_gain = 2.0", "stanley_gain = inf", "vehicle: stanley_gain must lie between"),
    ("acceleration = 1.5", "acceleration = 0", "vehicle: acceleration must be above 0"),
    (
        "acceleration = 1.5",
        "acceleration = nan",
        "vehicle: 'acceleration' must be a number, not nan",
    ),
    ("id = 9", "id = 7", "object 2: id 7 is already taken"),
    ("id = 9", "id = 64", "object 2: id must lie between 0 and 63, not 64"),
    ("id = 9", "id = -1", "object 2: id must lie between"),
    ("gap = 60.0", "gap = -60.0", "object 2: gap must lie between .*, not -60"),
    ("gap = 60.0", "gap = 0", "object 2: gap must lie between"),
    (
        "peak_kmh = 18.0",
        "peak_kmh = -18.0",
        r"segment 2 \(APPROACHING\): peak_kmh must lie between",
    ),
    ("peak_kmh = 9.0", "peak_kmh = inf", r"segment 4 \(RECEDING\): peak_kmh must lie between"),
    ("peak_kmh = 18.0", "peak_kmh = 91.0", "peak_kmh: 91 km/h slower than the ego is not forwards"),
    ("pull_out = 1.2", "pull_out = 0", "pull_out must be above 0 s, not 0"),
    ("pull_in = 1.4", "pull_in = nan", "'pull_in' must be a number, not nan"),
    # a table that does not make a drive
    ("{ start = 0,", "{ start = 1,", "object 1, segment 1: start must be 0, not 1"),
    ("start = 8.0", "start = 4.0", r"segment 2 \(OVERTAKING\): start 4 s is not before .*3, 4 s"),
    ("start = 8.0", "start = 3.0", r"segment 2 \(OVERTAKING\): start 4 s is not before .*3, 3 s"),
    ("start = 8.0", "start = nan", "segment 3: 'start' must be a number, not nan"),
    (
        "duration = 40.0",
        "duration = 11.0",
        r"segment 4 .* start 11 s is not before the run's duration",
    ),
    ('"KEEP_LEFT"', '"KEEP_RIGHT"', r"object 2, segment 1 \(KEEP_RIGHT\): label: .* the left lane"),
    ('"KEEP_RIGHT"', '"KEEP_LEFT"', r"object 1, segment 1 \(KEEP_LEFT\): label: .* the right lane"),
    ('direction = "left"', 'direction = "right"', "direction: .* the right lane already"),
    ('label = "KEEP_LEFT"', 'label = "LANE_CHANGE", direction = "left"', "the left lane already"),
    ("start = 11.0", "start = 8.1", r"segment 3 \(LANE_CHANGE\): start: 3.5 m sideways in 0.1 s"),
    ("pull_out = 1.2", "pull_out = 0.1", "pull_out: 3.5 m sideways in 0.1 s is too steep"),
    ("pull_in = 1.4", "pull_in = 3.0", "pull_out and pull_in take 4.2 s, the segment has 4 s"),
    ("peak_kmh = 7.2", "peak_kmh = 18.0", "two speed ramps take 6.67 s, the segment has 4 s"),
    (
        "APPROACHING",
        "REAR_END",
        "'label' must be one of KEEP_RIGHT.*an approach becomes REAR_END.*not 'REAR_END'",
    ),
]


@pytest.mark.parametrize(("old", "new", "message"), REFUSED)
def test_a_bad_file_is_refused_in_one_line(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    assert GOOD.count(old) == 1 or old in {"[[object]]", "id = 7"}, old
    with pytest.raises(CanImmError, match=message) as refusal:
        load(tmp_path, GOOD.replace(old, new))
    text = str(refusal.value)
    assert text.startswith(str(tmp_path / "mine.toml") + ": ")
    assert "\n" not in text


def test_overtaking_starts_in_the_right_lane(tmp_path: Path) -> None:
    row = 'label = "OVERTAKING", peak_kmh = 5.0, pull_out = 1.5, pull_in = 1.5'
    with pytest.raises(CanImmError, match="overtaking starts in the right lane"):
        load(tmp_path, GOOD.replace('label = "KEEP_LEFT"', row))


@pytest.mark.parametrize("objects", ["", "object = []", "object = 3"])
def test_a_file_without_objects_is_refused(tmp_path: Path, objects: str) -> None:
    with pytest.raises(
        CanImmError,
        match=r"mine\.toml: '?object'?( is missing|: at least one| must be a list of tables)",
    ):
        load(tmp_path, "duration = 10.0\n" + objects)


def test_an_object_without_segments_is_refused(tmp_path: Path) -> None:
    text = 'duration = 10.0\n[[object]]\nid = 1\ngap = 9.0\nlane = "left"\nsegments = []'
    with pytest.raises(CanImmError, match="object 1: segments: at least one is needed"):
        load(tmp_path, text)


def test_a_missing_file_is_refused_with_the_names_that_exist() -> None:
    with pytest.raises(CanImmError, match=r"nowhere\.toml: neither a file nor .*paper-a, paper-b"):
        load_scenario("nowhere.toml")


def test_what_is_not_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "binary.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CanImmError, match=r"binary\.toml: cannot be read: not a text file"):
        load_scenario(str(path))
    with pytest.raises(CanImmError, match="cannot be read: Is a directory"):
        load_scenario(str(tmp_path))


@pytest.mark.parametrize("label", [Manoeuvre.UNKNOWN, Manoeuvre.REAR_END])
def test_labels_that_are_not_driven_are_refused_from_code_too(label: Manoeuvre) -> None:
    with pytest.raises(CanImmError, match=rf"object 1, segment 1 \({label.name}\): label"):
        Scenario("mine", 10.0, (ScenarioObject(1, 50.0, RIGHT, (Segment(0.0, label),)),))


NAN = float("nan")
KEEP = Segment(0.0, Manoeuvre.KEEP_RIGHT)


@pytest.mark.parametrize(
    ("segments", "duration", "acceleration", "message"),
    [
        ((KEEP,), NAN, 2.0, "^duration must lie between .*, not nan"),
        ((KEEP,), 10.0, NAN, "^vehicle: acceleration must be above 0"),
        ((KEEP, Segment(NAN, Manoeuvre.KEEP_RIGHT)), 10.0, 2.0, "segment 1 .* is not before .*nan"),
        (
            (Segment(0.0, Manoeuvre.OVERTAKING, peak=2.0, pull_out=NAN, pull_in=1.0),),
            10.0,
            2.0,
            "pull_out must be above 0 s, not nan",
        ),
    ],
)
def test_not_a_number_is_refused_from_code_too(
    segments: tuple[Segment, ...], duration: float, acceleration: float, message: str
) -> None:
    vehicle = Vehicle(acceleration=acceleration)
    with pytest.raises(CanImmError, match=message):
        Scenario("mine", duration, (ScenarioObject(1, 50.0, RIGHT, segments),), vehicle=vehicle)
