"""What each export target computes from an exported calibration: the targets' own formulas.

They are written from the targets' sources and documents, named in each docstring, and import nothing of ours. A file is
read as the target reads it: field names, order, units, signs, and number types. Round-trip tests of the exports compare
the result with our compensated wrench.

`context` is what a target knows from elsewhere:

| key | meaning |
|---|---|
| `R_flange_sensor` (3, 3), `p_flange_sensor_m` (3,) | mounting of the sensor, as in the target's robot model |
| `g_m_s2` | gravity for targets that have it as a setting; CalaW and mc_rtc have it in their source |
| `gravity_m_s2` (3,), optional | the same as a vector in base, for targets whose setting is a vector; default down |
| `force_bias_N`, `torque_bias_Nm` (3,) | for targets that carry no bias |
| `sensor_mass_kg`, `p_flange_sensor_com_m` (3,) | sensor and adapter, for targets whose payload includes them |
| `p_sensor_com_m`, `gravity_force_base_N` (3,) | the load, for a target that carries only the mounting |
| `R_flange_parent` (3, 3), optional | mc_rtc: axes of the sensor's parent body at the flange; default the flange |

World axes are those of the robot base, unless a file names `base_link`: UR's base turned by 180 deg about z.
Frames named `tool0` are our flange; `flange` is ROS-Industrial's, with x out of the flange.
"""

import json
import re
import shlex
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from tests.target_files import (
    Array,
    Context,
    Data,
    context_bias,
    doubles,
    force_at,
    gravity_base,
    in_sensor_axes,
    mapping,
    mass_kg,
    mounting,
    numbers,
    six,
    split,
    tool0_from,
    transform_arguments,
    world_from_base,
    xyz,
)
from tests.target_payloads import franka, mujoco, ur_payload, urdf


