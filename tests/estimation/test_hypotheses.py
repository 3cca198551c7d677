"""Hypotheses of who changes lanes: against all of them written out with dense Gaussians, in small
scenes, and by what must not change when they are merged, split, moved or given up."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.gaussian import random_covariance
from small_roads import Traffic, parameters

from can_imm.estimation import hypotheses as hy
from can_imm.estimation import traffic as tr
from can_imm.estimation.guides import GATE, NOTE_DTYPE, meet_
from can_imm.estimation.lane_changes import SPREAD, STEADY_TIME, USUAL
from can_imm.estimation.road import N_ROAD
from can_imm.types import REPORT_DTYPE, FloatArray, Scan

WIDTH, HURRY, RATE, STEADY = 3.5, 0.5, 0.03, 0.1
BEFORE = (1.0 - hy.MIXED) * (STEADY * 0.96 + (1.0 - STEADY) * 0.04) + hy.MIXED * 0.5
"""Share of the lane changes at a constant rate before any was seen."""
LEVEL, STD = 0.25, 0.15
NEVER = 100.0
"""Courses that settle after so long are never merged."""
EGO_SPEED = 28.0
NAN = math.nan


class Drive(Traffic):
    """Traffic whose lateral speeds are measured, too."""

    def see(
        self,
        slots: Any,
        xy: Any,
        vy: Any = None,
        *,
        dt: float = 0.1,
        speed: float = EGO_SPEED,
        yaw_rate: float = 0.0,
        std: float = 0.1,
    ) -> int:
        n = len(slots)
        scan = Scan(n)
        scan.n, scan.valid[:], scan.std[:] = n, True, std
        scan.z[:, [0, 2]] = np.reshape(xy, (n, 2))
        if vy is None:
            scan.valid[:, 3] = False
        else:
            scan.z[:, 3] = vy
        self.t_ns += round(dt * 1e9)
        scan.t_ns = self.t_ns
        self.frame.move(self.t_ns, speed, yaw_rate)
        for s in slots:
            self.age[s] += 1
        return self.frame.watch_(
            self.bank, self.objects, scan, np.array(slots, np.int32), np.zeros(n, np.int8), self.age
        )


# ---- all hypotheses with dense matrices


def known_road(**changes: float) -> FloatArray:
    """Nothing is to be learnt of the road or the ego, and all vehicles wander by `LEVEL`."""
    names = (
        "width_std", "offset_std", "heading_std", "turn_std", "curvature_std", "bias_std",
        "mounting_std", "yaw_noise", "drift",
    )  # fmt: skip
    usual = {
        **dict.fromkeys(names, 1e-7), "beside_std": LEVEL, "beside_spread": 0.001,
        "beside_rate": HURRY, "change_rate": RATE, "change_steady": STEADY, "settle": NEVER,
    }  # fmt: skip
    return parameters(**{**usual, **changes})


def way(u: Any, steady: Any = False) -> FloatArray:
    """Share of the way done at the share u of the time."""
    u = np.clip(u, 0.0, 1.0)
    smooth = 0.5 * (6 * u**5 - 15 * u**4 + 10 * u**3) + 0.5 * (3 * u**2 - 2 * u**3)
    return np.where(steady, u, smooth)


def rate(u: Any, steady: Any = False) -> FloatArray:
    return (way(u + 1e-6, steady) - way(u - 1e-6, steady)) / 2e-6


def covariance(t: FloatArray) -> FloatArray:
    """Of a Matern 3/2 process at times t (K,): place and rate in turn (2 K, 2 K)."""
    tau = t[:, None] - t[None, :]
    fade = LEVEL**2 * np.exp(-HURRY * abs(tau))
    C = np.zeros((2 * len(t), 2 * len(t)))
    C[::2, ::2] = fade * (1.0 + HURRY * abs(tau))
    C[::2, 1::2] = fade * HURRY**2 * tau
    C[1::2, ::2] = C[::2, 1::2].T
    C[1::2, 1::2] = fade * HURRY**2 * (1.0 - HURRY * abs(tau))
    return C


def durations() -> tuple[FloatArray, FloatArray]:
    """Of lane changes, smooth ones and then steady ones; logarithms of their probabilities."""
    usual = np.geomspace(hy.LASTS[0], hy.LASTS[hy.N_DURATIONS - 1], hy.N_DURATIONS)
    p = np.exp(-0.5 * (np.log(usual / USUAL) / SPREAD) ** 2)
    p /= p.sum()
    both = np.concatenate(((1.0 - BEFORE) * p, BEFORE * p))
    return np.concatenate((usual, STEADY_TIME * usual)), np.log(both)


class WrittenOut:
    """Hypotheses with a row of means at all times each, one change after the other.

    Each row of ``courses``: lane, turn, begin, duration.  What is less likely than the best by
    ``impossible`` ends, by ``rare`` begins nothing, and less probable from the start than
    ``unborn`` is none.  A change begins after each course that has ended; or, ``joined``, after all
    of those that led to the same lane, as after the likeliest.
    """

    def __init__(
        self,
        t: FloatArray,
        y: FloatArray,
        vy: FloatArray | None,
        impossible: float = hy.IMPOSSIBLE,
        rare: float = hy.RARE,
        unborn: float = hy.IMPOSSIBLE,
        joined: bool = True,
    ) -> None:
        n = len(t)
        used = np.arange(0, 2 * n, 1 if vy is not None else 2)
        each = len(used) // n
        S = (covariance(t) + STD**2 * np.eye(2 * n))[np.ix_(used, used)]
        whiten = np.linalg.inv(np.linalg.cholesky(S))
        z = np.column_stack((y, np.zeros(n) if vy is None else vy)).ravel()[used]
        lasts, log_p = durations()
        steady = np.arange(len(lasts)) >= hy.N_DURATIONS
        lanes = math.floor(y[0] / WIDTH + 0.5) + np.array([0, -1, 1])
        courses = np.column_stack((lanes, np.zeros((3, 3))))
        means = np.tile(lanes[:, None, None] * [WIDTH, 0.0], (1, n, 1)).reshape(3, -1)
        misfit = ((z - means[:, used]) @ whiten.T) ** 2
        log_w = np.zeros(3)
        begun = t[0]
        self.t, self.after = t, []
        for k in range(n):
            first = k == 0
            if first or t[k] - begun >= hy.APART:
                ended = (courses[:, 1] == 0) | (t[k] - courses[:, 2] >= courses[:, 3])
                spans = lasts / hy.N_BEGUN if first else np.full(len(lasts), t[k] - begun)
                begun = t[k]
                log_prior = np.log(0.5 * RATE * spans) + log_p
                born = np.flatnonzero(log_prior >= -unborn)
                i, b = (a.ravel() for a in np.indices((len(born), hy.N_BEGUN if first else 1)))
                i = born[i]
                start = t[k] - (b + 0.5) * spans[i]
                u = (t[k:] - start[:, None]) / lasts[i, None]
                moved = np.stack(
                    (way(u, steady[i, None]), rate(u, steady[i, None]) / lasts[i, None]), axis=2
                )
                more = [(courses, means, misfit, log_w)]
                free, reached = np.flatnonzero(ended), courses[:, 0] + courses[:, 1]
                groups = [free[reached[free] == lane] for lane in np.unique(reached[free])]
                for those in groups if joined else free[:, None]:
                    total = np.logaddexp.reduce(log_w[those])
                    if total <= log_w.max() - rare:
                        continue
                    q = those[np.argmax(log_w[those])]
                    lane = reached[q]
                    for turn in (-1, 1):
                        if first and abs(y[0] / WIDTH - lane - 0.5 * turn) > 1.0:
                            continue
                        its = np.tile(means[q], (len(i), 1))
                        its[:, 2 * k :] += turn * WIDTH * moved.reshape(len(i), -1)
                        one = np.full((len(i), 1), 1.0)
                        more.append((
                            np.hstack((lane * one, turn * one, start[:, None], lasts[i, None])),
                            its,
                            ((z - its[:, used]) @ whiten.T) ** 2,
                            total + log_prior[i],
                        ))  # fmt: skip
                courses, means, misfit, log_w = (np.concatenate(a) for a in zip(*more, strict=True))
            now = misfit[:, k * each : (k + 1) * each]
            assert (now[log_w > log_w.max() - tr.LIKELY].min(axis=0) < GATE).all(), (
                "it is no outlier"
            )
            log_w = log_w - 0.5 * np.minimum(now, tr.MOST_LOST).sum(axis=1)
            kept = log_w >= log_w.max() - impossible
            courses, means, misfit, log_w = (a[kept] for a in (courses, means, misfit, log_w))
            self.after.append((courses, log_w))

    def probability(self, k: int, at: float) -> FloatArray:
        """Of changing to the left and right at a time, by what was measured until k."""
        (_, turn, start, lasts), log_w = self.after[k][0].T, self.after[k][1]
        w = np.exp(log_w - log_w.max())
        during = (start <= at) & (at < start + lasts)
        return np.array([w[during & (turn == side)].sum() for side in (1, -1)]) / w.sum()

    def scan_by_scan(self) -> FloatArray:
        return np.array([self.probability(k, at) for k, at in enumerate(self.t.tolist())])


@functools.cache
def wanderer(t: tuple[float, ...]) -> FloatArray:
    """Makes wander at these times out of white noise."""
    return np.linalg.cholesky(covariance(np.array(t)) + 1e-9 * np.eye(2 * len(t)))


Case = tuple[int, int, float, bool]
"""Lane, side to which it is left, when [s] from the first scan on, and whether steadily."""


def drive(
    case: Case, n: int = 70, seed: int = 3
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Times between scans, times, measured places and speeds of a vehicle."""
    lane, side, start, steady = case
    rng = np.random.default_rng([lane + 1, side + 1, seed])
    dt = rng.uniform(0.05, 0.13, n)
    dt[0] = 5.0
    t = np.cumsum(np.round(dt * 1e9)) * 1e-9
    wander = (wanderer(tuple(t)) @ rng.standard_normal(2 * n)).reshape(-1, 2)
    lasts = 4.2
    u = (t - t[0] - start) / lasts
    y = WIDTH * (lane + side * way(u, steady)) + wander[:, 0]
    vy = WIDTH * side * rate(u, steady) / lasts + wander[:, 1]
    noise = STD * rng.standard_normal((2, n))
    return dt, t, y + noise[0], vy + noise[1]


