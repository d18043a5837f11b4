"""A result that contradicts the described cell is at best usable, and says why."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, Parameters, solve
from ftcalib.model import predict
from ftcalib.poses.information import special
from ftdrive.cell.config import SensorConfig
from ftdrive.checks.plausibility import com_in_words, judged
from ftdrive.runs.outcome import solve_records
from tests.edited_files import edit
from tests.unit.ftdrive.fake_cell import Lab

Array = NDArray[np.float64]

SIGMA = np.repeat([0.01, 0.0005], 3)
R_FLANGE_SENSOR = Rotation.from_rotvec([0.0, 0.0, 0.7]).as_matrix()
COM_FLANGE_MM = np.array([12.0, -5.0, 60.0])
"""From the sensor, which is 40 mm above the flange."""
WEIGHT_N = 15.0
TOOL = {"cylinders_mm": [[0.0, 160.0, 80.0]], "height_mm": 40.0, "mounting": "floor"}


@cache
def result(mass_factor: float = 1.0, com_sign: int = 1, gravity: str = "down") -> CalibrationResult:
    F_b = WEIGHT_N * mass_factor * np.array({"down": [0, 0, -1.0], "aside": [1.0, 0, 0], "up": [0, 0, 1.0]}[gravity])
    com_m = com_sign * R_FLANGE_SENSOR.T @ COM_FLANGE_MM / 1e3
    truth = Parameters(R_FLANGE_SENSOR, F_b, np.array([1.0, 2, 3]), com_m, np.array([0.1, 0.2, 0.3]))
    R = special(range(1, 25))
    wrench = predict(truth, R) + SIGMA * np.random.default_rng(3).normal(size=(24, 6))
    cov = np.tile(np.diag(SIGMA**2), (24, 1, 1))
    return solve(CalibrationDataset(R, wrench, cov, np.full(24, 100), np.arange(24.0)))


def with_setup(given: CalibrationResult, **setup: Any) -> CalibrationResult:
    return replace(given, provenance={"setup": setup})


def test_a_result_that_agrees_with_the_cell_is_left_as_it_is() -> None:
    for setup in ({}, TOOL, TOOL | {"height_mm": None}, {"tool_mass_kg": 1.4, "payload_kg": 1.7}):
        given = with_setup(result(), **setup)
        assert judged(given) is given
        assert given.verdict == "good"
    assert judged(result()) is result()  # of a CSV file


@pytest.mark.parametrize(
    ("cylinder", "height_mm", "outside_mm"),
    [
        ([0.0, 70.0, 80.0], 40.0, 30),  # beyond the tip
        ([0.0, 70.0, 80.0], None, 0),  # the sensor may be at the flange face
        ([0.0, 40.0, 80.0], None, 20),
        ([0.0, 160.0, 80.0, 72.0, -5.0], 40.0, 20),  # beside it
        ([120.0, 160.0, 80.0], 40.0, 20),  # below it
        ([0.0, 95.0, 80.0], 40.0, 0),  # within the margin
    ],
)
def test_a_centre_of_mass_outside_the_described_tool_is_named(
    cylinder: list[float], height_mm: float | None, outside_mm: float
) -> None:
    setup = {"cylinders_mm": [cylinder], "height_mm": height_mm}
    words, surely = com_in_words(result(), setup)
    assert not surely
    assert bool(words) == bool(outside_mm)
    if outside_mm:
        assert float(words.partition("lies ")[2].partition(" mm")[0]) == pytest.approx(outside_mm, abs=1)
        found = judged(with_setup(result(), **setup))
        assert (found.verdict, found.reasons[0]) == ("usable", words)


def test_a_centre_of_mass_between_two_cylinders_is_inside_their_hull() -> None:
    fingers = [[0.0, 200.0, 20.0, 40.0, 0.0], [0.0, 200.0, 20.0, -40.0, 0.0], [0.0, 40.0, 80.0]]
    assert com_in_words(result(), {"cylinders_mm": fingers, "height_mm": 40.0}) == ("", False)


def test_a_centre_of_mass_far_outside_is_rejected_and_units_are_named() -> None:
    com = solved_with_com(4.448)
    found = judged(with_setup(com, **TOOL))
    assert found.verdict == "rejected"
    assert "forces in lbf" in found.reasons[0]
    assert judged(with_setup(com, **TOOL | {"cylinders_mm": []})).verdict == "good"


def solved_with_com(factor: float) -> CalibrationResult:
    given = result()
    return replace(given, parameters=replace(given.parameters, p_sensor_com_m=factor * given.p_sensor_com_m))


def test_reversed_torques_come_before_what_they_put_outside() -> None:
    found = judged(with_setup(result(com_sign=-1), **TOOL | {"cylinders_mm": [[40.0, 160.0, 80.0]]}))
    assert found.verdict == "usable"
    assert "torques are reversed" in found.reasons[0]
    assert "outside the tool" in found.reasons[1]


@pytest.mark.parametrize(
    ("factor", "says"),
    [
        (1.0, ""),
        (1.25, ""),
        (0.6, "[tool] mass_kg is 1.53 kg: check"),
        (1 / 4.448, "as with forces in lbf"),
        (1000.0, "as with forces in mN and torques in N·mm"),
    ],
)
def test_a_mass_unlike_the_described_tool_is_named(factor: float, says: str) -> None:
    given = with_setup(result(factor), tool_mass_kg=WEIGHT_N / 9.80665)
    if given.verdict == "rejected":  # 1000 times too heavy is named without a tool
        assert "forces in mN and torques in N·mm" in given.reasons[0]
        assert judged(given) is given
        return
    found = judged(given)
    assert (found.verdict == "good") == (not says)
    assert not says or says in found.reasons[0]


def test_a_payload_unlike_the_load_is_named_with_what_to_set() -> None:
    found = judged(with_setup(result(), payload_kg=3.0, sensor_mass_kg=0.4))
    assert found.verdict == "usable"
    assert "set the payload in PolyScope: 1.93 kg" in found.reasons[0]
    pounds = with_setup(result(), payload_kg=1.53 * 4.448, sensor_mass_kg=None)
    assert judged(pounds) is pounds  # the solver names units, from `payload_kg`


@pytest.mark.parametrize(("gravity", "says"), [("down", None), ("aside", "90° off the direction"), ("up", None)])
def test_gravity_far_from_the_configured_mounting_is_named(gravity: str, says: str | None) -> None:
    given = with_setup(result(gravity=gravity), mounting="floor")
    found = judged(given)
    assert (found is given) == (says is None)
    assert found.verdict == ("good" if gravity == "down" else "usable")
    if says:
        assert says in found.reasons[0]
    wall = with_setup(result(gravity="aside"), mounting="-90")
    assert judged(wall) is wall


def test_a_rejected_result_is_left_as_it_is() -> None:
    given = with_setup(replace(result(), verdict="rejected"), payload_kg=9.0)
    assert judged(given) is given


def test_a_session_saves_no_such_result_as_good(lab: Lab) -> None:
    lab.cell = replace(lab.cell, sensor=SensorConfig("fake://", height_mm=180.0))
    outcome = lab.calibrate()
    assert outcome is not None
    saved = CalibrationResult.load(outcome.run.calibration_path)
    assert saved.verdict == "usable"
    assert "outside the tool of [tool] cylinders_mm" in saved.reasons[0]


def test_a_tool_that_was_not_measured_is_no_reason(lab: Lab) -> None:
    lab.cell = replace(lab.cell, sensor=SensorConfig("fake://", height_mm=180.0))
    lab.calibrate()
    edit(lab.run().folder / "run.json", lambda header: header["config"]["workcell"].update(measured=False))
    assert solve_records(lab.run(), lab.run().records()).result.verdict == "good"
