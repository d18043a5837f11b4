"""What each export target computes from an exported calibration: the targets' own formulas.

They are written from the targets' sources and documents, named in each docstring, and import nothing of ours. A file is
read as the target reads it: field names, order, units, signs, and number types. Round-trip tests of the exports compare
the result with our compensated wrench.

`context` is what a target knows from elsewhere:

| key | meaning |
|---|---|
| `R_flange_sensor` (3, 3), `p_flange_sensor_m` (3,) | mounting of the sensor, as in the target's robot model |
| `g_m_s2` | gravity for targets that have it as a setting; mc_rtc has it in its source |
| `gravity_m_s2` (3,), optional | the same as a vector in base, for targets whose setting is a vector; default down |
| `force_bias_N`, `torque_bias_Nm` (3,) | for targets that carry no bias |
| `sensor_mass_kg`, `p_flange_sensor_com_m` (3,) | sensor and adapter, for targets whose payload includes them |
| `p_sensor_com_m`, `gravity_force_base_N` (3,) | the load, for a target that carries only the mounting |
| `R_flange_parent` (3, 3), optional | mc_rtc: axes of the sensor's parent body at the flange; default the flange |

The firmware of Franka, UR and xArm is not public: their formula is taken from the manuals' words.

World axes are those of the robot base, unless a file names `base_link`: UR's base turned by 180 deg about z.
Frames named `tool0` are our flange; `flange` is ROS-Industrial's, with x out of the flange.
"""

import json
import re
import shlex
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Context = Mapping[str, Any]
Data = tuple[Array, Array, Context]
"""R_base_flange, wrench and context of `evaluate`."""

R_TOOL0_FLANGE = Rotation.from_euler("xyz", [np.pi / 2, 0, np.pi / 2]).as_matrix().T
"""ur_description/urdf/ur_macro.xacro, joint `flange-tool0`: rpy = (pi/2, 0, pi/2)."""
Pose = tuple[Array, Array]


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