def follow_each(
    dt: FloatArray, y: FloatArray, vy: FloatArray | None, **changes: float
) -> tuple[Drive, FloatArray]:
    """Probabilities (K, 2) after each scan of one vehicle, 40 m ahead on a known road."""
    traffic = Drive(known_road(**changes))
    p = []
    for k in range(len(dt)):
        v = None if vy is None else vy[k : k + 1]
        traffic.see([0], [40.0, y[k]], v, dt=dt[k], std=STD)
        p.append(traffic.changing(0))
    assert traffic.filter["party"]["since"][0] == pytest.approx(dt[0]), "it was never lost"
    return traffic, np.array(p)


CASES: list[Case] = [
    (0, 1, 1.5, False), (1, -1, 2.5, False), (0, 0, 0.0, False), (0, 1, -2.5, False),
    (-1, -1, 4.0, False), (0, 1, 1.5, True),
]  # fmt: skip


@pytest.mark.parametrize("with_speed", [True, False])
@pytest.mark.parametrize("case", CASES)
def test_it_is_what_all_hypotheses_say(case: Case, with_speed: bool) -> None:
    """After every scan; and, by all of them, of every moment before.  One change after the other.

    What is given up is given up there, too.
    """
    dt, t, y, vy = drive(case)
    speeds = vy if with_speed else None
    oracle = WrittenOut(t, y, speeds)
    traffic, p = follow_each(dt, y, speeds)
    np.testing.assert_allclose(p, oracle.scan_by_scan(), atol=3e-4)
    back = np.sort(np.random.default_rng(1).uniform(t[0], t[-1] + 1.0, 60))
    expected = np.array([oracle.probability(-1, at) for at in back.tolist()])
    told = np.array([traffic.frame.changing(at)[0] for at in back.tolist()])
    np.testing.assert_allclose(told, expected, atol=3e-4)
    assert np.isnan(traffic.frame.changing(t[0] - 0.01)[0]).all()
    side = case[1]
    assert (p[:, 0 if side > 0 else 1].max() > 0.9) == (side != 0)


@pytest.mark.parametrize(
    ("case", "with_speed"), [(CASES[0], True), (CASES[1], True), (CASES[3], False)]
)
def test_it_costs_little_that_most_hypotheses_are_given_up(case: Case, with_speed: bool) -> None:
    dt, t, y, vy = drive(case)
    speeds = vy if with_speed else None
    p = follow_each(dt, y, speeds)[1]
    off = abs(p - WrittenOut(t, y, speeds, 20.0, 14.0, 25.0, False).scan_by_scan())
    assert off.max() < 0.01
    assert off.mean() < 2e-4


