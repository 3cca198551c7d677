"""What the motorway study counts, on drives that are made by hand."""

from __future__ import annotations

import math
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from can_imm.sim.motorway import DT_NS, ObjectTruth
from can_imm.studies.motorway_metrics import Said, ratio, score
from can_imm.studies.motorway_runs import MotorwayRun
from can_imm.types import Manoeuvre, X

KEEP, CHANGE, RECEDING = Manoeuvre.KEEP_LANE, Manoeuvre.LANE_CHANGE, Manoeuvre.RECEDING
STATIONARY, ONCOMING = Manoeuvre.STATIONARY, Manoeuvre.ONCOMING
PERIOD_NS = 100_000_000
PER_FRAME = PERIOD_NS // DT_NS


def stretch(*parts):
    """One value per frame from (value, frames) pairs."""
    return np.concatenate([np.full(n, value, np.int8) for value, n in parts])


def track(label, direction=None, *, second=False, lane=None):
    n = len(label)
    return SimpleNamespace(
        label=label,
        direction=np.zeros(n, np.int8) if direction is None else direction,
        lane=np.zeros(n, np.int8) if lane is None else lane,
        second=second,
    )


def drive_of(*tracks):
    """A run with these tracks, each of an object of its own that was there all the time."""
    objects, frames = [], []
    for number, one in enumerate(tracks):
        n = len(one.label) * PER_FRAME
        long = {k: np.repeat(getattr(one, k), PER_FRAME) for k in ("label", "direction", "lane")}
        objects.append(
            ObjectTruth(
                object_id=number,
                first=0,
                t_ns=np.arange(n, dtype=np.int64) * DT_NS,
                state=np.zeros((n, 4)),
                flags=np.zeros(n, np.int8),
                speed=np.zeros(n),
                station=np.zeros(n),
                d=np.zeros(n),
                driver=None,
                **long,
            )
        )
        frames.append(len(one.label))
    first = np.concatenate(([0], np.cumsum(frames)))

    def rows(name):
        return np.concatenate([getattr(one, name) for one in tracks])

    return MotorwayRun(
        truth=SimpleNamespace(objects=tuple(objects)),
        scans=[],
        first=first,
        t_ns=np.concatenate([np.arange(n, dtype=np.int64) * PERIOD_NS for n in frames]),
        object=np.repeat(np.arange(len(tracks)), frames),
        second=np.repeat([one.second for one in tracks], frames),
        label=rows("label"),
        direction=rows("direction"),
        lane=rows("lane"),
        state=np.zeros((int(first[-1]), 4)),
        tracks=[np.arange(a, b) for a, b in pairwise(first)],
    )


def say(run, **changed):
    """The truth, but what is given."""
    n = len(run.label)
    values = {
        "manoeuvre": run.label.copy(),
        "direction": run.direction.copy(),
        "lane": run.lane.copy(),
        "p": None,
        "x": np.zeros((n, 4)),
        "cov": np.broadcast_to(np.eye(4), (n, 4, 4)).copy(),
    }
    return Said(**{**values, **changed})


CHANGING = track(stretch((KEEP, 30), (CHANGE, 40), (KEEP, 30)), stretch((0, 30), (1, 40), (0, 30)))


def test_all_right():
    run = drive_of(CHANGING, track(stretch((RECEDING, 50))), track(stretch((STATIONARY, 20))))
    done = score(run, say(run))
    assert done.metrics.accuracy == 1.0
    assert done.metrics.macro_f1 == 1.0
    assert (done.changes, done.found, done.false) == (1, 1, 0)
    assert done.delays_s == (0.0,)
    assert done.hours == pytest.approx((9.9 + 4.9 + 1.9) / 3600)
    assert (done.lanes, done.stationary, done.oncoming) == ((150, 150), (20, 20), (0, 0))


def test_accuracy_is_over_traffic_and_over_frames_of_all_tracks():
    run = drive_of(
        track(stretch((RECEDING, 90))), track(stretch((KEEP, 10))), track(stretch((ONCOMING, 50)))
    )
    manoeuvre = run.label.copy()
    manoeuvre[90:95] = RECEDING
    manoeuvre[100:110] = STATIONARY
    done = score(run, say(run, manoeuvre=manoeuvre, lane=np.ones(150, np.int8)))
    assert done.metrics.accuracy == pytest.approx(0.95)
    assert done.metrics.confusion.sum() == 100
    f1 = (2 * 90 / (90 + 95) + 2 * 5 / (10 + 5)) / 2
    assert done.metrics.macro_f1 == pytest.approx(f1)
    assert done.lanes == (0, 100)
    assert done.oncoming == (40, 50)


