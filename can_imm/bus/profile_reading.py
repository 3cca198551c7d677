"""A profile's tables, one by one: every function takes what it reads out of a `Table`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from can_imm.bus.codec import field, load_dbc
from can_imm.bus.profile_parts import (
    QUANTITIES,
    Code,
    Component,
    Condition,
    Ego,
    EgoSignal,
    Header,
    Mounting,
    Sensors,
)
from can_imm.bus.protection import KINDS
from can_imm.bus.units import SI, known_unit, quantity, to_si, units_of
from can_imm.tables import Table

_LARGEST = 1e6
"""No time in milliseconds, noise or offset is larger."""

_FAR = 1e12
"""No signal has a larger value."""

Codes = Mapping[str, tuple[float, ...]]
"""Tables of codes by name."""


class Database:
    """The messages of a DBC, by name and by id."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._database = load_dbc(path)

    def message(self, table: Table, name: str) -> Any:
        """The message called ``name``, which ``table`` asks for."""
        try:
            return self._database.get_message_by_name(name)
        except KeyError:
            raise table.error(f"no message {name!r} in {self._path}") from None

    def messages(self, table: Table, key: str, *, needed: bool = False) -> tuple[Any, ...]:
        """The messages of a list of names and of id ranges such as "0x210-0x21F"."""
        messages: list[Any] = []
        for entry in table.values(key):
            first, _, last = str(entry).partition("-")
            try:
                ids = range(int(first, 0), int(last or first, 0) + 1)
            except ValueError:
                messages.append(self.message(table, str(entry)))
                continue
            known = {message.frame_id: message for message in self._database.messages}
            for frame_id in ids[:4096]:
                if frame_id not in known:
                    raise table.error(f"'{key}': no message with id 0x{frame_id:X} in {self._path}")
                messages.append(known[frame_id])
        if (needed and not messages) or len({m.frame_id for m in messages}) < len(messages):
            raise table.error(f"'{key}' must name at least one message, and none twice")
        return tuple(messages)


def read_milliseconds(table: Table, key: str, *, least: float) -> int:
    """A time of at least ``least`` ms [ns]."""
    return round(table.number(key, low=least, high=_LARGEST) * 1e6)


def read_kind(table: Table, key: str, default: str | None = None) -> str:
    """A kind of protection."""
    return table.choice(key, dict(zip(KINDS, KINDS, strict=True)), default)


def read_whole(table: Table, key: str) -> list[int]:
    """A list of whole numbers, of any length but 0."""
    values = table.values(key)
    if not values or not all(isinstance(v, int) and not isinstance(v, bool) for v in values):
        raise table.error(f"'{key}' must be a list of whole numbers")
    return values


def _numbers(table: Table, key: str) -> tuple[float, ...]:
    """A list of numbers of any length but 0."""
    values = table.values(key)
    if not values or not all(
        isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in values
    ):
        raise table.error(f"'{key}' must be a list of numbers")
    return tuple(map(float, values))


def read_condition(table: Table) -> Condition:
    """A condition on a signal."""
    bounds = {
        key: table.number(key, low=-_FAR, high=_FAR) if key in table else None
        for key in ("equals", "below", "above")
    }
    any_of = _numbers(table, "any_of") if "any_of" in table else None
    condition = Condition(table.text("signal"), **bounds, any_of=any_of)
    table.done()
    if sum(value is not None for value in (*bounds.values(), any_of)) != 1:
        raise table.error("needs either 'equals' or 'below', 'above' or 'any_of'")
    return condition


def read_codes(table: Table) -> Codes:
    """Tables of codes that have a name."""
    return {name: _numbers(table, name) for name in table}


def read_code(table: Table, named: Codes) -> Code:
    """A signal that is looked up."""
    code = _code(table, "signal", "codes", named)
    table.done()
    return code


def _code(table: Table, signal: str, codes: str, named: Codes) -> Code:
    """The signal at one key, and its codes at another: a list, or the name of one."""
    name = table.text(signal)
    if codes not in table:
        return Code(name, None)
    if table.is_text(codes):
        return Code(name, table.choice(codes, named))
    return Code(name, _numbers(table, codes))


def _unit(table: Table, what: str, signal: Any) -> str:
    """The unit of a signal: as the profile says, else as the DBC says, else the SI unit."""
    kind = QUANTITIES[what]
    if "unit" in table:
        return table.choice("unit", {unit: unit for unit in units_of(kind)})
    unit = known_unit(signal.unit) if signal is not None else None
    if unit is None:
        return SI[kind]
    if quantity(unit) != kind:
        raise table.error(f"signal {signal.name!r} is in {unit} by the DBC, not a {kind}")
    return unit


