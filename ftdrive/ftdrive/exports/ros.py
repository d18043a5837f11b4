"""Targets of ROS 1 and ROS 2."""

import shlex
from typing import Any

from ftcalib import CalibrationResult
from ftcalib.files import JSON
from ftdrive.exports.shared import (
    Exported,
    R_frame_sensor,
    Settings,
    gravity_in_frame_m_s2,
    numbers,
    quaternion_xyzw,
    rpy_rad,
    xyz,
    yaml_text,
)


def kth(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write the private parameters of KTH's gravity_compensation_node.

    Reader: kth-ros-pkg/force_torque_tools, gravity_compensation/src/gravity_compensation_node.cpp and
    gravity_compensation.cpp, master since pull request 18 (2021-05). With a the acceleration that its IMU reports,
    turned into the sensor frame, which points up at rest:

        force = raw - bias[:3] + gripper_mass a        torque = raw - bias[3:] + gripper_com x (gripper_mass a)
    """
    com_pose = [*numbers(calibration.p_sensor_com_m), 0.0, 0.0, 0.0]
    document = {
        "bias": numbers([*calibration.force_bias_N, *calibration.torque_bias_Nm]),
        "gripper_com_frame_id": settings.sensor_frame,
        "gripper_com_child_frame_id": settings.tool_frame,
        "gripper_com_pose": com_pose,
        "gripper_mass": calibration.mass_kg,
    }
    notes = (
        "The node waits for an IMU. Without one, publish sensor_msgs/Imu with the acceleration below, more than 10 "
        "times a second. Versions before May 2021 need it with the opposite sign.",
        _frame_note(calibration, settings),
    )
    elsewhere = {
        "imu header.frame_id": settings.base_frame,
        "imu linear_acceleration": numbers(-gravity_in_frame_m_s2(calibration, settings)),
    }
    return Exported(yaml_text(document), notes, elsewhere)


def kit(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write the offset of KIT's sensor node and the parameters of its gravity filter.

    Reader: KITrobotics/force_torque_sensor, src/force_torque_sensor_handle.cpp (Calibration/Offset), and
    KITrobotics/iirob_filters, include/iirob_filters/gravity_compensation.h (GravityCompensation/params), both master.
    In the axes of `world_frame`, and with `CoG` turned into them:

        force_z = raw - offset + force          torque_x = raw - offset + force CoG_y
                                                torque_y = raw - offset - force CoG_x

    `force` is the weight in N, positive, along -z of `world_frame`.
    """
    x, y, z = numbers(calibration.p_sensor_com_m)
    document = {
        "Calibration": {
            "Offset": {
                "isStatic": True,
                "force": xyz(calibration.force_bias_N),
                "torque": xyz(calibration.torque_bias_Nm),
            }
        },
        "GravityCompensation": {
            "name": "GravityCompensationWrench",
            "type": "iirob_filters/GravityCompensator",
            "params": {
                "world_frame": settings.base_frame,
                "sensor_frame": settings.sensor_frame,
                "force_frame": settings.sensor_frame,
                "CoG_x": x,
                "CoG_y": y,
                "CoG_z": z,
                "force": calibration.weight_N,
            },
        },
    }
    notes = (
        "Some versions of force_torque_sensor_handle.cpp assign torque offsets y and z to x: search it for "
        "m_calibOffset.torque.y before use.",
        _frame_note(calibration, settings),
    )
    return Exported(yaml_text(document), notes)


def code_iai(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write the parameters that ft_cleaner loads.

    Reader: code-iai/robot_wrist_ft_tools, wrist_ft_sensor_cleaner/src/wrist_ft_sensor_cleaner/ft_cleaner.py, master.
    With g as its gravity publisher sends it in the sensor frame, pointing down:

        force = raw - offset.force - mass g        torque = raw - offset.torque - (mass center_of_mass) x g
    """
    document = {
        "center_of_mass": numbers(calibration.p_sensor_com_m),
        "mass": calibration.mass_kg,
        "offset": {"force": numbers(calibration.force_bias_N), "torque": numbers(calibration.torque_bias_Nm)},
    }
    notes = (
        "Topics that end in _zeroed have bias and weight subtracted, those that end in _clean only the bias.",
        _frame_note(calibration, settings),
    )
    elsewhere = {
        "gravity_publisher fixed_frame": settings.base_frame,
        "gravity_publisher sensor_frame": settings.sensor_frame,
        "gravity_publisher gravity_vector": numbers(gravity_in_frame_m_s2(calibration, settings)),
    }
    return Exported(yaml_text(document), notes, elsewhere)


# Fixed in ft_compensation_node.py.
# A constant of the target's code: the force must be right, so the mass differs by up to 0.3 %.
CALAW_G_M_S2 = 9.81


def ft_tools(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write the calibration file of ICube's ft_estimation_node.

    Reader: ICube-Robotics/ft_tools_ros2, ft_tools/src/ft_parameters.cpp and ft_estimation.cpp, main. Signs are those of
    the code, which differ from its README. With g the parameter `gravity_in_reference_frame`, turned into the sensor
    frame:

        force = raw - mass g - force_offset        torque = raw - com x (mass g) - torque_offset
    """
    document = {
        "mass": calibration.mass_kg,
        "sensor_frame_to_com": numbers(calibration.p_sensor_com_m),
        "force_offset": numbers(calibration.force_bias_N),
        "torque_offset": numbers(calibration.torque_bias_Nm),
    }
    return Exported(yaml_text(document), (_frame_note(calibration, settings),), _ft_estimation(calibration, settings))


def ros2_message(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write a message ft_msgs/msg/FtCalibration, as `ros2 service call` and `ros2 topic pub` take it.

    Reader: ICube-Robotics/ft_tools_ros2, ft_msgs/msg/FtCalibration.msg, main; the only field of a request of
    ft_msgs/srv/SetCalibration. The formula is that of `ft_tools`, and gravity is the same parameter of the node.
    """
    document = {
        "mass": calibration.mass_kg,
        "sensor_frame_to_com": xyz(calibration.p_sensor_com_m),
        "force_offset": xyz(calibration.force_bias_N),
        "torque_offset": xyz(calibration.torque_bias_Nm),
    }
    notes = (
        "The request of the service ft_estimation_node/set_calibration has it in the field ft_calibration.",
        _frame_note(calibration, settings),
    )
    return Exported(yaml_text(document), notes, _ft_estimation(calibration, settings))


def _ft_estimation(calibration: CalibrationResult, settings: Settings) -> dict[str, JSON]:
    """Return the parameters of ft_estimation_node, ft_tools/src/ft_estimation_node_parameters.yaml."""
    return {
        "calibration.reference_frame.id": settings.base_frame,
        "calibration.sensor_frame.id": settings.sensor_frame,
        "calibration.gravity_in_reference_frame": numbers(gravity_in_frame_m_s2(calibration, settings)),
    }


def calaw(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write the calibration of CalaW's ft_compensation.

    Reader: CalaW/ft_tools_ros2, ft_compensation/ft_compensation/ft_compensator.py, main. Its ten numbers are mass, cog,
    f_bias, t_bias. With g = 9.81 m/s2 along -z of `world`, turned into the sensor frame:

        force = raw + mass g - f_bias              torque = raw - g x cog - t_bias

    This is right for a sensor that reports the reaction. For the sign of ftdrive, mass must be negative, and `cog` is
    minus mass times position, kg m.
    """
    mass_kg = calibration.weight_N / CALAW_G_M_S2
    vectors = {
        "cog": numbers(-mass_kg * calibration.p_sensor_com_m),
        "f_bias": numbers(calibration.force_bias_N),
        "t_bias": numbers(calibration.torque_bias_Nm),
    }
    notes = (
        "mass is negative on purpose, and cog is minus mass times position: the formula of CalaW is for sensors that "
        "report the reaction.",
        f"mass is weight / {CALAW_G_M_S2:g} m/s2, because the node multiplies it by {CALAW_G_M_S2:g}.",
        "The node does not read the file. Copy the ten numbers below into ft_compensation_node.py. The frames of "
        "gravity (world) and sensor are fixed there too.",
        _frame_note(calibration, settings),
    )
    ten = [-mass_kg, *(value for vector in vectors.values() for value in vector)]
    return Exported(yaml_text({"mass": -mass_kg, **vectors}), notes, {"calib_params": ten})


def ros2_control(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write the parameters of the broadcaster, with its offset and the gravity filter.

    Readers: ros-controls/ros2_controllers, force_torque_sensor_broadcaster.cpp, 5.0 or newer (offset: 4.16;
    sensor_filter_chain: September 2025), and ros-controls/control_toolbox, control_filters/gravity_compensation.hpp and
    .cpp, master (control_filters.md has older names). With g the vector `gravity_field`, turned from world_frame into
    sensor_frame:

        force = raw + offset.force - mass g        torque = raw + offset.torque - CoG x (mass g)

    The offset is added, so it is minus the bias.
    """
    gravity: dict[str, Any] = {
        "name": "gravity_compensation",
        "type": "control_filters/GravityCompensationWrench",
        "params": {
            "world_frame": settings.base_frame,
            "sensor_frame": settings.sensor_frame,
            "tool": {
                "CoG": numbers(calibration.p_sensor_com_m),
                "mass": calibration.mass_kg,
                "gravity_field": numbers(gravity_in_frame_m_s2(calibration, settings)),
            },
        },
    }
    parameters = {
        "frame_id": settings.sensor_frame,
        "sensor_name": settings.sensor_frame,
        "offset": {"force": xyz(-calibration.force_bias_N), "torque": xyz(-calibration.torque_bias_Nm)},
        "sensor_filter_chain": {"filter1": gravity},
    }
    notes = (
        "offset is minus the bias, because the broadcaster adds it.",
        "sensor_filter_chain needs ros2_controllers of September 2025 or newer; Humble has neither it nor offset.",
        _frame_note(calibration, settings),
    )
    return Exported(yaml_text({"force_torque_sensor_broadcaster": {"ros__parameters": parameters}}), notes)


def admittance(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write the sensor and gravity parameters of the admittance_controller.

    Reader: ros-controls/ros2_controllers, admittance_controller/admittance_rule_impl.hpp, Humble to Kilted. In the axes
    of fixed_world_frame:

        force_z = reading + CoG.force              torque = reading - CoG.pos x [0, 0, -CoG.force]

    CoG.force is the weight in N, positive. The controller subtracts no bias.
    """
    parameters = {
        "ft_sensor": {"name": settings.sensor_frame, "frame": {"id": settings.sensor_frame}},
        "fixed_world_frame": {"frame": {"id": settings.base_frame}},
        "gravity_compensation": {
            "frame": {"id": settings.sensor_frame},
            "CoG": {"pos": numbers(calibration.p_sensor_com_m), "force": calibration.weight_N},
        },
    }
    bias = ", ".join(map(str, numbers([calibration.force_bias_N, calibration.torque_bias_Nm])))
    notes = (
        f"The controller subtracts no bias: subtract [{bias}] (N, N·m) where the hardware interface reads the sensor.",
        "If your version has the parameter sensor_filter_chain in place of gravity_compensation, copy the filter of "
        "the format ros2-control.",
        _frame_note(calibration, settings),
    )
    return Exported(yaml_text({"admittance_controller": {"ros__parameters": parameters}}), notes)


def static_transform(calibration: CalibrationResult, settings: Settings) -> Exported:
    """Write the command that publishes the sensor frame.

    Reader: ros2/geometry2, tf2_ros static_transform_publisher, Humble or newer. Position (m) and quaternion map sensor
    coordinates to those of the frame-id: p = R(q) p_sensor + (x, y, z).
    """
    x, y, z = numbers(settings.p_frame_sensor_m("static-transform"))
    qx, qy, qz, qw = quaternion_xyzw(R_frame_sensor(calibration, settings))
    values = {"x": x, "y": y, "z": z, "qx": qx, "qy": qy, "qz": qz, "qw": qw}
    frames = {"frame-id": settings.flange_frame, "child-frame-id": settings.sensor_frame}
    words = ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    words += [word for name, value in values.items() for word in (f"--{name}", repr(value))]
    words += [word for name, frame in frames.items() for word in (f"--{name}", shlex.quote(frame))]
    return Exported(" ".join(words) + "\n", ("It has the place of the sensor only, no bias and no weight.",))


def _frame_note(calibration: CalibrationResult, settings: Settings) -> str:
    """Say how the robot model must turn the sensor frame, for targets that look it up there."""
    # A target that looks up frames trusts the robot model, so the note has the angles that it must have.
    rpy = ", ".join(str(angle) for angle in rpy_rad(R_frame_sensor(calibration, settings)))
    return (
        f"The robot model must turn {settings.sensor_frame} against {settings.flange_frame} by roll, pitch, yaw = "
        f"({rpy}) rad: the formats urdf and static-transform write it. {settings.base_frame} must have the axes of "
        f"{settings.base_axes}."
    )
