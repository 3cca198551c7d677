"""Motion models and transition tables against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_imm.estimation.models import (
    discretise,
    generator_from_dwell,
    generator_from_matrix,
    repeat,
    stationary,
    transition_table,
)

# Table 2 of the paper, row = from
TABLE_2 = np.array(
    [
        [0.90, 0.02, 0.00, 0.00, 0.04, 0.04, 0.00],
        [0.01, 0.90, 0.01, 0.08, 0.00, 0.00, 0.00],
        [0.00, 0.02, 0.90, 0.00, 0.04, 0.04, 0.00],
        [0.00, 0.10, 0.10, 0.80, 0.00, 0.00, 0.00],
        [0.05, 0.00, 0.05, 0.00, 0.90, 0.00, 0.00],
        [0.05, 0.00, 0.05, 0.00, 0.00, 0.80, 0.10],
        [0.00, 0.00, 0.00, 0.00, 0.10, 0.10, 0.80],
    ]
)


@given(st.floats(1e-3, 2.0), st.floats(1e-3, 10.0))
def test_white_noise_acceleration(dt: float, q: float) -> None:
    F, Q = discretise(np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, q]), dt)
    np.testing.assert_allclose(F, [[1.0, dt], [0.0, 1.0]], atol=1e-12)
    expected = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    np.testing.assert_allclose(Q, expected, rtol=1e-9, atol=1e-15)


@given(st.floats(0.01, 1.0), st.floats(0.3, 5.0), st.floats(0.1, 3.0))
def test_singer(dt: float, tau: float, sigma: float) -> None:
    """Singer (1970): the closed form in Bar-Shalom, Li, Kirubarajan (2001), section 8.2."""
    a = 1.0 / tau
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -a]])
    F, Q = discretise(A, np.diag([0.0, 0.0, 2.0 * a * sigma**2]), dt)
    u = a * dt
    e = np.exp(-u)
    np.testing.assert_allclose(
        F,
        [[1.0, dt, (u - 1.0 + e) / a**2], [0.0, 1.0, (1.0 - e) / a], [0.0, 0.0, e]],
        rtol=1e-8,
        atol=1e-12,
    )
    q11 = (1.0 - e**2 + 2.0 * u + 2.0 * u**3 / 3.0 - 2.0 * u**2 - 4.0 * u * e) / (2.0 * a**5)
    q12 = (e**2 + 1.0 - 2.0 * e + 2.0 * u * e - 2.0 * u + u**2) / (2.0 * a**4)
    q13 = (1.0 - e**2 - 2.0 * u * e) / (2.0 * a**3)
    q22 = (4.0 * e - 3.0 - e**2 + 2.0 * u) / (2.0 * a**3)
    q23 = (e**2 + 1.0 - 2.0 * e) / (2.0 * a**2)
    q33 = (1.0 - e**2) / (2.0 * a)
    expected = np.array([[q11, q12, q13], [q12, q22, q23], [q13, q23, q33]])
    # the closed form itself loses digits to cancellation where dt is small against tau
    scale = 2.0 * a * sigma**2
    np.testing.assert_allclose(Q, scale * expected, rtol=1e-6, atol=1e-12 * scale / a**5)


def test_tables_over_steps_are_a_semigroup() -> None:
    rng = np.random.default_rng(0)
    A, W = rng.normal(size=(3, 3)), np.diag([0.1, 0.0, 2.0])
    F1, Q1 = discretise(A, W, 0.01)
    F, Q = repeat(F1, Q1, 30)
    np.testing.assert_array_equal(F[0], np.eye(3))
    np.testing.assert_array_equal(Q[0], np.zeros((3, 3)))
    for a, b in ((1, 1), (3, 5), (12, 17), (0, 9)):
        np.testing.assert_allclose(F[a + b], F[b] @ F[a], atol=1e-12)
        np.testing.assert_allclose(Q[a + b], F[b] @ Q[a] @ F[b].T + Q[b], atol=1e-12)
    direct_F, direct_Q = discretise(A, W, 0.29)
    np.testing.assert_allclose(F[29], direct_F, atol=1e-12)
    np.testing.assert_allclose(Q[29], direct_Q, atol=1e-12)


def test_the_generator_of_table_2() -> None:
    G = generator_from_matrix(TABLE_2, 0.1)
    np.testing.assert_allclose(G.sum(axis=1), 0.0, atol=1e-12)
    assert (G - np.diag(np.diag(G)) >= 0.0).all()
    Pi = transition_table(G, 0.01, 11)[10]
    assert 1e-4 < np.abs(Pi - TABLE_2).max() <= 0.008, "Table 2 has no exact generator"
    np.testing.assert_allclose(Pi.sum(axis=1), 1.0, rtol=1e-14)


def test_an_embeddable_matrix_gives_its_generator_back() -> None:
    G = np.array([[-0.5, 0.4, 0.1], [1.0, -1.2, 0.2], [0.0, 3.0, -3.0]])
    Pi = transition_table(G, 0.1, 2)[1]
    np.testing.assert_allclose(generator_from_matrix(Pi, 0.1), G, atol=1e-10)


def test_generator_from_dwell_times() -> None:
    weights = [[9.0, 1.0, 3.0], [2.0, 0.0, 0.0], [1.0, 1.0, 5.0]]
    G = generator_from_dwell(np.array([2.0, 0.5, 4.0]), np.array(weights))
    expected = [[-0.5, 0.125, 0.375], [2.0, -2.0, 0.0], [0.125, 0.125, -0.25]]
    np.testing.assert_allclose(G, expected, atol=1e-15)


def test_transition_tables_compose() -> None:
    Pi = transition_table(generator_from_matrix(TABLE_2, 0.1), 0.01, 40)
    np.testing.assert_array_equal(Pi[0], np.eye(7))
    for a, b in ((1, 1), (7, 3), (10, 20), (39, 0)):
        np.testing.assert_allclose(Pi[a] @ Pi[b], Pi[a + b], atol=1e-13)
    assert (Pi >= 0.0).all()


def test_time_in_a_mode_is_its_dwell_time() -> None:
    """To first order a mode is left with probability step / dwell time."""
    G = generator_from_dwell(np.array([2.0, 5.0]), np.ones((2, 2)))
    Pi = transition_table(G, 1e-4, 2)[1]
    np.testing.assert_allclose(1.0 - np.diag(Pi), [1e-4 / 2.0, 1e-4 / 5.0], rtol=1e-3)


def test_stationary() -> None:
    Pi = np.array([[0.9, 0.1], [0.3, 0.7]])
    np.testing.assert_allclose(stationary(Pi), [0.75, 0.25], rtol=1e-12)
    mu = stationary(TABLE_2)
    np.testing.assert_allclose(mu @ TABLE_2, mu, atol=1e-12)
    assert mu.sum() == pytest.approx(1.0)
    assert (mu > 0.0).all()
