"""What the encoders send, read by cantools and by a checksum of our own."""

from __future__ import annotations

import numpy as np
import pytest
from bus_frames import MS, crc8_p01
from hypothesis import given, settings
from hypothesis import strategies as st

from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.encoder import (
    OUTPUT_IDS,
    DetectorState,
    ManoeuvreEncoder,
    RadarEncoder,
    StatusValues,
)
from can_imm.bus.frame import REMOTE
from can_imm.bus.listener import EstimateMessage, ManoeuvreDecoder
from can_imm.bus.profile import load_profile
from can_imm.types import CUT_IN, CUT_OUT, OVERTAKING_ANOTHER, REPORT_DTYPE, Manoeuvre, Scan

NAN = float("nan")


def scan_of(*rows, ids=None):
    scan = Scan(max(len(rows), 1))
    scan.n = len(rows)
    for i, row in enumerate(rows):
        scan.ids[i] = i if ids is None else ids[i]
        scan.valid[i] = ~np.isnan(row)
        scan.z[i] = np.nan_to_num(row)
    return scan


def report_of(**changes):
    report = np.zeros(1, REPORT_DTYPE)
    values = {
        "object_id": 5, "age": 17, "manoeuvre": Manoeuvre.LANE_CHANGE,
        "second": Manoeuvre.KEEP_LEFT, "direction": -1, "lane": 1,
        "probability": 0.8127, "second_probability": 0.1,
        "x": (51.237, -1.512, 1.444, 0.73),
    }  # fmt: skip
    for name, value in {**values, **changes}.items():
        report[name] = value
    return report


def check_protection(frames):
    """CRC right, counter of each id without a gap."""
    counters = {}
    for frame in frames:
        assert frame.data[0] == crc8_p01(frame.data, frame.id)
        counter = frame.data[1] & 0x0F
        assert counter == (counters.get(frame.id, -1) + 1) % 15
        counters[frame.id] = counter


def test_radar_frames(own_db):
    encoder = RadarEncoder()
    scan = scan_of([50.0, -0.98, 1.0, 0.35], [12.34, NAN, -3.0, NAN], ids=[3, 63])
    scan.new[1] = True
    frames = [frame for k in range(40) for frame in encoder.encode(scan, k * 100 * MS)]
    check_protection(frames)
    assert [f.id for f in frames[:4]] == [0x300, 0x301, 0x301, 0x300]
    assert {f.t_ns for f in frames[3:6]} == {100 * MS}
    head, one, two = [own_db.decode_message(f.id, f.data) for f in frames[-3:]]
    assert (head["ObjectCount"], head["ScanCounter"]) == (2, 39)
    assert (one["ObjectId"], one["ObjectValid"], one["ObjectNew"]) == (3, "Valid", "Known")
    assert (two["ObjectId"], two["ObjectNew"]) == (63, "New")
    assert one["DistLong"] == pytest.approx(50.0, abs=0.01)
    assert one["VrelLat"] == pytest.approx(0.35, abs=0.035)
    assert (two["VrelLong"], two["VrelLat"]) == ("NotAvailable", "NotAvailable")


def test_an_id_that_does_not_fit_is_left_out(own_db):
    encoder = RadarEncoder()
    frames = encoder.encode(scan_of(*[[1.0, 0, 0, 0]] * 3, ids=[-1, 5, 64]), 0)
    assert own_db.decode_message(0x300, frames[0].data)["ObjectCount"] == 1
    assert (len(frames), encoder.left_out) == (2, 2)


def test_the_scan_counter_wraps(own_db):
    encoder = RadarEncoder()
    counters = [
        own_db.decode_message(0x300, encoder.encode(scan_of(), 0)[0].data)["ScanCounter"]
        for _ in range(65537)
    ]
    assert counters == [*range(65536), 0]


STATE = st.tuples(
    st.floats(-75, 250), st.floats(-70, 70), st.floats(-25, 25), st.floats(-17.5, 17.5)
)


@settings(max_examples=50, deadline=None)
@given(rows=st.lists(STATE, max_size=64))
def test_a_scan_comes_back_within_half_a_step(rows):
    encoder, decoder = RadarEncoder(), ScanDecoder(load_profile("can_imm"))
    out = [scan for f in encoder.encode(scan_of(*rows), 7 * MS) if (scan := decoder.feed(f))]
    assert len(out) == 1
    assert (out[0].t_ns, out[0].n, out[0].incomplete) == (7 * MS, len(rows), False)
    half = np.array([0.01, 0.035, 0.025, 0.035]) + 1e-9
    assert (abs(out[0].z[: len(rows)] - np.reshape(rows, (-1, 4))) <= half).all()


