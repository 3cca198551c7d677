from __future__ import annotations

import shutil

import pytest
from bus_frames import ROOT

from can_imm.bus.profile import builtin_profiles, load_profile
from can_imm.types import CanImmError


def test_built_in_profiles():
    assert builtin_profiles() == ["can_imm", "toyota", "tracking"]
    own, toyota, _ = map(load_profile, builtin_profiles())
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
    ('["RadarObject"]', '["0x301-0x302"]', "object: 'messages': no message with id 0x302"),
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


@pytest.mark.parametrize("name", ["ars999", "", "none.toml", "sub/none"])
def test_a_profile_that_is_not_there(name):
    with pytest.raises(CanImmError) as caught:
        load_profile(name)
    assert "\n" not in str(caught.value)
