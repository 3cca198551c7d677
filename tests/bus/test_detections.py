"""Detections and tracked objects on the bus."""

from __future__ import annotations

import math

import cantools
import numpy as np
import pytest
from bus_frames import MS, ROOT, crc8_p01, protect
from hypothesis import given
from hypothesis import strategies as st

from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.detections import (
    DETECTION_IDS,
    TRACKED_IDS,
    WINDOW_NS,
    DetectionDecoder,
    DetectionEncoder,
    TrackedEncoder,
)
from can_imm.bus.frame import REMOTE, Frame
from can_imm.bus.profile import load_profile
from can_imm.types import DetectionScan, Scan

DB = cantools.database.load_file(ROOT / "dbc" / "tracking.dbc", strict=True)


def detection_scan(t_ns=0, sensors=(0, 3), per_sensor=2, counter=5, rate=True):
    scan = DetectionScan(len(sensors), per_sensor * len(sensors))
    scan.t_ns, scan.n_sensors, scan.n = t_ns, len(sensors), per_sensor * len(sensors)
    scan.sensor_id[:] = sensors
    scan.counter[:] = counter
    for row, sensor in enumerate(sensors):
        scan.pose[row] = 100.0 * sensor - 7.5, -3.25, 0.5 - sensor, 29.5, -0.25
    scan.sensor[:] = np.repeat(np.arange(len(sensors)), per_sensor)
    k = np.arange(scan.n)
    scan.z[:] = np.stack([10.0 + k, -3.0 + 0.7 * k, -20.0 + 3.0 * k], axis=1)
    if not rate:
        scan.z[:, 2] = np.nan
    return scan


def feed(decoder, frames):
    return [scan for frame in frames if (scan := decoder.feed(frame)) is not None]


def counts_add_up(c):
    parts = (
        c.unknown, c.bad_kind, c.bad_length, c.bad_crc, c.bad_counter, c.out_of_range, c.stray,
        c.used,
    )  # fmt: skip
    return c.frames == sum(parts)


def test_cantools_reads_what_we_send():
    frames = DetectionEncoder().encode(detection_scan(), 1000)
    assert [f.id for f in frames] == [0x320, 0x321, 0x322, 0x323, 0x323] * 2
    assert {f.id for f in frames} == DETECTION_IDS
    for frame in frames:
        assert frame.data[0] == crc8_p01(frame.data, frame.id)
    said = [DB.decode_message(f.id, f.data) for f in frames[5:]]
    assert said[0]["SensorId"] == 3
    assert said[0]["DetectionCount"] == 2
    assert said[0]["ScanCounter"] == 5
    assert said[1]["PosX"] == pytest.approx(292.5)
    assert said[2]["Heading"] == pytest.approx(math.degrees(-2.5), abs=0.005)
    assert said[2]["VelY"] == pytest.approx(-0.25)
    assert said[3]["Range"] == pytest.approx(12.0)
    assert said[3]["Bearing"] == pytest.approx(math.degrees(-1.6), abs=0.007)
    assert said[4]["RangeRate"] == pytest.approx(-11.0)


@pytest.mark.parametrize("rate", [True, False])
def test_there_and_back(rate):
    sent = detection_scan(rate=rate)
    decoder = DetectionDecoder()
    assert feed(decoder, DetectionEncoder().encode(sent, 50 * MS)) == []
    got = decoder.flush(50 * MS + WINDOW_NS + 1)
    assert got is not None
    assert (got.t_ns, got.n_sensors, got.n) == (50 * MS, 2, 4)
    assert got.sensor_id[:2].tolist() == [0, 3]
    assert got.counter[:2].tolist() == [5, 5]
    assert got.sensor[:4].tolist() == [0, 0, 1, 1]
    np.testing.assert_allclose(got.pose[:2, :2], sent.pose[:, :2], atol=0.0051)
    np.testing.assert_allclose(got.pose[:2, 2], sent.pose[:, 2], atol=1e-4)
    np.testing.assert_allclose(got.z[:4], sent.z, atol=0.0051, equal_nan=True)
    assert counts_add_up(decoder.counts)


