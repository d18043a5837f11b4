"""A weighed load as options describe it, as a run keeps it, and what its result must not be taken for."""

import pytest

from ftcalib.errors import BadCalibration
from ftdrive.errors import ConfigError
from ftdrive.runs.calibration import read_calibration
from ftdrive.runs.load import Load, mass_of, place_of
from ftdrive.runs.run import Run
from ftdrive.runs.source import SolveOptions, circumstances_of, read_source, solve_and_save
from tests.unit.ftdrive.fake_cell import Lab


@pytest.mark.parametrize("text", ["", "two", "0", "-1", "nan", "inf", "2±0", "2±3", "2±nan", "1±2±3"])
def test_a_mass_that_cannot_be_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="the mass"):
        mass_of(text)


@pytest.mark.parametrize("text", ["=0,0,200", "tip=0,0", "tip=0,0,x", "tip=0,0,nan", "tip=0,0,2001", "a b=0,0,2"])
def test_a_place_that_cannot_be_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="the place"):
        place_of(text)


def test_options_describe_one_place() -> None:
    assert Load.of("2", "tip=0,10,200", gripped=False).p_flange_mm == (0, 10, 200)
    assert Load.of("2", None, gripped=True).p_flange_mm is None
    for place, gripped in ((None, False), ("tip=0,0,200", True), ("tip", False)):
        with pytest.raises(ConfigError, match="--at"):
            Load.of("2", place, gripped=gripped)


@pytest.mark.slow
def test_a_run_with_a_load_is_not_that_of_its_tool(lab: Lab) -> None:
    load = Load.of("0.5", None, gripped=True)
    run = lab.take_poses(load=load, description={"load": load.to_dict()})
    assert run is not None
    solve_and_save(run)
    assert Load.of_header(read_source(run.folder, SolveOptions()).dataset.meta) == load
    with pytest.raises(BadCalibration, match=r"a load of 0\.5 kg in the gripper: use it in `ftdrive loads solve`"):
        read_calibration(run.folder)
    found = circumstances_of(Run(run.folder))
    assert found.origin["setup"]["tool"] != lab.cell.tool.name
    assert not found.setup.cylinders_m
