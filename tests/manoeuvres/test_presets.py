"""The presets: the published tables, written down again, and what every bank must hold."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from can_imm.estimation.layout import FIXED, GROUND, LANE
from can_imm.estimation.road import PARAMETERS
from can_imm.manoeuvres import Manoeuvre, ModeBank, builtin_presets, load_bank
from can_imm.types import CanImmError

STATES = ["x", "vx", "y", "vy", "ax", "ay"]
TWO_LANES = [m for m in Manoeuvre if Manoeuvre.KEEP_RIGHT <= m <= Manoeuvre.REAR_END]
NAMES = [m.name for m in TWO_LANES]
MOTORWAY = [
    Manoeuvre.LANE_CHANGE,
    *(m for m in Manoeuvre if m >= Manoeuvre.RECEDING),
]


@pytest.fixture(scope="module")
def paper() -> ModeBank:
    return load_bank("paper")


def soft_rows(bank: ModeBank, j: int) -> dict[str, tuple[float, float]]:
    r: Any = bank.record[0]
    count = r["n_soft"][j]
    assert (r["soft_kind"][j, :count] == FIXED).all()
    return {
        STATES[r["soft_state"][j, c]]: (r["soft_value"][j, c], r["soft_r"][j, c])
        for c in range(count)
    }


def bounds(bank: ModeBank, j: int) -> dict[str, tuple[float, float]]:
    r: Any = bank.record[0]
    return {
        STATES[r["bound_state"][j, c]]: (r["bound_lower"][j, c], r["bound_upper"][j, c])
        for c in range(r["n_bounds"][j])
    }


def test_names() -> None:
    assert builtin_presets() == ["motorway", "paper", "two-lane"]


def test_paper_table_2(paper: ModeBank) -> None:
    """Row = from, column = to; one row is one measurement period of 100 ms."""
    expected = [
        [0.90, 0.02, 0, 0, 0.04, 0.04, 0],
        [0.01, 0.90, 0.01, 0.08, 0, 0, 0],
        [0, 0.02, 0.90, 0, 0.04, 0.04, 0],
        [0, 0.10, 0.10, 0.80, 0, 0, 0],
        [0.05, 0, 0.05, 0, 0.90, 0, 0],
        [0.05, 0, 0.05, 0, 0, 0.80, 0.10],
        [0, 0, 0, 0, 0.10, 0.10, 0.80],
    ]
    assert paper.modes == tuple(NAMES)
    assert [m.name for m in paper.manoeuvres] == NAMES
    np.testing.assert_array_equal(paper.record[0]["Pi"][10, :7, :7], expected)


@pytest.mark.parametrize(
    ("mode", "rows"),
    [
        ("KEEP_RIGHT", {"vx": (0, 0.1), "y": (0, 0.2), "vy": (0, 0.2)}),
        ("LANE_CHANGE", {"vx": (0, 0.1), "vy": (1, 1)}),
        ("KEEP_LEFT", {"vx": (0, 0.1), "y": (3, 0.2), "vy": (0, 0.2)}),
    ],
)
def test_paper_soft_constraints(
    paper: ModeBank, mode: str, rows: dict[str, tuple[float, float]]
) -> None:
    j = paper.modes.index(mode)
    assert soft_rows(paper, j) == rows
    assert bounds(paper, j) == {}


@pytest.mark.parametrize(
    ("mode", "expected"),
    [
        ("RECEDING", {"vx": (4, math.inf)}),
        ("APPROACHING", {"vx": (-math.inf, -4)}),
        ("REAR_END", {"x": (-math.inf, 10), "vx": (-math.inf, -4)}),
    ],
)
def test_paper_hard_constraints(
    paper: ModeBank, mode: str, expected: dict[str, tuple[float, float]]
) -> None:
    """Projection; y = 0 and vy = 0 are equalities without noise to speak of."""
    j = paper.modes.index(mode)
    assert bounds(paper, j) == expected
    assert paper.record[0]["is_projected"][j]
    rows = soft_rows(paper, j)
    assert set(rows) == {"y", "vy"}
    for value, r in rows.values():
        assert value == 0
        assert r <= 1e-3


def test_paper_motion_and_noise(paper: ModeBank) -> None:
    """F of (32), Q of (33) per step, R of (34) as variances."""
    dt = 0.01
    r = paper.record[0]
    F = [[1, dt, 0, 0], [0, 1, 0, 0], [0, 0, 1, dt], [0, 0, 0, 1]]
    for j, name in enumerate(paper.modes):
        np.testing.assert_allclose(r["F"][1, j, :4, :4], F, atol=1e-15)
        if name != "OVERTAKING":
            Q = np.diag([dt**2 / 2, dt, dt**2 / 2, dt])
            np.testing.assert_allclose(r["Q"][1, j, :4, :4], Q, atol=1e-15)
    assert paper.n_states == 4
    assert paper.measurement_variance == pytest.approx([0.1, 0.3, 0.2, 0.3])
    assert paper.lane_width == 3.0


def test_paper_overtaking(paper: ModeBank) -> None:
    """Fig. 4: the trapezoid's corners (50.0, 0) (51.1, 2.1) (52.6, 2.1) (53.75, 0)."""
    r = paper.record[0]
    p = r["particle"]
    assert [n for n, on in zip(paper.modes, r["is_particle"], strict=False) if on] == ["OVERTAKING"]
    corners = [p["entry"] + u * p["length_low"] for u in (0, p["up"], p["down"], 1)]
    assert corners == pytest.approx([50.0, 51.1, 52.6, 53.75])
    assert p["length_high"] == p["length_low"]
    assert (p["peak_low"], p["peak_high"]) == (2.1, 2.1)
    assert (p["y_low"], p["y_high"]) == (0.5, 3.5)
    assert p["absolute"]
    assert 300 <= paper.n_particles <= 1000


