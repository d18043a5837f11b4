"""The functions of URScript that PolyScope and the programs for this emulator use.

Source: Universal Robots, "The URScript Programming Language", modules motion, internals, urmath, interfaces and
ioconfiguration. The Python signature of each function, after the program, is its signature in URScript. Programs that
PolyScope saved: docs/reference/urscript-constructs.md.

Chosen here:

* The period of `get_steptime` is that of the cell's clock whatever ``--time-scale`` is, so a program that counts cycles
  to watch its client keeps the cell's time. `sleep` and motions keep the time of the arm: where that is K times faster,
  a loop of `servoj` without `sync` runs K times in a cycle.
* `tool_contact` reports the cycle in which a force of `CONTACT_N` opposes the direction; the history of the joints ends
  with the current reading.
* `movec` moves to its end along a straight line. A TCP that is named, instead of given as a pose, is the active one.

Does not model: every other function (its name is a compile error), blends (a radius is taken as 0), force mode,
Modbus, and what `_WITHOUT_EFFECT` lists. Nothing is wired to the analog inputs.
"""

import math
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from inspect import Parameter, Signature
from typing import Any, Protocol

from ftmocks.arrays import Array
from ftmocks.kinematics import Vector6, forward, inverse, inverse_matrix, pose_of, rotvec, vector3, vector6
from ftmocks.ur.controller_program import ScriptError
from ftmocks.ur.motion import CannotFollow, Command, JointMove, LineMove, Path
from ftmocks.ur.robot import Robot
from ftmocks.ur.urscript import urmath
from ftmocks.ur.urscript.threads import Halt
from ftmocks.ur.urscript.values import Pose, Value, joints, number, numbers, text_of, truth, whole_number

Cycles = Generator[None, None, None]
"""A function that takes one control cycle for each value that it yields."""

LOOKAHEAD_S, GAIN = (0.03, 0.2), (100, 2000)
"""Smallest and largest values that servoj accepts."""
LAST_REGISTER, LAST_BIT_REGISTER = 47, 127
DIGITAL: dict[str, Sequence[int]] = {
    "standard_": range(8),
    "configurable_": range(8, 16),
    "tool_": (16, 17),
    "": (*range(8), 16, 17),
}
"""Bits of digital signals, as RTDE numbers them, by the group in the name of a function."""
_WITHOUT_EFFECT = {
    "end_force_mode": "",
    "end_freedrive_mode": "",
    "force_mode": "task_frame selection_vector wrench type limits",
    "force_mode_set_damping": "damping",
    "force_mode_set_gain_scaling": "scaling",
    "freedrive_mode": "freeAxes? feature?",
    "modbus_add_signal": "IP slave_number signal_address signal_type signal_name sequential_mode?",
    "modbus_delete_signal": "signal_name",
    "modbus_set_output_register": "signal_name register_value is_secondary_program?",
    "modbus_set_output_signal": "signal_name digital_value is_secondary_program?",
    "modbus_set_runstate_dependent_choice": "signal_name runstate_choice",
    "modbus_set_signal_update_frequency": "signal_name update_frequency",
    "set_analog_outputdomain": "port domain",
    "set_configurable_digital_input_action": "port action",
    "set_gp_boolean_input_action": "port action",
    "set_input_actions_to_default": "",
    "set_runstate_configurable_digital_output_to_value": "outputId state",
    "set_runstate_gp_boolean_output_to_value": "outputId state",
    "set_runstate_standard_analog_output_to_value": "outputId state",
    "set_runstate_standard_digital_output_to_value": "outputId state",
    "set_runstate_tool_digital_output_to_value": "outputId state",
    "set_safety_mode_transition_hardness": "type",
    "set_standard_analog_input_domain": "port domain",
    "set_standard_digital_input_action": "port action",
    "set_tool_analog_input_domain": "port domain",
    "set_tool_communication": "enabled baud_rate parity stop_bits rx_idle_chars tx_idle_chars",
    "set_tool_digital_input_action": "port action",
    "set_tool_digital_output_mode": "output_id mode",
    "set_tool_output_mode": "mode",
    "set_tool_voltage": "voltage",
}
"""Functions that this emulator accepts and ignores, with their parameters."""
CONTACT_N = 10.0
"""Smallest force for which `tool_contact` reports a contact, N."""
RAMP_SHARE = 0.2
"""Share of the duration of a timed move for the acceleration, and the same share for the deceleration."""


