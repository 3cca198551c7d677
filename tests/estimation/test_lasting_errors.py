"""Errors of the measured places that last, against Gaussian regression with dense matrices."""

from __future__ import annotations

import math

import numpy as np
import pytest
from small_roads import Traffic, parameters

from can_imm.estimation import traffic as tr
from can_imm.types import FloatArray, LastingErrors

LEVEL, HURRY, STD, DT, SPEED = 0.25, 0.5, 0.08, 0.05, 25.0
ERRORS = LastingErrors(0.2, 0.4, 0.004, 1.0, 0.01, 1.5, period_s=DT)
X = np.array([30.0, 60.0, 90.0])
"""Vehicles ahead of the ego [m], which keep its lane."""


def known_road() -> FloatArray:
    """Nothing is to be learnt of road and ego, all wander by `LEVEL`, nobody changes lanes."""
    names = (
        "width_std", "offset_std", "heading_std", "turn_std", "curvature_std", "bias_std",
        "mounting_std", "yaw_noise", "drift",
    )  # fmt: skip
    return parameters(
        **dict.fromkeys(names, 1e-7), beside_std=LEVEL, beside_spread=0.001, beside_rate=HURRY,
        change_rate=1e-12,
    )  # fmt: skip


def gauss_markov(t: FloatArray, std: float, lasts: float) -> FloatArray:
    return std**2 * np.exp(-abs(t[:, None] - t) / lasts)


def own_errors(t: FloatArray, x: float, since: float, errors: LastingErrors) -> FloatArray:
    """Covariance of a vehicle's own error: what it begins with, and what comes, fade from scan to
    scan; while the track is new, as its first error does."""
    n = len(t)
    lower = np.zeros((n, n))
    for k in range(n):
        if k == 0:
            lower[0, 0] = math.hypot(errors.std, errors.new_std * x)
            continue
        dt = t[k] - t[k - 1]
        new = t[k] - since < tr.NEW_TIMES * errors.new_s
        lower[k] = math.exp(-dt / (errors.new_s if new else errors.lasting_s)) * lower[k - 1]
        lower[k, k] = errors.std * math.sqrt(1.0 - math.exp(-2.0 * dt / errors.lasting_s))
    return np.asarray(lower @ lower.T)


def regression(
    t: FloatArray, z: FloatArray, errors: LastingErrors | None
) -> tuple[FloatArray, FloatArray]:
    """Places beside their lane (vehicles,) at the last time, and their covariance, by all
    measurements z (K, vehicles)."""
    n, vehicles = z.shape
    tau = HURRY * abs(t[:, None] - t)
    wander = LEVEL**2 * (1.0 + tau) * np.exp(-tau)
    S = np.kron(np.eye(vehicles), wander + STD**2 * np.eye(n))
    if errors is not None:
        bearing = gauss_markov(t, errors.bearing_std, errors.bearing_s)
        S += np.kron(np.outer(X, X), bearing)
        for g, x in enumerate(X):
            rows = slice(g * n, (g + 1) * n)
            S[rows, rows] += own_errors(t, x, t[0], errors)
    C = np.kron(np.eye(vehicles), wander[-1:])
    weight = np.linalg.solve(S, C.T).T
    return weight @ z.T.ravel(), LEVEL**2 * np.eye(vehicles) - weight @ C.T


