"""Lane changes scan by scan, against all hypotheses written out with dense Gaussians."""

from __future__ import annotations

import functools
import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_roads import parameters

from can_imm.estimation import changing as ch
from can_imm.estimation import lane_changes as lc
from can_imm.estimation import road
from can_imm.estimation.guides import NOTE_DTYPE, position
from can_imm.types import REPORT_DTYPE, FloatArray

WIDTH, HURRY, RATE, STEADY = 3.5, 0.5, 0.03, 0.1
LEVEL, ROAD_ERROR = 0.25, 0.02
STD, SPEED_STD = 0.15, 0.3
NEVER = 100.0
"""Courses that settle after so long are never merged."""


def one_level(**changes: float) -> FloatArray:
    """All vehicles wander by `LEVEL`."""
    return parameters(
        beside_std=LEVEL, beside_spread=0.01, beside_rate=HURRY,
        change_rate=RATE, change_steady=STEADY, **changes,
    )  # fmt: skip


def nobody() -> Any:
    changes = np.zeros(1, ch.CHANGES_DTYPE)
    changes["since"] = changes["t"] = np.nan
    return changes[0]


def follow(
    one: Any, par: FloatArray, t: float, y: float, vy: float | None = None, error: float = 0.0
) -> tuple[float, float]:
    """Take in a measurement; returns the probabilities after it."""
    rv = np.inf if vy is None else SPEED_STD**2
    ch.follow_(one, t, y, STD**2, 0.0 if vy is None else vy, rv, error, WIDTH, par)
    return ch.probabilities(one, t)


def follow_each(
    one: Any, par: FloatArray, t: FloatArray, y: FloatArray, vy: FloatArray | None, error: float
) -> FloatArray:
    """(K, 2) after each measurement."""
    speeds = [None] * len(t) if vy is None else vy.tolist()
    rows = zip(t.tolist(), y.tolist(), speeds, strict=True)
    return np.array([follow(one, par, *row, error) for row in rows])


def look_back(one: Any, t: FloatArray) -> FloatArray:
    """(K, 2) by what is known now."""
    changes = np.array([one], ch.CHANGES_DTYPE)
    p = np.zeros((len(t), 1, 2))
    for at, row in zip(t.tolist(), p, strict=True):
        ch.tell_changes_(changes, np.zeros(1, np.int32), at, row)
    return p[:, 0]


# ---- the same with dense matrices


def way(u: FloatArray, steady: bool) -> FloatArray:
    """Share of the way done at the share u of the time."""
    u = np.clip(u, 0.0, 1.0)
    smooth = 0.5 * (6 * u**5 - 15 * u**4 + 10 * u**3) + 0.5 * (3 * u**2 - 2 * u**3)
    return u if steady else smooth


def rate(u: FloatArray, steady: bool) -> FloatArray:
    return (way(u + 1e-6, steady) - way(u - 1e-6, steady)) / 2e-6


def covariance(t: FloatArray, std: float) -> FloatArray:
    """Of a Matern 3/2 process at times t (K,): place and rate in turn (2 K, 2 K)."""
    tau = t[:, None] - t[None, :]
    fade = std**2 * np.exp(-HURRY * abs(tau))
    C = np.zeros((2 * len(t), 2 * len(t)))
    C[::2, ::2] = fade * (1.0 + HURRY * abs(tau))
    C[::2, 1::2] = fade * HURRY**2 * tau
    C[1::2, ::2] = C[::2, 1::2].T
    C[1::2, 1::2] = fade * HURRY**2 * (1.0 - HURRY * abs(tau))
    return C


def whitener(t: FloatArray, std: float, with_speed: bool) -> tuple[FloatArray, Any]:
    """Lower triangular factor of the measurements' covariance, and which are used."""
    used = np.arange(0, 2 * len(t), 1 if with_speed else 2)
    noise = np.tile([STD**2, SPEED_STD**2], len(t))
    return np.linalg.cholesky((covariance(t, std) + np.diag(noise))[np.ix_(used, used)]), used


