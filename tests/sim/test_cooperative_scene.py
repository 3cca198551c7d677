"""Vehicles with radars around one object."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from can_imm.sim.cooperative import Radar, builtin_scenes, load_scene, play_scene
from can_imm.sim.scene import scene_kind
from can_imm.types import CanImmError

PERFECT = Radar(std_range=1e-6, std_bearing=1e-6, std_rate=1e-6, detection=1.0, clutter=0.0)

MINIMAL = """
kind = "cooperative"
duration = 2.0
[object]
x = 0
y = 0
speed = 20
[[sensor]]
x = -10
y = 3
speed = 21
"""


@pytest.fixture
def scene():
    return load_scene("cooperative")


def write(tmp_path, text):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return str(path)


def test_built_in_scene(scene):
    assert builtin_scenes() == ["cooperative"]
    assert [(o.x, o.y) for o in scene.observers] == [
        (-45.0, 0.0), (-25.0, 3.5), (20.0, -3.5), (40.0, 3.5), (-60.0, -3.5)
    ]  # fmt: skip
    assert all(29.5 <= o.speed <= 31.0 for o in scene.observers)
    assert scene.radar == Radar()


def test_true_path_changes_the_lane_smoothly(scene):
    t = np.linspace(0, 15, 15_001)
    state = scene.target.state(t)
    np.testing.assert_allclose(np.gradient(state[:, 0], t), state[:, 1], atol=1e-6)
    np.testing.assert_allclose(np.gradient(state[:, 2], t), state[:, 3], atol=2e-3)
    assert state[t <= 6.0, 2].max() == 0.0
    np.testing.assert_allclose(state[t >= 10.0, 2], 3.5)
    assert np.abs(np.gradient(state[:, 3], t)).max() < 2.0


def test_noiseless_detections_point_at_the_object(scene):
    run = play_scene(replace(scene, radar=PERFECT), np.random.default_rng(0))
    assert len(run.scans) == len(run.t_ns) == 150
    ego = scene.observers[0]
    for k in (0, 70, 149):
        scan, t = run.scans[k], run.t_ns[k] / 1e9
        assert scan.n == scan.n_sensors == 5
        at = scan.pose[:, 2] + scan.z[:, 1]
        np.testing.assert_allclose(
            scan.pose[:, 0] + scan.z[:, 0] * np.cos(at) - ego.x - ego.speed * t, run.state[k, 0],
            atol=1e-3,
        )  # fmt: skip
        np.testing.assert_allclose(
            scan.pose[:, 1] + scan.z[:, 0] * np.sin(at) - ego.y, run.state[k, 2], atol=1e-3
        )
    ranges = np.array([scan.z[:, 0] for scan in run.scans])
    rates = np.array([scan.z[:, 2] for scan in run.scans])
    np.testing.assert_allclose(np.gradient(ranges, 0.1, axis=0)[1:-1], rates[1:-1], atol=0.02)


def test_noise_misses_and_clutter_are_as_they_are_said_to_be(scene):
    rng = np.random.default_rng(1)
    quiet = replace(scene, radar=replace(scene.radar, clutter=0.0, detection=0.9), duration=200.0)
    quiet = replace(quiet, observers=tuple(replace(o, speed=30.0) for o in scene.observers))
    run = play_scene(quiet, rng)
    exact = play_scene(replace(quiet, radar=PERFECT), rng)
    seen = sum(scan.n for scan in run.scans) / (5 * len(run.scans))
    assert seen == pytest.approx(0.9, abs=0.01)
    e = np.concatenate(
        [scan.z - true.z[scan.sensor] for scan, true in zip(run.scans, exact.scans, strict=True)]
    )
    e[:, 1] = np.arctan2(np.sin(e[:, 1]), np.cos(e[:, 1]))
    np.testing.assert_allclose(e.std(axis=0), [0.2, math.radians(0.3), 0.6], rtol=0.05)
    np.testing.assert_allclose(e.mean(axis=0), 0.0, atol=0.03)
    noisy = replace(quiet, radar=replace(scene.radar, clutter=2.0, detection=0.0))
    run = play_scene(noisy, rng)
    z = np.concatenate([scan.z for scan in run.scans])
    assert len(z) / (5 * len(run.scans)) == pytest.approx(2.0, abs=0.05)
    np.testing.assert_allclose(z.mean(axis=0), [100.0, 0.0, 0.0], atol=3.0)
    assert np.abs(z).max(axis=0) == pytest.approx([200.0, np.pi, 50.0], rel=0.01)


def test_objects_and_sensors_come_and_go(tmp_path, scene):
    text = MINIMAL.replace("speed = 21", "speed = 21\nfrom = 0.5\nuntil = 1.0") + (
        "[[sensor]]\nx = 9\ny = 0\nspeed = 20\nfrom = 0.8\n"
    )
    run = play_scene(load_scene(write(tmp_path, text)), np.random.default_rng(0))
    taking_part = {scan.t_ns // 10**8: scan.sensor_id.tolist() for scan in run.scans}
    expected = [[0]] * 3 + [[0, 1]] * 2 + [[1]] * 10
    assert taking_part == dict(zip(range(5, 20), expected, strict=True))
    gone = replace(scene, target=replace(scene.target, appears=1.0, disappears=2.0), radar=PERFECT)
    run = play_scene(gone, np.random.default_rng(0))
    there = np.array([scan.n for scan in run.scans]) > 0
    assert np.flatnonzero(there).tolist() == list(range(10, 20))
    assert (np.isfinite(run.state).all(axis=1) == there).all()


def test_dropouts_and_the_seed(scene):
    lossy = replace(scene, radar=replace(scene.radar, dropout=0.3))
    a, b, c = (play_scene(lossy, np.random.default_rng(seed)) for seed in (1, 1, 2))
    share = sum(scan.n_sensors for scan in a.scans) / (5 * 150)
    assert share == pytest.approx(0.7, abs=0.06)
    assert [s.z.tobytes() for s in a.scans] == [s.z.tobytes() for s in b.scans]
    assert [s.z.tobytes() for s in a.scans] != [s.z.tobytes() for s in c.scans]


BAD = [
    ('kind = "cooperative"', 'kind = "other"', "'kind' must be one of cooperative"),
    ("duration = 2.0", "duration = 0", "duration must lie between 0.1 and 3600"),
    ("duration = 2.0", "duration = nan", "'duration' must be a number, not nan"),
    ("duration = 2.0", 'duration = "long"', "'duration' must be a number"),
    ("duration = 2.0", "duration = 2.0\nego = 2", "ego must lie between 1 and 1, not 2"),
    ("duration = 2.0", "duration = 2.0\nlength = 2", "unknown key 'length'"),
    ("speed = 20", "speed = 2000", "object: speed must lie between"),
    ("speed = 21", "", "sensor 1: 'speed' is missing"),
    ("speed = 20", "speed = 20\nchange_by = 3", "change_end must come after"),
    ("speed = 20", "speed = 20\nappears = 3\ndisappears = 2", "disappears must come after"),
    ("[object]", "[radar]\ndetection = 1.5\n[object]", "radar: detection must lie between 0 and 1"),
    ("[object]", "[radar]\nnoise = 1.5\n[object]", "radar: unknown key 'noise'"),
    ("[object]", "[object", "not valid TOML"),
]


@pytest.mark.parametrize(("old", "new", "words"), BAD)
def test_bad_scenes_are_refused_in_one_line(tmp_path, old, new, words):
    assert old in MINIMAL
    path = write(tmp_path, MINIMAL.replace(old, new, 1))
    with pytest.raises(CanImmError) as error:
        load_scene(path)
    assert words in str(error.value)
    assert str(error.value).startswith(path)
    assert "\n" not in str(error.value)


def test_too_many_sensors(tmp_path):
    one = MINIMAL[MINIMAL.index("[[sensor]]") :]
    with pytest.raises(CanImmError, match="between 1 and 15 are needed, not 16"):
        load_scene(write(tmp_path, MINIMAL + 15 * one))


def test_scenes_are_told_from_scenarios(tmp_path):
    assert scene_kind("cooperative") == "cooperative"
    assert scene_kind("roadside") == "roadside"
    assert scene_kind(write(tmp_path, MINIMAL)) == "cooperative"
    assert scene_kind("paper-a") is None
    assert scene_kind(write(tmp_path, "duration = 3")) is None
    assert scene_kind(write(tmp_path, "= 3")) is None
    assert scene_kind(str(tmp_path / "nothing.toml")) is None
