"""The kernel that packs reports against the general encoder, which the E2E library protects."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from can_imm.bus.encoder import DIRECTIONS, EVENTS, ManoeuvreEncoder, MessageEncoder
from can_imm.types import REPORT_DTYPE

SPEED = st.floats(-1e4, 1e4) | st.sampled_from([np.nan, np.inf, -np.inf, 0.0125, -75.0, 250.01])
SHARE = st.floats(-0.1, 1.1) | st.just(np.nan)
STATE = (
    "ObjectId", "Direction", "Lane", "Event", "Probability", "SecondProbability", "Coasting",
    "Manoeuvre", "SecondManoeuvre", "TrackAge",
)  # fmt: skip
ESTIMATE = ("ObjectId", "DistLong", "VrelLong", "DistLat", "VrelLat")


@st.composite
def reports(draw):
    rows = draw(st.integers(0, 40))
    report = np.zeros(rows, REPORT_DTYPE)
    for name, values in {
        "object_id": st.integers(-2, 300), "direction": st.sampled_from(DIRECTIONS),
        "lane": st.integers(-9, 9), "flags": st.integers(0, 7), "probability": SHARE,
        "second_probability": SHARE, "coasting": st.booleans(), "manoeuvre": st.integers(0, 10),
        "second": st.integers(0, 10), "age": st.integers(0, 5000),
    }.items():  # fmt: skip
        report[name] = draw(st.lists(values, min_size=rows, max_size=rows))
    report["x"] = draw(arrays.arrays(float, (rows, 4), elements=SPEED))
    return report


@given(st.lists(reports(), max_size=3), st.booleans())
def test_bit_by_bit_what_the_library_protects(scans, states):
    encoder = ManoeuvreEncoder()
    state, estimate = MessageEncoder("ManoeuvreState", STATE), MessageEncoder(
        "ObjectEstimate", ESTIMATE
    )  # fmt: skip
    for t_ns, rows in enumerate(scans):
        expected = []
        for r in rows:
            if not 0 <= r["object_id"] <= 254:
                continue
            if states:
                where, event = DIRECTIONS.index(r["direction"]), EVENTS[r["flags"]]
                p = 100 * float(r["probability"]), 100 * float(r["second_probability"])
                rest = [r[name].item() for name in ("coasting", "manoeuvre", "second", "age")]
                lane = int(r["lane"])
                expected.append(
                    state.encode(t_ns, int(r["object_id"]), where, lane, event, *p, *rest)
                )
            expected.append(estimate.encode(t_ns, int(r["object_id"]), *r["x"].tolist()))
        got = encoder.encode(rows, t_ns) if states else encoder.estimates(rows, t_ns)
        assert got == expected
