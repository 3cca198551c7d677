"""What passes between the rooms: manoeuvre names, state indices, scans.

This module sits below every other one and imports only numpy.  Units are SI throughout: metres,
metres per second, radians, integer nanoseconds.  The axes are those of the observing ("ego")
vehicle: x ahead, y to the left.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import numpy.typing as npt

X, VX, Y, VY = 0, 1, 2, 3
"""Indices of the four published states; AX and AY follow where a model carries acceleration."""
AX, AY = 4, 5

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


N_MANOEUVRES = len(Manoeuvre)

SCAN_OK, SCAN_INCOMPLETE = 0, 1


class Scan:
    """One sensor scan in preallocated arrays; rows ``0 <= i < n`` are in use.

    Attributes:
        t_ns: time of the measurement on the bus clock [ns].
        counter: the sensor's scan counter, -1 where it sends none.
        incomplete: fewer objects arrived than the sensor announced.
        n: number of objects.
        ids: (capacity,) int32, object ids as the sensor names them (a track slot's number counts).
        z: (capacity, 4) measured x, vx, y, vy [m, m/s, m, m/s].
        std: (capacity, 4) standard deviations of ``z``, same units.
        valid: (capacity, 4) which components were measured; the others' values mean nothing.
        new: (capacity,) the sensor says that this id names another object than in its last scan.
    """

    __slots__ = ("counter", "ids", "incomplete", "n", "new", "std", "t_ns", "valid", "z")

    def __init__(self, capacity: int) -> None:
        self.t_ns = 0
        self.counter = -1
        self.incomplete = False
        self.n = 0
        self.ids: IntArray = np.zeros(capacity, np.int32)
        self.z: FloatArray = np.zeros((capacity, 4))
        self.std: FloatArray = np.ones((capacity, 4))
        self.valid: BoolArray = np.zeros((capacity, 4), np.bool_)
        self.new: BoolArray = np.zeros(capacity, np.bool_)

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
        for name in ("ids", "z", "std", "valid", "new"):
            getattr(self, name)[:n] = getattr(other, name)[:n]


REPORT_DTYPE = np.dtype(
    [
        ("t_ns", np.int64),
        ("probability", np.float64),
        ("second_probability", np.float64),
        ("x", np.float64, (4,)),
        ("cov", np.float64, (4, 4)),
        ("p", np.float64, (N_MANOEUVRES,)),
        ("object_id", np.int32),
        ("age", np.int32),
        ("manoeuvre", np.int8),
        ("second", np.int8),
        ("direction", np.int8),
        ("lane", np.int8),
        ("coasting", np.bool_),
    ],
    align=True,
)
"""What the detector says of one object after a scan.

``t_ns`` time for which it holds: that of the step which took the scan; ``age`` number of scans in
which the object was seen; ``manoeuvre`` and ``second`` are values of `Manoeuvre`; ``direction`` of
a lane change: +1 left, -1 right, 0 none;
``lane`` 0 right, 1 left; ``coasting`` the object was missed in this scan; ``x``, ``cov`` mean and
covariance of (x, vx, y, vy); ``p`` probability by `Manoeuvre` value, summing to 1 (all 0 while
UNKNOWN).
"""


class CanImmError(Exception):
    """Bad input outside the running loop; the message is one clear line for the user."""
