"""Differences between the controller's settings and identified values: the payload, the mounting of the base."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, Parameters, solve
from ftcalib.model import predict
from ftcalib.poses.information import special
from ftdrive.cell.config import SensorConfig, ToolConfig
from ftdrive.checks.controller_settings import LEAN_DEG, lean_in_words, mismatches, payload_in_words
from ftdrive.planning.geometry.scene import Scene, lean_of
from ftdrive.runs.pose_hints import hints
from ftdrive.session.events import Noted, PoseTaken, Weighed
from ftdrive.session.preflight import Before, check_payload
from tests.unit.ftdrive.fake_cell import Lab

Array = NDArray[np.float64]

SURE = np.eye(3) * 0.001**2
WEIGHT_N = 12.0
MEASURED_KG = 1.2 * 9.81 / 9.80665
"""Of the fake cell."""


# ------------------------------------------------------------------------------------------------------------- the lean


def base_on(mounting: str) -> Array:
    """(3, 3) R_world_base of an arm that is mounted exactly so, world z up; its turn about the vertical is any."""
    down = Scene(lean_rad=lean_of(mounting)).down_base
    other = np.array([0.0, 1.0, 0.0])
    return np.array([np.cross(other, -down), other, -down])


@pytest.mark.parametrize("mounting", ["floor", "ceiling", "wall", "30"])
@pytest.mark.parametrize("heading_deg", range(0, 360, 15))
def test_the_low_side_is_named(mounting: str, heading_deg: float) -> None:
    # Tip the mounted base over the horizontal direction `heading` of the world, as a floor that gives way there.
    heading = np.radians(heading_deg)
    hinge = np.cross([0, 0, 1], [np.cos(heading), np.sin(heading), 0])
    R_world_base = Rotation.from_rotvec(np.radians(0.8) * hinge).as_matrix() @ base_on(mounting)
    gravity_base_N = R_world_base.T @ [0, 0, -WEIGHT_N]
    words = lean_in_words(gravity_base_N, SURE, mounting)
    assert "leans 0.80° (sigma 0.00°) towards its" in words
    named = words.partition("towards its ")[2].partition(",")[0].split(" and ")
    side = sum((-1 if name[0] == "-" else 1) * np.eye(3)["xyz".index(name[1])] for name in named)
    # A point on that side has sunk from where a true mounting would have it, nearly as far as any point could.
    sunk = (base_on(mounting) @ side - R_world_base @ side)[2] / np.linalg.norm(side)
    assert sunk > np.cos(np.radians(31)) * np.sin(np.radians(0.8))


def test_an_arm_on_a_floor_that_falls_towards_plus_x_leans_there() -> None:
    # Turned about +y by the right hand, z goes towards +x: the arm tips over its front.
    R_world_base = Rotation.from_euler("y", 0.8, degrees=True).as_matrix()
    words = lean_in_words(R_world_base.T @ [0, 0, -WEIGHT_N], SURE, "floor")
    assert "0.80° (sigma 0.00°) towards its +x" in words
    assert "[workcell] mounting (floor)" in words


def test_a_base_that_is_level_or_may_be_is_not_mentioned() -> None:
    def leaning(angle_deg: float, sigma_N: float) -> str:
        gravity_N = WEIGHT_N * np.array([np.sin(np.radians(angle_deg)), 0, -np.cos(np.radians(angle_deg))])
        return lean_in_words(gravity_N, np.eye(3) * sigma_N**2, "floor")

    assert leaning(0, 0.001) == ""
    assert leaning(0.9 * LEAN_DEG, 0.001) == ""
    assert leaning(1.1 * LEAN_DEG, 0.001)
    one_deg_N = WEIGHT_N * np.radians(1)
    assert leaning(1, one_deg_N / 3.9) == ""
    assert "leans 1.00° (sigma 0.24°)" in leaning(1, one_deg_N / 4.1)


@pytest.mark.parametrize(("mounting", "off_deg"), [("wall", 90), ("ceiling", 180), ("15", 15)])
def test_another_mounting_is_no_lean(mounting: str, off_deg: int) -> None:
    words = lean_in_words(np.array([0, 0, -WEIGHT_N]), SURE, mounting)
    assert words.startswith(f"gravity is {off_deg}° off")
    assert "leans" not in words


# ---------------------------------------------------------------------------------------------------------- the payload


@pytest.mark.parametrize(
    ("payload_kg", "weighed_kg", "sensor_kg", "fits"),
    [
        (1.50, 0.64, None, False),  # 0.86 kg off, which no usual sensor explains
        (1.40, 0.64, None, True),
        (1.40, 0.64, 0.1, False),
        (0.10, 0.64, None, False),
        (0.20, 0.64, None, True),  # smaller by the limit: a sensor cannot weigh less than nothing
        (0.20, 0.64, 0.1, False),
        (6.4, 5.0, 0.1, True),  # 30 %
        (6.7, 5.0, 0.1, False),
    ],
)
def test_a_payload_is_compared_with_all_that_hangs_on_the_flange(
    payload_kg: float, weighed_kg: float, sensor_kg: float | None, fits: bool
) -> None:
    words = payload_in_words(payload_kg, weighed_kg, sensor_kg)
    assert (words == "") is fits
    if fits:
        return
    assert f"{payload_kg:.2f} kg" in words
    assert f"{weighed_kg:.2f} kg hang on the sensor" in words
    cure = weighed_kg + (sensor_kg or 0)
    assert f"set the payload in PolyScope: {cure:.2f} kg" in words
    assert ("[sensor] mass_kg" in words) is (sensor_kg is None)


@pytest.mark.parametrize("sensor_kg", [None, 0.3])
def test_no_payload_is_advised_that_would_be_right_in_pounds(sensor_kg: float | None) -> None:
    words = payload_in_words(1.5 + (sensor_kg or 0), 1.5 / 4.448, sensor_kg)
    assert "0.34 kg hang on the sensor, as with forces in lbf: check the sensor's units" in words
    assert "set the payload" not in words


@pytest.mark.parametrize("payload_kg", np.arange(0.1, 4.0, 0.07))
def test_the_limit_is_that_of_the_check_before_the_tour(payload_kg: float, lab: Lab) -> None:
    lab.cell = replace(
        lab.cell,
        sensor=SensorConfig("fake://", mass_kg=0.3),
        tool=ToolConfig(cylinders_mm=((0.0, 200.0, 100.0),), mass_kg=1.7),
    )
    lab.arm.set_status(payload_kg=float(payload_kg), p_flange_payload_m=None)
    nothing: Any = None
    before = Before(lab.open_cell(), lab.cell, *[nothing] * 7)
    fits = payload_in_words(float(payload_kg), 1.7, 0.3) == ""
    assert (check_payload(before).state == "ok") == fits


def test_the_final_report_says_both_unless_the_result_is_refused() -> None:
    truth = Parameters(np.eye(3), np.array([0.2, 0.0, -11.0]), np.zeros(3), np.array([0.0, 0.0, 0.06]), np.zeros(3))
    R = special(range(1, 25))
    wrench = predict(truth, R) + np.random.default_rng(3).normal(size=(24, 6)) * np.repeat([0.01, 0.001], 3)
    cov = np.tile(np.diag(np.repeat([0.01, 0.001], 3) ** 2), (24, 1, 1))
    dataset = CalibrationDataset(R, wrench, cov, np.full(24, 100), np.arange(24.0), {})

    def result(provenance: dict[str, Any]) -> CalibrationResult:
        return solve(dataset, provenance=provenance)

    setup = {"payload_kg": 3.0, "sensor_mass_kg": 0.4, "mounting": "floor"}
    payload, lean = mismatches(result({"setup": setup}))
    assert "in PolyScope: 1.52 kg" in payload
    assert float(lean.partition("leans ")[2].partition("°")[0]) == pytest.approx(1.04, abs=0.04)
    assert "towards its +x" in lean
    assert mismatches(result({"setup": dict.fromkeys(setup)})) == ()
    assert mismatches(result({})) == ()
    assert mismatches(replace(result({"setup": setup}), verdict="rejected")) == ()


# --------------------------------------------------------------------------------------------------------- in a session


def test_a_wrong_payload_is_told_once_when_the_fit_knows_and_at_the_end(lab: Lab) -> None:
    lab.arm.set_status(payload_kg=2.5)
    outcome = lab.calibrate()
    words = [event for event in lab.operator.shown if isinstance(event, Noted) and "PolyScope" in event.words]
    assert len(words) == 1
    assert words[0].warning
    assert "2.50 kg, but 1.20 kg hang" in words[0].words
    before = lab.operator.shown[: lab.operator.shown.index(words[0])]
    assert [event.stop for event in before if isinstance(event, PoseTaken)] == [1, 2, 3, 4, 5, 6]
    (weighed,) = lab.operator.of(Weighed)
    assert weighed.mass_kg == pytest.approx(MEASURED_KG, abs=0.05)
    assert lab.holds() == []
    assert outcome is not None
    carried = lab.arm.status().p_flange_payload_m
    assert carried is not None
    assert outcome.result.provenance["setup"]["p_flange_payload_m"] == list(carried)
    assert outcome.result.verdict == "usable"
    assert outcome.result.reasons[0] == words[0].words
    assert hints(outcome.result, outcome.run.records()) == ()


def test_a_run_whose_payload_is_right_in_pounds_is_not_good(lab: Lab) -> None:
    lab.arm.set_status(payload_kg=1.2 * 4.448)
    outcome = lab.calibrate()
    assert outcome is not None
    assert outcome.result.verdict == "usable"
    assert outcome.result.reasons[0].startswith("the load is 1.20 kg, but 5.34 kg by the payload in the controller")
    assert "as with forces in lbf" in outcome.result.reasons[0]


@pytest.mark.parametrize(
    ("payload_kg", "sensor_kg", "reported"), [(1.9, 0.8, False), (1.9, None, False), (2.8, 0.8, True)]
)
def test_the_mass_of_the_sensor_counts(payload_kg: float, sensor_kg: float | None, reported: bool, lab: Lab) -> None:
    lab.cell = replace(lab.cell, sensor=SensorConfig("fake://", mass_kg=sensor_kg))
    lab.arm.set_status(payload_kg=payload_kg)
    outcome = lab.calibrate()
    assert ("PolyScope: 2.00 kg" in lab.said()) is reported
    assert outcome is not None
    assert any("payload" in one for one in outcome.result.reasons) is reported
    assert (outcome.result.verdict == "good") is not reported


@pytest.mark.slow
def test_a_run_goes_on_with_the_mass_of_the_sensor_as_it_is_known_now(lab: Lab) -> None:
    lab.arm.set_status(payload_kg=2.8)
    lab.calibrate()
    assert "PolyScope" in lab.said()
    lab.operator.shown.clear()
    lab.cell = replace(lab.cell, sensor=SensorConfig("fake://", mass_kg=1.6))
    lab.calibrate(resume=lab.run().folder, redo=(4,))
    assert "PolyScope" not in lab.said()


def test_a_controller_that_does_not_report_its_payload_is_not_compared(lab: Lab) -> None:
    lab.arm.set_status(payload_kg=None)
    lab.calibrate()
    assert lab.operator.of(Weighed) == []
    assert "PolyScope" not in lab.said()


@pytest.mark.slow
def test_a_payload_that_was_corrected_before_the_run_goes_on_is_no_longer_reported(lab: Lab) -> None:
    lab.arm.set_status(payload_kg=2.5)
    outcome = lab.calibrate()
    assert outcome is not None
    assert "2.50 kg" in lab.said()
    run = lab.run()
    with (run.folder / "events.ndjson").open("a") as file:
        file.write('{"event": "weigh')  # the power went
    lab.operator.shown.clear()
    lab.arm.set_status(payload_kg=1.3)
    again = lab.calibrate(resume=run.folder, redo=(4,))
    assert "PolyScope" not in lab.said()
    assert again is not None
    assert not any("payload" in one for one in again.result.reasons)
    saved = json.loads(run.calibration_path.read_text())
    known = {"payload_kg": 1.3, "sensor_mass_kg": None, "mounting": "floor", "height_mm": None, "tool_mass_kg": None}
    assert (known | {"cylinders_mm": [[0.0, 200.0, 100.0]]}).items() <= saved["provenance"]["setup"].items()
