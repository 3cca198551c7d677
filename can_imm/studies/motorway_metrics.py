"""What a motorway study counts: frames, and lane changes as events."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from can_imm.sim.motorway import DT_NS, ObjectTruth
from can_imm.studies.metrics import Metrics, evaluate
from can_imm.studies.motorway_runs import TRAFFIC, MotorwayRun
from can_imm.studies.runs import Int8Array, Int64Array
from can_imm.types import BoolArray, FloatArray, Manoeuvre, X

SEEN_NS = 2_000_000_000
"""A lane change counts if a track saw so much of it [ns]."""
NEAR_NS = 1_000_000_000
"""What is said of a lane change so long before or after it is not false [ns]."""
NEARBY = 100.0
"""Lane changes that begin within this distance along x [m] are counted by themselves, too."""


@dataclass(frozen=True)
class Said:
    """What a system says of the F frames of a run.

    Attributes:
        manoeuvre, direction, lane: (F,) as in a report.
        p: (F, 11), None from a system without probabilities.
        x, cov: (F, 4), (F, 4, 4), NaN where nothing is said.
    """

    manoeuvre: Int8Array
    direction: Int8Array
    lane: Int8Array
    p: FloatArray | None
    x: FloatArray
    cov: FloatArray


@dataclass(frozen=True)
class Score:
    """One system on one run.

    Attributes:
        metrics: of all frames whose truth is one of `TRAFFIC`, of all tracks; the states without
            second tracks.
        changes: number of lane changes.
        found: of them, those that were said.
        nearby: those found, and all, that begin within `NEARBY`.
        delays_s: from the beginning to the first of two right frames, where it was seen [s].
        false: stretches said to be a lane change where there is none.
        hours: that all tracks were seen [h].
        lanes, stationary, oncoming: frames that got the true lane (or the class), and all (of it).
    """

    metrics: Metrics
    changes: int
    found: int
    nearby: tuple[int, int]
    delays_s: tuple[float, ...]
    false: int
    hours: float
    lanes: tuple[int, int]
    stationary: tuple[int, int]
    oncoming: tuple[int, int]


def score(run: MotorwayRun, said: Said) -> Score | None:
    """Compare what was said with the truth; None if no vehicle was ever seen."""
    traffic = np.isin(run.label, TRAFFIC)
    if not traffic.any():
        return None
    found = _Events()
    for track in run.tracks:
        if not run.second[track[0]]:
            found.count(run, said, track)
    right = said.manoeuvre == run.label

    def share(of: BoolArray, good: BoolArray) -> tuple[int, int]:
        return int(np.count_nonzero(good & of)), int(np.count_nonzero(of))

    return Score(
        metrics=_metrics(run, said, [track for track in run.tracks if traffic[track[0]]]),
        changes=found.changes,
        found=found.found,
        nearby=(found.found_nearby, found.nearby),
        delays_s=tuple(found.delays_s),
        false=found.false,
        hours=found.hours,
        lanes=share(traffic, said.lane == run.lane),
        stationary=share(run.label == Manoeuvre.STATIONARY, right),
        oncoming=share(run.label == Manoeuvre.ONCOMING, right),
    )


def _metrics(run: MotorwayRun, said: Said, tracks: Sequence[Int64Array]) -> Metrics:
    """Frames pooled over tracks; what depends on their order, track by track."""
    x = np.where(run.second[:, None], np.nan, said.x)

    def of(frames: Int64Array) -> Metrics:
        return evaluate(
            run.t_ns[frames], run.label[frames], run.state[frames], said.manoeuvre[frames],
            None if said.p is None else said.p[frames], x[frames], said.cov[frames],
        )  # fmt: skip

    single = [of(track) for track in tracks]
    lengths = [len(track) for track in tracks]
    delays = np.concatenate([one.delays_s for one in single])
    seen = delays[np.isfinite(delays)]
    return replace(
        of(np.concatenate(tracks)),
        accuracy_tol_0_3=float(np.average([m.accuracy_tol_0_3 for m in single], weights=lengths)),
        accuracy_tol_0_5=float(np.average([m.accuracy_tol_0_5 for m in single], weights=lengths)),
        mean_delay_s=float(seen.mean()) if len(seen) else float("nan"),
        missed_segments=float(sum(m.missed_segments for m in single)),
        switches=float(sum(m.switches for m in single)),
        delays_s=delays,
    )


def lane_changes(run: MotorwayRun, track: Int64Array) -> Iterator[tuple[int, int]]:
    """Index in a track of the first frame of each true lane change that counts, and of the one
    after its last."""
    t_ns = run.t_ns[track]
    for begin, end in _stretches(run.direction[track]):
        if t_ns[end - 1] - t_ns[begin] >= SEEN_NS:
            yield begin, end


class _Events:
    """Counts lane changes."""

    def __init__(self) -> None:
        self.changes = self.found = self.false = 0
        self.nearby = self.found_nearby = 0
        self.delays_s: list[float] = []
        self.hours = 0.0

    def count(self, run: MotorwayRun, said: Said, track: Int64Array) -> None:
        t_ns, true = run.t_ns[track], run.direction[track]
        manoeuvre, direction = said.manoeuvre[track], said.direction[track]
        self.hours += float(t_ns[-1] - t_ns[0]) * 1e-9 / 3600.0
        changing = manoeuvre == Manoeuvre.LANE_CHANGE
        for begin, end in lane_changes(run, track):
            is_nearby = bool(run.state[track[begin], X] <= NEARBY)
            self.changes += 1
            self.nearby += is_nearby
            right = changing[begin:end] & (direction[begin:end] == true[begin])
            pairs = np.flatnonzero(right[:-1] & right[1:])
            if len(pairs):
                self.found += 1
                self.found_nearby += is_nearby
                if begin > 0:
                    self.delays_s.append(float(t_ns[begin + pairs[0]] - t_ns[begin]) * 1e-9)
        target = run.truth.objects[int(run.object[track[0]])]
        for begin, end in _stretches(changing.astype(np.int8)):
            if not _changes_near(target, int(t_ns[begin]), int(t_ns[end - 1])):
                self.false += 1


def _stretches(values: Int8Array) -> Iterator[tuple[int, int]]:
    """Beginning and end of each longest stretch with one value that is not 0."""
    edges = np.flatnonzero(np.diff(values, prepend=0, append=0))
    for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        if values[begin] != 0:
            yield begin, end


def _changes_near(target: ObjectTruth, first_ns: int, last_ns: int) -> bool:
    """Whether the object truly changes lane about that time."""
    begin = (first_ns - NEAR_NS - int(target.t_ns[0])) // DT_NS
    end = (last_ns + NEAR_NS - int(target.t_ns[0])) // DT_NS
    return bool(target.direction[max(begin, 0) : max(end + 1, 0)].any())


def ratio(above: Sequence[float], below: Sequence[float]) -> tuple[float, float]:
    """Sum of one number per run over that of another, and its standard error (a jackknife)."""
    a, b = np.array(above, np.float64), np.array(below, np.float64)
    n, nan = len(a), float("nan")
    if not b.sum() > 0.0:
        return nan, nan
    value = float(a.sum() / b.sum())
    rest = b.sum() - b
    if n < 2 or not (rest > 0.0).all():
        return value, nan
    without = (a.sum() - a) / rest
    return value, float(np.sqrt((n - 1) / n * np.sum((without - without.mean()) ** 2)))
