"""The Bernoulli particle filter against exact recursions."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.bernoulli import Grid, Mixture

from can_imm.estimation import bernoulli_kernels as kernels
from can_imm.estimation.bernoulli import BernoulliFilter, BernoulliModel
from can_imm.types import CanImmError

NO_DETECTIONS = (np.zeros(0, np.int32), np.zeros((0, 3)))


def make(model, *, particles=100, births=500, seed=0, **more):
    rng = np.random.default_rng(seed)
    return BernoulliFilter(model, rng, particles=particles, births=births, **more)


def poses(*places):
    return np.array([[x, y, heading, 0.0, 0.0] for x, y, heading in places])


# --- the existence probability ---


@pytest.mark.parametrize(
    ("sensors", "union", "expected"),
    [(1, False, 0.05 / 0.55), (2, False, 0.005 / 0.505), (2, True, 0.05 / 0.55)],
)
def test_empty_scans_lower_q_by_the_formula(sensors, union, expected):
    model = BernoulliModel(p_birth=0.0, p_survival=1.0, p_detection=0.9, union=union)
    f = make(model)
    f.q = 0.5
    f.particles[:] = np.array([10.0, 0.0, 5.0, 0.0])[:, None]
    f.step(0.1, poses((0, 0, 0), (1, 0, 0))[:sensors], np.zeros(sensors), *NO_DETECTIONS)
    assert f.q == pytest.approx(expected, abs=1e-12)


def test_survival_is_that_of_the_time_that_passed():
    f = make(BernoulliModel(p_survival=0.9, period_s=0.1))
    f.q = 0.8
    f.step(0.3, np.zeros((0, 5)), np.zeros(0), *NO_DETECTIONS)
    assert f.q == pytest.approx(0.8 * 0.9**3)


def test_without_detections_nothing_is_born():
    f = make(BernoulliModel())
    for _ in range(3):
        f.step(0.1, poses((0, 0, 0)), np.zeros(1), *NO_DETECTIONS)
        assert f.q == 0.0


def test_a_sensor_out_of_range_has_no_say():
    f = make(BernoulliModel(p_birth=0.0, p_survival=1.0, range_max=50.0))
    f.q = 0.5
    f.particles[:] = np.array([100.0, 0.0, 0.0, 0.0])[:, None]
    f.step(0.1, poses((0, 0, 0)), np.zeros(1), *NO_DETECTIONS)
    assert f.q == pytest.approx(0.5, abs=1e-12)


# --- exact recursions ---

FAR = 1e5
LINEAR = BernoulliModel(
    p_birth=0.05, p_survival=0.97, p_detection=0.8, clutter=2.0, range_max=2 * FAR,
    rate_span=2000.0, std_range=0.3, std_bearing=0.4 / FAR, std_rate=0.5, std_tangential=1.5,
    density=2.0, period_s=0.2,
)  # fmt: skip
"""For sensors so far away that everything is linear."""


def linear_sensors():
    """Poses of a sensor at -x and one at -y, and what they measure as z = H x + h."""
    pose = poses((-FAR, 0.0, 0.0), (0.0, -FAR, math.pi / 2))
    rows = [
        (np.array([[1, 0, 0, 0], [0, 0, 1 / FAR, 0], [0, 1, 0, 0]]), np.array([FAR, 0.0, 0.0])),
        (np.array([[0, 0, 1, 0], [-1 / FAR, 0, 0, 0], [0, 0, 0, 1]]), np.array([FAR, 0.0, 0.0])),
    ]
    return pose, rows


def linear_birth(model, row, z):
    """Gaussian of a detection in the linear geometry: (mean, cov)."""
    along, across = model.std_range**2, (model.std_bearing * FAR) ** 2
    radial, tangential = model.std_rate**2, model.std_tangential**2
    if row == 0:
        mean = np.array([z[0] - FAR, z[2], FAR * z[1], 0.0])
        return mean, np.diag([along, radial, across, tangential])
    mean = np.array([-FAR * z[1], 0.0, z[0] - FAR, z[2]])
    return mean, np.diag([across, tangential, along, radial])


def simulate_linear(model, rng, steps, rows, clutter_near=True):
    """Per step and sensor an array (n, 3) of detections: the object's, perhaps, and clutter."""
    R = np.diag([model.std_range, model.std_bearing, model.std_rate]) ** 2
    x = np.array([0.5, 1.0, -0.5, 0.3])
    F = np.kron(np.eye(2), np.array([[1.0, model.period_s], [0.0, 1.0]]))
    scans = []
    for _ in range(steps):
        x = F @ x
        found = []
        for H, h in rows:
            z = []
            if rng.random() < model.p_detection:
                z.append(H @ x + h + rng.multivariate_normal(np.zeros(3), R))
            if clutter_near and rng.random() < 0.7:
                z.append(H @ (x + rng.normal(0, [1.5, 1.0, 1.5, 1.0])) + h)
            found.append(np.array(z).reshape(-1, 3))
        scans.append(found)
    return scans


