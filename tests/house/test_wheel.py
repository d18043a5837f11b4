"""The wheel in a fresh environment: what it installs, and that examples run from it beside folders of other people."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.house.example_data import EXAMPLES
from tests.house.test_examples import SLOW
from tests.house.uv import run_uv

ROOT = EXAMPLES.parent
PACKAGES = {"ftdrive", "ftcalib", "ftdrivers", "ftmocks"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    run_uv("build", "--wheel", "--out-dir", folder, ROOT, cwd=folder)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def python(wheel: Path) -> Path:
    """The interpreter of an environment that has only the wheel and what it requires."""
    folder = wheel.parent
    run_uv("venv", "--python", sys.executable, folder / "venv", cwd=folder)
    run_uv("pip", "install", "--python", folder / "venv/bin/python", wheel, cwd=folder)
    return folder / "venv/bin/python"


@pytest.fixture(scope="module")
def user_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The examples, beside packages of other people and a folder with the name of ours."""
    folder = tmp_path_factory.mktemp("user") / "work"
    shutil.copytree(EXAMPLES, folder)
    for name in ("calib", "drivers", "mocks"):
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text("raise ImportError('this is a package of the user')\n")
    (folder / "ftdrive").mkdir()
    (folder / "ftdrive/notes.txt").touch()
    return folder


def run(python: Path, *arguments: str | Path, cwd: Path) -> str:
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}
    command = [str(python), *map(str, arguments)]
    variables = {**inherited, "PYTHONIOENCODING": "utf-8", "MPLBACKEND": "agg"}
    outcome = subprocess.run(command, cwd=cwd, env=variables, capture_output=True, encoding="utf-8", check=False)
    assert outcome.returncode == 0, outcome.stderr
    return outcome.stdout


@pytest.mark.slow
def test_the_wheel_installs_four_packages_and_nothing_else(python: Path, user_folder: Path) -> None:
    code = (
        "import ftdrive, json, importlib.metadata as m; files = m.files('ftdrive');"
        "print(json.dumps([ftdrive.__file__, *map(str, files)]))"
    )
    where, *files = json.loads(run(python, "-c", code, cwd=user_folder))
    assert python.parents[1] in Path(where).parents
    roots = {name.partition("/")[0] for name in files if not name.startswith("../")}
    assert {name for name in roots if not name.endswith(".dist-info")} == PACKAGES
    assert {f"{name}/py.typed" for name in PACKAGES} <= set(files)
    assert [name for name in files if name.startswith("../")] == ["../../../bin/ftdrive"]
    assert [name for name in files if name.endswith((".md", ".svg", ".png"))] == []


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(SLOW))
def test_an_example_runs_from_the_wheel(name: str, python: Path, user_folder: Path) -> None:
    printed = run(python, f"{name}.py", cwd=user_folder)
    assert printed == (EXAMPLES / f"output/{name}.txt").read_text(encoding="utf-8")
