"""Vehicles with radars around one object: what happens, and what each of them detects.

The scene is a TOML table, explained in the header of ``scenes/cooperative.toml``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from can_imm.sim.scene import SceneRun
from can_imm.tables import Table, read_table
from can_imm.types import POSE_VX, POSE_X, POSE_Y, CanImmError, DetectionScan, FloatArray

MAX_SENSORS = 15
"""Sensor ids 0 to 14 fit the frames."""

MAX_DETECTIONS = 62
"""So many detections of one sensor fit a scan on the bus."""

_BUILTIN = ("cooperative",)
_FOLDER = Path(__file__).parent / "scenes"


@dataclass(frozen=True)
class Radar:
    """Noise (standard deviations in m, rad, m/s), reach [m] and faults of every radar.

    ``detection`` and ``dropout`` are probabilities, ``clutter`` the mean number of false detections
    per scan, uniform over range, bearing and a range rate within half of ``rate_span`` [m/s].
    """

    std_range: float = 0.2
    std_bearing: float = math.radians(0.3)
    std_rate: float = 0.6
    range_max: float = 200.0
    detection: float = 0.95
    clutter: float = 1.0
    dropout: float = 0.0
    rate_span: float = 100.0


@dataclass(frozen=True)
class Target:
    """The object: position at the start [m], speed [m/s], when it is there [s], its lane change."""

    x: float
    y: float
    speed: float
    appears: float = 0.0
    disappears: float = math.inf
    change_start: float = 0.0
    change_end: float = 0.0
    change_by: float = 0.0

    def state(self, t_s: FloatArray) -> FloatArray:
        """(N, 4) x, vx, y, vy on the road at the times (N,) [s]; NaN while it is not there.

        The lateral path of the lane change is half a cosine.
        """
        state = np.empty((len(t_s), 4))
        state[:, 0] = self.x + self.speed * t_s
        state[:, 1] = self.speed
        state[:, 2] = self.y
        state[:, 3] = 0.0
        duration = self.change_end - self.change_start
        if duration > 0.0:
            phase = np.pi * np.clip((t_s - self.change_start) / duration, 0.0, 1.0)
            state[:, 2] += 0.5 * self.change_by * (1.0 - np.cos(phase))
            state[:, 3] = 0.5 * self.change_by * np.sin(phase) * np.pi / duration
        state[(t_s < self.appears) | (t_s >= self.disappears)] = np.nan
        return state


@dataclass(frozen=True)
class Observer:
    """A vehicle with a radar at constant speed along the road; it sends from ``since`` [s] on until
    ``until``."""

    x: float
    y: float
    speed: float
    since: float = 0.0
    until: float = math.inf


@dataclass(frozen=True)
class CooperativeScene:
    """A scene; ``ego`` is the row of the observer to which objects are relative.

    Raises:
        CanImmError: an impossible scene; the message names the key.
    """

    duration: float
    target: Target
    observers: tuple[Observer, ...]
    period: float = 0.1
    ego: int = 0
    radar: Radar = Radar()

    def __post_init__(self) -> None:
        radar = self.radar
        _within(self.duration, 0.1, 3600.0, "duration")
        _within(self.period, 0.001, 10.0, "period")
        for name in ("std_range", "std_bearing", "std_rate"):
            _within(getattr(radar, name), 1e-6, 100.0, f"radar: {name}")
        _within(radar.range_max, 1.0, 327.0, "radar: range")
        _within(radar.detection, 0.0, 1.0, "radar: detection")
        _within(radar.dropout, 0.0, 1.0, "radar: dropout")
        _within(radar.clutter, 0.0, 30.0, "radar: clutter")
        n = len(self.observers)
        if not 1 <= n <= MAX_SENSORS:
            raise CanImmError(f"sensor: between 1 and {MAX_SENSORS} are needed, not {n}")
        if not 0 <= self.ego < n:
            raise CanImmError(f"ego must lie between 1 and {n}, not {self.ego + 1}")
        movers: list[tuple[str, Target | Observer]] = [("object", self.target)]
        movers += [(f"sensor {k}", one) for k, one in enumerate(self.observers, start=1)]
        for where, one in movers:
            _within(one.x, -1e4, 1e4, f"{where}: x")
            _within(one.y, -1e4, 1e4, f"{where}: y")
            _within(one.speed, -100.0, 100.0, f"{where}: speed")
        target = self.target
        if target.change_by and not 0.0 <= target.change_start < target.change_end:
            raise CanImmError("object: change_end must come after change_start")
        if not target.appears < target.disappears:
            raise CanImmError("object: disappears must come after appears")


def builtin_scenes() -> list[str]:
    """Names of the cooperative scenes that come with the package."""
    return list(_BUILTIN)


def load_scene(name_or_path: str) -> CooperativeScene:
    """Read a built-in scene by its name or any other from a TOML file.

    Raises:
        CanImmError: no such scene, broken TOML, unknown keys, wrong types or an impossible scene;
            one line that names the file and the key.
    """
    top = read_table(name_or_path, _FOLDER, "scene")
    top.choice("kind", {"cooperative": True})
    radar, target = top.table("radar", {}), top.table("object", {})
    duration = top.number("duration")
    period = top.number("period", CooperativeScene.period)
    ego = int(top.number("ego", 1)) - 1
    noise = Radar(
        std_range=radar.number("std_range", Radar.std_range),
        std_bearing=math.radians(radar.number("std_bearing_deg", 0.3)),
        std_rate=radar.number("std_rate", Radar.std_rate),
        range_max=radar.number("range", Radar.range_max),
        detection=radar.number("detection", Radar.detection),
        clutter=radar.number("clutter", Radar.clutter),
        dropout=radar.number("dropout", Radar.dropout),
    )
    vehicle = Target(
        x=target.number("x"),
        y=target.number("y"),
        speed=target.number("speed"),
        appears=target.number("appears", 0.0),
        disappears=target.number("disappears", math.inf),
        change_start=target.number("change_start", 0.0),
        change_end=target.number("change_end", 0.0),
        change_by=target.number("change_by", 0.0),
    )
    observers = tuple(_observer(table) for table in top.tables("sensor"))
    for table in (radar, target, top):
        table.done()
    try:
        return CooperativeScene(
            duration=duration,
            period=period,
            ego=ego,
            radar=noise,
            target=vehicle,
            observers=observers,
        )
    except CanImmError as error:
        raise top.error(str(error)) from error


def _observer(table: Table) -> Observer:
    observer = Observer(
        x=table.number("x"),
        y=table.number("y"),
        speed=table.number("speed"),
        since=table.number("from", 0.0),
        until=table.number("until", math.inf),
    )
    table.done()
    return observer


def play_scene(scene: CooperativeScene, rng: np.random.Generator) -> SceneRun:
    """Simulate and measure; a scan in which no sensor took part is missing from the run's scans."""
    period_ns = round(scene.period * 1e9)
    t_ns = np.arange(0, round(scene.duration * 1e9), period_ns, dtype=np.int64)
    t_s: FloatArray = np.multiply(t_ns, 1e-9, dtype=np.float64)
    truth = scene.target.state(t_s)
    ego = scene.observers[scene.ego]
    relative = truth - np.stack(
        [ego.x + ego.speed * t_s, np.full_like(t_s, ego.speed),
         np.full_like(t_s, ego.y), np.zeros_like(t_s)], axis=1,
    )  # fmt: skip
    scans = []
    for k, at_s in enumerate(t_s):
        scan = _scan(scene, k, float(at_s), truth[k], rng)
        if scan.n_sensors:
            scan.t_ns = int(t_ns[k])
            scans.append(scan)
    return SceneRun(scans, t_ns, relative)


