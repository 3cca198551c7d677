"""Whole lane changes by hindsight, against all hypotheses written out with dense Gaussians."""

from __future__ import annotations

import itertools
import math
from functools import cache

import numpy as np
import pytest

from can_imm.estimation import lane_changes as lc
from can_imm.types import FloatArray

WIDTH, BESIDE = 3.5, 0.3


def way(u: FloatArray) -> FloatArray:
    """Share of the way done at the share u of the time."""
    u = np.clip(u, 0.0, 1.0)
    return 0.5 * (6 * u**5 - 15 * u**4 + 10 * u**3) + 0.5 * (3 * u**2 - 2 * u**3)


def covariance(t: FloatArray) -> FloatArray:
    """Of the places and rates (2 K, 2 K) of a Matern 3/2 process at times t (K,)."""
    a = lc.HURRY
    tau = t[:, None] - t[None, :]
    fade = BESIDE**2 * np.exp(-a * abs(tau))
    both = fade * a**2 * tau
    return np.block(
        [[fade * (1.0 + a * abs(tau)), both], [both.T, fade * a**2 * (1 - a * abs(tau))]]
    )


def written_out(t: FloatArray, y: FloatArray, vy: FloatArray | None) -> FloatArray:
    """Probability (K, 2) of changing to the left and right: none or one change, from any lane."""
    n = len(t)
    noise = np.repeat([0.2**2, 0.3**2], n)
    z = np.concatenate((y, np.zeros(n) if vy is None else vy))
    used = np.arange(2 * n if vy is not None else n)
    inverse = np.linalg.inv((covariance(t) + np.diag(noise))[np.ix_(used, used)])

    def log_likelihood(mean: FloatArray) -> float:
        e = (z - mean)[used]
        return -0.5 * float(e @ inverse @ e)

    durations = lc.SHORTEST * (lc.LONGEST / lc.SHORTEST) ** np.linspace(0.0, 1.0, lc.N_DURATIONS)
    p = np.exp(-0.5 * (np.log(durations / lc.USUAL) / lc.SPREAD) ** 2)
    p /= p.sum()
    stay = np.concatenate(([0.0], np.cumsum(np.log1p(-lc.RATE * np.diff(t)))))
    rows: list[FloatArray] = []
    weights: list[float] = []

    def add(mean: FloatArray, log_prior: float, during: FloatArray, side: int) -> None:
        weights.append(log_prior + log_likelihood(mean))
        rows.append(np.stack([during * (side > 0), during * (side < 0)], axis=1))

    for lane in range(-2, 3):
        add(np.repeat([lane * WIDTH, 0.0], n), stay[-1], np.zeros(n), 1)
        for side, (duration, share) in itertools.product((1, -1), zip(durations, p, strict=True)):
            begins = [(k, 0.5 * (t[k] + t[k - 1]), t[k] - t[k - 1]) for k in range(1, n)]
            begins += [
                (0, t[0] - (b + 0.5) / lc.N_BEGUN * duration, duration / lc.N_BEGUN)
                for b in range(lc.N_BEGUN)
            ]
            for first, start, span in begins:
                u = (t - start) / duration
                small = 1e-6
                slope = (way(u + small) - way(u - small)) / (2.0 * small * duration)
                mean = np.concatenate((WIDTH * (lane + side * way(u)), WIDTH * side * slope))
                during = ((np.arange(n) >= first) & (u < 1.0)).astype(float)
                arrived = np.flatnonzero(u >= 1.0)
                later = stay[-1] - stay[max(arrived[0] - 1, 0)] if len(arrived) else 0.0
                log_prior = stay[max(first - 1, 0)] + math.log(0.5 * lc.RATE * span * share)
                add(mean, log_prior + later, during, side)
    w = np.exp(np.array(weights) - max(weights))
    return np.asarray(np.einsum("h,hks->ks", w / w.sum(), np.array(rows)))


def found(
    t: FloatArray, y: FloatArray, vy: FloatArray | None, beside: float = BESIDE
) -> FloatArray:
    n = len(t)
    p = np.zeros((n, 2))
    rv = np.full(n, np.inf if vy is None else 0.3**2)
    speed = np.zeros(n) if vy is None else vy
    lc.find_lane_changes_(t, y, np.full(n, 0.2**2), speed, rv, np.full(n, beside), WIDTH, p)
    return p


@cache
def beside(t: bytes) -> FloatArray:
    """Root of the `covariance` at times t (K,)."""
    both = covariance(np.frombuffer(t))
    return np.linalg.cholesky(both + 1e-9 * np.eye(len(both)))


def drive(
    rng: np.random.Generator, t: FloatArray, lane: int, side: int, start: float, duration: float
) -> tuple[FloatArray, FloatArray]:
    """Measured places and speeds of a vehicle that changes lanes once (side 0: not at all)."""
    wander = (beside(t.tobytes()) @ rng.standard_normal(2 * len(t))).reshape(2, -1)
    u = (t - start) / duration
    slope = (way(u + 1e-6) - way(u - 1e-6)) / (2e-6 * duration)
    y = WIDTH * (lane + side * way(u)) + wander[0] + 0.2 * rng.standard_normal(len(t))
    return y, WIDTH * side * slope + wander[1] + 0.3 * rng.standard_normal(len(t))


