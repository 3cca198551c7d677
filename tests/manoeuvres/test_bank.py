"""A mode bank from TOML: what it becomes, and the one line that says why it is refused."""

from __future__ import annotations

import copy
import math
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from can_imm.estimation.layout import GROUND, LANE, MAX_MODES
from can_imm.estimation.road import PARAMETERS
from can_imm.manoeuvres import bank_from_dict, load_bank
from can_imm.manoeuvres.bank import PRESETS
from can_imm.types import CanImmError

PAPER = tomllib.loads((PRESETS / "paper.toml").read_text(encoding="utf-8"))
TWO_LANE = tomllib.loads((PRESETS / "two-lane.toml").read_text(encoding="utf-8"))

SMALL = """
name = "small"
states = ["x", "vx", "y", "vy", "ax"]
birth_std = [1.0, 4.0, 1.0, 1.0, 0.5]
jump_std = [1.0, 4.0, 1.0, 2.0]

[lanes]
width = 3.5
right = [-2, 0]
left = [1, 3]

[particles]
count = 50
profile = [0.0, 1.0, 3.0, 4.0]
peak = [1.0, 3.0]
length = [1.5, 2.5]
f_min = 0.4
window = [0.5, 4.5]
std_x = 0.03
std_profile = 0.2
q_vy = 2.0
entry_vy_std = 0.3

[[mode]]
name = "KEEP"
manoeuvre = "KEEP_LEFT"
x = { model = "constant-velocity", q = 0.01 }
y = { model = "constant-velocity", q = 0.02 }
soft = [{ state = "y", lane = "left", r = 0.3 }, { state = "vx", value = 0.5, r = 0.1 }]
dwell_s = 6.0
next = { CHANGE = 3, PASS = 1.0 }

[[mode]]
name = "CHANGE"
manoeuvre = "LANE_CHANGE"
direction = "right"
x = { model = "singer", tau_s = 2.0, acceleration_std = 0.5 }
y = { model = "constant-velocity", q = 0.4 }
bounds = [{ state = "vy", max = -0.25, mass = true }, { state = "y", lane = "right", min = -1 }]
entry = [
    { state = "vy", mean = -1.0, std = 0.6 },
    { state = "ax", mean = 0.2, std = 0.3, from = ["KEEP"] },
]
dwell_s = 2.0
next = { KEEP = 1.0 }

[[mode]]
name = "PASS"
manoeuvre = "OVERTAKING"
particles = true
dwell_s = 2.0
next = { KEEP = 1.0, CHANGE = 0.5 }
"""


def small() -> dict[str, Any]:
    return tomllib.loads(SMALL)


def build(data: Any) -> Any:
    return bank_from_dict(data, "some.toml", n_steps=12)


def test_a_bank_of_ones_own() -> None:
    bank = build(small())
    r = bank.record[0]
    assert bank.modes == ("KEEP", "CHANGE", "PASS")
    assert [m.name for m in bank.manoeuvres] == ["KEEP_LEFT", "LANE_CHANGE", "OVERTAKING"]
    assert bank.direction.tolist() == [0, -1, 0]
    assert (bank.n_states, bank.n_particles, bank.lane_width) == (5, 50, 3.5)
    assert bank.measurement_variance is None
    assert r["n_soft"][:3].tolist() == [2, 0, 0]
    assert (r["soft_kind"][0, 0], r["soft_state"][0, 0], r["soft_r"][0, 0]) == (LANE, 2, 0.3)
    assert r["soft_lanes"][0, 0].tolist() == [1, 3]
    assert (r["soft_value"][0, 1], r["soft_state"][0, 1]) == (0.5, 1)
    assert r["n_bounds"][:3].tolist() == [0, 2, 0]
    assert r["bound_lower"][1, :2].tolist() == [-math.inf, -1.0]
    assert r["bound_upper"][1, :2].tolist() == [-0.25, math.inf]
    assert r["bound_mass"][1, :2].tolist() == [1, 0]
    assert r["entry_mean"][1, [3, 4]].tolist() == [-1.0, 0.2]
    np.testing.assert_allclose(r["entry_var"][1, :5], [-1.0, -1.0, -1.0, 0.36, 0.09])
    assert r["entry_sources"][:3, 1].tolist() == [1 << 3 | 1 << 4, 0, 1 << 3]
    np.testing.assert_allclose(
        r["Q"][1, 0, 2:4, 2:4], 0.02 * np.array([[1e-6 / 3, 5e-5], [5e-5, 1e-2]])
    )
    step = 1.0 - np.diag(r["Pi"][1])[:3]
    np.testing.assert_allclose(step, [0.01 / 6.0, 0.01 / 2.0, 0.01 / 2.0], rtol=0.01)
    assert r["Pi"][1, 0, 1] == pytest.approx(3 * r["Pi"][1, 0, 2], rel=0.02)


