"""Forward model: the reading of a wrist-mounted sensor that carries a rigid tool at rest.

    force_N   = R_flange_sensor.T @ R_base_flange.T @ gravity_force_base_N + force_bias_N
    torque_Nm = p_sensor_com_m x (force_N - force_bias_N) + torque_bias_Nm

Source: Yu, Shi, Lou 2021, eqs 12-13, with e_bR = R_base_flange.T and s_eR = R_flange_sensor.T.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self, TypeAlias, cast

import numpy as np
import scipy  # submodules are imported at their first use, so that commands without them start fast
from numpy.typing import ArrayLike, NDArray

from ftcalib.display import Displayed

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

Rotations: TypeAlias = "Rotation | Sequence[Rotation] | ArrayLike"
"""Rotations as a user may pass them; `matrices_of` converts them to matrices."""

STANDARD_GRAVITY_M_S2 = 9.80665
ROUNDING = 2e-3  # rounding to three decimals moves an entry of R^T R by at most 1.8e-3
_IDENTITY = np.eye(3)
_YZX, _ZXY = np.array([1, 2, 0]), np.array([2, 0, 1])
UP_IN_BASE = np.array([0.0, 0.0, 1.0])
"""(3,) up direction in base axes of a robot on a table."""

_QUANTITIES = ("R_flange_sensor", "gravity_force_base_N", "force_bias_N", "p_sensor_com_m", "torque_bias_Nm")
PARAMETER_NAMES = tuple(f"{name}.{axis}" for name in _QUANTITIES for axis in "xyz")
"""Names of the 15 error coordinates, in the order of the Jacobian and of every covariance."""
BIASES = np.r_[6:9, 12:15]
"""Indices of force and torque bias in `PARAMETER_NAMES`."""

_CUBE = (
    "+x +y +z", "+x -y -z", "+x -z +y", "+x +z -y", "-x +y -z", "-x -y +z",
    "-x +z +y", "-x -z -y", "+y +x -z", "-y +x +z", "+z +x +y", "-z +x -y",
    "+y -x +z", "-y -x -z", "-z -x +y", "+z -x -y", "+y +z +x", "-y -z +x",
    "-z +y +x", "+z -y +x", "+y -z -x", "-y +z -x", "+z +y -x", "-z -y -x",
)  # fmt: skip
_AXES = dict(zip("xyz", np.eye(3), strict=True))
# (24, 3, 3) the paper's e_bR_1 … e_bR_24 (Fig. 3, Table of special orientations): the rotation group of the cube.
SPECIAL_R_flange_base = np.array([[float(row[0] + "1") * _AXES[row[1]] for row in rows.split()] for rows in _CUBE])


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Parameters(Displayed):
    """Estimated parameters of sensor and tool; arrays are read-only.

    Examples
    --------
    >>> import ftdrive
    >>> parameters = ftdrive.solve(ftdrive.read_dataset("poses.csv")).parameters
    >>> parameters.p_sensor_com_m.round(3)
    array([0.004, 0.002, 0.061])
    """

    R_flange_sensor: Array
    """(3, 3) mounting of the sensor: maps sensor coordinates to flange coordinates."""
    gravity_force_base_N: Array
    """(3,) weight of the load on the sensor, in base axes."""
    force_bias_N: Array
    """(3,) force bias in the sensor frame."""
    p_sensor_com_m: Array
    """(3,) centre of mass of the load in the sensor frame."""
    torque_bias_Nm: Array
    """(3,) torque bias in the sensor frame, about the sensor origin."""

    def __post_init__(self) -> None:
        for name in _QUANTITIES:
            shape = (3, 3) if name == "R_flange_sensor" else (3,)
            value = read_only(getattr(self, name))
            if value.shape != shape:
                raise ValueError(f"{name} has shape {value.shape}, expected {shape}")
            object.__setattr__(self, name, value)

    @property
    def weight_N(self) -> float:
        """Norm of the gravity force, N."""
        return float(np.linalg.norm(self.gravity_force_base_N))

    def weight_sigma_N(self, covariance: Array) -> float:
        """Return one standard deviation of the weight, N, from the covariance (15, 15) of the parameters."""
        variance = float(self.down @ covariance[3:6, 3:6] @ self.down)
        return float(np.sqrt(max(variance, 0.0)))  # a rounded variance may be negative if the weight is exactly known

    @property
    def down(self) -> Array:
        """(3,) unit vector along the gravity force in base axes; zero without a weight."""
        return np.asarray(self.gravity_force_base_N / (self.weight_N or 1.0))

    @property
    def bias(self) -> Array:
        """(6,) bias of force and torque, N and N·m."""
        return np.concatenate([self.force_bias_N, self.torque_bias_Nm])

    def moved(self, step: Array) -> Self:
        """Return the parameters after an error vector.

        Parameters
        ----------
        step : array, shape (15,)
            Error vector in the order of `PARAMETER_NAMES`. The first three entries are a small rotation vector delta in
            rad about the flange axes: s_eR <- s_eR exp([delta]x), R_flange_sensor <- exp([delta]x).T R_flange_sensor.
        """
        return type(self)(
            rotation_of(-step[:3]) @ self.R_flange_sensor,
            self.gravity_force_base_N + step[3:6],
            self.force_bias_N + step[6:9],
            self.p_sensor_com_m + step[9:12],
            self.torque_bias_Nm + step[12:15],
        )

    def difference(self, other: Self) -> Array:
        """Return the error vector (15,) for which `moved` returns `other`."""
        turn = scipy.spatial.transform.Rotation.from_matrix(self.R_flange_sensor @ other.R_flange_sensor.T)
        return np.concatenate(
            [
                turn.as_rotvec(),
                other.gravity_force_base_N - self.gravity_force_base_N,
                other.force_bias_N - self.force_bias_N,
                other.p_sensor_com_m - self.p_sensor_com_m,
                other.torque_bias_Nm - self.torque_bias_Nm,
            ]
        )


def cross(a: Array, b: Array) -> Array:
    """Return the cross product of vectors (..., 3), faster than `numpy.cross` for few vectors."""
    return a.take(_YZX, -1) * b.take(_ZXY, -1) - a.take(_ZXY, -1) * b.take(_YZX, -1)


def gravity_wrench(parameters: Parameters, R_base_flange: Array) -> Array:
    """Return the wrench of the weight alone, without bias.

    Parameters
    ----------
    R_base_flange : array, shape (..., 3, 3)

    Returns
    -------
    array, shape (..., 6)
        Wrench on the sensor, N and N·m, in the sensor frame, about the sensor origin.
    """
    R_base_sensor = R_base_flange @ parameters.R_flange_sensor
    force_N = parameters.gravity_force_base_N @ R_base_sensor  # a row vector times R equals R.T times the vector
    torque_Nm = cross(parameters.p_sensor_com_m, force_N)
    return np.asarray(np.concatenate([force_N, torque_Nm], axis=-1))


def predict(parameters: Parameters, R_base_flange: Rotations) -> Array:
    """Return the wrench that the sensor reads without contact: weight and bias, Yu eqs 12-13.

    Parameters
    ----------
    parameters : Parameters
    R_base_flange : array, shape (..., 3, 3), or Rotation
        Maps flange coordinates to base coordinates.

    Returns
    -------
    array, shape (..., 6)
        N and N·m, in the sensor frame, about the sensor origin.

    Examples
    --------
    1 kg below a sensor whose z axis points down:

    >>> import ftcalib
    >>> from scipy.spatial.transform import Rotation
    >>> parameters = ftcalib.Parameters(
    ...     R_flange_sensor=[[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    ...     gravity_force_base_N=[0, 0, -9.80665],
    ...     force_bias_N=[0, 0, 0],
    ...     p_sensor_com_m=[0, 0, 0.05],
    ...     torque_bias_Nm=[0, 0, 0],
    ... )
    >>> ftcalib.predict(parameters, Rotation.from_euler("x", 180, degrees=True)).round(3) + 0.0
    array([0.   , 0.   , 9.807, 0.   , 0.   , 0.   ])
    """
    R_base_flange = matrices_of(R_base_flange)
    return np.asarray(gravity_wrench(parameters, R_base_flange) + parameters.bias)


def jacobian(parameters: Parameters, R_base_flange: Array) -> Array:
    """Return the derivative of `predict` with respect to the error vector of `Parameters.moved`.

    With R = s_eR, A = e_bR, g = A F_b and u = R g:  dF = -R [g]x delta + R A dF_b + dF0,
    dT = [P]x (dF - dF0) - [u]x dP + dT0.

    Parameters
    ----------
    R_base_flange : array, shape (..., 3, 3)

    Returns
    -------
    array, shape (..., 6, 15)
        Columns in the order of `PARAMETER_NAMES`.
    """
    R_sensor_flange = parameters.R_flange_sensor.T
    gravity_flange_N = parameters.gravity_force_base_N @ R_base_flange
    P = skew(parameters.p_sensor_com_m)
    J = np.zeros((*R_base_flange.shape[:-2], 6, 15))
    J[..., :3, 0:3] = -R_sensor_flange @ skew(gravity_flange_N)
    J[..., :3, 3:6] = R_sensor_flange @ np.swapaxes(R_base_flange, -1, -2)
    J[..., :3, 6:9] = np.eye(3)
    J[..., 3:, 0:6] = P @ J[..., :3, 0:6]
    J[..., 3:, 9:12] = -skew(gravity_flange_N @ parameters.R_flange_sensor)
    J[..., 3:, 12:15] = np.eye(3)
    return J


def matrices_of(rotations: Rotations) -> NDArray[Any]:
    """Return the matrices (..., 3, 3) of rotations."""
    if hasattr(rotations, "as_matrix"):
        return np.asarray(rotations.as_matrix())
    if isinstance(rotations, Sequence) and rotations and hasattr(rotations[0], "as_matrix"):
        return np.stack([rotation.as_matrix() for rotation in cast("Sequence[Rotation]", rotations)])
    return np.asarray(rotations)


def skew(v: Array) -> Array:
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3): skew(a) @ b = a x b."""
    if v.ndim == 1:  # a single vector, the usual case: four times faster
        x, y, z = v.tolist()
        return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix = np.zeros((*v.shape[:-1], 3, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return matrix - np.swapaxes(matrix, -1, -2)


def rotation_of(vector: Array) -> Array:
    """Return the rotation matrix of a rotation vector (3,), ten times faster than scipy."""
    angle = math.sqrt(float(vector @ vector))
    K = skew(vector)
    if angle < 1e-4:  # the closed form loses digits at small angles, the series does not
        return np.asarray(_IDENTITY + (1 - angle**2 / 6) * K + (0.5 - angle**2 / 24) * (K @ K))
    return np.asarray(_IDENTITY + math.sin(angle) / angle * K + (1 - math.cos(angle)) / angle**2 * (K @ K))


def weight_and_tilt(F_b: Array) -> tuple[float, float, float]:
    """Return weight (N) and tilt angles alpha, beta (rad) of the base for a gravity force (3,): Yu eqs 46-48.

    Two misprints of eq 48 are corrected: the weight is the norm of F_b, not its square, and the angles satisfy
    F_b = -weight [cos(alpha) sin(beta), -sin(alpha), cos(alpha) cos(beta)], with alpha in [-pi/2, pi/2]. An upright
    base has (0, 0), a base on the ceiling (0, pi). If gravity is along base y, beta is undetermined and set to 0.
    """
    x, y, z = F_b.tolist()
    beta = np.arctan2(0.0 - x, 0.0 - z) if x or z else 0.0  # 0 - x instead of -x: a negative zero would turn pi to -pi
    return float(np.linalg.norm(F_b)), float(np.arctan2(y, np.hypot(x, z))), float(beta)


def angle_between(R1: Array, R2: Array) -> Array:
    """Return the angles (...) in rad between rotations (..., 3, 3); accurate also for small angles."""
    # Computed from the chord, because the trace loses half of the digits of small angles.
    chord = np.linalg.norm(np.asarray(R1) - R2, axis=(-2, -1)) / math.sqrt(8)
    return np.asarray(2 * np.arcsin(np.minimum(chord, 1.0)))


def angle_between_vectors(a: Array, b: Array) -> float:
    """Return the angle in rad between two vectors (3,) of any length; accurate also for small angles."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def nearest_rotation(M: Array) -> Array:
    """Return the rotations closest to the matrices M (..., 3, 3) in the Frobenius norm: U diag(1, 1, ±1) V^T."""
    U, _, Vt = np.linalg.svd(M)
    U[..., :, 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    return np.asarray(U @ Vt)


def is_rotation(R: Array) -> bool:
    """Return whether a matrix is a rotation (3, 3); its entries may be rounded to three decimals."""
    return R.shape == (3, 3) and bool(np.abs(R.T @ R - np.eye(3)).max() < ROUNDING and np.linalg.det(R) > 0)


def read_only(value: ArrayLike) -> Array:
    """Return a read-only float64 copy of an array."""
    array = np.array(value, dtype=np.float64)
    array.setflags(write=False)
    return array


def keep_finite(record: object, whose: str, **shapes: tuple[int, ...]) -> None:
    """Replace arrays of a frozen record by read-only copies; raise `ValueError` for a wrong shape, NaN or inf."""
    for name, shape in shapes.items():
        value = read_only(getattr(record, name))
        if value.shape != shape or not np.isfinite(value).all():
            size = shape if len(shape) > 1 else shape[0]
            raise ValueError(f"{whose}{name} must be {size} finite numbers, got shape {value.shape}")
        object.__setattr__(record, name, value)


@dataclass(frozen=True, slots=True, eq=False)
class DriftResult:
    """Drift of the bias during the session; arrays are read-only."""

    change: Array
    """(6,) bias at the last pose minus bias at the first, N and N·m."""
    sigma: Array
    """(6,) one standard deviation of `change`."""
    course: Array | None = None
    """(n, 6) bias of each pose minus the mean bias, in the order of measurement; None in a calibration result."""

    def __post_init__(self) -> None:
        keep_finite(self, "the drift's ", change=(6,), sigma=(6,))
