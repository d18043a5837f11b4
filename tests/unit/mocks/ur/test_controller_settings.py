"""What a controller assumes about gravity and payload, who sets it, and what its own readings make of it."""

from dataclasses import replace

import numpy as np
import pytest

from ftmocks.kinematics import MODELS, Vector3, Vector6, vector3
from ftmocks.ur.robot import Robot, RobotSettings
from ftmocks.ur.uploads import Upload, start_upload
from ftmocks.ur.variables import OUTPUTS
from ftmocks.world import Truth, World
from tests.unit.mocks.ur.urscript_robot import HOME, run

DH = MODELS["UR5e"]
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


def test_command_59_and_a_program_set_gravity() -> None:
    robot = started("rtde_control", "", informed())
    command(robot, 59, *WALL)
    assert reported(robot) == WALL
    started("upright", "set_gravity([0, 0.0, 9.82])", robot)
    assert reported(robot) == UPRIGHT


def test_a_target_payload_zeroes_the_force_and_a_payload_does_not() -> None:
    robot = started("rtde_control", "", informed())
    command(robot, 17, TRUTH.payload_kg + 1.0, 0.0, 0.0, 0.04)
    assert np.linalg.norm(robot.tcp_wrench()[:3]) == pytest.approx(9.82)
    command(robot, 65, TRUTH.payload_kg + 2.0, 0.0, 0.0, 0.05, *[0.01] * 6)
    assert robot.payload_kg == TRUTH.payload_kg + 2.0
    np.testing.assert_allclose(robot.tcp_wrench(), 0.0, atol=1e-12)
