"""Small arrays on a kernel's own stack.

Results that a kernel writes to scratch from outside have to be in memory: the compiler cannot know
that nobody reads them, nor that they overlap with nothing that the kernel reads.  Arrays of its own
it keeps in registers, if every index is a constant once the loops are unrolled.  Hence, where the
index is a variable, one branch for each of its values: ``for s in range(n): if s == i: ...``.
"""

from __future__ import annotations

from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from can_imm.types import FloatArray


def _on_stack(shape: tuple[Any, ...]) -> Any:
    """Signature and code generator of a float64 array of literal ``shape``, not initialised."""
    if not all(isinstance(length, types.IntegerLiteral) for length in shape):
        return None
    lengths = [length.literal_value for length in shape]
    array = types.Array(types.float64, len(lengths), "C")

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        word = context.get_value_type(types.intp)
        strides = [8]
        for length in lengths[:0:-1]:
            strides.insert(0, strides[0] * length)
        memory = ir.ArrayType(ir.DoubleType(), strides[0] * lengths[0] // 8)
        with builder.goto_entry_block():
            pointer = builder.alloca(memory)
        view = context.make_array(array)(context, builder)
        context.populate_array(
            view,
            data=builder.bitcast(pointer, view.data.type),
            shape=[word(length) for length in lengths],
            strides=[word(stride) for stride in strides],
            itemsize=word(8),
            meminfo=None,
        )
        return view._getvalue()

    return array(*shape), generate


def _vector(typing_context: Any, n: Any) -> Any:
    return _on_stack((n,))


def _matrix(typing_context: Any, rows: Any, columns: Any) -> Any:
    return _on_stack((rows, columns))


stack_vector: Any = intrinsic(_vector)
"""``stack_vector(n)``: an array (n,), n a constant."""

stack_matrix: Any = intrinsic(_matrix)
"""``stack_matrix(rows, columns)``: an array (rows, columns), both constants."""


# Read in any case: out of branches the compiler would make a variable index again.


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def element(n: int, x: FloatArray, i: int) -> float:  # pragma: no cover - compiled
    """x[i] of x (n,), by constant indices."""
    value: float = x[0]
    for s in range(1, n):
        other = x[s]
        value = other if s == i else value
    return value


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def diagonal(n: int, P: FloatArray, i: int) -> float:  # pragma: no cover - compiled
    """P[i, i] of P (n, n), by constant indices."""
    value: float = P[0, 0]
    for s in range(1, n):
        other = P[s, s]
        value = other if s == i else value
    return value
