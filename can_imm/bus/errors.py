"""Other libraries' errors in one line."""

from __future__ import annotations


def one_line(error: BaseException) -> str:
    """What the system or a library says of ``error``, on one line; its kind if it says nothing."""
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return " ".join(text.split())[:200] or type(error).__name__
