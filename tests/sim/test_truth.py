"""The true motion: the published events, the plateaus, and an independent bicycle."""

from dataclasses import replace
from math import atan, cos, sin, sqrt, tan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import cumulative_simpson, solve_ivp

from can_imm.sim.model import RIGHT, Scenario, ScenarioObject, Segment
from can_imm.sim.random import random_scenario
from can_imm.sim.scenario import load_scenario
from can_imm.sim.truth import Truth, _steering, simulate
from can_imm.types import VX, VY, Manoeuvre, X, Y

PAPER = ["paper-a", "paper-b", "paper-s"]
EGO = 60 / 3.6
TABLE_1 = [
    (0.0, "KEEP_RIGHT"),
    (5.0, "OVERTAKING"),
    (8.0, "KEEP_RIGHT"),
    (15.0, "LANE_CHANGE"),
    (17.0, "KEEP_LEFT"),
    (22.0, "LANE_CHANGE"),
    (26.0, "KEEP_RIGHT"),
    (35.0, "RECEDING"),
    (45.0, "KEEP_RIGHT"),
    (50.0, "APPROACHING"),
]
TRAVELLED = [83.50, 133.50, 250.17, 283.50, 366.83, 433.50, 583.50, 750.17, 833.50]


def paper(name: str) -> Truth:
    (truth,) = simulate(load_scenario(name))
    return truth


def seconds(truth: Truth) -> np.ndarray:
    return truth.t_ns * 1e-9


def between(truth: Truth, start: float, end: float) -> np.ndarray:
    t = seconds(truth)
    return truth.state[(t > start - 1e-6) & (t < end + 1e-6)]


def crossing(truth: Truth, gap: float) -> float:
    """When the gap is reached, by the speed at the last sample above it."""
    i = int(np.flatnonzero(truth.state[:, X] > gap)[-1])
    return float(seconds(truth)[i] + (truth.state[i, X] - gap) / -truth.state[i, VX])


def changes(truth: Truth) -> list[tuple[float, str]]:
    first = np.flatnonzero(np.diff(truth.label, prepend=-1))
    return [(round(seconds(truth)[i], 6), Manoeuvre(truth.label[i]).name) for i in first]


@pytest.mark.parametrize("name", PAPER)
def test_the_published_events_happen_on_time(name: str) -> None:
    truth = paper(name)
    near, touch = crossing(truth, 10.0), crossing(truth, 0.0)
    assert near == pytest.approx(67.25, abs=0.02)
    assert touch == pytest.approx(69.65, abs=0.02)
    assert touch - near == pytest.approx(2.40, abs=0.02)


@pytest.mark.parametrize("name", PAPER)
def test_the_run_ends_with_the_last_sample_above_gap_zero(name: str) -> None:
    truth = paper(name)
    assert truth.state[:, X].min() == truth.state[-1, X]
    assert 0.0 < truth.state[-1, X] <= -truth.state[-1, VX] * truth.dt_ns * 1e-9


@pytest.mark.parametrize("name", PAPER)
def test_labels_change_as_in_table_1(name: str) -> None:
    truth = paper(name)
    *written, rear_end = changes(truth)
    assert written == TABLE_1
    assert rear_end == (pytest.approx(67.25, abs=0.025), "REAR_END")
    assert len(written) + 1 == 11
    first = int(np.flatnonzero(truth.label == Manoeuvre.REAR_END)[0])
    assert truth.state[first, X] <= 10.0 < truth.state[first - 1, X]
    assert np.count_nonzero(np.diff(truth.label)) == 10


def test_the_distance_column_of_table_1() -> None:
    truth = paper("paper-a")
    starts = [t for t, _ in changes(truth)[1:10]]
    ego_speed = load_scenario("paper-a").ego_speed
    assert [round(ego_speed * (t + 0.01), 2) for t in starts] == TRAVELLED


def test_sampling_times_and_shapes() -> None:
    truth = paper("paper-a")
    n = len(truth.t_ns)
    assert truth.t_ns.dtype == np.int64
    assert truth.t_ns[0] == 0
    assert set(np.diff(truth.t_ns)) == {10_000_000}
    assert truth.state.shape == (n, 4)
    for signal in (truth.label, truth.direction, truth.lane):
        assert (signal.dtype, signal.shape) == (np.int8, (n,))
    for signal in (truth.speed, truth.steer, truth.heading):
        assert (signal.dtype, signal.shape) == (np.float64, (n,))
    assert truth.object_id == 1
    assert truth.state[0].tolist() == [50.0, 0.0, 0.0, 0.0]


