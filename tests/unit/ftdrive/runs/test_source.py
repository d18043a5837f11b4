"""What else a place says beside its poses."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from ftcalib import CalibrationDataset, Known, Parameters
from ftcalib.errors import BadDataset, NotObservable
from ftcalib.model import STANDARD_GRAVITY_M_S2
from ftdrive.runs.run import Run
from ftdrive.runs.source import SolveOptions, read_source


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    R, wrench, covariance = (np.tile(one, (3, 1, 1)) for one in (np.eye(3), np.zeros(6), np.eye(6)))
    path = tmp_path / "dataset.json"
    CalibrationDataset(R, wrench[:, 0], covariance, np.zeros(3, np.int64), np.full(3, np.nan)).save(path)
    return path


@pytest.mark.parametrize(("up", "down"), [(None, (0.0, 0.0, -1.0)), ((0.0, 1.0, 0.0), (0.0, -1.0, 0.0))])
def test_a_known_direction_of_gravity_is_that_of_the_mounting(
    dataset: Path, up: tuple[float, float, float] | None, down: tuple[float, float, float]
) -> None:
    found = read_source(
        dataset, SolveOptions(known=Known(gravity_direction_base=(0, 0, -1), mass_kg=2.0), up_in_base=up)
    )
    known = found.known
    assert known is not None
    np.testing.assert_array_equal(known.gravity_direction_base, down)
    assert known.mass_kg == 2.0
    assert found.g_m_s2 == STANDARD_GRAVITY_M_S2
    assert found.provenance.get("up_in_base") == (None if up is None else list(up))
    free = read_source(dataset, SolveOptions(known=Known(mass_kg=2.0), up_in_base=up)).known
    assert free is not None
    assert free.gravity_direction_base is None
    assert read_source(dataset, SolveOptions()).known is None


def test_a_recording_in_motion_has_no_poses(tmp_path: Path) -> None:
    run = Run.create(tmp_path, "gripper", {})
    run.motion_path.touch()
    with pytest.raises(BadDataset, match="in motion"):
        read_source(run.folder, SolveOptions())


@pytest.mark.parametrize(
    ("mode", "words"),
    [("sweep", "start again with --sweep"), ("passive", "start again with --passive"), ("auto", "--resume")],
)
def test_a_run_without_data_says_how_to_go_on(mode: str, words: str, tmp_path: Path) -> None:
    run = Run.create(tmp_path, "stopped", {"mode": mode, "config": {"site": {"g_m_s2": 9.81}}})
    with pytest.raises(NotObservable, match=f"stopped has no data to solve: .*{words}"):
        read_source(run.folder, SolveOptions())


def test_the_truth_is_that_of_a_described_emulated_cell(dataset: Path) -> None:
    found = read_source(dataset, SolveOptions())
    assert found.truth is None
    truth = Parameters(np.diag([1.0, -1.0, -1.0]), *np.arange(12.0).reshape(4, 3))
    described = {one.name: getattr(truth, one.name).tolist() for one in fields(truth)}
    emulated = replace(found, provenance={"station": {"truth": described, "sensor": "axia80"}}).truth
    assert emulated is not None
    np.testing.assert_array_equal(truth.difference(emulated), 0)
