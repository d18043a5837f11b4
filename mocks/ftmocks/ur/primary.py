"""Wire format of the packages that the controller sends on ports 30001 and 30002. It uses no sockets.

Every package starts with its size (int32, this field included) and its type (uint8): 16 is a robot state, a sequence
of sub-packages with a size (uint32) and a type (uint8) each; 20 is a message with a timestamp (uint64), a source (int8)
and a type (uint8). All numbers are big-endian. A client skips types that it does not know. The secondary interface
has states and the greeting, but no messages of programs.

Source: Universal Robots, "Remote Control via TCP/IP" (client interfaces) and the parsers of its client library
(BSD, fields and types only); recorded streams of URSim in the tests of that library and in the README of robotlab
(Pharmaceutical Bioinformatics, Uppsala): timestamps, sources, wording, which sub-packages come once. A maintainer of
the client library on local control (issue 459 of the ROS driver): connections end when the pendant is switched to
local control; one opened in local control can only read, also later; a program sent there is answered by the error
C210 and not executed. Commands other than programs: the client library's primary client. The packages of the greeting
after the version: logs of port 30002 in the README of Shawn-Armstrong/URSim_Demo (5.13), and in published clients of
a UR5 with 3.10 and of an e-Series arm with 5.12.

Chosen here, where the sources are silent:

* Timestamps are microseconds of the controller's clock; the greeting and compile errors have none (all bits set).
* No source explains message 12, the second of a greeting. It has the numbers of the logs of 5.12 and 5.13. The log of
  3.10 has 510 and 259 in place of the two zeros.
* The tolerances, package 24, follow in every version. Only the log of 3.10 is long enough to show them.
* Kinematics and configuration come in the first state of a connection only, the parts that are not modelled in each.
* C210 has argument 0, level warning and no text, and goes to the client that sent the program.
* A run-time error is the message of an exception with line, column and text, then ``PROGRAM_XXX_STOPPED``. It has the
  position of the call, else of the statement.
* A program that may not start now (robot or safety mode) is dropped, and nothing is sent.
* A safety mode is sent when it changes, with code, argument and data 0.
* The checksum of a joint is the CRC-32 of its parameters; a nominal arm has all bits set, as URSim.
"""

import struct
import zlib
from collections.abc import Callable, Sequence

from ftmocks.kinematics import MODELS, Dh
from ftmocks.ur import dashboard
from ftmocks.ur.events import Event
from ftmocks.ur.modes import JOINT_MODES, JOINT_POWER_OFF, POWERED, SAFETY_BITS, Runtime, SafetyMode
from ftmocks.ur.robot import Robot

STATES_HZ = 10
BUILD_DATE = "24-03-2022, 12:00:00"

ROBOT_STATE, ROBOT_MESSAGE, TOLERANCES = 16, 20, 24
MODE_DATA, JOINT_DATA, CARTESIAN_INFO, KINEMATICS_INFO, CONFIGURATION_DATA = 0, 1, 4, 5, 6
NOT_MODELLED = {2: 32, 3: 70, 7: 56, 8: 4, 9: 48, 10: 38, 11: 21, 12: 3}
"""Sub-packages of a state that are filled with zeros: type, and size of the content."""
TEXT, VERSION, SAFETY_MODE, ERROR_CODE, KEY, RUNTIME_EXCEPTION, UNEXPLAINED = 0, 3, 5, 6, 7, 10, 12
FROM_CONTROLLER, FROM_PROGRAM = -2, -3
NO_TIMESTAMP = 2**64 - 1
READ_ONLY_CODE = 210
WARNING = 2

ROBOT_TYPES = {"UR5": 1, "UR10": 2, "UR3": 3, "UR16": 4, "UR20": 7, "UR30": 8}
SUB_TYPES = {False: 2, True: 3}
"""Sub-type of the robot for a CB3 arm and for an e-Series arm."""
JOINT_ACCELERATION_RAD_S2 = 40.0
DEFAULTS = (1.0471975511965976, 1.3962634015954636, 0.25, 1.2, 0.25)
"""Default joint speed and acceleration, tool speed and acceleration, and radius of a joint, in rad, m and s."""

COMPLIANCE = (0.15, 25.0, 0.0, 3.0, *[0.2] * 6, *[0.052359878] * 6, 0.0, 0.0, 0.0, 0.01745329, 0.001, 0.01)
"""Content of the primary interface's package 24, as recorded from a controller with version 3.10."""

_MESSAGE = struct.Struct(">iBQbB")
_EMERGENCY_BIT, _PROTECTIVE_BIT = 0x80, 0x04

COMMANDS: dict[str, Callable[[Robot], object]] = {
    "stop program": lambda robot: robot.stop_program("stop program"),
    "power on": Robot.power_on,
    "power off": Robot.power_off,
    "set robotmode run": Robot.brake_release,
    "set unlock protective stop": Robot.unlock,
}
"""Commands to the controller that are sent like programs."""


def message(kind: int, payload: bytes, timestamp: int, source: int = FROM_CONTROLLER) -> bytes:
    """Return the bytes of the package that holds a message."""
    return _MESSAGE.pack(_MESSAGE.size + len(payload), ROBOT_MESSAGE, timestamp, source, kind) + payload


def greeting(robot: Robot) -> bytes:
    """Return the greeting: version, message 12, tolerances, and a complete state."""
    second = message(UNEXPLAINED, struct.pack(">iiB", 0, 0, 1), NO_TIMESTAMP)
    tolerances = struct.pack(">iB", 5 + 8 * len(COMPLIANCE), TOLERANCES) + _doubles(COMPLIANCE)
    return version_message(robot) + second + tolerances + state_package(robot, complete=True)


