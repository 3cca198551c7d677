"""Random traffic as an ARS408 would put it on the bus: nothing of it is shared with the project.

A straight road with three lanes, no ego motion on the bus; 14 Hz, noise of .1 m, .3 m/s, .2 m and
.3 m/s, the radar's own quantisation, 2 % of the objects missing from a scan.  Lane changes go at a
constant rate, as in the published scenario, or follow a cosine.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

WIDTH = 3.5
TICK = 0.01
SIGMA = np.array([0.1, 0.3, 0.2, 0.3])

Truth = dict[tuple[int, int], str]
"""Label by scan and object."""


class _Vehicle:
    """A minute of one vehicle: keeps its lane, and every few seconds does something else."""

    def __init__(self, rng: np.random.Generator, seconds: float, smooth: bool) -> None:
        n = int(seconds / TICK)
        lane = int(rng.integers(-1, 2))
        gap = start = rng.uniform(20.0, 80.0)
        speed = np.zeros(n)
        y = np.full(n, lane * WIDTH)
        label = np.full(n, "KEEP_LANE", dtype=object)
        k = int(rng.uniform(3.0, 9.0) / TICK)
        while k < n:
            what = rng.choice(["LANE_CHANGE", "RECEDING", "APPROACHING"])
            if what == "RECEDING" and gap > 100.0:
                what = "APPROACHING"
            elif what == "APPROACHING" and gap < 35.0:
                what = "RECEDING"
            if what == "LANE_CHANGE":
                to = lane + int(rng.choice([-1, 1])) if lane == 0 else 0
                m = int(rng.uniform(3.0, 5.0) / TICK) if smooth else int(rng.uniform(2, 4) / TICK)
                part = np.arange(m) / m
                if smooth:
                    part = 0.5 - 0.5 * np.cos(np.pi * part)
                path = (lane + (to - lane) * part) * WIDTH
                y[k : k + m] = path[: n - k]
                y[k + m :] = to * WIDTH
                lane = to
            else:
                # a trapezoid of the relative speed
                way, ramp = rng.uniform(15.0, 30.0), rng.uniform(1.4, 2.6)
                peak = rng.uniform(2.0, 3.6)
                m = int((way / peak + peak / ramp) / TICK)
                t = np.arange(m) * TICK
                shape = np.minimum(np.minimum(ramp * t, peak), ramp * (m * TICK - t))
                sign = 1.0 if what == "RECEDING" else -1.0
                speed[k : k + m] = sign * shape[: n - k]
                gap += sign * way
            label[k : k + m] = what
            k += m + int(rng.uniform(3.0, 9.0) / TICK)
        self.state = np.column_stack(
            [start + np.cumsum(speed) * TICK, speed, y, np.gradient(y, TICK)]
        )
        in_lane = np.abs(y) < 0.5 * WIDTH
        label[(label == "APPROACHING") & (self.state[:, 0] <= 10.0) & in_lane] = "REAR_END"
        self.label = label


def _object_frame(name: int, z: NDArray[np.float64]) -> bytes:
    """60B: DistLong, VrelLong, DistLat, VrelLat in their steps; moving, a typical echo."""
    lowest, lsb = np.array([-500.0, -128.0, -204.6, -64.0]), np.array([0.2, 0.25, 0.2, 0.25])
    steps = np.round((z - lowest) / lsb).astype(int)
    bits = name
    for value, width in zip(steps[[0, 2, 1, 3]], (13, 11, 10, 9), strict=True):
        bits = bits << width | int(value)
    return (bits << 13 | 0x8F).to_bytes(8, "big")


def write_recording(path: Path, seed: int, *, smooth: bool = False, seconds: float = 60.0) -> Truth:
    """Write a candump log of six vehicles; returns their labels, numbered by scan from 0."""
    rng = np.random.default_rng(seed)
    vehicles = [_Vehicle(rng, seconds, smooth) for _ in range(6)]
    truth: Truth = {}
    lines = []
    for scan in range(int(seconds * 14) - 1):
        at = int((scan + 0.5) / 14 / TICK)
        rows = []
        for name, vehicle in enumerate(vehicles):
            if rng.random() < 0.02:
                continue
            rows.append(_object_frame(name, vehicle.state[at] + SIGMA * rng.standard_normal(4)))
            truth[scan, name] = str(vehicle.label[at])
        status = bytes([len(rows), scan >> 8 & 0xFF, scan & 0xFF, 0x10, 0, 0, 0, 0])
        time = 1000.0 + at * TICK
        for number, (frame, data) in enumerate([(0x60A, status), *((0x60B, row) for row in rows)]):
            lines.append(f"({time + number * 0.0003:.6f}) can0 {frame:03X}#{data.hex().upper()}\n")
    path.write_text("".join(lines))
    return truth
