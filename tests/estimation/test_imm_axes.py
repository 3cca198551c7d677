"""Measurements in turned axes, rows that count from the ground or by the time that passed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.gaussian import random_covariance, update
from oracles.imm import Imm
from scipy.stats import multivariate_normal
from small_banks import Runner, add_bound, add_soft, blank, copy_state

from can_imm.estimation import imm, layout, modes

SEEDS = st.integers(0, 2**32 - 1)
R = np.array([0.3, 0.2, 0.4, 0.5])


def two_modes_and_scans() -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Constant velocity with little noise and a soft vy = 0, and with much; 12 measurements."""
    bank = blank(2, 4)
    record = bank[0]
    record["Pi"][10, :2, :2] = [[0.9, 0.1], [0.2, 0.8]]
    record["mu_floor"] = 1e-6
    record["birth_std"][:4] = [1.0, 4.0, 1.0, 1.0]
    for j, q in enumerate((0.01, 1.0)):
        for a in (0, 2):
            record["F"][10, j, a, a + 1] = 0.1
            record["Q"][10, j, a : a + 2, a : a + 2] = q * np.array([[3e-4, 5e-3], [5e-3, 0.1]])
    add_soft(bank, 0, 3, 0.0, 0.1)
    rng = np.random.default_rng(1)
    return bank, np.array([30.0, -2.0, 1.0, 0.2]) + rng.normal(0.0, 0.3, (12, 4))


# ---- turned axes


