"""What a picture of a recording needs of the reports; knows no matplotlib."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from can_imm.estimation.road import N_ROAD, OFFSET, WIDTH, lane_middles
from can_imm.types import FloatArray

if TYPE_CHECKING:
    from can_imm.road import RoadFrame

HISTORY_DTYPE = np.dtype(
    [
        ("t_ns", np.int64),
        ("object_id", np.int32),
        ("age", np.int32),
        ("coasting", np.bool_),
        ("x", np.float32),
        ("y", np.float32),
        ("ego_speed", np.float32),
        ("manoeuvre", np.int8),
        ("lane", np.int8),
        ("duplicate", np.bool_),
    ]
)
"""Of a report: time [ns], object, scans in which it was seen, whether it was missed now, gap and
lateral position [m], the ego's speed [m/s], manoeuvre, lane, whether it is a duplicate track."""


@dataclass(frozen=True)
class Recorded:
    """A whole recording.

    Attributes:
        rows: (N,) of `HISTORY_DTYPE`, in the order in which they came.
        ego_t_ns, ego_y: (S,) where the ego was across the road [ns, m].  If there are any, the
            rows' ``y`` is across the road, too: 0 is the middle of the ego's lane at the start, at
            whatever distance; otherwise it is the vehicle's.
        width: of the lanes [m], NaN if there is no road.
    """

    rows: npt.NDArray[Any]
    ego_t_ns: npt.NDArray[np.int64]
    ego_y: FloatArray
    width: float

    @property
    def on_road(self) -> bool:
        """Whether lateral positions are those across the road."""
        return len(self.ego_y) > 0


class History:
    """Keeps every report's row of `HISTORY_DTYPE`; called with the reports of each scan.

    Args:
        road: the detector's, if it has one; `watch` then has to be called after each scan, when the
            road is up to date (the reports may come later, smoothed).
    """

    def __init__(self, road: RoadFrame | None = None) -> None:
        self.road = road
        self._parts: list[npt.NDArray[Any]] = []
        self._road_t_ns: list[int] = []
        self._roads: list[FloatArray] = []

    def watch(self, t_ns: int, reports: npt.NDArray[Any]) -> None:
        """Keep the road of this step."""
        if self.road is not None and len(reports):
            self._road_t_ns.append(t_ns)
            self._roads.append(self.road.x[:N_ROAD].copy())

    def __call__(self, t_ns: int, reports: npt.NDArray[Any]) -> None:
        rows = np.empty(len(reports), HISTORY_DTYPE)
        for name in ("t_ns", "object_id", "age", "coasting", "ego_speed", "manoeuvre", "lane"):
            rows[name] = reports[name]
        rows["x"], rows["y"] = reports["x"][:, 0], reports["x"][:, 2]
        rows["duplicate"] = reports["duplicate_of"] >= 0
        self._parts.append(rows)

    def recorded(self) -> Recorded:
        """Return everything that was kept."""
        rows = np.concatenate([np.empty(0, HISTORY_DTYPE), *self._parts])
        t_ns = np.array(self._road_t_ns, np.int64)
        roads = np.array(self._roads).reshape(len(t_ns), N_ROAD)
        if not len(t_ns):
            return Recorded(rows, t_ns, np.empty(0), float("nan"))
        width = float(np.median(roads[:, WIDTH]))
        # When the ego has moved over, its offset counts from the next lane: a jump by a width.
        jumps = np.diff(roads[:, OFFSET], prepend=roads[0, OFFSET]) / roads[:, WIDTH]
        lane = -np.cumsum(np.where(np.abs(jumps) > 0.6, np.round(jumps), 0.0))
        at = np.clip(np.searchsorted(t_ns, rows["t_ns"], "right") - 1, 0, None)
        x = rows["x"].astype(np.float64)
        rows["y"] += (lane[at] * width - lane_middles(roads[at], x)).astype(np.float32)
        return Recorded(rows, t_ns, roads[:, OFFSET] + lane * width, width)
