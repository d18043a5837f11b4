"""A session compares its result with the described cell, before the tour, during it and at the end alike."""

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ftcalib import CalibrationResult
from ftcalib.judge import described_cell
from ftdrive.cell.config import SensorConfig, ToolConfig
from ftdrive.runs.pose_hints import hints
from ftdrive.runs.run import Run
from ftdrive.runs.source import circumstances_of, solve_records
from ftdrive.session.events import Noted, PoseTaken, Weighed
from ftdrive.session.open_session import SessionOptions
from ftdrive.session.preflight import check_total_payload
from ftdrive.session.session import Calibrating, describe_run
from ftdrivers.clock import REAL
from tests.edited_files import edit
from tests.fake_clock import FakeClock
from tests.unit.ftdrive.fake_cell import Lab

MEASURED_KG = 1.2 * 9.81 / 9.80665
"""Of the fake cell."""


def payload_notes(lab: Lab) -> list[str]:
    return [event.words for event in lab.operator.of(Noted) if "payload" in event.words]


@pytest.mark.parametrize("payload_kg", np.arange(0.1, 4.0, 0.3))
def test_the_limit_is_that_of_the_check_before_the_tour(payload_kg: float, lab: Lab) -> None:
    lab.cell = replace(
        lab.cell,
        sensor=SensorConfig("fake://", mass_kg=0.3),
        tool=ToolConfig(cylinders_mm=((0.0, 200.0, 100.0),), mass_kg=1.7),
    )
    lab.arm.set_status(payload_kg=float(payload_kg), p_flange_payload_m=None)
    before: Any = SimpleNamespace(cell=lab.open_cell(), config=lab.cell, task=SimpleNamespace(load=None))
    assert (check_total_payload(before).state == "ok") == (described_cell.payload(float(payload_kg), 1.7, 0.3) == [])


@pytest.mark.slow
def test_a_wrong_payload_is_noted_once_when_the_fit_knows_and_is_the_first_finding(lab: Lab) -> None:
    lab.arm.set_status(payload_kg=2.5)
    outcome = lab.calibrate()
    assert outcome is not None
    first = outcome.result.findings[0]
    assert (outcome.result.verdict, first.code) == ("usable", "payload_mismatch")
    assert (first.values["payload_kg"], first.values["load_kg"]) == (2.5, pytest.approx(MEASURED_KG, abs=0.001))
    assert payload_notes(lab) == [first.words]
    (noted,) = (event for event in lab.operator.of(Noted) if event.words == first.words)
    before = lab.operator.shown[: lab.operator.shown.index(noted)]
    assert [event.stop for event in before if isinstance(event, PoseTaken)] == [1, 2, 3, 4, 5, 6]
    (weighed,) = lab.operator.of(Weighed)
    assert weighed.mass_kg == pytest.approx(MEASURED_KG, abs=0.05)
    assert lab.holds() == []
    carried = lab.arm.status().p_flange_payload_m
    assert carried is not None
    assert outcome.result.provenance["setup"]["p_flange_payload_m"] == list(carried)
    assert hints(outcome.result, outcome.run.records()) == ()


def test_a_run_whose_payload_is_right_in_pounds_is_not_good(lab: Lab) -> None:
    lab.arm.set_status(payload_kg=1.2 * 4.448)
    outcome = lab.calibrate()
    assert outcome is not None
    assert (outcome.result.verdict, outcome.result.findings[0].code) == ("usable", "payload_units")
    assert ["lbf", "N·m"] in outcome.result.findings[0].values["units"]


@pytest.mark.slow
def test_a_payload_that_was_corrected_before_the_run_goes_on_is_no_longer_reported(lab: Lab) -> None:
    lab.arm.set_status(payload_kg=2.5)
    assert lab.calibrate() is not None
    assert payload_notes(lab)
    run = lab.run()
    with (run.folder / "events.ndjson").open("a") as file:
        file.write('{"event": "weigh')  # the power went
    lab.operator.shown.clear()
    lab.arm.set_status(payload_kg=1.3)
    again = lab.calibrate(resume=run.folder, redo=(4,))
    assert again is not None
    assert payload_notes(lab) == []
    assert [one.code for one in again.result.findings] == ["gain_unknown"]
    saved = json.loads(run.calibration_path.read_text())
    known = {"payload_kg": 1.3, "sensor_mass_kg": None, "mounting": "floor", "height_mm": None, "tool_mass_kg": None}
    assert (known | {"cylinders_mm": [[0.0, 200.0, 100.0]]}).items() <= saved["provenance"]["setup"].items()


@pytest.mark.slow
def test_a_session_saves_no_result_as_good_whose_tool_is_elsewhere_unless_it_was_not_measured(lab: Lab) -> None:
    lab.cell = replace(lab.cell, sensor=SensorConfig("fake://", height_mm=180.0, accuracy_percent=1.0))
    assert lab.calibrate() is not None
    saved = CalibrationResult.load(lab.run().calibration_path)
    assert (saved.verdict, saved.findings[0].code) == ("usable", "com_outside_tool")
    edit(lab.run().folder / "run.json", lambda header: header["config"]["workcell"].update(measured=False))
    assert solve_records(lab.run(), lab.run().records()).result.verdict == "good"


def test_a_cell_with_a_clock_of_its_own_marks_its_results_as_emulated(lab: Lab) -> None:
    options = SessionOptions(lab.folder)
    for clock, station in ((FakeClock(), {}), (REAL, None)):
        description = describe_run(Calibrating(replace(lab.cell, clock=clock), options), options, {})
        assert circumstances_of(Run.create(lab.folder, "r", description)).origin["station"] == station
