"""The emulated controller without sockets: what stops a program, what holds it, what lets it go on, and who did it."""

from collections.abc import Callable

import pytest

from ftmocks.kinematics import vector6
from ftmocks.ur.dashboard import answer
from ftmocks.ur.events import Event
from ftmocks.ur.modes import RobotMode, Runtime, SafetyMode
from ftmocks.ur.robot import Robot
from ftmocks.ur.uploads import Upload, start_upload
from ftmocks.ur.variables import OUTPUTS, output_type
from tests.unit.mocks.ur.urscript_robot import HOME, new_robot, run

GOAL = vector6([*HOME[:5], HOME[5] + 1.0])
CONTROL = Upload("rtde_control", "", secondary=False)
OTHER = Upload("other", "", secondary=False)


def moving_robot() -> Robot:
    """Its program runs, an asynchronous moveJ of 1 rad is under way at 0.2 rad/s."""
    robot = new_robot()
    start_upload(robot, CONTROL)
    run(robot, 0.15)
    doubles = {f"input_double_register_{i}": v for i, v in enumerate([*GOAL, 0.2, 2.0])}
    robot.write_inputs({"input_int_register_0": 1, **doubles, "input_int_register_1": 1})
    run(robot, 0.3)
    assert robot.runtime == Runtime.PLAYING
    assert not robot.arm.at_rest
    return robot


def found(robot: Robot, what: str, *, by: str | None = None) -> Event:
    """The last event of that name."""
    return next(e for e in reversed(robot.events) if e.what == what and by in (None, e.by))


STOPPING: dict[str, Callable[[Robot], object]] = {
    "dashboard stop": lambda r: answer(r, "stop"),
    "power off": lambda r: answer(r, "power off"),
    "emergency stop": lambda r: r.emergency_stop(True),
    "idle": lambda r: r.set_mode(RobotMode.IDLE),
    "recovery": lambda r: r.set_safety(SafetyMode.RECOVERY, "asked for"),
    "fault": lambda r: r.set_safety(SafetyMode.FAULT, "asked for"),
    "another program": lambda r: start_upload(r, OTHER, by="another script client"),
}


@pytest.mark.parametrize("how", STOPPING)
def test_what_ends_the_program_brings_the_arm_to_rest_for_good(how: str) -> None:
    robot = moving_robot()
    STOPPING[how](robot)
    assert robot.runtime == Runtime.STOPPED
    assert found(robot, "stopped rtde_control", by="program")
    run(robot, 1.0)
    stands = found(robot, "stands", by="arm")
    assert stands.detail["q_rad"] == list(robot.arm.q)
    assert robot.arm.at_rest
    q = robot.arm.q
    robot.emergency_stop(False)
    robot.set_safety(SafetyMode.NORMAL, "asked for")
    robot.set_mode(RobotMode.RUNNING)
    answer(robot, "play")
    run(robot, 1.0)
    assert robot.arm.q == q
    assert abs(q[5] - GOAL[5]) > 0.5


def test_a_closed_safeguard_lets_a_held_program_go_on_but_not_a_stopped_one() -> None:
    robot = moving_robot()
    robot.safeguard_stop(True)
    run(robot, 1.0)
    assert (robot.runtime, robot.arm.at_rest) == (Runtime.PAUSED, True)
    robot.safeguard_stop(False)
    run(robot, 1.0)
    assert not robot.arm.at_rest
    robot.safeguard_stop(True)
    answer(robot, "load another.urp")
    robot.safeguard_stop(False)
    run(robot, 1.0)
    assert (robot.runtime, robot.arm.at_rest) == (Runtime.STOPPED, True)