@pytest.mark.parametrize("case", CASES[:2])
def test_a_course_that_settled_is_one_with_its_lane(case: Case) -> None:
    """Then nearly the same is said, at less cost."""
    dt, _, y, vy = drive(case, 110)
    expected = follow_each(dt, y, vy)[1]
    traffic, p = follow_each(dt, y, vy, settle=1.0)
    assert abs(p - expected).max() < 0.01
    assert abs(p - expected).mean() < 1e-3
    T, t = traffic.filter, 1e-9 * traffic.t_ns
    courses = T["local"][: T["n"]]
    courses = courses[courses["who"] == 0]
    changes = courses[courses["turn"] != 0]
    assert (t - changes["start"] < changes["duration"] + 1.0).all()
    lanes = courses["lane"][courses["turn"] == 0]
    assert len(set(lanes.tolist())) == len(lanes)
    best = T["local"][T["choice"][tr.best_global(T), 0]]
    assert (best["lane"], best["turn"]) == (case[0] + case[1], 0)


@given(st.floats(0.01, 0.9), st.floats(0.02, 50.0))
def test_a_lane_change_counts_by_what_it_tells(change_steady: float, odds: float) -> None:
    """By how much likelier what was measured is under one kind, whatever was thought before."""
    par = known_road(change_steady=change_steady)
    T = tr.new_traffic()[0]
    tr.begin_traffic_(T, par, 0.0, WIDTH, 0.01)
    shares = np.array([0.04, 0.5, 0.96])
    p = np.array([(1 - change_steady) * (1 - hy.MIXED), hy.MIXED, change_steady * (1 - hy.MIXED)])
    for k in range(3):
        share = hy.steady_share(T, par)
        assert share == pytest.approx(p @ shares / p.sum())
        like = odds if k != 1 else 1.0
        smooth, steady = 1.0 - share, like * share
        T["party"]["ended"][4] = np.array([smooth, steady]) / (smooth + steady)
        hy.learn_habit_(T, 4, par)
        assert not T["party"]["ended"].any()
        p *= shares * like + (1.0 - shares)
        if p.min() < 1e-3 * p.max():
            return
    assert hy.steady_share(T, par) == pytest.approx(p @ shares / p.sum())


@pytest.mark.parametrize("steady", [True, False])
def test_what_lane_changes_are_like_is_learnt(steady: bool) -> None:
    """By those that have ended, one after the other."""
    traffic = Drive(known_road(settle=1.0))
    T = traffic.filter
    before = hy.steady_share(T, known_road())
    assert before == pytest.approx(BEFORE)
    rng = np.random.default_rng(2)
    lasts = 3.0 if steady else 4.3
    for k in range(300):
        t, begins = 0.1 * k, np.array([3.0, 12.0, 21.0])
        u = (t - begins) / lasts
        y = WIDTH * way(u, steady) @ [1, -1, 1] + rng.normal(0.0, STD)
        vy = WIDTH / lasts * rate(u, steady) @ [1, -1, 1] + rng.normal(0.0, STD)
        traffic.see([0], [40.0, y], vy, std=STD)
        if k in (115, 205, 299):
            share = hy.steady_share(T, known_road())
            assert share > before if steady else share < before, "by each of the three"
            before = share
    assert share > 0.85 if steady else share < 0.06
    before = int(T["n"])
    hy.begin_courses_(T, 0, 1e-9 * traffic.t_ns + 0.1, known_road(), np.zeros(0))
    born = T["local"][before : T["n"]]
    p = np.exp(T["odds"][0, before : T["n"]])
    left = born["turn"] > 0
    assert p[born["steady"] & left].sum() / p[left].sum() == pytest.approx(share, abs=0.01)


@pytest.mark.parametrize("n", [1, 2])
def test_left_and_right_are_alike(n: int) -> None:
    """Where nothing hangs by a hair: of global hypotheses that become the same where a course
    settles, and are as likely but for rounding, any one is kept."""
    rng = np.random.default_rng(5)
    y = np.array([0.3, 4.0]) + np.cumsum(rng.normal(0.0, 0.08, (60, 2)), axis=0)
    told = []
    for mirror in (1, -1):
        traffic = Drive(parameters())
        p = []
        for row in mirror * y[:, :n]:
            xy = np.column_stack(([30.0, 50.0][:n], row))
            traffic.see(range(n), xy, yaw_rate=mirror * 0.003)
            p.append(traffic.frame.changing(1e-9 * traffic.t_ns)[:n, ::mirror])
        told.append(p)
    assert np.nanmax(told[0]) > 0.6
    np.testing.assert_allclose(told[0], told[1], atol=1e-4)


# ---- a road that may bend, an ego that changes lanes


def bend(profile: tuple[list[float], list[float]], here: float, x: float) -> tuple[float, float]:
    """Where the road is x [m] ahead of an ego that has come to ``here``, and its direction there.

    ``profile``: places [m] and the curvature there [1/m].
    """
    s = np.linspace(0.0, x, 400)
    curvature = np.interp(here + s, *profile)
    return float(np.trapezoid((x - s) * curvature, s)), float(np.trapezoid(curvature, s))


def drive_into_a_bend(
    curvature: float,
    ahead: list[float],
    lanes: list[int],
    *,
    seed: int = 1,
    known: bool = True,
    **changes: float,
) -> FloatArray:
    """Probabilities (K, n, 2) scan by scan of vehicles that keep their lanes, so far ahead.

    The bend begins after 120 m; ``known``: how the ego turns.
    """
    rng = np.random.default_rng(seed)
    traffic = Drive(parameters(**changes))
    profile = [120.0, 180.0], [0.0, curvature]
    n, p = len(ahead), []
    for k in range(90):
        here = EGO_SPEED * 0.1 * k
        y, direction = np.array([bend(profile, here, x) for x in ahead]).T
        noise = 0.05 * rng.standard_normal((2, n))
        turning = EGO_SPEED * float(np.interp(here, *profile))
        traffic.see(
            range(n), np.column_stack((ahead, WIDTH * np.array(lanes) + y + noise[0])),
            EGO_SPEED * direction + noise[1], yaw_rate=turning if known else NAN,
        )  # fmt: skip
        p.append(traffic.frame.changing(1e-9 * traffic.t_ns)[:n])
    return np.array(p)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("known", [True, False])
