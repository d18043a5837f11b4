"""The formats of an exported calibration as data: keys, units, signs and frames of each target.

Without numpy, because help and completion must be fast. `registry.py` computes the named values and fills them in.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal

# What not every target can express: a tilt of the base, a rotation of the sensor, its gain and cross-talk.
Property = Literal["tilt", "rotation", "response"]
Comment = Literal["#", "# at the end", "<!-- -->", "none"]

# Default of the largest force error, N, that is accepted if a format cannot represent the whole calibration.
MAX_FORCE_ERROR_N: Final = 0.1
# Gravity in mc_rtc/constants.h. Mass times this value must be the right weight, so the exported mass is adjusted.
MC_RTC_G_M_S2: Final = 9.80665

_SPELLED: Final = str.maketrans({"°": " deg", "·": " ", "±": "+/-", "×": "x", "–": "-", "µ": "u", "²": "2"})


def plain_ascii(text: str) -> str:
    """Return text as printable ASCII without quotes or backslashes, because URScript strings have no escapes."""
    return "".join(c if " " <= c <= "~" and c not in "\"'\\" else "?" for c in text.translate(_SPELLED))


@dataclass(frozen=True, slots=True)
class ExportFormat:
    """Format in which a calibration is exported for one target, a program."""

    description: str
    file: str
    """Usual name of the file that the target reads."""
    subtracts: tuple[Literal["bias", "weight"], ...] = ("bias", "weight")
    """What the target subtracts from the sensor's reading with the exported values."""
    expresses: tuple[Property, ...] = ("tilt", "rotation")
    """Properties of the calibration that the target can express; for "response", see `has_own_reading`."""
    comment: Comment = "#"
    """Syntax and place of the comment with notes in the file."""
    content: Any = None
    """Content: a document that is written as YAML, or a text with values in braces; None for the complete result.

    In a document, "$name" stands for a value, and "*name" in a list for the components of a vector. A name is a field
    of calibration or settings, or defined in `registry.py`. "minus_name" is the negative of a vector, "name_xyz" its
    components as in ROS messages; `registry.py` defines the other suffixes."""
    notes: tuple[str, ...] = ()
    """Sentences about what the user of the target must know, with the names of values in braces."""
    elsewhere: Mapping[str, str] = field(default_factory=dict)
    """Values that the user must set in another place of the target, by their names there; "$name" as in `content`."""

    @property
    def has_own_reading(self) -> bool:
        """Whether the target does not read the calibrated sensor, so that its bias and response do not matter."""
        return "bias" not in self.subtracts and "response" in self.expresses


# Note for targets that look up the sensor's orientation in the robot model, with the angles that must be in it.
_FRAMES: Final = (
    "In the robot model, {sensor_frame} must be rotated from {flange_frame} by roll, pitch, yaw = ({rpy_rad_words}) "
    "rad: the formats urdf and static-transform write this rotation. {base_frame} must have the axes of {base_axes}."
)
# Parameters of ft_estimation_node, ft_tools/src/ft_estimation_node_parameters.yaml.
_FT_ESTIMATION: Final = {
    "calibration.reference_frame.id": "$base_frame",
    "calibration.sensor_frame.id": "$sensor_frame",
    "calibration.gravity_in_reference_frame": "$gravity_m_s2",
}
_BROADCASTER: Final = {
    "force_torque_sensor_broadcaster": {
        "ros__parameters": {
            "frame_id": "$sensor_frame",
            "sensor_name": "$sensor_frame",
            "offset": {"force": "$minus_force_bias_N_xyz", "torque": "$minus_torque_bias_Nm_xyz"},
            "sensor_filter_chain": {
                "filter1": {
                    "name": "gravity_compensation",
                    "type": "control_filters/GravityCompensationWrench",
                    "params": {
                        "world_frame": "$base_frame",
                        "sensor_frame": "$sensor_frame",
                        "tool": {"CoG": "$p_sensor_com_m", "mass": "$mass_kg", "gravity_field": "$gravity_m_s2"},
                    },
                }
            },
        }
    }
}
_OFFSET: Final = (
    "offset is minus the bias, because the broadcaster adds it.",
    "sensor_filter_chain needs ros2_controllers of September 2025 or newer; Humble has neither it nor offset.",
)
_WORLD: Final = "Gravity is given in the axes of {base_frame}, {base_axes}: rotate it if the world axes differ."
_OWN_READING: Final[tuple[Property, ...]] = ("tilt", "rotation", "response")

