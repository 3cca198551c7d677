"""Bernoulli particle filter: is there an object, and where?

Törő, Bécsi and Aradi (IFFK 2018), after Ristic et al. (IEEE TSP 61(13), 2013).  State x, vx, y,
vy; constant velocity with Σ_m = diag(Ξ, Ξ), Ξ = k_m [T³/3 T²/2; T²/2 T].  Recursion:

    q⁻ = p_b (1 - q) + p_s q
    s⁻ = [p_b (1 - q) b + p_s q ∫ π s] / q⁻
    1 - Δ = ∫ ψ s⁻,    q⁺ = (1 - Δ) q⁻ / (1 - Δ q⁻),    s⁺ = ψ s⁻ / (1 - Δ)

with ψ the product over the sensors of 1 - p_d + p_d Σ_z g(z|x) / (λ c), or the published sum over
the union of their detections.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from can_imm.estimation import bernoulli_kernels as kernels
from can_imm.types import CanImmError, FloatArray, IntArray


@dataclass(frozen=True)
class BernoulliModel:
    """Parameters of the filter, and of a sensor that behaves as it believes.

    Attributes:
        p_birth: probability that an object appears from one scan to the next.
        p_survival: probability that one is still there after ``period_s``.
        p_detection: probability that a sensor detects it.
        clutter: mean number of false detections per sensor and scan, λ; uniform over
            ``range_max`` [m] x 2π x ``rate_span`` [m/s] (c is one over that).
        std_range, std_bearing, std_rate: σ_d [m], σ_b [rad], σ_v [m/s].
        std_tangential: of the speed that a detection says nothing about, relative to the sensor's
            [m/s].
        density: k_m, power density of the acceleration [m²/s³].
        period_s: nominal time between scans [s].
        union: the published update over the union of all detections, not the product over sensors.

    Raises:
        CanImmError: a value that makes no sense.
    """

    p_birth: float = 0.01
    p_survival: float = 0.98
    p_detection: float = 0.95
    clutter: float = 1.0
    range_max: float = 200.0
    rate_span: float = 100.0
    std_range: float = 0.2
    std_bearing: float = math.radians(0.3)
    std_rate: float = 0.6
    std_tangential: float = 2.0
    density: float = 1.0
    period_s: float = 0.1
    union: bool = False

    def __post_init__(self) -> None:
        for name in ("p_birth", "p_survival", "p_detection"):
            value = getattr(self, name)
            # a certain detection would leave weights of 0 after a scan without one
            if not 0.0 <= value <= 1.0 or (name == "p_detection" and not 0.0 < value < 1.0):
                raise CanImmError(f"Bernoulli filter: {name} must be a probability, not {value:g}")
        for name in ("clutter", "range_max", "rate_span", "std_range", "std_bearing", "std_rate",
                     "std_tangential", "density", "period_s"):  # fmt: skip
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise CanImmError(f"Bernoulli filter: {name} must be positive, not {value:g}")

    def vector(self) -> FloatArray:
        """The parameters in the kernels' order."""
        par = np.zeros(kernels.N_PARAMETERS)
        par[kernels.P_BIRTH] = self.p_birth
        par[kernels.P_SURVIVAL] = self.p_survival
        par[kernels.P_DETECTION] = self.p_detection
        par[kernels.CLUTTER] = self.clutter
        par[kernels.RANGE_MAX] = self.range_max
        par[kernels.RATE_SPAN] = self.rate_span
        par[kernels.STD_RANGE] = self.std_range
        par[kernels.STD_BEARING] = self.std_bearing
        par[kernels.STD_RATE] = self.std_rate
        par[kernels.STD_TANGENTIAL] = self.std_tangential
        par[kernels.DENSITY] = self.density
        par[kernels.UNION] = self.union
        return par


