"""What a profile's radar, and the vehicle beside it, would send: the inverse of the decoder."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from can_imm.bus.codec import field
from can_imm.bus.frame import Frame
from can_imm.bus.packing import InverseTable, MessagePacker
from can_imm.bus.profile_parts import Condition, EgoSignal, Profile
from can_imm.types import FloatArray, Scan

STANDSTILL = 0.05
"""A vehicle slower than this [m/s] is said to stand, where a profile has a condition for that."""


class ProfileEncoder:
    """The frames of a profile's sensor.

    Components that are not valid are sent as "not available", values beyond a signal's range as
    that, too, or where the sensor has no code for it as the end of the range.  The first value of a
    condition ``any_of`` is the one that is sent.  All frames of a scan have its time.

    A polar sensor's range rate is made of both components of the velocity; if that across (the
    last one) is not valid, the other one is taken for the range rate.

    Attributes:
        left_out: objects whose id, or which, did not fit into the messages.

    Args:
        also: whether the sensor sends the messages that may come besides the first of an object.
    """

    def __init__(self, profile: Profile, *, also: bool = True) -> None:
        self.left_out = 0
        self._profile = profile
        self._shift = (profile.sensors.use or 0) * profile.sensors.id_step
        self._also = profile.also if also else ()
        self._scans = 0
        self._packers: dict[int, MessagePacker] = {}
        first = profile.messages[0]
        self._fields = [
            field(first.get_signal_by_name(part.signal)) if part else None for part in profile.state
        ]
        self._inverse = {
            code.signal: InverseTable(
                code, profile.source(code.signal).get_signal_by_name(code.signal)
            )
            for code in profile.codes()
        }
        self._known = _settings(profile, profile.valid_if, first)
        self._empty = {} if profile.header else _failing(profile)
        if profile.header is None:
            self._most, self._ids = len(profile.messages), range(len(profile.messages))
        else:
            count = field(profile.header.message.get_signal_by_name(profile.header.count))
            name = field(first.get_signal_by_name(profile.id))
            self._most, self._ids = count.high, range(name.low, name.high + 1)

    def encode(self, scan: Scan, t_ns: int) -> list[Frame]:
        """The frames of ``scan``, stamped ``t_ns`` [ns]."""
        rows: list[tuple[int, int]] = []
        seen = set()
        for row, name in enumerate(scan.ids[: scan.n].tolist()):
            if name in self._ids and name not in seen and len(rows) < self._most:
                rows.append((row, name))
                seen.add(name)
        self.left_out += scan.n - len(rows)
        profile, number = self._profile, self._scans
        self._scans += 1
        raws = self._raws(scan)
        frames = []
        if profile.header is not None:
            header = profile.header
            modulus = 1 << header.message.get_signal_by_name(profile.counter).length
            head = {header.count: len(rows), profile.counter: number % modulus}
            frames.append(self._frame(header.message, head, t_ns))
            for message in (profile.messages[0], *self._also):
                frames += [
                    self._frame(message, {**raws[row], profile.id: name}, t_ns)  # type: ignore[dict-item]
                    for row, name in rows
                ]
            return frames
        by_slot = {name: raws[row] for row, name in rows}
        for slot, message in enumerate(profile.messages):
            modulus = 1 << message.get_signal_by_name(profile.counter).length
            values = by_slot.get(slot, self._empty)
            frames.append(self._frame(message, {**values, profile.counter: number % modulus}, t_ns))
        return frames

    def encode_ego(self, speed: float, yaw_rate: float, t_ns: int) -> list[Frame]:
        """The frames that tell the vehicle's speed [m/s] and yaw rate [rad/s, to the left], stamped
        ``t_ns`` [ns]; a value that is NaN is sent as not available, or not at all."""
        ego = self._profile.ego
        by_message: dict[int, tuple[EgoSignal, dict[str, int]]] = {}
        for part, value in zip(ego.parts if ego else (), (speed, yaw_rate), strict=False):
            if part is None:
                continue
            raws = _ego_raws(part, value)
            if raws is not None:
                by_message.setdefault(part.message.frame_id, (part, {}))[1].update(raws)
        return [
            self._frame(part.message, raws, t_ns, part.protection)
            for part, raws in by_message.values()
        ]

    def _raws(self, scan: Scan) -> list[dict[str, int]]:
        """Raw values by signal of each row, but those of id and counter."""
        profile, n = self._profile, scan.n
        values, stds = (array.tolist() for array in _in_sensor_axes(profile, scan))
        news, sizes = scan.new[:n].tolist(), scan.size[:n].tolist()
        existence, classes = scan.existence[:n].tolist(), scan.object_class[:n].tolist()
        result = []
        for row in range(n):
            raws = dict(self._known)
            if profile.new is not None:
                _set_new(profile, raws, news[row])
            for state, (part, scaling) in enumerate(zip(profile.state, self._fields, strict=True)):
                if part is None or scaling is None:
                    continue
                value = (values[row][state] / part.factor - part.offset) * part.sign
                raws[part.signal] = scaling.raw(value)
                if part.std_from is not None:
                    inverse = self._inverse[part.std_from.signal]
                    raws[part.std_from.signal] = inverse.raw(stds[row][state] / part.factor)
            length, width = profile.size
            for code, value in (
                (profile.existence, existence[row]),
                (profile.object_class, classes[row]),
                (length, sizes[row][0]),
                (width, sizes[row][1]),
            ):
                if code is not None:
                    raws[code.signal] = self._inverse[code.signal].raw(value)
            result.append(raws)
        return result

    def _frame(
        self, message: Any, raws: Mapping[str, int], t_ns: int, protection: str | None = None
    ) -> Frame:
        packer = self._packers.get(message.frame_id)
        if packer is None:
            own = protection is None
            ego = self._profile.ego
            shift = self._shift if own or (ego and ego.shifted) else 0
            packer = self._packers[message.frame_id] = MessagePacker(
                self._profile, message, shift,
                protection or self._profile.protection, own,
            )  # fmt: skip
        return Frame(t_ns, packer.id, packer.pack(raws))


def _in_sensor_axes(profile: Profile, scan: Scan) -> tuple[FloatArray, FloatArray]:
    """Components and standard deviations [SI units] as the sensor measures them, NaN where not.

    Args:
        scan: in whatever axes; its `Scan.angle` says which.
    """
    n, at = scan.n, profile.mounting
    z = np.where(scan.valid[:n], scan.z[:n], np.nan)
    std = scan.std[:n].copy()
    along, across = np.cos(scan.angle[:n]), np.sin(scan.angle[:n])
    if not profile.polar and not at.yaw and not scan.angle[:n].any():
        z[:, 0] -= at.x
        z[:, 2] -= at.y
        return z, std
    x = along * z[:, 0] - across * z[:, 2] - at.x
    y = across * z[:, 0] + along * z[:, 2] - at.y
    vx, vy = along * z[:, 1] - across * z[:, 3], across * z[:, 1] + along * z[:, 3]
    if not profile.polar:
        turn = scan.angle[:n] - at.yaw
        cos, sin = math.cos(at.yaw), math.sin(at.yaw)
        z[:, 0], z[:, 2] = cos * x + sin * y, cos * y - sin * x
        if np.any(np.abs(turn) > 1e-9):  # otherwise the velocity has the right axes already
            z[:, 1], z[:, 3] = cos * vx + sin * vy, cos * vy - sin * vx
        return z, std
    distance, direction = np.hypot(x, y), np.arctan2(y, x)
    rate = np.cos(direction) * vx + np.sin(direction) * vy
    bearing = (direction - at.yaw + math.pi) % (2 * math.pi) - math.pi
    # without a velocity across, that along is the rate, as in a polar sensor's scan
    known = np.where(np.isnan(z[:, 3]), z[:, 1], rate)
    std[:, 2] /= np.maximum(distance, 1.0)
    return np.column_stack([distance, known, bearing, np.full(n, np.nan)]), std


def _settings(profile: Profile, conditions: Iterable[Condition], first: Any) -> dict[str, int]:
    """Raw values with which conditions hold, but those of measured signals."""
    measured = {part.signal for part in profile.state if part}
    raws = {}
    for condition in conditions:
        source = profile.source(condition.signal) or first
        if condition.signal in measured or condition.signal not in source.signal_tree:
            continue
        raws[condition.signal] = _fulfil(condition, source)
    return raws


def _fulfil(condition: Condition, message: Any) -> int:
    scaling = field(message.get_signal_by_name(condition.signal))
    if condition.equals is not None:
        return scaling.raw(condition.equals)
    if condition.any_of is not None:
        return scaling.raw(condition.any_of[0])
    return scaling.low if condition.below is not None else scaling.high


def _failing(profile: Profile) -> dict[str, int]:
    """Raw values of an empty slot: the first condition fails, and all that are limits."""
    raws = {}
    for k, condition in enumerate(profile.valid_if):
        scaling = field(profile.messages[0].get_signal_by_name(condition.signal))
        if condition.below is not None:
            raws[condition.signal] = scaling.high
        elif condition.above is not None:
            raws[condition.signal] = scaling.low
        elif k == 0:
            wanted = condition.any_of or (condition.equals,)
            raws[condition.signal] = next(
                (
                    raw
                    for raw in range(scaling.low, scaling.high + 1)
                    if raw * scaling.scale + scaling.offset not in wanted
                ),
                scaling.low,
            )
    return raws


def _set_new(profile: Profile, raws: dict[str, int], new: bool) -> None:
    """Raw value of the signal that tells new objects."""
    assert profile.new is not None
    codes = profile.new_codes
    if new:
        raws[profile.new] = codes[0] if codes else 1
    elif raws.get(profile.new, 0) in codes or not codes:
        raws[profile.new] = 0


def _ego_raws(part: EgoSignal, value: float) -> dict[str, int] | None:
    """Raw values by signal, None if there is no way to say that the value is not known."""
    fields = {name: field(part.message.get_signal_by_name(name)) for name in part.signals}
    raws = {c.signal: _fulfil(c, part.message) for c in part.valid_if}
    direction = part.forwards_if
    if part.standstill_if is not None and abs(value) < STANDSTILL:
        direction, value = part.standstill_if, abs(value)
    elif part.reverse_if is not None and value < 0:
        direction, value = part.reverse_if, -value
    if direction is not None:
        raws[direction.signal] = _fulfil(direction, part.message)
    wanted = (value / part.factor - part.offset) * part.sign
    for name in part.mean_of:
        raws[name] = fields[name].raw(wanted)
    if value != value:
        if part.valid_if:
            fail = part.valid_if[0]
            scaling = fields[fail.signal]
            raws[fail.signal] = next(
                raw for raw in (scaling.low, scaling.high) if raw != raws[fail.signal]
            )
        elif fields[part.mean_of[0]].missing is None:
            return None
    return raws
