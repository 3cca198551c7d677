"""The command itself: help, version, statuses, errors in one line."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from can_imm import __version__
from can_imm.cli import main as main_module
from can_imm.cli.main import COMMANDS, build_parser
from can_imm.types import CanImmError


def test_version(can_imm):
    assert can_imm("--version") == (0, f"can-imm {__version__}\n", "")


def test_help_names_every_command(can_imm):
    status, out, _ = can_imm("--help")
    assert status == 0
    assert all(f"    {name} " in out for name in COMMANDS)


def test_help_imports_nothing_heavy():
    code = (
        "import sys; from can_imm.cli.main import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'numpy', 'numba', 'can', 'cantools', 'rich', 'scipy', 'matplotlib'}\n"
        "print(heavy & set(sys.modules), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == "set()\n"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(can_imm, name):
    status, out, _ = can_imm(name, "--help")
    assert status == 0
    assert f"usage: can-imm {name}" in out
    assert f"can-imm {name}" in out.split("\n\n", 1)[1]  # an example


@pytest.mark.parametrize(
    "arguments", [(), ("bogus",), ("replay",), ("replay", "x.log", "--objects", "0"), ("--bogus",)]
)
def test_wrong_usage_is_status_2(can_imm, arguments):
    status, out, err = can_imm(*arguments)
    assert status == 2
    assert out == ""
    assert "can-imm" in err.splitlines()[-1]
    assert "error:" in err.splitlines()[-1]


def test_module_is_the_command():
    done = subprocess.run(
        [sys.executable, "-m", "can_imm", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout == f"can-imm {__version__}\n"


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh"])
def test_completion_script_knows_the_options(can_imm, shell):
    status, out, _ = can_imm("--print-completion", shell)
    assert status == 0
    assert "replay" in out
    assert "truth" in out


def test_only_the_chosen_command_is_loaded():
    parser = build_parser(["replay"])
    assert parser.parse_args(["replay", "x.log"]).logs == ["x.log"]
    assert not hasattr(parser.parse_args(["simulate"]), "scenario")


def run_with(monkeypatch, error: BaseException):
    """Run ``main`` with a command that raises."""

    class Parsed:
        @staticmethod
        def run(args):
            raise error

    monkeypatch.setattr(main_module, "_parse", lambda argv: Parsed)
    return main_module.main([])


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (CanImmError("x.toml: no such mode"), "can-imm: error: x.toml: no such mode\n"),
        (PermissionError(13, "Permission denied", "a.csv"),
         "can-imm: error: a.csv: Permission denied\n"),
        (OSError("odd"), "can-imm: error: odd\n"),
    ],
)  # fmt: skip
def test_errors_are_one_line_and_status_1(monkeypatch, capsys, error, line):
    assert run_with(monkeypatch, error) == 1
    assert capsys.readouterr() == ("", line)


def test_a_bug_is_not_hidden(monkeypatch):
    with pytest.raises(ZeroDivisionError):
        run_with(monkeypatch, ZeroDivisionError())


def test_ctrl_c_is_status_130(monkeypatch, capsys):
    assert run_with(monkeypatch, KeyboardInterrupt()) == 130
    assert capsys.readouterr() == ("", "")


def test_bus_options_that_print_do_not_soil_standard_output(can_imm, tmp_path):
    # python-can echoes --timing on standard output while it parses
    status, out, err = can_imm(
        "detect", "-i", "socketcan", "-c", "no_such", "--timing",
        "f_clock=8_000_000", "tseg1=5", "tseg2=2", "sjw=2", "brp=2", "nof_samples=1",
    )  # fmt: skip
    assert status == 1
    assert out == ""
    assert err.startswith("can-imm: error: cannot open bus socketcan no_such")


def test_reader_that_leaves_ends_it_quietly(log):
    command = f"{sys.executable} -m can_imm replay {log} --csv - | head -1; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=True)
    header, status = done.stdout.splitlines()
    assert header.startswith("time_s,")
    # a short log may fit the pipe whole
    assert status in ("0", str(128 + signal.SIGPIPE))
    assert "Traceback" not in done.stderr


def test_sigterm_closes_files_and_is_status_143(scenario, tmp_path):
    log = tmp_path / "sent.log"
    process = subprocess.Popen(
        [sys.executable, "-m", "can_imm", "simulate", "-i", "virtual", "--scenario", scenario,
         "--log", log],
        stderr=subprocess.PIPE, text=True,
        env={**os.environ, "CAN_CONFIG": "{}"},
    )  # fmt: skip
    with process:
        assert "playing" in process.stderr.readline()
        time.sleep(1.0)
        process.send_signal(signal.SIGTERM)
        assert process.wait(10) == 128 + signal.SIGTERM
        assert process.stderr.read() == ""
    lines = log.read_text().splitlines()
    assert 2 <= len(lines) < 40
    assert all("#" in line for line in lines)
