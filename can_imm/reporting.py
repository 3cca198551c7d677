"""Kernels that turn estimator states into reports."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.estimation.constraints import interval_probability, normal_mass
from can_imm.estimation.imm import extrapolate_
from can_imm.estimation.road import place
from can_imm.types import FloatArray, Manoeuvre

_LANE_CHANGE = int(Manoeuvre.LANE_CHANGE)
_APPROACHING = int(Manoeuvre.APPROACHING)
_REAR_END = int(Manoeuvre.REAR_END)
_RECEDING = int(Manoeuvre.RECEDING)
_KEEP_LANE = int(Manoeuvre.KEEP_LANE)
_STATIONARY = int(Manoeuvre.STATIONARY)
_ONCOMING = int(Manoeuvre.ONCOMING)

STEADY = 0.6
"""Up to this relative speed [m/s] an object is about as fast as the ego."""


RAMP_ODDS, RAMP_SPEED, RAMP_RATE, RAMP_MOST = -8.15, 7.4, 17.0, 0.5
"""Log odds that a vehicle said to keep its lane has begun to approach or recede because the ego
speeds up or slows down: bias, factors of the speed [s/m] and of the ego's acceleration [s²/m],
which counts up to the last value [m/s²].  Fitted on simulated traffic (settings "tuning")."""

LEAST = 1e-4
"""Where less is left for all that is no lane change, the speed tells what it would be."""


@numba.njit(nogil=True, cache=True, error_model="numpy")
def decide_(report: Any) -> int:
    """Set the most and the second most probable manoeuvre of a report; returns the first."""
    best = 1
    for i in range(2, report.p.shape[0]):
        if report.p[i] > report.p[best]:
            best = i
    second = 1 if best != 1 else 2
    for i in range(1, report.p.shape[0]):
        if i != best and report.p[i] > report.p[second]:
            second = i
    report.manoeuvre = best
    report.second = second
    report.probability = report.p[best]
    report.second_probability = report.p[second]
    return best


@numba.njit(nogil=True, cache=True, error_model="numpy")
def rear_end_share(gap: float, width: float, x: float, y: float, cov: FloatArray) -> float:
    """Probability that an object at x, y [m] is no further away than a gap, in the ego's lane.

    Args:
        gap, width: of the lane [m].  cov: (n, n) of the state.
    """
    sx = math.sqrt(cov[0, 0])
    sy = math.sqrt(cov[2, 2])
    return math.exp(
        normal_mass(-np.inf, (gap - x) / sx)
        + normal_mass((-0.5 * width - y) / sy, (0.5 * width - y) / sy)
    )


@numba.njit(nogil=True, cache=True, error_model="numpy")
def withhold_(
    bank: Any, mu: FloatArray, vx: float, variance: float, reached: FloatArray, p: FloatArray
) -> None:
    """Who holds a speed that never reached the bank's peak keeps its lane instead; in place.

    How far that is held against it depends on how sure it is that the speed is held.

    Args:
        mu: (M,).  vx, variance: relative speed [m/s].  reached: as in `layout.OBJECT_DTYPE`.
        p: (12,) of the manoeuvres, sums over modes.
    """
    for side in range(2):
        manoeuvre = _RECEDING if side == 0 else _APPROACHING
        held = 0.0
        for j in range(bank.n_modes):
            if bank.is_steady[j] and bank.manoeuvre[j] == manoeuvre:
                held += mu[j]
        if held <= 0.0:
            continue
        speed = vx if side == 0 else -vx
        slow = interval_probability(speed, variance, -np.inf, bank.peak_speed)
        share = held * held / p[manoeuvre] * slow * (1.0 - reached[side])
        p[manoeuvre] -= share
        p[_KEEP_LANE] += share


@numba.njit(nogil=True, cache=True, error_model="numpy")
def conclude_(
    bank: Any,
    width: float,
    mu: FloatArray,
    mean: FloatArray,
    cov: FloatArray,
    reached: FloatArray,
    report: Any,
) -> None:
    """Fill one report from mode probabilities and the combined estimate.

    A manoeuvre's probability is the sum over its modes; the direction of a lane change is that of
    its likelier modes; the lane is the nearest one.  Where APPROACHING turns into REAR_END by the
    gap, its probability is shared out by how likely the object is to be that near, and in the
    ego's lane.

    Args:
        bank: record of `layout.BANK_DTYPE`.  width: of the object's lanes [m].
        mu: (M,).  mean: (n,).  cov: (n, n).  reached: (2,) as in `layout.OBJECT_DTYPE`.
    """
    for i in range(report.p.shape[0]):
        report.p[i] = 0.0
    turn = 0.0
    for j in range(bank.n_modes):
        report.p[bank.manoeuvre[j]] += mu[j]
        turn += mu[j] * bank.direction[j]
    if bank.peak_speed > 0.0:
        withhold_(bank, mu, mean[1], cov[1, 1], reached, report.p)
    if bank.rear_end_gap > 0.0:
        near = rear_end_share(bank.rear_end_gap, width, mean[0], mean[2], cov)
        report.p[_REAR_END] += near * report.p[_APPROACHING]
        report.p[_APPROACHING] *= 1.0 - near
    best = decide_(report)
    report.flags = 0
    report.duplicate_of = -1
    report.ego_speed = np.nan
    report.change[:] = np.nan
    report.direction = 0
    if best == _LANE_CHANGE:
        report.direction = 1 if turn > 0.0 else -1
        if turn == 0.0:
            report.direction = 1 if mean[3] >= 0.0 else -1
    report.lane = 1 if mean[2] > 0.5 * width else 0
    if bank.relative_lanes:
        report.lane = min(max(math.floor(mean[2] / width + 0.5), -100), 100)
    for s in range(4):
        report.x[s] = mean[s]
        for t in range(4):
            report.cov[s, t] = cov[s, t]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def fill_reports_(
    objects: Any, ids: Any, age: Any, measured: Any, bank: Any, t_ns: int, reports: Any
) -> int:
    """Reports of all slots in use, in slot order; returns their number.

    Args:
        objects: (capacity,) records.  ids: (capacity,) int32, -1 for a free slot.
        age: (capacity,) int32.  measured: (capacity,) bool.  bank: (1,) records.
        reports: (capacity,) of `REPORT_DTYPE`, written.
    """
    n = 0
    for s in range(ids.shape[0]):
        if ids[s] < 0:
            continue
        report = reports[n]
        obj = objects[s]
        report.t_ns = t_ns
        report.object_id = ids[s]
        report.age = age[s]
        report.coasting = not measured[s]
        conclude_(bank[0], obj.lane_width, obj.mu, obj.mean, obj.cov, obj.reached, report)
        n += 1
    return n


@numba.njit(nogil=True, cache=True, error_model="numpy")
def extrapolate_all_(
    objects: Any,
    ids: Any,
    age: Any,
    updated: Any,
    spared: Any,
    bank: Any,
    work: Any,
    t_ns: int,
    now: int,
    reports: Any,
) -> int:
    """Like `fill_reports_`, but every object moved on to step ``now``.

    Args:
        updated: (capacity,) int64, step of the last measurement.
        spared: (capacity,) bool, slots whose reports are left as they are.
    """
    n = 0
    longest = bank[0].Pi.shape[0] - 1
    for s in range(ids.shape[0]):
        if ids[s] < 0:
            continue
        report = reports[n]
        n += 1
        if spared[s]:
            continue
        w = work[0]
        steps = min(max(now - updated[s], 0), longest)
        extrapolate_(bank[0], objects[s], steps, w.tx, w.tP, w.w, w)
        report.t_ns = t_ns
        report.object_id = ids[s]
        report.age = age[s]
        report.coasting = True
        conclude_(bank[0], objects[s].lane_width, w.w, w.tx, w.tP, objects[s].reached, report)
    return n


@numba.njit(nogil=True, cache=True, error_model="numpy")
def globalise_(road: FloatArray, h: FloatArray, reports: Any, n: int, speed: float) -> None:
    """States of the first n reports from the road's axes into the sensor's, in place.

    Args:
        road: (N,) state of `estimation.road`.  h: (N_ROAD,) scratch.
        speed: of the ego [m/s], NaN where unknown.
    """
    for k in range(n):
        report = reports[k]
        y, vy = place(road, h, report.x[0], report.x[1], speed)
        report.x[2] += y
        report.x[3] += vy
        report.ego_speed = speed


@numba.njit(nogil=True, cache=True, error_model="numpy")
def by_speed(vx: float) -> int:
    """What an object does that changes no lanes, by its relative speed [m/s]."""
    if not abs(vx) > STEADY:
        return _KEEP_LANE
    return _RECEDING if vx > 0.0 else _APPROACHING


@numba.njit(nogil=True, cache=True, error_model="numpy")
def judge_changes_(p: FloatArray, reports: Any, n: int) -> None:
    """Say of the first n reports whether they change lanes, in place.

    The probability of what else they do stays as it is, but for the common factor.

    Args:
        p: (n, 2) probabilities of changing to the left and to the right, by
            `estimation.hypotheses`; NaN where nothing is known: there the report is left alone.
    """
    for k in range(n):
        if p[k, 0] != p[k, 0]:
            continue
        report = reports[k]
        change = p[k, 0] + p[k, 1]
        others = ours = 0.0
        for i in range(1, report.p.shape[0]):
            if i != _STATIONARY and i != _ONCOMING:
                ours += report.p[i]
                if i != _LANE_CHANGE:
                    others += report.p[i]
        if others > LEAST:
            for i in range(1, report.p.shape[0]):
                if i != _STATIONARY and i != _ONCOMING and i != _LANE_CHANGE:
                    report.p[i] *= ours * (1.0 - change) / others
        else:
            for i in range(1, report.p.shape[0]):
                if i != _STATIONARY and i != _ONCOMING:
                    report.p[i] = 0.0
            report.p[by_speed(report.x[1])] = ours * (1.0 - change)
        report.p[_LANE_CHANGE] = ours * change
        report.direction = 0
        if decide_(report) == _LANE_CHANGE:
            report.direction = 1 if p[k, 0] > p[k, 1] else -1


@numba.njit(nogil=True, cache=True, error_model="numpy")
def judge_ramps_(acceleration: float, reports: Any, n: int) -> None:
    """Say in the first n reports who approaches or recedes for the ego changes its speed, in place.

    Whoever keeps their speed meanwhile does so from the first moment on, when their speed against
    the ego's does not show it yet.

    Args:
        acceleration: of the ego [m/s²].
    """
    way = -1.0 if acceleration > 0.0 else 1.0
    to = _RECEDING if acceleration < 0.0 else _APPROACHING
    for k in range(n):
        report = reports[k]
        odds = RAMP_ODDS + RAMP_SPEED * way * report.x[1]
        odds += RAMP_RATE * min(abs(acceleration), RAMP_MOST)
        share = report.p[_KEEP_LANE] / (1.0 + math.exp(-odds))
        report.p[_KEEP_LANE] -= share
        report.p[to] += share
        if decide_(report) != _LANE_CHANGE:
            report.direction = 0
