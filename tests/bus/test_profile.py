from __future__ import annotations

import shutil

import numpy as np
import pytest
from bus_frames import ROOT

from can_imm.bus.decoder import ScanDecoder
from can_imm.bus.describe import describe
from can_imm.bus.frame import Frame
from can_imm.bus.profile import builtin_profiles, load_profile
from can_imm.types import CanImmError, Scan


def test_built_in_profiles():
    names = ["ars408", "can_imm", "esr", "toyota", "toyota-tss2", "tracking"]
    assert builtin_profiles() == names
    assert [load_profile(name).name for name in names] == names
    own, toyota = load_profile("can_imm"), load_profile("toyota")
    assert (own.name, own.period_ns, own.dbc.name) == ("can_imm", 100_000_000, "can_imm.dbc")
    assert own.header is not None
    assert [c.std for c in own.state] == [0.1, 0.3, 0.2, 0.3]
    assert toyota.header is None
    assert [m.frame_id for m in toyota.messages] == list(range(0x210, 0x220))
    assert toyota.state[3] is None
    assert toyota.state[2].sign == -1


def test_a_profile_of_ones_own_beside_its_dbc(tmp_path):
    for suffix in (".toml", ".dbc"):
        shutil.copy(ROOT / "dbc" / f"can_imm{suffix}", tmp_path)
    profile = load_profile(str(tmp_path / "can_imm.toml"))
    assert profile.dbc == tmp_path / "can_imm.dbc"


BAD = [
    ('dbc = "can_imm.dbc"', 'dbc = "none.dbc"', "none.dbc: No such file"),
    ('dbc = "can_imm.dbc"', "dbc = 3", "'dbc' must be text, not 3"),
    ('dbc = "can_imm.dbc"', "", "'dbc' is missing"),
    ("[scan]", "[skan]", "'scan' is missing"),
    ("period_ms = 100", "period_ms = 0", "scan: 'period_ms' must be a number from 1"),
    ("period_ms = 100", "period_ms = nan", "scan: 'period_ms' must be a number from 1"),
    ("period_ms = 100", 'period_ms = "fast"', "scan: 'period_ms' must be a number"),
    ("period_ms = 100", "period_ms = 100\nperiods = 3", "scan: unknown key 'periods'"),
    ('header = "RadarScan"', 'header = "Scan"', "scan: no message 'Scan' in"),
    ('count = "ObjectCount"', 'count = "Number"', "no signal 'Number' in message RadarScan"),
    ('counter = "ScanCounter"', 'counter = "Cycle"', "no signal 'Cycle' in message RadarScan"),
    ('["RadarObject"]', "[]", "object: 'messages' must name at least one"),
    ('["RadarObject"]', '["RadarObject", "0x301"]', "object: 'messages' must name"),
    ('["RadarObject"]', '["0x301-0x303"]', "object: 'messages': no message with id 0x303"),
    ('["RadarObject"]', '["Object"]', "object: no message 'Object' in"),
    ('id = "ObjectId"', 'id = "Number"', "no signal 'Number' in message RadarObject"),
    ('id = "ObjectId"', "", "object: 'id' is needed with"),
    (", equals = 1", "", "object, valid_if 1: needs either 'equals' or 'below'"),
    ("equals = 1", "equal = 1", "object, valid_if 1: unknown key 'equal'"),
    ('signal = "ObjectValid"', 'signal = "Ok"', "no signal 'Ok' in message RadarObject"),
    ('signal = "DistLong"', 'signal = "Range"', "no signal 'Range' in message RadarObject"),
    ("std = 0.1", "std = 0", "object, state, x: 'std' must be a number above 0"),
    ("std = 0.1", "std = nan", "object, state, x: 'std' must be a number above 0"),
    ("std = 0.1", "std = 0.1, sign = 2", "object, state, x: 'sign' must be 1 or -1"),
    ("std = 0.1", "std = 0.1, offset = inf", "object, state, x: 'offset' must be a number from"),
    ("std = 0.1", "noise = 0.1", "object, state, x: 'std' is missing"),
    ("\nx = {", "\nz = {", "object, state: unknown key 'z'"),
    ('kind = "e2e-p01"', 'kind = "sum"', "protection: 'kind' must be one of e2e-p01, toyota"),
    ('kind = "e2e-p01"', 'kind = "toyota"', "protection: 'counter' is missing"),
    ("[object]", "[object", "not valid TOML"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "reason"), BAD)
def test_a_bad_profile_is_refused_in_one_line(tmp_path, old, new, reason):
    text = (ROOT / "dbc" / "can_imm.toml").read_text()
    assert text.count(old) >= 1
    path = tmp_path / "bad.toml"
    path.write_text(text.replace(old, new, 1))
    shutil.copy(ROOT / "dbc" / "can_imm.dbc", tmp_path)
    with pytest.raises(CanImmError) as caught:
        load_profile(str(path))
    assert reason in str(caught.value)
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


