"""The paper's study by Monte Carlo: presets of the detector beside the baselines.

Run k of a study uses seed ``seed + k`` on every truth and for every system, so the systems see
the same noise.  The truths "A", "B" and "S" are the readings of the published scenario; for
"random" each seed is another scenario.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from can_imm.studies.metrics import Metrics, evaluate, summarise
from can_imm.studies.montecarlo import map_jobs
from can_imm.studies.runs import TRUTHS, Observation, play
from can_imm.studies.systems import BASELINES, Answer, answer, bank

SYSTEMS = ("two-lane", "paper", "kalman", "rules", "measurement")

TABLE_6 = {"x": 0.1531, "vx": 0.2159, "y": 0.1150, "vy": 0.1786}
"""RMSE that the paper reports [m, m/s, m, m/s]."""

_SCALARS = (
    "accuracy",
    "macro_f1",
    "accuracy_tol_0_3",
    "accuracy_tol_0_5",
    "mean_delay_s",
    "missed_segments",
    "switches",
    "brier",
    "ece",
    "nees",
)


@dataclass(frozen=True)
class Result:
    """One system on one truth: the metrics of every object of every run."""

    system: str
    truth: str
    metrics: list[Metrics]


def score(seen: Observation, said: Answer) -> Metrics:
    """The metrics of what was said of one object."""
    return evaluate(seen.t_ns, seen.label, seen.state, said.manoeuvre, said.p, said.x, said.cov)


def _run(systems: Sequence[str], job: tuple[str, int]) -> list[list[Metrics]]:
    """All systems on one run: per system the metrics of each object."""
    truth, seed = job
    scans, seen = play(truth, seed)
    return [
        [score(*pair) for pair in zip(seen, answer(system, scans, seen, seed), strict=True)]
        for system in systems
    ]


def study(
    runs: int,
    seed: int,
    *,
    systems: Sequence[str] = SYSTEMS,
    truths: Sequence[str] = TRUTHS,
    jobs: int = 1,
    progress: Callable[[], None] = lambda: None,
) -> list[Result]:
    """Run every system on every truth; the result does not depend on ``jobs``.

    Args:
        runs: number of seeds per truth.
        seed: the first of them.
        systems: presets, paths of mode banks, or baselines.
        truths: some of `TRUTHS`.
        jobs: number of processes.
        progress: called after each of the ``runs * len(truths)`` jobs.

    Raises:
        CanImmError: a preset or mode bank that cannot be loaded.
    """
    for system in systems:
        if system not in BASELINES:
            bank(system)
    todo = [(truth, seed + k) for truth in truths for k in range(runs)]
    results = {(s, t): Result(s, t, []) for t in truths for s in systems}
    for (truth, _), per_system in zip(
        todo, map_jobs(partial(_run, systems), todo, jobs), strict=True
    ):
        for system, metrics in zip(systems, per_system, strict=True):
            results[system, truth].metrics.extend(metrics)
        progress()
    return list(results.values())


def to_json(runs: int, seed: int, results: Sequence[Result]) -> dict[str, Any]:
    """The study as a JSON object; a value that does not exist is None.

    Means over runs with their standard errors under ``"se"``; the calibration error is that of
    all runs' frames together (see `metrics.summarise`).
    """
    return {"runs": runs, "seed": seed, "results": [_result(result) for result in results]}


def _result(result: Result) -> dict[str, Any]:
    summary = summarise(result.metrics)
    mean, error = (metric_fields({k: v[i] for k, v in summary.items()}) for i in (0, 1))
    return {"system": result.system, "truth": result.truth, **mean, "se": error}


def metric_fields(values: dict[str, float]) -> dict[str, Any]:
    """Metrics by name as they stand in JSON."""
    known = {k: round(v, 6) if math.isfinite(v) else None for k, v in values.items()}
    rmse = {state: known[f"rmse_{state}"] for state in TABLE_6}
    return {**{name: known[name] for name in _SCALARS}, "rmse": rmse}
