"""A sensor profile compiled: per frame id the checks and the reader, and what the values mean."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from can_imm.bus.codec import (
    Lookup,
    Test,
    Value,
    compile_object,
    compile_reader,
    field,
    find_signal,
)
from can_imm.bus.profile_parts import Code, Component, Condition, Profile
from can_imm.bus.protection import Guard, p01_data_id, p01_guard, toyota_guard

HEADER = -1
"""`CompiledMessage.slot` of the message that starts a scan."""

COLUMNS = 8
EXISTENCE, CLASS, LENGTH, WIDTH = 4, 5, 6, 7
"""What a sensor may send of an object besides the state: columns 0 to 3 are the standard deviations
of the state's components."""

Take = Callable[[bytes], tuple[Any, ...]]


class CompiledMessage:
    """One message: its checks, its reader, and the last alive counter that was seen of it.

    Attributes:
        length, longest: allowed numbers of bytes.
        read: raw values of the header's count and counter; of other messages None.
        take: `compile_object` of a message about objects; of others None.
        slot: number among the messages of a scan without a header, `HEADER`, or of the messages
            of a scan with one: 0 for the object's first, 1, 2 ... for those that may follow.
        sensor: number of the sensor that sends it.
        columns: which of the columns ``take`` looks up.
    """

    __slots__ = (
        "columns", "guard", "last_counter", "last_ns", "length", "longest", "read", "sensor",
        "slot", "take",
    )  # fmt: skip

    def __init__(
        self,
        message: Any,
        guard: Guard | None,
        slot: int,
        *,
        padded: bool = False,
        sensor: int = 0,
        read: Callable[[bytes], tuple[int, ...]] | None = None,
        take: Take | None = None,
        columns: Sequence[int] = (),
    ) -> None:
        self.length: int = message.length
        self.longest = 8 if padded else self.length
        self.read, self.take = read, take
        self.slot, self.sensor = slot, sensor
        self.columns = list(columns)
        self.guard = guard
        self.last_counter = -1
        self.last_ns = 0


class Layout:
    """What `ScanDecoder` needs of a profile.

    Attributes:
        messages: by the number of the sensor, `CompiledMessage` by frame id.
        slots: number of object frames of a scan without a header, 0 with one.
        also: number of further messages that the sensor may send of each object.
        measured: number of components that are measured.
        columns: which of the columns some message looks up.
        count_range: lowest and highest number of objects.
        scan_modulus: number of values of the scan counter.
    """

    def __init__(self, profile: Profile) -> None:
        self.measured = sum(part is not None for part in profile.state)
        self.also = len(profile.also)
        readers: dict[tuple[Any, ...], tuple[Take, list[int]]] = {}
        for message in profile.object_messages:
            shape = _shape(profile, message)
            if shape not in readers:
                readers[shape] = _object_reader(profile, message)
        self.columns = sorted({column for _, columns in readers.values() for column in columns})
        first = profile.messages[0]
        counted, read_header = first, None
        if profile.header is None:
            self.slots = len(profile.messages)
            self.count_range = (self.slots, self.slots)
        else:
            self.slots = 0
            counted = profile.header.message
            count = counted.get_signal_by_name(profile.header.count)
            counter = counted.get_signal_by_name(profile.counter)
            self.count_range = (field(count).low, field(count).high)
            read_header = compile_reader(counted, [count, counter])
        self.scan_modulus = 1 << counted.get_signal_by_name(profile.counter).length

        self.messages: dict[int, dict[int, CompiledMessage]] = {}
        for sensor in range(profile.sensors.number):
            ids = self.messages[sensor] = {}
            step = sensor * profile.sensors.id_step
            if profile.header is not None:
                frame_id = counted.frame_id + step
                ids[frame_id] = CompiledMessage(
                    counted, _guard(profile, counted, frame_id), HEADER, padded=profile.padded,
                    sensor=sensor, read=read_header,
                )  # fmt: skip
            for place, message in enumerate(profile.object_messages):
                # several first messages of a sensor with a header are all alike
                slot = place if not profile.header else max(place - len(profile.messages) + 1, 0)
                frame_id = message.frame_id + step
                take, columns = readers[_shape(profile, message)]
                ids[frame_id] = CompiledMessage(
                    message, _guard(profile, message, frame_id), slot, padded=profile.padded,
                    sensor=sensor, take=take, columns=columns,
                )  # fmt: skip


def compile_condition(condition: Condition, scale: float, offset: float) -> str:
    """A test of the raw value ``r`` as source."""
    value = f"r * {scale!r} + {offset!r}"
    if condition.equals is not None:
        return f"{value} == {condition.equals!r}"
    if condition.below is not None:
        return f"{value} < {condition.below!r}"
    if condition.above is not None:
        return f"{value} > {condition.above!r}"
    return f"{value} in {condition.any_of!r}"


def guard_of(profile: Profile, message: Any, protection: str, frame_id: int) -> Guard | None:
    """The checksum of a message; nothing is asked of its alive counter."""
    if protection == "e2e-p01":
        return p01_guard(p01_data_id(message, profile.dbc))._replace(modulus=0)
    if protection == "toyota":
        return toyota_guard(frame_id, message.length)
    return None


