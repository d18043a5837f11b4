"""The functions of URScript that programs for this emulator use.

Source: Universal Robots, "The URScript Programming Language", modules motion, internals, urmath and interfaces. The
Python signature of each function, behind the program, is its signature in URScript.

Chosen here: the period of `get_steptime` is that of the cell's clock whatever ``--time-scale`` is, so a program that
counts cycles to watch its client keeps the cell's time. `sleep` and motions keep the time of the arm: where that is K
times faster, a loop of `servoj` without `sync` runs K times in a cycle.

Does not model: every other function (its name is a compile error), blends (a radius is taken as 0), goals as poses.
URScript has no ``abs``: `norm` of a number is its absolute value.
"""

import math
from collections.abc import Callable, Generator, Mapping
from typing import Any, Protocol

from ftmocks.kinematics import Vector6, vector3, vector6
from ftmocks.ur.controller_program import ScriptError
from ftmocks.ur.motion import CannotFollow, Command, JointMove, Path
from ftmocks.ur.robot import Robot
from ftmocks.ur.urscript.values import Pose, Value, joints, number, numbers, text_of, whole_number

Cycles = Generator[None, None, None]
"""Takes as many control cycles as it yields."""

LOOKAHEAD_S, GAIN = (0.03, 0.2), (100, 2000)
"""What servoj accepts."""
LAST_REGISTER = 47
RAMP_SHARE = 0.2
"""Share of its time in which a move with a given time speeds up, and again slows down."""


class Caller(Protocol):
    """The program that calls a function."""

    @property
    def robot(self) -> Robot:
        """The controller."""

    @property
    def owner(self) -> str:
        """Name of the thread that calls: only one thread at a time may move the arm."""

    def begin_cycle(self) -> None:
        """Let the thread that calls compute as much as in a cycle."""


def movej(program: Caller, q: Value, a: Value = 1.4, v: Value = 1.05, t: Value = 0, r: Value = 0) -> Cycles:
    """Move all joints together; a time `t` (s) replaces speed and acceleration."""
    number(r, "movej: r")
    arm, goal, seconds = program.robot.arm, joints(q, "movej: q"), number(t, "movej: t")
    speed, acceleration = number(v, "movej: v"), number(a, "movej: a")
    if seconds > 0:
        speed, acceleration = _pace(arm.q, goal, seconds)
    yield from _followed(program, JointMove(arm.dh, goal, speed, acceleration))


def _pace(start: Vector6, goal: Vector6, seconds: float) -> tuple[float, float]:
    travel = max(1e-9, *(abs(x - y) for x, y in zip(start, goal, strict=True)))
    speed = travel / (seconds * (1.0 - RAMP_SHARE))
    return speed, speed / (seconds * RAMP_SHARE)


def _followed(program: Caller, path: Path) -> Cycles:
    program.robot.arm.start(path, program.owner)
    yield from program.robot.arm.until_finished(program.owner)


def servoj(
    program: Caller,
    q: Value,
    a: Value = 0,
    v: Value = 0,
    t: Value = 0.002,
    lookahead_time: Value = 0.1,
    gain: Value = 300,
) -> Cycles:
    """Follow a target for `t` (s); a and v have no effect."""
    number(a, "servoj: a")
    number(v, "servoj: v")
    robot, goal, seconds = program.robot, joints(q, "servoj: q"), number(t, "servoj: t")
    lookahead_s, stiffness = number(lookahead_time, "servoj: lookahead_time"), number(gain, "servoj: gain")
    within = LOOKAHEAD_S[0] <= lookahead_s <= LOOKAHEAD_S[1] and GAIN[0] <= stiffness <= GAIN[1]
    if not (within and seconds > 0):
        raise ScriptError(f"servoj: t={seconds}, lookahead_time={lookahead_s} or gain={stiffness} is out of range")
    try:
        servo = robot.arm.servo(Command(goal, seconds, lookahead_s, stiffness), program.owner)
    except CannotFollow as error:
        robot.protective_stop(str(error))
        yield  # paused from here on
        return
    cycle_s = robot.period_s * robot.settings.time_scale
    while servo.ahead_s > cycle_s - 1e-9:
        yield
    program.begin_cycle()


def stopj(program: Caller, a: Value) -> Cycles:
    """Slow down the joints."""
    arm, owner = program.robot.arm, program.owner
    arm.stop_joints(number(a, "stopj: a"), owner)
    yield from arm.until_finished(owner)


def sync(_program: Caller) -> Cycles:
    """Use up the rest of this cycle."""
    yield


def sleep(program: Caller, t: Value) -> Cycles:
    """Wait in the time of the arm."""
    robot = program.robot
    for _ in range(math.ceil(number(t, "sleep: t") / (robot.period_s * robot.settings.time_scale) - 1e-9)):
        yield


def textmsg(program: Caller, s1: Value, s2: Value = "") -> None:
    """Write into the log of the pendant."""
    program.robot.note("program", "textmsg", why=text_of(s1) + text_of(s2))


def popup(
    program: Caller,
    s: Value,
    title: Value = "Popup",
    warning: Value = False,
    error: Value = False,
    blocking: Value = False,
) -> Cycles:
    """Show a message; a blocking one holds this thread until the operator closes it."""
    robot = program.robot
    robot.popup = text = text_of(s)
    robot.note("program", "popup", why=text, title=title, warning=warning, error=error, blocking=blocking)
    while blocking and robot.popup is not None:
        yield


def get_actual_joint_positions(program: Caller) -> list[float]:
    """Return the joint angles, rad."""
    return list(program.robot.measured_q)


