"""Targets that carry a payload, not a bias: calls of robot controllers, and robot models.

The firmware of Franka and UR is not public: their formula is taken from the manuals' words on the payload.
"""

import re
import xml.etree.ElementTree as ET

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
    split,
    tool0_from,
)

Pose = tuple[Array, Array]


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
