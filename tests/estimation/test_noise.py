"""The kernels' random numbers: the distributions, and the generator against its definition."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from scipy import stats

from can_imm.estimation import noise

MASK = 2**64 - 1


@numba.njit
def fill(out, state, normal):
    s = noise.load(state)
    for i in range(len(out)):
        if normal:
            out[i], s = noise.normal(s)
        else:
            out[i], s = noise.uniform(s)
    noise.store_(state, s)


def draw(n: int, *, normal: bool, seed: int = 1) -> np.ndarray:
    out = np.empty(n)
    fill(out, noise.noise_state(np.random.default_rng(seed)), normal)
    return out


def xoshiro256pp(s: list[int]) -> int:
    """As published, in Python's integers."""

    def rotl(x: int, k: int) -> int:
        return (x << k | x >> 64 - k) & MASK

    result = (rotl((s[0] + s[3]) & MASK, 23) + s[0]) & MASK
    t = s[1] << 17 & MASK
    s[2] ^= s[0]
    s[3] ^= s[1]
    s[1] ^= s[2]
    s[0] ^= s[3]
    s[2] ^= t
    s[3] = rotl(s[3], 45)
    return result


def test_bits_are_those_of_xoshiro():
    state = noise.noise_state(np.random.default_rng(5))
    words = [int(word) for word in state]
    out = np.empty(100)
    fill(out, state, False)
    assert out.tolist() == [(xoshiro256pp(words) >> 11) * 2.0**-53 for _ in out]
    assert [int(word) for word in state] == words


def test_normal_distribution():
    x = draw(1_000_000, normal=True)
    assert stats.kstest(x[:200_000], "norm").pvalue > 1e-3
    assert x.mean() == pytest.approx(0.0, abs=4e-3)
    assert x.var() == pytest.approx(1.0, abs=6e-3)
    assert stats.kurtosis(x) == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("edge", [2.0, 3.0, 3.6541528853610088, 4.0])
def test_tails_have_their_mass_on_both_sides(edge):
    n = 2_000_000
    x = draw(n, normal=True, seed=2)
    expected = n * stats.norm.sf(edge)
    for count in ((x > edge).sum(), (x < -edge).sum()):
        assert abs(count - expected) < 4.5 * expected**0.5


def test_successive_deviates_are_independent():
    x = draw(1_000_000, normal=True, seed=3)
    for lag in (1, 2, 3):
        assert abs(np.corrcoef(x[:-lag], x[lag:])[0, 1]) < 5e-3
        assert abs(np.corrcoef(x[:-lag] ** 2, x[lag:] ** 2)[0, 1]) < 5e-3


def test_the_generator_decides():
    assert draw(10, normal=True, seed=4).tolist() == draw(10, normal=True, seed=4).tolist()
    assert draw(10, normal=True, seed=4).tolist() != draw(10, normal=True, seed=5).tolist()
