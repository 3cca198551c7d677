"""A vehicle on a road of straights and bends, seen by lidars that stand beside it.

The scenes' format is explained in the header of ``scenes/roadside.toml``, the published scene (Cui
and Wang; its geometry is not printed and was chosen so that three lidars cover the road together).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from can_imm.sim.model import MAX_ID
from can_imm.sim.scene import SceneRun
from can_imm.tables import Table, read_table
from can_imm.types import BEARING, RANGE, BoolArray, CanImmError, DetectionScan, FloatArray

DEFAULT_SCENE = "roadside"
MAX_SENSOR_ID = 14
COUNTER_MODULUS = 256
_FOLDER = Path(__file__).parent / "scenes"


@dataclass(frozen=True)
class Piece:
    """A straight (``angle`` 0) or a bend of a road.

    Attributes:
        length: along the middle of the road [m].
        angle: by which the road turns on the way [rad], positive to the left.
    """

    length: float
    angle: float = 0.0


@dataclass(frozen=True)
class Road:
    """Where the road begins [m, m, rad], and its pieces."""

    x: float
    y: float
    heading: float
    pieces: tuple[Piece, ...]

    @property
    def length(self) -> float:
        """From the beginning to the end [m]."""
        return sum(piece.length for piece in self.pieces)

    def along(self, s: FloatArray) -> FloatArray:
        """x, y, heading and curvature (N, 4) at distances s (N,) from the beginning [m]."""
        starts = np.cumsum([0.0, *(piece.length for piece in self.pieces[:-1])])
        which = np.clip(np.searchsorted(starts, s, "right") - 1, 0, None)
        out = np.empty((len(s), 4))
        x, y, heading = self.x, self.y, self.heading
        for i, piece in enumerate(self.pieces):
            curvature = piece.angle / piece.length
            here = which == i
            inside = np.append(s[here] - starts[i], piece.length)
            turned = curvature * inside
            # the chord of an arc: its length over the arc's is sinc of half the angle
            chord = inside * np.sinc(turned / (2.0 * np.pi))
            px = x + chord * np.cos(heading + turned / 2.0)
            py = y + chord * np.sin(heading + turned / 2.0)
            out[here, 0], out[here, 1] = px[:-1], py[:-1]
            out[here, 2], out[here, 3] = heading + turned[:-1], curvature
            x, y, heading = float(px[-1]), float(py[-1]), heading + piece.angle
        return out


@dataclass(frozen=True)
class LidarModel:
    """What all lidars have in common.

    Attributes:
        field_of_view: whole angle [rad].
        range: the farthest point that is seen [m].
        grid: bearings are rounded to multiples of this [rad]; 0: they are not.
        range_noise, bearing_noise: standard deviations [m, rad].
    """

    field_of_view: float
    range: float
    grid: float
    range_noise: float
    bearing_noise: float


@dataclass(frozen=True)
class Lidar:
    """Id on the bus, and where it stands and looks [m, m, rad]."""

    id: int
    x: float
    y: float
    heading: float


@dataclass(frozen=True)
class RoadsideScene:
    """One vehicle that drives along a road with constant speed, and the lidars around.

    Attributes:
        name: for messages and file names.
        duration: the run's end [s], unless the road ends before.
        period_ns: time between scans [ns].
        miss_probability: of a lidar for a vehicle that it could see.
        object_id: the vehicle's.
        speed: [m/s].

    Raises:
        CanImmError: an impossible scene; the message names the key.
    """

    name: str
    duration: float
    period_ns: int
    object_id: int
    speed: float
    road: Road
    model: LidarModel
    lidars: tuple[Lidar, ...]
    miss_probability: float = 0.0

    def __post_init__(self) -> None:
        _check(self)


@dataclass(frozen=True)
class RoadsideRun(SceneRun):
    """A played scene.

    Attributes:
        turn_rate: (N,) true turn rate of the vehicle [rad/s].
        visible: (N, lidars) the lidar could see the vehicle.
    """

    turn_rate: FloatArray
    visible: BoolArray


def play_scene(scene: RoadsideScene, rng: np.random.Generator) -> RoadsideRun:
    """Drive along the road and measure; all lidars at the same times, from t = 0 on.

    Every lidar is in every scan, also where it sees nothing.  A bearing may lie a little outside of
    the field of view, because the noise comes after the question of what is visible.  The same
    generator gives the same noise whatever ``miss_probability`` is.
    """
    period = scene.period_ns * 1e-9
    end = min(scene.duration, scene.road.length / scene.speed)
    n = max(math.ceil(end / period - 1e-9), 1)
    t_ns = np.arange(n, dtype=np.int64) * scene.period_ns
    way = scene.road.along(scene.speed * period * np.arange(n, dtype=np.float64))
    state = np.stack(
        (
            way[:, 0],
            scene.speed * np.cos(way[:, 2]),
            way[:, 1],
            scene.speed * np.sin(way[:, 2]),
        ),
        axis=-1,
    )
    distance, bearing = _geometry(scene, way[:, :2])
    model = scene.model
    visible = (distance <= model.range) & (np.abs(bearing) <= model.field_of_view / 2.0)
    noise = rng.standard_normal((n, len(scene.lidars), 2))
    hit = visible & (rng.random(visible.shape) >= scene.miss_probability)
    distance = np.maximum(distance + model.range_noise * noise[:, :, 0], 0.0)
    bearing = bearing + model.bearing_noise * noise[:, :, 1]
    if model.grid > 0.0:
        bearing = np.round(bearing / model.grid) * model.grid
    scans = [_scan(scene, k, distance[k], bearing[k], hit[k]) for k in range(n)]
    return RoadsideRun(scans, t_ns, state, scene.speed * way[:, 3], visible)


def _geometry(scene: RoadsideScene, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance and bearing from each lidar's heading, both (N, lidars), in [-pi, pi)."""
    poses = np.array([(lidar.x, lidar.y, lidar.heading) for lidar in scene.lidars])
    dx = points[:, None, 0] - poses[:, 0]
    dy = points[:, None, 1] - poses[:, 1]
    bearing = np.arctan2(dy, dx) - poses[:, 2]
    return np.hypot(dx, dy), (bearing + np.pi) % (2.0 * np.pi) - np.pi


