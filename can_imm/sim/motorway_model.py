"""A motorway and the courses of those on it.

The road (`can_imm.sim.road`) has lanes whose centre lines lie at d = 0, w, 2 w, ... from the right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from can_imm.sim.road import Road
from can_imm.types import FloatArray

BEHIND, AHEAD = -30.0, 260.0
"""An object's truth begins and ends where its x along the road passes these [m]."""

Int8Array = npt.NDArray[np.int8]
Int64Array = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class LaneChange:
    """A lateral movement by ``shift`` [m] from ``start`` on [s] in ``time`` [s].

    Its course is ``mix`` times a quintic polynomial plus 1 - ``mix`` times half a cosine wave, or
    if it is ``steady`` a straight line.
    """

    start: float
    time: float
    shift: float
    mix: float
    steady: bool = False

    def along(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Share of the way that is done, and its rate [1/s], at shares u of the time."""
        if self.steady:
            return u, ((u > 0.0) & (u < 1.0)) / self.time
        quintic = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
        cosine = 0.5 - 0.5 * np.cos(np.pi * u)
        done = self.mix * quintic + (1.0 - self.mix) * cosine
        quintic = 30.0 * (u * (1.0 - u)) ** 2
        cosine = 0.5 * np.pi * np.sin(np.pi * u)
        return done, (self.mix * quintic + (1.0 - self.mix) * cosine) / self.time


@dataclass(frozen=True, eq=False)
class Driver:
    """The course of one vehicle (or thing at the roadside), from ``start`` to ``end`` [s].

    Attributes:
        pieces: (P, 4) rows t, s, v, a: from time t [s] on the station of the vehicle's rear is
            s + v τ + a τ²/2 [m], τ the time since t.
        d: lateral position at the beginning, without wander [m].
        changes: in order of time.
        wander: (W, 3) amplitude [m], angular frequency [rad/s] and phase [rad] of oscillations.
        length: [m].
    """

    id: int
    start: float
    end: float
    pieces: FloatArray
    d: float
    changes: tuple[LaneChange, ...]
    wander: FloatArray
    length: float

    def along(self, t: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Station [m], speed along the road [m/s] and its rate [m/s²] at times t [s]."""
        # the tolerance lets a sample at a piece's own time see that piece in spite of rounding
        i = np.searchsorted(self.pieces[:, 0], t + 1e-9, side="right") - 1
        since = t - self.pieces[i, 0]
        _, s, v, a = self.pieces[i].T
        return s + (v + 0.5 * a * since) * since, v + a * since, a

    def across(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Lateral position d [m] and its rate [m/s] at times t [s]."""
        amplitude, omega, phase = self.wander.T[:, :, None]
        angle = omega * t + phase
        d = self.d + (amplitude * np.sin(angle)).sum(axis=0)
        rate = (amplitude * omega * np.cos(angle)).sum(axis=0)
        for change in self.changes:
            done, pace = change.along(np.clip((t - change.start) / change.time, 0.0, 1.0))
            d += change.shift * done
            rate += change.shift * pace
        return d, rate

    def changing(self, t: FloatArray) -> Int8Array:
        """Direction of the lane change at times t [s]: +1 left, -1 right, 0 none."""
        direction = np.zeros(len(t), np.int8)
        for change in self.changes:
            during = (t >= change.start - 1e-9) & (t < change.start + change.time - 1e-9)
            direction[during] = 1 if change.shift > 0 else -1
        return direction


@dataclass(frozen=True, eq=False)
class MotorwayScenario:
    """A road, the ego and all the others; ``drivers`` are those with labels of traffic,
    ``oncoming`` and ``roadside`` are what the names say, ``noise`` is the settings' factor."""

    duration: float
    n_lanes: int
    lane_width: float
    road: Road
    ego: Driver
    drivers: tuple[Driver, ...]
    oncoming: tuple[Driver, ...]
    roadside: tuple[Driver, ...]
    noise: float = 1.0
