"""RTDE variables: names, types, and functions that read or write them.

Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", tables of controller outputs and inputs.
"""

from collections.abc import Callable

import numpy as np

from ftmocks.kinematics import ZERO6, forward
from ftmocks.ur.modes import JOINT_MODES, JOINT_POWER_OFF, POWERED, SAFETY_BITS, Runtime
from ftmocks.ur.robot import Robot
from ftmocks.ur.rtde import Value

Reader = Callable[[Robot], Value]


def _status_bits(robot: Robot) -> int:
    """Return the robot status bits: bit 0 power on, bit 1 program running, bit 3 power button pressed."""
    return int(robot.robot_mode in POWERED) | (robot.runtime == Runtime.PLAYING) << 1


def _joint_mode(robot: Robot) -> Value:
    return (JOINT_MODES.get(robot.robot_mode, JOINT_POWER_OFF),) * 6


def _accelerometer(robot: Robot) -> Value:
    """Return the reading (3,) of the tool accelerometer at rest, in tool axes: the negative gravity."""
    R_base_flange = forward(robot.arm.dh, robot.world.q)[:3, :3]
    x, y, z = (-R_base_flange.T @ robot.world.truth.gravity_m_s2).tolist()
    return (x, y, z)


def _fixed(value: Value) -> Reader:
    return lambda _robot: value


OUTPUTS: dict[str, tuple[str, Reader]] = {
    "timestamp": ("DOUBLE", lambda r: r.timestamp_s),
    "target_q": ("VECTOR6D", lambda r: r.arm.q),
    "target_qd": ("VECTOR6D", lambda r: r.arm.qd),
    "target_qdd": ("VECTOR6D", lambda r: r.arm.qdd),
    "target_current": ("VECTOR6D", _fixed(ZERO6)),
    "target_moment": ("VECTOR6D", _fixed(ZERO6)),
    "actual_q": ("VECTOR6D", lambda r: r.measured_q),
    "actual_qd": ("VECTOR6D", lambda r: r.arm.actual_qd),
    "actual_current": ("VECTOR6D", _fixed(ZERO6)),
    "actual_current_as_torque": ("VECTOR6D", _fixed(ZERO6)),
    "joint_control_output": ("VECTOR6D", _fixed(ZERO6)),
    "actual_TCP_pose": ("VECTOR6D", lambda r: r.tcp_pose("actual")),
    "actual_TCP_speed": ("VECTOR6D", lambda r: r.tcp_speed("actual")),
    "actual_TCP_force": ("VECTOR6D", lambda r: r.tcp_wrench()),
    "target_TCP_pose": ("VECTOR6D", lambda r: r.tcp_pose("target")),
    "target_TCP_speed": ("VECTOR6D", lambda r: r.tcp_speed("target")),
    "tcp_force_scalar": ("DOUBLE", lambda r: float(np.linalg.norm(r.tcp_wrench()[:3]))),
    "actual_digital_input_bits": ("UINT64", lambda r: r.signals.inputs),
    "actual_digital_output_bits": ("UINT64", lambda r: r.signals.outputs),
    "joint_temperatures": ("VECTOR6D", _fixed((28.0, 29.0, 29.5, 31.0, 32.0, 33.0))),
    "actual_execution_time": ("DOUBLE", _fixed(0.0)),
    "robot_mode": ("INT32", lambda r: int(r.robot_mode)),
    "joint_mode": ("VECTOR6INT32", _joint_mode),
    "safety_mode": ("INT32", lambda r: int(r.safety_mode)),
    "safety_status": ("INT32", lambda r: int(r.safety_mode)),
    "actual_tool_accelerometer": ("VECTOR3D", _accelerometer),
    "speed_scaling": ("DOUBLE", lambda r: r.arm.pace),
    "target_speed_fraction": ("DOUBLE", lambda r: r.arm.speed_fraction),
    "actual_momentum": ("DOUBLE", _fixed(0.0)),
    "actual_main_voltage": ("DOUBLE", _fixed(48.0)),
    "actual_robot_voltage": ("DOUBLE", _fixed(48.0)),
    "actual_robot_current": ("DOUBLE", _fixed(0.5)),
    "actual_joint_voltage": ("VECTOR6D", _fixed((48.0,) * 6)),
    "runtime_state": ("UINT32", lambda r: int(r.runtime)),
    "standard_analog_input0": ("DOUBLE", _fixed(0.0)),
    "standard_analog_input1": ("DOUBLE", _fixed(0.0)),
    "standard_analog_output0": ("DOUBLE", lambda r: r.signals.analog_outputs[0]),
    "standard_analog_output1": ("DOUBLE", lambda r: r.signals.analog_outputs[1]),
    "robot_status_bits": ("UINT32", _status_bits),
    "safety_status_bits": ("UINT32", lambda r: SAFETY_BITS[r.safety_mode]),
    "ft_raw_wrench": ("VECTOR6D", lambda r: r.raw_wrench()),
    "payload": ("DOUBLE", lambda r: r.payload_kg),
    "payload_cog": ("VECTOR3D", lambda r: r.payload_cog_m),
    "payload_inertia": ("VECTOR6D", lambda r: r.payload_inertia),
    "tcp_offset": ("VECTOR6D", lambda r: r.tcp_offset),
    "target_gravity": ("VECTOR3D", lambda r: r.target_gravity_m_s2),
    "output_bit_registers0_to_31": ("UINT32", lambda r: r.signals.registers & 0xFFFFFFFF),
    "output_bit_registers32_to_63": ("UINT32", lambda r: r.signals.registers >> 32 & 0xFFFFFFFF),
}
"""RTDE type of each output variable, and the function that reads its value."""


