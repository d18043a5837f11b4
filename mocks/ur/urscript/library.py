"""The functions of URScript, as far as programs for this arm need them.

From: Universal Robots, "The URScript Programming Language", modules motion, internals, urmath and interfaces. The
Python signature of each function, after the program, is its signature in URScript.

Left out: blends (a radius is taken as 0), inputs, sockets, force mode, servo and speed commands, and much else: a
function not listed here ends the program with a run-time error.
"""

import math
from collections.abc import Callable, Generator, Sequence
from typing import TYPE_CHECKING, Any

from mocks.kinematics import Array, Vector6, forward, inverse, inverse_matrix, matrix_of, pose_of, vector6
from mocks.ur.motion import JointMove, LineMove, Path

if TYPE_CHECKING:
    from mocks.ur.urscript.program import Program

Cycles = Generator[None, None, None]
"""Takes as many control cycles as it yields."""

REGISTERS = 48
FUNCTIONS: dict[str, Callable[..., Any]] = {}
"""By name."""


class ScriptError(Exception):
    """A run-time error of the program; it ends."""


class Pose(list[float]):
    """``p[x, y, z, rx, ry, rz]``: m and rad, a rotation vector."""


def is_number(value: object) -> bool:
    """Whether a value is a number, which a truth value is not."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def shown(value: object) -> str:
    """Write a value as in a message on the pendant."""
    if isinstance(value, list):
        return ("p" if isinstance(value, Pose) else "") + "[" + ", ".join(map(shown, value)) + "]"
    return "nothing" if value is None else str(value)


def number(value: object, what: str) -> float:
    """Take a finite number."""
    if not (isinstance(value, int | float) and is_number(value) and math.isfinite(value)):
        raise ScriptError(f"{what} must be a number, not {value!r}")
    return value


def six(value: object, what: str, kind: type = list) -> Vector6:
    """Take six numbers: joint angles, or a pose with `kind` Pose."""
    values = value if isinstance(value, list) and type(value) is kind else []
    if len(values) != 6:
        raise ScriptError(f"{what} must be {'a pose' if kind is Pose else 'six joint values'}, not {shown(value)}")
    return vector6([number(v, what) for v in values])


def function(*names: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Make a Python function one of URScript's, under its own name or these."""

    def add(called: Callable[..., Any]) -> Callable[..., Any]:
        for name in names or (called.__name__,):
            FUNCTIONS[name] = called
        return called

    return add


# -- motion -----------------------------------------------------------------------------------------------------------


def _flange(program: "Program", pose: object, what: str) -> Array:
    """Pose of the flange in base, (4, 4), that puts the active TCP at `pose`."""
    return matrix_of(six(pose, what, Pose)) @ inverse_matrix(program.robot.X_flange_tcp)


def _joints(program: "Program", goal: object, what: str, near: Vector6 | None = None) -> Vector6:
    """Joint angles of a goal, which may be a pose."""
    if type(goal) is not Pose:
        return six(goal, what)
    arm = program.robot.arm
    q = inverse(arm.dh, _flange(program, goal, what), near or arm.actual_q)
    if q is None:
        raise ScriptError(f"{what}: no solution for the pose {goal}")
    return q


def _follow(program: "Program", path: Path) -> Cycles:
    arm, owner = program.robot.arm, program.owner
    arm.start(path, owner)
    yield from arm.until_finished(owner)


@function()
def movej(program: "Program", q: object, a: object = 1.4, v: object = 1.05, t: object = 0, r: object = 0) -> Cycles:
    """Move all joints together; a time `t` (s) replaces speed and acceleration."""
    arm = program.robot.arm
    goal = _joints(program, q, "movej")
    speed, acceleration = _pace(arm.q, goal, a, v, t)
    number(r, "movej: r")
    return _follow(program, JointMove(arm.dh, goal, speed, acceleration))


