"""Mode banks for the kernels, written into the records by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
from oracles.gaussian import random_covariance
from oracles.imm import Imm, Mode

from can_imm.estimation import layout
from can_imm.estimation.entry import Processor
from can_imm.estimation.noise import noise_state
from can_imm.estimation.particles import N_COLUMNS, N_SCRATCH


def blank(n_modes: int, n_states: int) -> np.ndarray[Any, Any]:
    """A bank (1,) of modes without constraints that stand still; floor of the probabilities 0."""
    bank = np.zeros(1, layout.BANK_DTYPE)
    record = bank[0]
    record["n_modes"], record["n_states"] = n_modes, n_states
    record["F"][:, :, range(6), range(6)] = 1.0
    record["Pi"][:, :n_modes, :n_modes] = np.eye(n_modes)
    record["mu0"][:n_modes] = 1.0 / n_modes
    record["birth_std"] = 1.0
    record["jump_std"] = 1.0
    record["step_s"] = 0.01
    record["var_floor"] = 1e-12
    record["lane_width"] = 3.0
    record["entry_var"] = -1.0
    record["manoeuvre"][:n_modes] = 1
    return bank


def add_soft(
    bank: np.ndarray[Any, Any], j: int, state: int, value: float, r: float, lanes: Any = None
) -> None:
    record = bank[0]
    c = record["n_soft"][j]
    record["n_soft"][j] += 1
    record["soft_state"][j, c] = state
    record["soft_value"][j, c] = value
    record["soft_r"][j, c] = r
    if lanes is not None:
        record["soft_kind"][j, c] = layout.LANE
        record["soft_lanes"][j, c] = lanes


def add_bound(
    bank: np.ndarray[Any, Any],
    j: int,
    state: int,
    lower: float,
    upper: float,
    *,
    mass: bool = False,
    lanes: Any = None,
) -> None:
    record = bank[0]
    c = record["n_bounds"][j]
    record["n_bounds"][j] += 1
    record["bound_state"][j, c] = state
    record["bound_lower"][j, c] = lower
    record["bound_upper"][j, c] = upper
    record["bound_mass"][j, c] = mass
    if lanes is not None:
        record["bound_kind"][j, c] = layout.LANE
        record["bound_lanes"][j, c] = lanes


class Runner:
    """`Processor` with its buffers, for tests that go object by object or all at once."""

    def __init__(
        self, bank: np.ndarray[Any, Any], capacity: int, n_particles: int = 0, seed: int = 0
    ) -> None:
        self.bank = bank
        self.objects = np.zeros(capacity, layout.OBJECT_DTYPE)
        self.work = np.zeros(1, layout.WORK_DTYPE)
        self.particles = np.zeros((capacity, N_COLUMNS, n_particles))
        self.spare = np.zeros((N_SCRATCH, n_particles))
        self.weights = np.zeros(n_particles)
        self.noise = noise_state(np.random.default_rng(seed))

    def scan(
        self,
        slots: Any,
        steps: Any,
        z: Any,
        r: Any,
        valid: Any = None,
        age: float = 0.0,
        gate: float = np.inf,
        angle: float = 0.0,
        ground: float = layout.UNKNOWN_GROUND,
        lane_width: float = 0.0,
    ) -> np.ndarray[Any, Any]:
        """One scan; returns the status of each row."""
        n = len(slots)
        z = np.array(z, float).reshape(n, 4)
        status = np.full(n, 77, np.int8)
        valid = np.ones(z.shape, np.bool_) if valid is None else np.array(valid).reshape(n, 4)
        processor = Processor(
            gate, bank=self.bank, objects=self.objects, work=self.work,
            slot=np.array(slots, np.int32), steps=np.array(steps, np.int32), z=z,
            r=np.broadcast_to(np.asarray(r, float), z.shape).copy(), valid=valid,
            angle=np.full(n, float(angle)), particles=self.particles, spare=self.spare,
            weights=self.weights, noise=self.noise, status=status,
        )  # fmt: skip
        processor.run(processor.address, n, float(ground), float(lane_width), float(age))
        return status


def random_chain(rng: np.random.Generator, n: int) -> np.ndarray[Any, Any]:
    """A transition matrix that is not symmetric and favours staying."""
    Pi = rng.uniform(0.0, 1.0, (n, n)) + 3.0 * np.eye(n)
    return np.asarray(Pi / Pi.sum(axis=1, keepdims=True))


def random_pair(seed: int, n_modes: int, n: int) -> tuple[np.ndarray[Any, Any], Runner, Imm]:
    """The same random problem for the kernels (one object in slot 0) and for the oracle.

    Five steps are one cycle; returns Pi of it, too.
    """
    rng = np.random.default_rng(seed)
    bank = blank(n_modes, n)
    record = bank[0]
    Pi = random_chain(rng, n_modes)
    record["Pi"][5, :n_modes, :n_modes] = Pi
    modes = []
    for j in range(n_modes):
        F = np.eye(n) + 0.2 * rng.normal(size=(n, n))
        Q = 0.1 * random_covariance(rng, n)
        record["F"][5, j, :n, :n], record["Q"][5, j, :n, :n] = F, Q
        modes.append(Mode(F, Q))
    oracle = Imm(
        modes,
        [rng.normal(0.0, 1.0, n) for _ in modes],
        [random_covariance(rng, n) for _ in modes],
        rng.dirichlet(np.ones(n_modes)),
    )
    runner = Runner(bank, 1)
    copy_state(oracle, runner.objects[0])
    return Pi, runner, oracle


def copy_state(oracle: Imm, obj: Any) -> None:
    """Write the oracle's estimate into an object's record."""
    n = len(oracle.x[0])
    for j, (x, P) in enumerate(zip(oracle.x, oracle.P, strict=True)):
        obj["x"][j, :n], obj["P"][j, :n, :n] = x, P
    obj["mu"][: len(oracle.x)] = oracle.mu
    obj["mean"][:n], obj["cov"][:n, :n] = oracle.combined()
    obj["lane_width"] = 3.0
