"""Shared by all tests; its place also puts this directory on the path, for ``oracles``."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import settings

import can_imm

# Before numpy is imported: matrices are small here, a second thread gains nothing with them, and
# where something else wants its core, the first one waits for it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# A shell starts its background jobs with SIGINT ignored, and programs that the tests start would
# inherit that; a handler they do not.
signal.signal(signal.SIGINT, signal.default_int_handler)

# numba looks only at the file that a cached kernel is in, not at those that it calls into.
_package = Path(can_imm.__file__).parent
_newest = max(path.stat().st_mtime for path in (_package / "estimation").glob("*.py"))
for _cached in (
    *_package.glob("__pycache__/*.nb?"),
    *_package.glob("estimation/__pycache__/*.nb?"),
):
    if _cached.stat().st_mtime < _newest:
        _cached.unlink(missing_ok=True)

# Compiling leaves a million objects behind; looking through them as often as Python does by itself
# takes a tenth of the time of a run.
gc.set_threshold(100_000, 20, 100)

# The first example of many tests compiles kernels, so there is no deadline per example; the same
# examples in every run, so that a red run is red again.
settings.register_profile("can_imm", deadline=None, derandomize=True)
settings.load_profile("can_imm")

_ahead: list[subprocess.Popen[bytes]] = []
_WITHOUT_THE_DETECTOR = (
    "bus/",
    "manoeuvres/",
    "plots/",
    "sim/",
    "trackers/",
    "estimation/test_bernoulli",
    "estimation/test_ukf",
    "studies/test_bernoulli",
    "studies/test_roadside",
    "studies/test_motorway_rules",
    "studies/test_motorway_metrics",
    "studies/test_tuning",
)
"""Tests whose kernels `compile_ahead` does not compile."""


def pytest_sessionstart(session: pytest.Session) -> None:
    """Where nothing is compiled yet, let another process do most of it."""
    if not any(_package.glob("estimation/__pycache__/*.nbc")) and (os.cpu_count() or 1) > 1:
        script = Path(__file__).with_name("compile_ahead.py")
        _ahead.append(
            subprocess.Popen(
                [sys.executable, script], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
        )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """While the other process compiles, test what needs nothing of that."""
    if _ahead:
        here = Path(__file__).parent
        items.sort(
            key=lambda item: not str(item.path.relative_to(here)).startswith(_WITHOUT_THE_DETECTOR)
        )


def pytest_sessionfinish(session: pytest.Session) -> None:
    for process in _ahead:
        process.kill()
        process.wait()