def get_target_joint_positions(program: Caller) -> list[float]:
    """Return the set-points, rad."""
    return list(program.robot.arm.q)


def get_target_joint_speeds(program: Caller) -> list[float]:
    """Return the speeds of the set-points, rad/s."""
    return list(program.robot.arm.qd)


def get_tcp_offset(program: Caller) -> Pose:
    """Return the active TCP in the flange frame."""
    return Pose(program.robot.tcp_offset)


def get_steptime(program: Caller) -> float:
    """Return the length of a cycle on the cell's clock, s."""
    return program.robot.period_s


def is_steady(program: Caller) -> bool:
    """Return whether the arm has stood still for half a second."""
    return program.robot.steady


def is_within_safety_limits(program: Caller, q: Value) -> bool:
    """Return whether the arm may stand at joint angles."""
    robot = program.robot
    return robot.limits.allow(joints(q, "is_within_safety_limits: q"), robot.X_flange_tcp)


def set_payload(program: Caller, m: Value, cog: Value = None) -> None:
    """Set the mass on the flange (kg) and its centre in the flange frame (m); without `cog` the centre stays."""
    robot, payload_kg = program.robot, number(m, "set_payload: m")
    if cog is not None:
        robot.payload_cog_m = vector3(numbers(cog, "set_payload: cog", 3))
    robot.payload_kg = payload_kg


def set_target_payload(program: Caller, m: Value, cog: Value, inertia: Value = None) -> None:
    """Set mass (kg), centre (m) and inertia (kg·m²: Ixx, Iyy, Izz, Ixy, Ixz, Iyz) on the flange."""
    robot, six = program.robot, [0.0] * 6 if inertia is None else numbers(inertia, "set_target_payload: inertia", 6)
    cog_m = vector3(numbers(cog, "set_target_payload: cog", 3))
    robot.payload_kg, robot.payload_cog_m = number(m, "set_target_payload: m"), cog_m
    robot.payload_inertia = vector6(six)
    robot.zero_ft()


def set_gravity(program: Caller, d: Value) -> None:
    """Set the acceleration away from the earth that the controller assumes, m/s², base axes."""
    program.robot.target_gravity_m_s2 = vector3(numbers(d, "set_gravity: d", 3))


def zero_ftsensor(program: Caller) -> None:
    """Take the present wrench as zero."""
    program.robot.zero_ft()


def read_input_integer_register(program: Caller, address: Value) -> int:
    """Return what a client wrote."""
    return program.robot.input_int(_register(address))


def read_input_float_register(program: Caller, address: Value) -> float:
    """Return what a client wrote."""
    return program.robot.input_double(_register(address))


def read_output_integer_register(program: Caller, address: Value) -> int:
    """Return what a program wrote."""
    return program.robot.output_ints[_register(address)]


def write_output_integer_register(program: Caller, address: Value, value: Value) -> None:
    """Write a number for the clients."""
    what = "write_output_integer_register: value"
    program.robot.output_ints[_register(address)] = whole_number(value, what, -(2**31), 2**31 - 1)


def write_output_float_register(program: Caller, address: Value, value: Value) -> None:
    """Write a number for the clients."""
    program.robot.output_doubles[_register(address)] = float(number(value, "write_output_float_register: value"))


def _register(address: Value) -> int:
    return whole_number(address, "the address of a register", 0, LAST_REGISTER)


def norm(_program: Caller, a: Value) -> float:
    """Return the absolute value of a number, or the Euclidean length of a list or pose."""
    return math.hypot(*(number(value, "norm: a") for value in (a if isinstance(a, list) else [a])))


def floor(_program: Caller, f: Value) -> int:
    """Return the largest whole number not above a number."""
    return math.floor(number(f, "floor: f"))


def sin(_program: Caller, f: Value) -> float:
    """Return the sine of an angle, rad."""
    return math.sin(number(f, "sin: f"))


def cos(_program: Caller, f: Value) -> float:
    """Return the cosine of an angle, rad."""
    return math.cos(number(f, "cos: f"))


def sqrt(_program: Caller, f: Value) -> float:
    """Return the square root of a number."""
    return math.sqrt(number(f, "sqrt: f"))


def length(_program: Caller, v: Value) -> int:
    """Return the number of elements of a list or text."""
    if not isinstance(v, list | str):
        raise ScriptError(f"length: {text_of(v)} is no list")
    return len(v)


Built_in = Callable[..., Any]
_FUNCTIONS: tuple[Built_in, ...] = (movej, servoj, stopj, sync, sleep, textmsg, popup)
_FUNCTIONS += (norm, floor, sin, cos, sqrt, length)
_FUNCTIONS += (get_actual_joint_positions, get_target_joint_positions, get_target_joint_speeds, get_tcp_offset)
_FUNCTIONS += (get_steptime, is_steady, is_within_safety_limits, zero_ftsensor)
_FUNCTIONS += (set_payload, set_target_payload, set_gravity, read_output_integer_register)
_FUNCTIONS += (read_input_integer_register, read_input_float_register)
_FUNCTIONS += (write_output_integer_register, write_output_float_register)
_SINCE = {"set_target_payload": {3: 15, 5: 10}}
"""First minor version of each major one that knows a function."""


def functions(polyscope: tuple[int, int, int]) -> Mapping[str, Built_in]:
    """Return the functions that a version of PolyScope knows, by name."""
    major, minor, _bugfix = polyscope
    known = {function.__name__: function for function in _FUNCTIONS}
    return {name: called for name, called in known.items() if minor >= _SINCE.get(name, {}).get(major, 0)}
