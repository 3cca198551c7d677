"""What the preset motorway has to beat: one Kalman filter per track, and thresholds on its state.

The constants were found by ``can-imm study tune-motorway-rules``, on seeds below 1000, for every
profile by itself; for straight roads there are others, and for traffic that moves as published.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from can_imm.sim.motorway import FULL, PLAIN, PUBLISHED
from can_imm.studies.runs import Int8Array
from can_imm.types import VX, VY, BoolArray, FloatArray, IntArray, Manoeuvre, X, Y

MAX_LANE = 7


class Rules(NamedTuple):
    """Filter and thresholds.  In order: ONCOMING, STATIONARY, LANE_CHANGE, REAR_END, APPROACHING,
    RECEDING, KEEP_LANE."""

    q_along: float
    """White-noise acceleration along the road [m²/s³]."""
    q_across: float
    """White-noise acceleration across the road [m²/s³]."""
    curvature: float
    """Share of the curvature that is believed (0: a straight road)."""
    yaw_tau: float
    """Time constant of the yaw rate's low pass [s]."""
    common: float
    """Share in which the direction that all others take is put down to the ego's heading."""
    width: float
    """Of the lanes [m]."""
    lane_vy: float
    """LANE_CHANGE above this lateral speed, either way [m/s] ..."""
    lane_vy_far: float
    """... plus this, per 100 m of distance [m/s] ..."""
    lane_border: float
    """... or nearer to the border between two lanes than this [m] ..."""
    border_x: float
    """... at a distance up to this [m]."""
    lane_end: float
    """While it is being said, this share of that speed suffices."""
    lane_dwell: int
    """Frames in a row that must agree before it is said ..."""
    lane_hold: int
    """... and on its end."""
    receding: float
    """RECEDING above this vx [m/s] ..."""
    receding_end: float
    """... until below this."""
    approaching: float
    """APPROACHING below minus this vx [m/s] ..."""
    approaching_end: float
    """... until above minus this."""
    speed_dwell: int
    """Frames in a row that must agree on another one of these classes."""
    rear_end_x: float
    """REAR_END up to this gap in the ego's lane [m]."""
    stationary: float
    """STATIONARY below this speed over ground [m/s], either way."""
    oncoming: float
    """ONCOMING above this speed over ground against our direction [m/s]."""


START = Rules(
    q_along=0.15, q_across=0.3, curvature=0.75, yaw_tau=1.4, common=0.75, width=3.6,
    lane_vy=0.6, lane_vy_far=0.15, lane_border=0.4, border_x=50.0, lane_end=0.5,
    lane_dwell=4, lane_hold=4,
    receding=0.5, receding_end=0.35, approaching=0.5, approaching_end=0.35, speed_dwell=1,
    rear_end_x=10.0, stationary=3.0, oncoming=3.0,
)  # fmt: skip
"""Where the search for the others began."""

