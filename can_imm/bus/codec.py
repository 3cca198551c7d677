"""DBC files compiled to plain integer arithmetic: what cantools reads once, this applies per frame.

A message's reader is generated source: one `int.from_bytes` per byte order and a shift and mask
per signal, about a tenth of the time of a generic decoder. That of an object's message
(`compile_object`) checks and scales as well.
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


def _raw_terms(length: int, signals: Sequence[Any]) -> tuple[list[str], list[str]]:
    """Source that gives signals' raw values: lines to run first, and an expression for each."""
    bits = 8 * length
    words, values = set(), []
    for signal in signals:
        if signal.byte_order == "little_endian":
            word, shift = "little", signal.start
        else:
            word, shift = "big", bits - _from_top(signal) - signal.length
        words.add(word)
        value = f"({word} >> {shift} & {(1 << signal.length) - 1})"
        if signal.is_signed:
            sign = 1 << signal.length - 1
            value = f"(({value} ^ {sign}) - {sign})"
        values.append(value)
    return [f" {word} = from_bytes(data, {word!r})" for word in sorted(words)], values


def _from_top(signal: Any) -> int:
    """Where a big-endian signal starts: the DBC numbers its most significant bit byte * 8 + bit."""
    start: int = signal.start
    return start // 8 * 8 + 7 - start % 8


def _compile(name: str, argument: str, lines: Sequence[str], namespace: dict[str, Any]) -> Any:
    exec("\n".join([f"def {name}({argument}):", *lines]), namespace)
    return namespace[name]


def compile_reader(message: Any, signals: Sequence[Any]) -> Reader:
    """A function that gives the raw values of ``signals`` from the message's ``length`` bytes."""
    lines, values = _raw_terms(message.length, signals)
    result = "".join(f"{value}, " for value in values)
    namespace: dict[str, Any] = {"from_bytes": int.from_bytes}
    reader: Reader = _compile("read", "data", [*lines, f" return ({result})"], namespace)
    return reader


class Value(NamedTuple):
    """A physical value, ``((raw * scale + offset) * sign + shift) * factor + mount`` of a signal.

    ``scale``, ``offset`` and the range of the raw values are those of the signal's `field`.
    """

    signal: Any
    sign: float
    shift: float
    factor: float
    mount: float


class Lookup(NamedTuple):
    """A value that is looked up by the raw value of an unsigned or signed signal in ``table``,
    which has an entry for each (negative ones from the end)."""

    signal: Any
    table: Sequence[float]


class Test(NamedTuple):
    """Passed if ``table`` is true for the raw value, or, without one, the expression ``words``."""

    signal: Any
    words: str
    table: Sequence[bool] | None = None


USABLE, EMPTY, OUT_OF_RANGE = 0, 1, 2
"""First item of what a function of `compile_object` gives."""


def compile_object(
    length: int,
    key: Any,
    key_range: tuple[int, int] | None,
    tests: Sequence[Test],
    new: Lookup | None,
    values: Sequence[Value | None],
    needed: Sequence[int],
    lookups: Sequence[Lookup],
) -> Callable[[bytes], tuple[Any, ...]]:
    """A function that makes of the bytes of an object's message all that is to be known of it.

    It gives ``(USABLE, key, new, missing, values, looked up)``, where the values that are not
    measured (None) are 0, those that are not available NaN, and ``missing`` is the number of the
    latter; or ``(EMPTY or OUT_OF_RANGE, key)``.

    Args:
        length: bytes of the message.
        key: the signal that names the object, or the scan.
        key_range: raw values that it may have; None: all.
        tests: what the frame must pass, or it is empty.
        needed: without these values the frame is empty; it is too if no value is available.
    """
    measured = [k for k, value in enumerate(values) if value is not None]
    signals = [key, *(t.signal for t in tests), *(values[k].signal for k in measured)]  # type: ignore[union-attr]
    signals += [lookup.signal for lookup in (*([new] if new else []), *lookups)]
    lines, raws = _raw_terms(length, signals)
    rest = iter(raws)
    namespace: dict[str, Any] = {"from_bytes": int.from_bytes, "nan": float("nan")}
    lines.append(f" key = {next(rest)}")
    for k, test in enumerate(tests):
        if test.table is None:
            lines += [f" r = {next(rest)}", f" if not ({test.words}): return 1, key"]
        else:
            namespace[f"t{k}"] = test.table
            lines.append(f" if not t{k}[{next(rest)}]: return 1, key")
    coded = []
    for k in measured:
        value = values[k]
        assert value is not None
        scaling = field(value.signal)
        formula = f"v{k} * {scaling.scale!r} + {scaling.offset!r}"
        for operator, number, neutral in (
            ("*", value.sign, 1.0), ("+", value.shift, 0.0), ("*", value.factor, 1.0),
            ("+", value.mount, 0.0),
        ):  # fmt: skip
            if number != neutral:
                formula = f"({formula}) {operator} {number!r}"
        lines.append(f" v{k} = {next(rest)}")
        word = "if"
        if scaling.missing is not None:
            coded.append(k)
            lines += [f" if v{k} == {scaling.missing}:", f"  v{k} = nan"]
            word = "elif"
        lines += [f" {word} {scaling.low} <= v{k} <= {scaling.high}:", f"  v{k} = {formula}"]
        lines += [" else:", "  return 2, key"]
    if key_range is not None:
        lines.append(f" if not {key_range[0]} <= key <= {key_range[1]}: return 2, key")
    missing = " + ".join(f"(v{k} != v{k})" for k in coded) or "0"
    lines.append(f" missing = {missing}")
    for k in needed:
        if k in coded:
            lines.append(f" if v{k} != v{k}: return 1, key")
    if coded and len(coded) == len(measured):
        lines.append(f" if missing == {len(measured)}: return 1, key")
    is_new = "False"
    if new is not None:
        namespace["n"] = new.table
        is_new = f"n[{next(rest)}]"
    looked = []
    for k, lookup in enumerate(lookups):
        namespace[f"l{k}"] = lookup.table
        looked.append(f"l{k}[{next(rest)}], ")
    result = "".join(f"v{k}, " if value else "0.0, " for k, value in enumerate(values))
    lines.append(f" return 0, key, {is_new}, missing, ({result}), ({''.join(looked)})")
    take: Callable[[bytes], tuple[Any, ...]] = _compile("take", "data", lines, namespace)
    return take


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
    lines.append(f" return {' | '.join(terms)}")
    packer: Callable[..., int] = _compile("pack", ", ".join(names), lines, namespace)
    return packer


def place(message: Any, signal: Any) -> tuple[str, int]:
    """Byte order of a signal and its lowest bit in the message as one integer of that order."""
    if signal.byte_order == "little_endian":
        return "little", signal.start
    return "big", 8 * message.length - _from_top(signal) - signal.length
