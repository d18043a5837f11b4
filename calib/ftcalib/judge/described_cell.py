"""Contradictions with known values or with the described cell: signs, mounting, payload, mass and centre of mass."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ftcalib.findings import Finding
from ftcalib.judge import units
from ftcalib.judge.faults import channels
from ftcalib.judge.observability import axes_along, evenly_spread
from ftcalib.judge.units import FARTHEST_COM_M
from ftcalib.known import Known, Setup, turn_between, unit_vector
from ftcalib.likelihood.fit import Estimate
from ftcalib.model import UP_IN_BASE, Array, Parameters
from ftcalib.rounding import to_place_of

# Tolerated distance of a centre of mass on the robot's side of the sensor origin, where adapter plates may be.
INSIDE_M = 0.01
REVERSED_TILT_DEG = 135.0
# Tilt of the base above which the robot must be mounted on a wall.
HANGING_DEG = 60.0
# Largest angle between measured and expected gravity that counts as a leaning base; more means another mounting.
OTHER_MOUNTING_DEG: Final = 10.0
# Smallest angle of a leaning base that is reported: about the accuracy of an arm's orientation.
LEAN_DEG: Final = 0.2
# Distance by which a centre of mass may be outside the described cylinders, because of cables and screws.
COM_MARGIN_M = 0.01
# A centre of mass farther outside the described tool is wrong. If closer, the description may be wrong instead.
SURELY_OUTSIDE_M = 0.1
# Wrong units are suspected if the centre of mass is outside the tool and farther from the sensor than this.
FAR_COM_M = 0.1
# A mass below this share of the described mass is the rest of a compensated weight, not a tool.
NO_TOOL_SHARE = 0.1
# Tolerance of a described tool mass: the larger of this mass and this share.
TOOL_KG, TOOL_SHARE = 0.1, 0.3
_SIGMAS_OF_MARGIN: Final = 3.0
# Tolerance of the payload: the larger of this mass and this share of the expected payload.
PAYLOAD_KG, PAYLOAD_SHARE = 0.5, 0.3
# Additional tolerance, kg, for a payload that is too large, if the mass of sensor and adapter is unknown.
SENSOR_KG: Final = 0.3
# A payload that differs by more than this mass (kg), but agrees in another unit within this share: wrong units.
UNIT_KG, UNIT_SHARE = 0.8, 0.3
_SIGNIFICANT: Final = 4.0


def directions(parameters: Parameters, covariance: Array, setup: Setup, written: str = "") -> list[Finding]:
    """Return findings for reversed signs, and for a direction of gravity that contradicts the mounting of the robot.

    Parameters
    ----------
    covariance : array, shape (15, 15)
    written : str
        Form in which the orientations were given, see `faults`.
    """
    lean = lean_from(-setup.up, parameters.gravity_force_base_N, covariance[3:6, 3:6])
    inside_m = _inside_m(parameters, covariance)
    if lean.deg >= REVERSED_TILT_DEG:
        return [Finding.of("forces_reversed" if inside_m else "weight_upwards", off_deg=lean.deg)]
    findings = []
    if 0 < inside_m <= FARTHEST_COM_M:
        # Gravity shows the centre of mass only relative to the reference point of the torques. Reversed torques are
        # excluded only if the described tool cannot have the mirrored centre of mass.
        mirrored = replace(parameters, p_sensor_com_m=-parameters.p_sensor_com_m)
        possible = not setup.cylinders_m or _outside_m(mirrored, covariance, setup) <= COM_MARGIN_M
        code = "torques_reversed" if possible else "torques_about_point"
        findings.append(Finding.of(code, inside_mm=1e3 * inside_m))
    along = parameters.down
    is_declared = setup.up_in_base is not None
    if lean.is_other_mounting:
        undeclared = "mounting_undeclared" if lean.deg > HANGING_DEG else "gravity_tilted"
        code = "gravity_off_mounting" if is_declared else undeclared
        values = {} if code == "gravity_tilted" else {"orders": _quaternion_orders(along, setup.up, written)}
        findings.append(Finding.of(code, off_deg=lean.deg, direction=along, **values))
    elif is_declared and lean.is_significant:
        findings.append(Finding.of("base_leans", lean_deg=lean.deg, sigma_deg=lean.sigma_deg, side=lean.side))
    return findings


def _quaternion_orders(gravity_direction_base: Array, up: Array, written: str) -> list[str]:
    """Return the true orders of quaternions with which gravity would point down, if they were read wrongly.

    Quaternions read inverted and in the wrong order give `U R V` of the true R with fixed rotations U, V: they fit too.
    """
    if written not in ("", "quaternion"):
        return []
    along = {order: -float(up @ U @ gravity_direction_base) for order, U in _OTHER_ORDERS.items()}
    return [order for order, cosine in along.items() if cosine > np.cos(np.radians(OTHER_MOUNTING_DEG))]


# Rotations from the base axes as read to the true base axes, for quaternions whose true order is the key.
_OTHER_ORDERS: Final = {
    "w, x, y, z": np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]]),
    "x, y, z, w": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
}


def _inside_m(parameters: Parameters, covariance: Array) -> float:
    """Return the distance of the centre of mass behind the sensor, towards the robot; 0 if not significant.

    For a tool along the flange axis, reversed torques put the centre of mass inside the arm, where no tool can be. A
    centre of mass that is farther to the side than behind shows nothing.
    """
    outwards = parameters.R_flange_sensor[2]  # flange z in the sensor frame
    inside_m = -float(outwards @ parameters.p_sensor_com_m)
    aside_m = float(np.linalg.norm(np.cross(outwards, parameters.p_sensor_com_m)))
    sigma_m = float(np.sqrt(outwards @ covariance[9:12, 9:12] @ outwards))
    return inside_m if inside_m > max(INSIDE_M, 3 * sigma_m, aside_m) else 0.0


@dataclass(frozen=True, slots=True)
class Lean:
    """Angle between the measured and the expected direction of gravity in the base."""

    deg: float
    sigma_deg: float
    side: str
    """Direction in base axes towards which the base leans (its low side), such as "+y"."""

    @property
    def is_other_mounting(self) -> bool:
        """Whether the angle is so large that the mounting of the robot is another one than described."""
        return self.deg > OTHER_MOUNTING_DEG

    @property
    def is_significant(self) -> bool:
        """Whether the angle exceeds its uncertainty and the accuracy of an arm's orientation."""
        return self.deg >= max(LEAN_DEG, _SIGNIFICANT * self.sigma_deg)

    def __str__(self) -> str:
        deg, sigma_deg = (to_place_of(angle, self.sigma_deg) for angle in (self.deg, self.sigma_deg))
        return f"leans {deg}° (sigma {sigma_deg}°) towards its {self.side}"


