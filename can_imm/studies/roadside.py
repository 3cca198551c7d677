"""The roadside tracker by Monte Carlo: an IMM-UKF beside two constant-velocity filters.

Cui and Wang report an IMM against a single constant-velocity model; the size of their errors says
that this model had almost no process noise (``cv-strawman``).  What an IMM is worth shows beside a
constant-velocity filter whose noise was chosen as carefully as the IMM's (``cv-tuned``).

All systems are the same tracker with other models; they see the same detections, begin at the first
of them, believe every one and are never given up.  Run k uses seed ``seed + k``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from can_imm.estimation import ukf
from can_imm.sim.roadside import RoadsideRun, RoadsideScene, load_scene, play_scene
from can_imm.studies.runs import FIRST_SEED
from can_imm.trackers.roadside import IMM_UKF, Motion, RoadsideSettings, RoadsideTracker
from can_imm.types import VX, VY, BoolArray, FloatArray, X, Y

SETTLE_S = 1.0
"""The first second is not judged: at the first detection nothing is known of the speed [s]."""
DETECTED = 0.5
"""The bend is detected when constant turn is more probable than this."""

ERRORS = ("position", "speed", "velocity")
"""Distance [m], |v| and the length of the velocity's error vector [m/s]: RMS values of a run."""

PUBLISHED = {"cv": (11.62, 14.87), "imm": (1.53, 3.18), "reduction": (0.868, 0.786)}
"""Position [m] and speed [m/s]; the paper doesn't say which of the two speed errors it means."""


def cv(q: float) -> RoadsideSettings:
    """A tracker with one constant-velocity model of noise density q [m²/s³]."""
    # one model: nothing turns, so the noise of the turn rate has no effect
    return replace(
        IMM_UKF, models=(Motion(ukf.CV, q, 1e-4, (0.0, 0.01)),), transitions=((1.0,),), birth=(1.0,)
    )


SYSTEMS = {"cv-strawman": cv(1e-4), "cv-tuned": cv(3.0), "imm-ukf": IMM_UKF}
"""Tuned, where tuned, on seeds below 1000: `can_imm.studies.roadside_tuning`."""


@dataclass(frozen=True)
class Result:
    """What one system said in all runs.

    Attributes:
        system: its name.
        settings: of the tracker.
        x: (R, N, 4) estimated x, vx, y, vy; NaN before there is a track.
        p_turn: (R, N) probability of constant turn.
    """

    system: str
    settings: RoadsideSettings
    x: FloatArray
    p_turn: FloatArray


@dataclass(frozen=True)
class Study:
    """All systems on the same runs; the truth is that of every run."""

    seed: int
    scene: RoadsideScene
    run: RoadsideRun
    results: list[Result]

    @property
    def t_s(self) -> FloatArray:
        """(N,) times of the scans [s]."""
        return np.multiply(self.run.t_ns, 1e-9)

    @property
    def bend(self) -> BoolArray:
        """(N,) the vehicle turns."""
        return np.not_equal(self.run.turn_rate, 0.0)

    @property
    def judged(self) -> BoolArray:
        """(N,) the first second is over."""
        return self.t_s >= SETTLE_S


def track(settings: RoadsideSettings, run: RoadsideRun) -> tuple[FloatArray, FloatArray]:
    """Follow one run: estimated states (N, 4) and probabilities of constant turn (N,)."""
    tracker = RoadsideTracker(
        replace(settings, gate=math.inf, coast_s=math.inf, confirm=1, max_outliers=len(run.scans))
    )
    x, p_turn = np.full((len(run.scans), 4), np.nan), np.full(len(run.scans), np.nan)
    for k, scan in enumerate(run.scans):
        said = tracker.step(scan.t_ns, scan)
        if said is not None and said.n:
            x[k], p_turn[k] = said.z[0], tracker.turning
    return x, p_turn


def study(
    runs: int,
    seed: int = FIRST_SEED,
    *,
    systems: dict[str, RoadsideSettings] | None = None,
    scene: RoadsideScene | None = None,
    progress: Callable[[], None] = lambda: None,
) -> Study:
    """Run every system on the same detections.

    Args:
        runs: number of seeds.  seed: the first of them.
        systems: names and settings, default `SYSTEMS`.
        scene: default the published one.
        progress: called after each run.
    """
    scene = scene or load_scene()
    systems = SYSTEMS if systems is None else systems
    said: dict[str, list[tuple[FloatArray, FloatArray]]] = {name: [] for name in systems}
    for k in range(runs):
        run = play_scene(scene, np.random.default_rng(seed + k))
        if k == 0:
            first = run
        for name, settings in systems.items():
            said[name].append(track(settings, run))
        progress()
    results = [
        Result(name, systems[name], *(np.array(column) for column in zip(*rows, strict=True)))
        for name, rows in said.items()
    ]
    return Study(seed, scene, first, results)


