"""Targets with a syntax of their own: URScript, URDF and MuJoCo."""

import xml.etree.ElementTree as ET

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.after.weighing import true_tool
from ftcalib.model import Array
from ftdrive.exports.shared import (
    Exported,
    R_frame_sensor,
    Settings,
    gravity_in_frame_m_s2,
    gravity_m_s2,
    inertia_kg_m2,
    numbers,
    quaternion_xyzw,
    rpy_rad,
    yaml_text,
)


def ur_payload(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write one statement of URScript that sets the payload.

    Reader: Universal Robots controller, URScript manual 5.10 or newer, set_target_payload(m, cog, inertia): kg, and m
    in flange axes from the flange. The payload is all that the flange carries:

        force on the flange = m g                  torque about the flange = cog x (m g)

    with g that of `set_gravity`. The formula of the controller is not public. The statement zeroes the sensor of an
    e-Series arm.
    """
    mass_kg, com_m = settings.payload("ur-payload", calibration)
    cog = ", ".join(_fixed(x) for x in com_m)
    J = _payload_inertia_kg_m2(calibration, mass_kg, np.asarray(com_m), settings.p_flange_sensor_m("ur-payload"))
    inertia = "0, 0, 0, 0, 0, 0" if J is None else ", ".join(map(_fixed, J[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]))
    text = f"set_target_payload({_fixed(mass_kg)}, [{cog}], [{inertia}])\n"
    notes = (
        *filter(None, [settings.assumed]),
        "The controller zeroes its own force sensor when this runs: keep the tool free and the arm still.",
        f"{_inertia_note(calibration)} Needs PolyScope 5.10; set_payload before that.",
        "The payload has no bias. How the controller uses it is not public: compare get_tcp_force() without contact in "
        "two poses.",
        "set_gravity takes the acceleration away from the earth, in base axes. The mounting in PolyScope sets it too.",
    )
    return Exported(text, notes, {"set_gravity": numbers(-gravity_m_s2(calibration))})


def _fixed(value: float) -> str:
    """Write a number without exponent, which the URScript manual does not mention."""
    return f"{float(value) + 0.0:.12f}"


def urdf(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write sensor and tool as links, to be included below the flange of a robot.

    Reader: URDF 1.0, ros/urdfdom. The tool link has the frame of the sensor, so that `origin` of `inertial` is the
    centre of mass in the sensor frame. `rpy` is R = Rz(yaw) Ry(pitch) Rx(roll). With g the gravity of the simulation,
    in sensor axes:

        force on the sensor = mass g               torque about its origin = origin x (mass g)
    """
    origin_m = settings.p_frame_sensor_m("urdf")
    robot = ET.Element("robot", name=settings.tool_frame)
    for name in (settings.flange_frame, settings.sensor_frame):
        ET.SubElement(robot, "link", name=name)
    inertial = ET.SubElement(ET.SubElement(robot, "link", name=settings.tool_frame), "inertial")
    mass_kg, p_sensor_com_m = true_tool(calibration)
    ET.SubElement(inertial, "origin", xyz=_words(p_sensor_com_m.tolist()), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=repr(mass_kg))
    J = inertia_kg_m2(calibration)
    if J is None:
        inertial.append(ET.Comment(" not identified: zeros stand for a point mass; put values of the CAD model here "))
    moments = np.zeros((3, 3)) if J is None else J
    elements = {f"i{'xyz'[i]}{'xyz'[j]}": repr(float(moments[i, j])) for i in range(3) for j in range(i, 3)}
    ET.SubElement(inertial, "inertia", elements)
    _fix(
        robot,
        settings.flange_frame,
        settings.sensor_frame,
        origin_m.tolist(),
        rpy_rad(R_frame_sensor(calibration, settings)),
    )
    _fix(robot, settings.sensor_frame, settings.tool_frame, [0.0] * 3, [0.0] * 3)
    ET.indent(robot)
    notes = (
        _inertia_note(calibration),
        f"Leave out the link {settings.flange_frame} if your robot has it.",
        "The mass of the sensor itself is not in it, nor its bias.",
        _world_note(settings),
    )
    elsewhere = {"gravity of the simulation": numbers(gravity_in_frame_m_s2(calibration, settings))}
    return Exported(ET.tostring(robot, encoding="unicode") + "\n", notes, elsewhere)


def mujoco(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write the tool with its sensor as MJCF, and in a comment the parameters of the plugin that removes its weight.

    Readers: MuJoCo, whose element `attach` puts the body into the flange, and ros-controls/mujoco_ros2_control, which
    looks for the sensors NAME_force and NAME_torque. The plugin is mujoco_ros2_control_plugins/src/
    fts_grav_comp_plugin.cpp, pull request 308 of September 2026. Without it the simulated sensor shows the weight, as a
    real one does. With g the gravity of the model, turned into the site of the sensor, the tool at rest reads

        force = mass g                             torque = pos x (mass g)

    and the plugin gives

        force = reading - CoG.mass g               torque = reading - CoG.pos x (CoG.mass g)

    with the reading as the hardware interface gives it, which is minus that of MuJoCo.
    """
    # The plugin is newer than its release 0.1.2, and wrong without the weight in the model.
    mass_kg, p_sensor_com_m = true_tool(calibration)
    com_m = numbers(p_sensor_com_m)
    x, y, z, w = quaternion_xyzw(R_frame_sensor(calibration, settings))
    compensation = {"frame_id": settings.sensor_frame, "CoG": {"pos": com_m, "mass": mass_kg}}
    plugin = {"type": "mujoco_ros2_control_plugins/FtsGravCompPlugin", settings.sensor_frame: compensation}
    parameters = yaml_text({"/**": {"ros__parameters": {"mujoco_plugins": {"fts_grav_comp_plugin": plugin}}}})
    root = ET.Element("mujoco", model=settings.tool_frame)
    root.append(
        ET.Comment(f" parameters of the plugin that removes the weight, for a file of their own:\n{parameters}")
    )
    body = ET.SubElement(ET.SubElement(root, "worldbody"), "body", name=settings.tool_frame)
    body.attrib |= {"pos": _words(settings.p_frame_sensor_m("mujoco").tolist()), "quat": _words([w, x, y, z])}
    J = inertia_kg_m2(calibration)
    inertial = ET.SubElement(body, "inertial", pos=_words(com_m), mass=repr(mass_kg))
    if J is None:
        note = " inertia not identified: zeros stand for a point mass; put values of the CAD model here "
        body.insert(0, ET.Comment(note))
        inertial.set("diaginertia", "0 0 0")
    else:
        inertial.set("fullinertia", _words(J[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].tolist()))
    ET.SubElement(body, "site", name=settings.sensor_frame)
    sensors = ET.SubElement(root, "sensor")
    for kind in ("force", "torque"):
        ET.SubElement(sensors, kind, name=f"{settings.sensor_frame}_{kind}", site=settings.sensor_frame)
    ET.indent(root)
    notes = (
        f"Attach the body {settings.tool_frame} to {settings.flange_frame}. A simulated sensor has no bias.",
        "Plain MuJoCo sensors have the opposite sign: negate sensordata, as the hardware interface of "
        "mujoco_ros2_control does, to get the wrench on the sensor.",
        f"{_inertia_note(calibration)} The mass of the sensor itself is not in it.",
        "The plugin FtsGravCompPlugin needs a mujoco_ros2_control newer than 0.1.2 (pull request 308, September 2026).",
        _world_note(settings),
    )
    elsewhere = {"option gravity": numbers(gravity_in_frame_m_s2(calibration, settings))}
    return Exported(ET.tostring(root, encoding="unicode") + "\n", notes, elsewhere)


def _fix(robot: ET.Element, parent: str, child: str, xyz: list[float], rpy: list[float]) -> None:
    joint = ET.SubElement(robot, "joint", name=f"{parent}_to_{child}", type="fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=_words(xyz), rpy=_words(rpy))


def _words(values: list[float]) -> str:
    return " ".join(repr(value) for value in numbers(values))


def _world_note(settings: Settings) -> str:
    """Say in which axes gravity is, for simulations."""
    return f"Gravity is in axes of {settings.base_frame}, {settings.base_axes}: turn it if those of the world differ."


def _payload_inertia_kg_m2(
    calibration: CalibrationResult, mass_kg: float, p_flange_com_m: Array, p_flange_sensor_m: Array
) -> Array | None:
    """Return the inertia (3, 3) of all that the flange carries, about its centre of mass, flange axes; None as above.

    The sensor itself counts as a point at its centre of mass.
    """
    J = inertia_kg_m2(calibration)
    if J is None:
        return None
    Q, (tool_kg, p_sensor_com_m) = calibration.R_flange_sensor, true_tool(calibration)
    tool_m = p_flange_sensor_m + Q @ p_sensor_com_m - p_flange_com_m
    total, sensor_kg = Q @ J @ Q.T + tool_kg * _steiner(tool_m), mass_kg - tool_kg
    if sensor_kg > 0:
        total += sensor_kg * _steiner(-tool_kg / sensor_kg * tool_m)
    return np.asarray(total)


def _inertia_note(calibration: CalibrationResult) -> str:
    """Say whether the inertia was identified."""
    motion = calibration.motion
    if motion is None or inertia_kg_m2(calibration) is None:
        why = "" if motion is None else " well enough"
        return f"The inertia was not identified{why}: zeros stand for a point mass. Take the values of a CAD model."
    sigma = 1e3 * float(np.sqrt(np.diag(motion.covariance)[15:21].max()))
    return f"The inertia was identified from motion, with a sigma of {sigma:.2g} g·m2 at most."


def _steiner(p_m: Array) -> Array:
    """Inertia per mass (3, 3) of a point about the origin."""
    return np.asarray(p_m @ p_m * np.eye(3) - np.outer(p_m, p_m))
