"""TOML tables read key by key, with refusals that say where."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from can_imm.types import CanImmError

_T = TypeVar("_T")


def read_text(path: str, what: str, builtin: Sequence[str]) -> str:
    """The text of a file.

    Args:
        path: of the file.
        what: what it holds, for the message.
        builtin: names that would have done instead.

    Raises:
        CanImmError: it cannot be read.
    """
    try:
        return Path(path).read_text("utf-8")
    except FileNotFoundError:
        raise CanImmError(
            f"{path}: neither a file nor a built-in {what} ({', '.join(builtin)})"
        ) from None
    except (OSError, UnicodeDecodeError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text file in UTF-8"
        raise CanImmError(f"{path}: cannot be read: {reason}") from error


class Table:
    """A TOML table that is read key by key; what nobody asked for is an unknown key."""

    def __init__(self, data: Any, where: str) -> None:
        if not isinstance(data, dict):
            raise CanImmError(f"{where.removesuffix(': ')}: must be a table, not {data!r}")
        self._data = dict(data)
        self._where = where

    def _take(self, key: str, default: Any) -> Any:
        if key not in self._data and default is None:
            raise CanImmError(f"{self._where}{key} is missing")
        return self._data.pop(key, default)

    def _refuse(self, key: str, expected: str, value: Any) -> CanImmError:
        return CanImmError(f"{self._where}{key} must be {expected}, not {value!r}")

    def number(self, key: str, default: float | None = None) -> float:
        value = self._take(key, default)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self._refuse(key, "a number", value)
        return float(value)

    def integer(self, key: str) -> int:
        value = self._take(key, None)
        if isinstance(value, bool) or not isinstance(value, int):
            raise self._refuse(key, "a whole number", value)
        return value

    def choice(self, key: str, choices: dict[str, _T], hint: str = "") -> _T:
        value = self._take(key, None)
        if not isinstance(value, str) or value not in choices:
            raise self._refuse(key, f"one of {', '.join(choices)}{hint}", value)
        return choices[value]

    def table(self, key: str) -> Table:
        return Table(self._take(key, {}), f"{self._where}{key}: ")

    def tables(self, key: str, item: str) -> list[Table]:
        value = self._take(key, None)
        if not isinstance(value, list):
            raise self._refuse(key, "an array of tables", value)
        prefix = f"{self._where.removesuffix(': ')}, " if self._where else ""
        return [Table(v, f"{prefix}{item} {i}: ") for i, v in enumerate(value, start=1)]

    def done(self) -> None:
        if self._data:
            raise CanImmError(f"{self._where}unknown key {min(self._data)!r}")
