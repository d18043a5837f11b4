"""Differences between settings of the controller and identified values: the payload and the mounting of the base."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.assessment.contradictions import force_units
from ftdrive.planning.geometry.scene import down_of
from ftdrivers.interfaces import Array

PAYLOAD_KG, PAYLOAD_SHARE = 0.5, 0.3
"""A payload may differ by the larger of this mass and this share of the expected one."""
SENSOR_KG: Final = 0.3
"""A payload may be larger by this where the mass of sensor and adapter is unknown."""
LEAN_DEG: Final = 0.2
"""About the accuracy of an arm's own orientation."""
_SIGNIFICANT: Final = 4.0
OTHER_MOUNTING_DEG: Final = 10.0
"""A larger angle is another mounting, not a lean."""
_ALIGNED: Final = np.sin(np.radians(22.5))


def mismatches(result: CalibrationResult) -> tuple[str, ...]:
    """Return the differences from the `setup` in the result's provenance, in words; none for a rejected result.

    The setup has `payload_kg` as the controller reports it, `sensor_mass_kg` and `mounting` as configured; null where
    unknown. Words that are reasons of the verdict already are left out.
    """
    setup: Any = result.provenance.get("setup")
    if setup is None or result.verdict == "rejected":
        return ()
    words = []
    if setup["payload_kg"] is not None:
        words.append(payload_in_words(setup["payload_kg"], result.mass_kg, setup["sensor_mass_kg"]))
    if setup["mounting"] is not None:
        words.append(lean_in_words(result.gravity_force_base_N, result.covariance[3:6, 3:6], setup["mounting"]))
    return tuple(one for one in words if one and one not in result.reasons)


def payload_in_words(payload_kg: float, weighed_kg: float, sensor_kg: float | None) -> str:
    """Return the difference between the controller's payload and the load of the flange; empty where they agree.

    Parameters
    ----------
    payload_kg : float
        As set in the controller.
    weighed_kg : float
        Load of the sensor, which cannot weigh itself.
    sensor_kg : float, optional
        Mass of sensor and adapter. Where it is unknown the payload may be larger by `SENSOR_KG`.
    """
    least_kg = weighed_kg + (sensor_kg or 0.0)
    most_kg = least_kg + (SENSOR_KG if sensor_kg is None else 0.0)
    limit_kg = max(PAYLOAD_KG, PAYLOAD_SHARE * least_kg)
    if least_kg - limit_kg <= payload_kg <= most_kg + limit_kg:
        return ""
    found = f"the controller has a payload of {payload_kg:.2f} kg, but {weighed_kg:.2f} kg hang on the sensor"
    if units := force_units(weighed_kg, payload_kg - (sensor_kg or 0.0)):
        forces = f"forces in {' or '.join(units)}"
        return f"{found}, as with {forces}: check the sensor's units before you change the payload"
    if sensor_kg is None:
        return (
            f"{found} and [sensor] mass_kg is not set (up to {SENSOR_KG:g} kg are allowed for it): set the payload in "
            f"PolyScope: {weighed_kg:.2f} kg plus the mass of sensor and adapter"
        )
    return f"{found}, {least_kg:.2f} kg with sensor and adapter: set the payload in PolyScope: {least_kg:.2f} kg"


def lean_in_words(gravity_force_base_N: Array, covariance: Array, mounting: str) -> str:
    """Return in words which side of the base is low; empty for a lean that is small or not significant.

    The side is the axis of the base, or the pair of axes, along which gravity differs from that of the mounting: x and
    y on a floor and under a ceiling, y and z on a wall.

    Parameters
    ----------
    gravity_force_base_N : array, shape (3,)
        As measured.
    covariance : array, shape (3, 3)
    mounting : str
        As in [workcell]; assumed to be set in the controller too.
    """
    lean = lean_from(down_of(mounting), gravity_force_base_N, covariance)
    name = mounting if mounting.isalpha() else f"{float(mounting):g}°"
    mounted = f"[workcell] mounting ({name})"
    if lean.is_other_mounting:
        return (
            f"gravity is {lean.deg:.0f}° off the direction of {mounted}: correct the mounting, here and in PolyScope; "
            "near 180°, check the sensor's sign first"
        )
    if not lean.is_significant:
        return ""
    return (
        f"the base {lean}, compared with {mounted} and "
        "assuming PolyScope has the same mounting: level the base, or set its mounting in PolyScope"
    )


@dataclass(frozen=True, slots=True)
class Lean:
    """How far the measured direction of gravity in the base is from an expected one."""

    deg: float
    sigma_deg: float
    side: str
    """The low side of the base, such as "+y"."""

    @property
    def is_other_mounting(self) -> bool:
        """Whether it is too large for a lean."""
        return self.deg > OTHER_MOUNTING_DEG

    @property
    def is_significant(self) -> bool:
        """Whether it is larger than its uncertainty and than the accuracy of an arm's own orientation."""
        return self.deg >= max(LEAN_DEG, _SIGNIFICANT * self.sigma_deg)

    def __str__(self) -> str:
        return f"leans {self.deg:.2f}° (sigma {self.sigma_deg:.2f}°) towards its {self.side}"


def lean_from(down: Array, gravity_force_base_N: Array, covariance: Array) -> Lean:
    """Compare measured gravity (3,), with its covariance (3, 3), with the expected direction `down` (3,), unit length.

    All in base axes.
    """
    along_N = float(gravity_force_base_N @ down)
    aside_N = gravity_force_base_N - along_N * down
    size_N = float(np.linalg.norm(aside_N))
    low = aside_N / max(size_N, 1e-12)
    deg = float(np.degrees(np.arctan2(size_N, along_N)))
    weight_N = float(np.linalg.norm(gravity_force_base_N))
    sigma_deg = float(np.degrees(np.sqrt(max(float(low @ covariance @ low), 0.0)) / weight_N))
    return Lean(deg, sigma_deg, " and ".join(axes_along(low)))


def axes_along(direction: Array) -> list[str]:
    """Return the names of the axes along or between which a unit vector (3,) points, such as "-x"."""
    return [
        f"{'-' if part < 0 else '+'}{axis}"
        for axis, part in zip("xyz", direction.tolist(), strict=True)
        if abs(part) > _ALIGNED
    ]
