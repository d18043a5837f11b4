"""The sensor in the arm's wrist with the zero of a real one, about 25,400 N, and a range that is far smaller."""

import json

import pytest

from ftdrive.cell.emulated import Station
from tests.system.command_line import CommandLine

pytestmark = pytest.mark.slow

ANSWERS = "yes\nyes\nyes\nMOVE\nyes\n"


def test_a_range_holds_for_changes_in_every_command(ftdrive: CommandLine) -> None:
    with Station("ur-ft", ["--seed", "5", "--kinematics", "ideal", "--imperfections", "wrist_drift_N=0"]) as station:
        config = ftdrive.connect(station)
        config.write_text(config.read_text().replace("counts_per_Nm=1", "counts_per_Nm=1&range=50,10"))
        outcome = ftdrive.run("calibrate", "--quick", "--config", config, "--json", typed=ANSWERS)
        assert outcome.returncode == 0, outcome.stderr
        calibrated = json.loads(outcome.stdout.splitlines()[-1])
        assert calibrated["verdict"] != "rejected"
        run = calibrated["run"]
        verified = ftdrive.run(
            *("verify", "--quick", "--calibration", run, "--config", config, "--json"),
            *("--max-force", "0.5", "--max-torque", "0.02"),
            typed=ANSWERS,
        )
        assert verified.returncode == 0, verified.stderr
        for command in ("live", "weigh"):
            shown = ftdrive.run(command, "--once", "--json", "--calibration", run, "--config", config)
            assert shown.returncode == 0, shown.stderr
        assert abs(json.loads(shown.stdout)["mass_kg"]) < 0.05
