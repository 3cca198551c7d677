"""The roadside scene: the road's geometry, what the lidars see, and refusals."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from can_imm.sim.roadside import (
    COUNTER_MODULUS,
    Piece,
    Road,
    builtin_scenes,
    load_scene,
    play_scene,
)
from can_imm.types import BEARING, RANGE, RATE, CanImmError

SCENE = load_scene()
RUN = play_scene(SCENE, np.random.default_rng(0))
TEXT = (
    'kind = "roadside"\nduration = 2.0\nperiod = 0.05\n'
    "[vehicle]\nid = 1\nspeed = 12.0\n"
    "[road]\nx = 0.0\ny = 0.0\nheading = 0.0\npieces = [{ length = 60.0 }]\n"
    "[lidar]\nfield_of_view = 70.0\nrange = 70.0\ngrid = 0.2\nrange_noise = 0.05\n"
    "bearing_noise = 2.0\n"
    "[[lidars]]\nid = 3\nx = -8.0\ny = -6.0\nheading = 10.0\n"
)


def write(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return str(path)


def test_the_published_scene():
    assert builtin_scenes() == [SCENE.name]
    assert len(RUN.scans) == len(RUN.t_ns) == 250
    assert RUN.t_ns[1] == 50_000_000
    assert len(SCENE.lidars) == 3
    assert math.degrees(SCENE.model.field_of_view) == pytest.approx(70.0)
    assert SCENE.model.range == 70.0
    assert math.degrees(SCENE.model.grid) == pytest.approx(0.2)
    assert (SCENE.model.range_noise, SCENE.model.bearing_noise) == pytest.approx((0.05, 0.05), 1e-4)


def test_no_one_and_two_lidars_see_the_vehicle_in_5_64_and_31_percent_of_the_scans():
    seen = RUN.visible.sum(axis=1)
    shares = [100.0 * np.mean(seen == n) for n in range(4)]
    np.testing.assert_allclose(shares, [5.0, 64.0, 31.0, 0.0], atol=2.0)


def test_straight_then_a_bend_to_the_left_then_straight():
    x, y = RUN.state[:, 0], RUN.state[:, 2]
    np.testing.assert_allclose(np.hypot(RUN.state[:, 1], RUN.state[:, 3]), 12.0)
    bend = RUN.turn_rate != 0.0
    first, last = np.flatnonzero(bend)[[0, -1]]
    assert RUN.t_ns[first] == 5_000_000_000
    assert last - first + 1 == pytest.approx(20.0 * math.pi / 2 / 12.0 / 0.05, abs=1)
    np.testing.assert_allclose(np.hypot(x[bend] - 60.0, y[bend] - 20.0), 20.0)
    assert np.all(RUN.turn_rate[bend] == pytest.approx(0.6))
    assert np.all(y[:first] == 0.0)
    np.testing.assert_allclose(x[last + 1 :], 80.0)


@pytest.mark.parametrize("angle", [1.2, -2.5, 7.0, 1e-9])
def test_a_road_is_where_its_curvature_leads(angle):
    road = Road(1.0, -2.0, 0.7, (Piece(15.0), Piece(30.0, angle), Piece(10.0)))
    s = np.linspace(0.0, road.length, 56)
    found = road.along(s)

    def rate(s, p):
        return [math.cos(p[2]), math.sin(p[2]), angle / 30.0 if 15.0 < s < 45.0 else 0.0]

    expected = np.array([[1.0, -2.0, 0.7]])
    for start, end in ((0.0, 15.0), (15.0, 45.0), (45.0, 55.0)):
        at = s[(s > start) & (s <= end)]
        y = solve_ivp(rate, (start, end), expected[-1], t_eval=at, rtol=1e-11, atol=1e-11).y.T
        expected = np.concatenate((expected, y))
    np.testing.assert_allclose(found[:, :3], expected, rtol=0, atol=1e-6)
    # the places are a metre apart along the road
    assert np.all(np.linalg.norm(np.diff(found[:, :2], axis=0), axis=1) <= 1.0 + 1e-9)


def test_detections_lie_around_the_vehicle_as_far_as_the_noise_says():
    distance, across = [], []
    for seed in range(20):
        run = play_scene(SCENE, np.random.default_rng(seed))
        for k, scan in enumerate(run.scans):
            pose = scan.pose[scan.sensor[: scan.n]]
            dx, dy = run.state[k, 0] - pose[:, 0], run.state[k, 2] - pose[:, 1]
            distance.append(scan.z[: scan.n, RANGE] - np.hypot(dx, dy))
            bearing = scan.z[: scan.n, BEARING] + pose[:, 2] - np.arctan2(dy, dx)
            across.append(np.angle(np.exp(1j * bearing)))
    for errors in (np.concatenate(distance), np.concatenate(across)):
        assert errors.mean() == pytest.approx(0.0, abs=0.003)
        assert errors.std() == pytest.approx(0.05, rel=0.03)


def test_bearings_lie_on_the_grid_and_there_is_no_range_rate():
    z = np.concatenate([scan.z[: scan.n] for scan in RUN.scans])
    steps = np.degrees(z[:, BEARING]) / 0.2
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert np.isnan(z[:, RATE]).all()


def test_every_lidar_takes_part_in_every_scan_and_sees_what_it_can():
    for k, scan in enumerate(RUN.scans):
        assert scan.n_sensors == 3
        assert scan.sensor_id.tolist() == [0, 1, 2]
        assert (scan.counter == k % COUNTER_MODULUS).all()
        assert scan.sensor[: scan.n].tolist() == np.flatnonzero(RUN.visible[k]).tolist()
        assert scan.t_ns == RUN.t_ns[k]


def test_the_same_seed_gives_the_same_noise_with_and_without_losses(tmp_path):
    lossy = load_scene(
        write(tmp_path, TEXT.replace("[vehicle]", "miss_probability = 0.4\n[vehicle]"))
    )
    sound = load_scene(write(tmp_path, TEXT))
    some = play_scene(lossy, np.random.default_rng(3)).scans
    every = play_scene(sound, np.random.default_rng(3)).scans
    kept = [k for k, scan in enumerate(some) if scan.n]
    assert len(kept) == pytest.approx(0.6 * sum(scan.n for scan in every), abs=8)
    for k in kept:
        assert np.array_equal(some[k].z[0], every[k].z[0], equal_nan=True)


def test_the_run_ends_with_the_road(tmp_path):
    text = TEXT.replace("duration = 2.0", "duration = 100.0")
    run = play_scene(load_scene(write(tmp_path, text)), np.random.default_rng(0))
    assert len(run.scans) == 100
    assert run.state[-1, 0] == pytest.approx(60.0, abs=0.7)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("duration = 2.0", "duration = 0.0", "duration must lie between"),
        ("duration = 2.0\n", "", "'duration' is missing"),
        ("duration = 2.0", "duration = nan", "'duration' must be a number, not nan"),
        ('kind = "roadside"', 'kind = "cooperative"', "'kind' must be one of roadside"),
        ("period = 0.05", "period = 0", "'period' must be a number from 0.001 up to 10, not 0"),
        ("speed = 12.0", "speed = -3.0", "vehicle: speed"),
        ("speed = 12.0", 'speed = "fast"', "'speed' must be a number"),
        ("id = 1\n", "id = 64\n", "vehicle: id"),
        ("[{ length = 60.0 }]", "[]", "at least one piece"),
        ("[{ length = 60.0 }]", "[{ length = 0.0 }]", "piece 1"),
        ("[{ length = 60.0 }]", "[{ radius = 20.0 }]", "'angle' is missing"),
        ("[{ length = 60.0 }]", "[{ radius = nan, angle = 20.0 }]", "piece 1"),
        ("[{ length = 60.0 }]", "[{ length = 6.0, widht = 3.0 }]", "unknown key 'widht'"),
        ("x = 0.0\ny = 0.0", "x = inf\ny = 0.0", "road: x, y and heading"),
        ("range = 70.0", "range = 0.0", "lidar: range"),
        ("range_noise = 0.05", "range_noise = -0.05", "lidar: range_noise"),
        ("id = 3", "id = 15", "lidars: id"),
        ("x = -8.0", "x = nan", "lidar 1: 'x' must be a number, not nan"),
        (
            "[[lidars]]",
            "[[lidars]]\nid = 3\nx = 0\ny = 0\nheading = 0\n[[lidars]]",
            "is there twice",
        ),
        ("[vehicle]", "miss_probability = 1.0\n[vehicle]", "miss_probability"),
        ("[vehicle]", "colour = 1.0\n[vehicle]", "unknown key 'colour'"),
        ("[vehicle]", "[vehicle", "not valid TOML"),
    ],
)
def test_impossible_scenes_are_refused(tmp_path, old, new, message):
    assert old in TEXT
    path = write(tmp_path, TEXT.replace(old, new, 1))
    with pytest.raises(CanImmError, match=re.escape(message)) as refused:
        load_scene(path)
    assert path in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_scene_that_does_not_exist_is_refused():
    with pytest.raises(CanImmError, match="neither a file nor a built-in scene"):
        load_scene("no-such-scene")