RULES: dict[str, Rules] = {
    "can_imm": Rules(
        q_along=0.104, q_across=0.328, curvature=0.75, yaw_tau=1.59, common=0.75, width=3.7,
        lane_vy=0.747, lane_vy_far=0.233, lane_border=0.141, border_x=98.6, lane_end=0.528,
        lane_dwell=4, lane_hold=4,
        receding=0.391, receding_end=0.421, approaching=0.457, approaching_end=0.446, speed_dwell=1,
        rear_end_x=9.97, stationary=3.0, oncoming=3.0,
    ),
    "ars408": Rules(
        q_along=0.118, q_across=0.52, curvature=0.75, yaw_tau=1.35, common=0.75, width=3.8,
        lane_vy=0.849, lane_vy_far=0.333, lane_border=0.0897, border_x=10.4, lane_end=0.206,
        lane_dwell=2, lane_hold=2,
        receding=0.391, receding_end=0.401, approaching=0.396, approaching_end=0.387, speed_dwell=1,
        rear_end_x=9.97, stationary=3.0, oncoming=3.0,
    ),
    "toyota": Rules(
        q_along=0.115, q_across=0.191, curvature=0.0, yaw_tau=1.75, common=0.5, width=3.7,
        lane_vy=0.934, lane_vy_far=0.944, lane_border=0.454, border_x=10.4, lane_end=0.341,
        lane_dwell=8, lane_hold=1,
        receding=0.287, receding_end=0.306, approaching=0.422, approaching_end=0.355, speed_dwell=1,
        rear_end_x=9.97, stationary=3.0, oncoming=3.0,
    ),
    "esr": Rules(
        q_along=0.268, q_across=0.0679, curvature=0.0, yaw_tau=2.63, common=0.75, width=3.5,
        lane_vy=0.415, lane_vy_far=0.915, lane_border=0.0266, border_x=35.1, lane_end=1.04,
        lane_dwell=2, lane_hold=1,
        receding=0.344, receding_end=0.157, approaching=0.371, approaching_end=0.308, speed_dwell=1,
        rear_end_x=9.97, stationary=3.0, oncoming=3.0,
    ),
}  # fmt: skip
"""By profile, for all roads."""
RULES["toyota-tss2"] = RULES["toyota"]
PLAIN_RULES: dict[str, Rules] = {
    "can_imm": Rules(
        q_along=0.157, q_across=0.264, curvature=0.0, yaw_tau=1.75, common=0.25, width=3.5,
        lane_vy=0.622, lane_vy_far=0.0829, lane_border=0.202, border_x=78.9, lane_end=0.731,
        lane_dwell=2, lane_hold=4,
        receding=0.448, receding_end=0.401, approaching=0.457, approaching_end=0.355, speed_dwell=1,
        rear_end_x=9.97, stationary=3.0, oncoming=3.0,
    ),
    "ars408": Rules(
        q_along=0.114, q_across=0.43, curvature=0.0, yaw_tau=1.75, common=0.5, width=3.6,
        lane_vy=0.622, lane_vy_far=0.0553, lane_border=0.202, border_x=118.0, lane_end=0.528,
        lane_dwell=2, lane_hold=4,
        receding=0.444, receding_end=0.421, approaching=0.402, approaching_end=0.424, speed_dwell=1,
        rear_end_x=9.97, stationary=3.0, oncoming=3.0,
    ),
    "toyota": Rules(
        q_along=0.739, q_across=0.0821, curvature=0.0, yaw_tau=1.08, common=0.5, width=3.6,
        lane_vy=0.744, lane_vy_far=0.647, lane_border=0.293, border_x=108.0, lane_end=0.478,
        lane_dwell=8, lane_hold=1,
        receding=0.261, receding_end=0.2, approaching=0.251, approaching_end=0.163, speed_dwell=2,
        rear_end_x=9.84, stationary=3.0, oncoming=3.0,
    ),
    "esr": Rules(
        q_along=0.694, q_across=0.201, curvature=0.0, yaw_tau=1.75, common=0.75, width=3.5,
        lane_vy=0.622, lane_vy_far=0.079, lane_border=0.378, border_x=36.8, lane_end=1.04,
        lane_dwell=2, lane_hold=2,
        receding=0.391, receding_end=0.188, approaching=0.422, approaching_end=0.126, speed_dwell=1,
        rear_end_x=9.97, stationary=3.0, oncoming=3.0,
    ),
}  # fmt: skip
"""By profile, for straight roads and a constant speed of the ego."""
PLAIN_RULES["toyota-tss2"] = PLAIN_RULES["toyota"]


PUBLISHED_RULES: dict[str, Rules] = {
    "can_imm": Rules(
        q_along=0.171, q_across=0.742, curvature=0.0, yaw_tau=2.1, common=0.0, width=3.5,
        lane_vy=0.66, lane_vy_far=0.0485, lane_border=0.6, border_x=50.0, lane_end=0.682,
        lane_dwell=1, lane_hold=1,
        receding=0.476, receding_end=0.35, approaching=0.5, approaching_end=0.334, speed_dwell=1,
        rear_end_x=10.0, stationary=3.0, oncoming=3.0,
    ),
    "ars408": Rules(
        q_along=0.229, q_across=0.458, curvature=0.0, yaw_tau=1.08, common=0.0, width=3.6,
        lane_vy=0.546, lane_vy_far=0.0543, lane_border=1.15, border_x=243.0, lane_end=1.08,
        lane_dwell=1, lane_hold=1,
        receding=0.538, receding_end=0.305, approaching=0.514, approaching_end=0.32, speed_dwell=1,
        rear_end_x=9.84, stationary=3.0, oncoming=3.0,
    ),
    "toyota": Rules(
        q_along=0.279, q_across=0.363, curvature=0.0, yaw_tau=1.4, common=0.25, width=3.6,
        lane_vy=0.9, lane_vy_far=0.797, lane_border=0.9, border_x=112.0, lane_end=0.649,
        lane_dwell=6, lane_hold=1,
        receding=0.333, receding_end=0.156, approaching=0.303, approaching_end=0.156, speed_dwell=1,
        rear_end_x=10.0, stationary=3.0, oncoming=3.0,
    ),
    "esr": Rules(
        q_along=0.353, q_across=0.806, curvature=0.0, yaw_tau=2.63, common=0.0, width=3.6,
        lane_vy=0.622, lane_vy_far=0.304, lane_border=0.936, border_x=266.0, lane_end=1.04,
        lane_dwell=2, lane_hold=1,
        receding=0.372, receding_end=0.17, approaching=0.442, approaching_end=0.143, speed_dwell=1,
        rear_end_x=9.97, stationary=3.0, oncoming=3.0,
    ),
}  # fmt: skip
"""By profile, for traffic that moves as in the published scenario."""
PUBLISHED_RULES["toyota-tss2"] = PUBLISHED_RULES["toyota"]
_BY_KIND = {FULL: RULES, PLAIN: PLAIN_RULES, PUBLISHED: PUBLISHED_RULES}