def _sign(table: Table) -> float:
    sign = table.number("sign", 1.0)
    if sign not in (-1, 1):
        raise table.error(f"'sign' must be 1 or -1, not {sign:g}")
    return sign


_LASTING = ("std_lasting", "lasting_s"), ("std_per_m", "per_m_s"), ("new_per_m", "new_s")
"""Keys of a component's lasting errors: how large they are, and for how long."""


def read_component(table: Table, what: str, find: Callable[[str], Any], named: Codes) -> Component:
    """How the component ``what`` is measured.

    Args:
        find: gives a signal by its name, None if there is no such.
    """
    signal = table.text("signal")
    unit = _unit(table, what, find(signal))
    std_from = _code(table, "std_signal", "std_codes", named) if "std_signal" in table else None
    component = Component(
        signal,
        table.number("std", above=0.0, high=_LARGEST),
        _sign(table),
        table.number("offset", 0.0, low=-_LARGEST, high=_LARGEST),
        unit,
        to_si(unit),
        std_from,
        table.number("std_floor", 0.0, low=0.0, high=_LARGEST),
        **{
            key: table.number(key, 0.0, low=0.0, high=_LARGEST) for pair in _LASTING for key in pair
        },
    )
    table.done()
    if component.std_floor and std_from is None:
        raise table.error("'std_floor' is of use only with a 'std_signal'")
    for pair in _LASTING:
        for key in pair:
            if getattr(component, key) and what != "y":
                raise table.error(f"'{key}' is for y: an error of the bearing")
    for large, long in _LASTING:
        if (getattr(component, large) > 0.0) != (getattr(component, long) > 0.0):
            raise table.error(f"'{large}' and '{long}' go together: how large, and for how long")
    return component


def read_sensors(table: Table, header: Header | None) -> Sensors:
    """How many sensors may share a bus."""
    if not list(table):
        return Sensors()
    number = table.integer("number", low=1, high=64)
    sensors = Sensors(
        number,
        table.integer("id_step", low=1, high=0x400),
        table.integer("use", low=0, high=number - 1) if "use" in table else None,
    )
    table.done()
    if header is None:
        raise table.error("only a sensor with a scan header can be one of several")
    return sensors


def read_mounting(table: Table) -> Mounting:
    """Where the sensor sits."""
    x, y = (table.number(key, 0.0, low=-100.0, high=100.0) for key in ("x", "y"))
    yaw = math.radians(table.number("yaw_deg", 0.0, low=-360.0, high=360.0))
    table.done()
    return Mounting(x, y, yaw)


def read_ego(table: Table, database: Database) -> Ego:
    """Where the vehicle's own motion is told."""
    timeout_ns = read_milliseconds(table, "timeout_ms", least=1)
    shifted = table.flag("shifted", False)
    parts = [
        _ego_signal(table.table(key), key, database) if key in table else None
        for key in ("speed", "yaw_rate")
    ]
    table.done()
    first, second = parts
    if first is None and second is None:
        raise table.error("needs 'speed' or 'yaw_rate'")
    if not first or not second or first.message is not second.message:
        return Ego(timeout_ns, shifted, first, second)
    if first.protection != second.protection:
        raise table.error("speed and yaw_rate are in one message, with one protection")
    return Ego(timeout_ns, shifted, first, second)


def _ego_signal(table: Table, what: str, database: Database) -> EgoSignal:
    message = database.message(table, table.text("message"))
    names = tuple(map(str, table.values("mean_of"))) if "mean_of" in table else ()
    names = names or (table.text("signal"),)
    found = [message.get_signal_by_name(name) for name in names if name in message.signal_tree]
    if len({field(signal)[1:] for signal in found}) > 1:
        raise table.error("the signals of 'mean_of' have several scales")
    unit = _unit(table, what, found[0] if found else None)
    part = EgoSignal(
        message,
        names,
        _sign(table),
        table.number("offset", 0.0, low=-_LARGEST, high=_LARGEST),
        unit,
        to_si(unit),
        read_kind(table, "protection", "none"),
        tuple(read_condition(inner) for inner in table.tables("valid_if", [])),
        *(
            read_condition(table.table(name)) if name in table else None
            for name in ("reverse_if", "forwards_if", "standstill_if")
        ),
    )
    table.done()
    return part
