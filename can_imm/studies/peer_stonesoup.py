"""The detector's work done with Stone Soup: what `bench` compares with where it is installed.

Stone Soup has no IMM of Kalman filters.  This is one made of what it has, `KalmanPredictor` and
`KalmanUpdater`, with the interaction and the probabilities of the modes in numpy; constraints as in
`peer`.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.stats import multivariate_normal
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.array import CovarianceMatrix, StateVector
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import KalmanUpdater

from can_imm.manoeuvres import ModeBank
from can_imm.studies.peer import LEAST_LIKELIHOOD, Constraint
from can_imm.types import FloatArray


class SoupFilter:
    """One Gaussian mode; arguments as for `peer.ConstrainedFilter`.

    Attributes:
        x, P: (n,), (n, n) the state.
    """

    def __init__(
        self, bank: ModeBank, j: int, steps: int, seen: list[int], variance: FloatArray
    ) -> None:
        record, n = bank.record[0], bank.n_states
        model = LinearGaussianTimeInvariantTransitionModel(
            transition_matrix=record["F"][steps, j, :n, :n].copy(),
            covariance_matrix=CovarianceMatrix(record["Q"][steps, j, :n, :n].copy()),
        )
        self._predictor = KalmanPredictor(model)
        self._measured = LinearGaussian(n, seen, CovarianceMatrix(np.diag(variance)))
        self._updater = KalmanUpdater(self._measured)
        self._constraint = constraint = Constraint(bank, j)
        self._soft = LinearGaussian(
            n, constraint.soft_state.tolist(), CovarianceMatrix(np.diag(constraint.soft_variance))
        )
        self.x: FloatArray = np.zeros(n)
        self.P: FloatArray = np.eye(n)

    def predict(self) -> None:
        """To the next measurement."""
        state = self._predictor.predict(GaussianState(self.x[:, None], self.P))
        self.x, self.P = _arrays(state)

    def update(self, z: FloatArray) -> float:
        """Soft rows as pseudo-measurements, the measurement, the bounds; the log likelihood."""
        constraint = self._constraint
        if len(constraint.soft_state):
            self._update(self._soft, constraint.soft(self.x))
        bounds = constraint.bounds(self.x)
        before = constraint.truncated(self.x, self.P, bounds)[2]
        log_l = self._update(self._measured, z)
        self.x, self.P, after = constraint.applied(self.x, self.P, bounds)
        return max(log_l + after - before, math.log(LEAST_LIKELIHOOD))

    def _update(self, model: LinearGaussian, z: FloatArray) -> float:
        prior = GaussianState(self.x[:, None], self.P)
        expected = self._updater.predict_measurement(prior, model)
        detection = Detection(StateVector(z), measurement_model=model)
        self.x, self.P = _arrays(self._updater.update(SingleHypothesis(prior, detection, expected)))
        return float(multivariate_normal.logpdf(z, expected.mean.ravel(), expected.covar))


class SoupImm:
    """IMM over the Gaussian modes of a bank; arguments as for `peer.imm_peer`.

    Attributes:
        x, P: (n,), (n, n) the combined estimate.  mu: (M,) probabilities of the modes.
    """

    def __init__(
        self, bank: ModeBank, steps: int, seen: list[int], variance: FloatArray, x: FloatArray
    ) -> None:
        record, m, n = bank.record[0], len(bank.modes), bank.n_states
        self._filters = [SoupFilter(bank, j, steps, seen, variance) for j in range(m)]
        for f in self._filters:
            f.x, f.P = x.copy(), np.diag(record["birth_std"][:n] ** 2)
        self._Pi: FloatArray = record["Pi"][steps, :m, :m].copy()
        mu = record["mu0"][:m] + 1e-3
        self.mu: FloatArray = mu / mu.sum()
        self._prior: FloatArray = self.mu @ self._Pi
        self.x, self.P = x.copy(), self._filters[0].P.copy()

    def predict(self) -> None:
        """Interaction, and every filter to the next measurement."""
        self._prior = self.mu @ self._Pi
        w = self._Pi * self.mu[:, None] / self._prior
        xs = np.array([f.x for f in self._filters])
        Ps = np.array([f.P for f in self._filters])
        for j, f in enumerate(self._filters):
            f.x, f.P = _mixture(w[:, j], xs, Ps)
            f.predict()

    def update(self, z: FloatArray) -> None:
        """Every filter, the probabilities of the modes, the combined estimate."""
        log_l = np.array([f.update(z) for f in self._filters])
        mu = self._prior * np.exp(log_l - log_l.max())
        self.mu = mu / mu.sum()
        self.x, self.P = _mixture(
            self.mu, np.array([f.x for f in self._filters]), np.array([f.P for f in self._filters])
        )


def _arrays(state: GaussianState) -> tuple[FloatArray, FloatArray]:
    return np.asarray(state.mean).ravel(), np.asarray(state.covar)


def _mixture(w: FloatArray, xs: FloatArray, Ps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean (n,) and covariance (n, n) of Gaussians xs (M, n), Ps (M, n, n) with weights w (M,)."""
    x = w @ xs
    d = xs - x
    return x, np.tensordot(w, Ps, 1) + (w[:, None] * d).T @ d
