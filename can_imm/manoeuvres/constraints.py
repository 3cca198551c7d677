"""What a mode knows of an object's state: soft rows, bounds, and how the mode is entered."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from can_imm.estimation.layout import FIXED, GROUND, LANE, MAX_ROWS
from can_imm.tables import Table, show

Lanes = Mapping[str, tuple[int, int]]
"""Lowest and highest lane number of each named set of lanes."""


def read_lanes(table: Table) -> Lanes:
    """The named sets of lanes, which are what is left in the table.

    Raises:
        CanImmError: something else than [lowest, highest] lane number.
    """
    lanes = {}
    for name in table:
        span = table.values(name)
        if (
            len(span) != 2
            or not all(type(v) is int and abs(v) <= 100 for v in span)
            or span[0] > span[1]
        ):
            raise table.error(f"{show(name)} must be [lowest, highest] lane number")
        lanes[name] = (span[0], span[1])
    return lanes


def fill_soft(record: Any, j: int, mode: Table, states: Sequence[str], lanes: Lanes) -> None:
    """Soft constraints of mode j: state = value with variance r."""
    rows = _rows(mode, "soft")
    record["n_soft"][j] = len(rows)
    for c, row in enumerate(rows):
        s = _state(row, states)
        kind, span = _lane(row, states[s], lanes)
        record["soft_state"][j, c] = s
        record["soft_kind"][j, c], record["soft_lanes"][j, c] = kind, span
        record["soft_density"][j, c] = dense = "density" in row
        record["soft_r"][j, c] = row.number("density" if dense else "r", above=0.0)
        record["soft_value"][j, c] = row.number("value", None if kind == FIXED else 0.0)
        row.done()


def fill_bounds(record: Any, j: int, mode: Table, states: Sequence[str], lanes: Lanes) -> None:
    """Hard bounds of mode j: min and max of a state."""
    rows = _rows(mode, "bounds")
    record["n_bounds"][j] = len(rows)
    for c, row in enumerate(rows):
        s = _state(row, states)
        record["bound_state"][j, c] = s
        record["bound_kind"][j, c], record["bound_lanes"][j, c] = _lane(row, states[s], lanes)
        low = row.number("min") if "min" in row else -math.inf
        high = row.number("max") if "max" in row else math.inf
        if not low < high:
            raise row.error(f"bounds are empty: min {low} is not below max {high}")
        record["bound_lower"][j, c] = low
        record["bound_upper"][j, c] = high
        record["bound_mass"][j, c] = row.flag("mass", False)
        row.done()


def fill_entry(
    record: Any, j: int, mode: Table, states: Sequence[str], names: Sequence[str]
) -> None:
    """What replaces the state on the way into mode j, from all modes or from those named."""
    record["entry_var"][j] = -1.0
    for row in _rows(mode, "entry"):
        s = _state(row, states)
        record["entry_mean"][j, s] = row.number("mean")
        record["entry_var"][j, s] = row.number("std", low=0.0) ** 2
        for source in row.values("from", list(names)):
            if source not in names:
                raise row.error(f"'from' names the unknown mode {show(source)}")
            if source != names[j]:
                record["entry_sources"][names.index(source), j] |= 1 << s
        row.done()


def _rows(mode: Table, key: str) -> list[Table]:
    rows = mode.tables(key, [])
    if len(rows) > MAX_ROWS:
        raise mode.error(f"'{key}' has {len(rows)} rows, at most {MAX_ROWS} are possible")
    return rows


def _state(row: Table, states: Sequence[str]) -> int:
    return row.choice("state", {name: s for s, name in enumerate(states)})


def _lane(row: Table, state: str, lanes: Lanes) -> tuple[int, tuple[int, int]]:
    """Whether the row counts from a lane centre, and of which lanes, or from the ground."""
    if row.flag("ground", False):
        if state != "vx" or "lane" in row:
            raise row.error("'ground' is for vx, without a lane")
        return GROUND, (0, 0)
    if "lane" not in row:
        return FIXED, (0, 0)
    lane = row.text("lane")
    if state != "y" or lane not in lanes:
        raise row.error(f"no lane {show(lane)} for state '{state}' ({', '.join(lanes)})")
    return LANE, lanes[lane]
