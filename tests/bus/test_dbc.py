"""The DBC files as others see them: by cantools alone."""

from __future__ import annotations

import subprocess
import sys

import cantools
import pytest
from bus_frames import REAL_DATA, ROOT, protect

from can_imm.types import Manoeuvre

FILES = sorted(path.name for path in (ROOT / "dbc").glob("*.dbc"))


def run_cantools(*arguments: str, stdin: str = "") -> str:
    done = subprocess.run(
        [sys.executable, "-m", "cantools", *arguments],
        input=stdin, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stderr == ""
    return done.stdout


@pytest.mark.parametrize("name", FILES)
def test_dump_reads_it_without_a_complaint(name, monkeypatch, capsys):
    """In this process: starting another one takes longer than the reading."""
    monkeypatch.setattr(sys, "argv", ["cantools", "dump", str(ROOT / "dbc" / name)])
    cantools._main()
    said = capsys.readouterr()
    assert "Signal tree" in said.out
    assert said.err == ""


def test_decode_shows_our_frames():
    data = protect(bytes.fromhex("0003000000000000"), 0x310).hex().upper()
    out = run_cantools(
        "decode",
        "--single-line",
        str(ROOT / "dbc" / "can_imm.dbc"),
        stdin=f"vcan0  310   [8]  {' '.join(data[i : i + 2] for i in range(0, 16, 2))}\n",
    )
    assert "ManoeuvreState(" in out
    assert "Manoeuvre: UNKNOWN" in out
    assert "Direction: None" in out


@pytest.mark.parametrize("name", FILES)
def test_strict_loading_and_full_documentation(name):
    db = cantools.database.load_file(ROOT / "dbc" / name, strict=True)
    for message in db.messages:
        assert 1 <= message.length <= 8
        assert not message.is_extended_frame
        assert message.comment
        assert message.cycle_time
        assert message.send_type in ("Cyclic", "OnEvent")
        assert message.senders
        for signal in message.signals:
            assert signal.comment, signal.name
            assert None not in (signal.minimum, signal.maximum), signal.name


def test_the_six_messages(own_db):
    assert [node.name for node in own_db.nodes] == ["RADAR", "EGO", "DETECTOR"]
    assert {(m.name, m.frame_id, *m.senders) for m in own_db.messages} == {
        ("RadarScan", 0x300, "RADAR"),
        ("RadarObject", 0x301, "RADAR"),
        ("EgoMotion", 0x302, "EGO"),
        ("ManoeuvreState", 0x310, "DETECTOR"),
        ("ObjectEstimate", 0x311, "DETECTOR"),
        ("DetectorStatus", 0x31F, "DETECTOR"),
    }
    for message in own_db.messages:
        crc, counter = message.signals[:2]
        assert (crc.name, crc.start, crc.length) == ("Crc", 0, 8)
        assert (counter.name, counter.start, counter.length) == ("AliveCounter", 8, 4)
        attributes = message.dbc.attributes
        assert attributes["E2EProfile"].value == "P01"
        assert attributes["VFrameFormat"].value in (0, "StandardCAN")
        assert all("GenSigStartValue" in s.dbc.attributes for s in message.signals[1:])
    ids = [message.dbc.attributes["E2EDataId"].value for message in own_db.messages]
    assert len(set(ids)) == 6


def test_resolution_is_a_quarter_of_the_sensor_noise_or_finer(own_db):
    noise = {"DistLong": 0.1, "VrelLong": 0.3, "DistLat": 0.2, "VrelLat": 0.3}
    measured = own_db.get_message_by_name("RadarObject")
    estimated = own_db.get_message_by_name("ObjectEstimate")
    for name, std in noise.items():
        step = measured.get_signal_by_name(name).scale
        assert step <= std / 4
        assert estimated.get_signal_by_name(name).scale <= std / 4


def test_value_tables(own_db):
    state = own_db.get_message_by_name("ManoeuvreState")
    for name in ("Manoeuvre", "SecondManoeuvre"):
        choices = state.get_signal_by_name(name).choices
        assert {int(m): m.name for m in Manoeuvre} == {
            raw: str(label) for raw, label in choices.items() if raw != 15
        }
    lane = state.get_signal_by_name("Lane").choices
    assert {raw: str(label) for raw, label in lane.items()} == {15: "NotAvailable"}
    event = state.get_signal_by_name("Event").choices
    assert {raw: str(label) for raw, label in event.items()} == {
        0: "None", 1: "CUT_IN", 2: "CUT_OUT", 3: "OVERTAKING",
    }  # fmt: skip


def test_not_available_codes_lie_outside_the_range(own_db):
    seen = 0
    for message in own_db.messages:
        for signal in message.signals:
            for raw, label in (signal.choices or {}).items():
                if str(label) == "NotAvailable":
                    value = raw * signal.scale + signal.offset
                    assert not signal.minimum <= value <= signal.maximum
                    seen += 1
    assert seen >= 15


def test_zero_can_be_said_exactly(own_db):
    for name in ("RadarObject", "ObjectEstimate"):
        for signal in own_db.get_message_by_name(name).signals[3:]:
            raw = -signal.offset / signal.scale
            assert abs(raw - round(raw)) < 1e-9


@pytest.mark.skipif(not REAL_DATA.is_dir(), reason="no recorded data beside the repository")
def test_toyota_dbc_decodes_like_an_independent_one(toyota_db):
    other = cantools.database.load_file(REAL_DATA / "toyota_adas.dbc")
    lines = (REAL_DATA / "comma2k19_rav4_radar_tracks.log").read_text().splitlines()
    compared = 0
    for line in lines[::37]:
        frame_id, data = line.split()[2].split("#")
        number = int(frame_id, 16)
        if 0x210 <= number <= 0x21F:
            ours = toyota_db.decode_message(number, bytes.fromhex(data), decode_choices=False)
            assert ours == other.decode_message(number, bytes.fromhex(data))
            compared += 1
    assert compared > 400