def version_message(robot: Robot) -> bytes:
    """Return the first message of a connection: the version."""
    major, minor, bugfix = robot.settings.polyscope
    project = b"URControl"
    numbers = struct.pack(">BBii", major, minor, bugfix, dashboard.BUILD)
    return message(VERSION, bytes([len(project)]) + project + numbers + BUILD_DATE.encode(), NO_TIMESTAMP)


def read_only_error(robot: Robot) -> bytes:
    """Return the answer to a program on a read-only connection."""
    return message(ERROR_CODE, struct.pack(">iiiII", READ_ONLY_CODE, 0, WARNING, 0, 0), _us(robot.timestamp_s))


def messages_of(event: Event) -> bytes:
    """Return the messages that clients receive for an entry of the event log, possibly none."""
    at = _us(event.t_robot_s)
    word, _, name = event.what.partition(" ")
    if event.by == "safety":
        return message(SAFETY_MODE, struct.pack(">iiBII", 0, 0, SafetyMode[event.what], 0, 0), at)
    if word == "program" and "error" in event.detail:
        return _exception(event, NO_TIMESTAMP)
    if event.by != "program" or not event.accepted:
        return b""
    if word == "textmsg":
        return message(TEXT, _text(event.why), at, FROM_PROGRAM)
    if word == "started":
        return _key("PROGRAM_XXX_STARTED", name, at)
    if word == "stopped":
        error = _exception(event, at) if "error" in event.detail else b""
        return error + _key("PROGRAM_XXX_STOPPED", name, at)
    return b""


def _exception(event: Event, timestamp: int) -> bytes:
    place = struct.pack(">ii", event.detail["line"], event.detail["column"])
    return message(RUNTIME_EXCEPTION, place + _text(event.detail["error"]), timestamp, FROM_PROGRAM)


def _key(title: str, text: str, timestamp: int) -> bytes:
    payload = struct.pack(">iiB", 0, 0, len(title)) + _text(title + text)
    return message(KEY, payload, timestamp, FROM_PROGRAM)


def _text(text: str) -> bytes:
    """Return the bytes of a text that may quote a program, which was decoded as Latin-1."""
    return text.encode("latin-1", "replace")


def _us(seconds: float) -> int:
    return round(1e6 * seconds)


def state_package(robot: Robot, *, complete: bool = False) -> bytes:
    """Return the robot state. A complete state includes kinematics and configuration."""
    parts = {MODE_DATA: _mode_data(robot), JOINT_DATA: _joint_data(robot), CARTESIAN_INFO: _cartesian_info(robot)}
    if complete:
        if robot.reported_dh is not None:
            parts[KINEMATICS_INFO] = _kinematics_info(robot.reported_dh)
        parts[CONFIGURATION_DATA] = _configuration_data(robot)
    parts |= {kind: bytes(size) for kind, size in NOT_MODELLED.items()}
    body = b"".join(struct.pack(">IB", 5 + len(part), kind) + part for kind, part in parts.items())
    return struct.pack(">iB", 5 + len(body), ROBOT_STATE) + body


def _mode_data(robot: Robot) -> bytes:
    bits = SAFETY_BITS[robot.safety_mode]
    flags = (
        True,  # first two flags: real robot connected, and enabled
        True,
        robot.robot_mode in POWERED,
        bool(bits & _EMERGENCY_BIT),
        bool(bits & _PROTECTIVE_BIT),
        robot.runtime == Runtime.PLAYING,
        robot.runtime == Runtime.PAUSED,
    )
    position_control = 0
    mode = struct.pack(">Q7?bB", _us(robot.timestamp_s), *flags, robot.robot_mode, position_control)
    return mode + struct.pack(">3dB", robot.arm.speed_fraction, robot.arm.pace, 1.0, 0)


def _joint_data(robot: Robot) -> bytes:
    arm, mode = robot.arm, JOINT_MODES.get(robot.robot_mode, JOINT_POWER_OFF)
    return b"".join(
        struct.pack(">3d4fB", actual, target, speed, 0.0, 48.0, 28.0, 0.0, mode)
        for actual, target, speed in zip(robot.measured_q, arm.q, arm.actual_qd, strict=True)
    )


def _cartesian_info(robot: Robot) -> bytes:
    return struct.pack(">12d", *robot.tcp_pose("actual"), *robot.tcp_offset)


def _kinematics_info(dh: Dh) -> bytes:
    nominal = dh == MODELS[dh.model]
    alpha = [round(angle, 9) for angle in dh.alpha] if nominal else dh.alpha  # URSim reports pi / 2 as 1.570796327
    parameters = (dh.theta, dh.a, dh.d, alpha)
    checksums = [0xFFFFFFFF if nominal else zlib.crc32(_doubles(joint)) for joint in zip(*parameters, strict=True)]
    return struct.pack(">6I", *checksums) + b"".join(map(_doubles, parameters)) + struct.pack(">I", 0)


def _configuration_data(robot: Robot) -> bytes:
    dh, limit_rad, model = robot.arm.dh, robot.settings.joint_limit_rad, robot.settings.model
    motion = [value for speed in dh.max_speed for value in (speed, JOINT_ACCELERATION_RAD_S2)]
    lengths = b"".join(map(_doubles, (dh.a, dh.d, dh.alpha, dh.theta)))
    masterboard, control_box = 6, 4
    kinds = (masterboard, control_box, ROBOT_TYPES[model.rstrip("e")], SUB_TYPES[robot.settings.polyscope[0] > 3])
    return _doubles([-limit_rad, limit_rad] * 6 + motion + list(DEFAULTS)) + lengths + struct.pack(">4i", *kinds)


def _doubles(values: Sequence[float]) -> bytes:
    return struct.pack(f">{len(values)}d", *values)
