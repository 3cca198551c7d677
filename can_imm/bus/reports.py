"""Reports to frames, all of a scan in one call of a kernel.

`encoder.MessageEncoder` packs any message in Python and has it protected by the E2E library; this
does the two messages that go out for every object, bit by bit the same, in a tenth of the time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from can_imm.bus.codec import Field
from can_imm.bus.protection import P01_COUNTERS
from can_imm.types import REPORT_DTYPE

_POLYNOMIAL = 0x1D
"""Of the CRC8 of profile 1 (SAE J1850)."""

SIGNAL_DTYPE = np.dtype(
    [
        ("shift", np.uint64),
        ("scale", np.float64),
        ("offset", np.float64),
        ("low", np.float64),
        ("high", np.float64),
        ("missing", np.float64),
    ],
    align=True,
)
"""Lowest bit of a signal and its `codec.Field`; ``missing`` is NaN where there is no such code."""


def signal_table(parts: Sequence[tuple[int, Field]]) -> npt.NDArray[Any]:
    """Array of `SIGNAL_DTYPE` for (lowest bit, scaling) of each signal."""
    rows = [
        (shift, f.scale, f.offset, f.low, f.high, np.nan if f.missing is None else f.missing)
        for shift, f in parts
    ]
    return np.array(rows, SIGNAL_DTYPE)


def _crc_table() -> npt.NDArray[np.uint8]:
    table = np.zeros(256, np.uint8)
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc << 1) ^ (_POLYNOMIAL if crc & 0x80 else 0)
        table[byte] = crc & 0xFF
    return table


_CRC = _crc_table()


@numba.njit(nogil=True, cache=True, error_model="numpy")
def raw_value(signal: Any, value: float) -> Any:  # pragma: no cover - compiled
    """What `codec.Field.raw` gives, as an unsigned integer."""
    raw = (value - signal.offset) / signal.scale
    if signal.low - 0.5 <= raw <= signal.high + 0.5:
        raw = min(max(np.rint(raw), signal.low), signal.high)
    elif signal.missing == signal.missing:
        raw = signal.missing
    else:
        raw = signal.high if raw > signal.high else signal.low
    return np.uint64(raw)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def protect_(data: Any, word: Any, data_id: int, counter: int) -> None:  # pragma: no cover
    """Write a message of 8 bytes, little endian, with counter and CRC of profile 1."""
    word |= np.uint64(counter) << np.uint64(8)
    crc = _CRC[data_id & 0xFF]
    crc = _CRC[crc ^ (data_id >> 8)]
    for b in range(1, 8):
        data[b] = (word >> np.uint64(8 * b)) & np.uint64(0xFF)
        crc = _CRC[crc ^ data[b]]
    data[0] = crc


@numba.njit(nogil=True, cache=True, error_model="numpy")
def estimate_word(signals: Any, report: Any) -> Any:  # pragma: no cover - compiled
    """ObjectEstimate without its header."""
    word = raw_value(signals[0], report.object_id) << signals[0].shift
    for c in range(4):
        word |= raw_value(signals[1 + c], report.x[c]) << signals[1 + c].shift
    return word


@numba.njit(nogil=True, cache=True, error_model="numpy")
def state_word(
    signals: Any, report: Any, directions: Any, events: Any
) -> Any:  # pragma: no cover - compiled
    """ManoeuvreState without its header."""
    where = 0
    for k in range(directions.shape[0]):
        if directions[k] == report.direction:
            where = k
    word = raw_value(signals[0], report.object_id) << signals[0].shift
    word |= raw_value(signals[1], where) << signals[1].shift
    word |= raw_value(signals[2], report.lane) << signals[2].shift
    word |= raw_value(signals[3], events[report.flags]) << signals[3].shift
    word |= raw_value(signals[4], 100.0 * report.probability) << signals[4].shift
    word |= raw_value(signals[5], 100.0 * report.second_probability) << signals[5].shift
    word |= raw_value(signals[6], report.coasting) << signals[6].shift
    word |= raw_value(signals[7], report.manoeuvre) << signals[7].shift
    word |= raw_value(signals[8], report.second) << signals[8].shift
    word |= raw_value(signals[9], report.age) << signals[9].shift
    return word


@numba.njit(nogil=True, cache=True, error_model="numpy")
def pack_(
    reports: Any,
    n: int,
    state: Any,
    estimate: Any,
    ids: Any,
    counters: Any,
    directions: Any,
    events: Any,
    out: Any,
) -> int:  # pragma: no cover - compiled
    """Pack ManoeuvreState, if ``state`` has any signals, and ObjectEstimate of ``n`` reports.

    Args:
        state, estimate: (S,) of `SIGNAL_DTYPE`.
        ids: (2,) data ids of both.  counters: (2,) their alive counters, moved on.
        directions, events: values on the bus, see `encoder`.
        out: (2 n, 8) uint8, written.

    Returns:
        Number of rows written; a report whose object id does not fit has none.
    """
    k = 0
    for i in range(n):
        report = reports[i]
        if not estimate[0].low <= report.object_id <= estimate[0].high:
            continue
        if state.shape[0]:
            protect_(out[k], state_word(state, report, directions, events), ids[0], counters[0])
            counters[0] = (counters[0] + 1) % P01_COUNTERS
            k += 1
        protect_(out[k], estimate_word(estimate, report), ids[1], counters[1])
        counters[1] = (counters[1] + 1) % P01_COUNTERS
        k += 1
    return k


class ReportPacker:
    """`pack_` with its buffers.

    Args:
        state, estimate: `signal_table` of the two messages, in the order of the kernels.
        ids: their data ids.
        directions, events: see `encoder`.
    """

    def __init__(
        self,
        state: npt.NDArray[Any],
        estimate: npt.NDArray[Any],
        ids: tuple[int, int],
        directions: Sequence[int],
        events: Sequence[int],
    ) -> None:
        self._none = state[:0].copy()
        self._state, self._estimate = state, estimate
        self._ids = np.array(ids)
        self._counters = np.zeros(2, np.int64)
        self._directions, self._events = np.array(directions), np.array(events)
        self._out = np.zeros((2, 8), np.uint8)
        arguments = self._arguments(np.zeros(1, REPORT_DTYPE), 0, True)
        signature = tuple(map(numba.typeof, arguments))
        pack_.compile(signature)
        self._pack = pack_.get_overload(signature)

    def _arguments(self, reports: npt.NDArray[Any], n: int, states: bool) -> tuple[Any, ...]:
        return (
            reports, n, self._state if states else self._none, self._estimate, self._ids,
            self._counters, self._directions, self._events, self._out,
        )  # fmt: skip

    def pack(self, reports: npt.NDArray[Any], *, states: bool) -> tuple[bytes, int]:
        """Messages of all reports, one after the other, and their number.

        Args:
            reports: (N,) of `REPORT_DTYPE`, contiguous.
            states: ManoeuvreState before each ObjectEstimate.
        """
        n = len(reports)
        if len(self._out) < 2 * n:
            self._out = np.zeros((2 * n, 8), np.uint8)
        count: int = self._pack(*self._arguments(reports, n, states))
        return self._out[:count].tobytes(), count
