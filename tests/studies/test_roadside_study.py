"""The roadside study: its measures on made-up answers, and short runs of the real thing."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from can_imm.cli.main import build_parser, main
from can_imm.sim.roadside import load_scene, play_scene
from can_imm.studies import roadside_tuning
from can_imm.studies.roadside import (
    SYSTEMS,
    Result,
    Study,
    cv,
    mean_and_error,
    per_run,
    reduction,
    study,
    to_json,
)
from can_imm.studies.runs import FIRST_SEED
from can_imm.trackers.roadside import IMM_UKF

SCENE = load_scene()
RUN = play_scene(SCENE, np.random.default_rng(0))
BEND = np.flatnonzero(RUN.turn_rate)


def made_up(shift, p_turn):
    """A study of one system in two runs that is wrong by ``shift`` everywhere."""
    x = np.stack([RUN.state + shift, RUN.state])
    return Study(0, SCENE, RUN, [Result("imm-ukf", IMM_UKF, x, p_turn)])


def values(done):
    return per_run(done, done.results[0])


def test_errors_are_root_mean_squares_after_the_first_second():
    p = np.zeros((2, 250))
    done = made_up(np.array([0.3, 0.0, 0.4, 0.0]), p)
    done.results[0].x[:, :20] += 1e6
    found = values(done)
    assert found["position"] == pytest.approx([0.5, 0.0])
    assert found["speed"] == pytest.approx([0.0, 0.0])
    # 2 m/s too fast on the straight, the same vector where the vehicle drives across
    shift = np.zeros((250, 4))
    shift[:, 1] = RUN.state[:, 1] / 6.0
    shift[:, 3] = RUN.state[:, 3] / 6.0
    found = values(made_up(shift, p))
    assert found["speed"] == pytest.approx([2.0, 0.0])
    assert found["velocity"] == pytest.approx([2.0, 0.0])
    # a wrong heading is an error of the vector and not of the speed
    turned = np.stack([RUN.state[:, 0], -RUN.state[:, 3], RUN.state[:, 2], RUN.state[:, 1]], axis=1)
    found = values(made_up(turned - RUN.state, p))
    assert found["speed"] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert found["velocity"] == pytest.approx([12.0 * math.sqrt(2.0), 0.0])


def test_the_bend_is_detected_at_the_first_scan_in_it_above_one_half():
    p = np.full((2, 250), 0.1)
    p[0, BEND[4] :] = 0.8
    p[0, BEND[-1] + 1 :] = 0.2
    p[1, BEND[0] - 5 : BEND[0]] = 0.9  # before the bend: a false alarm and no detection
    found = values(made_up(np.zeros(4), p))
    assert found["delay_s"][0] == pytest.approx(0.2)
    assert math.isnan(found["delay_s"][1])
    assert found["missed"].tolist() == [0.0, 1.0]
    straights = 250 - 20 - len(BEND)
    assert found["false_alarms"] == pytest.approx([0.0, 5 / straights])
    assert found["p_turn_bend"] == pytest.approx([0.1 + 0.7 * (1 - 4 / len(BEND)), 0.1])
    assert found["p_turn_straight"][1] == pytest.approx(0.1 + 0.8 * 5 / straights)


def test_mean_and_error_leave_out_what_does_not_exist():
    mean, error = mean_and_error(np.array([1.0, 2.0, np.nan, 3.0]))
    assert (mean, error) == (2.0, pytest.approx(1.0 / math.sqrt(3.0)))
    assert all(map(math.isnan, mean_and_error(np.array([np.nan]))))


def test_the_error_of_a_reduction_is_the_spread_of_repeated_studies():
    rng = np.random.default_rng(1)
    found = []
    for _ in range(400):
        common = rng.normal(size=50)
        against = 5.0 + common
        found.append(reduction(2.0 + 0.3 * common + 0.1 * rng.normal(size=50), against))
    reductions, errors = np.array(found).T
    assert reductions.mean() == pytest.approx(0.6, abs=0.002)
    assert errors.mean() == pytest.approx(reductions.std(), rel=0.1)


@pytest.fixture(scope="module")
def done():
    return study(8, 200)


def test_the_published_reduction_comes_from_a_filter_without_noise(done):
    strawman, tuned, imm = (per_run(done, result)["position"].mean() for result in done.results)
    assert 9.0 < strawman < 13.0  # published: 11.62
    assert 1.0 - imm / strawman > 0.95
    assert 0.15 < 1.0 - imm / tuned < 0.7


def test_the_imm_knows_the_bend(done):
    found = per_run(done, done.results[2])
    assert found["p_turn_bend"].mean() > 0.85
    assert found["p_turn_straight"].mean() < 0.22
    assert found["delay_s"].mean() < 0.4
    assert not found["missed"].any()


def test_the_same_seeds_give_the_same_study(done):
    again = study(2, 201)
    for one, other in zip(done.results, again.results, strict=True):
        assert np.array_equal(one.x[1:3], other.x)
        assert np.array_equal(one.p_turn[1:3], other.p_turn)


def test_json_has_the_names_that_others_rely_on(done):
    data = to_json(done)
    json.dumps(data, allow_nan=False)
    assert (data["runs"], data["seed"]) == (8, 200)
    assert [result["system"] for result in data["results"]] == [*SYSTEMS]
    assert set(SYSTEMS) == {"cv-strawman", "cv-tuned", "imm-ukf"}
    for result in data["results"]:
        assert set(result["rmse"]) == {"position", "speed", "velocity"}
        assert set(result["se"]["rmse"]) == set(result["rmse"])
        assert result["setting"]["models"][0]["kind"] == "cv"
    imm = data["results"][2]
    assert {"p_turn_bend", "p_turn_straight", "delay_s"} <= set(imm)
    assert set(imm["reduction"]) == {"cv-strawman", "cv-tuned"}
    expected = 1 - imm["rmse"]["position"] / data["results"][1]["rmse"]["position"]
    assert imm["reduction"]["cv-tuned"]["position"] == pytest.approx(expected, abs=1e-5)


def test_tuning_numbers_there_and_back():
    again = roadside_tuning.settings(roadside_tuning.numbers(IMM_UKF))
    assert again == IMM_UKF


def test_tuning_keeps_to_its_floors_and_to_probabilities():
    wild = roadside_tuning.numbers(IMM_UKF) * [1e-9, 1e-9, 1e-9, 1.0, 1e-9, 1e9, 1e9, 1e9]
    found = roadside_tuning.settings(wild)
    assert found.models[0].q == roadside_tuning.LEAST_Q
    assert found.models[1].turn[1] == roadside_tuning.LEAST_TURN_STD
    for row in found.transitions:
        assert sum(row) == pytest.approx(1.0)
        assert min(row) > 0.0


def test_tuning_refuses_the_seeds_of_reports():
    with pytest.raises(ValueError, match="reporting"):
        roadside_tuning.cost(IMM_UKF, range(FIRST_SEED - 1, FIRST_SEED + 1))


def test_the_tuned_noise_is_better_than_its_neighbours():
    systems = {str(q): cv(q) for q in (0.3, 3.0, 30.0)}
    less, tuned, more = (
        per_run(d, r)["position"].mean()
        for d in [study(6, 300, systems=systems)]
        for r in d.results
    )
    assert tuned < min(less, more)
    assert SYSTEMS["cv-tuned"] == cv(3.0)


# The command


def test_prints_tables_and_writes_json_and_figures(tmp_path, capsys):
    file, folder = tmp_path / "out.json", tmp_path / "figures"
    arguments = ["--runs", "2", "--seed", "7", "--json", str(file), "--plots", str(folder)]
    assert main(["study", "roadside", *arguments]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "2 runs, seeds 7 to 8" in out
    assert "4 figures in" in out
    assert "…" not in out
    assert max(map(len, out.splitlines())) <= 80
    data = json.loads(file.read_text())
    position = data["results"][2]["rmse"]["position"]
    (row,) = (r for r in out.splitlines() if r.startswith("imm-ukf") and f"{position:.3f}" in r)
    assert row
    assert sorted(p.name for p in folder.iterdir()) == [
        "roadside_errors.png",
        "roadside_reductions.png",
        "roadside_trajectory.png",
        "roadside_turn_probability.png",
    ]
    assert all(p.read_bytes().startswith(b"\x89PNG") for p in folder.iterdir())


def test_a_road_without_a_bend_can_be_studied(tmp_path, capsys):
    straight = replace(SCENE, road=replace(SCENE.road, pieces=SCENE.road.pieces[:1]))
    done = study(2, 0, scene=straight)
    assert "delay_s" not in per_run(done, done.results[2])
    assert to_json(done)["results"][2]["p_turn_straight"] < 0.4


@pytest.mark.parametrize(
    "arguments",
    [["roadside", "--runs", "0"], ["roadside", "--seed", "-1"], ["tune-roadside", "--runs", "501"]],
)
def test_wrong_usage(arguments):
    with pytest.raises(SystemExit) as stopped:
        main(["study", *arguments])
    assert stopped.value.code == 2


def test_a_scene_that_does_not_exist_is_one_line(capsys):
    assert main(["study", "roadside", "--scene", "no-such-scene"]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert "no-such-scene" in err


def test_the_default_seed_is_one_that_nothing_was_tuned_on():
    arguments = build_parser(["study"]).parse_args(["study", "roadside"])
    assert arguments.seed == FIRST_SEED
    assert arguments.runs >= 50