def test_where_all_move_sideways_alike_the_road_bends(side: int, known: bool) -> None:
    """On a road that can't bend all of them would change lanes."""
    bent = side * 1e-3, [40.0, 70.0], [1, -1]
    assert drive_into_a_bend(*bent, known=known).max() < 0.1
    p = drive_into_a_bend(*bent, known=known, curvature_std=1e-6, turn_std=1.0)
    assert (p[:, :, 0 if side > 0 else 1].max(axis=0) > 0.9).all()


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("order", [1, -1])
def test_those_first_seen_in_a_bend_are_in_the_lanes_of_the_same_bend(
    side: int, order: int
) -> None:
    """Far ahead it leads a lane aside, which one vehicle alone would not make anybody believe."""
    rng = np.random.default_rng(4)
    traffic = Drive(parameters())
    ahead, lanes = np.array([12.0, 30.0, 130.0, 140.0, 150.0]), np.array([0, 1, 0, 1, -1])
    turning = EGO_SPEED * side * 5e-4
    for k in range(30):
        y, direction = np.array([bend(([0.0], [side * 5e-4]), 0.0, x) for x in ahead]).T
        noise = 0.05 * rng.standard_normal((2, 5))
        xy = np.column_stack((ahead, WIDTH * lanes + y + noise[0]))
        vy = EGO_SPEED * direction + noise[1]
        traffic.see(range(5)[::order], xy[::order], vy[::order], yaw_rate=turning if k else NAN)
        T = traffic.filter
        best = T["choice"][tr.best_global(T)]
        guide = traffic.guide_of[:5]
        if k > 5:
            assert (T["local"]["lane"][best[guide]] == lanes).all()
            assert not T["local"]["turn"][best[guide]].any()
            assert traffic.frame.changing(1e-9 * traffic.t_ns)[:5].max() < 0.3


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("known", [True, False])
def test_where_one_of_two_moves_it_changes_lanes(side: int, which: int, known: bool) -> None:
    """The other one does not, and the road stays where it is."""
    rng = np.random.default_rng(1)
    traffic = Drive(parameters())
    p = []
    for k in range(110):
        u = (0.1 * k - 4.0) / 4.3
        noise = 0.05 * rng.standard_normal((2, 2))
        y, vy = np.array([-WIDTH, 0.0]) + noise[0], noise[1]
        y[which] += side * WIDTH * way(u)
        vy[which] += side * WIDTH * rate(u) / 4.3
        xy = np.column_stack(([30.0, 45.0], y))
        assert traffic.see([0, 1], xy, vy, yaw_rate=0.0 if known else NAN) == 0
        p.append(traffic.frame.changing(1e-9 * traffic.t_ns)[:2])
        assert abs(traffic.offset) < 0.3
    told, t = np.array(p), 0.1 * np.arange(110)
    its = told[:, which, 0 if side > 0 else 1]
    assert (its[(t > 5.3) & (t < 7.8)] > 0.9).all()
    assert (its[(t < 4.0) | (t > 9.0)] < 0.1).all()
    assert told[:, which, 1 if side > 0 else 0].max() < 0.1
    assert told[:, 1 - which].max() < 0.2


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("known", [True, False])
def test_where_the_ego_changes_lanes_nobody_else_does(side: int, known: bool) -> None:
    """It is said once that the ego has; the others keep the lanes of another number."""
    rng = np.random.default_rng(2)
    traffic = Drive(parameters())
    ahead, lanes = np.array([30.0, 45.0, 60.0]), np.array([-1, 0, 1])
    heading, moves = 0.0, []
    for k in range(130):
        u, before = (0.1 * k - 4.0) / 4.5, heading
        heading = side * WIDTH * float(rate(u)) / 4.5 / EGO_SPEED
        noise = 0.05 * rng.standard_normal((2, 3))
        y = WIDTH * lanes - side * WIDTH * way(u) - heading * ahead + noise[0]
        moved = traffic.see(
            range(3), np.column_stack((ahead, y)), noise[1] - EGO_SPEED * heading,
            yaw_rate=(heading - before) / 0.1 if known else NAN,
        )  # fmt: skip
        moves += [moved] if moved else []
        assert traffic.frame.changing(1e-9 * traffic.t_ns)[:3].max() < 0.1
    assert moves == [side]
    assert abs(traffic.offset) < 0.2
    T = traffic.filter
    best = T["choice"][tr.best_global(T)]
    assert (T["local"]["lane"][best[:3]] == lanes - side).all()
    assert T["local"][best[tr.EGO]]["lane"] + T["local"][best[tr.EGO]]["turn"] == 0


@pytest.mark.parametrize("seed", [2, 3, 5])
def test_what_was_a_lane_change_is_a_bend_when_others_come_there(seed: int) -> None:
    """The first one comes to a bend that is sharper than usual; alone it is said to change lanes
    until it ought to have arrived."""
    bent: Any = 2e-3, [90.0, 60.0, 50.0], [1, 0, -1]
    with_others = drive_into_a_bend(*bent, seed=seed, known=False)
    alone = drive_into_a_bend(bent[0], bent[1][:1], bent[2][:1], seed=seed, known=False)
    assert with_others[:, 0, 0].max() > 0.7
    assert with_others[:, 1:].max() < 0.2
    last, its_last = (int(np.flatnonzero(p[:, 0, 0] > 0.5)[-1]) for p in (with_others, alone))
    assert with_others[last + 6 :, 0].max() < 0.15
    assert its_last > last + 5


# ---- what must not change


def anything(seed: int, each: int = 5, n_global: int = 4) -> Any:
    """A filter amid nothing in particular: three vehicles and the ego, all with some courses."""
    rng = np.random.default_rng(seed)
    T = tr.new_traffic()[0]
    tr.begin_traffic_(T, parameters(), 0.0, WIDTH, 0.01)
    parties = [0, 1, 2, tr.EGO]
    T["party"]["slot"][:3] = [7, 3, 5]
    T["top"] = top = N_ROAD + 6
    T["x"][:top] = rng.normal(size=top)
    T["P"][:top, :top] = random_covariance(rng, top)
    T["n"] = n = each * len(parties)
    local = T["local"][:n]
    local["who"] = rng.permutation(np.repeat(parties, each))
    local["lane"], local["turn"] = rng.integers(-1, 2, n), rng.integers(-1, 2, n)
    local["start"], local["duration"] = rng.uniform(-4.0, 0.0, n), rng.uniform(2.0, 5.0, n)
    T["mean"][:n, :top] = rng.normal(size=(n, top))
    T["n_global"] = n_global
    T["log_w"][:n_global] = -rng.permutation(n_global) * rng.uniform(0.5, 4.0)
    T["rest"][:n_global, :top] = rng.normal(size=(n_global, top))
    T["odds"][:n_global, :n] = rng.uniform(-9.0, -1.0, (n_global, n))
    T["choice"][:] = tr.FREE
    for g in range(n_global):
        for who in parties:
            q = rng.choice(np.flatnonzero(local["who"] == who))
            T["choice"][g, who] = q
            T["odds"][g, q] = 0.0
    return T


