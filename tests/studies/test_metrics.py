"""The metrics against cases counted by hand, and against loops that share no code with them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from can_imm.studies import metrics
from can_imm.studies.metrics import evaluate, expected_calibration_error, summarise
from can_imm.types import N_MANOEUVRES

SCAN_NS = 100_000_000


def run(truth, said, p=None, x=None, cov=None, state=None):
    n = len(truth)
    return evaluate(
        np.arange(n, dtype=np.int64) * SCAN_NS,
        np.array(truth, np.int8),
        np.zeros((n, 4)) if state is None else state,
        None if said is None else np.array(said, np.int8),
        p,
        x,
        cov,
    )


# one segment of each kind: said at once; 0.2 s late after a single frame too soon; never twice
TRUTH = [1, 1, 1, 1, 2, 2, 2, 2, 2, 3, 3, 3]
SAID_ = [0, 1, 1, 2, 2, 1, 2, 2, 2, 1, 3, 1]


def test_accuracy_counts_unknown_as_wrong():
    assert run(TRUTH, SAID_).accuracy == pytest.approx(7 / 12)


def test_macro_f1_by_hand():
    # class 1: 2 hits of 4 true, 5 said; class 2: 4 of 5, 5 said; class 3: 1 of 3, 1 said
    expected = np.mean([2 * 2 / (4 + 5), 2 * 4 / (5 + 5), 2 * 1 / (3 + 1)])
    assert run(TRUTH, SAID_).macro_f1 == pytest.approx(expected)


def test_macro_f1_leaves_out_classes_that_only_the_system_says():
    assert run([1, 1, 1, 1], [1, 1, 7, 7]).macro_f1 == pytest.approx(2 * 2 / (2 + 4))


def test_delay_is_the_first_of_two_consecutive_correct_frames():
    m = run(TRUTH, SAID_)
    assert m.delays_s == pytest.approx([0.2, math.nan], nan_ok=True)
    assert m.mean_delay_s == pytest.approx(0.2)
    assert m.missed_segments == 1


def test_a_pair_does_not_reach_into_the_next_segment():
    m = run([1, 1, 2, 1, 1], [1, 2, 1, 1, 1])
    assert m.missed_segments == 2  # the first segment's one right frame, and the second
    assert m.delays_s == pytest.approx([math.nan, 0.0], nan_ok=True)


def test_a_segment_of_one_frame_is_caught_on_it():
    m = run([1, 1, 2, 1, 1], [1, 1, 2, 1, 1])
    assert m.missed_segments == 0
    assert m.delays_s == pytest.approx([0.0, 0.0])


def test_number_of_switches_ignores_only_the_initial_unknown():
    assert run(TRUTH, SAID_).switches == 6
    assert run([1, 1, 1, 1], [0, 0, 1, 1]).switches == 0
    assert run([1, 1, 1, 1], [1, 0, 1, 1]).switches == 2
    assert run([1, 1], [0, 0]).switches == 0


@pytest.mark.parametrize(("late", "right_3", "right_5"), [(3, 20, 20), (4, 20, 20), (6, 18, 20)])
def test_tolerance_accepts_the_old_label_for_its_time_after_the_switch(late, right_3, right_5):
    truth = [1] * 10 + [2] * 10
    said = [1] * (10 + late) + [2] * (10 - late)
    m = run(truth, said)
    assert m.accuracy == pytest.approx((20 - late) / 20)
    assert m.accuracy_tol_0_3 == pytest.approx(right_3 / 20)
    assert m.accuracy_tol_0_5 == pytest.approx(right_5 / 20)


def test_tolerance_accepts_neither_a_third_label_nor_a_frame_further_off():
    truth = [1] * 10 + [2] * 10
    assert run(truth, [1] * 10 + [3, 3] + [2] * 8).accuracy_tol_0_5 == pytest.approx(18 / 20)
    assert run(truth, [1] * 4 + [2] * 16).accuracy_tol_0_5 == pytest.approx(19 / 20)


def test_brier_and_calibration_by_hand():
    p = np.zeros((4, N_MANOEUVRES))
    p[0, [1, 2]] = 0.75, 0.25
    p[1, [1, 2]] = 0.75, 0.25
    p[2, [1, 2, 3]] = 0.2, 0.5, 0.3
    # the last frame is undecided: worth a whole wrong answer, and no claim to calibrate
    m = run([1, 2, 3, 1], [1, 1, 2, 0], p)
    squares = [0.25**2 + 0.25**2, 0.75**2 + 0.75**2, 0.2**2 + 0.5**2 + 0.7**2, 1.0]
    assert m.brier == pytest.approx(np.mean(squares))
    # bin .7-.8: two frames, one right, mean .75; bin .5-.6: one wrong frame at .5
    assert m.ece == pytest.approx(2 / 3 * abs(0.5 - 0.75) + 1 / 3 * 0.5)


def test_certain_and_right_is_perfect():
    p = np.zeros((3, N_MANOEUVRES))
    p[:, 4] = 1.0
    m = run([4, 4, 4], [4, 4, 4], p)
    assert (m.brier, m.ece, m.accuracy, m.macro_f1) == (0.0, 0.0, 1.0, 1.0)


def test_rmse_and_nees_by_hand():
    x = np.array([[3.0, 0, 0, 1], [4.0, 0, 2, 1]])
    cov = np.array([np.diag([9.0, 1, 4, 1]), np.diag([4.0, 1, 1, 1])])
    cov[1][0, 2] = cov[1][2, 0] = 1.0
    m = run([1, 1], [1, 1], x=x, cov=cov)
    assert (m.rmse_x, m.rmse_vx) == (pytest.approx(math.sqrt(12.5)), 0.0)
    assert (m.rmse_y, m.rmse_vy) == (pytest.approx(math.sqrt(2)), 1.0)
    # second frame: (4, 2) weighted with inv([[4, 1], [1, 1]]) = [[1, -1], [-1, 4]] / 3, plus 1
    assert m.nees == pytest.approx(((1 + 1) + ((16 - 8 - 8 + 16) / 3 + 1)) / 2)


def test_frames_without_an_estimate_are_left_out_of_the_errors():
    x = np.array([[np.nan] * 4, [1.0, 1, 1, 1]])
    m = run([1, 1], [0, 1], x=x, cov=np.array([np.full((4, 4), np.nan), np.eye(4)]))
    assert (m.rmse_x, m.nees, m.accuracy) == (1.0, 4.0, 0.5)


def test_a_singular_covariance_claims_certainty():
    assert run([1], [1], x=np.ones((1, 4)), cov=np.zeros((1, 4, 4))).nees == math.inf


def test_what_does_not_exist_is_nan():
    m = run(TRUTH, None, x=np.zeros((12, 4)))
    assert all(math.isnan(getattr(m, name)) for name in metrics.SCALARS if "rmse" not in name)
    assert math.isnan(m.ece)
    m = run([1, 1], [1, 1])
    assert math.isnan(m.mean_delay_s)  # no switch
    assert math.isnan(m.brier)
    assert math.isnan(m.rmse_x)
    assert m.missed_segments == 0


def test_wrong_lengths_are_refused():
    with pytest.raises(ValueError, match="2 rows given for 3 frames"):
        run([1, 1, 1], [1, 1])
    with pytest.raises(ValueError, match="without frames"):
        run([], [])


LABELS = st.integers(1, 60).flatmap(
    lambda n: st.tuples(
        hnp.arrays(np.int8, n, elements=st.integers(1, 3)),
        hnp.arrays(np.int8, n, elements=st.integers(0, 3)),
        hnp.arrays(np.int64, n, elements=st.integers(1, 4)),
        hnp.arrays(float, (n, N_MANOEUVRES), elements=st.floats(0.001, 1.0)),
    )
)


@given(LABELS)
def test_against_plain_loops(case):
    truth, said, gaps, p = case
    p = p / p.sum(axis=1, keepdims=True)
    t_ns = np.cumsum(gaps) * SCAN_NS
    m = evaluate(t_ns, truth, np.zeros((len(truth), 4)), said, p, None, None)
    n = len(truth)
    t = [int(v) / 1e9 for v in t_ns]
    starts = [k for k in range(n) if k == 0 or truth[k] != truth[k - 1]]

    for tolerance, value in ((0.3, m.accuracy_tol_0_3), (0.5, m.accuracy_tol_0_5)):
        right = 0
        for k in range(n):
            allowed = {truth[k]}
            for s in starts[1:]:
                if abs(t[k] - t[s]) < tolerance + 1e-6:
                    allowed |= {truth[s], truth[s - 1]}
            right += said[k] in allowed
        assert value == pytest.approx(right / n)

    missed, delays = 0, []
    for s, end in zip(starts, [*starts[1:], n], strict=True):
        need = min(2, end - s)
        hits = [
            k for k in range(s, end - need + 1) if all(said[k : k + need] == truth[k : k + need])
        ]
        missed += not hits
        if s > 0 and hits:
            delays.append(t[hits[0]] - t[s])
    assert m.missed_segments == missed
    assert m.mean_delay_s == pytest.approx(np.mean(delays) if delays else math.nan, nan_ok=True)

    f1 = []
    for c in set(truth.tolist()):
        tp = sum(a == c and b == c for a, b in zip(truth, said, strict=True))
        fp = sum(a != c and b == c for a, b in zip(truth, said, strict=True))
        fn = sum(a == c and b != c for a, b in zip(truth, said, strict=True))
        f1.append(2 * tp / (2 * tp + fp + fn))
    assert m.macro_f1 == pytest.approx(np.mean(f1))

    claims = [(p[k, said[k]], said[k] == truth[k]) for k in range(n) if said[k]]
    gap = 0.0
    for b in range(10):
        inside = [c for c in claims if int(c[0] * 10) == b or (b == 9 and c[0] == 1.0)]
        gap += abs(sum(c[0] for c in inside) - sum(c[1] for c in inside))
    assert m.ece == pytest.approx(gap / len(claims) if claims else math.nan, nan_ok=True)
    assert m.confusion.sum() == n
    assert m.accuracy <= m.accuracy_tol_0_3 <= m.accuracy_tol_0_5


def test_summary_gives_mean_and_standard_error_and_skips_what_does_not_exist():
    runs = [run([1, 1, 2, 2], [1, 1, 2, 2]), run([1, 1, 2, 2], [1, 1, 1, 1])]
    s = summarise(runs)
    assert s["accuracy"] == pytest.approx((0.75, 0.25))  # std(1, .5) / sqrt(2)
    assert s["mean_delay_s"] == pytest.approx((0.0, math.nan), nan_ok=True)
    assert s["missed_segments"] == pytest.approx((0.5, 0.5))
    assert all(map(math.isnan, s["brier"] + s["ece"] + s["nees"]))
    assert math.isnan(summarise(runs[:1])["accuracy"][1])


def test_summary_pools_the_frames_before_the_calibration_error():
    """Two runs, each off by .2 in the other direction: alone .2 each, together calibrated."""
    p = np.zeros((10, N_MANOEUVRES))
    p[:, 1], p[:, 2] = 0.75, 0.25
    runs = [run([1] * 10, [1] * 10, p), run([1] * 5 + [2] * 5, [1] * 10, p)]
    assert [r.ece for r in runs] == pytest.approx([0.25, 0.25])
    mean, error = summarise(runs)["ece"]
    assert mean == pytest.approx(0.0)
    assert error == pytest.approx(0.0)  # jackknife: both leave-one-out values are .25
    # three runs of .75 claimed, right in 10, 10 and 5 of 10 frames
    mean, error = summarise([*runs, runs[0]])["ece"]
    assert mean == pytest.approx(25 / 30 - 0.75)
    left_out = np.array([0.0, 0.25, 0.0])
    assert error == pytest.approx(math.sqrt(2 / 3 * np.sum((left_out - left_out.mean()) ** 2)))


def test_no_frames_no_calibration_error():
    assert math.isnan(expected_calibration_error(np.zeros((3, 10))))