def lean_from(down: Array, gravity_force_base_N: Array, covariance: Array) -> Lean:
    """Return the lean of measured gravity (3,) with covariance (3, 3) from the expected unit vector `down` (3,).

    All vectors are in base axes. The side is the axis, or the pair of axes, along which gravity differs.
    """
    along_N = float(gravity_force_base_N @ down)
    aside_N = gravity_force_base_N - along_N * down
    size_N = float(np.linalg.norm(aside_N))
    low = aside_N / max(size_N, 1e-12)
    deg = float(np.degrees(np.arctan2(size_N, along_N)))
    weight_N = float(np.linalg.norm(gravity_force_base_N))
    sigma_deg = float(np.degrees(np.sqrt(max(float(low @ covariance @ low), 0.0)) / weight_N))
    return Lean(deg, sigma_deg, " and ".join(axes_along(low)))


def payload(
    payload_kg: float | None, load_kg: float, sensor_kg: float | None, parameters: Parameters | None = None
) -> list[Finding]:
    """Return findings if the payload in the controller does not match the load on the flange.

    Parameters
    ----------
    payload_kg : float, optional
        Payload configured in the controller.
    load_kg : float
        Load on the sensor, without the sensor itself.
    sensor_kg : float, optional
        Mass of sensor and adapter. If it is unknown, the payload may be larger by `SENSOR_KG`.
    parameters : Parameters, optional
        Estimated parameters, which show the unit of torque that belongs to a unit of force.
    """
    if payload_kg is None:
        return []
    expected_kg, set_kg = payload_kg - (sensor_kg or 0.0), load_kg + (sensor_kg or 0.0)
    forces = units.by_mass(load_kg, expected_kg, UNIT_SHARE) if abs(expected_kg - load_kg) > UNIT_KG else []
    if forces:
        suspects = [(force, "N·m") for force in forces] if parameters is None else units.suspects(parameters, forces)
        return [Finding.of("payload_units", load_kg=load_kg, expected_kg=expected_kg, units=suspects)]
    margin_kg = max(PAYLOAD_KG, PAYLOAD_SHARE * set_kg)
    most_kg = set_kg + (SENSOR_KG if sensor_kg is None else 0.0)
    if set_kg - margin_kg <= payload_kg <= most_kg + margin_kg:
        return []
    values = {"payload_kg": payload_kg, "load_kg": load_kg, "sensor_kg": sensor_kg, "set_kg": set_kg}
    return [Finding.of("payload_mismatch", **values)]


