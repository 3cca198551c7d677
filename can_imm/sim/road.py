"""The course of a road whose curvature changes linearly between knots (clothoids).

A point lies at a station s along the road's reference line [m] and d to the left of it [m].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from can_imm.types import FloatArray

_STEP = 1.0
"""Spacing of the tables [m]: between two entries a curve of 800 m leaves its chord by 0.2 mm."""


@dataclass(frozen=True, eq=False)
class Road:
    """The reference line, tabulated from ``start`` on at every metre.

    Attributes:
        start: station of the first entry [m].
        curvature: (N,) [1/m], positive to the left.
        heading: (N,) [rad]; 0 at the first entry.
        x, y: (N,) place [m]; (0, 0) at the first entry.
    """

    start: float
    curvature: FloatArray
    heading: FloatArray
    x: FloatArray
    y: FloatArray

    @classmethod
    def of(cls, station: FloatArray, curvature: FloatArray) -> Road:
        """The road with these curvatures [1/m] at these ascending stations [m]."""
        n = int(np.ceil((station[-1] - station[0]) / _STEP)) + 1
        s = station[0] + _STEP * np.arange(n)
        kappa = np.interp(s, station, curvature)
        heading = _integral(kappa)
        x, y = _integral(np.cos(heading)), _integral(np.sin(heading))
        return cls(float(station[0]), kappa, heading, x, y)

    def at(self, s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Curvature [1/m], heading [rad], x and y [m] of the reference line at stations s."""
        at = (s - self.start) / _STEP
        i = np.clip(at.astype(np.int64), 0, len(self.x) - 2)
        part = at - i

        def between(table: FloatArray) -> FloatArray:
            return np.asarray(table[i] + part * (table[i + 1] - table[i]))

        return between(self.curvature), between(self.heading), between(self.x), between(self.y)


def _integral(rate: FloatArray) -> FloatArray:
    total = np.zeros(len(rate))
    np.cumsum(0.5 * _STEP * (rate[1:] + rate[:-1]), out=total[1:])
    return total


def straight(start: float, end: float) -> Road:
    """A road without bends between two stations [m]."""
    return Road.of(np.array([start, end]), np.zeros(2))


def random_road(
    rng: np.random.Generator, start: float, end: float, min_radius: float = 1000.0
) -> Road:
    """Straight parts and bends in turn, joined by clothoids.

    Straight parts and bends are U(200, 1200) m long, clothoids U(120, 300) m; a bend's radius is
    ``min_radius`` / U(.15, 1), to either side.
    """
    station, curvature = [start], [0.0]
    kappa = 0.0
    while station[-1] < end:
        station.append(station[-1] + rng.uniform(200.0, 1200.0))
        curvature.append(kappa)
        kappa = 0.0 if kappa else rng.choice((-1.0, 1.0)) * rng.uniform(0.15, 1.0) / min_radius
        station.append(station[-1] + rng.uniform(120.0, 300.0))
        curvature.append(kappa)
    return Road.of(np.array(station), np.array(curvature))