def evaluate(format_name: str, text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """Compensate raw wrenches as a target does after it has read `text`.

    Parameters
    ----------
    format_name : str
        A key of `TARGETS`.
    text : str
        The exported file.
    R_base_flange : array, shape (n, 3, 3)
    wrench : array, shape (n, 6)
        As measured, N and N·m, sensor axes, about the sensor origin, exerted on the sensor by its load.
    context : Mapping
        See the module.

    Returns
    -------
    array, shape (n, 6)
        Compensated wrench, sensor axes, about the sensor origin.

    Raises
    ------
    KeyError, ValueError
        The target could not read the file.
    """
    return TARGETS[format_name](text, np.asarray(R_base_flange), np.asarray(wrench), context)


def kth(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """kth-ros-pkg/force_torque_tools, gravity_compensation/src/gravity_compensation.cpp and _node.cpp, 513af2e, PR #18.

    `ft_zeroed = raw - bias; f = m a, t = r x f; compensated = ft_zeroed + (f, t)` with a, the accelerometer's reading
    (up, at rest). Before PR #18 the weight was subtracted, so the IMU message had to point down: the same result.
    r is the position of `gripper_com_pose` in `gripper_com_frame_id`, transformed to the sensor frame.
    """
    file = mapping(yaml.safe_load(text))
    com = _in_sensor(str(file["gripper_com_frame_id"]), numbers(file["gripper_com_pose"], 6)[:3], context)
    accelerometer = -in_sensor_axes(gravity_base(context), R_base_flange, context)
    force = mass_kg(file["gripper_mass"]) * accelerometer
    return wrench - numbers(file["bias"], 6) + force_at(com, force)


def ft_tools(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """ICube ft_tools_ros2 (tpoignonec), ft_tools/src/ft_estimation.cpp `remove_weight`, 080098e; ft_parameters.cpp.

    `f_g = m R_ref_sensor^T g; raw - (f_g, com x f_g) - (force_offset, torque_offset)`. g is the parameter
    `calibration.gravity_in_reference_frame` of ft_estimation_node, default (0, 0, -9.81), which the file does not have.
    The formulas of the README have the opposite sign.
    """
    file = mapping(yaml.safe_load(text))
    return _ft_calibration(file, lambda value: numbers(value, 3), (R_base_flange, wrench, context))


def ros2_message(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """ft_msgs/msg/FtCalibration, read by ft_tools/src/ft_parameters.cpp `from_msg`; formula as in `ft_tools`.

    The vectors are geometry_msgs/Vector3.
    """
    file = mapping(yaml.safe_load(text))
    return _ft_calibration(file, xyz, (R_base_flange, wrench, context))


def calaw(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """CalaW/ft_tools_ros2, ft_compensation: ft_compensator.py and scripts/ft_compensation_node.py, 1ee0565.

    `force = raw + g mass - f_bias; torque = raw - g x cog - t_bias`, g = (0, 0, -9.81) in world, constant.
    The sign is that of a sensor that reports the reaction: with ours, `mass` and `cog` are negative. `cog` is the first
    moment, mass times centre of mass in kg·m, as ft_calibration/ft_calibrator.py estimates it (6223d83, and its test).
    """
    file = mapping(yaml.safe_load(text))
    mass, first_moment = numbers([file["mass"]], 1)[0], numbers(file["cog"], 3)
    f_bias, t_bias = numbers(file["f_bias"], 3), numbers(file["t_bias"], 3)
    g = in_sensor_axes(np.array([0.0, 0.0, -9.81]), R_base_flange, context)
    return np.hstack([wrench[:, :3] + g * mass - f_bias, wrench[:, 3:] - np.cross(g, first_moment) - t_bias])


def ros2_control(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """ros2_controllers force_torque_sensor_broadcaster with control_toolbox GravityCompensationWrench.

    force_torque_sensor_broadcaster.cpp `apply_sensor_offset`, `apply_sensor_multiplier`: `(raw + offset) multiplier`.
    control_toolbox/include/control_filters/gravity_compensation.hpp, 36913ec, and src/.../gravity_compensation.cpp:
    `F = R_sensor_world (gravity_field mass); raw - (F, CoG x F)`, CoG in the sensor frame.
    rcl's parameter parser rejects integers where the parameter is a double, and lists of mixed types.
    """
    (p,) = _ros_parameters(text, "sensor_filter_chain")
    wrench = wrench + six(p.get("offset", {}), 0.0)
    wrench = wrench * six(p.get("multiplier", {}), 1.0)
    filters = mapping(p["sensor_filter_chain"])
    for number in range(1, len(filters) + 1):
        each = mapping(filters[f"filter{number}"])
        if each["type"] != "control_filters/GravityCompensationWrench":
            raise ValueError(f"filter{number} is {each['type']}, which is not evaluated here")
        params = mapping(each["params"])
        if params["sensor_frame"] != p["frame_id"]:
            raise ValueError(f"sensor_frame {params['sensor_frame']} is not the frame_id {p['frame_id']}")
        tool = mapping(params["tool"])
        gravity_world = doubles(tool.get("gravity_field", [0.0, 0.0, -9.81]), 3)
        gravity = world_from_base(params["world_frame"]).T @ gravity_world
        F = in_sensor_axes(gravity, R_base_flange, context) * doubles([tool["mass"]], 1)[0]
        wrench = wrench - force_at(doubles(tool["CoG"], 3), F)
    return wrench


def admittance(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """admittance_controller of ros2_controllers, admittance_rule_impl.hpp `process_wrench_measurements`, 06ff415.

    `w = (0, 0, -CoG.force) in world; R_world_sensor raw - (w, (R_world_cog CoG.pos) x w)`. CoG.force is positive
    newtons. CoG.pos is in the axes of `gravity_compensation.frame.id` but from the sensor origin: only its axes count.
    The controller has no bias: that of the context is removed before.
    """
    (p,) = _ros_parameters(text, "gravity_compensation")
    gravity = p["gravity_compensation"]
    R_flange_sensor, _ = mounting(context)
    frame = gravity["frame"]["id"]
    R_flange_frame = R_flange_sensor if frame == p["ft_sensor"]["frame"]["id"] else tool0_from(frame)
    R_world_flange = world_from_base(p["fixed_world_frame"]["frame"]["id"]) @ R_base_flange
    R_world_sensor = R_world_flange @ R_flange_sensor
    com_world = R_world_flange @ R_flange_frame @ doubles(gravity["CoG"]["pos"], 3)
    weight = np.array([0.0, 0.0, -doubles([gravity["CoG"]["force"]], 1)[0]])
    unbiased = (wrench - context_bias(context)).reshape(-1, 2, 3) @ R_world_sensor.transpose(0, 2, 1)
    left = unbiased - np.stack([np.broadcast_to(weight, com_world.shape), np.cross(com_world, weight)], axis=1)
    return np.asarray((left @ R_world_sensor).reshape(-1, 6))


def kit(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """KITrobotics/force_torque_sensor, src/force_torque_sensor_handle.cpp, 1065d14, and iirob_filters, c482674.

    handle: `raw - offset`. include/iirob_filters/gravity_compensation.h, in world axes: `f_z += force;
    t_x += force cog_y; t_y -= force cog_x` with cog turned to world from the axes of the data. `force` is positive
    newtons. The offset counts only with `Calibration/Offset/isStatic: true`, otherwise the node tares at start.
    Both parts stand under the node's name: in one file, since both have a key `force`. `recalibrate` is not evaluated.
    """
    file = mapping(yaml.safe_load(text))
    offset, tool = mapping(file["Calibration"]["Offset"]), mapping(file["GravityCompensation"]["params"])
    if tool["force_frame"] != tool["sensor_frame"]:
        raise ValueError(f"force_frame {tool['force_frame']} is not the sensor_frame, and is not evaluated here")
    if offset["isStatic"] is not True:
        raise ValueError("isStatic is not true: the node would not use the offset")
    force = numbers([tool["force"]], 1)[0]
    R_world_sensor = world_from_base(tool["world_frame"]) @ R_base_flange @ mounting(context)[0]
    unbiased = wrench - np.concatenate([xyz(offset["force"]), xyz(offset["torque"])], dtype=np.float64)
    data = unbiased.reshape(-1, 2, 3) @ R_world_sensor.transpose(0, 2, 1)
    cog = R_world_sensor @ numbers([tool["CoG_x"], tool["CoG_y"], tool["CoG_z"]], 3)
    data[:, 0, 2] += force
    data[:, 1, 0] += force * cog[:, 1]
    data[:, 1, 1] -= force * cog[:, 0]
    return np.asarray((data @ R_world_sensor).reshape(-1, 6))


def code_iai(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """code-iai/robot_wrist_ft_tools, wrist_ft_sensor_cleaner/.../ft_cleaner.py `load_params`, `ft_cb`, 379d5b1.

    `clean = raw - offset; zeroed = clean - (m a, c m x a)`, a = gravity in sensor axes, pointing to the ground, from
    tf_gravity_publisher.py, whose parameter `gravity_vector` is (0, 0, -9.8) unless set.
    """
    file = mapping(yaml.safe_load(text))
    offset = np.concatenate([numbers(file["offset"][part], 3) for part in ("force", "torque")], dtype=np.float64)
    m, c = numbers([file["mass"]], 1)[0], numbers(file["center_of_mass"], 3)
    a = in_sensor_axes(gravity_base(context), R_base_flange, context)
    return wrench - offset - force_at(c, m * a)


def mc_rtc(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """jrl-umi3218/mc_rtc, src/mc_rbdyn/ForceSensor.cpp `loadData`, `wfToSensor`, 0a4d7c8; rpy_utils.h.

    `f_ext = f_mes - offset - X_0_vb^T (0; -mass gravity)`, gravity = (0, 0, +9.80665): Robot.cpp, 01d64da, loads the
    file with `mc_rtc::constants::gravity` of mc_rtc/constants.h, 3cca220. (Old versions of Robot.cpp have 9.81.)
    13 numbers: mass; rpy of X_f_ds, from the model's sensor axes to the real ones (E = RotX RotY RotZ of
    SpaceVecAlg, the transpose of Rz Ry Rx); centre of mass in the *parent body*; offset as couple, then force.
    The stream must be good after the last number: white space follows. What follows that is not read.
    """
    words = text.split()
    if len(words) < 13 or (len(words) == 13 and not text[-1].isspace()):
        raise ValueError("calib_data needs 13 numbers and white space after the last one")
    x = np.array([float(word) for word in words[:13]])
    R_flange_parent = np.asarray(context.get("R_flange_parent", np.eye(3)))
    R_flange_real = R_flange_parent @ Rotation.from_euler("xyz", x[1:4]).as_matrix()
    com = R_flange_real.T @ (R_flange_parent @ x[4:7] - mounting(context)[1])
    force = np.array([0.0, 0.0, -x[0] * 9.80665]) @ (R_base_flange @ R_flange_real)
    return wrench - np.concatenate([x[10:13], x[7:10]], dtype=np.float64) - force_at(com, force)


def xarm(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """xArm-Python-SDK, xarm/x3/ft_sensor.py `ft_sensor_cali_load`, SDK >= 1.11.0; also xarm_api.md of the C++ SDK.

    10 numbers: mass kg, centre of mass in **mm** (m before 1.11.0, and in the firmware's register), offset N, N·m; the
    centre of mass from the sensor origin (the same function adds 32 mm to reach the flange). The formula is in the
    firmware and not published; taken here as `raw - offset - (m g, c x m g)`. The offset's sign is not documented.
    """
    (found,) = re.findall(r"\[((?:[-+\d.eE\s]+,){9}[-+\d.eE\s]+)\]", re.sub(r"#.*|//.*", "", text))
    values = split(found)
    force = values[0] * in_sensor_axes(gravity_base(context), R_base_flange, context)
    return wrench - values[4:] - force_at(values[1:4] / 1000, force)


def static_transform(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """ros2/geometry2, tf2_ros `static_transform_publisher --x .. --qx .. --frame-id P --child-frame-id C`.

    The transform is the pose of the child in the parent: it maps sensor to flange coordinates.
    The load of the context keeps its place in the flange, so a wrong position shows as a wrong torque.
    """
    (command,) = re.findall(r"^[^#\n]*static_transform_publisher (.*)", text.replace("\\\n", " "), re.MULTILINE)
    parent, position, rotation = transform_arguments(shlex.split(command, comments=True))
    R_flange_parent = tool0_from(parent)
    R_flange_text, p_flange_text = R_flange_parent @ rotation.as_matrix(), R_flange_parent @ position
    R_flange_sensor, p_flange_sensor = mounting(context)
    p_flange_com = R_flange_sensor @ np.asarray(context["p_sensor_com_m"]) + p_flange_sensor
    com = R_flange_text.T @ (p_flange_com - p_flange_text)
    force = np.asarray(context["gravity_force_base_N"]) @ (R_base_flange @ R_flange_text)
    return wrench - context_bias(context) - force_at(com, force)


def plain_json(text: str, R_base_flange: Array, wrench: Array, _: Context) -> Array:
    """`ftdrive.export/1`, docs/reference/export-formats.md; the fields are those of a calibration.

    `u = R_flange_sensor^T R_base_flange^T gravity_force_base_N;
    raw - (force_bias_N, torque_bias_Nm) - (u, p x u) - (force_gain u, cross_talk_m u)`.
    """
    return _plain(json.loads(text), R_base_flange, wrench)


def plain_yaml(text: str, R_base_flange: Array, wrench: Array, _: Context) -> Array:
    """As `plain_json`, in YAML 1.1."""
    return _plain(yaml.safe_load(text), R_base_flange, wrench)


TARGETS: dict[str, Callable[[str, Array, Array, Context], Array]] = {
    "kth": kth,
    "ft-tools": ft_tools,
    "calaw": calaw,
    "ros2-control": ros2_control,
    "admittance": admittance,
    "mc-rtc": mc_rtc,
    "xarm": xarm,
    "franka": franka,
    "kit": kit,
    "code-iai": code_iai,
    "urdf": urdf,
    "mujoco": mujoco,
    "ur-payload": ur_payload,
    "static-transform": static_transform,
    "ros2-message": ros2_message,
    "json": plain_json,
    "yaml": plain_yaml,
}


def _ros_parameters(text: str, key: str) -> list[Mapping[str, Any]]:
    """Return the parameters of the nodes that have `key`."""
    nodes = (mapping(node)["ros__parameters"] for node in mapping(yaml.safe_load(text)).values())
    return [mapping(parameters) for parameters in nodes if key in parameters]


def _ft_calibration(file: Mapping[str, Any], vector: Callable[[Any], Array], data: Data) -> Array:
    R_base_flange, wrench, context = data
    com, force_offset, torque_offset = (
        vector(file[name]) for name in ("sensor_frame_to_com", "force_offset", "torque_offset")
    )
    f_g = mass_kg(file["mass"]) * in_sensor_axes(gravity_base(context), R_base_flange, context)
    return wrench - force_at(com, f_g) - np.concatenate([force_offset, torque_offset], dtype=np.float64)


def _plain(file: Any, R_base_flange: Array, wrench: Array) -> Array:
    if file["format"] != "ftdrive.export/1":
        raise ValueError(f"not an export: {file['format']}")
    R_flange_sensor = np.array([numbers(row, 3) for row in file["R_flange_sensor"]])
    u = numbers(file["gravity_force_base_N"], 3) @ (R_base_flange @ R_flange_sensor)
    bias = np.concatenate([numbers(file["force_bias_N"], 3), numbers(file["torque_bias_Nm"], 3)], dtype=np.float64)
    load = force_at(numbers(file["p_sensor_com_m"], 3), u)
    if file["response"] is not None:
        rows = [*file["response"]["force_gain"], *file["response"]["cross_talk_m"]]
        load += u @ np.array([numbers(row, 3) for row in rows]).T
    contact = wrench - bias - load
    return contact if file["decoder"] is None else contact @ np.array([numbers(row, 6) for row in file["decoder"]]).T


def _in_sensor(frame: str, point: Array, context: Context) -> Array:
    """(3,) a point of `frame` in the sensor frame; any other name than tool0 and flange is the sensor."""
    if not frame.endswith(("tool0", "flange")):
        return point
    R_flange_sensor, p_flange_sensor = mounting(context)
    return np.asarray(R_flange_sensor.T @ (tool0_from(frame) @ point - p_flange_sensor))
