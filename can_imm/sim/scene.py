"""What a played scene of several sensors gives: detections, and the truth beside them."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from can_imm.types import DetectionScan, FloatArray

KINDS = ("cooperative", "roadside")
"""What ``kind`` may be in a scene's TOML; also the names of the built-in scenes."""


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


def scene_kind(name_or_path: str) -> str | None:
    """The kind of a scene, None for what is none (a scenario, or no readable file at all)."""
    if name_or_path in KINDS:
        return name_or_path
    try:
        kind = tomllib.loads(Path(name_or_path).read_text("utf-8")).get("kind")
    except (OSError, ValueError):
        return None
    return kind if kind in KINDS else None
