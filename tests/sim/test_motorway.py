"""The motorway's geometry, motion and labels against closed forms and independent computations."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.special import fresnel

from can_imm.sim.motorway import (
    REPORTING,
    TUNING,
    Driver,
    LaneChange,
    MotorwayScenario,
    MotorwaySettings,
    MotorwayTruth,
    ObjectTruth,
    drive,
    motorway_settings,
    plain,
    published,
    random_motorway,
)
from can_imm.sim.road import Road, random_road, straight
from can_imm.types import CUT_IN, CUT_OUT, OVERTAKING_ANOTHER, CanImmError, Manoeuvre

W = 3.5
NO_WANDER = np.zeros((1, 3))


def driver(*rows: tuple[float, float, float, float], d: float = 0.0, number: int = 1,
           changes: tuple[LaneChange, ...] = (), length: float = 4.0) -> Driver:  # fmt: skip
    return Driver(number, 0.0, 1e3, np.array(rows), d, changes, NO_WANDER, length)


def scenario(
    *drivers: Driver, ego: Driver | None = None, road: Road | None = None, duration: float = 20.0
) -> MotorwayScenario:
    ego = ego or driver((0.0, -4.0, 25.0, 0.0), number=0)
    road = road or straight(-600.0, 3000.0)
    return MotorwayScenario(duration, 3, W, road, ego, drivers, (), ())


def runs(truth: ObjectTruth) -> list[tuple[Manoeuvre, float, float]]:
    """Label, first and last time [s] of each stretch of equal labels."""
    edges = [0, *(np.flatnonzero(np.diff(truth.label)) + 1).tolist(), len(truth.label)]
    t = truth.t_ns * 1e-9
    return [(Manoeuvre(truth.label[a]), t[a], t[b - 1]) for a, b in pairwise(edges)]


# -- the road ---------------------------------------------------------------------------------


def test_a_road_of_constant_curvature_is_a_circle() -> None:
    road = Road.of(np.array([-50.0, 1000.0]), np.full(2, 1 / 800.0))
    s = np.linspace(-50.0, 999.0, 313)
    angle = (s + 50.0) / 800.0
    curvature, heading, x, y = road.at(s)
    np.testing.assert_allclose(curvature, 1 / 800.0)
    np.testing.assert_allclose(heading, angle, atol=1e-9)
    np.testing.assert_allclose(x, 800.0 * np.sin(angle), atol=1e-3)
    np.testing.assert_allclose(y, 800.0 * (1.0 - np.cos(angle)), atol=1e-3)


def test_a_road_of_linear_curvature_is_a_clothoid() -> None:
    length, kappa = 400.0, 1 / 600.0
    road = Road.of(np.array([0.0, length]), np.array([0.0, kappa]))
    s = np.linspace(0.0, length, 101)
    scale = np.sqrt(np.pi * length / kappa)
    sine, cosine = fresnel(s / scale)
    _, heading, x, y = road.at(s)
    np.testing.assert_allclose(heading, kappa * s**2 / (2 * length), atol=1e-5)
    np.testing.assert_allclose(x, scale * cosine, atol=1e-3)
    np.testing.assert_allclose(y, scale * sine, atol=1e-3)


def test_random_roads_bend_gently_both_ways() -> None:
    roads = [random_road(np.random.default_rng(seed), 0.0, 5000.0) for seed in range(20)]
    kappa = np.stack([road.curvature[:5000] for road in roads])
    assert 0.9 / 1000.0 < np.abs(kappa).max() <= 1 / 1000.0
    assert np.abs(np.diff(kappa, axis=1)).max() <= 1 / 1000.0 / 120.0 + 1e-12
    assert (kappa > 1e-4).any()
    assert (kappa < -1e-4).any()
    assert 0.2 < np.mean(kappa == 0.0) < 0.7


# -- motion and labels of hand-made drives -------------------------------------------------------


def test_x_counts_from_the_egos_front_to_the_others_rear() -> None:
    (truth,) = drive(scenario(driver((0.0, 30.0, 25.0, 0.0), d=W))).objects
    np.testing.assert_allclose(truth.state, np.tile([30.0, 0.0, W, 0.0], (2001, 1)), atol=1e-9)
    assert set(truth.label) == {Manoeuvre.KEEP_LANE}
    assert set(truth.lane) == {1}
    np.testing.assert_allclose(truth.speed, 25.0)


def test_receding_lasts_from_the_start_to_the_end_of_its_ramps() -> None:
    # 4 m/s faster: ramps of 2 s each, from 3 s to 12 s
    rows = (0.0, 20.0, 25.0, 0.0), (3.0, 95.0, 25.0, 2.0), (5.0, 149.0, 29.0, 0.0)
    rows += ((10.0, 294.0, 29.0, -2.0), (12.0, 348.0, 25.0, 0.0))
    (truth,) = drive(scenario(driver(*rows, d=-W))).objects
    keep, recede, after = runs(truth)
    assert (keep[0], recede[0], after[0]) == (
        Manoeuvre.KEEP_LANE, Manoeuvre.RECEDING, Manoeuvre.KEEP_LANE,
    )  # fmt: skip
    assert recede[1:] == (pytest.approx(3.0, abs=0.011), pytest.approx(11.99, abs=0.011))
    np.testing.assert_allclose(truth.state[700, :2], [20.0 + 4.0 + 2.0 * 4.0, 4.0])
    np.testing.assert_allclose(truth.state[-1, :2], [20.0 + 4.0 + 5.0 * 4.0 + 4.0, 0.0], atol=1e-9)


def test_approaching_in_the_egos_lane_becomes_rear_end_at_10_m() -> None:
    rows = (0.0, 20.0, 25.0, 0.0), (2.0, 70.0, 25.0, -1.5), (4.0, 117.0, 22.0, 0.0)
    rows += ((6.0, 161.0, 22.0, 1.5), (8.0, 208.0, 25.0, 0.0))
    (truth,) = drive(scenario(driver(*rows))).objects
    assert [label for label, _, _ in runs(truth)] == [
        Manoeuvre.KEEP_LANE, Manoeuvre.APPROACHING, Manoeuvre.REAR_END, Manoeuvre.KEEP_LANE,
    ]  # fmt: skip
    assert runs(truth)[1][1] == pytest.approx(2.0, abs=0.011)
    # 20 - 3 - 3 (t - 4) = 10
    assert runs(truth)[2][1] == pytest.approx(4.0 + 7.0 / 3.0, abs=0.06)
    assert runs(truth)[2][2] == pytest.approx(8.0, abs=0.011)
    (beside,) = drive(scenario(driver(*rows, d=W))).objects
    assert Manoeuvre.REAR_END not in beside.label


def test_it_does_not_matter_who_accelerates() -> None:
    ego = driver((0.0, -4.0, 25.0, 0.0), (5.0, 121.0, 25.0, 1.0), (7.0, 173.0, 27.0, 0.0), number=0)
    (truth,) = drive(scenario(driver((0.0, 60.0, 25.0, 0.0), d=W), ego=ego)).objects
    (_, keep_from, _), (label, since, _) = runs(truth)
    assert keep_from == 0.0
    assert label == Manoeuvre.APPROACHING
    assert since == pytest.approx(5.0, abs=0.011)


def test_a_small_difference_of_speeds_is_keeping_the_lane() -> None:
    for dv in (-0.9, -0.3, 0.3, 0.9):
        (truth,) = drive(scenario(driver((0.0, 60.0, 25.0 + dv, 0.0)))).objects
        assert set(truth.label) == {Manoeuvre.KEEP_LANE}
    for dv, label in ((-1.2, Manoeuvre.APPROACHING), (1.2, Manoeuvre.RECEDING)):
        (truth,) = drive(scenario(driver((0.0, 60.0, 25.0 + dv, 0.0)))).objects
        assert set(truth.label) == {label}


@pytest.mark.parametrize("mix", [0.0, 0.4, 1.0])
def test_a_lane_change_takes_its_time_and_one_lane(mix: float) -> None:
    change = LaneChange(4.0, 3.0, W, mix)
    (truth,) = drive(scenario(driver((0.0, 40.0, 28.0, 0.0), changes=(change,)))).objects
    before, during, after = runs(truth)
    assert before[0] == after[0] == Manoeuvre.RECEDING
    assert during == (Manoeuvre.LANE_CHANGE, pytest.approx(4.0), pytest.approx(6.99))
    y, vy = truth.state[:, 2], truth.state[:, 3]
    np.testing.assert_allclose(y[:401], 0.0, atol=1e-9)
    np.testing.assert_allclose(y[700:], W, atol=1e-9)
    assert y[550] == pytest.approx(W / 2)
    assert (np.diff(y[400:700]) >= -1e-9).all()
    np.testing.assert_allclose(np.gradient(y, 0.01)[1:-1], vy[1:-1], atol=0.02)
    assert set(truth.direction[400:700]) == {1}
    assert set(truth.flags[400:700]) == {CUT_OUT}
    assert not truth.flags[:400].any()
    assert not truth.flags[700:].any()
    assert truth.lane[549:552].tolist() in ([0, 0, 1], [0, 1, 1])


def test_a_steady_lane_change_is_a_straight_line() -> None:
    change = LaneChange(4.0, 3.0, -W, 0.4, steady=True)
    (truth,) = drive(scenario(driver((0.0, 40.0, 25.0, 0.0), d=W, changes=(change,)))).objects
    t = truth.t_ns * 1e-9
    np.testing.assert_allclose(truth.state[:, 2], np.interp(t, [4.0, 7.0], [W, 0.0]), atol=1e-9)
    during = (t > 4.001) & (t < 6.999)
    np.testing.assert_allclose(truth.state[:, 3], np.where(during, -W / 3.0, 0.0), atol=1e-9)
    assert set(truth.direction[during]) == {-1}


def test_a_change_into_the_egos_lane_is_a_cut_in() -> None:
    change = LaneChange(4.0, 3.0, -W, 0.5)
    (truth,) = drive(scenario(driver((0.0, 40.0, 25.0, 0.0), d=W, changes=(change,)))).objects
    assert set(truth.flags[400:700]) == {CUT_IN}
    assert set(truth.direction[400:700]) == {-1}


def test_overtaking_another_vehicle() -> None:
    change = LaneChange(2.0, 3.0, W, 0.5)
    fast = driver((0.0, 20.0, 30.0, 0.0), d=0.0, changes=(change,), number=1)
    slow = driver((0.0, 60.0, 25.0, 0.0), d=0.0, number=2)
    passed, other = drive(scenario(fast, slow)).objects
    flagged = np.flatnonzero(passed.flags & OVERTAKING_ANOTHER) * 0.01
    # from the change's start (30 m behind) until its rear is 10 m ahead: 40 + 10 = 5 t
    assert flagged[0] == pytest.approx(2.0)
    assert flagged[-1] == pytest.approx(10.0, abs=0.011)
    assert not other.flags.any()


def test_the_egos_own_lane_change_moves_the_others_lanes_not_their_labels() -> None:
    ego = driver((0.0, -4.0, 25.0, 0.0), changes=(LaneChange(4.0, 4.0, W, 1.0),), number=0)
    truth = drive(scenario(driver((0.0, 60.0, 25.0, 0.0), d=0.0), ego=ego))
    (target,) = truth.objects
    assert set(target.label) == {Manoeuvre.KEEP_LANE}
    assert target.lane[500] == 0
    assert target.lane[700] == -1
    assert target.state[-1, 2] == pytest.approx(-W)
    # in the middle of a quintic the lateral speed is 1.875 times the mean one
    heading = np.arctan(1.875 * W / 4.0 / 25.0)
    assert truth.ego.heading[600] == pytest.approx(heading, rel=1e-3)
    assert target.state[600, 2] == pytest.approx(
        -np.sin(heading) * 60.0 - np.cos(heading) * W / 2, abs=0.01
    )
    assert np.trapezoid(truth.ego.yaw_rate[400:801], dx=0.01) == pytest.approx(0.0, abs=1e-6)


def test_in_a_bend() -> None:
    radius = 800.0
    road = Road.of(np.array([-600.0, 3000.0]), np.full(2, 1 / radius))
    (target,) = (truth := drive(scenario(driver((0.0, 100.0, 25.0, 0.0), d=W), road=road))).objects
    angle = 100.0 / radius
    x = (radius - W) * np.sin(angle)
    y = radius - (radius - W) * np.cos(angle)
    np.testing.assert_allclose(target.state[:, 0], x, atol=2e-3)
    np.testing.assert_allclose(target.state[:, 2], y, atol=2e-3)
    v = 25.0 * (1.0 - W / radius)
    np.testing.assert_allclose(target.state[:, 1], v * np.cos(angle) - 25.0, atol=1e-3)
    np.testing.assert_allclose(target.state[:, 3], v * np.sin(angle), atol=1e-3)
    np.testing.assert_allclose(truth.ego.yaw_rate, 25.0 / radius, atol=1e-6)
    assert set(target.lane) == {1}
    assert set(target.label) == {Manoeuvre.KEEP_LANE}


def test_what_passes_out_of_sight_is_gone() -> None:
    (truth,) = drive(scenario(driver((0.0, 20.0, 20.0, 0.0), d=W))).objects
    assert truth.state[-1, 0] == pytest.approx(-30.0, abs=0.06)
    assert truth.sample(2_000_000_000) == 200
    assert truth.sample(2_009_999_999) == 200
    assert truth.sample(int(truth.t_ns[-1]) + 10_000_000) == -1
    assert truth.sample(-1) == -1


# -- random traffic -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def drives() -> list[MotorwayTruth]:
    return [
        drive(random_motorway(np.random.default_rng(seed), settings))
        for settings in (TUNING, REPORTING)
        for seed in range(20)
    ]


def traffic(truth: MotorwayTruth) -> list[ObjectTruth]:
    """Without what comes towards us or stands."""
    others = (Manoeuvre.ONCOMING, Manoeuvre.STATIONARY)
    return [target for target in truth.objects if target.label[0] not in others]


def relative_speed(truth: MotorwayTruth, target: ObjectTruth) -> np.ndarray:
    span = slice(target.first, target.first + len(target.t_ns))
    return np.gradient(target.station, 0.01) - np.gradient(truth.ego.station, 0.01)[span]


def test_equal_seeds_give_equal_traffic_and_others_do_not() -> None:
    first, again, other = (
        drive(random_motorway(np.random.default_rng(seed), TUNING)) for seed in (1, 1, 2)
    )
    assert len(first.objects) == len(again.objects)
    for a, b in zip(first.objects, again.objects, strict=True):
        np.testing.assert_array_equal(a.state, b.state)
        np.testing.assert_array_equal(a.label, b.label)
    assert first.scenario.lane_width != other.scenario.lane_width


def test_every_label_and_flag_occurs_in_reasonable_shares(drives: list[MotorwayTruth]) -> None:
    labels = np.concatenate(
        [target.label[target.state[:, 0] > 1.0] for truth in drives for target in traffic(truth)]
    )
    share = np.bincount(labels, minlength=11) / len(labels)
    for manoeuvre, low, high in (
        (Manoeuvre.KEEP_LANE, 0.25, 0.5),
        (Manoeuvre.RECEDING, 0.15, 0.4),
        (Manoeuvre.APPROACHING, 0.15, 0.4),
        (Manoeuvre.LANE_CHANGE, 0.05, 0.15),
        (Manoeuvre.REAR_END, 0.002, 0.03),
    ):
        assert low < share[manoeuvre] < high, manoeuvre
    assert share[[0, 1, 3, 4, 9, 10]].sum() == 0
    everything = {label for truth in drives for target in truth.objects for label in target.label}
    assert {Manoeuvre.ONCOMING, Manoeuvre.STATIONARY} <= everything
    for flag in (CUT_IN, CUT_OUT, OVERTAKING_ANOTHER):
        assert any((target.flags & flag).any() for truth in drives for target in traffic(truth))


def test_positions_and_velocities_agree_in_the_turning_axes(drives: list[MotorwayTruth]) -> None:
    for truth in drives[::4]:
        for target in truth.objects:
            x, vx, y, vy = target.state.T
            turn = truth.ego.yaw_rate[target.first : target.first + len(x)]
            inner = slice(2, -2)
            np.testing.assert_allclose(
                np.gradient(x, 0.01)[inner], (vx + turn * y)[inner], atol=0.03
            )
            np.testing.assert_allclose(
                np.gradient(y, 0.01)[inner], (vy - turn * x)[inner], atol=0.06
            )


def test_labels_follow_the_speeds(drives: list[MotorwayTruth]) -> None:
    for truth in drives:
        for target in traffic(truth):
            dv = relative_speed(truth, target)
            label, x = target.label, target.state[:, 0]
            assert (np.abs(dv[label == Manoeuvre.KEEP_LANE]) < 1.05).all()
            assert (dv[label == Manoeuvre.RECEDING] > -0.03).all()
            approaching = (label == Manoeuvre.APPROACHING) | (label == Manoeuvre.REAR_END)
            assert (dv[approaching] < 0.03).all()
            changing = label == Manoeuvre.LANE_CHANGE
            assert set(label[~changing & (dv > 1.05)]) <= {Manoeuvre.RECEDING}
            assert not ((label == Manoeuvre.REAR_END) & ((x > 10.0) | (target.lane != 0))).any()
            near = (label == Manoeuvre.APPROACHING) & (target.lane == 0)
            assert (x[near] > 10.0).all()


def test_little_time_is_spent_between_the_thresholds(drives: list[MotorwayTruth]) -> None:
    unclear = total = 0
    for truth in drives:
        for target in traffic(truth):
            keeping = target.label == Manoeuvre.KEEP_LANE
            dv = np.abs(relative_speed(truth, target)[keeping])
            unclear += np.count_nonzero(dv > 0.5)
            total += len(target.label)
    assert unclear < 0.03 * total


def test_lane_changes_go_one_lane_in_their_time(drives: list[MotorwayTruth]) -> None:
    count = 0
    for truth in drives:
        settings = TUNING if truth in drives[:20] else REPORTING
        width = truth.scenario.lane_width
        for target in traffic(truth):
            wander = wander_of(truth, target)
            middle = target.d - wander
            # sum(a²) = 2 σ² bounds the sum of the sines by √(2 n) σ
            assert np.abs(wander).max() <= np.sqrt(2 * 6) * settings.wander[1] + 1e-9
            changes = [run[1:] for run in runs(target) if run[0] == Manoeuvre.LANE_CHANGE]
            for begin, end in (
                [target.sample(round(t * 1e9)) for t in change] for change in changes
            ):
                if begin == 0 or end == len(target.t_ns) - 1:
                    continue
                if len(set(target.direction[begin : end + 1])) > 1:
                    continue  # there and straight back again
                moved = middle[end + 1] - middle[begin]
                lanes = round(moved / width)
                low, high = settings.change_time
                assert low - 0.02 <= (end - begin + 1) * 0.01 / abs(lanes) <= high + 0.02
                assert abs(moved - lanes * width) < 1e-3
                assert np.sign(moved) == target.direction[begin]
                count += abs(lanes) == 1
            lane = middle[target.direction == 0] / width
            assert np.abs(lane - np.rint(lane)).max(initial=0.0) < 1e-3
    assert count > 200


def test_lanes_are_counted_from_the_egos(drives: list[MotorwayTruth]) -> None:
    for truth in drives:
        ego_lane = np.rint(truth.ego.d / truth.scenario.lane_width)
        for target in traffic(truth):
            own = np.rint(target.d / truth.scenario.lane_width)
            span = slice(target.first, target.first + len(own))
            np.testing.assert_array_equal(target.lane, own - ego_lane[span])
            assert own.min() >= 0
            assert own.max() < truth.scenario.n_lanes


def test_nobody_drives_through_anybody(drives: list[MotorwayTruth]) -> None:
    nearest = np.inf
    for truth in drives:
        cars = traffic(truth)
        length = {d.id: d.length for d in truth.scenario.drivers}
        assert len(cars) <= len(length)
        lengths = [
            next(d.length for d in truth.scenario.drivers if is_of(d, target)) for target in cars
        ]
        for i, a in enumerate(cars):
            for j in range(i):
                b = cars[j]
                first = max(a.first, b.first)
                stop = min(a.first + len(a.d), b.first + len(b.d))
                if first >= stop:
                    continue
                mine, its = (
                    slice(first - a.first, stop - a.first),
                    slice(first - b.first, stop - b.first),
                )
                along = a.station[mine] - b.station[its]
                gap = np.abs(along) - np.where(along > 0, lengths[j], lengths[i])
                beside = np.abs(a.d[mine] - b.d[its]) < 2.0
                nearest = min(nearest, gap[beside].min(initial=np.inf))
            span = slice(a.first, a.first + len(a.d))
            gap = a.station - truth.ego.station[span]
            in_front = (np.abs(a.d - truth.ego.d[span]) < 2.0) & (gap > 0.0)
            assert gap[in_front].min(initial=np.inf) > 2.3
    assert 5.5 < nearest < 8.0


def is_of(d: Driver, target: ObjectTruth) -> bool:
    t = target.t_ns[:1] * 1e-9
    return bool(d.start <= t[0] + 1e-9 and abs(d.along(t)[0][0] - target.station[0]) < 1e-9)


def sines(d: Driver, t: np.ndarray) -> np.ndarray:
    """The driver's wander [m] at times t [s]."""
    return sum(a * np.sin(omega * t + phase) for a, omega, phase in d.wander)