@pytest.mark.parametrize("with_speed", [True, False])
@pytest.mark.parametrize(
    ("lane", "side", "start"), [(0, 1, 2.0), (1, -1, 3.0), (0, 0, 0.0), (0, 1, -2.5), (-1, -1, 5.5)]
)
def test_it_is_what_all_hypotheses_say(
    lane: int, side: int, start: float, with_speed: bool
) -> None:
    rng = np.random.default_rng([lane + 1, side + 1])
    t = np.arange(40) * 0.2 + rng.uniform(0.0, 0.05, 40)
    y, vy = drive(rng, t, lane, side, start, 4.2)
    expected = written_out(t, y, vy if with_speed else None)
    p = found(t, y, vy if with_speed else None)
    # courses are merged, but only when they have settled; two changes are possible, but rare
    assert abs(p - expected).max() < (0.03 if with_speed else 0.1)
    assert abs(p - expected).mean() < (0.002 if with_speed else 0.01)
    if side and (with_speed or start > 0.0):
        middle = np.argmin(abs(t - max(start + 2.1, 0.3)))
        assert p[middle, 0 if side > 0 else 1] > 0.9


@pytest.mark.parametrize("second", [1, -1])
@pytest.mark.parametrize("pause", [0.0, 0.3, 0.8, 2.0])
def test_another_one_right_after_the_first(pause: float, second: int) -> None:
    """On to the lane after next, or back again."""
    rng = np.random.default_rng(3)
    t = np.arange(210) / 14.0
    right: list[float] = []
    for _ in range(8):
        begin, lasts = rng.uniform(3.0, 4.0), rng.uniform(3.0, 4.0, 2)
        again = begin + lasts[0] + pause
        y, vy = drive(rng, t, 0, 1, begin, lasts[0])
        u = (t - again) / lasts[1]
        y = y + second * WIDTH * way(u)
        vy = vy + second * WIDTH * (way(u + 1e-6) - way(u - 1e-6)) / (2e-6 * lasts[1])
        p = found(t, y, vy)
        first = (t >= begin) & (t < begin + lasts[0])
        then = (t >= again) & (t < again + lasts[1])
        side = 0 if second > 0 else 1
        said = np.where((p > 0.5).any(axis=1), p.argmax(axis=1), -1)
        right.append(float(np.mean(said == np.where(first, 0, np.where(then, side, -1)))))
    assert np.mean(right) > 0.94
    assert min(right) > 0.88


def test_onset_and_end_to_a_fifth_of_a_second() -> None:
    """Many changes at 14 Hz: where the probability passes one half, and how often that is right."""
    rng = np.random.default_rng(2)
    t = np.arange(200) / 14.0
    errors, stretches, p_all, truth = [], [], [], []
    for _ in range(40):
        start, duration = rng.uniform(3.0, 7.0), rng.uniform(3.0, 6.0)
        side = int(rng.choice((-1, 1)))
        y, vy = drive(rng, t, 0, side, start, duration)
        p = found(t, y, vy)[:, 0 if side > 0 else 1]
        edges = np.flatnonzero(np.diff(p > 0.5))
        stretches.append(len(edges))
        errors.append((t[edges[0]] - start, t[edges[1]] - start - duration))
        p_all.append(p)
        truth.append((t >= start) & (t < start + duration))
    assert np.mean(np.array(stretches) == 2) > 0.95, "one connected stretch"
    assert np.abs(errors).mean() < 0.2
    assert np.abs(np.mean(errors, axis=0)).max() < 0.12, "neither late nor early"
    p, changing = np.concatenate(p_all), np.concatenate(truth)
    for low, high in itertools.pairwise((0.05, 0.35, 0.65, 0.95)):
        unsure = (p > low) & (p <= high)
        assert abs(p[unsure].mean() - changing[unsure].mean()) < 0.15


def test_two_changes_in_a_row() -> None:
    rng = np.random.default_rng(4)
    t = np.arange(220) / 14.0
    u, w = (t - 2.0) / 4.0, (t - 8.0) / 5.0
    p = found(t, WIDTH * (way(u) + way(w)) + 0.2 * rng.standard_normal(220), None)
    assert p[(t > 2.6) & (t < 5.4), 0].min() > 0.5
    assert p[(t > 6.6) & (t < 7.4), 0].max() < 0.5
    assert p[(t > 8.8) & (t < 12.2), 0].min() > 0.5
    assert p[:, 1].max() < 0.05


def test_a_single_row_and_outliers() -> None:
    p = found(np.array([3.0]), np.array([0.1]), np.array([0.0]))
    assert p.min() >= 0.0
    assert p.sum() < 0.3
    rng = np.random.default_rng(1)
    t = np.arange(100) / 14.0
    y, vy = drive(rng, t, 0, 0, 0.0, 4.0)
    y[50] += 3.0
    assert found(t, y, vy).max() < 0.3