@settings(max_examples=25)
@given(SEEDS, st.integers(4, 6), st.floats(-3.0, 3.0), st.sampled_from([0.0, 0.05]))
def test_a_measurement_in_turned_axes(seed: int, n: int, angle: float, age: float) -> None:
    """Rows of H turned by the angle; a position of some time ago moves along them."""
    rng = np.random.default_rng(seed)
    x, P, z = rng.normal(size=n), random_covariance(rng, n), rng.normal(size=4)
    valid = rng.random(4) < 0.7
    valid[rng.integers(4)] = True
    back = np.eye(n)  # the state at the time of the measurement
    back[0, 1] = back[2, 3] = -age
    for a, (s, v) in {4: (0, 1), 5: (2, 3)}.items():
        if a < n:
            back[s, a], back[v, a] = 0.5 * age**2, -age
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.zeros((4, n))
    turn[0, [0, 2]] = turn[1, [1, 3]] = cos, sin
    turn[2, [0, 2]] = turn[3, [1, 3]] = -sin, cos
    H = (turn @ back)[valid]
    new_x, new_P, e, S = update(x, P, H, np.diag(R[valid]), z[valid])
    log_l = modes.correct_(n, x, P, np.where(valid, z, np.nan), R, valid, age, angle)
    np.testing.assert_allclose(x, new_x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(P, new_P, rtol=1e-9, atol=1e-9)
    expected = multivariate_normal.logpdf(e, np.zeros(len(e)), S)
    assert log_l == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("angle", [0.4, -1.1, 2.5])
def test_surprise_in_turned_axes(angle: float) -> None:
    """Component by component: position moved on, covariance and jumps turned."""
    rng = np.random.default_rng(2)
    bank = blank(1, 4)
    bank[0]["jump_std"] = jump = np.array([1.0, 4.0, 0.5, 2.0])
    obj = np.zeros(1, layout.OBJECT_DTYPE)
    mean, cov = rng.normal(0.0, 3.0, 4), random_covariance(rng, 4)
    obj[0]["mean"][:4], obj[0]["cov"][:4, :4] = mean, cov
    z, tau = rng.normal(size=4), 0.1 - 0.02
    wide = np.zeros((4, 4))
    for a in (0, 1):
        wide[np.ix_([a, a + 2], [a, a + 2])] = cov[np.ix_([a, a + 2], [a, a + 2])]
    wide += np.diag(jump**2)
    there = mean + tau * np.array([mean[1], 0.0, mean[3], 0.0])
    d = 0.0
    for c, axis in enumerate(([1, 0], [1, 0], [0, 1], [0, 1])):
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        u = np.zeros(4)
        u[[c % 2, c % 2 + 2]] = np.array(axis) @ turn
        d += (z[c] - u @ there) ** 2 / (u @ wide @ u + R[c])
    value = imm.surprise(bank[0], obj[0], 10, z, R, np.ones(4, np.bool_), 0.02, angle)
    assert value == pytest.approx(d, rel=1e-9)


def test_a_track_in_turned_axes_is_the_track_turned_back() -> None:
    """Equal noise along both axes: every measurement in other axes, and nothing else changes."""
    bank, scans = two_modes_and_scans()
    r = np.array([0.3, 0.2, 0.3, 0.2])
    straight, turned = Runner(bank, 1), Runner(bank, 1)
    for k, z in enumerate(scans):
        angle = 0.3 * k - 1.0
        c = (z[:2] + 1j * z[2:]) * np.exp(-1j * angle)
        steps = [10 if k else -1]
        assert straight.scan([0], steps, z, r, gate=1e6)[0] == imm.OK
        other = np.concatenate([c.real, c.imag])
        assert turned.scan([0], steps, other, r, gate=1e6, angle=angle)[0] == imm.OK
        for name in ("mean", "cov", "mu", "x", "P"):
            np.testing.assert_allclose(
                turned.objects[0][name], straight.objects[0][name], rtol=1e-7, atol=1e-7
            )


# ---- rows that count from the ground


@pytest.mark.parametrize("speed", [0.0, 12.0, 40.0, -3.0])
def test_a_row_that_counts_from_the_ground(speed: float) -> None:
    """The same as a row that counts from zero, at minus the ego's speed."""
    counted, fixed = blank(2, 4), blank(2, 4)
    for bank, base in ((counted, 0.0), (fixed, -speed)):
        bank[0]["birth_std"][:4] = 5.0
        bank[0]["mu_floor"] = 1e-6
        bank[0]["Pi"][10, :2, :2] = [[0.9, 0.1], [0.2, 0.8]]
        add_soft(bank, 0, 1, base + 0.3, 0.4)
        add_bound(bank, 0, 1, base - 1.5, base + 1.5, mass=True)
        add_bound(bank, 1, 1, base + 1.5, np.inf, mass=True)
    counted[0]["soft_kind"][0, 0] = layout.GROUND
    counted[0]["bound_kind"][:2, 0] = layout.GROUND
    one, two = Runner(counted, 1), Runner(fixed, 1)
    for k in range(8):
        z = [50.0, -speed + 0.4 * k, 0.0, 0.0]
        one.scan([0], [10 if k else -1], z, R, ground=-speed)
        two.scan([0], [10 if k else -1], z, R)
        for name in ("mu", "mean", "cov"):
            np.testing.assert_allclose(
                one.objects[0][name], two.objects[0][name], rtol=1e-9, atol=1e-9
            )


@pytest.mark.parametrize("valid_vx", [True, False])
def test_without_the_ground_a_mode_that_needs_it_is_never_said(valid_vx: bool) -> None:
    bank = blank(2, 4)
    bank[0]["birth_std"][:4] = 8.0
    bank[0]["mu_floor"] = floor = 1e-6
    bank[0]["Pi"][10, :2, :2] = [[0.9, 0.1], [0.2, 0.8]]
    add_soft(bank, 0, 1, 0.0, 0.25)
    add_bound(bank, 0, 1, -1.5, 1.5, mass=True)
    bank[0]["soft_kind"][0, 0] = bank[0]["bound_kind"][0, 0] = layout.GROUND
    runner = Runner(bank, 1)
    valid = [[True, valid_vx, True, True]]
    for k in range(5):
        z = [50.0 - 2.0 * k, -20.0, 0.0, 0.0]
        status = runner.scan([0], [10 if k else -1], z, R, valid)
        assert status[0] == imm.OK
        assert runner.objects[0]["mu"][0] == pytest.approx(floor, rel=1e-3)
    assert np.isfinite(runner.objects[0]["x"][:2]).all()
    # the ego's speed comes, and the mode with it; it goes, and the mode with it
    for _ in range(25):
        runner.scan([0], [10], [30.0, -20.0, 0.0, 0.0], R, ground=-20.0)
    assert runner.objects[0]["mu"][0] > 0.5
    assert runner.scan([0], [10], [30.0, -20.0, 0.0, 0.0], R)[0] == imm.OK
    assert runner.objects[0]["mu"][0] == pytest.approx(floor, rel=1e-3)


# ---- rows whose variance depends on the time


@pytest.mark.parametrize("steps", [1, 10, 40])
def test_a_density_row_counts_by_the_time_that_passed(steps: int) -> None:
    bank = blank(1, 4)
    bank[0]["Pi"][:, 0, 0] = 1.0
    add_soft(bank, 0, 3, 0.2, 0.05)
    bank[0]["soft_density"][0, 0] = 1
    runner = Runner(bank, 1)
    rng = np.random.default_rng(0)
    x, P = rng.normal(size=4), random_covariance(rng, 4)
    copy_state(Imm([], [x], [P], np.array([1.0])), runner.objects[0])
    z = rng.normal(size=4)
    assert runner.scan([0], [steps], z, R)[0] == imm.OK
    elapsed = 0.01 * steps
    x, P, _, _ = update(x, P, np.eye(4)[[3]], np.array([[0.05 / elapsed]]), np.array([0.2]))
    x, P, _, _ = update(x, P, np.eye(4), np.diag(R), z)
    np.testing.assert_allclose(runner.objects[0]["mean"][:4], x, rtol=1e-9)
    np.testing.assert_allclose(runner.objects[0]["cov"][:4, :4], P, rtol=1e-9, atol=1e-12)


def test_the_roads_width_is_that_of_all_objects() -> None:
    runner = Runner(blank(1, 4), 2)
    runner.scan([0, 1], [-1, -1], np.zeros((2, 4)), R, lane_width=3.8)
    assert runner.objects["lane_width"].tolist() == [3.8, 3.8]
    runner.scan([0], [5], np.zeros(4), R, lane_width=3.7)
    assert runner.objects["lane_width"].tolist() == [3.7, 3.8]


# ---- bounds of one state


def keeping_and_bounded(*rows: tuple[float, float], mass: bool) -> Runner:
    """Mode 0 knows no bounds, mode 1 those rows for vx."""
    bank = blank(2, 4)
    bank[0]["mu_floor"] = 1e-6
    bank[0]["birth_std"][:4] = 3.0
    bank[0]["Pi"][10, :2, :2] = [[0.9, 0.1], [0.2, 0.8]]
    bank[0]["Q"][10, :2, range(4), range(4)] = 0.1
    for low, high in rows:
        add_bound(bank, 1, 1, low, high, mass=mass)
    return Runner(bank, 1)


@pytest.mark.parametrize("mass", [False, True])
@pytest.mark.parametrize("projected", [False, True])
def test_bounds_of_one_state_are_one_interval(mass: bool, projected: bool) -> None:
    several = keeping_and_bounded((-np.inf, 1.0), (0.4, np.inf), (-5.0, 2.0), mass=mass)
    one = keeping_and_bounded((0.4, 1.0), mass=mass)
    rng = np.random.default_rng(0)
    for runner in (several, one):
        runner.bank[0]["is_projected"][1] = projected
        add_bound(runner.bank, 1, 3, -1.0, 1.0, mass=mass)
    for k in range(10):
        z = rng.normal(0.0, 0.5, 4)
        for runner in (several, one):
            assert runner.scan([0], [10 if k else -1], z, R)[0] == imm.OK
        if k == 0:  # a birth weighs row by row
            copied = one.objects.copy()
            several.objects[:] = copied
        for name in ("mu", "mean", "cov", "Pi"):
            np.testing.assert_allclose(
                several.objects[0][name], one.objects[0][name], rtol=1e-9, atol=1e-12
            )


@pytest.mark.parametrize("mass", [False, True])
def test_bounds_that_contradict_each_other_make_a_mode_impossible(mass: bool) -> None:
    """However far the measurement jumps towards one of them."""
    runner = keeping_and_bounded((-np.inf, -0.1), (1.5, np.inf), mass=mass)
    for k in range(12):
        z = [10.0, (0.0, 0.5, -0.5, 1.6)[k % 4], 0.0, 0.0]
        assert runner.scan([0], [10 if k else -1], z, R)[0] == imm.OK
        assert runner.objects[0]["mu"][1] == pytest.approx(1e-6, rel=1e-3)
        assert abs(runner.objects[0]["mean"][1]) < 1.6
