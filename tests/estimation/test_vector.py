"""Our elementary functions against numpy's."""

from __future__ import annotations

import numba
import numpy as np

from can_imm.estimation.vector import fast_angle, fast_exp, fast_log


@numba.njit
def _exp(x, out):
    for i in range(len(x)):
        out[i] = fast_exp(x[i])


@numba.njit
def _log(x, out):
    for i in range(len(x)):
        out[i] = fast_log(x[i])


@numba.njit
def _angle(s, c, out):
    for i in range(len(s)):
        out[i] = fast_angle(s[i], c[i])


def test_exp():
    x = np.concatenate([np.linspace(-700, 700, 20_001), np.linspace(-1, 1, 2001), [0.0]])
    out = np.empty_like(x)
    _exp(x, out)
    np.testing.assert_allclose(out, np.exp(x), rtol=2e-14)
    assert out[-1] == 1.0
    _exp(np.array([-1e4]), out)
    assert out[0] == np.exp(-700.0)


def test_log():
    x = np.concatenate([np.exp(np.linspace(-700, 700, 20_001)), np.linspace(0.5, 2.0, 2001), [1.0]])
    out = np.empty_like(x)
    _log(x, out)
    np.testing.assert_allclose(out, np.log(x), rtol=1e-14, atol=1e-15)
    assert out[-1] == 0.0


def test_angle():
    angle = np.concatenate([np.linspace(-np.pi, np.pi, 10_001), [0.0, np.pi, np.pi / 2, 1e-12]])
    s, c = np.sin(angle), np.cos(angle)
    out = np.empty_like(angle)
    _angle(s, c, out)
    np.testing.assert_allclose(out, np.abs(np.arctan2(s, c)), atol=5e-11)
    _angle(np.array([0.0, 0.0]), np.array([-1.0, 1.0]), out)
    np.testing.assert_allclose(out[:2], [np.pi, 0.0], atol=1e-10)
