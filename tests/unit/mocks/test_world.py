"""The shared truth: sign of a wrench, frames, and a sensor that is not perfect, against loads computed by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ftmocks.disturbances import Push
from ftmocks.kinematics import MODELS, Vector6, inverse, matrix_of, vector6
from ftmocks.sensor_errors import SensorErrors
from ftmocks.world import Truth, World

DH = MODELS["UR5e"]
POSTURE = vector6(np.radians([45, -100, 60, -50, 90, 45]))


def plain(**changes: object) -> Truth:
    """One kilogram 50 mm below the sensor, sensor axes = flange axes, no bias, no noise."""
    truth = Truth(
        mass_kg=1.0,
        p_sensor_com_m=np.array([0.0, 0.0, 0.05]),
        R_flange_sensor=np.eye(3),
        tilt_alpha_rad=0.0,
        tilt_beta_rad=0.0,
        force_bias_N=np.zeros(3),
        torque_bias_Nm=np.zeros(3),
        noise_force_N=0.0,
        noise_torque_Nm=0.0,
        g_m_s2=9.81,
    )
    return replace(truth, **changes)  # type: ignore[arg-type]  # field names and values come from the tests below


def reach(rotation_vector: list[float]) -> Vector6:
    q = inverse(DH, matrix_of([-0.3, -0.4, 0.4, *rotation_vector]), POSTURE)
    assert q is not None
    return q


@pytest.mark.parametrize(
    ("rotation_vector", "wrench"),
    [
        ([math.pi, 0.0, 0.0], [0, 0, 9.81, 0, 0, 0]),  # sensor z points down
        ([0.0, 0.0, 0.0], [0, 0, -9.81, 0, 0, 0]),  # up
        ([0.0, math.pi / 2, 0.0], [9.81, 0, 0, 0, 0.05 * 9.81, 0]),  # z along base x, x down: a lever of 50 mm
    ],
)
def test_one_kilogram_pulls_down_in_sensor_axes(rotation_vector: list[float], wrench: list[float]) -> None:
    world = World(plain(), DH, reach(rotation_vector))
    np.testing.assert_allclose(world.true_wrench(), wrench, atol=1e-9)


@pytest.mark.parametrize(
    ("alpha_deg", "beta_deg", "down"),
    [(0, 0, [0, 0, -1]), (0, 90, [-1, 0, 0]), (0, 180, [0, 0, 1]), (90, 0, [0, 1, 0]), (-90, 0, [0, -1, 0])],
)
def test_tilt_turns_gravity_in_base(alpha_deg: float, beta_deg: float, down: list[float]) -> None:
    truth = plain(tilt_alpha_rad=math.radians(alpha_deg), tilt_beta_rad=math.radians(beta_deg))
    np.testing.assert_allclose(truth.gravity_force_base_N, 9.81 * np.array(down), atol=1e-12)


def test_gain_and_cross_talk_act_on_the_load_and_not_on_the_bias() -> None:
    """1 kg on the z axis that points down, 98.1 N more: 2 % of both, 0.01 N·m of each newton, and 3 N of bias."""
    error = np.zeros((6, 6))
    error[2, 2], error[4, 2] = 0.02, 0.01
    truth = plain(sensor_errors=SensorErrors(error, np.zeros((6, 2))), force_bias_N=np.array([0.0, 0.0, 3.0]))
    world = World(truth, DH, reach([np.pi, 0.0, 0.0]))
    still = [0, 0, 9.81 * 1.02 + 3.0, 0, 9.81 * 0.01, 0]
    np.testing.assert_allclose(world.measure(2), [still, still], atol=1e-9)
    world.touch("push", Push(np.array([0, 0, 98.1, 0, 0, 0]), in_sensor=True))
    np.testing.assert_allclose(world.measure(1)[0], [0, 0, 107.91 * 1.02 + 3.0, 0, 1.0791, 0], atol=1e-9)


def test_a_curved_response_is_relative_to_the_range() -> None:
    """At half of 150 N: a quarter of the square and an eighth of the cube; the square has the same sign both ways."""
    bends = np.zeros((6, 2))
    bends[0] = [0.004, -0.008]
    errors = SensorErrors(np.zeros((6, 6)), bends)
    for force_N, expected in ((75.0, 150 * (0.001 - 0.001)), (-75.0, 150 * (0.001 + 0.001)), (-150.0, 150 * 0.012)):
        np.testing.assert_allclose(errors.of(np.array([force_N, 0, 0, 0, 0, 0])), [expected, 0, 0, 0, 0, 0], atol=1e-12)