class WrittenOut:
    """All hypotheses: a lane kept, or one change that began before the first measurement or in one
    of the spans since; what is known of each after every measurement."""

    def __init__(self, t: FloatArray, y: FloatArray, vy: FloatArray | None, std: float) -> None:
        n = len(t)
        stay = np.concatenate(([0.0], np.cumsum(np.log1p(-RATE * np.diff(t)))))
        begins = []
        last = 0
        for k in range(1, n):
            if t[k] - t[last] >= ch.APART:
                begins.append((k, 0.5 * (t[k] + t[last]), t[k] - t[last]))
                last = k
        means, priors, begun, lanes = [], [], [], []
        self.start, self.end, self.side = [], [], []
        durations = lc.SHORTEST * (lc.LONGEST / lc.SHORTEST) ** np.linspace(0, 1, lc.N_DURATIONS)
        p = np.exp(-0.5 * (np.log(durations / lc.USUAL) / lc.SPREAD) ** 2)
        usual = list(zip(durations, p / p.sum(), strict=True))
        for lane in range(-lc.EDGE, lc.EDGE + 1):
            means.append(np.tile([lane * WIDTH, 0.0], n))
            priors.append(stay)
            begun.append(0)
            keep = len(lanes)
            lanes.append(keep)
            self.start.append(0.0)
            self.end.append(0.0)
            self.side.append(0)
            sides = (1, -1) if abs(lane) <= 2 else ()
            for (usually, share), steady, side in itertools.product(usual, (False, True), sides):
                lasts = usually * (lc.STEADY_TIME if steady else 1.0)
                share *= STEADY if steady else 1.0 - STEADY
                under_way = [
                    (0, t[0] - (b + 0.5) / lc.N_BEGUN * lasts, lasts / lc.N_BEGUN)
                    for b in range(lc.N_BEGUN)
                ]
                for first, start, span in under_way + begins:
                    u = (t - start) / lasts
                    on = np.arange(n) >= first
                    mean = np.zeros((n, 2))
                    mean[:, 0] = WIDTH * (lane + side * on * way(u, steady))
                    mean[:, 1] = WIDTH * side * on * rate(u, steady) / lasts
                    means.append(mean.ravel())
                    log_prior = stay[max(first - 1, 0)] + math.log(0.5 * RATE * span * share)
                    priors.append(np.full(n, log_prior))
                    begun.append(first)
                    lanes.append(keep)
                    self.start.append(start)
                    self.end.append(start + lasts)
                    self.side.append(side)
        factor, used = whitener(t, std, vy is not None)
        z = np.column_stack((y, np.zeros(n) if vy is None else vy)).ravel()
        e = np.linalg.solve(factor, (z - np.array(means))[:, used].T) ** 2
        each = len(used) // n
        misfit = np.cumsum(np.minimum(e, ch.OUTLIER), axis=0)[each - 1 :: each]
        prior = np.array(priors)
        self.log_w = prior - 0.5 * misfit.T
        # those that become impossible are given up, and so is what would have come of them; at
        # first what does not pass by is out of the question
        first, unborn = np.array(begun), np.arange(n) < np.array(begun)[:, None]
        self.kept = np.full_like(self.log_w, -np.inf)
        side = np.array(self.side)
        passes = abs(y[0] / WIDTH - np.array(means)[lanes, 0] / WIDTH - 0.5 * side) <= 1.0
        alive = (first == 0) & (prior[:, 0] >= -ch.IMPOSSIBLE) & (passes | (side == 0))
        for k in range(n):
            possible = self.log_w[:, k] - self.log_w[alive, k].max() >= -ch.IMPOSSIBLE
            alive &= possible
            self.kept[alive, k] = self.log_w[alive, k]
            alive |= alive[lanes] & possible & (first == k + 1)
        self.log_w[unborn] = -np.inf

    def probability(self, k: int, t: float, log_w: FloatArray) -> tuple[float, float]:
        """Of changing at a time t, by what was measured until k."""
        w = np.exp(log_w[:, k] - log_w[:, k].max())
        during = (np.array(self.start) <= t) & (t < np.array(self.end))
        side = np.array(self.side)
        left, right = (w[during & (side == one)].sum() / w.sum() for one in (1, -1))
        return left, right

    def scan_by_scan(self, t: FloatArray, log_w: FloatArray) -> FloatArray:
        return np.array([self.probability(k, at, log_w) for k, at in enumerate(t)])


