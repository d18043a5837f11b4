"""The names of `import ftdrive`: a fixed list, cheap to import, typed, each with an example that runs."""

import ast
import doctest
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import ftcalib
import ftdrive
import ftdrivers
from ftcalib.model import predict
from ftcalib.poses.information import special
from ftcalib.routine import PoseRecord, TourPose
from ftdrive.recording import Recorder
from ftdrive.runs.run import Reading, Run
from ftdrive.runs.source import solve_and_save
from ftdrivers.interfaces import FtSamples
from tests.house.example_data import EXAMPLES, TRUTH
from tests.unit.ftdrive.recorded import block, info

ERRORS = ["AcceptanceError", "DataError", "DeviceError", "FtdriveError", "UsageError"]
RESULTS = ["CalibrationDataset", "CalibrationResult", "Known", "Run", "Setup", "TableOptions"]
FUNCTIONS = ["compare", "plan_tour", "read_calibration", "read_dataset", "read_recording", "solve", "write_recording"]
LIVE = ["Contact", "Stages", "WrenchFrame", "open_arm", "open_sensor", "open_stream", "weigh"]
EMULATED = {"ForceTorqueSensor", "RobotArm", "Weight", "open_arm", "open_sensor", "open_stream", "weigh"}
SLOW = EMULATED | {"compare"}  # every method of estimation
PACKAGES = [ftdrive, ftcalib, ftdrivers]
EXAMPLES_OF = [
    (package, name)
    for package in PACKAGES
    for name in package.__all__
    if package is ftdrive or (name not in ftdrive.__all__ and ">>>" in (getattr(package, name).__doc__ or ""))
]


def test_completion_shows_25_names() -> None:
    assert sorted(ftdrive.__all__) == sorted(ERRORS + RESULTS + FUNCTIONS + LIVE)
    assert len(ftdrive.__all__) == 25
    for package in PACKAGES:
        assert dir(package) == sorted(package.__all__)


def test_a_name_that_is_elsewhere_is_an_error_that_says_where() -> None:
    with pytest.raises(AttributeError, match=r"module 'ftdrive' has no attribute 'sovle'$"):
        _ = ftdrive.sovle  # type: ignore[attr-defined]  # the point of the test
    for name, package in (("RobotArm", "ftdrivers"), ("solve_loads", "ftcalib")):
        with pytest.raises(AttributeError, match=rf"has no attribute '{name}': from {package} import {name}$"):
            getattr(ftdrive, name)


def test_import_ftdrive_loads_only_itself() -> None:
    code = "import sys; before = {*sys.modules}; import ftdrive; print(*sorted({*sys.modules} - before))"
    outcome = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert {name.partition(".")[0] for name in outcome.stdout.split()} <= {"ftdrive", "importlib", "warnings"}


@pytest.mark.parametrize("package", PACKAGES)
def test_type_checkers_see_the_objects_that_are_imported(package: ModuleType) -> None:
    tree = ast.parse(Path(str(package.__file__)).read_text(encoding="utf-8"))
    seen = {
        alias.name: node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module != "importlib"
        for alias in node.names
    }
    assert seen == {name: module for module, names in package._MODULES.items() for name in names}
    assert set(seen) == set(package.__all__)
    assert all(hasattr(package, name) for name in seen)


@pytest.fixture(scope="module")
def user_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with poses.csv, a recording and a run."""
    folder = tmp_path_factory.mktemp("user")
    shutil.copy(EXAMPLES / "poses.csv", folder)
    recorder = Recorder([folder / "peg.csv"], info(), {})
    recorder.add(block(3000), [])
    recorder.end()
    run = Run.create(folder, "gripper", {"config": {"site": {"g_m_s2": 9.80665}}})
    rng = np.random.default_rng(3)
    for stop, R in enumerate(special([1, 5, 9, 14, 18, 22]), 1):
        reading = Reading(stop * 10**9, np.zeros(6), R)
        wrench = predict(TRUTH, R) + rng.normal(0, 0.01, (50, 6))
        samples = FtSamples.of(stop * 10**9 + np.arange(50) * 10**6, np.arange(50), wrench)
        run.commit(PoseRecord(stop, TourPose(stop, reading.q_rad), reading, reading, samples, steady=True))
    solve_and_save(run)
    (folder / "runs").mkdir()
    run.folder.rename(folder / "runs/gripper")
    return folder


@pytest.mark.parametrize(
    ("package", "name"),
    [pytest.param(*one, id=one[1], marks=[pytest.mark.slow] * (one[1] in SLOW)) for one in EXAMPLES_OF],
)
def test_each_name_has_an_example_that_runs(
    package: ModuleType, name: str, user_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(shutil.copytree(user_folder, tmp_path / "user"))
    text = getattr(package, name).__doc__
    example = doctest.DocTestParser().get_doctest(text, {}, name, name, 0)
    assert example.examples
    shown = list[str]()
    doctest.DocTestRunner(verbose=False).run(example, out=shown.append)
    assert shown == []