def test_manoeuvre_frames(own_db):
    encoder = ManoeuvreEncoder()
    odd = report_of(object_id=254, lane=-9, coasting=True, age=9999, flags=CUT_IN)
    reports = np.concatenate([report_of(), odd])
    frames = [frame for k in range(20) for frame in encoder.encode(reports, k * 10 * MS)]
    check_protection(frames)
    assert [f.id for f in frames[:4]] == [0x310, 0x311] * 2
    state, estimate, other, _ = [own_db.decode_message(f.id, f.data) for f in frames[:4]]
    del state["Crc"], state["AliveCounter"]
    assert state == {
        "ObjectId": 5, "Coasting": "Seen", "Manoeuvre": "LANE_CHANGE",
        "SecondManoeuvre": "KEEP_LEFT", "Direction": "Right", "Lane": 1, "Event": "None",
        "Probability": pytest.approx(81.3), "SecondProbability": pytest.approx(10.0),
        "TrackAge": 17,
    }  # fmt: skip
    assert estimate["ObjectId"] == 5
    for name, value in zip(
        ("DistLong", "VrelLong", "DistLat", "VrelLat"), (51.24, -1.5, 1.44, 0.75), strict=True
    ):
        assert estimate[name] == pytest.approx(value)
    assert (other["ObjectId"], other["Lane"], other["Coasting"]) == (
        254,
        "NotAvailable",
        "Coasting",
    )
    assert (other["TrackAge"], other["Event"]) == (1023, "CUT_IN")


@pytest.mark.parametrize("object_id", [-1, 255, 530])
def test_a_report_whose_id_does_not_fit_is_left_out(object_id):
    encoder = ManoeuvreEncoder()
    assert encoder.encode(report_of(object_id=object_id), 0) == []
    assert encoder.left_out == 1


def test_estimates_that_do_not_fit_are_not_available(own_db):
    frame = ManoeuvreEncoder().encode(report_of(x=(251.0, NAN, 20.5, -6.4)), 0)[1]
    values = own_db.decode_message(0x311, frame.data)
    for name in ("DistLong", "VrelLong", "DistLat", "VrelLat"):
        assert values[name] == "NotAvailable"


def test_status_saturates(own_db):
    encoder = ManoeuvreEncoder()
    assert encoder.status_period_ns == 100 * MS
    frames = [
        encoder.status(k * 100 * MS, StatusValues(DetectorState.RUNNING, 3, 4094, 4096, 10**9))
        for k in range(17)
    ]
    check_protection(frames)
    values = own_db.decode_message(0x31F, frames[0].data)
    assert (values["State"], values["ObjectsTracked"]) == ("Running", 3)
    counts = [values[name] for name in ("DeadlineMisses", "FramesRejected", "DroppedScans")]
    assert counts == [4094, 4095, 4095]


def test_state_names_are_those_of_the_dbc(own_db):
    choices = own_db.get_message_by_name("DetectorStatus").get_signal_by_name("State").choices
    for state in DetectorState:
        assert str(choices[state]).lower() == state.name.replace("_", "").lower()


def test_output_ids_are_what_the_detector_sends(own_db):
    assert {m.frame_id for m in own_db.messages if "DETECTOR" in m.senders} == OUTPUT_IDS


@given(
    manoeuvre=st.sampled_from(Manoeuvre), second=st.sampled_from(Manoeuvre),
    direction=st.sampled_from([-1, 0, 1]), lane=st.integers(-7, 7),
    flags=st.sampled_from([0, CUT_IN, CUT_OUT, OVERTAKING_ANOTHER]),
    probability=st.floats(0, 1), age=st.integers(0, 1023), coasting=st.booleans(),
    x=st.tuples(st.floats(-75, 250), st.floats(-76.7, 76.7), st.floats(-20.4, 20.4),
                st.floats(-6.3, 6.3)),
)  # fmt: skip
def test_the_listener_reads_back_what_was_said(x, probability, **values):
    report = report_of(probability=probability, x=x, **values)
    listener = ManoeuvreDecoder()
    state, estimate = map(listener.feed, ManoeuvreEncoder().encode(report, 0))
    assert state.object_id == 5
    for name, value in values.items():
        assert getattr(state, name) == value
    assert state.probability == pytest.approx(probability, abs=0.0005001)
    assert estimate.object_id == 5
    assert (abs(np.array(estimate[1:]) - x) <= np.array([0.01, 0.0375, 0.01, 0.025]) + 1e-9).all()


def test_the_listener_rejects_what_is_broken():
    listener, encoder = ManoeuvreDecoder(), ManoeuvreEncoder()
    values = StatusValues(2, 0, 1, 2, 3)
    frame = encoder.status(0, values)
    assert listener.feed(frame) == values
    assert listener.feed(frame._replace(data=frame.data[:7])) is None
    assert listener.feed(frame._replace(flags=REMOTE, data=b"")) is None
    assert listener.feed(frame._replace(data=bytes([frame.data[0] ^ 1]) + frame.data[1:])) is None
    assert listener.rejected == 3
    assert listener.feed(frame._replace(id=0x301)) is None
    assert listener.rejected == 3


def test_the_listener_says_nan_for_not_available():
    listener = ManoeuvreDecoder()
    frame = ManoeuvreEncoder().encode(report_of(x=(NAN, 0.0, 99.0, 0.0)), 0)[1]
    message = listener.feed(frame)
    assert isinstance(message, EstimateMessage)
    assert np.isnan(message[1:]).tolist() == [True, False, True, False]
