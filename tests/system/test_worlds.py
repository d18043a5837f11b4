"""Cells that are not level, not straight, not on the floor."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ftdrive.config import CellConfig
from ftdrive.report import errors_in_sigma
from ftdrive.simulation import Station
from tests.system.command_line import CommandLine

WORLDS = {
    "base tilted by 8 degrees": ("can", ["--tilt-deg", "8,0"]),
    "sensor turned 137 degrees about an odd axis": ("serial", ["--sensor-rotvec-deg", "79.1,-98.9,52.7"]),
    "arm on a wall, with a TCP set": ("serial", ["--mount", "wall", "--tcp", "0.03,-0.02,0.15,0.4,-0.3,0.9"]),
    "arm under a ceiling": ("can", ["--mount", "ceiling"]),
}


@pytest.mark.parametrize("world", WORLDS)
def test_odd_cells_are_recovered_within_their_sigmas(
    world: str, ftdrive: CommandLine, write_config: Callable[[CellConfig], Path], tmp_path: Path
) -> None:
    from calib import CalibrationResult

    sensor, options = WORLDS[world]
    with Station(sensor, ["--seed", "7", *options]) as station:
        answer = ftdrive.json("calibrate", "--config", write_config(station.cell), typed="yes\nyes\nyes\nMOVE\nyes\n")
        truth = station.truth
        told = ftdrive.json("solve", answer["run"], "--level-deg", "5")  # level as it is mounted
    assert not any("was given as known" in reason for reason in told["reasons"]), told["reasons"]
    result = CalibrationResult.load(tmp_path / answer["run"] / "calibration.json")
    assert not any("upwards" in reason or "gravity is" in reason for reason in result.reasons), result.reasons
    for key, errors in errors_in_sigma(result, truth).items():
        assert np.abs(errors).max() < 4, (key, errors)
