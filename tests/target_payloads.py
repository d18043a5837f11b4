"""Targets that carry a payload, not a bias: calls of robot controllers, and robot models.

The firmware of Franka and UR is not public: their formula is taken from the manuals' words on the payload.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence

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
    message,
    mounting,
    numbers,
    split,
    tool0_from,
)

Pose = tuple[Array, Array]
Body = tuple[float, Array]
"""Mass, and centre of mass in the flange."""


def franka(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """libfranka, include/franka/robot.h `setLoad(load_mass, F_x_Cload, load_inertia)`; franka_msgs/srv/SetLoad.

    kg; m from the flange in flange axes; kg·m2 column-major. Read from a call in any language (brackets or braces),
    or from the service's fields `mass`, `center_of_mass` (`F_x_center_load` in ROS 1), `load_inertia`.
    """
    text = re.sub(r"#.*|//.*", "", text)
    number, sequence = r"([-+\d.eE]+)", r"[^\[{]*[\[{]+([^\]}]*)[\]}]+"
    call = re.search(r"set_?[lL]oad\(\s*(?:\w+\s*=\s*)?" + number + r"\s*," + sequence + "," + sequence, text)
    if call:
        mass, com, inertia = float(call[1]), split(call[2]), split(call[3])
    else:
        fields = message(text)
        com_name = next(n for n in ("center_of_mass", "F_x_center_load", "F_x_Cload") if n in fields)
        mass = mass_kg(fields.get("mass", fields.get("load_mass")))
        com, inertia = numbers(fields[com_name], 3), numbers(fields["load_inertia"], 9)
    if len(com) != 3 or len(inertia) != 9:
        raise ValueError(f"a load has 3 and 9 numbers, got {len(com)} and {len(inertia)}")
    return _payload(mass, com, (R_base_flange, wrench, context))


def ur_payload(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """URScript manual, `set_target_payload(m, cog, inertia=[0, 0, 0, 0, 0, 0], transition_time=0)`, PolyScope >= 5.10.

    kg; m from the tool mount in flange axes; inertia [Ixx, Iyy, Izz, Ixy, Ixz, Iyz]. Also `set_payload(m, cog)`.
    """
    script = re.sub(r"#.*", "", text)
    number, cog = r"([-+\d.eE]+)", r"\[([^]]*)\]"
    (call,) = re.finditer(
        rf"\bset_(target_)?payload\(\s*(?:m\s*=\s*)?{number}\s*,\s*(?:cog\s*=\s*)?{cog}"
        rf"(?:\s*,\s*(?:inertia\s*=\s*)?{cog})?(?:\s*,\s*(?:transition_time\s*=\s*)?{number})?\s*\)",
        script,
    )
    com, inertia = split(call[3]), call[4] and split(call[4])
    if len(com) != 3 or (inertia is not None and (call[1] is None or len(inertia) != 6)):
        raise ValueError(f"not the arguments of URScript: {call[0]}")
    return _payload(float(call[2]), com, (R_base_flange, wrench, context))


def urdf(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """URDF specification, `<inertial><origin/><mass/>` of `<link>`, `<joint type="fixed"><origin/>`; see `_urdf_load`.

    The reading of an ideal sensor is the weight of the links after it. If no link stands at the pose of the sensor, the
    links are a payload at the flange, and sensor and adapter are subtracted.
    """
    bodies, with_sensor = _urdf_load(text, *mounting(context))
    return _payload(*_sum(bodies), (R_base_flange, wrench, context), with_sensor=with_sensor)


def mujoco(text: str, R_base_flange: Array, wrench: Array, context: Context) -> Array:
    """MuJoCo XML reference, `body`, `body/inertial`, `sensor/force`; see `_mujoco_load`.

    The load is the site's body and all bodies in it. If neither a site nor a body stands at the pose of the sensor, the
    bodies are a payload at the flange, as in `urdf`. The simulated `force` and `torque` have the opposite sign to ours:
    MuJoCo 4.0.0 reads (0, 0, +m g) in world of a load at rest. A load has no sign, so the file does not depend on it.
    Gravity is `<option gravity>` (default 0 0 -9.81) if the text has an `option`, else that of the context.
    """
    bodies, with_sensor, gravity = _mujoco_load(text, *mounting(context))
    if gravity is not None:
        context = {**context, "gravity_m_s2": gravity}
    return _payload(*_sum(bodies), (R_base_flange, wrench, context), with_sensor=with_sensor)


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


def _sum(bodies: Sequence[Body]) -> tuple[float, Array]:
    """Mass, and centre of mass in the flange, of all."""
    mass = sum(m for m, _ in bodies)
    return mass, np.asarray(sum(m * p for m, p in bodies) / mass)


def _urdf_load(text: str, R_flange_sensor: Array, p_flange_sensor: Array) -> tuple[list[Body], bool]:
    """Return the bodies that the sensor carries, and whether sensor and adapter are among them.

    wiki.ros.org/urdf/XML: `<origin xyz rpy>` of a joint is the pose of the child in the parent, R = Rz(y) Ry(p) Rx(r);
    that of an inertial is in the link, and its rpy turns the inertia only. The root is the flange. The sensor is the
    link at the sensor's pose next to the root; its load is what follows it, or the link itself if nothing follows.
    """
    robot = _parse(text)
    joints: dict[str, tuple[str, Pose]] = {}
    for joint in robot.iter("joint"):
        if joint.get("type") != "fixed":
            raise ValueError(f"joint {joint.get('name')} is {joint.get('type')}, not fixed")
        joints[_attribute(joint, "child", "link")] = (_attribute(joint, "parent", "link"), _origin(joint))
    masses = {
        link.attrib["name"]: (float(_attribute(inertial, "mass", "value")), _origin(inertial)[1])
        for link in robot.iter("link")
        if (inertial := link.find("inertial")) is not None
    }

    def pose(link: str) -> Pose:
        if link not in joints:
            return tool0_from(link), np.zeros(3)
        parent, origin = joints[link]
        return _compose(pose(parent), origin)

    def chain(link: str) -> Iterator[str]:
        while link in joints:
            yield link
            link = joints[link][0]

    bodies = {link: (mass, _apply(pose(link), com)) for link, (mass, com) in masses.items()}
    sensor = (R_flange_sensor, p_flange_sensor)
    at_sensor = [link for link in joints if _same(pose(link), sensor)]
    if not at_sensor:
        return list(bodies.values()), True
    sensor_link = min(at_sensor, key=lambda link: len(list(chain(link))))
    after = [body for link, body in bodies.items() if link != sensor_link and sensor_link in chain(link)]
    return after or [bodies[sensor_link]], False


def _mujoco_load(text: str, R_flange_sensor: Array, p_flange_sensor: Array) -> tuple[list[Body], bool, Array | None]:
    """Return the bodies that the sensor carries, whether sensor and adapter are among them, and gravity, if given.

    mujoco.readthedocs.io/en/stable/XMLreference.html: `pos` and orientation of a body are in its parent, those of
    `inertial` and `site` in the body. `quat` is w x y z; `euler` and `axisangle` are degrees unless
    `<compiler angle="radian">`; `eulerseq` is xyz, turning axes. The outermost body hangs on tool0, or is what its name
    says: tool0, or ROS-Industrial's flange. The sensor's site belongs to the child: its whole body counts as load.
    """
    model = _parse(text)
    compiler = next(model.iter("compiler"), ET.Element("compiler")).attrib
    option = next(model.iter("option"), None)
    gravity = None if option is None else _floats(option.get("gravity", "0 0 -9.81"))
    flange = (np.eye(3), np.zeros(3))
    bodies: list[tuple[ET.Element, Pose]] = []

    def visit(parent: ET.Element, pose: Pose) -> None:
        for body in parent.findall("body"):
            name = body.get("name", "")
            is_flange = parent.tag != "body" and name.endswith(("tool0", "flange"))
            here = (tool0_from(name), np.zeros(3)) if is_flange else _compose(pose, _mujoco_pose(body, compiler))
            bodies.append((body, here))
            visit(body, here)

    for holder in model.iter():
        if holder.tag != "body":
            visit(holder, flange)

    def loads(root: ET.Element | None) -> list[Body]:
        wanted = None if root is None else set(root.iter("body"))
        return [
            (float(inertial.attrib["mass"]), _apply(pose, _floats(inertial.attrib["pos"])))
            for body, pose in bodies
            if (inertial := body.find("inertial")) is not None and (wanted is None or body in wanted)
        ]

    sensor = (R_flange_sensor, p_flange_sensor)
    for body, pose in bodies:
        if any(_same(_compose(pose, _mujoco_pose(site, compiler)), sensor) for site in body.findall("site")):
            return loads(body), False, gravity
    for body, pose in bodies:
        if _same(pose, sensor):
            return loads(body), False, gravity
    return loads(None), True, gravity


def _mujoco_pose(element: ET.Element, compiler: Mapping[str, str]) -> Pose:
    position = _floats(element.get("pos", "0 0 0"))
    degrees = compiler.get("angle", "degree") == "degree"
    given = {name: _floats(element.attrib[name]) for name in _ORIENTATIONS if name in element.attrib}
    if not given:
        return np.eye(3), position
    ((name, value),) = given.items()
    if name == "quat":
        rotation = Rotation.from_quat(value, scalar_first=True)
    elif name == "euler":
        # The case is opposite in scipy: capitals turn with the body there, and stay fixed here.
        rotation = Rotation.from_euler(compiler.get("eulerseq", "xyz").swapcase(), value, degrees=degrees)
    elif name == "axisangle":
        angle = np.radians(value[3]) if degrees else value[3]
        rotation = Rotation.from_rotvec(angle * value[:3] / np.linalg.norm(value[:3]))
    else:
        x, y = value[:3] / np.linalg.norm(value[:3]), value[3:]
        y = (y - (x @ y) * x) / np.linalg.norm(y - (x @ y) * x)
        return np.column_stack([x, y, np.cross(x, y)]), position
    return rotation.as_matrix(), position


_ORIENTATIONS = ("quat", "euler", "axisangle", "xyaxes", "zaxis")


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
