"""The house rules that a machine can check."""

import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.timeout(600)  # mypy without a cache takes 45 s of computing time
@pytest.mark.parametrize(
    "command",
    [
        ["ruff", "check", "."],
        ["ruff", "format", "--check", "."],
        pytest.param(["mypy"], marks=pytest.mark.slow),
        ["lint-imports"],
    ],
    ids=" ".join,
)
def test_checker_is_content(command: list[str]) -> None:
    tool = Path(sys.executable).with_name(command[0])
    outcome = subprocess.run([tool, *command[1:]], cwd=ROOT, capture_output=True, text=True, check=False)
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr


def test_every_dependency_is_bounded_and_has_its_reason() -> None:
    lines = (ROOT / "pyproject.toml").read_text(encoding="utf-8").splitlines()
    required = [line.strip().strip('",') for line in lines if line.startswith('  "') and ">=" in line]
    assert len(required) >= len(distribution("ftdrive").requires or [])
    assert all("<" in line for line in required)


def test_help_imports_nothing_heavy_and_opens_nothing() -> None:
    code = (
        "import sys, socket\n"
        "socket.socket = None\n"
        "sys.argv = ['ftdrive', '--help']\n"
        "from ftdrive.cli import main\n"
        "main()\n"
        "heavy = {'numpy', 'scipy', 'rich', 'can', 'serial', 'rtde_control', 'sqlalchemy'} & sys.modules.keys()\n"
        "sys.exit(f'help imports {heavy}' if heavy else 0)\n"
    )
    outcome = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert outcome.returncode == 0, outcome.stderr
    assert "demo" in outcome.stdout
