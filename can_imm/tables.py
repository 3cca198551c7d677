"""TOML files of the package and of the user, read table by table and key by key.

Whatever is wrong with a file is refused in one line: ``file: table: 'key' must be ..., not ...``.
"""

from __future__ import annotations

import math
import reprlib
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from can_imm.types import CanImmError

_T = TypeVar("_T")


def builtin_names(folder: Path) -> list[str]:
    """Names of the TOML files that come with the package in ``folder``."""
    return sorted(path.stem for path in folder.glob("*.toml"))


def read_table(name_or_path: str, folder: Path, kind: str, *, limit: float = math.inf) -> Table:
    """The whole of a TOML file: of a built-in one in ``folder`` by its name, of any by its path.

    Args:
        kind: what the file describes, for the message that there is no such thing.
        limit: see `Table`.

    Raises:
        CanImmError: the file is missing, cannot be read, is not UTF-8 or not TOML.
    """
    names = builtin_names(folder)
    builtin = name_or_path in names
    path = folder / f"{name_or_path}.toml" if builtin else Path(name_or_path)
    try:
        text = path.read_text("utf-8")
    except FileNotFoundError:
        reason = f"neither a file nor a built-in {kind} ({', '.join(names)})"
        raise _refusal(path, reason) from None
    except UnicodeDecodeError as error:
        raise _refusal(path, "cannot be read: not a text file in UTF-8") from error
    except (OSError, ValueError) as error:  # a ValueError: not even possible as a path
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise _refusal(path, f"cannot be read: {reason}") from error
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # of syntax and of long numbers; of nesting
        raise _refusal(path, f"not valid TOML: {error}") from error
    return Table(data, str(path), limit=limit)


