"""Everything below the flange: hand-computed sums, and the sigma against numerical derivatives."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult, Parameters, SensorMatrix
from ftdrive.checks.arm import RATED_KG, flange_load, margin_in_words

Array = NDArray[np.float64]
QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Sensor x points along flange y."""
G_M_S2 = 9.8


def calibrated(
    mass_kg: float = 1.0,
    R_flange_sensor: Array = QUARTER_TURN,
    p_sensor_com_m: tuple[float, float, float] = (0.02, 0.0, 0.05),
    covariance: Array | None = None,
    gain_sigma: float = 0.0,
    up_base: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> CalibrationResult:
    weight = -mass_kg * G_M_S2 * np.array(up_base)
    parameters = Parameters(R_flange_sensor, weight, np.zeros(3), np.array(p_sensor_com_m), np.zeros(3))
    covariance = np.zeros((15, 15)) if covariance is None else covariance
    sensor = SensorMatrix.usual(gain_sigma)
    return CalibrationResult(
        parameters, covariance, np.zeros((6, 6)), 1.0, 21, "measured", G_M_S2, "ml", (), sensor=sensor
    )


def test_sensor_and_tool_add_up() -> None:
    # 1 kg at (0.02, 0, 0.05) in a sensor turned by 90° and 40 mm up: flange (0, 0.02, 0.09).
    # 0.25 kg half way up: (0, 0, 0.02). Together 1.25 kg at (0, 0.02 / 1.25, (0.09 + 0.25 × 0.02) / 1.25).
    load = flange_load(calibrated(), 0.25, 0.04)
    assert load.mass_kg == pytest.approx(1.25)
    assert load.p_flange_com_m == pytest.approx([0.0, 0.016, 0.076])


def test_sigma_agrees_with_numerical_derivatives() -> None:
    rng = np.random.default_rng(4)
    root = rng.normal(size=(15, 15)) * 1e-3
    covariance = root @ root.T
    R = Rotation.from_rotvec([0.3, -0.5, 1.1]).as_matrix()
    result = calibrated(1.3, R, (0.02, -0.03, 0.05), covariance, up_base=(0.6, 0.0, 0.8))

    def summed(parameters: Parameters) -> Array:
        moved = CalibrationResult(parameters, covariance, np.zeros((6, 6)), 1.0, 21, "measured", G_M_S2, "ml", ())
        load = flange_load(moved, 0.3, 0.04)
        return np.array([load.mass_kg, *load.p_flange_com_m])

    step = 1e-6
    jacobian = np.array(
        [
            (summed(result.parameters.moved(one)) - summed(result.parameters.moved(-one))) / (2 * step)
            for one in step * np.eye(15)
        ]
    ).T
    expected = np.diag(jacobian @ covariance @ jacobian.T).copy()
    common_gain = np.zeros(15)
    common_gain[3:6] = 0.002 * result.gravity_force_base_N
    expected += (jacobian @ common_gain) ** 2
    expected[3] += (0.3 / 1.6 * 0.04) ** 2 / 12
    load = flange_load(result, 0.3, 0.04)
    assert [load.sigma_kg, *load.sigma_m] == pytest.approx(np.sqrt(expected), rel=1e-6)


def test_the_margin_names_rated_payload_and_model() -> None:
    assert margin_in_words(1.442, "UR5e").startswith("3.56 kg below the rated payload of a UR5e, 5 kg;")
    assert margin_in_words(3.5, "UR3").startswith("0.50 kg above the rated payload of a UR3, 3 kg:")
    assert "Acme" in margin_in_words(1.0, "Acme")


def test_every_model_that_can_be_driven_has_a_rated_payload() -> None:
    from ftdrivers.ur.kinematics import MODELS

    assert set(RATED_KG) == set(MODELS)
