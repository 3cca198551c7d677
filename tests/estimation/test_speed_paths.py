"""Paths of a speed by hindsight, and what is said of them."""

from __future__ import annotations

import numpy as np
import pytest

from can_imm.estimation import speed_paths as sp
from can_imm.estimation.noise import noise_state
from can_imm.sim.motorway import _speed_labels
from can_imm.types import FloatArray, Manoeuvre

N = 200


def draw(
    t: FloatArray, s: FloatArray, v: FloatArray, std: tuple[float, float], seed: int = 0
) -> tuple[FloatArray, FloatArray]:
    r = np.tile(np.square(std), (len(t), 1))
    speed, rate = np.zeros((2, len(t), N))
    sp.draw_speeds_(t, s, v, r, noise_state(np.random.default_rng(seed)), speed, rate)
    return speed, rate


def ramps(t: FloatArray, knots: list[tuple[float, float]]) -> tuple[FloatArray, FloatArray]:
    """Way and speed at times t (K,) between knots (time, speed)."""
    fine = np.arange(0.0, t[-1] + 0.01, 0.001)
    v = np.interp(fine, *np.array(knots).T)
    return np.interp(t, fine, np.cumsum(v) * 0.001), np.interp(t, fine, v)


def test_a_constant_speed_is_that_of_the_best_line() -> None:
    """Least squares, way and speed measured: mean and spread of the paths."""
    rng = np.random.default_rng(3)
    t = np.arange(60) / 14.0
    s = 20.0 * t + 0.3 * rng.standard_normal(60)
    v = 20.0 + 0.3 * rng.standard_normal(60)
    speed, rate = draw(t, s, v, (0.3, 0.3))
    design = np.concatenate(
        (np.stack([np.ones(60), t], 1), np.stack([np.zeros(60), np.ones(60)], 1))
    )
    cov = np.linalg.inv(design.T @ design / 0.09)
    best = cov @ design.T @ np.concatenate((s, v)) / 0.09
    middle = slice(20, 40)
    assert speed[middle].mean() == pytest.approx(best[1], abs=0.03)
    assert np.sqrt(cov[1, 1]) < speed[30].std() < 2.5 * np.sqrt(cov[1, 1])
    assert (rate[middle] == 0.0).mean() > 0.9


def test_a_ramp_is_found_where_it_is() -> None:
    rng = np.random.default_rng(4)
    t = np.arange(200) / 14.0
    s, v = ramps(t, [(0.0, 0.0), (5.0, 0.0), (7.0, 3.0), (20.0, 3.0)])
    speed, rate = draw(
        t, s + 0.1 * rng.standard_normal(200), v + 0.3 * rng.standard_normal(200), (0.1, 0.3)
    )
    assert np.abs(speed.mean(axis=1) - v).max() < 0.2
    up = (rate > 0.0).mean(axis=1)
    assert up[(t > 5.3) & (t < 6.7)].min() > 0.9
    assert up[(t > 1.0) & (t < 4.6)].max() < 0.1
    assert rate[(t > 5.5) & (t < 6.5)].mean() == pytest.approx(1.5, abs=0.25)


def test_the_truth_is_one_of_the_paths() -> None:
    """Ranks of the true speed among the paths: as often high as low, rarely outside; the paths
    spread further than their mean is wrong, but not by far."""
    rng = np.random.default_rng(5)
    ranks, errors, spreads = [], [], []
    for seed in range(30):
        t = np.arange(120) / 14.0
        knots, at, value = [(0.0, 0.0)], 0.0, 0.0
        while at < t[-1]:
            at += rng.exponential(4.0)
            knots.append((at, value))
            to = value + rng.choice((-1, 1)) * rng.uniform(1.0, 4.0)
            at += abs(to - value) / rng.uniform(1.0, 2.0)
            value = to
            knots.append((at, value))
        s, v = ramps(t, knots)
        speed, _ = draw(
            t, s + 0.1 * rng.standard_normal(120), v + 0.3 * rng.standard_normal(120), (0.1, 0.3),
            seed,
        )  # fmt: skip
        ranks.append((speed[10:110] < v[10:110, None]).mean(axis=1))
        errors.append(speed[10:110].mean(axis=1) - v[10:110])
        spreads.append(speed[10:110].std(axis=1))
    rank = np.concatenate(ranks)
    assert 0.42 < rank.mean() < 0.58
    assert ((rank > 0.025) & (rank < 0.975)).mean() > 0.9
    wrong, spread = (np.sqrt(np.mean(np.square(one))) for one in (errors, spreads))
    assert wrong < spread < 0.1


def test_what_is_not_measured_is_no_measurement() -> None:
    rng = np.random.default_rng(6)
    t = np.arange(80) * 0.05
    _, v = ramps(t, [(0.0, 10.0), (9.0, 10.0)])
    v = v + 0.1 * rng.standard_normal(80)
    v[20:60] = np.nan
    speed, _ = draw(t, np.full(80, np.nan), v, (1.0, 0.1))
    assert np.isfinite(speed).all()
    assert np.abs(speed.mean(axis=1) - 10.0).max() < 0.3
    assert speed[40].std() > 1.2 * speed[10].std()


def test_judged_as_the_truth_is_labelled() -> None:
    rng = np.random.default_rng(7)
    t = np.arange(3000) * 0.01
    speed, rate = np.zeros((2, 3000, 20))
    for n in range(20):
        at, value = 0.0, float(rng.choice((0.0, 0.3, -0.3)))
        knots = [(0.0, value)]
        while at < 30.0:
            at += rng.uniform(0.5, 4.0)
            knots.append((at, value))
            to = float(rng.choice((0.0, 0.2, -0.2, 0.8, -0.8, 1.2, -1.2, 3.0, -3.0)))
            at += abs(to - value) / rng.uniform(0.3, 2.0) + 0.1
            value = to
            knots.append((at, value))
        speed[:, n] = np.interp(t, *np.array(knots).T)
        rate[:, n] = np.interp(t + 1e-4, *np.array(knots).T) - np.interp(t, *np.array(knots).T)
    rate = np.where(abs(rate) < 1e-9, 0.0, rate * 1e4)
    p = np.zeros((3000, 2))
    sp.judge_speeds_(speed, rate, p)
    labels = np.stack([_speed_labels(speed[:, n], rate[:, n]) for n in range(20)], axis=1)
    np.testing.assert_allclose(p[:, 0], (labels == Manoeuvre.RECEDING).mean(axis=1), atol=0.051)
    np.testing.assert_allclose(p[:, 1], (labels == Manoeuvre.APPROACHING).mean(axis=1), atol=0.051)
    assert abs(p[:, 0] - (labels == Manoeuvre.RECEDING).mean(axis=1)).mean() < 0.001