def change(path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    """Set (or, with None, delete) the value at a dotted path."""

    def apply(data: Any) -> None:
        *where, last = [int(p) if p.isdigit() else p for p in path.split(".")]
        for key in where:
            data = data[key]
        if value is None:
            del data[last]
        else:
            data[last] = value

    return apply


EVEN = {"period_s": 0.1, "matrix": [[0.8, 0.1, 0.1], [0.1, 0.8, 0.1], [0.1, 0.1, 0.8]]}
MANOEUVRE = (
    "'manoeuvre' must be one of KEEP_RIGHT, LANE_CHANGE, KEEP_LEFT, OVERTAKING, RECEDING, "
    "APPROACHING, REAR_END, KEEP_LANE, STATIONARY, ONCOMING"
)
MODEL = "'model' must be one of constant-velocity, damped, singer, equation-33"
STATE = "'state' must be one of x, vx, y, vy, ax"

REFUSALS = [
    ("name", None, "'name' is missing"),
    ("name", 3, "'name' must be text"),
    ("states", ["x", "y"], "'states'"),
    ("states", "x", "'states'"),
    ("birth_std", [1.0, 1.0], "'birth_std'"),
    ("birth_std", [1.0, 1.0, 0.0, 1.0, 1.0], "'birth_std'"),
    ("birth_std", [1.0, 1.0, math.nan, 1.0, 1.0], "'birth_std'"),
    ("birth_std", [1.0, 1.0, math.inf, 1.0, 1.0], "'birth_std'"),
    ("birth_std", [1.0, 1.0, True, 1.0, 1.0], "'birth_std'"),
    ("birth_std", [1.0, 1.0, [1.0], 1.0, 1.0], "'birth_std'"),
    ("jump_std", 7.0, "'jump_std'"),
    ("measurement_variance", [0.1, 0.3, -0.2, 0.3], "'measurement_variance'"),
    ("probability_floor", 0.5, "'probability_floor'"),
    ("probability_floor", -1e-9, "'probability_floor'"),
    ("variance_floor", 0.0, "'variance_floor'"),
    ("colour", "red", "unknown key 'colour'"),
    ("lanes", None, "'lanes' is missing"),
    ("lanes", 3.0, "'lanes' must be a table"),
    ("lanes.width", 0.0, "lanes: 'width'"),
    ("lanes.width", "wide", "lanes: 'width'"),
    ("lanes.width", 10**400, "lanes: 'width'"),
    ("lanes.right", [1, 0], "lanes: 'right'"),
    ("lanes.right", [0.0, 1.0], "lanes: 'right'"),
    ("lanes.right", [0, 10**400], "lanes: 'right'"),
    ("lanes.left", None, "mode 'KEEP', soft 1: no lane 'left'"),
    ("mode", [], "no [[mode]]"),
    ("mode", [3], "mode 1: must be a table, not 3"),
    ("mode.1.name", "KEEP", "same name"),
    ("mode.1.name", ["KEEP"], "mode 2: 'name' must be text"),
    ("mode.1.name", None, "mode 2: 'name' is missing"),
    ("mode.0.manoeuvre", "PARKING", f"mode 'KEEP': {MANOEUVRE}, not 'PARKING'"),
    ("mode.0.manoeuvre", "UNKNOWN", f"mode 'KEEP': {MANOEUVRE}, not 'UNKNOWN'"),
    ("mode.1.direction", "up", "mode 'CHANGE': 'direction'"),
    ("mode.1.colour", "red", "mode 'CHANGE': unknown key 'colour'"),
    ("mode.0.x", None, "mode 'KEEP': 'x' is missing"),
    ("mode.0.x.model", "jerk", f"mode 'KEEP', x: {MODEL}, not 'jerk'"),
    ("mode.0.x.q", -1.0, "mode 'KEEP', x: 'q'"),
    ("mode.0.x.q", math.inf, "mode 'KEEP', x: 'q'"),
    ("mode.0.x.q", 1e300, "mode 'KEEP', x: 'q'"),
    ("mode.0.x.tau_s", 1.0, "mode 'KEEP', x: unknown key 'tau_s'"),
    ("mode.0.y.model", "singer", "mode 'KEEP', y: model 'singer' needs"),
    ("mode.1.x.tau_s", 0.0, "mode 'CHANGE', x: 'tau_s'"),
    ("mode.1.x.acceleration_std", None, "mode 'CHANGE', x: 'acceleration_std' is missing"),
    ("mode.0.soft.0.state", "z", f"mode 'KEEP', soft 1: {STATE}, not 'z'"),
    ("mode.0.soft.0.state", "ay", f"mode 'KEEP', soft 1: {STATE}, not 'ay'"),
    ("mode.0.soft.0.lane", "middle", "mode 'KEEP', soft 1: no lane 'middle'"),
    ("mode.0.soft.1.lane", "left", "mode 'KEEP', soft 2: no lane 'left' for state 'vx'"),
    ("mode.0.soft.0.r", -1.0, "mode 'KEEP', soft 1: 'r'"),
    ("mode.0.soft.0.r", 0.0, "mode 'KEEP', soft 1: 'r'"),
    ("mode.0.soft.1.value", None, "mode 'KEEP', soft 2: 'value' is missing"),
    ("mode.0.soft.1.value", math.nan, "mode 'KEEP', soft 2: 'value'"),
    ("mode.0.soft.1", {"state": "vx", "density": 0.0}, "mode 'KEEP', soft 2: 'density'"),
    ("mode.0.soft.1", {"state": "vx", "density": 1.0, "r": 1.0, "value": 0.0}, "unknown key 'r'"),
    ("mode.0.soft.0.ground", True, "mode 'KEEP', soft 1: 'ground' is for vx, without a lane"),
    ("mode.0.soft.1.ground", "yes", "mode 'KEEP', soft 2: 'ground' must be true or false"),
    ("mode.1.bounds.0.ground", True, "mode 'CHANGE', bounds 1: 'ground' is for vx"),
    ("mode.0.soft.1", {"state": "vx", "ground": True, "lane": "left", "r": 1.0}, "'ground' is"),
    ("mode.0.entry", [{"state": "vx", "ground": True, "mean": 0, "std": 1}], "key 'ground'"),
    ("mode.0.x.model", "damped", "mode 'KEEP', x: 'tau_s' is missing"),
    ("mode.0.x", {"model": "damped", "tau_s": 0.0, "speed_std": 1.0}, "'tau_s'"),
    ("mode.0.x", {"model": "damped", "tau_s": 1.0, "speed_std": -1.0}, "'speed_std'"),
    ("rear_end_gap", -1.0, "'rear_end_gap'"),
    ("peak_speed", -1.0, "'peak_speed'"),
    ("mode.0.steady", 1, "mode 'KEEP': 'steady' must be true or false"),
    ("road", {}, "road: 'width_std' is missing"),
    ("road", 3.0, "'road' must be a table"),
    ("mode.0.soft", {}, "mode 'KEEP': 'soft' must be a list"),
    ("mode.0.soft", ["y"], "mode 'KEEP', soft 1: must be a table, not 'y'"),
    ("mode.0.soft", [{"state": "y", "value": 0.0, "r": 1.0}] * 5, "'soft' has 5 rows, at most 4"),
    ("mode.1.bounds.0.max", "low", "mode 'CHANGE', bounds 1: 'max'"),
    ("mode.1.bounds.0.min", 3.0, "mode 'CHANGE', bounds 1: bounds are empty"),
    ("mode.1.bounds.0.min", -0.25, "mode 'CHANGE', bounds 1: bounds are empty"),
    ("mode.1.bounds.0.min", math.nan, "mode 'CHANGE', bounds 1: 'min'"),
    ("mode.1.bounds.0.min", -(10**400), "mode 'CHANGE', bounds 1: 'min'"),
    ("mode.1.bounds.0.mass", 1, "mode 'CHANGE', bounds 1: 'mass' must be true or false"),
    ("mode.1.entry.0.std", -0.1, "mode 'CHANGE', entry 1: 'std'"),
    ("mode.1.entry.0.std", 1e200, "mode 'CHANGE', entry 1: 'std'"),
    ("mode.1.entry.1.from", ["NOBODY"], "mode 'CHANGE', entry 2: 'from' names the unknown"),
    ("mode.1.entry.1.from", [[]], "mode 'CHANGE', entry 2: 'from' names the unknown"),
    ("mode.0.dwell_s", 0.0, "mode 'KEEP': 'dwell_s'"),
    ("mode.0.dwell_s", -2.0, "mode 'KEEP': 'dwell_s'"),
    ("mode.0.dwell_s", None, "mode 'KEEP': 'dwell_s' is missing"),
    ("mode.0.next", None, "mode 'KEEP': 'next' is missing"),
    ("mode.0.next", {}, "mode 'KEEP', next: no mode follows"),
    ("mode.0.next.PASS", -1.0, "mode 'KEEP', next: 'PASS'"),
    ("mode.0.next.PASS", math.inf, "mode 'KEEP', next: 'PASS'"),
    ("mode.0.next.PASS", True, "mode 'KEEP', next: 'PASS'"),
    ("mode.0.next.NOBODY", 1.0, "mode 'KEEP', next: 'NOBODY' is no other mode"),
    ("mode.0.next.KEEP", 1.0, "mode 'KEEP', next: 'KEEP' is no other mode"),
    ("mode.0.next", {"PASS": 0.0}, "mode 'KEEP', next: no mode follows"),
    ("mode.2.soft", [], "mode 'PASS': a mode with particles takes no 'soft'"),
    ("mode.2.particles", None, "mode 'PASS': 'x' is missing"),
    ("mode.2.particles", "yes", "mode 'PASS': 'particles' must be true or false"),
    ("particles", None, "mode 'PASS': 'particles' needs a [particles] table"),
    ("particles.count", 3, "particles: 'count'"),
    ("particles.count", 50.0, "particles: 'count' must be a whole number"),
    ("particles.profile", [0.0, 1.0, 3.0], "particles: 'profile'"),
    ("particles.profile", [0.0, 3.0, 1.0, 4.0], "particles: 'profile'"),
    ("particles.profile", [0.0, 1.0, 3.0, math.inf], "particles: 'profile'"),
    ("particles.peak", [3.0, 1.0], "particles: 'peak'"),
    ("particles.peak", ["1", "3"], "particles: 'peak'"),
    ("particles.length", [0.0, 1.0], "particles: 'length'"),
    ("particles.f_min", 1.5, "particles: 'f_min'"),
    ("particles.window", [4.5, 0.5], "particles: 'window'"),
    ("particles.window", ["a", "b"], "particles: 'window'"),
    ("particles.std_x", None, "particles: 'std_x' is missing"),
    ("particles.colour", "red", "particles: unknown key 'colour'"),
    ("transition", {}, "transition: 'matrix' is missing"),
    ("transition", EVEN, "mode 'KEEP': unknown key 'dwell_s'"),
    ("transition", 3, "'transition' must be a table"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("path", "value", "message"), REFUSALS, ids=[f"{p}={v!r:.30}" for p, v, _ in REFUSALS]
)
def test_refusals_name_file_mode_and_key(path: str, value: Any, message: str) -> None:
    data = small()
    change(path, value)(data)
    with pytest.raises(CanImmError, match=re.escape(message)) as e:
        build(data)
    check_line(str(e.value))


MATRIX_REFUSALS = [
    ("transition.matrix.3.3", 0.9, "row 'OVERTAKING' of 'matrix' sums to 1.1, not to 1"),
    ("transition.matrix.3.3", -0.8, "row 'OVERTAKING' of 'matrix': -0.8 is no probability"),
    ("transition.matrix.3.3", math.nan, "row 'OVERTAKING' of 'matrix': nan is no probability"),
    ("transition.matrix.3.3", "0.8", "row 'OVERTAKING' of 'matrix': '0.8' is no probability"),
    ("transition.matrix.3.3", True, "row 'OVERTAKING' of 'matrix': True is no probability"),
    ("transition.matrix.3.3", [0.8], "row 'OVERTAKING' of 'matrix': [0.8] is no probability"),
    ("transition.matrix.3", None, "'matrix' must be 7 x 7"),
    ("transition.matrix.3", 1.0, "'matrix' must be 7 x 7"),
    ("transition.matrix.3.3", None, "'matrix' must be 7 x 7"),
    ("transition.matrix", None, "transition: 'matrix' is missing"),
    ("transition.matrix", [[1.0]], "'matrix' must be 7 x 7"),
    ("transition.period_s", 0.0, "transition: 'period_s'"),
    ("transition.period_s", None, "transition: 'period_s' is missing"),
    ("transition.colour", "red", "transition: unknown key 'colour'"),
    ("mode.0.dwell_s", 3.0, "mode 'KEEP_RIGHT': unknown key 'dwell_s'"),
    (
        "transition.matrix",
        np.roll(np.eye(7), 1, axis=0).tolist(),
        "'matrix' is not near to any Markov chain in continuous time",
    ),
]


@pytest.mark.parametrize(("path", "value", "message"), MATRIX_REFUSALS)
def test_refusals_of_a_matrix(path: str, value: Any, message: str) -> None:
    data = copy.deepcopy(PAPER)
    change(path, value)(data)
    with pytest.raises(CanImmError, match=re.escape(message)) as e:
        build(data)
    check_line(str(e.value))


def check_line(text: str, file: str = "some.toml") -> None:
    assert text.startswith(f"{file}: ")
    assert len(text.splitlines()) == 1
    assert len(text) < 400


MOTORWAY = tomllib.loads((PRESETS / "motorway.toml").read_text(encoding="utf-8"))


def test_the_table_of_a_road() -> None:
    """In the order of the filter's parameters, after the lanes' width."""
    bank = build(copy.deepcopy(MOTORWAY))
    assert bank.road is not None
    assert bank.road.tolist() == [
        MOTORWAY["lanes"]["width"],
        *(MOTORWAY["road"][name] for name in PARAMETERS[1:]),
    ]
    assert bank.record[0]["relative_lanes"]
    assert not build(small()).record[0]["relative_lanes"]
    assert build(small()).road is None


@pytest.mark.parametrize("name", PARAMETERS[1:])
def test_refusals_of_a_road(name: str) -> None:
    for value in (None, "wide", math.nan, *(() if name == "offset" else (-0.1, 0.0))):
        data = copy.deepcopy(MOTORWAY)
        change(f"road.{name}", value)(data)
        with pytest.raises(CanImmError, match=f"road: '{name}'") as e:
            build(data)
        check_line(str(e.value))


def test_a_road_has_no_other_keys() -> None:
    data = copy.deepcopy(MOTORWAY)
    data["road"]["colour"] = "grey"
    with pytest.raises(CanImmError, match="road: unknown key 'colour'"):
        build(data)


def test_rows_that_count_from_the_ground() -> None:
    data = small()
    data["mode"][0]["soft"][1] = {"state": "vx", "ground": True, "r": 0.1}
    data["mode"][1]["bounds"][0] = {"state": "vx", "ground": True, "max": -1.5, "mass": True}
    r = build(data).record[0]
    assert (r["soft_kind"][0, 1], r["soft_value"][0, 1]) == (GROUND, 0.0)
    assert (r["bound_kind"][1, 0], r["bound_upper"][1, 0]) == (GROUND, -1.5)
    assert r["bound_kind"][1, 1] == LANE


def test_a_row_with_a_density() -> None:
    data = small()
    data["mode"][0]["soft"][1] = {"state": "vx", "value": 0.5, "density": 0.02}
    r = build(data).record[0]
    assert r["soft_density"][0, :2].tolist() == [0, 1]
    assert r["soft_r"][0, :2].tolist() == [0.3, 0.02]


@pytest.mark.parametrize("tau", [0.3, 2.0, 50.0])
@pytest.mark.parametrize("axis", ["x", "y"])
def test_a_damped_speed(tau: float, axis: str) -> None:
    """The integrated Ornstein-Uhlenbeck process, at one step and at many."""
    data, sigma = small(), 0.7
    data["mode"][0][axis] = {"model": "damped", "tau_s": tau, "speed_std": sigma}
    r = build(data).record[0]
    at = slice(0, 2) if axis == "x" else slice(2, 4)
    for m in (1, 7, 11):
        t = 0.01 * m
        a = math.exp(-t / tau)
        position = 2 * tau * t - tau**2 * (3.0 - 4.0 * a + a * a)
        both = tau * (1.0 - a) ** 2
        F = [[1.0, tau * (1.0 - a)], [0.0, a]]
        Q = sigma**2 * np.array([[position, both], [both, 1.0 - a * a]])
        np.testing.assert_allclose(r["F"][m, 0, at, at], F, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(r["Q"][m, 0, at, at], Q, rtol=1e-6, atol=1e-11)


def test_too_many_modes() -> None:
    data = small()
    data["mode"] = [{**data["mode"][0], "name": f"M{i}"} for i in range(MAX_MODES + 1)]
    with pytest.raises(CanImmError, match=f"{MAX_MODES + 1} modes, at most {MAX_MODES}"):
        build(data)


def test_two_modes_with_particles() -> None:
    data = small()
    data["mode"].append({**data["mode"][2], "name": "PASS2"})
    with pytest.raises(CanImmError, match="only one mode can have particles"):
        build(data)


def test_particles_that_no_mode_uses() -> None:
    data = small()
    data["mode"].pop()
    data["mode"][0]["next"] = {"CHANGE": 1}
    with pytest.raises(CanImmError, match="no mode has 'particles = true'"):
        build(data)


def test_a_name_with_a_line_break_leaves_one_line() -> None:
    data = small()
    data["mode"][0]["name"] = "A\nB"
    with pytest.raises(CanImmError) as e:
        build(data)
    check_line(str(e.value))


# ---- files


def test_a_file_by_its_path(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(SMALL, encoding="utf-8")
    assert load_bank(str(path)).name == "small"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "neither a file nor a built-in preset (motorway, paper, two-lane)"),
        (b"name = ", "not valid TOML"),
        (b"\xff\xfe\x00", "cannot be read: not a text file in UTF-8"),
        (b"a = " + b"[" * 5000, "not valid TOML"),
        (b"a = " + b"9" * 5000, "not valid TOML"),
        (b"", "'name' is missing"),
        (SMALL.replace("r = 0.3", "r = -0.3").encode(), "mode 'KEEP', soft 1: 'r'"),
    ],
)
def test_refusals_of_a_file(tmp_path: Path, content: bytes | None, message: str) -> None:
    path = tmp_path / "mine.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CanImmError, match=re.escape(message)) as e:
        load_bank(str(path))
    check_line(str(e.value), str(path))


def test_a_directory_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "folder.toml"
    path.mkdir()
    with pytest.raises(CanImmError, match=r"folder\.toml: cannot be read: Is a directory"):
        load_bank(str(path))


def test_an_unknown_preset_names_the_known_ones() -> None:
    with pytest.raises(
        CanImmError, match=r"three-lane: neither .* preset \(motorway, paper, two-lane\)"
    ):
        load_bank("three-lane")


# ---- anything at all

NASTY = st.one_of(
    st.none(),
    st.booleans(),
    st.floats(),
    st.integers(),
    st.sampled_from([0, -1, 1, 10**400, 1e300, -1e300, 1e-300, 0.5, "", "y", "singer", "KEEP"]),
    st.text(max_size=5),
    st.lists(st.one_of(st.floats(), st.text(max_size=2), st.booleans()), max_size=7),
    st.lists(st.lists(st.floats(0.0, 1.0), max_size=7), max_size=7),
    st.dictionaries(st.text(max_size=3), st.floats(), max_size=2),
    st.lists(st.dictionaries(st.sampled_from(["state", "r", "min"]), st.floats()), max_size=6),
)


def places(data: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths of all values in nested tables and lists."""
    items = data.items() if isinstance(data, dict) else enumerate(data)
    found = []
    for key, value in items:
        found.append((*at, key))
        if isinstance(value, (dict, list)):
            found += places(value, (*at, key))
    return found


@settings(max_examples=250, suppress_health_check=[HealthCheck.too_slow])
@given(st.sampled_from(["small", "small", "paper", "two-lane"]), st.data())
def test_whatever_is_written_is_accepted_or_refused(name: str, data: st.DataObject) -> None:
    """Values deleted or replaced at random: a bank of finite numbers, or one line."""
    mutated = {"small": small, "paper": PAPER.copy, "two-lane": TWO_LANE.copy}[name]()
    mutated = copy.deepcopy(mutated)
    for _ in range(data.draw(st.integers(1, 3))):
        all_places = places(mutated)
        if not all_places:
            break
        *where, last = data.draw(st.sampled_from(all_places))
        parent = mutated
        for key in where:
            parent = parent[key]
        if data.draw(st.integers(0, 3)) == 0:
            del parent[last]
        else:
            parent[last] = data.draw(NASTY)
    try:
        bank = bank_from_dict(mutated, "some.toml", n_steps=12)
    except CanImmError as e:
        check_line(str(e))
        return
    record = bank.record[0]
    for name in ("F", "Q", "Pi", "mu0", "birth_std", "soft_value", "entry_mean", "entry_var"):
        assert np.isfinite(record[name]).all(), name
    assert np.isfinite([record["particle"][n] for n in record["particle"].dtype.names]).all()
    m = len(bank.modes)
    np.testing.assert_allclose(record["Pi"][:12, :m, :m].sum(axis=2), 1.0, rtol=1e-9)
