"""The Bernoulli filter's study: its numbers, its baseline, its file and its figures."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from can_imm.cli.main import main
from can_imm.estimation.bernoulli import BernoulliModel
from can_imm.sim.cooperative import load_scene
from can_imm.studies import bernoulli, bernoulli_runtime
from can_imm.studies.bernoulli import (
    EKF,
    PRODUCT,
    SWEEPS,
    UNION,
    Setting,
    follow_ekf,
    linearity,
    model_for,
    play,
    settings,
    study,
    to_json,
    trends,
)

FAST = {"period": (0.5,), "particles": (100,), "k_s": (1.0, 3.0), "k_m": (1.0, 3.0)}


@pytest.fixture(scope="module")
def done():
    return study(2, 0, sweeps=FAST)


def test_the_published_sweeps():
    rows = settings(SWEEPS)
    assert len(rows) == 6 + 5 + 6 + 6
    # one parameter at a time
    for sweep, value, setting in rows:
        assert replace(Setting(), **{sweep: value}) == setting
    assert Setting() == Setting(0.1, 100, 1.0, 1.0)


def test_k_s_multiplies_the_covariance_and_k_m_the_process_noise():
    base, model = BernoulliModel(), model_for(Setting(k_s=4.0, k_m=3.0, period=0.5))
    assert model.std_range == pytest.approx(2.0 * base.std_range)
    assert model.std_bearing == pytest.approx(2.0 * base.std_bearing)
    assert model.std_rate == pytest.approx(2.0 * base.std_rate)
    assert (model.density, model.period_s) == (3.0, 0.5)


def test_the_sensors_are_as_the_model_believes():
    run = play(load_scene("cooperative"), model_for(Setting(period=0.5), clutter=4.0), 1)
    assert len(run.scans) == 30
    assert np.mean([scan.n for scan in run.scans]) == pytest.approx(5 * 4.95, rel=0.15)


def test_errors_are_of_the_expected_size(done):
    rmse = {(p.system, p.sweep, p.value): p.rmse.mean() for p in done.points if p.sweep != "period"}
    assert 0.04 < rmse[PRODUCT, "particles", 100] < 0.09
    assert 0.04 < rmse[EKF, "particles", 100] < 0.08
    assert rmse[PRODUCT, "particles", 100] < rmse[UNION, "particles", 100]
    ratio = rmse[PRODUCT, "k_s", 3.0] / rmse[PRODUCT, "k_s", 1.0]
    assert ratio == pytest.approx(math.sqrt(3.0), rel=0.25)
    for p in done.points:
        assert (p.std < p.rmse).all()
        assert (p.missing < 0.05).all()


def test_q_rises_and_falls_in_time(done):
    for system, worst in ((PRODUCT, (3, 2)), (UNION, (3, 5))):
        assert (done.existence[system] <= worst).all()


def test_linearity():
    x = np.array([1.0, 2.0, 3.0, 4.0])
    assert linearity(x, 2 * x + 1) == pytest.approx((2.0, 1.0, 1.0))
    assert linearity(x, np.array([1.0, -1.0, 1.0, -1.0]))[2] == pytest.approx(0.2)


def test_json(done):
    data = json.loads(json.dumps(to_json(done, []), allow_nan=False))
    assert {result["system"] for result in data["results"]} == {PRODUCT, UNION, EKF}
    assert (data["runs"], data["seed"]) == (2, 0)
    for result in data["results"]:
        assert result["rmse"] > 0.0
        assert result["se"]["rmse"] >= 0.0
        assert set(result["setting"]) == {"sweep", "period", "particles", "k_s", "k_m"}
    assert trends(done)[PRODUCT]["rmse"]["r2_sqrt_k_s"] == pytest.approx(1.0)


def test_ekf_recovers_what_there_is_to_see():
    model = BernoulliModel(std_range=0.01, std_bearing=1e-4, std_rate=0.01, clutter=1e-9)
    scene = load_scene("cooperative")
    run = play(scene, replace(model, p_detection=0.9), 3)
    x = follow_ekf(run, model)
    truth = scene.target.state(run.t_ns * 1e-9)
    np.testing.assert_allclose(x[5:, [0, 2]], truth[5:, [0, 2]], atol=0.05)


def test_the_numpy_filter_follows_the_same_object():
    scene = load_scene("cooperative")
    model = BernoulliModel()
    run = play(scene, model, 3)
    slow = bernoulli_runtime.NumpyFilter(model, 500, np.random.default_rng(0))
    x, q = bernoulli.follow(run, model, 500, 3)
    error = []
    for k, scan in enumerate(run.scans[:60]):
        slow.step(0.1, scan)
        error.append(np.hypot(*(slow._p.mean(axis=1) - x[k])[[0, 2]]))
    assert slow.q == pytest.approx(q[59], abs=1e-3)
    assert np.mean(error[5:]) < 0.08


def test_command(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(bernoulli, "QUICK_SWEEPS", FAST)
    monkeypatch.setattr(bernoulli_runtime, "QUICK_SIZES", (600,))
    arguments = [
        "study", "bernoulli", "--quick", "--runs", "2", "--seed", "0", "--jobs", "1",
        "--resume", str(tmp_path / "runs.jsonl"), "--json", str(tmp_path / "out.json"),
        "--plots", str(tmp_path / "figures"),
    ]  # fmt: skip
    assert main(arguments) == 0
    out = capsys.readouterr().out
    assert "T_s  0.5" in out
    assert "14 figures" in out
    assert len(list((tmp_path / "figures").glob("bernoulli_*.png"))) == 14
    data = json.loads((tmp_path / "out.json").read_text())
    assert data["runtime"][0]["particles"] == 600
    assert len((tmp_path / "runs.jsonl").read_text().splitlines()) == 2 * (4 + 1)


@pytest.mark.benchmark
def test_42000_particles_take_a_small_part_of_the_period():
    (row,) = bernoulli_runtime.measure((42_000,))
    assert row["best_ms"] < 8.0
    assert row["median_ms"] < row["numpy_median_ms"]