@pytest.mark.parametrize(
    ("number", "name", "by_dashboard", "runtime", "bits"),
    [
        (12, "AUTOMATIC_MODE_SAFEGUARD_STOP", "SAFEGUARD_STOP", Runtime.PAUSED, 0x410),
        (15, "IMMI_EMERGENCY_STOP", "IMMI_EMERGENCY_STOP", Runtime.STOPPED, 0x4A0),
        (17, "PROFISAFE_WAITING_FOR_PARAMETERS", "PROFISAFE_WAITING_FOR_PARAMETERS", Runtime.STOPPED, 0x400),
    ],
)
def test_newer_safety_modes_hold_the_arm_or_cut_its_power(
    number: int, name: str, by_dashboard: str, runtime: Runtime, bits: int
) -> None:
    robot = moving_robot()
    robot.set_safety(SafetyMode(number), "asked for")
    run(robot, 1.0)
    assert (robot.runtime, robot.arm.at_rest) == (runtime, True)
    assert answer(robot, "safetystatus") == f"Safetystatus: {name}"
    assert answer(robot, "safetymode") == f"Safetymode: {by_dashboard}"
    assert [OUTPUTS[output][1](robot) for output in ("safety_mode", "safety_status_bits")] == [number, bits]
    assert (robot.robot_mode == RobotMode.RUNNING) == ("EMERGENCY" not in name)


@pytest.mark.parametrize("mode", [m for m in SafetyMode if m not in (SafetyMode.NORMAL, SafetyMode.REDUCED)])
def test_no_program_starts_in_any_other_safety_mode(mode: SafetyMode) -> None:
    robot = new_robot()
    robot.set_safety(mode, "asked for")
    assert start_upload(robot, CONTROL) is False
    assert not found(robot, "program rtde_control").accepted
    run(robot, 0.3)
    assert robot.runtime == Runtime.STOPPED


def test_limiter_and_slider_multiply_and_only_the_slider_is_the_fraction() -> None:
    robot = moving_robot()
    robot.arm.speed_fraction, robot.arm.scaling = 0.5, 0.5
    run(robot, 0.3)
    assert robot.arm.qd[5] == pytest.approx(0.05)
    assert OUTPUTS["speed_scaling"][1](robot) == pytest.approx(0.5)
    assert OUTPUTS["target_speed_fraction"][1](robot) == 0.5


@pytest.mark.parametrize(
    ("polyscope", "unknown"),
    [
        ((3, 15, 0), {"ft_raw_wrench", "actual_current_as_torque", "target_gravity"}),
        ((5, 4, 0), {"ft_raw_wrench", "actual_current_as_torque", "target_gravity", "payload", "payload_inertia"}),
        ((5, 5, 1), {"ft_raw_wrench", "actual_current_as_torque", "target_gravity", "payload_inertia"}),
        ((5, 9, 0), {"actual_current_as_torque", "target_gravity", "payload_inertia"}),
        ((5, 15, 0), {"actual_current_as_torque", "target_gravity"}),
        ((5, 23, 0), {"target_gravity"}),
        ((5, 26, 0), set()),
    ],
)
def test_outputs_of_a_version(polyscope: tuple[int, int, int], unknown: set[str]) -> None:
    robot = new_robot(polyscope=polyscope)
    candidates = {"ft_raw_wrench", "actual_current_as_torque", "payload", "payload_inertia", "tcp_offset"}
    candidates.add("target_gravity")
    assert {name for name in candidates if output_type(robot, name) == "NOT_FOUND"} == unknown
    assert robot.frequency_hz == (125 if polyscope[0] == 3 else 500)


@pytest.mark.parametrize(
    ("polyscope", "understood"), [((3, 15, 0), "0111"), ((5, 4, 0), "0001"), ((5, 6, 0), "1111"), ((5, 26, 0), "1111")]
)
def test_dashboard_of_a_version(polyscope: tuple[int, int, int], understood: str) -> None:
    robot = new_robot(polyscope=polyscope)
    queries = ("is in remote control", "get serial number", "get robot model", "safetystatus")
    known = ["could not understand" not in answer(robot, query) for query in queries]
    assert known == [mark == "1" for mark in understood]
