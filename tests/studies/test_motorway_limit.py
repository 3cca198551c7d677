"""How soon lane changes can be noticed, against draws and against tests made of what is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from can_imm.sim.motorway import REPORTING, LaneChange, published
from can_imm.sim.radar import RADARS
from can_imm.studies.motorway_limit import (
    LASTING,
    PER_HOUR,
    course,
    divergence,
    error_covariance,
    least_delays,
    most_found,
    wander_covariance,
)
from can_imm.studies.motorway_metrics import lane_changes
from can_imm.studies.motorway_runs import play_motorway

CHANGE = LaneChange(start=1.0, time=3.0, shift=3.6, mix=0.3)


def drawn(covariance, n, rng):
    return rng.multivariate_normal(np.zeros(len(covariance)), covariance, n, method="cholesky")


def test_the_course_is_that_of_the_simulation():
    t = np.linspace(0.0, 5.0, 501)
    y, vy = course(CHANGE, t).reshape(-1, 2).T
    assert [y[0], vy[0], y[-1], vy[-1]] == pytest.approx([0.0, 0.0, 3.6, 0.0], abs=1e-9)
    np.testing.assert_allclose(np.gradient(y, t)[2:-2], vy[2:-2], atol=5e-3)


def test_no_test_finds_more():
    """Likelihood ratios of draws, with a threshold from draws without a lane change."""
    rng = np.random.default_rng(0)
    t = np.arange(20) * 0.1
    zero = np.zeros(20)
    covariance = error_covariance(t, zero, zero, RADARS["can_imm"], 3.0)
    covariance += wander_covariance(t, 0.04, (5.0, 20.0))
    shift = course(LaneChange(start=0.35, time=3.0, shift=3.6, mix=0.3), t)
    for d in (0.5, 0.7, 0.9):
        n = 2 * (int(d / 0.1) + 5)
        part = covariance[:n, :n]
        law = multivariate_normal(np.zeros(n), part)
        kept = drawn(part, 200_000, rng)
        changed = drawn(part, 20_000, rng) + shift[:n]

        def log_ratio(z, law=law, n=n):
            return law.logpdf(z - shift[:n]) - law.logpdf(z)

        false = (d + LASTING) * PER_HOUR / 3600.0
        bound = most_found(divergence(shift[:n], part)[-1:], np.array([d]))[0]
        threshold = np.quantile(log_ratio(kept), 1.0 - false)
        found = np.mean(log_ratio(changed) > threshold)
        assert 0.02 < bound < 0.98
        assert found == pytest.approx(bound, abs=0.03)
        # the optimal test for the last speed alone finds no more
        slow = np.mean(changed[:, -1] > np.quantile(kept[:, -1], 1.0 - false))
        assert slow <= bound + 0.01


def test_nothing_is_learnt_from_nothing():
    """Then a lane change is said as often as a false one."""
    until = np.array([0.0, 1.0, 10.0])
    np.testing.assert_allclose(
        most_found(np.zeros(3), until), (until + LASTING) * PER_HOUR / 3600.0
    )


def test_wander_is_that_of_the_drivers():
    """Sines of random periods and phases, as a driver of the simulation has them."""
    rng = np.random.default_rng(1)
    t = np.array([0.0, 0.7, 3.0, 8.0])
    period = rng.uniform(5.0, 20.0, (200_000, 1))
    phase = rng.uniform(0.0, 2.0 * np.pi, (200_000, 1))
    omega = 2.0 * np.pi / period
    std = 0.2
    y = std * np.sqrt(2.0) * np.sin(omega * t + phase)
    vy = std * np.sqrt(2.0) * omega * np.cos(omega * t + phase)
    both = np.stack([y, vy], axis=2).reshape(len(y), -1)
    np.testing.assert_allclose(
        both.T @ both / len(both), wander_covariance(t, std**2, (5.0, 20.0)), atol=4e-4
    )


@pytest.mark.parametrize("profile", ["ars408", "toyota"])
def test_errors_are_those_of_the_radar(profile):
    """White ones, one of each track, one of the bearing that all share: in the simulated drive."""
    radar = RADARS[profile]
    settings = replace(published(REPORTING), duration=60.0, noise=1.3)
    products = []
    for seed in range(2000, 2002):
        run = play_motorway(profile, seed, settings)
        z = np.concatenate([scan.z[: scan.n] for scan in run.scans])
        for track in run.tracks:
            t = run.t_ns[track] * 1e-9
            x, y = run.state[track][:, [0, 2]].T
            error = (z[track] - run.state[track])[:, 2]
            for first in range(0, len(track) - 30, 10):
                part = slice(first, first + 30, 6)
                expected = error_covariance(t[part], x[part], y[part], radar, settings.noise)
                products.append((np.outer(error[part], error[part]), expected[::2, ::2]))
    found, expected = np.mean(products, axis=0)
    # quantisation comes on top
    found -= np.eye(5) * {"ars408": 0.2, "toyota": 0.04}[profile] ** 2 / 12.0
    np.testing.assert_allclose(found, expected, atol=0.2 * expected.max())


def test_a_polar_radar_sees_speeds_across_beside_it():
    """The covariance of what is read from bearing, range and range rate by least squares."""
    radar = RADARS["esr"]
    x, y, vx, vy, h = 30.0, 8.0, 4.0, 1.0, 1e-6

    def measured(y, vy):
        r = np.hypot(x, y)
        return np.array([r, (x * vx + y * vy) / r, np.arctan2(y, x)])

    slopes = np.column_stack(
        [
            (measured(y + h, vy) - measured(y - h, vy)) / (2.0 * h),
            (measured(y, vy + h) - measured(y, vy - h)) / (2.0 * h),
        ]
    )
    # that y changes the range rate, too, tells next to nothing
    slopes[1, 0] = 0.0
    white = np.linalg.inv(slopes.T @ np.diag(1.0 / np.square(radar.std)) @ slopes)
    one = np.array([0.0])
    np.testing.assert_allclose(
        error_covariance(one, one + x, one + y, radar, 1.0), white, rtol=0.08
    )


def test_more_noise_takes_longer():
    settings = published(REPORTING)
    run = play_motorway("ars408", 2001, settings)
    radar = RADARS["ars408"]
    least = least_delays(run, radar, settings)
    counted = [
        (begin, end)
        for track in run.tracks
        if not run.second[track[0]]
        for begin, end in lane_changes(run, track)
        if begin > 0
    ]
    assert len(least) == len(counted) >= 3
    assert all(0.0 <= one < 0.2 for one in least)
    noisy = least_delays(run, radar, replace(settings, noise=3.0))
    assert all(a > b for a, b in zip(noisy, least, strict=True))


def test_one_who_knows_it_all_is_as_fast():
    """A sequential test on lane changes of one kind, at a constant rate, with white errors: it
    makes up one per hour, and is slower than the limit, but not by much."""
    rng = np.random.default_rng(2)
    period, n = 0.1, 36_000
    std = np.array([0.2, 0.3])
    rate = 1.2
    change = LaneChange(start=-0.5 * period, time=3.0, shift=3.6, mix=0.0, steady=True)
    t = np.arange(30) * period
    shift = course(change, t).reshape(-1, 2)

    def score(z):
        """The greatest log-likelihood ratio of a change that began up to 10 scans ago."""
        best = np.full(len(z), -np.inf)
        for age in range(1, 11):
            ahead = shift[:age]
            single = [
                (np.roll(z, age - 1 - k, axis=0) @ (ahead[k] / std**2))
                - 0.5 * np.sum((ahead[k] / std) ** 2)
                for k in range(age)
            ]
            best = np.maximum(best, np.sum(single, axis=0))
        return best

    kept = score(rng.standard_normal((10 * n, 2)) * std)
    # one per hour: in ten hours the ten highest
    threshold = np.sort(kept)[-10]
    delays = []
    for _ in range(1000):
        z = rng.standard_normal((40, 2)) * std
        z[10:] += shift
        said = np.flatnonzero(score(z)[10:] > threshold)
        delays.append(said[0] * period)
    covariance = np.diag(np.tile(std**2, 30))
    found = most_found(divergence(shift.ravel(), covariance), t)
    limit = float((1.0 - found[:-1]) @ np.diff(t))
    assert limit <= np.mean(delays) <= limit + 0.08
    assert rate == pytest.approx(shift[0, 1])
