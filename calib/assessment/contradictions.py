"""Known values that the data contradict."""

import numpy as np
from scipy.spatial.transform import Rotation

from calib.assessment.faults import force_unit
from calib.known import Known, turn_between, unit_vector
from calib.model import Array, Parameters


def contradictions(known: Known, found: Parameters, covariance: Array, g_m_s2: float, sigmas: float) -> list[str]:
    """List the known values that the data contradict, each with the value from the data.

    Parameters
    ----------
    known : Known
    found : Parameters
        From a fit without known values.
    covariance : array, shape (15, 15)
        Of that fit.
    g_m_s2 : float
    sigmas : float
        Smallest difference to list, in standard deviations.
    """
    words = []
    if known.mass_kg is not None:
        weight_N = float(np.linalg.norm(found.gravity_force_base_N))
        along = found.gravity_force_base_N / (weight_N or 1.0)
        mass_kg, sigma_kg = weight_N / g_m_s2, float(np.sqrt(along @ covariance[3:6, 3:6] @ along)) / g_m_s2
        if abs(mass_kg - known.mass_kg) > sigmas * np.hypot(sigma_kg, known.mass_tolerance_kg):
            unit = force_unit(known.mass_kg / mass_kg) if mass_kg else None
            why = f", as if the forces were in {unit}" if unit else ""
            words.append(f"mass {known.mass_kg:g} kg (data: {_with_sigma(mass_kg, sigma_kg, ' kg')}{why})")
    if known.gravity_direction_base is not None:
        direction = np.asarray(known.gravity_direction_base)
        turn = turn_between(direction, unit_vector(found.gravity_force_base_N))
        across = np.cross(unit_vector(turn), direction)
        sigma = float(np.sqrt(across @ covariance[3:6, 3:6] @ across / np.sum(found.gravity_force_base_N**2)))
        if np.linalg.norm(turn) > sigmas * np.hypot(sigma, known.direction_tolerance_rad):
            words.append(f"direction of gravity in base (data: {_angle(turn, sigma)})")
    if known.R_flange_sensor is not None:
        turn = Rotation.from_matrix(found.R_flange_sensor @ np.asarray(known.R_flange_sensor).T).as_rotvec()
        if known.yaw_only:
            z = np.array([0.0, 0.0, 1.0])
            turn = turn_between(z, Rotation.from_rotvec(turn).apply(z))
        axis = unit_vector(turn)
        sigma = float(np.sqrt(axis @ covariance[:3, :3] @ axis))
        if np.linalg.norm(turn) > sigmas * np.hypot(sigma, known.R_tolerance_rad):
            words.append(f"mounting of the sensor (data: {_angle(turn, sigma)})")
    return words


def _angle(turn_rad: Array, sigma_rad: float) -> str:
    return _with_sigma(float(np.degrees(np.linalg.norm(turn_rad))), float(np.degrees(sigma_rad)), "°", " away")


def _with_sigma(value: float, sigma: float, unit: str, then: str = "") -> str:
    digits = int(np.clip(1 - np.floor(np.log10(max(sigma, 1e-9))), 0, 6))
    return f"{value:.{digits}f}{unit}{then}, sigma {sigma:.{digits}f}{unit}"