def squared_errors(x: FloatArray, state: FloatArray) -> dict[str, FloatArray]:
    """Squares of `ERRORS` for states (..., 4) against the true ones (N, 4)."""
    e = x - state
    speeds = np.hypot(x[..., VX], x[..., VY]) - np.hypot(state[..., VX], state[..., VY])
    return {
        "position": e[..., X] ** 2 + e[..., Y] ** 2,
        "speed": speeds**2,
        "velocity": e[..., VX] ** 2 + e[..., VY] ** 2,
    }


def per_run(done: Study, result: Result) -> dict[str, FloatArray]:
    """Every measure of a system, one value per run (R,).

    The RMS `ERRORS`; ``p_turn_bend`` and ``p_turn_straight``, means of the probability of constant
    turn; ``delay_s`` from the beginning of the bend to the first scan in it that detects it, NaN
    where none does; ``missed``, 1 there; ``false_alarms``, the share of the scans on straights that
    detect a bend.  All after the first second.  Without a constant-turn model only the errors.
    """
    judged, bend = done.judged, done.bend
    squares = squared_errors(result.x, done.run.state)
    values = {name: np.sqrt(square[:, judged].mean(axis=1)) for name, square in squares.items()}
    if not any(model.kind == ukf.CT for model in result.settings.models):
        return values
    inside, straight = bend & judged, ~bend & judged
    detected = result.p_turn > DETECTED
    values["p_turn_straight"] = result.p_turn[:, straight].mean(axis=1)
    values["false_alarms"] = detected[:, straight].mean(axis=1)
    if inside.any():
        values["p_turn_bend"] = result.p_turn[:, inside].mean(axis=1)
        found = detected[:, inside].any(axis=1)
        after = done.t_s[inside] - done.t_s[inside][0]
        values["delay_s"] = np.where(found, after[detected[:, inside].argmax(axis=1)], np.nan)
        values["missed"] = 1.0 - found
    return values


def mean_and_error(values: FloatArray) -> tuple[float, float]:
    """Mean and its standard error of the values that exist; NaN where there are too few."""
    known = values[np.isfinite(values)]
    n = len(known)
    mean = float(known.mean()) if n else math.nan
    return mean, float(known.std(ddof=1) / math.sqrt(n)) if n > 1 else math.nan


def reduction(of: FloatArray, against: FloatArray) -> tuple[float, float]:
    """1 - mean(of) / mean(against), paired by run, and its standard error (linearised)."""
    ratio = float(of.mean() / against.mean())
    _, error = mean_and_error((of - ratio * against) / against.mean())
    return 1.0 - ratio, error


def to_json(done: Study) -> dict[str, Any]:
    """The study as a JSON object; a value that does not exist is None.

    Means over runs with their standard errors under ``"se"``.  ``"reduction"`` is that of a
    system's RMSE against those of the systems before it.
    """
    values = {result.system: per_run(done, result) for result in done.results}
    return {
        "runs": len(done.results[0].x),
        "seed": done.seed,
        "results": [_result(result, values) for result in done.results],
    }


def _result(result: Result, values: dict[str, dict[str, FloatArray]]) -> dict[str, Any]:
    mine = values[result.system]
    summary = {name: mean_and_error(value) for name, value in mine.items()}
    before = list(values)[: list(values).index(result.system)]
    less = {
        other: {name: reduction(mine[name], values[other][name]) for name in ERRORS}
        for other in before
    }
    fields = [
        {
            **{name: _known(value[i]) for name, value in summary.items() if name not in ERRORS},
            "rmse": {name: _known(summary[name][i]) for name in ERRORS},
            "reduction": {
                other: {name: _known(value[i]) for name, value in row.items()}
                for other, row in less.items()
            },
        }
        for i in (0, 1)
    ]
    return {
        "system": result.system,
        "setting": _setting(result.settings),
        **fields[0],
        "se": fields[1],
    }


def _setting(settings: RoadsideSettings) -> dict[str, Any]:
    names = {ukf.CV: "cv", ukf.CT: "ct"}
    models: Sequence[dict[str, Any]] = [
        {**asdict(model), "kind": names[model.kind]} for model in settings.models
    ]
    return {
        "models": models,
        "transitions": settings.transitions,
        "birth": settings.birth,
        "period_s": settings.period_s,
    }


def _known(value: float) -> float | None:
    return round(value, 6) if math.isfinite(value) else None
