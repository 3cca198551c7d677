"""Mode banks: a preset's TOML, checked, as the parameter record of the estimator."""

from __future__ import annotations

import math
import reprlib
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from can_imm.estimation.imm import BANK_DTYPE, FIXED, LANE, MAX_MODES, MAX_ROWS, MAX_STEPS
from can_imm.estimation.models import (
    discretise,
    generator_from_dwell,
    generator_from_matrix,
    repeat,
    stationary,
    transition_table,
)
from can_imm.types import CanImmError, FloatArray, Manoeuvre

STATES = ("x", "vx", "y", "vy", "ax", "ay")
PRESETS = Path(__file__).parent / "presets"
LARGEST = 1e6
"""No number of a preset is larger: nothing on a road is, and nothing can overflow."""


@dataclass(frozen=True)
class ModeBank:
    """A checked preset.

    Attributes:
        name: the preset's name.
        modes: names of the modes; several may belong to one manoeuvre.
        manoeuvres: (M,) `Manoeuvre` of each mode.
        direction: (M,) int8, lane-change direction of each mode: +1 left, -1 right, 0 none.
        record: () record of `can_imm.estimation.imm.bank_dtype`.
        n_states: 4, 5 or 6.
        n_particles: of the particle mode, 0 without one.
        step_ns: step that the tables are made for [ns].
        lane_width: [m].
        measurement_variance: (4,) to be used instead of the sensor's own, or None.
    """

    name: str
    modes: tuple[str, ...]
    manoeuvres: tuple[Manoeuvre, ...]
    direction: np.ndarray[Any, np.dtype[np.int8]]
    record: np.ndarray[Any, np.dtype[np.void]]
    n_states: int
    n_particles: int
    step_ns: int
    lane_width: float
    measurement_variance: FloatArray | None


def builtin_presets() -> list[str]:
    """Names of the presets that come with the package."""
    return sorted(path.stem for path in PRESETS.glob("*.toml"))


def load_bank(name_or_path: str, *, step_ns: int = 10_000_000) -> ModeBank:
    """Load a preset by name, or any TOML file by path.

    Args:
        step_ns: step of the loop [ns].

    Raises:
        CanImmError: the file is missing, is not TOML or does not describe a mode bank.
    """
    path, data = preset_data(name_or_path)
    return bank_from_dict(data, str(path), step_ns=step_ns)


def preset_data(name_or_path: str) -> tuple[Path, dict[str, Any]]:
    """Path of a preset's TOML file and what it holds, unchecked.

    Raises:
        CanImmError: the file is missing or is not TOML.
    """
    path = PRESETS / f"{name_or_path}.toml"
    if name_or_path not in builtin_presets():
        path = Path(name_or_path)
        if path.suffix != ".toml":
            names = ", ".join(builtin_presets())
            raise CanImmError(
                f"{name_or_path}: no such preset ({names}), and not the path of a .toml file"
            )
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as e:
        raise CanImmError(f"{path}: {e.strerror or e}") from e
    except (ValueError, RecursionError) as e:  # of TOML, of UTF-8, of numbers, of nesting
        raise CanImmError(f"{path}: not a TOML file: {e}") from e
    return path, data


_KINDS = {
    str: "string", float: "number", int: "whole number", bool: "true or false", list: "list",
    dict: "table",
}  # fmt: skip


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


