"""The targets' formulas on one tool that is easy to compute by hand.

The tool weighs 10 N (1 kg at g = 10 m/s2), its centre of mass is at (20, 0, 100) mm in the sensor. The sensor is
turned by +90 deg about the flange's z and sits 30 mm above it; sensor and adapter weigh 0.5 kg, 15 mm above the flange.

| | flange z | gravity in flange | in sensor (x = flange y, y = -flange x) | torque p x F |
|---|---|---|---|---|
| DOWN: flange turned 180 deg about x | down | (0, 0, 10) | (0, 0, 10) | (0, -0.2, 0) |
| LEVEL: flange turned 90 deg about y | along base x | (10, 0, 0) | (0, -10, 0) | (1, 0, -0.2) |
| TILTED: as DOWN, base tilted, 3-4-5 | | (6, 0, 8) | (0, -6, 8) | (0.6, -0.16, -0.12) |

Raw = torque or force of the table + bias (1, 2, 3) N, (0.1, 0.2, 0.3) N·m + contact (0.5, 0, 0) N, (0, 0, 0.25) N·m.
"""

import math
from typing import Any

import numpy as np
import pytest

from tests.target_formulas import TARGETS, evaluate

DOWN = np.diag([1.0, -1.0, -1.0])
LEVEL = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
RAW = np.array([[1.5, 2.0, 13.0, 0.1, 0.0, 0.55], [1.5, -8.0, 3.0, 1.1, 0.2, 0.35]])
CONTACT = [0.5, 0.0, 0.0, 0.0, 0.0, 0.25]
TILTED_RAW = np.array([[1.5, -4.0, 11.0, 0.7, 0.04, 0.43]])
TILTED_GRAVITY = [6.0, 0.0, -8.0]

