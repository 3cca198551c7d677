"""Calling a kernel without looking up its types."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba

_typeof: Callable[[Any], Any] = numba.typeof


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
