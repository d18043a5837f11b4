"""Known values that the data contradict."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ftcalib.assessment.faults import FORCE_UNITS_N, SAME_UNIT, axis_order, units
from ftcalib.known import Known, turn_between, unit_vector
from ftcalib.model import UP_IN_BASE, Array, Parameters

PAYLOAD_KG = 0.8
"""A payload that is larger than the load by no more than this may include a sensor and cables."""
PAYLOAD_SHARE = 0.3
"""A payload is set this accurately at worst."""
SAME_AXES = 0.1
"""Entries of a rotation this close to -1, 0 and 1 permute the axes."""


def contradictions(
    known: Known,
    found: Parameters,
    covariance: Array,
    g_m_s2: float,
    sigmas: float,
    up_in_base: ArrayLike = UP_IN_BASE,
) -> list[str]:
    """Name the known values that the data contradict, each with the value from the data: one reason, or none.

    Parameters
    ----------
    known : Known
    found : Parameters
        From a fit without known values.
    covariance : array, shape (15, 15)
        Of that fit.
    g_m_s2 : float
    sigmas : float
        Smallest difference to name, in standard deviations.
    up_in_base : array_like, shape (3,)
        Where up should be.
    """
    words = []
    weight_N = float(np.linalg.norm(found.gravity_force_base_N))
    along = found.gravity_force_base_N / (weight_N or 1.0)
    sigma_N = float(np.sqrt(along @ covariance[3:6, 3:6] @ along))
    shows_directions = weight_N > sigmas * sigma_N
    if known.mass_kg is not None:
        mass_kg, sigma_kg = weight_N / g_m_s2, sigma_N / g_m_s2
        if abs(mass_kg - known.mass_kg) > sigmas * np.hypot(sigma_kg, known.mass_tolerance_kg):
            why = as_with(found, _force_units(mass_kg, known.mass_kg, SAME_UNIT))
            words.append(f"mass {known.mass_kg:g} kg (data: {_with_sigma(mass_kg, sigma_kg, ' kg')}{why})")
    if known.gravity_direction_base is not None and shows_directions:
        direction = np.asarray(known.gravity_direction_base)
        turn = turn_between(direction, unit_vector(found.gravity_force_base_N))
        across = np.cross(unit_vector(turn), direction)
        sigma = float(np.sqrt(across @ covariance[3:6, 3:6] @ across / np.sum(found.gravity_force_base_N**2)))
        if np.linalg.norm(turn) > sigmas * np.hypot(sigma, known.direction_tolerance_rad):
            words.append(f"direction of gravity in base (data: {_angle(turn, sigma)})")
    if known.R_flange_sensor is not None and shows_directions:
        turn = Rotation.from_matrix(found.R_flange_sensor @ np.asarray(known.R_flange_sensor).T).as_rotvec()
        if known.yaw_only:
            z = np.array([0.0, 0.0, 1.0])
            turn = turn_between(z, Rotation.from_rotvec(turn).apply(z))
        axis = unit_vector(turn)
        sigma = float(np.sqrt(axis @ covariance[:3, :3] @ axis))
        if np.linalg.norm(turn) > sigmas * np.hypot(sigma, known.R_tolerance_rad):
            upwards = float(found.gravity_force_base_N @ np.asarray(up_in_base)) > 0  # as mirrored axes read
            Q = np.asarray(known.R_flange_sensor).T @ found.R_flange_sensor * (-1 if upwards else 1)
            why = "" if known.yaw_only else _axes_taken(Q)
            words.append(f"mounting of the sensor (data: {_angle(turn, sigma)}{why})")
    if not words:
        return []
    return [f"the known values contradict the data: {'; '.join(words)}: correct the data or the known values"]


def other_unit(found: Parameters, payload_kg: float, g_m_s2: float) -> list[str]:
    """Name the units, if any, with which the load would agree with the controller's payload.

    Parameters
    ----------
    found : Parameters
    payload_kg : float
        As set in the controller, without the sensor if its mass is known.
    g_m_s2 : float
    """
    mass_kg = float(np.linalg.norm(found.gravity_force_base_N)) / g_m_s2
    if not force_units(mass_kg, payload_kg):
        return []
    return [
        f"the load is {mass_kg:.2f} kg, but {payload_kg:.2f} kg by the payload in the controller"
        f"{as_with(found, force_units(mass_kg, payload_kg))}: check the units of the sensor, or correct the payload"
    ]


def force_units(mass_kg: float, payload_kg: float) -> list[str]:
    """Name the units of force that make a load (kg) of the data agree with a payload (kg), if they differ a lot."""
    return _force_units(mass_kg, payload_kg, PAYLOAD_SHARE) if abs(payload_kg - mass_kg) > PAYLOAD_KG else []


def _force_units(mass_kg: float, true_kg: float, tolerance: float) -> list[str]:
    off = {unit: abs(mass_kg * size / true_kg - 1) for unit, size in FORCE_UNITS_N.items() if size != 1}
    return [unit for unit, share in off.items() if share < tolerance]


def as_with(found: Parameters, forces: list[str]) -> str:
    """Name these units of force, and those of torque that give a usual centre of mass."""
    named = units(float(np.linalg.norm(found.p_sensor_com_m)), forces) or [f"forces in {unit}" for unit in forces]
    return f", as with {', or '.join(named)}" if named else ""


def _axes_taken(Q: Array) -> str:
    """Name the permutation of the axes that explains another mounting, if it is one."""
    order = np.round(Q)
    if np.abs(Q - order).max() > SAME_AXES or (order == np.eye(3)).all():
        return ""
    return f", as with wrench {axis_order(order)}"


def _angle(turn_rad: Array, sigma_rad: float) -> str:
    return _with_sigma(float(np.degrees(np.linalg.norm(turn_rad))), float(np.degrees(sigma_rad)), "°", " away")


def _with_sigma(value: float, sigma: float, unit: str, then: str = "") -> str:
    digits = int(np.clip(1 - np.floor(np.log10(max(sigma, 1e-9))), 0, 6))
    return f"{value:.{digits}f}{unit}{then}, sigma {sigma:.{digits}f}{unit}"