@pytest.mark.parametrize("name", builtin_presets())
def test_every_preset(name: str) -> None:
    bank = load_bank(name)
    r = bank.record[0]
    m, n = len(bank.modes), bank.n_states
    assert bank.name == name
    said = set(bank.manoeuvres) | ({Manoeuvre.REAR_END} if r["rear_end_gap"] > 0.0 else set())
    assert said == set(MOTORWAY if name == "motorway" else TWO_LANES)
    np.testing.assert_allclose(r["Pi"][:, :m, :m].sum(axis=2), 1.0, rtol=1e-12)
    assert (r["Pi"] >= 0.0).all()
    assert (r["Pi"][:, m:] == 0.0).all()
    np.testing.assert_allclose(r["Pi"][0, :m, :m], np.eye(m), atol=1e-12)
    np.testing.assert_array_equal(r["F"][0, :m, :n, :n], np.broadcast_to(np.eye(n), (m, n, n)))
    assert (r["Q"][0] == 0.0).all()
    assert r["mu0"][:m].sum() == pytest.approx(1.0)
    for j in range(m):
        assert np.linalg.eigvalsh(r["Q"][10, j, :n, :n]).min() >= -1e-15


def test_two_lane_knows_both_directions_of_a_lane_change() -> None:
    bank = load_bank("two-lane")
    changes = {
        int(d)
        for m, d in zip(bank.manoeuvres, bank.direction, strict=True)
        if m is Manoeuvre.LANE_CHANGE
    }
    assert changes == {-1, 1}


def test_two_lane_can_go_from_keeping_right_to_overtaking() -> None:
    """Table 2 has a 0 there."""
    bank = load_bank("two-lane")
    Pi = bank.record[0]["Pi"][10]
    keep = [j for j, m in enumerate(bank.manoeuvres) if m is Manoeuvre.KEEP_RIGHT]
    over = [j for j, m in enumerate(bank.manoeuvres) if m is Manoeuvre.OVERTAKING]
    assert Pi[np.ix_(keep, over)].sum() > 1e-4