def clutter_density(model):
    return model.clutter / (model.range_max * math.tau * model.rate_span)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_against_all_hypotheses_with_births_clutter_and_misses(seed):
    model = LINEAR
    pose, rows = linear_sensors()
    R = np.diag([model.std_range, model.std_bearing, model.std_rate]) ** 2
    exact = Mixture(
        p_birth=model.p_birth, p_survival=model.p_survival, p_detection=model.p_detection,
        clutter_density=clutter_density(model), T=model.period_s, k=model.density,
    )  # fmt: skip
    f = make(model, particles=60_000, births=240_000)
    for found in simulate_linear(model, np.random.default_rng(seed), 4, rows):
        births = [linear_birth(model, row, z) for row, zs in enumerate(found) for z in zs]
        exact.step([(*rows[row], R, zs) for row, zs in enumerate(found)], births)
        sensor = np.repeat(np.arange(2, dtype=np.int32), [len(zs) for zs in found])
        f.step(model.period_s, pose, np.zeros(2), sensor, np.concatenate(found))
        assert f.q == pytest.approx(exact.q, abs=0.01)
        if exact.q > 0.01:
            mean, cov = exact.moments()
            std = np.sqrt(np.diag(cov))
            np.testing.assert_allclose(f.mean, mean, atol=0.05 * std.max())
            np.testing.assert_allclose(np.sqrt(np.diag(f.cov)), std, rtol=0.06)
    assert exact.q > 0.5


def test_against_a_grid_with_survival_clutter_and_misses():
    T, x0 = 0.5, -60.0
    model = BernoulliModel(
        p_birth=0.0, p_survival=0.95, p_detection=0.7, clutter=1.0, range_max=200.0,
        rate_span=50.0, std_range=0.5, std_bearing=1e3, std_rate=0.8, density=0.5, period_s=T,
    )  # fmt: skip
    grid = Grid(np.linspace(-5, 7, 61), np.linspace(-3.5, 5, 44), T, model.density, x0)
    grid.p = np.exp(-0.5 * ((grid.X / 0.8) ** 2 + ((grid.V - 0.8) / 0.7) ** 2))
    grid.p /= grid.p.sum()
    n = 100_000
    rng = np.random.default_rng(3)
    f = make(model, particles=n, births=1)
    f.particles[0] = rng.normal(0.0, 0.8, n)
    f.particles[1] = rng.normal(0.8, 0.7, n)
    f.particles[2:] = 0.0
    grid.q = f.q = 0.6
    # the bearing's density is that of a standard normal spread over all directions
    flat = 1.0 / (math.sqrt(math.tau) * model.std_bearing)
    for z in ([(60.9, 1.1)], [], [(61.0, 0.4), (59.2, -0.5)], [(63.0, 2.0), (62.0, 1.0)], []):
        grid.step(
            z, p_survival=model.p_survival, p_detection=model.p_detection,
            clutter_density=clutter_density(model) / flat,
            std=(model.std_range, model.std_rate),
        )  # fmt: skip
        rows = np.array([(r, 0.0, rate) for r, rate in z]).reshape(-1, 3)
        sensor = np.zeros(len(rows), np.int32)
        f.step(T, poses((x0, 0.0, 0.0)), np.zeros(1), sensor, rows)
        mean, cov = grid.moments()
        assert f.q == pytest.approx(grid.q, abs=0.005)
        np.testing.assert_allclose(f.mean[:2], mean, atol=0.02)
        np.testing.assert_allclose(f.cov[:2, :2], cov, atol=0.03)


