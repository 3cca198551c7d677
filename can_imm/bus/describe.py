"""A profile in words: what it reads, and what is odd about it."""

from __future__ import annotations

import math
from typing import Any

from can_imm.bus.codec import field
from can_imm.bus.layout import total_std
from can_imm.bus.profile_parts import (
    POLAR,
    STATES,
    Code,
    Component,
    EgoSignal,
    Profile,
)
from can_imm.bus.units import known_unit

_WORDS = {
    "x": "distance ahead", "vx": "relative speed ahead", "y": "distance to the left",
    "vy": "relative speed to the left", "range": "distance", "rate": "rate of the distance",
    "bearing": "bearing, to the left",
}  # fmt: skip
_PROTECTION = {
    "e2e-p01": "AUTOSAR E2E profile 1: CRC and alive counter",
    "toyota": "checksum in the last byte, alive counter",
    "none": "none: damaged frames are believed",
}
_CHECKSUM = {"e2e-p01": "CRC checked", "toyota": "checksum checked", "none": "no checksum"}


def describe(profile: Profile) -> list[tuple[str, list[str]]]:
    """Headings and the lines below each."""
    at, shared = profile.mounting, profile.sensors
    parts = [
        ("profile", [f"{profile.path}", profile.description or "no description"]),
        ("DBC", [f"{profile.dbc}", *_messages(profile)]),
        ("a scan", _scan(profile)),
        ("an object", _object(profile)),
        ("measured", [line for line, _ in _measured(profile)]),
        ("protection", [_PROTECTION[profile.protection]]),
    ]
    if shared.number > 1:
        which = "the first that is heard" if shared.use is None else f"sensor {shared.use}"
        parts.append(
            ("sensors", [f"0 to {shared.number - 1}, ids {shared.id_step} apart; read: {which}"])
        )
    parts.append(
        (
            "mounting",
            [
                f"{at.x:g} m ahead and {at.y:g} m to the left of the middle of the front bumper, "
                f"turned {math.degrees(at.yaw):g} deg to the left"
            ],
        )
    )
    parts.append(("ego motion", _ego(profile)))
    warnings = warnings_of(profile)
    if warnings:
        parts.append(("careful", warnings))
    return parts


def warnings_of(profile: Profile) -> list[str]:
    """What is right, but perhaps not meant so."""
    warnings = [text for _, text in _measured(profile) if text]
    for name, part in zip(("speed", "yaw_rate"), _ego_parts(profile), strict=True):
        if part is None:
            continue
        signal = part.message.get_signal_by_name(part.mean_of[0])
        if known_unit(signal.unit) is None:
            warnings.append(
                f"ego {name}: signal {signal.name} has no unit that is known; taken as {part.unit}"
            )
    speed, turn = _ego_parts(profile)
    if speed is None:
        warnings.append("no ego speed: STATIONARY and ONCOMING cannot be told from traffic")
    if turn is None:
        warnings.append("no ego yaw rate: the ego's own curves look like the others' lane changes")
    if profile.polar and profile.state[1] is None:
        warnings.append("no range rate: speeds come from the distance alone")
    if not profile.polar and profile.state[1] is None:
        warnings.append("no vx: speeds come from the distance alone")
    if profile.state[0] is None or profile.state[2] is None:
        warnings.append("x and y are both needed to place an object")
    if profile.new is None:
        warnings.append("nothing tells when an id names another object")
    if profile.header is None and not profile.valid_if:
        warnings.append("no 'valid_if': every slot holds an object all the time")
    if profile.timeout_ns > profile.period_ns:
        warnings.append("timeout_ms is longer than period_ms: an incomplete scan delays the next")
    return warnings


def measures(profile: Profile) -> str:
    """The measured components in a few letters."""
    names = POLAR if profile.polar else STATES
    return " ".join(name for name, part in zip(names, profile.state, strict=False) if part)


def tells_ego(profile: Profile) -> str:
    """What of the ego's motion the profile reads, in a few words."""
    speed, turn = _ego_parts(profile)
    names = (["speed"] if speed else []) + (["yaw rate"] if turn else [])
    return ", ".join(names) or "-"


def frame_ids(profile: Profile) -> str:
    """Ids of the sensor's messages, short: "0x300 0x301", "0x500-0x53F"."""
    messages = [*([profile.header.message] if profile.header else []), *profile.object_messages]
    ids = sorted(message.frame_id for message in messages)
    runs: list[list[int]] = []
    for number in ids:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return " ".join(
        f"0x{run[0]:X}" if len(run) == 1 else f"0x{run[0]:X}-0x{run[-1]:X}" for run in runs
    )


def _ego_parts(profile: Profile) -> tuple[EgoSignal | None, EgoSignal | None]:
    return profile.ego.parts if profile.ego else (None, None)


def _messages(profile: Profile) -> list[str]:
    lines = []
    if profile.header:
        lines.append(f"{_name(profile.header.message)} starts a scan")
    first, last = profile.messages[0], profile.messages[-1]
    several = "" if first is last else f" to {_name(last)}"
    lines.append(f"{_name(first)}{several}: objects")
    lines += [f"{_name(message)}: more about each, if sent" for message in profile.also]
    told = {part.message.name: part.message for part in _ego_parts(profile) if part}
    lines += [f"{_name(message)}: ego motion" for message in told.values()]
    return lines