@functools.cache
def wanderer(t: tuple[float, ...]) -> FloatArray:
    """Makes wander of 1 m at these times out of white noise."""
    return np.linalg.cholesky(covariance(np.array(t), 1.0) + 1e-8 * np.eye(2 * len(t)))


def drive(
    rng: np.random.Generator,
    t: FloatArray,
    lane: int,
    side: int,
    start: float,
    lasts: float = 4.2,
    std: float = LEVEL,
    steady: bool = False,
) -> tuple[FloatArray, FloatArray]:
    """Measured places and speeds of a vehicle that changes lanes once (side 0: not at all)."""
    wander = (std * wanderer(tuple(t - t[0])) @ rng.standard_normal(2 * len(t))).reshape(-1, 2)
    u = (t - start) / lasts
    y = WIDTH * (lane + side * way(u, steady)) + wander[:, 0]
    vy = WIDTH * side * rate(u, steady) / lasts + wander[:, 1]
    noise = rng.standard_normal((2, len(t)))
    return y + STD * noise[0], vy + SPEED_STD * noise[1]


CASES = [
    (0, 1, 1.5, False), (1, -1, 2.5, False), (0, 0, 0.0, False), (0, 1, -2.5, False),
    (-1, -1, 4.0, False), (0, 1, 2.0, True),
]  # fmt: skip


@pytest.mark.parametrize("with_speed", [True, False])
@pytest.mark.parametrize("case", CASES)
def test_it_is_what_all_hypotheses_say(
    case: tuple[int, int, float, bool], with_speed: bool
) -> None:
    """After every measurement; and, by all of them, of every moment before."""
    lane, side, start, steady = case
    rng = np.random.default_rng([lane + 1, side + 1, 3])
    t = 5.0 + np.cumsum(rng.uniform(0.05, 0.13, 70))
    y, vy = drive(rng, t, lane, side, t[0] + start, 2.6 if steady else 4.2, steady=steady)
    speeds = vy if with_speed else None
    std = math.hypot(LEVEL, math.sqrt(ROAD_ERROR))
    oracle = WrittenOut(t, y, speeds, std)
    one = nobody()
    p = follow_each(one, one_level(settle=NEVER), t, y, speeds, ROAD_ERROR)
    np.testing.assert_allclose(p, oracle.scan_by_scan(t, oracle.kept), atol=1e-6)
    back = np.sort(np.concatenate((t, rng.uniform(t[0], t[-1] + 1.0, 30))))
    expected = np.array([oracle.probability(-1, at, oracle.kept) for at in back])
    np.testing.assert_allclose(look_back(one, back), expected, atol=1e-6)
    # it costs little that most hypotheses are given up
    expected = oracle.scan_by_scan(t, oracle.log_w)
    assert np.quantile(abs(p - expected), 0.98) < 0.02
    assert abs(p - expected).mean() < 0.002
    assert (p[:, 0 if side > 0 else 1].max() > 0.9) == (side != 0)


