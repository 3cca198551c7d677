"""The compiled decoder against cantools, bit for bit."""

from __future__ import annotations

import cantools
import pytest
from bus_frames import ROOT
from cantools.database.can import Message, Signal
from cantools.database.conversion import BaseConversion
from hypothesis import given, settings
from hypothesis import strategies as st

from can_imm.bus.codec import compile_reader, field, load_dbc
from can_imm.types import CanImmError

MESSAGES = [
    message
    for name in ("can_imm.dbc", "toyota.dbc")
    for message in cantools.database.load_file(ROOT / "dbc" / name).messages
]
READERS = {message.name: compile_reader(message, message.signals) for message in MESSAGES}


@given(data=st.binary(min_size=8, max_size=8))
def test_every_signal_agrees_with_cantools(data):
    for message in MESSAGES:
        raws = READERS[message.name](data)
        expected = message.decode(data, decode_choices=False, scaling=False)
        assert dict(zip([s.name for s in message.signals], raws, strict=True)) == expected
        scaled = message.decode(data, decode_choices=False)
        for signal, raw in zip(message.signals, raws, strict=True):
            scaling = field(signal)
            # exactly: the same two operations on doubles
            assert raw * scaling.scale + scaling.offset == scaled[signal.name]


@st.composite
def layouts(draw):
    """A signal of any place, length, byte order and sign in a message of any length."""
    size = draw(st.integers(1, 8))
    length = draw(st.integers(1, 8 * size))
    first = draw(st.integers(0, 8 * size - length))
    order = draw(st.sampled_from(["little_endian", "big_endian"]))
    # counted from the most significant bit of byte 0, DBC numbers each byte from its lowest
    start = first if order == "little_endian" else first // 8 * 8 + 7 - first % 8
    conversion = BaseConversion.factory(scale=1, offset=0)
    signal = Signal("S", start, length, order, draw(st.booleans()), conversion=conversion)
    return Message(1, "M", size, [signal]), draw(st.binary(min_size=size, max_size=size))


@given(layouts())
def test_any_layout_agrees_with_cantools(case):
    message, data = case
    read = compile_reader(message, message.signals)
    assert read(data) == (message.decode(data)["S"],)


@settings(max_examples=50)
@given(value=st.floats(-200, 400))
def test_raw_is_the_nearest_step_within_the_range(own_db, value):
    signal = own_db.get_message_by_name("RadarObject").get_signal_by_name("DistLong")
    raw = field(signal).raw(value)
    if -75.005 <= value <= 250.005:
        assert abs(raw * 0.02 - 75 - value) <= 0.0100001
    elif not -75.02 <= value <= 250.02:
        assert raw == 16383


def test_ranges_are_those_of_the_dbc_to_the_step():
    for message in MESSAGES:
        for signal in message.signals:
            scaling = field(signal)
            ends = [raw * signal.scale + signal.offset for raw in (scaling.low, scaling.high)]
            assert ends == pytest.approx([signal.minimum, signal.maximum], abs=1e-9), signal.name


def test_raw_without_a_code_for_it_takes_the_end_of_the_range(own_db):
    scaling = field(own_db.get_message_by_name("DetectorStatus").get_signal_by_name("DroppedScans"))
    assert (scaling.raw(5000), scaling.raw(-3), scaling.raw(float("nan"))) == (4095, 0, 0)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("nonsense", "Invalid syntax"),
        ('VERSION ""\nBO_ 1 M: 8 N\n SG_ A : 0|8@1+ (1,0) [0|0] "" N\n'
         ' SG_ B : 4|8@1+ (1,0) [0|0] "" N\n', "overlapping"),
    ],
)  # fmt: skip
def test_broken_dbc_is_refused_in_one_line(tmp_path, text, reason):
    path = tmp_path / "x.dbc"
    path.write_text(text)
    with pytest.raises(CanImmError, match=reason) as caught:
        load_dbc(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_and_undecodable_dbc(tmp_path):
    with pytest.raises(CanImmError, match="No such file"):
        load_dbc(tmp_path / "none.dbc")
    (tmp_path / "binary.dbc").write_bytes(bytes(range(256)))
    with pytest.raises(CanImmError, match="not a valid DBC"):
        load_dbc(tmp_path / "binary.dbc")
