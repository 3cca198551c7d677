"""How much a vehicle wanders in its lane, against Gaussian evidence with dense matrices."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_roads import Traffic, parameters

from can_imm.estimation import traffic as tr
from can_imm.estimation import wander
from can_imm.estimation.lane_changes import fading
from can_imm.estimation.road import P_BESIDE_SPREAD, P_BESIDE_STD
from can_imm.types import FloatArray

HURRY, ROAD_ERROR = 0.5, 0.02
STD, SPEED_STD = 0.15, 0.3
WIDTH, EGO_SPEED = 3.5, 25.0
NOTHING = np.zeros(wander.N_USUAL)
"""What others have told before any was seen."""


def somebody(par: FloatArray) -> Any:
    one = np.zeros(1, np.dtype(wander.WANDER_FIELDS, align=True))
    one["evidence"] = one["level_place"] = one["level_rate"] = 77.0
    wander.forget_wander_(one[0], NOTHING, par)
    return one[0]


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


def wanderer(rng: np.random.Generator, t: FloatArray, std: float) -> FloatArray:
    """Places and speeds (K, 2) beside a course."""
    factor = np.linalg.cholesky(covariance(t, std) + 1e-10 * np.eye(2 * len(t)))
    return (factor @ rng.standard_normal(2 * len(t))).reshape(-1, 2)


def expected_std(par: FloatArray, evidence: FloatArray) -> float:
    apart = np.log(wander.LEVELS / par[P_BESIDE_STD]) / par[P_BESIDE_SPREAD]
    w = np.exp(evidence - 0.5 * apart**2)
    return math.sqrt(w @ wander.LEVELS**2 / w.sum())


def learn(
    one: Any, par: FloatArray, t: FloatArray, rows: FloatArray, lane: int, *,
    with_place: bool = True, with_speed: bool = True,
) -> None:  # fmt: skip
    """Take in the rows (K, 2) at times t."""
    for k in range(len(t)):
        wander.learn_wander_(
            one, lane, t[k],
            rows[k, 0], STD**2 if with_place else np.inf,
            rows[k, 1], SPEED_STD**2 if with_speed else np.inf, ROAD_ERROR, HURRY, NOTHING, par,
        )  # fmt: skip


def log_evidence(t: FloatArray, rows: FloatArray, used: FloatArray, now: float) -> FloatArray:
    """(levels,) Gaussian likelihoods of one measurement after the other, outliers cut; the older
    the less they count."""
    noise = np.diag(np.tile([STD**2, SPEED_STD**2], len(t)))
    evidence = []
    for level in wander.LEVELS:
        S = covariance(t, math.hypot(level, math.sqrt(ROAD_ERROR))) + noise
        factor = np.linalg.cholesky(S[np.ix_(used, used)])
        e = np.linalg.solve(factor, rows.ravel()[used]) ** 2
        log_p = -0.5 * np.minimum(e, wander.SURPRISE) - np.log(np.diag(factor))
        age = now - np.repeat(t, len(used) // len(t))
        evidence.append(np.exp(-age / wander.MEMORY_S) @ log_p)
    return np.array(evidence)


def test_who_is_not_known_is_like_all() -> None:
    for std, spread in ((0.25, 0.5), (0.1, 1.0), (0.4, 0.05)):
        par = parameters(beside_std=std, beside_spread=spread)
        one = somebody(par)
        assert one["kept"] == wander.NO_LANE
        assert one["beside"] == pytest.approx(expected_std(par, np.zeros(wander.N_LEVELS)))
    assert one["beside"] == pytest.approx(0.4, rel=1e-3), "of one level only"


@pytest.mark.parametrize("used", ["both", "place", "speed"])
def test_the_levels_are_weighed_by_what_they_foretell(used: str) -> None:
    """That is all it knows: how it starts from the stationary covariance, too."""
    rng = np.random.default_rng(5)
    par = parameters(beside_std=0.3, beside_spread=0.5)
    t = np.cumsum(rng.uniform(0.05, 0.13, 60))
    rows = wanderer(rng, t, 0.2) + rng.standard_normal((60, 2)) * [STD, SPEED_STD]
    rows[30] += 2.0
    one = somebody(par)
    what = {"with_place": used != "speed", "with_speed": used != "place"}
    learn(one, par, t, rows, -2, **what)
    of = {"both": np.arange(120), "place": np.arange(0, 120, 2), "speed": np.arange(1, 120, 2)}
    evidence = log_evidence(t, rows, of[used], t[-1])
    evidence -= evidence.max()
    assert np.ptp(evidence) > 1.0
    np.testing.assert_allclose(one["evidence"], evidence, atol=1e-9)
    assert one["beside"] == pytest.approx(expected_std(par, evidence))
    assert one["kept"] == -2


def test_an_outlier_is_cut() -> None:
    """Else it would be proof of a wild one."""
    par = parameters()
    stds = []
    for off in (0.0, 3.0, 300.0):
        one = somebody(par)
        t = np.arange(0.0, 6.0, 0.1)
        learn(one, par, t, np.zeros((60, 2)), 0)
        wander.learn_wander_(one, 0, 6.0, off, STD**2, 0.0, np.inf, ROAD_ERROR, HURRY, NOTHING, par)
        stds.append(float(one["beside"]))
    assert stds[0] < 0.15
    assert stds[1:] == pytest.approx([stds[0]] * 2, rel=0.05)
    assert stds[2] == pytest.approx(stds[1], rel=1e-9)


def test_in_another_lane_it_is_still_the_same_driver() -> None:
    """There it begins at the middle, give or take its wander; what was learnt stays."""
    rng = np.random.default_rng(6)
    par = parameters(beside_std=0.3, beside_spread=0.5)
    t = np.arange(0.0, 4.0, 0.1)
    rows = wanderer(rng, t, 0.2) + rng.standard_normal((40, 2)) * [STD, SPEED_STD]
    one = somebody(par)
    learn(one, par, t[:25], rows[:25], 1)
    learn(one, par, t[25:], rows[25:], 2)
    first = log_evidence(t[:25], rows[:25], np.arange(50), t[-1])
    second = log_evidence(t[25:], rows[25:], np.arange(30), t[-1])
    evidence = first + second
    np.testing.assert_allclose(one["evidence"], evidence - evidence.max(), atol=1e-9)
    # after a time in which it kept none, too
    again = somebody(par)
    learn(again, par, t[:25], rows[:25], 1)
    again["kept"] = wander.NO_LANE
    learn(again, par, t[25:], rows[25:], 1)
    np.testing.assert_allclose(again["evidence"], one["evidence"], atol=1e-9)


@pytest.mark.parametrize("lane", [1, 2])
@pytest.mark.parametrize("gap", [0.1, 0.9, 7.0])
def test_what_was_learnt_fades_with_time(gap: float, lane: int) -> None:
    """Whether the vehicle was seen in it or not."""
    rng = np.random.default_rng(7)
    par = parameters()
    t = np.arange(0.0, 20.0, 0.1)
    row = np.array([0.3, 0.1])
    one = somebody(par)
    learn(one, par, t, 0.2 * wanderer(rng, t, 0.1), 1)
    evidence = math.exp(-gap / wander.MEMORY_S) * one["evidence"]
    place, rate, cov = (one[f].copy() for f in ("level_place", "level_rate", "level_cov"))
    learn(one, par, t[-1:] + gap, row[None], lane)
    f = np.array(fading(HURRY, gap)).reshape(2, 2)
    for i, level in enumerate(wander.LEVELS):
        S = np.diag([1.0, HURRY**2]) * (level**2 + ROAD_ERROR)
        P, x = S, np.zeros(2)
        if lane == 1:
            P = np.array([[cov[i, 0], cov[i, 1]], [cov[i, 1], cov[i, 2]]])
            P, x = f @ (P - S) @ f.T + S, f @ [place[i], rate[i]]
        factor = np.linalg.cholesky(P + np.diag([STD**2, SPEED_STD**2]))
        e = np.linalg.solve(factor, row - x)
        evidence[i] -= 0.5 * e @ e + np.log(np.diag(factor)).sum()
    np.testing.assert_allclose(one["evidence"], evidence - evidence.max(), atol=1e-9)


# ---- what is usual


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.6), st.floats(0.01, 1.0), st.floats(0.01, 1.0))
def test_who_is_like_the_others(seed: int, std: float, spread: float, spread_all: float) -> None:
    """Levels are drawn about a median, which is drawn about the preset's and told by others."""
    rng = np.random.default_rng(seed)
    par = parameters(
        beside_std=std, beside_spread=spread, beside_spread_all=spread_all, beside_margin=1.5
    )
    one = somebody(par)
    one["evidence"] = -rng.exponential(3.0, wander.N_LEVELS)
    others = rng.normal(0.0, 3.0, wander.N_USUAL)
    wander.weigh_levels_(one, others, par)
    z = np.linspace(-4.0, 4.0, wander.N_USUAL)
    medians = math.log(std) + spread_all * z
    log_p = -0.5 * ((np.log(wander.LEVELS) - medians[:, None]) / spread) ** 2
    log_p -= np.logaddexp.reduce(log_p, axis=1)[:, None]
    told = np.logaddexp.reduce(log_p + one["evidence"], axis=1)
    np.testing.assert_allclose(one["told"], told, atol=1e-9)
    w = log_p + one["evidence"] + (others - 0.5 * z**2)[:, None]
    w = np.exp(w - w.max())
    mean = (w @ wander.LEVELS**2).sum() / w.sum()
    assert one["beside"] == pytest.approx(1.5 * math.sqrt(mean))


