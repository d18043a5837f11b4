"""Ten inertial parameters of a load from a recording in motion: mass, centre of mass, inertia.

With s = gravity minus the acceleration of the sensor origin, all in the sensor frame, and the inertia I about that
origin, the load exerts on the sensor

    force_N   = m s - alpha x (m p) - omega x (omega x (m p))
    torque_Nm = (m p) x s - I alpha - omega x (I omega)

which is linear in m, m p and I; biases are estimated beside them. The model is that of D. Kubus, T. Kröger, F. M. Wahl,
"On-line estimation of inertial parameters using a recursive total least-squares approach", IROS 2008; the estimator is
weighted least squares.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from calib.data.dataset import finite
from calib.errors import BadDataset, NotObservable
from calib.model import Array, Parameters, read_only, skew

REACH_S = 0.01
"""Half the time over which `motion_of_poses` fits: the acceleration of trapezoidal moves keeps its edges."""

INERTIA_NAMES = (
    *("mass_kg", "p_sensor_com_m.x", "p_sensor_com_m.y", "p_sensor_com_m.z"),
    *(f"inertia_com_kg_m2.{axes}" for axes in ("xx", "yy", "zz", "xy", "xz", "yz")),
)
"""The order of the covariance."""

LEAST_SAMPLES = 100
LEAST_ROTATION_RAD_S2 = 0.1  # angular acceleration, rms, about the weakest axis
LEAST_SHARE = 0.1  # weakest over strongest axis: less may be noise of differentiated angles
RANK_TOLERANCE = 1e-8  # of eigenvalues of the Fisher information, columns scaled
LEVER_M = 0.025  # usual ratio of torque noise to force noise, to start with
DELAY_GRID = 21
DELAY_STEP_S = 1e-4  # for the derivative by the delay

GROUPS = (("mass", 0, 1), ("centre of mass", 1, 4), ("inertia", 4, 10), ("force bias", 10, 13), ("torque bias", 13, 16))


class Motion(NamedTuple):
    """Motion of the flange and the sensor against the base, n samples."""

    t_s: Array
    """(n,) increasing."""
    R_base_flange: Array
    """(n, 3, 3)"""
    angular_velocity_rad_s: Array
    """(n, 3) of the flange, in sensor axes."""
    angular_acceleration_rad_s2: Array
    """(n, 3) of the flange, in sensor axes."""
    linear_acceleration_m_s2: Array
    """(n, 3) of the sensor origin, in sensor axes, gravity not included."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadInertia:
    """The load on the sensor, in the sensor frame."""

    mass_kg: float
    p_sensor_com_m: Array
    """(3,) centre of mass."""
    inertia_com_kg_m2: Array
    """(3, 3) about the centre of mass, in sensor axes."""
    bias: Array
    """(6,) N and N·m."""
    delay_s: float
    """Delay of the wrench after the motion; 0 if not estimated."""
    delay_sigma_s: float
    """One standard deviation; 0 if not estimated."""
    covariance: Array
    """(10, 10) in the order of `INERTIA_NAMES`, for residuals that are uncorrelated in time."""
    residual_rms_N: float
    """Per axis."""
    residual_rms_Nm: float
    """Per axis."""

    @property
    def sigma(self) -> dict[str, float]:
        """One standard deviation by name."""
        return dict(zip(INERTIA_NAMES, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def implausibilities(self) -> tuple[str, ...]:
        """Sentences about values that no rigid body can have; empty if plausible."""
        found = []
        if self.mass_kg <= 0:
            found.append(f"the mass is {self.mass_kg:.3g} kg: check the sign of the wrench")
        moments = np.linalg.eigvalsh(self.inertia_com_kg_m2)
        listed = ", ".join(f"{moment:.3g}" for moment in moments)
        if moments[0] <= 0:
            found.append(f"the principal moments {listed} kg·m² are not all positive: move faster about all axes")
        elif moments[0] + moments[1] < moments[2]:
            found.append(
                f"of the principal moments {listed} kg·m² the largest exceeds the sum of the others, which is "
                "impossible: move faster about all axes"
            )
        return tuple(found)


def motion_of_poses(
    t_s: Array,
    R_base_flange: Array,
    p_base_flange_m: Array,
    *,
    R_flange_sensor: Array,
    p_flange_sensor_m: Array,
    reach: int,
) -> Motion:
    """Differentiate n poses twice: at each, a quadratic is fitted to position and rotation vector of its neighbours.

    Parameters
    ----------
    t_s : array, shape (n,)
        Increasing, at any spacing.
    R_base_flange : array, shape (n, 3, 3)
    p_base_flange_m : array, shape (n, 3)
    R_flange_sensor : array, shape (3, 3)
    p_flange_sensor_m : array, shape (3,)
        Origin of the sensor.
    reach : int
        Neighbours on each side; the first and last `reach` poses have too few and are left out.

    Returns
    -------
    Motion
        Of n - 2 reach poses.
    """
    size, inner = 2 * reach + 1, slice(reach, len(t_s) - reach)

    def around(columns: Array) -> Array:
        """Neighbours (m, size, k) of each inner row of (n, k)."""
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
    return Motion(t, R, omega @ R_flange_sensor, alpha @ R_flange_sensor, acceleration @ R_flange_sensor)


def inertial_wrench(
    mass_kg: float, p_sensor_com_m: Array, motion: Motion, inertia_com_kg_m2: Array | None = None
) -> Array:
    """Wrench (n, 6) that the motion of a load exerts on the sensor beside its weight, N and N·m, in the sensor frame.

    Parameters
    ----------
    mass_kg : float
    p_sensor_com_m : array, shape (3,)
    motion : Motion
    inertia_com_kg_m2 : array, shape (3, 3), optional
        About the centre of mass, in sensor axes. Without it the load counts as a point.
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


def estimate_inertia(
    parameters: Parameters, motion: Motion, wrench: ArrayLike, *, g_m_s2: float, most_delay_s: float = 0.0
) -> LoadInertia:
    """Estimate mass, centre of mass and inertia.

    Force and torque are weighted by their residuals, one standard deviation for each kind.

    Parameters
    ----------
    parameters : Parameters
        An ordinary calibration: its `R_flange_sensor` and the direction of its gravity are used.
    motion : Motion
        100 samples or more.
    wrench : array, shape (n, 6)
        As measured, N and N·m, in the sensor frame.
    g_m_s2 : float
        Gravity.
    most_delay_s : float
        Estimate the delay of the wrench after the motion, up to this much in either direction. 0 assumes none; an
        ignored delay of 5 ms already costs more than the noise of a good sensor.

    Raises
    ------
    BadDataset
        Shapes that do not fit each other, or times that do not increase.
    NotObservable
        The motion does not excite all ten parameters; the message names what is missing.
    """
    n = len(motion.t_s)
    shapes = (n,), (n, 3, 3), (n, 3), (n, 3), (n, 3)
    arrays = (finite(name, value, shape) for (name, value), shape in zip(motion._asdict().items(), shapes, strict=True))
    t_s, R_base_flange, omega, alpha, acceleration = arrays
    wrench = finite("wrench", wrench, (n, 6))
    if n < LEAST_SAMPLES or not (np.diff(t_s) > 0).all():
        raise BadDataset(f"t_s has {n} times, expected {LEAST_SAMPLES} or more, each later than the one before.")
    if not 0 <= most_delay_s < (t_s[-1] - t_s[0]) / 4:
        raise ValueError(f"most_delay_s is {most_delay_s}, expected 0 to a quarter of the recording.")
    weight_N = float(np.linalg.norm(parameters.gravity_force_base_N))
    if weight_N == 0:
        raise NotObservable("the calibration has no weight, so the direction of gravity is unknown: calibrate first.")
    _require_rotation(alpha)

    gravity = g_m_s2 / weight_N * parameters.gravity_force_base_N @ (R_base_flange @ parameters.R_flange_sensor)
    signals = np.concatenate([gravity - acceleration, alpha, omega], axis=1)
    fit = _Fit(t_s, signals, wrench, most_delay_s)
    delay_s = fit.best_delay(most_delay_s) if most_delay_s > 0 else 0.0
    phi, residual, sigma = fit.solve(delay_s)

    Y = fit.design(delay_s)
    if most_delay_s > 0:
        by_delay = (fit.design(delay_s + DELAY_STEP_S) - fit.design(delay_s - DELAY_STEP_S)) @ phi / (2 * DELAY_STEP_S)
        Y = np.concatenate([Y, by_delay[..., None]], axis=2)
    Y = (Y / sigma[:, None]).reshape(-1, Y.shape[2])
    full = np.linalg.inv(Y.T @ Y)
    # The derivative of the result by the ten linear parameters, by complex steps: exact.
    D = np.array([_physical(phi[:10] + 1e-30j * e).imag / 1e-30 for e in np.eye(10)]).T
    x = _physical(phi[:10])
    rms = np.sqrt((residual**2).reshape(-1, 2, 3).mean(axis=(0, 2)))
    return LoadInertia(
        mass_kg=float(x[0]),
        p_sensor_com_m=read_only(x[1:4]),
        inertia_com_kg_m2=read_only(_symmetric(x[4:])),
        bias=read_only(phi[10:]),
        delay_s=delay_s,
        delay_sigma_s=float(np.sqrt(full[16, 16])) if most_delay_s > 0 else 0.0,
        covariance=read_only(D @ full[:10, :10] @ D.T),
        residual_rms_N=float(rms[0]),
        residual_rms_Nm=float(rms[1]),
    )


class _Fit:
    """Least squares for a given delay; all delays use the same samples."""

    def __init__(self, t_s: Array, signals: Array, wrench: Array, most_delay_s: float) -> None:
        margin_s = most_delay_s + DELAY_STEP_S if most_delay_s > 0 else 0.0
        inside = (t_s >= t_s[0] + margin_s) & (t_s <= t_s[-1] - margin_s)
        self._t_s, self._wrench = t_s[inside], wrench[inside]
        self._signals, self._at = signals, CubicSpline(t_s, signals) if most_delay_s > 0 else None

    def design(self, delay_s: float) -> Array:
        """Regressor (n, 6, 16) of a wrench `delay_s` after the motion."""
        return regressor(self._at(self._t_s - delay_s) if self._at else self._signals)

    def solve(self, delay_s: float) -> tuple[Array, Array, Array]:
        """Estimates (16,), residuals (n, 6) and noise (6,)."""
        Y = self.design(delay_s)
        force, torque = Y[:, :3].reshape(-1, 16), Y[:, 3:].reshape(-1, 16)
        y_force, y_torque = self._wrench[:, :3].ravel(), self._wrench[:, 3:].ravel()
        parts = force.T @ force, torque.T @ torque, force.T @ y_force, torque.T @ y_torque
        least = 1e-12 * np.abs(self._wrench).max()
        sigma_N, sigma_Nm = 1.0, LEVER_M
        for _ in range(4):
            information = parts[0] / sigma_N**2 + parts[1] / sigma_Nm**2
            phi = _solve(information, parts[2] / sigma_N**2 + parts[3] / sigma_Nm**2)
            e_force, e_torque = y_force - force @ phi, y_torque - torque @ phi
            dof = len(e_force) - 8  # half of the 16
            sigma_N = max(float(np.sqrt(e_force @ e_force / dof)), least)
            sigma_Nm = max(float(np.sqrt(e_torque @ e_torque / dof)), LEVER_M * least)
        residual = np.concatenate([e_force.reshape(-1, 3), e_torque.reshape(-1, 3)], axis=1)
        return phi, residual, np.repeat([sigma_N, sigma_Nm], 3)

    def best_delay(self, most_delay_s: float) -> float:
        """Maximise the profile likelihood, first on a grid, because it may have several maxima."""

        def cost(delay_s: float) -> float:
            return float(np.log(self.solve(delay_s)[2]).sum())

        grid = np.linspace(-most_delay_s, most_delay_s, DELAY_GRID)
        i = int(np.argmin([cost(delay_s) for delay_s in grid.tolist()]))
        if i in (0, DELAY_GRID - 1):
            raise NotObservable(
                f"no delay within {1e3 * most_delay_s:g} ms fits best: increase most_delay_s, or check the clocks."
            )
        found = minimize_scalar(cost, bounds=(grid[i - 1], grid[i + 1]), method="bounded", options={"xatol": 1e-7})
        return float(found.x)


def regressor(signals: Array) -> Array:
    """Derivative of the wrench by mass, mass times centre of mass, inertia about the sensor origin, and biases.

    Parameters
    ----------
    signals : array, shape (n, 9)
        Gravity minus linear acceleration, angular acceleration, angular velocity; in the sensor frame.

    Returns
    -------
    array, shape (n, 6, 16)
        Inertia in the order xx, yy, zz, xy, xz, yz.
    """
    s, alpha, omega = signals[:, :3], signals[:, 3:6], signals[:, 6:]
    W = skew(omega)
    Y = np.zeros((len(signals), 6, 16))
    Y[:, :3, 0] = s
    Y[:, :3, 1:4] = -skew(alpha) - W @ W
    Y[:, 3:, 1:4] = -skew(s)
    Y[:, 3:, 4:10] = -_times_inertia(alpha) - W @ _times_inertia(omega)
    Y[:, :, 10:] = np.eye(6)
    return Y


def _times_inertia(v: Array) -> Array:
    """Matrices (n, 3, 6) that map xx, yy, zz, xy, xz, yz of an inertia I to I v."""
    x, y, z = v.T
    L = np.zeros((len(v), 3, 6))
    L[:, 0, 0], L[:, 0, 3], L[:, 0, 4] = x, y, z
    L[:, 1, 1], L[:, 1, 3], L[:, 1, 5] = y, x, z
    L[:, 2, 2], L[:, 2, 4], L[:, 2, 5] = z, x, y
    return L


def _symmetric(six: Array) -> Array:
    xx, yy, zz, xy, xz, yz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _physical(phi: Array) -> Array:
    """Mass, centre of mass and inertia about it (10,), from the linear parameters (10,); also of complex numbers."""
    m, p = phi[0], phi[1:4] / phi[0]
    x, y, z = p
    steiner = np.array([y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z])
    return np.concatenate([phi[:1], p, phi[4:] - m * steiner])


def _solve(information: Array, right: Array) -> Array:
    """Solve the normal equations; raise `NotObservable` with the parameters that the motion does not separate."""
    scale = np.sqrt(np.diag(information))
    scale[scale == 0] = 1.0
    eigenvalues, V = np.linalg.eigh(information / np.outer(scale, scale))
    free = eigenvalues < RANK_TOLERANCE * eigenvalues[-1]
    if free.any():
        share = (V[:, free] ** 2).sum(axis=1) / free.sum()
        names = [name for name, start, stop in GROUPS if share[start:stop].sum() > 0.05]
        raise NotObservable(
            f"the motion does not determine {free.sum()} of 16 combinations of {', '.join(names)}: tilt the tool "
            "about two axes while it moves, and turn it about all three."
        )
    return np.asarray(V @ (V.T @ (right / scale) / eigenvalues) / scale)


def _require_rotation(alpha: Array) -> None:
    """Raise `NotObservable` for a motion without angular acceleration about an axis, and name the axis."""
    squares, axes = np.linalg.eigh(alpha.T @ alpha / len(alpha))
    weakest, strongest = np.sqrt(np.maximum(squares[[0, 2]], 0.0))
    if weakest >= max(LEAST_ROTATION_RAD_S2, LEAST_SHARE * strongest):
        return
    if strongest < LEAST_ROTATION_RAD_S2:
        raise NotObservable(
            f"the tool hardly turns ({strongest:.2g} rad/s² rms), so its inertia is undetermined: turn it back and "
            "forth about all three axes."
        )
    lacking = axes[:, squares < max(LEAST_ROTATION_RAD_S2, LEAST_SHARE * strongest) ** 2]
    named = [axis for axis, part in zip("xyz", (lacking**2).sum(axis=1), strict=True) if part > 0.3]
    raise NotObservable(
        f"the tool hardly turns about {' and '.join(named)} of the sensor ({weakest:.2g} rad/s² rms, at least "
        f"{max(LEAST_ROTATION_RAD_S2, LEAST_SHARE * strongest):.2g} needed), so the inertia about it is undetermined: "
        "turn it back and forth about that axis too."
    )
