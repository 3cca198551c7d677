"""One simulated run as a study sees it: scans, and per object what was true at each of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from can_imm.sim.random import random_scenario
from can_imm.sim.scenario import load_scenario
from can_imm.sim.sensor import SensorModel, measure
from can_imm.sim.truth import Truth, simulate
from can_imm.types import BoolArray, FloatArray, Scan

Int8Array = npt.NDArray[np.int8]
Int64Array = npt.NDArray[np.int64]

TRUTHS = ("A", "B", "S", "random")
"""Three readings of the published scenario, and random scenarios."""

FIRST_SEED = 1000
"""Default first seed of a study.  Nothing was tuned on seeds from here on."""


@dataclass(frozen=True)
class Observation:
    """One object as the sensor saw it, one row per scan from its first to the end of its truth.

    Attributes:
        truth: what was true, every 10 ms.
        at: (N,) the truth's samples at the scans.
        t_ns: (N,) times of the scans [ns].
        z: (N, 4) measurements [m, m/s, m, m/s]; a row that was not seen repeats the last one.
        seen: (N,) the object was in the scan.
        std: (4,) standard deviations of ``z``.
    """

    truth: Truth
    at: Int64Array
    t_ns: Int64Array
    z: FloatArray
    seen: BoolArray
    std: FloatArray

    @property
    def label(self) -> Int8Array:
        """(N,) true `Manoeuvre` values at the scans."""
        return self.truth.label[self.at]

    @property
    def state(self) -> FloatArray:
        """(N, 4) true states at the scans."""
        return self.truth.state[self.at]


def observe(truth: Truth, scans: Sequence[Scan]) -> Observation:
    """Collect one object's measurements from the scans of a run.

    Raises:
        ValueError: the sensor never saw the object.
    """
    t_ns: list[int] = []
    z: list[FloatArray] = []
    seen: list[bool] = []
    std = np.ones(4)
    for scan in scans:
        rows = np.flatnonzero(scan.ids[: scan.n] == truth.object_id)
        if scan.t_ns > truth.t_ns[-1] or not (z or rows.size):
            continue
        t_ns.append(scan.t_ns)
        seen.append(bool(rows.size))
        z.append(scan.z[rows[0]] if rows.size else z[-1])
        if rows.size:
            std = scan.std[rows[0]]
    if not z:
        raise ValueError(f"object {truth.object_id} was never seen")
    times = np.array(t_ns, np.int64)
    return Observation(truth, times // truth.dt_ns, times, np.array(z), np.array(seen), std)


@lru_cache
def _paper_truths(truth: str) -> list[Truth]:
    return simulate(load_scenario(f"paper-{truth.lower()}"))


def play(truth: str, seed: int) -> tuple[list[Scan], list[Observation]]:
    """Simulate and measure one run; ``truth`` is one of `TRUTHS`."""
    rng = np.random.default_rng(seed)
    truths = simulate(random_scenario(rng)) if truth == "random" else _paper_truths(truth)
    scans = measure(truths, SensorModel(), rng)
    return scans, [observe(one, scans) for one in truths]