def test_what_vehicles_told_stays_when_they_leave_and_fades() -> None:
    calm, lively = (
        keep_lanes([std] * 4, 30.0, 3, beside_spread_all=0.5)[0] for std in (0.06, 0.25)
    )
    said = [t.filter["party"]["told"][:4].sum(axis=0) for t in (calm, lively)]
    assert np.argmax(said[0]) < np.argmax(said[1])
    new = []
    for traffic, told in zip((calm, lively), said, strict=True):
        T = traffic.filter
        for _ in range(20):
            traffic.nothing(speed=EGO_SPEED, yaw_rate=0.0)
        assert not T["party"]["told"].any()
        gone = T["gone"].copy()
        np.testing.assert_allclose(gone, told, rtol=0.01, atol=0.05)
        traffic.scan([9], [[30.0, 0.0]], speed=EGO_SPEED, yaw_rate=0.0, speeds=False)
        new.append(float(T["party"]["beside"][0]))
        np.testing.assert_allclose(T["gone"], math.exp(-0.1 / tr.GONE_S) * gone, rtol=1e-9)
    assert new[0] < 0.8 * new[1]


# ---- in traffic


def keep_lanes(
    stds: list[float], seconds: float, seed: int, **changes: float
) -> tuple[Traffic, FloatArray]:
    """Vehicles in lanes 1, 0, -1, 1, ... that wander so much, and where they are at the end."""
    rng = np.random.default_rng(seed)
    traffic = Traffic(parameters(beside_spread=0.6, **changes))
    t = np.arange(0.0, seconds, 0.1)
    n = len(stds)
    y = np.column_stack([wanderer(rng, t, std)[:, 0] for std in stds])
    y += WIDTH * (1 - np.arange(n) % 3)
    for row in y:
        xy = np.column_stack((25.0 + 12.0 * np.arange(n), row + 0.05 * rng.standard_normal(n)))
        traffic.scan(range(n), xy, speed=EGO_SPEED, yaw_rate=0.0, std=0.05, speeds=False)
    return traffic, y[-1]


