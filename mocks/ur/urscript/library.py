"""The functions of URScript that programs for this emulator use.

From: Universal Robots, "The URScript Programming Language", modules motion, internals and urmath. The Python signature
of each function, after the program, is its signature in URScript.

Does not model: every other function (it ends the program with a run-time error), blends, moves with a time.
"""

import math
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, Any

from mocks.kinematics import vector3, vector6
from mocks.ur.motion import JointMove

if TYPE_CHECKING:
    from mocks.ur.urscript.program import Program

Cycles = Generator[None, None, None]
"""Takes as many control cycles as it yields."""


class ScriptError(Exception):
    """A run-time error of the program; it ends."""


def text_of(value: object) -> str:
    """Write a value as in a message on the pendant."""
    if isinstance(value, list):
        return "[" + ", ".join(map(text_of, value)) + "]"
    return str(value)


def number(value: object, what: str) -> float:
    """Take a finite number, which a truth value is not."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ScriptError(f"{what} must be a number, not {value!r}")
    return value


def movej(program: "Program", q: object, a: object = 1.4, v: object = 1.05) -> Cycles:
    """Move all joints together."""
    if not isinstance(q, list) or len(q) != 6:
        raise ScriptError(f"movej: q must be six joint values, not {text_of(q)}")
    arm = program.robot.arm
    goal = vector6([number(value, "movej: q") for value in q])
    arm.start(JointMove(arm.dh, goal, number(v, "movej: v"), number(a, "movej: a")), program.name)
    yield from arm.until_finished(program.name)


def sleep(program: "Program", t: object) -> Cycles:
    """Wait in the controller's time."""
    robot = program.robot
    for _ in range(math.ceil(number(t, "sleep") / (robot.period_s * robot.settings.time_scale) - 1e-9)):
        yield


def textmsg(program: "Program", s1: object, s2: object = "") -> None:
    """Write into the log of the pendant."""
    program.robot.note("program", "textmsg", why=text_of(s1) + text_of(s2))


def popup(
    program: "Program",
    s: object,
    title: object = "Popup",
    warning: bool = False,
    error: bool = False,
    blocking: bool = False,
) -> Cycles:
    """Show a message; a blocking one holds the program until the operator closes it."""
    robot = program.robot
    robot.popup = text = text_of(s)
    robot.note("program", "popup", why=text, title=title, warning=warning, error=error, blocking=blocking)
    while blocking and robot.popup is not None:
        yield


def get_actual_joint_positions(program: "Program") -> list[float]:
    """Return the joint angles, rad."""
    return list(program.robot.arm.actual_q)


def set_gravity(program: "Program", d: object) -> None:
    """Set the acceleration away from the earth that the controller assumes, m/s², base axes."""
    if not isinstance(d, list) or len(d) != 3:
        raise ScriptError(f"set_gravity: d must be three numbers, not {text_of(d)}")
    program.robot.target_gravity_m_s2 = vector3([number(value, "set_gravity: d") for value in d])


def norm(_program: "Program", a: object) -> float:
    """Return the absolute value of a number, or the Euclidean length of a list."""
    return math.hypot(*(number(value, "norm") for value in (a if isinstance(a, list) else [a])))


_FUNCTIONS = (movej, sleep, textmsg, popup, get_actual_joint_positions, set_gravity, norm)
FUNCTIONS: dict[str, Callable[..., Any]] = {function.__name__: function for function in _FUNCTIONS}
"""By name."""
