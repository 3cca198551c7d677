"""The cooperative tracker: what it reports, and what it survives."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_imm.sim.cooperative import CooperativeScene, Radar, Target, load_scene, play_scene
from can_imm.trackers.cooperative import CONFIRM, OBJECT_ID, CooperativeTracker
from can_imm.types import CanImmError, DetectionScan

MS = 1_000_000


@pytest.fixture(scope="module")
def run():
    return play_scene(load_scene("cooperative"), np.random.default_rng(7))


def follow(tracker, scans):
    """Answers by time of the scan: (n, state, existence, new)."""
    answers = {}
    for scan in scans:
        said = tracker.step(scan.t_ns, scan)
        if said is not None:
            answers[said.t_ns] = (
                said.n, said.z[0].copy(), float(said.existence[0]), bool(said.new[0])
            )  # fmt: skip
    return answers


def errors(run, answers):
    truth = dict(zip(run.t_ns.tolist(), run.state, strict=True))
    return np.array([np.hypot(*(z - truth[t])[[0, 2]]) for t, (n, z, _, _) in answers.items() if n])


def copy(scan, room=0):
    other = DetectionScan(scan.n_sensors + room, scan.n + room)
    other.copy_from(scan)
    return other


def test_follows_the_object_relative_to_the_ego_vehicle(run):
    tracker = CooperativeTracker(particles=300)
    answers = follow(tracker, run.scans)
    assert len(answers) == len(run.scans)
    known = [t for t, answer in answers.items() if answer[0]]
    # a birth needs the scan before; then it has to be confirmed
    assert known == run.t_ns[CONFIRM:].tolist()
    error = errors(run, answers)
    assert np.sqrt(np.mean(error**2)) < 0.12
    assert [answer[3] for answer in answers.values() if answer[0]] == [True] + [False] * (
        len(known) - 1
    )
    assert all(answer[2] > 0.99 for answer in answers.values() if answer[0])
    assert tracker.counts.scans == len(run.scans)
    assert tracker.counts.detections == sum(scan.n for scan in run.scans)


def test_object_is_in_the_axes_of_a_vehicle_that_drives_elsewhere(run):
    """The whole world turned and shifted: the object relative to the ego is the same."""
    turn = 2.0
    c, s = math.cos(turn), math.sin(turn)
    turned = []
    for scan in run.scans[:40]:
        other = copy(scan)
        x, y, heading, vx, vy = scan.pose[: scan.n_sensors].T
        other.pose[:] = np.stack(
            [c * x - s * y + 1e4, s * x + c * y - 2e4, heading + turn, c * vx - s * vy,
             s * vx + c * vy], axis=1
        )  # fmt: skip
        turned.append(other)
    truth = dict(zip(run.t_ns.tolist(), run.state, strict=True))
    for t, (n, z, _, _) in follow(CooperativeTracker(particles=2000), turned).items():
        if n:
            np.testing.assert_allclose(z[[0, 2]], truth[t][[0, 2]], atol=0.4)
            np.testing.assert_allclose(z[[1, 3]], truth[t][[1, 3]], atol=1.5)


def test_object_that_appears_and_disappears():
    scene = load_scene("cooperative")
    scene = replace(scene, target=replace(scene.target, appears=2.0, disappears=4.0), duration=6.0)
    run = play_scene(scene, np.random.default_rng(3))
    tracker = CooperativeTracker(particles=300)
    answers = follow(tracker, run.scans)
    there = [t / 1e9 for t, answer in answers.items() if answer[0]]
    assert 2.0 < min(there) <= 2.5
    assert 3.8 < max(there) < 4.1
    assert len(there) == round((max(there) - min(there)) / 0.1) + 1
    assert (tracker.counts.births, tracker.counts.deaths) == (1, 1)


def test_sensors_that_vanish_one_by_one(run):
    scans = []
    for k, scan in enumerate(run.scans):
        other = copy(scan)
        # from the second on one less every two seconds, down to one
        other.n_sensors = max(5 - k // 20, 1)
        other.n = int(np.searchsorted(scan.sensor[: scan.n], other.n_sensors))
        scans.append(other)
    error = errors(run, follow(CooperativeTracker(particles=500), scans))
    assert len(error) > 140
    assert error.max() < 2.0


def test_ego_that_vanishes_is_taken_to_drive_on(run):
    scans = []
    for k, scan in enumerate(run.scans):
        other = copy(scan)
        if k > 20:
            other.sensor_id[0] = 9  # another vehicle of that name, at the same place
        scans.append(other)
    error = errors(run, follow(CooperativeTracker(particles=500), scans))
    assert len(error) > 140
    assert error.max() < 0.6


def test_a_sensor_that_contradicts_the_others(run):
    """One radar sees the object 10 m too far, another looks the other way."""
    scans = []
    for scan in run.scans:
        other = copy(scan)
        other.z[: scan.n, 0] += np.where(scan.sensor[: scan.n] == 1, 10.0, 0.0)
        other.pose[3, 2] += math.pi
        scans.append(other)
    error = errors(run, follow(CooperativeTracker(particles=500), scans))
    assert len(error) > 140
    assert np.sqrt(np.mean(error**2)) < 0.25


def test_repeated_and_delayed_scans_change_nothing(run):
    plain = follow(CooperativeTracker(particles=200), run.scans)
    tracker = CooperativeTracker(particles=200)
    answers = {}
    for k, scan in enumerate(run.scans):
        answers |= follow(tracker, [scan])
        assert tracker.step(scan.t_ns + 10 * MS, copy(scan)) is None  # once more
        again = copy(scan)
        again.t_ns += 10 * MS  # once more with another time: told by the counters
        assert tracker.step(again.t_ns, again) is None
        if k > 2:
            assert tracker.step(scan.t_ns + 20 * MS, copy(run.scans[k - 2])) is None  # late
    assert {t: (n, z.tobytes(), q) for t, (n, z, q, _) in answers.items()} == {
        t: (n, z.tobytes(), q) for t, (n, z, q, _) in plain.items()
    }
    assert tracker.counts.repeated_sensors == 2 * 5 * len(run.scans)
    assert tracker.counts.late_sensors == 5 * (len(run.scans) - 3)
    assert tracker.counts.late_scans == 2 * len(run.scans) + len(run.scans) - 3


def test_impossible_values_are_counted_and_left_out(run):
    plain = follow(CooperativeTracker(particles=200), run.scans)
    tracker = CooperativeTracker(particles=200)
    scans = []
    bad = [
        (math.nan, 0.0, 0.0), (-1.0, 0.0, 0.0), (10.0, math.nan, 0.0), (10.0, 0.0, math.inf),
        (math.inf, 0.0, 0.0), (10.0, 99.0, 0.0), (10.0, 0.0, -1e9),
    ]  # fmt: skip
    for scan in run.scans:
        other = copy(scan, room=20)
        n, last = scan.n, scan.n_sensors - 1
        other.z[n : n + len(bad)] = bad
        other.sensor[n : n + len(bad)] = last
        other.n += len(bad)
        # and a sensor that does not know where it is
        other.sensor_id[last + 1], other.pose[last + 1, 0] = 12, math.nan
        other.z[other.n], other.sensor[other.n] = (30.0, 0.0, 0.0), last + 1
        other.n += 1
        other.n_sensors += 1
        scans.append(other)
    answers = follow(tracker, scans)
    assert [z.tobytes() for _, z, _, _ in answers.values()] == [
        z.tobytes() for _, z, _, _ in plain.values()
    ]
    assert tracker.counts.invalid == (len(bad) + 1) * len(run.scans)
    assert tracker.counts.numeric_failures == 0


def test_everything_begins_anew_after_a_long_silence(run):
    tracker = CooperativeTracker(particles=200)
    follow(tracker, run.scans[:20])
    now = run.scans[19].t_ns
    for k in range(1, 400):
        assert tracker.step(now + k * 10 * MS, None) is None
    assert tracker.counts.resets == 1
    assert tracker.counts.deaths == 1
    later = []
    for scan in run.scans[20:40]:
        other = copy(scan)
        other.t_ns += 10_000 * MS
        later.append(other)
    said = list(follow(tracker, later).values())
    assert [n for n, *_ in said] == [0] * CONFIRM + [1] * (20 - CONFIRM)
    assert tracker.counts.births == 2


def test_a_scan_without_any_sensor_and_one_from_the_future(run):
    tracker = CooperativeTracker(particles=50)
    assert tracker.step(0, DetectionScan(5, 5)) is None
    future = copy(run.scans[0])
    future.t_ns = 60_000 * MS
    assert tracker.step(0, future) is None
    assert tracker.counts.invalid == 5
    assert follow(tracker, run.scans[:3])


@given(data=st.data())
def test_survives_anything(data):
    """Whatever comes, every answer is finite and counted."""
    tracker = _small_tracker()
    wild = st.one_of(
        st.floats(-300, 300), st.sampled_from([math.nan, math.inf, -math.inf, 0.0, 1e300, -1e300])
    )
    t_ns = 10_000 * MS
    for _ in range(data.draw(st.integers(1, 6))):
        t_ns += data.draw(st.integers(-200, 300)) * MS
        sensors, n = data.draw(st.integers(0, 4)), data.draw(st.integers(0, 5))
        scan = DetectionScan(4, 5)
        scan.t_ns, scan.n_sensors, scan.n = t_ns, sensors, n if sensors else 0
        scan.sensor_id[:] = np.arange(4)
        scan.counter[:] = data.draw(st.integers(0, 3))
        scan.delay[:] = data.draw(st.lists(wild | st.just(0.0), min_size=4, max_size=4))
        scan.pose[:] = np.reshape(data.draw(st.lists(wild, min_size=20, max_size=20)), (4, 5))
        scan.z[:] = np.reshape(data.draw(st.lists(wild, min_size=15, max_size=15)), (5, 3))
        scan.sensor[:] = np.sort(
            data.draw(st.lists(st.integers(0, max(sensors - 1, 0)), min_size=5, max_size=5))
        )
        said = tracker.step(t_ns, scan)
        assert 0.0 <= tracker.filter.q <= 1.0
        if said is not None and said.n:
            assert said.ids[0] == OBJECT_ID
            assert np.isfinite(said.z[0]).all()
            assert np.isfinite(said.std[0]).all()
            assert 0.5 < said.existence[0] <= 1.0


def _small_tracker():
    return CooperativeTracker(particles=20, capacity=8, sensors=4)


def test_refusals():
    with pytest.raises(CanImmError, match="needs particles"):
        CooperativeTracker(particles=0)


@pytest.mark.slow
def test_errors_of_the_published_setting():
    """The figures of the study on other seeds: 50 runs, N_p = 100."""
    from can_imm.studies.bernoulli import PRODUCT, study

    done = study(50, 5000, sweeps={"particles": (100,)})
    (rmse,) = [point.rmse for point in done.points if point.system == PRODUCT]
    assert rmse.mean() < 0.075
    assert done.existence[PRODUCT][:, 0].max() <= 3
    assert done.existence[PRODUCT][:, 1].max() <= 5


def test_a_scene_of_ones_own_is_judged_by_its_numbers():
    scene = CooperativeScene(
        duration=3.0,
        target=Target(0.0, 0.0, 20.0),
        observers=load_scene("cooperative").observers[:2],
        radar=Radar(detection=0.0, clutter=3.0),
    )
    tracker = CooperativeTracker(particles=200)
    answers = follow(tracker, play_scene(scene, np.random.default_rng(0)).scans)
    assert all(n == 0 for n, *_ in answers.values())
