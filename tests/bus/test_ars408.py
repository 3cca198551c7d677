"""The ARS408's three messages per object, its several sensors and its own standard deviations."""

from __future__ import annotations

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
from can_imm.types import CanImmError

DB = cantools.database.load_file(ROOT / "dbc" / "ars408.dbc")
PROFILE = load_profile("ars408")
HEADER, GENERAL, QUALITY, EXTENDED = range(0x60A, 0x60E)


def encode(frame_id: int, **values: float) -> tuple[int, bytes]:
    message = DB.get_message_by_frame_id(frame_id)
    rest = {s.name: s.offset if s.offset < 0 else 0 for s in message.signals}
    return frame_id, message.encode({**rest, **values}, strict=False)


def quality(name: int, **changes: float) -> tuple[int, bytes]:
    values = {"Obj_ProbOfExist": 7, "Obj_MeasState": 2, **changes}
    return encode(QUALITY, Obj_ID=name, **values)


def scan_frames(ids, number=1, *, also=(QUALITY, EXTENDED)):
    frames = [encode(HEADER, Obj_NofObjects=len(ids), Obj_MeasCounter=number)]
    frames += [encode(GENERAL, Obj_ID=i, Obj_DistLong=20.0 + i) for i in ids]
    if QUALITY in also:
        frames += [quality(i) for i in ids]
    if EXTENDED in also:
        frames += [encode(EXTENDED, Obj_ID=i, Obj_Class=1, Obj_Length=4.4) for i in ids]
    return frames


class Bench:
    def __init__(self, profile=PROFILE, capacity=128):
        self.decoder = ScanDecoder(profile, capacity)
        self.scan = self.decoder._scan
        self.t_ns = 0
        self.found = []

    def feed(self, *frames, sensor=0):
        for frame_id, data in frames:
            self._keep(self.decoder.feed(Frame(self.t_ns, frame_id + 16 * sensor, data)))

    def wait(self, ms):
        self.t_ns += ms * MS
        self._keep(self.decoder.flush(self.t_ns))

    def _keep(self, scan):
        if scan is not None:
            now = round((self.t_ns - scan.t_ns) / MS)
            self.found.append((scan.counter, scan.ids[: scan.n].tolist(), now, scan.incomplete))


@pytest.fixture
def bench():
    return Bench()


def test_real_frames(bench):
    header = encode(HEADER, Obj_NofObjects=2, Obj_MeasCounter=61081)
    frames = ["104ECC028020018F", "024E73FF8020018E"]
    bench.feed(header, *((GENERAL, bytes.fromhex(text)) for text in frames))
    bench.wait(61)
    assert bench.found == [(61081, [16, 2], 61, False)]
    np.testing.assert_allclose(bench.scan.z[:2], [[4.2, 0, 0.6, 0], [2, 0, 0, 0]], atol=1e-9)


def test_a_real_header_announces_nine_objects(bench):
    bench.feed((HEADER, bytes.fromhex("09EE9910")))
    assert (bench.decoder._expected, bench.decoder._counter) == (9, 0xEE99)


@settings(max_examples=60)
@given(data=st.binary(min_size=8, max_size=8))
def test_any_object_frame_agrees_with_cantools(data):
    bench = Bench()
    bench.feed(encode(HEADER, Obj_NofObjects=1), (GENERAL, data))
    bench.wait(61)
    want = DB.decode_message(GENERAL, data, decode_choices=False)
    assert bench.scan.ids[0] == want["Obj_ID"]
    names = ("Obj_DistLong", "Obj_VrelLong", "Obj_DistLat", "Obj_VrelLat")
    np.testing.assert_allclose(bench.scan.z[0], [want[name] for name in names], atol=1e-9)


