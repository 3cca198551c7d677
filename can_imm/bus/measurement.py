"""The objects of a scan as the frames told them, and what a `Scan` is to hold of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from can_imm.bus.layout import CLASS, COLUMNS, EXISTENCE, LENGTH, WIDTH, Layout, total_std
from can_imm.bus.profile_parts import Component, Profile
from can_imm.types import LastingErrors, Scan, Y

_NEAREST = 1.0
"""A polar sensor's error across is not less than it is at this range [m]."""

_DEFAULTS = np.array([np.nan] * 4 + [1.0, 0.0, np.nan, np.nan])


def _lasting(part: Component, period_s: float) -> LastingErrors | None:
    """The lasting errors of a lateral position."""
    if not (part.std_lasting or part.std_per_m or part.new_per_m):
        return None
    return LastingErrors(
        part.std_lasting * part.factor, part.lasting_s, part.std_per_m * part.factor, part.per_m_s,
        part.new_per_m * part.factor, part.new_s, period_s,
    )  # fmt: skip


class ObjectList:
    """The objects of the scan that is being collected; `write` puts them into a `Scan`."""

    def __init__(self, profile: Profile, layout: Layout, capacity: int) -> None:
        self._capacity = capacity
        self._polar, self._mounting = profile.polar, profile.mounting
        self._columns = layout.columns
        self._table = np.empty((capacity, COLUMNS))
        self._defaults = _DEFAULTS.copy()
        self._mask = np.array([part is not None for part in profile.state])
        for state, part in enumerate(profile.state):
            if part is not None:
                signal = profile.messages[0].get_signal_by_name(part.signal)
                self._defaults[state] = total_std(part, part.std, signal)
            else:
                self._defaults[state] = 1.0
        across = profile.state[Y]
        self._lasting = _lasting(across, profile.period_ns * 1e-9) if across else None
        self._stds = any(column < 4 for column in self._columns)
        self._also = layout.also + 1
        self._fields: list[list[int]] = [[] for _ in range(self._also)]
        for messages in layout.messages.values():
            for message in messages.values():
                if message.take is not None and message.columns:
                    self._fields[message.slot if not layout.slots else 0] = message.columns
        self.clear()

    def prepare(self, scan: Scan) -> None:
        """Set what is the same in every scan."""
        scan.std[:] = self._defaults[:4]
        scan.lasting = self._lasting
        scan.angle[:] = 0.0 if self._polar else self._mounting.yaw

    def clear(self) -> None:
        """Forget the objects."""
        self.ids: list[int] = []
        self.new: list[bool] = []
        self._values: list[tuple[float, ...]] = []
        self._missing = 0
        self._rows: list[list[int]] = [[] for _ in range(self._also)]
        self._looked: list[list[tuple[float, ...]]] = [[] for _ in range(self._also)]
        self._dropped: set[int] = set()

    def add(self, key: int, row: tuple[Any, ...]) -> None:
        """An object from its first message; ``row`` as `compile_object` gives it."""
        _, _, new, missing, values, looked = row
        if looked:
            self._rows[0].append(len(self.ids))
            self._looked[0].append(looked)
        self.ids.append(key)
        self.new.append(new)
        self._values.append(values)
        self._missing += missing

    def complete(self, number: int, slot: int, row: tuple[Any, ...]) -> None:
        """What message ``slot`` says of object ``number``."""
        if row[2]:
            self.new[number] = True
        self._rows[slot].append(number)
        self._looked[slot].append(row[5])

    def drop(self, number: int) -> None:
        """Object ``number`` is none after all."""
        self._dropped.add(number)

    def write(self, scan: Scan) -> None:
        """Put the objects into ``scan``."""
        n = len(self.ids)
        if not n:
            scan.n = 0
            return
        ids, new, values = self.ids, self.new, self._values
        if self._columns:
            table = self._table[:n]
            table[:] = self._defaults
            for columns, rows, looked in zip(self._fields, self._rows, self._looked, strict=True):
                if rows:
                    table[np.ix_(rows, columns)] = looked
        if self._dropped:
            keep = [k for k in range(n) if k not in self._dropped]
            ids, new = [ids[k] for k in keep], [new[k] for k in keep]
            values = [values[k] for k in keep]
            n = len(keep)
            if self._columns:
                table = table[keep]
        scan.n = n
        if not n:
            return
        scan.ids[:n], scan.new[:n] = ids, new
        z, valid = scan.z[:n], scan.valid[:n]
        z[:] = values
        valid[:] = self._mask
        if self._missing:
            np.logical_and(valid, z == z, out=valid)
            z[~valid] = 0.0
        if self._columns:
            if self._stds:
                scan.std[:n] = table[:, :4]
            scan.existence[:n] = table[:, EXISTENCE]
            scan.object_class[:n] = table[:, CLASS]
            scan.size[:n] = table[:, [LENGTH, WIDTH]]
        if self._polar:
            self._to_cartesian_axes(scan, n)

    def _to_cartesian_axes(self, scan: Scan, n: int) -> None:
        """Range and bearing from the sensor become a position in axes along and across the line
        of sight, counted from the vehicle's origin."""
        z, std, at = scan.z[:n], scan.std[:n], self._mounting
        distance = np.maximum(z[:, 0], _NEAREST)
        if self._stds:
            std[:, 2] *= distance
        else:
            std[:, 2] = self._defaults[2] * distance
        angle = scan.angle[:n]
        np.add(z[:, 2], at.yaw, out=angle)
        if at.x or at.y:
            cos, sin = np.cos(angle), np.sin(angle)
            z[:, 0] += at.x * cos + at.y * sin
            z[:, 2] = at.y * cos - at.x * sin
        else:
            z[:, 2] = 0.0