class BernoulliFilter:
    """One object that may be there or not, followed with particles.

    Everything is allocated and compiled at construction.

    Attributes:
        q: probability that the object exists.
        mean, cov: (4,), (4, 4) of x, vx, y, vy [m, m/s], if it exists; of the last step.
        particles: (4, N_p) of equal weight, if it exists.

    Args:
        model: parameters.
        rng: randomness of the particles.
        particles: N_p, particles of the object that is followed.
        births: particles for new objects, all together; they are shared out evenly over the
            detections of the scan before, at most N_p for each.
        sensors: at most so many take part in a scan.
        capacity: at most so many detections in a scan.
    """

    def __init__(
        self,
        model: BernoulliModel,
        rng: np.random.Generator,
        *,
        particles: int = 100,
        births: int = 500,
        sensors: int = 15,
        capacity: int = 64,
    ) -> None:
        if particles < 1 or births < 1:
            raise CanImmError(
                f"Bernoulli filter: needs at least one particle, not {particles} and {births}"
            )
        self.model = model
        self.q = 0.0
        self.mean: FloatArray = np.zeros(4)
        self.cov: FloatArray = np.zeros((4, 4))
        self.particles: FloatArray = np.zeros((4, particles))
        self._rng = rng
        self._par = model.vector()
        self._max_births = births
        self._cloud: FloatArray = np.zeros((4, particles + births))
        self._weight: FloatArray = np.zeros(particles + births)
        self._work: FloatArray = np.zeros((6, kernels.BLOCK))
        self._starts: IntArray = np.zeros(sensors + 1, np.int32)
        self._n_births = 0
        self._birth_mean: FloatArray = np.zeros((capacity, 4))
        self._birth_cov: FloatArray = np.zeros((capacity, 4, 4))
        self._birth_age: FloatArray = np.zeros(capacity)
        self._warm_up(sensors, capacity)

    def _warm_up(self, sensors: int, capacity: int) -> None:
        """Compile, or load from the cache, what `step` calls; leaves no trace."""
        state = self._rng.bit_generator.state
        self.step(0.1, np.zeros((sensors, 5))[:1], np.zeros(sensors)[:1],
                  np.zeros(capacity, np.int32)[:1], np.full((capacity, 3), 10.0)[:1])  # fmt: skip
        self.forget()
        self._rng.bit_generator.state = state

    def forget(self) -> None:
        """Begin anew: no object, and no detections from which one could be born."""
        self.q = 0.0
        self._n_births = 0

    def step(
        self, dt: float, pose: FloatArray, delay: FloatArray, sensor: IntArray, z: FloatArray
    ) -> bool:
        """Predict by ``dt`` seconds and update with one scan.

        Args:
            dt: time since the last scan [s], 0 or more.
            pose: (S, 5) poses of the sensors that looked, as in `types.DetectionScan`.
            delay: (S,) how long after the scan's time they did [s].
            sensor: (n,) row of the sensor of each detection, ascending.
            z: (n, 3) range, bearing, range rate or NaN; finite and possible otherwise.

        Returns:
            Whether there is a finite result; if not, the filter begins anew.
        """
        sensors, n = len(pose), len(z)
        starts = self._starts[: sensors + 1]
        starts[:] = np.searchsorted(sensor, np.arange(sensors + 1))
        par = self._par
        survival = self.model.p_survival ** (dt / self.model.period_s)
        status, self.q = kernels.step_(
            self.q, dt, survival, self.particles, self._n_births, self._birth_mean,
            self._birth_cov, self._birth_age, self._max_births, pose, delay, starts, z, par,
            self._cloud, self._weight, self._work, self.mean, self.cov, self._rng,
        )  # fmt: skip
        if status != kernels.OK:
            self.forget()
            return False
        for m in range(n):
            s = sensor[m]
            kernels.birth_density_(z[m], pose[s], par, self._birth_mean[m], self._birth_cov[m])
            self._birth_age[m] = -delay[s]
        self._n_births = n
        return True
