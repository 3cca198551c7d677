"""The rules' filter against filterpy, its bends against geometry, and the thresholds by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter

from can_imm.studies.motorway_filter import (
    POSITION_STD,
    VELOCITY_STD,
    Frames,
    bent,
    curvature_of,
    follow,
    level,
)
from can_imm.studies.motorway_rules import START, judge
from can_imm.types import Manoeuvre

KEEP, CHANGE, REAR_END = Manoeuvre.KEEP_LANE, Manoeuvre.LANE_CHANGE, Manoeuvre.REAR_END
RECEDING, APPROACHING = Manoeuvre.RECEDING, Manoeuvre.APPROACHING
STD = np.array([0.15, 0.3, 0.2, 0.4])
SIMPLE = START._replace(
    lane_vy=0.5, lane_vy_far=0.0, lane_border=0.0, lane_end=0.5, lane_dwell=2, lane_hold=3,
    receding=0.5, receding_end=0.3, approaching=0.6, approaching_end=0.2, speed_dwell=1,
    rear_end_x=10.0, width=3.5,
)  # fmt: skip


def frames(z, *, t=None, **changed):
    n = len(z)
    values = {
        "run": np.zeros(n, np.int32),
        "t": np.arange(n) * 0.1 if t is None else t,
        "id": np.zeros(n, np.int32),
        "new": np.zeros(n, np.bool_),
        "z": np.asarray(z, np.float64),
        "std": np.broadcast_to(STD, (n, 4)).copy(),
        "valid": np.ones((n, 4), np.bool_),
        "angle": np.zeros(n),
        "speed": np.full(n, 30.0),
        "yaw_rate": np.zeros(n),
    }
    return Frames(**{**values, **changed})


def by_filterpy(f, rows, q_along, q_across):
    kf = KalmanFilter(dim_x=4, dim_z=4)
    kf.x = np.zeros(4)
    kf.P = np.diag([POSITION_STD, VELOCITY_STD[0], POSITION_STD, VELOCITY_STD[1]]) ** 2
    last = None
    for k in rows:
        if last is not None:
            dt = f.t[k] - last
            block = np.array([[1.0, dt], [0.0, 1.0]])
            kf.F = np.kron(np.eye(2), block)
            noise = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
            kf.Q = np.kron(np.diag([q_along, q_across]), noise)
            kf.predict()
        last = f.t[k]
        c, s = math.cos(f.angle[k]), math.sin(f.angle[k])
        turn = np.kron(np.array([[c, s], [-s, c]]), np.eye(2))
        used = f.valid[k]
        kf.update(f.z[k][used], R=np.diag(f.std[k][used] ** 2), H=turn[used])
        yield k, kf.x, kf.P


def check_against_filterpy(f, tracks):
    x, cov, begins = follow(f, 0.3, 0.7, np.zeros(len(f.t)), True)
    assert np.flatnonzero(begins).tolist() == sorted(track[0] for track in tracks)
    for rows in tracks:
        for k, mean, P in by_filterpy(f, rows, 0.3, 0.7):
            # the huge covariance at birth costs digits
            np.testing.assert_allclose(x[k], mean, rtol=0, atol=1e-5)
            np.testing.assert_allclose(cov[k], P, rtol=0, atol=1e-4)
    assert len(follow(f, 0.3, 0.7, np.zeros(len(f.t)), False)[1]) == 0


def test_filter_agrees_with_filterpy():
    """Two tracks in turn, uneven times, components missing."""
    rng = np.random.default_rng(3)
    n = 60
    ids = np.tile([4, 7], n // 2).astype(np.int32)
    t = np.repeat(np.cumsum(rng.uniform(0.05, 0.15, n // 2)), 2)
    z = np.column_stack([40.0 + 2.0 * t, np.full(n, 2.0), 3.0 - 0.4 * t, np.full(n, -0.4)])
    z += rng.standard_normal((n, 4)) * STD
    valid = np.ones((n, 4), np.bool_)
    valid[ids == 7, 3] = False
    valid[10:20, 1] = False
    f = frames(z, t=t, id=ids, valid=valid)
    check_against_filterpy(f, [range(0, n, 2), range(1, n, 2)])


def test_filter_of_a_polar_sensor_agrees_with_filterpy():
    rng = np.random.default_rng(4)
    n = 50
    t = np.arange(n) * 0.05
    x, y = 20.0 + 3.0 * t, 8.0 - 1.0 * t
    angle = np.arctan2(y, x)
    distance = np.hypot(x, y)
    z = np.zeros((n, 4))
    z[:, 0] = distance + 0.1 * rng.standard_normal(n)
    z[:, 1] = (3.0 * x - y) / distance + 0.1 * rng.standard_normal(n)
    valid = np.tile([True, True, True, False], (n, 1))
    f = frames(z, t=t, angle=angle, valid=valid)
    check_against_filterpy(f, [range(n)])
    means = follow(f, 0.3, 0.7, np.zeros(n), False)[0]
    np.testing.assert_allclose(means[-1], [x[-1], 3.0, y[-1], -1.0], atol=0.5)


def test_tracks_begin_anew_at_gaps_jumps_news_and_runs():
    z = np.tile([50.0, 0.0, 0.0, 0.0], (12, 1))
    z[5:] += [20.0, 0.0, 3.5, 0.0]
    t = np.arange(12) * 0.1
    t[8:] += 1.0
    new = np.zeros(12, np.bool_)
    new[2] = True
    run = np.zeros(12, np.int32)
    run[10:] = 1
    t[10:] -= 1.0
    f = frames(z, t=t, new=new, run=run)
    x, _, begins = follow(f, 0.3, 0.3, np.zeros(12), False)
    assert np.flatnonzero(begins).tolist() == [0, 2, 5, 8, 10]
    np.testing.assert_allclose(x, z, atol=0.01)


@pytest.mark.parametrize("polar", [False, True])
def test_a_vehicle_in_its_lane_in_a_bend_is_straight_ahead(polar):
    """Ego and object on one circle; geometry says where it is seen."""
    radius, v, dv = 600.0, 30.0, -2.0
    n = 60
    t = np.arange(n) * 0.05
    arc = 60.0 + dv * t
    turned = arc / radius
    x, y = radius * np.sin(turned), radius * (1.0 - np.cos(turned))
    vx, vy = (v + dv) * np.cos(turned) - v, (v + dv) * np.sin(turned)
    if polar:
        angle, distance = np.arctan2(y, x), np.hypot(x, y)
        z = np.column_stack([distance, (x * vx + y * vy) / distance, 0 * x, 0 * x])
        valid = np.tile([True, True, True, False], (n, 1))
        f = frames(z, t=t, angle=angle, valid=valid, yaw_rate=np.full(n, v / radius))
    else:
        z = np.column_stack([x, vx, y, vy])
        f = frames(z, t=t, yaw_rate=np.full(n, v / radius))
    curvature = curvature_of(f, 0.5)
    np.testing.assert_allclose(curvature, 1.0 / radius)
    states, _, begins = follow(f, 0.3, 0.3, curvature, False)
    assert begins.sum() == 1
    assert np.abs(states[10:, 2]).max() < 0.05
    assert np.abs(states[10:, 3]).max() < 0.1
    assert np.abs(states[10:, 1] - dv).max() < 0.1
    back = bent(f, states, curvature)
    np.testing.assert_allclose(back[10:], np.column_stack([x, vx, y, vy])[10:], atol=0.2)


def test_curvature_is_a_low_pass_and_forgets_with_the_run():
    n = 200
    yaw = np.where(np.arange(n) < 100, 0.0, 0.03)
    f = frames(np.zeros((n, 4)), yaw_rate=yaw)
    curvature = curvature_of(f, 1.0)
    assert curvature[99] == 0.0
    # one time constant after the step: 1 - 1/e of it
    assert curvature[109] == pytest.approx(0.001 * (1 - math.exp(-1.0)))
    assert curvature[-1] == pytest.approx(0.001, rel=1e-3)
    again = curvature_of(f._replace(run=(np.arange(n) >= 100).astype(np.int32)), 1.0)
    assert again[100] == pytest.approx(0.001)
    unknown = f._replace(yaw_rate=np.full(n, np.nan))
    assert not curvature_of(unknown, 1.0).any()


def test_what_all_do_is_the_egos_heading():
    x = np.zeros((4, 4))
    x[:, 0] = 50.0
    x[:, 1] = [0.0, 2.0, -2.0, -30.0]  # the last one stands still
    x[:, 3] = 0.01 * (30.0 + x[:, 1])
    x[:, 2] = [0.5, 4.0, -3.0, 9.0]
    x[1, 3] += 1.0  # changes lane
    f = frames(x, t=np.zeros(4))
    flat = level(f, x, 1.0)
    np.testing.assert_allclose(flat[:, 3], [0.0, 1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(flat[:, 2], x[:, 2] - 0.5)
    np.testing.assert_array_equal(level(f, x, 0.0), x)
    few = frames(x[2:], t=np.zeros(2))
    np.testing.assert_array_equal(level(few, x[2:], 1.0), x[2:])


def said(x, *, speed=30.0, rules=SIMPLE):
    x = np.asarray(x, np.float64)
    n = len(x)
    begins = np.arange(n) == 0
    return [a.tolist() for a in judge(np.zeros(n, np.int32), np.full(n, speed), x, begins, rules)]


def test_speed_thresholds_with_hysteresis():
    vx = [0.4, 0.6, 0.4, 0.2, 0.4, -0.55, -0.65, -0.3, -0.1]
    x = [[50.0, v, 0.0, 0.0] for v in vx]
    assert said(x)[0] == [
        KEEP, RECEDING, RECEDING, KEEP, KEEP, KEEP, APPROACHING, APPROACHING, KEEP,
    ]  # fmt: skip
    x = [[50.0, v, 0.0, 0.0] for v in (0.0, 0.6, 0.4, 0.6, 0.6, 0.0, 0.6, 0.0, 0.0)]
    R = RECEDING
    slow = said(x, rules=SIMPLE._replace(speed_dwell=2))[0]
    assert slow == [KEEP, KEEP, KEEP, KEEP, R, R, R, R, KEEP]


def test_rear_end_is_in_the_egos_lane():
    assert said([[9.0, -1.0, 1.0, 0.0]])[0] == [REAR_END]
    assert said([[9.0, -1.0, 3.5, 0.0]])[0] == [APPROACHING]
    assert said([[11.0, -1.0, 0.0, 0.0]])[0] == [APPROACHING]
    assert said([[9.0, 0.0, 0.0, 0.0]])[0] == [KEEP]


def test_lane_changes_take_two_frames_to_begin_and_three_to_end():
    vy = [0.0, 0.6, 0.6, 0.3, 0.2, 0.2, 0.2, 0.6, 0.0, -0.6, -0.6]
    x = [[50.0, 0.0, 0.0, v] for v in vy]
    manoeuvre, direction, _ = said(x)
    C, K = CHANGE, KEEP
    assert manoeuvre == [K, K, C, C, C, C, K, K, K, K, C]
    assert direction == [0, 0, 1, 1, 1, 1, 0, 0, 0, 0, -1]


def test_lane_change_near_the_border_and_lanes():
    rules = SIMPLE._replace(lane_border=0.5, border_x=60.0, lane_dwell=1)
    x = [[50.0, 0.0, 1.5, -0.1], [70.0, 0.0, 1.5, -0.1], [50.0, 0.0, -3.6, 0.0]]
    assert said(x[:1], rules=rules) == [[CHANGE], [-1], [0]]
    assert said(x[1:2], rules=rules) == [[KEEP], [0], [0]]
    assert said(x[2:], rules=rules) == [[KEEP], [0], [-1]]
    assert said([[50.0, 0.0, 70.0, 0.0]])[2] == [7]


def test_speed_over_ground():
    assert said([[50.0, -29.0, 9.0, 0.0]])[0] == [Manoeuvre.STATIONARY]
    assert said([[50.0, -60.0, 9.0, 0.0]])[0] == [Manoeuvre.ONCOMING]
    assert said([[50.0, -29.0, 9.0, 0.0]], speed=math.nan)[0] == [APPROACHING]
