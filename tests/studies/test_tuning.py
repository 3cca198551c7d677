"""The tuning's fast filter and objective against the slow ones, and its result against others."""

from __future__ import annotations

import numpy as np
import pytest

from can_imm.studies import tuning
from can_imm.studies.baselines import KALMAN_NOISE, RULES, Noise, apply_rules, kalman
from can_imm.studies.metrics import evaluate
from can_imm.studies.runs import FIRST_SEED, TRUTHS, play


@pytest.fixture(scope="module")
def data() -> dict[str, tuning.Data]:
    return {truth: tuning.collect(truth, range(900, 904)) for truth in TRUTHS}


def test_filter_of_all_runs_agrees_with_filterpy(data):
    noise = Noise(0.2, 1.7)
    fast = tuning.filter_all(data["random"], noise)
    for k, seed in enumerate(range(900, 904)):
        _, (seen,) = play("random", seed)
        slow, _ = kalman(seen.t_ns, seen.z, seen.seen, seen.std, noise)
        np.testing.assert_allclose(fast[k, : len(slow)], slow, rtol=0, atol=1e-9)


def test_wrong_frames_are_those_of_the_metrics(data):
    wrong = []
    for seed in range(900, 904):
        _, (seen,) = play("random", seed)
        x, cov = kalman(
            seen.t_ns, seen.z, seen.seen, seen.std, Noise(RULES.q_along, RULES.q_across)
        )
        m = evaluate(seen.t_ns, seen.label, seen.state, apply_rules(x, RULES), None, x, cov)
        wrong.append(1 - m.accuracy)
    assert tuning.wrong_frames(data, RULES)["random"] == pytest.approx(np.mean(wrong))


def test_relative_rmse_of_hardly_any_filtering_is_one(data):
    np.testing.assert_allclose(tuning.relative_rmse(data, Noise(1e6, 1e6)), 1.0, atol=0.05)


def test_no_single_threshold_can_be_moved_to_great_effect(data):
    """Four seeds per truth are noisy, but a forgotten or mistyped constant would show."""
    weights = tuning.WEIGHTS

    def error(rules):
        return sum(weights[t] * v for t, v in tuning.wrong_frames(data, rules).items())

    tuned = error(RULES)
    for name in RULES._fields:
        value = getattr(RULES, name)
        for other in (value * 1.5, value / 1.5):
            changed = not value if isinstance(value, bool) else type(value)(other)
            assert error(RULES._replace(**{name: changed})) > tuned - 0.005, name


def test_tuned_noise_beats_twice_and_half_of_it(data):
    def badness(noise):
        return tuning.relative_rmse(data, noise).sum()

    tuned = badness(KALMAN_NOISE)
    for along, across in ((2, 1), (0.5, 1), (1, 2), (1, 0.5)):
        changed = Noise(KALMAN_NOISE.along * along, KALMAN_NOISE.across * across)
        assert badness(changed) > tuned


def test_search_leaves_a_bad_start(data):
    few = {"A": data["A"], "random": data["random"]}
    bad = RULES._replace(receding=2.5, lane_vy=0.2, dwell=4)
    before = tuning.wrong_frames(few, bad)
    objective = tuning.Objective(few)
    error, rules = tuning.descend(objective, bad)
    after = tuning.wrong_frames(few, rules)
    assert error == pytest.approx(objective(rules))
    assert after["A"] < before["A"] - 0.02
    assert after["random"] < before["random"] - 0.02


def test_seeds_for_reporting_are_refused():
    with pytest.raises(ValueError, match="for reporting"):
        tuning.collect("A", [FIRST_SEED])
