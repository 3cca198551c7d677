"""Mode banks: a preset's TOML, checked, as the parameter record of the estimator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from can_imm.estimation.layout import BANK_DTYPE, MAX_MODES, MAX_STEPS
from can_imm.estimation.models import repeat, stationary
from can_imm.estimation.road import PARAMETERS
from can_imm.manoeuvres.constraints import Lanes, fill_bounds, fill_entry, fill_soft, read_lanes
from can_imm.manoeuvres.motion import constant_speed, read_motion
from can_imm.manoeuvres.particles import fill_particles
from can_imm.manoeuvres.transitions import transitions_from_dwell, transitions_from_matrix
from can_imm.tables import Table, builtin_names, read_table
from can_imm.types import CanImmError, FloatArray, Manoeuvre

STATES = ("x", "vx", "y", "vy", "ax", "ay")
PRESETS = Path(__file__).parent / "presets"
LARGEST = 1e6
"""No number of a preset is larger: nothing on a road is, and nothing can overflow."""

FIXED_STD = 0.02
"""Standard deviation of a lane width or offset that is given [m]."""
STRAIGHT_STD = 1e-6
"""That of the curvature of a road that is straight [1/m]."""

_MANOEUVRES = {m.name: m for m in Manoeuvre if m is not Manoeuvre.UNKNOWN}
_OFF_LANE = (Manoeuvre.STATIONARY, Manoeuvre.ONCOMING)
_DIRECTIONS = {"left": +1, "right": -1, "none": 0}


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
        road: `estimation.road.PARAMETERS`, None for a bank whose lanes stand still in the
            sensor's axes.
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
    road: FloatArray | None = None


def builtin_presets() -> list[str]:
    """Names of the presets that come with the package."""
    return builtin_names(PRESETS)


def load_bank(
    name_or_path: str,
    *,
    step_ns: int = 10_000_000,
    lane_width: float | None = None,
    lane_offset: float | None = None,
    straight_road: bool = False,
) -> ModeBank:
    """Load a preset by name, or any TOML file by path.

    Args:
        step_ns: step of the loop [ns].
        lane_width: of the road, if it is known and not to be learned [m].
        lane_offset: how far to the left of the middle of its lane the ego usually is [m]; for a
            preset with a [road].
        straight_road: the road is known to be straight; for a preset with a [road].

    Raises:
        CanImmError: the file is missing, is not TOML or does not describe a mode bank, or a lane
            that is none.
    """
    top = read_table(name_or_path, PRESETS, "preset", limit=LARGEST)
    bank = _bank(top, step_ns, MAX_STEPS)
    if lane_width is not None:
        if not 2.0 <= lane_width <= 6.0:
            raise CanImmError(f"the lanes' width must be 2 to 6 m, not {lane_width:g}")
        bank.record["lane_width"], bank.record["lane_prior"] = lane_width, 0.0
        bank = replace(bank, lane_width=lane_width)
    for name, value in (("width", lane_width), ("offset", lane_offset)):
        if value is None:
            continue
        if bank.road is not None:
            bank.road[PARAMETERS.index(name)] = value
            bank.road[PARAMETERS.index(f"{name}_std")] = FIXED_STD
        elif name == "offset":
            raise top.error("this preset has no [road], and so no offset of the lanes")
    if straight_road:
        if bank.road is None:
            raise top.error("this preset has no [road], and so no bends")
        bank.road[PARAMETERS.index("curvature_std")] = STRAIGHT_STD
    if lane_offset is not None and not abs(lane_offset) <= 3.0:
        raise CanImmError(f"the lanes' offset must be -3 to 3 m, not {lane_offset:g}")
    return bank


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
    return _bank(Table(data, where, limit=LARGEST), step_ns, n_steps)


def _bank(top: Table, step_ns: int, n_steps: int) -> ModeBank:
    array = np.zeros((1,), BANK_DTYPE)
    record = array[0]
    step_s = step_ns * 1e-9
    name = top.text("name")
    top.text("description", "")
    states = _states(top)
    modes = _modes(top)
    names = [mode.text("name") for mode in modes]
    if len(set(names)) != len(names):
        raise top.error("two modes have the same name")
    m, n = len(names), len(states)
    record["n_modes"], record["n_states"] = m, n
    record["step_s"] = step_s
    lanes = _fill_lanes(record, top.table("lanes"))
    _fill_spreads(record, top, n)
    variance = None
    if "measurement_variance" in top:
        variance = np.array(top.numbers("measurement_variance", 4, above=0.0))
    road = _road(top.table("road"), float(record["lane_width"])) if "road" in top else None
    record["relative_lanes"] = road is not None
    record["rear_end_gap"] = top.number("rear_end_gap", 0.0, low=0.0)
    record["peak_speed"] = top.number("peak_speed", 0.0, low=0.0)
    n_particles = fill_particles(record, top.table("particles")) if "particles" in top else 0

    for j, mode in enumerate(modes):
        _fill_mode(record, j, mode, states, n_steps, n_particles)
        fill_soft(record, j, mode, states, lanes)
        fill_bounds(record, j, mode, states, lanes)
        fill_entry(record, j, mode, states, names)
    if record["is_particle"].sum() > 1:
        raise top.error("only one mode can have particles")
    if n_particles and not record["is_particle"].any():
        raise top.error("there is a [particles] table, but no mode has 'particles = true'")
    if "transition" in top:
        Pi = transitions_from_matrix(top.table("transition"), names, step_s, n_steps)
    else:
        Pi = transitions_from_dwell(modes, names, step_s, n_steps)
    record["Pi"][:n_steps, :m, :m] = Pi
    record["mu0"][:m] = stationary(Pi[min(10, n_steps - 1)])
    for table in (*modes, top):
        table.done()
    return ModeBank(
        name=name,
        modes=tuple(names),
        manoeuvres=tuple(Manoeuvre(value) for value in record["manoeuvre"][:m]),
        direction=record["direction"][:m].copy(),
        record=array,
        n_states=n,
        n_particles=n_particles,
        step_ns=step_ns,
        lane_width=float(record["lane_width"]),
        measurement_variance=variance,
        road=road,
    )


def _states(top: Table) -> list[str]:
    states = top.values("states")
    if states not in (list(STATES[:4]), list(STATES[:5]), list(STATES)):
        raise top.error("'states' must be x, vx, y, vy and then, if wanted, ax or ax, ay")
    return states


def _modes(top: Table) -> list[Table]:
    modes = top.tables("mode")
    if not modes:
        raise top.error("there is no [[mode]]")
    if len(modes) > MAX_MODES:
        raise top.error(f"{len(modes)} modes, at most {MAX_MODES} are possible")
    return modes


def _fill_lanes(record: Any, table: Table) -> Lanes:
    width = table.number("width", above=0.0)
    record["lane_width"] = width
    record["lane_range"] = width * 0.8, width * 1.3
    record["lane_prior"] = table.number("learn_scans", 0.0, low=0.0)
    return read_lanes(table)


def _road(table: Table, width: float) -> FloatArray:
    values = [width]
    for name in PARAMETERS[1:]:
        sign = {} if name == "offset" else {"above": 0.0}
        values.append(table.number(name, **sign))
    table.done()
    return np.array(values)


def _fill_spreads(record: Any, top: Table, n: int) -> None:
    """Floors, and how far an object is from what is expected of it."""
    record["mu_floor"] = top.number("probability_floor", 1e-6, low=0.0, high=0.01)
    record["var_floor"] = top.number("variance_floor", 1e-8, above=0.0)
    record["birth_std"][:n] = top.numbers("birth_std", n, above=0.0)
    record["jump_std"] = top.numbers("jump_std", 4, above=0.0)


def _fill_mode(
    record: Any, j: int, mode: Table, states: list[str], n_steps: int, n_particles: int
) -> None:
    """What mode j is called by, and how it moves."""
    n, step_s = len(states), float(record["step_s"])
    record["manoeuvre"][j] = mode.choice("manoeuvre", _MANOEUVRES)
    record["direction"][j] = mode.choice("direction", _DIRECTIONS, "none")
    record["off_lane"][j] = record["manoeuvre"][j] in _OFF_LANE
    record["is_steady"][j] = mode.flag("steady", False)
    record["is_particle"][j] = is_particle = _is_particle(mode, n_particles)
    record["is_projected"][j] = mode.flag("project", False)
    F, Q = constant_speed(n, step_s) if is_particle else read_motion(mode, states, step_s)
    record["F"][:n_steps, j, :n, :n], record["Q"][:n_steps, j, :n, :n] = repeat(F, Q, n_steps)


def _is_particle(mode: Table, n_particles: int) -> bool:
    if not mode.flag("particles", False):
        return False
    for key in ("soft", "bounds", "entry", "project"):
        if key in mode:
            raise mode.error(f"a mode with particles takes no '{key}'")
    if not n_particles:
        raise mode.error("'particles' needs a [particles] table")
    return True
