"""Scans of a radar with track slots and no header, by the profile of the Toyota radar."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from bus_frames import MS, REAL_DATA

from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.frame import Frame
from can_imm.bus.profile import load_profile
from can_imm.bus.sources import LogSource

PROFILE = load_profile("toyota")


@pytest.fixture
def decoder():
    return ScanDecoder(PROFILE)


def feed(decoder, frames, t_ms=0):
    """Feed frames 0.1 ms apart; gives (time in ms, ids, incomplete) of the scans that come out."""
    out = []
    for k, frame in enumerate(frames):
        if scan := decoder.feed(Frame(t_ms * MS + k * MS // 10, *frame)):
            out.append((scan.t_ns // MS, scan.ids[: scan.n].tolist(), scan.incomplete))
    return out


def test_sixteen_slots_in_any_order_are_a_scan(decoder, track):
    order = [5, 3, 15, *range(6, 15), 0, 1, 2, 4]
    assert feed(decoder, [track(slot, 200) for slot in order], 70) == [(70, order, False)]
    scan = decoder._scan
    assert scan.counter == 200
    np.testing.assert_allclose(scan.z[:16], [[30.0, -1.5, -2.0, 0.0]] * 16)
    assert scan.valid[:16].tolist() == [[True, True, True, False]] * 16
    # sideways to steps of .04 m, which is next to nothing
    of_y = np.hypot(0.2, 0.04 / np.sqrt(12.0))
    np.testing.assert_allclose(scan.std[:16, :3], [[0.25, 0.15, of_y]] * 16, rtol=0.002)
    assert scan.lasting == (0.25, 0.4, 0.004, 1.0, 0.01, 1.0, 0.05)


def test_empty_and_invalid_slots_are_no_objects(decoder, track):
    changes = {3: {"LONG_DIST": 255.0}, 4: {"VALID": 0}, 6: {"LONG_DIST": 327.64, "VALID": 0}}
    frames = [track(slot, 1, **changes.get(slot, {})) for slot in range(8)]
    frames += [track(slot, 1, NEW_TRACK=slot % 2, LONG_DIST=254.99) for slot in range(8, 16)]
    assert feed(decoder, frames) == [(0, [0, 1, 2, 5, 7, *range(8, 16)], False)]
    assert decoder._scan.new[:13].tolist() == [False] * 5 + [False, True] * 4
    assert (decoder.counts.empty, decoder.counts.used) == (3, 13)


def test_a_slot_that_is_missing_ends_with_the_next_scan(decoder, track):
    frames = [track(slot, 255) for slot in range(15)] + [track(slot, 0) for slot in range(16)]
    assert feed(decoder, frames) == [(0, list(range(15)), True), (1, list(range(16)), False)]
    assert decoder.counts.lost == 0


def test_a_slot_that_is_missing_ends_with_the_timeout(decoder, track):
    assert feed(decoder, [track(slot, 9) for slot in range(15)]) == []
    assert decoder.flush(30 * MS) is None
    scan = decoder.flush(31 * MS)
    assert (scan.n, scan.incomplete) == (15, True)
    assert feed(decoder, [track(15, 9)], 33) == []
    assert decoder.flush(70 * MS) is None
    assert decoder.counts.stray == 1


def test_a_frame_of_the_last_scan_does_not_break_the_next(decoder, track):
    frames = [track(slot, 9) for slot in range(15)] + [track(0, 10), track(15, 9)]
    frames += [track(slot, 10) for slot in range(1, 16)]
    assert feed(decoder, frames) == [(0, list(range(15)), True), (1, list(range(16)), False)]
    assert decoder.counts.stray == 1


def test_repeats_wrong_checksums_and_jumps(decoder, track):
    frame_id, data = track(2, 7)
    wrong = (frame_id, data[:7] + bytes([data[7] ^ 1]))
    frames = [track(0, 7), track(0, 7), wrong, track(1, 7), (frame_id, data)]
    frames += [track(slot, 7) for slot in range(3, 16)]
    assert feed(decoder, frames) == [(0, list(range(16)), False)]
    assert (decoder.counts.bad_counter, decoder.counts.bad_crc) == (1, 1)
    feed(decoder, [track(0, 10)], 50)
    assert decoder.counts.lost == 2


def test_the_checksum_covers_id_and_length(decoder, track):
    _, data = track(2, 7)
    feed(decoder, [(0x213, data), (0x212, data[:7])])
    assert (decoder.counts.bad_crc, decoder.counts.bad_length) == (1, 1)


def test_without_protection_a_repeated_slot_is_a_duplicate(tmp_path, track):
    text = (
        (PROFILE.path).read_text().replace('kind = "toyota"\ncounter = "COUNTER"', 'kind = "none"')
    )
    (tmp_path / "bare.toml").write_text(text.replace('dbc = "', f'dbc = "{PROFILE.path.parent}/'))
    decoder = ScanDecoder(load_profile(str(tmp_path / "bare.toml")))
    frames = [track(0, 7), track(0, 7), *(track(slot, 7) for slot in range(1, 16))]
    assert feed(decoder, frames) == [(0, list(range(16)), False)]
    assert (decoder.counts.duplicates, decoder.counts.checksums_ok) == (1, 0)


@pytest.mark.skipif(not REAL_DATA.is_dir(), reason="no recorded data beside the repository")
def test_a_minute_of_a_real_radar():
    decoder = ScanDecoder(PROFILE)
    first, sizes = {}, Counter()
    source = LogSource(REAL_DATA / "comma2k19_rav4_radar_tracks.log")
    for frame in source:
        if scan := decoder.feed(frame):
            sizes[scan.n] += 1
            for i in range(scan.n):
                first.setdefault(int(scan.ids[i]), scan.z[i].copy())
    counts = decoder.counts
    assert (counts.frames, counts.checksums_ok, counts.unknown) == (38_400, 19_200, 19_200)
    assert (counts.scans, counts.incomplete_scans, counts.rejected, counts.lost) == (1200, 0, 0, 0)
    assert (source.bad_lines, source.dropped_frames, source.damage) == (0, 0, None)
    np.testing.assert_allclose(first[2], [26.63, 3.875, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(first[4], [15.58, -1.575, -2.88, 0.0], atol=1e-9)
    assert counts.used / counts.scans == pytest.approx(8.4, abs=0.05)
