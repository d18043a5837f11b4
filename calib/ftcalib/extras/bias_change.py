"""Change of the six biases since a calibration, from the readings of one verification.

The residuals are r = H b + K e + noise, with b the change, H the identity for each pose, and e the errors of the
calibration, which all its verifications share. Their mean is that of generalised least squares,

    b = G r,    G = (H' S^-1 H)^-1 H' S^-1,    S = noise + K C K',

and its covariance has two parts: G noise G' is that of this verification, G K C K' G' that of the calibration.
"""

from dataclasses import dataclass

import numpy as np

from ftcalib.extras.expected_readings import Expected
from ftcalib.files import JSON
from ftcalib.model import Array, read_only


@dataclass(frozen=True, slots=True, eq=False)
class BiasChange:
    """New bias minus that of the calibration, in the sensor frame; force first, N and N·m. Arrays are read-only."""

    value: Array
    """(6,)"""
    sigma: Array
    """(6,) one standard deviation from the readings of this verification, independent of any other."""
    calibration_sigma: Array
    """(6,) one standard deviation from the calibration: nearly the same error in all its verifications."""

    def __post_init__(self) -> None:
        for name in ("value", "sigma", "calibration_sigma"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def to_dict(self) -> dict[str, JSON]:
        """Return the content as JSON."""
        return {name: getattr(self, name).tolist() for name in ("value", "sigma", "calibration_sigma")}


def bias_change(expected: Expected, R_base_flange: Array, wrench: Array) -> BiasChange:
    """Estimate the change of the six biases, as if nothing else had changed.

    Parameters
    ----------
    expected : Expected
        What unchanged readings of these poses scatter by.
    R_base_flange : array, shape (n, 3, 3)
    wrench : array, shape (n, 6)
        Mean readings as measured, N and N·m, in the sensor frame.
    """
    residual, _, _ = expected.distance(R_base_flange, wrench)
    common = expected.common(R_base_flange)
    H = np.tile(np.eye(6), (len(wrench), 1))
    weighted = np.linalg.solve(expected.noise + common, H).T
    G = np.linalg.solve(weighted @ H, weighted)
    noise, calibration = (
        np.sqrt(expected.factor * np.diag(G @ part @ G.T).clip(0.0)) for part in (expected.noise, common)
    )
    return BiasChange(G @ residual.ravel(), noise, calibration)