class _Table:
    """A TOML table whose keys are taken one by one, so that what is left over is a mistake."""

    def __init__(self, data: Any, where: str) -> None:
        self.where = where
        if not isinstance(data, dict):
            raise self.error("a table is expected")
        self.data = dict(data)

    def error(self, text: str) -> CanImmError:
        return CanImmError(" ".join(f"{self.where}: {text}".splitlines()))

    def take(self, key: str, kind: type, default: Any = None) -> Any:
        if key not in self.data:
            if default is None:
                raise self.error(f"'{key}' is missing")
            return default
        value = self.data.pop(key)
        fits = _is_number(value) if kind is float else isinstance(value, kind)
        if not fits or (kind is int and isinstance(value, bool)):
            raise self.error(f"'{key}' must be a {_KINDS[kind]}, not {reprlib.repr(value)}")
        return value

    def number(
        self,
        key: str,
        default: float | None = None,
        low: float = -LARGEST,
        high: float = LARGEST,
        *,
        open_low: bool = False,
    ) -> float:
        value = self.take(key, float, default)
        if not low <= value <= high or (open_low and value == low):
            what = "above" if open_low else "from"
            raise self.error(
                f"'{key}' must be {what} {low:g} to {high:g}, not {reprlib.repr(value)}"
            )
        return float(value)

    def numbers(self, key: str, count: int, low: float = 0.0) -> list[float]:
        """A list of numbers above ``low``."""
        values = self.take(key, list)
        if len(values) != count or not all(_is_number(v) and low < v <= LARGEST for v in values):
            raise self.error(
                f"'{key}' must be {count} numbers above {low:g} to {LARGEST:g},"
                f" not {reprlib.repr(values)}"
            )
        return [float(v) for v in values]

    def done(self) -> None:
        if self.data:
            raise self.error(f"unknown key '{next(iter(self.data))}'")


def _axis(table: _Table, has_acceleration: bool) -> tuple[FloatArray, FloatArray, str]:
    """Continuous A, W of one axis (position, speed[, acceleration]) from its motion table."""
    kind = table.take("model", str)
    n = 3 if has_acceleration else 2
    A = np.zeros((n, n))
    W = np.zeros((n, n))
    A[0, 1] = 1.0
    if kind in ("constant-velocity", "equation-33"):
        # white-noise acceleration of spectral density q [m^2/s^3]
        W[1, 1] = table.number("q", low=0.0) if kind == "constant-velocity" else 1.0
        if has_acceleration:
            # no acceleration in this model: the state decays at once and keeps its prior spread
            sigma = table.number("acceleration_std", 1.0, low=0.0)
            A[2, 2] = -50.0
            W[2, 2] = 100.0 * sigma**2
    elif kind == "singer":
        if not has_acceleration:
            raise table.error("model 'singer' needs the axis' acceleration among the states")
        tau = table.number("tau_s", low=0.01)
        sigma = table.number("acceleration_std", low=0.0)
        A[1, 2] = 1.0
        A[2, 2] = -1.0 / tau
        W[2, 2] = 2.0 * sigma**2 / tau
        W[1, 1] = table.number("q", 0.0, low=0.0)
    else:
        raise table.error(f"unknown model '{kind}' (constant-velocity, singer, equation-33)")
    table.done()
    return A, W, kind


def _motion(mode: _Table, states: list[str], dt: float) -> tuple[FloatArray, FloatArray]:
    """One-step F and Q of a mode: the two axes are independent."""
    n = len(states)
    F = np.eye(n)
    Q = np.zeros((n, n))
    for axis in ("x", "y"):
        where = [states.index(s) for s in (axis, f"v{axis}", f"a{axis}") if s in states]
        table = _Table(mode.take(axis, dict), f"{mode.where}, {axis}")
        A, W, kind = _axis(table, len(where) == 3)
        f, q = discretise(A, W, dt)
        if kind == "equation-33":
            # as printed, per prediction step
            q[:2, :2] = np.diag([dt**2 / 2.0, dt])
        F[np.ix_(where, where)] = f
        Q[np.ix_(where, where)] = q
    return F, Q


def _rows(mode: _Table, key: str) -> list[_Table]:
    rows = mode.take(key, list, [])
    if len(rows) > MAX_ROWS:
        raise mode.error(f"'{key}' has {len(rows)} rows, at most {MAX_ROWS} are possible")
    return [_Table(row, f"{mode.where}, {key}[{i}]") for i, row in enumerate(rows)]


def _state(row: _Table, states: list[str]) -> int:
    name = row.take("state", str)
    if name not in states:
        raise row.error(f"unknown state '{name}' ({', '.join(states)})")
    return states.index(name)