def test_when_the_sensors_are_known_a_scan_ends_with_its_last_frame():
    decoder, encoder = DetectionDecoder(), DetectionEncoder()
    feed(decoder, encoder.encode(detection_scan(counter=1), 0))
    assert decoder.flush(WINDOW_NS + 1) is not None
    frames = encoder.encode(detection_scan(counter=2), 100 * MS)
    assert feed(decoder, frames[:-1]) == []
    assert len(feed(decoder, frames[-1:])) == 1


def test_a_sensor_that_vanishes_delays_one_scan_only():
    decoder, encoder = DetectionDecoder(), DetectionEncoder()
    feed(decoder, encoder.encode(detection_scan(counter=1), 0))
    decoder.flush(WINDOW_NS + 1)
    assert feed(decoder, encoder.encode(detection_scan(sensors=(0,), counter=2), 100 * MS)) == []
    assert decoder.flush(100 * MS + WINDOW_NS) is None
    late = decoder.flush(100 * MS + WINDOW_NS + 1)
    assert late is not None
    assert late.n_sensors == 1
    at_once = feed(decoder, encoder.encode(detection_scan(sensors=(0,), counter=3), 200 * MS))
    assert len(at_once) == 1
    # and when it is back, its first part comes too late, its second does not
    feed(decoder, encoder.encode(detection_scan(counter=4), 300 * MS))
    assert decoder.counts.late_parts == 1
    both = feed(decoder, encoder.encode(detection_scan(counter=5), 400 * MS))
    assert [scan.n_sensors for scan in both] == [2]


def test_empty_scans_and_repeated_ones():
    decoder, encoder = DetectionDecoder(), DetectionEncoder()
    feed(decoder, encoder.encode(detection_scan(per_sensor=0, counter=1), 0))
    got = decoder.flush(WINDOW_NS + 1)
    assert got is not None
    assert (got.n_sensors, got.n) == (2, 0)
    assert feed(decoder, encoder.encode(detection_scan(per_sensor=1, counter=1), 100 * MS)) == []
    assert decoder.counts.repeated_parts == 2
    assert decoder.flush(200 * MS) is None


def test_the_delay_of_a_sensor_is_what_it_says():
    sent = detection_scan(per_sensor=0)
    sent.delay[:] = 0.0, 0.012
    decoder = DetectionDecoder()
    feed(decoder, DetectionEncoder().encode(sent, 100 * MS))
    got = decoder.flush(200 * MS)
    assert got is not None
    assert got.t_ns == 88 * MS
    np.testing.assert_allclose(got.delay[:2], [0.0, 0.012])


def test_a_part_measured_before_the_last_scan_is_late():
    decoder, encoder = DetectionDecoder(), DetectionEncoder()
    feed(decoder, encoder.encode(detection_scan(counter=1), 100 * MS))
    assert decoder.flush(200 * MS) is not None
    old = detection_scan(sensors=(3, 0), counter=2)
    old.delay[:] = 0.15, 0.0  # sensor 0's measurement is 150 ms older than its frame
    feed(decoder, encoder.encode(old, 201 * MS))
    assert decoder.counts.late_parts == 1
    got = decoder.flush(300 * MS)
    assert got is not None
    assert got.sensor_id[: got.n_sensors].tolist() == [3]


def test_damaged_frames_are_counted_and_survived():
    decoder, encoder = DetectionDecoder(), DetectionEncoder()
    frames = encoder.encode(detection_scan(), 0)
    flipped = bytearray(frames[4].data)
    flipped[4] ^= 0x10
    frames[4] = frames[4]._replace(data=bytes(flipped))
    frames.insert(3, frames[2])  # repeated
    frames += [
        frames[0]._replace(data=b"\0" * 7),
        frames[0]._replace(flags=REMOTE),
        frames[0]._replace(id=0x700),
    ]
    feed(decoder, frames)
    got = decoder.flush(100 * MS)
    assert got is not None
    assert got.n == 3
    c = decoder.counts
    assert (c.bad_crc, c.bad_counter, c.bad_length, c.bad_kind, c.unknown) == (1, 1, 1, 1, 1)
    assert c.incomplete_parts == 1
    assert c.lost == 1
    assert counts_add_up(c)


