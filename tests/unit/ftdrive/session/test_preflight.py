"""What is checked before anything moves, on the fake cell: each finding is refused with its words."""

from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ftdrive.cell.config import ToolConfig
from ftdrive.checks.check import Check
from ftdrive.errors import NotAccepted
from ftdrive.session import preflight
from ftdrive.session.events import Checked, Noted
from ftdrivers.errors import StreamBroken
from ftdrivers.interfaces import ArmState, DeviceInfo, Fact
from tests.unit.ftdrive.fake_cell import Lab
from tests.unit.ftdrive.session.scenarios import Action, status


def refuse(lab: Lab, words: str) -> None:
    with pytest.raises(NotAccepted, match=words):
        lab.take_poses()
    assert lab.arm.moves == []
    assert lab.operator.asked == []


def describe(section: str, **different: Any) -> Action:
    """Return the action that changes a section of the cell's configuration."""
    return lambda lab: setattr(
        lab, "cell", replace(lab.cell, **{section: replace(getattr(lab.cell, section), **different)})
    )


def forbid_a_pose(lab: Lab) -> None:
    lab.arm.within_safety_limits = lambda q_rad: q_rad[4] < 2.0  # type: ignore[method-assign]  # this arm only


def report_another_flange(lab: Lab) -> None:
    right = lab.arm.state

    def elsewhere() -> ArmState:
        state = right()
        return replace(state, p_base_flange_m=np.add(state.p_base_flange_m, [0, 0, 0.02]))

    lab.arm.state = elsewhere  # type: ignore[method-assign]  # this arm only


def read_beyond_the_range(lab: Lab) -> None:
    facts = {"range": Fact((50.0,) * 3 + (10.0,) * 3, "configured")}
    lab.sensor.identify = lambda: DeviceInfo("fake", "S1", "1", facts)  # type: ignore[method-assign]
    lab.sensor.push = np.array([0, 0, 25_400.0, 0, 0, 0])


