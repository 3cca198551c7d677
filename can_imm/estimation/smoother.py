"""Fixed-interval smoother for the interacting multiple model: one backward pass over a track.

Mode probabilities go back through the transition matrices that the filter used, states go back by
Rauch, Tung and Striebel for every pair of modes (i before j), and the pairs of each i are collapsed
to one Gaussian (Kim 1994).  Two things are done better.  What is known of the end in mode j is
passed on as evidence: the smoothed density divided by the predicted one, all sources mixed.  So no
pair gets a covariance that is larger than the filter's, though each source predicted another end.
And the evidence is weighed under the prediction from each source (Barber 2006): where the state is
in the end tells from which mode it came.  Constraints and measurements need no part here: they are
within the filter's posterior.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np

from can_imm.estimation.smoother_pairs import enter_pair_, evidence_, learn_pair_, move_pair_
from can_imm.types import FloatArray

NEGLIGIBLE = 1e-5
"""A mode with a smaller smoothed probability, or a source with a smaller weight, does not count."""


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def forget_pair_(n: int, i: int, P: FloatArray, work: Any) -> None:  # pragma: no cover - compiled
    """Source i stays as it was filtered."""
    for s in range(n):
        work.dx[i, s] = 0.0
        for t in range(n):
            work.sP[i, s, t] = P[s, t]


# As in `imm`, kernels that are part of one other only are put in before anything is compiled.
@numba.njit(inline="always", error_model="numpy")
def back_(
    n: int,
    bank: Any,
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    Pi: FloatArray,
    m: int,
    to: int,
    trust: float,
    work: Any,
) -> None:  # pragma: no cover - compiled
    """One step back: from work.x[to], work.P[to], work.mu[to] to those of 1 - to.

    Args:
        x, P, mu: (M, n), (M, n, n), (M,) filtered at the beginning of the interval; mu without
            modes at the floor.
        Pi: (M, M) transitions of the interval.  m: its length in steps.
        trust: power of the evidence for one source or another, see `smooth_`.
    """
    n_modes = bank.n_modes
    at = 1 - to
    for i in range(n_modes):
        work.mu[at, i] = 0.0
        for s in range(n):
            work.x[at, i, s] = 0.0
            for t in range(n):
                work.P[at, i, s, t] = 0.0
    for j in range(n_modes):
        later = work.mu[to, j]
        if later < NEGLIGIBLE:
            continue
        c = 0.0
        for i in range(n_modes):
            work.w[i] = Pi[i, j] * mu[i]
            c += work.w[i]
        if not c > 0.0:
            continue
        for i in range(n_modes):
            if not work.w[i] > NEGLIGIBLE * c:
                work.w[i] = 0.0
                continue
            enter_pair_(n, bank, x[i], P[i], i, j, m * bank.step_s, work)
            move_pair_(n, bank, i, j, m, work)
        known = evidence_(n, n_modes, j, to, work)
        top = -np.inf
        for i in range(n_modes):
            if known and work.w[i] > 0.0:
                log_l = trust * learn_pair_(n, i, P[i], work)
                work.log_l[i] = log_l + math.log(work.w[i])
                known = abs(work.log_l[i]) < np.inf
                top = max(top, work.log_l[i])
                for s in range(n):
                    known = known and work.sP[i, s, s] > 0.0
        total = 0.0
        for i in range(n_modes):
            if work.w[i] > 0.0:
                if known:
                    work.w[i] = math.exp(work.log_l[i] - top)
                else:
                    forget_pair_(n, i, P[i], work)
                total += work.w[i]
        for i in range(n_modes):
            if not work.w[i] > NEGLIGIBLE * total:
                continue
            q = later * work.w[i] / total
            work.mu[at, i] += q
            for s in range(n):
                work.x[at, i, s] += q * work.dx[i, s]
                for t in range(n):
                    work.P[at, i, s, t] += q * (work.sP[i, s, t] + work.dx[i, s] * work.dx[i, t])
    total = 0.0
    for i in range(n_modes):
        if work.mu[at, i] > NEGLIGIBLE:
            total += work.mu[at, i]
    for i in range(n_modes):
        q = work.mu[at, i]
        if not (total > 0.0 and q > NEGLIGIBLE):
            work.mu[at, i] = 0.0 if total > 0.0 else mu[i]
            for s in range(n):
                work.x[at, i, s] = x[i, s]
                for t in range(n):
                    work.P[at, i, s, t] = P[i, s, t]
            continue
        work.mu[at, i] = q / total
        for s in range(n):
            work.x[at, i, s] /= q
        for s in range(n):
            for t in range(n):
                work.P[at, i, s, t] = work.P[at, i, s, t] / q - work.x[at, i, s] * work.x[at, i, t]
        for s in range(n):
            work.x[at, i, s] += x[i, s]


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def present_of_(bank: Any, mu: FloatArray, w: FloatArray) -> None:  # pragma: no cover - compiled
    """`imm.present_` for an array."""
    total = 0.0
    for j in range(bank.n_modes):
        w[j] = mu[j] if mu[j] > 2.0 * bank.mu_floor else 0.0
        total += w[j]
    for j in range(bank.n_modes):
        w[j] /= total


@numba.njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def combine_smoothed_(
    n: int, bank: Any, at: int, work: Any, mean: FloatArray, cov: FloatArray
) -> None:  # pragma: no cover - compiled
    """Combined mean and covariance of work.x[at], work.P[at], work.mu[at]."""
    n_modes = bank.n_modes
    for s in range(n):
        v = 0.0
        for j in range(n_modes):
            v += work.mu[at, j] * work.x[at, j, s]
        mean[s] = v
    for s in range(n):
        for t in range(s + 1):
            v = 0.0
            for j in range(n_modes):
                q = work.mu[at, j]
                if q > 0.0:
                    v += q * (
                        work.P[at, j, s, t]
                        + (work.x[at, j, s] - mean[s]) * (work.x[at, j, t] - mean[t])
                    )
            cov[s, t] = v
            cov[t, s] = v


@numba.njit(inline="always", error_model="numpy")
def pass_(
    n: int,
    bank: Any,
    first: int,
    last: int,
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    Pi: FloatArray,
    steps: Any,
    trust: float,
    mean: FloatArray,
    cov: FloatArray,
    p: FloatArray,
    work: Any,
) -> None:  # pragma: no cover - compiled
    """`smooth_` with the number of states as a constant."""
    n_modes = bank.n_modes
    at: Any = np.int64(0)  # a plain 0 is a type of its own, for which kernels would be compiled
    later = -1
    for b in range(last - first):
        k = last - 1 - b
        if steps[k] == 0:
            continue
        if later < 0:
            present_of_(bank, mu[k], work.mu[at])
            for j in range(n_modes):
                for s in range(n):
                    work.x[at, j, s] = x[k, j, s]
                    for t in range(n):
                        work.P[at, j, s, t] = P[k, j, s, t]
        else:
            present_of_(bank, mu[k], work.present)
            back_(n, bank, x[k], P[k], work.present, Pi[later], steps[later], at, trust, work)
            at = 1 - at
        later = k
        combine_smoothed_(n, bank, at, work, mean[k], cov[k])
        for j in range(n_modes):
            p[k, j] = work.mu[at, j]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def smooth_(
    bank: Any,
    first: int,
    last: int,
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    Pi: FloatArray,
    steps: Any,
    trust: float,
    mean: FloatArray,
    cov: FloatArray,
    p: FloatArray,
    work: Any,
) -> None:  # pragma: no cover - compiled
    """Smooth the records first .. last - 1 of one track with all that came until the last one.

    Args:
        bank, work: (1,) records of `layout.BANK_DTYPE` and `SMOOTHER_DTYPE`.
        x, P, mu: (K, M, n), (K, M, n, n), (K, M) filtered per mode.
        Pi: (K, M, M) transitions of the cycle that led to each record.
        steps: (K,) int32, steps of that cycle; 0 in a row without a measurement, which is left out.
        trust: which mode came before j is said by the transition probabilities and, to this power,
            by the density of what is known of the end in j under the prediction from each.  1: the
            modes are true, and so is the result; 0: only the transitions count (Kim 1994).
        mean, cov, p: (K, n), (K, n, n), (K, M), written: combined estimate, mode probabilities.
    """
    # Named one by one: the number of states would be no constant beside a starred tuple.
    if bank[0].n_states == 4:
        pass_(4, bank[0], first, last, x, P, mu, Pi, steps, trust, mean, cov, p, work[0])
    elif bank[0].n_states == 5:
        pass_(5, bank[0], first, last, x, P, mu, Pi, steps, trust, mean, cov, p, work[0])
    else:
        pass_(6, bank[0], first, last, x, P, mu, Pi, steps, trust, mean, cov, p, work[0])
