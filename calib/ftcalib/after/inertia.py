"""Wrench that a load in motion exerts beside its weight, and the motion from a series of poses.

With a the acceleration of the sensor origin, all in the sensor frame, and the inertia I about that origin, the load
exerts on the sensor

    force_N   = -m a - alpha x (m p) - omega x (omega x (m p))
    torque_Nm = -(m p) x a - I alpha - omega x (I omega)

as in D. Kubus, T. Kröger, F. M. Wahl, "On-line estimation of inertial parameters using a recursive total least-squares
approach", IROS 2008.
"""

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ftcalib.model import Array, skew


class SensorMotion(NamedTuple):
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


def motion_of_poses(
    t_s: Array,
    R_base_flange: Array,
    p_base_flange_m: Array,
    *,
    R_flange_sensor: Array,
    p_flange_sensor_m: Array,
    reach: int,
) -> SensorMotion:
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
        Motion of n - 2 reach poses.
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
    return SensorMotion(t, R, omega @ R_flange_sensor, alpha @ R_flange_sensor, acceleration @ R_flange_sensor)


def inertial_wrench(
    mass_kg: float, p_sensor_com_m: Array, motion: SensorMotion, inertia_com_kg_m2: Array | None = None
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