def courses_of(T: Any, who: int) -> Any:
    return np.flatnonzero(T["local"]["who"][: T["n"]] == who)


def mean_of(T: Any, g: int) -> FloatArray:
    """(N,) of a global hypothesis."""
    chosen = T["choice"][g][T["choice"][g] != tr.FREE]
    return T["x"] + T["rest"][g] + T["mean"][chosen].sum(axis=0)


def kinds(T: Any, g: int) -> tuple[Any, ...]:
    """From and to which lanes the courses of a global hypothesis lead."""
    return tuple(
        (who, int(T["local"]["lane"][q]), int(T["local"]["turn"][q]))
        for who, q in enumerate(T["choice"][g].tolist())
        if q != tr.FREE
    )


def kinds_but(T: Any, g: int, who: int) -> tuple[Any, ...]:
    """`kinds` of all parties but one."""
    return tuple(one for one in kinds(T, g) if one[0] != who)


SEEDS = st.integers(0, 2**32 - 1)


@settings(max_examples=20)
@given(SEEDS, st.sampled_from([0, 1, 2, tr.EGO]))
def test_which_course_is_chosen_does_not_matter(seed: int, who: int) -> None:
    """Every course of the party is as probable as before, together with what the others do."""
    T = anything(seed)
    rng = np.random.default_rng(seed)
    g, q = int(rng.integers(4)), int(rng.choice(courses_of(T, who)))
    n = T["n"]
    joint, odds = T["log_w"][:4, None] + T["odds"][:4, :n], T["odds"][:4, :n].copy()
    hy.rechoose_(T, g, who, q)
    assert T["choice"][g, who] == q
    assert T["odds"][g, q] == 0.0
    its = T["local"]["who"][:n] == who
    now = T["log_w"][:4, None] + T["odds"][:4, :n]
    np.testing.assert_allclose(now[:, its], joint[:, its], atol=1e-12)
    np.testing.assert_array_equal(T["odds"][:4, :n][:, ~its], odds[:, ~its])
    others = np.arange(4) != g
    np.testing.assert_array_equal(now[others], joint[others])


@settings(max_examples=20)
@given(SEEDS, st.sampled_from([0, 1, 2, tr.EGO]))
def test_two_courses_merged_are_as_probable_as_both(seed: int, who: int) -> None:
    """With the mean of both, as the best global hypothesis has it."""
    T = anything(seed)
    rng = np.random.default_rng(seed)
    its = courses_of(T, who)
    p, q = np.sort(rng.choice(its, 2, replace=False)).tolist()
    best = tr.best_global(T)
    w = np.exp(T["odds"][best, [p, q]])
    mean = w @ T["mean"][[p, q]] / w.sum()
    joint = np.exp(T["log_w"][:4, None] + T["odds"][:4, its])
    both = joint[:, (its == p) | (its == q)].sum(axis=1)
    hy.merge_(T, p, q)
    now = np.exp(T["log_w"][:4, None] + T["odds"][:4, its])
    np.testing.assert_allclose(now[:, its == p].ravel(), both, rtol=1e-9)
    assert not now[:, its == q].any()
    rest = (its != p) & (its != q)
    np.testing.assert_allclose(now[:, rest], joint[:, rest], rtol=1e-9)
    np.testing.assert_allclose(T["mean"][p], mean, atol=1e-12)
    assert (T["choice"][:4, who] != q).all()
    assert (T["odds"][range(4), T["choice"][:4, who]] == 0.0).all()


@settings(max_examples=30)
@given(SEEDS, st.sampled_from([2, 4, tr.N_GLOBAL - hy.SPLITS]))
def test_a_split_makes_nothing_up(seed: int, n_global: int) -> None:
    """Each global hypothesis was there before, or is one of those with another course of one party,
    and weighs what that weighed.  What is nearly as likely as the best now has one of its own."""
    T = anything(seed, n_global=n_global)
    rng = np.random.default_rng(seed)
    n = T["n"]
    likely = rng.random((n_global, n)) < 0.1
    T["odds"][:n_global, :n] += likely * rng.uniform(2.0, 9.0, (n_global, n))
    for who in (0, 1, 2, tr.EGO):
        T["odds"][range(n_global), T["choice"][:n_global, who]] = 0.0
    for g in range(n_global):
        for who in (0, 1, 2, tr.EGO):
            # the best of its kind is chosen already: else that comes first
            its = courses_of(T, who)
            same = [q for q in its if hy.alike(T, T["choice"][g, who], int(q))]
            T["odds"][g, same] = np.minimum(T["odds"][g, same], 0.0)
    before = T.copy()
    hy.split_(T)
    made = 0
    for g in range(T["n_global"]):
        found = False
        for old in range(n_global):
            differ = np.flatnonzero(before["choice"][old] != T["choice"][g])
            if len(differ) > 1 or not (T["rest"][g] == before["rest"][old]).all():
                continue
            gained = before["odds"][old, T["choice"][g, differ]].sum()
            found |= bool(abs(T["log_w"][g] - before["log_w"][old] - gained) < 1e-12)
        assert found
        made += kinds(T, g) not in [kinds(before, old) for old in range(n_global)]
    assert made <= hy.SPLITS
    assert made == T["n_global"] - n_global
    if made < hy.SPLITS:
        best = T["log_w"][: T["n_global"]].max()
        there = {kinds(T, g) for g in range(T["n_global"])}
        for g in range(n_global):
            for q in range(n):
                if before["log_w"][g] + before["odds"][g, q] > best - hy.SPLIT:
                    other = T.copy()
                    other["choice"][g] = before["choice"][g]
                    other["choice"][g, T["local"]["who"][q]] = q
                    assert kinds(other, g) in there


