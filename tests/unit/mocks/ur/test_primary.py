"""What the emulated controller sends on port 30001: bytes of recorded streams, and a second decoder."""

import pytest

from ftmocks.factory_kinematics import drawn
from ftmocks.kinematics import MODELS
from ftmocks.ur import primary
from ftmocks.ur.events import Event
from ftmocks.ur.modes import RobotMode
from ftmocks.ur.robot import Robot
from tests.unit.mocks.ur.primary_decoder import decoded, packages
from tests.unit.mocks.ur.urscript_robot import new_robot, start


def heard(robot: Robot, since: int = 0) -> list[dict[str, object]]:
    """Messages of the events from a number on."""
    found, rest = packages(b"".join(primary.messages_of(event) for event in robot.events[since:]))
    assert rest == b""
    return [decoded(package) for package in found]


def event(by: str, what: str, why: str = "", t_robot_s: float = 0.0, **detail: object) -> Event:
    return Event(0, t_robot_s, by, what, by == "program", why, detail)


@pytest.mark.parametrize(
    ("entry", "golden"),
    [  # recorded from URSim 5.4: README of robotlab, Pharmaceutical Bioinformatics, Uppsala
        (
            event("program", "textmsg", "nonce nonce nonce pharmbio says hello", 16381.792),
            "00000034 14 00000003d06e4f00 fd 00" + b"nonce nonce nonce pharmbio says hello".hex(),
        ),
        (
            event("program", "stopped silly", "ended", 16634.482),
            "00000030 14 00000003df7e0d50 fd 07 00000000 00000000 13" + b"PROGRAM_XXX_STOPPEDsilly".hex(),
        ),
        (
            event("primary port", "program silly", error="syntax_error_on_line:2:end:", line=2, column=1),
            "00000032 14 ffffffffffffffff fd 0a 00000002 00000001" + b"syntax_error_on_line:2:end:".hex(),
        ),
        (
            event("primary port", "program silly", error="compile_error_name_not_found:txtmsg:", line=2, column=2),
            "0000003b 14 ffffffffffffffff fd 0a 00000002 00000002" + b"compile_error_name_not_found:txtmsg:".hex(),
        ),
    ],
)
def test_messages_byte_by_byte(entry: Event, golden: str) -> None:
    assert primary.messages_of(entry).hex(" ") == bytes.fromhex(golden).hex(" ")


def test_a_greeting_has_packages_that_are_neither_state_nor_documented() -> None:
    """Message 12 as recorded from 5.12 and 5.13, the tolerances as from a UR5 with 3.10."""
    robot = new_robot()
    version = primary.version_message(robot)
    head = "00000018 14 ffffffffffffffff fe 0c 00000000 00000000 01" + "000000b5 18 3fc3333333333333 4039000000000000"
    assert primary.greeting(robot).startswith(version + bytes.fromhex(head))
    found, rest = packages(primary.greeting(robot))
    assert rest == b""
    assert [decoded(package)["type"] for package in found] == ["version", "unexplained", "tolerances", "state"]
    assert "kinematics" in decoded(found[-1])


def test_kinematics_of_a_nominal_arm_byte_by_byte() -> None:
    """Recorded from a UR5e in URSim 5.8: parser test of the client library."""
    zero, right = "00" * 8, "3ff921fb54524550"  # 1.570796327
    golden = [
        "000000e105" + "ff" * 24,
        zero * 6,
        zero + "bfdb333333333333" + "bfd919ce075f6fd2" + zero * 3,
        "3fc4cccccccccccd" + zero * 2 + "3fc10ff972474539" + "3fb985f06f694467" + "3fb97f62b6ae7d56",
        right + zero * 2 + right + "b" + right[1:] + zero,
        "00000000",
    ]
    assert bytes.fromhex("".join(golden)) in primary.state_package(new_robot(), complete=True)


@pytest.mark.parametrize("what", ["none", "wrong"])
def test_kinematics_can_be_missing_or_those_of_another_arm(what: str) -> None:
    robot, other = new_robot(), drawn("UR5e", 2)
    robot.reported_dh = None if what == "none" else other
    state = decoded(primary.state_package(robot, complete=True))
    assert state.get("kinematics", {}).get("d") == (None if what == "none" else list(other.d))
    assert state["configuration"]["d"] == list(MODELS["UR5e"].d)


def test_modes_of_a_held_and_of_a_powerless_arm() -> None:
    robot = start("def f():\n  sleep(9)\nend\n")
    assert decoded(primary.state_package(robot))["mode"]["running"] == 1
    robot.protective_stop("test")
    mode = decoded(primary.state_package(robot))["mode"]
    assert (mode["protective"], mode["running"], mode["paused"], mode["emergency"]) == (1, 0, 1, 0)
    robot.emergency_stop(True)
    mode = decoded(primary.state_package(robot))["mode"]
    assert (mode["emergency"], mode["power_on"], mode["robot_mode"]) == (1, 0, RobotMode.POWER_OFF)
    assert [message["mode"] for message in heard(robot) if message["type"] == "safety"] == [3, 7]


def test_a_connection_that_can_only_read_is_answered_by_c210() -> None:
    error = decoded(primary.read_only_error(new_robot()))
    assert (error["type"], error["code"], error["argument"], error["text"]) == ("error", 210, 0, "")
