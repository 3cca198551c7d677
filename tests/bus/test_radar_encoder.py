"""What the radars would send, read back by the decoder, and by cantools."""

from __future__ import annotations

import cmath
import math

import cantools
import numpy as np
import pytest
from bus_frames import MS
from hypothesis import given, settings
from hypothesis import strategies as st

from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.encoder import RadarEncoder
from can_imm.bus.profile import builtin_profiles, load_profile
from can_imm.bus.radar_encoder import ProfileEncoder
from can_imm.types import Scan

PROFILES = {name: load_profile(name) for name in builtin_profiles()}
NAN = float("nan")


def scan_of(rows, ids, new=()):
    scan = Scan(max(len(rows), 1))
    scan.n = len(rows)
    for i, row in enumerate(rows):
        scan.ids[i] = ids[i]
        scan.valid[i] = ~np.isnan(row)
        scan.z[i] = np.nan_to_num(row)
        scan.new[i] = ids[i] in new
    scan.std[:] = (0.1, 0.3, 0.2, 0.3)
    return scan


class Bench:
    """Sends and reads; a first scan teaches the decoder what the sensor sends."""

    def __init__(self, profile, **options):
        self.encoder, self.decoder = ProfileEncoder(profile, **options), ScanDecoder(profile, 64)
        self.t_ns = 0
        self.period_ns = profile.period_ns

    def run(self, scan):
        found = []
        for frame in self.encoder.encode(scan, self.t_ns):
            result = self.decoder.feed(frame)
            found += [result] if result else []
        self.t_ns += self.period_ns
        assert len(found) == 1
        return found[0]


def steps(profile):
    """Size of a signal's step in SI units for each component."""
    return [
        part.factor * profile.messages[0].get_signal_by_name(part.signal).scale if part else 0.0
        for part in profile.state
    ]


def most(profile):
    if profile.header is None:
        return len(profile.messages)
    signal = profile.messages[0].get_signal_by_name(profile.id)
    return min(int(signal.maximum or 2**signal.length - 1) + 1, 60)


@pytest.mark.parametrize("name", PROFILES)
@settings(max_examples=25)
@given(data=st.data())
def test_a_scan_comes_back_within_half_a_step(name, data):
    profile = PROFILES[name]
    ids = data.draw(st.lists(st.integers(0, most(profile) - 1), unique=True, max_size=4))
    state = st.tuples(st.floats(1, 200), st.floats(-40, 40), st.floats(-20, 20), st.floats(-10, 10))
    rows = [data.draw(state) for _ in ids]
    new = data.draw(st.sets(st.sampled_from(ids))) if ids else set()
    bench = Bench(profile)
    scan = bench.run(scan_of(rows, ids, new))
    by_id = {int(scan.ids[k]): k for k in range(scan.n)}
    assert sorted(by_id) == sorted(ids)
    assert bench.decoder.counts.rejected == 0
    step = steps(profile)
    for name_, row in zip(ids, rows, strict=True):
        k = by_id[name_]
        assert scan.new[k] == (name_ in new)
        if not profile.polar:
            for state_, part in enumerate(profile.state):
                assert scan.valid[k, state_] == (part is not None)
                if part is not None:
                    assert abs(scan.z[k, state_] - row[state_]) <= step[state_] / 2 + 1e-9
            continue
        place, speed = complex(row[0], row[2]), complex(row[1], row[3])
        assert abs(scan.z[k, 0] - abs(place)) <= step[0] / 2 + 1e-9
        assert abs(scan.angle[k] - cmath.phase(place)) <= step[2] / 2 + 1e-9 or abs(
            cmath.phase(place)
        ) > math.radians(51)
        rate = (place.conjugate() * speed).real / abs(place)
        assert abs(scan.z[k, 1] - rate) <= step[1] / 2 + 1e-9