@settings(max_examples=10)
@given(SEEDS)
def test_where_there_is_no_room_a_likelier_one_takes_the_place_of_the_least_likely(
    seed: int,
) -> None:
    T = anything(seed, n_global=tr.N_GLOBAL)
    T["log_w"] = np.random.default_rng(seed).uniform(-9.0, 0.0, tr.N_GLOBAL)
    T["log_w"][5] = 0.0
    likely = courses_of(T, 1)[[1, 3]]
    T["odds"][5, likely] = 0.1
    before = T.copy()
    hy.split_(T)
    assert T["n_global"] == tr.N_GLOBAL
    replaced = (T["choice"] != before["choice"]).any(axis=1)
    replaced[5] = False  # another course of the same kind, at most
    assert replaced.sum() <= hy.SPLITS
    least = np.sort(before["log_w"])[: replaced.sum()]
    np.testing.assert_array_equal(np.sort(before["log_w"][replaced]), least)
    assert (T["log_w"][replaced] > before["log_w"][replaced]).all()
    now = [kinds(T, g) for g in range(tr.N_GLOBAL)]
    assert all(now.count(now[g]) == 1 for g in np.flatnonzero(replaced))
    # unless it is there already
    assert replaced.any() or all(hy.find_global(before, 5, 1, int(q)) >= 0 for q in likely)


@settings(max_examples=20)
@given(SEEDS, st.integers(0, 3), st.integers(0, 3))
def test_a_copy_is_the_same(seed: int, g: int, to: int) -> None:
    T = anything(seed)
    before = T.copy()
    hy.copy_global_(T, g, to)
    n = T["n"]
    for name in ("log_w", "rest", "choice"):
        expected = before[name].copy()
        expected[to] = before[name][g]
        np.testing.assert_array_equal(T[name], expected)
    expected = before["odds"][:, :n].copy()
    expected[to] = before["odds"][g, :n]
    np.testing.assert_array_equal(T["odds"][:, :n], expected)


@settings(max_examples=30)
@given(SEEDS)
def test_of_the_global_hypotheses_the_unlikely_are_given_up(seed: int) -> None:
    """And the second of two alike; what is kept weighs what it weighed.  Not alike are those of
    another road, by what is known of it, whatever the vehicles do."""
    T = anything(seed, n_global=8)
    rng = np.random.default_rng(seed)
    T["log_w"][:8] = rng.uniform(-1.4 * hy.LATE, 0.0, 8) + 3.0
    std = np.sqrt(np.diag(T["P"])[:N_ROAD])
    for g, apart in ((3, 0.9), (6, 0.9), (7, 1.1)):
        like = rng.integers(3)
        T["choice"][g], T["rest"][g] = T["choice"][like], T["rest"][like]
        i = rng.integers(N_ROAD)
        T["rest"][g, i] += rng.choice([-1, 1]) * apart * hy.OTHER_ROAD * std[i]
        T["rest"][g, N_ROAD:] += 9.0
    before = T.copy()
    kept: list[int] = []
    for g in range(8):
        if before["log_w"][g] < before["log_w"][:8].max() - hy.LATE:
            continue
        for i, other in enumerate(kept):
            apart = np.abs(mean_of(before, g) - mean_of(before, other))[:N_ROAD] / std
            if kinds(before, g) == kinds(before, other) and apart.max() <= hy.OTHER_ROAD:
                if before["log_w"][g] > before["log_w"][other]:
                    kept[i] = g
                break
        else:
            kept.append(g)
    hy.drop_globals_(T)
    assert T["n_global"] == len(kept)
    n = T["n"]
    log_w = before["log_w"][kept] - before["log_w"][:8].max()
    np.testing.assert_allclose(T["log_w"][: len(kept)], log_w, atol=1e-12)
    for to, g in enumerate(kept):
        np.testing.assert_array_equal(T["choice"][to], before["choice"][g])
        np.testing.assert_array_equal(T["rest"][to], before["rest"][g])
        np.testing.assert_array_equal(T["odds"][to, :n], before["odds"][g, :n])


def everything(T: Any) -> list[dict[Any, Any]]:
    """Of each global hypothesis: its mean, and by course how probable that would be."""
    said = []
    for g in range(T["n_global"]):
        one: dict[Any, Any] = {}
        for q in range(T["n"]):
            course = T["local"][q]
            chosen = bool(T["choice"][g, course["who"]] == q)
            key = (course.tobytes(), T["mean"][q, :N_ROAD].tobytes())
            one[key] = T["log_w"][g] + T["odds"][g, q], chosen
        said.append(one)
    return said


@settings(max_examples=20)
@given(SEEDS)
def test_the_mean_follows_the_likeliest_hypothesis(seed: int) -> None:
    """No hypothesis changes by that, only what all of them count from."""
    T = anything(seed)
    top = int(T["top"])
    means, before = [mean_of(T, g) for g in range(4)], everything(T)
    P = T["P"].copy()
    hy.centre_(T)
    for g in range(4):
        np.testing.assert_allclose(mean_of(T, g), means[g], atol=1e-12)
    np.testing.assert_allclose(T["x"][:top], means[tr.best_global(T)][:top], atol=1e-12)
    assert everything(T) == before
    np.testing.assert_array_equal(T["P"], P)


@settings(max_examples=30)
@given(SEEDS, st.sampled_from([0.0, 30.0, -30.0]))
def test_of_the_local_hypotheses_the_impossible_are_given_up(seed: int, level: float) -> None:
    """By the best one, however the weights are scaled in the middle of a scan."""
    T = anything(seed)
    T["log_w"][:4] -= T["log_w"][:4].max() - level
    rng = np.random.default_rng(seed)
    n = T["n"]
    T["odds"][:4, :n] *= rng.uniform(1.0, 4.0, n)
    before, means = everything(T), [mean_of(T, g) for g in range(4)]
    possible = {
        key
        for one in before
        for key, (log_w, chosen) in one.items()
        if log_w >= level - hy.IMPOSSIBLE or chosen
    }
    hy.drop_locals_(T, -1)
    assert T["n"] == len(possible) <= n
    for one, now in zip(before, everything(T), strict=True):
        assert now == {key: value for key, value in one.items() if key in possible}
    for g in range(4):
        np.testing.assert_allclose(mean_of(T, g), means[g], atol=1e-12)


def ways(T: Any, g: int, who: int) -> dict[Any, tuple[float, FloatArray]]:
    """By lanes from and to which a party may have driven, in a global hypothesis: logarithm of the
    weight, and what that does to the mean, by the probabilities of the best hypothesis."""
    its, best, found = courses_of(T, who), tr.best_global(T), {}
    lanes = np.column_stack((T["local"]["lane"][its], T["local"]["turn"][its]))
    for way in np.unique(lanes, axis=0):
        q = its[(lanes == way).all(axis=1)]
        mean = np.average(T["mean"][q], axis=0, weights=np.exp(T["odds"][best, q]))
        weight = T["log_w"][g] + np.logaddexp.reduce(T["odds"][g, q])
        found[tuple(way.tolist())] = weight, mean
    return found


