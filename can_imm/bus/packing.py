"""Raw values to the bytes of a protected message; values to the raw values that stand for them."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping
from typing import Any

import numpy as np

from can_imm.bus.codec import field, place
from can_imm.bus.layout import code_table
from can_imm.bus.profile_parts import Code, Profile
from can_imm.bus.protection import P01_COUNTERS, p01_data_id, p01_protect, toyota_protect


class MessagePacker:
    """One message: where its signals are, its checksum and its alive counter."""

    def __init__(
        self, profile: Profile, message: Any, shift: int, protection: str, of_sensor: bool
    ) -> None:
        self.id: int = message.frame_id + shift
        self._length: int = message.length
        self._places = {}
        self._little = self._big = 0
        for signal in message.signals:
            order, lowest = place(message, signal)
            mask = (1 << signal.length) - 1
            # what is not set is 0, whatever the offset: an exclusive or with that sets it
            raw = 0 if signal.is_float else field(signal).raw(0.0) & mask
            self._places[signal.name] = (order == "big", lowest, mask, raw)
            if order == "big":
                self._big |= raw << lowest
            else:
                self._little |= raw << lowest
        self._kind = protection
        self._data_id = p01_data_id(message, profile.dbc) if protection == "e2e-p01" else 0
        self._counted = profile.protection_counter if of_sensor else None
        if self._counted == profile.counter and profile.header is None:
            self._counted = None  # the caller counts
        self._counter = 0

    def pack(self, raws: Mapping[str, int]) -> bytes:
        """The next frame's bytes from raw values by signal; those of other messages are ignored."""
        little, big, places = self._little, self._big, self._places
        if self._counted is not None:
            raws = {**raws, self._counted: self._counter}
        for name, raw in raws.items():
            if name not in places:
                continue  # of another message about the object
            is_big, lowest, mask, default = places[name]
            if is_big:
                big ^= (raw & mask ^ default) << lowest
            else:
                little ^= (raw & mask ^ default) << lowest
        if little:
            little |= int.from_bytes(big.to_bytes(self._length, "big"), "little")
            data = bytearray(little.to_bytes(self._length, "little"))
        else:
            data = bytearray(big.to_bytes(self._length, "big"))
        if self._kind == "e2e-p01":
            p01_protect(data, self._data_id, self._counter % P01_COUNTERS)
        elif self._kind == "toyota":
            toyota_protect(data, self.id)
        self._counter += 1
        return bytes(data)


class InverseTable:
    """From the value that a raw value stands for back to the raw value."""

    def __init__(self, code: Code, signal: Any) -> None:
        table = np.array(code_table(code, signal, math.nan))
        raws = np.flatnonzero(np.isfinite(table))
        order = np.argsort(table[raws], kind="stable")
        self._raws, self._values = raws[order].tolist(), table[raws[order]].tolist()
        missing = np.flatnonzero(np.isnan(table))
        self._missing = int(missing[0]) if len(missing) else 0

    def raw(self, value: float) -> int:
        """Raw value whose meaning is nearest; "not available", or else 0, for NaN."""
        if not math.isfinite(value):
            return self._missing
        values = self._values
        k = bisect_left(values, value)
        if k == len(values) or (k and value - values[k - 1] <= values[k] - value):
            k -= 1
        raw: int = self._raws[k]
        return raw
