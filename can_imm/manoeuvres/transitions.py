"""Which mode follows which: from the modes' dwell times, or from a matrix and its period."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from can_imm.estimation.models import (
    generator_from_dwell,
    generator_from_matrix,
    transition_table,
)
from can_imm.tables import Table, show
from can_imm.types import FloatArray


def transitions_from_dwell(
    modes: Sequence[Table], names: Sequence[str], step_s: float, n_steps: int
) -> FloatArray:
    """Pi (n_steps, M, M) from ``dwell_s`` and ``next`` of each mode.

    Raises:
        CanImmError: one of them is missing or wrong, or no mode follows.
    """
    dwell = [mode.number("dwell_s", low=0.01) for mode in modes]
    weights = np.zeros((len(names), len(names)))
    for i, mode in enumerate(modes):
        following = mode.table("next")
        for target in following:
            if target not in names or target == names[i]:
                raise following.error(f"{show(target)} is no other mode")
            weights[i, names.index(target)] = following.number(target, low=0.0)
        if not weights[i].sum() > 0:
            raise following.error("no mode follows")
    return transition_table(generator_from_dwell(np.array(dwell), weights), step_s, n_steps)


def transitions_from_matrix(
    table: Table, names: Sequence[str], step_s: float, n_steps: int
) -> FloatArray:
    """Pi (n_steps, M, M) from the probabilities ``matrix`` over ``period_s``.

    Raises:
        CanImmError: no matrix of probabilities, or one of no Markov chain in continuous time.
    """
    Pi = _matrix(table, names)
    period = table.number("period_s", low=0.01)
    table.done()
    G = generator_from_matrix(Pi, period)
    if not np.abs(transition_table(G, period, 2)[1] - Pi).max() < 0.05:
        raise table.error("'matrix' is not near to any Markov chain in continuous time")
    result = transition_table(G, step_s, n_steps)
    at = round(period / step_s)
    if 0 < at < n_steps and math.isclose(at * step_s, period):
        result[at] = Pi  # as printed where it was meant
    return result


def _matrix(table: Table, names: Sequence[str]) -> FloatArray:
    rows = table.values("matrix")
    m = len(names)
    if len(rows) != m or any(not isinstance(r, list) or len(r) != m for r in rows):
        raise table.error(f"'matrix' must be {m} x {m}, one row and one column per mode")
    for name, row in zip(names, rows, strict=True):
        for entry in row:
            if type(entry) not in (int, float) or not 0.0 <= entry <= 1.0:
                raise table.error(f"row {show(name)} of 'matrix': {show(entry)} is no probability")
        if abs(sum(row) - 1.0) > 1e-9:
            raise table.error(f"row {show(name)} of 'matrix' sums to {sum(row):.6g}, not to 1")
    return np.array(rows, float)
