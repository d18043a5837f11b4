"""The Robot API of an emulated PolyScope X controller, without sockets."""

import json

import pytest

from ftmocks.ur import api
from ftmocks.ur.modes import RobotMode, Runtime, SafetyMode
from ftmocks.ur.robot import Robot
from tests.unit.mocks.ur.urscript_robot import new_robot, start

SLEEPING = "def f():\n  sleep(9)\nend\n"
X = (10, 12, 0)


def get(robot: Robot, path: str) -> dict[str, object] | int:
    status, document = api.respond(robot, "GET", api.BASE + path, b"")
    return document if status == 200 else int(status)


def put(robot: Robot, path: str, action: object) -> int:
    return int(api.respond(robot, "PUT", api.BASE + path, json.dumps({"action": action}).encode())[0])


@pytest.mark.parametrize(
    ("polyscope", "version", "known", "unknown"),
    [
        ((10, 11, 0), "3.0.0", ["/program/v1/state"], ["/robotstate/v1/robotmode", "/versions/v1"]),
        ((10, 12, 1), "3.1.4", ["/robotstate/v1/robotmode", "/system/v1/controlmode"], ["/system/v1/information"]),
        ((10, 16, 0), "5.0.107", ["/system/v1/information", "/versions/v1"], ["/popup/v1"]),
    ],
)
def test_each_version_knows_its_resources(
    polyscope: tuple[int, int, int], version: str, known: list[str], unknown: list[str]
) -> None:
    robot = new_robot(polyscope)
    document = get(robot, "/openapi.json")
    assert isinstance(document, dict)
    assert document["info"] == {"title": "Robot API", "version": version}
    assert all(isinstance(get(robot, path), dict) for path in known)
    assert [get(robot, path) for path in unknown] == [404] * len(unknown)


def test_modes_by_their_names() -> None:
    robot = new_robot(X)
    states = ["/robotstate/v1/robotmode", "/robotstate/v1/safetymode", "/system/v1/controlmode", "/program/v1/state/"]

    def values() -> list[object]:
        documents = [get(robot, path) for path in states]
        return [next(iter(document.values())) for document in documents if isinstance(document, dict)]

    assert values() == ["RUNNING", "NORMAL", "REMOTE", "STOPPED"]
    start(SLEEPING, robot)
    robot.protective_stop("test")
    robot.remote_control = False
    assert values() == ["RUNNING", "PROTECTIVE_STOP", "LOCAL", "PAUSED"]
    for mode, name in {SafetyMode.SAFEGUARD_STOP: "PROTECTIVE_STOP", SafetyMode.VIOLATION: "FAULT"}.items():
        robot.set_safety(mode, "test")
        assert values()[1] == name
    robot.set_mode(RobotMode.UPDATING_FIRMWARE)
    assert values()[0] == "UPDATING"


def test_local_control_forbids_every_action_and_no_question() -> None:
    robot = start(SLEEPING, new_robot(X))
    robot.remote_control = False
    assert put(robot, "/program/v1/state", "stop") == 403
    assert put(robot, "/robotstate/v1/state", "POWER_OFF") == 403
    assert robot.runtime == Runtime.PLAYING
    assert get(robot, "/program/v1/state") == {"state": "PLAYING", "message": "OK"}
    assert (robot.events[-1].by, robot.events[-1].accepted) == ("api", False)


@pytest.mark.parametrize("body", [b"", b"[]", b'"stop"', b'{"action": 1}', b'{"action": "STOP"}', b"\xff"])
def test_other_bodies_are_rejected(body: bytes) -> None:
    assert api.respond(new_robot(X), "PUT", api.BASE + "/program/v1/state", body)[0] == 422


def test_other_methods_and_paths_are_rejected() -> None:
    robot = new_robot(X)
    assert api.respond(robot, "DELETE", api.BASE + "/program/v1/state", b"")[0] == 405
    assert api.respond(robot, "GET", api.BASE + "/robotstate/v1/state", b"")[0] == 405
    assert api.respond(robot, "GET", "/program/v1/state", b"")[0] == 404