class Table:
    """A TOML table whose keys are taken one by one, so that what is left over is a mistake.

    Every method that takes a key raises `CanImmError` if the value does not fit, or if the key is
    missing and has no default.

    Args:
        data: what the TOML reader gives.
        file: begins every message.
        place: where in the file the table is; empty for the whole file.
        limit: no number in the table, or in a table inside it, has a larger magnitude.
    """

    def __init__(self, data: Any, file: str, place: str = "", *, limit: float = math.inf) -> None:
        self.file = file
        self._place = place
        self._limit = limit
        if not isinstance(data, dict):
            raise self.error(f"must be a table, not {show(data)}")
        self._data = dict(data)

    def __contains__(self, key: str) -> bool:
        return key in self._data

    def __iter__(self) -> Iterator[str]:
        """The keys that have not been taken yet; they may be taken meanwhile."""
        return iter(list(self._data))

    def is_text(self, key: str) -> bool:
        """Whether the key is there and its value a string."""
        return isinstance(self._data.get(key), str)

    def error(self, text: str) -> CanImmError:
        """The refusal of this table for the reason ``text``, to be raised."""
        return _refusal(self.file, f"{self._place}: {text}" if self._place else text)

    def number(
        self,
        key: str,
        default: float | None = None,
        *,
        low: float | None = None,
        high: float | None = None,
        above: float | None = None,
    ) -> float:
        """A number, never NaN, from ``low`` (or above ``above``) up to ``high``."""
        value = self._take(key, default)
        span = self._span(low, high, above)
        if not _is_number(value) or not span.holds(value):
            raise self._misfit(key, f"a number{span.words()}", value)
        return float(value)

    def numbers(self, key: str, count: int, *, above: float | None = None) -> list[float]:
        """A list of ``count`` numbers."""
        values = self._take(key)
        span = self._span(None, None, above)
        if (
            not isinstance(values, list)
            or len(values) != count
            or not all(_is_number(v) and span.holds(v) for v in values)
        ):
            raise self._misfit(key, f"a list of {count} numbers{span.words()}", values)
        return [float(v) for v in values]

    def integer(self, key: str, *, low: int | None = None, high: int | None = None) -> int:
        """A whole number, written as such."""
        value = self._take(key)
        span = self._span(low, high, None)
        if not _is_integer(value) or not span.holds(value):
            raise self._misfit(key, f"a whole number{span.words()}", value)
        return int(value)

    def flag(self, key: str, default: bool | None = None) -> bool:
        """True or false."""
        value = self._take(key, default)
        if not isinstance(value, bool):
            raise self._misfit(key, "true or false", value)
        return value

    def text(self, key: str, default: str | None = None) -> str:
        """A string."""
        value = self._take(key, default)
        if not isinstance(value, str):
            raise self._misfit(key, "text", value)
        return value

    def choice(
        self, key: str, choices: Mapping[str, _T], default: str | None = None, *, hint: str = ""
    ) -> _T:
        """What one of the strings ``choices`` stands for; ``hint`` follows them in the refusal."""
        value = self._take(key, default)
        if not isinstance(value, str) or value not in choices:
            raise self._misfit(key, f"one of {', '.join(choices)}{hint}", value)
        return choices[value]

    def values(self, key: str, default: list[Any] | None = None) -> list[Any]:
        """A list of anything."""
        value = self._take(key, default)
        if not isinstance(value, list):
            raise self._misfit(key, "a list", value)
        return list(value)

    def table(self, key: str, default: dict[str, Any] | None = None) -> Table:
        """A table in this one."""
        value = self._take(key, default)
        if not isinstance(value, dict):
            raise self._misfit(key, "a table", value)
        return self._inner(value, key)

    def tables(
        self, key: str, default: list[Any] | None = None, *, each: str | None = None
    ) -> list[Table]:
        """A list of tables. Messages call them ``each`` (or ``key``) and their name or number."""
        value = self._take(key, default)
        if not isinstance(value, list):
            raise self._misfit(key, "a list of tables", value)
        inner = []
        for number, row in enumerate(value, start=1):
            name = row.get("name") if isinstance(row, dict) else None
            label = show(name) if name and isinstance(name, str) else str(number)
            inner.append(self._inner(row, f"{each or key} {label}"))
        return inner

    def done(self) -> None:
        """Refuse the keys that nobody has taken."""
        if self._data:
            raise self.error(f"unknown key {show(next(iter(self)))}")

    def _take(self, key: str, default: Any = None) -> Any:
        if key not in self._data and default is None:  # TOML has no null
            raise self.error(f"'{key}' is missing")
        return self._data.pop(key, default)

    def _misfit(self, key: str, expected: str, value: Any) -> CanImmError:
        return self.error(f"{show(key)} must be {expected}, not {show(value)}")

    def _span(self, low: float | None, high: float | None, above: float | None) -> _Span:
        return _Span(
            -self._limit if low is None else low, self._limit if high is None else high, above
        )

    def _inner(self, data: Any, label: str) -> Table:
        place = f"{self._place}, {label}" if self._place else label
        return Table(data, self.file, place, limit=self._limit)


class _Span(NamedTuple):
    low: float
    high: float
    above: float | None

    def holds(self, value: float) -> bool:
        """Whether the value, and not NaN, lies within."""
        return self.low <= value <= self.high and (self.above is None or value > self.above)

    def words(self) -> str:
        lower = "" if self.low == -math.inf else f" from {self.low:g}"
        lower = lower if self.above is None else f" above {self.above:g}"
        return lower + ("" if self.high == math.inf else f" up to {self.high:g}")


def show(value: Any) -> str:
    """A value as a short piece of a message."""
    try:
        text = reprlib.repr(value)
    except ValueError:  # thousands of digits, which Python does not print
        text = "a huge number"
    return text if len(text) <= 60 else f"{text[:57]}..."


def _refusal(file: str | Path, text: str) -> CanImmError:
    return CanImmError(" ".join(f"{file}: {text}".splitlines()))


def _is_integer(value: Any) -> bool:
    # TOML's whole numbers have 64 bits; longer ones would not fit into a float either
    return isinstance(value, int) and not isinstance(value, bool) and -(2**63) <= value < 2**63


def _is_number(value: Any) -> bool:
    return isinstance(value, float) or _is_integer(value)
