"""Kinematics of Universal Robots arms for many joint vectors at once.

Joints 2, 3 and 4 turn about parallel axes (the lift axis), so the flange orientation in the shoulder frame is
`Rz(psi) @ Ry(-q5) @ Rz(q6)` with psi = q2 + q3 + q4. Both inverses below read the wrist off this product.
Lengths are nominal: good for planning, never a source of flange poses for the solver.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ftdrive.errors import ConfigError
from ftdrivers.ur.kinematics import Array, Geometry

ALIGNED = 1e-9
"""Below this sine of q5, joints 4 and 6 turn about one line."""


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Where the joints are, for n joint vectors; everything (n, 3) in base, metres."""

    lift: Array
    """Direction of joint axes 2, 3 and 4."""
    shoulder_m: Array
    elbow_m: Array
    forearm_end_m: Array
    wrist_m: Array
    """Wrist centre, where axes 4 and 5 cross."""
    axis_5: Array
    wrist_2_m: Array
    """Where axes 5 and 6 cross."""
    R_base_flange: Array
    """(n, 3, 3); its last column is the direction of axis 6."""
    flange_m: Array


def checked_joints(q_rad: ArrayLike) -> Array:
    """Joint vector (6,); raises `ConfigError` unless all are within one turn of zero, which every model can reach."""
    q = np.asarray(q_rad, dtype=np.float64)
    if q.shape != (6,) or not np.all(np.abs(q) <= 2 * np.pi + ALIGNED):
        raise ConfigError(f"joints are {np.degrees(q).round(1).tolist()} degrees: give six within one turn of zero")
    return q


def frames(geometry: Geometry, q_rad: ArrayLike) -> Frames:
    """Forward kinematics of joint vectors (n, 6)."""
    q = np.asarray(q_rad, dtype=np.float64).reshape(-1, 6)
    c1, s1 = np.cos(q[:, 0]), np.sin(q[:, 0])
    zero = np.zeros(len(q))
    outward, lift = np.stack([c1, s1, zero], axis=1), np.stack([s1, -c1, zero], axis=1)
    up = np.array([0.0, 0.0, 1.0])

    def in_plane(angle: Array) -> Array:
        return np.asarray(np.cos(angle)[:, None] * outward + np.sin(angle)[:, None] * up)

    psi = q[:, 1] + q[:, 2] + q[:, 3]
    shoulder = np.tile(geometry.d1_m * up, (len(q), 1))
    elbow = shoulder + geometry.a2_m * in_plane(q[:, 1])
    forearm_end = elbow + geometry.a3_m * in_plane(q[:, 1] + q[:, 2])
    wrist = forearm_end + geometry.d4_m * lift
    axis_5 = in_plane(psi - np.pi / 2)
    wrist_2 = wrist + geometry.d5_m * axis_5
    R_base_shoulder = np.stack([outward, np.broadcast_to(up, outward.shape), lift], axis=2)
    R = R_base_shoulder @ wrist_rotation(psi, q[:, 4], q[:, 5])
    return Frames(lift, shoulder, elbow, forearm_end, wrist, axis_5, wrist_2, R, wrist_2 + geometry.d6_m * R[:, :, 2])


def wrist_rotation(psi_rad: Array, q5_rad: Array, q6_rad: Array) -> Array:
    """Flange orientation (n, 3, 3) in the shoulder frame (x outward, y up, z along the lift axis)."""
    cp, sp, c5, s5, c6, s6 = (f(a) for a in (psi_rad, q5_rad, q6_rad) for f in (np.cos, np.sin))
    rows = (
        (cp * c5 * c6 - sp * s6, -cp * c5 * s6 - sp * c6, -cp * s5),
        (sp * c5 * c6 + cp * s6, -sp * c5 * s6 + cp * c6, -sp * s5),
        (s5 * c6, -s5 * s6, c5),
    )
    return np.array(rows).transpose(2, 0, 1)


