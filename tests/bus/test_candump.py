from __future__ import annotations

import io

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_imm.bus.candump import _parse_slowly, dropped, format_frame, parse
from can_imm.bus.frame import BRS, DLC_SHIFT, ERROR, ESI, EXTENDED, FD, REMOTE, TX, Frame

T = 1_700_000_000_123_456_000

LINES = [
    ("(1700000000.123456) can1 210#9338", Frame(T, 0x210, b"\x93\x38", "can1")),
    ("(1700000000.123456) can1 210#9338 R\r\n", Frame(T, 0x210, b"\x93\x38", "can1")),
    ("(1700000000.123456) can1 210# T", Frame(T, 0x210, b"", "can1", TX)),
    ("(1700000000.123456) vcan0 00000210#01", Frame(T, 0x210, b"\x01", "vcan0", EXTENDED)),
    ("(1700000000.123456) c 1FFFFFFF#01", Frame(T, 0x1FFFFFFF, b"\x01", "c", EXTENDED)),
    ("(1700000000.123456) c 123#R", Frame(T, 0x123, b"", "c", REMOTE)),
    ("(1700000000.123456) c 123#R8", Frame(T, 0x123, b"", "c", REMOTE | 8 << DLC_SHIFT)),
    ("(1700000000.123456) c 123##3aabb", Frame(T, 0x123, b"\xaa\xbb", "c", FD | BRS | ESI)),
    ("(1700000000.123456) c 123##0" + "00" * 64, Frame(T, 0x123, bytes(64), "c", FD)),
    ("(1700000000.123456) c 20000080#0000000000000000", Frame(T, 0x80, bytes(8), "c", ERROR)),
    ("(1700000000.123456) c 123#0000000000000000_E", Frame(T, 0x123, bytes(8), "c")),
    ("(0.5)  can1   210#", Frame(500_000_000, 0x210, b"", "can1")),
    ("(0.123456789) can1 210#", Frame(123_456_000, 0x210, b"", "can1")),
]  # fmt: skip


@pytest.mark.parametrize(("line", "frame"), LINES)
def test_lines_that_are_frames(line, frame):
    assert parse(line) == frame


@pytest.mark.parametrize(
    "line",
    [
        "",
        "garbage",
        "(1700000000.123456) can1",
        "(1700000000.123456) can1 210",
        "(1700000000.123456) can1 210#933",
        "(1700000000.123456) can1 210#93381122334455667788",
        "(1700000000.123456) can1 210#zz",
        "(1700000000.123456) can1 2_1#93",
        "(1700000000.123456) can1 0x2#93",
        "(1700000000.123456) can1 800#93",
        "(1700000000.123456) can1 21#93",
        "(1700000000.123456) can1 40000000#93",
        "(1700000000.123456) can1 123#R9",
        "(1700000000.123456) can1 123##",
        "(1700000000.123456) can1 123##0aab",
        "(1700000000.123456 can1 210#93",
        "(nan) can1 210#93",
        "(-1.000000) can1 210#93",
        "1700000000.123456 can1 210#93",
        "(1700000000.123456) can1 210#93 X",
        "(1700000000.123456) can1 210#93 R junk",
        "(١٢.123456) can1 210#93",
    ],
)
def test_lines_that_are_none(line):
    assert parse(line) is None


def test_drop_lines():
    line = "DROPCOUNT: dropped 17 CAN frames on 'vcan0' socket (total drops 40)"
    assert (dropped(line), parse(line)) == (17, None)
    assert dropped("dropped 17 CAN frames") == 0


def test_exact_lines():
    assert (
        format_frame(Frame(T, 0x60B, b"\x10\x4e", "vcan0"))
        == "(1700000000.123456) vcan0 60B#104E\n"
    )
    assert format_frame(Frame(1000, 0x1, b"", "3")) == "(0.000001) can3 001#\n"


@st.composite
def frames(draw):
    kind = draw(st.sampled_from(["classic", "remote", "fd", "error"]))
    extended = draw(st.booleans()) and kind != "error"
    flags = EXTENDED * extended
    data = b""
    if kind == "remote":
        flags |= REMOTE | draw(st.integers(0, 8)) << DLC_SHIFT
    elif kind == "fd":
        flags |= FD | BRS * draw(st.booleans()) | ESI * draw(st.booleans())
        data = draw(
            st.sampled_from([0, 5, 8, 12, 64]).flatmap(lambda n: st.binary(min_size=n, max_size=n))
        )
    else:
        flags |= ERROR * (kind == "error")
        data = draw(st.binary(max_size=8))
    number = draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF))
    t_us = draw(st.integers(0, 4 * 10**15))
    return Frame(t_us * 1000, number, data, draw(st.sampled_from(["can0", "vcan1"])), flags)


@given(frames())
def test_what_is_written_is_read_back(frame):
    assert parse(format_frame(frame)) == frame


@given(frames())
def test_python_can_reads_the_same(frame):
    if frame.flags & ERROR or len(frame.data) > 64:
        return
    [message] = list(can.CanutilsLogReader(io.StringIO(format_frame(frame))))
    assert message.arbitration_id == frame.id
    assert bytes(message.data) == frame.data
    assert round(message.timestamp * 1e6) == frame.t_ns // 1000
    assert message.is_extended_id == bool(frame.flags & EXTENDED)
    assert message.is_fd == bool(frame.flags & FD)
    assert message.bitrate_switch == bool(frame.flags & BRS)
    assert message.is_remote_frame == bool(frame.flags & REMOTE)


@given(st.text(max_size=60))
def test_no_text_is_too_strange(text):
    parse(text)
    dropped(text)


@given(
    st.from_regex(r"\(\d{0,13}[.,]?\d{5,7}\)?", fullmatch=True),
    st.sampled_from(["can0", "", "x y", "#"]),
    st.from_regex(r"(210|7fF|2_1|0x2| 21|800|12345678)[#]?[0-9A-Fa-f_ g]{0,18}", fullmatch=True),
    st.sampled_from(["", " R", " T", " r", "\r\n", " R\n", " X", " R R"]),
)
def test_the_short_way_and_the_patterns_agree(time, channel, body, end):
    line = f"{time} {channel} {body}{end}"
    slow = _parse_slowly(line)
    _parse_slowly("(0.000000) c 210#"), _parse_slowly("(0.000000) c 7fF#")
    assert parse(line) == slow
    known = Frame(12_345_678_000, 0x210, b"\xab" * 4, "can0")
    assert parse(f"(12.345678) can0 210#{'AB' * 4} R\n") == known