def test_motorway() -> None:
    """Both directions; what stands or comes needs the ground; nobody else stands or comes."""
    bank = load_bank("motorway")
    r: Any = bank.record[0]
    changes = [
        int(d)
        for m, d in zip(bank.manoeuvres, bank.direction, strict=True)
        if m is Manoeuvre.LANE_CHANGE
    ]
    assert sorted(set(changes)) == [-1, 1]
    assert bank.road is not None
    assert bank.n_particles == 0
    assert r["relative_lanes"]
    for j, manoeuvre in enumerate(bank.manoeuvres):
        off_lane = manoeuvre in (Manoeuvre.STATIONARY, Manoeuvre.ONCOMING)
        assert r["off_lane"][j] == off_lane
        grounded = r["bound_kind"][j, : r["n_bounds"][j]] == GROUND
        assert (r["bound_mass"][j, : r["n_bounds"][j]][grounded] == 1).all()
        if off_lane:
            assert grounded.any(), "without the ego's speed it is never said"
        for c in np.flatnonzero(grounded):
            low, high = r["bound_lower"][j, c], r["bound_upper"][j, c]
            if manoeuvre is Manoeuvre.STATIONARY:
                assert low < 0.0 < high
            elif manoeuvre is Manoeuvre.ONCOMING:
                assert high < 0.0
            else:
                assert low > 0.0
        lanes = r["soft_kind"][j, : r["n_soft"][j]] == LANE
        assert (r["soft_lanes"][j, : r["n_soft"][j]][lanes] == [-9, 9]).all()
    # every mode can be reached from every other one
    m = len(bank.modes)
    assert (r["Pi"][200, :m, :m] > 0.0).all()


def test_lanes_that_are_known() -> None:
    """Taken as they are, and not learned."""
    bank, usual = load_bank("motorway", lane_width=3.2, lane_offset=-0.3), load_bank("motorway")
    assert bank.road is not None
    assert usual.road is not None
    told = dict(zip(PARAMETERS, bank.road, strict=True))
    assert (told["width"], told["offset"], bank.lane_width) == (3.2, -0.3, 3.2)
    assert max(told["width_std"], told["offset_std"]) <= 0.05
    assert (bank.road != usual.road).sum() <= 4
    assert load_bank("two-lane", lane_width=3.2).record[0]["lane_prior"] == 0.0


def test_a_road_that_is_known_to_be_straight() -> None:
    bank, usual = load_bank("motorway", straight_road=True), load_bank("motorway")
    assert bank.road is not None
    assert usual.road is not None
    changed = np.array(PARAMETERS)[bank.road != usual.road]
    assert changed.tolist() == ["curvature_std"]
    # over 250 m it leaves its tangent by less than what a radar sees
    assert 0.0 < bank.road[PARAMETERS.index("curvature_std")] * 250.0**2 / 2.0 < 0.05


@pytest.mark.parametrize(
    ("name", "lanes", "message"),
    [
        ("motorway", {"lane_width": 1.9}, "width must be 2 to 6 m, not 1.9"),
        ("motorway", {"lane_width": math.nan}, "width must be"),
        ("motorway", {"lane_offset": 3.1}, "offset must be -3 to 3 m, not 3.1"),
        ("motorway", {"lane_offset": math.nan}, "offset must be"),
        ("two-lane", {"lane_offset": 0.1}, r"two-lane.*: this preset has no \[road\]"),
        ("two-lane", {"straight_road": True}, r"two-lane.*: this preset has no \[road\]"),
    ],
)
def test_lanes_that_are_none(name: str, lanes: dict[str, Any], message: str) -> None:
    with pytest.raises(CanImmError, match=message):
        load_bank(name, **lanes)


@pytest.mark.parametrize("step_ms", [5, 10, 20, 50])
def test_another_step_gives_the_same_model(step_ms: int) -> None:
    """100 ms are 100 ms, whatever they are divided into (eq. (33) is per step: two-lane only)."""
    usual, other = load_bank("two-lane"), load_bank("two-lane", step_ns=step_ms * 1_000_000)
    k = 100 // step_ms
    for table in ("F", "Q", "Pi"):
        np.testing.assert_allclose(
            other.record[0][table][k], usual.record[0][table][10], rtol=1e-8, atol=1e-12
        )
