"""A sensor that is not perfect: what it reads of loads computed by hand, and what a seed draws."""

import numpy as np

from ftmocks.disturbances import Push
from ftmocks.sensor_errors import SensorErrors
from ftmocks.world import World
from tests.unit.mocks.test_world import DH, plain, reach


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