def rules_for(profile: str, kind: str) -> Rules:
    """The constants for a profile's radar and a kind of traffic (`sim.motorway.KINDS`)."""
    return _BY_KIND[kind].get(profile, START)


_KEEP, _CHANGE = int(Manoeuvre.KEEP_LANE), int(Manoeuvre.LANE_CHANGE)
_RECEDING, _APPROACHING = int(Manoeuvre.RECEDING), int(Manoeuvre.APPROACHING)
_REAR_END = int(Manoeuvre.REAR_END)
_STATIONARY, _ONCOMING = int(Manoeuvre.STATIONARY), int(Manoeuvre.ONCOMING)


@njit(cache=True)
def _changing(x: FloatArray, lane: float, said: int, r: Rules) -> int:
    """Direction of a lane change, 0 for none, given what is being said."""
    limit = r.lane_vy + r.lane_vy_far * x[X] / 100.0
    if said:
        limit *= r.lane_end
    border = (0.5 - abs(x[Y] / r.width - lane)) * r.width
    if abs(x[VY]) > limit or (border < r.lane_border and x[X] <= r.border_x):
        return 1 if x[VY] > 0.0 else -1
    return 0


@njit(cache=True)
def _relation(vx: float, said: int, r: Rules) -> int:
    """RECEDING, APPROACHING or KEEP_LANE, given what is being said."""
    if vx > (r.receding_end if said == _RECEDING else r.receding):
        return _RECEDING
    if vx < -(r.approaching_end if said == _APPROACHING else r.approaching):
        return _APPROACHING
    return _KEEP


@njit(cache=True)
def judge(
    ids: IntArray, speed: FloatArray, x: FloatArray, begins: BoolArray, r: Rules
) -> tuple[Int8Array, Int8Array, Int8Array]:
    """What the thresholds say: `Manoeuvre` values, directions and lanes, (F,) each.

    Args:
        ids, speed, x, begins: (F,), (F,), (F, 4), (F,) as in `Frames` and from `follow`.
    """
    n = len(x)
    said, directions, lanes = np.empty(n, np.int8), np.zeros(n, np.int8), np.empty(n, np.int8)
    slots = ids.max() + 1 if n else 0
    relation, other = np.zeros(slots, np.int64), np.zeros(slots, np.int64)
    agreeing = np.zeros(slots, np.int64)
    change, moving = np.zeros(slots, np.int64), np.zeros(slots, np.int64)
    for k in range(n):
        i = ids[k]
        lane = float(np.rint(x[k, Y] / r.width))
        lanes[k] = int(min(max(lane, -MAX_LANE), MAX_LANE))
        now = _relation(x[k, VX], relation[i], r)
        if begins[k]:
            relation[i], other[i], agreeing[i] = now, now, 0
            change[i] = moving[i] = 0
        agreeing[i] = agreeing[i] + 1 if now == other[i] else 1
        other[i] = now
        if agreeing[i] >= r.speed_dwell:
            relation[i] = now
        now = _changing(x[k], lane, change[i], r)
        # frames that speak against what is being said
        moving[i] = moving[i] + 1 if (now != 0) != (change[i] != 0) else 0
        if change[i] and now:
            change[i] = now
        elif moving[i] >= (r.lane_hold if change[i] else r.lane_dwell):
            change[i], moving[i] = now, 0
        ground = speed[k] + x[k, VX]
        if ground < -r.oncoming:
            said[k] = _ONCOMING
        elif abs(ground) < r.stationary:
            said[k] = _STATIONARY
        elif change[i]:
            said[k], directions[k] = _CHANGE, change[i]
        elif relation[i] == _APPROACHING and lane == 0.0 and x[k, X] <= r.rear_end_x:
            said[k] = _REAR_END
        else:
            said[k] = relation[i]
    return said, directions, lanes
