"""Errors of a calibration: over orientations, at the tip of the tool, and relative to known true values."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib.model import Array
from ftcalib.result import CalibrationResult
from ftcalib.shown import values_of

# Assumed distance of the tool tip from the flange if no tool is described.
_USUAL_TIP_MM: Final = 200.0
CONTACT_N: Final = 100.0
"""Contact force for which a sigma is reported, N."""
# Orientations over which the error of a calibration is averaged if the true values are known.
_RANDOM = Rotation.random(1000, rng=0).as_matrix()
# Step of the grid of elevation and azimuth.
_STEP_DEG = 10
# Number of rotations of the tool about its axis for each direction of the axis.
_TURNS = 12


def error_map(result: CalibrationResult) -> dict[str, Any]:
    """Return the sigma of the compensated wrench of a free tool as a function of the direction of the tool axis.

    `elevation_deg` (n,) and `azimuth_deg` (m,) give the direction of flange z in base axes. `force_N` and `torque_Nm`
    contain `map` (n, m), the largest error over rotations about the tool axis, `largest`, `rms` over all orientations,
    and `worst_direction` (3,), the direction of flange z in base with the largest error.
    """
    elevation = np.radians(np.arange(-90, 91, _STEP_DEG))
    azimuth = np.radians(np.arange(-180, 181, _STEP_DEG))
    R = orientations(elevation, azimuth)
    variance = np.diagonal(result.wrench_covariance(R), axis1=-2, axis2=-1)
    document: dict[str, Any] = {
        "elevation_deg": np.degrees(elevation).round().tolist(),
        "azimuth_deg": np.degrees(azimuth).round().tolist(),
    }
    for k, name in enumerate(("force_N", "torque_Nm")):
        error = np.sqrt(variance[..., 3 * k : 3 * k + 3].sum(axis=-1))
        worst = np.unravel_index(int(np.argmax(error)), error.shape)
        document[name] = {
            "map": error.max(axis=-1).tolist(),
            "largest": float(error.max()),
            "rms": result.predicted_error()[k],
            "worst_direction": R[worst][:, 2].tolist(),
        }
    return document


def orientations(elevation_rad: Array, azimuth_rad: Array) -> Array:
    """Return R_base_flange (n, m, 12, 3, 3) with flange z in given directions, and 12 rotations about flange z.

    Elevation (n,) is measured from the base xy-plane, azimuth (m,) about base z from base x.
    """
    tip, turn = np.meshgrid(np.pi / 2 - elevation_rad, azimuth_rad, indexing="ij")
    point = Rotation.from_euler("ZY", np.stack([turn, tip], axis=-1).reshape(-1, 2)).as_matrix()
    spin = Rotation.from_rotvec(np.outer(np.linspace(0, 2 * np.pi, _TURNS, endpoint=False), [0, 0, 1])).as_matrix()
    return np.asarray(point[:, None] @ spin).reshape(*tip.shape, _TURNS, 3, 3)


def tip_of(result: CalibrationResult) -> Array:
    """Return the position (3,) of the tool tip relative to the sensor origin, in sensor axes, m.

    It is the far end of the described cylinders, by default 200 mm from the flange.
    """
    setup = result.provenance.get("setup")
    described: Mapping[str, Any] = setup if isinstance(setup, dict) else {}
    rows = described.get("cylinders_mm") or [[0.0, _USUAL_TIP_MM, 0.0]]
    far = max(rows, key=lambda row: row[1])
    # Each row of the cylinders holds start, end, diameter, and optionally x and y of the axis.
    x, y = far[3:] if len(far) > 3 else (0.0, 0.0)
    tip_mm = np.array([x, y, far[1] - (described.get("height_mm") or 0.0)])
    return np.asarray(result.R_flange_sensor.T @ tip_mm / 1e3)


def force_sigma_at_tip(result: CalibrationResult, force_N: Array | float = CONTACT_N) -> Array:
    """Return the rms error of a contact force at the tip over all directions, N, as the norm of the error."""
    share, _ = result.contact.sigma_at(tip_of(result))
    return np.asarray(np.hypot(result.likely_error()[0], share * np.asarray(force_N)))


def errors_in_sigma(result: CalibrationResult, truth: Mapping[str, Any]) -> dict[str, Array]:
    """Return the errors of the estimates, each divided by its standard deviation.

    The error of the mounting is the rotation vector from true to estimated mounting, in flange axes, at most 180°.
    """
    errors = {}
    for _, _, _, key, values, sigma, _ in result.estimates:
        if key not in truth:
            continue
        if key == "R_flange_sensor":
            error = Rotation.from_matrix(result.R_flange_sensor @ np.transpose(truth[key])).as_rotvec()
        else:
            error = values - values_of(truth[key], key)
            if key.endswith("_rad"):
                # a base on the ceiling has a tilt of +180 or -180 degrees
                error = np.remainder(error + np.pi, 2 * np.pi) - np.pi
        errors[key] = error / sigma
    return errors


def _free_tool_wrench(truth: Mapping[str, Any], R_base_flange: Array) -> Array:
    """Return the readings (n, 6) of a free tool from the true values, computed without the solver's model."""
    weight = np.einsum(
        "ji,nkj,k->ni", np.asarray(truth["R_flange_sensor"]), R_base_flange, np.asarray(truth["gravity_force_base_N"])
    )
    load = np.hstack([weight, np.cross(truth["p_sensor_com_m"], weight)])
    # Emulated cells of version 0.1.0 and earlier have a perfect sensor.
    load = load + load @ np.array(truth.get("sensor_error", np.zeros((6, 6)))).T
    return np.asarray(load + np.hstack([truth["force_bias_N"], truth["torque_bias_Nm"]]))


def compensation_error(result: CalibrationResult, truth: Mapping[str, Any]) -> dict[str, float]:
    """Return the rms wrench of a free tool after compensation, over random orientations."""
    left = result.compensate(_free_tool_wrench(truth, _RANDOM), _RANDOM)
    return {"force_rms_N": _rms_length(left[:, :3]), "torque_rms_Nm": _rms_length(left[:, 3:])}


def uncompensated(truth: Mapping[str, Any]) -> tuple[float, float]:
    """Return the rms wrench of a free tool before compensation, N and N·m, over random orientations."""
    raw = _free_tool_wrench(truth, _RANDOM)
    return _rms_length(raw[:, :3]), _rms_length(raw[:, 3:])


def _rms_length(vectors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))
