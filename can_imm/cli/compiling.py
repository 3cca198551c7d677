"""What a command does while numba compiles: once per version and machine, and it takes a while."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def announced() -> Iterator[None]:
    """Say on standard error when something has to be compiled that is not in numba's cache.

    Meanwhile SIGINT and SIGTERM end the process at once: an exception that a handler raises inside
    one of numba's callbacks would be swallowed, and the compilation fail for it later.
    """
    from numba.core import event

    class Notice(event.Listener):
        said = False

        def on_start(self, _: object) -> None:
            if not self.said:
                print(
                    "can-imm: compiling the estimators (once, up to a minute) ...",
                    file=sys.stderr,
                    flush=True,
                )
            self.said = True

        def on_end(self, _: object) -> None:
            pass

    numbers = (signal.SIGINT, signal.SIGTERM)
    previous = [signal.signal(number, signal.SIG_DFL) for number in numbers]
    try:
        with event.install_listener("numba:compile", Notice()):
            yield
    finally:
        for number, action in zip(numbers, previous, strict=True):
            signal.signal(number, action)
