"""Each target, parsed by a standard parser, against numbers followed by hand: 2 kg at (10, -20, 50) mm, turned 90°."""

import json
import re
import shlex
import xml.etree.ElementTree as ET
from dataclasses import replace
from math import pi, sqrt
from typing import Any

import numpy as np
import pytest
import yaml
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from ftdrive import __version__
from ftdrive.exports.calibration.formats import FORMATS
from ftdrive.exports.calibration.registry import TARGETS, Export, export
from ftdrive.exports.calibration.settings import Settings
from tests.unit.ftdrive.exports.calibration.example import (
    G_M_S2,
    MEASURED,
    WEIGHT_N,
    calibration,
    responding,
    tilted,
)

FORCE = [1.0, -2.0, 0.00001]
TORQUE = [0.1, -0.2, 0.3]
COM = [0.01, -0.02, 0.05]
COM_IN_FLANGE = [0.02, 0.01, 0.033 + 0.05]
"""The sensor's x is the flange's y, and its y is the flange's -x."""
IN_YAML = [name for name, one in FORMATS.items() if one.file.endswith(".yaml")]


def made(name: str, settings: Settings = MEASURED, limit_N: float = 1e3) -> Export:
    return export(calibration(), name, settings, max_force_error_N=limit_N)


def document(name: str, settings: Settings = MEASURED) -> Any:
    return yaml.safe_load(made(name, settings).text)


def equal(found: Any, expected: Any) -> bool:
    return bool(np.allclose(found, expected, rtol=1e-15, atol=1e-17))


def xyz(found: dict[str, float]) -> list[float]:
    assert list(found) == ["x", "y", "z"]
    return list(found.values())


def test_kth_has_the_bias_as_it_is_and_an_accelerometer_that_points_up() -> None:
    found = document("kth")
    assert equal(found["bias"], FORCE + TORQUE)
    assert equal(found["gripper_com_pose"], [*COM, 0, 0, 0])
    assert equal(found["gripper_mass"], 2.0)
    assert (found["gripper_com_frame_id"], found["gripper_com_child_frame_id"]) == ("ft_sensor", "tool")
    assert made("kth").elsewhere["imu linear_acceleration"] == pytest.approx([0, 0, G_M_S2], abs=1e-15)


def test_ft_tools_has_offsets_as_they_are_and_gravity_down() -> None:
    found = document("ft-tools")
    assert list(found) == ["mass", "sensor_frame_to_com", "force_offset", "torque_offset"]
    assert equal([found["mass"], *found["sensor_frame_to_com"]], [2.0, *COM])
    assert equal(found["force_offset"] + found["torque_offset"], FORCE + TORQUE)
    elsewhere = export(tilted(30), "ft-tools", MEASURED).elsewhere
    gravity = elsewhere["calibration.gravity_in_reference_frame"]
    assert gravity == pytest.approx([-G_M_S2 / 2, 0, -G_M_S2 * sqrt(3) / 2], rel=1e-14)


def test_the_ros2_message_has_the_same_as_vectors() -> None:
    found = document("ros2-message")
    assert equal(found["mass"], 2.0)
    assert equal(xyz(found["sensor_frame_to_com"]), COM)
    assert equal(xyz(found["force_offset"]) + xyz(found["torque_offset"]), FORCE + TORQUE)
    assert made("ros2-message").elsewhere == made("ft-tools").elsewhere  # both are read by ft_estimation_node


def test_calaw_has_minus_the_mass_and_minus_the_moment_for_its_fixed_gravity() -> None:
    found = document("calaw")
    mass = WEIGHT_N / 9.81
    assert equal(found["mass"], -mass)
    assert equal(found["cog"], [-mass * 0.01, mass * 0.02, -mass * 0.05])
    assert equal(found["f_bias"] + found["t_bias"], FORCE + TORQUE)
    assert made("calaw").elsewhere["calib_params"] == [
        found["mass"],
        *found["cog"],
        *found["f_bias"],
        *found["t_bias"],
    ]


def test_ros2_control_adds_minus_the_bias_and_has_the_tilt() -> None:
    found = yaml.safe_load(export(tilted(30), "ros2-control", MEASURED).text)
    parameters = found["force_torque_sensor_broadcaster"]["ros__parameters"]
    assert equal(xyz(parameters["offset"]["force"]), [-1.0, 2.0, -0.00001])
    assert equal(xyz(parameters["offset"]["torque"]), [-0.1, 0.2, -0.3])
    gravity = parameters["sensor_filter_chain"]["filter1"]
    assert gravity["type"] == "control_filters/GravityCompensationWrench"
    assert (gravity["params"]["world_frame"], gravity["params"]["sensor_frame"]) == ("base", "ft_sensor")
    tool = gravity["params"]["tool"]
    assert equal([tool["mass"], *tool["CoG"]], [2.0, *COM])
    assert tool["gravity_field"] == pytest.approx([-G_M_S2 / 2, 0, -G_M_S2 * sqrt(3) / 2], rel=1e-14)


