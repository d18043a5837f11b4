"""The examples run as their pages show them, and the data that they read can be made again."""

import os
import re
import runpy
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.house import example_data

EXAMPLES = example_data.EXAMPLES
PAGES = EXAMPLES.parent / "docs/examples"
SLOW = {"live_contact", "monte_carlo", "plan_without_robot"}
"""`test_wheel.py` runs these, and no others."""
NAMES = sorted(path.stem for path in EXAMPLES.glob("*.py"))
NOTEBOOKS = sorted(
    path.stem for path in PAGES.glob("*.md") if "file_format: mystnb" in path.read_text(encoding="utf-8")
)
"""Sphinx runs them when it builds the pages."""


def cells_of(notebook: str) -> list[str]:
    """Return the code of the cells of a notebook."""
    text = (PAGES / f"{notebook}.md").read_text(encoding="utf-8")
    return re.findall(r"```\{code-cell\} python\n(.*?)```", text, re.DOTALL)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in NAMES if name not in SLOW])
def test_an_example_prints_what_its_page_shows(name: str, tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONIOENCODING": "utf-8"}
    command = [sys.executable, "-W", "error", str(EXAMPLES / f"{name}.py")]
    outcome = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, encoding="utf-8", check=False)
    assert (outcome.returncode, outcome.stderr) == (0, "")
    assert outcome.stdout == (EXAMPLES / f"output/{name}.txt").read_text(encoding="utf-8")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_figures_of_the_papers_are_drawn_with_the_numbers_of_their_page(tmp_path: Path) -> None:
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-W", "error", str(EXAMPLES / "papers/paper_figures.py"), "--output", str(tmp_path)]
    outcome = subprocess.run(command, env=environment, capture_output=True, encoding="utf-8", check=False)
    assert (outcome.returncode, outcome.stderr) == (0, "")
    assert outcome.stdout == (EXAMPLES / "papers/output.txt").read_text(encoding="utf-8")
    drawn = {path.name for path in tmp_path.iterdir()}
    assert drawn == {path.name for path in (EXAMPLES.parent / "docs/pictures/papers").iterdir()}
    page = (EXAMPLES.parent / "docs/explanation/papers-reproduced.md").read_text(encoding="utf-8")
    assert {name for name in drawn if f"papers/{name})" in page} == drawn


def test_the_figures_of_the_papers_say_what_they_need(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script = str(EXAMPLES / "papers/paper_figures.py")
    (file := tmp_path / "file").touch()
    monkeypatch.setattr(sys, "argv", [script, "yu-fig14", "--output", str(file)])
    with pytest.raises(SystemExit, match="2"):
        runpy.run_path(script, run_name="__main__")
    assert "choose another folder with --output" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(SystemExit, match="need matplotlib: run with"):
        runpy.run_path(script, run_name="__main__")


def test_each_example_is_short_and_has_a_page_that_the_index_names() -> None:
    assert [name for name in NAMES if not 10 <= len((EXAMPLES / f"{name}.py").read_text().splitlines()) <= 40] == []
    index = (PAGES / "index.md").read_text(encoding="utf-8")
    for name in NAMES:
        page = (PAGES / f"{name}.md").read_text(encoding="utf-8")
        assert re.findall(r"\{literalinclude\} (.*)", page) == [
            f"../../examples/{name}.py",
            f"../../examples/output/{name}.txt",
        ]
        assert f"\n{name}\n" in index


def test_each_notebook_has_short_cells_and_the_index_names_it() -> None:
    for name in NOTEBOOKS:
        assert f"\n{name}\n" in (PAGES / "index.md").read_text(encoding="utf-8")
        assert max(len(cell.splitlines()) for cell in cells_of(name)) <= 10


@pytest.mark.slow
def test_the_stream_of_the_readme_runs_with_the_file_of_its_first_step(tmp_path: Path) -> None:
    readme = (EXAMPLES.parent / "README.md").read_text(encoding="utf-8")
    (init,) = re.findall(r"^\$ uv run ftdrive (init .*)$", readme, re.MULTILINE)
    (snippet,) = re.findall(r"```python\n(.*?)```", readme, re.DOTALL)
    subprocess.run([sys.executable, "-m", "ftdrive", *shlex.split(init)], cwd=tmp_path, check=True, capture_output=True)
    command = [sys.executable, "-u", "-W", "error", "-c", snippet]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, encoding="utf-8") as process:
        assert process.stdout is not None
        lines = [process.stdout.readline() for _ in range(3)]
        process.send_signal(signal.SIGINT)  # as Ctrl-C
        process.communicate()
    assert all(line.endswith("sensor axes, about the sensor origin\n") for line in lines), lines


@pytest.mark.parametrize("name", example_data.FILES)
def test_the_data_are_those_that_the_script_makes(name: str) -> None:
    assert (EXAMPLES / name).read_text(encoding="utf-8") == example_data.FILES[name]()