def _name(message: Any) -> str:
    return f"0x{message.frame_id:X} {message.name}"


def _scan(profile: Profile) -> list[str]:
    times = (
        f"every {profile.period_ns / 1e6:g} ms ({1e9 / profile.period_ns:.3g} per second), "
        f"measured {profile.latency_ns / 1e6:g} ms before the first frame"
    )
    limit = f"given up {profile.timeout_ns / 1e6:g} ms after its first frame"
    if profile.header is None:
        return [
            times,
            f"is one frame of each of the {len(profile.messages)} messages with one "
            f"{profile.counter}; {limit}",
        ]
    more = ""
    if profile.also:
        names = " and ".join(message.name for message in profile.also)
        more = f", and as many {names} if the sensor sends these"
    first = profile.messages[0].name
    return [
        times,
        f"begins with {profile.header.message.name}, numbered by {profile.counter}",
        f"ends when {profile.header.count} frames {first} have come{more}; {limit}",
    ]


def _object(profile: Profile) -> list[str]:
    name = f"signal {profile.id}" if profile.id else "its message's place in the list"
    lines = [f"is named by {name}"]
    lines += [f"is there only if {condition.words()}" for condition in profile.valid_if]
    if profile.existence is not None:
        lines.append(
            f"is there only if {profile.existence.signal} means a probability of "
            f"{profile.existence_least:g} or more"
        )
    if profile.new is not None:
        codes = profile.new_codes
        value = f"is {' or '.join(map(str, codes))}" if codes else "is not 0"
        lines.append(f"is another one than before if {profile.new} {value}")
    named: list[tuple[str, Code | None]] = [("class", profile.object_class)]
    named += [("length", profile.size[0]), ("width", profile.size[1])]
    lines += [f"{what}: {code.signal}" for what, code in named if code is not None]
    return lines


def _measured(profile: Profile) -> list[tuple[str, str]]:
    """A line and a warning, or an empty text, for each component."""
    found = []
    names = POLAR if profile.polar else STATES
    for name, part in zip(names, profile.state, strict=False):
        if part is None:
            found.append((f"{name:<8}not measured", ""))
        else:
            found.append(_component(profile, name, part))
    return found


def _component(profile: Profile, name: str, part: Component) -> tuple[str, str]:
    signal = profile.messages[0].get_signal_by_name(part.signal)
    scaling = field(signal)
    step = abs(scaling.scale)
    ends = [
        (raw * scaling.scale + scaling.offset) * part.sign + part.offset
        for raw in (scaling.low, scaling.high)
    ]
    unit = part.unit
    std = total_std(part, part.std, signal) / part.factor
    sign = "-" if part.sign < 0 else ""
    shift = f" {part.offset:+g}" if part.offset else ""
    line = (
        f"{name:<8}{_WORDS[name]} = {sign}{part.signal}{shift} [{unit}], {min(ends):g} to "
        f"{max(ends):g} in steps of {step:g}, std {std:.3g} ({part.std:g} and rounding)"
    )
    if part.std_from is not None:
        line += f", or that of {part.std_from.signal}"
        line += f", at least {part.std_floor:g}" if part.std_floor else ""
    lasting = (
        (part.std_lasting, "", part.lasting_s),
        (part.new_per_m, " per metre ahead in a new track", part.new_s),
        (part.std_per_m, " per metre ahead in all tracks alike", part.per_m_s),
    )
    errors = [f"{size:g} {unit}{where} for {time:g} s" for size, where, time in lasting if size]
    if errors:
        line += "; errors that last: " + ", ".join(errors)
    if scaling.missing is not None:
        line += f"; raw {scaling.missing}: not available"
    texts = []
    if part.std < step / math.sqrt(12):
        texts.append(f"{name}: std {part.std:g} is smaller than the rounding to steps of {step:g}")
    if known_unit(signal.unit) is None:
        said = f"unit {signal.unit!r}" if signal.unit else "no unit"
        texts.append(f"{name}: signal {part.signal} has {said} in the DBC; taken as {unit}")
    elif known_unit(signal.unit) != unit:
        texts.append(f"{name}: signal {part.signal} is in {signal.unit} by the DBC, not in {unit}")
    return line, "; ".join(texts)


def _ego(profile: Profile) -> list[str]:
    if profile.ego is None:
        return ["not told"]
    lines = []
    for name, part in zip(("speed", "yaw rate"), profile.ego.parts, strict=True):
        if part is None:
            lines.append(f"{name} not told")
            continue
        signals = " + ".join(part.mean_of)
        many = len(part.mean_of)
        value = signals if many == 1 else f"({signals}) / {many}"
        text = f"{name} = {'-' if part.sign < 0 else ''}{value}"
        text += f" {part.offset:+g}" if part.offset else ""
        text += f" [{part.unit}] of {_name(part.message)}, {_CHECKSUM[part.protection]}"
        text += "".join(f", if {condition.words()}" for condition in part.valid_if)
        if part.reverse_if is not None:
            text += f", negative if {part.reverse_if.words()}"
        lines.append(text)
    if profile.ego.shifted:
        lines.append("or of the same messages with ids higher as the sensor's")
    return [*lines, f"forgotten {profile.ego.timeout_ns / 1e6:g} ms after its frame"]
