"""The house rules that a machine can check."""

import re
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import click
import pytest

from ftdrive.cli import cli

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("ftdrive", "calib", "drivers", "mocks", "tests")


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


def test_the_page_of_commands_has_every_command() -> None:
    page = (ROOT / "docs/reference/commands.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r":prog: ftdrive (\w+)", page)) == sorted(cli.list_commands(click.Context(cli)))


@pytest.mark.parametrize(
    ("page", "lines"),
    [
        ("README.md", 150),
        ("CONTRIBUTING.md", 150),
        *(
            (f"{folder}/README.md", 60)
            for folder in ("ftdrive", "calib", "drivers", "mocks", "tests", "tests/benchmarks")
        ),
    ],
)
def test_a_page_is_short_and_its_links_exist(page: str, lines: int) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    assert len(text.splitlines()) <= lines
    links = re.findall(r"\]\((?!https?:)([^)#]+)", text)
    assert links
    assert [link for link in links if not (ROOT / page).parent.joinpath(link).exists()] == []


def test_every_page_that_the_code_names_exists() -> None:
    code = [file for folder in FOLDERS for file in (ROOT / folder).rglob("*.py")]
    named = {page for file in code for page in re.findall(r"docs/[\w/-]+\.md", file.read_text(encoding="utf-8"))}
    assert len(named) > 5
    assert [page for page in named if not (ROOT / page).exists()] == []


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
