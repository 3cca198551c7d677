"""Motorway traffic by Monte Carlo: the preset motorway beside thresholds on a Kalman filter.

Run k of a study is the drive with seed ``seed + k`` for every profile; its measurements depend on
the profile's radar and are the same for all systems.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from can_imm.bus.profile import load_profile
from can_imm.detector import Detector
from can_imm.manoeuvres import ModeBank
from can_imm.runtime.loop import STEP_NS
from can_imm.sim.motorway import FULL, KINDS, REPORTING, MotorwaySettings
from can_imm.sim.radar import radar_model
from can_imm.smoothing import FixedIntervalSmoother
from can_imm.studies.metrics import summarise
from can_imm.studies.montecarlo import map_jobs
from can_imm.studies.motorway_filter import bent, curvature_of, follow, frames_of, level
from can_imm.studies.motorway_limit import least_delays
from can_imm.studies.motorway_metrics import Said, Score, ratio, score
from can_imm.studies.motorway_rules import Rules, judge
from can_imm.studies.motorway_rules import rules_for as tuned_rules
from can_imm.studies.motorway_runs import CAPACITY, MotorwayRun, play_motorway
from can_imm.studies.paper import metric_fields
from can_imm.studies.systems import bank
from can_imm.types import N_MANOEUVRES

RULES = "rules"
SYSTEMS = ("motorway", "motorway-smoothed", RULES)
TRUTH = "motorway"


@dataclass(frozen=True)
class Result:
    """One system on one profile.

    Attributes:
        scores: of every run in which a vehicle was seen.
        least_delays_s: per run, see `motorway_limit`; the same for all systems.
    """

    system: str
    profile: str
    scores: list[Score]
    least_delays_s: list[tuple[float, ...]]


def rules_say(run: MotorwayRun, rules: Rules) -> Said:
    """What the rules say of a run."""
    frames = frames_of([run])
    curvature = curvature_of(frames, rules.yaw_tau) * rules.curvature
    x, cov, begins = follow(frames, rules.q_along, rules.q_across, curvature, True)
    said = judge(frames.id, frames.speed, level(frames, x, rules.common), begins, rules)
    return Said(*said, p=None, x=bent(frames, x, curvature), cov=cov)


def detector_says(run: MotorwayRun, modes: ModeBank, seed: int) -> tuple[Said, Said]:
    """What the detector says of a run, at once and by hindsight.

    Args:
        modes: the detector's mode bank.
        seed: of its particles.
    """
    detector = Detector(modes, capacity=CAPACITY, seed=seed)
    detector.history = smoother = FixedIntervalSmoother(modes)
    at_once, later = _Collector(run), _Collector(run)
    due = {scan.t_ns: scan for scan in run.scans}
    for t_ns in range(0, max(due, default=0) + 1, STEP_NS):
        n = detector.step(t_ns, due.get(t_ns))
        at_once(t_ns, detector.reports[:n])
        later.take(smoother.due(t_ns))
    later.take(smoother.finish())
    return at_once.said, later.said


class _Collector:
    """Takes reports; frames of which nothing was reported stay UNKNOWN with NaN."""

    def __init__(self, run: MotorwayRun) -> None:
        n = len(run.t_ns)
        self.said = Said(
            np.zeros(n, np.int8),
            np.zeros(n, np.int8),
            np.full(n, np.iinfo(np.int8).min, np.int8),
            np.zeros((n, N_MANOEUVRES)),
            np.full((n, 4), np.nan),
            np.full((n, 4, 4), np.nan),
        )
        self._frame = {
            (scan.t_ns, name): first + row
            for scan, first in zip(run.scans, run.first.tolist(), strict=False)
            for row, name in enumerate(scan.ids[: scan.n].tolist())
        }

    def __call__(self, t_ns: int, reports: npt.NDArray[Any]) -> None:
        frames = [self._frame.get((t_ns, name), -1) for name in reports["object_id"].tolist()]
        at = np.array(frames, np.int64)
        known = at >= 0
        for name, values in vars(self.said).items():
            values[at[known]] = reports[name][known]

    def take(self, scans: Iterable[tuple[int, npt.NDArray[Any]]]) -> None:
        for t_ns, reports in scans:
            self(t_ns, reports)


def _scores(
    settings: MotorwaySettings,
    kind: str,
    systems: Sequence[str],
    preset: str,
    job: tuple[str, int],
) -> tuple[list[Score | None], tuple[float, ...]]:
    """The scores of all systems on one run, and the least delays."""
    profile, seed = job
    run = play_motorway(profile, seed, settings)
    said: dict[str, Said] = {}
    if any(system != RULES for system in systems):
        said["motorway"], said["motorway-smoothed"] = detector_says(run, _modes(preset, kind), seed)
    if RULES in systems:
        said[RULES] = rules_say(run, tuned_rules(profile_name(profile), kind))
    least = least_delays(run, radar_model(profile_name(profile)), settings)
    return [score(run, said[system]) for system in systems], least


def _modes(preset: str, kind: str) -> ModeBank:
    """The detector's; the rules for straight roads know that they are, and so does it."""
    modes = bank(preset)
    return bank(preset, straight_road=True) if kind != FULL and modes.road is not None else modes


