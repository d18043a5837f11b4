"""Check of a sensor with one known weight on a string, in one or several poses."""

from math import isfinite
from typing import NamedTuple

import numpy as np

from ftcalib.compensation import Compensator
from ftcalib.files import JSON
from ftcalib.loads.model import KnownLoad
from ftcalib.model import Array, cross
from ftcalib.result import CalibrationResult
from ftcalib.sensor_matrix import Calibrated

# Errors up to this many sigmas are within the promised accuracy of the sensor.
_WITHIN = 2.0


class LoadCheck(NamedTuple):
    """Result of the check of a sensor with a known weight on a string."""

    read_N: float
    """Measured force along gravity, mean over the poses, N."""
    expected_N: float
    scale_error: float
    """Relative error of the measured force: `read_N` / `expected_N` - 1."""
    scale_sigma: float
    """Standard deviation of `scale_error` from noise, drift and calibration, without errors of the sensor."""
    promised_sigma: float
    """Relative standard deviation of the sensor at this load, according to its declared or known accuracy."""
    off_vertical_rad: float
    """Angle between force and gravity, mean over the poses, rad."""
    off_m: float
    """Distance of the measured line of action from the declared position of the load, m; NaN if none is declared."""
    off_sigma_m: float

    @property
    def is_within(self) -> bool:
        """Whether the error is within the promised accuracy of the sensor."""
        return abs(self.scale_error) <= _WITHIN * float(np.hypot(self.scale_sigma, self.promised_sigma))

    @property
    def is_significant(self) -> bool:
        """Whether the error exceeds its own uncertainty significantly."""
        return abs(self.scale_error) > _WITHIN * self.scale_sigma

    def to_dict(self) -> dict[str, JSON]:
        """Return the check as a JSON object; unknown numbers are None."""
        values: dict[str, JSON] = {key: value if isfinite(value) else None for key, value in self._asdict().items()}
        return values | {"is_within": self.is_within}


def check_hung_load(
    calibration: CalibrationResult,
    reference: Calibrated,
    load: KnownLoad,
    poses: tuple[Array, Array, Array],
    *,
    drift: Array,
    p_flange_sensor_m: Array,
) -> LoadCheck:
    """Return the comparison of readings with a known load that hangs on the tool.

    Parameters
    ----------
    calibration : CalibrationResult
        Calibration of the tool.
    reference : CalibrationResult or Update
        The calibration, or its tare.
    poses : array, shape (n, 3, 3), array, shape (n, 6), and array, shape (n, 6, 6)
        R_base_flange, mean readings as measured, and their covariances.
    drift : array, shape (6,)
        One standard deviation of the change of the bias since the reference.
    p_flange_sensor_m : array, shape (3,)
        Sensor origin from the centre of the flange face.
    """
    R_base_flange, wrench, noise = poses
    tool, contact = reference.parameters, calibration.contact
    free = Compensator(tool, response=reference.response).batch(wrench, R_base_flange)
    left = contact.decode(np.asarray(free, dtype=np.float64))
    force, torque = left[:, :3], left[:, 3:]
    down = tool.down @ (R_base_flange @ tool.R_flange_sensor)
    expected_N = load.mass_kg * calibration.g_m_s2
    read_N = float(np.mean(np.sum(force * down, axis=1)))
    # Errors of calibration and bias are common to all poses.
    common = reference.wrench_covariance(R_base_flange) + np.diag(drift**2)

    def along(C: Array) -> float:
        return float(np.mean(np.einsum("ni,nij,nj->n", down, C[:, :3, :3], down)))

    sigma_N = np.sqrt(along(common) + along(noise) / len(wrench))
    place = np.zeros(3)
    if load.p_flange_m is not None:
        place = tool.R_flange_sensor.T @ (np.asarray(load.p_flange_m) - p_flange_sensor_m)
    of_load = expected_N * np.concatenate([down, cross(place, down)], axis=1)
    own = contact.covariance(of_load)
    across = float(np.mean(np.linalg.norm(np.cross(down, force), axis=1)))
    off, off_sigma = float("nan"), float("nan")
    if load.p_flange_m is not None:
        lever = (torque - cross(place, force)).mean(axis=0) / expected_N
        spread = np.trace((own + common)[:, 3:, 3:], axis1=1, axis2=2).mean() / expected_N**2
        off, off_sigma = float(np.linalg.norm(lever)), float(np.sqrt(spread + 2 * load.place_sigma_m**2))
    return LoadCheck(
        read_N,
        expected_N,
        read_N / expected_N - 1,
        float(np.hypot(sigma_N / expected_N, load.mass_sigma_kg / load.mass_kg)),
        np.sqrt(along(own)) / expected_N,
        float(np.arctan2(across, read_N)),
        off,
        off_sigma,
    )
