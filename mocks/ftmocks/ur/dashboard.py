"""Answers of the dashboard server to command lines.

Source: Universal Robots, "Dashboard Server e-Series, port 29999" and its CB-Series page, with their exact wording,
which clients compare. `load` and the name in `programState`: issues 89 and 268 of its client library.
"""

from collections.abc import Callable

from ftmocks.ur.modes import Runtime, SafetyMode
from ftmocks.ur.robot import Robot

BANNER = "Connected: Universal Robots Dashboard Server"
BUILD = 1261331

TOO_EARLY = (
    "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop before unlocking"
)
LOCAL_CONTROL = (
    "Command is not allowed due to safety reasons, "
    "please switch robot to Remote Control mode and reconnect to port 29999"
)

PROGRAMS, INSTALLATION = "/programs/", "/programs/default.installation"

_SAFETY_MODES = {
    SafetyMode.AUTOMATIC_MODE_SAFEGUARD_STOP: SafetyMode.SAFEGUARD_STOP,
    SafetyMode.SYSTEM_THREE_POSITION_ENABLING_STOP: SafetyMode.SAFEGUARD_STOP,
}
"""Safety modes that `safetymode` does not distinguish, and the mode that it reports instead."""

_QUERIES: dict[str, Callable[[Robot], str]] = {
    "polyscopeversion": lambda r: f"URSoftware {'.'.join(map(str, r.settings.polyscope))}.{BUILD} (Mar 24 2022)",
    "get serial number": lambda r: r.settings.serial_number,
    "get robot model": lambda r: r.settings.model.rstrip("e"),
    "is in remote control": lambda r: str(r.remote_control).lower(),
    "robotmode": lambda r: f"Robotmode: {r.robot_mode.name}",
    "safetymode": lambda r: f"Safetymode: {_SAFETY_MODES.get(r.safety_mode, r.safety_mode).name}",
    "safetystatus": lambda r: f"Safetystatus: {r.safety_mode.name}",
    "running": lambda r: f"Program running: {str(r.runtime == Runtime.PLAYING).lower()}",
    "programstate": lambda r: f"{r.runtime.name} {r.program_name}",
    "isprogramsaved": lambda r: f"true {r.program_name}",
    "get loaded program": lambda r: f"Loaded program: {r.loaded_program}" if r.loaded_program else "No program loaded",
}

_FIXED_REPLIES = {
    "popup": "showing popup",
    "close safety popup": "closing safety popup",
    "addtolog": "Added log message",
    "quit": "Disconnected",
    "shutdown": "Shutting down",
}

_SINCE = {
    "get serial number": {3: 12, 5: 6},
    "get robot model": {3: 12, 5: 6},
    "is in remote control": {5: 6},
    "safetystatus": {3: 11, 5: 4},
}
"""For each command, the first minor version of PolyScope that has it, by major version."""


def _play(robot: Robot) -> str | None:
    return "Starting program" if robot.play() else None


def _stop(robot: Robot) -> str | None:
    robot.stop_program("dashboard stop")
    return "Stopped"


def _pause(robot: Robot) -> str | None:
    return "Pausing program" if robot.pause("dashboard pause") else None


def _unlock(robot: Robot) -> str | None:
    return "Protective stop releasing" if robot.unlock() else None


def _close_popup(robot: Robot) -> str | None:
    robot.popup = None
    return "closing popup"


def _power_on(robot: Robot) -> str | None:
    return "Powering on" if robot.power_on() else None


def _power_off(robot: Robot) -> str | None:
    robot.power_off()
    return "Powering off"


def _brake_release(robot: Robot) -> str | None:
    return "Brake releasing" if robot.brake_release() else None


def _restart_safety(robot: Robot) -> str | None:
    robot.restart_safety()
    return "Restarting safety"


def _load(robot: Robot, name: str) -> str:
    robot.stop_program("another program loaded")
    robot.loaded_program = name if name.startswith("/") else PROGRAMS + name
    return f"Loading program: {robot.loaded_program}, {INSTALLATION}"


_COMMANDS: dict[str, Callable[[Robot], str | None]] = {
    "play": _play,
    "stop": _stop,
    "pause": _pause,
    "unlock protective stop": _unlock,
    "close popup": _close_popup,
    "power on": _power_on,
    "power off": _power_off,
    "brake release": _brake_release,
    "restart safety": _restart_safety,
}
"""Functions of the commands that change the state. They return the reply, or None if the controller refuses."""


def answer(robot: Robot, line: str, *, by: str = "dashboard", trusted: bool = True) -> str:
    """Execute a dashboard command and return the reply without line end.

    Parameters
    ----------
    by
        Source of the command, for the event log.
    trusted
        Whether this connection may send commands: the pendant was in remote control since the connection was opened.
    """
    command = line.strip()
    verb = command.lower()
    major, minor, _bugfix = robot.settings.polyscope
    since = _SINCE.get(verb)
    if verb in _QUERIES and (since is None or minor >= since.get(major, minor + 1)):
        return _QUERIES[verb](robot)
    for start, reply in _FIXED_REPLIES.items():
        if verb == start or verb.startswith(start + " "):
            return reply
    loads = verb.startswith("load ")
    if verb not in _COMMANDS and not loads:
        return f"could not understand: '{command}'"
    if not trusted:
        robot.note(by, verb, accepted=False, why=LOCAL_CONTROL)
        return LOCAL_CONTROL
    if loads:
        reply_text: str | None = _load(robot, command[5:].strip())
    else:
        reply_text = _COMMANDS[verb](robot)
    refusal = TOO_EARLY if verb == "unlock protective stop" else f"Failed to execute: {verb}"
    robot.note(by, verb, accepted=reply_text is not None, why=reply_text or refusal)
    return reply_text or refusal