@pytest.mark.parametrize("case", CASES[:2])
def test_a_course_that_settled_is_one_with_its_lane(case: tuple[int, int, float, bool]) -> None:
    """Then nearly the same is said, at less cost."""
    lane, side, start, _ = case
    rng = np.random.default_rng([lane + 1, side + 1])
    t = np.cumsum(rng.uniform(0.05, 0.13, 110))
    y, vy = drive(rng, t, lane, side, t[0] + start)
    oracle = WrittenOut(t, y, vy, LEVEL)
    one = nobody()
    p = follow_each(one, one_level(settle=1.0), t, y, vy, 0.0)
    expected = oracle.scan_by_scan(t, oracle.log_w)
    assert abs(p - expected).max() < 0.1
    assert abs(p - expected).mean() < 0.005
    courses = one["course"][: one["n"]]
    assert (t[-1] - courses["start"] < courses["duration"] + 1.0).all()
    assert p[-1].sum() < 0.05
    there = lc.EDGE + lane + side
    assert one["log_w"].argmax() == there
    # it is where the best course was
    other = nobody()
    follow_each(other, one_level(settle=NEVER), t, y, vy, 0.0)
    courses = other["course"][: other["n"]]
    best = courses[courses["log_w"].argmax()]
    assert one["place"][there] == pytest.approx(best["place"], abs=0.01)
    assert one["rate"][there] == pytest.approx(best["rate"], abs=0.01)


# ---- how much a vehicle wanders


def prior_variance(par: FloatArray, evidence: FloatArray) -> float:
    apart = np.log(ch.LEVELS / par[road.P_BESIDE_STD]) / par[road.P_BESIDE_SPREAD]
    w = np.exp(evidence - 0.5 * apart**2)
    return float(w @ ch.LEVELS**2 / w.sum())


