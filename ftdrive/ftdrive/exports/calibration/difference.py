"""The largest difference between two compensations over all orientations of the flange."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult
from ftcalib.compensation import Compensator
from ftcalib.model import Array, nearest_rotation
from ftdrive.exports.calibration.formats import Format

_STEPS = 500
_CONVERGED = 1e-12
"""Relative gain of a step, at the start that gains most."""


def compensations(calibration: CalibrationResult, target: Format) -> tuple[Compensator, Compensator]:
    """Return our compensation, and that of a target that expresses all but what its `expresses` lacks.

    Without tilt, gravity points along -z of the base. Without rotation, the sensor's axes are those of the flange.
    Where the target has another sensor, or none, neither has the response of ours.
    """
    parameters = calibration.parameters
    response = None if target.has_own_reading else calibration.response
    ours = Compensator(parameters, response=response)
    if "tilt" not in target.expresses:
        parameters = replace(parameters, gravity_force_base_N=np.array([0.0, 0.0, -calibration.weight_N]))
    if "rotation" not in target.expresses:
        parameters = replace(parameters, R_flange_sensor=np.eye(3))
    return ours, Compensator(parameters, response=response if "response" in target.expresses else None)


def largest_difference(one: Compensator, other: Compensator) -> tuple[float, float]:
    """Return the largest norms of the difference of force (N) and torque (N·m) over all orientations."""
    matrix, offset = other.matrix - one.matrix, other.offset - one.offset
    return _largest_norm(matrix[:3], offset[:3]), _largest_norm(matrix[3:], offset[3:])


def _largest_norm(matrix: Array, offset: Array) -> float:
    """Maximise |matrix @ vec(R) + offset| over rotations R.

    The square is convex in R, so that the rotation which is best for its tangent never lowers it. Ascent from the 60
    rotations of the icosahedron reaches every maximum.
    """
    R = Rotation.create_group("I").as_matrix()
    norms = np.zeros(len(R))
    for _ in range(_STEPS):
        error = R.reshape(-1, 9) @ matrix.T + offset
        before, norms = norms, np.linalg.norm(error, axis=1)
        if (norms - before).max() <= _CONVERGED * norms.max():
            break
        R = nearest_rotation((error @ matrix).reshape(-1, 3, 3))
    return float(norms.max())
