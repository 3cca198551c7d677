"""Log files written and read: every format, and what is broken."""

from __future__ import annotations

import gzip
import sys

import can
import pytest

from can_imm.bus.frame import DLC_SHIFT, EXTENDED, REMOTE, Frame
from can_imm.bus.sinks import LogSink
from can_imm.bus.sources import LOG_SUFFIXES, LogSource
from can_imm.types import CanImmError

MS = 1_000_000
START = 1_700_000_000_010 * MS
FORMATS = [*LOG_SUFFIXES, ".log.gz", ".asc.gz", ".csv.gz", ".trc.gz"]
RELATIVE = (".asc", ".asc.gz")
NO_CHANNEL = (".csv", ".csv.gz", ".db")


def frames_of(n, channel="1"):
    frames = [
        Frame(START + k * 10_007_000, 0x300 + k % 3, bytes([k & 0xFF] * (k % 9)), channel)
        for k in range(n)
    ]
    frames[1] = frames[1]._replace(id=0x18FF0001, flags=EXTENDED)
    return frames


def write(path, frames):
    with LogSink(path) as sink:
        for frame in frames:
            sink.send(frame)
    assert (sink.lost, sink.damage) == (0, None)


@pytest.mark.parametrize("suffix", FORMATS)
def test_what_is_written_is_read_back(tmp_path, suffix):
    path = tmp_path / f"x{suffix}"
    frames = frames_of(1500)
    write(path, frames)
    source = LogSource(path)
    back = list(source)
    assert source.damage is None
    offset = START if suffix in RELATIVE else 0
    assert [f.t_ns + offset for f in back] == [f.t_ns for f in frames]
    assert [f[1:3] for f in back] == [f[1:3] for f in frames]
    assert [f.flags for f in back] == [f.flags for f in frames]
    if suffix not in NO_CHANNEL:
        # python-can writes a .trc's channels from 1 and reads them as they are
        shift = suffix.startswith(".trc")
        assert {f.channel for f in back} == {
            "can1" if suffix.startswith(".log") else f"{1 + shift}"
        }


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".csv"])
def test_remote_frames_keep_their_length(tmp_path, suffix):
    path = tmp_path / f"x{suffix}"
    frame = Frame(START, 0x123, b"", "1", REMOTE | 5 << DLC_SHIFT)
    write(path, [frame])
    assert [f[1:3] + f[4:] for f in LogSource(path)] == [frame[1:3] + frame[4:]]


@pytest.mark.parametrize("suffix", FORMATS)
def test_an_older_file_is_replaced(tmp_path, suffix):
    path = tmp_path / f"x{suffix}"
    for n in (30, 20):
        write(path, frames_of(n))
    assert len(list(LogSource(path))) == 20


def test_a_candump_log_is_exact(tmp_path):
    path = tmp_path / "x.log"
    write(path, [Frame(46408587652000, 0x210, b"\x93\x38", "can1")])
    assert path.read_bytes() == b"(46408.587652) can1 210#9338\n"


@pytest.mark.parametrize("name", ["x.txt", "x", "x.gz", "x.blf.gz", "x.log.zip"])
def test_an_unknown_format_is_refused(tmp_path, name):
    (tmp_path / name).write_text("")
    for kind in (LogSource, LogSink):
        with pytest.raises(CanImmError, match="unknown log format") as caught:
            kind(tmp_path / name)
        assert name in str(caught.value)


def test_files_that_cannot_be_opened(tmp_path):
    for suffix in FORMATS:
        with pytest.raises(CanImmError, match="No such file"):
            LogSource(tmp_path / f"none{suffix}")
        with pytest.raises(CanImmError, match="No such file"):
            LogSink(tmp_path / "none" / f"x{suffix}")
    (tmp_path / "dir.log").mkdir()
    with pytest.raises(CanImmError, match="directory"):
        LogSource(tmp_path / "dir.log")


def test_mf4_without_asammdf_says_so(tmp_path, monkeypatch):
    path = tmp_path / "x.mf4"
    write(path, frames_of(3))
    monkeypatch.setattr(sys.modules["can.io.mf4"], "asammdf", None)
    with pytest.raises(CanImmError, match="asammdf"):
        list(LogSource(path))
    with pytest.raises(CanImmError, match="asammdf"):
        LogSink(path)


MESSY = b"""\
(1.000000) can0 300#01
DROPCOUNT: dropped 3 CAN frames on 'can0' socket (total drops 3)

\xff\xfe\x00 garbage
(1.000001) can0 301#0
(1.00000
(2.000000) can0 301#02
DROPCOUNT: dropped 4 CAN frames on 'can0' socket (total drops 7)
(3.000000) can0 30"""


@pytest.mark.parametrize("packed", [False, True])
def test_garbage_and_drop_lines_are_counted(tmp_path, packed):
    path = tmp_path / ("x.log.gz" if packed else "x.log")
    path.write_bytes(gzip.compress(MESSY) if packed else MESSY)
    source = LogSource(path)
    assert [frame.data for frame in source] == [b"\x01", b"\x02"]
    assert (source.bad_lines, source.dropped_frames, source.damage) == (4, 7, None)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("content", [b"", b"nothing of the kind\n" * 30, bytes(range(256)) * 40])
def test_a_log_without_frames_is_one_clear_line(tmp_path, suffix, content):
    path = tmp_path / f"x{suffix}"
    path.write_bytes(gzip.compress(content) if suffix.endswith(".gz") else content)
    with pytest.raises(CanImmError) as caught:
        list(LogSource(path))
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", [s for s in FORMATS if s not in (".db", ".mf4")])
def test_a_file_that_breaks_off_gives_what_it_holds(tmp_path, suffix):
    path = tmp_path / f"x{suffix}"
    write(path, frames_of(20_000))
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 2 // 3])
    source = LogSource(path)
    n = sum(1 for _ in source)
    assert 5_000 < n < 19_000
    if suffix.endswith(".gz"):
        assert str(path) in source.damage
        assert "\n" not in source.damage


def test_a_broken_line_in_another_format_ends_the_reading_with_a_word(tmp_path):
    path = tmp_path / "x.csv"
    write(path, frames_of(9))
    lines = path.read_text().splitlines()
    lines[5] = "1.0,zz,0"
    path.write_text("\n".join(lines))
    source = LogSource(path)
    assert len(list(source)) == 4
    assert source.damage.startswith(f"{path}: broken, reading stopped")


@pytest.mark.parametrize("suffix", [".log", ".log.gz", ".blf", ".asc", ".asc.gz", ".csv"])
def test_progress_rises_from_0_to_1(tmp_path, suffix):
    path = tmp_path / f"x{suffix}"
    write(path, frames_of(40_000))
    source = LogSource(path)
    seen = [source.progress() for k, _ in enumerate(source) if k % 5000 == 0]
    assert seen == sorted(seen)
    assert seen[0] < 0.3
    assert seen[-1] > 0.7
    assert source.progress() == 1.0


def test_a_frame_that_cannot_be_written_is_counted(tmp_path, monkeypatch):
    sink = LogSink(tmp_path / "x.blf")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(can.BLFWriter, "on_message_received", full)
    for frame in frames_of(3):
        sink.send(frame)
    sink.close()
    assert sink.lost == 3
    assert sink.damage == f"{tmp_path / 'x.blf'}: No space left on device"


def test_closing_twice_and_unread(tmp_path):
    path = tmp_path / "x.blf"
    write(path, frames_of(5))
    sink = LogSink(tmp_path / "y.log")
    sink.close()
    sink.close()
    with LogSource(path) as source:
        assert next(iter(source)).id == 0x300
    source.close()
