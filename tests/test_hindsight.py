"""Labels by hindsight: the road that the ego drove later, and what becomes of a simulated drive."""

from __future__ import annotations

import math

import numpy as np
import pytest

from can_imm.detector import Detector
from can_imm.ego_road import (
    BESIDE,
    DRIFT,
    EgoHistory,
    RoadAtTheTime,
    RoadDriven,
    ahead_cov,
    learn_ahead,
)
from can_imm.estimation.road import BIAS, HEADING, KNOT, MOUNTING, OFFSET, WIDTH
from can_imm.manoeuvres import load_bank
from can_imm.road import RoadFrame
from can_imm.sim.motorway import TUNING, plain
from can_imm.sim.road import Road
from can_imm.smoothing import FixedIntervalSmoother
from can_imm.studies.motorway import detector_says
from can_imm.studies.motorway_metrics import Score, score
from can_imm.studies.motorway_runs import MotorwayRun, play_motorway
from can_imm.types import FloatArray, Manoeuvre, Scan

BANK = load_bank("motorway")
SPEED, PERIOD, LANE = 30.0, 0.07, 3.6


class Drive:
    """An ego that wanders in its lane on a road that begins to bend 150 m ahead."""

    def __init__(self, seconds: float = 14.0, bias: float = 0.002) -> None:
        station = np.array([-300.0, 150.0, 300.0, 2000.0])
        self.road = Road.of(station, np.array([0.0, 0.0, 0.001, 0.001]))
        self.t = np.arange(0.0, seconds, PERIOD)
        self.d = 0.2 * np.sin(0.6 * self.t)
        self.s = SPEED * self.t
        # against the middle of the lane
        self.slope = 0.12 * np.cos(0.6 * self.t) / SPEED
        self.history = EgoHistory()
        assert BANK.road is not None
        frame = RoadFrame(BANK.road)
        curvature, heading, *_ = self.road.at(self.s)
        self.heading = heading + np.arctan(self.slope)
        yaw_rate = np.gradient(self.heading, PERIOD)
        for k, t in enumerate(self.t):
            frame.x[:] = 0.0
            frame.x[[OFFSET, HEADING]] = self.d[k], self.slope[k]
            frame.x[KNOT:] = curvature[k]
            frame.x[[BIAS, MOUNTING, WIDTH]] = bias, 0.0, LANE
            frame.speed, frame.yaw_rate = SPEED, float(yaw_rate[k]) + bias
            self.history.add(float(t), frame, 0.0)

    def seen(self, k: int, ahead: float, d: float) -> FloatArray:
        """x, vx, y, vy of a vehicle in scan k, as fast as the ego."""
        at = np.array([self.s[k], self.s[k] + ahead])
        _, heading, x, y = self.road.at(at)
        x, y = (
            x - np.array([self.d[k], d]) * np.sin(heading),
            y + np.array([self.d[k], d]) * np.cos(heading),
        )
        cos, sin = math.cos(self.heading[k]), math.sin(self.heading[k])
        dx, dy = x[1] - x[0], y[1] - y[0]
        turn = heading[1] - self.heading[k]
        return np.array(
            [
                cos * dx + sin * dy, SPEED * math.cos(turn) - SPEED,
                cos * dy - sin * dx, SPEED * math.sin(turn),
            ]
        )  # fmt: skip


@pytest.mark.parametrize("bias", [0.002, -0.008])
def test_the_road_is_where_the_ego_drives_later(bias: float) -> None:
    """120 m ahead, in the left lane, into a bend of which nothing is seen yet.  What is wrong with
    the yaw rate is known."""
    drive = Drive(bias=bias)
    ego = drive.history.journey(0, len(drive.t) - 1, 0.0)
    scan = np.arange(0, 100, 5)
    z = np.array([drive.seen(int(k), 120.0, LANE) for k in scan])
    r = np.ones_like(z)
    speed = np.full(len(drive.t), SPEED)
    place, beside = RoadDriven(ego, speed, np.zeros(3), np.eye(3)).place(scan, z, r)
    np.testing.assert_allclose(place[:, 2], LANE, atol=0.1)
    np.testing.assert_allclose(place[:, 3], 0.0, atol=0.1)
    np.testing.assert_allclose(place[:, 1], SPEED, atol=0.2)
    np.testing.assert_allclose(np.diff(place[:, 0]), 5 * PERIOD * SPEED, atol=0.2)
    np.testing.assert_allclose(beside, math.hypot(BESIDE, 120.0 * DRIFT), rtol=0.02)
    then, _ = RoadAtTheTime(ego, speed).place(scan, z, r)
    assert np.abs(then[:, 2] - LANE).max() > 0.7, "the filter could not know"


def test_beyond_the_last_place_nobody_knows() -> None:
    drive = Drive(3.0)
    ego = drive.history.journey(0, len(drive.t) - 1, 0.0)
    last = len(drive.t) - 1
    scan = np.array([0, last, last])
    z = np.array(
        [drive.seen(int(k), x, 0.0) for k, x in zip(scan, (60.0, 60.0, 120.0), strict=True)]
    )
    cov = np.diag(np.square([0.002, 1e-4, 1e-6]))
    speed = np.full(len(drive.t), SPEED)
    _, beside = RoadDriven(ego, speed, np.zeros(3), cov).place(scan, z, np.ones_like(z))
    assert beside[0] == pytest.approx(math.hypot(BESIDE, 60.0 * DRIFT), rel=0.02)
    assert beside[2] > beside[1] > beside[0]
    wrong = np.array([0.01, 0.0, 0.0])
    place, _ = RoadDriven(ego, speed, np.zeros(3), cov).place(scan, z, np.ones_like(z))
    other, _ = RoadDriven(ego, speed, wrong, cov).place(scan, z, np.ones_like(z))
    np.testing.assert_allclose(other[:, 2] - place[:, 2], [0.0, -0.6, -1.2], atol=0.05)


