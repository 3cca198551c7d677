"""The baseline of the Bernoulli study: an extended Kalman filter, one sensor after the other.

It is told that there is an object and takes of every sensor the detection nearest to where it
expects one, if any lies in its gate.
"""

from __future__ import annotations

import math

import numpy as np

from can_imm.estimation.bernoulli import BernoulliModel
from can_imm.types import DetectionScan, FloatArray

GATE = 16.3
"""Squared Mahalanobis distance of the gate: 99.9 % of chi-square with 3 degrees of freedom."""

_AGREE_M = 5.0
"""At the start detections within this distance [m] of each other speak of one object."""


class CooperativeEkf:
    """Constant velocity with the model's noise; range, bearing and range rate linearised.

    Attributes:
        x, P: (4,), (4, 4) of x, vx, y, vy; None before the first scan in which two sensors agree.
    """

    def __init__(self, model: BernoulliModel) -> None:
        self._model = model
        self._R = np.diag([model.std_range, model.std_bearing, model.std_rate]) ** 2
        self.x: FloatArray | None = None
        self.P: FloatArray = np.zeros((4, 4))

    def step(self, dt: float, scan: DetectionScan) -> None:
        """Predict by ``dt`` [s] and update with the scan's sensors one by one."""
        poses = [scan.pose[row] for row in range(scan.n_sensors)]
        found = [scan.z[: scan.n][scan.sensor[: scan.n] == row] for row in range(scan.n_sensors)]
        skipped = -1
        if self.x is None:
            skipped = self._begin(poses, found)
        else:
            F = np.eye(4)
            F[0, 1] = F[2, 3] = dt
            block = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
            self.x = F @ self.x
            self.P = F @ self.P @ F.T + self._model.density * np.kron(np.eye(2), block)
        if self.x is None:
            return
        for row, (pose, z) in enumerate(zip(poses, found, strict=True)):
            if row != skipped and len(z):
                self._update(pose, z)

    def _begin(self, poses: list[FloatArray], found: list[FloatArray]) -> int:
        """Start at the detection with which most other sensors agree; returns its sensor's row."""
        places = []
        for pose, z in zip(poses, found, strict=True):
            angle = pose[2] + z[:, 1]
            places.append(pose[:2] + z[:, :1] * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        best, start = 1, (-1, -1)
        for row, mine in enumerate(places):
            for k, place in enumerate(mine):
                near = [np.hypot(*(other - place).T).min(initial=np.inf) for other in places]
                votes = sum(distance < _AGREE_M for distance in near)
                if votes > best:
                    best, start = votes, (row, k)
        row, k = start
        if row < 0:
            return row
        model, pose, (r, bearing, rate) = self._model, poses[row], found[row][k]
        c, s = math.cos(pose[2] + bearing), math.sin(pose[2] + bearing)
        turn = np.array([[c, -s], [s, c]])
        place = turn @ np.diag([model.std_range, r * model.std_bearing]) ** 2 @ turn.T
        speed = turn @ np.diag([model.std_rate, model.std_tangential]) ** 2 @ turn.T
        self.P = np.zeros((4, 4))
        self.P[::2, ::2], self.P[1::2, 1::2] = place, speed
        self.x = np.array(
            [pose[0] + r * c, pose[3] + rate * c, pose[1] + r * s, pose[4] + rate * s]
        )
        return row

    def _update(self, pose: FloatArray, z: FloatArray) -> None:
        assert self.x is not None
        dx, dy = self.x[0] - pose[0], self.x[2] - pose[1]
        dvx, dvy = self.x[1] - pose[3], self.x[3] - pose[4]
        r = math.hypot(dx, dy)
        rate = (dx * dvx + dy * dvy) / r
        H = np.array([
            [dx / r, 0, dy / r, 0],
            [-dy / r**2, 0, dx / r**2, 0],
            [(dvx - rate * dx / r) / r, dx / r, (dvy - rate * dy / r) / r, dy / r],
        ])  # fmt: skip
        e = z - np.array([r, math.atan2(dy, dx) - pose[2], rate])
        e[:, 1] = np.arctan2(np.sin(e[:, 1]), np.cos(e[:, 1]))
        S = H @ self.P @ H.T + self._R
        distance = np.einsum("ni,ij,nj->n", e, np.linalg.inv(S), e)
        nearest = int(np.argmin(distance))
        if distance[nearest] < GATE:
            K = self.P @ H.T @ np.linalg.inv(S)
            self.x = self.x + K @ e[nearest]
            A = np.eye(4) - K @ H
            self.P = A @ self.P @ A.T + K @ self._R @ K.T
