"""Values known before the calibration, exactly or within a tolerance, and the description of the cell."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ftcalib.model import UP_IN_BASE, Array, Parameters, is_rotation, read_only


@dataclass(frozen=True, eq=False)
class Known:
    """Known values of parameters. A tolerance is one standard deviation; 0 means exactly known.

    Raises
    ------
    ValueError
        An invalid rotation, a direction of length zero, a mass that is not positive, or a negative tolerance.

    Examples
    --------
    A tool that was weighed on a scale:

    >>> import ftdrive
    >>> result = ftdrive.solve(ftdrive.read_dataset("poses.csv"), known=ftdrive.Known(mass_kg=1.235))
    >>> round(result.mass_kg, 6)
    1.235
    """

    R_flange_sensor: ArrayLike | None = None
    """(3, 3) mounting of the sensor; with `yaw_only` up to a rotation about flange z, by default the identity."""
    R_tolerance_rad: float = 0.0
    """Tolerance of each rotation angle of the mounting, rad; with `yaw_only`, of the two tilts."""
    yaw_only: bool = False
    """Whether the sensor is mounted flat, so only its rotation about the flange z axis is unknown."""
    gravity_direction_base: ArrayLike | None = None
    """(3,) direction of gravity in base axes, of any length: (0, 0, -1) for a level robot."""
    direction_tolerance_rad: float = 0.0
    """Tolerance of each of the two tilt angles of gravity, rad."""
    mass_kg: float | None = None
    """Mass of the load on the sensor, kg."""
    mass_tolerance_kg: float = 0.0

    def __post_init__(self) -> None:
        if self.R_flange_sensor is not None or self.yaw_only:
            R = read_only(np.eye(3) if self.R_flange_sensor is None else self.R_flange_sensor)
            if not is_rotation(R):
                raise ValueError(f"the known R_flange_sensor must be a rotation matrix, not {R.tolist()}")
            object.__setattr__(self, "R_flange_sensor", R)
        if self.gravity_direction_base is not None:
            direction = np.asarray(self.gravity_direction_base, dtype=np.float64)
            length = float(np.linalg.norm(direction))
            if direction.shape != (3,) or not 0 < length < np.inf:
                raise ValueError(f"gravity_direction_base must be three numbers, not all 0, got {direction.tolist()}")
            object.__setattr__(self, "gravity_direction_base", read_only(direction / length))
        if self.mass_kg is not None and not 0 < self.mass_kg < np.inf:
            raise ValueError(f"mass_kg is {self.mass_kg}, expected a positive number")
        for name in ("R_tolerance_rad", "direction_tolerance_rad", "mass_tolerance_kg"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} is {getattr(self, name)}, expected 0 (exactly known) or more")


class Constraints:
    """Known values as the solver needs them: free directions, and pseudo-measurements divided by their tolerance."""

    def __init__(self, known: Known, g_m_s2: float) -> None:
        self.R = None if known.R_flange_sensor is None else np.asarray(known.R_flange_sensor)
        self.yaw_only = known.yaw_only
        self.direction = None if known.gravity_direction_base is None else np.asarray(known.gravity_direction_base)
        self.weight_N = None if known.mass_kg is None else known.mass_kg * g_m_s2
        self.R_tolerance = known.R_tolerance_rad
        self.direction_tolerance = known.direction_tolerance_rad
        self.weight_tolerance_N = known.mass_tolerance_kg * g_m_s2
        self.any = not (self.R is None and self.direction is None and self.weight_N is None)
        self._tilts = 2 if self.yaw_only else 3

    def rotations(self, minima: list[Array], cost: Array) -> list[Array]:
        """Return starting rotations R_flange_sensor: the unconstrained minima, or rotations near the known mounting.

        Parameters
        ----------
        minima : list of array, shape (3, 3)
            R_flange_sensor of the unconstrained minima.
        cost : array, shape (9, 9)
            Quadratic force cost as a function of vec(R_flange_sensor.T).
        """
        if self.R is None:
            return minima
        if not self.yaw_only:
            return [self.R] if self.R_tolerance == 0 else [self.R, *minima]
        angles = np.arange(24) * np.pi / 12  # enough starts, because the cost is a trigonometric polynomial of degree 2
        turned = Rotation.from_rotvec(angles[:, None] * [0.0, 0.0, 1.0]).as_matrix() @ self.R
        r = np.swapaxes(turned, 1, 2).reshape(-1, 9)
        value = np.einsum("ki,ij,kj->k", r, cost, r)
        low = (value <= np.roll(value, 1)) & (value <= np.roll(value, -1))
        return [*turned[low][np.argsort(value[low])][:4], *(minima if self.R_tolerance > 0 else [])]

    def satisfy(self, p: Parameters) -> Parameters:
        """Return the parameters with direction and norm of the gravity force replaced by those exactly known."""
        b = np.array(p.gravity_force_base_N)
        if self.direction is not None and self.direction_tolerance == 0:
            b = float(np.linalg.norm(b)) * self.direction
        if self.weight_N is not None and self.weight_tolerance_N == 0:
            b *= self.weight_N / max(float(np.linalg.norm(b)), 1e-300)
        return Parameters(p.R_flange_sensor, b, p.force_bias_N, p.p_sensor_com_m, p.torque_bias_Nm)

    def free(self, p: Parameters) -> Array:
        """Return an orthonormal basis (15, m) of the directions that are not exactly known."""
        keep = np.eye(15)
        fixed = []
        if self.R is not None and self.R_tolerance == 0:
            fixed += [keep[k] for k in range(self._tilts)]
        b_hat = unit_vector(p.gravity_force_base_N)
        if self.direction is not None and self.direction_tolerance == 0:
            fixed += [np.concatenate([np.zeros(3), t, np.zeros(9)]) for t in _perpendicular_axes(b_hat)]
        if self.weight_N is not None and self.weight_tolerance_N == 0:
            fixed.append(np.concatenate([np.zeros(3), b_hat, np.zeros(9)]))
        if not fixed:
            return keep
        Q, _ = np.linalg.qr(np.column_stack([np.array(fixed).T, keep]))
        return np.asarray(Q[:, len(fixed) : 15])

    @property
    def dof(self) -> int:
        """Number of degrees of freedom that constraints and pseudo-measurements add to the residuals."""
        rotation = 0 if self.R is None else self._tilts
        return rotation + 2 * (self.direction is not None) + (self.weight_N is not None)

    def measurements(self, p: Parameters) -> tuple[Array, Array]:
        """Return derivative (k, 15) and residual (k,), known minus estimated, of values known within a tolerance."""
        rows, residuals = [np.zeros((0, 15))], [np.zeros(0)]

        def add(at: int, derivative: Array, residual: Array, tolerance: float) -> None:
            row = np.zeros((len(residual), 15))
            row[:, at : at + 3] = derivative / tolerance
            rows.append(row)
            residuals.append(residual / tolerance)

        if self.R is not None and self.R_tolerance > 0:
            turn = p.R_flange_sensor @ self.R.T
            if self.yaw_only:
                z = np.array([0.0, 0.0, 1.0])
                add(0, np.eye(2, 3), turn_between(z, turn @ z)[:2], self.R_tolerance)
            else:
                add(0, np.eye(3), Rotation.from_matrix(turn).as_rotvec(), self.R_tolerance)
        b = p.gravity_force_base_N
        length = max(float(np.linalg.norm(b)), 1e-300)
        if self.direction is not None and self.direction_tolerance > 0:
            across = _perpendicular_axes(self.direction)
            off = across @ np.cross(turn_between(self.direction, b / length), self.direction)
            add(3, across / length, -off, self.direction_tolerance)
        if self.weight_N is not None and self.weight_tolerance_N > 0:
            add(3, b[None] / length, np.array([self.weight_N - length]), self.weight_tolerance_N)
        return np.concatenate(rows), np.concatenate(residuals)


def turn_between(a: Array, b: Array) -> Array:
    """Return the smallest rotation vector that rotates unit vector a to unit vector b."""
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, a @ b)
    if sine < 1e-12:
        return np.asarray(axis if a @ b > 0 else np.pi * _perpendicular_axes(a)[0])
    return np.asarray(axis * (angle / sine))


def unit_vector(v: Array) -> Array:
    """Return a vector (3,) divided by its norm; -z for a zero vector."""
    length = float(np.linalg.norm(v))
    return v / length if length > 0 else np.array([0.0, 0.0, -1.0])


def _perpendicular_axes(direction: Array) -> Array:
    """Return two unit vectors (2, 3) perpendicular to a unit vector and to each other."""
    first = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(direction, first)])


# Description of the cell, with which a result is compared.

# Standard deviation of the gain of a mounted sensor; comparisons between sensors show errors of up to 2 to 5 %.
USUAL_GAIN: Final = 0.02
# Share of the variance of the gain that is common to all axes: 1.4 % common, and 1.4 % for each axis separately.
COMMON_SHARE: Final = 0.5
# Ratio of the standard deviations of cross-talk and gain.
CROSS_TALK_SHARE: Final = 0.5
# Standard deviation per axis of the orientation of an arm with its own factory kinematics.
USUAL_ORIENTATION_DEG: Final = 0.06
# Ratio of torque range to force range of a sensor without data sheet.
RANGE_LEVER_M: Final = 0.05


@dataclass(frozen=True, slots=True)
class Setup:
    """Description of the cell; None means not declared. A result that contradicts it is at best usable.

    Examples
    --------
    >>> import ftdrive
    >>> ftdrive.Setup(up_in_base=(1.0, 0.0, 0.0), tool_mass_kg=1.2).up
    array([1., 0., 0.])

    Raises
    ------
    ValueError
        A direction of length zero, or an invalid cylinder.
    """

    up_in_base: Sequence[float] | None = None
    """(3,) up direction in base axes, of any length: (0, 0, 1) for a robot on the floor. If it is not declared, a
    result for a robot on a wall or a ceiling is not good, because wrong rotations have the same effect."""
    tool_mass_kg: float | None = None
    """Approximate mass of the load on the sensor, kg."""
    tool_mass_sigma_kg: float | None = None
    """One standard deviation of the tool mass, kg, if the tool was weighed."""
    cylinders_m: Sequence[Sequence[float]] = ()
    """Tool and sensor as cylinders along flange z: start, end, diameter, and optionally x and y of the axis, m."""
    sensor_height_m: float | None = None
    """Height of the sensor origin above the flange face, m."""
    sensor_mass_kg: float | None = None
    """Mass of sensor and adapter, kg, which the sensor cannot measure."""
    payload_kg: float | None = None
    """Payload configured in the controller, kg: everything mounted on the flange."""
    sensor_accuracy_percent: float | None = None
    """Accuracy of readings under load (95 %) from the data sheet or a test; 4 % is assumed if not declared."""
    sensor_range: Sequence[float] | None = None
    """(2,) measuring ranges of force, N, and torque, N·m."""
    orientation_accuracy_deg: float | None = None
    """Standard deviation per axis of the arm's orientation, deg; 0.06 is assumed if not declared, as for an arm with
    its own factory kinematics. 0 declares an exact arm with rigid mounts."""
    sensor_has_arbitrary_zero: bool = False
    """Whether the zero of the sensor is arbitrary. A large bias is then not a sign of a mistake."""

    def __post_init__(self) -> None:
        if self.up_in_base is not None:
            up = np.array(self.up_in_base, dtype=np.float64)
            if up.shape != (3,) or not 0 < np.linalg.norm(up) < np.inf:
                raise ValueError(f"up_in_base is {self.up_in_base}, expected three numbers that are not all 0")
            object.__setattr__(self, "up_in_base", tuple(up.tolist()))
        if self.sensor_range is not None and not (len(self.sensor_range) == 2 and min(self.sensor_range) > 0):
            raise ValueError(f"sensor_range is {list(self.sensor_range)}, expected two positive numbers: N and N·m")
        for row in self.cylinders_m:
            if len(row) not in {3, 5} or not np.isfinite(row).all():
                raise ValueError(f"the cylinder {list(row)} is invalid: give start, end, diameter, and optionally x, y")

    @property
    def sensor_lever_m(self) -> float:
        """Ratio of torque range to force range, m."""
        return RANGE_LEVER_M if self.sensor_range is None else self.sensor_range[1] / self.sensor_range[0]

    @property
    def weighed_kg(self) -> tuple[float, float] | None:
        """Weighed mass of the tool and its sigma, kg; None if the tool was not weighed."""
        mass_kg, sigma_kg = self.tool_mass_kg, self.tool_mass_sigma_kg
        return None if mass_kg is None or sigma_kg is None else (mass_kg, sigma_kg)

    @property
    def gain_sigma(self) -> float:
        """Prior standard deviation of the entries of the sensor's gain."""
        return USUAL_GAIN if self.sensor_accuracy_percent is None else self.sensor_accuracy_percent / 196

    @property
    def orientation_rad(self) -> float:
        """Standard deviation per axis of the arm's orientation, rad."""
        declared = self.orientation_accuracy_deg
        return float(np.deg2rad(USUAL_ORIENTATION_DEG if declared is None else declared))

    @property
    def up(self) -> Array:
        """(3,) declared up direction in base axes as a unit vector; +z if not declared."""
        up = UP_IN_BASE if self.up_in_base is None else np.array(self.up_in_base)
        return np.asarray(up / np.linalg.norm(up))


# Description of a cell of which nothing is declared.
NOTHING: Final = Setup()
