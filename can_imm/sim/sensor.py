"""The abstract sensor: it measures x, vx, y and vy of every object, with noise and gaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np

from can_imm.sim.truth import Truth
from can_imm.types import CanImmError, Scan


@dataclass(frozen=True, slots=True)
class SensorModel:
    """White Gaussian noise on the whole state (H = I, eq. (34)), and what gets lost.

    Attributes:
        std: standard deviation of x, vx, y, vy [m, m/s, m, m/s].
        period_ns: time between scans, a multiple of the truth's sampling time [ns].
        missed: probability that one object is missing from a scan.
        dropout: probability that a whole scan is missing.

    Raises:
        CanImmError: a value outside its range.
    """

    std: tuple[float, float, float, float] = (0.1, 0.3, 0.2, 0.3)
    period_ns: int = 100_000_000
    missed: float = 0.0
    dropout: float = 0.0

    def __post_init__(self) -> None:
        if len(self.std) != 4 or not all(isfinite(s) and s > 0 for s in self.std):
            raise CanImmError(f"sensor: std must be four numbers above 0, not {self.std}")
        if self.period_ns <= 0:
            raise CanImmError(f"sensor: period_ns must be above 0, not {self.period_ns}")
        for name in ("missed", "dropout"):
            if not 0.0 <= getattr(self, name) < 1.0:
                raise CanImmError(
                    f"sensor: {name} must be a probability below 1, not {getattr(self, name)}"
                )


def measure(truths: Sequence[Truth], sensor: SensorModel, rng: np.random.Generator) -> list[Scan]:
    """Measure the objects at t = 0 and every period from then on, until the last object's end.

    An object that has reached its end is no longer seen; a scan may hold no object at all.
    ``counter`` counts the scans that were due, so a dropout leaves a gap in it (the codec cuts it
    to the width that it has on the bus).  ``new`` is set where an object is seen for the first
    time.  The same generator gives the same noise whatever the loss rates are.

    Args:
        truths: one per object, all with the same sampling time.
        sensor: the noise and loss model.
        rng: where the noise comes from.

    Returns:
        the scans in order of time.

    Raises:
        CanImmError: the period is not a multiple of the truths' sampling time.
    """
    for truth in truths:
        if sensor.period_ns % truth.dt_ns:
            raise CanImmError(
                f"sensor: period_ns must be a multiple of {truth.dt_ns}, not {sensor.period_ns}"
            )
    samples = [truth.state[:: sensor.period_ns // truth.dt_ns] for truth in truths]
    n_scans = max((len(s) for s in samples), default=0)
    noise = rng.standard_normal((n_scans, len(truths), 4)) * sensor.std
    missed = rng.random((n_scans, len(truths))) < sensor.missed
    dropped = rng.random(n_scans) < sensor.dropout
    seen: set[int] = set()
    scans = []
    for k in np.flatnonzero(~dropped).tolist():
        scan = Scan(len(truths))
        scan.t_ns = k * sensor.period_ns
        scan.counter = k
        for i, truth in enumerate(truths):
            if k >= len(samples[i]) or missed[k, i]:
                continue
            row = scan.n
            scan.ids[row] = truth.object_id
            scan.z[row] = samples[i][k] + noise[k, i]
            scan.std[row] = sensor.std
            scan.valid[row] = True
            scan.new[row] = truth.object_id not in seen
            seen.add(truth.object_id)
            scan.n += 1
        scans.append(scan)
    return scans
