"""The IMM kernels against the textbook oracle and, where it is right, against filterpy."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import IMMEstimator, KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.gaussian import random_covariance
from oracles.imm import Imm, Mode, enter
from scipy.stats import norm
from small_banks import (
    Runner,
    add_bound,
    add_soft,
    blank,
    copy_state,
    random_chain,
    random_pair,
)

from can_imm.estimation import imm, layout
from can_imm.estimation.models import transition_table

SEEDS = st.integers(0, 2**32 - 1)
R = np.array([0.3, 0.2, 0.4, 0.5])


def assert_same(runner: Runner, oracle: Imm, tolerance: float = 1e-9) -> None:
    obj, n, m = runner.objects[0], len(oracle.x[0]), len(oracle.x)
    kw = {"rtol": tolerance, "atol": tolerance}
    np.testing.assert_allclose(obj["mu"][:m], oracle.mu, **kw)
    np.testing.assert_allclose(obj["x"][:m, :n], oracle.x, **kw)
    np.testing.assert_allclose(obj["P"][:m, :n, :n], oracle.P, **kw)
    mean, cov = oracle.combined()
    np.testing.assert_allclose(obj["mean"][:n], mean, **kw)
    np.testing.assert_allclose(obj["cov"][:n, :n], cov, **kw)
    np.testing.assert_array_equal(obj["cov"], obj["cov"].T)


@settings(max_examples=15)
@given(SEEDS, st.integers(2, 5), st.integers(4, 6))
def test_many_cycles_equal_the_textbook(seed: int, n_modes: int, n: int) -> None:
    """(14) to (20), with a transition matrix that is not symmetric."""
    Pi, runner, oracle = random_pair(seed, n_modes, n)
    rng = np.random.default_rng(seed + 1)
    for _ in range(25):
        z = rng.normal(0.0, 2.0, 4)
        valid = rng.random(4) < 0.8
        valid[rng.integers(4)] = True
        assert runner.scan([0], [5], z, R, valid)[0] == imm.OK
        oracle.cycle(Pi, np.eye(n)[:4][valid], np.diag(R[valid]), z[valid])
        assert_same(runner, oracle)


@pytest.mark.parametrize("seed", range(4))
def test_many_cycles_equal_filterpy(seed: int) -> None:
    """One predict per update, M[i, j] from i to j, likelihoods within range: there it is right."""
    n_modes = 3
    Pi, runner, oracle = random_pair(seed, n_modes, 4)
    filters = []
    for mode, x, P in zip(oracle.modes, oracle.x, oracle.P, strict=True):
        f = KalmanFilter(4, 4)
        f.x, f.P, f.F, f.Q, f.H, f.R = x.copy(), P.copy(), mode.F, mode.Q, np.eye(4), np.diag(R)
        filters.append(f)
    reference = IMMEstimator(filters, oracle.mu, Pi)
    rng = np.random.default_rng(seed + 1)
    for _ in range(40):
        z = rng.normal(0.0, 2.0, 4)
        runner.scan([0], [5], z, R)
        reference.predict()
        reference.update(z)
        obj = runner.objects[0]
        np.testing.assert_allclose(obj["mu"][:n_modes], reference.mu, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(obj["mean"][:4], reference.x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(obj["cov"][:4, :4], reference.P, rtol=1e-9, atol=1e-9)


def test_transitions_go_from_row_to_column() -> None:
    """All probability in mode 0, which goes to mode 1 for sure."""
    bank = blank(2, 4)
    bank[0]["Pi"][5, :2, :2] = [[0.0, 1.0], [0.0, 1.0]]
    runner = Runner(bank, 1)
    x = [np.zeros(4), np.full(4, 5.0)]
    copy_state(Imm([], x, [np.eye(4)] * 2, np.array([1.0, 0.0])), runner.objects[0])
    assert runner.scan([0], [5], np.zeros(4), 1.0)[0] == imm.OK
    np.testing.assert_array_equal(runner.objects[0]["mu"][:2], [0.0, 1.0])
    np.testing.assert_allclose(runner.objects[0]["x"][1, :4], 0.0, atol=1e-12)


@settings(max_examples=15)
@given(SEEDS)
def test_constraints_within_the_cycle(seed: int) -> None:
    """Soft rows, an interval and entry distributions, over several cycles."""
    n_modes, n = 4, 5
    Pi, runner, oracle = random_pair(seed, n_modes, n)
    record = runner.bank[0]
    modes = oracle.modes
    modes[0].D, modes[0].d = np.eye(n)[[1, 3]], np.array([0.2, -0.4])
    modes[0].D_noise = np.diag([0.1, 0.6])
    add_soft(runner.bank, 0, 1, 0.2, 0.1)
    add_soft(runner.bank, 0, 3, -0.4, 0.6)
    modes[1].interval = (2, -0.5, 1.5)
    add_bound(runner.bank, 1, 2, -0.5, 1.5)
    modes[2].entry = {1: (0.7, 0.3), 4: (-1.0, 0.8)}
    modes[2].entry_from = frozenset({0, 3})
    for s, (mean, variance) in modes[2].entry.items():
        record["entry_mean"][2, s], record["entry_var"][2, s] = mean, variance
        record["entry_sources"][[0, 3], 2] |= 1 << s
    modes[3].entry = {2: (0.1, 0.05)}
    modes[3].entry_from = frozenset({2})
    record["entry_mean"][3, 2], record["entry_var"][3, 2] = 0.1, 0.05
    record["entry_sources"][2, 3] = 1 << 2
    rng = np.random.default_rng(seed + 1)
    for _ in range(8):
        z = rng.normal(0.0, 1.0, 4)
        assert runner.scan([0], [5], z, R)[0] == imm.OK
        oracle.cycle(Pi, np.eye(n)[:4], np.diag(R), z)
        assert_same(runner, oracle, 1e-8)


def test_each_entry_state_has_its_own_sources() -> None:
    """State 1 is replaced on the way from mode 0, state 3 on the way from mode 1."""
    rng = np.random.default_rng(0)
    bank = blank(3, 4)
    record = bank[0]
    record["entry_mean"][2, :4] = [0.0, 0.7, 0.0, -0.2]
    record["entry_var"][2, :4] = [-1.0, 0.3, -1.0, 0.1]
    record["entry_sources"][0, 2] = 1 << 1
    record["entry_sources"][1, 2] = 1 << 3
    xs = [rng.normal(size=4) for _ in range(3)]
    Ps = [random_covariance(rng, 4) for _ in range(3)]
    w = np.array([0.2, 0.5, 0.3])
    runner = Runner(bank, 1)
    copy_state(Imm([], xs, Ps, w), runner.objects[0])
    runner.work[0]["w"][:3] = w
    mixed_x, mixed_P = np.empty(4), np.empty((4, 4))
    imm.mix_(4, bank[0], runner.objects[0], runner.work[0], 2, 0, mixed_x, mixed_P)
    for i, s, mean, variance in ((0, 1, 0.7, 0.3), (1, 3, -0.2, 0.1)):
        xs[i][s] = mean
        Ps[i][s, :] = Ps[i][:, s] = 0.0
        Ps[i][s, s] = variance
    mean, cov = Imm([], xs, Ps, w).combined()
    np.testing.assert_allclose(mixed_x, mean, rtol=1e-12)
    np.testing.assert_allclose(mixed_P, cov, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(
    "entry",
    [
        {1: (2.0, 0.5)},
        {1: (2.0, 0.5), 4: (-0.3, 0.2)},
        {1: (2.0, 0.5), 2: (0.1, 0.4), 3: (0.0, 0.0)},
        {0: (30.0, 1.0), 1: (2.0, 0.5)},
    ],
    ids=str,
)
def test_a_new_speed_sets_in_at_any_instant_of_the_interval(
    entry: dict[int, tuple[float, float]],
) -> None:
    """Correlated source, half a second: x and its covariances with everything else follow."""
    rng = np.random.default_rng(4)
    bank = blank(2, 5)
    record = bank[0]
    for s, (mean, variance) in entry.items():
        record["entry_mean"][1, s], record["entry_var"][1, s] = mean, variance
        record["entry_sources"][0, 1] |= 1 << s
    x, P = rng.normal(0.0, 2.0, 5), random_covariance(rng, 5)
    runner = Runner(bank, 1)
    copy_state(Imm([], [x, x], [P, P], np.array([1.0, 0.0])), runner.objects[0])
    runner.work[0]["w"][:2] = [1.0, 0.0]
    mixed_x, mixed_P = np.empty(5), np.empty((5, 5))
    imm.mix_(5, record, runner.objects[0], runner.work[0], 1, 50, mixed_x, mixed_P)
    mean, cov = enter(x, P, entry, 0.5)
    np.testing.assert_allclose(mixed_x, mean, rtol=1e-12)
    np.testing.assert_allclose(mixed_P, cov, rtol=1e-12, atol=1e-14)


def test_a_speed_step_covers_the_way_that_two_speeds_cover() -> None:
    """The oracle's linear map itself against a simulation of the step at a random instant."""
    rng = np.random.default_rng(0)
    x, P, tau, n = np.array([1.0, -2.0, 0.5, 0.3]), random_covariance(rng, 4), 0.5, 400_000
    old = rng.multivariate_normal(x, P, n)
    instant, speed = rng.uniform(0.0, tau, n), rng.normal(2.0, 0.7, n)
    end = old.copy()
    end[:, 0] += instant * old[:, 1] + (tau - instant) * speed
    end[:, 1] = speed
    mean, cov = enter(x, P, {1: (2.0, 0.49)}, tau)
    F = np.eye(4)
    F[0, 1] = tau
    np.testing.assert_allclose(end.mean(axis=0), F @ mean, atol=0.01)
    np.testing.assert_allclose(np.cov(end.T), F @ cov @ F.T, atol=0.015)


