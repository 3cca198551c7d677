"""A radar that nobody knows: little-endian, polar, with a header, mounted off the middle."""

from __future__ import annotations

import cmath
import math

import cantools
import numpy as np
import pytest
from bus_frames import MS

from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.frame import Frame
from can_imm.bus.profile import load_profile
from can_imm.bus.radar_encoder import ProfileEncoder

DBC = """
VERSION ""
NS_ :
BS_:
BU_: RADAR CAR

BO_ 1024 RadarStatus: 3 RADAR
 SG_ Targets : 0|6@1+ (1,0) [0|40] "" CAR
 SG_ Cycle : 8|16@1+ (1,0) [0|65535] "" CAR

BO_ 1025 RadarTarget: 8 RADAR
 SG_ Number : 0|6@1+ (1,0) [0|39] "" CAR
 SG_ State : 6|2@1+ (1,0) [0|3] "" CAR
 SG_ Range : 8|14@1+ (0.02,0) [0|300] "m" CAR
 SG_ Azimuth : 22|11@1- (0.1,0) [-75|75] "deg" CAR
 SG_ RangeRate : 33|12@1- (0.18,0) [-360|360] "km/h" CAR
 SG_ RangeSigma : 45|6@1+ (0.05,0) [0|3.1] "m" CAR
 SG_ Likelihood : 51|7@1+ (1,0) [0|100] "%" CAR

BO_ 416 CarMotion: 6 CAR
 SG_ CarSpeed : 0|16@1+ (0.01,0) [0|300] "km/h" RADAR
 SG_ CarTurn : 16|16@1- (0.01,0) [-100|100] "deg/s" RADAR

VAL_ 1025 RangeRate -2048 "NotAvailable" ;
"""
TOML = """
dbc = "own.dbc"
[scan]
period_ms = 60
timeout_ms = 40
latency_ms = 35
header = "RadarStatus"
count = "Targets"
counter = "Cycle"
[object]
messages = ["RadarTarget"]
id = "Number"
new = "State"
new_codes = [1]
valid_if = [{ signal = "State", any_of = [2, 1] }]
existence = { signal = "Likelihood", at_least = 0.5 }
[object.polar]
range = { signal = "Range", std = 0.2, std_signal = "RangeSigma", std_floor = 0.1 }
rate = { signal = "RangeRate", std = 0.36 }
bearing = { signal = "Azimuth", sign = -1, offset = 1.5, std = 0.4 }
[protection]
kind = "none"
[mounting]
x = -0.3
y = 0.5
[ego]
timeout_ms = 300
speed = { message = "CarMotion", signal = "CarSpeed" }
yaw_rate = { message = "CarMotion", signal = "CarTurn" }
"""


@pytest.fixture
def profile(tmp_path):
    (tmp_path / "own.dbc").write_text(DBC)
    (tmp_path / "own.toml").write_text(TOML)
    return load_profile(str(tmp_path / "own.toml"))


@pytest.fixture
def scan(profile):
    """What is read of frames that cantools made."""
    db = cantools.database.load_file(profile.dbc)
    target = {
        "Number": 7, "State": 1, "Range": 50.0, "Azimuth": -10.0, "RangeRate": -36.0,
        "RangeSigma": 0.6, "Likelihood": 80,
    }  # fmt: skip
    frames = [
        (416, {"CarSpeed": 90.0, "CarTurn": -2.0}),
        (1024, {"Targets": 3, "Cycle": 9}),
        (1025, target),
        (1025, {**target, "Number": 8, "Likelihood": 49}),
        (1025, {**target, "Number": 9, "State": 2, "RangeRate": -2048 * 0.18, "RangeSigma": 0}),
    ]
    decoder = ScanDecoder(profile)
    results = []
    for frame_id, values in frames:
        data = db.get_message_by_frame_id(frame_id).encode(values, strict=False)
        results.append(decoder.feed(Frame(100 * MS, frame_id, data)))
    assert results[:4] == [None] * 4
    assert (decoder.counts.empty, decoder.counts.not_available) == (1, 1)
    return results[4]


def test_all_of_it(scan):
    assert (scan.t_ns, scan.n, scan.counter, scan.incomplete) == (65 * MS, 2, 9, False)
    assert (scan.ids[:2].tolist(), scan.new[:2].tolist()) == ([7, 9], [True, False])
    assert scan.existence[:2].tolist() == [0.8, 0.8]
    sight = cmath.rect(1, math.radians(11.5))
    assert cmath.rect(1, scan.angle[0]) == pytest.approx(sight)
    assert complex(scan.z[0, 0], scan.z[0, 2]) * sight == pytest.approx(50 * sight - 0.3 + 0.5j)
    assert scan.z[0, 1] == pytest.approx(-10.0)
    assert scan.valid[:2].tolist() == [[True, True, True, False], [True, False, True, False]]
    range_std = math.hypot(0.6, 0.02 / 12**0.5), math.hypot(0.1, 0.02 / 12**0.5)
    np.testing.assert_allclose(scan.std[:2, 0], range_std)
    assert scan.std[0, 1] == pytest.approx(math.hypot(0.1, 0.05 / 12**0.5))
    across = 50 * math.radians(math.hypot(0.4, 0.1 / 12**0.5))
    np.testing.assert_allclose(scan.std[:2, 2], across)
    assert scan.ego_speed == pytest.approx(25.0)
    assert scan.ego_yaw_rate == pytest.approx(math.radians(-2.0))


def test_it_can_be_sent_again(profile, scan):
    decoder = ScanDecoder(profile)
    again = [decoder.feed(frame) for frame in ProfileEncoder(profile).encode(scan, 0)][-1]
    np.testing.assert_allclose(again.z[:2], scan.z[:2], atol=1e-9)
    np.testing.assert_allclose(again.angle[:2], scan.angle[:2], atol=1e-9)
    assert again.valid[:2].tolist() == scan.valid[:2].tolist()
    assert again.existence[:2].tolist() == [0.8, 0.8]
    np.testing.assert_allclose(again.std[:2], scan.std[:2], atol=0.03)