def wrist_inverse(q_arm_rad: ArrayLike, R_base_flange: Array) -> Array:
    """Angles of the wrist that give the flange these orientations while joints 1 to 3 stand still.

    Parameters
    ----------
    q_arm_rad : array_like, shape (3,)
    R_base_flange : array, shape (n, 3, 3)

    Returns
    -------
    array, shape (n, 2, 6)
        Joint vectors with the wrist in (-pi, pi], once with q5 >= 0 and once with q5 <= 0. Where axes 4 and 6 are
        parallel, q6 is free and taken as zero.
    """
    q_arm = np.asarray(q_arm_rad, dtype=np.float64)
    psi, q5, q6 = _wrist_angles(q_arm[0], R_base_flange)
    q4 = _wrapped(psi - q_arm[1] - q_arm[2])
    return np.concatenate([np.broadcast_to(q_arm, (*q4.shape, 3)), np.stack([q4, q5, q6], axis=2)], axis=2)


def inverse(geometry: Geometry, R_base_flange: Array, p_base_flange_m: Array) -> Array:
    """All joint vectors that bring the flange to these poses.

    Parameters
    ----------
    geometry : Geometry
    R_base_flange : array, shape (n, 3, 3)
    p_base_flange_m : array, shape (n, 3)

    Returns
    -------
    array, shape (n, 8, 6)
        In (-pi, pi]; two shoulders, two wrists, two elbows, in this order of nesting; nan where there is no solution.
    """
    R, p = np.asarray(R_base_flange, dtype=np.float64), np.asarray(p_base_flange_m, dtype=np.float64)
    crossing = p - geometry.d6_m * R[:, :, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        swing = np.arccos(geometry.d4_m / np.hypot(crossing[:, 0], crossing[:, 1]))
    heading = np.arctan2(crossing[:, 1], crossing[:, 0]) + np.pi / 2
    q = np.full((len(R), 2, 2, 2, 6), np.nan)
    for shoulder, q1 in enumerate((heading + swing, heading - swing)):
        psi, q5, q6 = _wrist_angles(q1, R)  # (n, 2)
        c1, s1 = np.cos(q1), np.sin(q1)
        x = (c1 * crossing[:, 0] + s1 * crossing[:, 1])[:, None] - geometry.d5_m * np.sin(psi)
        y = (crossing[:, 2] - geometry.d1_m)[:, None] + geometry.d5_m * np.cos(psi)
        a2, a3 = geometry.a2_m, geometry.a3_m
        with np.errstate(invalid="ignore"):
            bend = np.arccos((x**2 + y**2 - a2**2 - a3**2) / (2 * a2 * a3))
        for elbow, q3 in enumerate((bend, -bend)):
            q2 = np.arctan2(y, x) - np.arctan2(a3 * np.sin(q3), a2 + a3 * np.cos(q3))
            joints = np.stack([np.broadcast_to(q1[:, None], q3.shape), q2, q3, psi - q2 - q3, q5, q6], axis=2)
            q[:, shoulder, :, elbow] = _wrapped(joints)
    q = q.reshape(len(R), 8, 6)
    q[np.isnan(q).any(axis=2)] = np.nan
    return q


def _wrist_angles(q1_rad: Array | float, R_base_flange: Array) -> tuple[Array, Array, Array]:
    """psi, q5 and q6 (n, 2), with q5 first positive, then negative."""
    c1, s1 = np.cos(q1_rad), np.sin(q1_rad)
    R = np.asarray(R_base_flange, dtype=np.float64)
    x = np.moveaxis(c1 * R[:, 0].T + s1 * R[:, 1].T, 0, 1)  # rows of the orientation in the shoulder frame
    y, z = R[:, 2], np.moveaxis(s1 * R[:, 0].T - c1 * R[:, 1].T, 0, 1)
    sine = np.hypot(x[:, 2], y[:, 2])
    q5 = np.arctan2(sine, z[:, 2])[:, None] * [1.0, -1.0]
    sign = np.array([1.0, -1.0])
    psi = np.arctan2(-sign * y[:, 2:], -sign * x[:, 2:])
    q6 = np.arctan2(-sign * z[:, 1:2], sign * z[:, :1])
    facing = np.sign(z[:, 2:])
    aligned = (sine < ALIGNED)[:, None]
    return np.where(aligned, np.arctan2(facing * y[:, :1], facing * x[:, :1]), psi), q5, np.where(aligned, 0.0, q6)


def _wrapped(angle_rad: Array) -> Array:
    """Angles in (-pi, pi]."""
    return np.asarray(np.pi - np.mod(np.pi - angle_rad, 2 * np.pi))
