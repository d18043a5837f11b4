"""The errors of the three packages hang below one root, and each has the exit code of the documents."""

import ast
import builtins
import subprocess
import sys
from pathlib import Path

import pytest

from ftcalib.errors import AcceptanceError, BadDataset, DataError, DeviceError, NotObservable, TooFewSamples, UsageError
from ftdrive.errors import NotAccepted, RecordingHasGaps, exit_code
from ftdrivers.errors import BadUrl, ConnectError, DeviceFault, DeviceTimeout, Unreachable

ROOT = Path(__file__).resolve().parents[2]
PYTHONS_OWN = {name for name, kind in vars(builtins).items() if isinstance(kind, type) and issubclass(kind, Exception)}


@pytest.mark.slow
def test_only_the_root_derives_from_an_exception_of_python() -> None:
    trees = [
        ast.parse(path.read_text(encoding="utf-8"))
        for room in ("ftdrive", "calib", "drivers")
        for path in (ROOT / room).rglob("*.py")
    ]
    classes = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    found = {one.name for one in classes for base in one.bases if isinstance(base, ast.Name) and base.id in PYTHONS_OWN}
    # Session and `init` catch `Tripped` and the private ones themselves.
    assert {name for name in found if not name.startswith("_")} == {"FtdriveError", "Tripped"}


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (UsageError(), 2),
        (BadUrl(), 2),
        (ModuleNotFoundError(name="termios"), 2),
        (Unreachable("silent"), 3),
        (ConnectError("silent"), 3),
        (DeviceError("silent"), 4),
        (DeviceTimeout("silent"), 4),
        (TooFewSamples(), 4),
        (DeviceFault("hot"), 5),
        (DataError(), 6),
        (BadDataset(), 6),
        (FileNotFoundError(), 6),
        (AcceptanceError(), 7),
        (NotAccepted(), 7),
        (NotObservable("one tilt"), 7),
        (RecordingHasGaps(), 8),
        (ValueError(), None),
        (ModuleNotFoundError(name="numpie"), None),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Exception) else str(value),
)
def test_each_kind_of_error_has_its_exit_code(error: Exception, code: int | None) -> None:
    assert exit_code(error) == code


def test_too_few_samples_are_no_failed_device() -> None:
    assert not issubclass(TooFewSamples, DeviceError)  # a session would take the controller for lost


@pytest.mark.parametrize("module", ["ftcalib.errors", "ftdrivers.errors", "ftdrive.errors"])
def test_the_errors_need_neither_numpy_nor_scipy(module: str) -> None:
    code = f"import sys, {module}; sys.exit(str(sorted({{'numpy', 'scipy'}} & sys.modules.keys())))"
    outcome = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert outcome.stderr.strip() == "[]"
