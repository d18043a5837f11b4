"""The Robot API of PolyScope X: converts an HTTP request to a JSON document. It uses no sockets.

Source: the PolyScope X side of Universal Robots' client library and its tests (resources, bodies, the version of the
API with which each appeared, names of modes); "Remote Robot Controller" by an engineer of Universal Robots (status
codes of each resource); urctl, recorded against URSim 10.x (403 in local control, its message, `message` in answers).

Chosen here, where the sources are silent:

* PolyScope 10.11 has version 3.0.0 of the API. Unknown resources and resources of a later version are answered by 404,
  other methods by 405.
* A program from port 30001 is paused, resumed and stopped like one of PolyScope. ``stop`` without a program succeeds.
  ``play`` and ``resume`` are answered by 500 when there is nothing to play or resume, and ``pause`` when none plays.
* Answers are sent at once, also to ``POWER_ON``, which takes a while on a real controller.
* A safeguard stop is reported as ``PROTECTIVE_STOP``, recovery as ``REDUCED`` and a violation as ``FAULT``, because the
  API has only five modes.

Does not model: loading and storing programs, popups, time, log, support files.
"""

import json
from collections.abc import Callable
from http import HTTPStatus
from typing import NamedTuple

from ftmocks.ur.modes import EMERGENCY, SAFEGUARDED, RobotMode, Runtime, SafetyMode
from ftmocks.ur.robot import Robot

POLYSCOPE_X = 10
BASE = "/universal-robots/robot-api"
API_VERSIONS = {(10, 11): (3, 0, 0), (10, 12): (3, 1, 4), (10, 13): (3, 1, 6), (10, 14): (5, 0, 107)}
"""Version of the API, by the first version of PolyScope that has it."""

Document = dict[str, object]
Answer = tuple[int, Document]

_SAFETY_NAMES = {
    **dict.fromkeys(SAFEGUARDED, "PROTECTIVE_STOP"),
    **dict.fromkeys(EMERGENCY, "EMERGENCY_STOP"),
    SafetyMode.RECOVERY: "REDUCED",
    SafetyMode.VIOLATION: "FAULT",
}
"""Safety modes whose names in the Robot API differ from those of RTDE."""

FORBIDDEN: Document = {
    "message": "Forbidden - Operation Not Allowed",
    "details": "The robot must be in remote mode or the request must originate from an internal URCap",
}


def _version_of(robot: Robot) -> tuple[int, int, int]:
    first = max((since for since in API_VERSIONS if since <= robot.settings.polyscope[:2]), default=(10, 11))
    return API_VERSIONS[first]


def _unlock(robot: Robot) -> bool:
    return robot.safety_mode == SafetyMode.PROTECTIVE_STOP and robot.unlock()


def _power_off(robot: Robot) -> bool:
    robot.power_off()
    return True


def _restart_safety(robot: Robot) -> bool:
    robot.restart_safety()
    return True


def _stop(robot: Robot) -> bool:
    robot.stop_program("api stop")
    return True


_POWER: dict[str, Callable[[Robot], bool]] = {
    "POWER_ON": Robot.power_on,
    "POWER_OFF": _power_off,
    "BRAKE_RELEASE": Robot.brake_release,
    "UNLOCK_PROTECTIVE_STOP": _unlock,
    "RESTART_SAFETY": _restart_safety,
}
_PROGRAM: dict[str, Callable[[Robot], bool]] = {
    "play": Robot.play,
    "resume": lambda robot: robot.runtime == Runtime.PAUSED and robot.play(),
    "pause": lambda robot: robot.pause("api pause"),
    "stop": _stop,
}


class Resource(NamedTuple):
    """A resource of the API: first version, function that reads it, and actions."""

    since: tuple[int, int, int]
    get: Callable[[Robot], Document] | None
    actions: dict[str, Callable[[Robot], bool]] | None = None
    refusal: HTTPStatus = HTTPStatus.CONFLICT
    """HTTP status of an action that is not possible in the current state."""


def _robot_mode(robot: Robot) -> Document:
    return {"mode": "UPDATING" if robot.robot_mode == RobotMode.UPDATING_FIRMWARE else robot.robot_mode.name}


def _open_api(robot: Robot) -> Document:
    return {"openapi": "3.1.0", "info": {"title": "Robot API", "version": ".".join(map(str, _version_of(robot)))}}


RESOURCES: dict[str, Resource] = {
    "/openapi.json": Resource((0, 0, 0), _open_api),
    "/robotstate/v1/state": Resource((0, 0, 0), None, _POWER),
    "/program/v1/state": Resource(
        (0, 0, 0), lambda r: {"state": r.runtime.name}, _PROGRAM, HTTPStatus.INTERNAL_SERVER_ERROR
    ),
    "/program/v1/loaded": Resource((3, 1, 4), lambda r: {"name": r.loaded_program or "Default program"}),
    "/robotstate/v1/robotmode": Resource((3, 1, 4), _robot_mode),
    "/robotstate/v1/safetymode": Resource(
        (3, 1, 4), lambda r: {"mode": _SAFETY_NAMES.get(r.safety_mode, r.safety_mode.name)}
    ),
    "/system/v1/controlmode": Resource((3, 1, 4), lambda r: {"mode": "REMOTE" if r.remote_control else "LOCAL"}),
    "/system/v1/operationalmode": Resource((3, 1, 4), lambda _robot: {"mode": "AUTOMATIC"}),
    "/versions/v1": Resource((5, 0, 107), lambda r: {"marketingVersion": ".".join(map(str, r.settings.polyscope))}),
    "/system/v1/information": Resource(
        (5, 0, 107), lambda r: {"robotType": r.settings.model, "serialNumber": r.settings.serial_number}
    ),
}
"""Resources of the Robot API by their path after `BASE`."""


def respond(robot: Robot, method: str, path: str, body: bytes) -> Answer:
    """Process a request; return status and document of the answer."""
    place = path.partition("?")[0].rstrip("/")
    resource = RESOURCES.get(place.removeprefix(BASE)) if place.startswith(BASE) else None
    if resource is None or resource.since > _version_of(robot):
        return HTTPStatus.NOT_FOUND, {"message": "Not Found"}
    if method == "GET" and resource.get is not None:
        return HTTPStatus.OK, {**resource.get(robot), "message": "OK"}
    if method == "PUT" and resource.actions is not None:
        return _act(robot, resource, body)
    return HTTPStatus.METHOD_NOT_ALLOWED, {"message": "Method Not Allowed"}


def _act(robot: Robot, resource: Resource, body: bytes) -> Answer:
    action = _action_in(body)
    do = (resource.actions or {}).get(action)
    if do is None:
        return HTTPStatus.UNPROCESSABLE_ENTITY, {"message": f"Validation Error: no action {action!r}"}
    if not robot.remote_control:
        robot.note("api", action, accepted=False, why="local control")
        return HTTPStatus.FORBIDDEN, FORBIDDEN
    done = do(robot)
    status = HTTPStatus.OK if done else resource.refusal
    document: Document = {"message": f"{action} {'succeeded' if done else 'failed'}"}
    robot.note("api", action, accepted=done, why=str(document["message"]))
    return status, document


def _action_in(body: bytes) -> str:
    try:
        action = json.loads(body)["action"]
    except (ValueError, TypeError, KeyError):
        return ""
    return action if isinstance(action, str) else ""
