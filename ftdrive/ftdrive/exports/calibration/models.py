"""Targets that are models of the robot."""

import xml.etree.ElementTree as ET

import numpy as np

from ftcalib import CalibrationResult
from ftdrive.exports.calibration.settings import Settings
from ftdrive.exports.calibration.shared import (
    R_frame_sensor,
    gravity_in_frame_m_s2,
    inertia_kg_m2,
    inertia_note,
    quaternion_xyzw,
    rpy_rad,
    world_note,
)
from ftdrive.exports.calibration.text import Exported, numbers, yaml_text


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
    ET.SubElement(inertial, "origin", xyz=_words(calibration.p_sensor_com_m.tolist()), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=repr(calibration.mass_kg))
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
        inertia_note(calibration),
        f"Leave out the link {settings.flange_frame} if your robot has it.",
        "The mass of the sensor itself is not in it, nor its bias.",
        world_note(settings),
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
    com_m = numbers(calibration.p_sensor_com_m)
    x, y, z, w = quaternion_xyzw(R_frame_sensor(calibration, settings))
    compensation = {"frame_id": settings.sensor_frame, "CoG": {"pos": com_m, "mass": calibration.mass_kg}}
    plugin = {"type": "mujoco_ros2_control_plugins/FtsGravCompPlugin", settings.sensor_frame: compensation}
    parameters = yaml_text({"/**": {"ros__parameters": {"mujoco_plugins": {"fts_grav_comp_plugin": plugin}}}})
    root = ET.Element("mujoco", model=settings.tool_frame)
    root.append(
        ET.Comment(f" parameters of the plugin that removes the weight, for a file of their own:\n{parameters}")
    )
    body = ET.SubElement(ET.SubElement(root, "worldbody"), "body", name=settings.tool_frame)
    body.attrib |= {"pos": _words(settings.p_frame_sensor_m("mujoco").tolist()), "quat": _words([w, x, y, z])}
    J = inertia_kg_m2(calibration)
    inertial = ET.SubElement(body, "inertial", pos=_words(com_m), mass=repr(calibration.mass_kg))
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
        f"{inertia_note(calibration)} The mass of the sensor itself is not in it.",
        "The plugin FtsGravCompPlugin needs a mujoco_ros2_control newer than 0.1.2 (pull request 308, September 2026).",
        world_note(settings),
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