def _lane(
    row: _Table, state: str, lanes: dict[str, tuple[int, int]]
) -> tuple[int, tuple[int, int]]:
    """Whether the row counts from a lane centre, and of which lanes."""
    if "lane" not in row.data:
        return FIXED, (0, 0)
    lane = row.take("lane", str)
    if state != "y" or lane not in lanes:
        raise row.error(f"no lane '{lane}' for state '{state}' ({', '.join(lanes)})")
    return LANE, lanes[lane]


def _fill_constraints(
    record: Any,
    j: int,
    mode: _Table,
    names: list[str],
    states: list[str],
    lanes: dict[str, tuple[int, int]],
) -> None:
    """Soft rows, bounds and entry distribution of mode j."""
    rows = _rows(mode, "soft")
    record["n_soft"][j] = len(rows)
    for c, row in enumerate(rows):
        s = _state(row, states)
        record["soft_state"][j, c] = s
        record["soft_r"][j, c] = row.number("r", low=0.0, open_low=True)
        record["soft_kind"][j, c], record["soft_lanes"][j, c] = _lane(row, states[s], lanes)
        record["soft_value"][j, c] = row.number(
            "value", 0.0 if record["soft_kind"][j, c] == LANE else None
        )
        row.done()
    rows = _rows(mode, "bounds")
    record["n_bounds"][j] = len(rows)
    for c, row in enumerate(rows):
        s = _state(row, states)
        record["bound_state"][j, c] = s
        record["bound_kind"][j, c], record["bound_lanes"][j, c] = _lane(row, states[s], lanes)
        low = row.number("min", -math.inf, -math.inf)
        high = row.number("max", math.inf, high=math.inf)
        if not low < high:
            raise row.error(f"bounds are empty: min {low} is not below max {high}")
        record["bound_lower"][j, c] = low
        record["bound_upper"][j, c] = high
        record["bound_mass"][j, c] = row.take("mass", bool, False)
        row.done()
    rows = _rows(mode, "entry")
    record["entry_var"][j] = -1.0
    for row in rows:
        s = _state(row, states)
        record["entry_mean"][j, s] = row.number("mean")
        record["entry_var"][j, s] = row.number("std", low=0.0) ** 2
        for source in row.take("from", list, names):
            if source not in names:
                raise row.error(f"'from' names the unknown mode '{source}'")
            if source != names[j]:
                record["entry_sources"][names.index(source), j] |= 1 << s
        row.done()


def _fill_particle(record: Any, table: _Table) -> int:
    """Parameters of the particle mode; returns the number of particles."""
    p = record["particle"]
    count: int = table.take("count", int)
    if not 10 <= count <= 100_000:
        raise table.error(f"'count' = {count} is out of range")
    corners = table.numbers("profile", 4, low=-LARGEST)
    if not corners[0] < corners[1] <= corners[2] < corners[3]:
        raise table.error("'profile' must be four rising distances of the trapezoid's corners")
    length = corners[3] - corners[0]
    p["up"] = (corners[1] - corners[0]) / length
    p["down"] = (corners[2] - corners[0]) / length
    p["absolute"] = table.take("absolute", bool, False)
    p["entry"] = corners[0]
    for key in ("peak", "length"):
        # 'length' is in metres for the absolute profile, else per m/s of peak speed
        fixed = p["absolute"] and key == "length"
        low, high = (length, length) if fixed else table.numbers(key, 2)
        if not low <= high:
            raise table.error(f"'{key}' must be [low, high] with low <= high")
        p[f"{key}_low"], p[f"{key}_high"] = low, high
    p["f_min"] = table.number("f_min", low=0.0, high=float(p["peak_low"]))
    p["y_low"], p["y_high"] = table.numbers("window", 2, low=-LARGEST)
    if not p["y_low"] < p["y_high"]:
        raise table.error("'window' must be [low, high] of y with low < high")
    p["std_x"] = table.number("std_x", low=0.0)
    p["std_profile"] = table.number("std_profile", low=0.0)
    p["q_vy"] = table.number("q_vy", low=0.0)
    p["entry_vy_std"] = table.number("entry_vy_std", low=0.0)
    table.done()
    return count


