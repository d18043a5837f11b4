"""Cells that are not level, not straight, not on the floor."""

import pytest

from ftcalib import CalibrationResult
from ftcalib.accuracy import errors_in_sigma
from ftdrive.cell.emulated import Station
from tests.system.command_line import CommandLine, assert_found

WORLDS = {
    "arm on a wall with a TCP set, sensor turned 137 degrees about an odd axis": (
        "robotous-serial",
        "usable",  # turned so far, the sensor has the tool behind it, as it would be with reversed torques
        ["--mount", "wall", "--tcp", "0.03,-0.02,0.15,0.4,-0.3,0.9", "--sensor-rotvec-deg", "79.1,-98.9,52.7"],
    ),
    "arm under a ceiling, base tilted by 8 degrees": (
        "robotous-serial",
        "good",
        ["--mount", "ceiling", "--tilt-deg", "8,0"],
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("world", WORLDS)
def test_odd_cells_are_recovered_within_their_sigmas(world: str, ftdrive: CommandLine) -> None:
    sensor, verdict, options = WORLDS[world]
    with Station(sensor, ["--seed", "7", *options]) as station:
        config = ftdrive.connect(station)
        answer = ftdrive.json("calibrate", "--config", config, "--quick", typed="yes\nyes\nyes\nMOVE\nyes\n")
        level = ftdrive.json("solve", ftdrive.folder / answer["run"], "--level-deg", "5")  # level as it is mounted
    assert answer["verdict"] == verdict, answer["findings"]
    result = CalibrationResult.load(ftdrive.folder / answer["run"] / "calibration.json")
    assert_found(errors_in_sigma(result, station.truth))
    codes = [[one["code"] for one in found["findings"]] for found in (level, answer)]
    assert (level["verdict"], codes[0]) == (verdict, codes[1])
