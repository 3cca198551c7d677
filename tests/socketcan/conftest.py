"""Two processes on a real bus: helpers to start our commands and wait for what they say."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

SCENARIO = """
duration = 5.0
[[object]]
id = 3
gap = 40.0
lane = "right"
segments = [
    { start = 0.0, label = "KEEP_RIGHT" },
    { start = 1.0, label = "LANE_CHANGE", direction = "left" },
    { start = 3.0, label = "KEEP_LEFT" },
]
"""


class Process:
    """A running command whose standard error is watched for lines."""

    def __init__(self, *command: str, **options) -> None:
        self.process = subprocess.Popen(
            command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options
        )
        self.said: list[str] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        for line in self.process.stderr:
            self.said.append(line)

    def wait_for(self, text: str, timeout_s: float = 120.0) -> str:
        """Wait until a line with ``text`` was said on standard error and return it."""
        until = time.monotonic() + timeout_s
        while time.monotonic() < until:
            for line in list(self.said):
                if text in line:
                    return line
            assert self.process.poll() is None, "".join(self.said)
            time.sleep(0.02)
        raise AssertionError(f"never said {text!r}: {''.join(self.said)}")

    def end(self, number: int | None = signal.SIGTERM, timeout_s: float = 60.0) -> tuple[int, str]:
        """Send a signal, if any, and wait; exit status and standard output."""
        if number is not None:
            self.process.send_signal(number)
        # not communicate(): the other pipe has a reader of its own
        out = self.process.stdout.read()
        status = self.process.wait(timeout_s)
        self._reader.join()
        return status, out

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self._reader.join()
        self.process.stdout.close()
        self.process.stderr.close()


@pytest.fixture
def start() -> Iterator:
    """Return a function that starts a command; what still runs at the end is killed."""
    running = []

    def start_command(*command: str, **options) -> Process:
        running.append(Process(*map(str, command), **options))
        return running[-1]

    yield start_command
    for process in running:
        process.close()


@pytest.fixture
def can_imm(start):
    """Return a function that starts ``can-imm`` with the arguments given."""

    def start_can_imm(*arguments: str, **options) -> Process:
        return start(sys.executable, "-m", "can_imm", *arguments, **options)

    return start_can_imm


@pytest.fixture
def scenario(tmp_path) -> Path:
    """A scenario of 5 s: 50 scans of object 3."""
    path = tmp_path / "short.toml"
    path.write_text(SCENARIO)
    return path


@pytest.fixture(scope="session")
def vcan0() -> str:
    if not Path("/sys/class/net/vcan0").exists():
        pytest.skip("no vcan0: this kernel has no virtual CAN bus")
    return "vcan0"


@pytest.fixture
def root_rights() -> None:
    if os.geteuid() != 0:
        pytest.skip("only root may take a link down")
