"""``can-imm track``, and the chain sensors, tracker, detector in logs and in the demonstration."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from can_imm.bus.sources import LogSource


@pytest.fixture(scope="module")
def sensors(tmp_path_factory):
    """Log of the built-in cooperative scene, and its truth."""
    from can_imm.cli.main import main

    folder = tmp_path_factory.mktemp("sensors")
    log, truth = folder / "sensors.log", folder / "truth.csv"
    arguments = ["simulate", "--scenario", "cooperative", "--log", str(log), "--truth", str(truth)]
    assert main(arguments) == 0
    return log, truth


def table(path):
    with path.open() as file:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]


def test_objects_lie_where_they_are(can_imm, sensors, tmp_path):
    log, truth = sensors
    out = tmp_path / "objects.csv"
    status, said, _ = can_imm("track", "cooperative", log, "--csv", out)
    assert status == 0
    assert "150 of 5.0 sensors, 150 used" in said
    true = {row["time_s"]: row for row in table(truth)}
    rows = table(out)
    assert len(rows) == 146
    error = [
        np.hypot(r["x"] - true[r["time_s"]]["x"], r["y"] - true[r["time_s"]]["y"]) for r in rows
    ]
    assert np.sqrt(np.mean(np.square(error))) < 0.1
    assert all(row["existence"] > 0.99 for row in rows)


def test_the_chain_finds_the_lane_change(can_imm, sensors, tmp_path):
    tracked, answers = tmp_path / "tracked.log", tmp_path / "answers.csv"
    assert can_imm("track", "cooperative", sensors[0], "--out", tracked)[0] == 0
    status, said, _ = can_imm("replay", tracked, "--profile", "tracking", "--csv", answers)
    assert status == 0
    assert said.count(" left") == 1
    with answers.open() as file:
        changes = [
            float(row["time_s"]) for row in csv.DictReader(file)
            if row["manoeuvre"] == "LANE_CHANGE"
        ]  # fmt: skip
    assert 6.0 < min(changes) < 7.5
    assert 9.5 < max(changes) < 11.0


def test_tracking_its_own_output_replaces_it(can_imm, sensors, tmp_path):
    first, second = tmp_path / "first.log", tmp_path / "second.log"
    assert can_imm("track", "cooperative", sensors[0], "--out", first)[0] == 0
    status, said, _ = can_imm("track", "cooperative", first, "--out", second)
    assert status == 0
    assert "replaced: 296 frames" in said
    assert second.read_bytes() == first.read_bytes()


def test_options_of_the_filter_are_heard(can_imm, sensors, tmp_path):
    files = []
    for number, options in enumerate([[], ["--update", "union"], ["--seed", "3"],
                                      ["--particles", "50"], ["--ego", "2"]]):  # fmt: skip
        path = tmp_path / f"{number}.csv"
        assert can_imm("track", "cooperative", sensors[0], "--csv", path, *options)[0] == 0
        files.append(path.read_text())
    assert len(set(files)) == len(files)


def test_roadside_in_a_log(can_imm, tmp_path):
    log, tracked = tmp_path / "lidars.log", tmp_path / "tracked.log"
    assert can_imm("simulate", "--scenario", "roadside", "--log", log)[0] == 0
    status, said, _ = can_imm("track", "roadside", log, "--out", tracked)
    assert status == 0
    assert "1 appeared" in said
    with LogSource(tracked) as source:
        assert sum(frame.id == 0x331 for frame in source) > 200


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["roadside", "LOG", "--particles", "5"], "--particles is an option of the cooperative"),
        (["cooperative", "LOG", "--ego", "15"], "--ego must be a sensor id, 0 to 14, not 15"),
        (["cooperative", "LOG", "--seed", "-1"], "--seed must be 0 or more"),
        (["cooperative", "LOG", "--out", "LOG"], "this is the log that is read"),
        (["cooperative", "LOG", "--duration", "3"], "do not go with a log"),
        (["cooperative", "nothing.log"], "nothing.log: No such file"),
        (["cooperative", "LOG", "--out", "x.doc"], "unknown log format"),
    ],
)
def test_refusals(can_imm, sensors, arguments, words):
    status, _, err = can_imm("track", *(sensors[0] if a == "LOG" else a for a in arguments))
    assert status == 1
    assert words in err
    assert err.count("\n") == 1


def test_a_scene_says_itself_what_fails(can_imm, tmp_path):
    status, _, err = can_imm("simulate", "--scenario", "cooperative", "--missed", "0.1",
                             "--log", tmp_path / "x.log")  # fmt: skip
    assert status == 1
    assert "a scene's own table says this" in err


@pytest.mark.parametrize("system", ["cooperative", "roadside"])
def test_demo(can_imm, system):
    status, out, _ = can_imm("demo", system)
    assert status == 0
    assert "RMS error" in out
    assert "; 0 rejected" in out
    if system == "cooperative":
        assert "LANE_CHANGE" in out
    status, again, _ = can_imm("demo", system)
    lines = [text.split("\n\n")[0] for text in (out, again)]
    assert lines[0] == lines[1]


def test_demo_of_a_tracker_draws_no_figures(can_imm, tmp_path):
    status, _, err = can_imm("demo", "cooperative", "--plot", tmp_path)
    assert status == 1
    assert "can-imm study" in err