def wander_of(truth: MotorwayTruth, target: ObjectTruth) -> np.ndarray:
    (d,) = (d for d in truth.scenario.drivers if is_of(d, target))
    return sines(d, target.t_ns * 1e-9)


def test_wander_has_the_stated_deviation_and_is_slow() -> None:
    settings = replace(plain(TUNING), duration=600.0, ego_change_rate=0.0, vehicles=(4, 4))
    deviations = []
    for seed in range(6):
        truth = drive(random_motorway(np.random.default_rng(seed), settings))
        d = truth.ego.d / truth.scenario.lane_width
        off = (d - np.rint(d)) * truth.scenario.lane_width
        deviations.append(off.std())
        stated = np.sqrt((truth.scenario.ego.wander[:, 0] ** 2).sum() / 2.0)
        assert off.std() == pytest.approx(stated, rel=0.07)
        later = np.corrcoef(off[:-100], off[100:])[0, 1]
        assert later > 0.5  # after 1 s
        assert np.abs(truth.ego.yaw_rate).max() < 0.02
    # sines of nearly equal periods beat over longer than the drive: some per cent
    low, high = settings.wander
    assert 0.93 * low < min(deviations) < max(deviations) < 1.07 * high
    assert max(deviations) - min(deviations) > 0.4 * (high - low)


