"""The house rules that a machine can check."""

import subprocess
import sys
import tomllib
from importlib.metadata import distribution
from pathlib import Path

import pytest

from tests.house import codes_page
from tests.house.printing import prints_in
from tests.house.sentences import sentences_in

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


def test_the_page_of_finding_codes_is_up_to_date() -> None:
    assert codes_page.PAGE.read_text(encoding="utf-8") == codes_page.page(), f"uv run python {codes_page.__file__}"


@pytest.mark.slow
def test_no_code_tests_or_edits_a_sentence() -> None:
    """A program that has to know what was found takes it as data, such as `ftcalib.Finding` or a class of errors."""
    folders = ("ftdrive/ftdrive", "calib/ftcalib", "drivers/ftdrivers", "mocks/ftmocks")
    assert sentences_in([ROOT / folder for folder in folders]) == []


@pytest.mark.parametrize(
    ("code", "is_hit"),
    [
        ("causes = [one for one in causes if one in result.reasons]", True),
        ('if view.note.startswith("STOP"): pass', True),
        ('words = direction_in_words(x).replace("base", "flange")', True),
        ('found, _, fix = str(error).rpartition(": ")', True),
        ('if "already in use" in error.found: pass', True),
        ('if text == "the arm has stopped": pass', True),
        ('if re.search("remote control", str(exc).lower()): pass', True),
        ('if finding.code == "drift": pass', False),
        ('if not event.words or event.words == "": pass', False),
        ('KINDS = {"centre of mass": 1}\nif kind == "centre of mass": pass', False),
        ('print(f"{finding.found}: {finding.fix}")', False),
        ('name = path.name.removesuffix(".partial")', False),
    ],
)
def test_tests_of_a_sentence_are_recognised(code: str, is_hit: bool, tmp_path: Path) -> None:
    (tmp_path / "module.py").write_text(code, encoding="utf-8")
    assert bool(sentences_in([tmp_path])) == is_hit


def test_every_dependency_is_bounded_and_has_its_reason() -> None:
    lines = (ROOT / "pyproject.toml").read_text(encoding="utf-8").splitlines()
    required = [line.strip().strip('",') for line in lines if line.startswith('  "') and ">=" in line]
    assert len(required) >= len(distribution("ftdrive").requires or [])
    assert all("<" in line for line in required)


def test_uv_run_compiles_nothing() -> None:
    """A setting that compiles costs each `uv run` a look at some thousand files; CI compiles once by itself."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert "compile-bytecode" not in project["tool"].get("uv", {})


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


def test_whatever_is_printed_cannot_command_the_terminal() -> None:
    assert prints_in(ROOT / "ftdrive/ftdrive") == []


@pytest.mark.parametrize(
    ("code", "is_hit"),
    [
        ("print(name)", True),
        ("click.echo(run.tool)", True),
        ("self._stdout.write(line)", True),
        ("sys.stderr.write(str(error))", True),
        ("Console().print(table)", True),
        ("handlers = [logging.StreamHandler()]", True),
        ("self._stderr.write(in_whole_words(text, file))", False),
        ("click.prompt(visible(shown))", False),
        ("click.echo(json.dumps(found))", False),
        ("click.echo(json.dumps(found, ensure_ascii=False))", True),
        ("echo(run.tool)", False),
        ("messages.print(run.tool)", False),
        ("file.write(text)", False),
    ],
)
def test_unsafe_prints_are_recognised(code: str, is_hit: bool, tmp_path: Path) -> None:
    (tmp_path / "module.py").write_text(code, encoding="utf-8")
    assert bool(prints_in(tmp_path)) == is_hit