def _scan(
    scene: CooperativeScene, k: int, t_s: float, state: FloatArray, rng: np.random.Generator
) -> DetectionScan:
    poses, ids, found = [], [], []
    for number, observer in enumerate(scene.observers):
        lost = not observer.since <= t_s < observer.until or rng.random() < scene.radar.dropout
        if lost:
            continue
        pose = np.zeros(5)
        pose[POSE_X] = observer.x + observer.speed * t_s
        pose[POSE_Y] = observer.y
        pose[POSE_VX] = observer.speed
        poses.append(pose)
        ids.append(number)
        found.append(_detect(scene.radar, pose, state, rng))
    scan = DetectionScan(len(ids), sum(len(one) for one in found))
    scan.n_sensors, scan.n = len(ids), len(scan.z)
    if ids:
        scan.sensor_id[:] = ids
        scan.counter[:] = k % 256
        scan.pose[:] = poses
        scan.sensor[:] = np.repeat(np.arange(len(ids)), [len(one) for one in found])
        scan.z[:] = np.concatenate(found)
    return scan


def _detect(
    radar: Radar, pose: FloatArray, state: FloatArray, rng: np.random.Generator
) -> npt.NDArray[np.float64]:
    """(n, 3) detections of one radar in random order: perhaps the object, and clutter."""
    rows = []
    dx, dy = state[0] - pose[0], state[2] - pose[1]
    distance = math.hypot(dx, dy)
    noise = rng.standard_normal(3) * (radar.std_range, radar.std_bearing, radar.std_rate)
    # not-a-number, an object that is not there, is never within reach
    if distance <= radar.range_max and rng.random() < radar.detection:
        rate = ((state[1] - pose[3]) * dx + (state[3] - pose[4]) * dy) / max(distance, 1e-9)
        exact = np.array([distance, math.atan2(dy, dx) - pose[2], rate])
        rows.append(exact + noise)
    false = min(int(rng.poisson(radar.clutter)), MAX_DETECTIONS - 1)
    reach = np.array([radar.range_max, np.pi, 0.5 * radar.rate_span])
    rows += list(rng.uniform((0.0, -reach[1], -reach[2]), reach, (false, 3)))
    z = np.array(rows).reshape(-1, 3)
    z[:, 0] = np.abs(z[:, 0])
    z[:, 1] = np.arctan2(np.sin(z[:, 1]), np.cos(z[:, 1]))
    return rng.permutation(z)


def _within(value: float, low: float, high: float, where: str) -> None:
    if not low <= value <= high:
        raise CanImmError(f"{where} must lie between {low:g} and {high:g}, not {value:g}")


__all__ = [
    "CooperativeScene", "Observer", "Radar", "Target", "builtin_scenes", "load_scene", "play_scene",
]  # fmt: skip
