"""The forward model: signs in words, derivatives, invariances."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ftcalib import PARAMETER_NAMES, Parameters
from ftcalib.model import Array, angle_between, gravity_wrench, jacobian, predict, rotation_of

SENSOR_Z_DOWN = Rotation.from_euler("x", 180, degrees=True).as_matrix()


def random_parameters(rng: np.random.Generator) -> Parameters:
    return Parameters(Rotation.random(rng=rng).as_matrix(), *rng.normal(size=(4, 3)))


def one_kilogram(R_flange_sensor: Array, p_sensor_com_m: Array) -> Parameters:
    return Parameters(R_flange_sensor, np.array([0, 0, -9.80665]), np.zeros(3), p_sensor_com_m, np.zeros(3))


def test_a_kilogram_hanging_from_a_sensor_that_looks_down_pulls_along_plus_z() -> None:
    wrench = predict(one_kilogram(np.eye(3), np.array([0, 0, 0.05])), SENSOR_Z_DOWN)
    np.testing.assert_allclose(wrench, [0, 0, 9.80665, 0, 0, 0], atol=1e-14)


def test_a_kilogram_on_a_sensor_that_looks_up_presses_along_minus_z() -> None:
    wrench = predict(one_kilogram(np.eye(3), np.zeros(3)), np.eye(3))
    np.testing.assert_allclose(wrench, [0, 0, -9.80665, 0, 0, 0], atol=1e-15)


def test_a_kilogram_out_on_x_of_a_level_sensor_turns_it_about_plus_y() -> None:
    # Gravity along -z at +x: the torque x cross -z is +y.
    wrench = predict(one_kilogram(np.eye(3), np.array([0.1, 0, 0])), np.eye(3))
    np.testing.assert_allclose(wrench[3:], [0, 0.980665, 0], atol=1e-15)


def test_the_sensor_rotation_maps_sensor_to_flange() -> None:
    # Sensor x lies along flange y; the flange is level and looks up. Gravity in base along +y is felt along sensor x.
    R_flange_sensor = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    np.testing.assert_allclose(R_flange_sensor @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    parameters = Parameters(R_flange_sensor, np.array([0, 2, 0]), np.zeros(3), np.zeros(3), np.zeros(3))
    np.testing.assert_allclose(gravity_wrench(parameters, np.eye(3))[:3], [2, 0, 0], atol=1e-15)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_jacobian_is_the_derivative(seed: int) -> None:
    rng = np.random.default_rng(seed)
    parameters, R_base_flange = random_parameters(rng), Rotation.random(3, rng=rng).as_matrix()
    h = 1e-6
    numeric = np.stack(
        [
            (predict(parameters.moved(step), R_base_flange) - predict(parameters.moved(-step), R_base_flange)) / (2 * h)
            for step in h * np.eye(15)
        ],
        axis=-1,
    )
    np.testing.assert_allclose(jacobian(parameters, R_base_flange), numeric, atol=1e-8)
    assert len(PARAMETER_NAMES) == 15
    np.testing.assert_allclose(
        jacobian(parameters, R_base_flange[0]), jacobian(parameters, R_base_flange)[0], atol=1e-14
    )


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_difference_undoes_moved(seed: int) -> None:
    rng = np.random.default_rng(seed)
    parameters, step = random_parameters(rng), rng.normal(size=15)
    step[:3] *= min(1.0, 3.0 / float(np.linalg.norm(step[:3])))  # half a turn and more has a shorter way round
    np.testing.assert_allclose(parameters.difference(parameters.moved(step)), step, atol=1e-13)


def test_parameters_are_frozen_copies_of_the_right_shape() -> None:
    parameters = random_parameters(np.random.default_rng(0))
    with pytest.raises(ValueError, match="read-only"):
        parameters.force_bias_N[0] = 1
    with pytest.raises(ValueError, match=r"force_bias_N .*\(2,\).*\(3,\)"):
        Parameters(np.eye(3), np.zeros(3), np.zeros(2), np.zeros(3), np.zeros(3))


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3), st.sampled_from([1.0, 1e-3, 1e-5, 1e-9, 0.0]))
def test_quick_rotations_and_angles_are_scipys(vector: list[float], size: float) -> None:
    turn = size * np.array(vector)
    ours, theirs = rotation_of(turn), Rotation.from_rotvec(turn).as_matrix()
    np.testing.assert_allclose(ours, theirs, atol=1e-15)
    R = Rotation.random(rng=1).as_matrix()
    expected = Rotation.from_rotvec(turn).magnitude()
    np.testing.assert_allclose(angle_between(R, ours @ R), expected, rtol=1e-6, atol=1e-15)