@pytest.mark.parametrize("name", PROFILES)
def test_what_was_decoded_can_be_sent_again(name):
    profile = PROFILES[name]
    first = Bench(profile)
    scan = first.run(scan_of([[55.3, -4.2, 2.7, 0.4], [20, 3, -3, 0]], [0, 1]))
    again = Bench(profile).run(scan)
    np.testing.assert_allclose(again.z[:2], scan.z[:2], atol=1e-9)
    np.testing.assert_allclose(again.angle[:2], scan.angle[:2], atol=1e-9)


@pytest.mark.parametrize("name", ["can_imm", "ars408", "esr", "toyota"])
@given(speed=st.floats(-30, 60), turn=st.floats(-1.5, 1.5))
@settings(max_examples=30)
def test_ego_motion_comes_back(name, speed, turn):
    profile = PROFILES[name]
    decoder, encoder = ScanDecoder(profile), ProfileEncoder(profile)
    if name == "can_imm":
        speed = abs(speed)
    for frame in encoder.encode_ego(speed, turn, 0):
        decoder.feed(frame)
    assert decoder.counts.rejected == decoder.counts.unknown == 0
    back = decoder._ego.at(0)
    exact = {
        "can_imm": (0.01, 0.0002),
        "ars408": (0.02, math.radians(0.01)),
        "esr": (0.0625, math.radians(0.0625)),
        "toyota": (0.01 / 3.6, math.radians(0.244)),
    }
    if name == "toyota":
        speed = max(speed, -67.67 / 3.6)
    if name == "ars408" and abs(speed) < 0.05:
        speed = abs(speed)  # standstill, neither forwards nor backwards
    assert abs(back[0] - speed) <= exact[name][0] / 2 + 1e-9
    assert abs(back[1] - turn) <= exact[name][1] / 2 + 1e-9


@pytest.mark.parametrize(
    ("speed", "direction", "raw"),
    [(20, 1, 1000), (0.06, 1, 3), (0.04, 0, 2), (0, 0, 0), (-0.04, 0, 2), (-0.06, 2, 3)],
)
def test_the_ars408_is_told_which_way_the_vehicle_goes(speed, direction, raw):
    """SpeedInformation: two bits of direction, one without meaning, 13 of speed in 0.02 m/s."""
    frames = ProfileEncoder(PROFILES["ars408"]).encode_ego(speed, 0.1, 0)
    [data] = [frame.data for frame in frames if frame.id == 0x300]
    assert int.from_bytes(data, "big") == direction << 14 | raw


def test_ego_motion_that_is_not_known():
    for name in ("can_imm", "esr", "ars408", "toyota"):
        decoder = ScanDecoder(PROFILES[name])
        for frame in ProfileEncoder(PROFILES[name]).encode_ego(NAN, NAN, 0):
            decoder.feed(frame)
        if name != "esr":  # it can say that of the yaw rate only
            assert math.isnan(decoder._ego.at(0)[0])
        assert math.isnan(decoder._ego.at(0)[1])
    assert ProfileEncoder(PROFILES["tracking"]).encode_ego(1.0, 0.0, 0) == []


def test_our_own_messages_are_bit_for_bit_those_of_the_lean_encoder():
    lean, general = RadarEncoder(), ProfileEncoder(PROFILES["can_imm"])
    for k in range(40):
        rows = [[50.3 + k, -1.1, 2.2, NAN], [10.0, NAN, -30.0, 0.1], [260.0, 1.0, 0.0, 0.0]]
        scan = scan_of(rows, [3, 63, 70 if k % 2 else 5], {63})
        assert general.encode(scan, k * MS) == lean.encode(scan, k * MS)
    assert general.left_out == lean.left_out == 20