def _scan(
    scene: RoadsideScene, k: int, distance: FloatArray, bearing: FloatArray, hit: BoolArray
) -> DetectionScan:
    scan = DetectionScan(len(scene.lidars), len(scene.lidars))
    scan.t_ns = k * scene.period_ns
    scan.n_sensors = len(scene.lidars)
    scan.counter[:] = k % COUNTER_MODULUS
    for i, lidar in enumerate(scene.lidars):
        scan.sensor_id[i] = lidar.id
        scan.pose[i] = lidar.x, lidar.y, lidar.heading, 0.0, 0.0
    rows: npt.NDArray[np.intp] = np.flatnonzero(hit)
    scan.n = len(rows)
    scan.sensor[: scan.n] = rows
    scan.z[: scan.n] = np.nan
    scan.z[: scan.n, RANGE] = distance[rows]
    scan.z[: scan.n, BEARING] = bearing[rows]
    return scan


def builtin_scenes() -> list[str]:
    """Names of the roadside scenes that come with the package."""
    return [DEFAULT_SCENE]


def load_scene(name_or_path: str = DEFAULT_SCENE) -> RoadsideScene:
    """Read the built-in scene or any other from a TOML file.

    Raises:
        CanImmError: no such scene, broken TOML, unknown keys, wrong types or an impossible scene;
            one line that names the file and the key.
    """
    top = read_table(name_or_path, _FOLDER, "scene")
    top.choice("kind", {"roadside": None})
    duration, period = top.number("duration"), top.number("period", low=0.001, high=10.0)
    miss_probability = top.number("miss_probability", 0.0)
    vehicle, road, lidar = top.table("vehicle", {}), top.table("road", {}), top.table("lidar", {})
    object_id, speed = vehicle.integer("id"), vehicle.number("speed")
    begins = road.number("x"), road.number("y"), math.radians(road.number("heading"))
    pieces = tuple(_piece(row) for row in road.tables("pieces", each="piece"))
    model = LidarModel(
        field_of_view=math.radians(lidar.number("field_of_view")),
        range=lidar.number("range"),
        grid=math.radians(lidar.number("grid")),
        range_noise=lidar.number("range_noise"),
        bearing_noise=math.radians(lidar.number("bearing_noise")),
    )
    lidars = tuple(_lidar(row) for row in top.tables("lidars", each="lidar"))
    for table in (vehicle, road, lidar, top):
        table.done()
    try:
        return RoadsideScene(
            name=Path(top.file).stem,
            duration=duration,
            period_ns=round(period * 1e9),
            object_id=object_id,
            speed=speed,
            road=Road(*begins, pieces),
            model=model,
            lidars=lidars,
            miss_probability=miss_probability,
        )
    except CanImmError as error:
        raise top.error(str(error)) from error