CONTEXT: dict[str, Any] = {
    "R_flange_sensor": [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
    "p_flange_sensor_m": [0.0, 0.0, 0.03],
    "g_m_s2": 10.0,
    "force_bias_N": [1.0, 2.0, 3.0],
    "torque_bias_Nm": [0.1, 0.2, 0.3],
    "sensor_mass_kg": 0.5,
    "p_flange_sensor_com_m": [0.0, 0.0, 0.015],
    "p_sensor_com_m": [0.02, 0.0, 0.1],
    "gravity_force_base_N": [0.0, 0.0, -10.0],
}
KG_AT_9_81 = 10 / 9.81
COG_FLANGE = (0.0, 0.02 / 1.5, (0.13 + 0.5 * 0.015) / 1.5)
"""Of tool, sensor and adapter: the tool's is (0, 20, 130) mm in the flange."""
QUARTER = math.sqrt(0.5)

TEXTS = {
    "kth": """
bias: [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]
gripper_com_frame_id: ft_sensor
gripper_com_child_frame_id: gripper_com
gripper_com_pose: [0.02, 0.0, 0.1, 0.0, 0.0, 0.0]
gripper_mass: 1.0
""",
    "ft-tools": """
mass: 1.0
sensor_frame_to_com: [0.02, 0.0, 0.1]
force_offset: [1.0, 2.0, 3.0]
torque_offset: [0.1, 0.2, 0.3]
""",
    "calaw": f"""
mass: {-KG_AT_9_81}
cog: [{-0.02 * KG_AT_9_81}, 0.0, {-0.1 * KG_AT_9_81}]
f_bias: [1.0, 2.0, 3.0]
t_bias: [0.1, 0.2, 0.3]
""",
    "ros2-control": """
force_torque_sensor_broadcaster:
  ros__parameters:
    frame_id: ft_sensor
    sensor_name: ft_sensor
    offset:
      force: {x: -1.0, y: -2.0, z: -3.0}
      torque: {x: -0.1, y: -0.2, z: -0.3}
    sensor_filter_chain:
      filter1:
        name: gravity_compensation
        type: control_filters/GravityCompensationWrench
        params:
          world_frame: base
          sensor_frame: ft_sensor
          tool: {CoG: [0.02, 0.0, 0.1], mass: 1.0, gravity_field: [0.0, 0.0, -10.0]}
""",
    "admittance": """
admittance_controller:
  ros__parameters:
    ft_sensor: {name: ft_sensor, frame: {id: ft_sensor}}
    fixed_world_frame: {frame: {id: base_link}}
    gravity_compensation: {frame: {id: ft_sensor}, CoG: {pos: [0.02, 0.0, 0.1], force: 10.0}}
""",
    "mc-rtc": f"{10 / 9.80665}\n0 0 {math.pi / 2}\n0 0.02 0.13\n0.1 0.2 0.3\n1 2 3\n",
    "xarm": "arm.ft_sensor_cali_load([1.0, 20.0, 0.0, 100.0, 1.0, 2.0, 3.0, 0.1, 0.2, 0.3])  # kg, mm, N, N·m [SDK]\n",
    "franka": f"""
mass: 1.5
F_x_Cload: [{COG_FLANGE[0]}, {COG_FLANGE[1]}, {COG_FLANGE[2]}]
load_inertia: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
""",
    "kit": """
Calibration:
  Offset:
    isStatic: true
    force: {x: 1.0, y: 2.0, z: 3.0}
    torque: {x: 0.1, y: 0.2, z: 0.3}
GravityCompensation:
  params: {world_frame: base_link, sensor_frame: s, force_frame: s, CoG_x: 0.02, CoG_y: 0.0, CoG_z: 0.1, force: 10.0}
""",
    "code-iai": """
center_of_mass:
- 0.02
- 0.0
- 0.1
mass: 1.0
offset:
  force: [1.0, 2.0, 3.0]
  torque: [0.1, 0.2, 0.3]
""",
    "urdf": f"""
<link name="ft_sensor"/>
<joint name="flange-ft_sensor" type="fixed">
  <parent link="tool0"/><child link="ft_sensor"/><origin xyz="0 0 0.03" rpy="0 0 {math.pi / 2}"/>
</joint>
<link name="tool"><inertial><origin xyz="0.02 0 0.1" rpy="0 0 0"/><mass value="1.0"/></inertial></link>
<joint name="ft_sensor-tool" type="fixed"><parent link="ft_sensor"/><child link="tool"/></joint>
""",
    "mujoco": f"""
<worldbody><body name="tool0"><body name="ft_sensor" pos="0 0 0.03" quat="{QUARTER} 0 0 {QUARTER}">
  <site name="ft_sensor"/>
  <inertial pos="0.02 0 0.1" mass="1.0" diaginertia="1e-6 1e-6 1e-6"/>
</body></body></worldbody>
""",
    "ur-payload": f"""
# m, cog in kg, m
set_target_payload(1.5, [{COG_FLANGE[0]}, {COG_FLANGE[1]}, {COG_FLANGE[2]}], [0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
""",
    "static-transform": f"""
# the operator's mounting
ros2 run tf2_ros static_transform_publisher --x 0 --y 0 --z 0.03 \\
  --qx 0 --qy 0 --qz {QUARTER} --qw {QUARTER} --frame-id tool0 --child-frame-id ft_sensor
""",
    "ros2-message": """
mass: 1.0
sensor_frame_to_com: {x: 0.02, y: 0.0, z: 0.1}
force_offset: {x: 1.0, y: 2.0, z: 3.0}
torque_offset: {x: 0.1, y: 0.2, z: 0.3}
""",
    "json": """{
 "format": "ftdrive.export/1",
 "R_flange_sensor": [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
 "gravity_force_base_N": [0.0, 0.0, -10.0],
 "p_sensor_com_m": [0.02, 0.0, 0.1],
 "force_bias_N": [1.0, 2.0, 3.0], "torque_bias_Nm": [0.1, 0.2, 0.3], "response": null
}""",
    "yaml": """
format: ftdrive.export/1
R_flange_sensor: [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
gravity_force_base_N: [0.0, 0.0, -10.0]
p_sensor_com_m: [0.02, 0.0, 0.1]
force_bias_N: [1.0, 2.0, 3.0]
torque_bias_Nm: [0.1, 0.2, 0.3]
response: null
""",
}


def test_every_target_has_a_text() -> None:
    assert set(TEXTS) == set(TARGETS)


@pytest.mark.parametrize("name", TEXTS)
def test_only_the_contact_is_left(name: str) -> None:
    left = evaluate(name, TEXTS[name], np.array([DOWN, LEVEL]), RAW, CONTEXT)
    np.testing.assert_allclose(left, [CONTACT, CONTACT], atol=1e-12)


TURNED_CONTEXT = CONTEXT | {"R_flange_sensor": [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]}
"""Roll 90 deg, then yaw 90 deg: sensor x, y, z are flange y, z, x. The tool is at (100, 20, 30) mm in the flange."""
TURNED_RAW = np.array([[1.5, 12.0, 3.0, -0.9, 0.2, 0.75], [1.5, 2.0, 13.0, 0.1, 0.0, 0.55]])
"""Free tool: (0, 10, 0) N, (-1, 0, 0.2) N·m and (0, 0, 10) N, (0, -0.2, 0) N·m."""
TURNED = {
    "mc-rtc": f"{10 / 9.80665} {math.pi / 2} 0 {math.pi / 2} 0.1 0.02 0.03 0.1 0.2 0.3 1 2 3\n",
    "urdf": TEXTS["urdf"].replace('rpy="0 0 1', f'rpy="{math.pi / 2} 0 1'),
    "mujoco": TEXTS["mujoco"].replace(f"{QUARTER} 0 0 {QUARTER}", "0.5 0.5 0.5 0.5"),
    "static-transform": TEXTS["static-transform"].replace(
        f"--qx 0 --qy 0 --qz {QUARTER} --qw {QUARTER}", "--qx 0.5 --qy 0.5 --qz 0.5 --qw 0.5"
    ),
    "json": TEXTS["json"].replace(
        "[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]", "[[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]"
    ),
    "franka": TEXTS["franka"].replace(
        f"{COG_FLANGE[0]}, {COG_FLANGE[1]}, {COG_FLANGE[2]}", f"{0.1 / 1.5}, {0.02 / 1.5}, {0.0375 / 1.5}"
    ),
}


@pytest.mark.parametrize(("name", "text"), TURNED.items(), ids=TURNED)
def test_a_mounting_about_two_axes(name: str, text: str) -> None:
    left = evaluate(name, text, np.array([DOWN, LEVEL]), TURNED_RAW, TURNED_CONTEXT)
    np.testing.assert_allclose(left, [CONTACT, CONTACT], atol=1e-12)


TILTED = {
    "ros2-control": TEXTS["ros2-control"].replace("[0.0, 0.0, -10.0]", "[6.0, 0.0, -8.0]"),
    "ros2-control, base_link": TEXTS["ros2-control"]
    .replace("world_frame: base", "world_frame: base_link")
    .replace("[0.0, 0.0, -10.0]", "[-6.0, 0.0, -8.0]"),
    "json": TEXTS["json"].replace("[0.0, 0.0, -10.0]", "[6.0, 0.0, -8.0]"),
}


@pytest.mark.parametrize(("name", "text"), TILTED.items(), ids=TILTED)
def test_a_tilt_in_the_file_counts(name: str, text: str) -> None:
    left = evaluate(name.partition(",")[0], text, DOWN[None], TILTED_RAW, CONTEXT)
    np.testing.assert_allclose(left, [CONTACT], atol=1e-12)


@pytest.mark.parametrize(
    "name", ["kth", "ft-tools", "ros2-message", "code-iai", "xarm", "franka", "urdf", "mujoco", "ur-payload"]
)
def test_a_tilt_among_the_settings_of_the_target_counts(name: str) -> None:
    left = evaluate(name, TEXTS[name], DOWN[None], TILTED_RAW, CONTEXT | {"gravity_m_s2": TILTED_GRAVITY})
    np.testing.assert_allclose(left, [CONTACT], atol=1e-12)


@pytest.mark.parametrize("name", ["admittance", "kit", "calaw", "mc-rtc"])
def test_what_a_target_cannot_express_is_left_over(name: str) -> None:
    # The target takes (0, 0, 10) N and (0, -0.2, 0) N·m off; the load is (0, -6, 8) N, (0.6, -0.16, -0.12) N·m.
    left = evaluate(name, TEXTS[name], DOWN[None], TILTED_RAW, CONTEXT | {"gravity_m_s2": TILTED_GRAVITY})
    np.testing.assert_allclose(left, [[0.5, -6.0, -2.0, 0.6, 0.04, 0.13]], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("mc-rtc", TEXTS["mc-rtc"].rstrip()),  # std::ifstream is no longer good() after the last number
        ("mc-rtc", "# mass\n" + TEXTS["mc-rtc"]),
        ("ros2-control", TEXTS["ros2-control"].replace("mass: 1.0", "mass: 1")),  # rcl: an integer is not a double
        ("ros2-control", TEXTS["ros2-control"].replace("0.02, 0.0, 0.1", "0.02, 0, 0.1")),
        ("ros2-control", TEXTS["ros2-control"].replace("CoG:", "pos:")),  # until 2025
        ("kth", TEXTS["kth"].replace("0.02, 0.0", "1e-05, 0.0")),  # YAML 1.1: a string
        ("kth", TEXTS["kth"].replace("mass: 1.0", "mass: -1.0")),
        ("ft-tools", TEXTS["ft-tools"].replace("force_offset", "force_bias")),
        ("kit", TEXTS["kit"].replace("isStatic: true", "isStatic: false")),
        ("franka", TEXTS["franka"].replace(", 1.0]", "]")),
        ("ur-payload", TEXTS["ur-payload"].replace(", 0.0]", "]")),
        ("xarm", TEXTS["xarm"].replace(", 0.3]", "]")),
        ("static-transform", TEXTS["static-transform"].replace("--qx 0", "--qx 1")),
        ("json", TEXTS["json"].replace("/1", "/2")),
    ],
)
def test_a_file_that_the_target_cannot_read_is_an_error(name: str, text: str) -> None:
    assert text != TEXTS[name]
    with pytest.raises((ValueError, KeyError)):
        evaluate(name, text, DOWN[None], RAW[:1], CONTEXT)
