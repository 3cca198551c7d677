"""Long runs: nothing grows, and the kernels allocate nothing."""

from __future__ import annotations

import gc
import tracemalloc
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core.runtime import _nrt_python, rtsys

import can_imm
from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.encoder import ManoeuvreEncoder, RadarEncoder
from can_imm.detector import Detector
from can_imm.manoeuvres import load_bank
from can_imm.runtime.clock import FastClock
from can_imm.runtime.feeds import LogFeed
from can_imm.runtime.health import Health
from can_imm.runtime.loop import STEP_NS, Loop
from can_imm.runtime.nodes import DetectorNode
from can_imm.types import Scan

OURS = f"{Path(can_imm.__file__).parent}/*"


def sensor(objects: int = 3):
    """Frames of a sensor for ever: objects that weave, vanish for a while and come back."""
    encoder, scan = RadarEncoder(), Scan(objects)
    scan.valid[:] = True
    k = 0
    while True:
        k += 1
        scan.t_ns = k * 10 * STEP_NS
        scan.n = objects - (k // 50) % 2
        scan.ids[: scan.n] = range(scan.n)
        for i in range(scan.n):
            scan.z[i] = 40.0 + i, 0.0, 3.0 * ((k // 40 + i) % 2), 0.0
        yield from encoder.encode(scan, scan.t_ns)


def make_loop(profile) -> tuple[Loop, DetectorNode, Health]:
    health = Health()
    node = DetectorNode(
        ScanDecoder(profile), Detector(load_bank("two-lane"), capacity=8), ManoeuvreEncoder(),
        health,
    )  # fmt: skip
    return Loop(LogFeed(sensor(), FastClock(), health), node, health), node, health


def soak(profile, steps: int) -> None:
    """After a start-up of a fifth of the steps, the rest leaves no object behind."""
    loop, node, health = make_loop(profile)
    for _ in range(steps // 5):
        loop.step()
    gc.collect()
    tracemalloc.start()
    try:
        for _ in range(steps // 5):  # what is replaced from now on is traced as well
            loop.step()
        gc.collect()
        before = tracemalloc.take_snapshot().filter_traces([tracemalloc.Filter(True, OURS)])
        for _ in range(steps - 2 * (steps // 5)):
            loop.step()
        gc.collect()
        after = tracemalloc.take_snapshot().filter_traces([tracemalloc.Filter(True, OURS)])
    finally:
        tracemalloc.stop()
    grown = [line for line in after.compare_to(before, "lineno") if line.size_diff > 1024]
    assert not grown
    total = sum(trace.size for trace in after.traces) - sum(trace.size for trace in before.traces)
    assert total < 2048
    assert health.steps == steps
    assert node.detector.counts.births > steps // 1000
    assert node.detector.counts.numeric_failures == 0


def test_nothing_grows(profile):
    soak(profile, 5_000)


@pytest.mark.slow
def test_nothing_grows_in_a_million_steps(profile):
    soak(profile, 1_000_000)


def allocations(kernel, arguments) -> int:
    """Of one call, beside the header that numba wraps around each array argument."""
    kernel(*arguments)
    _nrt_python.memsys_enable_stats()
    try:
        before = rtsys.get_allocation_stats()
        kernel(*arguments)
        after = rtsys.get_allocation_stats()
    finally:
        _nrt_python.memsys_disable_stats()
    return after.alloc - before.alloc - sum(isinstance(a, np.ndarray) for a in arguments)


def test_kernels_allocate_nothing(profile):
    loop, node, _ = make_loop(profile)
    for _ in range(500):
        loop.step()
    detector = node.detector
    scan = Scan(8)
    scan.valid[:] = True
    scan.z[:] = 40.0, 1.0, 1.5, 1.0  # all modes have something to do
    for first_ones in (-1, 10):
        detector._slot[:8], detector._steps[:8], detector._r[:8] = range(8), first_ones, 0.1
        detector._z[:8], detector._valid[:8] = scan.z, True
        processor = detector._processor
        assert allocations(processor.run, (processor.address, 8, -1e3, 0.0, 0.0)) == 0
        assert (detector._status[:8] == 0).all()
    assert allocations(detector._assign, detector._assign_arguments(scan, 8, 0)) == 0
    assert allocations(detector._settle, detector._settle_arguments(8, 0)) == 0
    assert allocations(detector._fill, detector._report_arguments(0)) == 0


def test_an_allocation_would_be_seen():
    kernel = numba.njit(lambda a: np.zeros(len(a)).sum())
    assert allocations(kernel, (np.zeros(3),)) == 1