# ---- transitions that depend on the state


def test_the_mass_of_a_region_moves_the_transition() -> None:
    """Row i of the chain times what source i, moved on, has inside each mode's region."""
    Pi, runner, oracle = random_pair(3, 3, 4)
    add_bound(runner.bank, 1, 0, 0.3, np.inf, mass=True)
    add_bound(runner.bank, 2, 0, -np.inf, 0.3, mass=True)
    add_bound(runner.bank, 2, 1, -1.0, 1.0)  # not a matter of the transition
    runner.work[0]["mu"][:3] = oracle.mu
    imm.transitions_(
        runner.bank[0]["n_states"], runner.bank[0], runner.objects[0], runner.work[0], 5
    )
    expected = Pi.copy()
    for i, mode in enumerate(oracle.modes):
        x = mode.F @ oracle.x[i]
        P = mode.F @ oracle.P[i] @ mode.F.T + mode.Q
        above = norm.sf(0.3, x[0], np.sqrt(P[0, 0]))
        expected[i] *= [1.0, above, 1.0 - above]
        expected[i] /= expected[i].sum()
    np.testing.assert_allclose(runner.objects[0]["Pi"][:3, :3], expected, rtol=1e-9)


def test_a_state_that_the_entry_replaces_does_not_count_in_the_transition() -> None:
    Pi, runner, _ = random_pair(3, 2, 4)
    add_bound(runner.bank, 1, 1, 50.0, 60.0, mass=True)
    record = runner.bank[0]
    record["entry_mean"][1, 1], record["entry_var"][1, 1] = 55.0, 1.0
    record["entry_sources"][0, 1] = 1 << 1
    runner.work[0]["mu"][:2] = 0.5
    imm.transitions_(record["n_states"], record, runner.objects[0], runner.work[0], 5)
    np.testing.assert_allclose(runner.objects[0]["Pi"][0, :2], Pi[0], rtol=1e-12)
    assert runner.objects[0]["Pi"][1, 1] < 1e-12, "staying counts: nothing is replaced there"


