"""Scenarios as TOML tables: the published one (Table 1) and a user's own.

The format is explained in the header of ``scenarios/paper-a.toml``.
"""

from __future__ import annotations

from pathlib import Path

from can_imm.sim.model import (
    LEFT,
    RIGHT,
    SPEED_LABELS,
    Scenario,
    ScenarioObject,
    Segment,
    Vehicle,
)
from can_imm.tables import Table, builtin_names, read_table
from can_imm.types import CanImmError, Manoeuvre

__all__ = [
    "Scenario",
    "ScenarioObject",
    "Segment",
    "Vehicle",
    "builtin_scenarios",
    "load_scenario",
]

_KMH = 3.6
_LANES = {"right": RIGHT, "left": LEFT}
_DIRECTIONS = {"left": +1, "right": -1}
_LABELS = {m.name: m for m in map(Manoeuvre, range(1, Manoeuvre.REAR_END))}
_FOLDER = Path(__file__).parent / "scenarios"


def builtin_scenarios() -> list[str]:
    """Names of the scenarios that come with the package."""
    return builtin_names(_FOLDER)


def load_scenario(name_or_path: str) -> Scenario:
    """Read a built-in scenario by its name or any other from a TOML file.

    Raises:
        CanImmError: no such scenario, broken TOML, unknown keys, wrong types or an impossible
            scenario; one line that names the file and the key.
    """
    top = read_table(name_or_path, _FOLDER, "scenario")
    vehicle = _vehicle(top.table("vehicle", {}))
    keywords = {
        "duration": top.number("duration"),
        "ego_speed": top.number("ego_speed_kmh", Scenario.ego_speed * _KMH) / _KMH,
        "lane_width": top.number("lane_width", Scenario.lane_width),
        "rear_end_gap": top.number("rear_end_gap", Scenario.rear_end_gap),
    }
    objects = tuple(_object(table) for table in top.tables("object"))
    top.done()
    name = Path(top.file).stem
    try:
        return Scenario(name=name, objects=objects, vehicle=vehicle, **keywords)
    except CanImmError as error:
        raise top.error(str(error)) from error


def _vehicle(table: Table) -> Vehicle:
    vehicle = Vehicle(
        wheelbase=table.number("wheelbase", Vehicle.wheelbase),
        stanley_gain=table.number("stanley_gain", Vehicle.stanley_gain),
        acceleration=table.number("acceleration", Vehicle.acceleration),
    )
    table.done()
    return vehicle


def _object(table: Table) -> ScenarioObject:
    target = ScenarioObject(
        id=table.integer("id"),
        gap=table.number("gap"),
        lane=table.choice("lane", _LANES),
        segments=tuple(_segment(row) for row in table.tables("segments", each="segment")),
    )
    table.done()
    return target


def _segment(row: Table) -> Segment:
    label = row.choice("label", _LABELS, hint=" (an approach becomes REAR_END by its gap)")
    overtaking = label is Manoeuvre.OVERTAKING
    segment = Segment(
        start=row.number("start"),
        label=label,
        peak=row.number("peak_kmh") / _KMH if label in SPEED_LABELS else 0.0,
        direction=row.choice("direction", _DIRECTIONS) if label is Manoeuvre.LANE_CHANGE else 0,
        pull_out=row.number("pull_out") if overtaking else 0.0,
        pull_in=row.number("pull_in") if overtaking else 0.0,
    )
    row.done()
    return segment
