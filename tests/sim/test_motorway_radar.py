"""The radars on the motorway: noise, fields of view, ids, losses, second tracks."""

from __future__ import annotations

from dataclasses import replace
from math import radians

import numpy as np
import pytest

from can_imm.sim.motorway import (
    REPORTING,
    TUNING,
    Driver,
    MotorwayScenario,
    MotorwayTruth,
    drive,
    random_motorway,
)
from can_imm.sim.radar import RADARS, Measured, RadarModel, observe, radar_model
from can_imm.sim.road import straight
from can_imm.types import CanImmError, Manoeuvre

NAMES = list(RADARS)
DIFFERENT = [name for name in NAMES if name != "toyota-tss2"]
"""That one is as `toyota`."""
QUIET = {"missed": 0.0, "dropout": 0.0, "duplicates": 0.0}


def driver(number: int, rear: float, speed: float, d: float) -> Driver:
    rows = np.array([[0.0, rear, speed, 0.0]])
    return Driver(number, 0.0, 1e4, rows, d, (), np.zeros((1, 3)), 4.0)


def still_picture(*places: tuple[float, float], duration: float = 100.0) -> MotorwayTruth:
    """Vehicles that stay at these x, y from the ego."""
    road = straight(-600.0, 25.0 * duration + 600.0)
    cars = tuple(driver(i, x, 25.0, y) for i, (x, y) in enumerate(places, start=1))
    return drive(MotorwayScenario(duration, 3, 3.5, road, driver(0, -4.0, 25.0, 0.0), cars, (), ()))


