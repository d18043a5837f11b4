"""Targets that are models of the robot."""

import xml.etree.ElementTree as ET

from calib import CalibrationResult
from ftdrive.exports.calibration.settings import Settings
from ftdrive.exports.calibration.shared import frame_note, gravity_m_s2, quaternion_xyzw, rpy_rad
from ftdrive.exports.calibration.text import Exported, numbers, yaml_text


def urdf(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write sensor and tool as links, to be included below the flange of a robot.

    Reader: URDF 1.0, ros/urdfdom. The tool link has the frame of the sensor, so that `origin` of `inertial` is the
    centre of mass in the sensor frame. `rpy` is R = Rz(yaw) Ry(pitch) Rx(roll). With g the gravity of the simulation,
    in sensor axes:

        force on the sensor = mass g               torque about its origin = origin x (mass g)
    """
    origin_m = settings.p_flange_sensor_m("urdf")
    robot = ET.Element("robot", name=settings.tool_frame)
    for name in (settings.flange_frame, settings.sensor_frame):
        ET.SubElement(robot, "link", name=name)
    inertial = ET.SubElement(ET.SubElement(robot, "link", name=settings.tool_frame), "inertial")
    ET.SubElement(inertial, "origin", xyz=_words(calibration.p_sensor_com_m.tolist()), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=repr(calibration.mass_kg))
    inertial.append(ET.Comment(" not identified: zeros stand for a point mass; put values of the CAD model here "))
    ET.SubElement(inertial, "inertia", {f"i{axes}": "0.0" for axes in ("xx", "xy", "xz", "yy", "yz", "zz")})
    _fix(robot, settings.flange_frame, settings.sensor_frame, origin_m.tolist(), rpy_rad(calibration))
    _fix(robot, settings.sensor_frame, settings.tool_frame, [0.0] * 3, [0.0] * 3)
    ET.indent(robot)
    notes = (
        "The inertia was not identified: zeros stand for a point mass. Simulators may need the values of a CAD model.",
        f"Leave out the link {settings.flange_frame} if your robot has it. The mass of the sensor itself is not in it.",
    )
    elsewhere = {"gravity of the simulation": numbers(gravity_m_s2(calibration))}
    return Exported(ET.tostring(robot, encoding="unicode") + "\n", notes, elsewhere)


def mujoco(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write the parameters of the plugin that removes the weight from a simulated sensor.

    Reader: ros-controls/mujoco_ros2_control, mujoco_ros2_control_plugins/src/fts_grav_comp_plugin.cpp, since pull
    request 308 (2026-09). The model must have a site `frame_id` in the sensor frame, and sensors NAME_force and
    NAME_torque at a site. With g the gravity of the model, turned into the site of the sensor:

        force = reading - CoG.mass g               torque = reading - CoG.pos x (CoG.mass g)

    with the reading as the hardware interface gives it, which is minus that of MuJoCo.
    """
    sensor = {
        "frame_id": settings.sensor_frame,
        "CoG": {"pos": numbers(calibration.p_sensor_com_m), "mass": calibration.mass_kg},
    }
    plugin = {"type": "mujoco_ros2_control_plugins/FtsGravCompPlugin", settings.sensor_frame: sensor}
    x, y, z, w = quaternion_xyzw(calibration)
    notes = (
        f"The MJCF must have a site {settings.sensor_frame} and the sensors {settings.sensor_frame}_force and "
        f"{settings.sensor_frame}_torque on it, in the body of the tool. A simulated sensor has no bias.",
        frame_note(calibration, settings),
    )
    elsewhere = {
        "option gravity": numbers(gravity_m_s2(calibration)),
        "site quat (w x y z) in the flange": [w, x, y, z],
    }
    document = {"/**": {"ros__parameters": {"mujoco_plugins": {"fts_grav_comp_plugin": plugin}}}}
    return Exported(yaml_text(document), notes, elsewhere)


def _fix(robot: ET.Element, parent: str, child: str, xyz: list[float], rpy: list[float]) -> None:
    joint = ET.SubElement(robot, "joint", name=f"{parent}_to_{child}", type="fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=_words(xyz), rpy=_words(rpy))


def _words(values: list[float]) -> str:
    return " ".join(repr(value) for value in numbers(values))
