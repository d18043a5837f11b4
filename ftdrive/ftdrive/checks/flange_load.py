"""Mass and centre of mass of everything below the flange, which a controller calls the payload.

The sensor cannot weigh itself, so sensor and adapter are added from the configuration. Gravity does not reveal where
the sensor's origin is, so its height is configuration too.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.model import Array, skew

# Rated payloads by Universal Robots' data sheets. Later arms of one model may carry more: see the label of the arm.
# The curve of payload against the offset of its centre is published only as a picture, in the user manual.
RATED_KG: Final = (
    {"UR3": 3.0, "UR5": 5.0, "UR10": 10.0}
    | {"UR3e": 3.0, "UR5e": 5.0, "UR7e": 7.5, "UR10e": 10.0, "UR12e": 12.5, "UR16e": 16.0}
    | {"UR8long": 8.0, "UR15": 15.0, "UR18": 18.0, "UR20": 20.0, "UR30": 30.0}
)


@dataclass(frozen=True, slots=True, eq=False)
class FlangeLoad:
    """Everything below the flange."""

    mass_kg: float
    p_flange_com_m: Array
    """(3,) centre of mass."""
    sigma_kg: float
    sigma_m: Array
    """(3,) of the centre."""


def flange_load(
    result: CalibrationResult, sensor_kg: float, height_m: float, p_flange_sensor_com_m: Array | None = None
) -> FlangeLoad:
    """Add sensor and adapter to the load that a calibration has weighed.

    The sum is ``m = m_tool + m_sensor``, its centre ``(m_tool c_tool + m_sensor c_sensor) / m`` with
    ``c_tool = p_flange_sensor + R_flange_sensor p_sensor_com``.

    Parameters
    ----------
    result : CalibrationResult
    sensor_kg : float
        Mass of sensor and adapter.
    height_m : float
        Of the sensor's origin above the flange face.
    p_flange_sensor_com_m : array, shape (3,), optional
        Known centre of mass of sensor and adapter. Default: half way up, on the axis of the flange; its height then
        counts as known within the whole height, evenly distributed.
    """
    arm_m = result.R_flange_sensor @ result.p_sensor_com_m
    c_tool_m = np.array([0.0, 0.0, height_m]) + arm_m
    c_sensor_m = np.array([0.0, 0.0, height_m / 2]) if p_flange_sensor_com_m is None else p_flange_sensor_com_m
    mass_kg = result.mass_kg + sensor_kg
    share = result.mass_kg / mass_kg
    com_m = share * c_tool_m + (1 - share) * c_sensor_m

    # Derivatives of (m, com) by the mass of the tool, then by the error coordinates of `Parameters.moved`.
    by_mass = np.concatenate([[1.0], (c_tool_m - com_m) / mass_kg])
    jacobian = np.zeros((4, 15))
    jacobian[:, 3:6] = np.outer(by_mass, result.gravity_force_base_N / (result.weight_N * result.g_m_s2))
    jacobian[1:, 0:3] = share * skew(arm_m)
    jacobian[1:, 9:12] = share * result.R_flange_sensor
    covariance = jacobian @ result.tool_covariance @ jacobian.T
    gain_variance = float(np.square(result.sigma["mass_kg"])) - covariance[0, 0]  # see `sigma`
    covariance += max(gain_variance, 0.0) * np.outer(by_mass, by_mass)
    if p_flange_sensor_com_m is None:
        covariance[3, 3] += ((1 - share) * height_m) ** 2 / 12
    sigma = np.sqrt(np.diag(covariance))
    return FlangeLoad(mass_kg, com_m, float(sigma[0]), sigma[1:])


def margin_in_words(mass_kg: float, model: str) -> str:
    """Compare a load with the rated payload of an arm."""
    rated_kg = RATED_KG.get(model)
    if rated_kg is None:
        return f"{mass_kg:.2f} kg, and the rated payload of a {model} is unknown: compare with its data sheet"
    curve = "compare with the payload curve in its user manual, too"
    if mass_kg > rated_kg:
        over_kg = mass_kg - rated_kg
        return (
            f"{over_kg:.2f} kg over the rated payload of a {model}, {rated_kg:g} kg: see the label of the arm; {curve}"
        )
    return f"{rated_kg - mass_kg:.2f} kg below the rated payload of a {model}, {rated_kg:g} kg; {curve}"
