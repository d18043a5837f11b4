"""Everything below the flange: hand-computed sums, and the sigma against numerical derivatives."""

import numpy as np
import pytest
from numpy.typing import NDArray

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


def test_the_margin_names_rated_payload_and_model() -> None:
    assert margin_in_words(1.442, "UR5e").startswith("3.56 kg below the rated payload of a UR5e, 5 kg;")
    assert margin_in_words(3.5, "UR3").startswith("0.50 kg above the rated payload of a UR3, 3 kg:")
    assert "Acme" in margin_in_words(1.0, "Acme")


def test_every_model_that_can_be_driven_has_a_rated_payload() -> None:
    from ftdrivers.ur.kinematics import MODELS

    assert set(RATED_KG) == set(MODELS)