def _transitions(
    table: _Table,
    names: list[str],
    dwell: list[float],
    following: list[_Table],
    step_s: float,
    n_steps: int,
) -> FloatArray:
    """Pi[m] from the modes' dwell times and what follows, or from a matrix and its period."""
    if following:
        weights = np.zeros((len(names), len(names)))
        for i, row in enumerate(following):
            for target in list(row.data):
                if target not in names or target == names[i]:
                    raise row.error(f"'{target}' is no other mode")
                weights[i, names.index(target)] = row.number(target, low=0.0)
            if not weights[i].sum() > 0:
                raise row.error("no mode follows")
        return transition_table(generator_from_dwell(np.array(dwell), weights), step_s, n_steps)
    rows = table.take("matrix", list)
    period = table.number("period_s", low=0.01)
    table.done()
    m = len(names)
    if len(rows) != m or any(not isinstance(r, list) or len(r) != m for r in rows):
        raise table.error(f"'matrix' must be {m} x {m}, one row and one column per mode")
    for name, row in zip(names, rows, strict=True):
        for entry in row:
            if not (_is_number(entry) and 0.0 <= entry <= 1.0):
                raise table.error(
                    f"row '{name}' of 'matrix': {reprlib.repr(entry)} is no probability"
                )
        if abs(sum(row) - 1.0) > 1e-9:
            raise table.error(f"row '{name}' of 'matrix' sums to {sum(row):.6g}, not to 1")
    Pi = np.array(rows, float)
    G = generator_from_matrix(Pi, period)
    if not np.abs(transition_table(G, period, 2)[1] - Pi).max() < 0.05:
        raise table.error("'matrix' is not near to any Markov chain in continuous time")
    result = transition_table(G, step_s, n_steps)
    at = round(period / step_s)
    if 0 < at < n_steps and math.isclose(at * step_s, period):
        result[at] = Pi  # as printed where it was meant
    return result


