"""When a vehicle changed lanes, by hindsight: whole lane changes weighed against keeping the lane.

A semi-Markov chain (Yu, "Hidden semi-Markov models", 2010): a vehicle keeps to the middle of a lane,
and now and then moves to the middle of the next one within a few seconds, along a smooth course.
Beside the course it wanders, and what is thought of the road is not quite right; both together are
a Gaussian process with the Matern covariance of order 3/2 (state: place beside the course and its
rate), known through a Kalman filter.  All courses have the same covariance in it, only the means
differ, so that many courses can be followed at little cost.  Where a course ends in a lane, it is
merged with the others that are in that lane by then.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.types import FloatArray

RATE = 0.03
"""Lane changes of a vehicle [1/s]."""
SHORTEST, LONGEST = 2.5, 7.5
N_DURATIONS = 11
"""Durations of lane changes that are tried [s]."""
USUAL, SPREAD = 4.3, 0.24
"""Median of the durations [s], and standard deviation of their logarithm."""
HURRY = 0.5
"""How fast the place beside the course is forgotten [1/s]: rate of the Matern process."""
IMPOSSIBLE = 18.0
"""A course whose log weight is so much lower than that of the best one is given up."""
OUTLIER = 16.0
"""Squared normalised error of a measurement counts as this at most."""
EDGE = 12
"""Lanes are numbered from -EDGE to EDGE."""


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def course(u: float) -> tuple[float, float]:  # pragma: no cover - compiled
    """How much of the way is done at the share u of the time (0 to 1), and its derivative by u.

    Between a quintic polynomial and half a cosine wave, which differ by 2 % of the way.
    """
    quintic = u * u * u * (10.0 - 15.0 * u + 6.0 * u * u)
    slope = 30.0 * u * u * (1.0 - u) * (1.0 - u)
    cosine = 0.5 - 0.5 * math.cos(math.pi * u)
    wave = 0.5 * math.pi * math.sin(math.pi * u)
    return 0.5 * (quintic + cosine), 0.5 * (slope + wave)


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def add_logs(a: float, b: float) -> float:  # pragma: no cover - compiled
    """log(exp(a) + exp(b))"""
    if a < b:
        a, b = b, a
    return a + math.log1p(math.exp(b - a)) if b > -np.inf else a


@numba.njit(nogil=True, cache=True, error_model="numpy")
def find_lane_changes_(
    t: FloatArray,
    y: FloatArray,
    r: FloatArray,
    vy: FloatArray,
    rv: FloatArray,
    beside: FloatArray,
    width: float,
    p: FloatArray,
) -> None:  # pragma: no cover - compiled
    n = len(t)
    lanes = 2 * EDGE + 1
    alpha = np.full((n, lanes), -np.inf)
    beta = np.full((n, lanes), -np.inf)
    ll = np.zeros((n, lanes))
    m = np.zeros((lanes, 2))
    pred = np.zeros((lanes, 2))
    duration = np.empty(N_DURATIONS)
    log_prior = np.empty(N_DURATIONS)
    total = 0.0
    for i in range(N_DURATIONS):
        duration[i] = SHORTEST * (LONGEST / SHORTEST) ** (i / (N_DURATIONS - 1))
        d = math.log(duration[i] / USUAL) / SPREAD
        log_prior[i] = -0.5 * d * d
        total += math.exp(log_prior[i])
    for i in range(N_DURATIONS):
        log_prior[i] -= math.log(total)
    cap = 4096
    first = np.empty(cap, np.int32)   # transition first-1 -> first; 0: before the track
    end = np.empty(cap, np.int32)
    start = np.empty(cap)
    dur = np.empty(cap, np.int8)
    lane = np.empty(cap, np.int8)
    turn = np.empty(cap, np.int8)
    weight = np.empty(cap)
    like = np.empty(cap)
    mean = np.empty((cap, 2))
    count = 0
    active = np.empty(cap, np.int32)
    n_active = 0
    # before the first
    P00 = beside[0] ** 2
    P01 = 0.0
    P11 = (HURRY * beside[0]) ** 2
    for l in range(lanes):
        alpha[0, l] = 0.0
    best = -np.inf
    for k in range(n):
        # predict the covariance
        if k > 0:
            dt = t[k] - t[k - 1]
            a = HURRY
            ex = math.exp(-a * dt)
            f00, f01, f10, f11 = (1.0 + a * dt) * ex, dt * ex, -a * a * dt * ex, (1.0 - a * dt) * ex
            s0 = beside[k] ** 2
            s1 = a * a * s0
            # P = F (P - Pinf) F' + Pinf
            d00, d01, d11 = P00 - s0, P01, P11 - s1
            g00, g01 = f00 * d00 + f01 * d01, f00 * d01 + f01 * d11
            g10, g11 = f10 * d00 + f11 * d01, f10 * d01 + f11 * d11
            P00 = g00 * f00 + g01 * f01 + s0
            P01 = g00 * f10 + g01 * f11
            P11 = g10 * f10 + g11 * f11 + s1
            for l in range(lanes):
                alpha[k, l] = alpha[k - 1, l] + math.log1p(-min(RATE * dt, 0.5))
                pred[l, 0] = f00 * m[l, 0] + f01 * m[l, 1]
                pred[l, 1] = f10 * m[l, 0] + f11 * m[l, 1]
        else:
            dt = 0.0
            f00 = f01 = f10 = f11 = 0.0
        # new changes
        if k > 0:
            for l in range(1, lanes - 1):
                if alpha[k - 1, l] < best - IMPOSSIBLE:
                    continue
                for d in (-1, 1):
                    for i in range(N_DURATIONS):
                        if count == cap:
                            cap *= 2
                            first = np.concatenate((first, np.empty_like(first)))
                            end = np.concatenate((end, np.empty_like(end)))
                            start = np.concatenate((start, np.empty_like(start)))
                            dur = np.concatenate((dur, np.empty_like(dur)))
                            lane = np.concatenate((lane, np.empty_like(lane)))
                            turn = np.concatenate((turn, np.empty_like(turn)))
                            weight = np.concatenate((weight, np.empty_like(weight)))
                            like = np.concatenate((like, np.empty_like(like)))
                            mean = np.concatenate((mean, np.empty_like(mean)))
                            active = np.concatenate((active, np.empty_like(active)))
                        c = count
                        first[c], end[c], start[c] = k, n, t[k] - 0.5 * dt
                        dur[c], lane[c], turn[c] = i, l, d
                        weight[c] = alpha[k - 1, l] + math.log(0.5 * RATE * dt) + log_prior[i]
                        like[c] = 0.0
                        mean[c, 0], mean[c, 1] = m[l, 0], m[l, 1]
                        active[n_active] = c
                        n_active += 1
                        count += 1
        else:
            for l in range(1, lanes - 1):
                for d in (-1, 1):
                    q0 = abs(y[0] / width - (l - EDGE + 0.5 * d))
                    if q0 > 1.0:
                        continue
                    for i in range(N_DURATIONS):
                        steps = 8
                        for s in range(steps):
                            c = count
                            first[c], end[c] = 0, n
                            start[c] = t[0] - (s + 0.5) / steps * duration[i]
                            dur[c], lane[c], turn[c] = i, l, d
                            weight[c] = math.log(0.5 * RATE * duration[i] / steps) + log_prior[i]
                            like[c] = 0.0
                            mean[c] = 0.0
                            active[n_active] = c
                            n_active += 1
                            count += 1
        # move, end
        kept = 0
        for b in range(n_active):
            c = active[b]
            if k > 0:
                v0, v1 = mean[c, 0], mean[c, 1]
                mean[c, 0] = f00 * v0 + f01 * v1
                mean[c, 1] = f10 * v0 + f11 * v1
            if t[k] >= start[c] + duration[dur[c]]:
                end[c] = k
                to = lane[c] + turn[c]
                w = weight[c] + like[c]
                tot = add_logs(alpha[k, to], w)
                q = math.exp(w - tot)
                pred[to, 0] += q * (mean[c, 0] - pred[to, 0])
                pred[to, 1] += q * (mean[c, 1] - pred[to, 1])
                alpha[k, to] = tot
                continue
            active[kept] = c
            kept += 1
        n_active = kept
        # gains
        use_y = r[k] < 1e6
        use_v = rv[k] < 1e6
        Sy = P00 + r[k]
        k0, k1 = P00 / Sy, P01 / Sy
        if not use_y:
            k0 = k1 = 0.0
        A00, A01, A11 = P00 - k0 * P00, P01 - k0 * P01, P11 - k1 * P01
        Sv = A11 + rv[k]
        h0, h1 = A01 / Sv, A11 / Sv
        if not use_v:
            h0 = h1 = 0.0
        P00, P01, P11 = A00 - h0 * A01, A01 - h0 * A11, A11 - h1 * A11
        cy = -0.5 * math.log(Sy) if use_y else 0.0
        cv = -0.5 * math.log(Sv) if use_v else 0.0
        best = -np.inf
        for l in range(lanes):
            e = y[k] - (l - EDGE) * width - pred[l, 0]
            v = 0.0
            a0, a1 = pred[l, 0], pred[l, 1]
            if use_y:
                v += cy - 0.5 * min(e * e / Sy, OUTLIER)
                a0 += k0 * e
                a1 += k1 * e
            if use_v:
                e = vy[k] - a1
                v += cv - 0.5 * min(e * e / Sv, OUTLIER)
                a0 += h0 * e
                a1 += h1 * e
            m[l, 0], m[l, 1] = a0, a1
            ll[k, l] = v
            alpha[k, l] += v
            best = max(best, alpha[k, l])
        for b in range(n_active):
            c = active[b]
            T = duration[dur[c]]
            done, slope = course((t[k] - start[c]) / T)
            e = y[k] - (lane[c] - EDGE + turn[c] * done) * width - mean[c, 0]
            v = 0.0
            if use_y:
                v += cy - 0.5 * min(e * e / Sy, OUTLIER)
                mean[c, 0] += k0 * e
                mean[c, 1] += k1 * e
            if use_v:
                e = vy[k] - turn[c] * slope * width / T - mean[c, 1]
                v += cv - 0.5 * min(e * e / Sv, OUTLIER)
                mean[c, 0] += h0 * e
                mean[c, 1] += h1 * e
            like[c] += v
            best = max(best, weight[c] + like[c])
        kept = 0
        for b in range(n_active):
            c = active[b]
            if weight[c] + like[c] < best - IMPOSSIBLE:
                like[c] = -np.inf
                continue
            active[kept] = c
            kept += 1
        n_active = kept
    # back
    for l in range(lanes):
        beta[n - 1, l] = 0.0
    c = count - 1
    for b in range(n):
        k = n - 1 - b
        if k < n - 1:
            dt = t[k + 1] - t[k]
            for l in range(lanes):
                beta[k, l] = math.log1p(-min(RATE * dt, 0.5)) + ll[k + 1, l] + beta[k + 1, l]
            while c >= 0 and first[c] == k + 1:
                l = lane[c]
                after = 0.0
                if end[c] < n:
                    to = l + turn[c]
                    after = ll[end[c], to] + beta[end[c], to]
                like[c] += after
                if like[c] > -np.inf:
                    beta[k, l] = add_logs(
                        beta[k, l], math.log(0.5 * RATE * dt) + log_prior[dur[c]] + like[c]
                    )
                c -= 1
    z = -np.inf
    for l in range(lanes):
        z = add_logs(z, alpha[0, l] + beta[0, l])
    while c >= 0:
        if end[c] < n:
            to = lane[c] + turn[c]
            like[c] += ll[end[c], to] + beta[end[c], to]
        if like[c] > -np.inf:
            z = add_logs(z, weight[c] + like[c])
        c -= 1
    for k in range(n):
        p[k, 0] = p[k, 1] = 0.0
    for c in range(count):
        q = weight[c] + like[c] - z
        if q > -20.0:
            q = math.exp(q)
            side = 0 if turn[c] > 0 else 1
            for k in range(first[c], min(end[c], n)):
                p[k, side] += q
