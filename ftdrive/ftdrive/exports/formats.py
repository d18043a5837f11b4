"""The formats by name, without numpy: help and completion must be fast."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

# What a calibration has: leaning base; turned sensor; gain and cross-talk of the sensor.
Property = Literal["tilt", "rotation", "response"]
Comment = Literal["#", "# at the end", "<!-- -->", "none"]

# By which the force of a target may differ from ours because it cannot express everything.
MAX_FORCE_ERROR_N: Final = 0.1


@dataclass(frozen=True, slots=True)
class Format:
    """One target."""

    description: str
    file: str
    """Usual name of the file."""
    subtracts: tuple[Literal["bias", "weight"], ...] = ("bias", "weight")
    """What the target subtracts from the reading."""
    expresses: tuple[Property, ...] = ("tilt", "rotation")
    """What the target has of the calibration, in the file or where it reads it; response: see `has_own_reading`."""
    comment: Comment = "#"
    """How the header is written."""

    @property
    def has_own_reading(self) -> bool:
        """Whether the target reads another sensor, or none, so that neither bias nor response of ours matter."""
        return "bias" not in self.subtracts and "response" in self.expresses


# By name, as `--format` takes it.
FORMATS: Mapping[str, Format] = {
    "kth": Format("ROS 1 node gravity_compensation of kth-ros-pkg/force_torque_tools", "ft_calib.yaml"),
    "ft-tools": Format("ROS 2 node ft_estimation of ICube-Robotics/ft_tools_ros2", "calibration_parameters.yaml"),
    "ros2-message": Format("ROS 2 message ft_msgs/FtCalibration, for the service set_calibration", "calibration.yaml"),
    "calaw": Format(
        "ROS 2 package ft_compensation of CalaW/ft_tools_ros2",
        "ft_calibration.yaml",
        expresses=("rotation",),
    ),
    "ros2-control": Format(
        "ros2_controllers force_torque_sensor_broadcaster with the gravity filter of control_toolbox", "ft.yaml"
    ),
    "admittance": Format(
        "ros2_controllers admittance_controller",
        "admittance.yaml",
        subtracts=("weight",),
        expresses=("rotation",),
    ),
    "kit": Format(
        "ROS nodes of KITrobotics: force_torque_sensor and iirob_filters", "ft.yaml", expresses=("rotation",)
    ),
    "code-iai": Format("ROS 1 node wrist_ft_sensor_cleaner of code-iai/robot_wrist_ft_tools", "params.yaml"),
    "mc-rtc": Format(
        "mc_rtc, calib_data.NAME of a force sensor",
        "calib_data.ft_sensor",
        expresses=("rotation",),
        comment="# at the end",
    ),
    "xarm": Format("UFACTORY xArm, the ten numbers of ft_sensor_cali_load", "load.yaml", expresses=("tilt",)),
    "franka": Format(
        "Franka libfranka setLoad, with the mass of the sensor",
        "load.yaml",
        subtracts=("weight",),
        expresses=("rotation", "response"),
    ),
    "ur-payload": Format(
        "Universal Robots URScript set_target_payload, with the mass of the sensor",
        "payload.script",
        subtracts=("weight",),
        expresses=("tilt", "rotation", "response"),
    ),
    "urdf": Format(
        "URDF links and fixed joints of sensor and tool",
        "tool.urdf",
        subtracts=("weight",),
        expresses=("tilt", "rotation", "response"),
        comment="<!-- -->",
    ),
    "mujoco": Format(
        "MuJoCo body of tool and sensor, with parameters for mujoco_ros2_control",
        "tool.xml",
        subtracts=("weight",),
        expresses=("tilt", "rotation", "response"),
        comment="<!-- -->",
    ),
    "static-transform": Format("ROS 2 static_transform_publisher, flange to sensor", "transform.sh", subtracts=()),
    "json": Format(
        "JSON with everything that compensation needs",
        "ft.json",
        expresses=("tilt", "rotation", "response"),
        comment="none",
    ),
    "yaml": Format(
        "YAML with everything that compensation needs", "ft.yaml", expresses=("tilt", "rotation", "response")
    ),
}