def watch(truth: MotorwayTruth, radar: RadarModel, seed: int = 0) -> Measured:
    return observe(truth, radar, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def drives() -> list[MotorwayTruth]:
    settings = replace(TUNING, duration=30.0)
    return [drive(random_motorway(np.random.default_rng(seed), settings)) for seed in range(4)]


@pytest.mark.parametrize(
    ("name", "steps_ms"),
    [
        ("can_imm", {100}),
        ("ars408", {71, 72}),
        ("toyota", {50}),
        ("toyota-tss2", {50}),
        ("esr", {50}),
    ],
)
def test_scans_come_on_time(name: str, steps_ms: set[int]) -> None:
    truth = still_picture((30.0, 0.0), duration=50.0)
    scans = watch(truth, replace(RADARS[name], **QUIET)).scans
    times = [scan.t_ns for scan in scans]
    assert times[0] == 0
    assert set(np.diff(times).tolist()) == {step * 1_000_000 for step in steps_ms}
    assert abs(len(scans) - 1 - 50.0 / RADARS[name].period) < 1
    assert [scan.counter for scan in scans] == list(range(len(scans)))
    assert not any(scan.incomplete for scan in scans)


@pytest.mark.parametrize("name", DIFFERENT)
def test_noise_is_what_it_says(name: str) -> None:
    truth = still_picture((40.0, 3.5), (20.0, -3.5), duration=600.0)
    radar = replace(RADARS[name], **QUIET)
    scans = watch(truth, radar).scans
    z = np.array([scan.z[:2] for scan in scans])
    std = np.array([scan.std[:2] for scan in scans])
    angle = np.array([scan.angle[:2] for scan in scans])
    valid = np.array([scan.valid[:2] for scan in scans])
    rows = {int(i): k for k, i in enumerate(scans[0].ids[:2])}
    for k in rows.values():
        x = truth.objects[int(np.argmin([abs(o.state[0, 0] - z[0, k, 0]) for o in truth.objects]))]
        x0, _, y0, _ = x.state[0]
        if radar.polar:
            distance, bearing = np.hypot(x0, y0), np.arctan2(y0, x0)
            error = np.stack(
                [z[:, k, 0] - distance, z[:, k, 1], distance * (angle[:, k] - bearing)], axis=1
            )
            np.testing.assert_allclose(z[:, k, 2], 0.0)
            assert valid[:, k].all(axis=0).tolist() == [True, True, True, False]
            assert angle[:, k].std() == pytest.approx(radians(0.4), rel=0.05)
        else:
            measured = np.isfinite(radar.std)
            assert (valid[:, k] == measured).all()
            error = (z[:, k] - [x0, 0.0, y0, 0.0])[:, measured]
            assert not angle[:, k].any()
        stated = std[:, k].mean(axis=0)[: error.shape[1]]
        # the error of the bearing that all tracks share is told by the profile, not by the scan
        whole = np.hypot(stated, [0.0, 0.0, radar.bearing * x0, 0.0][: error.shape[1]])
        # a wandering error has few independent values: 600 s / .4 s
        few = 0.06 if any(radar.wander) else 0.04
        np.testing.assert_allclose(np.sqrt((error**2).mean(axis=0)), whole, rtol=few)
        assert np.abs(error.mean(axis=0)).max() < 0.06
        steps = np.corrcoef(error[1:].T, error[:-1].T)
        n = error.shape[1]
        for i in range(n):
            white = radar.std[i] if any(radar.wander) else stated[i]
            lasting = 1.0 - (white / whole[i]) ** 2
            expected = lasting * np.exp(-radar.period / radar.wander_time)
            assert steps[i, n + i] == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize("name", ["toyota", "toyota-tss2"])
def test_what_the_toyota_radars_errors_are(name: str) -> None:
    radar = RADARS[name]
    assert replace(radar, name="toyota") == RADARS["toyota"]
    assert radar.std[:3] == (0.08, 0.06, 0.08)
    assert (radar.wander, radar.wander_time, radar.bearing) == ((0.12, 0.2), 0.4, 0.004)


@pytest.mark.parametrize("noise", [1.0, 1.5])
def test_all_tracks_share_the_error_of_the_bearing(noise: float) -> None:
    truth = still_picture((40.0, 3.5), (20.0, -3.5), (90.0, 0.0), duration=600.0)
    truth = drive(replace(truth.scenario, noise=noise))
    radar = replace(RADARS["toyota"], std=(1e-9, 1e-9, 1e-9, np.nan), wander=(0.0, 0.0), **QUIET)
    seen = watch(truth, radar)
    z = np.array([scan.z[:3] for scan in seen.scans])
    states = np.array(seen.states)
    np.testing.assert_allclose(z[:, :, :2], states[:, :, :2], atol=1e-7)
    turned = (z - states)[:, :, 2] / states[:, :, 0]
    np.testing.assert_allclose(turned, turned[:, :1] * np.ones(3), atol=1e-9)
    error = turned[:, 0]
    assert np.sqrt((error**2).mean()) == pytest.approx(0.004 * noise, rel=0.06)
    assert abs(error.mean()) < 0.0005 * noise
    # 8 periods of .05 s are the .4 s in which it wanders
    assert np.corrcoef(error[:-1], error[1:])[0, 1] == pytest.approx(np.exp(-1 / 8), abs=0.02)
    assert np.corrcoef(error[:-8], error[8:])[0, 1] == pytest.approx(np.exp(-1), abs=0.08)
    # and it does not begin with 0
    firsts = [
        watch(still_picture((50.0, 0.0), duration=1.0), radar, seed).scans[0].z[0, 2] / 50.0
        for seed in range(40)
    ]
    assert np.std(firsts) == pytest.approx(0.004, rel=0.35)


@pytest.mark.parametrize("name", DIFFERENT)
def test_rows_are_the_objects_that_they_are_said_to_be(
    name: str, drives: list[MotorwayTruth]
) -> None:
    for truth in drives[:2]:
        seen = watch(truth, RADARS[name])
        for scan, objects, samples, states, second in zip(
            seen.scans, seen.objects, seen.samples, seen.states, seen.second, strict=True
        ):
            n = scan.n
            assert len(objects) == len(samples) == len(states) == len(second) == n
            assert len(set(scan.ids[:n].tolist())) == n <= RADARS[name].slots
            assert scan.capacity == RADARS[name].slots
            assert (scan.ids[:n] >= 0).all()
            assert (scan.ids[:n] < RADARS[name].slots).all()
            once = objects[~second]
            assert len(set(once.tolist())) == len(once)
            for row in range(n):
                target = truth.objects[objects[row]]
                assert target.sample(scan.t_ns) == samples[row]
                late = (scan.t_ns - int(target.t_ns[samples[row]])) * 1e-9
                assert 0.0 <= late < 0.01
                moved = states[row] - target.state[samples[row]]
                assert np.abs(moved[[0, 2]]).max() < 0.7
                far = np.hypot(states[row, 0], states[row, 2])
                c, s = np.cos(scan.angle[row]), np.sin(scan.angle[row])
                z = scan.z[row]
                x, y = c * z[0] - s * z[2], s * z[0] + c * z[2]
                reach = 1.0 + 0.035 * far + 1.5 * second[row]
                assert np.hypot(x - states[row, 0], y - states[row, 2]) < reach


def test_the_range_rate_is_the_change_of_the_range(drives: list[MotorwayTruth]) -> None:
    seen = watch(drives[0], replace(RADARS["esr"], std=(0.2, 1e-9, 1e-9), **QUIET))
    at: dict[int, list[tuple[float, float, float]]] = {}
    for scan, objects, states in zip(seen.scans, seen.objects, seen.states, strict=True):
        for row, number in enumerate(objects.tolist()):
            distance = float(np.hypot(states[row, 0], states[row, 2]))
            at.setdefault(number, []).append((scan.t_ns * 1e-9, distance, scan.z[row, 1]))
    checked = 0
    for rows in at.values():
        t, distance, rate = np.array(rows).T
        if len(t) < 20:
            continue
        mean = np.diff(distance) / np.diff(t)
        # it may have been out of view, and what is near passes faster than that
        together = (np.diff(t) < 0.06) & (distance[1:] > 30.0)
        error = mean - 0.5 * (rate[1:] + rate[:-1])
        np.testing.assert_allclose(error[together], 0.0, atol=0.03)
        checked += 1
    assert checked > 5


def test_the_field_of_view(drives: list[MotorwayTruth]) -> None:
    for truth in drives:
        seen = watch(truth, replace(RADARS["can_imm"], **QUIET))
        for scan, objects, states in zip(seen.scans, seen.objects, seen.states, strict=True):
            expected = set()
            for target in truth.objects:
                sample = target.sample(scan.t_ns)
                if sample < 0:
                    continue
                x, _, y, _ = target.state[sample]
                far, side = np.hypot(x, y), abs(np.degrees(np.arctan2(y, x)))
                if x > 1.0 and ((far < 60.0 and side < 45.0) or (far < 200.0 and side < 9.5)):
                    expected.add(target.object_id)
            assert set(objects.tolist()) == expected
            assert (states[:, 0] > 1.0).all()


def test_a_radar_with_few_slots_takes_the_nearest() -> None:
    places = [(10.0 + 8.0 * i, 0.0) for i in range(20)]
    truth = still_picture(*places, duration=3.0)
    seen = watch(truth, replace(RADARS["toyota"], **QUIET))
    for scan, states in zip(seen.scans, seen.states, strict=True):
        assert scan.n == 16
        assert states[:, 0].max() == pytest.approx(10.0 + 8.0 * 15)


@pytest.mark.parametrize("name", DIFFERENT)
def test_new_marks_an_ids_first_row_of_each_object(name: str, drives: list[MotorwayTruth]) -> None:
    radar = replace(RADARS[name], duplicates=0.0)
    reused = 0
    for truth in drives:
        seen = watch(truth, radar)
        named: dict[int, int] = {}
        last: dict[int, int] = {}
        for scan, objects in zip(seen.scans, seen.objects, strict=True):
            for i, number, new in zip(
                scan.ids[: scan.n].tolist(), objects.tolist(), scan.new[: scan.n], strict=True
            ):
                if named.get(i) != number:
                    assert new
                    if i in named:
                        reused += 1
                        # all but those without a rest: the same id means somebody else later
                        assert (scan.t_ns - last[i]) * 1e-9 > radar.rest
                elif new:
                    # the same object has left and come back
                    assert (scan.t_ns - last[i]) * 1e-9 > radar.period
                named[i] = number
                last[i] = scan.t_ns
    if name.startswith("toyota"):
        assert reused > 20


def test_losses() -> None:
    truth = still_picture((30.0, 0.0), (50.0, 3.5), duration=300.0)
    radar = replace(RADARS["toyota"], missed=0.1, dropout=0.2, duplicates=0.0)
    scans = watch(truth, radar).scans
    due = 6001
    assert len(scans) / due == pytest.approx(0.8, abs=0.03)
    assert np.mean([scan.n for scan in scans]) == pytest.approx(1.8, abs=0.03)
    counters = [scan.counter for scan in scans]
    assert [scan.t_ns for scan in scans] == [c * 50_000_000 for c in counters]
    assert len({int(i) for scan in scans for i in scan.ids[: scan.n]}) == 2
    assert sum(int(scan.new[: scan.n].sum()) for scan in scans) == 2


def test_second_tracks_are_of_the_same_vehicle_for_some_seconds() -> None:
    truth = still_picture((40.0, 0.0), duration=1000.0)
    radar = replace(RADARS["ars408"], duplicates=0.04, missed=0.0, dropout=0.0)
    seen = watch(truth, radar)
    second = np.array([flags.any() for flags in seen.second])
    edges = np.flatnonzero(np.diff(second.astype(int), prepend=0, append=0)).reshape(-1, 2)
    seconds = (edges[:, 1] - edges[:, 0]) * radar.period
    assert 15 < len(edges) < 60
    assert 1.0 < np.mean(seconds) < 6.0
    assert seconds.max() < 6.2
    for first, _ in edges[edges[:, 0] < len(seen.scans) - 10]:
        scan = seen.scans[first]
        assert scan.n == 2
        assert set(seen.objects[first].tolist()) == {0}
        (row,) = np.flatnonzero(seen.second[first])
        assert 0.2 - 0.6 < scan.z[row, 0] - 40.0 < 1.5 + 0.6
        assert scan.new[row]


def test_no_second_tracks_of_things_at_the_roadside(drives: list[MotorwayTruth]) -> None:
    for truth in drives:
        seen = watch(truth, replace(RADARS["esr"], duplicates=0.2))
        twice = {int(i) for o, s in zip(seen.objects, seen.second, strict=True) for i in o[s]}
        assert twice
        assert Manoeuvre.STATIONARY not in {truth.objects[i].label[0] for i in twice}


def test_ego_motion_is_measured(drives: list[MotorwayTruth]) -> None:
    biases = []
    for seed in range(12):
        truth = drives[seed % 4]
        scans = watch(truth, RADARS["toyota"], seed).scans
        index = np.array([scan.t_ns // 10_000_000 for scan in scans])
        speed = np.array([scan.ego_speed for scan in scans]) - truth.ego.speed[index]
        yaw = np.array([scan.ego_yaw_rate for scan in scans]) - truth.ego.yaw_rate[index]
        assert speed.std() == pytest.approx(0.05, rel=0.1)
        assert abs(speed.mean()) < 0.01
        assert yaw.std() == pytest.approx(0.002, rel=0.1)
        biases.append(yaw.mean())
    assert 0.001 < np.std(biases) < 0.006


def test_the_settings_scale_the_noise_but_not_what_the_radar_says_of_it() -> None:
    assert REPORTING.noise > TUNING.noise
    truth = still_picture((40.0, 0.0), duration=300.0)
    louder = replace(truth.scenario, noise=1.5)
    seen = watch(drive(louder), replace(RADARS["can_imm"], **QUIET))
    x = np.array([scan.z[0, 0] for scan in seen.scans])
    assert x.std() == pytest.approx(0.15, rel=0.1)
    assert seen.scans[0].std[0, 0] == 0.1


@pytest.mark.parametrize("name", DIFFERENT)
def test_equal_seeds_give_equal_scans(name: str, drives: list[MotorwayTruth]) -> None:
    first, again, other = (watch(drives[0], RADARS[name], seed) for seed in (3, 3, 4))
    assert [s.t_ns for s in first.scans] == [s.t_ns for s in again.scans]
    for a, b in zip(first.scans, again.scans, strict=True):
        np.testing.assert_array_equal(a.z, b.z)
        np.testing.assert_array_equal(a.ids, b.ids)
    assert first.scans[0].ego_speed != other.scans[0].ego_speed


def test_an_empty_road_gives_empty_scans() -> None:
    seen = watch(still_picture(duration=2.0), RADARS["ars408"])
    assert len(seen.scans) > 20
    assert {scan.n for scan in seen.scans} == {0}
    assert np.isfinite([scan.ego_speed for scan in seen.scans]).all()


@pytest.mark.parametrize(
    ("wrong", "named"),
    [({"missed": 1.0}, "missed"), ({"dropout": -0.1}, "dropout"), ({"period": 0.0}, "period"),
     ({"tick": 0.0}, "tick"), ({"slots": 0}, "slots")],
)  # fmt: skip
def test_impossible_radars_are_refused(wrong: dict[str, float], named: str) -> None:
    with pytest.raises(CanImmError, match=named):
        replace(RADARS["toyota"], **wrong)  # type: ignore[arg-type]


def test_radars_have_the_profiles_names() -> None:
    assert NAMES == ["can_imm", "ars408", "toyota", "toyota-tss2", "esr"]
    assert radar_model("esr").polar
    with pytest.raises(CanImmError, match="nope"):
        radar_model("nope")
