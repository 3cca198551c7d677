"""Random numbers for the kernels: xoshiro256++ and the ziggurat, with the state in an array.

A numpy Generator costs 7 us each time that it is passed to a compiled function, and 10 ns per
normal deviate in it; this costs 0.03 us and 3 ns.  The Generator gives the state, so it is still
what makes a run repeatable.  In the kernels the state is four local variables that stay in
registers: ``s = load(state)``, then ``value, s = normal(s)``, at the end ``store_(state, s)``.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

NoiseState = npt.NDArray[np.uint64]
"""(4,) uint64."""

Words = tuple[Any, Any, Any, Any]

_LAYERS = 256
_R = 3.6541528853610088
"""Where the tail begins."""
_V = 0.00492867323399
"""Area of a layer."""
_SCALE = 2.0**52


def _tables() -> tuple[npt.NDArray[np.uint64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Accept bounds, widths and densities of the layers (Marsaglia and Tsang 2000)."""
    bound = np.zeros(_LAYERS, np.uint64)
    x = np.zeros(_LAYERS)
    x[-1] = _R
    for i in range(_LAYERS - 2, 0, -1):
        x[i] = math.sqrt(-2.0 * math.log(_V / x[i + 1] + math.exp(-0.5 * x[i + 1] ** 2)))
    width = x / _SCALE
    width[0] = _V / math.exp(-0.5 * _R**2) / _SCALE
    bound[0] = int(_R / width[0])
    bound[2:] = [int(a / b * _SCALE) for a, b in pairwise(x[1:])]
    return bound, width, np.exp(-0.5 * x**2)


_BOUND, _WIDTH, _DENSITY = _tables()

_U8, _U1 = np.uint64(8), np.uint64(1)
_U11, _U12, _U17, _U19, _U23, _U41, _U45 = map(np.uint64, (11, 12, 17, 19, 23, 41, 45))
_BYTE = np.uint64(0xFF)


def noise_state(rng: np.random.Generator) -> NoiseState:
    """Return a state drawn from ``rng``."""
    state = rng.integers(0, 2**64, 4, np.uint64)
    state[0] |= _U1  # all zeros would stay zeros
    return state


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def load(state: NoiseState) -> Words:  # pragma: no cover - compiled
    """Return the words of a state."""
    return state[0], state[1], state[2], state[3]


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def store_(state: NoiseState, s: Words) -> None:  # pragma: no cover - compiled
    """Write the words back."""
    state[0], state[1], state[2], state[3] = s


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def _bits(s: Words) -> tuple[Any, Words]:  # pragma: no cover - compiled
    """64 random bits: xoshiro256++ (Blackman and Vigna 2021)."""
    s0, s1, s2, s3 = s
    a = s0 + s3
    bits = ((a << _U23) | (a >> _U41)) + s0
    t = s1 << _U17
    s2 ^= s0
    s3 ^= s1
    s1 ^= s2
    s0 ^= s3
    s2 ^= t
    s3 = (s3 << _U45) | (s3 >> _U19)
    return bits, (s0, s1, s2, s3)


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def uniform(s: Words) -> tuple[float, Words]:  # pragma: no cover - compiled
    """Uniform in [0, 1), a multiple of 2^-53."""
    bits, s = _bits(s)
    return np.float64(bits >> _U11) * 2.0**-53, s


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _edge(s: Words, layer: Any, x: float) -> tuple[bool, float, Words]:  # pragma: no cover
    """What the fast test did not accept: the tail, or the wedge beside a layer."""
    if layer == 0:
        while True:
            u, s = uniform(s)
            v, s = uniform(s)
            x = -math.log1p(-u) / _R
            if -2.0 * math.log1p(-v) > x * x:
                return True, _R + x, s
    u, s = uniform(s)
    f = _DENSITY[layer] + u * (_DENSITY[layer - 1] - _DENSITY[layer])
    return f < math.exp(-0.5 * x * x), x, s


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def normal(s: Words) -> tuple[float, Words]:  # pragma: no cover - compiled
    """Standard normal deviate."""
    while True:
        bits, s = _bits(s)
        layer = np.int64(bits & _BYTE)
        negative = (bits >> _U8) & _U1
        m = bits >> _U12
        x = np.float64(m) * _WIDTH[layer]
        ok = m < _BOUND[layer]
        if not ok:
            ok, x, s = _edge(s, layer, x)
        if ok:
            return (-x if negative else x), s
