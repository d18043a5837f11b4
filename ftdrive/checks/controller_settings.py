"""Where the controller was told otherwise than was measured: the payload, and how the base is mounted."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from calib import CalibrationResult
from ftdrive.planning.geometry.scene import down_of

Array = NDArray[np.float64]

PAYLOAD_KG, PAYLOAD_SHARE = 0.5, 0.3
"""A payload may be off by the larger: kg, or this share of what is expected."""
SENSOR_KG: Final = 0.3
"""A payload may be larger by this where nobody tells what sensor and adapter weigh."""
LEAN_DEG: Final = 0.2
"""An arm turns its flange hardly more exactly."""
_SIGNIFICANT: Final = 4.0
_OTHER_MOUNTING_DEG: Final = 10.0
"""Whoever bolts down a base is not off by more."""
_ALIGNED: Final = np.sin(np.radians(22.5))


def mismatches(result: CalibrationResult) -> tuple[str, ...]:
    """Say what the controller should be told otherwise, as far as the `setup` in the result's provenance tells.

    That has `payload_kg` as the controller told it, `sensor_mass_kg` and `mounting` as configured; null where unknown.
    Nothing is said of a rejected result.
    """
    setup: Any = result.provenance.get("setup")
    if setup is None or result.verdict == "rejected":
        return ()
    words = []
    if setup["payload_kg"] is not None:
        words.append(payload_in_words(setup["payload_kg"], result.mass_kg, setup["sensor_mass_kg"]))
    if setup["mounting"] is not None:
        words.append(lean_in_words(result.gravity_force_base_N, result.covariance[3:6, 3:6], setup["mounting"]))
    return tuple(one for one in words if one)


def payload_in_words(told_kg: float, weighed_kg: float, sensor_kg: float | None) -> str:
    """Say that the controller's payload is not what hangs on the flange; empty where they agree.

    Parameters
    ----------
    told_kg : float
        What the controller was told.
    weighed_kg : float
        What the sensor carries; it cannot weigh itself.
    sensor_kg : float, optional
        Mass of sensor and adapter. Where it is not known the payload may be larger by `SENSOR_KG`.
    """
    least_kg = weighed_kg + (sensor_kg or 0.0)
    most_kg = least_kg + (SENSOR_KG if sensor_kg is None else 0.0)
    limit_kg = max(PAYLOAD_KG, PAYLOAD_SHARE * least_kg)
    if least_kg - limit_kg <= told_kg <= most_kg + limit_kg:
        return ""
    told = f"the controller was told a payload of {told_kg:.2f} kg"
    if sensor_kg is None:
        return (
            f"{told}, but {weighed_kg:.2f} kg hang on the sensor, whose own mass is not in [sensor] mass_kg (up to "
            f"{SENSOR_KG:g} kg are allowed for it): set the payload in PolyScope: {weighed_kg:.2f} kg, and what sensor "
            "and adapter weigh"
        )
    return (
        f"{told}, but {weighed_kg:.2f} kg hang on the sensor, with sensor and adapter {least_kg:.2f} kg: set the "
        f"payload in PolyScope: {least_kg:.2f} kg"
    )


def lean_in_words(gravity_force_base_N: Array, covariance: Array, mounting: str) -> str:
    """Say which side of the base is low; empty where it leans no more than matters or can be told.

    The side is that axis of the base, or that pair, along which gravity has more than the mounting gives it: on a
    floor and under a ceiling x and y, on a wall y and z.

    Parameters
    ----------
    gravity_force_base_N : array, shape (3,)
        As measured.
    covariance : array, shape (3, 3)
        Of it.
    mounting : str
        As in [workcell]: assumed to be set in the controller too.
    """
    down = down_of(mounting)
    along_N = float(gravity_force_base_N @ down)
    aside_N = gravity_force_base_N - along_N * down
    size_N = float(np.linalg.norm(aside_N))
    lean_deg = float(np.degrees(np.arctan2(size_N, along_N)))
    assumed = f"[workcell] mounting, {_named(mounting)}"
    if lean_deg > _OTHER_MOUNTING_DEG:
        return (
            f"gravity is {lean_deg:.0f}° off what the base has by {assumed}: correct that, here and in PolyScope; near "
            "180° it may be the sensor's sign instead"
        )
    low = aside_N / max(size_N, 1e-12)
    sigma_deg = float(np.degrees(np.sqrt(low @ covariance @ low) / along_N))
    if lean_deg < max(LEAN_DEG, _SIGNIFICANT * sigma_deg):
        return ""
    side = " and ".join(axes_along(low))
    return (
        f"the base leans {lean_deg:.2f}° ± {sigma_deg:.2f}° towards its {side}, that side is too low; counted "
        f"from {assumed}, and PolyScope is taken to be set so too: level the base, or set its mounting in PolyScope"
    )


def _named(mounting: str) -> str:
    return mounting if mounting.isalpha() else f"{float(mounting):g}°"


def axes_along(direction: Array) -> list[str]:
    """Name the axes that a unit vector (3,) is along, or between, such as "-x"."""
    return [
        f"{'-' if part < 0 else '+'}{axis}"
        for axis, part in zip("xyz", direction.tolist(), strict=True)
        if abs(part) > _ALIGNED
    ]
