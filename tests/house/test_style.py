"""The house rules that a machine can check."""

import re
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest

from tests.house import commands_page

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


def test_the_page_of_commands_is_up_to_date() -> None:
    assert commands_page.PAGE.read_text(encoding="utf-8") == commands_page.page(), (
        "an option has changed: uv run python tests/house/commands_page.py"
    )


def test_the_readme_is_short_and_its_links_exist() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    links = re.findall(r"\]\((?!https?:)([^)#]+)", text)
    assert len(links) > 5
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_no_merge_was_left_half_done() -> None:
    pages = [*ROOT.glob("*.md"), *ROOT.glob("[!.]*/**/*.md")]
    assert len(pages) > 5
    assert [page for page in pages if re.search(r"^(<{7}|>{7}) ", page.read_text(encoding="utf-8"), re.MULTILINE)] == []


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
