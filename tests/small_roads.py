"""Parameters of the road filter, a mode bank and a stream of traffic for its tests."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np

from can_imm.estimation import layout, road
from can_imm.road import RoadFrame
from can_imm.types import FloatArray, LastingErrors, Scan

KEEP, LEFT, STILL = 0, 1, 2
"""Modes of `small_bank`."""

USUAL = {
    "width": 3.5, "width_std": 0.25, "offset": 0.0, "offset_std": 0.3, "offset_time": 8.0,
    "heading_std": 0.01, "heading_time": 2.0, "turn_std": 0.01, "turn_time": 1.0,
    "curvature_std": 0.001, "curvature_length": 1000.0, "bias_std": 0.005, "mounting_std": 0.003,
    "yaw_noise": 0.001, "yaw_noise_unknown": 0.01, "drift": 0.05,
    "error_weight": 3.0, "error_most": 0.5, "speed_error_weight": 10.0, "speed_error_most": 2.0,
    "beside_std": 0.25, "beside_spread": 0.5, "beside_spread_all": 0.0,
    "beside_margin": 1.0, "beside_rate": 0.5, "change_rate": 0.03, "change_steady": 0.1,
    "settle": 1.0, "false_change": 0.5,
}  # fmt: skip


def parameters(**changes: float) -> FloatArray:
    """`road.PARAMETERS` with some changed."""
    values = {**USUAL, **changes}
    return np.array([values[name] for name in road.PARAMETERS])


def nothing_but_motion() -> FloatArray:
    """A road and a driver that nothing is known of, and no noise: predicting is F x and F P F'."""
    loose = dict.fromkeys(("offset_std", "heading_std", "turn_std"), 1e9)
    silent = dict.fromkeys(("yaw_noise", "yaw_noise_unknown", "drift", "bias_std"), 0.0)
    return parameters(**loose, curvature_length=1e15, **silent)


def small_bank() -> np.ndarray[Any, Any]:
    """Modes that keep a lane, change it to the left, and stand still."""
    bank = np.zeros(1, layout.BANK_DTYPE)
    bank[0]["n_modes"] = 3
    bank[0]["direction"][LEFT] = 1
    bank[0]["off_lane"][STILL] = 1
    return bank


class Traffic:
    """The axes of the road amid a detector's buffers: one call per scan of vehicles."""

    def __init__(self, par: FloatArray, capacity: int = 32) -> None:
        self.frame = RoadFrame(par)
        self.bank: Any = SimpleNamespace(record=small_bank())
        self.objects = np.zeros(capacity, layout.OBJECT_DTYPE)
        self.objects["mu"][:, KEEP] = 1.0
        self.age = np.zeros(capacity, np.int32)
        self.t_ns = 0

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
        speeds: bool = True,
        lasting: LastingErrors | None = None,
    ) -> int:
        """Vehicles at xy (n, 2) in the vehicle's axes, measured in axes turned by ``angle``.

        ``speeds``: the lateral ones are measured, too.
        """
        n = len(slots)
        xy = np.asarray(xy, float).reshape(n, 2)
        scan = Scan(n)
        scan.n, scan.std[:], scan.angle[:], scan.valid[:] = n, std, angle, True
        scan.valid[:, 3] = speeds
        scan.lasting = lasting
        scan.z[:, 0] = xy[:, 0] * math.cos(angle) + xy[:, 1] * math.sin(angle)
        scan.z[:, 2] = xy[:, 1] * math.cos(angle) - xy[:, 0] * math.sin(angle)
        self.t_ns += round(dt * 1e9)
        scan.t_ns = self.t_ns
        self.frame.move(self.t_ns, speed, yaw_rate)
        for s in slots:
            self.age[s] += 1
        return self.frame.watch_(
            self.bank, self.objects, scan, np.array(slots, np.int32),
            np.full(n, status, np.int8), self.age,
        )  # fmt: skip

    def nothing(self, **motion: float) -> None:
        """A scan without vehicles."""
        self.scan([], np.zeros((0, 2)), **motion)

    @property
    def filter(self) -> Any:
        """The record of `traffic.TRAFFIC_DTYPE`."""
        return self.frame._traffic

    @property
    def guide_of(self) -> Any:
        """(capacity,) party of each slot."""
        return self.frame._guide_of

    def changing(self, slot: int) -> FloatArray:
        """How probable it is that the vehicle in a slot changes to the left, to the right."""
        return self.frame.changing(self.t_ns * 1e-9)[slot]

    @property
    def offset(self) -> float:
        return float(self.frame.x[road.OFFSET])

    @property
    def width(self) -> float:
        return self.frame.width
