"""What the IMM has to beat: one constant-velocity Kalman filter, and thresholds on its state.

All constants below were found by ``can-imm study tune-rules`` on seeds below 1000; studies report
on seeds from 1000 on.  The rules have one set of thresholds for the published scenario and for
random ones: sets tuned for either alone were no better on seeds that they had not seen.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from filterpy.kalman import KalmanFilter
from numba import njit

from can_imm.types import VX, VY, FloatArray, Manoeuvre, X, Y

Int8Array = npt.NDArray[np.int8]
Int64Array = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


class Noise(NamedTuple):
    """Spectral densities of the white-noise acceleration [m²/s³], along and across the road."""

    along: float
    across: float


class Rules(NamedTuple):
    """Filter and thresholds of the baseline "rules" (spec of the detector, baselines).

    Tested in this order: APPROACHING (REAR_END within ``rear_end_x``), OVERTAKING, LANE_CHANGE,
    RECEDING, else the lane that is nearer.
    """

    q_along: float
    """White-noise acceleration along the road [m²/s³]."""
    q_across: float
    """White-noise acceleration across the road [m²/s³]."""
    approaching: float
    """APPROACHING or REAR_END below minus this vx [m/s]."""
    rear_end_x: float
    """REAR_END up to this gap [m]."""
    overtaking_y: float
    """OVERTAKING above this y [m] ..."""
    overtaking_vx: float
    """... and above this vx [m/s]."""
    lane_vy: float
    """LANE_CHANGE above this lateral speed, either way [m/s] ..."""
    lane_border: float
    """... or nearer to the border between the lanes than this [m]."""
    border_y: float
    """Where that border lies [m]."""
    receding: float
    """RECEDING above this vx [m/s]."""
    out_of_right_lane: bool
    """OVERTAKING only if the lane that was kept last is the right one; without this memory, which
    the published scenario does not need, every RECEDING in the left lane is taken for it."""
    hysteresis: float
    """Share by which the thresholds of the class that is being said are easier (0: none)."""
    dwell: int
    """Frames in a row that must agree on another class before it is said (1: at once)."""


KALMAN_NOISE = Noise(along=0.303, across=0.335)
"""Of the baseline "kalman"."""

RULES = Rules(
    q_along=0.175,
    q_across=3.797,
    approaching=0.392,
    rear_end_x=10.05,
    overtaking_y=0.251,
    overtaking_vx=0.206,
    lane_vy=0.827,
    lane_border=1.25,
    border_y=1.511,
    receding=0.412,
    out_of_right_lane=True,
    hysteresis=0.05,
    dwell=1,
)
"""Of the baseline "rules": one set for the published scenario and for random ones."""


def white_noise_acceleration(dt: float, noise: Noise) -> tuple[FloatArray, FloatArray]:
    """Transition matrix and process noise (4, 4) of the constant-velocity model over ``dt`` [s]."""
    F = np.eye(4)
    F[X, VX] = F[Y, VY] = dt
    Q = np.zeros((4, 4))
    for q, axis in ((noise.along, slice(X, Y)), (noise.across, slice(Y, None))):
        Q[axis, axis] = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    return F, Q


def kalman(
    t_ns: Int64Array, z: FloatArray, seen: BoolArray, std: FloatArray, noise: Noise
) -> tuple[FloatArray, FloatArray]:
    """Filter one object's measurements with filterpy's `KalmanFilter`.

    Args:
        t_ns: (N,) times of the scans [ns]; the first must contain the object.
        z: (N, 4) measured x, vx, y, vy [m, m/s, m, m/s].
        seen: (N,) the object was in the scan; without it the filter predicts only.
        std: (4,) standard deviations of ``z``; R = std².
        noise: process noise.

    Returns:
        Means (N, 4) and covariances (N, 4, 4) after each scan; started by the first measurement
        with covariance R.
    """
    f = KalmanFilter(dim_x=4, dim_z=4)
    f.H = np.eye(4)
    f.R = np.diag(np.square(std))
    f.x, f.P = z[0].copy(), f.R.copy()
    x, cov = np.empty((len(z), 4)), np.empty((len(z), 4, 4))
    x[0], cov[0] = f.x, f.P
    for k in range(1, len(z)):
        f.F, f.Q = white_noise_acceleration((t_ns[k] - t_ns[k - 1]) * 1e-9, noise)
        f.predict()
        if seen[k]:
            f.update(z[k])
        x[k], cov[k] = f.x, f.P
    return x, cov


_KEEP_RIGHT, _LANE_CHANGE, _KEEP_LEFT = (
    int(Manoeuvre.KEEP_RIGHT),
    int(Manoeuvre.LANE_CHANGE),
    int(Manoeuvre.KEEP_LEFT),
)
_OVERTAKING, _RECEDING = int(Manoeuvre.OVERTAKING), int(Manoeuvre.RECEDING)
_APPROACHING, _REAR_END = int(Manoeuvre.APPROACHING), int(Manoeuvre.REAR_END)


@njit(cache=True)
def _decide(x: FloatArray, said: int, kept: int, r: Rules) -> int:
    """The thresholds on one state (4,), given what is being said and the lane last kept."""
    ease = 1.0 - r.hysteresis
    if x[VX] < -r.approaching * (ease if said in (_APPROACHING, _REAR_END) else 1.0):
        return _REAR_END if x[X] <= r.rear_end_x else _APPROACHING
    e = ease if said == _OVERTAKING else 1.0
    if (
        x[Y] > r.overtaking_y * e
        and x[VX] > r.overtaking_vx * e
        and not (r.out_of_right_lane and kept == _KEEP_LEFT)
    ):
        return _OVERTAKING
    e = ease if said == _LANE_CHANGE else 1.0
    if abs(x[VY]) > r.lane_vy * e or abs(x[Y] - r.border_y) < r.lane_border * (2.0 - e):
        return _LANE_CHANGE
    if x[VX] > r.receding * (ease if said == _RECEDING else 1.0):
        return _RECEDING
    return _KEEP_LEFT if x[Y] > r.border_y else _KEEP_RIGHT


@njit(cache=True)
def apply_rules(x: FloatArray, rules: Rules) -> Int8Array:
    """What the rules say: (N,) `Manoeuvre` values for the filtered states ``x`` (N, 4)."""
    out = np.empty(len(x), np.int8)
    kept = _KEEP_LEFT if x[0, Y] > rules.border_y else _KEEP_RIGHT
    said = candidate = _decide(x[0], 0, kept, rules)
    agreeing = 0
    for k in range(len(x)):
        now = _decide(x[k], said, kept, rules)
        agreeing = agreeing + 1 if now == candidate else 1
        candidate = now
        if agreeing >= rules.dwell:
            said = now
            if said in (_KEEP_RIGHT, _KEEP_LEFT):
                kept = said
        out[k] = said
    return out