@settings(max_examples=60)
@given(data=st.binary(min_size=6, max_size=6), more=st.binary(min_size=7, max_size=7))
def test_any_quality_and_size_agree_with_cantools(data, more):
    bench = Bench()
    data, more = b"\x05" + data, b"\x05" + more
    bench.feed(encode(HEADER, Obj_NofObjects=1), encode(GENERAL, Obj_ID=5))
    bench.feed((QUALITY, data), (EXTENDED, more))
    said = {name: str(value) for name, value in DB.decode_message(QUALITY, data).items()}
    there = said["Obj_ProbOfExist"] not in ("Invalid", "Below25", "Below50")
    there &= said["Obj_MeasState"] in ("New", "Measured", "Predicted", "NewFromMerge")
    assert bench.scan.n == there
    if not there:
        return
    usual = (0.1, 0.3, 0.2, 0.3)
    for k, (name, step) in enumerate(
        (("DistLong", 0.2), ("VrelLong", 0.25), ("DistLat", 0.2), ("VrelLat", 0.25))
    ):
        text = said[f"Obj_{name}_rms"]
        own = usual[k] if text == "Invalid" else max(float(text), 0.1)
        assert bench.scan.std[0, k] == pytest.approx(math.hypot(own, step / math.sqrt(12)))
    assert bench.scan.new[0] == (said["Obj_MeasState"] in ("New", "NewFromMerge"))
    least = {"Below75": 0.5, "Below90": 0.75, "Below99": 0.9, "Below999": 0.99, "UpTo100": 0.999}
    assert least[said["Obj_ProbOfExist"]] < bench.scan.existence[0] <= 1
    told = DB.decode_message(EXTENDED, more, decode_choices=False)
    assert bench.scan.object_class[0] == told["Obj_Class"] % 7
    size = [told["Obj_Length"] or math.nan, told["Obj_Width"] or math.nan]
    np.testing.assert_allclose(bench.scan.size[0], size)


def test_a_scan_ends_with_its_last_frame(bench):
    bench.feed(*scan_frames([7, 3, 250]))
    assert bench.found == [(1, [7, 3, 250], 0, False)]
    assert bench.decoder.counts.used == bench.decoder.counts.frames == 10


@pytest.mark.parametrize("also", [(), (QUALITY,), (EXTENDED,)])
def test_what_a_sensor_does_not_send_is_waited_for_once(bench, also):
    for number in range(5):
        bench.feed(*scan_frames([1, 2], number, also=also))
        bench.wait(61)
        bench.wait(11)
    assert [late for _, _, late, _ in bench.found] == [61, 0, 0, 0, 0]
    assert not any(incomplete for *_, incomplete in bench.found)


def test_a_late_first_scan_ends_with_the_next_header(bench):
    bench.feed(*scan_frames([1], 1, also=()))
    bench.t_ns += 40 * MS
    bench.feed(*scan_frames([2], 2, also=()))
    assert bench.found == [(1, [1], 40, False), (2, [2], 0, False)]


def test_quality_switched_on_is_used_and_switched_off_is_forgotten(bench):
    def run(number, also):
        bench.feed(*scan_frames([1, 2], number, also=also))
        bench.wait(61)
        bench.wait(11)

    for number in range(3):
        run(number, ())
    assert bench.scan.existence[0] == 1
    run(3, (QUALITY,))
    run(4, (QUALITY,))
    assert bench.scan.existence[0] == 0.9995
    assert bench.found[-1][2] == 0
    for number in range(5, 10):
        run(number, ())
    assert [late for _, _, late, _ in bench.found[5:]] == [61, 61, 61, 0, 0]
    assert bench.scan.existence[0] == 1
    # the scan that brought the quality back had ended before
    assert bench.decoder.counts.stray == 2


def test_quality_that_is_lost_costs_the_quality_only(bench):
    bench.feed(*scan_frames([1, 2], 1))
    frames = scan_frames([1, 2], 2)
    del frames[3]
    bench.feed(*frames)
    bench.wait(61)
    assert bench.found[-1] == (2, [1, 2], 61, False)
    assert bench.scan.existence[:2].tolist() == [1, 0.9995]
    assert bench.scan.object_class[:2].tolist() == [1, 1]


def test_deleted_and_improbable_objects_are_left_out(bench):
    frames = scan_frames([1, 2, 3, 4], also=())
    frames += [quality(1), quality(2, Obj_MeasState=4), quality(3, Obj_ProbOfExist=2), quality(4)]
    bench.feed(*frames, *(encode(EXTENDED, Obj_ID=i, Obj_Class=i) for i in (1, 2, 3, 4)))
    assert bench.found == [(1, [1, 4], 0, False)]
    assert bench.scan.object_class[:2].tolist() == [1, 4]
    np.testing.assert_allclose(bench.scan.z[:2, 0], [21, 24])
    assert bench.decoder.counts.empty == 2


def test_frames_that_belong_to_no_object(bench):
    bench.feed(*scan_frames([1, 2], also=()))
    bench.feed(quality(9), quality(1), quality(1), encode(GENERAL, Obj_ID=3))
    counts = bench.decoder.counts
    assert (counts.stray, counts.duplicates, counts.used) == (2, 1, 4)


