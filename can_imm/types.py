"""What passes between the rooms: manoeuvre names, state indices, scans.

This module sits below every other one and imports only numpy.  Units are SI throughout: metres,
metres per second, radians, integer nanoseconds.  The axes are those of the observing ("ego")
vehicle: x ahead, y to the left.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

X, VX, Y, VY = 0, 1, 2, 3
"""Indices of the four published states; AX and AY follow where a model carries acceleration."""
AX, AY = 4, 5
MAX_STATES = 6
"""Largest number of states."""

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int32]
BoolArray = npt.NDArray[np.bool_]


class Manoeuvre(IntEnum):
    """What an object does relative to the ego vehicle; the value is the one on the bus."""

    UNKNOWN = 0
    KEEP_RIGHT = 1
    LANE_CHANGE = 2
    KEEP_LEFT = 3
    OVERTAKING = 4
    RECEDING = 5
    APPROACHING = 6
    REAR_END = 7
    KEEP_LANE = 8
    STATIONARY = 9
    ONCOMING = 10


N_MANOEUVRES = len(Manoeuvre)

CUT_IN, CUT_OUT, OVERTAKING_ANOTHER = 1, 2, 4
"""Bits of a report's ``flags``: a lane change into or out of the ego's lane; the object passes
another one whose lane it left to the left."""


class LastingErrors(NamedTuple):
    """Errors of measured lateral positions that last for longer than a scan.

    Each object has one of its own, and all share one of the bearing: Gauss-Markov processes, whose
    time constants are ``lasting_s`` and ``bearing_s``.  Where a track begins, its own error is
    larger and fades more slowly.

    Attributes:
        std, lasting_s: of an object's own error [m, s].
        bearing_std, bearing_s: of that of the bearing [rad, s].
        new_std, new_s: of a new track's own error, times its distance [rad, s].
        period_s: between two scans [s].
    """

    std: float
    lasting_s: float
    bearing_std: float
    bearing_s: float
    new_std: float
    new_s: float
    period_s: float

    def as_white(self, x: FloatArray) -> FloatArray:
        """Variances (N,) [m²] of white noise that does about the same harm at distances x (N,) [m]:
        as many scans as share an error count as one."""
        own = self.std**2 * max(self.lasting_s / self.period_s, 1.0)
        shared = self.bearing_std**2 * max(self.bearing_s / self.period_s, 1.0)
        return np.asarray(own + shared * np.square(x))


class Scan:
    """One sensor scan in preallocated arrays; rows ``0 <= i < n`` are in use.

    Attributes:
        t_ns: time of the measurement on the bus clock [ns].
        counter: the sensor's scan counter, -1 where it sends none.
        incomplete: fewer objects arrived than the sensor announced.
        n: number of objects.
        ids: (capacity,) int32, object ids as the sensor names them (a track slot's number counts).
        ego_speed: of the observing vehicle [m/s], NaN where the bus does not tell.
        ego_yaw_rate: of the observing vehicle [rad/s], positive to the left, NaN where unknown.
        angle: (capacity,) the axes in which a row was measured are turned by so much against the
            vehicle's, positive to the left [rad].  0 for a sensor with Cartesian coordinates; for a
            polar one the bearing: its first axis then points from the vehicle's origin to the
            object, ``z`` is (range, range rate, 0, -) and the noise is independent in these axes.
        z: (capacity, 4) measured x, vx, y, vy [m, m/s, m, m/s], in axes turned by ``angle``.
        std: (capacity, 4) standard deviations of ``z``, same units.
        lasting: errors of ``z`` that last for longer than a scan, None from a sensor without.
        valid: (capacity, 4) which components were measured; the others' values mean nothing.
        new: (capacity,) the sensor says that this id names another object than in its last scan.
        existence: (capacity,) probability that the object exists; 1 from a sensor that gives none.
        object_class: (capacity,) int8, 0 unknown, 1 car, 2 truck, 3 pedestrian, 4 motorcycle,
            5 bicycle, 6 wide object.
        size: (capacity, 2) length and width [m], NaN where the sensor gives none.
    """

    __slots__ = (
        "angle", "counter", "ego_speed", "ego_yaw_rate", "existence", "ids", "incomplete",
        "lasting", "n", "new", "object_class", "size", "std", "t_ns", "valid", "z",
    )  # fmt: skip

    def __init__(self, capacity: int) -> None:
        self.t_ns = 0
        self.counter = -1
        self.incomplete = False
        self.n = 0
        self.ego_speed = self.ego_yaw_rate = float("nan")
        self.angle: FloatArray = np.zeros(capacity)
        self.ids: IntArray = np.zeros(capacity, np.int32)
        self.z: FloatArray = np.zeros((capacity, 4))
        self.std: FloatArray = np.ones((capacity, 4))
        self.lasting: LastingErrors | None = None
        self.valid: BoolArray = np.zeros((capacity, 4), np.bool_)
        self.new: BoolArray = np.zeros(capacity, np.bool_)
        self.existence: FloatArray = np.ones(capacity)
        self.object_class: npt.NDArray[np.int8] = np.zeros(capacity, np.int8)
        self.size: FloatArray = np.full((capacity, 2), np.nan)

    @property
    def capacity(self) -> int:
        """Number of rows."""
        return len(self.ids)

    def copy_from(self, other: Scan) -> None:
        """Take over another scan's content; ``other.n`` must not exceed this capacity."""
        n = other.n
        self.t_ns, self.counter, self.incomplete, self.n = (
            other.t_ns,
            other.counter,
            other.incomplete,
            n,
        )
        self.ego_speed, self.ego_yaw_rate = other.ego_speed, other.ego_yaw_rate
        self.lasting = other.lasting
        for name in (
            "ids", "angle", "z", "std", "valid", "new", "existence", "object_class",
            "size",
        ):  # fmt: skip
            getattr(self, name)[:n] = getattr(other, name)[:n]


RANGE, BEARING, RATE = 0, 1, 2
"""Columns of `DetectionScan.z`."""
POSE_X, POSE_Y, POSE_HEADING, POSE_VX, POSE_VY = 0, 1, 2, 3, 4
"""Columns of `DetectionScan.pose`."""


class DetectionScan:
    """What several sensors detected at about the same time, in preallocated arrays.

    Rows ``0 <= s < n_sensors`` and ``0 <= i < n`` are in use.  A sensor that looked and saw nothing
    has its row, too; one that is gone has none.  Poses are in axes that stand still, the same for
    all sensors of a system.

    Attributes:
        t_ns: time of the earliest measurement on the bus clock [ns].
        n_sensors: number of sensors that took part.
        sensor_id: (sensors,) int32, 0 to 14.
        counter: (sensors,) int32, each sensor's own scan counter, 0 to 255.
        delay: (sensors,) the sensor measured so long after ``t_ns`` [s], 0 or more.
        pose: (sensors, 5) x, y [m], heading [rad], vx, vy [m/s] of the sensor at its measurement.
        n: number of detections, of all sensors.
        sensor: (capacity,) int32, row of the sensor that made the detection, ascending.
        z: (capacity, 3) range [m], bearing [rad] from the sensor's heading, positive to the left,
            and rate of change of the range [m/s], NaN where the sensor measures none.
    """

    __slots__ = ("counter", "delay", "n", "n_sensors", "pose", "sensor", "sensor_id", "t_ns", "z")

    def __init__(self, sensors: int, capacity: int) -> None:
        self.t_ns = 0
        self.n_sensors = 0
        self.sensor_id: IntArray = np.zeros(sensors, np.int32)
        self.counter: IntArray = np.zeros(sensors, np.int32)
        self.delay: FloatArray = np.zeros(sensors)
        self.pose: FloatArray = np.zeros((sensors, 5))
        self.n = 0
        self.sensor: IntArray = np.zeros(capacity, np.int32)
        self.z: FloatArray = np.zeros((capacity, 3))

    def copy_from(self, other: DetectionScan) -> None:
        """Take over another scan's content; it must fit."""
        n, sensors = other.n, other.n_sensors
        self.t_ns, self.n, self.n_sensors = other.t_ns, n, sensors
        for name in ("sensor_id", "counter", "delay", "pose"):
            getattr(self, name)[:sensors] = getattr(other, name)[:sensors]
        for name in ("sensor", "z"):
            getattr(self, name)[:n] = getattr(other, name)[:n]


REPORT_DTYPE = np.dtype(
    [
        ("t_ns", np.int64),
        ("probability", np.float64),
        ("second_probability", np.float64),
        ("x", np.float64, (4,)),
        ("cov", np.float64, (4, 4)),
        ("p", np.float64, (N_MANOEUVRES,)),
        ("ego_speed", np.float64),
        ("change", np.float64, (2,)),
        ("object_id", np.int32),
        ("duplicate_of", np.int32),
        ("age", np.int32),
        ("manoeuvre", np.int8),
        ("second", np.int8),
        ("direction", np.int8),
        ("lane", np.int8),
        ("flags", np.int8),
        ("coasting", np.bool_),
    ],
    align=True,
)
"""What the detector says of one object after a scan.

``t_ns`` time for which it holds: that of the step which took the scan; ``age`` number of scans in
which the object was seen; ``manoeuvre`` and ``second`` are values of `Manoeuvre`; ``direction`` of
a lane change: +1 left, -1 right, 0 none; ``change`` when the lane change that is under way or
has just ended began and ends, as far as is known now [s], NaN if there is none or with a preset
that does not tell;
``lane`` with two lanes 0 right, 1 left; otherwise 0 the ego's, +1 the next to the left;
``flags`` bits `CUT_IN`, `CUT_OUT`, `OVERTAKING_ANOTHER`; ``duplicate_of`` object id of an older
track of the same vehicle, -1 if there is none; ``ego_speed`` [m/s], NaN if unknown;
``coasting`` the object was missed in this scan; ``x``, ``cov`` mean and
covariance of (x, vx, y, vy); ``p`` probability by `Manoeuvre` value, summing to 1 (all 0 while
UNKNOWN).
"""


class CanImmError(Exception):
    """Bad input outside the running loop; the message is one clear line for the user."""
