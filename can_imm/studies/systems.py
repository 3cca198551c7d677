"""The systems that a study compares, run over the scans of one run without a bus.

A system is a preset of the detector (or a TOML file with a mode bank), or one of `BASELINES`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from can_imm.detector import Detector
from can_imm.manoeuvres import ModeBank, load_bank
from can_imm.studies.baselines import KALMAN_NOISE, RULES, Noise, apply_rules, kalman
from can_imm.studies.runs import Observation
from can_imm.types import N_MANOEUVRES, FloatArray, Scan

Int8Array = npt.NDArray[np.int8]

BASELINES = ("kalman", "rules", "measurement")


@dataclass(frozen=True)
class Answer:
    """What a system says of one object, one row per scan; see `metrics.evaluate`."""

    manoeuvre: Int8Array | None
    p: FloatArray | None
    x: FloatArray
    cov: FloatArray


def answer(
    system: str, scans: Sequence[Scan], observations: Sequence[Observation], seed: int
) -> list[Answer]:
    """Run a system over one run; one `Answer` per observation, in their order.

    Args:
        system: name of a preset or baseline, or path of a mode bank.
        scans: all scans of the run.
        observations: the objects in them.
        seed: of the detector's particles.
    """
    if system in BASELINES:
        return [_baseline(system, observation) for observation in observations]
    return _detect(bank(system), scans, observations, seed)


@lru_cache
def bank(name: str, *, straight_road: bool = False) -> ModeBank:
    """The mode bank of that name or path, read once per process; see `load_bank`."""
    return load_bank(name, straight_road=straight_road)


def _baseline(system: str, seen: Observation) -> Answer:
    if system == "measurement":
        cov = np.broadcast_to(np.diag(seen.std**2), (len(seen.z), 4, 4))
        return Answer(None, None, seen.z, cov)
    noise = Noise(RULES.q_along, RULES.q_across) if system == "rules" else KALMAN_NOISE
    x, cov = kalman(seen.t_ns, seen.z, seen.seen, seen.std, noise)
    return Answer(apply_rules(x, RULES) if system == "rules" else None, None, x, cov)


class Collector:
    """What a detector says of the observed objects: takes reports, scan by scan.

    It can stand among the listeners of a `runtime.nodes.DetectorNode`.

    Attributes:
        answers: one per observation, in their order; rows not yet reported are UNKNOWN with NaN.

    Args:
        observations: the objects.
        start_ns: the reports' time at which the observations' time 0 lies [ns].
    """

    def __init__(self, observations: Sequence[Observation], start_ns: int = 0) -> None:
        self.answers: list[Answer] = []
        self._row: dict[tuple[int, int], tuple[Answer, int]] = {}
        for one in observations:
            n = len(one.t_ns)
            said = Answer(
                np.zeros(n, np.int8),
                np.zeros((n, N_MANOEUVRES)),
                np.full((n, 4), np.nan),
                np.full((n, 4, 4), np.nan),
            )
            self.answers.append(said)
            for k, t_ns in enumerate(one.t_ns):
                self._row[one.truth.object_id, int(t_ns) + start_ns] = said, k

    def __call__(self, t_ns: int, reports: npt.NDArray[Any]) -> None:
        for report in reports:
            found = self._row.get((int(report["object_id"]), int(report["t_ns"])))
            if found is None:
                continue
            said, k = found
            assert said.manoeuvre is not None
            assert said.p is not None
            said.manoeuvre[k] = report["manoeuvre"]
            said.p[k] = report["p"]
            said.x[k] = report["x"]
            said.cov[k] = report["cov"]


def _detect(
    modes: ModeBank, scans: Sequence[Scan], observations: Sequence[Observation], seed: int
) -> list[Answer]:
    detector = Detector(modes, capacity=len(observations), seed=seed)
    collect = Collector(observations)
    due = {scan.t_ns: scan for scan in scans}
    for t_ns in range(0, max(due) + 1, modes.step_ns):
        n = detector.step(t_ns, due.get(t_ns))
        collect(t_ns, detector.reports[:n])
    return collect.answers