def tool(parameters: Parameters, covariance: Array, setup: Setup, g_m_s2: float) -> list[Finding]:
    """Return findings if the mass or the centre of mass contradicts the described tool."""
    return [*_mass_findings(parameters, covariance, setup, g_m_s2), *_centre_of_mass(parameters, covariance, setup)]


def _mass_findings(parameters: Parameters, covariance: Array, setup: Setup, g_m_s2: float) -> list[Finding]:
    weight_N, tool_kg = parameters.weight_N, setup.tool_mass_kg
    load_kg = weight_N / g_m_s2
    sigma_kg = parameters.weight_sigma_N(covariance) / g_m_s2
    if tool_kg is None:
        return []
    margin_kg = _margin_kg(tool_kg)
    if setup.weighed_kg is not None:
        margin_kg = _SIGNIFICANT * float(np.hypot(setup.gain_sigma * tool_kg, setup.weighed_kg[1]))
    if abs(load_kg - tool_kg) <= max(margin_kg, _SIGNIFICANT * sigma_kg):
        return []
    suspects = units.suspects(parameters, units.by_mass(load_kg, tool_kg, UNIT_SHARE))
    if not suspects and load_kg < NO_TOOL_SHARE * tool_kg:
        return [Finding.of("weight_compensated", weight_N=weight_N)]
    unit_N = units.unit_of_force(load_kg, sigma_kg, tool_kg, _margin_kg(tool_kg) / _SIGMAS_OF_MARGIN)
    return [Finding.of("tool_mass_mismatch", load_kg=load_kg, tool_kg=tool_kg, units=suspects, unit_N=unit_N)]


def force_unit_of_cell(
    estimate: Estimate, known: Known | None, setup: Setup, g_m_s2: float
) -> tuple[float, float] | None:
    """Return the size of the unit of force in N according to the known or described mass, and its sigma."""
    if known is not None and known.mass_kg is not None:
        true_kg, tolerance_kg = known.mass_kg, known.mass_tolerance_kg
    elif setup.tool_mass_kg:
        true_kg, tolerance_kg = setup.tool_mass_kg, _margin_kg(setup.tool_mass_kg) / _SIGMAS_OF_MARGIN
    else:
        return None
    weight_N, sigma_N = estimate.parameters.weight_N, estimate.parameters.weight_sigma_N(estimate.covariance)
    if weight_N == 0:
        return None
    return units.unit_of_force(weight_N / g_m_s2, sigma_N / g_m_s2, true_kg, tolerance_kg)


def _margin_kg(tool_kg: float) -> float:
    return max(TOOL_KG, TOOL_SHARE * tool_kg)


def _centre_of_mass(parameters: Parameters, covariance: Array, setup: Setup) -> list[Finding]:
    if not setup.cylinders_m or (outside_m := _outside_m(parameters, covariance, setup)) <= COM_MARGIN_M:
        return []
    com_m, height_m = parameters.R_flange_sensor @ parameters.p_sensor_com_m, setup.sensor_height_m
    distance_m = float(np.linalg.norm(com_m))
    return [
        Finding.of(
            "com_outside_tool",
            "reject" if outside_m > SURELY_OUTSIDE_M else "limit",
            com_mm=1e3 * np.add(com_m, (0.0, 0.0, height_m or 0.0)),
            origin="sensor" if height_m is None else "flange",
            outside_mm=1e3 * outside_m,
            units=units.by_com(distance_m) if distance_m > FAR_COM_M else [],
        )
    ]


def _outside_m(parameters: Parameters, covariance: Array, setup: Setup) -> float:
    """Return the significant distance of the centre of mass outside the described cylinders; negative inside.

    A body's centre of mass lies in its convex hull. The distance from the hull is the maximum over all directions of
    the extent of the point minus that of the hull, less a multiple of sigma. An unknown height may have any value.
    """
    height_m = setup.sensor_height_m
    lowest_m, highest_m = (0.0, max(row[1] for row in setup.cylinders_m)) if height_m is None else (height_m,) * 2
    R = parameters.R_flange_sensor
    com_m = R @ parameters.p_sensor_com_m
    along_z = _DIRECTIONS[:, 2]
    reach_m = _DIRECTIONS @ com_m + np.minimum(along_z * lowest_m, along_z * highest_m)
    sigma_m = np.sqrt(np.einsum("ni,ij,nj->n", _DIRECTIONS, R @ covariance[9:12, 9:12] @ R.T, _DIRECTIONS))
    return float((reach_m - _reach_m(setup.cylinders_m) - _SIGNIFICANT * sigma_m).max())


