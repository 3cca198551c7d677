"""Scenarios as TOML tables: the published one (Table 1) and a user's own.

The format is explained in the header of ``scenarios/paper-a.toml``.
"""

from __future__ import annotations

import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

from can_imm.sim.model import (
    LEFT,
    RIGHT,
    SPEED_LABELS,
    Scenario,
    ScenarioObject,
    Segment,
    Vehicle,
)
from can_imm.types import CanImmError, Manoeuvre

__all__ = [
    "Scenario",
    "ScenarioObject",
    "Segment",
    "Vehicle",
    "builtin_scenarios",
    "load_scenario",
]

_T = TypeVar("_T")
_KMH = 3.6
_LANES = {"right": RIGHT, "left": LEFT}
_DIRECTIONS = {"left": +1, "right": -1}
_LABELS = {m.name: m for m in Manoeuvre if m not in (Manoeuvre.UNKNOWN, Manoeuvre.REAR_END)}
_FOLDER = files("can_imm.sim") / "scenarios"


def builtin_scenarios() -> list[str]:
    """Names of the scenarios that come with the package."""
    return sorted(
        entry.name.removesuffix(".toml")
        for entry in _FOLDER.iterdir()
        if entry.name.endswith(".toml")
    )


def load_scenario(name_or_path: str) -> Scenario:
    """Read a built-in scenario by its name or any other from a TOML file.

    Raises:
        CanImmError: no such scenario, broken TOML, unknown keys, wrong types or an impossible
            scenario; one line that names the file and the key.
    """
    if name_or_path in builtin_scenarios():
        text, name = (_FOLDER / f"{name_or_path}.toml").read_text("utf-8"), name_or_path
    else:
        text, name = _read(name_or_path), Path(name_or_path).stem
    try:
        return _scenario(name, tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise CanImmError(f"{name_or_path}: not valid TOML: {error}") from error
    except CanImmError as error:
        raise CanImmError(f"{name_or_path}: {error}") from error


def _read(path: str) -> str:
    try:
        return Path(path).read_text("utf-8")
    except FileNotFoundError:
        raise CanImmError(
            f"{path}: neither a file nor a built-in scenario ({', '.join(builtin_scenarios())})"
        ) from None
    except (OSError, UnicodeDecodeError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file in UTF-8"
        raise CanImmError(f"{path}: cannot be read: {reason}") from error


class _Table:
    """A TOML table that is read key by key; what nobody asked for is an unknown key."""

    def __init__(self, data: Any, where: str) -> None:
        if not isinstance(data, dict):
            raise CanImmError(f"{where.removesuffix(': ')}: must be a table, not {data!r}")
        self._data = dict(data)
        self._where = where

    def _take(self, key: str, default: Any) -> Any:
        if key not in self._data and default is None:
            raise CanImmError(f"{self._where}{key} is missing")
        return self._data.pop(key, default)

    def _refuse(self, key: str, expected: str, value: Any) -> CanImmError:
        return CanImmError(f"{self._where}{key} must be {expected}, not {value!r}")

    def number(self, key: str, default: float | None = None) -> float:
        value = self._take(key, default)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self._refuse(key, "a number", value)
        return float(value)

    def integer(self, key: str) -> int:
        value = self._take(key, None)
        if isinstance(value, bool) or not isinstance(value, int):
            raise self._refuse(key, "a whole number", value)
        return value

    def choice(self, key: str, choices: dict[str, _T], hint: str = "") -> _T:
        value = self._take(key, None)
        if not isinstance(value, str) or value not in choices:
            raise self._refuse(key, f"one of {', '.join(choices)}{hint}", value)
        return choices[value]

    def table(self, key: str) -> _Table:
        return _Table(self._take(key, {}), f"{self._where}{key}: ")

    def tables(self, key: str, item: str) -> list[_Table]:
        value = self._take(key, None)
        if not isinstance(value, list):
            raise self._refuse(key, "an array of tables", value)
        prefix = f"{self._where.removesuffix(': ')}, " if self._where else ""
        return [_Table(v, f"{prefix}{item} {i}: ") for i, v in enumerate(value, start=1)]

    def done(self) -> None:
        if self._data:
            raise CanImmError(f"{self._where}unknown key {min(self._data)!r}")


def _scenario(name: str, data: dict[str, Any]) -> Scenario:
    top = _Table(data, "")
    vehicle = top.table("vehicle")
    scenario_vehicle = Vehicle(
        wheelbase=vehicle.number("wheelbase", Vehicle.wheelbase),
        stanley_gain=vehicle.number("stanley_gain", Vehicle.stanley_gain),
        acceleration=vehicle.number("acceleration", Vehicle.acceleration),
    )
    vehicle.done()
    keywords = {
        "duration": top.number("duration"),
        "ego_speed": top.number("ego_speed_kmh", Scenario.ego_speed * _KMH) / _KMH,
        "lane_width": top.number("lane_width", Scenario.lane_width),
        "rear_end_gap": top.number("rear_end_gap", Scenario.rear_end_gap),
    }
    objects = tuple(_object(table) for table in top.tables("object", "object"))
    top.done()
    return Scenario(name=name, objects=objects, vehicle=scenario_vehicle, **keywords)


def _object(table: _Table) -> ScenarioObject:
    target = ScenarioObject(
        id=table.integer("id"),
        gap=table.number("gap"),
        lane=table.choice("lane", _LANES),
        segments=tuple(_segment(row) for row in table.tables("segments", "segment")),
    )
    table.done()
    return target


def _segment(row: _Table) -> Segment:
    label = row.choice("label", _LABELS, " (an approach becomes REAR_END by its gap)")
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