def test_admittance_has_the_weight_positive_and_prints_the_bias_that_it_lacks() -> None:
    parameters = document("admittance")["admittance_controller"]["ros__parameters"]
    assert equal(parameters["gravity_compensation"]["CoG"]["force"], WEIGHT_N)
    assert equal(parameters["gravity_compensation"]["CoG"]["pos"], COM)
    assert parameters["gravity_compensation"]["frame"]["id"] == "ft_sensor"
    assert parameters["fixed_world_frame"]["frame"]["id"] == "base"
    assert any("[1.0, -2.0, 1e-05, 0.1, -0.2, 0.3]" in note for note in made("admittance").notes)


def test_kit_has_the_weight_positive_and_the_offset_static() -> None:
    found = document("kit")
    offset = found["Calibration"]["Offset"]
    assert offset["isStatic"] is True
    assert equal(xyz(offset["force"]) + xyz(offset["torque"]), FORCE + TORQUE)
    parameters = found["GravityCompensation"]["params"]
    assert equal([parameters[name] for name in ("CoG_x", "CoG_y", "CoG_z", "force")], [*COM, WEIGHT_N])
    assert parameters["world_frame"] == "base"


def test_code_iai_has_a_mass_a_position_and_gravity_down() -> None:
    found = document("code-iai")
    assert equal([found["mass"], *found["center_of_mass"]], [2.0, *COM])
    assert equal(found["offset"]["force"] + found["offset"]["torque"], FORCE + TORQUE)
    gravity = made("code-iai").elsewhere["gravity_publisher gravity_vector"]
    assert gravity == pytest.approx([0, 0, -G_M_S2], abs=1e-15)


def test_mc_rtc_has_13_numbers_first_the_centre_in_the_flange_and_the_couple_before_the_force() -> None:
    lines = made("mc-rtc").text.splitlines()
    expected = [2.0, 0, 0, pi / 2, *COM_IN_FLANGE, *TORQUE, *FORCE]
    assert [float(line) for line in lines[:13]] == pytest.approx(expected, abs=1e-15)
    assert all(line.startswith("#") for line in lines[13:])  # its reader stops after 13


def test_xarm_has_ten_numbers_and_millimetres() -> None:
    assert document("xarm") == pytest.approx([2.0, 10, -20, 50, *FORCE, *TORQUE], rel=1e-14)
    assert made("xarm").elsewhere["set_gravity_direction"] == pytest.approx([0, 0, -1], abs=1e-15)


PAYLOAD_COM = [2 * 0.02 / 2.5, 2 * 0.01 / 2.5, (2 * 0.083 + 0.5 * 0.015) / 2.5]
"""2 kg of tool and 0.5 kg of sensor, 15 mm below the flange face."""


def test_franka_has_tool_and_sensor_in_the_flange_and_no_invented_inertia() -> None:
    found = document("franka")
    assert found["mass"] == pytest.approx(2.5, rel=1e-15)
    assert found["F_x_Cload"] == pytest.approx(PAYLOAD_COM, rel=1e-14)
    assert found["load_inertia"] == [0.0] * 9
    assert any("not identified" in note for note in made("franka").notes)


def test_ur_payload_is_one_statement_without_exponents() -> None:
    comments, statement = made("ur-payload").text.rsplit("\n", 2)[:2]
    assert all(line.startswith("#") and line.isascii() for line in comments.splitlines())
    match = re.fullmatch(r"set_target_payload\(([\d.]+), \[([-\d., ]+)\], \[0, 0, 0, 0, 0, 0\]\)", statement)
    assert match
    assert float(match[1]) == pytest.approx(2.5, abs=1e-12)
    assert [float(x) for x in match[2].split(", ")] == pytest.approx(PAYLOAD_COM, abs=1e-12)


def test_a_sensor_inside_the_arm_adds_nothing_to_the_payload() -> None:
    found = document("franka", Settings(height_mm=0.0, sensor_mass_kg=0.0))
    assert found["mass"] == pytest.approx(2.0, rel=1e-15)
    assert found["F_x_Cload"] == pytest.approx([0.02, 0.01, 0.05], rel=1e-14)


