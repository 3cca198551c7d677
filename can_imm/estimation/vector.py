"""Elementary functions that the compiler can vectorise: a call to libm would stop it.

Plain IEEE operations in a fixed order, so the results are the same whatever the vector width.
"""

from __future__ import annotations

from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

_LOG2E = 1.4426950408889634
_LN2_HIGH, _LN2_LOW = 0.6931471803691238, 1.9082149292705877e-10
_ROUND = 6755399441055744.0
"""1.5 * 2**52: adding it leaves the nearest integer in the low bits of a double."""


def _to_float(typing_context: Any, bits: Any) -> Any:  # pragma: no cover - compiled
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.DoubleType())

    return types.float64(types.int64), generate


def _to_int(typing_context: Any, value: Any) -> Any:  # pragma: no cover - compiled
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.IntType(64))

    return types.int64(types.float64), generate


_as_float: Any = intrinsic(_to_float)
_as_int: Any = intrinsic(_to_int)


@numba.njit(inline="always", error_model="numpy")
def fast_exp(x: float) -> float:  # pragma: no cover - compiled
    """exp(x) for x <= 700 to about 1e-15 relative; below -700 it stays at exp(-700)."""
    x = max(x, -700.0)
    shifted = x * _LOG2E + _ROUND
    n = shifted - _ROUND
    r = (x - n * _LN2_HIGH) - n * _LN2_LOW
    p = 1.0 / 479001600.0
    p = p * r + 1.0 / 39916800.0
    p = p * r + 1.0 / 3628800.0
    p = p * r + 1.0 / 362880.0
    p = p * r + 1.0 / 40320.0
    p = p * r + 1.0 / 5040.0
    p = p * r + 1.0 / 720.0
    p = p * r + 1.0 / 120.0
    p = p * r + 1.0 / 24.0
    p = p * r + 1.0 / 6.0
    p = p * r + 0.5
    p = p * r + 1.0
    p = p * r + 1.0
    scale: float = _as_float((_as_int(shifted) + 1023) << 52)
    return p * scale


@numba.njit(inline="always", error_model="numpy")
def fast_log(x: float) -> float:  # pragma: no cover - compiled
    """log(x) for normal positive x to about 1e-15; nothing sensible for any other."""
    bits = _as_int(x)
    # split off the exponent such that the mantissa lies in [sqrt(1/2), sqrt(2))
    shifted = bits - 0x3FE6A09E667F3BCD
    exponent = shifted >> 52
    m: float = _as_float(bits - (exponent << 52))
    # an integer below 2**51 to a double without a conversion instruction
    n: float = _as_float(exponent + 0x4338000000000000) - _ROUND
    t = (m - 1.0) / (m + 1.0)
    v = t * t
    p = 1.0 / 21.0
    p = p * v + 1.0 / 19.0
    p = p * v + 1.0 / 17.0
    p = p * v + 1.0 / 15.0
    p = p * v + 1.0 / 13.0
    p = p * v + 1.0 / 11.0
    p = p * v + 1.0 / 9.0
    p = p * v + 1.0 / 7.0
    p = p * v + 1.0 / 5.0
    p = p * v + 1.0 / 3.0
    p = p * v + 1.0
    return n * _LN2_HIGH + (2.0 * t * p + n * _LN2_LOW)


@numba.njit(inline="always", error_model="numpy")
def fast_angle(sine: float, cosine: float) -> float:  # pragma: no cover - compiled
    """|atan2(sine, cosine)| for sine² + cosine² = 1, to 3e-11."""
    # tan of the half angle is above / below; the tiny numbers keep 0/0 away from straight behind
    above = abs(sine) + 1e-200
    below = max(1.0 + cosine, 1e-300)
    u = min(above, below) / max(above, below)
    v = u * u
    # atan(u) / u in v, interpolated in Chebyshev nodes on [0, 1]
    p = 0.00041923393867625194
    p = p * v - 0.003195461834616629
    p = p * v + 0.011427729645781124
    p = p * v - 0.02600614172204219
    p = p * v + 0.043646729133535726
    p = p * v - 0.06022205218890623
    p = p * v + 0.07495266091119122
    p = p * v - 0.09049180114773321
    p = p * v + 0.11105306907877154
    p = p * v - 0.1428522562534094
    p = p * v + 0.19999978337002625
    p = p * v - 0.33333332951665584
    p = p * v + 0.999999999988737
    p = 2.0 * u * p
    return p if above <= below else 3.141592653589793 - p
