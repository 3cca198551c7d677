"""Parameters of the road filter, a mode bank and a stream of traffic for its tests."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from can_imm.estimation import guides, layout, road
from can_imm.types import FloatArray

KEEP, LEFT, STILL = 0, 1, 2
"""Modes of `small_bank`."""

USUAL = {
    "width": 3.5, "width_std": 0.25, "offset": 0.0, "offset_std": 0.3, "offset_time": 8.0,
    "heading_std": 0.01, "heading_time": 2.0, "turn_std": 0.01, "turn_time": 1.0,
    "curvature_std": 0.001, "curvature_length": 1000.0, "change_std": 6e-6, "change_length": 100.0,
    "far_curvature": 3e-4, "bias_std": 0.005, "mounting_std": 0.003, "yaw_noise": 0.001,
    "yaw_noise_unknown": 0.01,
    "drift": 0.05, "wander_std": 0.2, "wander_time": 4.0, "freedom": 0.1, "freedom_changing": 1.0,
    "error_weight": 3.0, "error_most": 0.5, "speed_error_weight": 10.0, "speed_error_most": 2.0,
    "doubtful": 0.5, "unrest_change": 1e-9, "unrest_curvature": 1e-9,
}  # fmt: skip


def parameters(**changes: float) -> FloatArray:
    """`road.PARAMETERS` with some changed."""
    values = {**USUAL, **changes}
    return np.array([values[name] for name in road.PARAMETERS])


def nothing_but_motion() -> FloatArray:
    """A road and a driver that nothing is known of, and no noise: predicting is F x and F P F'."""
    loose = dict.fromkeys(("offset_std", "heading_std", "turn_std"), 1e9)
    fixed = dict.fromkeys(("curvature_length", "change_length"), 1e15)
    silent = dict.fromkeys(("yaw_noise", "yaw_noise_unknown", "drift", "bias_std"), 0.0)
    return parameters(**loose, **fixed, **silent)


def small_bank() -> np.ndarray[Any, Any]:
    """Modes that keep a lane, change it to the left, and stand still."""
    bank = np.zeros(1, layout.BANK_DTYPE)
    bank[0]["n_modes"] = 3
    bank[0]["direction"][LEFT] = 1
    bank[0]["off_lane"][STILL] = 1
    return bank


class Traffic:
    """The road filter with its buffers: one call per scan of vehicles."""

    def __init__(self, par: FloatArray, capacity: int = 32) -> None:
        self.par = par
        self.bank = small_bank()
        self.objects = np.zeros(capacity, layout.OBJECT_DTYPE)
        self.objects["mu"][:, KEEP] = 1.0
        self.age = np.zeros(capacity, np.int32)
        self.guide_slot = np.full(road.N_GUIDES, road.FREE, np.int32)
        self.guide_unseen = np.zeros(road.N_GUIDES)
        self.x, self.P = road.new_road(par)

    def scan(
        self,
        slots: Any,
        xy: Any,
        *,
        dt: float = 0.1,
        speed: float = math.nan,
        yaw_rate: float = math.nan,
        angle: float = 0.0,
        std: float = 0.1,
        status: int = 0,
    ) -> int:
        """Vehicles at xy (n, 2) in the vehicle's axes, measured in axes turned by ``angle``."""
        n = len(slots)
        xy = np.asarray(xy, float).reshape(n, 2)
        z = np.zeros((n, 4))
        z[:, 0] = xy[:, 0] * math.cos(angle) + xy[:, 1] * math.sin(angle)
        z[:, 2] = xy[:, 1] * math.cos(angle) - xy[:, 0] * math.sin(angle)
        road.predict_road_(self.x, self.P, self.par, dt, speed, yaw_rate)
        for s in slots:
            self.age[s] += 1
        return int(
            guides.watch_traffic_(
                self.x, self.P, self.par, self.guide_slot, self.guide_unseen, np.ones(1),
                self.bank, self.objects, n, np.array(slots, np.int32),
                np.full(n, status, np.int8), self.age, z, np.full((n, 4), std**2),
                np.ones((n, 4), np.bool_), np.full(n, angle), dt,
            )
        )  # fmt: skip

    @property
    def offset(self) -> float:
        return float(self.x[road.OFFSET])

    @property
    def width(self) -> float:
        return float(self.x[road.WIDTH])
