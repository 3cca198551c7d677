"""Fill numba's cache: ``python tests/compile_ahead.py``.

Compiling holds the interpreter, so another process does it while the first tests run, those that
need nothing of what is compiled here (see `conftest`).
"""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from small_roads import Traffic, parameters

from can_imm.cli.main import main

REPLAY = Path(__file__).parent.parent / "replay"
OPTIONS = ("--profile", "ars408", "--preset", "motorway")


def follow_some_vehicles() -> None:
    traffic = Traffic(parameters())
    for _ in range(3):
        traffic.scan([0, 1], [[30.0, 0.0], [50.0, 3.5]], speed=25.0, yaw_rate=0.0)


def replay_by_hindsight() -> None:
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "table.csv"
        for log, *options in (
            (REPLAY / "motorway-ars408.log.gz", *OPTIONS, "--lag", "0.5"),
            (REPLAY / "motorway-ars408.log.gz", *OPTIONS, "--smooth"),
            (REPLAY / "paper-a.log", "--smooth"),
        ):
            main(["replay", str(log), *options, "--csv", str(table)])


if __name__ == "__main__":
    follow_some_vehicles()
    with contextlib.redirect_stdout(io.StringIO()):
        replay_by_hindsight()