@function()
def movel(program: "Program", pose: object, a: object = 1.2, v: object = 0.25, t: object = 0, r: object = 0) -> Cycles:
    """Move the TCP along a straight line."""
    robot = program.robot
    if number(t, "movel: t") > 0:
        raise ScriptError("movel with a time is not modelled by this emulator")
    number(r, "movel: r")
    if type(pose) is Pose:
        goal = matrix_of(six(pose, "movel", Pose))
    else:
        goal = forward(robot.arm.dh, six(pose, "movel")) @ robot.X_flange_tcp
    speed, acceleration = number(v, "movel: v"), number(a, "movel: a")
    return _follow(program, LineMove(robot.arm.dh, robot.X_flange_tcp, goal, speed, acceleration))


def _pace(start: Vector6, goal: Vector6, a: object, v: object, t: object) -> tuple[float, float]:
    seconds = number(t, "movej: t")
    if seconds <= 0:
        return number(v, "movej: v"), number(a, "movej: a")
    way = max(1e-9, *(abs(x - y) for x, y in zip(start, goal, strict=True)))
    return 1.25 * way / seconds, 6.25 * way / seconds**2  # a fifth of the time to speed up, a fifth to slow down


@function()
def stopj(program: "Program", a: object) -> Cycles:
    """Slow down the joints."""
    arm, owner = program.robot.arm, program.owner
    arm.stop_joints(number(a, "stopj"), owner)
    yield from arm.until_finished(owner)


@function()
def stopl(program: "Program", a: object, aRot: object = None) -> Cycles:  # its name in URScript
    """Slow down the tool."""
    del aRot
    arm, owner = program.robot.arm, program.owner
    arm.stop_tool(number(a, "stopl"), owner)
    yield from arm.until_finished(owner)


# -- time and messages ------------------------------------------------------------------------------------------------


@function()
def sync(program: "Program") -> Cycles:
    """Use up this cycle."""
    del program
    yield


@function()
def sleep(program: "Program", t: object) -> Cycles:
    """Wait in the controller's time."""
    robot = program.robot
    for _ in range(math.ceil(number(t, "sleep") / (robot.period_s * robot.settings.time_scale) - 1e-9)):
        yield


@function()
def textmsg(program: "Program", s1: object, s2: object = "") -> None:
    """Write into the log of the pendant."""
    program.robot.note("program", "textmsg", why=shown(s1) + shown(s2))


@function()
def popup(
    program: "Program",
    s: object,
    title: object = "Popup",
    warning: bool = False,
    error: bool = False,
    blocking: bool = False,
) -> Cycles:
    """Show a message; a blocking one holds this thread until somebody closes it."""
    robot = program.robot
    robot.popup = text = shown(s)
    robot.note("program", "popup", why=text, title=title, warning=warning, error=error, blocking=blocking)
    while blocking and robot.popup is not None:
        yield


@function("enter_critical", "exit_critical")
def critical(program: "Program") -> None:
    """Threads here run one after the other anyway, up to their next cycle."""
    del program


# -- state ------------------------------------------------------------------------------------------------------------


@function()
def get_actual_joint_positions(program: "Program") -> list[float]:
    """Joint angles, rad."""
    return list(program.robot.arm.actual_q)


@function()
def get_target_joint_positions(program: "Program") -> list[float]:
    """Set-points, rad."""
    return list(program.robot.arm.q)


@function()
def get_actual_joint_speeds(program: "Program") -> list[float]:
    """Joint speeds, rad/s."""
    return list(program.robot.arm.actual_qd)


@function()
def get_target_joint_speeds(program: "Program") -> list[float]:
    """Speeds of the set-points, rad/s."""
    return list(program.robot.arm.qd)


@function()
def get_actual_tcp_pose(program: "Program") -> Pose:
    """Pose of the active TCP in base."""
    return Pose(program.robot.tcp_pose("actual"))