def test_against_a_kalman_filter():
    model = replace(LINEAR, p_birth=1e-6, p_survival=1.0, p_detection=0.999, clutter=1e-6)
    pose, rows = linear_sensors()
    R = np.diag([model.std_range, model.std_bearing, model.std_rate]) ** 2
    F = np.kron(np.eye(2), np.array([[1.0, 0.2], [0.0, 1.0]]))
    Q = np.kron(np.eye(2), model.density * np.array([[0.2**3 / 3, 0.02], [0.02, 0.2]]))
    n = 100_000
    rng = np.random.default_rng(5)
    m, P = np.array([0.4, 0.9, -0.4, 0.2]), np.diag([0.3, 0.5, 0.3, 0.5]) ** 2
    f = make(model, particles=n, births=1)
    f.particles[:] = rng.multivariate_normal(m, P, n).T
    f.q = 0.999
    always = replace(model, p_detection=0.9999999)
    for found in simulate_linear(always, rng, 6, rows, clutter_near=False):
        m, P = F @ m, F @ P @ F.T + Q
        for (H, h), (z,) in zip(rows, found, strict=True):
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            m, P = m + K @ (z - H @ m - h), P - K @ H @ P
        f.step(0.2, pose, np.zeros(2), np.arange(2, dtype=np.int32), np.concatenate(found))
        std = np.sqrt(np.diag(P))
        np.testing.assert_allclose(f.mean, m, atol=0.03 * std.max())
        np.testing.assert_allclose(np.sqrt(np.diag(f.cov)), std, rtol=0.03)
        assert f.q > 0.999


def test_a_late_sensor_sees_the_object_where_it_is_by_then():
    """The same object at 20 m/s, measured at once and 50 ms later: 1 m farther."""
    model = BernoulliModel(std_range=0.05)
    results = []
    for delay in (0.0, 0.05):
        f = make(model, particles=20_000, births=1)
        rng = np.random.default_rng(2)
        f.particles[:] = np.array([[50.0, 20.0, 0.0, 0.0]]).T
        f.particles[0] += rng.normal(0, 1.0, 20_000)
        f.q = 0.99
        z = np.array([[52.0 + 20.0 * delay, 0.0, 20.0]])
        f.step(0.1, poses((0, 0, 0)), np.array([delay]), np.zeros(1, np.int32), z)
        results.append(f.mean[0])
    assert results[0] == pytest.approx(52.0, abs=0.02)
    assert results[1] == pytest.approx(results[0], abs=0.02)


# --- the parts ---


@given(
    weights=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=40).filter(lambda w: sum(w) > 1e-3),
    count=st.integers(1, 60),
    u=st.floats(0.0, 1.0, exclude_max=True),
)
def test_systematic_resampling_takes_each_as_often_as_its_weight_says(weights, count, u):
    w = np.array(weights) / np.sum(weights)
    n = len(w)
    cloud = np.arange(4.0 * n).reshape(4, n)
    particles = np.zeros((4, count))
    kernels.resample_(cloud, n, w, particles, u)
    taken = np.bincount(particles[0].astype(int), minlength=n)
    assert taken.sum() == count
    assert (np.abs(taken - count * w) < 1.0 + 1e-6).all()
    assert (particles == cloud[:, particles[0].astype(int)]).all()


@pytest.mark.parametrize("n", [1, 2, 5, 10_001])
def test_process_noise_has_its_covariance_and_neighbours_oppose_each_other(n):
    T, k = 0.5, 2.0
    particles = np.tile(np.array([[1.0, 2.0, 3.0, 4.0]]).T, n)
    cloud = np.full((4, n + 3), np.nan)
    kernels.move_(particles, cloud, T, k, np.random.default_rng(0))
    assert np.isnan(cloud[:, n:]).all()
    e = cloud[:, :n] - np.array([[1.0 + 2.0 * T, 2.0, 3.0 + 4.0 * T, 4.0]]).T
    even = e[:, : n - n % 2]
    np.testing.assert_allclose(even[:, ::2], -even[:, 1::2], atol=1e-12)
    if n > 1000:
        Q = np.kron(np.eye(2), k * np.array([[T**3 / 3, T**2 / 2], [T**2 / 2, T]]))
        np.testing.assert_allclose(e @ e.T / n, Q, atol=0.03)


