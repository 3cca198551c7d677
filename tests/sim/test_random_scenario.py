"""Randomised scenarios: varied, physically continuous, labelled by the same rules."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from can_imm.sim.model import LEFT, RIGHT, Scenario, windows
from can_imm.sim.random import random_scenario
from can_imm.sim.truth import Truth, simulate
from can_imm.types import N_MANOEUVRES, VY, Manoeuvre, X, Y

seeds = st.integers(0, 2**32 - 1)


def draw(seed: int) -> tuple[Scenario, Truth]:
    scenario = random_scenario(np.random.default_rng(seed))
    (truth,) = simulate(scenario)
    return scenario, truth


@pytest.fixture(scope="module")
def drives() -> list[tuple[Scenario, Truth]]:
    return [draw(seed) for seed in range(150)]


def test_equal_seeds_give_equal_scenarios() -> None:
    first, again, other = (random_scenario(np.random.default_rng(s)) for s in (1, 1, 2))
    assert first == again
    assert first != other


def test_all_manoeuvres_occur_in_reasonable_shares(drives: list[tuple[Scenario, Truth]]) -> None:
    labels = np.concatenate([truth.label for _, truth in drives])
    share = np.bincount(labels, minlength=N_MANOEUVRES) / len(labels)
    two_lanes = [Manoeuvre(m) for m in range(Manoeuvre.KEEP_RIGHT, Manoeuvre.REAR_END + 1)]
    assert share[[m for m in Manoeuvre if m not in two_lanes]].sum() == 0
    low = {"KEEP_RIGHT": 0.2, "KEEP_LEFT": 0.08, "RECEDING": 0.08, "APPROACHING": 0.12}
    for manoeuvre in two_lanes:
        assert low.get(manoeuvre.name, 0.02) < share[manoeuvre] < 0.4, manoeuvre
    segments = [1 + np.count_nonzero(np.diff(truth.label)) for _, truth in drives]
    assert 10 < np.mean(segments) < 17


def test_length_and_end(drives: list[tuple[Scenario, Truth]]) -> None:
    ends = np.array([truth.t_ns[-1] * 1e-9 for _, truth in drives])
    assert ends.min() > 55
    assert np.median(ends) == pytest.approx(70, abs=4)
    assert np.mean(ends < 84) > 0.9
    closed = np.array([truth.label[-1] == Manoeuvre.REAR_END for _, truth in drives])
    assert 0.45 < closed.mean() < 0.75
    # those that end with a rear-end are at full speed, the others keep their lane
    for (_, truth), crash in zip(drives, closed, strict=True):
        if crash:
            assert truth.state[-1, 1] < -2.8
            assert truth.state[-1, X] < 0.1
        else:
            assert truth.label[-1] in (Manoeuvre.KEEP_RIGHT, Manoeuvre.KEEP_LEFT)


def test_parameters_spread_over_their_ranges(drives: list[tuple[Scenario, Truth]]) -> None:
    def spread(values: list[float], low: float, high: float) -> None:
        assert low <= min(values) < low + 0.15 * (high - low)
        assert high - 0.15 * (high - low) < max(values) <= high

    scenarios = [scenario for scenario, _ in drives]
    spread([s.lane_width for s in scenarios], 3.0, 3.75)
    spread([s.vehicle.acceleration for s in scenarios], 1.4, 2.6)
    spread([s.objects[0].gap for s in scenarios], 30.0, 70.0)
    assert {s.objects[0].lane for s in scenarios} == {RIGHT, LEFT}
    rows = [(s, row, end) for s in scenarios for row, end in windows(s, s.objects[0])]
    receding = [row.peak * 3.6 for _, row, _ in rows if row.label == Manoeuvre.RECEDING]
    spread(receding, 7.0, 13.0)
    approaching = [row.peak * 3.6 for _, row, _ in rows if row.label == Manoeuvre.APPROACHING]
    assert 17.0 < max(approaching) <= 19.5
    rates = [
        s.lane_width / (end - row.start)
        for s, row, end in rows
        if row.label == Manoeuvre.LANE_CHANGE
    ]
    spread(rates, 0.75 * 0.7 - 0.002, 1.5 * 1.3)
    assert {row.direction for _, row, _ in rows} == {-1, 0, 1}


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_a_drive_is_continuous_and_keeps_its_distance(seed: int) -> None:
    scenario, truth = draw(seed)
    assert truth.state[:, X].min() > 0
    assert truth.state[:, X].max() < 150
    assert np.abs(np.diff(truth.speed)).max() <= scenario.vehicle.acceleration * 0.01 + 1e-9
    assert np.abs(truth.state[:, VY]).max() < 4.0
    assert truth.state[:, Y].min() > -0.3
    assert truth.state[:, Y].max() < scenario.lane_width + 0.3


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_labels_tell_what_the_vehicle_does(seed: int) -> None:
    scenario, truth = draw(seed)
    y, gap = truth.state[:, Y], truth.state[:, X]
    first = np.flatnonzero(np.diff(truth.label, prepend=-1))
    order = [Manoeuvre(label) for label in truth.label[first]]
    keep = {Manoeuvre.KEEP_RIGHT, Manoeuvre.KEEP_LEFT}
    for before, after in pairwise(order):
        assert before in keep or after in keep or after == Manoeuvre.REAR_END
        assert after != Manoeuvre.REAR_END or before == Manoeuvre.APPROACHING
        # between the lanes only a lane change
        assert {before, after} != keep
        if Manoeuvre.OVERTAKING in (before, after):
            assert Manoeuvre.KEEP_LEFT not in (before, after)
    assert (gap[truth.label == Manoeuvre.REAR_END] <= 10.0).all()
    assert (gap[truth.label == Manoeuvre.APPROACHING] > 10.0).all()
    # once the steering has settled, the lane is the label's
    settled = np.convolve(truth.label == Manoeuvre.KEEP_RIGHT, np.ones(200), "full")
    assert np.abs(y[settled[: len(y)] == 200]).max(initial=0) < 0.1
    settled = np.convolve(truth.label == Manoeuvre.KEEP_LEFT, np.ones(200), "full")
    assert np.abs(y[settled[: len(y)] == 200] - scenario.lane_width).max(initial=0) < 0.1