def measured(seed: int, n: int) -> FloatArray:
    """A shared error and noise, as large as may be."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(n)
    shared = 0.004 * np.sin(2.0 * t)[:, None] * X
    return np.asarray(shared + 0.1 * rng.standard_normal((n, len(X))))


@pytest.mark.parametrize("errors", [None, ERRORS, ERRORS._replace(new_std=0.0)])
@pytest.mark.parametrize("n", [1, 7, 120])
def test_where_vehicles_are(n: int, errors: LastingErrors | None) -> None:
    traffic = Traffic(known_road())
    z = measured(n, n)
    for row in z:
        traffic.scan(
            range(3), np.column_stack((X, row)), dt=DT, speed=SPEED, yaw_rate=0.0, std=STD,
            speeds=False, lasting=errors,
        )  # fmt: skip
    T = traffic.filter
    slots = T["party"]["slot"][:3].tolist()
    stride = tr.WITHOUT_ERROR if errors is None else tr.WITH_ERROR
    assert T["stride"] == stride
    places = T["first"] + stride * np.array([slots.index(s) for s in range(3)])
    expected, cov = regression(DT * np.arange(n), z, errors)
    np.testing.assert_allclose(T["x"][places], expected, atol=1e-5)
    np.testing.assert_allclose(T["P"][np.ix_(places, places)], cov, atol=1e-6)


def test_what_all_vehicles_seem_to_do_is_the_bearing() -> None:
    """One alone might be a vehicle that moves."""
    bearings, places = [], []
    for those in ([2], [0, 1, 2]):
        traffic = Traffic(known_road())
        for k in range(100):
            turned = 0.006 * min(max(k - 80, 0) / 10.0, 1.0) * X[those]
            traffic.scan(
                those, np.column_stack((X[those], turned)), dt=DT, speed=SPEED, yaw_rate=0.0,
                std=STD, speeds=False, lasting=ERRORS,
            )  # fmt: skip
        T = traffic.filter
        far = T["party"]["slot"].tolist().index(2)
        bearings.append(T["x"][tr.BEARING])
        places.append(T["x"][T["first"] + tr.WITH_ERROR * far])
    assert 0.5 * 0.006 < bearings[1] < 0.006
    assert bearings[0] < bearings[1]
    assert places[1] < 0.8 * places[0]


def test_more_vehicles_than_can_be_followed() -> None:
    """The nearest are; there is room for sixteen, as many as the radar has slots."""
    traffic = Traffic(known_road())
    n = 20
    xy = np.column_stack((10.0 + 9.0 * np.arange(n), np.zeros(n)))
    for _ in range(30):
        traffic.scan(
            range(n), xy, dt=DT, speed=SPEED, yaw_rate=0.0, std=STD, speeds=False, lasting=ERRORS
        )
    T = traffic.filter
    assert sorted(T["party"]["slot"][T["party"]["slot"] >= 0].tolist()) == list(range(16))
    assert T["top"] <= tr.N
    assert np.isfinite(T["P"]).all()


def test_after_a_long_silence_errors_last_as_before() -> None:
    traffic = Traffic(known_road())
    for dt in (DT, DT, 5.0, DT):
        traffic.scan(
            range(3), np.column_stack((X, np.zeros(3))), dt=dt, speed=SPEED, yaw_rate=0.0, std=STD,
            speeds=False, lasting=ERRORS,
        )  # fmt: skip
        T = traffic.filter
        assert T["stride"] == tr.WITH_ERROR
        assert (T["party"]["slot"] >= 0).sum() == 3
        assert T["lasting_s"] == ERRORS.lasting_s


@pytest.mark.parametrize(
    "errors",
    [
        LastingErrors(0.0, 0.0, 0.004, 1.0, 0.0, 0.0, DT),
        LastingErrors(0.2, 0.4, 0.0, 0.0, 0.0, 0.0, DT),
        LastingErrors(0.0, 0.0, 0.0, 0.0, 0.01, 1.0, DT),
    ],
)
def test_a_profile_need_not_tell_of_all_of_them(errors: LastingErrors) -> None:
    traffic = Traffic(known_road())
    for row in measured(5, 80):
        traffic.scan(
            range(3), np.column_stack((X, row)), dt=DT, speed=SPEED, yaw_rate=0.0, std=STD,
            speeds=False, lasting=errors,
        )  # fmt: skip
    T = traffic.filter
    used = T["P"][: T["top"], : T["top"]]
    assert np.isfinite(used).all()
    assert np.isfinite(T["x"]).all()
    assert np.linalg.eigvalsh(used).min() > -1e-12
    if not errors.std and not errors.new_std:
        own = T["first"] + tr.WITH_ERROR * np.arange(3) + 2
        assert not T["x"][own].any()
    if not errors.bearing_std:
        assert T["x"][tr.BEARING] == 0.0
