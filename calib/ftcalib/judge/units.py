"""Detection of wrong units of force and torque, by implausible weights and centres of mass."""

from collections.abc import Collection

import numpy as np

from ftcalib.findings import Finding, Severity
from ftcalib.model import Parameters

USUAL_COM_M = (0.02, 0.2)
# A centre of mass farther than this from the sensor limits the verdict: without a described tool, and always.
FAR_COM_M, FARTHEST_COM_M = 0.25, 0.5
NEAREST_COM_M = 5e-4
# Weights below 0.3 N (30 g) or above 500 N (the payload of UR arms) look like forces in another unit.
LIGHTEST_N, HEAVIEST_N, IMPOSSIBLE_N = 0.3, 500.0, 2000.0
# Bias of force and torque, N and N·m, beyond the range of most sensors, and beyond that of any sensor on an arm.
LARGE_BIAS, IMPOSSIBLE_BIAS = (500.0, 100.0), (2000.0, 400.0)
# A bias must also exceed the weight by this factor to be implausible.
LARGE_SHARE = 20.0
CONFIRMED_SIGMAS = 3.0
# Largest residual, as a share of the weight, of data that are only in another unit.
NOISY = 0.03
FORCE_UNITS_N = {"N": 1.0, "lbf": 4.4482216152605, "kgf": 9.80665, "gf": 9.80665e-3, "mN": 1e-3, "kN": 1e3}
TORQUE_UNITS_NM = {
    "N·m": 1.0,
    "N·mm": 1e-3,
    "lbf·in": 0.1129848290276167,
    "lbf·ft": 1.3558179483314004,
    "kgf·cm": 0.0980665,
    "kgf·m": 9.80665,
    "kN·m": 1e3,
}
# Pairs of wrong units of force and torque, the simplest mistake first.
UNITS = (
    *(("N", "N·mm"), ("N", "lbf·in"), ("lbf", "N·m"), ("kgf", "N·m"), ("gf", "N·m"), ("mN", "N·m"), ("kN", "N·m")),
    *(("lbf", "lbf·in"), ("lbf", "lbf·ft"), ("kgf", "kgf·cm"), ("kgf", "kgf·m"), ("mN", "N·mm"), ("kN", "kN·m")),
)

# Pairs of suspected units of force and torque.
Suspects = list[tuple[str, str]]


def by_com(com_m: float, forces: Collection[str] = tuple(FORCE_UNITS_N)) -> Suspects:
    """Return the pairs of wrong units, with a given unit of force, that explain how far the centre of mass is."""
    low, high = USUAL_COM_M
    return [
        (force, torque)
        for force, torque in UNITS
        if force in forces and low <= com_m * TORQUE_UNITS_NM[torque] / FORCE_UNITS_N[force] <= high
    ]


def by_mass(mass_kg: float, true_kg: float, tolerance: float) -> list[str]:
    """Return the units of force with which the measured mass would equal the true mass, within a relative tolerance."""
    if true_kg <= 0:
        return []
    off = {unit: abs(mass_kg * size / true_kg - 1) for unit, size in FORCE_UNITS_N.items() if size != 1}
    return [unit for unit, share in off.items() if share < tolerance]


def suspects(estimate: Parameters, forces: Collection[str]) -> Suspects:
    """Return the units of force, each with the units of torque that give a usual centre of mass."""
    return by_com(float(np.linalg.norm(estimate.p_sensor_com_m)), forces) or [(force, "N·m") for force in forces]


def unit_of_force(mass: float, sigma: float, true_kg: float, tolerance_kg: float) -> tuple[float, float]:
    """Return the size of the unit of force in N according to a known mass, and its standard deviation.

    Parameters
    ----------
    mass, sigma : float
        Mass from the data and its standard deviation, for a unit of 1 N.
    true_kg, tolerance_kg : float
        Known mass and its standard deviation.
    """
    unit_N = true_kg / mass
    return unit_N, unit_N * float(np.hypot(sigma / mass, tolerance_kg / true_kg))


def implausible(
    estimate: Parameters,
    residual_N: float,
    *,
    described: bool,
    any_bias: bool = False,
    unit_N: tuple[float, float] | None = None,
) -> list[Finding]:
    """Return findings for an implausible bias, weight or centre of mass, with the units that would explain them.

    Parameters
    ----------
    residual_N : float
        Rms residual of the forces.
    described : bool
        Whether the shape of the tool is described; then the description limits the centre of mass.
    any_bias : bool
        Whether the zero of the sensor is arbitrary.
    unit_N : (float, float), optional
        Size of the unit of force according to a known mass, from `unit_of_force`.
    """
    weight_N, com_m = estimate.weight_N, float(np.linalg.norm(estimate.p_sensor_com_m))
    findings = [*([] if any_bias else _bias(estimate, unit_N)), *too_light(weight_N, com_m, residual_N)]
    if weight_N > HEAVIEST_N:
        severity: Severity = "reject" if weight_N > IMPOSSIBLE_N else "limit"
        names = [unit for unit in ("gf", "mN") if LIGHTEST_N < weight_N * FORCE_UNITS_N[unit] <= HEAVIEST_N]
        pairs = suspects(estimate, names)
        findings.append(Finding.of("weight_implausible", severity, weight_N=weight_N, units=pairs, unit_N=unit_N))
    if com_m > FAR_COM_M and not described:
        values = {"distance_m": com_m, "most_m": FARTHEST_COM_M if com_m > FARTHEST_COM_M else FAR_COM_M}
        severity = "reject" if com_m > FARTHEST_COM_M else "limit"
        findings.append(Finding.of("com_too_far", severity, **values, units=by_com(com_m)))
    if com_m < NEAREST_COM_M:
        findings.append(Finding.of("com_too_near", distance_mm=1e3 * com_m))
    return findings


def _bias(estimate: Parameters, unit_N: tuple[float, float] | None) -> list[Finding]:
    size = np.array([np.linalg.norm(estimate.force_bias_N), np.linalg.norm(estimate.torque_bias_Nm)])
    lever_m = max(USUAL_COM_M[1], float(np.linalg.norm(estimate.p_sensor_com_m)))
    large = (size > LARGE_BIAS) & (size > LARGE_SHARE * estimate.weight_N * np.array([1.0, lever_m]))
    # A large force bias is plausible if a known mass confirms the unit of force.
    large[0] &= unit_N is None or abs(unit_N[0] - 1) > CONFIRMED_SIGMAS * unit_N[1]
    if not large.any():
        return []
    impossible = bool((large & (size > IMPOSSIBLE_BIAS)).any())
    values = {"force_N": size[0], "torque_Nm": size[1], "weight_N": estimate.weight_N, "unit_N": unit_N}
    return [Finding.of("bias_implausible", "reject" if impossible else "limit", **values)]


def too_light(weight_N: float, com_m: float, residual_N: float) -> list[Finding]:
    """Return a finding for a weight near zero: in kilonewtons, or already compensated."""
    if weight_N >= LIGHTEST_N:
        return []
    if residual_N < NOISY * weight_N and (pairs := by_com(com_m, ["kN"])):
        return [Finding.of("weight_implausible", "limit", weight_N=weight_N, units=pairs)]
    return [Finding.of("weight_compensated", "limit", weight_N=weight_N)]
