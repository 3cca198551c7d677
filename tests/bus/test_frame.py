from __future__ import annotations

from copy import deepcopy

import can
from hypothesis import given
from hypothesis import strategies as st

from can_imm.bus.frame import Frame, from_message, to_message


@st.composite
def messages(draw):
    kind = draw(st.sampled_from(["classic", "remote", "fd", "error"]))
    extended = draw(st.booleans())
    return can.Message(
        timestamp=draw(st.integers(0, 4 * 10**15)) / 1e6,
        arbitration_id=draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF)),
        is_extended_id=extended,
        is_remote_frame=kind == "remote",
        is_error_frame=kind == "error",
        is_fd=kind == "fd",
        bitrate_switch=kind == "fd" and draw(st.booleans()),
        error_state_indicator=kind == "fd" and draw(st.booleans()),
        is_rx=draw(st.booleans()),
        channel=draw(st.sampled_from([None, 0, 7, "vcan0"])),
        dlc=draw(st.integers(0, 8)) if kind == "remote" else None,
        data=None if kind == "remote" else draw(st.binary(max_size=8)),
        check=True,
    )


@given(messages())
def test_a_message_is_rebuilt_without_loss(message):
    back = to_message(from_message(message))
    assert back.equals(message, timestamp_delta=1e-6)
    assert back.dlc == message.dlc
    assert back.is_rx == message.is_rx


@given(messages())
def test_times_are_whole_microseconds_and_stay(message):
    frame = from_message(message)
    assert frame.t_ns % 1000 == 0
    assert abs(frame.t_ns - message.timestamp * 1e9) <= 1500
    assert from_message(to_message(frame)) == frame


@given(messages())
def test_a_copy_of_a_message_is_one_of_its_own(message):
    original = to_message(from_message(message))
    copy = deepcopy(original)
    assert copy.equals(original, timestamp_delta=0.0)
    assert copy.dlc == original.dlc
    assert isinstance(copy.data, bytearray)
    copy.data += b"more"
    assert original.data == message.data


def test_a_frame_is_small():
    assert Frame(0, 1, b"") == (0, 1, b"", None, 0)