def bank_from_dict(
    data: dict[str, Any], where: str, *, step_ns: int = 10_000_000, n_steps: int = MAX_STEPS
) -> ModeBank:
    """Check a preset's data and build its bank.

    Args:
        data: what the TOML file holds.
        where: begins every error message.
        step_ns: step of the loop [ns].
        n_steps: how many rows of the tables are filled, at most `MAX_STEPS`.

    Raises:
        CanImmError: with the reason, in one line.
    """
    top = _Table(data, where)
    step_s = step_ns * 1e-9
    name = top.take("name", str)
    top.take("description", str, "")
    states = top.take("states", list)
    if states not in (list(STATES[:4]), list(STATES[:5]), list(STATES)):
        raise top.error("'states' must be x, vx, y, vy and then, if wanted, ax or ax, ay")
    lanes_table = _Table(top.take("lanes", dict), f"{where}, lanes")
    width = lanes_table.number("width", low=0.0, open_low=True)
    record_lane_prior = lanes_table.number("learn_scans", 0.0, low=0.0)
    lanes: dict[str, tuple[int, int]] = {}
    for key in list(lanes_table.data):
        span = lanes_table.take(key, list)
        if (
            len(span) != 2
            or not all(type(v) is int and abs(v) <= 100 for v in span)
            or span[0] > span[1]
        ):
            raise lanes_table.error(f"'{key}' must be [lowest, highest] lane number")
        lanes[key] = (span[0], span[1])
    modes = top.take("mode", list)
    if not modes:
        raise top.error("there is no [[mode]]")
    names: list[str] = []
    for i, mode in enumerate(modes, 1):
        label = mode.get("name") if isinstance(mode, dict) else None
        names.append(label if isinstance(label, str) and label else f"#{i}")
    mode_tables = [_Table(m, f"{where}, mode '{n}'") for n, m in zip(names, modes, strict=True)]
    if len(set(names)) != len(names):
        raise top.error("two modes have the same name")

    m, n = len(names), len(states)
    if m > MAX_MODES:
        raise top.error(f"{m} modes, at most {MAX_MODES} are possible")
    array = np.zeros((1,), BANK_DTYPE)
    record = array[0]
    record["n_modes"], record["n_states"] = m, n
    record["step_s"] = step_s
    record["lane_width"] = width
    record["lane_range"] = width * 0.8, width * 1.3
    record["lane_prior"] = record_lane_prior
    record["mu_floor"] = top.number("probability_floor", 1e-6, low=0.0, high=0.01)
    record["var_floor"] = top.number("variance_floor", 1e-8, low=0.0, open_low=True)
    record["birth_std"][:n] = top.numbers("birth_std", n)
    record["jump_std"] = top.numbers("jump_std", 4)
    variance = None
    if "measurement_variance" in top.data:
        variance = np.array(top.numbers("measurement_variance", 4))
    n_particles = 0
    if "particles" in top.data:
        n_particles = _fill_particle(
            record, _Table(top.take("particles", dict), f"{where}, particles")
        )
    from_matrix = "transition" in top.data
    transition = _Table(top.take("transition", dict, {}), f"{where}, transition")

    manoeuvres: list[Manoeuvre] = []
    direction = np.zeros(m, np.int8)
    dwell: list[float] = []
    following: list[_Table] = []
    for j, mode in enumerate(mode_tables):
        mode.take("name", str)
        label = mode.take("manoeuvre", str)
        if label not in Manoeuvre.__members__ or label == "UNKNOWN":
            known = ", ".join(k for k in Manoeuvre.__members__ if k != "UNKNOWN")
            raise mode.error(f"unknown manoeuvre '{label}' ({known})")
        manoeuvres.append(Manoeuvre[label])
        side = mode.take("direction", str, "none")
        if side not in ("left", "right", "none"):
            raise mode.error(f"'direction' must be left, right or none, not '{side}'")
        direction[j] = {"left": 1, "right": -1, "none": 0}[side]
        record["is_particle"][j] = mode.take("particles", bool, False)
        if record["is_particle"][j]:
            for key in ("soft", "bounds", "entry", "project"):
                if key in mode.data:
                    raise mode.error(f"a mode with particles takes no '{key}'")
        record["is_projected"][j] = mode.take("project", bool, False)
        if not record["is_particle"][j]:
            F, Q = _motion(mode, states, step_s)
        elif not n_particles:
            raise mode.error("'particles' needs a [particles] table")
        else:
            F, Q = np.eye(n), np.zeros((n, n))
            F[0, 1] = F[2, 3] = step_s
        tables = repeat(F, Q, n_steps)
        record["F"][:n_steps, j, :n, :n], record["Q"][:n_steps, j, :n, :n] = tables
        _fill_constraints(record, j, mode, names, states, lanes)
        if not from_matrix:
            dwell.append(mode.number("dwell_s", low=0.01))
            following.append(_Table(mode.take("next", dict), f"{mode.where}, next"))
        mode.done()
    if record["is_particle"].sum() > 1:
        raise top.error("only one mode can have particles")
    if n_particles and not record["is_particle"].any():
        raise top.error("there is a [particles] table, but no mode has 'particles = true'")
    record["manoeuvre"][:m] = manoeuvres
    record["direction"][:m] = direction
    Pi = _transitions(transition, names, dwell, following, step_s, n_steps)
    record["Pi"][:n_steps, :m, :m] = Pi
    record["mu0"][:m] = stationary(Pi[min(10, n_steps - 1)])
    top.done()
    return ModeBank(
        name,
        tuple(names),
        tuple(manoeuvres),
        direction,
        array,
        n,
        n_particles,
        step_ns,
        width,
        variance,
    )
