"""Sensor profiles: which message and signal of which DBC means what, as TOML beside the DBC."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can_imm
from can_imm.bus.codec import Field, field, find_signal, load_dbc
from can_imm.bus.errors import one_line
from can_imm.bus.protection import KINDS, p01_data_id
from can_imm.types import CanImmError

STATES = ("x", "vx", "y", "vy")


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
    return sorted(path.stem for path in dbc_dir().glob("*.toml"))


class _Table:
    """A TOML table that says where it is when something is wrong with it."""

    def __init__(self, values: Any, path: Path, where: str) -> None:
        self.path, self.where = path, where
        if not isinstance(values, dict):
            self.fail("must be a table")
        self._values = dict(values)

    def fail(self, text: str) -> Any:
        raise CanImmError(f"{self.path}: {self.where + ': ' if self.where else ''}{text}")

    def take(self, key: str, kind: type, default: Any = ...) -> Any:
        if key not in self._values:
            return self.fail(f"key {key!r} is missing") if default is ... else default
        value = self._values.pop(key)
        wanted = (int, float) if kind is float else (kind,)
        if not isinstance(value, wanted) or isinstance(value, bool):
            names = {str: "text", float: "a number", dict: "a table", list: "a list"}
            self.fail(f"key {key!r} must be {names[kind]}, not {value!r}")
        return value

    def table(self, key: str) -> _Table:
        return _Table(self.take(key, dict), self.path, f"{self.where} {key}".strip())

    def milliseconds(self, key: str, *, least: float) -> int:
        value = self.take(key, float)
        # NaN must not pass either
        if not least <= value < 1e6:
            self.fail(f"key {key!r} must lie between {least:g} and 1e6, not {value:g}")
        return round(float(value) * 1e6)

    def close(self) -> None:
        if self._values:
            self.fail(f"unknown key {next(iter(self._values))!r}")


def load_profile(name_or_path: str) -> Profile:
    """A built-in profile by name, or one from a TOML file; its DBC's path is relative to the TOML.

    Raises:
        CanImmError: file missing or broken, or a key, message or signal that is wrong.
    """
    path = Path(name_or_path)
    if path.suffix != ".toml" and len(path.parts) == 1:
        if name_or_path not in builtin_profiles():
            known = ", ".join(builtin_profiles())
            raise CanImmError(f"no sensor profile {name_or_path!r} (built-in: {known}; or a .toml)")
        path = dbc_dir() / f"{name_or_path}.toml"
    try:
        values = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise CanImmError(f"{path}: {one_line(error)}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CanImmError(f"{path}: not valid TOML: {one_line(error)}") from error
    return _read(_Table(values, path, ""))


def _read(top: _Table) -> Profile:
    path = top.path
    dbc = path.parent / top.take("dbc", str)
    description = top.take("description", str, "")
    scan, obj, protection = top.table("scan"), top.table("object"), top.table("protection")
    top.close()
    database = load_dbc(dbc)

    period_ns = scan.milliseconds("period_ms", least=1)
    timeout_ns = scan.milliseconds("timeout_ms", least=1)
    latency_ns = scan.milliseconds("latency_ms", least=0)
    counter = scan.take("counter", str)
    header = None
    if (header_name := scan.take("header", str, None)) is not None:
        header = Header(_message(scan, database, header_name, dbc), scan.take("count", str))
    scan.close()

    messages = _messages(obj, database, dbc)
    id_signal, new_signal = obj.take("id", str, None), obj.take("new", str, None)
    if (header is None) != (id_signal is None):
        obj.fail("key 'id' is needed with, and only with, a scan header")
    valid_if = tuple(
        _condition(_Table(entry, path, "object valid_if"))
        for entry in obj.take("valid_if", list, [])
    )
    states = obj.table("state")
    obj.close()
    components = tuple(_component(states, name) for name in STATES)
    states.close()
    if not any(components):
        states.fail("no state is measured")

    kind = protection.take("kind", str)
    if kind not in KINDS:
        protection.fail(f"key 'kind' must be one of {', '.join(KINDS)}, not {kind!r}")
    protection_counter = protection.take("counter", str) if kind == "toyota" else None
    protection.close()

    profile = Profile(
        path.stem, path, description, dbc, period_ns, timeout_ns, latency_ns, header, counter,
        messages, id_signal, new_signal, valid_if, components, kind, protection_counter,
    )  # fmt: skip
    _check_messages(profile)
    return profile


def _message(table: _Table, database: Any, name: str, dbc: Path) -> Any:
    try:
        return database.get_message_by_name(name)
    except KeyError:
        return table.fail(f"no message {name!r} in {dbc}")


def _messages(table: _Table, database: Any, dbc: Path) -> tuple[Any, ...]:
    """The messages of a list of names and of id ranges such as "0x210-0x21F"."""
    messages: list[Any] = []
    for entry in table.take("messages", list):
        first, _, last = str(entry).partition("-")
        try:
            ids = range(int(first, 0), int(last or first, 0) + 1)
        except ValueError:
            messages.append(_message(table, database, str(entry), dbc))
            continue
        known = {message.frame_id: message for message in database.messages}
        for frame_id in ids[:4096]:
            if frame_id not in known:
                table.fail(f"key 'messages': no message with id 0x{frame_id:X} in {dbc}")
            messages.append(known[frame_id])
    if not messages or len({message.frame_id for message in messages}) < len(messages):
        table.fail("key 'messages' must name at least one message, and none twice")
    return tuple(messages)


def _condition(table: _Table) -> Condition:
    condition = Condition(
        table.take("signal", str),
        table.take("equals", float, None),
        table.take("below", float, None),
    )
    table.close()
    if (condition.equals is None) == (condition.below is None):
        table.fail("needs either 'equals' or 'below'")
    return condition


def _component(states: _Table, name: str) -> Component | None:
    values = states.take(name, dict, None)
    if values is None:
        return None
    table = _Table(values, states.path, f"{states.where} {name}")
    component = Component(
        table.take("signal", str),
        float(table.take("std", float)),
        float(table.take("sign", float, 1)),
        float(table.take("offset", float, 0)),
    )
    table.close()
    if not 0 < component.std < 1e6:
        table.fail(f"key 'std' must be a positive number, not {component.std:g}")
    if component.sign not in (-1, 1):
        table.fail(f"key 'sign' must be 1 or -1, not {component.sign:g}")
    if not abs(component.offset) < 1e6:
        table.fail(f"key 'offset' must be a finite number, not {component.offset:g}")
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
