"""What the functions of `import ftdrive` refuse, and with which words."""

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ftdrive
from ftcalib.display import MOST_LINES
from ftdrive.recording import Recorder
from tests.house.example_data import EXAMPLES
from tests.unit.ftdrive.recorded import block, info


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"model": "ur6e"}, "ur6e"),
        ({"tool_mm": []}, "the tool is not described"),
        ({"poses": 7}, "choose one of 24, 12, 6"),
        ({"mounting": "shelf"}, "shelf"),
        ({"mass_kg": -1.0}, "mass_kg"),
    ],
)
def test_an_impossible_cell_is_named_by_its_argument(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(ftdrive.UsageError, match=words):
        ftdrive.plan_tour(**{"model": "ur5e", "tool_mm": [(0, 200, 100)], **arguments})


def test_devices_that_cannot_be_named_or_reached() -> None:
    with pytest.raises(ftdrive.UsageError, match="unknown sensor 'scale'"):
        ftdrive.open_sensor("scale:///dev/ttyUSB0")
    with pytest.raises(ftdrive.UsageError, match="unknown arm 'kuka'"):
        ftdrive.open_arm("192.0.2.1", driver="kuka")
    with pytest.raises(ftdrive.DeviceError, match="no-such-port"):
        ftdrive.open_sensor("bota:///dev/no-such-port")


def test_a_stream_needs_one_calibration() -> None:
    with pytest.raises(ftdrive.UsageError, match=r"no calibration.*or simulate=True"):
        ftdrive.open_stream()
    with pytest.raises(FileNotFoundError):
        ftdrive.open_stream(calibration="runs/none/calibration.json")


def test_an_emulated_cell_is_opened_only_with_simulate(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "ftdrive.toml").write_text('format = "ftdrive.config/1"\n[robot]\nsimulate = true\n')
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ftdrive.UsageError, match=r"ftdrive.toml describes an emulated cell.* simulate=True"):
        ftdrive.open_stream(calibration=info().calibration)


def test_a_path_a_table_arrays_and_a_dataset_give_the_same_result() -> None:
    path = EXAMPLES / "poses.csv"
    dataset = ftdrive.read_dataset(path)
    table = np.genfromtxt(path, delimiter=",", names=True)
    columns = {name: table[name] for name in table.dtype.names or ()}
    expected = ftdrive.solve(dataset).id
    assert [ftdrive.solve(one).id for one in (path, str(path), columns)] == [expected] * 3
    bare = ftdrive.CalibrationDataset.of(dataset.R_base_flange, dataset.wrench)
    pairs = [(dataset.R_base_flange, dataset.wrench), [dataset.R_base_flange.tolist(), dataset.wrench.tolist()]]
    assert {ftdrive.read_dataset(one).sha256() for one in [bare, *pairs]} == {bare.sha256()}
    turned = ftdrive.read_dataset((Rotation.from_matrix(dataset.R_base_flange), dataset.wrench))
    np.testing.assert_allclose(turned.R_base_flange, dataset.R_base_flange, atol=1e-12)


@pytest.mark.parametrize(
    ("source", "error", "words"),
    [
        ([[1.0] * 13] * 24, TypeError, "list has no column names: give a path, a DataFrame"),
        (info().calibration, TypeError, "this is a result, which is already solved"),
        ((np.zeros((4, 6)), np.zeros((4, 3, 3))), ftdrive.DataError, r"Give \(R_base_flange, wrench\), of shapes"),
        ({}, ftdrive.DataError, "no orientation among the columns"),
        ({"fx": [1.0]}, ftdrive.DataError, r"table=ftdrive.TableOptions\(columns=\{'qx': '…'"),
    ],
)
def test_what_cannot_be_solved_is_an_error_that_names_what_can(source: Any, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        ftdrive.solve(source)


@pytest.fixture
def recorded(tmp_path: Any) -> Path:
    """A recording of 30 s in motion."""
    recorder = Recorder([tmp_path / "turn.csv"], info(), {})
    recorder.add(block(1500, step_ns=2 * 10**7), [])
    recorder.end()
    return Path(tmp_path / "turn.csv")


@pytest.mark.slow
def test_a_recording_in_memory_gives_the_result_of_its_file(recorded: Path) -> None:
    known = ftdrive.Known(R_flange_sensor=np.eye(3))  # it turns about one axis
    in_memory = ftdrive.solve(ftdrive.read_recording(recorded), known=known)
    assert in_memory.id == ftdrive.solve(recorded, known=known).id
    assert in_memory.provenance["recording"] == "in memory"


def test_a_recording_in_memory_is_shown_and_a_frame(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = ftdrive.read_recording(recorded)
    with pytest.raises(TypeError, match=r"ftdrive.solve\(recording\)"):
        ftdrive.read_dataset(recording)
    with pytest.raises(ftdrive.DataError, match="read without p_base_flange_m"):
        ftdrive.solve(ftdrive.read_recording(recorded, ["t_host_ns", "seq", "raw", "quaternion_base_flange"]))
    assert repr(recording).startswith("Recording of 1500 samples in 29.98 s")
    assert len(repr(recording).splitlines()) <= MOST_LINES
    pandas = ModuleType("pandas")
    pandas.DataFrame = dict  # type: ignore[attr-defined]  # all that is used of it
    monkeypatch.setitem(sys.modules, "pandas", pandas)
    frame = recording.to_frame()
    assert list(frame)[:3] == ["t_s", "t_utc_s", "t_host_ns"]
    np.testing.assert_array_equal(frame["fz"], recording.rows["wrench"][:, 2])


def test_a_run_that_is_none_is_shown_all_the_same(tmp_path: Any) -> None:
    assert "is not a run folder" in repr(ftdrive.Run(tmp_path))
    assert repr(ftdrive.Run(tmp_path)).startswith(f"Run {tmp_path}")
