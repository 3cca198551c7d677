"""DBC files compiled to plain integer arithmetic: what cantools reads once, this applies per frame.

A message's reader is generated source: one `int.from_bytes` per byte order and a shift and mask
per signal, about a tenth of the time of a generic decoder.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import ceil, floor
from pathlib import Path
from typing import Any, NamedTuple

import cantools

from can_imm.bus.errors import one_line
from can_imm.types import CanImmError

NOT_AVAILABLE = "NotAvailable"
"""A raw value with this label in the signal's value table says that there is no value."""

Reader = Callable[[bytes], tuple[int, ...]]


class Field(NamedTuple):
    """How the raw integer of a signal becomes a physical value: ``raw * scale + offset``.

    ``low <= raw <= high`` is the range that the DBC allows; ``missing`` the raw value that stands
    for "not available", None without one.
    """

    name: str
    scale: float
    offset: float
    low: int
    high: int
    missing: int | None

    def raw(self, value: float) -> int:
        """Nearest raw value; "not available" for what is NaN or out of range, where there is such a
        code, otherwise the nearer end of the range."""
        if value == value:
            raw = (value - self.offset) / self.scale
            if self.low - 0.5 <= raw <= self.high + 0.5:
                return min(max(round(raw), self.low), self.high)
            if self.missing is None:
                return self.high if raw > self.high else self.low
        return self.low if self.missing is None else self.missing


def load_dbc(path: Path) -> Any:
    """The cantools database in ``path``.

    Raises:
        CanImmError: the file is missing, or cantools refuses it (overlapping signals included).
    """
    try:
        return cantools.database.load_file(str(path), database_format="dbc", strict=True)
    except OSError as error:
        raise CanImmError(f"{path}: {one_line(error)}") from error
    except Exception as error:  # cantools lets errors of its parser's making through
        raise CanImmError(f"{path}: not a valid DBC: {one_line(error)}") from error


def find_signal(message: Any, name: str, where: Path, dbc: Path) -> Any:
    """The signal called ``name``.

    Raises:
        CanImmError: there is none, or not one that we can read; the line names ``where``.
    """
    try:
        signal = message.get_signal_by_name(name)
    except KeyError:
        raise CanImmError(
            f"{where}: no signal {name!r} in message {message.name} of {dbc}"
        ) from None
    if signal.is_float or signal.multiplexer_ids:
        raise CanImmError(
            f"{where}: signal {name!r} of {message.name} is a float or multiplexed: not supported"
        )
    return signal


def field(signal: Any) -> Field:
    """Scaling, range and "not available" code of a cantools signal."""
    bits = signal.length
    low = -(1 << bits - 1) if signal.is_signed else 0
    high = low + (1 << bits) - 1
    scale, offset = float(signal.scale), float(signal.offset)
    ends = [
        (limit - offset) / scale for limit in (signal.minimum, signal.maximum) if limit is not None
    ]
    if len(ends) == 2:
        # the tolerance absorbs the rounding of limits like 0.07 * 1000
        low = max(low, ceil(min(ends) - 1e-6))
        high = min(high, floor(max(ends) + 1e-6))
    missing = next(
        (raw for raw, label in (signal.choices or {}).items() if str(label) == NOT_AVAILABLE), None
    )
    return Field(signal.name, scale, offset, low, high, missing)


def compile_reader(message: Any, signals: Sequence[Any]) -> Reader:
    """A function that gives the raw values of ``signals`` from the message's ``length`` bytes."""
    bits = 8 * message.length
    words, values = set(), []
    for signal in signals:
        if signal.byte_order == "little_endian":
            word, shift = "little", signal.start
        else:
            # a big-endian signal starts at its most significant bit, numbered as byte * 8 + bit
            from_top = signal.start // 8 * 8 + 7 - signal.start % 8
            word, shift = "big", bits - from_top - signal.length
        words.add(word)
        value = f"({word} >> {shift} & {(1 << signal.length) - 1})"
        if signal.is_signed:
            sign = 1 << signal.length - 1
            value = f"(({value} ^ {sign}) - {sign})"
        values.append(value)
    lines = [f" {word} = from_bytes(data, {word!r})" for word in sorted(words)]
    result = "".join(f"{value}, " for value in values)
    source = "\n".join(["def read(data):", *lines, f" return ({result})"])
    namespace: dict[str, Any] = {"from_bytes": int.from_bytes}
    exec(source, namespace)
    reader: Reader = namespace["read"]
    return reader


def compile_packer(parts: Sequence[tuple[int, Field]]) -> Callable[..., int]:
    """A function that takes a physical value per part and gives the message as one integer.

    It does what `Field.raw` does, without a call per signal as long as the value is in range.

    Args:
        parts: lowest bit and scaling of each signal.
    """
    names = [f"v{k}" for k in range(len(parts))]
    lines, terms = [], []
    namespace: dict[str, Any] = {}
    for name, (shift, scaling) in zip(names, parts, strict=True):
        low, high = scaling.low, scaling.high
        namespace[f"raw_{name}"] = scaling.raw
        lines += [
            f" r = ({name} - {scaling.offset!r}) / {scaling.scale!r}",
            f" {name} = round(r) if {low} <= r <= {high} else raw_{name}({name})",
        ]
        terms.append(f"{name} << {shift}")
    source = [f"def pack({', '.join(names)}):", *lines, f" return {' | '.join(terms)}"]
    exec("\n".join(source), namespace)
    packer: Callable[..., int] = namespace["pack"]
    return packer