def test_speed_plateaus_and_ramps() -> None:
    truth = paper("paper-a")
    relative = truth.speed - EGO
    at = {t: relative[round(t * 100)] for t in (0.0, 4.99, 6.5, 8.0, 34.99, 40.0, 45.0, 60.0)}
    assert at[0.0] == at[4.99] == at[34.99] == 0.0
    assert at[6.5] == pytest.approx(7.6 / 3.6)
    assert at[40.0] == pytest.approx(10 / 3.6)
    assert at[60.0] == pytest.approx(-15 / 3.6)
    assert (at[8.0], at[45.0]) == pytest.approx((0.0, 0.0), abs=1e-9)
    for start, sign in ((5.0, 1), (35.0, 1), (50.0, -1)):
        ramp = relative[round(start * 100) : round(start * 100) + 100]
        assert np.diff(ramp) * 100 == pytest.approx(np.full(99, sign * 2.0))
    # on a straight road the relative speed is the profile itself
    assert between(truth, 36.5, 43.5)[:, VX] == pytest.approx(10 / 3.6)
    assert truth.state[-1, VX] == pytest.approx(-15 / 3.6)


def test_speed_steps_of_truth_s() -> None:
    relative = paper("paper-s").speed - EGO
    for start, end, peak in ((5.0, 8.0, 5.5), (35.0, 45.0, 10.0)):
        i, j = round(start * 100), round(end * 100)
        assert relative[i - 1] == relative[j] == 0.0
        assert relative[i:j] == pytest.approx(np.full(j - i, peak / 3.6))
    assert relative[5000:] == pytest.approx(np.full(len(relative) - 5000, -15 / 3.6))


def test_overtaking_gains_what_the_paper_shows() -> None:
    truth = paper("paper-a")
    assert between(truth, 9.0, 14.0)[:, X] == pytest.approx(53.75, abs=0.01)


@pytest.mark.parametrize("name", PAPER)
def test_lateral_rates_and_lanes(name: str) -> None:
    truth = paper(name)
    assert between(truth, 16.0, 16.99)[:, VY] == pytest.approx(1.5, abs=0.01)
    assert between(truth, 23.0, 25.99)[:, VY] == pytest.approx(-0.75, abs=0.005)
    assert between(truth, 18.5, 21.99)[:, Y] == pytest.approx(3.0, abs=0.02)
    assert between(truth, 28.0, 69.0)[:, Y] == pytest.approx(0.0, abs=0.02)
    assert between(truth, 5.0, 8.0)[:, Y].max() == pytest.approx(2.9, abs=0.15)
    t = seconds(truth)
    assert set(truth.direction[(t >= 15) & (t < 17)]) == {1}
    assert set(truth.direction[(t >= 22) & (t < 26)]) == {-1}
    assert set(truth.direction[truth.label != Manoeuvre.LANE_CHANGE]) == {0}
    assert np.array_equal(truth.lane == 1, truth.state[:, Y] > 1.5)


def oracle(t_end: float) -> tuple[np.ndarray, np.ndarray, list[float]]:
    """Truth A once more, in continuous time: t, (x, y, heading) and the steering angle."""

    def profile(t: float) -> float:
        v = EGO
        for start, end, peak in ((5, 8, 7.6), (35, 45, 10), (50, 80, -15)):
            height = min(2.0 * (t - start), abs(peak) / 3.6, 2.0 * (end - t))
            v += max(height, 0.0) * (1 if peak > 0 else -1)
        return v

    fine = np.linspace(0.0, 80.0, 80_001)
    travelled = cumulative_simpson([profile(t) for t in fine], x=fine, initial=0)
    knots = [(0, 0), (5, 0), (6.25, 3), (6.75, 3), (8, 0), (15, 0), (17, 3), (22, 3), (26, 0)]
    along = np.interp([t for t, _ in knots], fine, travelled)
    px, py = [2.7], [0.0]
    for i in range(1, len(knots)):
        rise = knots[i][1] - knots[i - 1][1]
        px.append(px[-1] + sqrt((along[i] - along[i - 1]) ** 2 - rise**2))
        py.append(knots[i][1])
    px.append(1e6)
    py.append(0.0)

    def steering(t: float, s: np.ndarray) -> float:
        x, y, heading = s
        front = x + 2.7 * cos(heading)
        leg = int(np.searchsorted(px, front)) - 1 if front > px[0] else 0
        slope = (py[leg + 1] - py[leg]) / (px[leg + 1] - px[leg])
        error = (py[leg] + slope * (front - px[leg]) - y - 2.7 * sin(heading)) * cos(atan(slope))
        return float(atan(slope) - heading + atan(2.5 * error / profile(t)))

    def motion(t: float, s: np.ndarray) -> list[float]:
        v, heading = profile(t), s[2]
        return [v * cos(heading), v * sin(heading), v * tan(steering(t, s)) / 2.7]

    t_eval = np.arange(0.0, t_end, 0.25)
    run = solve_ivp(motion, (0.0, t_end), [0, 0, 0], t_eval=t_eval, max_step=0.02, rtol=1e-6)
    assert run.success
    return t_eval, run.y.T, [steering(*pair) for pair in zip(t_eval, run.y.T, strict=True)]


