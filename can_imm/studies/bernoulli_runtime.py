"""How long a step of the Bernoulli filter takes, beside the same recursion in numpy."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from can_imm.estimation.bernoulli import BernoulliFilter, BernoulliModel
from can_imm.sim.cooperative import load_scene, play_scene
from can_imm.types import DetectionScan, FloatArray

SIZES = (600, 6_000, 42_000, 120_000, 300_000, 1_000_000)
QUICK_SIZES = (600, 6_000, 42_000)
"""Particles in all: a sixth of them follow the object, the rest are born."""

NUMPY_UP_TO = 300_000
PERIOD_S = 0.1


class NumpyFilter:
    """The product update as one writes it in numpy: whole arrays, libm, four normals each."""

    def __init__(self, model: BernoulliModel, particles: int, rng: np.random.Generator) -> None:
        self.q = 0.0
        self._m = model
        self._p: FloatArray = np.zeros((4, particles))
        self._rng = rng
        self._before: tuple[FloatArray, FloatArray] | None = None

    def step(self, dt: float, scan: DetectionScan) -> None:
        """Predict by ``dt`` [s], update, resample."""
        m, rng, count = self._m, self._rng, self._p.shape[1]
        born = [self._p[:, :0]]
        if self._before is not None:
            born = [self._births(pose, z, count) for pose, z in zip(*self._before, strict=True)]
        births = np.concatenate(born, axis=1)
        p_birth = m.p_birth * (1.0 - self.q) if births.size else 0.0
        predicted = p_birth + m.p_survival * self.q
        poses = scan.pose[scan.sensor[: scan.n]]
        self._before = poses.copy(), scan.z[: scan.n].copy()
        if predicted <= 0.0:
            return
        cloud = np.concatenate([self._p, births], axis=1)
        weight = np.full(cloud.shape[1], p_birth / max(births.shape[1], 1))
        weight[:count] = m.p_survival * self.q / count
        noise = rng.standard_normal(cloud.shape)
        cloud[::2] += dt * cloud[1::2] + math.sqrt(m.density * dt**3 / 3) * noise[::2]
        cloud[1::2] += math.sqrt(m.density * dt * 0.75) * noise[::2]
        cloud[1::2] += math.sqrt(m.density * dt * 0.25) * noise[1::2]
        log_weight = np.log(weight / predicted + 1e-300)
        for row in range(scan.n_sensors):
            z = scan.z[: scan.n][scan.sensor[: scan.n] == row]
            log_weight += np.log(self._psi(cloud, scan.pose[row], z))
        top = log_weight.max()
        weight = np.exp(log_weight - top)
        total = weight.sum()
        evidence = total * math.exp(top)
        self.q = predicted * evidence / (1.0 - predicted + predicted * evidence)
        steps = (np.arange(count) + rng.random()) / count
        chosen = np.searchsorted(np.cumsum(weight / total), steps)
        self._p = cloud[:, np.minimum(chosen, cloud.shape[1] - 1)]

    def _births(self, pose: FloatArray, z: FloatArray, count: int) -> FloatArray:
        m = self._m
        e = self._rng.standard_normal((4, count))
        r, angle = z[0] + m.std_range * e[0], pose[2] + z[1] + m.std_bearing * e[1]
        rate, across = z[2] + m.std_rate * e[2], m.std_tangential * e[3]
        c, s = np.cos(angle), np.sin(angle)
        return np.stack(
            [pose[0] + r * c, pose[3] + rate * c - across * s,
             pose[1] + r * s, pose[4] + rate * s + across * c]
        )  # fmt: skip

    def _psi(self, cloud: FloatArray, pose: FloatArray, z: FloatArray) -> FloatArray:
        m = self._m
        dx, dy = cloud[0] - pose[0], cloud[2] - pose[1]
        r = np.hypot(dx, dy)
        bearing = np.arctan2(dy, dx) - pose[2]
        rate = (dx * (cloud[1] - pose[3]) + dy * (cloud[3] - pose[4])) / r
        scale = m.p_detection * m.range_max * math.tau * m.rate_span / m.clutter
        scale /= math.tau**1.5 * m.std_range * m.std_bearing * m.std_rate
        psi: FloatArray = np.full(cloud.shape[1], 1.0 - m.p_detection)
        for one in z:
            angle = (bearing - one[1] + np.pi) % math.tau - np.pi
            exponent = ((r - one[0]) / m.std_range) ** 2 + (angle / m.std_bearing) ** 2
            psi += scale * np.exp(-0.5 * (exponent + ((rate - one[2]) / m.std_rate) ** 2))
        return psi


def measure(
    sizes: Sequence[int] = SIZES, *, steps: int = 20, progress: Callable[[], None] = lambda: None
) -> list[dict[str, Any]]:
    """Median and best time of a step with five sensors and one detection of each [ms].

    Args:
        sizes: particles in all.
        steps: measured for each size.
        progress: called for every size.
    """
    scene = load_scene("cooperative")
    radar = replace(scene.radar, clutter=0.0, detection=1.0)
    scene = replace(scene, radar=radar, period=PERIOD_S)
    scans = play_scene(scene, np.random.default_rng(0)).scans[: steps + 3]
    model = BernoulliModel()
    rows = []
    for size in sizes:
        count = size // 6
        f = BernoulliFilter(
            model, np.random.default_rng(0), particles=count, births=size - count, capacity=5
        )
        times = {"": _times(partial(_step, f), scans)}
        if size <= NUMPY_UP_TO:
            slow = NumpyFilter(model, count, np.random.default_rng(0))
            times["numpy_"] = _times(partial(slow.step, PERIOD_S), scans)
        row: dict[str, Any] = {"particles": size, "sensors": 5}
        for name, ms in times.items():
            row[f"{name}median_ms"] = round(float(np.median(ms)), 4)
            row[f"{name}best_ms"] = round(float(ms.min()), 4)
        row["share_of_period"] = round(row["median_ms"] / (1e3 * PERIOD_S), 6)
        rows.append(row)
        progress()
    return rows


def _step(f: BernoulliFilter, scan: DetectionScan) -> None:
    f.step(PERIOD_S, scan.pose, scan.delay, scan.sensor, scan.z)


def _times(step: Callable[[DetectionScan], None], scans: Sequence[DetectionScan]) -> FloatArray:
    """Times of all steps but the first three [ms]: those have nothing to follow yet."""
    times = []
    for scan in scans:
        began = time.perf_counter()
        step(scan)
        times.append(1e3 * (time.perf_counter() - began))
    return np.array(times[3:])
