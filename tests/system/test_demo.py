"""The demo recovers the truth within its own sigmas, and its run can be replayed, solved again and shown live."""

from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pytest


class CommandLine(Protocol):
    folder: Path

    def json(self, *arguments: str | Path, typed: str = "") -> dict[str, Any]: ...


@pytest.mark.parametrize(("sensor", "seed"), [("can", 0), ("serial", 1)])
def test_demo_recovers_the_truth_and_leaves_a_run_that_repeats(sensor: str, seed: int, ftdrive: CommandLine) -> None:
    demo = ftdrive.json("demo", "--sensor", sensor, "--seed", str(seed))
    for key, errors in demo["error_in_sigma"].items():
        assert np.abs(errors).max() < 4, (key, errors)
    for key, error in demo["compensation_error"].items():
        assert error < 3 * demo["result"]["predicted_error"][key]
    assert demo["result"]["verdict"] == "good"
    run = Path(demo["run"])
    calibration = run / "calibration.json"

    again = ftdrive.json("replay", run)  # compares with the saved calibration itself
    assert again["R_flange_sensor"] == demo["result"]["R_flange_sensor"]
    solved = ftdrive.json("solve", run / "dataset.json")
    assert solved["force_bias_N"] == again["force_bias_N"]
    srom = ftdrive.json("solve", run, "--method", "srom")
    assert srom["mass_kg"] == pytest.approx(demo["truth"]["mass_kg"], abs=4 * srom["sigma"]["mass_kg"])

    for source in (["--simulate"], ["--replay", run]):
        look = ftdrive.json("live", "--calibration", calibration, *source, "--once", "--axes", "base")
        assert look["about"] == "sensor origin"
        for key, limit in (("force_N", 0.05), ("torque_Nm", 0.005)):
            assert np.abs(look["compensated"][key]).max() < limit
            assert np.abs(np.divide(look["compensated"][key], look["sigma"][key])).max() < 5
        assert np.linalg.norm(look["raw"]["force_N"]) > 1