def test_calm_and_lively_drivers_get_their_levels() -> None:
    """Where four others tell the road: of one driver among a few it is hard to know."""
    learnt = []
    for seed in range(4):
        for std in (0.06, 0.25):
            traffic, _ = keep_lanes([0.06, std, 0.06, 0.06, 0.06], 30.0, seed)
            learnt.append(traffic.filter["party"]["beside"][:5])
    stds = np.array(learnt)
    assert np.median(stds[:, [0, 2, 3, 4]]) < 0.09
    calm, lively = stds[:, 1].reshape(-1, 2).T
    assert calm.max() < 0.13
    assert np.median(lively) > 0.16
    assert (lively > 1.3 * calm).all()


def test_who_drives_calmly_is_sooner_seen_to_leave() -> None:
    seen = []
    for seed in range(3):
        for std in (0.06, 0.4):
            traffic, last = keep_lanes([0.1, std, 0.1], 30.0, seed)
            t = np.arange(0.1, 5.0, 0.1)
            p = []
            for u in np.minimum(t / 4.3, 1.0):
                y = last.copy()
                y[1] += WIDTH * u * u * (3.0 - 2.0 * u)
                xy = np.column_stack((25.0 + 12.0 * np.arange(3), y))
                traffic.scan(range(3), xy, speed=EGO_SPEED, yaw_rate=0.0, std=0.05, speeds=False)
                p.append(traffic.changing(1)[0])
            assert np.nanmax(p) > 0.8
            seen.append(t[np.argmax(np.array(p) > 0.5)])
    calm, lively = np.array(seen).reshape(-1, 2).T
    assert (calm < lively).all()
    assert (lively - calm).mean() > 0.15


@pytest.mark.parametrize("moved", [1, -1])
def test_lanes_that_are_kept_count_anew_when_the_ego_changes_its_own(moved: int) -> None:
    traffic, _ = keep_lanes([0.1, 0.1, 0.1], 3.0, 1)
    T = traffic.filter
    T["party"]["kept"][2] = wander.NO_LANE
    evidence = T["party"]["evidence"].copy()
    tr.change_lane_(T, moved)
    assert T["party"]["kept"][:3].tolist() == [1 - moved, -moved, wander.NO_LANE]
    np.testing.assert_array_equal(T["party"]["evidence"], evidence)


@pytest.mark.parametrize("side", [1, -1])
def test_an_ego_that_changes_lanes_does_not_make_others_lively(side: int) -> None:
    """They keep their lanes, which are others from then on."""
    traffic, last = keep_lanes([0.1, 0.1, 0.1], 20.0, 2)
    before = traffic.filter["party"]["beside"][:3].copy()
    heading, moves, ahead = 0.0, [], 25.0 + 12.0 * np.arange(3)
    for k in range(100):
        u, was = min(max((0.1 * k - 2.0) / 4.5, 0.0), 1.0), heading
        heading = side * WIDTH * 6.0 * u * (1.0 - u) / 4.5 / EGO_SPEED
        y = last - side * WIDTH * u * u * (3.0 - 2.0 * u) - heading * ahead
        moves.append(
            traffic.scan(
                range(3), np.column_stack((ahead, y)), speed=EGO_SPEED,
                yaw_rate=(heading - was) / 0.1, std=0.05, speeds=False,
            )
        )  # fmt: skip
        lanes = np.array([1, 0, -1]) - sum(moves)
        assert traffic.filter["party"]["kept"][:3].tolist() == lanes.tolist()
    assert [m for m in moves if m] == [side]
    assert (traffic.filter["party"]["beside"][:3] < 1.3 * before).all()
