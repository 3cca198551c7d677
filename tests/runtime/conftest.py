"""A detector whose every answer depends on all that it was ever given, and when."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
import pytest

from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.encoder import ManoeuvreEncoder
from can_imm.bus.profile import load_profile
from can_imm.runtime.health import Health
from can_imm.runtime.nodes import DetectorNode
from can_imm.types import REPORT_DTYPE, Scan


@dataclass
class Counts:
    late_scans: int = 0


class HashDetector:
    """Reports a checksum over all steps and scans so far; times count from the first step."""

    def __init__(self, capacity: int = 64) -> None:
        self.reports = np.zeros(capacity, REPORT_DTYPE)
        self.n_tracked = 0
        self.counts = Counts()
        self.scans: list[tuple[int, int]] = []
        self._first_ns: int | None = None
        self._sum = 0

    def step(self, t_ns: int, scan: Scan | None) -> int:
        if self._first_ns is None:
            self._first_ns = t_ns
        self._add(t_ns - self._first_ns)
        if scan is None:
            return 0
        self.scans.append((t_ns, scan.counter))
        self._add(scan.t_ns - self._first_ns)
        self._sum = zlib.crc32(scan.z[: scan.n].tobytes(), self._sum)
        self.n_tracked = scan.n
        for row, object_id in zip(self.reports, scan.ids[: scan.n], strict=False):
            row["t_ns"] = scan.t_ns
            row["object_id"] = object_id
            row["manoeuvre"] = 1 + self._sum % 7
            row["probability"] = (self._sum % 1000) / 1000
            row["second_probability"] = (self._sum // 1000 % 1000) / 1000
            row["age"] = self._sum // 1_000_000 % 4000
        return scan.n

    def _add(self, number: int) -> None:
        self._sum = zlib.crc32(number.to_bytes(8, "little", signed=True), self._sum)


@pytest.fixture(scope="session")
def profile():
    return load_profile("can_imm")


@pytest.fixture(scope="session")
def make_node(profile):
    """Return a function that builds a fresh detector node around a HashDetector."""

    def make(health: Health | None = None, listeners=(), **options) -> DetectorNode:
        return DetectorNode(
            ScanDecoder(profile), HashDetector(), ManoeuvreEncoder(), health or Health(), listeners,
            **options,
        )  # fmt: skip

    return make
