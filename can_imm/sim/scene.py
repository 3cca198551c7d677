"""What a played scene of several sensors gives: detections, and the truth beside them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from can_imm.types import DetectionScan, FloatArray


@dataclass(frozen=True)
class SceneRun:
    """Scans of a scene with one object, and what was true at each of them.

    Attributes:
        scans: in order of time, from 0.
        t_ns: (N,) times of the scans as planned [ns]; a scan that was lost has its row, too.
        state: (N, 4) true x, vx, y, vy of the object in the axes of the tracker's objects, NaN
            while it is not there.
    """

    scans: list[DetectionScan]
    t_ns: npt.NDArray[np.int64]
    state: FloatArray