# ---- probabilities


def normalise(log_l: list[float], c: list[float], floor: float) -> tuple[bool, np.ndarray]:
    mu = np.full(len(c), 0.25)
    with np.errstate(divide="ignore"):
        log_c = np.log(c)
    return imm.normalise_(len(c), mu, np.array(log_l), log_c, floor), mu


def test_extreme_likelihoods_keep_their_order() -> None:
    """An outlier for all modes leaves exp(-2000) and less: mu must not become equal."""
    ok, mu = normalise([-2000.0, -2003.0, -2500.0, -1e6], [0.1, 0.2, 0.3, 0.4], 0.0)
    assert ok
    e = np.exp(-3.0)
    expected = np.array([0.1, 0.2 * e, 0.0, 0.0]) / (0.1 + 0.2 * e)
    np.testing.assert_allclose(mu, expected, rtol=1e-12, atol=1e-200)


def test_floor() -> None:
    ok, mu = normalise([0.0, -1e5, layout.LOG_FLOOR, 0.0], [0.5, 0.3, 0.2, 0.0], 1e-6)
    assert ok
    np.testing.assert_allclose(mu, np.array([1.0, 1e-6, 1e-6, 1e-6]) / (1.0 + 3e-6), rtol=1e-12)


@pytest.mark.parametrize("bad", [layout.LOG_FLOOR, -np.inf, np.inf])
def test_no_likelihood_at_all_is_a_failure(bad: float) -> None:
    ok, mu = normalise([bad] * 3, [0.3, 0.3, 0.4], 1e-6)
    assert not ok
    np.testing.assert_array_equal(mu, 0.25)