def _piece(row: Table) -> Piece:
    radius = row.number("radius", 0.0)
    if radius:
        angle = math.radians(row.number("angle"))
        piece = Piece(abs(radius * angle), angle)
    else:
        piece = Piece(row.number("length"))
    row.done()
    return piece


def _lidar(row: Table) -> Lidar:
    lidar = Lidar(
        row.integer("id"), row.number("x"), row.number("y"), math.radians(row.number("heading"))
    )
    row.done()
    return lidar


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise CanImmError(message)


def _check(scene: RoadsideScene) -> None:
    model = scene.model
    numbers = {
        "duration": (scene.duration, 0.1, 3600.0, "s"),
        "vehicle: speed": (scene.speed, 0.1, 100.0, "m/s"),
        "lidar: range": (model.range, 1.0, 1000.0, "m"),
        "lidar: field_of_view": (math.degrees(model.field_of_view), 1.0, 360.0, "°"),
        "lidar: grid": (math.degrees(model.grid), 0.0, 10.0, "°"),
        "lidar: range_noise": (model.range_noise, 0.0, 10.0, "m"),
        "lidar: bearing_noise": (math.degrees(model.bearing_noise), 0.0, 30.0, "°"),
    }
    for key, (value, low, high, unit) in numbers.items():
        _require(
            low <= value <= high,
            f"{key} must lie between {low:g} and {high:g} {unit}, not {value:g}",
        )
    _require(
        0.0 <= scene.miss_probability < 1.0,
        f"miss_probability must be a probability below 1, not {scene.miss_probability:g}",
    )
    _require(
        0 <= scene.object_id <= MAX_ID,
        f"vehicle: id must lie between 0 and {MAX_ID}, not {scene.object_id}",
    )
    places = (scene.road.x, scene.road.y, scene.road.heading)
    _require(all(map(math.isfinite, places)), "road: x, y and heading must be finite")
    _require(bool(scene.road.pieces), "road: at least one piece is needed")
    for i, piece in enumerate(scene.road.pieces, start=1):
        _require(
            0.1 <= piece.length <= 1e5 and abs(piece.angle) <= 4.0 * math.pi,
            f"road, piece {i}: must be between 0.1 m and 100 km long and turn by 720° at most",
        )
    _require(bool(scene.lidars), "lidars: at least one is needed")
    for lidar in scene.lidars:
        _require(
            0 <= lidar.id <= MAX_SENSOR_ID,
            f"lidars: id must lie between 0 and {MAX_SENSOR_ID}, not {lidar.id}",
        )
        _require(
            all(map(math.isfinite, (lidar.x, lidar.y, lidar.heading))),
            f"lidar {lidar.id}: x, y and heading must be finite",
        )
    ids = sorted(lidar.id for lidar in scene.lidars)
    for one, other in pairwise(ids):
        _require(one != other, f"lidars: id {one} is there twice")
