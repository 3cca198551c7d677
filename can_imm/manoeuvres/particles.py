"""Parameters of the mode that is a particle filter: its speed profile and its noise."""

from __future__ import annotations

from typing import Any

from can_imm.tables import Table


def fill_particles(record: Any, table: Table) -> int:
    """Fill in the bank's ``particle`` record; return the number of particles.

    Raises:
        CanImmError: a parameter is wrong or missing.
    """
    p = record["particle"]
    count = table.integer("count", low=10, high=100_000)
    corners = table.numbers("profile", 4)
    if not corners[0] < corners[1] <= corners[2] < corners[3]:
        raise table.error("'profile' must be four rising distances of the trapezoid's corners")
    length = corners[3] - corners[0]
    p["up"] = (corners[1] - corners[0]) / length
    p["down"] = (corners[2] - corners[0]) / length
    p["absolute"] = table.flag("absolute", False)
    p["entry"] = corners[0]
    p["peak_low"], p["peak_high"] = _range(table, "peak", above=0.0)
    # in metres for the absolute profile, else per m/s of peak speed
    p["length_low"], p["length_high"] = (
        (length, length) if p["absolute"] else _range(table, "length", above=0.0)
    )
    p["f_min"] = table.number("f_min", low=0.0, high=float(p["peak_low"]))
    p["y_low"], p["y_high"] = _range(table, "window")
    if p["y_low"] == p["y_high"]:
        raise table.error("'window' is empty")
    p["std_x"] = table.number("std_x", low=0.0)
    p["std_profile"] = table.number("std_profile", low=0.0)
    p["q_vy"] = table.number("q_vy", low=0.0)
    p["entry_vy_std"] = table.number("entry_vy_std", low=0.0)
    table.done()
    return count


def _range(table: Table, key: str, *, above: float | None = None) -> tuple[float, float]:
    low, high = table.numbers(key, 2, above=above)
    if not low <= high:
        raise table.error(f"'{key}' must be [low, high] with low <= high")
    return low, high
