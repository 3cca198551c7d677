"""How an object moves in a mode: the motion table of each axis as one-step F and Q."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np

from can_imm.estimation.models import discretise
from can_imm.tables import Table
from can_imm.types import FloatArray

Matrices = tuple[FloatArray, FloatArray]


def read_motion(mode: Table, states: Sequence[str], dt: float) -> Matrices:
    """F and Q (n, n) over ``dt`` [s] of a mode: the two axes are independent.

    Raises:
        CanImmError: no such model, or a parameter that is wrong.
    """
    n = len(states)
    F = np.eye(n)
    Q = np.zeros((n, n))
    for axis in ("x", "y"):
        where = [states.index(s) for s in (axis, f"v{axis}", f"a{axis}") if s in states]
        table = mode.table(axis)
        model = table.choice("model", _MODELS)
        F[np.ix_(where, where)], Q[np.ix_(where, where)] = model(table, len(where), dt)
        table.done()
    return F, Q


def constant_speed(n: int, dt: float) -> Matrices:
    """F and Q (n, n) of the particle mode, whose particles bring their own noise."""
    F = np.eye(n)
    F[0, 1] = F[2, 3] = dt
    return F, np.zeros((n, n))


def _constant_velocity(table: Table, n: int, dt: float) -> Matrices:
    """White-noise acceleration of spectral density q [m^2/s^3]."""
    return _discrete_cv(table, table.number("q", low=0.0), n, dt)


def _equation_33(table: Table, n: int, dt: float) -> Matrices:
    """Constant velocity with Q as printed in the paper's equation (33), per prediction step."""
    F, Q = _discrete_cv(table, 1.0, n, dt)
    Q = Q.copy()
    Q[:2, :2] = np.diag([dt**2 / 2.0, dt])
    return F, Q


def _damped(table: Table, n: int, dt: float) -> Matrices:
    """A speed that forgets itself in tau, as of a vehicle that wanders about in its lane."""
    tau = table.number("tau_s", low=0.01)
    sigma = table.number("speed_std", low=0.0)
    return _discrete_cv(table, 2.0 * sigma**2 / tau, n, dt, 1.0 / tau)


def _discrete_cv(table: Table, q: float, n: int, dt: float, damping: float = 0.0) -> Matrices:
    A = np.zeros((n, n))
    W = np.zeros((n, n))
    A[0, 1] = 1.0
    A[1, 1] = -damping
    W[1, 1] = q
    if n == 3:
        # no acceleration in this model: the state decays at once and keeps its prior spread
        sigma = table.number("acceleration_std", 1.0, low=0.0)
        A[2, 2] = -50.0
        W[2, 2] = 100.0 * sigma**2
    return _discretised(A.tobytes(), W.tobytes(), n, dt)


def _singer(table: Table, n: int, dt: float) -> Matrices:
    """Acceleration that forgets itself in tau (Singer 1970)."""
    if n != 3:
        raise table.error("model 'singer' needs the axis' acceleration among the states")
    tau = table.number("tau_s", low=0.01)
    sigma = table.number("acceleration_std", low=0.0)
    A = np.zeros((n, n))
    W = np.zeros((n, n))
    A[0, 1] = A[1, 2] = 1.0
    A[2, 2] = -1.0 / tau
    W[2, 2] = 2.0 * sigma**2 / tau
    W[1, 1] = table.number("q", 0.0, low=0.0)
    return _discretised(A.tobytes(), W.tobytes(), n, dt)


@lru_cache(maxsize=256)
def _discretised(A: bytes, W: bytes, n: int, dt: float) -> Matrices:
    """`discretise`, which takes most of the time of loading a bank: its modes have a lot in common.

    The matrices by their bytes; the result is everybody's and must not be changed.
    """
    return discretise(np.frombuffer(A).reshape(n, n), np.frombuffer(W).reshape(n, n), dt)


_MODELS: dict[str, Callable[[Table, int, float], Matrices]] = {
    "constant-velocity": _constant_velocity,
    "damped": _damped,
    "singer": _singer,
    "equation-33": _equation_33,
}