@settings(max_examples=30)
@given(SEEDS, st.integers(0, 2), st.sampled_from([4, tr.N_GLOBAL]))
def test_who_leaves_takes_nothing_along(seed: int, gone: int, n_global: int) -> None:
    """The road and the other vehicles stay what they were, in every global hypothesis; what it may
    have done instead remains possible."""
    T = anything(seed, n_global=n_global)
    T["log_w"][:n_global] *= 0.3
    T["log_w"][:n_global] -= T["log_w"][:n_global].max()
    before = T.copy()
    hy.remove_guide_(T, gone)
    its = [N_ROAD + 2 * gone, N_ROAD + 2 * gone + 1]
    others = np.setdiff1d(np.arange(tr.N), its)
    P = before["P"]
    np.testing.assert_array_equal(T["P"][np.ix_(others, others)], P[np.ix_(others, others)])
    assert not T["P"][its].any()
    assert not T["P"][:, its].any()
    assert T["party"]["slot"][gone] == tr.FREE
    assert (T["choice"][:, gone] == tr.FREE).all()
    assert not len(courses_of(T, gone))
    assert T["top"] == N_ROAD + (4 if gone == 2 else 6)

    # what may have been: of each global hypothesis and way of the party, what becomes of it
    rest = np.setdiff1d(np.arange(before["n"]), courses_of(before, gone))
    possible = []
    for g in range(n_global):
        chosen = before["choice"][g].copy()
        q = before["local"][chosen[gone]]
        chosen[gone] = tr.FREE
        by = before["x"] + before["rest"][g]
        by = by + before["mean"][chosen[chosen != tr.FREE]].sum(axis=0)
        for way, (weight, mean) in ways(before, g, gone).items():
            odds = before["odds"][g, rest]
            was_chosen = way == (q["lane"], q["turn"])
            possible.append((weight, by + mean, odds, g, way, was_chosen))
    kept = set()
    for g in range(T["n_global"]):
        mean = mean_of(T, g)
        assert not mean[its].any()
        (k,) = [
            k
            for k, (_, other, *_) in enumerate(possible)
            if np.abs(other - mean)[others].max() < 1e-9
        ]
        weight, _, odds, *_ = possible[k]
        assert T["log_w"][g] == pytest.approx(weight, abs=1e-9)
        np.testing.assert_allclose(T["odds"][g, : T["n"]], odds, atol=1e-12)
        kept.add(k)
    assert len(kept) == T["n_global"]
    made = {k for k in kept if not possible[k][-1]}
    best = max(possible[k][0] for k in kept)
    least = min(possible[k][0] for k in kept)
    assert len(made) <= hy.SPLITS
    assert all(possible[k][0] > best - hy.RARE for k in made)
    if n_global + hy.SPLITS <= tr.N_GLOBAL:
        assert all(k in kept for k, one in enumerate(possible) if one[-1])
    if len(made) < hy.SPLITS:
        there = {(kinds_but(before, possible[k][3], gone), possible[k][4]) for k in kept}
        for weight, _, _, g, way, _ in possible:
            if weight > max(best - hy.RARE, least):
                assert (kinds_but(before, g, gone), way) in there


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("seed", [3, 6, 7])
def test_who_leaves_amid_a_lane_change_bends_no_road(side: int, seed: int) -> None:
    """Far ahead a lane change looks like a bend, and before it has ended the vehicle is out of
    view.  Then the others, who drive straight ahead, are not said to change lanes."""
    rng = np.random.default_rng(seed)
    traffic = Drive(parameters())
    for k in range(70):
        t = 0.1 * k
        u = (t - 2.0) / 4.0
        x = [30.0 + 8.0 * t, 20.0 + 10.0 * t, 10.0 + 9.0 * t, 180.0]
        y = [0.0, WIDTH, -WIDTH, side * WIDTH * float(way(u))]
        vy = [0.0, 0.0, 0.0, side * WIDTH * float(rate(u)) / 4.0]
        n = 4 if t < 4.0 else 3
        noise = 0.1 * rng.standard_normal((2, 4))
        traffic.see(range(n), np.column_stack((x, y + noise[0]))[:n], (vy + noise[1])[:n])
        assert traffic.frame.changing(1e-9 * traffic.t_ns)[:3].max() < 0.3


NEEDED = 3 + 2 * 2 * hy.N_BEGUN * len(hy.LASTS)
"""In one of three lanes, or to either side between two pairs of them."""


@pytest.mark.parametrize("room", [0, 3, NEEDED - 1, NEEDED, hy.FOR_NEW])
def test_without_room_for_all_its_courses_nobody_is_met(room: int) -> None:
    """Others stay as they are, and leave room for somebody new."""
    traffic = Traffic(parameters())
    for _ in range(10):
        traffic.scan([0, 1], [[30.0, 0.0], [50.0, WIDTH]], speed=25.0, yaw_rate=0.0)
    T = traffic.filter
    n, full = int(T["n"]), tr.N_LOCAL - room
    some = courses_of(T, 1)[0]
    T["local"][n:full] = T["local"][some]
    T["odds"][:, n:full] = -12.0
    T["mean"][n:full] = 0.0
    T["n"] = full
    notes = np.zeros(32, NOTE_DTYPE)
    notes["x"][4], notes["y"][4], notes["noise"][4], notes["seen"][4] = 40.0, -3.4, 0.01, True
    before = traffic.frame.x.copy()
    hy.begin_courses_(T, 0, 1e-9 * traffic.t_ns + 0.1, parameters(), np.zeros(0))
    assert T["n"] == full
    got = meet_(T, parameters(), traffic.guide_of, notes, 4, 1e-9 * traffic.t_ns)
    met = room >= NEEDED
    assert got == (2 if met else tr.FREE)
    assert traffic.guide_of[4] == got
    assert (T["party"]["slot"][2] == 4) == met
    assert (len(courses_of(T, 2)) > 100) == met
    assert T["n"] == full + len(courses_of(T, 2))
    traffic.age[4] = 1
    for k in range(5):
        traffic.scan(
            [0, 1, 4], [[30.0, 0.0], [50.0, WIDTH], [40.0, -3.4]], speed=25.0, yaw_rate=0.0
        )
        p = traffic.frame.changing(1e-9 * traffic.t_ns)[[0, 1, 4]]
        assert ((p >= 0.0) & (p < 0.1))[:2].all()
        assert T["n"] <= tr.N_LOCAL
        if k == 1:
            T["odds"][:, courses_of(T, 1)[20:]] = -50.0
    assert np.isfinite(p).all()
    assert T["n"] < 1000
    np.testing.assert_allclose(traffic.frame.x[:4], before[:4], atol=0.1)