def cartesian_controllers(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """fzi cartesian_controllers of ROS 2, cartesian_force_controller.cpp `computeForceError`, 082b381.

    `net = R X ft_sensor_wrench + target`: the arm moves along the net force, so the topic needs what is exerted on the
    sensor, without bias and weight. X moves it from ft_sensor_ref_link to the controlled link, and the header is not
    read: that link must be the frame of the broadcaster before it. Returned is ft_sensor_wrench.
    """
    links = {parameters["ft_sensor_ref_link"] for parameters in _ros_parameters(text, "ft_sensor_ref_link")}
    frames = {parameters["frame_id"] for parameters in _ros_parameters(text, "sensor_filter_chain")}
    if links != frames:
        raise ValueError(f"ft_sensor_ref_link {links} is not the frame_id {frames}")
    return ros2_control(text, R_base_flange, wrench, context)


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


def franka(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """franka_msgs/srv/SetLoad, libfranka include/franka/robot.h `setLoad(load_mass, F_x_Cload, load_inertia)`.

    kg; m from the flange in flange axes; kg·m2 column-major.
    """
    fields = mapping(yaml.safe_load(text))
    com, _ = numbers(fields["F_x_Cload"], 3), numbers(fields["load_inertia"], 9)
    return _payload(mass_kg(fields["mass"]), com, (R_base_flange, wrench, context))


def ur_payload(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """URScript manual, `set_target_payload(m, cog, inertia=[0, 0, 0, 0, 0, 0], transition_time=0)`, PolyScope >= 5.10.

    kg; m from the tool mount in flange axes; inertia [Ixx, Iyy, Izz, Ixy, Ixz, Iyz].
    """
    pattern = r"^set_target_payload\(([-\d.]+), \[([^]]*)\], \[([^]]*)\]\)$"
    ((mass, cog, inertia),) = re.findall(pattern, text, re.MULTILINE)
    if len(split(cog)) != 3 or len(split(inertia)) != 6:
        raise ValueError(f"not the arguments of URScript: {text}")
    return _payload(float(mass), split(cog), (R_base_flange, wrench, context))


def urdf(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """URDF specification, wiki.ros.org/urdf/XML: `<inertial><origin/><mass/>` of `<link>`, `<joint><origin/>`.

    `<origin xyz rpy>` of a joint is the pose of the child in the parent, R = Rz(y) Ry(p) Rx(r); that of an inertial is
    in the link. The root is the flange, and a link stands at the sensor. The reading of an ideal sensor is the weight
    of the links after it.
    """
    robot = _parse(text)
    joints = {_attribute(one, "child", "link"): (_attribute(one, "parent", "link"), one) for one in robot.iter("joint")}

    def pose(link: str) -> Pose:
        if link not in joints:
            return tool0_from(link), np.zeros(3)
        parent, joint = joints[link]
        return _compose(pose(parent), _origin(joint))

    if not any(_same(pose(link), mounting(context)) for link in joints):
        raise ValueError("no link stands at the sensor")
    ((mass, com),) = (
        (float(_attribute(inertial, "mass", "value")), _apply(pose(link.attrib["name"]), _origin(inertial)[1]))
        for link in robot.iter("link")
        for inertial in link.findall("inertial")
    )
    return _payload(mass, com, (R_base_flange, wrench, context), with_sensor=False)


def mujoco(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """MuJoCo XML reference, `body`, `body/inertial`, `site`: mujoco.readthedocs.io/en/stable/XMLreference.html.

    `pos` and `quat` (w x y z) of a body are in its parent, those of `inertial` and `site` in the body. The outermost
    body is tool0 or ROS-Industrial's flange by its name. The sensor's site belongs to the child: its whole body counts
    as load. The simulated `force` and `torque` have the opposite sign to ours: MuJoCo 4.0.0 reads (0, 0, +m g) in world
    of a load at rest. A load has no sign, so the file does not depend on it.
    """
    (flange,) = (body for holder in _parse(text).iter("worldbody") for body in holder.findall("body"))
    (body,) = flange.findall("body")
    at_flange = tool0_from(flange.attrib["name"]), np.zeros(3)
    rotation = Rotation.from_quat(_floats(body.attrib["quat"]), scalar_first=True).as_matrix()
    pose = _compose(at_flange, (rotation, _floats(body.attrib["pos"])))
    if body.find("site") is None or not _same(pose, mounting(context)):
        raise ValueError("no site stands at the sensor")
    inertial = body.find("inertial")
    assert inertial is not None
    mass, com = float(inertial.attrib["mass"]), _apply(pose, _floats(inertial.attrib["pos"]))
    return _payload(mass, com, (R_base_flange, wrench, context), with_sensor=False)


def mujoco_plugin(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """mujoco_ros2_control_plugins/src/fts_grav_comp_plugin.cpp, 145426f, ros-controls/mujoco_ros2_control PR #308.

    In MuJoCo's sign, in the site of the sensor: `F + mass g; T + pos x (mass g)`, pos moved from the site `frame_id`.
    The hardware interface then negates both. The parameters stand in a comment of the model, which must have a site
    `frame_id`, and the sensors NAME_force and NAME_torque; here both are at one site.
    """
    (parameters,) = re.findall(r"<!--[^\n]*\n(/\*\*:.*?)-->", text, re.DOTALL)
    plugins = yaml.safe_load(parameters)["/**"]["ros__parameters"]["mujoco_plugins"]
    plugin = mapping(plugins["fts_grav_comp_plugin"])
    if plugin["type"] != "mujoco_ros2_control_plugins/FtsGravCompPlugin":
        raise ValueError(f"a plugin {plugin['type']}")
    ((name, sensor),) = ((name, mapping(value)) for name, value in plugin.items() if name != "type")
    model = _parse(text)
    for kind in ("force", "torque"):
        if [one.get("site") for one in model.iter(kind) if one.get("name") == f"{name}_{kind}"] != [sensor["frame_id"]]:
            raise ValueError(f"no sensor {name}_{kind} at the site {sensor['frame_id']}")
    mass, pos = doubles([sensor["CoG"]["mass"]], 1)[0], doubles(sensor["CoG"]["pos"], 3)
    weight = mass * in_sensor_axes(gravity_base(context), R_base_flange, context)
    return -(-(wrench - context_bias(context)) + force_at(pos, weight))


TARGETS: dict[str, Callable[[str, Array, Array, Context], Array]] = {
    "kth": kth,
    "ft-tools": ft_tools,
    "ros2-control": ros2_control,
    "admittance": admittance,
    "cartesian-controllers": cartesian_controllers,
    "mc-rtc": mc_rtc,
    "xarm": xarm,
    "franka": franka,
    "urdf": urdf,
    "mujoco": mujoco,
    "ur-payload": ur_payload,
    "static-transform": static_transform,
    "ros2-message": ros2_message,
    "json": plain_json,
    "yaml": plain_yaml,
}


def mounting(context: Context) -> tuple[Array, Array]:
    """Rotation and position of the sensor in the flange."""
    R, p = (np.asarray(context[key], dtype=np.float64) for key in ("R_flange_sensor", "p_flange_sensor_m"))
    return R, p


def context_bias(context: Context) -> Array:
    """(6,) force, torque."""
    return np.concatenate([context["force_bias_N"], context["torque_bias_Nm"]], dtype=np.float64)


def gravity_base(context: Context) -> Array:
    """(3,) in base, m/s2, pointing down."""
    return np.asarray(context.get("gravity_m_s2", [0.0, 0.0, -context["g_m_s2"]]), dtype=np.float64)


def in_sensor_axes(base: Array, R_base_flange: Array, context: Context) -> Array:
    """(n, 3) from (3,) in base."""
    return np.asarray(base @ (R_base_flange @ mounting(context)[0]))


def force_at(point: Array, force: Array) -> Array:
    """(n, 6) wrench about the origin of the forces (n, 3) at a point (3,)."""
    return np.hstack([force, np.cross(point, force)], dtype=np.float64)


def world_from_base(world_frame: str) -> Array:
    """(3, 3) `base_link` is UR's base turned by 180 deg about z; any other name is UR's base.

    ur_description/urdf/ur_macro.xacro, joint base_link-base_fixed_joint; names may have a prefix.
    """
    return np.diag([-1.0, -1.0, 1.0]) if world_frame.endswith("base_link") else np.eye(3)


def tool0_from(flange_frame: str) -> Array:
    """(3, 3) `flange` is ROS-Industrial's, x out of the flange; any other name is tool0. Names may have a prefix."""
    return R_TOOL0_FLANGE if flange_frame.endswith("flange") else np.eye(3)


def mapping(node: Any) -> Mapping[str, Any]:
    if not isinstance(node, Mapping):
        raise ValueError(f"expected a mapping, got {node!r}")  # noqa: TRY004 - what evaluate promises
    return node


def numbers(values: Any, count: int) -> Array:
    """As Python reads them: YAML 1.1 makes a string of 1e-05."""
    if len(values) != count or not all(type(value) in {int, float} for value in values):
        raise ValueError(f"expected {count} numbers, got {values!r}")
    return np.array(values, dtype=np.float64)


def doubles(values: Any, count: int) -> Array:
    """As rcl reads parameters of type double: no integers, but exponents without a point."""
    if len(values) != count or any(type(value) is int for value in values):
        raise ValueError(f"expected {count} doubles, got {values!r}")
    return np.array([float(value) for value in values])


def xyz(vector: Any) -> Array:
    return numbers([vector[axis] for axis in "xyz"], 3)


def six(parts: Mapping[str, Any], default: float) -> Array:
    """(6,) of `force: {x, y, z}`, `torque: {x, y, z}`."""
    return doubles([parts.get(part, {}).get(axis, default) for part in ("force", "torque") for axis in "xyz"], 6)


def mass_kg(value: Any) -> float:
    mass = float(numbers([value], 1)[0])
    if mass < 0:
        raise ValueError(f"the target rejects the mass {mass}")
    return mass


def split(values: str) -> Array:
    """Numbers between commas."""
    return np.array([float(value) for value in values.split(",") if value.strip()])


def transform_arguments(words: Sequence[str]) -> tuple[str, Array, Rotation]:
    """Return parent frame, position and rotation."""
    o = {key.removeprefix("--"): value for key, value in zip(words[::2], words[1::2], strict=True)}
    rotation = _unit([float(o[name]) for name in ("qx", "qy", "qz", "qw")])
    return o["frame-id"], np.array([float(o[axis]) for axis in "xyz"]), rotation


def _unit(xyzw: Sequence[float]) -> Rotation:
    if abs(np.linalg.norm(xyzw) - 1) > 1e-6:
        raise ValueError(f"the quaternion {xyzw} is not of unit length")
    return Rotation.from_quat(xyzw)


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


def _payload(mass: float, p_flange_com: Array, data: Data, *, with_sensor: bool = True) -> Array:
    """Subtract bias and payload, less sensor and adapter if it includes them, from a wrench about the sensor origin."""
    R_base_flange, wrench, context = data
    g_flange = gravity_base(context) @ R_base_flange
    load = force_at(p_flange_com, mass * g_flange)
    if with_sensor:
        load -= force_at(np.asarray(context["p_flange_sensor_com_m"]), context["sensor_mass_kg"] * g_flange)
    R_flange_sensor, p_flange_sensor = mounting(context)
    load[:, 3:] -= np.cross(p_flange_sensor, load[:, :3])
    return wrench - context_bias(context) - (load.reshape(-1, 2, 3) @ R_flange_sensor).reshape(-1, 6)


def _parse(text: str) -> ET.Element:
    """Parse a document or a fragment of one."""
    body = re.sub(r"<\?xml.*?\?>", "", text, flags=re.DOTALL)
    return ET.fromstring(f'<fragment xmlns:xacro="http://www.ros.org/wiki/xacro">{body}</fragment>')


def _origin(element: ET.Element) -> Pose:
    origin = element.find("origin")
    if origin is None:
        return np.eye(3), np.zeros(3)
    rotation = Rotation.from_euler("xyz", _floats(origin.get("rpy", "0 0 0")))
    return rotation.as_matrix(), _floats(origin.get("xyz", "0 0 0"))


def _attribute(element: ET.Element, child: str, name: str) -> str:
    found = element.find(child)
    if found is None:
        raise ValueError(f"<{element.tag}> lacks <{child}>")
    return found.attrib[name]


def _floats(text: str) -> Array:
    return np.array([float(word) for word in text.split()])


def _compose(a: Pose, b: Pose) -> Pose:
    return a[0] @ b[0], a[0] @ b[1] + a[1]


def _apply(pose: Pose, point: Array) -> Array:
    return np.asarray(pose[0] @ point + pose[1])


def _same(a: Pose, b: Pose) -> bool:
    return bool(np.allclose(a[0], b[0], atol=1e-6) and np.allclose(a[1], b[1], atol=1e-6))
