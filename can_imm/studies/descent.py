"""Coordinate descent over the constants of a set of rules."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, TypeVar

R = TypeVar("R", bound=Any)
"""A named tuple of constants."""


def descend(
    objective: Callable[[R], float],
    rules: R,
    *,
    steps: Sequence[float],
    choices: Mapping[str, Sequence[Any]],
    fixed: Collection[str] = (),
    least: float = 1e-6,
) -> tuple[float, R]:
    """One constant at a time, until no step of any size helps.

    Args:
        objective: what is minimised.
        rules: where to start.
        steps: relative steps, coarse to fine.
        choices: values tried for the constants that are no thresholds.
        fixed: constants that stay.
        least: a smaller gain is none.

    Returns:
        The least value found, and the rules that have it.
    """
    best = objective(rules)
    for step in steps:
        moved = True
        while moved:
            moved = False
            for name in rules._fields:
                if name in fixed:
                    continue
                now = getattr(rules, name)
                for value in choices.get(name, (now * (1.0 + step), now / (1.0 + step))):
                    if value == now:
                        continue
                    candidate = rules._replace(**{name: value})
                    error = objective(candidate)
                    if error < best - least:
                        best, rules, moved = error, candidate, True
    return best, rules