class Caller(Protocol):
    """The program that calls a function."""

    @property
    def robot(self) -> Robot:
        """The controller on which the program runs."""

    @property
    def owner(self) -> str:
        """Name of the calling thread: only one thread at a time may move the arm."""

    def begin_cycle(self) -> None:
        """Give the calling thread a full allowance of statements again, as at the start of a cycle."""


def movej(program: Caller, q: Value, a: Value = 1.4, v: Value = 1.05, t: Value = 0, r: Value = 0) -> Cycles:
    """Move all joints together; a time `t` (s) replaces speed and acceleration."""
    number(r, "movej: r")
    arm, seconds = program.robot.arm, number(t, "movej: t")
    goal = _solved(program.robot, q, "movej: q") if isinstance(q, Pose) else joints(q, "movej: q")
    speed, acceleration = number(v, "movej: v"), number(a, "movej: a")
    if seconds > 0:
        speed, acceleration = _pace(max(abs(x - y) for x, y in zip(arm.q, goal, strict=True)), seconds)
    yield from _followed(program, JointMove(arm.dh, goal, speed, acceleration))


def movel(program: Caller, pose: Value, a: Value = 1.2, v: Value = 0.25, t: Value = 0, r: Value = 0) -> Cycles:
    """Move the TCP along a straight line; a time `t` (s) replaces speed and acceleration."""
    number(r, "movel: r")
    robot, seconds = program.robot, number(t, "movel: t")
    arm, X_flange_tcp = robot.arm, robot.X_flange_tcp
    is_pose = isinstance(pose, Pose)
    X = urmath.matrix(pose, "movel: pose") if is_pose else _base_tcp(robot, joints(pose, "movel: pose"))
    speed, acceleration = number(v, "movel: v"), number(a, "movel: a")
    if seconds > 0:
        start = _base_tcp(robot, arm.q)
        turn = rotvec(X[:3, :3] @ start[:3, :3].T)
        speed, acceleration = _pace(max(math.hypot(*(X - start)[:3, 3]), math.hypot(*turn)), seconds)
    yield from _followed(program, LineMove(arm.dh, X_flange_tcp, X, speed, acceleration))


def movep(program: Caller, pose: Value, a: Value = 1.2, v: Value = 0.25, r: Value = 0) -> Cycles:
    """Move the TCP at constant speed, emulated like `movel`."""
    yield from movel(program, pose, a, v, 0, r)


def movec(
    program: Caller, pose_via: Value, pose_to: Value, a: Value = 1.2, v: Value = 0.25, r: Value = 0, mode: Value = 0
) -> Cycles:
    """Move the TCP to the end of a circular arc, emulated by a straight line."""
    urmath.matrix(pose_via, "movec: pose_via")
    whole_number(mode, "movec: mode", 0, 1)
    yield from movel(program, pose_to, a, v, 0, r)


def _pace(travel: float, seconds: float) -> tuple[float, float]:
    speed = max(1e-9, travel) / (seconds * (1.0 - RAMP_SHARE))
    return speed, speed / (seconds * RAMP_SHARE)


def _flange_tcp(robot: Robot, tcp: Value) -> Array:
    return urmath.matrix(tcp, "tcp") if isinstance(tcp, Pose) else robot.X_flange_tcp


def _base_tcp(robot: Robot, q: Sequence[float], tcp: Value = None) -> Array:
    """Return the frame (4, 4) of a TCP, by default the active one, in base."""
    X: Array = forward(robot.arm.dh, q) @ _flange_tcp(robot, tcp)
    return X


def _solved(robot: Robot, pose: Value, what: str, near: Vector6 | None = None, tcp: Value = None) -> Vector6:
    X_base_flange = urmath.matrix(pose, what) @ inverse_matrix(_flange_tcp(robot, tcp))
    q = inverse(robot.arm.dh, X_base_flange, robot.arm.q if near is None else near)
    if q is None:
        raise ScriptError(f"{what}: no solution for the pose {text_of(pose)}")
    return q


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
        yield  # a protective stop: the program stays paused here
        return
    cycle_s = robot.period_s * robot.settings.time_scale
    while servo.ahead_s > cycle_s - 1e-9:
        yield
    program.begin_cycle()


def stopj(program: Caller, a: Value) -> Cycles:
    """Decelerate the joints to rest."""
    arm, owner = program.robot.arm, program.owner
    arm.stop_joints(number(a, "stopj: a"), owner)
    yield from arm.until_finished(owner)


def stopl(program: Caller, a: Value, aRot: Value = 0) -> Cycles:
    """Decelerate the tool to rest."""
    arm, owner = program.robot.arm, program.owner
    number(aRot, "stopl: aRot")
    arm.stop_tool(number(a, "stopl: a"), owner)
    yield from arm.until_finished(owner)


