"""The baselines against textbook recursions and hand-made trajectories."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from can_imm.studies.baselines import (
    Noise,
    Rules,
    apply_rules,
    kalman,
    white_noise_acceleration,
)
from can_imm.types import Manoeuvre

STD = np.array([0.1, 0.3, 0.2, 0.3])
KR, LC, KL, OV, RE, AP, REAR = (
    Manoeuvre.KEEP_RIGHT,
    Manoeuvre.LANE_CHANGE,
    Manoeuvre.KEEP_LEFT,
    Manoeuvre.OVERTAKING,
    Manoeuvre.RECEDING,
    Manoeuvre.APPROACHING,
    Manoeuvre.REAR_END,
)
SIMPLE = Rules(
    q_along=0.4,
    q_across=0.4,
    approaching=0.8,
    rear_end_x=10.0,
    overtaking_y=0.5,
    overtaking_vx=0.4,
    lane_vy=0.6,
    lane_border=0.75,
    border_y=1.5,
    receding=0.8,
    out_of_right_lane=False,
    hysteresis=0.0,
    dwell=1,
)


def test_process_noise_is_the_exact_discretisation():
    """Van Loan's method on the continuous model."""
    dt, noise = 0.13, Noise(0.7, 2.5)
    A = np.kron(np.eye(2), [[0.0, 1.0], [0.0, 0.0]])
    block = np.zeros((8, 8))
    block[:4, :4] = -A
    block[:4, 4:] = np.diag([0.0, noise.along, 0.0, noise.across])
    block[4:, 4:] = A.T
    E = expm(block * dt)
    F, Q = white_noise_acceleration(dt, noise)
    np.testing.assert_allclose(F, E[4:, 4:].T, atol=1e-12)
    np.testing.assert_allclose(Q, E[4:, 4:].T @ E[:4, 4:], atol=1e-12)


def test_filter_agrees_with_weighted_least_squares_over_the_whole_past():
    """The last state's posterior from one batch of normal equations, gaps in time included."""
    rng = np.random.default_rng(1)
    t_ns = np.array([0, 1, 2, 4, 5, 8], np.int64) * 100_000_000
    seen = np.array([True, True, False, True, True, True])
    z = rng.normal(0, 1, (6, 4))
    noise = Noise(0.5, 1.5)
    x, cov = kalman(t_ns, z, seen, STD, noise)

    n = len(t_ns)
    information, vector = np.zeros((4 * n, 4 * n)), np.zeros(4 * n)
    for k in range(n):
        here = slice(4 * k, 4 * k + 4)
        if seen[k]:
            information[here, here] += np.diag(STD**-2.0)
            vector[here] += z[k] / STD**2
        if k:
            F, Q = white_noise_acceleration((t_ns[k] - t_ns[k - 1]) * 1e-9, noise)
            jacobian = np.zeros((4, 4 * n))
            jacobian[:, 4 * k - 4 : 4 * k] = -F
            jacobian[:, here] = np.eye(4)
            information += jacobian.T @ np.linalg.inv(Q) @ jacobian
    posterior = np.linalg.inv(information)
    np.testing.assert_allclose(x[-1], (posterior @ vector)[-4:], rtol=1e-8)
    np.testing.assert_allclose(cov[-1], posterior[-4:, -4:], rtol=1e-8)
    np.testing.assert_array_equal(x[0], z[0])


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        ((50, 0, 0, 0), KR),
        ((50, 0, 0.74, 0), KR),
        ((50, 0, 0.76, 0), LC),
        ((50, 0, 2.24, 0), LC),
        ((50, 0, 2.26, 0), KL),
        ((50, 0, 0, 0.61), LC),
        ((50, 0, 3, -0.61), LC),
        ((50, 0.79, 0, 0), KR),
        ((50, 0.81, 0, 0), RE),
        ((50, 0.81, 0.4, 0), RE),
        ((50, 0.41, 0.51, 0), OV),
        ((50, 0.39, 0.51, 0), KR),
        ((50, 2.0, 3, 2.0), OV),
        ((50, -0.79, 0, 0), KR),
        ((50, -0.81, 0, 0), AP),
        ((50, -0.81, 1.5, 1), AP),
        ((10.1, -0.81, 0, 0), AP),
        ((10.0, -0.81, 0, 0), REAR),
        ((9.0, -0.79, 0, 0), KR),
    ],
)
def test_thresholds(state, expected):
    assert apply_rules(np.array([state], float), SIMPLE).tolist() == [expected]


def test_receding_in_the_left_lane_is_no_overtaking_where_the_rules_remember_the_lane():
    left_then_faster = np.array([[50, 0, 3, 0], [50, 2, 3, 0], [50, 2, 3, 0]], float)
    right_then_out = np.array([[50, 0, 0, 0], [50, 2, 1.5, 2], [50, 2, 3, 0]], float)
    remembering = SIMPLE._replace(out_of_right_lane=True)
    assert apply_rules(left_then_faster, SIMPLE).tolist() == [KL, OV, OV]
    assert apply_rules(left_then_faster, remembering).tolist() == [KL, RE, RE]
    assert apply_rules(right_then_out, remembering).tolist() == [KR, OV, OV]
    assert apply_rules(left_then_faster[1:], remembering).tolist() == [RE, RE]


def test_hysteresis_eases_only_the_threshold_of_what_is_said():
    x = np.zeros((4, 4))
    x[:, 0], x[:, 1] = 50, (0.7, 0.9, 0.7, 0.5)
    easier = SIMPLE._replace(hysteresis=0.25)
    assert apply_rules(x, SIMPLE).tolist() == [KR, RE, KR, KR]
    assert apply_rules(x, easier).tolist() == [KR, RE, RE, KR]
    x[:, 1] *= -1
    assert apply_rules(x, easier).tolist() == [KR, AP, AP, KR]
    x[:, 1], x[:, 3] = 0.0, (0.5, 0.7, -0.5, 0.4)
    assert apply_rules(x, easier).tolist() == [KR, LC, LC, KR]
    x[:, 3], x[:, 2] = 0.0, (0.7, 0.8, 0.6, 0.5)
    assert apply_rules(x, easier).tolist() == [KR, LC, LC, KR]
    x[:, 1], x[:, 2] = (0.35, 0.45, 0.35, 0.25), 0.6
    assert apply_rules(x, easier).tolist() == [KR, OV, OV, KR]


def test_dwell_waits_for_agreeing_frames():
    x = np.zeros((8, 4))
    x[:, 0], x[:, 1] = 50, (0, 1, 0, 1, -1, -1, -1, 0)
    patient = SIMPLE._replace(dwell=2)
    assert apply_rules(x, patient).tolist() == [KR, KR, KR, KR, KR, AP, AP, AP]
