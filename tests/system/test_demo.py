"""The demo recovers the truth within its own sigmas, and its run can be replayed, solved again and shown live."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from ftcalib.sensor_matrix import SensorMatrix
from tests.system.command_line import CommandLine, assert_demo_found_the_truth

pytestmark = pytest.mark.slow


def test_demo_recovers_the_truth(demo: dict[str, Any]) -> None:
    assert_demo_found_the_truth(demo)


def test_known_loads_correct_the_contacts_of_a_sensor(ftdrive: CommandLine) -> None:
    shown = ftdrive.json("demo", "--loads", "--seed", "1")
    before, after = shown["contact_error"]["before"], shown["contact_error"]["after"]
    assert shown["verdict"] == "good"
    assert before["as_read_N"] > 2.0
    assert after["decoded_N"] < 0.3 * before["as_read_N"]
    assert after["decoded_N"] < 3 * after["sigma_N"]
    found = SensorMatrix.from_dict(shown["sensor"])
    error = (found.error - shown["truth"]["sensor_error"]).ravel()
    assert chi2.cdf(error @ np.linalg.solve(found.covariance[3:, 3:], error), error.size) < 0.9973, "3 sigma"
    # The loads, and not the assumed sizes, determine it.
    assert (found.sigma.diagonal() < 0.25 * SensorMatrix.usual().sigma.diagonal()).all()


def test_the_run_of_a_demo_is_replayed_to_the_same_result(demo: dict[str, Any], ftdrive: CommandLine) -> None:
    again = ftdrive.json("replay", demo["run"])  # compares with the saved calibration itself
    assert again["R_flange_sensor"] == demo["result"]["R_flange_sensor"]
    solved = ftdrive.json("solve", Path(demo["run"]) / "dataset.json")
    assert solved["force_bias_N"] == again["force_bias_N"]


@pytest.mark.parametrize("source", ["--simulate", "--replay"])
def test_the_calibration_of_a_demo_compensates_live(source: str, demo: dict[str, Any], ftdrive: CommandLine) -> None:
    run = Path(demo["run"])
    wrenches, path = ([source], run) if source == "--simulate" else ([source, run], run / "calibration.json")
    look = ftdrive.json("live", "--calibration", path, *wrenches, "--once", "--axes", "base")
    assert look["about"] == "sensor origin"
    for key, limit in (("force_N", 0.05), ("torque_Nm", 0.005)):
        assert np.abs(look["compensated"][key]).max() < limit
        assert np.abs(np.divide(look["compensated"][key], look["sigma"][key])).max() < 6
    assert np.linalg.norm(look["raw"]["force_N"]) > 1
