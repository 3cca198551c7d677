"""How the constants of the roadside study were found: ``can-imm study tune-roadside``.

On the published scene, seeds below `runs.FIRST_SEED`.  The constant-velocity filter has one number:
the noise with the least position error of a grid.  The IMM's are found by a random search over what
the systems are compared by, with a floor under all noise: the scene's vehicle keeps to the models
exactly, a real one doesn't, and noise that is too small loses it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from can_imm.estimation import ukf
from can_imm.studies.roadside import cv, mean_and_error, per_run, study
from can_imm.studies.runs import FIRST_SEED
from can_imm.trackers.roadside import IMM_UKF, Motion, RoadsideSettings
from can_imm.types import FloatArray

LEAST_Q = 0.001
"""Floor of the acceleration's spectral density [m²/s³]: 0.03 m/s² in a second."""
LEAST_Q_TURN = 0.001
"""Floor of the turn rate's [rad²/s³]: 0.03 rad/s in a second."""
LEAST_TURN_STD = 0.15
"""Floor of the spread of turn rates [rad/s]: not only the bend of this scene is one."""

_DENSITIES = (0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)
_TRIES = 150
_SPREAD = 0.4
"""Standard deviation of a step of the search, of the logarithms."""


@dataclass(frozen=True)
class Tuning:
    """What was found, and what is minimised on seeds used and not used for it."""

    q: float
    imm: RoadsideSettings
    cost_tuned: float
    cost_checked: float
    cost_constants: float


def numbers(settings: RoadsideSettings) -> FloatArray:
    """The eight numbers (8,) of the straight and the mirrored turns; the last model is fixed."""
    straight, left = settings.models[:2]
    Pi = settings.transitions
    return np.array(
        [straight.q, left.q, left.q_turn, *left.turn, Pi[0][1], Pi[1][0], Pi[1][2]], np.float64
    )


def settings(values: FloatArray) -> RoadsideSettings:
    """The inverse of `numbers`, above the floors and with transitions that leave a mode alive."""
    q, q_bend, q_turn, turn, std, enter, leave, change = (float(f"{v:.3g}") for v in values)
    q, q_bend = max(q, LEAST_Q), max(q_bend, LEAST_Q)
    q_turn, std = max(q_turn, LEAST_Q_TURN), max(std, LEAST_TURN_STD)
    enter, leave, change = min(enter, 0.1), min(leave, 0.2), min(change, 0.01)
    free = IMM_UKF.transitions[0][3]
    stay = round(1.0 - leave - change - free, 9)
    return replace(
        IMM_UKF,
        models=(
            Motion(ukf.CV, q, 1e-4, (0.0, 0.01)),
            Motion(ukf.CT, q_bend, q_turn, (turn, std)),
            Motion(ukf.CT, q_bend, q_turn, (-turn, std)),
            IMM_UKF.models[3],
        ),
        transitions=(
            (round(1.0 - 2.0 * enter - free, 9), enter, enter, free),
            (leave, stay, change, free),
            (leave, change, stay, free),
            IMM_UKF.transitions[3],
        ),
    )


def cost(candidate: RoadsideSettings, seeds: Sequence[int]) -> float:
    """Delay and errors in units of what is asked for, with penalties beyond the limits."""
    if max(seeds) >= FIRST_SEED:
        raise ValueError(f"seeds from {FIRST_SEED} on are for reporting")
    done = study(len(seeds), seeds[0], systems={"candidate": candidate})
    values = {k: mean_and_error(v)[0] for k, v in per_run(done, done.results[0]).items()}
    errors = (values["position"] / 0.36, values["speed"] / 0.2, values["velocity"] / 0.67)
    return (
        2.0 * values["delay_s"] / 0.3
        + values["p_turn_straight"]
        + 0.1 * sum(errors)
        + 40.0 * max(0.0, values["p_turn_straight"] - 0.19)
        + 20.0 * max(0.0, 0.865 - values["p_turn_bend"])
        + 10.0 * max(0.0, max(errors) - 0.92)
    )


def tune_cv(seeds: Sequence[int]) -> float:
    """The noise density with the least position error."""
    done = study(len(seeds), seeds[0], systems={f"{q:g}": cv(q) for q in _DENSITIES})
    errors = [per_run(done, result)["position"].mean() for result in done.results]
    return _DENSITIES[int(np.argmin(errors))]


def tune_imm(
    seeds: Sequence[int], rng: np.random.Generator, progress: Callable[[float], None]
) -> tuple[float, RoadsideSettings]:
    """Random search around the constants in use; ``progress`` is called with the best so far."""
    best, found = cost(IMM_UKF, seeds), IMM_UKF
    for _ in range(_TRIES):
        step = _SPREAD * rng.standard_normal(8) * (rng.random(8) < 0.4)
        candidate = settings(numbers(found) * np.exp(step))
        value = cost(candidate, seeds)
        if value < best:
            best, found = value, candidate
        progress(best)
    return best, found


def tune(runs: int, progress: Callable[[float], None] = lambda _: None) -> Tuning:
    """Tune on seeds 0 to ``runs`` - 1, check on as many from `FIRST_SEED` / 2 on."""
    half = FIRST_SEED // 2
    check = range(half, half + runs)
    best, found = tune_imm(range(runs), np.random.default_rng(0), progress)
    return Tuning(
        q=tune_cv(range(runs)),
        imm=found,
        cost_tuned=best,
        cost_checked=cost(found, check),
        cost_constants=cost(IMM_UKF, check),
    )
