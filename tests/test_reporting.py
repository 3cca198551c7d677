"""Reports from mode probabilities: who was never fast keeps its lane."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from can_imm import reporting
from can_imm.manoeuvres import load_bank
from can_imm.types import REPORT_DTYPE, Manoeuvre

KEEP, RECEDING, APPROACHING = (
    Manoeuvre.KEEP_LANE,
    Manoeuvre.RECEDING,
    Manoeuvre.APPROACHING,
)


def concluded(
    preset: str, weights: dict[str, float], vx: float, std: float, reached: tuple[float, float]
) -> np.ndarray:
    """Probabilities of the manoeuvres, from those of some modes."""
    bank = load_bank(preset)
    mu = np.zeros(bank.record["mu0"].shape[-1])
    for name, weight in weights.items():
        mu[list(bank.modes).index(name)] = weight
    mean, cov = np.array([60.0, vx, 0.0, 0.0, 0.0, 0.0]), np.diag([0.1, std**2, 0.1, 0.1, 1.0, 1.0])
    report = np.zeros(1, REPORT_DTYPE)
    reporting.conclude_(bank.record[0], 3.5, mu, mean, cov, np.array(reached), report[0])
    assert report["p"].sum() == pytest.approx(1.0)
    return report["p"][0]


@pytest.mark.parametrize("vx", [0.6, 0.9, 1.0, 1.3])
@pytest.mark.parametrize("reached", [0.0, 0.3, 1.0])
def test_a_speed_that_was_never_reached_counts_by_how_sure_it_is_held(vx, reached):
    weights = {"RECEDING_HOLD": 0.5, "RECEDING_UP": 0.2, "RECEDING_DOWN": 0.1, "KEEP_LANE": 0.2}
    p = concluded("motorway", weights, vx, 0.1, (reached, 1.0))
    kept = 0.5 * (0.5 / 0.8) * norm.cdf((1.0 - vx) / 0.1) * (1.0 - reached)
    assert p[RECEDING] == pytest.approx(0.8 - kept)
    assert p[KEEP] == pytest.approx(0.2 + kept)
    mirrored = {name.replace("RECEDING", "APPROACHING"): weight for name, weight in weights.items()}
    q = concluded("motorway", mirrored, -vx, 0.1, (1.0, reached))
    assert q[APPROACHING] == pytest.approx(p[RECEDING])


def test_ramps_count_as_they_are():
    p = concluded("motorway", {"RECEDING_UP": 0.6, "KEEP_LANE": 0.4}, 0.5, 0.1, (0.0, 0.0))
    assert p[RECEDING] == pytest.approx(0.6)


def test_a_preset_without_a_peak_speed_is_taken_at_its_word():
    p = concluded("paper", {"RECEDING": 1.0}, 0.5, 0.1, (0.0, 0.0))
    assert p[RECEDING] == pytest.approx(1.0)