def test_what_most_vehicles_do_the_road_does() -> None:
    """Four keep their lanes on a road that bends, one changes lanes."""
    rng = np.random.default_rng(1)
    distances = [np.linspace(low, low + 60.0, 20) for low in (0.0, 10.0, 30.0, 50.0, 60.0)]
    places = [
        1e-4 * one**2 / 2.0 + lane * LANE + 0.1 * rng.standard_normal(20)
        for one, lane in zip(distances, (0, 1, -1, 0, 1), strict=True)
    ]
    places[3] = places[3] + LANE / (1.0 + np.exp(-np.linspace(-6.0, 6.0, 20)))
    x, cov = learn_ahead(distances, places, ahead_cov(1e-3))
    for far in (40.0, 80.0, 110.0):
        row = np.array([far, far**2 / 2.0, far**3 / 6.0])
        error = row @ x - 1e-4 * far**2 / 2.0
        assert abs(error) < 0.15
        assert abs(error) < 3.0 * math.sqrt(row @ cov @ row)


def test_a_straight_road_does_not_bend_for_who_changes_lanes() -> None:
    """One vehicle far ahead moves to the next lane.  What may be a bend elsewhere is none there."""
    far = np.linspace(60.0, 120.0, 20)
    moved = LANE / (1.0 + np.exp(-np.linspace(-3.0, 3.0, 20)))
    row = np.array([120.0, 120.0**2 / 2.0, 120.0**3 / 6.0])
    bent, _ = learn_ahead([far], [moved], ahead_cov(4.5e-4))
    straight, cov = learn_ahead([far], [moved], ahead_cov(1e-6))
    assert abs(row @ bent) > 0.5
    assert abs(row @ straight) < 0.3
    np.testing.assert_allclose(np.sqrt(np.diag(cov))[1:], [1e-6, 5e-9], rtol=1e-3)


def test_journeys_and_what_is_forgotten() -> None:
    history = EgoHistory()
    assert BANK.road is not None
    frame = RoadFrame(BANK.road)
    for k in range(600):
        history.add(0.1 * k + 5.0 * (k >= 500), frame, 0.0)
    assert len(history.journey(100, 200, 1.0)) == 111
    assert len(history.journey(100, 495, 20.0)) == 400, "a silence ends the journey"
    assert history.since(2.0) == 579
    history.forget(450)
    assert history.end == 600
    np.testing.assert_allclose(history.journey(480, 490, 0.55)["t"], 0.1 * np.arange(480, 496))
    assert history.add(70.0, frame, 0.0) == 600


@pytest.fixture(scope="module")
def runs() -> list[MotorwayRun]:
    """Bends, lane changes and ramps of the ego, everything; then a straight road."""
    full = [play_motorway("ars408", seed, TUNING) for seed in (3, 4)]
    return [*full, play_motorway("ars408", 5, plain(TUNING))]


def test_a_recording_is_labelled_better_than_any_causal_detector_could(
    runs: list[MotorwayRun],
) -> None:
    causal: list[Score] = []
    later: list[Score] = []
    for run in runs:
        for said, scores in zip(detector_says(run, BANK, 0), (causal, later), strict=True):
            if scores is later:
                assert said.p is not None
                spoken = said.manoeuvre > 0
                np.testing.assert_allclose(said.p[spoken].sum(axis=1), 1.0)
                assert said.p.min() >= 0.0
            one = score(run, said)
            assert one is not None
            scores.append(one)
    wrong_causal, wrong = (np.mean([1.0 - s.metrics.accuracy for s in x]) for x in (causal, later))
    assert wrong < 0.015
    assert wrong < 0.4 * wrong_causal
    assert np.mean([s.metrics.ece for s in later]) < 0.02
    assert sum(s.found for s in later) >= 0.9 * sum(s.changes for s in later)
    for known in ("lanes", "stationary", "oncoming"):
        good, of = np.sum([getattr(s, known) for s in later], axis=0)
        assert good > 0.97 * of, known


def test_without_the_ego_s_motion_too(runs: list[MotorwayRun]) -> None:
    run = runs[-1]
    for scan in run.scans:
        scan.ego_speed = scan.ego_yaw_rate = math.nan
    causal, later = (score(run, said) for said in detector_says(run, BANK, 0))
    assert causal is not None
    assert later is not None
    assert later.metrics.accuracy > 0.97
    assert later.metrics.accuracy > causal.metrics.accuracy + 0.01


def test_a_vehicle_without_a_slot_is_not_taken_for_another() -> None:
    """There is room for one; the other drives away in the next lane."""
    detector = Detector(BANK, capacity=1)
    detector.history = smoother = FixedIntervalSmoother(BANK)
    scan, said = Scan(2), []
    scan.n, scan.ids[:], scan.valid[:], scan.std[:] = 2, (7, 8), True, 0.1
    scan.ego_speed, scan.ego_yaw_rate = 30.0, 0.0
    for k in range(60):
        scan.t_ns = k * 70_000_000
        scan.z[:] = [(40.0, 0.0, 0.0, 0.0), (60.0 + 0.35 * k, 5.0, BANK.lane_width, 0.0)]
        detector.step(scan.t_ns, scan)
    assert detector.counts.overflow > 0
    for _, reports in smoother.finish():
        assert reports["object_id"].tolist() == [7]
        said += reports["manoeuvre"].tolist()
    assert set(said) == {Manoeuvre.KEEP_LANE}
