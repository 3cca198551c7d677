"""Slow textbook versions: one step of filterpy's UKF, and an IMM of them in plain numpy.

The models are integrated or written out here; nothing is shared with the package.
"""

from __future__ import annotations

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from scipy.stats import multivariate_normal


def cv(p, dt):
    x, vx, y, vy, w = p
    return np.array([x + dt * vx, vx, y + dt * vy, vy, w])


def ct(p, dt):
    """Closed form with the chord: the way is straight along the mean heading."""
    x, vx, y, vy, w = p
    v, heading = np.hypot(vx, vy), np.arctan2(vy, vx)
    chord = v * dt * np.sinc(w * dt / 2 / np.pi)
    return np.array(
        [
            x + chord * np.cos(heading + w * dt / 2),
            v * np.cos(heading + w * dt),
            y + chord * np.sin(heading + w * dt / 2),
            v * np.sin(heading + w * dt),
            w,
        ]
    )


def noise(q, q_omega, dt):
    block = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    Q = np.zeros((5, 5))
    Q[:2, :2] = Q[2:4, 2:4] = block
    Q[4, 4] = q_omega * dt
    return Q


def wrapped(a):
    return np.angle(np.exp(1j * a))


def measure(p, places):
    """Range and bearing from every place, one after the other."""
    d = np.array([p[0], p[2]]) - np.asarray(places)[:, :2]
    return np.stack([np.hypot(*d.T), np.arctan2(d[:, 1], d[:, 0])], axis=1).ravel()


def filterpy_step(x, P, f, Q, dt, places=(), z=None, r=None, spread=(1.0, 0.0, 0.0)):
    """Predict and, with places, update: x, P, log likelihood (None without an update)."""
    points = MerweScaledSigmaPoints(5, *spread)
    n = max(2 * len(places), 1)

    def difference(a, b):
        d = np.atleast_1d(np.subtract(a, b)).astype(float)
        d[1::2] = wrapped(d[1::2])
        return d

    def mean(sigmas, weights):
        m = weights @ sigmas
        m[1::2] = np.arctan2(weights @ np.sin(sigmas[:, 1::2]), weights @ np.cos(sigmas[:, 1::2]))
        # a weighted mean of small deviations, like that of the other columns
        m[1::2] += weights @ wrapped(sigmas[:, 1::2] - m[1::2])
        return m

    ukf = UnscentedKalmanFilter(
        5, n, dt, lambda s: measure(s, places), f, points, z_mean_fn=mean, residual_z=difference
    )
    ukf.x, ukf.P, ukf.Q = x.copy(), P.copy(), Q
    ukf.predict()
    # sigma points that hold the process noise, whatever this version of filterpy does
    ukf.sigmas_f = points.sigma_points(ukf.x, ukf.P)
    if not len(places):
        return ukf.x, ukf.P, None
    ukf.R = np.diag(np.ravel(r))
    ukf.update(np.ravel(z))
    log_l = multivariate_normal.logpdf(ukf.y, np.zeros(n), ukf.S)
    return ukf.x, ukf.P, log_l


def imm_cycle(xs, Ps, mu, Pi, entries, steps):
    """One IMM cycle; ``steps[j](x, P)`` gives x, P and log likelihood (or None) of model j.

    ``entries[j]``: mean and variance of the turn rate of who changes to model j.
    """
    n = len(xs)
    c = [sum(Pi[i][j] * mu[i] for i in range(n)) for j in range(n)]
    new_x, new_P, log_mu = [], [], []
    for j in range(n):
        sources = []
        for i in range(n):
            x, P = np.array(xs[i]), np.array(Ps[i])
            if i != j:
                x[4] = entries[j][0]
                P[4, :] = P[:, 4] = 0.0
                P[4, 4] = entries[j][1]
            sources.append((Pi[i][j] * mu[i] / c[j], x, P))
        x, P, log_l = steps[j](*combine(sources))
        new_x.append(x)
        new_P.append(P)
        log_mu.append(np.log(c[j]) + (log_l or 0.0))
    weights = np.exp(np.array(log_mu) - max(log_mu))
    weights /= weights.sum()
    return new_x, new_P, weights, combine(list(zip(weights, new_x, new_P, strict=True)))


def combine(parts):
    mean = sum(w * x for w, x, _ in parts)
    return mean, sum(w * (P + np.outer(x - mean, x - mean)) for w, x, P in parts)
