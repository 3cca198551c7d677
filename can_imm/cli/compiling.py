"""Tells the user that numba is compiling: once per version and machine, and it takes a while."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def announced() -> Iterator[None]:
    """Say on standard error when something has to be compiled that is not in numba's cache."""
    from numba.core import event

    class Notice(event.Listener):  # type: ignore[misc]
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

    with event.install_listener("numba:compile", Notice()):
        yield