def test_switches() -> None:
    for seed in range(5):
        truth = drive(random_motorway(np.random.default_rng(seed), plain(TUNING)))
        assert (truth.scenario.road.curvature == 0.0).all()
        assert not truth.ego.direction.any()
        speed = np.diff(truth.ego.station)[0] / 0.01
        np.testing.assert_allclose(truth.ego.speed, speed, rtol=1e-3)
        assert len(truth.objects) == len(traffic(truth))


def test_as_published_everybody_keeps_to_the_middle_or_crosses_at_a_constant_rate() -> None:
    settings = published(REPORTING)
    assert settings.noise == 1.0
    changes = 0
    for seed in range(5):
        truth = drive(random_motorway(np.random.default_rng(seed), settings))
        width = truth.scenario.lane_width
        for one in truth.objects:
            lane, vy = one.d / width, one.state[:, 3]
            keeping = one.direction == 0
            np.testing.assert_allclose(lane[keeping], np.round(lane[keeping]), atol=1e-6)
            for begin in np.flatnonzero(np.diff(one.direction) != 0)[:-1] + 1:
                rates = np.abs(vy[begin : begin + 199])[1:-1]
                if keeping[begin] or len(rates) < 197:
                    continue
                changes += 1
                np.testing.assert_allclose(rates, rates[0], atol=1e-6)
                assert width / 4.0 <= rates[0] <= width / 2.0
    assert changes > 20