def sync(_program: Caller) -> Cycles:
    """Wait for the end of this cycle."""
    yield


def sleep(program: Caller, t: Value) -> Cycles:
    """Wait for `t` seconds of the arm's time."""
    robot = program.robot
    for _ in range(math.ceil(number(t, "sleep: t") / (robot.period_s * robot.settings.time_scale) - 1e-9)):
        yield


def textmsg(program: Caller, s1: Value, s2: Value = "") -> None:
    """Write a message to the log of the pendant."""
    program.robot.note("program", "textmsg", why=text_of(s1) + text_of(s2))


def popup(
    program: Caller,
    s: Value,
    title: Value = "Popup",
    warning: Value = False,
    error: Value = False,
    blocking: Value = False,
) -> Cycles:
    """Show a message. A blocking message holds this thread until the operator closes it."""
    robot = program.robot
    robot.popup = text = text_of(s)
    robot.note("program", "popup", why=text, title=title, warning=warning, error=error, blocking=blocking)
    while blocking and robot.popup is not None:
        yield


def _requests() -> Iterator[tuple[str, Callable[[Caller, Value], Generator[None, None, Value]]]]:
    """Yield the functions that ask the operator for a value and wait for it; no answer ends the program."""
    for name, kind in {"boolean": bool, "float": float, "integer": int, "string": str}.items():

        def request(program: Caller, message: Value, kind: type = kind) -> Generator[None, None, Value]:
            program.robot.popup_answer = None
            yield from popup(program, message, "Input", blocking=True)
            if program.robot.popup_answer is None:
                raise Halt
            return kind(program.robot.popup_answer)

        yield f"request_{name}_from_primary_client", request


def get_actual_joint_positions(program: Caller) -> list[float]:
    """Return the joint angles, rad."""
    return list(program.robot.measured_q)


def get_actual_joint_positions_history(program: Caller, steps: Value = 0) -> list[float]:
    """Return the joint angles of some cycles ago, rad; the emulator returns the current ones."""
    whole_number(steps, "get_actual_joint_positions_history: steps", 0, 2**31 - 1)
    return get_actual_joint_positions(program)


def get_actual_tcp_pose(program: Caller) -> Pose:
    """Return the pose of the TCP in base."""
    return Pose(program.robot.tcp_pose("actual"))


def get_target_tcp_pose(program: Caller) -> Pose:
    """Return the pose of the TCP in base at the set-point."""
    return Pose(program.robot.tcp_pose("target"))


def get_actual_tcp_speed(program: Caller) -> list[float]:
    """Return the velocity of the TCP, m/s and rad/s, base axes."""
    return list(program.robot.tcp_speed("actual"))


def get_target_tcp_speed(program: Caller) -> list[float]:
    """Return the velocity of the TCP at the set-point, m/s and rad/s, base axes."""
    return list(program.robot.tcp_speed("target"))


def get_tcp_force(program: Caller) -> list[float]:
    """Return the wrench at the TCP, N and N·m, base axes."""
    return list(program.robot.tcp_wrench())


def force(program: Caller) -> float:
    """Return the norm of the force at the TCP, N."""
    return math.hypot(*program.robot.tcp_wrench()[:3])


def tool_contact(program: Caller, direction: Value = None) -> int:
    """Return 1 while a force opposes a velocity of the tool (base axes; None: any direction), else 0."""
    pushed = program.robot.tcp_wrench()[:3]
    towards = [0.0] * 6 if direction is None else numbers(direction, "tool_contact: direction", 6)
    speed = math.hypot(*towards[:3])
    along = sum(a * b for a, b in zip(pushed, towards, strict=False))
    against = -along / speed if speed else math.hypot(*pushed)
    return int(against > CONTACT_N)


def get_forward_kin(program: Caller, q: Value = None, tcp: Value = None) -> Pose:
    """Return the pose of the TCP in base at joint angles, by default the current ones."""
    robot = program.robot
    at = robot.measured_q if q is None else joints(q, "get_forward_kin: q")
    return Pose(pose_of(_base_tcp(robot, at, tcp)))


def get_inverse_kin(
    program: Caller,
    x: Value,
    qnear: Value = None,
    maxPositionError: Value = 1e-10,
    maxOrientationError: Value = 1e-10,
    tcp: Value = None,
) -> list[float]:
    """Return the joint angles (rad) nearest to `qnear`, by default to the current ones, for a pose of the TCP."""
    number(maxPositionError, "get_inverse_kin: maxPositionError")
    number(maxOrientationError, "get_inverse_kin: maxOrientationError")
    near = None if qnear is None else joints(qnear, "get_inverse_kin: qnear")
    return list(_solved(program.robot, x, "get_inverse_kin: x", near, tcp))


