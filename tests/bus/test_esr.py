"""The ESR's polar tracks: turned axes, proper noise, mounting."""

from __future__ import annotations

import cmath
import math

import cantools
import numpy as np
import pytest
from bus_frames import MS, ROOT
from hypothesis import given, settings
from hypothesis import strategies as st

from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.frame import Frame
from can_imm.bus.profile import load_profile

DB = cantools.database.load_file(ROOT / "dbc" / "esr.dbc")
PROFILE = load_profile("esr")
SHORT = {
    "status": "STATUS", "range": "RANGE", "rate": "RANGE_RATE", "angle": "ANGLE",
    "count": "ROLLING_COUNT", "bridge": "BRIDGE_OBJECT", "width": "WIDTH",
}  # fmt: skip


def track(slot, **values):
    message = DB.get_message_by_frame_id(0x500 + slot)
    signals = {signal.name: 0 for signal in message.signals}
    for name, value in values.items():
        signals[f"CAN_TX_TRACK_{SHORT[name]}"] = value
    return message.frame_id, message.encode(signals)


def scan_of(decoder, tracks, count=0, t_ms=0):
    """The scan of these tracks; the other slots are empty."""
    found = []
    for slot in range(64):
        values = {"count": count, **tracks.get(slot, {})}
        scan = decoder.feed(Frame(t_ms * MS + slot * MS // 10, *track(slot, **values)))
        found += [scan] if scan else []
    assert len(found) == 1
    return found[0]


def test_a_track_in_axes_along_the_line_of_sight():
    seen = {"status": 3, "range": 80.0, "rate": -4.5, "angle": 12.0, "width": 2.0}
    scan = scan_of(ScanDecoder(PROFILE), {9: seen})
    assert (scan.n, scan.ids[0], scan.incomplete) == (1, 9, False)
    assert scan.angle[0] == pytest.approx(math.radians(-12))  # the sensor counts to the right
    np.testing.assert_allclose(scan.z[0], [80.0, -4.5, 0, 0])
    assert scan.valid[0].tolist() == [True, True, True, False]
    bearing = math.hypot(math.radians(0.5), math.radians(0.1) / math.sqrt(12))
    want = [math.hypot(0.25, 0.1 / 12**0.5), math.hypot(0.12, 0.01 / 12**0.5), 80 * bearing]
    np.testing.assert_allclose(scan.std[0, :3], want)
    assert scan.size[0, 1] == 2.0
    assert math.isnan(scan.size[0, 0])


def test_near_by_the_noise_across_does_not_vanish():
    scan = scan_of(ScanDecoder(PROFILE), {0: {"status": 3, "range": 0.0}})
    assert scan.std[0, 2] > 0.008


@pytest.mark.parametrize(
    ("status", "there", "new"),
    [(0, 0, 0), (1, 1, 1), (2, 1, 0), (3, 1, 0), (4, 0, 0), (5, 1, 0), (6, 0, 0), (7, 0, 0)],
)
def test_what_a_status_means(status, there, new):
    scan = scan_of(ScanDecoder(PROFILE), {3: {"status": status, "range": 50.0}})
    assert scan.n == there
    assert not there or scan.new[0] == new


def test_bridges_and_what_is_out_of_reach_are_left_out():
    tracks = {1: {"status": 3, "range": 204.7}, 2: {"status": 3, "range": 60.0, "bridge": 1}}
    assert scan_of(ScanDecoder(PROFILE), tracks).n == 0


def test_scans_are_told_apart_by_one_bit():
    decoder = ScanDecoder(PROFILE)
    for k in range(20):
        scan = scan_of(decoder, {k % 64: {"status": 3, "range": 50.0}}, k % 2, 50 * k)
        assert (scan.t_ns, scan.ids[0]) == (50 * k * MS, k % 64)
    assert (decoder.counts.scans, decoder.counts.stray) == (20, 0)


@settings(max_examples=15)
@given(
    distance=st.integers(10, 2000), angle=st.integers(-450, 450), x=st.floats(-5, 5),
    y=st.floats(-2, 2), yaw=st.floats(-170, 170),
)  # fmt: skip
def test_mounting(tmp_path_factory, distance, angle, x, y, yaw):
    path = tmp_path_factory.mktemp("esr") / "turned.toml"
    text = PROFILE.path.read_text().replace('dbc = "', f'dbc = "{PROFILE.path.parent}/')
    path.write_text(f"{text}\n[mounting]\nx = {x}\ny = {y}\nyaw_deg = {yaw}\n")
    track = {"status": 3, "range": distance / 10, "rate": 3.0, "angle": angle / 10}
    scan = scan_of(ScanDecoder(load_profile(str(path))), {0: track})
    sight = cmath.rect(1, math.radians(yaw - angle / 10))
    assert cmath.rect(1, scan.angle[0]) == pytest.approx(sight)
    place = complex(scan.z[0, 0], scan.z[0, 2]) * cmath.rect(1, scan.angle[0])
    assert place == pytest.approx(complex(x, y) + distance / 10 * sight)
    assert scan.z[0, 1] == pytest.approx(3.0)


def test_ego_motion_is_positive_to_the_left():
    decoder = ScanDecoder(PROFILE)
    message = DB.get_message_by_name("Vehicle1")

    def tell(**values):
        names = {"speed": "VEHICLE_SPEED", "way": "VEHICLE_SPEED_DIRECTION", "turn": "YAW_RATE",
                 "valid": "YAW_RATE_VALIDITY"}  # fmt: skip
        data = message.encode({f"CAN_RX_{names[k]}": v for k, v in values.items()})
        decoder.feed(Frame(0, message.frame_id, data))

    tell(speed=20.0, way=0, turn=5.0, valid=1)
    scan = scan_of(decoder, {}, 0)
    assert scan.ego_speed == 20.0
    assert scan.ego_yaw_rate == pytest.approx(-math.radians(5.0))
    tell(speed=3.0, way=1, turn=5.0, valid=0)
    scan = scan_of(decoder, {}, 1, 50)
    assert scan.ego_speed == -3.0
    assert math.isnan(scan.ego_yaw_rate)