def test_births_have_the_density_of_their_detection():
    model = BernoulliModel()
    z, pose = np.array([40.0, 0.4, -3.0]), np.array([5.0, -2.0, 0.3, 20.0, 1.0])
    mean, cov = np.zeros(4), np.zeros((4, 4))
    kernels.birth_density_(z, pose, model.vector(), mean, cov)
    n = 200_000
    cloud = np.zeros((4, n))
    kernels.draw_births_(cloud, 0, n, mean, cov, 0.0, 1.0, np.random.default_rng(0))
    rng = np.random.default_rng(1)
    r = z[0] + model.std_range * rng.standard_normal(n)
    a = pose[2] + z[1] + model.std_bearing * rng.standard_normal(n)
    rate, side = z[2] + model.std_rate * rng.standard_normal(n), 2.0 * rng.standard_normal(n)
    direct = np.stack(
        [pose[0] + r * np.cos(a), pose[3] + rate * np.cos(a) - side * np.sin(a),
         pose[1] + r * np.sin(a), pose[4] + rate * np.sin(a) + side * np.cos(a)]
    )  # fmt: skip
    np.testing.assert_allclose(cloud.mean(axis=1), direct.mean(axis=1), atol=0.02)
    np.testing.assert_allclose(np.cov(cloud), np.cov(direct), atol=0.05)


def test_births_are_shared_out_over_the_detections():
    """More detections than birth particles: every one gets its turn, none is preferred."""
    model = BernoulliModel(p_detection=0.5)
    f = make(model, particles=4, births=8, capacity=32)
    z = np.stack([np.linspace(5, 190, 30), np.zeros(30), np.zeros(30)], axis=1)
    started = set()
    for _ in range(60):
        f.forget()
        for _ in range(2):
            assert f.step(0.1, poses((0, 0, 0)), np.zeros(1), np.zeros(30, np.int32), z)
        assert 0.0 < f.q < 1.0
        started |= {int(np.argmin(abs(z[:, 0] - x))) for x in f.particles[0]}
    assert len(started) > 20


def test_the_same_seed_gives_the_same_bits():
    def run(seed):
        f = make(BernoulliModel(), particles=300, births=1500, seed=seed)
        rng = np.random.default_rng(9)
        for k in range(10):
            z = np.array([[30.0 + 0.1 * k, 0.1, 1.0], [80.0, 1.0, 3.0]]) + 0.01 * rng.random((2, 3))
            f.step(0.1, poses((0, 0, 0), (3, 1, 0)), np.zeros(2), np.array([0, 1], np.int32), z)
        return f.q, f.mean.tobytes(), f.particles.tobytes()

    assert run(4) == run(4)
    assert run(4) != run(5)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"p_detection": 1.0}, "p_detection"),
        ({"p_birth": -0.1}, "p_birth"),
        ({"p_survival": math.nan}, "p_survival"),
        ({"clutter": 0.0}, "clutter"),
        ({"std_rate": math.inf}, "std_rate"),
        ({"density": -1.0}, "density"),
    ],
)
def test_impossible_models_are_refused(change, words):
    with pytest.raises(CanImmError, match=words):
        BernoulliModel(**change)


def test_a_filter_without_particles_is_refused():
    with pytest.raises(CanImmError, match="at least one particle"):
        make(BernoulliModel(), particles=0)


def test_a_numeric_failure_starts_anew():
    f = make(BernoulliModel())
    f.q = 0.9
    f.particles[:] = np.nan
    z = np.array([[30.0, 0.0, 0.0]])
    one = np.zeros(1, np.int32)
    assert not f.step(0.1, poses((0, 0, 0)), np.zeros(1), one, z)
    assert f.q == 0.0
    for _ in range(3):
        assert f.step(0.1, poses((0, 0, 0)), np.zeros(1), one, z)
    assert f.q > 0.9
