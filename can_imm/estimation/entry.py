"""Calling a kernel without looking up its types, and without taking its arrays apart."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba import carray as _view  # type: ignore[attr-defined]
from numba import types
from numba.extending import intrinsic

from can_imm.estimation import imm
from can_imm.estimation.layout import BANK_DTYPE, OBJECT_DTYPE, WORK_DTYPE
from can_imm.estimation.particles import N_COLUMNS, N_SCRATCH

_typeof: Callable[[Any], Any] = numba.typeof

_ARRAYS = (
    "bank", "objects", "work", "slot", "steps", "z", "r", "valid", "angle",
    "particles", "spare", "weights", "noise", "status",
)  # fmt: skip

_CALL_DTYPE = np.dtype(
    [(name, np.int64) for name in (*_ARRAYS, "capacity", "rows", "n_particles")]
    + [("gate", np.float64)],
    align=True,
)
"""Addresses of the arrays of `imm.process_scan_`, and their lengths."""


def entry_point(kernel: Any, *args: Any) -> Callable[..., Any]:
    """Return the machine code of ``kernel`` for arguments of these types, compiled if need be.

    A kernel finds out the type of every argument of every call, which costs a measurement step of
    one object as much time as its arithmetic.  What is returned does not: give it arguments of
    these types and no others.
    """
    signature = tuple(map(_typeof, args))
    kernel.compile(signature)
    code: Callable[..., Any] = kernel.get_overload(signature)
    return code


def _to_pointer(typing_context: Any, address: Any) -> Any:  # pragma: no cover - compiled
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generate


_pointer: Any = intrinsic(_to_pointer)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _process(
    address: int, n: int, ground: float, lane_width: float, age: float
) -> None:  # pragma: no cover - compiled
    call = _view(_pointer(address), 1, _CALL_DTYPE)[0]
    count, rows = call.n_particles, call.rows
    imm.process_scan_(
        _view(_pointer(call.bank), 1, BANK_DTYPE),
        _view(_pointer(call.objects), call.capacity, OBJECT_DTYPE),
        _view(_pointer(call.work), 1, WORK_DTYPE),
        n,
        _view(_pointer(call.slot), rows, np.int32),
        _view(_pointer(call.steps), rows, np.int32),
        _view(_pointer(call.z), (rows, 4), np.float64),
        _view(_pointer(call.r), (rows, 4), np.float64),
        _view(_pointer(call.valid), (rows, 4), np.bool_),
        _view(_pointer(call.angle), rows, np.float64),
        ground,
        lane_width,
        age,
        call.gate,
        _view(_pointer(call.particles), (call.capacity, N_COLUMNS, count), np.float64),
        _view(_pointer(call.spare), (N_SCRATCH, count), np.float64),
        _view(_pointer(call.weights), count, np.float64),
        _view(_pointer(call.noise), 4, np.uint64),
        _view(_pointer(call.status), rows, np.int8),
    )


class Processor:
    """`imm.process_scan_` on arrays that stay where they are.

    Taking nineteen arguments apart costs as much as half a measurement step of one object; here
    the kernel finds its arrays by their addresses.

    Args:
        arrays: all arrays of `imm.process_scan_` by name; to be written to, not to be replaced.
        gate: as there.

    Attributes:
        run: ``run(address, n, ground, lane_width, age)``, the rest as there.
        address: its first argument.
    """

    def __init__(self, gate: float, **arrays: Any) -> None:
        assert set(arrays) == set(_ARRAYS)
        assert all(array.flags.c_contiguous for array in arrays.values())
        self._arrays = arrays  # keeps them alive
        self._call = np.zeros(1, _CALL_DTYPE)
        for name, array in arrays.items():
            self._call[name] = array.ctypes.data
        self._call["capacity"] = len(arrays["objects"])
        self._call["rows"] = len(arrays["slot"])
        self._call["n_particles"] = len(arrays["weights"])
        self._call["gate"] = gate
        self.address: int = self._call.ctypes.data
        self.run = entry_point(_process, self.address, 0, 0.0, 0.0, 0.0)