def test_urdf_is_a_tree_with_the_mount_and_an_inertia_marked_as_not_identified() -> None:
    text = made("urdf").text
    robot = ET.fromstring(text)
    assert [link.get("name") for link in robot.iter("link")] == ["tool0", "ft_sensor", "tool"]
    mount, tool = robot.iter("joint")
    assert (mount.find("parent"), mount.find("child")) != (None, None)
    ends = [one.get("link") for joint in (mount, tool) for one in (*joint.iter("parent"), *joint.iter("child"))]
    assert ends == ["tool0", "ft_sensor", "ft_sensor", "tool"]
    origins = [[list(map(float, one.attrib[key].split())) for key in ("xyz", "rpy")] for one in robot.iter("origin")]
    expected: list[list[list[float]]] = [[COM, [0] * 3], [[0, 0, 0.033], [0, 0, pi / 2]], [[0] * 3, [0] * 3]]
    assert np.allclose(origins, expected, atol=1e-15)
    assert float(robot.find(".//mass").get("value")) == pytest.approx(2.0)  # type: ignore[union-attr, arg-type]
    assert set(robot.find(".//inertia").attrib.values()) == {"0.0"}  # type: ignore[union-attr]
    assert "not identified" in text.partition("<inertia ")[0].rpartition("<mass")[2]


def test_mujoco_has_the_tool_at_the_site_of_the_sensor_and_the_parameters_of_the_plugin() -> None:
    text = made("mujoco").text
    (body,) = ET.fromstring(text).iter("body")
    inertial, site = body
    values = {name: list(map(float, body.attrib[name].split())) for name in ("pos", "quat")}
    assert values["pos"] == pytest.approx([0, 0, 0.033], abs=1e-15)
    assert values["quat"] == pytest.approx([sqrt(0.5), 0, 0, sqrt(0.5)], abs=1e-15)
    assert (site.tag, site.attrib) == ("site", {"name": "ft_sensor"})
    assert equal([float(x) for x in inertial.attrib["pos"].split()], COM)
    assert float(inertial.attrib["mass"]) == pytest.approx(2.0)
    assert inertial.attrib["diaginertia"] == "0 0 0"
    assert "not identified" in text.partition("<inertial ")[0].rpartition("<body")[2]
    sensors = [(one.tag, one.get("name"), one.get("site")) for one in ET.fromstring(text).iterfind("sensor/*")]
    assert sensors == [("force", "ft_sensor_force", "ft_sensor"), ("torque", "ft_sensor_torque", "ft_sensor")]
    parameters = yaml.safe_load("/**:" + text.partition("/**:")[2].partition("-->")[0])
    plugin = parameters["/**"]["ros__parameters"]["mujoco_plugins"]["fts_grav_comp_plugin"]
    assert plugin["type"] == "mujoco_ros2_control_plugins/FtsGravCompPlugin"
    assert plugin["ft_sensor"]["frame_id"] == "ft_sensor"
    assert equal([plugin["ft_sensor"]["CoG"]["mass"], *plugin["ft_sensor"]["CoG"]["pos"]], [2.0, *COM])
    assert any(
        "Plain MuJoCo sensors have the opposite sign: negate sensordata" in note for note in made("mujoco").notes
    )
    assert made("mujoco").elsewhere["option gravity"] == pytest.approx([0, 0, -G_M_S2], abs=1e-15)


ROS = replace(MEASURED, base_frame="base_link", flange_frame="flange")


def test_base_link_is_turned_by_half_a_turn_against_the_base_of_the_controller() -> None:
    down = [G_M_S2 / 2, 0, -G_M_S2 * sqrt(3) / 2]
    found = yaml.safe_load(export(tilted(30), "ros2-control", ROS).text)["force_torque_sensor_broadcaster"]
    tool = found["ros__parameters"]["sensor_filter_chain"]["filter1"]["params"]["tool"]
    assert tool["gravity_field"] == pytest.approx(down, rel=1e-14)
    assert export(tilted(30), "kth", ROS).elsewhere["imu linear_acceleration"] == pytest.approx([-x for x in down])
    assert export(tilted(30), "ur-payload", ROS).elsewhere["set_gravity"] == pytest.approx([down[0], 0, -down[2]])


def test_the_flange_of_ros_industrial_has_x_out_of_it() -> None:
    """The sensor's x is tool0's y, and so its z; y is tool0's -x, and so its -y; z is tool0's z, and so its x."""
    words = shlex.split(made("static-transform", ROS).text, comments=True)
    found = dict(zip(words[4::2], words[5::2], strict=True))
    assert [float(found[f"--{axis}"]) for axis in "xyz"] == pytest.approx([0.033, 0, 0], abs=1e-15)
    half = sqrt(0.5)
    assert [float(found[f"--q{axis}"]) for axis in "xyzw"] == pytest.approx([half, 0, half, 0], abs=1e-15)
    lines = made("mc-rtc", ROS).text.splitlines()
    assert [float(line) for line in lines[4:7]] == pytest.approx([0.083, 0.02, 0.01], abs=1e-15)