def get_target_joint_positions(program: Caller) -> list[float]:
    """Return the joint angles of the set-point, rad."""
    return list(program.robot.arm.q)


def get_target_joint_speeds(program: Caller) -> list[float]:
    """Return the joint speeds of the set-point, rad/s."""
    return list(program.robot.arm.qd)


def get_tcp_offset(program: Caller) -> Pose:
    """Return the pose of the active TCP in the flange frame."""
    return Pose(program.robot.tcp_offset)


def set_tcp(program: Caller, pose: Value, tcp_name: Value = "") -> None:
    """Set the active TCP in the flange frame. Its name is only shown on the pendant."""
    if not isinstance(tcp_name, str):
        raise ScriptError(f"set_tcp: tcp_name must be a text, not {text_of(tcp_name)}")
    urmath.matrix(pose, "set_tcp: pose")
    program.robot.tcp_offset = vector6(pose)


def get_steptime(program: Caller) -> float:
    """Return the length of a cycle on the cell's clock, s."""
    return program.robot.period_s


def is_steady(program: Caller) -> bool:
    """Return whether the arm has been at rest for half a second."""
    return program.robot.steady


def is_within_safety_limits(program: Caller, q: Value) -> bool:
    """Return whether the arm may be at the joint angles `q`."""
    robot = program.robot
    return robot.limits.allow(joints(q, "is_within_safety_limits: q"), robot.X_flange_tcp)


def set_payload_mass(program: Caller, m: Value) -> None:
    """Set the mass on the flange, kg."""
    program.robot.payload_kg = number(m, "set_payload_mass: m")


def set_payload_cog(program: Caller, CoG: Value) -> None:
    """Set the centre of the mass on the flange, m, flange frame."""
    program.robot.payload_cog_m = vector3(numbers(CoG, "set_payload_cog: CoG", 3))


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
    """Set the upward acceleration that the controller assumes for gravity, m/s², base axes."""
    program.robot.target_gravity_m_s2 = vector3(numbers(d, "set_gravity: d", 3))


def zero_ftsensor(program: Caller) -> None:
    """Zero the force/torque sensor: subtract its current reading from later ones."""
    program.robot.zero_ft()


def read_input_integer_register(program: Caller, address: Value) -> int:
    """Return the number that a client wrote into this input register."""
    return program.robot.input_int(_register(address))


def read_input_float_register(program: Caller, address: Value) -> float:
    """Return the number that a client wrote into this input register."""
    return program.robot.input_double(_register(address))


def read_output_integer_register(program: Caller, address: Value) -> int:
    """Return the number that a program wrote into this output register."""
    return program.robot.output_ints[_register(address)]


def write_output_integer_register(program: Caller, address: Value, value: Value) -> None:
    """Write a number into this output register, which the clients read."""
    what = "write_output_integer_register: value"
    program.robot.output_ints[_register(address)] = whole_number(value, what, -(2**31), 2**31 - 1)


def write_output_float_register(program: Caller, address: Value, value: Value) -> None:
    """Write a number into this output register, which the clients read."""
    program.robot.output_doubles[_register(address)] = float(number(value, "write_output_float_register: value"))


def read_output_boolean_register(program: Caller, address: Value) -> bool:
    """Return the bit that a program wrote into this output register."""
    return bool(program.robot.signals.registers >> _bit_register(address) & 1)


def write_output_boolean_register(program: Caller, address: Value, value: Value) -> None:
    """Write a bit into this output register, which the clients read."""
    program.robot.signals.registers = _with_bit(program.robot.signals.registers, _bit_register(address), value)


def _bit_register(address: Value) -> int:
    return whole_number(address, "the address of a register", 0, LAST_BIT_REGISTER)


def _with_bit(bits: int, place: int, value: Value) -> int:
    return bits | 1 << place if truth(value) else bits & ~(1 << place)


