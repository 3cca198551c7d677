"""The vehicle's own motion: found on whichever channel, checked, forgotten, and in nobody's way."""

from __future__ import annotations

import math

import cantools
import numpy as np
import pytest
from bus_frames import MS, REAL_DATA, ROOT, protect

from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.frame import REMOTE, Frame
from can_imm.bus.profile import load_profile
from can_imm.bus.sources import LogSource

TOYOTA = load_profile("toyota")


def ego_motion(own_db, speed, turn, counter=0):
    message = own_db.get_message_by_name("EgoMotion")
    values = {"Crc": 0, "AliveCounter": counter, "Speed": speed, "YawRate": turn}
    return 0x302, protect(message.encode(values, strict=False), 0x302)


def one_scan(decoder, radar, t_ns):
    scan = decoder.feed(Frame(t_ns, *radar.scan(0)))
    return (scan.ego_speed, scan.ego_yaw_rate) if scan else None


def test_values_and_their_age(own_db, radar):
    decoder = ScanDecoder(load_profile("can_imm"))
    assert all(map(math.isnan, one_scan(decoder, radar, 0)))
    decoder.feed(Frame(100 * MS, *ego_motion(own_db, 20.5, -0.1), "can1"))
    assert one_scan(decoder, radar, 100 * MS) == pytest.approx((20.5, -0.1))
    assert one_scan(decoder, radar, 600 * MS) == pytest.approx((20.5, -0.1))
    assert all(map(math.isnan, one_scan(decoder, radar, 601 * MS)))


def test_not_available_is_not_known(own_db, radar):
    decoder = ScanDecoder(load_profile("can_imm"))
    decoder.feed(Frame(0, *ego_motion(own_db, 20.5, -0.1)))
    decoder.feed(Frame(0, *ego_motion(own_db, 16383 * 0.01, 0.2)))
    speed, turn = one_scan(decoder, radar, 0)
    assert math.isnan(speed)
    assert turn == pytest.approx(0.2)


def test_every_frame_is_counted_once_and_the_scans_are_not_disturbed(own_db, radar):
    decoder = ScanDecoder(load_profile("can_imm"))
    frame_id, data = ego_motion(own_db, 10, 0)
    feed = [
        Frame(0, *radar.scan(2)), Frame(0, frame_id, data), Frame(0, frame_id, data),
        Frame(0, *radar.object(1)), Frame(0, frame_id, data[:7] + b"\xff"),
        Frame(0, frame_id, data[:4]), Frame(0, frame_id, b"", None, REMOTE),
        Frame(60 * MS, frame_id, data),
    ]  # fmt: skip
    assert [decoder.feed(frame) for frame in feed] == [None] * 8
    scan = decoder.feed(Frame(49 * MS, *radar.object(2)))
    assert (scan.n, scan.incomplete) == (2, False)
    counts = decoder.counts
    assert (counts.ego, counts.bad_crc, counts.unknown, counts.bad_kind) == (3, 1, 1, 1)
    assert counts.frames == 9 == counts.ego + counts.used + 3
    assert (counts.bad_counter, counts.lost) == (0, 0)


def test_toyota_checksum_and_units():
    db = cantools.database.load_file(ROOT / "dbc" / "toyota.dbc")
    decoder = ScanDecoder(TOYOTA)
    data = db.encode_message("KINEMATICS", {"YAW_RATE": 5.044, "CHECKSUM": 0}, strict=False)
    good = data[:7] + bytes([(sum(data[:7]) + 0x24 + 8) & 0xFF])
    decoder.feed(Frame(0, 0x24, data))
    decoder.feed(Frame(0, 0x24, good))
    wheels = dict(zip(("FR", "FL", "RR", "RL"), (72.0, 71.6, 72.4, 72.0), strict=True))
    data = db.encode_message("WHEEL_SPEEDS", {f"WHEEL_SPEED_{k}": v for k, v in wheels.items()})
    decoder.feed(Frame(0, 0xAA, data))
    speed, turn = decoder._ego.at(0)
    assert speed == pytest.approx(20.0, abs=0.002)
    assert math.degrees(turn) == pytest.approx(5.044, abs=0.122)
    assert (decoder.counts.bad_crc, decoder.counts.ego) == (1, 2)


@pytest.mark.skipif(not REAL_DATA.is_dir(), reason="no recorded data beside the repository")
def test_a_minute_of_a_real_car():
    decoder = ScanDecoder(TOYOTA)
    speeds, stand = [], []
    for frame in LogSource(REAL_DATA / "comma2k19_rav4_bus0_bus1.log"):
        if scan := decoder.feed(frame):
            speeds.append(scan.ego_speed)
            absolute = scan.z[: scan.n, 1] + scan.ego_speed
            stand += absolute[np.abs(absolute) < 1].tolist()
            assert abs(math.degrees(scan.ego_yaw_rate)) < 5
    counts = decoder.counts
    assert (counts.ego, counts.bad_crc, counts.bad_counter, counts.scans) == (9948, 0, 0, 1200)
    assert 7 < min(speeds[1:]) < 9
    assert 19 < max(speeds[1:]) < 21
    # the roadside stands still
    assert len(stand) > 1000
    assert abs(np.median(stand)) < 0.15