def test_values_outside_of_their_range():
    scan = detection_scan(sensors=(1,), per_sensor=4)
    scan.z[0, 0] = -5.0
    scan.z[1, 0] = np.nan
    scan.z[2, 1] = np.inf
    decoder = DetectionDecoder()
    feed(decoder, DetectionEncoder().encode(scan, 0))
    got = decoder.flush(100 * MS)
    assert got is not None
    assert got.n == 1
    assert got.z[0, 0] == pytest.approx(13.0)
    assert decoder.counts.out_of_range == 3


def test_without_a_pose_there_is_no_part():
    frames = DetectionEncoder().encode(detection_scan(), 0)
    decoder = DetectionDecoder()
    feed(decoder, [f for k, f in enumerate(frames) if k not in (1, 7)])
    assert decoder.flush(100 * MS) is None
    assert decoder.counts.dropped_parts == 2


def test_more_detections_than_there_is_room_for():
    encoder = DetectionEncoder()
    scan = detection_scan(sensors=(1,), per_sensor=70)
    scan.z[:, 1] = 0.0
    frames = encoder.encode(scan, 0)
    assert encoder.left_out == 8
    decoder = DetectionDecoder(capacity=10)
    feed(decoder, frames)
    got = decoder.flush(100 * MS)
    assert got is not None
    assert got.n == 10
    assert decoder.counts.overflow == 52


@given(data=st.lists(st.tuples(st.sampled_from(sorted(DETECTION_IDS)), st.binary(max_size=8))))
def test_survives_any_bytes(data):
    decoder = DetectionDecoder()
    for k, (frame_id, payload) in enumerate(data):
        if len(payload) == 8:
            payload = protect(
                payload[:1] + bytes([payload[1] & 0xF0 | k % 15]) + payload[2:], frame_id
            )
        scan = decoder.feed(Frame(k * MS, frame_id, payload))
        if scan is not None:
            assert np.isfinite(scan.pose[: scan.n_sensors]).all()
            assert np.isfinite(scan.z[: scan.n, :2]).all()
    assert counts_add_up(decoder.counts)


def test_tracked_objects_are_read_by_the_detectors_decoder():
    scan = Scan(2)
    scan.n = 2
    scan.ids[:] = 1, 2
    scan.z[:] = [[44.98, -1.4, -99.9, 0.7], [-60.0, 12.0, 3.5, -7.0]]
    scan.valid[:] = True
    scan.valid[1, 3] = False
    scan.new[0] = True
    scan.existence[:] = 0.973, 1.0
    frames = TrackedEncoder().encode(scan, 30 * MS)
    assert {f.id for f in frames} == TRACKED_IDS
    said = DB.decode_message(frames[1].id, frames[1].data)
    assert said["Existence"] == 97
    decoder = ScanDecoder(load_profile("tracking"))
    (got,) = feed(decoder, frames)
    assert got.t_ns == 30 * MS
    assert got.ids[:2].tolist() == [1, 2]
    assert got.new[:2].tolist() == [True, False]
    assert got.valid[:2].tolist() == [[True] * 4, [True, True, True, False]]
    resolution = [0.021, 0.071, 0.051, 0.071]
    assert (abs(got.z[0] - scan.z[0]) < resolution).all()
    assert (abs(got.z[1, :3] - scan.z[1, :3]) < resolution[:3]).all()


def test_an_object_that_does_not_fit_is_left_out():
    scan = Scan(1)
    scan.n, scan.ids[0] = 1, 4
    encoder = TrackedEncoder()
    (header,) = encoder.encode(scan, 0)
    assert DB.decode_message(header.id, header.data)["ObjectCount"] == 0
    assert encoder.left_out == 1