def profile_name(profile: str) -> str:
    """Name of a profile given by name or path."""
    return load_profile(profile).name


def study(
    runs: int,
    seed: int,
    *,
    profiles: Sequence[str],
    systems: Sequence[str] = SYSTEMS,
    preset: str = "motorway",
    settings: MotorwaySettings = REPORTING,
    kind: str = FULL,
    jobs: int = 1,
    progress: Callable[[], None] = lambda: None,
) -> list[Result]:
    """Run every system on every profile's frames; the result does not depend on ``jobs``.

    Args:
        runs: number of seeds per profile.
        seed: the first of them.
        profiles: names or paths; those whose radar is simulated.
        systems: some of `SYSTEMS`.
        preset: the detector's mode bank, by name or path.
        settings: what the traffic is drawn from.
        kind: of traffic, see `sim.motorway.KINDS`.  Where it has no bends, all systems know that.
        jobs: number of processes.
        progress: called after each of the ``runs * len(profiles)`` jobs.

    Raises:
        CanImmError: no such profile, radar or preset.
    """
    for profile in profiles:
        radar_model(profile_name(profile))
    _modes(preset, kind)
    work = partial(_scores, KINDS[kind](settings), kind, systems, preset)
    todo = [(profile, seed + k) for profile in profiles for k in range(runs)]
    results = {(s, p): Result(s, p, [], []) for p in profiles for s in systems}
    for (profile, _), (scores, least) in zip(todo, map_jobs(work, todo, jobs), strict=True):
        for system, one in zip(systems, scores, strict=True):
            results[system, profile].least_delays_s.append(least)
            if one is not None:
                results[system, profile].scores.append(one)
        progress()
    return list(results.values())


def to_json(runs: int, seed: int, results: Sequence[Result]) -> dict[str, Any]:
    """The study as a JSON object; a value that does not exist is None.

    As `paper.to_json`: means over runs, with standard errors under ``"se"``.  What counts lane
    changes, lanes, objects and hours is a quotient of sums over all runs.
    ``"lane_change_delay_limit_s"`` is what no detector can undercut, see `motorway_limit`.
    """
    rules = {result.profile: result for result in results if result.system == RULES}
    return {
        "runs": runs,
        "seed": seed,
        "results": [_result(result, rules.get(result.profile)) for result in results],
    }


def _result(result: Result, rules: Result | None) -> dict[str, Any]:
    fields = {"system": result.system, "truth": TRUTH, "profile": result.profile}
    scores = result.scores
    if not scores:
        return fields
    summary = summarise([one.metrics for one in scores])
    mean, error = (metric_fields({k: v[i] for k, v in summary.items()}) for i in (0, 1))
    least = [sum(run) for run in result.least_delays_s], [len(run) for run in result.least_delays_s]
    quotients = {**_quotients(scores, rules), "lane_change_delay_limit_s": ratio(*least)}
    for name, (value, std) in quotients.items():
        mean[name], error[name] = _known(value), _known(std)
    mean["lane_changes"] = sum(one.changes for one in scores)
    mean["object_hours"] = round(sum(one.hours for one in scores), 4)
    return {**fields, **mean, "se": error}


def _quotients(scores: Sequence[Score], rules: Result | None) -> dict[str, tuple[float, float]]:
    quotients = {
        "lane_changes_found": ratio([s.found for s in scores], [s.changes for s in scores]),
        "false_lane_changes_per_hour": ratio([s.false for s in scores], [s.hours for s in scores]),
        "lane_change_delay_s": ratio(
            [sum(s.delays_s) for s in scores], [len(s.delays_s) for s in scores]
        ),
        **{
            name: ratio(
                [getattr(s, attribute)[0] for s in scores],
                [getattr(s, attribute)[1] for s in scores],
            )
            for name, attribute in (
                ("lane_changes_found_nearby", "nearby"),
                ("lane_accuracy", "lanes"),
                ("stationary_share", "stationary"),
                ("oncoming_share", "oncoming"),
            )
        },
        "error_ratio": (math.nan, math.nan),
    }
    if rules is not None and rules.scores is not scores:
        quotients["error_ratio"] = ratio(
            [1.0 - s.metrics.accuracy for s in scores],
            [1.0 - s.metrics.accuracy for s in rules.scores],
        )
    return quotients


def _known(value: float) -> float | None:
    return round(value, 6) if math.isfinite(value) else None
