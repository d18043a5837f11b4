"""A calibration with numbers that can be followed by hand."""

from dataclasses import replace
from math import cos, radians, sin

import numpy as np

from ftcalib import CalibrationResult, Finding, Parameters
from ftcalib.model import Array
from ftcalib.sensor_matrix import SIZE, Response
from ftdrive.exports.registry import Settings

G_M_S2 = 9.80665
WEIGHT_N = 2 * G_M_S2
UPRIGHT = np.array([0.0, 0.0, -WEIGHT_N])
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Sensor x along flange y."""
MEASURED = Settings(height_mm=33.0, sensor_mass_kg=0.5, sensor_com_mm=(0.0, 0.0, 15.0))


def calibration(
    *, gravity_N: Array = UPRIGHT, R_flange_sensor: Array = TURN, response: Response | None = None
) -> CalibrationResult:
    """2 kg at (10, -20, 50) mm."""
    return CalibrationResult(
        parameters=Parameters(
            R_flange_sensor,
            gravity_N,
            np.array([1.0, -2.0, 0.00001]),
            np.array([0.01, -0.02, 0.05]),
            np.array([0.1, -0.2, 0.3]),
        ),
        covariance=np.eye(15) * 1e-6,
        residuals=np.zeros((24, 6)),
        chi2=129.0,
        dof=129,
        noise_source="measured",
        g_m_s2=G_M_S2,
        method="ml",
        findings=(),
        provenance={"created_utc": "2026-11-14T08:00:00+00:00"},
        response=response,
    )


def tilted(tilt_deg: float) -> CalibrationResult:
    """Lean the base towards its -x."""
    tilt_rad = radians(tilt_deg)
    return calibration(gravity_N=WEIGHT_N * np.array([-sin(tilt_rad), 0.0, -cos(tilt_rad)]))


def responding(gain: float, cross_talk_m: float) -> CalibrationResult:
    """Gain `gain` along x and `-gain` along y, and as much torque about x for a force along x."""
    coefficients = np.zeros(SIZE)
    coefficients[0] = gain * np.sqrt(2)
    coefficients[5] = cross_talk_m / 0.05
    return calibration(response=Response(coefficients, np.zeros((15 + SIZE, 15 + SIZE))))


def rejected() -> CalibrationResult:
    return replace(calibration(), findings=(Finding.of("second_solution", probability_percent=40.0),))
