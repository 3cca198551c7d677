"""A sensor profile compiled: per frame id the checks and the reader, and what the values mean."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from can_imm.bus.codec import compile_reader, field, find_signal
from can_imm.bus.profile import Condition, Profile
from can_imm.bus.protection import Guard, p01_data_id, p01_guard, toyota_guard

HEADER = -1
"""`CompiledMessage.slot` of the message that starts a scan."""


class CompiledMessage:
    """One message: its checks, its reader, and the last alive counter that was seen of it."""

    __slots__ = ("guard", "last_counter", "last_ns", "length", "read", "slot")

    def __init__(self, profile: Profile, message: Any, names: list[str], slot: int) -> None:
        signals = [find_signal(message, name, profile.path, profile.dbc) for name in names]
        self.length: int = message.length
        self.read = compile_reader(message, signals)
        self.slot = slot
        self.guard = _guard(profile, message)
        self.last_counter = -1
        self.last_ns = 0


class ComponentRule(NamedTuple):
    """How the raw value at ``position`` becomes state ``state``: ``(raw * scale + offset) * sign +
    shift`` if ``low <= raw <= high``; ``missing`` stands for "not available"."""

    position: int
    state: int
    scale: float
    offset: float
    low: int
    high: int
    missing: int | None
    sign: float
    shift: float


class Layout:
    """What `ScanDecoder` needs of a profile.

    A reader of an object message gives the raw values of the key, the new flag if there is one, the
    measured states and the validity conditions, in this order. The key is the object's id, or
    without a header the counter of the scan. The header's reader gives the number of objects and
    the counter of the scan.

    Attributes:
        messages: `CompiledMessage` by frame id.
        slots: number of object frames of a scan without a header, 0 with one.
        new: index of the new flag, None without one.
        components: `ComponentRule` for each measured state.
        conditions: pairs of index and test of the raw value; an object must pass all.
        key_range, count_range: lowest and highest raw value of the key and the number of objects.
        scan_modulus: number of values of the scan counter.
    """

    def __init__(self, profile: Profile) -> None:
        parts = [(state, part) for state, part in enumerate(profile.state) if part]
        names = [profile.id or profile.counter]
        if profile.new is not None:
            names.append(profile.new)
        self.new = 1 if profile.new is not None else None
        first_component = len(names)
        names += [part.signal for _, part in parts]
        first_condition = len(names)
        names += [condition.signal for condition in profile.valid_if]

        # load_profile has made sure that the scaling is the same in all object messages
        first = profile.messages[0]
        scalings = [field(first.get_signal_by_name(name)) for name in names]
        self.messages = {
            message.frame_id: CompiledMessage(profile, message, names, slot)
            for slot, message in enumerate(profile.messages)
        }
        self.key_range = (scalings[0].low, scalings[0].high)
        self.components = [
            ComponentRule(index, state, *scalings[index][1:], part.sign, part.offset)
            for index, (state, part) in enumerate(parts, first_component)
        ]
        self.conditions = [
            (index, _test(condition, scalings[index].scale, scalings[index].offset))
            for index, condition in enumerate(profile.valid_if, first_condition)
        ]
        if profile.header is None:
            self.slots = len(profile.messages)
            self.count_range = (self.slots, self.slots)
            counter = first.get_signal_by_name(profile.counter)
        else:
            message = profile.header.message
            self.slots = 0
            self.messages[message.frame_id] = CompiledMessage(
                profile, message, [profile.header.count, profile.counter], HEADER
            )
            count = field(message.get_signal_by_name(profile.header.count))
            self.count_range = (count.low, count.high)
            counter = message.get_signal_by_name(profile.counter)
        self.scan_modulus = 1 << counter.length


def _guard(profile: Profile, message: Any) -> Guard | None:
    if profile.protection == "e2e-p01":
        return p01_guard(p01_data_id(message, profile.dbc))
    if profile.protection_counter is not None:
        signal = message.get_signal_by_name(profile.protection_counter)
        read = compile_reader(message, [signal])
        return toyota_guard(
            message.frame_id, message.length, lambda data: read(data)[0], 1 << signal.length
        )
    return None


def _test(condition: Condition, scale: float, offset: float) -> Callable[[int], bool]:
    """The validity condition as a test of the raw value."""
    equals, below = condition.equals, condition.below
    if below is not None:
        limit = below
        return lambda raw: raw * scale + offset < limit
    return lambda raw: raw * scale + offset == equals