def _digital_signals() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Yield the functions that read and set digital inputs and outputs."""
    for group, places in DIGITAL.items():

        def place_of(n: Value, places: Sequence[int] = places) -> int:
            return places[whole_number(n, "the number of a digital signal", 0, len(places) - 1)]

        def read_input(program: Caller, n: Value, place_of: Callable[[Value], int] = place_of) -> bool:
            return bool(program.robot.signals.inputs >> place_of(n) & 1)

        def read_output(program: Caller, n: Value, place_of: Callable[[Value], int] = place_of) -> bool:
            return bool(program.robot.signals.outputs >> place_of(n) & 1)

        def write(program: Caller, n: Value, b: Value, place_of: Callable[[Value], int] = place_of) -> None:
            program.robot.signals.outputs = _with_bit(program.robot.signals.outputs, place_of(n), b)

        yield f"get_{group}digital_in", read_input
        yield f"get_{group}digital_out", read_output
        yield f"set_{group}digital_out", write


def get_standard_analog_in(_program: Caller, n: Value) -> float:
    """Return the level of an analog input, to which nothing is connected."""
    whole_number(n, "the number of an analog input", 0, 3)
    return 0.0


def get_standard_analog_out(program: Caller, n: Value) -> float:
    """Return the level of an analog output, 0 to 1."""
    return program.robot.signals.analog_outputs[whole_number(n, "the number of an analog output", 0, 1)]


def set_standard_analog_out(program: Caller, n: Value, f: Value) -> None:
    """Set the level of an analog output, 0 to 1."""
    level = number(f, "set_standard_analog_out: f")
    program.robot.signals.analog_outputs[whole_number(n, "the number of an analog output", 0, 1)] = level


class _WithoutEffect:
    """A function that only checks its arguments; `?` in `parameters` marks an optional argument."""

    def __init__(self, parameters: str) -> None:
        self.__signature__ = Signature(
            [
                Parameter(
                    name.rstrip("?"),
                    Parameter.POSITIONAL_OR_KEYWORD,
                    default=None if name.endswith("?") else Parameter.empty,
                )
                for name in ("program", *parameters.split())
            ]
        )

    def __call__(self, *_args: Value, **_named: Value) -> None:
        """Do nothing."""


def _register(address: Value) -> int:
    return whole_number(address, "the address of a register", 0, LAST_REGISTER)


Built_in = Callable[..., Any]
_NAMED: tuple[Built_in, ...] = (movej, movel, movep, movec, servoj, stopj, stopl, sync, sleep, textmsg, popup)
_NAMED += (get_actual_joint_positions, get_target_joint_positions, get_target_joint_speeds, get_tcp_offset)
_NAMED += (get_actual_tcp_pose, get_target_tcp_pose, get_actual_tcp_speed, get_target_tcp_speed, get_tcp_force, force)
_NAMED += (get_forward_kin, get_inverse_kin, tool_contact, get_actual_joint_positions_history)
_NAMED += (get_steptime, is_steady, is_within_safety_limits, zero_ftsensor)
_NAMED += (set_tcp, set_payload, set_payload_mass, set_payload_cog, set_target_payload, set_gravity)
_NAMED += (read_input_integer_register, read_input_float_register, read_output_integer_register)
_NAMED += (write_output_integer_register, write_output_float_register)
_NAMED += (read_output_boolean_register, write_output_boolean_register)
_NAMED += (get_standard_analog_in, get_standard_analog_out, set_standard_analog_out)
_NAMED += (urmath.atan2, urmath.pow, urmath.length, urmath.norm, urmath.normalize, urmath.point_dist)
_NAMED += (urmath.pose_trans, urmath.pose_inv, urmath.pose_add, urmath.pose_sub, urmath.interpolate_pose)
_FUNCTIONS: dict[str, Built_in] = {
    **{function.__name__: function for function in _NAMED},
    **{name: _WithoutEffect(parameters) for name, parameters in _WITHOUT_EFFECT.items()},
    **dict(urmath.functions_of_a_number()),
    **dict(_requests()),
    **dict(_digital_signals()),
    "get_analog_in": get_standard_analog_in,
    "get_tool_analog_in": get_standard_analog_in,
    "set_analog_out": set_standard_analog_out,
    "get_target_waypoint": get_target_tcp_pose,
    "tool_pose": get_target_tcp_pose,
}
_NEVER = 1000
_SINCE = {
    "get_actual_joint_positions_history": {3: _NEVER, 5: 4},
    "set_target_payload": {3: 15, 5: 10},
    "set_tool_communication": {3: _NEVER},
    "set_tool_digital_output_mode": {3: _NEVER},
    "set_tool_output_mode": {3: _NEVER},
    "tool_contact": {3: _NEVER, 5: 4},
}
"""For each function, the first minor version of PolyScope that has it, by major version."""


def functions(polyscope: tuple[int, int, int]) -> Mapping[str, Built_in]:
    """Return the functions that a version of PolyScope knows, by name."""
    major, minor, _bugfix = polyscope
    return {name: called for name, called in _FUNCTIONS.items() if minor >= _SINCE.get(name, {}).get(major, 0)}
