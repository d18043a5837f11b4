"""Units that were taken for N and N·m, by the weight and the centre of mass that they make."""

from collections.abc import Collection

import numpy as np

from ftcalib.findings import Finding, Severity
from ftcalib.model import Parameters

USUAL_COM_M = (0.02, 0.2)
# A centre of mass farther than the first must be described; farther than the second is wrong otherwise.
FAR_COM_M, FARTHEST_COM_M = 0.25, 0.5
NEAREST_COM_M = 5e-4
# Weights beyond these look like forces in another unit: 30 g, and more than any UR arm carries.
LIGHTEST_N, HEAVIEST_N, IMPOSSIBLE_N = 0.3, 500.0, 2000.0
# A force and a torque of bias beyond the range of most sensors, in N and N·m, and of any that an arm carries.
LARGE_BIAS, IMPOSSIBLE_BIAS = (500.0, 100.0), (2000.0, 400.0)
# A sensor whose bias is so many times the weight was not chosen for the tool.
LARGE_SHARE = 20.0
CONFIRMED_SIGMAS = 3.0
# Forces in another unit leave less than this share of the weight.
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
# The simplest mistake first.
UNITS = (
    *(("N", "N·mm"), ("N", "lbf·in"), ("lbf", "N·m"), ("kgf", "N·m"), ("gf", "N·m"), ("mN", "N·m"), ("kN", "N·m")),
    *(("lbf", "lbf·in"), ("lbf", "lbf·ft"), ("kgf", "kgf·cm"), ("kgf", "kgf·m"), ("mN", "N·mm"), ("kN", "kN·m")),
)

# Pairs of a unit of force and one of torque.
Suspects = list[tuple[str, str]]


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


def suspects(estimate: Parameters, forces: Collection[str]) -> Suspects:
    """Return these units of force, with those of torque that give a usual centre of mass."""
    return by_com(float(np.linalg.norm(estimate.p_sensor_com_m)), forces) or [(force, "N·m") for force in forces]


def unit_of_force(mass: float, sigma: float, true_kg: float, tolerance_kg: float) -> tuple[float, float]:
    """Return what a unit of force is by a known mass, in N, and its standard deviation.

    Parameters
    ----------
    mass, sigma : float
        As the data give it, with its standard deviation, if a unit were 1 N.
    true_kg, tolerance_kg : float
        The known mass, and its standard deviation.
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
    """Find a bias that no sensor, and a weight or a centre of mass that no tool has, with units that make it usual.

    Parameters
    ----------
    estimate : Parameters
    residual_N : float
        Root mean square of the forces.
    described : bool
        Whether the shape of the tool is, which alone limits how far its centre of mass may be.
    any_bias : bool
        Whether the zero of the sensor is arbitrary.
    unit_N : (float, float), optional
        By a known mass, as of `unit_of_force`.
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
    # Of a sensor with an arbitrary zero, a known mass confirms the unit of force.
    large[0] &= unit_N is None or abs(unit_N[0] - 1) > CONFIRMED_SIGMAS * unit_N[1]
    if not large.any():
        return []
    impossible = bool((large & (size > IMPOSSIBLE_BIAS)).any())
    values = {"force_N": size[0], "torque_Nm": size[1], "weight_N": estimate.weight_N, "unit_N": unit_N}
    return [Finding.of("bias_implausible", "reject" if impossible else "limit", **values)]


def too_light(weight_N: float, com_m: float, residual_N: float) -> list[Finding]:
    """Find a weight that is none: in kilonewtons, or already compensated, which leaves little but noise."""
    if weight_N >= LIGHTEST_N:
        return []
    if residual_N < NOISY * weight_N and (pairs := by_com(com_m, ["kN"])):
        return [Finding.of("weight_implausible", "limit", weight_N=weight_N, units=pairs)]
    return [Finding.of("weight_compensated", "limit", weight_N=weight_N)]