@function()
def get_target_tcp_pose(program: "Program") -> Pose:
    """Pose of the active TCP in base at the set-points."""
    return Pose(program.robot.tcp_pose("target"))


@function()
def get_actual_tool_flange_pose(program: "Program") -> Pose:
    """Pose of the flange in base."""
    return Pose(pose_of(forward(program.robot.arm.dh, program.robot.arm.actual_q)))


@function()
def get_actual_tcp_speed(program: "Program") -> list[float]:
    """Speed of the active TCP, m/s and rad/s, base axes."""
    return list(program.robot.tcp_speed("actual"))


@function()
def get_tcp_force(program: "Program") -> list[float]:
    """Wrench at the TCP, base axes."""
    return list(program.robot.tcp_wrench())


@function()
def get_tcp_offset(program: "Program") -> Pose:
    """Active TCP in the flange frame."""
    return Pose(program.robot.tcp_offset)


@function()
def get_steptime(program: "Program") -> float:
    """Length of a cycle, s."""
    return program.robot.period_s


@function()
def is_steady(program: "Program") -> bool:
    """Whether the arm has stood still for half a second."""
    return program.robot.steady


@function()
def get_forward_kin(program: "Program", q: object = None, tcp: object = None) -> Pose:
    """Pose of the TCP at joint angles."""
    robot = program.robot
    X_flange_tcp = robot.X_flange_tcp if tcp is None else matrix_of(six(tcp, "get_forward_kin", Pose))
    joints = robot.arm.actual_q if q is None else six(q, "get_forward_kin")
    return Pose(pose_of(forward(robot.arm.dh, joints) @ X_flange_tcp))


@function()
def get_inverse_kin(program: "Program", x: object, qnear: object = None) -> list[float]:
    """Joint angles of a pose of the TCP."""
    near = None if qnear is None else six(qnear, "get_inverse_kin")
    if type(x) is not Pose:
        raise ScriptError(f"get_inverse_kin needs a pose, not {x!r}")
    return list(_joints(program, x, "get_inverse_kin", near))


@function()
def is_within_safety_limits(program: "Program", goal: object) -> bool:
    """Whether the arm may stand at joint angles or a pose."""
    robot = program.robot
    if type(goal) is Pose:
        q = inverse(robot.arm.dh, _flange(program, goal, "is_within_safety_limits"), robot.arm.actual_q)
        return q is not None and robot.limits.allow(q, robot.X_flange_tcp)
    return robot.limits.allow(six(goal, "is_within_safety_limits"), robot.X_flange_tcp)


# -- settings ---------------------------------------------------------------------------------------------------------


@function()
def set_tcp(program: "Program", pose: object) -> None:
    """Change the active TCP."""
    program.robot.tcp_offset = six(pose, "set_tcp", Pose)


@function()
def set_payload(program: "Program", m: object, cog: object = None) -> None:
    """Tell the controller what it carries."""
    program.robot.payload_kg = number(m, "set_payload")
    if cog is not None:
        if type(cog) is not list or len(cog) != 3:
            raise ScriptError(f"set_payload: the centre of gravity must be three numbers, not {cog!r}")
        x, y, z = (number(v, "set_payload") for v in cog)
        program.robot.payload_cog_m = (x, y, z)


@function()
def zero_ftsensor(program: "Program") -> None:
    """Take the present wrench as zero."""
    program.robot.zero_ft()


@function()
def protective_stop(program: "Program") -> Cycles:
    """Stop, as at a collision."""
    program.robot.protective_stop("the program asked for it")
    yield


@function()
def rtde_set_watchdog(
    program: "Program", variable_name: object, min_frequency: object, action: object = "pause"
) -> None:
    """Stop the program when an input register is not written often enough."""
    if action != "stop":
        raise ScriptError(f"rtde_set_watchdog: the action {action!r} is not modelled by this emulator")
    program.robot.set_watchdog(str(variable_name), number(min_frequency, "rtde_set_watchdog"))


