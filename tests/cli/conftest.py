"""Logs to replay and a way to run the command in this process."""

from __future__ import annotations

from pathlib import Path

import pytest

from can_imm.cli.main import main

SCENARIO = """
duration = 6.0
[[object]]
id = 3
gap = 40.0
lane = "right"
segments = [
    { start = 0.0, label = "KEEP_RIGHT" },
    { start = 2.0, label = "LANE_CHANGE", direction = "left" },
    { start = 4.0, label = "KEEP_LEFT" },
]
"""


@pytest.fixture(scope="session")
def scenario(tmp_path_factory) -> Path:
    """Six seconds with one lane change to the left by object 3 from 2 to 4 s: 61 scans."""
    path = tmp_path_factory.mktemp("scenario") / "short.toml"
    path.write_text(SCENARIO)
    return path


@pytest.fixture(scope="session")
def log(scenario, tmp_path_factory) -> Path:
    """The scenario as a candump log."""
    path = tmp_path_factory.mktemp("log") / "sensor.log"
    assert main(["simulate", "--scenario", str(scenario), "--log", str(path)]) == 0
    return path


@pytest.fixture
def can_imm(capsys):
    """Return a function that runs ``can-imm`` and returns status, standard output and error."""

    def run(*arguments) -> tuple[int, str, str]:
        capsys.readouterr()
        try:
            status = main([str(argument) for argument in arguments])
        except SystemExit as end:
            status = int(end.code or 0)
        said = capsys.readouterr()
        return status, said.out, said.err

    return run
