"""Checksums and alive counters: is this frame whole, and is it the next one?"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from e2e.p01 import e2e_p01_check, e2e_p01_protect

from can_imm.types import CanImmError

P01_COUNTERS = 15
"""Profile 1 counts 0 to 14; 15 is invalid."""

KINDS = ("e2e-p01", "toyota", "none")


class Guard(NamedTuple):
    """The checks of one message id.

    ``check(data)`` is true if the checksum is right; ``counter(data)`` the alive counter, which
    runs from 0 to ``modulus - 1``; with modulus 0 nobody is to look at it.
    """

    check: Callable[[bytes], bool]
    counter: Callable[[bytes], int]
    modulus: int


def p01_data_id(message: Any, dbc: Path) -> int:
    """The attribute E2EDataId of a cantools message.

    Raises:
        CanImmError: the message has none, or is too short for the header of profile 1.
    """
    attribute = message.dbc.attributes.get("E2EDataId") if message.dbc else None
    if attribute is None:
        raise CanImmError(f"{dbc}: message {message.name} has no attribute 'E2EDataId'")
    if message.length < 2:
        raise CanImmError(f"{dbc}: message {message.name} is too short for E2E profile 1")
    return int(attribute.value)


def p01_guard(data_id: int) -> Guard:
    """AUTOSAR E2E profile 1: CRC8 in byte 0, counter in the low nibble of byte 1, both bytes of the
    data id in every CRC."""
    # the library wants a buffer that it could write to
    return Guard(
        lambda data: e2e_p01_check(bytearray(data), data_id),
        lambda data: data[1] & 0x0F,
        P01_COUNTERS,
    )


def p01_protect(data: bytearray, data_id: int, counter: int) -> None:
    """Write counter and CRC of profile 1 into ``data``."""
    data[1] = data[1] & 0xF0 | counter
    e2e_p01_protect(data, data_id, increment_counter=False)


def toyota_guard(
    frame_id: int,
    length: int,
    counter: Callable[[bytes], int] = lambda data: 0,
    modulus: int = 0,
) -> Guard:
    """Toyota's checksum in the last byte: sum of the other bytes, the id's bytes and the length."""
    head = _toyota_head(frame_id, length)
    return Guard(lambda data: (sum(data[:-1]) + head) & 0xFF == data[-1], counter, modulus)


def toyota_protect(data: bytearray, frame_id: int) -> None:
    """Write Toyota's checksum into the last byte of ``data``."""
    data[-1] = (sum(data[:-1]) + _toyota_head(frame_id, len(data))) & 0xFF


def _toyota_head(frame_id: int, length: int) -> int:
    return (frame_id & 0xFF) + (frame_id >> 8) + length