# -- registers --------------------------------------------------------------------------------------------------------


def _register(address: object) -> int:
    if type(address) is not int or not 0 <= address < REGISTERS:
        raise ScriptError(f"there is no register {address!r}: they are 0 to {REGISTERS - 1}")
    return address


@function()
def read_input_integer_register(program: "Program", address: object) -> int:
    """Read what a client wrote."""
    return program.robot.input_int(_register(address))


@function()
def read_input_float_register(program: "Program", address: object) -> float:
    """Read what a client wrote."""
    return program.robot.input_double(_register(address))


@function()
def read_output_integer_register(program: "Program", address: object) -> int:
    """Read what a program wrote."""
    return program.robot.output_ints[_register(address)]


@function()
def read_output_float_register(program: "Program", address: object) -> float:
    """Read what a program wrote."""
    return program.robot.output_doubles[_register(address)]


@function()
def write_output_integer_register(program: "Program", address: object, value: object) -> None:
    """Tell clients a whole number."""
    if type(value) is not int or not -(2**31) <= value < 2**31:
        raise ScriptError(f"write_output_integer_register: {value!r} is no whole number of 32 bits")
    program.robot.output_ints[_register(address)] = value


@function()
def write_output_float_register(program: "Program", address: object, value: object) -> None:
    """Tell clients a number."""
    program.robot.output_doubles[_register(address)] = float(number(value, "write_output_float_register"))


@function("set_standard_digital_out", "set_configurable_digital_out", "set_tool_digital_out", "set_digital_out")
def set_digital_out(program: "Program", n: object, b: object) -> None:
    """Switch an output, which nothing is connected to."""
    program.robot.note("program", "digital output", number=n, on=b)


# -- mathematics ------------------------------------------------------------------------------------------------------


def _of_numbers(name: str, calculate: Callable[..., float], count: int = 1) -> None:
    def called(_program: "Program", *values: object) -> float:
        if len(values) != count:
            raise ScriptError(f"{name} takes {count} numbers, not {len(values)}")
        try:
            return calculate(*(number(value, name) for value in values))
        except (ValueError, OverflowError) as error:
            raise ScriptError(f"{name}{values}: {error}") from None

    FUNCTIONS[name] = called


for _name in ("floor", "ceil", "sqrt", "sin", "cos", "tan", "asin", "acos", "atan"):
    _of_numbers(_name, getattr(math, _name))
_of_numbers("atan2", math.atan2, 2)
_of_numbers("pow", math.pow, 2)
_of_numbers("log", lambda b, a: math.log(a, b), 2)
_of_numbers("d2r", math.radians)
_of_numbers("r2d", math.degrees)


@function()
def norm(_program: "Program", a: object) -> float:
    """Absolute value of a number, Euclidean length of a list or pose."""
    if isinstance(a, list):
        return math.hypot(*(number(v, "norm") for v in a))
    return abs(number(a, "norm"))


@function("length", "get_list_length")
def length(_program: "Program", v: object) -> int:
    """Count the elements of a list, or the characters of a text."""
    if not isinstance(v, Sequence):
        raise ScriptError(f"length: {v!r} has none")
    return len(v)


@function()
def pose_trans(_program: "Program", p_from: object, p_from_to: object) -> Pose:
    """Chain two poses."""
    X = matrix_of(six(p_from, "pose_trans", Pose)) @ matrix_of(six(p_from_to, "pose_trans", Pose))
    return Pose(pose_of(X))


@function()
def pose_inv(_program: "Program", p_from: object) -> Pose:
    """Turn a pose round."""
    return Pose(pose_of(inverse_matrix(matrix_of(six(p_from, "pose_inv", Pose)))))


@function()
def to_str(_program: "Program", val: object) -> str:
    """Write a value as a text."""
    return shown(val)


@function()
def str_cat(_program: "Program", op1: object, op2: object) -> str:
    """Join two texts."""
    return shown(op1) + shown(op2)
