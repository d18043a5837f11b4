"""The estimates of a calibration as people read them: labels, units of the screen, elements of vectors."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import scipy

from ftcalib.model import Array

QUANTITIES: Final[Sequence[tuple[str, float, str, str]]] = (
    ("mass", 1.0, "kg", "mass_kg"),
    ("centre of mass", 1e3, "mm", "p_sensor_com_m"),
    ("force bias", 1.0, "N", "force_bias_N"),
    ("torque bias", 1.0, "N·m", "torque_bias_Nm"),
    ("flange to sensor", 180 / np.pi, "deg", "R_flange_sensor"),
    ("gravity in base", 1.0, "N", "gravity_force_base_N"),
    ("base tilt alpha", 180 / np.pi, "deg", "tilt_alpha_rad"),
    ("base tilt beta", 180 / np.pi, "deg", "tilt_beta_rad"),
)
"""Label, factor from the unit of the file to that of the screen, unit on the screen, key in the file."""
_IN_MOTION: Final[Sequence[tuple[str, float, str, str]]] = (
    ("inertia", 1e3, "g·m²", "inertia_kg_m2"),
    ("wrench after pose", 1e3, "ms", "delay_s"),
    ("sensor above flange", 1e3, "mm", "height_m"),
)
FIXED_BELOW: Final = 1e-9
"""A standard deviation below this share of the largest one is one of rounding: its value was taken as known."""


def quantities_of(document: Mapping[str, Any]) -> Sequence[tuple[str, float, str, str]]:
    """Return the quantities of the content of a calibration file as `QUANTITIES`, those of a motion included."""
    return [*QUANTITIES, *_IN_MOTION] if "inertia_kg_m2" in document else QUANTITIES


def axes_of(count: int) -> Sequence[str]:
    """Return the names of the elements of a number, a vector, or a symmetric tensor."""
    return {1: ("",), 3: tuple("xyz"), 6: ("xx", "yy", "zz", "xy", "xz", "yz")}[count]


def values_of(value: Any, key: str) -> Array:
    """Return a quantity or its sigma as numbers; a mounting as its rotation vector, rad."""
    values = np.asarray(value, dtype=np.float64)
    # shown as a rotation vector
    if key == "R_flange_sensor" and values.ndim == 2:
        values = scipy.spatial.transform.Rotation.from_matrix(values).as_rotvec()
    if key == "inertia_kg_m2":
        values = values[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return np.atleast_1d(values)