BAD_NEW = [
    ("toyota", "std = 0.25 ", "std = 0.25, std_per_m = 0.01 ", "x: 'std_per_m' is for y"),
    ("toyota", "std = 0.15 ", "std = 0.15, std_per_m = 0.01 ", "vx: 'std_per_m' is for y"),
    ("ars408", "std = 0.3, ", "std = 0.3, std_per_m = 0.01, ", "'std_per_m' is for y"),
    ("esr", "std = 0.5 }", "std = 0.5, std_per_m = 0.01 }", "bearing: 'std_per_m' is for y"),
    ("toyota", "std_per_m = 0.004", "std_per_m = -0.01", "y: 'std_per_m' must be a number from 0"),
    ("toyota", "std_per_m = 0.004", "std_per_m = nan", "y: 'std_per_m' must be a number from 0"),
    ("toyota", "per_m_s = 1.0", "", "y: 'std_per_m' and 'per_m_s' go together"),
    ("toyota", "lasting_s = 0.4", "lasting_s = 0", "y: 'std_lasting' and 'lasting_s' go together"),
    ("toyota", "new_per_m = 0.01", "", "y: 'new_per_m' and 'new_s' go together"),
    ("toyota", "new_s = 1.0", "new_s = -1", "y: 'new_s' must be a number from 0"),
    ("ars408", "number = 8", "number = 0", "sensors: 'number' must be a whole number from 1"),
    ("ars408", "number = 8", "number = 8\nuse = 8", "sensors: 'use' must be a whole number from 0"),
    ("ars408", "new_codes = [1, 5]", "new_codes = [1.5]", "'new_codes' must be a list of whole"),
    ("ars408", "any_of = [2, 1, 3, 5]", "any_of = []", "'any_of' must be a list of numbers"),
    ("ars408", "any_of = [2, 1, 3, 5]", "any_of = [2], above = 1", "either 'equals' or 'below'"),
    ("ars408", "at_least = 0.5", "at_least = 2", "existence: 'at_least' must be a number from 0"),
    ("ars408", "Obj_DistLong_rms", "Obj_Dist_rms", "no signal 'Obj_Dist_rms' in message"),
    ("ars408", "Obj_ProbOfExist", "Obj_Prob", "no signal 'Obj_Prob' in message"),
    ("ars408", '"Obj_2_Quality", ', '"Obj_1_General", ', "two messages with one id"),
    ("ars408", "Obj_VrelLat_rms\", std_codes = \"rms\"", "Obj_VrelLat_rms\", std_codes = \"r\"",
     "vy: 'std_codes' must be one of rms, not 'r'"),
    ("ars408", "rms = [", "rms = [[],", "codes: 'rms' must be a list of numbers"),
    ("ars408", "at_least = 0.5", "at_least = 0.5\ncode = 3", "existence: unknown key 'code'"),
    ("toyota", "below = 255.0", "below = inf", "valid_if 2: 'below' must be a number from"),
    ("ars408", "id_step = 0x10", "id_step = 1", "two messages with one id"),
    ("ars408", 'std_signal = "Obj_VrelLat_rms",', "", "vy: unknown key 'std_codes'"),
    ("ars408", 'message = "SpeedInformation"', 'message = "Speed"', "ego, speed: no message"),
    ("ars408", '"RadarDevice_YawRate"', '"YawRate"', "no signal 'YawRate' in message"),
    ("ars408", "timeout_ms = 500", "", "ego: 'timeout_ms' is missing"),
    ("ars408", "equals = 2 }", "equal = 2 }", "ego, speed, reverse_if: unknown key 'equal'"),
    ("ars408", 'signal = "Obj_DistLong"', 'signal = "Obj_VrelLong"', "is in m/s by the DBC"),
    ("esr", "bearing =", "angle =", "object, polar: unknown key 'angle'"),
    ("esr", "range =", "rage =", "object, polar: unknown key 'rage'"),
    ("esr", "[object.polar]", "[object.state]", "object, state: unknown key 'range'"),
    ("esr", "std = 0.5 }", 'std = 0.5, unit = "m" }', "bearing: 'unit' must be one of rad, deg"),
    ("esr", "[protection]", "[sensors]\nnumber = 2\nid_step = 64\n[protection]", "scan header"),
    ("esr", "[protection]", "[mounting]\nz = 2\n[protection]", "mounting: unknown key 'z'"),
    ("toyota", 'mean_of = ["WHEEL', 'mean_of = ["WEEL', "no signal 'WEEL_SPEED_FR' in message"),
    ("can_imm", 'protection = "e2e-p01" }\nyaw', 'protection = "none" }\nyaw', "one protection"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "old", "new", "reason"), BAD_NEW)
