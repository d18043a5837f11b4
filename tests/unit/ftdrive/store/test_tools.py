"""Tools by name: the newest accepted calibration of this arm, sensor and mount, and nothing else."""

import sqlite3
from dataclasses import replace
from pathlib import Path

import pytest

from ftcalib import Finding
from ftdrive.errors import ConfigError
from ftdrive.store.store import Store
from ftdrive.store.tools import Tool, calibration_of_tool
from ftdrivers.interfaces import NOT_REPORTED, DeviceInfo
from tests.unit.ftdrive.store.run_folders import new_run, result, verified

ARM, SENSOR = DeviceInfo("ARM", "arm-1", "1"), DeviceInfo("SENSOR", "ft-1", "1")
OTHER = DeviceInfo("SENSOR", "ft-2", "1")


@pytest.fixture(autouse=True)
def _empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def indexed(folder: Path) -> str:
    """Make a store of one cell with two tools and two mounts, and of another sensor."""
    results = {
        "gripper-old": result(0),
        "gripper-new": result(10),
        "gripper-rejected": replace(result(20), findings=(Finding.of("second_solution", probability_percent=40.0),)),
        "drill": result(30, tool="drill"),
        "gripper-elsewhere": result(40, serials=("arm-1", "ft-2")),
        "gripper-remounted": result(50, mount="adapter-b"),
    }
    for name, one in results.items():
        new_run(folder / "indexed", name, one)
    url = f"sqlite:///{folder / 'store.sqlite'}"
    Store(url).index(folder / "indexed")
    return url


@pytest.fixture(scope="module")
def shared_url(tmp_path_factory: pytest.TempPathFactory) -> str:
    """For tests that change nothing."""
    return indexed(tmp_path_factory.mktemp("store"))


@pytest.fixture
def url(tmp_path: Path) -> str:
    return indexed(tmp_path)


def run_of(tool: Tool) -> str:
    return tool.path.parent.name


@pytest.mark.parametrize(
    ("name", "sensor", "mount", "run"),
    [
        ("gripper", SENSOR, None, "gripper-new"),
        ("drill", SENSOR, None, "drill"),
        ("gripper", OTHER, None, "gripper-elsewhere"),
        ("gripper", SENSOR, "adapter-b", "gripper-remounted"),
    ],
)
def test_the_newest_accepted_one_of_this_cell_is_taken(
    shared_url: str, name: str, sensor: DeviceInfo, mount: str | None, run: str
) -> None:
    found = calibration_of_tool(name, ARM, sensor, mount, url=shared_url)
    assert (run_of(found), found.warnings) == (run, ())
    assert found.calibration.id == Store(shared_url).find(found.calibration.id)[0].id


@pytest.mark.parametrize(
    ("name", "sensor", "mount", "words"),
    [
        ("welder", SENSOR, None, r"tool 'welder' .*arm-1.*ft-1.*no mount label.*\[tool\] name.*or choose one of drill"),
        ("drill", OTHER, None, "ft-2.*or choose one of gripper"),
        ("drill", SENSOR, "adapter-b", "the mount 'adapter-b'"),
    ],
)
def test_a_tool_that_is_not_calibrated_here_is_refused(
    shared_url: str, name: str, sensor: DeviceInfo, mount: str | None, words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        calibration_of_tool(name, ARM, sensor, mount, url=shared_url)


def test_forced_it_is_taken_from_another_cell_only_if_there_is_none(shared_url: str) -> None:
    assert run_of(calibration_of_tool("drill", ARM, OTHER, url=shared_url, force=True)) == "drill"
    assert run_of(calibration_of_tool("gripper", ARM, SENSOR, url=shared_url, force=True)) == "gripper-new"
    with pytest.raises(ConfigError, match="welder"):
        calibration_of_tool("welder", ARM, SENSOR, url=shared_url, force=True)


def test_without_a_serial_number_the_model_decides(shared_url: str) -> None:
    unnamed = DeviceInfo("SENSOR", NOT_REPORTED, "1")
    assert run_of(calibration_of_tool("gripper", ARM, unnamed, url=shared_url)) == "gripper-elsewhere"
    with pytest.raises(ConfigError):
        calibration_of_tool("gripper", ARM, DeviceInfo("AXIA", NOT_REPORTED, "1"), url=shared_url)


def test_a_run_that_is_not_indexed_counts_and_one_that_is_gone_does_not(url: str, tmp_path: Path) -> None:
    new_run(tmp_path / "runs", "fresh", result(15))
    assert run_of(calibration_of_tool("gripper", ARM, SENSOR, url=url)) == "fresh"
    (tmp_path / "runs" / "fresh" / "calibration.json").unlink()
    (tmp_path / "indexed" / "gripper-new" / "calibration.json").write_text("{")
    assert run_of(calibration_of_tool("gripper", ARM, SENSOR, url=url)) == "gripper-old"


def test_a_failed_verification_is_a_warning(url: str, tmp_path: Path) -> None:
    verified(new_run(tmp_path / "indexed", "verify"), result(10).id, 60, passed=False)
    Store(url).index(tmp_path / "indexed")
    (words,) = calibration_of_tool("gripper", ARM, SENSOR, url=url).warnings
    assert "failed: the force bias has changed by 0.5 N; calibrate again" in words


def test_a_store_that_cannot_be_read_leaves_the_run_folders(url: str, tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "store.sqlite") as connection:
        connection.execute("UPDATE ftdrive_schema SET version = 99")
    connection.close()
    (tmp_path / "runs").symlink_to(tmp_path / "indexed")
    found = calibration_of_tool("gripper", ARM, SENSOR, url=url)
    assert run_of(found) == "gripper-new"
    assert "has version 99" in found.warnings[0]
