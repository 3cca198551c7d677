"""Exact Bernoulli recursions: on a grid over (x, vx), and as a mixture of all hypotheses.

Both for sensors so placed that range, bearing and range rate are linear in the state.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import multivariate_normal, norm


def xi(T: float, k: float) -> np.ndarray:
    return k * np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]])


class Grid:
    """Point masses over (x, vx), one sensor far down the negative x axis at ``x0`` and at rest;
    bearings say nothing.  ``transition`` is the full matrix between the points."""

    def __init__(self, x, vx, T, k, x0):
        self.X, self.V = (a.ravel() for a in np.meshgrid(x, vx, indexing="ij"))
        self.x0 = x0
        points = np.stack([self.X, self.V], axis=1)
        moved = np.stack([self.X + T * self.V, self.V], axis=1)
        inverse = np.linalg.inv(xi(T, k))
        e = points[:, None, :] - moved[None, :, :]
        self.transition = np.exp(-0.5 * np.einsum("abi,ij,abj->ab", e, inverse, e))
        self.transition /= self.transition.sum(axis=0).max()
        self.p = None
        self.q = 0.0

    def step(self, z, *, p_survival, p_detection, clutter_density, std):
        """``z``: list of (range, rate); clutter_density: λ c of the bearing-free measurement."""
        q = p_survival * self.q
        p = self.transition @ self.p
        p /= p.sum()
        psi = np.full(len(p), 1.0 - p_detection)
        for r, rate in z:
            g = norm.pdf(r, self.X - self.x0, std[0]) * norm.pdf(rate, self.V, std[1])
            psi += p_detection * g / clutter_density
        mean_psi = psi @ p
        self.p = psi * p / mean_psi
        self.q = q * mean_psi / (1.0 - q + q * mean_psi)

    def moments(self):
        mean = np.array([self.X @ self.p, self.V @ self.p])
        d = np.stack([self.X, self.V]) - mean[:, None]
        return mean, (d * self.p) @ d.T


class Mixture:
    """All hypotheses (which detection was whose) as Gaussians; linear measurement z = H x + h."""

    def __init__(self, *, p_birth, p_survival, p_detection, clutter_density, T, k):
        self.p_birth, self.p_survival, self.p_detection = p_birth, p_survival, p_detection
        self.clutter_density = clutter_density
        self.F = np.kron(np.eye(2), np.array([[1.0, T], [0.0, 1.0]]))
        self.Q = np.kron(np.eye(2), xi(T, k))
        self.q = 0.0
        self.parts: list[tuple[float, np.ndarray, np.ndarray]] = []
        self.births: list[tuple[np.ndarray, np.ndarray]] = []

    def step(self, scans, births):
        """``scans``: per sensor (H, h, R, [z]); ``births``: (mean, cov) of this scan's detections,
        used in the next step."""
        p_birth = self.p_birth * (1.0 - self.q) if self.births else 0.0
        q = p_birth + self.p_survival * self.q
        parts = [(w * self.p_survival * self.q, m, P) for w, m, P in self.parts]
        parts += [(p_birth / len(self.births), m, P) for m, P in self.births]
        self.births = births
        if q == 0.0:
            return
        F, Q = self.F, self.Q
        parts = [(w / q, F @ m, F @ P @ F.T + Q) for w, m, P in parts if w > 0.0]
        for H, h, R, zs in scans:
            after = [(w * (1.0 - self.p_detection), m, P) for w, m, P in parts]
            for w, m, P in parts:
                S = H @ P @ H.T + R
                K = P @ H.T @ np.linalg.inv(S)
                for z in zs:
                    e = z - H @ m - h
                    # in standard deviations: scipy takes unlike scales for a singular matrix
                    d = np.sqrt(np.diag(S))
                    g = multivariate_normal.pdf(e / d, np.zeros(len(e)), S / np.outer(d, d))
                    g /= d.prod()
                    weight = w * self.p_detection * g / self.clutter_density
                    after.append((weight, m + K @ e, P - K @ S @ K.T))
            parts = [part for part in after if part[0] > 1e-14]
        total = sum(w for w, _, _ in parts)
        self.q = q * total / (1.0 - q + q * total)
        self.parts = [(w / total, m, P) for w, m, P in parts]

    def moments(self):
        mean = sum(w * m for w, m, _ in self.parts)
        cov = sum(w * (P + np.outer(m - mean, m - mean)) for w, m, P in self.parts)
        return mean, cov
