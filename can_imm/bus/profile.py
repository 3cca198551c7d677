"""Sensor profiles: which message and signal of which DBC means what, as TOML beside the DBC."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can_imm
from can_imm.bus.codec import Field, field, find_signal, load_dbc
from can_imm.bus.protection import KINDS, p01_data_id
from can_imm.tables import Table, builtin_names, read_table
from can_imm.types import CanImmError

STATES = ("x", "vx", "y", "vy")
_LARGEST = 1e6
"""No time in milliseconds, noise or offset is larger."""


@dataclass(frozen=True)
class Component:
    """How a state is measured: ``sign * signal + offset``, noise ``std`` (SI units)."""

    signal: str
    std: float
    sign: float
    offset: float


@dataclass(frozen=True)
class Condition:
    """The frame holds an object only if the physical value of ``signal`` is ``equals``, or lies
    below ``below``; the other of the two is None."""

    signal: str
    equals: float | None
    below: float | None


@dataclass(frozen=True)
class Header:
    """The message that starts a scan, and its signal for the number of object frames."""

    message: Any
    count: str


@dataclass(frozen=True)
class Profile:
    """A sensor. Messages are cantools messages; signals are named.

    With a ``header`` a scan is the header and as many object frames as it announces; without one
    it is one frame of each of ``messages``, and the signal ``counter`` tells the scans apart.
    """

    name: str
    path: Path
    description: str
    dbc: Path
    period_ns: int
    timeout_ns: int
    latency_ns: int
    header: Header | None
    counter: str
    messages: tuple[Any, ...]
    id: str | None
    new: str | None
    valid_if: tuple[Condition, ...]
    state: tuple[Component | None, ...]
    protection: str
    protection_counter: str | None


def dbc_dir() -> Path:
    """Folder of the built-in DBC files and profiles: the installed package's, or the checkout's."""
    package = Path(can_imm.__file__).parent
    installed = package / "dbc"
    return installed if installed.is_dir() else package.parent / "dbc"


def builtin_profiles() -> list[str]:
    """Names of the built-in profiles."""
    return builtin_names(dbc_dir())


def load_profile(name_or_path: str) -> Profile:
    """A built-in profile by name, or one from a TOML file; its DBC's path is relative to the TOML.

    Raises:
        CanImmError: file missing or broken, or a key, message or signal that is wrong.
    """
    top = read_table(name_or_path, dbc_dir(), "sensor profile")
    path = Path(top.file)
    dbc = path.parent / top.text("dbc")
    description = top.text("description", "")
    scan, obj, protection = top.table("scan"), top.table("object"), top.table("protection")
    top.done()
    database = load_dbc(dbc)

    period_ns = _milliseconds(scan, "period_ms", least=1)
    timeout_ns = _milliseconds(scan, "timeout_ms", least=1)
    latency_ns = _milliseconds(scan, "latency_ms", least=0)
    counter = scan.text("counter")
    header = None
    if "header" in scan:
        header = Header(_message(scan, database, scan.text("header"), dbc), scan.text("count"))
    scan.done()

    messages = _messages(obj, database, dbc)
    id_signal = obj.text("id") if "id" in obj else None
    new_signal = obj.text("new") if "new" in obj else None
    if (header is None) != (id_signal is None):
        raise obj.error("'id' is needed with, and only with, a scan header")
    valid_if = tuple(_condition(table) for table in obj.tables("valid_if", []))
    state = obj.table("state")
    obj.done()
    components = tuple(_component(state.table(s)) if s in state else None for s in STATES)
    state.done()
    if not any(components):
        raise state.error("no state is measured")

    kind = protection.choice("kind", dict(zip(KINDS, KINDS, strict=True)))
    protection_counter = protection.text("counter") if kind == "toyota" else None
    protection.done()

    profile = Profile(
        path.stem, path, description, dbc, period_ns, timeout_ns, latency_ns, header, counter,
        messages, id_signal, new_signal, valid_if, components, kind, protection_counter,
    )  # fmt: skip
    _check_messages(profile)
    return profile


def _milliseconds(table: Table, key: str, *, least: float) -> int:
    return round(table.number(key, low=least, high=_LARGEST) * 1e6)


def _message(table: Table, database: Any, name: str, dbc: Path) -> Any:
    try:
        return database.get_message_by_name(name)
    except KeyError:
        raise table.error(f"no message {name!r} in {dbc}") from None


def _messages(table: Table, database: Any, dbc: Path) -> tuple[Any, ...]:
    """The messages of a list of names and of id ranges such as "0x210-0x21F"."""
    messages: list[Any] = []
    for entry in table.values("messages"):
        first, _, last = str(entry).partition("-")
        try:
            ids = range(int(first, 0), int(last or first, 0) + 1)
        except ValueError:
            messages.append(_message(table, database, str(entry), dbc))
            continue
        known = {message.frame_id: message for message in database.messages}
        for frame_id in ids[:4096]:
            if frame_id not in known:
                raise table.error(f"'messages': no message with id 0x{frame_id:X} in {dbc}")
            messages.append(known[frame_id])
    if not messages or len({message.frame_id for message in messages}) < len(messages):
        raise table.error("'messages' must name at least one message, and none twice")
    return tuple(messages)


def _condition(table: Table) -> Condition:
    condition = Condition(
        table.text("signal"),
        table.number("equals") if "equals" in table else None,
        table.number("below") if "below" in table else None,
    )
    table.done()
    if (condition.equals is None) == (condition.below is None):
        raise table.error("needs either 'equals' or 'below'")
    return condition


def _component(table: Table) -> Component:
    component = Component(
        signal=table.text("signal"),
        std=table.number("std", above=0.0, high=_LARGEST),
        sign=table.number("sign", 1.0),
        offset=table.number("offset", 0.0, low=-_LARGEST, high=_LARGEST),
    )
    table.done()
    if component.sign not in (-1, 1):
        raise table.error(f"'sign' must be 1 or -1, not {component.sign:g}")
    return component


def _check_messages(profile: Profile) -> None:
    """Refuse messages that we cannot decode and signals that are not there."""
    wanted: list[tuple[Any, tuple[str, ...]]] = []
    wanted += [(profile.header.message, (profile.header.count,))] if profile.header else []
    names = [profile.id, profile.new, profile.protection_counter]
    names += [condition.signal for condition in profile.valid_if]
    names += [component.signal for component in profile.state if component]
    wanted += [(message, tuple(filter(None, names))) for message in profile.messages]
    counted = {wanted[0][0].name} if profile.header else {m.name for m in profile.messages}
    fields: dict[tuple[bool, str], Field] = {}
    for message, signals in wanted:
        if message.is_extended_frame or message.is_fd or not 1 <= message.length <= 8:
            raise CanImmError(
                f"{profile.path}: message {message.name} of {profile.dbc.name} is not a classic "
                "frame with an 11-bit id: not supported"
            )
        for name in (*signals, *([profile.counter] if message.name in counted else [])):
            signal = find_signal(message, name, profile.path, profile.dbc)
            first = fields.setdefault((message in profile.messages, name), field(signal))
            if field(signal) != first:
                raise CanImmError(
                    f"{profile.path}: signal {name!r} of {message.name} has another scale or range "
                    f"than in {profile.messages[0].name}"
                )
        if profile.protection == "e2e-p01":
            p01_data_id(message, profile.dbc)
