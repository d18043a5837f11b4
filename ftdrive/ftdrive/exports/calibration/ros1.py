"""Targets of ROS 1."""

from ftcalib import CalibrationResult
from ftdrive.exports.calibration.settings import Settings
from ftdrive.exports.calibration.shared import frame_note, gravity_in_frame_m_s2
from ftdrive.exports.calibration.text import Exported, numbers, xyz, yaml_text


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
        frame_note(calibration, settings),
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
        frame_note(calibration, settings),
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
        frame_note(calibration, settings),
    )
    elsewhere = {
        "gravity_publisher fixed_frame": settings.base_frame,
        "gravity_publisher sensor_frame": settings.sensor_frame,
        "gravity_publisher gravity_vector": numbers(gravity_in_frame_m_s2(calibration, settings)),
    }
    return Exported(yaml_text(document), notes, elsewhere)
