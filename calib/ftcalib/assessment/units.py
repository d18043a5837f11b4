"""Units that were taken for N and N·m, by the weight and the centre of mass that they make."""

from collections.abc import Collection

import numpy as np

from ftcalib.model import Parameters

USUAL_COM_M = (0.02, 0.2)
FORCE_UNITS_N = {"N": 1.0, "lbf": 4.4482216, "kgf": 9.80665, "mN": 1e-3, "kN": 1e3}
TORQUE_UNITS_NM = {
    "N·m": 1.0,
    "N·mm": 1e-3,
    "lbf·in": 0.11298483,
    "lbf·ft": 1.3558179,
    "kgf·cm": 0.0980665,
    "kgf·m": 9.80665,
    "kN·m": 1e3,
}
UNITS = (
    *(("N", "N·mm"), ("N", "lbf·in"), ("lbf", "N·m"), ("kgf", "N·m"), ("mN", "N·m"), ("kN", "N·m")),
    *(("lbf", "lbf·in"), ("lbf", "lbf·ft"), ("kgf", "kgf·cm"), ("kgf", "kgf·m"), ("mN", "N·mm"), ("kN", "kN·m")),
)
"""The simplest mistake first."""

Suspects = list[tuple[str, str]]
"""Pairs of a unit of force and one of torque."""


def by_com(com_m: float, forces: Collection[str] = tuple(FORCE_UNITS_N)) -> Suspects:
    """Return the wrong units, with one of these units of force, that make a usual distance of the centre of mass."""
    low, high = USUAL_COM_M
    return [
        (force, torque)
        for force, torque in UNITS
        if force in forces and low <= com_m * TORQUE_UNITS_NM[torque] / FORCE_UNITS_N[force] <= high
    ]


def by_mass(mass_kg: float, true_kg: float, tolerance: float) -> list[str]:
    """Return the wrong units of force that make a mass of the data agree with another one, within a share of it."""
    if true_kg <= 0:
        return []
    off = {unit: abs(mass_kg * size / true_kg - 1) for unit, size in FORCE_UNITS_N.items() if size != 1}
    return [unit for unit, share in off.items() if share < tolerance]


def suspects(found: Parameters, forces: Collection[str]) -> Suspects:
    """Return these units of force, with those of torque that give a usual centre of mass."""
    com_m = float(np.linalg.norm(found.p_sensor_com_m))
    return by_com(com_m, forces) or [(force, "N·m") for force in forces]
