"""How the constants of `motorway_rules` were found: ``can-imm study tune-motorway-rules``.

For every profile and every kind of traffic by itself, on traffic with the settings
"tuning" and seeds below `runs.FIRST_SEED`.  What is minimised is the share of wrong frames among
those of `TRAFFIC`, averaged over runs: one constant at a time, coarse steps first, from several
starts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from can_imm.sim.motorway import FULL, KINDS, TUNING, MotorwaySettings
from can_imm.studies.descent import descend
from can_imm.studies.motorway_filter import Frames, curvature_of, follow, frames_of, level
from can_imm.studies.motorway_rules import START, Rules, judge, rules_for
from can_imm.studies.motorway_runs import TRAFFIC, play_motorway
from can_imm.studies.runs import FIRST_SEED, Int8Array
from can_imm.types import BoolArray, FloatArray

_STEPS = (0.5, 0.25, 0.1, 0.05)
"""Relative steps of the search, coarse to fine."""
_CHOICES: dict[str, tuple[Any, ...]] = {
    "curvature": (0.0, 0.25, 0.5, 0.75, 1.0),
    "common": (0.0, 0.25, 0.5, 0.75, 1.0),
    "width": (3.4, 3.5, 3.6, 3.7, 3.8),
    "lane_dwell": (1, 2, 3, 4, 6, 8),
    "lane_hold": (1, 2, 4, 7, 10, 14, 20, 28),
    "speed_dwell": (1, 2, 3, 4, 6),
}
"""Values tried for what is not a threshold."""
_FIXED = ("stationary", "oncoming")
"""Hardly ever wrong, whatever their values."""
_STARTS = 4
"""Starting points of the search: the constants as they stand, and random ones around them."""
_SPREAD = 0.35
"""Standard deviation of the random starting points' logarithms."""


@dataclass(frozen=True, eq=False)
class Data:
    """Runs of one profile; ``label`` (F,) is true, ``traffic`` (F,) says which frames count."""

    frames: Frames
    label: Int8Array
    traffic: BoolArray


def collect(profile: str, seeds: Sequence[int], settings: MotorwaySettings) -> Data:
    """Play one run per seed."""
    if max(seeds) >= FIRST_SEED:
        raise ValueError(f"seeds from {FIRST_SEED} on are for reporting")
    runs = [play_motorway(profile, seed, settings) for seed in seeds]
    label = np.concatenate([run.label for run in runs])
    return Data(frames_of(runs), label, np.isin(label, TRAFFIC))


class Objective:
    """Share of wrong frames of a set of rules; remembers the filtered states by filter."""

    def __init__(self, data: Data) -> None:
        self._data = data
        number = data.frames.run
        self._frames = np.bincount(number, data.traffic)
        self._filtered = lru_cache(maxsize=8)(self._filter)

    def _filter(
        self, q_along: float, q_across: float, curvature: float, yaw_tau: float, common: float
    ) -> tuple[FloatArray, BoolArray]:
        frames = self._data.frames
        x, _, begins = follow(
            frames, q_along, q_across, curvature_of(frames, yaw_tau) * curvature, False
        )
        return level(frames, x, common), begins

    def __call__(self, rules: Rules) -> float:
        data, r = self._data, rules
        # without a curvature its time constant means nothing
        tau = r.yaw_tau if r.curvature else 1.0
        x, begins = self._filtered(r.q_along, r.q_across, r.curvature, tau, r.common)
        said, _, _ = judge(data.frames.id, data.frames.speed, x, begins, rules)
        wrong = np.bincount(data.frames.run, (said != data.label) & data.traffic)
        seen = self._frames > 0
        return float(np.mean(wrong[seen] / self._frames[seen]))


def _scattered(rules: Rules, rng: np.random.Generator) -> Rules:
    values: dict[str, Any] = {
        name: value * float(np.exp(_SPREAD * rng.standard_normal()))
        for name, value in rules._asdict().items()
        if name not in _CHOICES and name not in _FIXED
    }
    return rules._replace(**values)


@dataclass(frozen=True)
class Tuning:
    """What was found, and the share of wrong frames on seeds used and not used for it, and there
    with the rules in use."""

    rules: Rules
    wrong_tuned: float
    wrong_checked: float
    wrong_constants: float


def tune(
    profile: str,
    runs: int,
    *,
    kind: str = FULL,
    starts: int = _STARTS,
    progress: Callable[[float], None] = lambda _: None,
) -> Tuning:
    """Tune on seeds 0 to ``runs`` - 1, check on as many from `FIRST_SEED` / 2 on.

    Args:
        profile: name of a profile whose radar is simulated.
        runs: number of seeds, up to `FIRST_SEED` / 2.
        kind: of traffic, see `sim.motorway.KINDS`.
        starts: number of starting points.
        progress: called with the best share so far.
    """
    settings = KINDS[kind](TUNING)
    half = FIRST_SEED // 2
    objective = Objective(collect(profile, range(runs), settings))
    check = Objective(collect(profile, range(half, half + runs), settings))
    rng = np.random.default_rng(0)
    best, found = np.inf, START
    in_use = rules_for(profile, kind)
    for start in range(starts):
        begin = in_use if start == 0 else _scattered(START, rng)
        error, rules = descend(
            objective, begin, steps=_STEPS, choices=_CHOICES, fixed=_FIXED, least=1e-5
        )
        if error < best:
            best, found = error, rules
        progress(best)
    rounded: dict[str, Any] = {
        name: float(f"{value:.3g}") if isinstance(value, float) else value
        for name, value in found._asdict().items()
    }
    found = Rules(**rounded)
    return Tuning(found, objective(found), check(found), check(in_use))
