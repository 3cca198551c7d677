"""Scans of our own radar messages: what is right is used, everything else counted and survived."""

from __future__ import annotations

import math

import numpy as np
import pytest
from bus_frames import MS, Radar, protect
from hypothesis import given, settings
from hypothesis import strategies as st

from can_imm.bus.decoder import DecodeCounts, ScanDecoder
from can_imm.bus.frame import ERROR, EXTENDED, FD, REMOTE, Frame
from can_imm.bus.profile import load_profile

PROFILE = load_profile("can_imm")
FATES = (
    "unknown", "bad_kind", "bad_length", "bad_crc", "bad_counter", "out_of_range", "stray",
    "duplicates", "overflow", "empty", "used", "ego", "other_sensor",
)  # fmt: skip


class Bench:
    """A decoder that is fed at a time of its own and keeps copies of what it says."""

    def __init__(self, capacity: int = 64) -> None:
        self.decoder = ScanDecoder(PROFILE, capacity)
        self.t_ns = 0
        self.scans: list[tuple[int, list[int], bool]] = []

    def feed(self, *frames: tuple[int, bytes], flags: int = 0) -> None:
        for frame_id, data in frames:
            self._keep(self.decoder.feed(Frame(self.t_ns, frame_id, data, "vcan0", flags)))

    def wait(self, ms: int) -> None:
        self.t_ns += ms * MS
        self._keep(self.decoder.flush(self.t_ns))

    def _keep(self, scan) -> None:
        if scan is not None:
            ids = scan.ids[: scan.n].tolist()
            self.scans.append((scan.t_ns // MS, ids, scan.incomplete))

    @property
    def counts(self) -> DecodeCounts:
        counts = self.decoder.counts
        assert counts.frames == sum(getattr(counts, fate) for fate in FATES)
        return counts


@pytest.fixture
def bench():
    return Bench()


def test_a_whole_scan_in_si_units(bench, radar):
    bench.t_ns = 1234 * MS
    assert bench.decoder.feed(Frame(bench.t_ns, *radar.scan(2))) is None
    assert bench.decoder.feed(Frame(bench.t_ns + MS, *radar.object(7, ObjectNew=1))) is None
    scan = bench.decoder.feed(
        Frame(bench.t_ns + 2 * MS, *radar.object(63, DistLong=-3.5, DistLat=-2.0, VrelLat=-1.4))
    )
    assert (scan.t_ns, scan.counter, scan.incomplete, scan.n) == (1234 * MS, 1, False, 2)
    assert scan.ids[:2].tolist() == [7, 63]
    assert scan.new[:2].tolist() == [True, False]
    expected = [[50.0, -0.98, 1.0, 0.35], [-3.5, -0.98, -2.0, -1.4]]
    np.testing.assert_allclose(scan.z[:2], expected, atol=1e-12)
    steps = np.array([0.02, 0.07, 0.05, 0.07])
    std = np.sqrt(np.array([0.1, 0.3, 0.2, 0.3]) ** 2 + steps**2 / 12)
    np.testing.assert_allclose(scan.std[:2], [std] * 2)
    assert not scan.angle[:2].any()
    assert (scan.existence[:2] == 1).all()
    assert scan.valid[:2].all()
    assert bench.counts.used == bench.counts.checksums_ok == 3
    assert bench.decoder.ids == {0x300, 0x301, 0x302}


def test_latency_sign_and_offset_of_a_profile(tmp_path, radar):
    text = PROFILE.path.read_text().replace("latency_ms = 0", "latency_ms = 12.5")
    text = text.replace("std = 0.2", "std = 0.4, sign = -1, offset = 0.5")
    text = text.replace('dbc = "', f'dbc = "{PROFILE.path.parent}/')
    (tmp_path / "x.toml").write_text(text)
    decoder = ScanDecoder(load_profile(str(tmp_path / "x.toml")))
    decoder.feed(Frame(100 * MS, *radar.scan(1)))
    scan = decoder.feed(Frame(101 * MS, *radar.object(1, DistLat=2.0)))
    assert scan.t_ns == 87_500_000
    assert scan.z[0, 2] == pytest.approx(-1.5)
    np.testing.assert_allclose(scan.std[0], [0.1, 0.3, 0.4, 0.3], rtol=0.005)


def test_an_empty_scan_is_a_scan(bench, radar):
    bench.feed(radar.scan(0))
    assert bench.scans == [(0, [], False)]


@pytest.mark.parametrize("bit", range(64))
def test_one_wrong_bit_costs_that_object_only(radar, bit):
    bench = Bench()
    good, (frame_id, data) = radar.object(1), radar.object(2)
    broken = int.from_bytes(data, "little") ^ 1 << bit
    bench.feed(radar.scan(3), good, (frame_id, broken.to_bytes(8, "little")), radar.object(3))
    assert bench.scans == []
    bench.wait(51)
    assert bench.scans == [(0, [1, 3], True)]
    assert (bench.counts.bad_crc, bench.counts.incomplete_scans, bench.counts.lost) == (1, 1, 1)


def test_the_crc_covers_the_data_id(bench, radar):
    _, data = radar.object(1)
    bench.feed(radar.scan(1), (0x301, protect(data, 0x300)))
    assert bench.counts.bad_crc == 1


def test_a_repeated_frame_is_rejected(bench, radar):
    first = radar.object(1)
    bench.feed(radar.scan(2), first, first, radar.object(2))
    assert bench.scans == [(0, [1, 2], False)]
    assert bench.counts.bad_counter == 1


def test_counter_15_is_invalid(bench, radar):
    radar.counters["RadarObject"] = 15
    bench.feed(radar.scan(1), radar.object(1))
    assert (bench.counts.bad_crc, bench.counts.used) == (1, 1)


def test_lost_frames_are_counted_by_the_counter_across_its_wrap(bench, radar):
    for lost in (0, 1, 13):
        bench.feed(radar.scan(1))
        for _ in range(lost):
            radar.object(1)
        bench.feed(radar.object(1))
    assert bench.counts.lost == 14
    assert len(bench.scans) == 3


def test_lost_scans_are_counted_by_the_scan_counter(bench, radar):
    for step in (1, 3, 65533, 2, 65000):
        bench.feed(radar.scan(0))
        bench.t_ns += 100 * MS
        radar.scans = (radar.scans + step - 1) % 65536
    bench.feed(radar.scan(0))
    assert bench.counts.lost_scans == 3


def test_after_a_long_silence_any_counter_will_do(bench, radar):
    bench.feed(radar.scan(1), radar.object(1))
    radar.counters = {"RadarScan": 0, "RadarObject": 0}
    bench.wait(1001)
    bench.feed(radar.scan(1), radar.object(1))
    assert len(bench.scans) == 2
    assert (bench.counts.bad_counter, bench.counts.lost) == (0, 0)


@pytest.mark.parametrize("size", [0, 1, 7, 9])
def test_wrong_length(bench, radar, size):
    frame_id, data = radar.object(1)
    bench.feed(radar.scan(1), (frame_id, (data + bytes(8))[:size]))
    assert (bench.counts.bad_length, bench.counts.used) == (1, 1)


@pytest.mark.parametrize("flags", [EXTENDED, FD, REMOTE, ERROR])
def test_frames_of_another_kind(bench, radar, flags):
    bench.feed(radar.scan(1))
    bench.feed(radar.object(1), flags=flags)
    bench.feed((0x7FF, b""), flags=flags)
    assert (bench.counts.bad_kind, bench.counts.unknown, bench.counts.used) == (1, 1, 1)


def test_unknown_ids_are_ignored(bench, radar):
    bench.feed(radar.scan(1), (0x303, bytes(8)), (0x310, bytes(8)), radar.object(4))
    assert bench.scans == [(0, [4], False)]
    assert bench.counts.unknown == 2


@pytest.mark.parametrize(
    ("signal", "value"),
    [("DistLong", 251.0), ("DistLat", -25.4), ("VrelLong", 71.0), ("VrelLat", -17.7)],
)
def test_an_object_out_of_range_is_not_used_at_all(bench, radar, signal, value):
    bench.feed(radar.scan(2), radar.object(1, **{signal: value}), radar.object(2))
    assert bench.scans == [(0, [2], True)]
    assert (bench.counts.out_of_range, bench.counts.incomplete_scans) == (1, 1)


def test_a_count_out_of_range_or_not_available(bench, radar):
    for count in (65, 127):
        bench.feed(radar.scan(count), radar.object(1))
    assert (bench.counts.out_of_range, bench.counts.stray) == (2, 2)
    assert bench.scans == []


NOT_AVAILABLE = {
    "DistLong": 16383 * 0.02 - 75, "VrelLong": 2047 * 0.07 - 71.61,
    "DistLat": 1023 * 0.05 - 25.55, "VrelLat": 511 * 0.07 - 17.85,
}  # fmt: skip


@pytest.mark.parametrize(("column", "signal"), list(enumerate(NOT_AVAILABLE)))
def test_a_component_that_is_not_available(radar, column, signal):
    bench = Bench()
    bench.feed(radar.scan(2), radar.object(1, **{signal: NOT_AVAILABLE[signal]}))
    scan = bench.decoder.feed(Frame(0, *radar.object(2)))
    assert [i for i in range(4) if not scan.valid[0, i]] == [column]
    assert np.isfinite(scan.z[:2]).all()
    assert scan.valid[1].all()
    assert not scan.incomplete
    assert bench.counts.not_available == 1


def test_an_object_without_any_component_and_an_invalid_one_fill_their_place(bench, radar):
    bench.feed(
        radar.scan(4),
        radar.object(1, **NOT_AVAILABLE),
        radar.object(0, ObjectValid=0),
        radar.object(0, ObjectValid=0, DistLong=251.0),
        radar.object(3),
    )
    assert bench.scans == [(0, [3], False)]
    assert (bench.counts.empty, bench.counts.used) == (3, 2)


def test_fewer_objects_than_announced(bench, radar):
    bench.feed(radar.scan(3), radar.object(1))
    bench.wait(50)
    assert bench.scans == []
    bench.wait(1)
    assert bench.scans == [(0, [1], True)]
    bench.feed(radar.object(2))
    assert bench.counts.stray == 1


def test_an_overdue_scan_ends_without_a_flush_too(bench, radar):
    bench.feed(radar.scan(2), radar.object(1))
    bench.t_ns += 51 * MS
    bench.feed(radar.object(2))
    assert bench.scans == [(0, [1], True)]
    assert bench.counts.stray == 1


def test_a_new_scan_before_the_old_one_is_complete(bench, radar):
    bench.feed(radar.scan(2), radar.object(1))
    bench.t_ns += 10 * MS
    bench.feed(radar.scan(1), radar.object(5))
    assert bench.scans == [(0, [1], True), (10, [5], False)]


def test_an_empty_scan_that_ends_an_incomplete_one_is_not_forgotten(bench, radar):
    bench.feed(radar.scan(2), radar.object(1))
    bench.t_ns += 10 * MS
    bench.feed(radar.scan(0))
    bench.wait(0)
    assert bench.scans == [(0, [1], True), (10, [], False)]


def test_more_objects_than_announced(bench, radar):
    bench.feed(radar.scan(1), radar.object(1), radar.object(2))
    assert bench.scans == [(0, [1], False)]
    assert bench.counts.stray == 1


def test_objects_before_the_first_scan(bench, radar):
    bench.feed(radar.object(1), radar.scan(1), radar.object(2))
    assert bench.scans == [(0, [2], False)]
    assert bench.counts.stray == 1


def test_an_object_twice_in_a_scan(bench, radar):
    bench.feed(radar.scan(3), radar.object(1), radar.object(1, DistLong=60.0), radar.object(2))
    assert bench.scans == [(0, [1, 2], True)]
    assert bench.counts.duplicates == 1


def test_more_objects_than_there_is_room_for(radar):
    bench = Bench(capacity=2)
    bench.feed(radar.scan(3), radar.object(1), radar.object(2), radar.object(3))
    assert bench.scans == [(0, [1, 2], True)]
    assert bench.counts.overflow == 1


def test_rejected_sums_up_what_failed(bench, radar):
    bench.feed(radar.object(1), (0x301, b""), (0x123, b""), radar.scan(0))
    assert bench.counts.rejected == 2


OPS = st.sampled_from(
    ["scan", "object", "wait", "late", "flip", "cut", "remote", "unknown", "again", "lose"]
)


@settings(max_examples=150, deadline=None)
@given(ops=st.lists(st.tuples(OPS, st.integers(0, 63)), max_size=60))
def test_whatever_comes_every_frame_is_counted_once(own_db, ops):
    bench, radar = Bench(capacity=8), Radar(own_db)
    last = (0x301, bytes(8))
    fed = 0
    for op, k in ops:
        if op in ("wait", "late"):
            bench.wait(k if op == "wait" else -k)
            continue
        frame_id, data = radar.scan(k % 5) if op == "scan" else radar.object(k)
        if op == "lose":
            continue
        if op == "flip":
            data = (int.from_bytes(data, "big") ^ 1 << k).to_bytes(8, "big")
        elif op == "cut":
            data = data[: k % 8]
        elif op == "unknown":
            frame_id = 0x400 + k
        elif op == "again":
            frame_id, data = last
        last = (frame_id, data)
        bench.feed(last, flags=REMOTE if op == "remote" else 0)
        fed += 1
    counts = bench.counts
    assert counts.frames == fed
    assert counts.scans == len(bench.scans)
    assert counts.incomplete_scans == sum(incomplete for _, _, incomplete in bench.scans)
    for _, ids, _ in bench.scans:
        assert len(set(ids)) == len(ids) <= 8
    assert all(math.isfinite(v) for v in bench.decoder._scan.z.ravel())
