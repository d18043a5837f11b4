"""Verifications on an emulated cell: an unchanged cell passes, a change is named, an update names its parent."""

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from ftcalib import CalibrationResult
from ftcalib.accuracy import compensation_error
from ftdrive.cell.emulated import Station
from ftdrive.session.rehearsal import NoOperator, rehearse
from tests.system.command_line import CommandLine

pytestmark = pytest.mark.slow

ANSWERS = "yes\nyes\nyes\nMOVE\nyes\n"
"""Three safety questions, the word for the first motion, the beginning of the tour."""

LIMITS = ("--max-force", "0.2", "--max-torque", "0.02")
"""Far above the noise: the prediction itself fails one unchanged cell in a hundred."""


@pytest.fixture
def station() -> Iterator[Station]:
    with Station("robotous-serial", ["--seed", "5"]) as station:
        yield station


def test_the_cell_of_a_calibration_passes(demo: dict[str, Any], ftdrive: CommandLine) -> None:
    arguments = ("--calibration", demo["run"], "--simulate", "--quick", "--yes")
    answer = ftdrive.json("verify", *arguments, *LIMITS)
    assert answer["passed"]
    assert answer["calibration"]["id"] == demo["result"]["id"]
    assert [len(pose["residual"]) for pose in answer["poses"]] == [6, 6]


def test_a_bias_step_and_another_payload_are_named(station: Station, ftdrive: CommandLine) -> None:
    calibrated = rehearse(station, ftdrive.folder / "runs", "calibrate", NoOperator(), poses=6)
    config, parent = ftdrive.connect(station), calibrated.run.calibration_path
    station.control(do="drift", force_N=[0.3, 0.4, 0.0], seconds=0.01)
    outcome = ftdrive.run(
        "verify", "--quick", "--calibration", parent, "--config", config, "--json", typed=f"{ANSWERS}yes\n"
    )
    assert outcome.returncode == 7, outcome.stderr
    answer = json.loads(outcome.stdout.splitlines()[-1])
    assert (answer["passed"], answer["change"], answer["update"]) == (False, "bias", "bias")
    assert "bias" in outcome.stderr
    saved_in = ftdrive.folder / answer["saved"]
    saved = CalibrationResult.load(saved_in)
    assert saved.provenance["parent"] == {"id": calibrated.result.id, "path": str(parent)}
    step, sigma = saved.force_bias_N - calibrated.result.force_bias_N, np.asarray(saved.sigma["force_bias_N"])
    assert np.abs((step - [0.3, 0.4, 0.0]) / sigma).max() < 6
    truth = dict(station.truth, force_bias_N=np.add(station.truth["force_bias_N"], [0.3, 0.4, 0.0]))
    assert compensation_error(saved, truth)["force_rms_N"] < 0.05
    reading = ftdrive.run("live", "--once", "--json", "--calibration", parent, "--config", config)
    assert reading.returncode == 0, reading.stderr
    assert "VERIFICATION FAILED" in reading.stderr
    assert json.loads(reading.stdout)["verification"]["change"] == "bias"

    station.control(do="payload-shift", mass_kg=station.truth["mass_kg"] + 0.05)
    arguments = ("--calibration", saved_in, "--config", config, "--yes", "--update", "no", "--json")
    again = ftdrive.run("verify", "--quick", *arguments, typed=ANSWERS)
    assert again.returncode == 7, again.stderr
    answer = json.loads(again.stdout.splitlines()[-1])
    assert "payload" in (answer["change"], *answer["alternatives"])
    assert (answer["calibration"]["id"], answer["saved"]) == (saved.id, None)
