"""What is checked before anything moves, on the fake cell: each finding is refused with its words."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.errors import StreamBroken
from drivers.interfaces import ArmState
from ftdrive.config import ToolConfig, WorkcellConfig
from ftdrive.errors import NotAccepted
from ftdrive.session import preflight
from ftdrive.session.events import (
    Checked,
    Noted,
)
from tests.unit.fake_cell import Lab


def refuse(lab: Lab, words: str) -> None:
    with pytest.raises(NotAccepted, match=words):
        lab.calibrate()
    assert lab.arm.moves == []
    assert lab.operator.asked == []


def test_a_workcell_nobody_measured_is_refused(lab: Lab) -> None:
    lab.cell = replace(lab.cell, workcell=WorkcellConfig())
    refuse(lab, "measured = true")


@pytest.mark.parametrize(
    ("different", "words"),
    [
        ({"fault": "protective stop: clear it", "safety_mode": "protective stop"}, "protective stop"),
        ({"payload_kg": 0.0}, "nothing hangs"),
        (
            {"p_flange_payload_m": (0.0, 0.0, -0.15)},
            r"centre at \(0, 0, -150\) mm from the flange, where the tool is not",
        ),
        ({"p_flange_payload_m": (0.3, 0.0, 0.05)}, r"centre at \(300, 0, 50\) mm"),
    ],
)
def test_a_controller_that_is_not_ready_is_refused(different: dict[str, Any], words: str, lab: Lab) -> None:
    lab.arm.set_status(**different)
    refuse(lab, words)


def test_a_tour_that_would_wind_up_the_cable_is_refused(lab: Lab, tmp_path: Path) -> None:
    lab.arm.q[5] = np.radians(-90)
    made_there = tmp_path / "there.json"
    assert lab.calibrate(dry_run=True, output=made_there) is None
    assert "wrist 3 stands at -90°" in next(e.words for e in lab.operator.of(Checked) if e.name == "cable")
    lab.arm.q[5] = np.radians(160)
    lab.operator.told.clear()
    refuse_plan = pytest.raises(NotAccepted, match=r"wrist 3 stands at 160°.*jog it to between -?\d+° and -?\d+°")
    with refuse_plan:
        lab.calibrate(plan=made_there)
    assert lab.arm.moves == []


def test_a_payload_that_is_not_that_of_the_tool_is_refused(lab: Lab) -> None:
    lab.cell = replace(lab.cell, tool=replace(lab.cell.tool, mass_kg=3.0))
    refuse(lab, "1.50 kg, sensor and tool are 3.00 kg")


def test_a_pose_the_controller_forbids_is_refused(lab: Lab) -> None:
    assert lab.calibrate(dry_run=True) is None
    lab.arm.forbidden = lab.arm.q.round(12)
    lab.arm.within_safety_limits = lambda q_rad: q_rad[4] < 2.0  # type: ignore[method-assign]  # this arm only
    refuse(lab, "safety limits forbid")


def test_another_model_or_tcp_is_refused(lab: Lab) -> None:
    right = lab.arm.state

    def elsewhere() -> ArmState:
        state = right()
        return replace(state, p_base_flange_m=np.add(state.p_base_flange_m, [0, 0, 0.02]))

    lab.arm.state = elsewhere  # type: ignore[method-assign]  # this arm only
    refuse(lab, "check the model and the active TCP")


def test_a_stuck_sensor_is_refused(lab: Lab) -> None:
    lab.sensor.stuck = True
    refuse(lab, "did not change")


def test_a_sensor_that_stumbles_once_is_opened_again(lab: Lab) -> None:
    def stumble() -> None:
        lab.sensor.collecting = lambda: None
        raise StreamBroken("a write took too long")

    lab.sensor.collecting = stumble
    assert lab.calibrate(dry_run=True) is None
    assert "trying once more" in " ".join(event.words for event in lab.operator.of(Noted))
    lab.sensor.failure = StreamBroken("gone for good")
    with pytest.raises(StreamBroken):
        lab.calibrate(dry_run=True)


def test_a_folder_that_cannot_be_written_is_refused(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(**_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(preflight, "TemporaryFile", full)
    refuse(lab, "No space left")


def test_a_plan_for_another_tool_is_refused(lab: Lab) -> None:
    lab.calibrate()
    plan = lab.run().plan_path
    lab.arm.moves.clear()
    lab.operator.asked.clear()
    lab.cell = replace(lab.cell, tool=ToolConfig(cylinders_mm=((0.0, 210.0, 100.0),)))
    with pytest.raises(NotAccepted, match="another tool"):
        lab.calibrate(plan=plan)
    assert lab.arm.moves == []
