"""Known values that the data contradict."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ftcalib.assessment import units
from ftcalib.assessment.faults import channels
from ftcalib.findings import Finding
from ftcalib.known import Known, turn_between, unit_vector
from ftcalib.model import UP_IN_BASE, Array, Parameters

SAME_UNIT = 0.04
"""A ratio this close to that of two units is one."""
SAME_AXES = 0.1
"""Entries of a rotation this close to -1, 0 and 1 permute the axes."""


def contradictions(
    known: Known,
    found: Parameters,
    covariance: Array,
    g_m_s2: float,
    sigmas: float,
    up_in_base: ArrayLike = UP_IN_BASE,
) -> list[Finding]:
    """Name the known values that the data contradict, each with the value from the data.

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
    contradicted = []
    weight_N = float(np.linalg.norm(found.gravity_force_base_N))
    along = found.gravity_force_base_N / (weight_N or 1.0)
    sigma_N = float(np.sqrt(along @ covariance[3:6, 3:6] @ along))
    shows_directions = weight_N > sigmas * sigma_N
    if known.mass_kg is not None:
        mass_kg, sigma_kg = weight_N / g_m_s2, sigma_N / g_m_s2
        if abs(mass_kg - known.mass_kg) > sigmas * np.hypot(sigma_kg, known.mass_tolerance_kg):
            suspects = units.suspects(found, units.by_mass(mass_kg, known.mass_kg, SAME_UNIT))
            values = {"known_kg": known.mass_kg, "mass_kg": mass_kg, "sigma_kg": sigma_kg, "units": suspects}
            contradicted.append(Finding.of("known_mass", "limit", **values))
    if known.gravity_direction_base is not None and shows_directions:
        direction = np.asarray(known.gravity_direction_base)
        turn = turn_between(direction, unit_vector(found.gravity_force_base_N))
        across = np.cross(unit_vector(turn), direction)
        sigma = float(np.sqrt(across @ covariance[3:6, 3:6] @ across / np.sum(found.gravity_force_base_N**2)))
        if np.linalg.norm(turn) > sigmas * np.hypot(sigma, known.direction_tolerance_rad):
            contradicted.append(Finding.of("known_gravity_direction", "limit", **_off(turn, sigma)))
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
            order = np.round(Q)
            permuted = np.abs(Q - order).max() <= SAME_AXES and not (order == np.eye(3)).all()
            corrections = [("wrench", channels(order))] if permuted and not known.yaw_only else []
            contradicted.append(Finding.of("known_mounting", "limit", **_off(turn, sigma), corrections=corrections))
    return contradicted


def _off(turn_rad: Array, sigma_rad: float) -> dict[str, float]:
    return {"off_deg": float(np.degrees(np.linalg.norm(turn_rad))), "sigma_deg": float(np.degrees(sigma_rad))}
