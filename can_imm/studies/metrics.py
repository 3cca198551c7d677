"""The metrics of every study: what was said of one object against what was true.

A *frame* is one scan.  A *segment* is a longest stretch of frames with one true label; a *switch*
happens at the first frame of every segment but the first.  A value that does not exist (no
probabilities, no covariance, no switch) is NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from can_imm.types import N_MANOEUVRES, FloatArray, Manoeuvre

Int8Array = npt.NDArray[np.int8]
Int64Array = npt.NDArray[np.int64]

N_BINS = 10
"""Bins of the expected calibration error, equally wide over [0, 1]."""

TOLERANCES_NS = (300_000_000, 500_000_000)


@dataclass(frozen=True)
class Metrics:
    """All metrics of one run (one object).

    Attributes:
        accuracy: share of frames given the true label; UNKNOWN counts as wrong.
        macro_f1: mean F1 over the classes that occur in the truth.
        accuracy_tol_0_3: as ``accuracy``, but a frame within 0.3 s of a switch is also right if
            it has the label before or after that switch.
        accuracy_tol_0_5: the same with 0.5 s.
        mean_delay_s: mean of ``delays_s`` over the switches that were noticed [s].
        missed_segments: number of segments never given their label on two consecutive frames
            (a segment of one frame: on that one).
        switches: number of changes of the label said; leaving the initial UNKNOWN is none.
        brier: mean over frames of the squared distance between the probabilities and the truth
            (0 is perfect, 2 the worst).
        rmse_x, rmse_vx, rmse_y, rmse_vy: root mean square errors [m, m/s, m, m/s].
        nees: mean over frames of the normalised estimation error squared, 4 degrees of freedom;
            infinite if a covariance is singular.
        delays_s: (segments - 1,) time from each switch to the first of two consecutive correct
            frames of its segment [s]; NaN where the segment was missed.
        calibration: (3, N_BINS) over the decided frames by probability of what was said: number
            of frames, sum of probabilities, number of correct frames.
        confusion: (8, 8) number of frames by true (row) and said (column) `Manoeuvre`.
    """

    accuracy: float
    macro_f1: float
    accuracy_tol_0_3: float
    accuracy_tol_0_5: float
    mean_delay_s: float
    missed_segments: float
    switches: float
    brier: float
    rmse_x: float
    rmse_vx: float
    rmse_y: float
    rmse_vy: float
    nees: float
    delays_s: FloatArray
    calibration: FloatArray
    confusion: Int64Array

    @property
    def ece(self) -> float:
        """Expected calibration error of this run alone; biased upwards, see `summarise`."""
        return expected_calibration_error(self.calibration)


SCALARS = tuple(f.name for f in fields(Metrics) if f.type == "float")
"""Names of the metrics that are one number per run and are averaged over runs."""


def evaluate(
    t_ns: Int64Array,
    label_true: Int8Array,
    state_true: FloatArray,
    manoeuvre: Int8Array | None,
    p: FloatArray | None,
    x: FloatArray | None,
    cov: FloatArray | None,
) -> Metrics:
    """Compare one run with the truth.

    Args:
        t_ns: (N,) times of the frames [ns], increasing, N >= 1.
        label_true: (N,) true `Manoeuvre` values.
        state_true: (N, 4) true x, vx, y, vy [m, m/s, m, m/s].
        manoeuvre: (N,) `Manoeuvre` values said; None for a system without classes.
        p: (N, 8) probabilities by `Manoeuvre` value; None if the system gives none.
        x: (N, 4) estimated states; rows with a NaN (no estimate yet) are left out.
        cov: (N, 4, 4) their covariances.

    Raises:
        ValueError: no frames, or lengths that differ.
    """
    n = len(t_ns)
    if n == 0:
        raise ValueError("a run without frames cannot be evaluated")
    for array in (label_true, state_true, manoeuvre, p, x, cov):
        if array is not None and len(array) != n:
            raise ValueError(f"{len(array)} rows given for {n} frames")

    nan = float("nan")
    rmse, nees = (np.full(4, nan), nan) if x is None else _errors(state_true, x, cov)
    delays = np.full(0, nan)
    calibration = np.zeros((3, N_BINS))
    confusion = np.zeros((N_MANOEUVRES, N_MANOEUVRES), np.int64)
    accuracy = f1 = tol_3 = tol_5 = delay = missed = switches = brier = nan
    if manoeuvre is not None:
        correct = manoeuvre == label_true
        np.add.at(confusion, (label_true.astype(int), manoeuvre.astype(int)), 1)
        caught, delays = _first_pairs(t_ns, label_true, correct)
        accuracy = float(correct.mean())
        f1 = _macro_f1(confusion)
        tol_3, tol_5 = (_tolerant_accuracy(t_ns, label_true, manoeuvre, s) for s in TOLERANCES_NS)
        delay = float(np.nanmean(delays)) if np.isfinite(delays).any() else nan
        missed = float((~caught).sum())
        switches = float(_count_switches(manoeuvre))
        if p is not None:
            brier = float(np.mean(np.sum((p - np.eye(N_MANOEUVRES)[label_true]) ** 2, axis=1)))
            calibration = _calibration(p[np.arange(n), manoeuvre], correct, manoeuvre != 0)
    return Metrics(
        accuracy=accuracy,
        macro_f1=f1,
        accuracy_tol_0_3=tol_3,
        accuracy_tol_0_5=tol_5,
        mean_delay_s=delay,
        missed_segments=missed,
        switches=switches,
        brier=brier,
        rmse_x=float(rmse[0]),
        rmse_vx=float(rmse[1]),
        rmse_y=float(rmse[2]),
        rmse_vy=float(rmse[3]),
        nees=nees,
        delays_s=delays,
        calibration=calibration,
        confusion=confusion,
    )


def _segment_starts(labels: Int8Array) -> Int64Array:
    """Indices of the frames at which a segment begins, 0 among them."""
    return np.concatenate(([0], 1 + np.flatnonzero(np.diff(labels)))).astype(np.int64)


def _macro_f1(confusion: Int64Array) -> float:
    hits = np.diagonal(confusion).astype(float)
    occurring = confusion.sum(axis=1) > 0
    f1 = 2 * hits[occurring] / (confusion.sum(axis=0) + confusion.sum(axis=1))[occurring]
    return float(f1.mean())


def _tolerant_accuracy(
    t_ns: Int64Array, label_true: Int8Array, said: Int8Array, tolerance_ns: int
) -> float:
    at = _segment_starts(label_true)[1:]
    near = np.abs(t_ns[:, None] - t_ns[at]) <= tolerance_ns
    either = (said[:, None] == label_true[at - 1]) | (said[:, None] == label_true[at])
    return float(np.mean((said == label_true) | (near & either).any(axis=1)))


def _first_pairs(
    t_ns: Int64Array, label_true: Int8Array, correct: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.bool_], FloatArray]:
    """Which segments were caught (segments,), and the delay per switch (segments - 1,) [s]."""
    starts = _segment_starts(label_true)
    segment = np.zeros(len(t_ns), np.int64)
    segment[starts[1:]] = 1
    segment = np.cumsum(segment)
    pair = correct.copy()
    inside = segment[:-1] == segment[1:]
    pair[:-1] &= np.where(inside, correct[1:], False)
    pair[-1] = False
    lengths = np.bincount(segment)
    lone = starts[lengths == 1]
    pair[lone] = correct[lone]

    delay = np.full(len(starts), np.nan)
    where = np.flatnonzero(pair)
    found, first = np.unique(segment[where], return_index=True)
    delay[found] = (t_ns[where[first]] - t_ns[starts[found]]) * 1e-9
    return np.isfinite(delay), delay[1:]


def _count_switches(said: Int8Array) -> int:
    known = np.flatnonzero(said != Manoeuvre.UNKNOWN)
    return int(np.count_nonzero(np.diff(said[known[0] :]))) if known.size else 0


def _calibration(
    confidence: FloatArray, correct: npt.NDArray[np.bool_], decided: npt.NDArray[np.bool_]
) -> FloatArray:
    confidence, correct = confidence[decided], correct[decided]
    bins = np.clip((confidence * N_BINS).astype(int), 0, N_BINS - 1)
    return np.stack(
        [np.bincount(bins, w, N_BINS) for w in (np.ones(len(bins)), confidence, correct)]
    )


def expected_calibration_error(calibration: FloatArray) -> float:
    """Mean over frames of |share correct - mean probability| of the frame's bin.

    Args:
        calibration: (3, bins) frames, sum of probabilities, correct frames per bin.
    """
    frames, confidence, correct = calibration
    total = frames.sum()
    return float(np.abs(correct - confidence).sum() / total) if total else float("nan")


def _errors(
    state_true: FloatArray, x: FloatArray, cov: FloatArray | None
) -> tuple[FloatArray, float]:
    """Root mean square error (4,) and mean NEES over the frames that have an estimate."""
    known = np.isfinite(x).all(axis=1)
    if not known.any():
        return np.full(4, np.nan), float("nan")
    error = (x - state_true)[known]
    rmse = np.sqrt(np.mean(error**2, axis=0))
    if cov is None:
        return rmse, float("nan")
    try:
        weighted = np.linalg.solve(cov[known], error[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:  # singular: certainty claimed along some direction
        return rmse, float("inf")
    return rmse, float(np.mean(np.sum(error * weighted, axis=1)))


def summarise(runs: Sequence[Metrics]) -> dict[str, tuple[float, float]]:
    """Mean and standard error over runs, by metric name (those of `SCALARS`, and ``ece``).

    A mean is taken over the runs in which the value exists.  The expected calibration error is
    not averaged: with ten bins a single run has only a handful of frames in most of them, so that
    its own error is mostly counting noise, which the absolute value turns into bias.  Instead the
    frames of all runs are pooled in the bins, and the standard error is a jackknife over runs
    (frames of one run depend on each other, runs do not).

    Returns:
        name -> (mean, standard error); NaN where there are too few runs.
    """
    summary: dict[str, tuple[float, float]] = {}
    for name in SCALARS:
        values = np.array([getattr(run, name) for run in runs], float)
        values = values[np.isfinite(values)]
        n = len(values)
        summary[name] = (
            float(values.mean()) if n else float("nan"),
            float(values.std(ddof=1) / np.sqrt(n)) if n > 1 else float("nan"),
        )
    bins = np.array([run.calibration for run in runs])
    pooled = bins.sum(axis=0)
    without = np.array([expected_calibration_error(pooled - one) for one in bins])
    n = len(runs)
    summary["ece"] = (
        expected_calibration_error(pooled),
        float(np.sqrt((n - 1) / n * np.sum((without - without.mean()) ** 2)))
        if n > 1
        else float("nan"),
    )
    return summary
