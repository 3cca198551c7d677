"""The rooms of the house: the import contract of pyproject.toml."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import can_imm

ROOT = Path(__file__).parents[1]
PACKAGE = Path(can_imm.__file__).parent
LINT = "from importlinter.cli import lint_imports_command as c; c()"


def lint_imports(config: Path, *path: Path) -> subprocess.CompletedProcess[str]:
    """The linter in a process of its own: it keeps what it has imported."""
    code = f"import sys; sys.path[:0] = {[str(p) for p in path]!r}; {LINT}"
    return subprocess.run(
        [sys.executable, "-c", code, "--config", str(config), "--no-cache"],
        cwd=ROOT, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip


def test_imports_point_down() -> None:
    result = lint_imports(ROOT / "pyproject.toml", ROOT)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "0 broken" in result.stdout


def test_an_import_that_points_up_is_found(tmp_path: Path) -> None:
    """The same layers with the two lowest ones exchanged must be broken."""
    config = tmp_path / "contract.toml"
    config.write_text(
        '[tool.importlinter]\nroot_package = "can_imm"\n'
        '[[tool.importlinter.contracts]]\nname = "upside down"\ntype = "layers"\n'
        'layers = ["can_imm.types", "can_imm.estimation"]\n',
        encoding="utf-8",
    )
    result = lint_imports(config, ROOT)
    assert result.returncode == 1, result.stdout + result.stderr
    assert "1 broken" in result.stdout


def imported(path: Path) -> set[str]:
    """Top-level packages that a module imports anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return {n.split(".")[0] for n in names}


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda p: p.stem)
def test_estimation_knows_no_bus_no_clock_and_no_files(path: Path) -> None:
    """And nobody but the command line and the bus knows the CAN libraries."""
    room = path.relative_to(PACKAGE).parts[0]
    names = imported(path)
    if room not in ("bus", "cli"):
        assert not names & {"can", "cantools", "e2e"}
    if not room.startswith("plots"):
        assert "matplotlib" not in names
    if room == "estimation":
        assert not names & {"time", "datetime", "pathlib", "os", "io", "socket", "threading"}
