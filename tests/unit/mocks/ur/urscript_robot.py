"""An emulated controller without sockets that runs programs, for the tests of URScript."""

from textwrap import indent

import numpy as np

from ftmocks.kinematics import MODELS, vector6
from ftmocks.ur.events import Event
from ftmocks.ur.modes import Runtime
from ftmocks.ur.robot import Robot, RobotSettings
from ftmocks.ur.uploads import start_upload, take_uploads
from ftmocks.world import Truth, World

HOME = vector6(np.radians([45, -100, 60, -50, 90, 45]))


def new_robot(polyscope: tuple[int, int, int] = (5, 15, 0), time_scale: float = 1.0) -> Robot:
    world = World(Truth.drawn(0), MODELS["UR5e"], HOME, 0)
    return Robot(world, RobotSettings(polyscope=polyscope, time_scale=time_scale))


def start(text: str, robot: Robot | None = None) -> Robot:
    """Upload a program and let it begin."""
    robot = robot or new_robot()
    (upload,) = take_uploads(bytearray(text.encode()))
    assert start_upload(robot, upload), robot.events[-1].why
    run(robot, 0.12)
    return robot


def run(robot: Robot, seconds: float) -> None:
    for _ in range(round(seconds * robot.frequency_hz)):
        robot.tick()


def logged(robot: Robot) -> list[str]:
    return [event.why for event in robot.events if event.what == "textmsg"]


def end_of(robot: Robot) -> Event:
    return next(event for event in reversed(robot.events) if event.what.startswith("stopped"))


def results(*expressions: str, before: str = "") -> list[str]:
    """Values of expressions, as the log shows them."""
    lines = "\n".join([before, *(f"textmsg({expression})" for expression in expressions)])
    robot = start(f"def f():\n{indent(lines, '  ')}\nend\n")
    assert end_of(robot).why == "ended"
    return logged(robot)


def failure(body: str) -> Event:
    """The end of a program that fails."""
    robot = start(f"def f():\n{body}\nend\n")
    assert robot.runtime == Runtime.STOPPED
    return end_of(robot)
