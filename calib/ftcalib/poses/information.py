"""Predicted accuracy of a set of poses before any measurement, and sets that are known to be good.

The Fisher information of the model depends on the orientations, a guess of the tool, and the noise, but not on
readings. The best poses hardly depend on the guess; predictions in newtons and radians do. `ftcalib.poses.selection`
selects poses that an arm can reach.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import ArrayLike

from ftcalib.judge.observability import second_minimum
from ftcalib.known import NOTHING
from ftcalib.likelihood.rotation_minima import com_and_torque_bias, given_rotation
from ftcalib.likelihood.structure import hidden_columns
from ftcalib.model import (
    STANDARD_GRAVITY_M_S2,
    Array,
    Parameters,
    SPECIAL_R_flange_base,
    jacobian,
    predict,
    read_only,
    skew,
)
from ftcalib.sensor_matrix import SensorMatrix

# Eigenvalues of the scaled information below this share of the largest are taken as zero.
OBSERVABLE = 1e-9

TOOL_DOWN_R_base_flange = np.diag([1.0, -1.0, -1.0])

# Numbers of the tetrahedral subgroup of the paper's 24 orientations: as accurate per pose as all 24, for every tool.
T12 = (1, 2, 5, 6, 11, 12, 15, 16, 17, 18, 21, 22)
# Six of the 24 orientations, nearly the best six with a unique solution; second-basin gap 0.28.
SUBSET_6 = (9, 10, 16, 19, 21, 22)


@dataclass(frozen=True, slots=True, eq=False)
class Guess:
    """Expected tool, noise and base, with angles and offsets as in a calibration file."""

    mass_kg: float
    """Mass of the load on the sensor, kg."""
    sigma_force_N: float
    """Standard deviation of one force axis in the mean of one pose, N."""
    sigma_torque_Nm: float
    """Standard deviation of one torque axis in the mean of one pose, N·m."""
    p_sensor_com_m: ArrayLike = (0.0, 0.0, 0.08)
    R_flange_sensor: ArrayLike = field(default_factory=lambda: np.eye(3))
    tilt_alpha_rad: float = 0.0
    tilt_beta_rad: float = 0.0
    g_m_s2: float = STANDARD_GRAVITY_M_S2
    sensor: SensorMatrix | None = None
    """Prior of the errors of the sensor's matrix; None: a perfect sensor, predictions from noise alone."""
    orientation_rad: float = NOTHING.orientation_rad
    """Standard deviation per axis of the arm's orientation, rad."""

    def __post_init__(self) -> None:
        for name in ("mass_kg", "sigma_force_N", "sigma_torque_Nm", "g_m_s2"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}, expected a positive number")

    @property
    def gain_sigma(self) -> float:
        """Standard deviation of the gain of one axis of the sensor; 0 for a perfect sensor."""
        return 0.0 if self.sensor is None else float(self.sensor.sigma[0, 0])

    @property
    def weight_N(self) -> float:
        """Weight of the load, N."""
        return self.mass_kg * self.g_m_s2

    @property
    def parameters(self) -> Parameters:
        """Guessed parameters without bias, because the information does not depend on the bias."""
        alpha, beta = self.tilt_alpha_rad, self.tilt_beta_rad
        down = -np.array([np.cos(alpha) * np.sin(beta), -np.sin(alpha), np.cos(alpha) * np.cos(beta)])
        R_flange_sensor = np.asarray(self.R_flange_sensor, dtype=np.float64)
        p_sensor_com_m = np.asarray(self.p_sensor_com_m, dtype=np.float64)
        return Parameters(R_flange_sensor, self.weight_N * down, np.zeros(3), p_sensor_com_m, np.zeros(3))

    @property
    def scale(self) -> Array:
        """(15,) units that make the error coordinates comparable: 1 rad, weight, weight, lever, weight times lever.

        The lever is |P|, or the ratio of torque to force noise if that is longer.
        """
        lever_m = max(float(np.linalg.norm(self.p_sensor_com_m)), self.sigma_torque_Nm / self.sigma_force_N)
        return np.repeat([1.0, self.weight_N, self.weight_N, lever_m, self.weight_N * lever_m], 3)

    @property
    def wrench_sigma(self) -> Array:
        """(6,) standard deviations of the mean wrench of a pose, N and N·m."""
        return np.repeat([self.sigma_force_N, self.sigma_torque_Nm], 3)


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Expected accuracy of a calibration from given poses."""

    n_poses: int
    sigma: Mapping[str, Array | float]
    """Standard deviations, named as in `CalibrationResult.sigma`; infinite if not determined by the poses."""
    force_rms_N: float
    """Rms force error (norm) of the compensation over all orientations, N."""
    torque_rms_Nm: float
    """Rms torque error (norm) of the compensation over all orientations, N·m."""
    cond9: float
    """Condition number of the force equations with nine parameters: at best 1.22, fair above 4, poor above 8."""
    cond_u1: float
    """Condition number of gravity directions with a constant, for LROM: at best 1.7, fair above 8, poor above 25."""
    second_basin_gap: float
    """Gap to the second solution, from `second_basin`."""


def special(numbers: Sequence[int]) -> Array:
    """Return the orientations R_base_flange (n, 3, 3) with these numbers, 1 to 24, of the paper (Yu, eq. 14)."""
    return np.swapaxes(SPECIAL_R_flange_base[np.asarray(numbers) - 1], 1, 2)


def whitened_jacobian(R_base_flange: Array, guess: Guess) -> Array:
    """Return the Jacobian (n, 6, 15) in noise standard deviations per unit of `Guess.scale`."""
    return np.asarray(jacobian(guess.parameters, R_base_flange) * guess.scale / guess.wrench_sigma[:, None])


def predicted_sigma(R_base_flange: Array, guess: Guess) -> Prediction:
    """Return the predicted accuracy of a calibration from its poses (Cramér-Rao bound of the joint model).

    If the guess includes errors of the sensor, the sigmas include the hidden errors of sensor, arm and mounts.

    Parameters
    ----------
    R_base_flange : array, shape (n, 3, 3)

    Returns
    -------
    Prediction
    """
    R_base_flange = np.asarray(R_base_flange, dtype=np.float64)
    J = whitened_jacobian(R_base_flange, guess).reshape(-1, 15)
    variance = _Variance(J.T @ J, guess.scale)

    rows = np.concatenate([np.eye(15), _weight_and_tilt_rows(guess)])
    total = variance(rows)
    if guess.sensor is not None:
        columns = hidden_columns(guess.parameters, R_base_flange, R_base_flange.mean(axis=0), guess.orientation_rad)
        columns = (columns / guess.wrench_sigma[:, None]).reshape(len(J), -1)
        moved = guess.scale[:, None] * np.linalg.lstsq(J, columns)[0]
        hidden = guess.sensor.hidden_covariance(guess.parameters) + moved @ moved.T
        total = total + np.einsum("ki,ij,kj->k", rows, hidden, rows)
    std, (weight, alpha, beta) = np.sqrt(total[:15]), np.sqrt(total[15:]).tolist()
    everywhere = jacobian(guess.parameters, special(range(1, 25)))
    force, torque = (variance(everywhere[:, k].reshape(-1, 15)).sum() / 24 for k in (slice(3), slice(3, 6)))
    u = predict(guess.parameters, R_base_flange)[:, :3] / guess.weight_N
    return Prediction(
        n_poses=len(R_base_flange),
        sigma={
            **{each.name: read_only(part) for each, part in zip(fields(Parameters), std.reshape(5, 3), strict=True)},
            "weight_N": weight,
            "mass_kg": weight / guess.g_m_s2,
            "tilt_alpha_rad": min(alpha, float(np.pi)),
            "tilt_beta_rad": min(beta, float(np.pi)),
        },
        force_rms_N=float(np.sqrt(force)),
        torque_rms_Nm=float(np.sqrt(torque)),
        cond9=_condition(force_rows(R_base_flange, guess).reshape(-1, 9)),
        cond_u1=_condition(np.column_stack([u, np.ones(len(u))])),
        second_basin_gap=second_basin(R_base_flange, guess)[0],
    )


def prediction_weights(R_base_flange: Array, guess: Guess) -> tuple[Array, Array]:
    """Return matrices (15, 15) whose scalar product with a covariance is the mean square error over orientations.

    The error is in sigma_force_N² for force, in sigma_torque_Nm² for torque; the covariance in units of `Guess.scale`.
    """
    J = whitened_jacobian(R_base_flange, guess)
    force, torque = (np.einsum("nki,nkj->ij", rows, rows) / len(J) for rows in (J[:, :3], J[:, 3:]))
    return force, torque


def second_basin(R_base_flange: Array, guess: Guess) -> tuple[float, Parameters | None]:
    """Return the gap between the true mounting and the best other one, and that solution; None if there is no other.

    The gap is the residual sum of squares at the second minimum over the rotations, fitted to exact forces of the
    guessed tool, divided by n weight². It is 8/9 for the special 24, weak below 0.05, and 0 if exactly ambiguous (all
    tool axes at one angle to the vertical, or too few poses). The chi2 of the second solution is larger by
    gap n (weight / sigma_force_N)².
    """
    if len(R_base_flange) < 3:
        return 0.0, None  # the second solutions form a continuum: the gap is zero
    gap, other = second_minimum(R_base_flange, guess.parameters)
    if other is None:
        return gap, None
    wrench, R = predict(guess.parameters, R_base_flange), other.R
    gravity_N, bias_N = given_rotation(R, R_base_flange, wrench[:, :3], np.ones(len(wrench)))
    com_m, torque_bias_Nm = com_and_torque_bias(gravity_N @ R_base_flange @ R.T, wrench[:, 3:])
    return gap, Parameters(R.T, gravity_N, bias_N, com_m, torque_bias_Nm)


def force_rows(R_base_flange: Array, guess: Guess) -> Array:
    """Return the force equations (n, 3, 9) of rotation, weight and bias, divided by the weight: [-R [g]x, R A, 1]."""
    return np.asarray((jacobian(guess.parameters, R_base_flange) * guess.scale / guess.weight_N)[:, :3, :9])


class _Variance:
    """Variances of linear functions of the error coordinates; infinite if undetermined."""

    def __init__(self, information: Array, scale: Array) -> None:
        eigenvalues, V = np.linalg.eigh(information)
        observable = eigenvalues > OBSERVABLE * eigenvalues[-1]
        self._scale = scale
        self._root = V[:, observable] / np.sqrt(eigenvalues[observable])
        self._null = V[:, ~observable]

    def __call__(self, rows: Array) -> Array:
        """Return the variances (k,) of the products of rows (k, 15) and the error vector."""
        scaled = rows * self._scale
        blind = ((scaled @ self._null) ** 2).sum(axis=1) > OBSERVABLE * (scaled**2).sum(axis=1)
        return np.where(blind, np.inf, ((scaled @ self._root) ** 2).sum(axis=1))


def _weight_and_tilt_rows(guess: Guess) -> Array:
    """Return the derivatives (3, 15) of weight, alpha and beta with respect to the error coordinates."""
    F_b = guess.parameters.gravity_force_base_N
    turn = skew(F_b / guess.weight_N**2)  # small rotation of F_b: cross(F_b, dF_b) / weight²
    alpha, beta = guess.tilt_alpha_rad, guess.tilt_beta_rad
    axis_of_alpha = np.array([np.cos(beta), 0.0, -np.sin(beta)])
    rows = np.zeros((3, 15))
    rows[0, 3:6] = F_b / guess.weight_N
    rows[1, 3:6] = axis_of_alpha @ turn
    rows[2, 3:6] = np.array([0.0, 1.0, 0.0]) @ turn / max(np.cos(alpha) ** 2, OBSERVABLE)
    return rows


def _condition(M: Array) -> float:
    """Return the condition number of a matrix; infinite if it lacks full column rank."""
    singular = np.linalg.svd(M, compute_uv=False)
    if len(singular) < M.shape[1] or singular[-1] <= OBSERVABLE * singular[0]:
        return float("inf")
    return float(singular[0] / singular[-1])