REFUSED: dict[str, tuple[Action, str]] = {
    "a workcell that was not measured": (describe("workcell", measured=False), "measured = true"),
    "a protective stop": (status("protective stop"), "protective stop"),
    "no payload": (status(payload_kg=0.0), "no payload is set"),
    "a payload behind the flange": (status(p_flange_payload_m=(0.0, 0.0, -0.15)), r"\(0, 0, -150\) mm"),
    "a payload beside the tool": (status(p_flange_payload_m=(0.3, 0.0, 0.05)), r"\(300, 0, 50\) mm"),
    "a payload that is not that of the tool": (
        describe("tool", mass_kg=3.0),
        "payload 1.50 kg .* sensor and tool weigh 3.00 kg",
    ),
    "a reading at rest beyond the range": (
        read_beyond_the_range,
        "at rest the sensor reads .* in Fz, 50[78].. % of its range",
    ),
    "a pose the controller forbids": (forbid_a_pose, "safety limits forbid"),
    "another model or TCP": (report_another_flange, "check the model and the active TCP"),
    "a stuck sensor": (lambda lab: setattr(lab.sensor, "stuck", True), "did not change"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_not_as_it_should_be_is_refused(what: str, lab: Lab) -> None:
    arrange, words = REFUSED[what]
    arrange(lab)
    refuse(lab, words)


def test_a_tour_that_would_wind_up_the_cable_is_refused(lab: Lab, tmp_path: Path) -> None:
    lab.arm.q[5] = np.radians(-90)
    made_there = tmp_path / "there.json"
    assert lab.take_poses(dry_run=True, output=made_there) is None
    assert "wrist 3 is at -90°" in next(e.words for e in lab.operator.of(Checked) if e.name == "cable")
    lab.arm.q[5] = np.radians(160)
    lab.operator.shown.clear()
    refuse_plan = pytest.raises(NotAccepted, match=r"160°.* -?\d+° and -?\d+°")
    with refuse_plan:
        lab.take_poses(plan=made_there)
    assert lab.arm.moves == []


@pytest.mark.parametrize(("outside_rad", "state"), [(1e-4, "ok"), (0.05, "failed")])
def test_wrist_3_at_the_end_of_its_range_may_be_outside_it_by_its_joint_noise(outside_rad: float, state: str) -> None:
    low, high = np.radians([-90.0, 180.0])
    for stands in (low - outside_rad, high + outside_rad):
        arm = SimpleNamespace(state=lambda q6=stands: SimpleNamespace(q_rad=np.array([0.0] * 5 + [q6])))
        steps = [SimpleNamespace(q_rad=(0.0,) * 5 + (q6,)) for q6 in (low, high)]
        before = SimpleNamespace(
            cell=SimpleNamespace(arm=arm), plan=SimpleNamespace(steps=steps), known=False, resumed=True
        )
        assert preflight.check_cable(cast("preflight.Before", before)).state == state


@pytest.mark.parametrize(
    ("range_N", "range_Nm", "share", "passes"),
    [
        (40.0, 10.0, 74, True),  # 2 · 1.5 kg · 9.81 m/s² = 29.4 N
        (200.0, 8.0, 74, True),  # on the 0.2 m of the tool: 5.9 N·m
        (200.0, 7.0, 84, False),
    ],
)
def test_a_tool_too_heavy_or_too_long_for_the_sensor_is_refused(
    range_N: float, range_Nm: float, share: int, passes: bool, lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits = np.array([200.0, range_N, 200, 20, 20, range_Nm])
    monkeypatch.setattr(preflight.Before, "sensor_range", limits)
    lab.cell = replace(lab.cell, tool=replace(lab.cell.tool, mass_kg=1.5))
    words = f"twice the tool's weight is {share} % of the sensor's range"
    if passes:
        assert lab.take_poses(dry_run=True) is None
        assert words in next(event.words for event in lab.operator.of(Checked) if event.name == "load")
    else:
        refuse(lab, f"{words}: use a larger sensor")


@pytest.mark.slow
def test_a_sensor_with_an_arbitrary_zero_is_calibrated_within_its_range(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    facts = {"range": Fact((50.0,) * 3 + (10.0,) * 3, "configured"), "zero": Fact("arbitrary", "assumed")}
    monkeypatch.setattr(lab.sensor, "identify", lambda: DeviceInfo("wrist", "S1", "1", facts))
    lab.sensor.push = np.array([1800.0, 400, 25_400, -76, 0, 0])
    outcome = lab.calibrate()
    assert outcome is not None
    assert outcome.result.force_bias_N == pytest.approx([1800, 400, 25_400], abs=5)


def test_another_arm_than_the_one_that_is_meant_is_refused(lab: Lab) -> None:
    lab.cell = replace(lab.cell, robot=replace(lab.cell.robot, serial="A1"))
    assert lab.take_poses(dry_run=True) is None
    lab.cell = replace(lab.cell, robot=replace(lab.cell.robot, serial="B2"))
    refuse(lab, r"the arm at fake has serial A1, but \[robot\] serial is B2")


def test_a_plan_for_another_tool_is_refused(lab: Lab) -> None:
    lab.take_poses()
    plan = lab.run().plan_path
    lab.arm.moves.clear()
    lab.operator.asked.clear()
    lab.cell = replace(lab.cell, tool=ToolConfig(cylinders_mm=((0.0, 210.0, 100.0),)))
    with pytest.raises(NotAccepted, match="another tool"):
        lab.take_poses(plan=plan)
    assert lab.arm.moves == []


@pytest.mark.parametrize(("program", "dry_run"), [("playing", True), ("paused", False)])
def test_a_program_of_another_client_is_refused_before_anything_is_done(
    program: str, dry_run: bool, lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lab.arm, "reported_program", lambda: "PLAYING pick.urp")
    lab.arm.program = program
    words = r"program is active on the controller \(PLAYING pick\.urp\): stop it on the pendant, then start again"
    with pytest.raises(NotAccepted, match=words):
        lab.take_poses(dry_run=dry_run)
    assert (lab.arm.opened, lab.arm.moves, lab.operator.asked) == (1, [], [])


def test_a_program_that_goes_on_is_none_that_was_left_behind(lab: Lab) -> None:
    lab.arm.program = "playing"
    lab.clock.at(1.6, lambda: setattr(lab.arm, "program", "stopped"))
    with pytest.raises(NotAccepted):
        lab.take_poses(dry_run=True)


def test_an_old_controller_is_controlled_from_the_start_because_it_reports_no_poses_before(lab: Lab) -> None:
    lab.arm.set_status(tcp_offset=None)
    right = lab.arm.state

    def state() -> ArmState:
        assert lab.arm.control
        return right()

    lab.arm.state = state  # type: ignore[method-assign]  # this arm only
    lab.take_poses()
    assert lab.stops()[-1] == 7


def link(lab: Lab, *, old: bool, late_s: Callable[[int], float]) -> Check:
    """Check an arm that answers each question after so long; `old`: its program is asked for the TCP, twice a time."""
    lab.arm.set_status(tcp_offset=None if old else (0.0,) * 6)
    looks = count()

    def late() -> ArmState:
        lab.clock.sleep(late_s(next(looks)))
        return right()

    right, lab.arm.answers_s = lab.arm.state, 0.0
    lab.arm.state = late  # type: ignore[method-assign]  # this arm only
    return preflight.check_session_link(cast("preflight.Before", SimpleNamespace(cell=lab.open_cell())))


@pytest.mark.parametrize(("old", "limit_s"), [(False, 0.02), (True, 0.06)])
def test_an_arm_that_answers_late_is_refused(old: bool, limit_s: float, lab: Lab) -> None:
    assert link(lab, old=old, late_s=lambda _: 0.9 * limit_s).state == "ok"
    found = link(lab, old=old, late_s=lambda _: 1.1 * limit_s)
    assert found.state == "failed"
    assert f"{1e3 * limit_s:.0f} ms" in found.found


def test_a_link_with_gaps_is_refused(lab: Lab) -> None:
    assert link(lab, old=False, late_s=lambda look: 0.09 if look % 5 == 4 else 0.008).state == "ok"
    assert link(lab, old=False, late_s=lambda look: 0.11 if look % 5 == 4 else 0.008).state == "failed"


@pytest.mark.parametrize("granted", [True, False])
def test_the_computer_is_kept_awake_by_a_process_that_ends_with_our_end_of_its_pipe(
    granted: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inhibit, ended = tmp_path / "systemd-inhibit", tmp_path / "ended"
    inhibit.write_text(f"#!/bin/sh\n{'cat' if granted else 'exit 1'}\necho by itself > {ended}\n")
    inhibit.chmod(0o755)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("shutil.which", lambda _: str(inhibit))
    with preflight.awake() as words:
        assert words.startswith("this computer is kept awake") == granted
        assert not ended.exists()
    assert ended.exists() == granted


def test_a_sensor_that_stumbles_once_is_opened_again(lab: Lab) -> None:
    def stumble() -> None:
        lab.sensor.collecting = lambda: None
        raise StreamBroken("a write took too long")

    lab.sensor.collecting = stumble
    assert lab.take_poses(dry_run=True) is None
    assert "trying once more" in " ".join(event.words for event in lab.operator.of(Noted))
    lab.sensor.failure = StreamBroken("gone for good")
    with pytest.raises(StreamBroken):
        lab.take_poses(dry_run=True)