def test_the_bicycle_agrees_with_an_independent_integration() -> None:
    truth = paper("paper-a")
    t, states, steer = oracle(69.0)
    i = np.rint(t * 100).astype(int)
    assert truth.state[i, X] == pytest.approx(50.0 + states[:, 0] - EGO * t, abs=2e-3)
    assert truth.state[i, Y] == pytest.approx(states[:, 1], abs=3e-3)
    assert truth.heading[i] == pytest.approx(states[:, 2], abs=1e-3)
    # at the very knots it jumps, and a rounding error decides which leg counts
    off_knots = ~np.isin(t, [5, 6.25, 6.75, 8, 15, 17, 22, 26])
    assert truth.steer[i][off_knots] == pytest.approx(np.array(steer)[off_knots], abs=2e-3)


def test_the_gain_pulls_the_front_axle_back_to_the_path() -> None:
    """By hand, as no scenario leaves the path: on it the front axle needs no correction."""
    keys = {"speed": 20.0, "knot_x": 0.0, "knot_y": 0.0, "wheelbase": 2.7, "gain": 2.5}
    on = _steering(10.0, 1.0 - 2.7 * sin(0.1), 0.1, **(keys | {"knot_y": 1.0}), path_heading=0.0)
    assert on == pytest.approx(-0.1)
    right = _steering(10.0, -0.8, 0.0, path_heading=0.0, **keys)
    assert right == pytest.approx(atan(2.5 * 0.8 / 20.0))
    uphill = _steering(10.0, 0.0, 0.0, path_heading=0.2, **keys)
    assert uphill == pytest.approx(0.2 + atan(2.5 * 10.0 * sin(0.2) / 20.0))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_position_is_the_integral_of_velocity(seed: int) -> None:
    (truth,) = simulate(random_scenario(np.random.default_rng(seed)))
    for position, velocity in ((X, VX), (Y, VY)):
        v = truth.state[:, velocity]
        steps = 0.5 * (v[1:] + v[:-1]) * 0.01
        integral = truth.state[0, position] + np.concatenate(([0.0], np.cumsum(steps)))
        assert truth.state[:, position] == pytest.approx(integral, abs=3e-3)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_speed_and_heading_make_the_velocity(seed: int) -> None:
    (truth,) = simulate(random_scenario(np.random.default_rng(seed)))
    ground = np.hypot(truth.state[:, VX] + EGO, truth.state[:, VY])
    assert ground == pytest.approx(truth.speed)
    assert np.arctan2(truth.state[:, VY], truth.state[:, VX] + EGO) == pytest.approx(truth.heading)


def one_object(duration: float, gap: float, *segments: Segment, **keys: float) -> Scenario:
    return Scenario("mine", duration, (ScenarioObject(5, gap, RIGHT, segments),), **keys)


def test_a_run_ends_with_its_duration() -> None:
    (truth,) = simulate(one_object(12.0, 50.0, Segment(0.0, Manoeuvre.RECEDING, peak=2.0)))
    assert truth.t_ns[-1] == 12_000_000_000
    assert truth.speed[-1] == pytest.approx(EGO)
    assert truth.state[-1, X] == pytest.approx(50.0 + 2.0 * (12.0 - 1.0))


def test_an_approach_that_breaks_off_is_rear_end_until_its_row_ends() -> None:
    scenario = one_object(
        30.0,
        20.0,
        Segment(0.0, Manoeuvre.APPROACHING, peak=2.0),
        Segment(9.0, Manoeuvre.KEEP_RIGHT),
        rear_end_gap=12.0,
    )
    (truth,) = simulate(scenario)
    (_, approaching), (begin, rear_end), (end, keep) = changes(truth)
    assert (approaching, rear_end, keep) == ("APPROACHING", "REAR_END", "KEEP_RIGHT")
    assert begin == pytest.approx(4.5, abs=0.011)
    assert end == 9.0
    assert truth.state[-1, X] == pytest.approx(4.0)


def test_a_manoeuvre_may_be_the_first_and_the_only_one() -> None:
    change = Segment(0.0, Manoeuvre.LANE_CHANGE, direction=1)
    (truth,) = simulate(one_object(4.0, 50.0, change))
    assert truth.state[200:, VY] == pytest.approx(0.75, abs=0.005)
    assert truth.state[-1, Y] == pytest.approx(3.0, abs=0.2)


def test_objects_do_not_touch_each_other() -> None:
    alone = load_scenario("paper-a")
    (target,) = alone.objects
    other = ScenarioObject(9, 30.0, RIGHT, (Segment(0.0, Manoeuvre.KEEP_RIGHT),))
    both = simulate(replace(alone, objects=(other, target)))
    assert [truth.object_id for truth in both] == [9, 1]
    assert len(both[0].t_ns) == 8001
    assert np.array_equal(both[1].state, paper("paper-a").state)
