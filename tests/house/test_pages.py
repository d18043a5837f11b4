"""What the pages for users say about commands, files and one another."""

import re
import runpy
import shlex
from pathlib import Path

import click
import pytest

import ftdrive
from ftdrive.cli import cli

ROOT = Path(__file__).resolve().parents[2]
PAGES = [*ROOT.glob("*.md"), *ROOT.glob("[!.]*/**/*.md")]
PACKAGES = ("ftdrive", "calib", "drivers", "mocks", "tests")


def test_the_page_of_commands_has_every_command() -> None:
    page = (ROOT / "docs/reference/commands.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r":prog: ftdrive ([\w-]+)", page)) == sorted(cli.list_commands(click.Context(cli)))


def test_the_page_of_the_api_has_every_name() -> None:
    page = (ROOT / "docs/reference/api/ftdrive.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"\{py:obj\}`~ftdrive\.(\w+)`", page)) == sorted(ftdrive.__all__)


def _command_lines() -> list[str]:
    lines = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        lines += re.findall(r"^\s*\$ (?:\w+=\S+ )?(?:uv run )?ftdrive (.*)$", text, re.MULTILINE)
        lines += re.findall(r"`ftdrive ([^`\n]*)`", text)
    return sorted(set(lines))


def test_commands_and_options_of_the_pages_exist() -> None:
    unknown = []
    lines = _command_lines()
    assert len(lines) > 100
    for line in lines:
        command: click.Command = cli
        options = set(_options(command))
        for word in shlex.split(line.partition(" --ros-args ")[0], comments=True):
            if word.startswith("-"):
                options |= set(_options(command))
                if re.fullmatch(r"--?[a-z][\w-]*", word) and word not in options:
                    unknown.append(f"{word} in {line}")
            elif isinstance(command, click.Group) and re.fullmatch(r"[a-z][a-z0-9-]*", word):
                found = command.get_command(click.Context(command), word)
                if found is None:
                    unknown.append(f"{word} in {line}")
                    break
                command = found
    assert unknown == []


def _options(command: click.Command) -> list[str]:
    names = [name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)]
    return ["--help", "-h", "-vv", *names]


@pytest.mark.parametrize(
    ("page", "lines"),
    [
        ("README.md", 150),
        ("CONTRIBUTING.md", 150),
        ("tests/benchmarks/README.md", 60),
        *((f"{package}/README.md", 60) for package in PACKAGES),
    ],
)
def test_a_page_is_short(page: str, lines: int) -> None:
    assert len((ROOT / page).read_text(encoding="utf-8").splitlines()) <= lines


def test_links_of_pages_exist() -> None:
    missing = []
    for page in PAGES:
        text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        links = re.findall(r"\]\((?!https?:|mailto:|#)([^)#\s]+)", text)
        missing += [f"{page.relative_to(ROOT)}: {link}" for link in links if not (page.parent / link).exists()]
    assert missing == []


def test_plots_are_those_of_the_tables() -> None:
    pictures = ROOT / "docs/pictures"
    plots = runpy.run_path(str(ROOT / "docs/plots.py"))["PLOTS"]
    assert [
        name for name, draw in plots.items() if (pictures / f"{name}.svg").read_text(encoding="utf-8") != draw()
    ] == [], "run `uv run python docs/plots.py`"


def test_pages_that_the_code_names_exist() -> None:
    code = [
        file for folder in ("ftdrive", "calib", "drivers", "mocks", "tests") for file in (ROOT / folder).rglob("*.py")
    ]
    named = {page for file in code for page in re.findall(r"docs/[\w/-]+\.md", file.read_text(encoding="utf-8"))}
    assert len(named) > 5
    assert [page for page in named if not (ROOT / page).exists()] == []


def test_decisions_have_a_number_each_and_stay_out_of_the_search() -> None:
    pages = {page: page.read_text(encoding="utf-8") for page in (ROOT / "docs/decisions").glob("*.md")}
    assert [page.name for page, text in pages.items() if not text.startswith("---\nnosearch: true\n---\n")] == []
    anchors = [int(number) for text in pages.values() for number in re.findall(r"^\(decision-(\d{4})\)=", text, re.M)]
    headings = [int(number) for text in pages.values() for number in re.findall(r"^## (\d+)\. .* \(2\d", text, re.M)]
    assert len(anchors) == len(set(anchors)) > 100
    assert len(headings) == len(set(headings))
    assert set(headings) <= set(anchors)


def test_no_merge_was_left_half_done() -> None:
    assert len(PAGES) > 5
    assert [page for page in PAGES if re.search(r"^(<{7}|>{7}) ", page.read_text(encoding="utf-8"), re.MULTILINE)] == []
