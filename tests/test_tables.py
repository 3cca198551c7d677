"""The reader of TOML tables: what it takes, and the one line that says why it takes it not."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_imm.tables import Table, builtin_names, read_table, show
from can_imm.types import CanImmError

NAN, INF = math.nan, math.inf
TOO_LONG = 10**400


def table(**data: Any) -> Table:
    return Table(data, "some.toml", limit=100.0)


def refused(act: Callable[[], Any], message: str) -> None:
    """``act`` is refused with exactly this message."""
    with pytest.raises(CanImmError, match=f"^{re.escape(message)}$"):
        act()


def test_values_are_taken_as_they_are() -> None:
    t = table(
        a=3, b=[1, 2.5], c=7, d=False, e="text", f="left", g=[1, "x"], h={"k": 1}, i=[{"k": 2}]
    )
    assert (t.number("a"), t.numbers("b", 2), t.integer("c")) == (3.0, [1.0, 2.5], 7)
    assert (t.flag("d"), t.text("e"), t.choice("f", {"left": 1})) == (False, "text", 1)
    assert t.values("g") == [1, "x"]
    assert t.table("h").number("k") == 1.0
    assert [row.integer("k") for row in t.tables("i")] == [2]
    t.done()


def test_a_key_that_is_missing_has_its_default_or_is_refused() -> None:
    t = table()
    assert (t.number("k", 0.0), t.flag("k", False), t.text("k", "")) == (0.0, False, "")
    assert (t.choice("k", {"no": 3}, "no"), t.values("k", []), t.tables("k", [])) == (3, [], [])
    t.table("k", {}).done()
    for take in (t.number, t.integer, t.flag, t.text, t.values, t.table, t.tables):
        refused(lambda take=take: take("k"), "some.toml: 'k' is missing")
    refused(lambda: t.numbers("k", 2), "some.toml: 'k' is missing")
    refused(lambda: t.choice("k", {}), "some.toml: 'k' is missing")


def test_what_was_not_taken_is_unknown() -> None:
    t = table(a=1, b=2, c=3)
    t.number("a")
    assert list(t) == ["b", "c"]
    assert "a" not in t
    assert "b" in t
    refused(t.done, "some.toml: unknown key 'b'")
    for key in t:
        t.number(key)
    t.done()


NUMBERS = [
    ({}, [0, -100, 100.0, 1e-300], ["1", None, True, [1], NAN, INF, -INF, 100.1, -101, TOO_LONG],
     "a number from -100 up to 100"),
    ({"low": 0.0}, [0, 100], [-1e-9, NAN, 101], "a number from 0 up to 100"),
    ({"above": 0.0}, [1e-9, 100], [0, -1, NAN, 101], "a number above 0 up to 100"),
    ({"low": 1, "high": 2}, [1, 2], [0.9, 2.1], "a number from 1 up to 2"),
]  # fmt: skip


@pytest.mark.parametrize(("limits", "good", "bad", "expected"), NUMBERS)
def test_a_number_lies_within(
    limits: dict[str, float], good: list[Any], bad: list[Any], expected: str
) -> None:
    for value in good:
        assert table(k=value).number("k", **limits) == value
    for value in bad:
        refused(
            lambda value=value: table(k=value).number("k", **limits),
            f"some.toml: 'k' must be {expected}, not {show(value)}",
        )


def test_without_a_limit_a_number_may_be_infinite_but_is_one() -> None:
    assert Table({"k": INF}, "f").number("k") == INF
    assert Table({"k": 2**63 - 1}, "f").number("k") == 2.0**63
    for value in (NAN, 2**63, -TOO_LONG, True):
        message = f"f: 'k' must be a number, not {show(value)}"
        refused(lambda value=value: Table({"k": value}, "f").number("k"), message)


@pytest.mark.parametrize("value", [[1, 2], [1, 2, 101], [1, 2, 0], [1, 2, True], [1, 2, NAN], 3])
def test_a_list_of_numbers(value: Any) -> None:
    refused(
        lambda: table(k=value).numbers("k", 3, above=0.0),
        f"some.toml: 'k' must be a list of 3 numbers above 0 up to 100, not {value}",
    )


@pytest.mark.parametrize("value", [7.0, True, "7", 4, 11])
def test_a_whole_number(value: Any) -> None:
    assert table(k=5).integer("k", low=5, high=10) == 5
    refused(
        lambda: table(k=value).integer("k", low=5, high=10),
        f"some.toml: 'k' must be a whole number from 5 up to 10, not {value!r}",
    )


def test_a_whole_number_has_64_bits() -> None:
    refused(
        lambda: Table({"k": 2**63}, "f").integer("k"),
        f"f: 'k' must be a whole number, not {2**63}",
    )


def test_other_kinds() -> None:
    t = table
    refused(lambda: t(k=1).flag("k"), "some.toml: 'k' must be true or false, not 1")
    refused(lambda: t(k=1).text("k"), "some.toml: 'k' must be text, not 1")
    refused(lambda: t(k="x").values("k"), "some.toml: 'k' must be a list, not 'x'")
    refused(lambda: t(k=[]).table("k"), "some.toml: 'k' must be a table, not []")
    refused(lambda: t(k={}).tables("k"), "some.toml: 'k' must be a list of tables, not {}")
    for value in ("c", 1, ["a"]):
        refused(
            lambda value=value: t(k=value).choice("k", {"a": 1, "b": 2}, hint=" (or so)"),
            f"some.toml: 'k' must be one of a, b (or so), not {value!r}",
        )
    refused(lambda: Table(3, "f"), "f: must be a table, not 3")


def test_a_message_says_where() -> None:
    """Tables are called by their keys, rows by their names or else counted from 1."""
    t = table(outer={"rows": [{"name": "A", "k": "x"}, {"name": 3}, {}]}, object=[{}, 5])
    first, second, third = t.table("outer").tables("rows", each="row")
    refused(lambda: first.number("k", low=0), (
        "some.toml: outer, row 'A': 'k' must be a number from 0 up to 100, not 'x'"
    ))  # fmt: skip
    refused(lambda: second.text("name"), "some.toml: outer, row 2: 'name' must be text, not 3")
    refused(lambda: third.table("k"), "some.toml: outer, row 3: 'k' is missing")
    refused(lambda: t.tables("object"), "some.toml: object 2: must be a table, not 5")


@given(st.text(max_size=3), st.recursive(
    st.text() | st.integers() | st.floats() | st.sampled_from([1, 2]).map(lambda i: i << 20_000),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
))  # fmt: skip
def test_whatever_was_written_the_message_is_a_short_line(key: str, value: Any) -> None:
    with pytest.raises(CanImmError) as refusal:
        table(rows=[{"name": "A\nB", key + "k": value}]).tables("rows")[0].flag(key + "k")
    assert len(str(refusal.value).splitlines()) == 1
    assert len(str(refusal.value)) < 200


# ---- files


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("two", "one"):
        (tmp_path / f"{name}.toml").write_text(f"name = '{name}'", encoding="utf-8")
    (tmp_path / "other.txt").touch()
    return tmp_path


def test_a_file_by_name_or_path(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert builtin_names(folder) == ["one", "two"]
    built_in = read_table("one", folder, "thing", limit=1.0)
    assert built_in.file == str(folder / "one.toml")
    assert built_in.text("name") == "one"
    (folder / "mine").write_text("name = 'é'\nk = 2", encoding="utf-8")
    monkeypatch.chdir(folder)
    mine = read_table("mine", folder, "thing", limit=1.0)
    assert (mine.file, mine.text("name")) == ("mine", "é")
    refused(lambda: mine.number("k"), "mine: 'k' must be a number from -1 up to 1, not 2")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"name = ", "not valid TOML: "),
        (b"a = 1\na = 2", "not valid TOML: "),
        (b"a = " + b"[" * 5000, "not valid TOML: "),
        (b"a = " + b"9" * 5000, "not valid TOML: "),
        (b"\xff\xfe\x00", "cannot be read: not a text file in UTF-8"),
    ],
)
def test_a_broken_file(folder: Path, content: bytes, message: str) -> None:
    path = folder / "broken.toml"
    path.write_bytes(content)
    check_refused(str(path), folder, f"{path}: {message}")


def test_a_file_that_is_not_there(folder: Path) -> None:
    check_refused("three", folder, "three: neither a file nor a built-in thing (one, two)")
    check_refused(str(folder), folder, f"{folder}: cannot be read: Is a directory")
    check_refused("nul\0byte", folder, "nul\0byte: cannot be read: embedded null byte")
    check_refused("", folder, ".: cannot be read: Is a directory")


def check_refused(name_or_path: str, folder: Path, start: str) -> None:
    with pytest.raises(CanImmError) as refusal:
        read_table(name_or_path, folder, "thing")
    assert str(refusal.value).startswith(start)
    assert len(str(refusal.value).splitlines()) == 1
