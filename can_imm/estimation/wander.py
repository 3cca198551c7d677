"""How much a vehicle wanders in its lane, learnt while it keeps it.

`LEVELS` of it are weighed by how well each foretells where the vehicle is.  Who drives calmly is
sooner seen to leave.  What is usual is learnt from all vehicles of a drive: where the others keep
to the middle of their lanes, so will the next one.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.estimation.lane_changes import carried, correct, fading, gains, spread
from can_imm.estimation.road import (
    P_BESIDE_MARGIN,
    P_BESIDE_SPREAD,
    P_BESIDE_SPREAD_ALL,
    P_BESIDE_STD,
)
from can_imm.types import FloatArray

LEVELS = np.array([0.06, 0.1, 0.16, 0.25, 0.4, 0.6])
"""Standard deviations of places beside the middle of a lane that are told apart [m]."""
N_LEVELS = len(LEVELS)
_LOG_LEVELS = np.log(LEVELS)
_USUAL = np.arange(-4.0, 4.5)
N_USUAL = len(_USUAL)
"""So many medians of a drive's vehicles are told apart; how far the logarithm of each is from that
of the preset's one, in units of the spread from drive to drive."""
MEMORY_S = 35.0
"""So long it counts how a vehicle has wandered [s]."""
SURPRISE = 9.0
"""Squared normalised error of a measurement counts as this at most."""

WANDER_FIELDS = [
    ("kept", np.int32),
    ("learnt", np.float64),
    ("evidence", np.float64, (N_LEVELS,)),
    ("told", np.float64, (N_USUAL,)),
    ("level_cov", np.float64, (N_LEVELS, 3)),
    ("level_place", np.float64, (N_LEVELS,)),
    ("level_rate", np.float64, (N_LEVELS,)),
    ("beside", np.float64),
]
"""Of one vehicle: the lane that it has kept, `NO_LANE` while that is not sure; when it was learnt
from last [s]; log evidence for each level, and covariance (P00, P01, P11), place and rate if it
were the true one; ``told``: log evidence for each median; ``beside`` the standard deviation that
follows [m]."""
NO_LANE = -128


@numba.njit(nogil=True, cache=True, error_model="numpy")
def forget_wander_(
    one: Any, others: FloatArray, par: FloatArray
) -> None:  # pragma: no cover - compiled
    """Nothing is known of the vehicle.

    Args:
        one: record with `WANDER_FIELDS`.  par: `road.PARAMETERS`.
        others: (N_USUAL,) log evidence for each median, from other vehicles.
    """
    one.kept = NO_LANE
    one.learnt = -np.inf
    one.evidence[:] = 0.0
    weigh_levels_(one, others, par)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def weigh_levels_(
    one: Any, others: FloatArray, par: FloatArray
) -> None:  # pragma: no cover - compiled
    """Set ``beside`` by the evidence and by what vehicles are like, and ``told``."""
    median = math.log(par[P_BESIDE_STD])
    mean = total = 0.0
    most = -np.inf
    apart = np.empty(N_LEVELS)
    for k in range(N_USUAL):
        usual = median + _USUAL[k] * par[P_BESIDE_SPREAD_ALL]
        before = after = -np.inf
        for i in range(N_LEVELS):
            apart[i] = -0.5 * ((_LOG_LEVELS[i] - usual) / par[P_BESIDE_SPREAD]) ** 2
            before = max(before, apart[i])
            after = max(after, apart[i] + one.evidence[i])
        norm = likely = squares = 0.0
        for i in range(N_LEVELS):
            norm += math.exp(apart[i] - before)
            w = math.exp(apart[i] + one.evidence[i] - after)
            likely += w
            squares += w * LEVELS[i] ** 2
        one.told[k] = after - before + math.log(likely / norm)
        log_w = one.told[k] + others[k] - 0.5 * _USUAL[k] ** 2
        if log_w > most:
            fade = math.exp(most - log_w)
            total, mean, most = total * fade, mean * fade, log_w
        w = math.exp(log_w - most)
        total += w
        mean += w * squares / likely
    one.beside = par[P_BESIDE_MARGIN] * math.sqrt(mean / total)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def learn_wander_(
    one: Any,
    lane: int,
    t: float,
    off: float,
    r: float,
    off_speed: float,
    rv: float,
    road_error: float,
    hurry: float,
    others: FloatArray,
    par: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Take in a measurement of a vehicle that keeps its lane.

    Args:
        lane: the lane.  t: time of the measurement [s].
        off, off_speed: place and speed beside its middle [m, m/s].  r, rv: their variances,
            infinite where not measured.
        road_error: variance of where the middle is thought to be [m²].
        hurry: rate of the Matern process [1/s].  others: see `forget_wander_`.
    """
    begins = lane != one.kept
    one.kept = lane
    dt = t - one.learnt
    one.learnt = t
    memory = math.exp(-dt / MEMORY_S)
    most = -np.inf
    for i in range(N_LEVELS):
        beside = math.sqrt(LEVELS[i] ** 2 + road_error)
        if begins:
            P = beside**2, 0.0, (hurry * beside) ** 2
            place = rate = 0.0
        else:
            f = fading(hurry, dt)
            cov = one.level_cov[i]
            P = spread((cov[0], cov[1], cov[2]), f, hurry, beside)
            place, rate = carried(one.level_place[i], one.level_rate[i], f)
        P, of_place, of_speed = gains(P, r, rv)
        one.level_cov[i, 0], one.level_cov[i, 1], one.level_cov[i, 2] = P
        one.level_place[i], one.level_rate[i], lost = correct(
            place, rate, off, off_speed, of_place, of_speed, SURPRISE
        )
        lost += math.log(of_place[0]) + math.log(of_speed[0])
        one.evidence[i] = memory * one.evidence[i] - 0.5 * lost
        most = max(most, one.evidence[i])
    for i in range(N_LEVELS):
        one.evidence[i] -= most
    weigh_levels_(one, others, par)