def test_tracks_do_not_run_into_each_other():
    """The label changes from one track to the next, but nobody has switched."""
    run = drive_of(track(stretch((RECEDING, 20))), track(stretch((KEEP, 20))))
    late = run.label.copy()
    late[20] = RECEDING
    done = score(run, say(run, manoeuvre=late)).metrics
    assert done.switches == 1.0
    assert done.missed_segments == 0.0
    assert len(done.delays_s) == 0
    assert math.isnan(done.mean_delay_s)
    assert done.accuracy_tol_0_5 == pytest.approx(39 / 40)
    both = drive_of(CHANGING, CHANGING)
    late = both.label.copy()
    late[30:35] = KEEP
    done = score(both, say(both, manoeuvre=late)).metrics
    assert done.delays_s == pytest.approx([0.5, 0.0, 0.0, 0.0])
    assert done.mean_delay_s == pytest.approx(0.125)
    assert done.accuracy_tol_0_5 == 1.0


def test_a_lane_change_is_found_by_two_frames_in_the_right_direction():
    run = drive_of(CHANGING)

    def found(frames, direction=1):
        manoeuvre, said = np.full(100, KEEP, np.int8), np.zeros(100, np.int8)
        manoeuvre[frames], said[frames] = CHANGE, direction
        done = score(run, say(run, manoeuvre=manoeuvre, direction=said))
        assert done.changes == 1
        return done.found, tuple(round(delay, 9) for delay in done.delays_s)

    assert found([40, 41]) == (1, (1.0,))
    assert found([40, 42, 44]) == (0, ())
    assert found([40, 41], -1) == (0, ())
    assert found([29, 30]) == (0, ())
    assert found([69, 70]) == (0, ())
    assert found([35, 68, 69]) == (1, (3.8,))


def test_lane_changes_nearby_are_counted_by_themselves():
    """Where they are when they begin counts."""
    run = drive_of(CHANGING, CHANGING, CHANGING)
    run.state[:, X] = np.repeat([99.0, 101.0, 40.0], 100)
    run.state[35:60, X] = 120.0
    manoeuvre, direction = run.label.copy(), run.direction.copy()
    manoeuvre[200:] = KEEP
    done = score(run, say(run, manoeuvre=manoeuvre, direction=direction))
    assert (done.changes, done.found, done.nearby) == (3, 2, (1, 2))


def test_lane_changes_seen_in_part():
    cut = track(stretch((CHANGE, 25), (KEEP, 10)), stretch((-1, 25), (0, 10)))
    done = score(drive_of(cut), say(drive_of(cut)))
    assert (done.changes, done.found, done.delays_s) == (1, 1, ())  # nobody saw it begin
    short = track(stretch((KEEP, 10), (CHANGE, 20)), stretch((0, 10), (-1, 20)))
    assert score(drive_of(short), say(drive_of(short))).changes == 0
    twice = track(
        stretch((KEEP, 10), (CHANGE, 60), (KEEP, 5)), stretch((0, 10), (1, 30), (-1, 30), (0, 5))
    )
    done = score(drive_of(twice), say(drive_of(twice)))
    assert (done.changes, done.found, done.delays_s) == (2, 2, (0.0, 0.0))


def test_false_lane_changes_are_stretches_far_from_a_true_one():
    run = drive_of(CHANGING)

    def false(*stretches):
        manoeuvre = run.label.copy()
        for begin, end in stretches:
            manoeuvre[begin:end] = CHANGE
        return score(run, say(run, manoeuvre=manoeuvre)).false

    assert false((5, 10)) == 1
    assert false((5, 10), (12, 13)) == 2
    assert false((22, 25)) == 0  # half a second before
    assert false((10, 35)) == 0
    assert false((75, 79)) == 0
    assert false((81, 90)) == 1


def test_second_tracks_count_in_frames_but_not_as_lane_changes_nor_in_the_states():
    run = drive_of(
        track(stretch((KEEP, 40))), track(CHANGING.label, CHANGING.direction, second=True)
    )
    x = np.zeros((140, 4))
    x[40:] = 5.0
    x[:40, 0] = 0.1
    manoeuvre = run.label.copy()
    manoeuvre[45:50] = CHANGE
    done = score(run, say(run, x=x, manoeuvre=manoeuvre))
    assert (done.changes, done.false) == (0, 0)
    assert done.hours == pytest.approx(3.9 / 3600)
    assert done.metrics.accuracy == pytest.approx(135 / 140)
    assert done.metrics.rmse_x == pytest.approx(0.1)
    assert done.metrics.nees == pytest.approx(0.01)


def test_a_drive_without_traffic_has_no_score():
    run = drive_of(track(stretch((STATIONARY, 5))))
    assert score(run, say(run)) is None


def test_ratio_is_of_the_sums_with_the_jackknife_of_a_mean():
    values = [1.0, 4.0, 2.0, 9.0]
    mean, error = ratio(values, [1.0] * 4)
    assert mean == 4.0
    assert error == pytest.approx(np.std(values, ddof=1) / 2)
    assert ratio([3, 0], [3, 1])[0] == 0.75
    assert math.isnan(ratio([0, 0], [0, 0])[0])
    assert ratio([1], [2])[0] == 0.5
    assert math.isnan(ratio([1], [2])[1])
    assert math.isnan(ratio([1, 0], [2, 0])[1])