def test_an_outlier_without_a_gate_does_not_reset_the_probabilities() -> None:
    _, runner, _ = random_pair(1, 3, 4)
    before = runner.objects[0]["mu"][:3].copy()
    assert runner.scan([0], [5], np.full(4, 300.0), R)[0] == imm.OK
    mu = runner.objects[0]["mu"][:3]
    assert mu.sum() == pytest.approx(1.0)
    assert np.ptp(mu) > 0.3
    assert not np.allclose(mu, before)


def test_a_mode_that_its_bounds_rule_out_is_not_computed() -> None:
    """It gets the floor, as it would otherwise, and its state is that of the others."""
    bank, scans = objects_and_scans(4)
    runner = Runner(bank, 1)
    runner.scan([0], [-1], scans[0][0], R)
    obj = runner.objects[0]
    for near in (True, False):
        z = scans[1][0].copy()
        z[3] = 0.3 if near else -4.0  # mode 1 is one of vy > 0.2
        before = obj["mean"].copy()
        assert runner.scan([0], [10], z, 0.02)[0] == imm.OK
        assert (obj["log_l"][1] > layout.LOG_FLOOR) == near
    assert obj["mu"][1] == pytest.approx(1e-6, rel=1e-3)
    np.testing.assert_array_equal(obj["x"][1], before)


def test_a_mode_without_probability_stays_finite_and_can_come_back() -> None:
    """Nothing leads to mode 1 for a while; filterpy makes this a NaN."""
    bank = blank(2, 4)
    bank[0]["Pi"][5, :2, :2] = [[1.0, 0.0], [1.0, 0.0]]
    bank[0]["Pi"][6, :2, :2] = [[0.5, 0.5], [0.5, 0.5]]
    runner = Runner(bank, 1)
    assert runner.scan([0], [-1], np.zeros(4), 1.0)[0] == imm.OK
    for _ in range(3):
        assert runner.scan([0], [5], np.zeros(4), 1.0)[0] == imm.OK
        obj = runner.objects[0]
        np.testing.assert_array_equal(obj["mu"][:2], [1.0, 0.0])
        assert np.isfinite(obj["x"]).all()
        assert np.isfinite(obj["P"]).all()
    assert runner.scan([0], [6], np.zeros(4), 1.0)[0] == imm.OK
    np.testing.assert_allclose(runner.objects[0]["mu"][:2], 0.5)


def test_modes_at_the_floor_count_neither_as_sources_nor_in_the_estimate() -> None:
    Pi, runner, oracle = random_pair(5, 3, 4)
    runner.bank[0]["mu_floor"] = oracle.floor = 1e-3
    oracle.mu = np.array([0.6, 0.399, 1e-3])
    oracle.x[2] = np.full(4, 1e3)
    copy_state(oracle, runner.objects[0])
    rng = np.random.default_rng(0)
    for _ in range(10):
        z = rng.normal(0.0, 1.0, 4)
        assert runner.scan([0], [5], z, R)[0] == imm.OK
        oracle.cycle(Pi, np.eye(4), np.diag(R), z)
        assert_same(runner, oracle)
        assert np.abs(runner.objects[0]["mean"]).max() < 5.0