def total_std(part: Component, std: float, signal: Any) -> float:
    """Standard deviation in SI units of a component: the sensor's, and that of the rounding to the
    signal's steps, LSB^2 / 12."""
    step = float(signal.scale)
    return part.factor * math.sqrt(std * std + step * step / 12)


def code_table(code: Code, signal: Any, default: float) -> list[float]:
    """What each raw value of a signal stands for, ``default`` for "not available"; negative raw
    values are at the end. Percent become numbers from 0 to 1."""
    scaling = field(signal)
    one = 0.01 if signal.unit == "%" else 1.0
    table = []
    for unsigned in range(1 << signal.length):
        raw = unsigned
        if signal.is_signed and raw >= 1 << signal.length - 1:
            raw -= 1 << signal.length
        if code.table is not None:
            table.append(code.table[raw] if 0 <= raw < len(code.table) else default)
        elif raw == scaling.missing or not scaling.low <= raw <= scaling.high:
            table.append(default)
        else:
            table.append((raw * scaling.scale + scaling.offset) * one)
    return table


def std_table(part: Component, signal: Any, own: Any) -> list[float]:
    """Standard deviation [SI units] of a component of ``signal`` by the raw value of the signal
    ``own`` in which the sensor sends its own."""
    assert part.std_from is not None
    stds = code_table(part.std_from, own, math.nan)
    return [
        total_std(part, part.std if math.isnan(std) else max(std, part.std_floor, 1e-6), signal)
        for std in stds
    ]


def _shape(profile: Profile, message: Any) -> tuple[Any, ...]:
    """Where a message has what is read of it: messages of one shape share a reader."""
    names = {profile.id or profile.counter, *profile.object_signals()} & set(message.signal_tree)
    signals = (message.get_signal_by_name(name) for name in sorted(names))
    return message.length, *((s.name, s.start, s.length, s.byte_order) for s in signals)


def _object_reader(profile: Profile, message: Any) -> tuple[Take, list[int]]:
    """The function that reads a message about objects, and the columns that it looks up."""
    main = message in profile.messages
    own = message if not main else profile.messages[0]

    def mine(name: str) -> Any:
        """The signal, if this is the message where it is read."""
        if profile.source(name) is not own:
            return None
        return find_signal(message, name, profile.path, profile.dbc)

    key = find_signal(message, profile.id or profile.counter, profile.path, profile.dbc)
    tests = []
    for condition in profile.valid_if:
        if (signal := mine(condition.signal)) is not None:
            scaling = field(signal)
            words = compile_condition(condition, scaling.scale, scaling.offset)
            tests.append(Test(signal, words))
    lookups: dict[int, Lookup] = {}
    for state, part in enumerate(profile.state):
        if part is None or part.std_from is None:
            continue
        if (signal := mine(part.std_from.signal)) is not None:
            measured = profile.messages[0].get_signal_by_name(part.signal)
            lookups[state] = Lookup(signal, std_table(part, measured, signal))
    for column, code, default in (
        (EXISTENCE, profile.existence, 1.0),
        (CLASS, profile.object_class, 0.0),
        (LENGTH, profile.size[0], math.nan),
        (WIDTH, profile.size[1], math.nan),
    ):
        if code is not None and (signal := mine(code.signal)) is not None:
            table = code_table(code, signal, default)
            if column in (LENGTH, WIDTH):
                table = [value or math.nan for value in table]  # nothing is 0 m long
            lookups[column] = Lookup(signal, table)
    if EXISTENCE in lookups and profile.existence_least > 0:
        signal, chances = lookups[EXISTENCE]
        tests.append(Test(signal, "", [p >= profile.existence_least for p in chances]))
    new = None
    if profile.new is not None and (signal := mine(profile.new)) is not None:
        codes = profile.new_codes
        size = 1 << signal.length
        flags = [raw in codes if codes else raw != 0 for raw in range(size)]
        new = Lookup(signal, flags)
    shifts = _shifts(profile)
    values = [
        Value(mine(part.signal), part.sign, part.offset, part.factor, shift)
        if main and part
        else None
        for part, shift in zip(profile.state, shifts, strict=True)
    ]
    key_field = field(key)
    key_range = (key_field.low, key_field.high) if profile.header is not None else None
    take = compile_object(
        message.length, key, key_range, tests, new, values,
        (0, 2) if profile.polar and main else (), list(lookups.values()),
    )  # fmt: skip
    return take, list(lookups)


def _shifts(profile: Profile) -> tuple[float, ...]:
    """What the mounting adds to Cartesian components, in the sensor's axes."""
    if profile.polar:
        return (0.0,) * 4
    at = profile.mounting
    cos, sin = math.cos(at.yaw), math.sin(at.yaw)
    return (at.x * cos + at.y * sin, 0.0, at.y * cos - at.x * sin, 0.0)


def _guard(profile: Profile, message: Any, frame_id: int) -> Guard | None:
    if profile.protection == "e2e-p01":
        return p01_guard(p01_data_id(message, profile.dbc))
    if profile.protection_counter is not None:
        if profile.protection_counter not in message.signal_tree:
            return toyota_guard(frame_id, message.length)
        signal = message.get_signal_by_name(profile.protection_counter)
        read = compile_reader(message, [signal])
        return toyota_guard(
            frame_id, message.length, lambda data: read(data)[0], 1 << signal.length
        )
    return None
