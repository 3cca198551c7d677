"""Units that a profile or a DBC may give for a signal, and what they are in SI units."""

from __future__ import annotations

import math

_UNITS = {
    "m": ("length", 1.0),
    "cm": ("length", 0.01),
    "m/s": ("speed", 1.0),
    "km/h": ("speed", 1 / 3.6),
    "mph": ("speed", 0.44704),
    "rad": ("angle", 1.0),
    "deg": ("angle", math.pi / 180),
    "rad/s": ("turn rate", 1.0),
    "deg/s": ("turn rate", math.pi / 180),
}
_SAME = {"kph": "km/h", "kmh": "km/h", "deg/sec": "deg/s", "°": "deg", "°/s": "deg/s"}

SI = {"length": "m", "speed": "m/s", "angle": "rad", "turn rate": "rad/s"}
"""The SI unit of each quantity."""


def known_unit(unit: str | None) -> str | None:
    """The usual spelling of a unit that we know, None for any other."""
    unit = _SAME.get(unit or "", unit or "")
    return unit if unit in _UNITS else None


def quantity(unit: str) -> str:
    """What a known unit measures: length, speed, angle or turn rate."""
    return _UNITS[unit][0]


def to_si(unit: str) -> float:
    """So many SI units are one of the known ``unit``."""
    return _UNITS[unit][1]


def units_of(what: str) -> list[str]:
    """The known units of a quantity."""
    return [name for name, (kind, _) in _UNITS.items() if kind == what]
