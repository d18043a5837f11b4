"""Predicted compensation error for every direction in which the tool can point."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult
from ftcalib.model import Array
from ftcalib.sphere import axes_along

STEP_DEG = 10
"""Grid of elevation and azimuth."""
TURNS = 12
"""Turns of the tool about its axis at each direction, over a whole turn."""


def error_map(result: CalibrationResult) -> dict[str, Any]:
    """Return the error of the compensation of a free tool over the directions of the tool axis, one standard deviation.

    Returns
    -------
    dict
        `elevation_deg` (n,) and `azimuth_deg` (m,) of flange z in base axes; `force_N` and `torque_Nm`, each a dict of
        `map` (n, m): largest error over the turns of the tool about its axis, `largest`, `rms` over all orientations,
        `worst_direction` (3,) of flange z in base, and that direction as `axes` and in `words`.
    """
    elevation = np.radians(np.arange(-90, 91, STEP_DEG))
    azimuth = np.radians(np.arange(-180, 181, STEP_DEG))
    R = orientations(elevation, azimuth)
    variance = np.diagonal(result.wrench_covariance(R), axis1=-2, axis2=-1)
    document: dict[str, Any] = {
        "elevation_deg": np.degrees(elevation).round().tolist(),
        "azimuth_deg": np.degrees(azimuth).round().tolist(),
    }
    for k, name in enumerate(("force_N", "torque_Nm")):
        error = np.sqrt(variance[..., 3 * k : 3 * k + 3].sum(axis=-1))
        worst = np.unravel_index(int(np.argmax(error)), error.shape)
        direction = R[worst][:, 2]
        document[name] = {
            "map": error.max(axis=-1).tolist(),
            "largest": float(error.max()),
            "rms": result.predicted_error()[k],
            "worst_direction": direction.tolist(),
            "axes": along_axes(direction),
            "words": direction_in_words(direction, "base"),
        }
    return document


def orientations(elevation_rad: Array, azimuth_rad: Array) -> Array:
    """Return R_base_flange (n, m, TURNS, 3, 3): flange z in these directions, turned about itself.

    Parameters
    ----------
    elevation_rad : array, shape (n,)
        From the base xy-plane.
    azimuth_rad : array, shape (m,)
        About base z, from base x.
    """
    tip, turn = np.meshgrid(np.pi / 2 - elevation_rad, azimuth_rad, indexing="ij")
    point = Rotation.from_euler("ZY", np.stack([turn, tip], axis=-1).reshape(-1, 2)).as_matrix()
    spin = Rotation.from_rotvec(np.outer(np.linspace(0, 2 * np.pi, TURNS, endpoint=False), [0, 0, 1])).as_matrix()
    return np.asarray(point[:, None] @ spin).reshape(*tip.shape, TURNS, 3, 3)


def along_axes(direction: Array) -> str:
    """Name the axis along which a unit vector (3,) points, or the two or three between which it does."""
    names = axes_along(direction)
    return f"along {names[0]}" if len(names) == 1 else f"between {' and '.join(names)}"


def direction_in_words(direction: Array, frame: str) -> str:
    """Name the direction of a unit vector (3,) in a frame."""
    return f"{along_axes(direction)} of the {frame}"