def test_the_ego_keeps_to_its_ranges(drives: list[MotorwayTruth]) -> None:
    changes = seconds = 0.0
    for k, truth in enumerate(drives):
        low, high = (TUNING if k < 20 else REPORTING).ego_speed
        assert low - 5.0 < truth.ego.speed.min() < truth.ego.speed.max() < high + 5.0
        acceleration = np.diff(np.gradient(truth.ego.station, 0.01)) / 0.01
        # more only in need
        assert np.mean(np.abs(acceleration) > 1.02) < 0.05
        changes += np.count_nonzero(np.diff(truth.ego.direction, prepend=0) > 0)
        changes += np.count_nonzero(np.diff(truth.ego.direction, prepend=0) < 0)
        seconds += len(truth.t_ns) * 0.01
    assert 0.004 < changes / 2.0 / seconds < 0.03


def test_settings_have_names_and_differ() -> None:
    assert motorway_settings("tuning") is TUNING
    assert motorway_settings("reporting") is REPORTING
    for name in ("ego_speed", "acceleration", "change_time", "vehicles", "faster", "slower"):
        assert getattr(TUNING, name) != getattr(REPORTING, name)
    with pytest.raises(CanImmError, match="nope"):
        motorway_settings("nope")


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"duration": 0.0}, "duration"),
        ({"lanes": (0, 2)}, "lanes"),
        ({"faster": (3.0, 1.0)}, "faster"),
    ],
)
def test_impossible_settings_are_refused(wrong: dict[str, object], named: str) -> None:
    with pytest.raises(CanImmError, match=named):
        MotorwaySettings(**wrong)  # type: ignore[arg-type]