@settings(max_examples=25)
@given(SEEDS, st.sampled_from([1e-6, 1.0, 1e4]))
def test_combined_covariance_is_one(seed: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    n_modes, n = int(rng.integers(1, 8)), int(rng.integers(4, 7))
    bank, obj, work = (
        blank(n_modes, n),
        np.zeros(1, layout.OBJECT_DTYPE),
        np.zeros(1, layout.WORK_DTYPE),
    )
    xs = [rng.normal(0.0, spread, n) for _ in range(n_modes)]
    Ps = [random_covariance(rng, n) for _ in range(n_modes)]
    oracle = Imm([], xs, Ps, rng.dirichlet(np.ones(n_modes)))
    copy_state(oracle, obj[0])
    obj["mean"], obj["cov"] = np.nan, np.nan
    imm.combine_(bank[0]["n_states"], bank[0], obj[0], work[0])
    mean, cov = oracle.combined()
    np.testing.assert_allclose(obj[0]["mean"][:n], mean, rtol=1e-9, atol=1e-9 * spread)
    np.testing.assert_allclose(obj[0]["cov"][:n, :n], cov, rtol=1e-9, atol=1e-9 * spread**2)
    eigenvalues = np.linalg.eigvalsh(obj[0]["cov"][:n, :n])
    assert eigenvalues.min() > -1e-12 * eigenvalues.max()


# ---- extrapolation and birth


@settings(max_examples=15)
@given(SEEDS)
def test_extrapolation(seed: int) -> None:
    Pi, runner, oracle = random_pair(seed, 3, 5)
    x, P, mu = np.empty(5), np.empty((5, 5)), np.empty(3)
    before = runner.objects.tobytes()
    imm.extrapolate_(runner.bank[0], runner.objects[0], 5, x, P, mu, runner.work[0])
    assert runner.objects.tobytes() == before, "the object must not change"
    Fs, Qs = [m.F for m in oracle.modes], [m.Q for m in oracle.modes]
    for value, expected in zip((x, P, mu), oracle.extrapolated(Pi, Fs, Qs), strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-9, atol=1e-9)


def test_predictions_between_measurements_mix_nothing() -> None:
    """Ten predictions must leave what the next cycle gives as it is."""
    _, one, _ = random_pair(7, 3, 4)
    _, two, _ = random_pair(7, 3, 4)
    for m in range(5):
        imm.extrapolate_(
            two.bank[0], two.objects[0], m, np.empty(4), np.empty((4, 4)), np.empty(3), two.work[0]
        )
    for runner in (one, two):
        runner.scan([0], [5], np.ones(4), R)
    assert one.objects.tobytes() == two.objects.tobytes()


def test_birth() -> None:
    """Every mode: a wide prior at the measured position, its entry states, its constraints."""
    bank = blank(3, 5)
    record = bank[0]
    record["mu0"][:3] = [0.5, 0.3, 0.2]
    record["birth_std"][:5] = [2.0, 3.0, 1.0, 1.5, 0.7]
    record["entry_mean"][1, 1], record["entry_var"][1, 1] = 2.0, 0.4
    add_soft(bank, 2, 2, 3.0, 0.5)
    z = np.array([40.0, 1.2, 0.4, -0.3])
    prior_x = np.array([40.0, 0.0, 0.4, 0.0, 0.0])
    prior_P = np.diag(np.array([2.0, 3.0, 1.0, 1.5, 0.7]) ** 2)
    xs, Ps = [prior_x.copy() for _ in range(3)], [prior_P.copy() for _ in range(3)]
    xs[1][1], Ps[1][1, 1] = 2.0, 0.4
    still = Mode(np.eye(5), np.zeros((5, 5)))
    pulled = Mode(np.eye(5), np.zeros((5, 5)), np.eye(5)[[2]], np.array([3.0]), np.array([[0.5]]))
    oracle = Imm([still, still, pulled], xs, Ps, np.array([0.5, 0.3, 0.2]))
    oracle.cycle(np.eye(3), np.eye(5)[:4], np.diag(R), z)
    runner = Runner(bank, 1)
    runner.objects["x"] = np.nan  # a slot may hold anything
    runner.objects["P"] = np.nan
    assert runner.scan([0], [-1], z, R)[0] == imm.OK
    assert_same(runner, oracle)


def test_birth_without_a_component() -> None:
    bank = blank(1, 4)
    bank[0]["birth_std"][:4] = [2.0, 3.0, 1.0, 1.5]
    runner = Runner(bank, 1)
    z = [30.0, -1.0, np.nan, np.nan]
    assert runner.scan([0], [-1], z, R, [[True, True, False, False]])[0] == imm.OK
    obj = runner.objects[0]
    np.testing.assert_allclose(obj["mean"][2:4], 0.0)
    np.testing.assert_allclose(np.diag(obj["cov"])[2:4], [1.0, 2.25])
    assert obj["mean"][0] == pytest.approx(30.0)
    assert obj["mean"][1] == pytest.approx(-9.0 / 9.2)


# ---- a scan of many objects


def objects_and_scans(seed: int) -> tuple[np.ndarray, list[np.ndarray]]:
    rng = np.random.default_rng(seed)
    bank = blank(3, 4)
    record = bank[0]
    Pi = random_chain(rng, 3)
    G = (Pi - np.eye(3)) * 2.0
    record["Pi"][:20, :3, :3] = transition_table(G, 0.01, 20)
    record["mu_floor"] = 1e-6
    record["birth_std"][:4] = [1.0, 4.0, 1.0, 1.0]
    for m in range(20):
        tau = 0.01 * m
        for j, q in enumerate((0.01, 0.3, 3.0)):
            for a in (0, 2):
                record["F"][m, j, a, a + 1] = tau
                record["Q"][m, j, a : a + 2, a : a + 2] = q * np.array(
                    [[tau**3 / 3, tau**2 / 2], [tau**2 / 2, tau]]
                )
    add_soft(bank, 0, 3, 0.0, 0.1)
    add_bound(bank, 1, 3, 0.2, np.inf)
    start = rng.normal(0.0, 10.0, (6, 4))
    return bank, [start + rng.normal(0.0, 0.3, (6, 4)) for _ in range(12)]


def test_a_scan_of_many_objects_equals_one_by_one() -> None:
    bank, scans = objects_and_scans(0)
    rng = np.random.default_rng(5)
    together, alone = Runner(bank, 8), Runner(bank, 8)
    alone.work.view(np.uint8)[:] = 0x5A  # scratch carries nothing over
    for k, z in enumerate(scans):
        rows = rng.permutation(6)
        steps = np.where(rng.random(6) < 0.5, 10, 7) if k else np.full(6, -1)
        together.scan(rows, steps, z[rows], R)
        for row, m in sorted(zip(rows, steps, strict=True)):
            alone.scan([row], [m], z[row], R)
    assert together.objects.tobytes() == alone.objects.tobytes()


def test_an_object_does_not_depend_on_the_others() -> None:
    bank, scans = objects_and_scans(1)
    crowd, single = Runner(bank, 8), Runner(bank, 8)
    for k, z in enumerate(scans):
        m = 10 if k else -1
        crowd.scan(range(6), [m] * 6, z, R)
        single.scan([3], [m], z[3], R)
    assert crowd.objects[3].tobytes() == single.objects[3].tobytes()


def test_rows_without_a_slot_and_outliers_change_nothing() -> None:
    bank, scans = objects_and_scans(2)
    runner = Runner(bank, 8)
    runner.scan(range(6), [-1] * 6, scans[0], R)
    before = runner.objects.copy()
    z = scans[1].copy()
    z[0] += 1000.0
    status = runner.scan([0, -1, 2], [10] * 3, z[:3], R, gate=25.0)
    assert status[0] == imm.OUTLIER
    assert status[2] == imm.OK
    assert runner.objects[0].tobytes() == before[0].tobytes()
    assert runner.objects[1].tobytes() == before[1].tobytes()
    assert runner.objects[2].tobytes() != before[2].tobytes()


def test_a_failure_is_flagged() -> None:
    bank, scans = objects_and_scans(3)
    runner = Runner(bank, 8)
    runner.scan([0], [-1], scans[0][0], R)
    runner.objects[0]["P"][:] = np.nan
    assert runner.scan([0], [10], scans[1][0], R)[0] == imm.FAILED
    assert runner.scan([1], [-1], np.full(4, np.nan), R)[0] == imm.FAILED


def test_one_failed_mode_gets_the_floor_and_spoils_nothing() -> None:
    bank, scans = objects_and_scans(3)
    runner = Runner(bank, 8)
    runner.scan([0], [-1], scans[0][0], R)
    bank[0]["Q"][10, 2] = np.nan  # mode 2 cannot be predicted
    bank[0]["Q"][11:, 2] = 0.0
    assert runner.scan([0], [10], scans[1][0], R)[0] == imm.OK
    obj = runner.objects[0]
    assert obj["mu"][2] == pytest.approx(1e-6, rel=1e-3)
    assert np.isfinite(obj["mean"]).all()
    assert np.isfinite(obj["cov"]).all()
    assert runner.scan([0], [11], scans[2][0], R)[0] == imm.OK
    assert np.isfinite(obj["mean"]).all()
    assert np.isfinite(obj["x"]).all()


# ---- the gate


def test_surprise_is_the_distance_from_what_is_possible() -> None:
    bank = blank(1, 4)
    bank[0]["jump_std"] = [1.0, 4.0, 0.5, 2.0]
    obj = np.zeros(1, layout.OBJECT_DTYPE)
    obj[0]["mean"][:4] = [10.0, -2.0, 1.0, 0.5]
    obj[0]["cov"][range(4), range(4)] = [0.1, 0.2, 0.3, 0.4]
    z, valid = np.array([9.0, -1.0, 1.5, 0.0]), np.ones(4, np.bool_)
    tau = 0.1 - 0.02
    e = z - [10.0 - 2.0 * tau, -2.0, 1.0 + 0.5 * tau, 0.5]
    d = e**2 / (np.array([0.1, 0.2, 0.3, 0.4]) + R + np.array([1.0, 16.0, 0.25, 4.0]))
    value = imm.surprise(bank[0], obj[0], 10, z, R, valid, 0.02, 0.0)
    assert value == pytest.approx(d.sum(), rel=1e-12)
    valid[0] = False
    value = imm.surprise(bank[0], obj[0], 10, z, R, valid, 0.02, 0.0)
    assert value == pytest.approx(d[1:].sum(), rel=1e-12)


# ---- lanes


def keep_left(width: float, y: float, scans: int, prior: float = 10.0) -> float:
    """Lane width that is learned from an object that stays at ``y``."""
    bank = blank(1, 4)
    record = bank[0]
    record["lane_width"], record["lane_prior"], record["lane_range"] = width, prior, [2.4, 4.0]
    record["Q"][10, 0, range(4), range(4)] = 0.1
    add_soft(bank, 0, 2, 0.0, 0.1, (-1, 2))
    runner = Runner(bank, 1)
    for k in range(scans):
        runner.scan([0], [10 if k else -1], [20.0, 0.0, y, 0.0], R)
    return float(runner.objects[0]["lane_width"])


@pytest.mark.parametrize(("y", "width"), [(3.5, 3.5), (-3.5, 3.5), (6.8, 3.4), (9.0, 4.0)])
def test_the_lane_width_is_learned_where_the_object_keeps_to_a_lane(y: float, width: float) -> None:
    """From lane 1, lane -1 and lane 2; never beyond the range."""
    assert keep_left(3.0, y, 2000) == pytest.approx(width, abs=0.03)


def test_the_right_lane_says_nothing_of_the_width() -> None:
    assert keep_left(3.0, 0.4, 100) == 3.0


def test_a_lane_width_can_be_fixed() -> None:
    assert keep_left(3.0, 3.5, 100, prior=0.0) == 3.0


def test_a_new_object_in_the_slot_knows_no_lanes() -> None:
    bank = blank(1, 4)
    bank[0]["lane_prior"], bank[0]["lane_range"] = 10.0, [2.4, 4.0]
    add_soft(bank, 0, 2, 0.0, 0.1, (0, 1))
    runner = Runner(bank, 1)
    runner.scan([0], [-1], [20.0, 0.0, 3.5, 0.0], R)
    runner.scan([0], [10], [20.0, 0.0, 3.5, 0.0], R)
    assert runner.objects[0]["lane_width"] > 3.0
    runner.scan([0], [-1], [20.0, 0.0, 3.5, 0.0], R)
    assert runner.objects[0]["lane_width"] == 3.0
