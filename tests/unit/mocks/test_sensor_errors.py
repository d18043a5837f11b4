"""A sensor that is not perfect: what it reads of loads computed by hand, and what a seed draws."""

from dataclasses import replace

import numpy as np

from ftmocks.disturbances import Push
from ftmocks.kinematics import MODELS
from ftmocks.sensor_errors import SensorErrors
from ftmocks.world import World
from tests.unit.mocks.test_world import DH, POSTURE, plain, reach


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


def test_the_seed_draws_errors_of_the_sizes_relative_to_the_ranges() -> None:
    drawn = [SensorErrors.drawn(seed, 0.02, 0.01, 0.003) for seed in range(400)]
    scaled = np.array([one.error for one in drawn]) * np.tile(np.repeat([1.0, 1 / 15], 3), 6).reshape(6, 6)
    scaled *= np.repeat([1.0, 15.0], 3)[:, None]
    expected = np.where(np.eye(6) > 0, 0.02, 0.01)
    np.testing.assert_allclose(scaled.std(axis=0), expected, rtol=0.15)
    gains = np.einsum("nii->ni", scaled)
    np.testing.assert_allclose(np.corrcoef(gains.T)[~np.eye(6, dtype=bool)], 0.5, atol=0.2)
    assert np.isclose(np.std([one.nonlinearity for one in drawn]), 0.003, rtol=0.1)
    np.testing.assert_array_equal(drawn[7].error, SensorErrors.drawn(7, 0.02, 0.01, 0.0).error)


def test_the_arm_feels_the_true_wrench() -> None:
    errors = SensorErrors(0.1 * np.eye(6), np.zeros((6, 2)))
    worlds = [World(truth, MODELS["UR5e"], POSTURE) for truth in (plain(), replace(plain(), sensor_errors=errors))]
    perfect, wrong = (world.true_wrench() for world in worlds)
    np.testing.assert_array_equal(perfect, wrong)
