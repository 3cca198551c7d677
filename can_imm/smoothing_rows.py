"""Rows of one track for the smoothers, and kernels that make reports of them."""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from can_imm.reporting import conclude_
from can_imm.types import REPORT_DTYPE, VX, VY, FloatArray, IntArray, Scan, X, Y

Reports = npt.NDArray[Any]
"""Structured array of `can_imm.types.REPORT_DTYPE`."""

FIRST, COASTING = -1, 0
"""Instead of a row's steps: it began the track; it was not measured."""


ACROSS = 0.6
"""Standard deviation of a speed across the line of sight that was not measured [m/s]."""


def measurements(scan: Scan) -> tuple[FloatArray, FloatArray]:
    """What a scan measured along the vehicle's axes.

    Returns:
        (N, 4) x, vx, y, vy [m, m/s, m, m/s]; (N, 4) variances, infinite where not measured.
    """
    n = scan.n
    with np.errstate(over="ignore"):  # a row that is not used may say anything
        r = np.where(scan.valid[:n], np.square(scan.std[:n]), np.inf)
        if scan.lasting is not None:
            r[:, Y] += scan.lasting.as_white(scan.z[:n, X])
    z = np.where(scan.valid[:n], scan.z[:n], 0.0)
    for k in np.flatnonzero(scan.angle[:n]):
        cos, sin = math.cos(scan.angle[k]), math.sin(scan.angle[k])
        turn = np.array([[cos, -sin], [sin, cos]])
        z[k, [X, Y]] = turn @ z[k, [X, Y]]
        r[k, [X, Y]] = np.square(turn) @ r[k, [X, Y]]
        if not np.isfinite(r[k, VY]):
            # along the line of sight alone
            z[k, [VX, VY]] = z[k, VX] / cos, 0.0
            r[k, VX] = (r[k, VX] + (sin * ACROSS) ** 2) / cos**2
            continue
        z[k, [VX, VY]] = turn @ z[k, [VX, VY]]
        r[k, [VX, VY]] = np.square(turn) @ r[k, [VX, VY]]
    return z, r


@numba.njit(nogil=True, cache=True, error_model="numpy")
def fill_gap_(
    a: int, b: int, k: int, lam: float, tau: float, mean: FloatArray, cov: FloatArray, p: FloatArray
) -> None:  # pragma: no cover - compiled
    """Row k at the share ``lam`` of the ``tau`` seconds from row a to row b.

    Positions lie on the cubic that has both positions and both speeds, all else on a line.
    """
    n = mean.shape[1]
    for s in range(n):
        mean[k, s] = (1.0 - lam) * mean[a, s] + lam * mean[b, s]
        for t in range(n):
            cov[k, s, t] = (1.0 - lam) * cov[a, s, t] + lam * cov[b, s, t]
    for s in (X, Y):
        way = mean[b, s] - mean[a, s]
        bend = (1.0 - lam) * (tau * mean[a, s + VX] - way) + lam * (way - tau * mean[b, s + VX])
        mean[k, s] += lam * (1.0 - lam) * bend
    for j in range(p.shape[1]):
        p[k, j] = (1.0 - lam) * p[a, j] + lam * p[b, j]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def conclude_rows_(
    bank: Any,
    first: int,
    last: int,
    end: int,
    now: Any,
    steps: Any,
    width: FloatArray,
    shift: FloatArray,
    said: Any,
    mean: FloatArray,
    cov: FloatArray,
    p: FloatArray,
    out: Any,
) -> None:  # pragma: no cover - compiled
    """Reports of the rows first .. last - 1 of a track into out[0 ..].

    Args:
        bank: (1,) records.  end: number of rows; those from the measured one before ``first`` to
            the measured one after ``last`` have been smoothed.
        now, steps: (K,) number of the step, and steps since the last measurement or `COASTING`.
        width: (K,) of the lanes [m].  shift: (K,) what is to be taken off y [m].
        said: (K,) what the detector reported.
        mean, cov, p: (K, n), (K, n, n), (K, M) smoothed; those of the rows said are used up.
    """
    # who was never fast is left to `hindsight`, which knows whole paths of the speed
    reached = np.ones(2)
    for k in range(first, last):
        report = out[k - first]
        a = k
        while a > 0 and steps[a] == COASTING:
            a -= 1
        b = k
        while b < end and steps[b] == COASTING:
            b += 1
        if b == end or steps[a] == COASTING:
            out[k - first] = said[k]
            continue
        if a < b:
            lam = (now[k] - now[a]) / (now[b] - now[a])
            fill_gap_(a, b, k, lam, (now[b] - now[a]) * bank[0].step_s, mean, cov, p)
        y = mean[k, Y]
        mean[k, Y] -= shift[k]
        conclude_(bank[0], width[k], p[k], mean[k], cov[k], reached, report)
        mean[k, Y] = y
        report.t_ns = said[k].t_ns
        report.object_id = said[k].object_id
        report.age = said[k].age
        report.coasting = said[k].coasting


class Rows:
    """The last rows of one track; a row is a scan in which the track was reported.

    Attributes:
        n: number of rows in use.
        x, P, mu: filtered per mode.  Pi, steps: of the cycle that led there.
        now: number of the step.  width: of the lanes [m].
        shift: the modes' y counts from a lane that does not change its number; what is said of y is
            less by this [m].
        said: what the detector reported.
        scan: its number.
        z, r: measured x, vx, y, vy [m, m/s, m, m/s], and variances, infinite where not measured.
        mean, cov, p: results.
    """

    def __init__(self, size: int, n_modes: int, n_states: int) -> None:
        self.n = 0
        self.x: FloatArray = np.zeros((size, n_modes, n_states))
        self.P: FloatArray = np.zeros((size, n_modes, n_states, n_states))
        self.mu: FloatArray = np.zeros((size, n_modes))
        self.Pi: FloatArray = np.zeros((size, n_modes, n_modes))
        self.steps: IntArray = np.zeros(size, np.int32)
        self.now = np.zeros(size, np.int64)
        self.width: FloatArray = np.zeros(size)
        self.shift: FloatArray = np.zeros(size)
        self.said: Reports = np.zeros(size, REPORT_DTYPE)
        self.scan: npt.NDArray[np.int64] = np.zeros(size, np.int64)
        self.z: FloatArray = np.zeros((size, 4))
        self.r: FloatArray = np.zeros((size, 4))
        self.mean: FloatArray = np.zeros((size, n_states))
        self.cov: FloatArray = np.zeros((size, n_states, n_states))
        self.p: FloatArray = np.zeros((size, n_modes))

    def grow(self) -> None:
        """Twice the room."""
        for name, array in vars(self).items():
            if name != "n":
                setattr(self, name, np.concatenate((array, np.zeros_like(array))))

    def drop(self, count: int) -> None:
        """Forget the first rows."""
        for name, array in vars(self).items():
            if name != "n":
                array[: self.n - count] = array[count : self.n]
        self.n -= count

    def measured_before(self, k: int) -> int:
        """The last measured row not after row ``k``."""
        while k > 0 and self.steps[k] == COASTING:
            k -= 1
        return k
