"""Compensation subtracts weight and bias: one sample in about a microsecond, a recording at memory bandwidth.

For given parameters the expected wrench is affine in the nine entries of R_base_flange, so the contact wrench is

    contact = wrench - matrix @ vec(R_base_flange) - offset        vec: row by row

which equals `wrench - predict(parameters, R_base_flange)` of `ftcalib.model`, with all constants computed once. If the
errors of the sensor's matrix are known, the result is multiplied by a constant decoder matrix.

For a tool in motion `inertial_wrench` returns the wrench due to acceleration.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, DTypeLike, NDArray

from ftcalib.model import Array, Parameters, Rotations, matrices_of, read_only, skew
from ftcalib.sensor_matrix import Response, shown_gain

Reals = NDArray[np.floating[Any]]


# Number of rows per matrix product, small enough that input and output stay in the cache.
CHUNK_ROWS = 8192


class Compensator:
    """Compensation with the parameters of one calibration.

    Parameters
    ----------
    parameters : Parameters
    dtype : float64 (default) or float32
        Type of the arithmetic and of the result. float32 halves the memory traffic, with a relative error of 1e-7.
    response : Response, optional
        Gain and cross-talk of the sensor for the weight of the tool.
    decoder : array, shape (6, 6), optional
        Converts readings minus the free-tool wrench to contact wrenches, see `ContactResponse.decoder`.

    Attributes
    ----------
    matrix : array, shape (6, 9)
        Derivative of the wrench with respect to the entries of R_base_flange, N and N·m.
    offset : array, shape (6,)
        Bias, N and N·m.
    decoder : array, shape (6, 6), or None

    Notes
    -----
    Instances are not modified after construction, so threads may share them.

    Examples
    --------
    >>> import ftcalib, ftdrive, numpy as np
    >>> calibration = ftdrive.solve(ftdrive.read_dataset("poses.csv"))
    >>> compensate = ftcalib.Compensator(calibration.parameters, response=calibration.response)
    >>> free = ftcalib.predict(calibration.parameters, np.eye(3))
    >>> bool(np.abs(compensate(free, np.eye(3))).max() < 0.01)
    True
    """

    def __init__(
        self,
        parameters: Parameters,
        dtype: DTypeLike = np.float64,
        *,
        response: Response | None = None,
        decoder: Array | None = None,
    ) -> None:
        self.dtype: np.dtype[Any] = np.dtype(dtype)
        if self.dtype not in (np.float64, np.float32):
            raise TypeError(f"dtype is {self.dtype}, expected float64 or float32")
        by_force = np.einsum("i,jk->kij", parameters.gravity_force_base_N, parameters.R_flange_sensor).reshape(3, 9)
        matrix = np.concatenate([by_force, skew(parameters.p_sensor_com_m) @ by_force])
        matrix += shown_gain(response) @ by_force
        offset = parameters.bias
        self.matrix: Reals = matrix.astype(self.dtype)
        self.offset: Reals = offset.astype(self.dtype)
        self.matrix.setflags(write=False)
        self.offset.setflags(write=False)
        self._offsets: Reals = np.tile(self.offset, (CHUNK_ROWS, 1))  # numpy broadcasts a single row slowly
        # One sample is a single product with (wrench, vec(R_base_flange), 1).
        product = np.concatenate([np.eye(6), -matrix, -offset[:, None]], axis=1)
        self.decoder: Reals | None = None if decoder is None else read_only(decoder).astype(self.dtype)
        self._product = (product if decoder is None else decoder @ product).astype(self.dtype).dot
        self._operand: Reals = np.zeros(16, self.dtype)
        self._operand[15] = 1

    def __call__(self, wrench: ArrayLike, R_base_flange: Rotations) -> Reals:
        """Compensate one sample or many, with all checks; `sample` and `batch` are faster.

        Parameters
        ----------
        wrench : array, shape (6,) or (n, 6)
            As measured, N and N·m, in the sensor frame.
        R_base_flange : array, shape (3, 3) or (n, 3, 3), or Rotation

        Returns
        -------
        array, same shape as `wrench`
            Contact wrench on the sensor, in the sensor frame, about the sensor origin.
        """
        wrench, R_base_flange = np.asarray(wrench), matrices_of(R_base_flange)
        _check_shapes(wrench, R_base_flange)
        return self.sample(wrench, R_base_flange) if wrench.ndim == 1 else self.batch(wrench, R_base_flange)

    def sample(self, wrench: Reals, R_base_flange: Reals, out: Reals | None = None) -> Reals:
        """Compensate one sample, for fast loops. Shapes are checked only as far as numpy needs them.

        Parameters
        ----------
        wrench : array, shape (6,)
            As measured, N and N·m, in the sensor frame. A NaN in any channel makes all six NaN.
        R_base_flange : array, shape (3, 3)
        out : array, shape (6,), optional
            Buffer for the result, may be `wrench` itself; of the type of the compensator. Default: a new array.

        Returns
        -------
        array, shape (6,)
            Contact wrench on the sensor, in the sensor frame, about the sensor origin.
        """
        operand = self._operand.copy()
        operand[:6] = wrench
        operand[6:15] = R_base_flange.ravel()
        return self._product(operand, out)

    def batch(self, wrench: Reals, R_base_flange: Reals, out: Reals | None = None) -> Reals:
        """Compensate a recording.

        Parameters
        ----------
        wrench : array, shape (n, 6)
            As measured, N and N·m, in the sensor frame.
        R_base_flange : array, shape (n, 3, 3)
            Arrays of another type than the compensator are converted first.
        out : array, shape (n, 6), optional
            Buffer for the result, may be `wrench` itself; of the type of the compensator. Default: a new array.

        Returns
        -------
        array, shape (n, 6)
            Contact wrenches on the sensor, in the sensor frame, about the sensor origin.
        """
        wrench, R_base_flange = np.asarray(wrench, self.dtype), np.asarray(R_base_flange, self.dtype)
        _check_shapes(wrench, R_base_flange)
        if wrench.ndim != 2:
            raise ValueError(f"wrench has shape {wrench.shape}, expected (n, 6): use `sample` for a single wrench.")
        if out is not None and (out.shape != wrench.shape or out.dtype != self.dtype):
            raise ValueError(f"out is {out.dtype} {out.shape}, expected {self.dtype} {wrench.shape}")
        contact = np.empty_like(wrench) if out is None else out
        entries = R_base_flange.reshape(-1, 9)
        for start in range(0, len(contact), CHUNK_ROWS):
            rows = slice(start, start + CHUNK_ROWS)
            np.subtract(wrench[rows], entries[rows] @ self.matrix.T, contact[rows])
            contact[rows] -= self._offsets[: len(contact[rows])]
            if self.decoder is not None:
                contact[rows] = contact[rows] @ self.decoder.T
        return contact


def _check_shapes(wrench: Reals, R_base_flange: Reals) -> None:
    if wrench.shape[-1:] != (6,) or wrench.ndim > 2 or R_base_flange.shape != (*wrench.shape[:-1], 3, 3):
        raise ValueError(
            f"wrench has shape {wrench.shape} and R_base_flange {R_base_flange.shape}: "
            "expected (6,) with (3, 3), or (n, 6) with (n, 3, 3)"
        )


class SensorMotion(NamedTuple):
    """Motion of flange and sensor relative to the base, n samples."""

    t_s: Array
    """(n,) increasing times, s."""
    R_base_flange: Array
    """(n, 3, 3) orientations of the flange."""
    angular_velocity_rad_s: Array
    """(n, 3) angular velocity of the flange, in sensor axes."""
    angular_acceleration_rad_s2: Array
    """(n, 3) angular acceleration of the flange, in sensor axes."""
    linear_acceleration_m_s2: Array
    """(n, 3) acceleration of the sensor origin, in sensor axes, without gravity."""


def motion_of_poses(
    t_s: Array,
    R_base_flange: Array,
    p_base_flange_m: Array,
    *,
    R_flange_sensor: Array,
    p_flange_sensor_m: Array,
    reach: int,
) -> SensorMotion:
    """Return velocities and accelerations of poses, from a quadratic fit to the neighbours of each pose.

    The position and the rotation vector of the neighbours relative to the pose are fitted.

    Parameters
    ----------
    t_s : array, shape (n,)
        Increasing times, at any spacing.
    R_base_flange : array, shape (n, 3, 3)
    p_base_flange_m : array, shape (n, 3)
    R_flange_sensor : array, shape (3, 3)
    p_flange_sensor_m : array, shape (3,)
        Origin of the sensor, in flange axes.
    reach : int
        Number of neighbours on each side. The first and last `reach` poses have too few and are left out.

    Returns
    -------
    SensorMotion
        Motion at n - 2 reach poses.
    """
    size, inner = 2 * reach + 1, slice(reach, len(t_s) - reach)

    def around(columns: Array) -> Array:
        """Return the neighbours (m, size, k) of each inner row of columns (n, k)."""
        return np.swapaxes(sliding_window_view(columns, size, axis=0), 1, 2)

    t, R = t_s[inner], R_base_flange[inner]
    tau = around(t_s[:, None])[..., 0] - t[:, None]
    turned = np.swapaxes(R, -1, -2)[:, None] @ around(R_base_flange.reshape(-1, 9)).reshape(-1, size, 3, 3)
    sines = np.stack([turned[..., i, j] - turned[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=-1) / 2
    sine = np.maximum(np.linalg.norm(sines, axis=-1, keepdims=True), 1e-12)
    rotvec = sines * np.arcsin(np.minimum(sine, 1.0)) / sine
    moved = (around(p_base_flange_m) - p_base_flange_m[inner][:, None]) @ R  # in flange axes
    powers = np.stack([np.ones_like(tau), tau, tau**2 / 2], axis=1)  # (m, 3, size)
    fit = np.linalg.solve(powers @ np.swapaxes(powers, 1, 2), powers @ np.concatenate([rotvec, moved], axis=2))
    omega, alpha, acceleration = fit[:, 1, :3], fit[:, 2, :3], fit[:, 2, 3:]
    W = skew(omega)
    acceleration = acceleration + (skew(alpha) + W @ W) @ p_flange_sensor_m
    return SensorMotion(t, R, omega @ R_flange_sensor, alpha @ R_flange_sensor, acceleration @ R_flange_sensor)


def inertial_wrench(
    mass_kg: float, p_sensor_com_m: Array, motion: SensorMotion, inertia_com_kg_m2: Array | None = None
) -> Array:
    """Return the inertial wrench (n, 6) of a moving load on the sensor, without weight, N and N·m, in the sensor frame.

    With the acceleration a of the sensor origin and the inertia I about that origin, all in the sensor frame,

        force_N   = -m a - alpha x (m p) - omega x (omega x (m p))
        torque_Nm = -(m p) x a - I alpha - omega x (I omega)

    as in D. Kubus, T. Kröger, F. M. Wahl, "On-line estimation of inertial parameters using a recursive total
    least-squares approach", IROS 2008.

    Parameters
    ----------
    p_sensor_com_m : array, shape (3,)
    inertia_com_kg_m2 : array, shape (3, 3), optional
        Inertia about the centre of mass, in sensor axes. Default: a point mass.
    """
    I_com = np.zeros((3, 3)) if inertia_com_kg_m2 is None else inertia_com_kg_m2
    P = skew(p_sensor_com_m)
    I_origin = I_com - mass_kg * P @ P
    omega, alpha = motion.angular_velocity_rad_s, motion.angular_acceleration_rad_s2
    lever = np.cross(alpha, p_sensor_com_m) + np.cross(omega, np.cross(omega, p_sensor_com_m))
    force_N = -mass_kg * (motion.linear_acceleration_m_s2 + lever)
    torque_Nm = -mass_kg * np.cross(p_sensor_com_m, motion.linear_acceleration_m_s2)
    torque_Nm -= alpha @ I_origin + np.cross(omega, omega @ I_origin)
    return np.concatenate([force_N, torque_Nm], axis=1)


class MovedLoad:
    """Load moved by the arm: its motion and inertial wrench from poses, with `reach` neighbours on each side."""

    def __init__(self, parameters: Parameters, g_m_s2: float, p_flange_sensor_m: Array, reach: int) -> None:
        self._mass_kg = float(np.linalg.norm(parameters.gravity_force_base_N)) / g_m_s2
        self._parameters, self._p_flange_sensor_m, self._reach = parameters, p_flange_sensor_m, reach

    def motion(self, t_s: Array, R_base_flange: Array, p_base_flange_m: Array) -> SensorMotion:
        """Return the motion at the poses with enough neighbours; an unknown position (NaN) is taken as constant."""
        return motion_of_poses(
            t_s,
            R_base_flange,
            np.nan_to_num(p_base_flange_m),
            R_flange_sensor=self._parameters.R_flange_sensor,
            p_flange_sensor_m=self._p_flange_sensor_m,
            reach=self._reach,
        )

    def wrench(self, motion: SensorMotion, inertia_kg_m2: Array | None = None) -> Array:
        """Return the inertial wrench (m, 6) of a motion; without an inertia the load is a point mass."""
        return inertial_wrench(self._mass_kg, self._parameters.p_sensor_com_m, motion, inertia_kg_m2)
