"""Whether a sensor reads a known weight right: one weight on a string, weighed in one pose or several."""

from typing import NamedTuple

import numpy as np

from ftcalib.after.weighing import Weight
from ftcalib.loads.model import KnownLoad
from ftcalib.model import Array
from ftcalib.result import CalibrationResult

# So many sigmas of what the sensor promises are within it.
_WITHIN = 2.0


class LoadCheck(NamedTuple):
    """What a known weight shows."""

    scale_error: float
    """Weight as read over the weight as known, less 1."""
    scale_sigma: float
    """One standard deviation of that, without the sensor's own errors."""
    promised_sigma: float
    """What the sensor may be off at this load, one standard deviation."""
    off_m: float
    """Distance of the line of action from the place of the load; NaN where no place is given."""
    off_sigma_m: float

    @property
    def is_within(self) -> bool:
        """Whether the error is within what the sensor promises."""
        return abs(self.scale_error) <= _WITHIN * float(np.hypot(self.scale_sigma, self.promised_sigma))

    @property
    def is_significant(self) -> bool:
        """Whether the check shows an error at all."""
        return abs(self.scale_error) > _WITHIN * self.scale_sigma


def check_load(
    calibration: CalibrationResult, weight: Weight, load: KnownLoad, u_sensor: Array, p_flange_sensor_m: Array
) -> LoadCheck:
    """Compare a weighing with the load that hangs there.

    Parameters
    ----------
    calibration : CalibrationResult
        Of the tool.
    weight : Weight
        As `ftcalib.after.weighing.weigh` gives it.
    load : KnownLoad
    u_sensor : array, shape (3,)
        Down in the sensor frame, in the last pose.
    p_flange_sensor_m : array, shape (3,)
        Sensor origin from the flange.
    """
    down = u_sensor / np.linalg.norm(u_sensor)
    R = calibration.R_flange_sensor
    place = (
        weight.p_sensor_com_m if load.p_flange_m is None else R.T @ (np.asarray(load.p_flange_m) - p_flange_sensor_m)
    )
    force = down * load.mass_kg * calibration.g_m_s2
    covariance = calibration.contact.covariance(np.concatenate([force, np.cross(place, force)]))
    promised = float(np.sqrt(down @ covariance[:3, :3] @ down)) / float(np.linalg.norm(force))
    across = np.eye(3) - np.outer(down, down)
    off, off_sigma = float("nan"), float("nan")
    if load.p_flange_m is not None:
        off = float(np.linalg.norm(across @ (weight.p_sensor_com_m - place)))
        torque_sigma = np.sqrt(np.trace(across @ covariance[3:, 3:] @ across)) / float(np.linalg.norm(force))
        spread = np.trace(across @ weight.com_covariance @ across)
        off_sigma = float(np.sqrt(spread + torque_sigma**2 + 2 * load.place_sigma_m**2))
    ratio = weight.mass_kg / load.mass_kg
    sigma = float(np.hypot(weight.mass_sigma_kg / load.mass_kg, ratio * load.mass_sigma_kg / load.mass_kg))
    return LoadCheck(ratio - 1, sigma, promised, off, off_sigma)
