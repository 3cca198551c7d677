"""Sensor profiles: which message and signal of which DBC means what, as TOML beside the DBC.

The format is described at the top of ``dbc/ars408.toml``.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import can_imm
from can_imm.bus.codec import Field, field, find_signal
from can_imm.bus.profile_parts import POLAR, STATES, Code, Header, Profile
from can_imm.bus.profile_reading import (
    Database,
    read_code,
    read_codes,
    read_component,
    read_condition,
    read_ego,
    read_kind,
    read_milliseconds,
    read_mounting,
    read_sensors,
    read_whole,
)
from can_imm.bus.protection import p01_data_id
from can_imm.tables import builtin_names, read_table
from can_imm.types import CanImmError

__all__ = ["STATES", "Profile", "builtin_profiles", "dbc_dir", "load_profile"]

LONGEST_CODE = 12
"""Bits of the longest signal that is looked up in a table."""


def dbc_dir() -> Path:
    """Folder of the built-in DBC files and profiles: the installed package's, or the checkout's."""
    package = Path(can_imm.__file__).parent
    installed = package / "dbc"
    return installed if installed.is_dir() else package.parent / "dbc"


def builtin_profiles() -> list[str]:
    """Names of the built-in profiles."""
    return builtin_names(dbc_dir())


def load_profile(name_or_path: str, *, sensor: int | None = None) -> Profile:
    """A built-in profile by name, or one from a TOML file; its DBC's path is relative to the TOML.

    Args:
        sensor: number of the sensor that counts, where several may share a bus; None leaves it to
            the profile, which may leave it to the decoder (the first one that is heard).

    Raises:
        CanImmError: file missing or broken, or a key, message or signal that is wrong.
    """
    top = read_table(name_or_path, dbc_dir(), "sensor profile")
    path = Path(top.file)
    dbc = path.parent / top.text("dbc")
    description = top.text("description", "")
    scan, obj, protection = top.table("scan"), top.table("object"), top.table("protection")
    several, mounted = top.table("sensors", {}), top.table("mounting", {})
    moving = top.table("ego") if "ego" in top else None
    named = read_codes(top.table("codes", {}))
    top.done()
    database = Database(dbc)

    period_ns = read_milliseconds(scan, "period_ms", least=1)
    timeout_ns = read_milliseconds(scan, "timeout_ms", least=1)
    latency_ns = read_milliseconds(scan, "latency_ms", least=0)
    counter = scan.text("counter")
    header = None
    if "header" in scan:
        header = Header(database.message(scan, scan.text("header")), scan.text("count"))
    padded = scan.flag("padded", False)
    scan.done()

    messages = database.messages(obj, "messages", needed=True)
    also = database.messages(obj, "also") if "also" in obj else ()
    id_signal = obj.text("id") if "id" in obj else None
    if (header is None) != (id_signal is None):
        raise obj.error("'id' is needed with, and only with, a scan header")
    if also and id_signal is None:
        raise obj.error("'also' needs an 'id' that ties the messages to an object")
    new_signal = obj.text("new") if "new" in obj else None
    new_codes = tuple(read_whole(obj, "new_codes")) if "new_codes" in obj else ()
    valid_if = tuple(read_condition(table) for table in obj.tables("valid_if", []))
    object_class = read_code(obj.table("class"), named) if "class" in obj else None
    sizes = tuple(
        read_code(obj.table(key), named) if key in obj else None for key in ("length", "width")
    )
    existence: Code | None = None
    least = 0.0
    if "existence" in obj:
        table = obj.table("existence")
        least = table.number("at_least", 0.0, low=0.0, high=1.0)
        existence = read_code(table, named)
    polar = "polar" in obj
    if polar and "state" in obj:
        raise obj.error("either 'state' or 'polar', not both")
    state = obj.table("polar" if polar else "state")
    obj.done()

    def find(signal: str) -> Any:
        """The signal, None without one; what is missing is refused later."""
        return next(
            (m.get_signal_by_name(signal) for m in (messages[0], *also) if signal in m.signal_tree),
            None,
        )

    keys = POLAR if polar else STATES
    components = tuple(
        read_component(state.table(k), k, find, named) if k in state else None for k in keys
    )
    state.done()
    if not any(components):
        raise state.error("no state is measured")
    if polar and not (components[0] and components[2]):
        raise state.error("'range' and 'bearing' are both needed")

    kind = read_kind(protection, "kind")
    protection_counter = protection.text("counter") if kind == "toyota" else None
    protection.done()
    sensors = read_sensors(several, header)
    if sensor is not None:
        if not 0 <= sensor < sensors.number:
            raise CanImmError(f"{path}: has sensors 0 to {sensors.number - 1}, not {sensor}")
        sensors = replace(sensors, use=sensor)

    profile = Profile(
        path.stem, path, description, dbc, period_ns, timeout_ns, latency_ns, header, counter,
        messages, also, padded, id_signal, new_signal, new_codes, valid_if,
        components if len(components) == len(STATES) else (*components, None), polar,
        existence, least, object_class, (sizes[0], sizes[1]), kind, protection_counter, sensors,
        read_mounting(mounted), read_ego(moving, database) if moving else None,
    )  # fmt: skip
    _check_messages(profile)
    return profile


def _check_messages(profile: Profile) -> None:
    """Refuse messages that we cannot decode and signals that are not there."""
    first = profile.messages[0]
    wanted: list[tuple[Any, list[str]]] = []
    if profile.header:
        wanted.append((profile.header.message, [profile.header.count, profile.counter]))
    of_first = [profile.id] if profile.header else [profile.counter]
    if profile.protection_counter is not None:
        of_first.append(profile.protection_counter)
        wanted += [(message, [profile.protection_counter]) for message in profile.also]
    of_also: dict[str, list[str]] = {message.name: [] for message in profile.also}
    for name in profile.object_signals():
        source = profile.source(name)
        of_also[source.name].append(name) if source in profile.also else of_first.append(name)
    names = [name for name in of_first if name is not None]
    wanted += [(message, names) for message in profile.messages]
    wanted += [(m, [profile.id, *of_also[m.name]]) for m in profile.also if profile.id]
    used = [*([profile.header.message] if profile.header else []), *profile.object_messages]
    shared = profile.sensors
    ids = {m.frame_id + n * shared.id_step for m in used for n in range(shared.number)}
    if len(ids) < len(used) * shared.number:
        raise CanImmError(f"{profile.path}: two messages with one id")
    fields: dict[str, Field] = {}
    codes = {code.signal for code in profile.codes()}
    for message, signals in wanted:
        _check_frame(profile, message, profile.protection)
        for name in signals:
            signal = find_signal(message, name, profile.path, profile.dbc)
            if name in codes and signal.length > LONGEST_CODE:
                raise CanImmError(
                    f"{profile.path}: signal {name!r} of {message.name} is longer than "
                    f"{LONGEST_CODE} bits: not supported here"
                )
            if message not in profile.messages:
                continue
            if fields.setdefault(name, field(signal)) != field(signal):
                raise CanImmError(
                    f"{profile.path}: signal {name!r} of {message.name} has another scale or "
                    f"range than in {first.name}"
                )
    for part in profile.ego.parts if profile.ego else ():
        if part is not None:
            _check_frame(profile, part.message, part.protection)
            for name in part.signals:
                find_signal(part.message, name, profile.path, profile.dbc)
            if part.message.frame_id in ids:
                raise CanImmError(f"{profile.path}: {part.message.name} is also a sensor message")


def _check_frame(profile: Profile, message: Any, protection: str) -> None:
    if message.is_extended_frame or message.is_fd or not 1 <= message.length <= 8:
        raise CanImmError(
            f"{profile.path}: message {message.name} of {profile.dbc.name} is not a classic "
            "frame with an 11-bit id: not supported"
        )
    if protection == "e2e-p01":
        p01_data_id(message, profile.dbc)
