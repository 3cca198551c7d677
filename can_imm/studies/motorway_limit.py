"""How soon lane changes can be noticed at all, by whatever detector.

Take somebody who knows everything but whether a lane change happens: when it would begin, its
course, the middle of the lane, the road, where the ego and the vehicle are along it, and the
covariances of the radar's errors and of the vehicle's wander.  What has been measured until d after
the beginning then is Gaussian with one mean if the lane is kept and another one if it is changed.
With K(d) the Kullback-Leibler divergence between the two, no test that is wrong with a probability
of a where the lane is kept is right with more than

    b(d) = Phi(sqrt(2 K(d)) - Phi^-1(1 - a))

where it is changed (J. Neyman, E. S. Pearson, "On the problem of the most efficient tests of
statistical hypotheses", Phil. Trans. R. Soc. A 231, 1933).  A detector that makes up `PER_HOUR`
lane changes per hour that a vehicle keeps its lane, of `LASTING` each, says one within d of any
given time with a probability of a = (d + `LASTING`) `PER_HOUR` / 3600 s at most.  So it says a true
one within d with b(d) at most, and its mean delay is at least the integral of 1 - b.

The limit is not reached: no detector knows all that.  What is simpler here than in the simulation
lets it come out lower, not higher (no quantisation), but for the wander: its sines of random
periods are taken for a Gaussian process with their covariance.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.stats import norm

from can_imm.sim.motorway import LaneChange, MotorwaySettings
from can_imm.sim.radar import RadarModel
from can_imm.studies.motorway_metrics import lane_changes
from can_imm.studies.motorway_runs import MotorwayRun
from can_imm.studies.runs import Int64Array
from can_imm.types import FloatArray, X, Y

PER_HOUR, LASTING = 1.0, 2.0
"""False lane changes per object-hour that are allowed, and how long each is said on average [s]."""
BEFORE = 10.0
"""What was measured so long before a lane change tells of the wander and of lasting errors [s]."""
_PERIODS = 64
"""Points of the integral over the wander's periods."""
_UNKNOWN = 1e4
"""Standard deviation of what is not measured [m/s]."""


def least_delays(
    run: MotorwayRun, radar: RadarModel, settings: MotorwaySettings
) -> tuple[float, ...]:
    """Least mean delay [s] of each lane change whose beginning a track saw, track by track.

    Args:
        radar: the one that measured the run.
        settings: those from which its traffic was drawn.
    """
    return tuple(
        _least_delay(run, track[:end], begin, radar, settings)
        for track in run.tracks
        if not run.second[track[0]]
        for begin, end in lane_changes(run, track)
        if begin > 0
    )


def _least_delay(
    run: MotorwayRun, track: Int64Array, begin: int, radar: RadarModel, settings: MotorwaySettings
) -> float:
    """Of the lane change that begins with frame ``begin`` of a track and ends with its last one."""
    driver = run.truth.objects[int(run.object[track[0]])].driver
    t: FloatArray = run.t_ns[track].astype(np.float64) * 1e-9
    *earlier, change = (c for c in driver.changes if c.start <= t[begin] + 1e-6)
    since = max([t[begin] - BEFORE, *(c.start + c.time for c in earlier)])
    first = int(np.searchsorted(t, since))
    t, begin, place = t[first:], begin - first, run.state[track[first:]]
    amplitude = driver.wander[:, 0]
    covariance = error_covariance(t, place[:, X], place[:, Y], radar, settings.noise)
    covariance += wander_covariance(t, float(amplitude @ amplitude) / 2.0, settings.wander_time)
    until = t[begin:] - t[begin]
    found = most_found(divergence(course(change, t), covariance)[begin:], until)
    return float((1.0 - found[:-1]) @ np.diff(until))


def course(change: LaneChange, t: FloatArray) -> FloatArray:
    """(2 N,) what a lane change adds to y and vy at times t (N,) [s], in turn [m, m/s]."""
    done, rate = change.along(np.clip((t - change.start) / change.time, 0.0, 1.0))
    return change.shift * np.column_stack([done, rate]).ravel()


def divergence(shift: FloatArray, covariance: FloatArray) -> FloatArray:
    """Kullback-Leibler divergence (N,) of what is measured until each of N times.

    Args:
        shift: (2 N,) difference of the means, y and vy in turn.
        covariance: (2 N, 2 N) common to both.
    """
    white = solve_triangular(cholesky(covariance, lower=True), shift, lower=True)
    return np.asarray(0.5 * np.cumsum(white**2)[1::2])


def most_found(kl: FloatArray, until: FloatArray) -> FloatArray:
    """(N,) highest probability that a lane change is said not later than ``until`` [s] after its
    beginning; ``kl`` (N,) see `divergence`."""
    false = (until + LASTING) * PER_HOUR / 3600.0
    return np.asarray(norm.cdf(np.sqrt(2.0 * kl) - norm.isf(false)))


def error_covariance(
    t: FloatArray, x: FloatArray, y: FloatArray, radar: RadarModel, noise: float
) -> FloatArray:
    """(2 N, 2 N) of a radar's errors of y and vy, in turn, of an object at x, y (N,) [m].

    Args:
        t: (N,) [s].
        noise: factor on all standard deviations, see `MotorwaySettings`.
    """
    if radar.polar:
        # whoever knows x and vx reads y from bearing and range, and vy from the range rate
        r = np.hypot(x, y)
        across = np.maximum(np.abs(y) / r, 1e-9)
        white_y = 1.0 / np.hypot(1.0 / (radar.std[2] * r), across / radar.std[0])
        white_vy = np.minimum(radar.std[1] / across, _UNKNOWN)
    else:
        white_y = np.full(len(t), radar.std[2])
        white_vy = np.nan_to_num(np.full(len(t), radar.std[3]), nan=_UNKNOWN)
    out = np.diag(np.column_stack([white_y, white_vy]).ravel() ** 2)
    stay = np.exp(-np.abs(t[:, None] - t) / radar.wander_time)
    out[::2, ::2] += stay * (radar.wander[1] ** 2 + radar.bearing**2 * np.outer(x, x))
    return noise**2 * out


def wander_covariance(t: FloatArray, variance: float, periods: tuple[float, float]) -> FloatArray:
    """(2 N, 2 N) of the wander of y and of its rate, in turn, at times t (N,) [s].

    Args:
        variance: of the wander [m²].
        periods: of its oscillations, which are uniformly distributed between these two [s].
    """
    ages = t[:, None] - t
    out = np.zeros((2 * len(t), 2 * len(t)))
    share = (np.arange(_PERIODS) + 0.5) / _PERIODS
    for period in periods[0] + (periods[1] - periods[0]) * share:
        omega = 2.0 * math.pi / period
        cos, sin = np.cos(omega * ages), omega * np.sin(omega * ages)
        out[::2, ::2] += cos
        out[::2, 1::2] += sin
        out[1::2, ::2] -= sin
        out[1::2, 1::2] += omega**2 * cos
    return out * (variance / _PERIODS)