@pytest.mark.parametrize("with_speed", [True, False])
def test_the_levels_of_wander_are_weighed_by_what_they_foretell(with_speed: bool) -> None:
    """Gaussian likelihoods measurement by measurement, outliers cut; the older the less they count.

    That is all it knows: how it starts from the prior, too.
    """
    rng = np.random.default_rng(5)
    par = parameters(beside_std=0.3, beside_spread=0.5, beside_rate=HURRY, change_rate=1e-6)
    t = np.cumsum(rng.uniform(0.05, 0.13, 60))
    y, vy = drive(rng, t, 1, 0, 0.0, std=0.2)
    y[30] += 1.5
    one = nobody()
    assert ch.wander_variance(one, par) == pytest.approx(prior_variance(par, np.zeros(5)))
    p = follow_each(one, par, t, y, vy if with_speed else None, ROAD_ERROR)
    assert p.max() < ch.CALM
    z = np.column_stack((y - WIDTH, vy)).ravel()
    evidence = []
    for level in ch.LEVELS:
        factor, used = whitener(t, math.hypot(level, math.sqrt(ROAD_ERROR)), with_speed)
        e = np.linalg.solve(factor, z[used]) ** 2
        assert (e > ch.SURPRISE).any(), "an outlier is among them"
        log_p = -0.5 * np.minimum(e, ch.SURPRISE) - np.log(np.diag(factor))
        age = t[-1] - np.repeat(t, len(used) // len(t))
        evidence.append(np.exp(-age / ch.MEMORY_S) @ log_p)
    expected = np.array(evidence) - max(evidence)
    assert np.ptp(expected) > 1.0
    np.testing.assert_allclose(one["evidence"], expected, atol=1e-6)
    assert ch.wander_variance(one, par) == pytest.approx(prior_variance(par, expected))


def lane_keeper(seed: int, std: float, par: FloatArray, seconds: float = 40.0) -> Any:
    t = np.arange(0.0, seconds, 0.1)
    y, vy = drive(np.random.default_rng(seed), t, 0, 0, 0.0, std=std)
    one = nobody()
    follow_each(one, par, t, y, vy, 0.0)
    return one


SPREAD_OUT = parameters(beside_std=0.3, beside_spread=0.6, beside_rate=HURRY)


def test_how_much_a_vehicle_wanders_is_learnt() -> None:
    learnt = []
    for std in (0.1, 0.25, 0.6):
        of = [lane_keeper(seed, std, SPREAD_OUT) for seed in range(5)]
        learnt.append([math.sqrt(ch.wander_variance(one, SPREAD_OUT)) for one in of])
    assert np.median(learnt[0]) < 0.15
    assert 0.15 < np.median(learnt[1]) < 0.38
    assert np.median(learnt[2]) > 0.42


def test_after_a_gap_it_is_another_vehicle() -> None:
    rng = np.random.default_rng(2)
    t = np.arange(0.0, 3.0, 0.1)
    y, vy = drive(rng, t, 0, 1, 0.5)
    for gap, forgets in ((ch.LONGEST_S - 0.01, False), (ch.LONGEST_S + 0.01, True)):
        one, fresh = lane_keeper(1, 0.1, SPREAD_OUT), nobody()
        later = t + one["t"] + gap
        p = [follow_each(o, SPREAD_OUT, later, y, vy, 0.0) for o in (one, fresh)]
        same = np.allclose(p[0], p[1], rtol=0.0, atol=1e-12)
        assert same == forgets
        wander = [ch.wander_variance(o, SPREAD_OUT) for o in (one, fresh)]
        assert (wander[0] == wander[1]) == forgets
        # of what was before nothing is known any more
        assert np.isnan(ch.probabilities(one, later[0] - 0.1)).any() == forgets
        assert np.isfinite(ch.probabilities(one, later[0])).all()


def test_who_drives_calmly_is_sooner_seen_to_leave() -> None:
    t = np.arange(0.0, 4.3, 0.1)
    u = t / 4.3
    seen = []
    for seed in range(5):
        for std in (0.1, 0.6):
            one = lane_keeper(seed, std, SPREAD_OUT)
            # from where it keeps its lane on
            place = float(one["place"][lc.EDGE])
            y, vy = place + WIDTH * way(u, False), WIDTH * rate(u, False) / 4.3
            p = follow_each(one, SPREAD_OUT, one["t"] + 0.1 + t, y, vy, 0.0)
            seen.append(t[np.argmax(p[:, 0] > 0.5)])
            assert p[:, 0].max() > 0.9
    calm, lively = np.array(seen).reshape(-1, 2).T
    assert (calm < lively).all()
    assert (lively - calm).mean() > 0.2


@pytest.mark.parametrize("side", [1, -1])
def test_what_is_a_lane_change_is_no_wander(side: int) -> None:
    """Then it wanders about the middle of its new lane, also before that is settled."""
    par = parameters(beside_std=0.3, beside_spread=0.6, beside_rate=HURRY, settle=3.0)
    one = lane_keeper(3, 0.1, par, 30.0)
    before = ch.wander_variance(one, par)
    t = one["t"] + 0.1 + np.arange(0.0, 9.0, 0.1)
    y, vy = drive(np.random.default_rng(4), t, 0, side, t[0] + 1.0, std=0.1)
    kept = []
    for row in zip(t.tolist(), y.tolist(), vy.tolist(), strict=True):
        follow(one, par, *row)
        kept.append(int(one["kept"]) - lc.EDGE if one["kept"] >= 0 else None)
        assert ch.wander_variance(one, par) < 1.5 * before
    assert [lane for lane, _ in itertools.groupby(kept)] == [0, None, side]
    settled = t > t[0] + 1.0 + 4.2 + 3.0
    assert kept.index(side) < np.argmax(settled) - 10


# ---- lanes of another number


@pytest.mark.parametrize("moved", [1, -1])
@pytest.mark.parametrize("at", [25, 45, 80])
def test_after_the_egos_lane_change_the_lanes_are_as_if_numbered_so_before(
    moved: int, at: int
) -> None:
    """While it is kept, changed, and thereafter."""
    par = parameters()
    t = np.arange(0.0, 12.0, 0.1)
    y, vy = drive(np.random.default_rng(6), t, 1, -1, 3.0)
    changes = np.array([nobody(), nobody()])
    p = follow_each(changes[0], par, t[:at], y[:at], vy[:at], 0.0)
    ch.shift_changes_(changes, moved)
    assert ch.probabilities(changes[0], t[at - 1]) == pytest.approx(p[-1])
    rest = follow_each(changes[0], par, t[at:], y[at:] - moved * WIDTH, vy[at:], 0.0)
    other = nobody()
    expected = follow_each(other, par, t, y - moved * WIDTH, vy, 0.0)
    np.testing.assert_allclose(np.concatenate((p, rest)), expected, atol=1e-6)
    assert expected.max() > 0.9
    np.testing.assert_allclose(changes[0]["evidence"], other["evidence"], atol=1e-6)
    assert changes[0]["kept"] == other["kept"] == lc.EDGE - moved
    assert math.isnan(changes[1]["t"])


def test_beyond_the_last_lane_nothing_is_known() -> None:
    """Until it is measured again."""
    par = parameters()
    for side in (1, -1):
        changes = np.array([nobody()])
        for k in range(30):
            follow(changes[0], par, 0.1 * k, side * lc.EDGE * WIDTH, 0.0)
        for moved in range(1, 4):
            ch.shift_changes_(changes, -side)
            follow(changes[0], par, 3.0 + 0.1 * moved, side * (lc.EDGE + moved) * WIDTH, 0.0)
        for k in range(30):
            p = follow(changes[0], par, 3.4 + 0.1 * k, side * WIDTH, 0.0)
            assert min(p) >= 0.0
            assert sum(p) <= 1.0


# ---- whatever is measured

LARGE = st.one_of(st.floats(-20.0, 20.0), st.floats(-1e9, 1e9))
ROW = st.tuples(
    st.floats(0.001, 1.3),
    LARGE,
    st.floats(0.001, 1e4),
    LARGE,
    st.one_of(st.none(), st.floats(0.001, 1e4)),
    st.floats(0.0, 100.0),
    st.sampled_from([0, 0, 0, 0, 1, -1]),
    st.booleans(),
)


@settings(max_examples=150)
@given(st.lists(ROW, min_size=1, max_size=40), st.floats(2.5, 4.5))
def test_probabilities_are_probabilities(rows: Any, width: float) -> None:
    """Outliers, gaps, places or speeds that are missing, lanes of another number."""
    par = parameters()
    changes = np.array([nobody()])
    one = changes[0]
    t = 0.0
    for dt, y, std, vy, speed_std, error, moved, known in rows:
        t += dt
        r, rv = std**2 if known else np.inf, np.inf if speed_std is None else speed_std**2
        ch.follow_(one, t, y, r, vy, rv, error, width, par)
        assert 0 <= one["n"] <= ch.N_COURSES
        for at in (t, t - 0.5, t + 0.5):
            left, right = ch.probabilities(one, at)
            if at < one["since"]:
                assert math.isnan(left)
                assert math.isnan(right)
                continue
            assert left >= 0.0
            assert right >= 0.0
            assert left + right <= 1.0 + 1e-9
        assert ch.LEVELS[0] ** 2 <= ch.wander_variance(one, par) <= ch.LEVELS[-1] ** 2
        if moved:
            ch.shift_changes_(changes, moved)


@pytest.mark.parametrize("y", [0.5 * WIDTH, -2.5 * WIDTH])
def test_there_are_only_so_many_courses(y: float) -> None:
    """Of a vehicle between two lanes of which hardly anything is known."""
    par = parameters(change_rate=1.0)
    one = nobody()
    most = 0
    for k in range(60):
        ch.follow_(one, 0.13 * k, y, 100.0**2, 0.0, np.inf, 100.0, WIDTH, par)
        most = max(most, int(one["n"]))
        assert np.isfinite(ch.probabilities(one, 0.13 * k)).all()
    assert most == ch.N_COURSES


def wild(seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Places and speeds that follow from no model, with gaps."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(np.where(rng.random(120) < 0.03, 1.2, rng.uniform(0.03, 0.11, 120)))
    y = np.cumsum(rng.normal(0.0, 0.2, 120)) + 5.0 * (rng.random(120) < 0.03)
    return t, y, np.gradient(y, t) + rng.normal(0.0, 0.3, 120)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("with_speed", [True, False])
def test_left_and_right_are_alike(seed: int, with_speed: bool) -> None:
    t, y, vy = wild(seed)
    par = parameters()
    one, mirrored = nobody(), nobody()
    p = follow_each(one, par, t, y, vy if with_speed else None, ROAD_ERROR)
    q = follow_each(mirrored, par, t, -y, -vy if with_speed else None, ROAD_ERROR)
    np.testing.assert_allclose(p, q[:, ::-1], atol=1e-9)
    np.testing.assert_allclose(one["evidence"], mirrored["evidence"], atol=1e-9)
    assert p.max() > 0.5


@pytest.mark.parametrize("seed", range(4))
def test_it_does_not_matter_when(seed: int) -> None:
    t, y, vy = wild(seed)
    par = parameters()
    p = follow_each(nobody(), par, t, y, vy, ROAD_ERROR)
    q = follow_each(nobody(), par, t + 1e4, y, vy, ROAD_ERROR)
    np.testing.assert_allclose(p, q, atol=1e-6)


# ---- scans


class Slots:
    """Two slots on a straight road that the ego drives along the middle of its lane."""

    def __init__(self) -> None:
        self.par = parameters()
        x, P = road.new_road(self.par)
        self.road, self.P = x[: road.N_ROAD], 1e-6 * P[: road.N_ROAD, : road.N_ROAD]
        self.changes = np.array([nobody(), nobody()])
        self.t = 0.0

    def scan(
        self,
        places: dict[int, float],
        speed: float = 0.0,
        angle: float = 0.0,
        **notes: dict[int, float],
    ) -> None:
        """Vehicles at 40 m by slot, that in slot 0 with this speed to the left; notes that are not
        given say the usual."""
        self.t += 0.1
        note = np.zeros(2, NOTE_DTYPE)
        n = len(places)
        slot = np.array([*places], np.int64)
        note["seen"][slot] = True
        for name, values in notes.items():
            for s, value in values.items():
                note[name][s] = value
        u, w = 40.0, np.array([*places.values()])
        cos, sin = math.cos(angle), math.sin(angle)
        z = np.zeros((n, 4))
        v = speed * (slot == 0)
        z[:, 1], z[:, 3] = v * sin, v * cos
        z[:, 0], z[:, 2] = u * cos + w * sin, w * cos - u * sin
        for k, s in enumerate(slot):
            note["x"][s], note["y"][s], note["noise"][s] = position(z[k], np.full(4, STD**2), angle)
        ch.follow_all_(
            self.changes, self.road, self.P, self.par, self.t, 25.0, note, n, slot,
            z, np.full((n, 4), STD**2), np.ones((n, 4), np.bool_), np.full(n, angle),
        )  # fmt: skip

    def tell(self) -> FloatArray:
        p = np.full((2, 2), -1.0)
        ch.tell_changes_(self.changes, np.zeros(2, np.int32), self.t, p)
        return p


def test_slots_are_told_in_the_order_of_those_in_use() -> None:
    slots = Slots()
    slots.scan({1: 0.5 * WIDTH})
    p = np.full((2, 2), -1.0)
    ch.tell_changes_(slots.changes, np.array([-1, 7], np.int32), slots.t, p)
    np.testing.assert_array_equal(p[0], ch.probabilities(slots.changes[1], slots.t))
    np.testing.assert_array_equal(p[1], -1.0)
    ch.tell_changes_(slots.changes, np.array([7, -1], np.int32), slots.t, p)
    assert np.isnan(p[0]).all(), "of the other one nothing is known"


@pytest.mark.parametrize("seen", [True, False])
def test_a_new_object_in_the_slot_starts_from_nothing(seen: bool) -> None:
    slots, fresh = Slots(), Slots()
    for k in range(25):
        slots.scan({0: 0.1 * k, 1: 0.0}, 1.0)
    assert slots.tell()[0, 0] > 0.9
    slots.scan({0: 3.0} if seen else {}, new={0: 1})
    assert math.isnan(slots.tell()[0, 0]) == (not seen)
    fresh.t = slots.t - 0.1 * seen
    if seen:
        fresh.scan({0: 3.0}, new={0: 1})
    for _ in range(5):
        slots.scan({0: 3.0})
        fresh.scan({0: 3.0})
        np.testing.assert_array_equal(slots.tell()[0], fresh.tell()[0])
    assert ch.wander_variance(slots.changes[0], slots.par) == ch.wander_variance(
        fresh.changes[0], slots.par
    )
    assert slots.changes[1]["t"] < slots.t - 0.5, "the other one was not seen"
    assert np.isfinite(slots.tell()[1]).all()


def test_who_is_not_in_our_direction_changes_no_lanes() -> None:
    slots = Slots()
    for _ in range(10):
        slots.scan({0: 0.0, 1: 0.0})
    slots.scan({0: 0.0, 1: 0.0}, off={0: 0.995, 1: 0.5})
    assert np.isnan(slots.tell()[0]).all()
    assert np.isfinite(slots.tell()[1]).all()
    slots.scan({0: 0.0})
    assert np.isfinite(slots.tell()[0]).all(), "or so it was thought"


def test_what_was_noted_of_those_not_seen_is_old() -> None:
    """Notes are not wiped: such a one may be of another object."""
    slots = Slots()
    for _ in range(10):
        slots.scan({0: 0.0, 1: 0.0})
    slots.scan({1: 0.0}, off={0: 1.0})
    assert np.isfinite(slots.tell()).all()


def test_rows_without_a_slot_and_those_not_taken_are_left_out() -> None:
    slots = Slots()
    slots.scan({0: 0.0, 1: 0.0}, seen={0: False})
    assert np.isnan(slots.tell()[0]).all()
    slots.scan({-1: 0.0})
    assert slots.changes[1]["t"] < slots.t


def test_measured_in_turned_axes() -> None:
    one, other = Slots(), Slots()
    for k in range(12):
        one.scan({0: 0.1 * k, 1: 0.0}, 1.0)
        other.scan({0: 0.1 * k, 1: 0.0}, 1.0, angle=0.3)
    assert one.tell()[0, 0] > 0.5
    np.testing.assert_allclose(one.tell(), other.tell(), atol=1e-9)


@pytest.mark.parametrize("side", [1, -1])
def test_when_a_lane_change_began_and_ended(side: int) -> None:
    """Better and better while it lasts, and some time after it; nothing is told of who keeps."""
    rng = np.random.default_rng(8)
    slots = np.zeros(3, ch.CHANGES_DTYPE)
    slots["since"] = slots["t"] = np.nan
    reports = np.zeros(2, REPORT_DTYPE)
    ids = np.array([4, -1, 6], np.int32)
    par, told = one_level(settle=1.5), []
    for t in np.arange(0.0, 12.0, 0.07).tolist():
        u = min(max((t - 3.0) / 4.0, 0.0), 1.0)
        for slot, done in ((0, 0.0), (2, u)):
            slope = 6.0 * u * (1.0 - u) / 4.0 * WIDTH if slot else 0.0
            y = side * WIDTH * done * done * (3.0 - 2.0 * done) + STD * rng.standard_normal()
            follow(slots[slot], par, t, y, side * slope + SPEED_STD * rng.standard_normal())
        ch.tell_times_(slots, ids, reports)
        told.append((t, *reports["change"].ravel().tolist()))
    t, keeps_from, keeps_to, begin, end = np.array(told).T
    assert np.isnan(keeps_from).all()
    assert np.isnan(keeps_to).all()
    assert np.isnan(begin[(t < 2.9) | (t > 10.0)]).all()
    during, after = (t > 5.0) & (t < 7.0), (t > 7.3) & (t < 8.0)
    assert abs(begin[during] - 3.0).max() < 0.6
    assert (end[during] > t[during]).all()
    assert abs(begin[after] - 3.0).max() < 0.4
    assert abs(end[after] - 7.0).max() < 0.4