# Neighbouring directions are about 4° apart, so the distance is accurate to 0.1 %.
_DIRECTIONS = np.vstack([evenly_spread(2000), np.eye(3), -np.eye(3)])


def _reach_m(cylinders_m: Sequence[Sequence[float]]) -> Array:
    """Return the extent of the convex hull of cylinders along flange z in each of `_DIRECTIONS`, m."""
    aside, along_z = np.linalg.norm(_DIRECTIONS[:, :2], axis=1), _DIRECTIONS[:, 2]
    reaches = []
    for low, high, diameter, *axis in cylinders_m:
        ends = np.maximum(along_z * low, along_z * high)
        reaches.append(ends + aside * diameter / 2 + _DIRECTIONS[:, :2] @ (axis or (0.0, 0.0)))
    return np.asarray(np.max(reaches, axis=0))


# Known values that the data contradict.

# A ratio of masses equals a ratio of units up to this relative difference.
SAME_UNIT = 0.04
# Largest difference of the entries of a rotation from -1, 0 and 1 for a permutation of the axes.
SAME_AXES = 0.1


def contradictions(
    known: Known,
    estimate: Parameters,
    covariance: Array,
    g_m_s2: float,
    sigmas: float,
    up_in_base: ArrayLike = UP_IN_BASE,
) -> list[Finding]:
    """Return a finding for each known value that the data contradict, with the value from the data.

    Parameters
    ----------
    estimate : Parameters
        Estimate without known values.
    covariance : array, shape (15, 15)
        Covariance of `estimate`.
    sigmas : float
        Smallest difference that is reported, in standard deviations.
    up_in_base : array_like, shape (3,)
        Expected up direction.
    """
    contradicted = []
    weight_N, sigma_N = estimate.weight_N, estimate.weight_sigma_N(covariance)
    shows_directions = weight_N > sigmas * sigma_N
    if known.mass_kg is not None:
        mass_kg, sigma_kg = weight_N / g_m_s2, sigma_N / g_m_s2
        if abs(mass_kg - known.mass_kg) > sigmas * np.hypot(sigma_kg, known.mass_tolerance_kg):
            suspects = units.suspects(estimate, units.by_mass(mass_kg, known.mass_kg, SAME_UNIT))
            unit_N = units.unit_of_force(mass_kg, sigma_kg, known.mass_kg, known.mass_tolerance_kg)
            values = {"known_kg": known.mass_kg, "mass_kg": mass_kg, "sigma_kg": sigma_kg, "unit_N": unit_N}
            contradicted.append(Finding.of("known_mass", "limit", **values, units=suspects))
    if known.gravity_direction_base is not None and shows_directions:
        direction = np.asarray(known.gravity_direction_base)
        turn = turn_between(direction, unit_vector(estimate.gravity_force_base_N))
        across = np.cross(unit_vector(turn), direction)
        sigma = float(np.sqrt(across @ covariance[3:6, 3:6] @ across / np.sum(estimate.gravity_force_base_N**2)))
        if np.linalg.norm(turn) > sigmas * np.hypot(sigma, known.direction_tolerance_rad):
            contradicted.append(Finding.of("known_gravity_direction", "limit", **_off(turn, sigma)))
    if known.R_flange_sensor is not None and shows_directions:
        turn = Rotation.from_matrix(estimate.R_flange_sensor @ np.asarray(known.R_flange_sensor).T).as_rotvec()
        if known.yaw_only:
            z = np.array([0.0, 0.0, 1.0])
            turn = turn_between(z, Rotation.from_rotvec(turn).apply(z))
        axis = unit_vector(turn)
        sigma = float(np.sqrt(axis @ covariance[:3, :3] @ axis))
        if np.linalg.norm(turn) > sigmas * np.hypot(sigma, known.R_tolerance_rad):
            upwards = float(estimate.gravity_force_base_N @ np.asarray(up_in_base)) > 0  # mirrored axes
            Q = np.asarray(known.R_flange_sensor).T @ estimate.R_flange_sensor * (-1 if upwards else 1)
            order = np.round(Q)
            permuted = np.abs(Q - order).max() <= SAME_AXES and not (order == np.eye(3)).all()
            corrections = [("wrench", channels(order))] if permuted and not known.yaw_only else []
            contradicted.append(Finding.of("known_mounting", "limit", **_off(turn, sigma), corrections=corrections))
    return contradicted


def _off(turn_rad: Array, sigma_rad: float) -> dict[str, float]:
    return {"off_deg": float(np.degrees(np.linalg.norm(turn_rad))), "sigma_deg": float(np.degrees(sigma_rad))}
