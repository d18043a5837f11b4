"""What a controller assumes about gravity and payload, who sets it, and what its own readings make of it."""

from dataclasses import replace

import numpy as np
import pytest

from ftmocks.kinematics import MODELS, Vector3, Vector6, forward, vector3, vector6
from ftmocks.ur.robot import Robot, RobotSettings
from ftmocks.ur.uploads import Upload, start_upload
from ftmocks.ur.variables import OUTPUTS
from ftmocks.world import Truth, World
from tests.unit.mocks.ur.urscript_robot import HOME, run

DH = MODELS["UR5e"]
TURNED = vector6(np.radians([20, -80, 70, -120, 40, -30]))
UPRIGHT = (0.0, 0.0, 9.82)
WALL = (9.82, 0.0, 0.0)
TRUTH = replace(
    Truth.drawn(3),
    sensor_mass_kg=0.3,
    p_flange_sensor_m=np.array([0.0, 0.01, 0.05]),
    tilt_alpha_rad=0.0,
    tilt_beta_rad=0.0,
    g_m_s2=9.82,
)
"""A base that stands exactly as the installation says."""


def robot_with(payload_kg: float, payload_cog_m: Vector3, q: Vector6 = HOME) -> Robot:
    return Robot(World(TRUTH, DH, q), RobotSettings(payload_kg=payload_kg, payload_cog_m=payload_cog_m))


def informed(q: Vector6 = HOME) -> Robot:
    """Its payload is the true one."""
    return robot_with(TRUTH.payload_kg, vector3(TRUTH.payload_cog_m), q)


def reported(robot: Robot) -> Vector3:
    gravity: Vector3 = OUTPUTS["target_gravity"][1](robot)  # type: ignore[assignment]  # a VECTOR3D
    return gravity


def started(name: str, body: str, robot: Robot) -> Robot:
    assert start_upload(robot, Upload(name, f"def {name}():\n  {body}\nend\n", secondary=False)), robot.events[-1].why
    run(robot, 0.2)
    return robot


def command(robot: Robot, number: int, *doubles: float) -> None:
    """Let the control script carry out a command, as ur_rtde sends it."""
    values = {f"input_double_register_{i}": value for i, value in enumerate(doubles)}
    robot.write_inputs({"input_int_register_0": number, **values})
    run(robot, 0.01)
    robot.write_inputs({"input_int_register_0": 0})
    run(robot, 0.01)


def test_an_upright_installation_assumes_9_82_away_from_the_earth() -> None:
    assert reported(Robot(World(Truth.drawn(0), DH, HOME), RobotSettings())) == UPRIGHT, "wherever the base leans"


def test_command_59_and_a_program_set_gravity() -> None:
    robot = started("rtde_control", "", informed())
    command(robot, 59, *WALL)
    assert reported(robot) == WALL
    started("upright", "set_gravity([0, 0.0, 9.82])", robot)
    assert reported(robot) == UPRIGHT


@pytest.mark.parametrize("d", ["[0, 9.82]", "9.82", '[0, 0, "9.82"]'])
def test_gravity_that_is_no_vector_ends_the_program(d: str) -> None:
    robot = started("wrong", f"set_gravity({d})", informed())
    assert "set_gravity: d must be" in robot.events[-1].why
    assert reported(robot) == UPRIGHT


@pytest.mark.parametrize("q", [HOME, TURNED])
def test_a_true_payload_leaves_no_force_in_any_posture(q: Vector6) -> None:
    np.testing.assert_allclose(informed(q).tcp_wrench(), 0.0, atol=1e-12)


@pytest.mark.parametrize("q", [HOME, TURNED])
def test_a_payload_without_the_sensor_leaves_the_weight_of_the_sensor(q: Vector6) -> None:
    p_flange_tool_m = TRUTH.p_flange_sensor_m + TRUTH.R_flange_sensor @ TRUTH.p_sensor_com_m
    robot = robot_with(TRUTH.mass_kg, vector3(p_flange_tool_m), q)
    weight_N = np.array([0.0, 0.0, -0.3 * 9.82])
    lever_m = forward(DH, q)[:3, :3] @ TRUTH.p_flange_sensor_m / 2
    np.testing.assert_allclose(robot.tcp_wrench(), [*weight_N, *np.cross(lever_m, weight_N)], atol=1e-12)


def test_another_gravity_shows_in_the_force_of_an_arm_at_rest() -> None:
    robot = informed()
    assert np.linalg.norm(robot.tcp_wrench()) < 1e-12
    robot.target_gravity_m_s2 = WALL
    left_N = TRUTH.payload_kg * (np.array(WALL) - UPRIGHT)
    np.testing.assert_allclose(robot.tcp_wrench()[:3], left_N, atol=1e-12)


def test_a_target_payload_zeroes_the_force_and_a_payload_does_not() -> None:
    robot = started("rtde_control", "", informed())
    command(robot, 17, TRUTH.payload_kg + 1.0, 0.0, 0.0, 0.04)
    assert np.linalg.norm(robot.tcp_wrench()[:3]) == pytest.approx(9.82)
    command(robot, 65, TRUTH.payload_kg + 2.0, 0.0, 0.0, 0.05, *[0.01] * 6)
    assert robot.payload_kg == TRUTH.payload_kg + 2.0
    np.testing.assert_allclose(robot.tcp_wrench(), 0.0, atol=1e-12)