def _register_readers() -> None:
    def int_reader(index: int) -> Reader:
        return lambda r: r.output_ints[index]

    def double_reader(index: int) -> Reader:
        return lambda r: r.output_doubles[index]

    def echo(name: str, default: Value) -> Reader:
        return lambda r: r.inputs.get(name, default)

    for i in range(48):
        OUTPUTS[f"output_int_register_{i}"] = ("INT32", int_reader(i))
        OUTPUTS[f"output_double_register_{i}"] = ("DOUBLE", double_reader(i))
        OUTPUTS[f"input_int_register_{i}"] = ("INT32", echo(f"input_int_register_{i}", 0))
        OUTPUTS[f"input_double_register_{i}"] = ("DOUBLE", echo(f"input_double_register_{i}", 0.0))


_register_readers()

_SINCE: dict[str, dict[int, tuple[int, int]]] = {
    "safety_status": {3: (10, 0), 5: (4, 0), 10: (0, 0)},
    "ft_raw_wrench": {5: (9, 0), 10: (0, 0)},
    "payload": {3: (11, 0), 5: (5, 1), 10: (0, 0)},
    "payload_cog": {3: (11, 0), 5: (5, 1), 10: (0, 0)},
    "payload_inertia": {3: (15, 0), 5: (11, 0), 10: (0, 0)},
    "actual_current_as_torque": {5: (23, 0), 10: (10, 0)},
    "target_gravity": {5: (26, 0), 10: (13, 0)},
}
"""First minor and bug-fix version with an output, by major version.

`target_gravity` follows a maintainer of Universal Robots' client library (its pull request 420). PolyScope X has what
the PolyScope 5 of the same time has: 10.10 came with 5.23. That 10.13 came with 5.26 is assumed.
"""

INPUTS: dict[str, str] = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    "configurable_digital_output_mask": "UINT8",
    "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8",
    "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
    "external_force_torque": "VECTOR6D",
    **{f"input_int_register_{i}": "INT32" for i in range(48)},
    **{f"input_double_register_{i}": "DOUBLE" for i in range(48)},
}
"""RTDE type of each input variable of the controller."""


def output_type(robot: Robot, name: str) -> str:
    """Return the RTDE type of an output in the software version of the robot, or NOT_FOUND."""
    if name not in OUTPUTS or name in robot.settings.unknown_outputs:
        return "NOT_FOUND"
    major, *release = robot.settings.polyscope
    since = _SINCE.get(name)
    if since is not None and (major not in since or tuple(release) < since[major]):
        return "NOT_FOUND"
    return OUTPUTS[name][0]