def test_what_the_ars408_says_of_its_objects():
    bench = Bench(PROFILES["ars408"])
    scan = scan_of([[50, -1, 2, 0], [80, 3, 1, 0]], [7, 200], {200})
    scan.std[:2] = [[0.5, 0.2, 1.0, NAN], [0.02, 3, 3, 3]]
    scan.existence[:2] = [1.0, 0.8]
    scan.object_class[:2] = [1, 2]
    scan.size[:2] = [[4.4, 1.8], [NAN, NAN]]
    db = cantools.database.load_file(PROFILES["ars408"].dbc)
    frames = bench.encoder.encode(scan, 0)
    assert [f.id for f in frames] == [0x60A, *[0x60B] * 2, *[0x60C] * 2, *[0x60D] * 2]
    one, two = (db.decode_message(0x60C, f.data) for f in frames[3:5])
    said = {name: str(value) for name, value in one.items()}
    assert (said["Obj_DistLong_rms"], said["Obj_VrelLong_rms"]) == ("0.478", "0.224")
    assert (said["Obj_DistLat_rms"], said["Obj_VrelLat_rms"]) == ("1.023", "Invalid")
    assert (said["Obj_MeasState"], said["Obj_ProbOfExist"]) == ("Measured", "UpTo100")
    assert (str(two["Obj_MeasState"]), str(two["Obj_ProbOfExist"])) == ("New", "Below90")
    back = bench.run(scan)
    assert back.object_class[:2].tolist() == [1, 2]
    np.testing.assert_allclose(back.size[:2], [[4.4, 1.8], [NAN, NAN]])


def test_quality_can_be_left_out():
    bench = Bench(PROFILES["ars408"], also=False)
    frames = bench.encoder.encode(scan_of([[50, -1, 2, 0]], [7]), 0)
    assert [f.id for f in frames] == [0x60A, 0x60B]


def test_a_chosen_sensor_sends_with_its_ids():
    encoder = ProfileEncoder(load_profile("ars408", sensor=3))
    frames = encoder.encode(scan_of([[50, -1, 2, 0]], [7]), 0) + encoder.encode_ego(1, 0, 0)
    assert [f.id for f in frames] == [0x63A, 0x63B, 0x63C, 0x63D, 0x330, 0x331]


@pytest.mark.parametrize("name", ["toyota", "toyota-tss2", "esr"])
def test_slots(name):
    profile = PROFILES[name]
    bench = Bench(profile)
    for k in range(300):
        slot = k % len(profile.messages)
        frames = bench.encoder.encode(scan_of([[40, 1, 0, 0]] * 2, [slot, 64]), bench.t_ns)
        assert [f.id for f in frames] == [m.frame_id for m in profile.messages]
        for frame in frames:
            if scan := bench.decoder.feed(frame):
                assert scan.ids[: scan.n].tolist() == [slot]
        bench.t_ns += bench.period_ns
    counts = bench.decoder.counts
    assert (counts.scans, counts.incomplete_scans, counts.rejected, counts.lost) == (300, 0, 0, 0)
    assert bench.encoder.left_out == 300


def test_toyota_checksums():
    for frame in ProfileEncoder(PROFILES["toyota"]).encode(scan_of([[40, 1, 0, 0]], [3]), 0):
        head = 0x02 + (frame.id & 0xFF) + 8
        assert (sum(frame.data[:7]) + head) & 0xFF == frame.data[7]


def test_mounted_sensors_send_in_their_own_axes(tmp_path):
    for name in ("ars408", "esr"):
        text = PROFILES[name].path.read_text()
        text = text.replace('dbc = "', f'dbc = "{PROFILES[name].path.parent}/')
        path = tmp_path / f"{name}.toml"
        path.write_text(text + "\n[mounting]\nx = -1.5\ny = 0.8\nyaw_deg = 20\n")
        profile = load_profile(str(path))
        scan = Bench(profile).run(scan_of([[60.0, -4.0, 15.0, 1.0]], [1]))
        axes = cmath.rect(1, scan.angle[0])
        assert complex(scan.z[0, 0], scan.z[0, 2]) * axes == pytest.approx(60 + 15j, abs=0.2)
        if name == "ars408":
            speed = complex(scan.z[0, 1], scan.z[0, 3]) * axes
            assert speed == pytest.approx(-4 + 1j, abs=0.2)