def test_bad_parts_of_other_profiles_are_refused_in_one_line(tmp_path, name, old, new, reason):
    text = (ROOT / "dbc" / f"{name}.toml").read_text()
    comments, rest = text.split("\ndescription = ", 1)
    assert old in rest
    path = tmp_path / f"{name}.toml"
    path.write_text(comments + "\ndescription = " + rest.replace(old, new, 1))
    shutil.copy(ROOT / "dbc" / f"{name}.dbc", tmp_path)
    with pytest.raises(CanImmError) as caught:
        load_profile(str(path))
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "old", "new", "reason"),
    [
        ("can_imm", 'BA_ "E2EDataId" BO_ 769 769;', "", "RadarObject has no attribute 'E2EDataId'"),
        ("toyota", "531", "2147484179", "TRACK_A_3 of toyota.dbc is not a classic frame"),
        ("can_imm", "BO_ 769 RadarObject: 8", "BO_ 769 RadarObject: 12", "not a classic frame"),
    ],
)
def test_a_dbc_that_does_not_fit_the_profile(tmp_path, name, old, new, reason):
    text = (ROOT / "dbc" / f"{name}.dbc").read_text()
    assert old in text
    (tmp_path / f"{name}.dbc").write_text(text.replace(old, new))
    profile = (ROOT / "dbc" / f"{name}.toml").read_text()
    names = ", ".join(f'"TRACK_A_{k}"' for k in range(16))
    (tmp_path / f"{name}.toml").write_text(profile.replace('"0x210-0x21F"', names))
    with pytest.raises(CanImmError, match=reason) as caught:
        load_profile(str(tmp_path / f"{name}.toml"))
    assert "\n" not in str(caught.value)


def test_object_messages_must_scale_alike(tmp_path):
    text = (ROOT / "dbc" / "toyota.dbc").read_text()
    at = text.index("BO_ 531 ")
    text = text[:at] + text[at:].replace("(0.01,0) [0|327.67]", "(0.02,0) [0|655.34]", 1)
    (tmp_path / "toyota.dbc").write_text(text)
    shutil.copy(ROOT / "dbc" / "toyota.toml", tmp_path)
    with pytest.raises(CanImmError, match="'LONG_DIST' of TRACK_A_3 has another scale"):
        load_profile(str(tmp_path / "toyota.toml"))


def profile_with(tmp_path, name, old, new):
    """The built-in profile of that name with one change."""
    text = (ROOT / "dbc" / f"{name}.toml").read_text()
    assert text.count(old) == 1
    (tmp_path / f"{name}.toml").write_text(text.replace(old, new))
    shutil.copy(ROOT / "dbc" / f"{name}.dbc", tmp_path)
    return load_profile(str(tmp_path / f"{name}.toml"))


OWN_Y = 'y = { signal = "DistLat", std = 0.2'


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ("", None),
        (", std_per_m = 0.0", None),
        (", std_lasting = 0.3, lasting_s = 0.4", (0.3, 0.4, 0.0, 0.0, 0.0, 0.0, 0.1)),
        (", std_per_m = 0.015, per_m_s = 2", (0.0, 0.0, 0.015, 2.0, 0.0, 0.0, 0.1)),
        (", new_per_m = 0.02, new_s = 1.5", (0.0, 0.0, 0.0, 0.0, 0.02, 1.5, 0.1)),
        (
            ', std_per_m = 0.015, per_m_s = 2, std_lasting = 20, lasting_s = 0.4, unit = "cm"',
            (0.2, 0.4, 0.00015, 2.0, 0.0, 0.0, 0.1),
        ),
    ],
)
def test_errors_that_last(tmp_path, radar, more, expected):
    decoder = ScanDecoder(profile_with(tmp_path, "can_imm", OWN_Y, OWN_Y + more))
    frames = [radar.scan(2), radar.object(0, DistLong=10.0), radar.object(1, DistLong=100.0)]
    (scan,) = (found for frame in frames if (found := decoder.feed(Frame(0, *frame))))
    assert scan.z[: scan.n, 0].tolist() == pytest.approx([10.0, 100.0])
    if expected is None:
        assert scan.lasting is None
    else:
        assert tuple(scan.lasting) == pytest.approx(expected)
    other = Scan(2)
    other.copy_from(scan)
    assert other.lasting == scan.lasting
    y = 0.002 if "cm" in more else 0.2
    assert scan.std[: scan.n, :3] == pytest.approx(np.tile([0.1, 0.3, y], (scan.n, 1)), rel=0.05)


def test_profiles_check_tells_of_errors_that_last(tmp_path):
    def of_y(profile):
        ((line, _),) = (
            (line, part)
            for part, lines in describe(profile)
            for line in lines
            if line.startswith("y ")
        )
        return line

    assert of_y(load_profile("toyota")).endswith(
        "; errors that last: 0.25 m for 0.4 s, 0.01 m per metre ahead in a new track for 1 s, "
        "0.004 m per metre ahead in all tracks alike for 1 s"
    )
    assert "per metre" not in of_y(load_profile("can_imm"))
    changed = profile_with(tmp_path, "can_imm", OWN_Y, OWN_Y + ", std_per_m = 0.02, per_m_s = 3")
    errors = "errors that last: 0.02 m per metre ahead in all tracks alike for 3 s; raw 1023"
    assert f"(0.2 and rounding); {errors}" in of_y(changed)


@pytest.mark.parametrize("name", ["ars999", "", "none.toml", "sub/none"])
def test_a_profile_that_is_not_there(name):
    with pytest.raises(CanImmError) as caught:
        load_profile(name)
    assert "\n" not in str(caught.value)
