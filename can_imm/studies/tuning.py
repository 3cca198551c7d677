"""How the constants of `baselines` were found: ``can-imm study tune-rules``.

Tuned on the truths A, B, S and on random scenarios, all on seeds below `runs.FIRST_SEED`.  The
rules' measure is the share of wrong frames: half of it the mean of A, B and S, half of it that of
the random scenarios.  The Kalman filter's is its RMSE in units of the sensor's noise, averaged in
the same way over the four states.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from can_imm.studies import descent
from can_imm.studies.baselines import (
    RULES,
    Noise,
    Rules,
    apply_rules,
    white_noise_acceleration,
)
from can_imm.studies.runs import FIRST_SEED, TRUTHS, play
from can_imm.types import FloatArray, X, Y

Int8Array = npt.NDArray[np.int8]
Int64Array = npt.NDArray[np.int64]

WEIGHTS = {"A": 1 / 6, "B": 1 / 6, "S": 1 / 6, "random": 1 / 2}
"""Of each truth in what is minimised: the same for the published scenario and for random ones."""

_STEPS = (0.3, 0.15, 0.07, 0.03)
"""Relative steps of the search, coarse to fine."""
_CHOICES = {
    "out_of_right_lane": (False, True),
    "hysteresis": (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5),
    "dwell": (1, 2, 3, 4),
}
"""Values tried for what is not a threshold."""
_STARTS = 20
"""Starting points of the search: the constants as they stand, and random ones around them."""
_SPREAD = 0.35
"""Standard deviation of the random starting points' logarithms."""
_DENSITIES = np.geomspace(0.05, 5.0, 47)
"""Spectral densities tried for the Kalman filter [m²/s³]."""


@dataclass(frozen=True)
class Data:
    """Runs of one truth or of several, padded with zeros to the longest.

    Attributes:
        z, state: (R, N, 4) measurements and true states [m, m/s, m, m/s].
        label: (R, N) true `Manoeuvre` values.
        length: (R,) frames in use.
        std: (4,) of the measurements.
        dt: time between frames [s].
    """

    z: FloatArray
    state: FloatArray
    label: Int8Array
    length: Int64Array
    std: FloatArray
    dt: float


def collect(truth: str, seeds: Sequence[int]) -> Data:
    """Simulate and measure one run per seed (sensor without losses)."""
    if max(seeds) >= FIRST_SEED:
        raise ValueError(f"seeds from {FIRST_SEED} on are for reporting")
    seen = [one for seed in seeds for one in play(truth, seed)[1]]
    length = np.array([len(one.t_ns) for one in seen])
    n = int(length.max())
    z, state = np.zeros((len(seen), n, 4)), np.zeros((len(seen), n, 4))
    label = np.zeros((len(seen), n), np.int8)
    for k, one in enumerate(seen):
        z[k, : length[k]] = one.z
        state[k, : length[k]] = one.state
        label[k, : length[k]] = one.label
    dt = float(seen[0].t_ns[1] - seen[0].t_ns[0]) * 1e-9
    return Data(z, state, label, length, seen[0].std, dt)


def filter_all(data: Data, noise: Noise) -> FloatArray:
    """The filter of `baselines.kalman` on all runs at once: means (R, N, 4).

    All runs share one covariance, because none misses a measurement.
    """
    F, Q = white_noise_acceleration(data.dt, noise)
    R = np.diag(data.std**2)
    out = np.empty_like(data.z)
    P = R
    out[:, 0] = data.z[:, 0]
    for k in range(1, data.z.shape[1]):
        P = F @ P @ F.T + Q
        K = P @ np.linalg.inv(P + R)
        P = P - K @ P
        prior = out[:, k - 1] @ F.T
        out[:, k] = prior + (data.z[:, k] - prior) @ K.T
    return out


@njit(cache=True)
def _wrong_frames(x: FloatArray, label: Int8Array, length: Int64Array, rules: Rules) -> float:
    total = 0.0
    for k in range(len(x)):
        n = length[k]
        total += np.mean(apply_rules(x[k, :n], rules) != label[k, :n])
    return total / len(x)