def test_static_transform_is_one_command_with_the_scalar_last() -> None:
    words = shlex.split(made("static-transform").text, comments=True)
    assert words[:4] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    found = dict(zip(words[4::2], words[5::2], strict=True))
    assert (found["--frame-id"], found["--child-frame-id"]) == ("tool0", "ft_sensor")
    values = [float(found[f"--{name}"]) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    assert values == pytest.approx([0, 0, 0.033, 0, 0, sqrt(0.5), sqrt(0.5)], abs=1e-15)


@pytest.mark.parametrize(("name", "parse"), [("json", json.loads), ("yaml", yaml.safe_load)])
def test_the_complete_formats_keep_every_bit_and_the_response(name: str, parse: Any) -> None:
    result = responding(0.01, 0.002)
    found = parse(export(result, name, MEASURED, max_force_error_N=0.0).text)
    saved = result.to_dict()
    for key in ("gravity_force_base_N", "R_flange_sensor", "force_bias_N", "torque_bias_Nm", "p_sensor_com_m", "id"):
        assert found[key] == saved[key]
    assert found["response"] == {key: saved["response"][key] for key in ("force_gain", "cross_talk_m")}
    assert found["p_flange_sensor_m"] == [0.0, 0.0, 0.033]
    assert parse(export(result, name, Settings()).text)["p_flange_sensor_m"] is None


@pytest.mark.parametrize("name", IN_YAML)
def test_two_yaml_readers_agree_and_a_small_number_is_a_number_to_both(name: str) -> None:
    """YAML 1.1 reads 1e-05 as a text, and ROS 1 reads YAML 1.1."""
    text = made(name).text
    one, other = yaml.safe_load(text), YAML(typ="safe").load(text)
    assert one == other
    assert len(IN_YAML) == 11

    def leaves(value: Any) -> list[Any]:
        if isinstance(value, dict):
            return [leaf for item in value.values() for leaf in leaves(item)]
        return [leaf for item in value for leaf in leaves(item)] if isinstance(value, list) else [value]

    assert not [leaf for leaf in leaves(one) if isinstance(leaf, str) and re.fullmatch(r"[-+.\de]+", leaf)]
    assert not [leaf for leaf in leaves(one) if type(leaf) is int]  # rclcpp rejects 0 where it wants 0.0


@pytest.mark.parametrize("name", TARGETS)
def test_every_text_names_calibration_date_and_version(name: str) -> None:
    text = made(name).text
    for word in (calibration().id, "2026-11-14T08:00:00+00:00", f"ftdrive {__version__}"):
        assert word in text


def test_a_name_that_yaml_would_read_as_true_is_quoted() -> None:
    settings = Settings(sensor_frame="yes", base_frame="on")
    filter1 = document("ros2-control", settings)["force_torque_sensor_broadcaster"]["ros__parameters"]
    assert filter1["sensor_name"] == "yes"
    assert filter1["sensor_filter_chain"]["filter1"]["params"]["world_frame"] == "on"


def numbers_after(words: str, notes: tuple[str, ...]) -> list[float]:
    """Read the numbers in the brackets that follow some words in a note."""
    (note,) = (one for one in notes if words in one)
    found = re.search(r"[(\[](-?\d[^)\]]*)[)\]]", note[note.index(words) :])
    assert found is not None
    return [float(number) for number in found[1].split(",")]


def test_notes_have_all_digits() -> None:
    """A user who copies six digits would turn the sensor by 1e-5 rad, and be wrong by 1e-5 N."""
    R = Rotation.random(rng=7).as_matrix()
    parameters = replace(calibration(R_flange_sensor=R).parameters, force_bias_N=np.array([1, -2, 3]) / 7)
    odd = replace(calibration(), parameters=parameters)
    for name in ("ft-tools", "ros2-control", "admittance"):
        notes = export(odd, name, MEASURED, max_force_error_N=1e3).notes
        rpy = numbers_after("roll, pitch, yaw = ", notes)
        np.testing.assert_allclose(Rotation.from_euler("xyz", rpy).as_matrix(), R, rtol=0, atol=1e-15)
    bias = numbers_after("subtracts no bias: subtract ", notes)
    assert bias == [*(np.array([1, -2, 3]) / 7), *TORQUE]
    raised = replace(MEASURED, height_mm=100 / 3)
    notes = export(odd, "mc-rtc", raised, max_force_error_N=1e3).notes
    assert numbers_after("with the sensor at ", notes)[2] == raised.p_frame_sensor_m("mc-rtc")[2]