def test_frames_may_be_padded_but_not_cut(bench):
    header, one, good, more = scan_frames([1])
    bench.feed((HEADER, header[1] + bytes(4)), one, (QUALITY, good[1] + b"\xff"), more)
    assert bench.found == [(1, [1], 0, False)]
    bench.feed((HEADER, header[1][:3]))
    assert bench.decoder.counts.bad_length == 1


def test_the_first_sensor_that_is_heard_counts(bench):
    bench.feed(encode(GENERAL, Obj_ID=1), sensor=5)
    assert bench.decoder.sensor is None
    bench.feed(*scan_frames([1], 1), sensor=3)
    bench.feed(*scan_frames([2], 2), sensor=0)
    bench.feed(*scan_frames([3], 2), sensor=3)
    assert bench.decoder.sensor == 3
    assert [ids for _, ids, *_ in bench.found] == [[1], [3]]
    counts = bench.decoder.counts
    assert (counts.stray, counts.other_sensor, counts.unknown) == (1, 4, 0)
    assert counts.frames == counts.used + counts.stray + counts.other_sensor


def test_a_sensor_can_be_chosen(tmp_path):
    bench = Bench(load_profile("ars408", sensor=2))
    bench.feed(*scan_frames([1]), sensor=0)
    bench.feed(*scan_frames([2]), sensor=2)
    assert bench.decoder.sensor == 2
    assert [ids for _, ids, *_ in bench.found] == [[2]]
    text = PROFILE.path.read_text().replace("number = 8", "number = 8\nuse = 6")
    text = text.replace('dbc = "', f'dbc = "{PROFILE.path.parent}/')
    (tmp_path / "six.toml").write_text(text)
    assert ScanDecoder(load_profile(str(tmp_path / "six.toml"))).sensor == 6


@pytest.mark.parametrize(("name", "sensor"), [("ars408", 8), ("ars408", -1), ("toyota", 1)])
def test_a_sensor_that_is_not_there(name, sensor):
    with pytest.raises(CanImmError, match="has sensors 0 to"):
        load_profile(name, sensor=sensor)


@pytest.mark.parametrize("sensor", [0, 4])
def test_ego_motion_of_the_sensor_bus(bench, sensor):
    speed = encode(0x300, RadarDevice_Speed=21.5, RadarDevice_SpeedDirection=1)
    back = encode(0x300, RadarDevice_Speed=2.0, RadarDevice_SpeedDirection=2)
    turn = encode(0x301, RadarDevice_YawRate=-3.0)
    bench.feed(*scan_frames([1]), sensor=sensor)
    assert math.isnan(bench.scan.ego_speed)
    bench.feed(speed, turn)
    bench.feed(*scan_frames([1], 2), sensor=sensor)
    assert bench.scan.ego_speed == pytest.approx(21.5)
    assert bench.scan.ego_yaw_rate == pytest.approx(math.radians(-3.0))
    bench.feed(back, sensor=sensor)
    bench.feed(*scan_frames([1], 3), sensor=sensor)
    assert bench.scan.ego_speed == pytest.approx(-2.0)
    assert bench.decoder.counts.ego == 3


def test_a_mounted_and_turned_sensor(tmp_path):
    text = PROFILE.path.read_text().replace('dbc = "', f'dbc = "{PROFILE.path.parent}/')
    text += "\n[mounting]\nx = -1.5\ny = 0.8\nyaw_deg = 30\n"
    (tmp_path / "corner.toml").write_text(text)
    bench = Bench(load_profile(str(tmp_path / "corner.toml")))
    bench.feed(encode(HEADER, Obj_NofObjects=1, Obj_MeasCounter=1))
    bench.feed(
        encode(GENERAL, Obj_ID=1, Obj_DistLong=40, Obj_DistLat=6, Obj_VrelLong=-5, Obj_VrelLat=1)
    )
    bench.wait(61)
    scan = bench.scan
    turn = complex(math.cos(math.radians(30)), math.sin(math.radians(30)))
    assert scan.angle[0] == pytest.approx(math.radians(30))
    place = complex(scan.z[0, 0], scan.z[0, 2]) * turn
    assert place == pytest.approx(complex(40, 6) * turn + complex(-1.5, 0.8))
    assert complex(scan.z[0, 1], scan.z[0, 3]) == pytest.approx(complex(-5, 1))