class Objective:
    """Share of wrong frames of a set of rules; remembers the filtered states by noise."""

    def __init__(self, data: dict[str, Data]) -> None:
        self._data = data
        self._filtered = lru_cache(maxsize=64)(lambda truth, noise: filter_all(data[truth], noise))

    def per_truth(self, rules: Rules) -> dict[str, float]:
        noise = Noise(rules.q_along, rules.q_across)
        return {
            truth: _wrong_frames(self._filtered(truth, noise), d.label, d.length, rules)
            for truth, d in self._data.items()
        }

    def __call__(self, rules: Rules) -> float:
        return sum(WEIGHTS[truth] * v for truth, v in self.per_truth(rules).items())


def descend(objective: Callable[[Rules], float], rules: Rules) -> tuple[float, Rules]:
    """One threshold at a time, until no step of any size helps."""
    return descent.descend(objective, rules, steps=_STEPS, choices=_CHOICES)


def tune_rules(
    data: dict[str, Data], rng: np.random.Generator, progress: Callable[[float], None]
) -> Rules:
    """Minimise the share of wrong frames; ``progress`` is called with the best so far."""
    objective = Objective(data)
    best, rules = np.inf, RULES
    for start in range(_STARTS):
        scale = np.exp(_SPREAD * rng.standard_normal(len(Rules._fields))) if start else None
        error, found = descend(objective, RULES if scale is None else _scaled(RULES, scale))
        if error < best:
            best, rules = error, found
        progress(best)
    return rules._replace(
        **{n: round(v, 3) for n, v in rules._asdict().items() if n not in _CHOICES}
    )


def _scaled(rules: Rules, scale: FloatArray) -> Rules:
    values: dict[str, Any] = {
        name: getattr(rules, name) * factor
        for name, factor in zip(Rules._fields, scale.tolist(), strict=True)
        if name not in _CHOICES
    }
    return rules._replace(**values)


def wrong_frames(data: dict[str, Data], rules: Rules) -> dict[str, float]:
    """Share of wrong frames of these rules, by truth."""
    return Objective(data).per_truth(rules)


def relative_rmse(data: dict[str, Data], noise: Noise) -> FloatArray:
    """RMSE of the Kalman filter in units of the sensor's noise, averaged over truths: (4,)."""
    total = np.zeros(4)
    for truth, d in data.items():
        error = filter_all(d, noise) - d.state
        used = np.arange(error.shape[1]) < d.length[:, None]
        total += WEIGHTS[truth] * np.sqrt(np.mean(error[used] ** 2, axis=0)) / d.std
    return total


def tune_noise(data: dict[str, Data]) -> Noise:
    """The process noise with the least mean relative RMSE; the axes do not touch each other."""
    tried = np.array([relative_rmse(data, Noise(q, q)) for q in _DENSITIES.tolist()])
    along, across = (
        _DENSITIES[np.argmin(tried[:, axis].sum(axis=1))] for axis in (slice(X, Y), slice(Y, None))
    )
    return Noise(round(float(along), 3), round(float(across), 3))


@dataclass(frozen=True)
class Tuning:
    """What was found, and the share of wrong frames by truth on seeds used and not used for it."""

    noise: Noise
    rules: Rules
    wrong_tuned: dict[str, float]
    wrong_checked: dict[str, float]
    wrong_constants: dict[str, float]


def tune(runs: int, progress: Callable[[float], None] = lambda _: None) -> Tuning:
    """Tune on seeds 0 to ``runs`` - 1, check on as many from `FIRST_SEED` / 2 on."""
    tuning = {truth: collect(truth, range(runs)) for truth in TRUTHS}
    half = FIRST_SEED // 2
    check = {truth: collect(truth, range(half, half + runs)) for truth in TRUTHS}
    rules = tune_rules(tuning, np.random.default_rng(0), progress)
    return Tuning(
        noise=tune_noise(tuning),
        rules=rules,
        wrong_tuned=wrong_frames(tuning, rules),
        wrong_checked=wrong_frames(check, rules),
        wrong_constants=wrong_frames(check, RULES),
    )
