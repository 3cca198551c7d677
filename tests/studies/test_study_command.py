"""``can-imm study`` from the command line."""

from __future__ import annotations

import json

import pytest

from can_imm.cli.main import build_parser, main
from can_imm.studies.runs import FIRST_SEED, TRUTHS

BASELINES = ["--systems", "kalman", "rules", "measurement"]


def test_paper_prints_tables_with_table_6_and_writes_json(tmp_path, capsys):
    file = tmp_path / "out.json"
    arguments = ["--runs", "2", "--seed", "7", "--truths", "A", "random", "--jobs", "1"]
    assert main(["study", "paper", *arguments, *BASELINES, "--json", str(file)]) == 0
    out, err = capsys.readouterr()
    assert err == ""  # no progress bar without a terminal
    assert "\x1b" not in out
    assert "2 runs per truth, seeds 7 to 8" in out
    rows = [line.split() for line in out.splitlines()]
    assert ["A", "paper,", "Table", "6", "0.1531", "0.2159", "0.1150", "0.1786", "-"] in rows
    data = json.loads(file.read_text())
    assert (data["runs"], data["seed"]) == (2, 7)
    found = {(r["truth"], r["system"]): r for r in data["results"]}
    assert set(found) == {(t, s) for t in ("A", "random") for s in BASELINES[1:]}
    rules = found["A", "rules"]
    (row,) = (r for r in rows if r[:2] == ["A", "rules"] and len(r) == 11)
    assert row[2:4] == [f"{rules['accuracy']:.4f}", f"{rules['macro_f1']:.3f}"]
    assert row[-2:] == ["-", "-"]  # no probabilities, no calibration
    assert not any(r[:2] == ["A", "kalman"] and len(r) == 11 for r in rows)
    assert sum(r[:2] == ["random", "paper,"] for r in rows) == 0
    assert max(map(len, out.splitlines())) <= 80
    assert "…" not in out


def test_paper_draws_comparisons(tmp_path, capsys):
    folder = tmp_path / "figures"
    arguments = ["--runs", "1", "--truths", "S", "--jobs", "1", "--plots", str(folder)]
    assert main(["study", "paper", *arguments, "--systems", "rules"]) == 0
    assert sorted(p.name for p in folder.iterdir()) == ["comparison_S.png", "confusion_S_rules.png"]
    assert "2 figures in" in capsys.readouterr().out


def test_tune_rules_prints_constants_as_code(monkeypatch, capsys):
    from can_imm.studies import tuning
    from can_imm.studies.baselines import RULES, Noise

    wrong = {"A": 0.01, "random": 0.02}
    asked = []

    def tune(runs, progress):
        asked.append(runs)
        progress(0.5)
        return tuning.Tuning(Noise(0.1, 0.2), RULES, wrong, wrong, wrong)

    monkeypatch.setattr(tuning, "tune", tune)
    assert main(["study", "tune-rules", "--runs", "3"]) == 0
    out, err = capsys.readouterr()
    assert asked == [3]
    assert err == ""
    assert "KALMAN_NOISE = Noise(along=0.1, across=0.2)" in out
    assert f"RULES = {RULES}" in out
    assert "A 0.0100 random 0.0200" in out


def test_unknown_preset_is_one_line(capsys):
    assert main(["study", "paper", "--runs", "1", "--systems", "no-such-preset"]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert "no-such-preset" in err


def test_a_json_file_that_cannot_be_written_is_refused_before_the_runs(tmp_path, capsys):
    file = tmp_path / "missing" / "out.json"
    assert main(["study", "paper", "--runs", "1000000", *BASELINES, "--json", str(file)]) == 1
    assert str(file) in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["paper", "--runs", "0"],
        ["paper", "--runs", "x"],
        ["paper", "--truths", "C"],
        ["paper", "--seed", "-1"],
        ["tune-rules", "--runs", "501"],
    ],
)
def test_wrong_usage(arguments):
    with pytest.raises(SystemExit) as stopped:
        main(["study", *arguments])
    assert stopped.value.code == 2


def test_what_the_parser_knows_without_importing_the_study_is_right():
    parser = build_parser(["study"])
    assert parser.parse_args(["study", "paper"]).seed == FIRST_SEED
    assert parser.parse_args(["study", "paper", "--truths", *TRUTHS]).truths == list(TRUTHS)
    assert parser.parse_args(["study", "tune-rules"]).runs <= FIRST_SEED // 2
