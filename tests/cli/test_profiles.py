"""``can-imm profiles``: the list, a profile in words, and what it finds in a log."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from can_imm.bus.profile import builtin_profiles, dbc_dir


def test_the_list_names_every_profile(can_imm):
    status, out, err = can_imm("profiles")
    assert (status, err) == (0, "")
    rows = [line.split()[0] for line in out.splitlines()]
    assert rows == ["name", *builtin_profiles()]
    esr = next(line for line in out.splitlines() if line.startswith("esr"))
    assert "0x500-0x53F" in esr
    assert "range rate bearing" in esr


@pytest.mark.parametrize("name", builtin_profiles())
def test_a_built_in_profile_in_words(can_imm, name):
    status, out, err = can_imm("profiles", "check", name)
    assert (status, err) == (0, "")
    assert f"{name}.toml" in out
    assert "LSB" not in out
    assert "given up" in out
    assert ("careful" in out) == (name == "tracking")


def test_of_a_log_it_counts_what_it_reads(can_imm, log):
    status, out, _ = can_imm("profiles", "check", "can_imm", "--log", log)
    assert status == 0
    assert "0x300 RadarScan: 61 frames" in out
    assert "0x301 RadarObject: 61 frames" in out
    assert "122 used" in out
    assert "10 scans per second, 1.0 objects each" in out
    assert "first object id 3 at" in out


def test_of_a_log_of_something_else(can_imm, log):
    status, out, _ = can_imm("profiles", "check", "esr", "--log", log)
    assert status == 0
    assert "none: nothing in this log" in out


def own(tmp_path: Path, *changes: tuple[str, str]) -> Path:
    text = (dbc_dir() / "can_imm.toml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    shutil.copy(dbc_dir() / "can_imm.dbc", tmp_path)
    (tmp_path / "mine.toml").write_text(text)
    return tmp_path / "mine.toml"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("std = 0.1 ", "std = 0.001 ", "x: std 0.001 is smaller than the rounding"),
        ("std = 0.1 ", 'std = 0.1, unit = "cm" ', "x: signal DistLong is in m by the DBC"),
        ("speed = {", "yaw_rate = {", "ego speed"),
        ('new = "ObjectNew"', "", "nothing tells when an id names another object"),
        ("timeout_ms = 50 ", "timeout_ms = 150 ", "an incomplete scan delays the next"),
    ],
)
def test_what_is_odd_is_said(can_imm, tmp_path, old, new, words):
    changes = [(old, new)]
    if new == "yaw_rate = {":
        text = (dbc_dir() / "can_imm.toml").read_text()
        line = next(x for x in text.splitlines() if x.startswith("speed = "))
        changes, words = [(line, "")], "no ego speed: STATIONARY"
    status, out, _ = can_imm("profiles", "check", own(tmp_path, *changes))
    assert status == 0
    assert words in out.split("careful")[1]


def test_a_signal_without_a_unit_is_taken_as_si(can_imm, tmp_path):
    path = own(tmp_path)
    dbc = tmp_path / "can_imm.dbc"
    text = dbc.read_text().replace('(0.02,-75) [-75|250] "m"', '(0.02,-75) [-75|250] ""')
    dbc.write_text(text)
    _, out, _ = can_imm("profiles", "check", path)
    assert "x: signal DistLong has no unit in the DBC; taken as m" in out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["none.toml"], "neither a file nor a built-in sensor profile"),
        (["toyota", "--sensor", "2"], "has sensors 0 to 0, not 2"),
        (["toyota", "--log", "none.log"], "none.log"),
    ],
)
def test_errors_are_one_line(can_imm, arguments, words):
    status, _, err = can_imm("profiles", "check", *arguments)
    assert status == 1
    assert words in err
    assert err.count("\n") == 1