# ---- whatever is measured

STEPS = st.lists(
    st.tuples(
        SEEDS,
        st.integers(0, 6),
        st.sampled_from([0.02, 0.1, 0.1, 0.1, 0.9, 1.2]),
        st.sampled_from([NAN, 0.0, 5.0, 30.0, -3.0]),
        st.sampled_from([NAN, 0.0, 0.1]),
    ),
    min_size=5,
    max_size=30,
)


@settings(max_examples=25)
@given(STEPS, st.floats(0.1, 4.0))
def test_probabilities_are_probabilities(script: list[Any], jumpy: float) -> None:
    traffic = Drive(parameters(change_rate=0.3), capacity=8)
    y = np.array([0.0, 3.5, -3.5, 0.0, 3.5, -3.5, 7.0, -7.0])
    ahead = np.linspace(15.0, 120.0, 8)
    for seed, n, dt, speed, yaw_rate in script:
        rng = np.random.default_rng(seed)
        slots = rng.permutation(8)[:n]
        traffic.age[rng.random(8) < 0.03] = 0
        y += rng.normal(0.0, 0.3, 8) * jumpy
        vy = rng.normal(0.0, 0.5, n)
        xy = np.column_stack((ahead, y))[slots]
        traffic.see(slots, xy, vy, dt=dt, speed=speed, yaw_rate=yaw_rate)
        T, t = traffic.filter, 1e-9 * traffic.t_ns
        assert 1 <= T["n_global"] <= tr.N_GLOBAL
        assert 1 <= T["n"] < tr.N_LOCAL
        for at in (t, t - 0.5):
            p = traffic.frame.changing(at)
            known = np.isfinite(p).all(axis=1)
            assert (known == np.isfinite(p).any(axis=1)).all()
            assert (p[known] >= 0.0).all()
            assert (p[known].sum(axis=1) <= 1.0 + 1e-9).all()
        assert np.isfinite(traffic.frame.changing(t)[slots]).all() or (traffic.guide_of < 0).any()
        for g in range(T["n_global"]):
            for who in (*range(tr.N_GUIDES), tr.EGO):
                q = T["choice"][g, who]
                assert (q != tr.FREE) == (who == tr.EGO or T["party"]["slot"][who] != tr.FREE)
                assert q == tr.FREE or T["local"]["who"][q] == who
                assert q == tr.FREE or T["odds"][g, q] == pytest.approx(0.0, abs=1e-9)


# ---- what is told


def weights(traffic: Traffic) -> FloatArray:
    weight = np.zeros(tr.N_LOCAL)
    hy.weigh_(traffic.filter, weight)
    return weight


def test_a_party_does_one_thing_or_another() -> None:
    """Its hypotheses' weights add up to one."""
    traffic = Traffic(parameters(), capacity=4)
    for k in range(12):
        traffic.scan([1, 3], [[30.0, 0.0], [50.0, 0.15 * k]], speed=25.0, speeds=False)
    T = traffic.filter
    who, weight = T["local"]["who"][: T["n"]], weights(traffic)
    for party in set(who.tolist()):
        assert weight[: T["n"]][who == party].sum() == pytest.approx(1.0)
    assert len(set(who.tolist())) == 3


def test_slots_are_told_in_the_order_of_those_in_use() -> None:
    traffic = Traffic(parameters(), capacity=4)
    for k in range(12):
        traffic.scan([1, 3], [[30.0, 0.0], [50.0, 0.15 * k]], speed=25.0, speeds=False)
    t = 1e-9 * traffic.t_ns
    by_slot = traffic.frame.changing(t)
    assert np.isfinite(by_slot[[1, 3]]).all()
    assert by_slot[3, 0] > 2.0 * by_slot[1, 0]
    p = np.full((3, 2), -1.0)
    ids = np.array([5, -1, 6, 7], np.int32)
    hy.tell_changes_(traffic.filter, weights(traffic), traffic.guide_of, ids, t, p)
    assert np.isnan(p[:2]).all(), "the one is not followed, nor is that in slot 1 told"
    np.testing.assert_array_equal(p[2], by_slot[3])
    traffic.scan([1, 3], [[30.0, 0.0], [50.0, 1.8]], speed=25.0, speeds=False)
    assert np.isnan(traffic.frame.changing(0.0)).all(), "before they were seen"


@pytest.mark.parametrize("side", [1, -1])
def test_when_a_lane_change_begins_and_ends(side: int) -> None:
    """Better and better while it lasts, and some time after it; nothing is told of who keeps."""
    rng = np.random.default_rng(8)
    traffic = Drive(parameters(settle=1.5), capacity=3)
    reports = np.zeros(2, REPORT_DTYPE)
    ids = np.array([4, -1, 6], np.int32)
    told = []
    while traffic.t_ns < 12e9:
        u = (1e-9 * traffic.t_ns + 0.07 - 3.0) / 4.0
        noise = rng.standard_normal((2, 2)) * 0.12
        y = noise[0] + [0.0, side * WIDTH * float(way(u))]
        vy = noise[1] + [0.0, side * WIDTH * float(rate(u)) / 4.0]
        traffic.see([0, 2], np.column_stack(([30.0, 50.0], y)), vy, dt=0.07, std=0.15)
        t = 1e-9 * traffic.t_ns
        hy.tell_times_(traffic.filter, weights(traffic), traffic.guide_of, ids, t, reports)
        told.append((t, *reports["change"].ravel().tolist()))
    t, keeps_from, keeps_to, begin, end = np.array(told).T
    assert np.isnan(keeps_from).all()
    assert np.isnan(keeps_to).all()
    assert np.isnan(begin[(t < 2.9) | (t > 10.0)]).all()
    during, after = (t > 5.0) & (t < 6.5), (t > 7.0) & (t < 8.0)
    assert abs(begin[during] - 3.0).max() < 0.6
    assert (end[during] > t[during]).all()
    assert abs(begin[after] - 3.0).max() < 0.5
    assert abs(end[after] - 7.0).max() < 0.5