# The formats by name, as in `--format`. Above each: project, file and version of the reader, and its formula.
FORMATS: Mapping[str, ExportFormat] = {
    # kth-ros-pkg/force_torque_tools, gravity_compensation/src/gravity_compensation_node.cpp and
    # gravity_compensation.cpp, master since pull request 18 (2021-05). a is the acceleration that its IMU reports,
    # in the axes of the sensor; at rest, it points up:
    #     force = raw - bias[:3] + gripper_mass a        torque = raw - bias[3:] + gripper_com x (gripper_mass a)
    "kth": ExportFormat(
        "ROS 1 node gravity_compensation of kth-ros-pkg/force_torque_tools",
        "ft_calib.yaml",
        content={
            "bias": ["*force_bias_N", "*torque_bias_Nm"],
            "gripper_com_frame_id": "$sensor_frame",
            "gripper_com_child_frame_id": "$tool_frame",
            "gripper_com_pose": ["*p_sensor_com_m", 0.0, 0.0, 0.0],
            "gripper_mass": "$mass_kg",
        },
        notes=(
            "The node waits for an IMU. Without one, publish sensor_msgs/Imu with the acceleration below, more than 10 "
            "times a second. Versions before May 2021 need it with the opposite sign.",
            _FRAMES,
        ),
        elsewhere={"imu header.frame_id": "$base_frame", "imu linear_acceleration": "$minus_gravity_m_s2"},
    ),
    # ICube-Robotics/ft_tools_ros2, ft_tools/src/ft_parameters.cpp and ft_estimation.cpp, main. Signs are those of the
    # code, which differ from its README. g is the parameter `gravity_in_reference_frame` in the sensor frame:
    #     force = raw - mass g - force_offset            torque = raw - com x (mass g) - torque_offset
    "ft-tools": ExportFormat(
        "ROS 2 node ft_estimation of ICube-Robotics/ft_tools_ros2",
        "calibration_parameters.yaml",
        content={
            "mass": "$mass_kg",
            "sensor_frame_to_com": "$p_sensor_com_m",
            "force_offset": "$force_bias_N",
            "torque_offset": "$torque_bias_Nm",
        },
        notes=(_FRAMES,),
        elsewhere=_FT_ESTIMATION,
    ),
    # As ft-tools: ft_msgs/msg/FtCalibration.msg, as `ros2 service call` and `ros2 topic pub` accept it: the only field
    # of a request to ft_msgs/srv/SetCalibration.
    "ros2-message": ExportFormat(
        "ROS 2 message ft_msgs/FtCalibration, for the service set_calibration",
        "calibration.yaml",
        content={
            "mass": "$mass_kg",
            "sensor_frame_to_com": "$p_sensor_com_m_xyz",
            "force_offset": "$force_bias_N_xyz",
            "torque_offset": "$torque_bias_Nm_xyz",
        },
        notes=(
            "The service ft_estimation_node/set_calibration takes it in the field ft_calibration of its request.",
            _FRAMES,
        ),
        elsewhere=_FT_ESTIMATION,
    ),
    # ros-controls/ros2_controllers, force_torque_sensor_broadcaster.cpp, 5.0 or newer (offset: 4.16;
    # sensor_filter_chain: September 2025), and ros-controls/control_toolbox, control_filters/gravity_compensation.hpp
    # and .cpp, master (control_filters.md has older names). g is the vector `gravity_field`, turned from world_frame
    # into sensor_frame:
    #     force = raw + offset.force - mass g            torque = raw + offset.torque - CoG x (mass g)
    "ros2-control": ExportFormat(
        "ros2_controllers force_torque_sensor_broadcaster with the gravity filter of control_toolbox",
        "ft.yaml",
        content=_BROADCASTER,
        notes=(*_OFFSET, _FRAMES),
    ),
    # ros-controls/ros2_controllers, admittance_controller/admittance_rule_impl.hpp, Humble to Kilted. In the axes of
    # fixed_world_frame, with the weight CoG.force in N, positive; the controller subtracts no bias:
    #     force_z = reading + CoG.force                  torque = reading - CoG.pos x [0, 0, -CoG.force]
    "admittance": ExportFormat(
        "ros2_controllers admittance_controller",
        "admittance.yaml",
        subtracts=("weight",),
        expresses=("rotation",),
        content={
            "admittance_controller": {
                "ros__parameters": {
                    "ft_sensor": {"name": "$sensor_frame", "frame": {"id": "$sensor_frame"}},
                    "fixed_world_frame": {"frame": {"id": "$base_frame"}},
                    "gravity_compensation": {
                        "frame": {"id": "$sensor_frame"},
                        "CoG": {"pos": "$p_sensor_com_m", "force": "$weight_N"},
                    },
                }
            }
        },
        notes=(
            "The controller subtracts no bias: subtract [{force_bias_N_words}, {torque_bias_Nm_words}] (N, N·m) where "
            "the hardware interface reads the sensor.",
            "If your version has the parameter sensor_filter_chain in place of gravity_compensation, copy the filter "
            "of the format ros2-control.",
            _FRAMES,
        ),
    ),
    # fzi-forschungszentrum-informatik/cartesian_controllers, cartesian_force_controller.cpp and
    # cartesian_compliance_controller.cpp, ROS 2, which have neither bias nor weight. ft_sensor_wrench must be
    # compensated, in the axes of ft_sensor_ref_link and about its origin; header.frame_id is not read. X moves it to
    # end_effector_link (force) or compliance_ref_link, R turns it into the axes of robot_base_link, and the arm moves
    # along the net force:
    #     net = R X (raw + offset - weight) + target     with the broadcaster of ros2-control before it
    "cartesian-controllers": ExportFormat(
        "FZI cartesian_controllers of ROS 2 for force and compliance, with the broadcaster of ros2-control",
        "controllers.yaml",
        content={
            **_BROADCASTER,
            "cartesian_force_controller": {"ros__parameters": {"ft_sensor_ref_link": "$sensor_frame"}},
            "cartesian_compliance_controller": {"ros__parameters": {"ft_sensor_ref_link": "$sensor_frame"}},
        },
        notes=(
            "Sign test: activate the force controller with a small solver.error_scale, and push the tool gently. The "
            "arm must yield along the push. If it moves against your hand, stop: the driver reports the reaction. "
            "Negate it there, and calibrate again.",
            "The controllers subtract neither bias nor weight: remap their topic ft_sensor_wrench to "
            "/force_torque_sensor_broadcaster/wrench_filtered, or to the wrench of `ftdrive ros2 --axes sensor --about "
            "sensor`. Add joints, gains and links of your cell.",
            "ft_sensor_ref_link must be a link of the robot model between robot_base_link and end_effector_link, with "
            "the origin of the sensor: use the format urdf. The controllers read neither static transforms nor "
            "header.frame_id.",
            "target_wrench is the wrench the tool is to exert: in axes of end_effector_link, or of robot_base_link if "
            "hand_frame_control is false.",
            *_OFFSET,
            _FRAMES,
        ),
    ),
    # jrl-umi3218/mc_rtc, src/mc_rbdyn/ForceSensor.cpp, master; Robot.cpp gives it the gravity of constants.h. 13
    # numbers, one per line: mass, rpy, com, offset. `rpy` turns the sensor of the model into the real one, here that of
    # a model whose sensor has the axes of the flange. `com` is in the axes of the sensor's parent body, from its
    # origin: here the flange. The offset has the torque first. g is along -z of the world, p is the sensor's position:
    #     force = raw - offset[3:] - mass g
    #     torque = raw - offset[:3] - (com - p) x (mass g), in sensor axes
    # White space must follow the last number. The reader stops there.
    "mc-rtc": ExportFormat(
        "mc_rtc, calib_data.NAME of a force sensor",
        "calib_data.ft_sensor",
        expresses=("rotation",),
        comment="# at the end",
        content="{mc_rtc_mass_kg!r}\n"
        + "".join(
            f"{{{name}[{i}]!r}}\n"
            for name in ("rpy_rad", "frame_com_m", "torque_bias_Nm", "force_bias_N")
            for i in range(3)
        ),
        notes=(
            "The parent body of the force sensor must be the flange ({flange_frame}), with the sensor at "
            "({origin_m_words}) m and its axes. World z must point up.",
            f"mass is weight / {MC_RTC_G_M_S2:g} m/s2, because mc_rtc multiplies it by that. Old versions have 9.81.",
        ),
    ),
    # xArm-Developer/xArm-Python-SDK, xarm/x3/ft_sensor.py, 1.11 or newer: mass (kg), centre of mass (mm), offsets of
    # force (N) and torque (N·m). The origin of `com` is that of the sensor: with `association_setting_tcp_load`, the
    # SDK adds 32 mm to reach the flange. The formula of the firmware is not public. It is assumed here, with g of the
    # calibration, and a sensor that has the axes of the flange:
    #     force = raw - offset[:3] - mass g              torque = raw - offset[3:] - com x (mass g)
    "xarm": ExportFormat(
        "UFACTORY xArm, the ten numbers of ft_sensor_cali_load",
        "load.yaml",
        expresses=("tilt",),
        content=["$mass_kg", "*com_mm", "*force_bias_N", "*torque_bias_Nm"],
        notes=(
            "The centre of mass is in mm. An SDK before 1.11 takes metres.",
            "The formula of the firmware and the sign of the offsets are not public. Read the sensor without contact "
            "in two poses before you use them.",
        ),
        elsewhere={"set_gravity_direction": "$gravity_direction"},
    ),
    # frankarobotics/libfranka, include/franka/robot.h, 0.8 or newer: mass (kg), centre of mass in flange axes from the
    # flange (m), inertia about the centre of mass (kg m2, column by column), as the service SetLoad of franka_ros takes
    # them. The load is all that the flange carries. Neither the formula nor g of the firmware is public; g is along -z
    # of the base, which cannot be changed:
    #     force on the flange = mass g                   torque about the flange = F_x_Cload x (mass g)
    "franka": ExportFormat(
        "Franka libfranka setLoad, with the mass of the sensor",
        "load.yaml",
        subtracts=("weight",),
        expresses=("rotation", "response"),
        content={"mass": "$payload_kg", "F_x_Cload": "$payload_com_m", "load_inertia": [0.0] * 9},
        notes=(
            "{assumed}",
            "The inertia was not identified: zeros stand for a point mass. Put values of the CAD model there.",
            "Franka names the centre of mass F_x_center_load in ROS 1 and center_of_mass in ROS 2.",
            "The load has no bias. How the controller uses the load is not public: compare O_F_ext_hat_K without "
            "contact in two poses.",
        ),
    ),
    # Universal Robots controller, URScript manual 5.10 or newer, set_target_payload(m, cog, inertia): kg, and m in
    # flange axes from the flange, no exponents. The payload is all that the flange carries. The statement zeroes the
    # sensor of an e-Series arm. The formula of the controller is not public. It is assumed, with g of `set_gravity`:
    #     force on the flange = m g                      torque about the flange = cog x (m g)
    "ur-payload": ExportFormat(
        "Universal Robots URScript set_target_payload, with the mass of the sensor",
        "payload.script",
        subtracts=("weight",),
        expresses=_OWN_READING,
        content="set_target_payload({payload_kg:.12f}, [{payload_com_m_fixed}], [{payload_inertia}])\n",
        notes=(
            "{assumed}",
            "The controller zeroes its own force sensor when this runs: keep the tool free and the arm still.",
            "{inertia_note} Needs PolyScope 5.10 or newer; use set_payload before that.",
            "The payload has no bias. How the controller uses it is not public: compare get_tcp_force() without "
            "contact in two poses.",
            "set_gravity expects the acceleration that points away from the earth, in base axes. The mounting in "
            "PolyScope sets it too.",
        ),
        elsewhere={"set_gravity": "$minus_gravity_base_m_s2"},
    ),
    # URDF 1.0, ros/urdfdom, to be included below the flange of a robot. The tool link has the frame of the sensor, so
    # that `origin` of `inertial` is the centre of mass in the sensor frame. `rpy` is R = Rz(yaw) Ry(pitch) Rx(roll).
    # g is the gravity of the simulation, in sensor axes:
    #     force on the sensor = mass g                   torque about its origin = origin x (mass g)
    "urdf": ExportFormat(
        "URDF links and fixed joints of sensor and tool",
        "tool.urdf",
        subtracts=("weight",),
        expresses=_OWN_READING,
        comment="<!-- -->",
        content="""\
<robot name="{tool_frame}">
  <link name="{flange_frame}" />
  <link name="{sensor_frame}" />
  <link name="{tool_frame}">
    <inertial>
      <origin xyz="{true_com_m_spaced}" rpy="0 0 0" />
      <mass value="{true_kg!r}" />
      {urdf_point_mass}<inertia ixx="{J[0]!r}" ixy="{J[1]!r}" ixz="{J[2]!r}" \
iyy="{J[4]!r}" iyz="{J[5]!r}" izz="{J[8]!r}" />
    </inertial>
  </link>
  <joint name="{flange_frame}_to_{sensor_frame}" type="fixed">
    <parent link="{flange_frame}" />
    <child link="{sensor_frame}" />
    <origin xyz="{origin_m_spaced}" rpy="{rpy_rad_spaced}" />
  </joint>
  <joint name="{sensor_frame}_to_{tool_frame}" type="fixed">
    <parent link="{sensor_frame}" />
    <child link="{tool_frame}" />
    <origin xyz="0.0 0.0 0.0" rpy="0.0 0.0 0.0" />
  </joint>
</robot>
""",
        notes=(
            "{inertia_note}",
            "Leave out the link {flange_frame} if your robot has it.",
            "The model contains neither the mass of the sensor itself nor its bias.",
            _WORLD,
        ),
        elsewhere={"gravity of the simulation": "$gravity_m_s2"},
    ),
    # MuJoCo, whose element `attach` attaches the body to the flange, and ros-controls/mujoco_ros2_control, which looks
    # for the sensors NAME_force and NAME_torque. The plugin is fts_grav_comp_plugin.cpp of mujoco_ros2_control_plugins,
    # pull request 308 of September 2026, newer than release 0.1.2 and wrong without the weight in the model. Without
    # the plugin, the simulated sensor shows the weight, as a real one does. With the gravity g of the model in the axes
    # of the sensor's site, the tool at rest reads
    #     force = mass g                                 torque = pos x (mass g)
    # and the plugin gives, with the reading as the hardware interface has it, which is minus that of MuJoCo:
    #     force = reading - CoG.mass g                   torque = reading - CoG.pos x (CoG.mass g)
    "mujoco": ExportFormat(
        "MuJoCo body of tool and sensor, with parameters for mujoco_ros2_control",
        "tool.xml",
        subtracts=("weight",),
        expresses=_OWN_READING,
        comment="<!-- -->",
        content="""\
<mujoco model="{tool_frame}">
  <!-- parameters of the plugin that removes the weight, for a file of their own:
/**:
  ros__parameters:
    mujoco_plugins:
      fts_grav_comp_plugin:
        type: mujoco_ros2_control_plugins/FtsGravCompPlugin
        {sensor_frame_yaml}:
          frame_id: {sensor_frame_yaml}
          CoG:
            pos: {true_com_m_yaml}
            mass: {true_kg_yaml}
-->
  <worldbody>
    <body name="{tool_frame}" pos="{origin_m_spaced}" quat="{quaternion_wxyz_spaced}">
      {mujoco_point_mass}<inertial pos="{true_com_m_spaced}" mass="{true_kg!r}" {mujoco_inertia} />
      <site name="{sensor_frame}" />
    </body>
  </worldbody>
  <sensor>
    <force name="{sensor_frame}_force" site="{sensor_frame}" />
    <torque name="{sensor_frame}_torque" site="{sensor_frame}" />
  </sensor>
</mujoco>
""",
        notes=(
            "Attach the body {tool_frame} to {flange_frame}. A simulated sensor has no bias.",
            "Plain MuJoCo sensors have the opposite sign: negate sensordata, as the hardware interface of "
            "mujoco_ros2_control does, to get the wrench on the sensor.",
            "{inertia_note} The body does not contain the mass of the sensor itself.",
            "The plugin FtsGravCompPlugin needs a mujoco_ros2_control newer than 0.1.2 (pull request 308, September "
            "2026).",
            _WORLD,
        ),
        elsewhere={"option gravity": "$gravity_m_s2"},
    ),
    # ros2/geometry2, tf2_ros static_transform_publisher, Humble or newer. Position (m) and quaternion map sensor
    # coordinates to those of the frame-id: p = R(q) p_sensor + (x, y, z).
    "static-transform": ExportFormat(
        "ROS 2 static_transform_publisher, flange to sensor",
        "transform.sh",
        subtracts=(),
        content="ros2 run tf2_ros static_transform_publisher "
        "--x {origin_m[0]!r} --y {origin_m[1]!r} --z {origin_m[2]!r} "
        "--qx {quaternion[0]!r} --qy {quaternion[1]!r} --qz {quaternion[2]!r} --qw {quaternion[3]!r} "
        "--frame-id {flange_frame} --child-frame-id {sensor_frame}\n",
        notes=("The transform contains only the position of the sensor, no bias and no weight.",),
    ),
    "json": ExportFormat(
        "JSON with everything that compensation needs", "ft.json", expresses=_OWN_READING, comment="none"
    ),
    "yaml": ExportFormat("YAML with everything that compensation needs", "ft.yaml", expresses=_OWN_READING),
}
