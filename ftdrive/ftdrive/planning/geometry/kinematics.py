"""Forward and inverse kinematics of Universal Robots arms for arrays of joint vectors.

Joints 2, 3 and 4 of a nominal arm turn about parallel axes (the lift axis), so the flange orientation in the shoulder
frame is `Rz(psi) @ Ry(-q5) @ Rz(q6)` with psi = q2 + q3 + q4. Both inverses take the wrist angles from this product.
The axes of a real arm deviate from parallel by up to half a degree; the product is then the start of Newton's method.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ftcalib.model import cross
from ftdrive.errors import ConfigError
from ftdrivers.ur.kinematics import Array, Kinematics

# Below this sine of q5 the axes of joints 4 and 6 are considered parallel.
ALIGNED = 1e-9
# Number of Newton steps from the solution for parallel axes, after which only rounding errors remain.
_STEPS = 5
_TINY = 1e-14
# Largest error, m and rad, of the flange pose for which joint angles count as a solution.
_REACHED = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Positions (n, 3) and axes (n, 3) of the joints for n joint vectors, base axes, metres."""

    lift: Array
    """Direction of joint axis 2."""
    lift_3: Array
    lift_4: Array
    """Directions of joint axes 3 and 4, parallel to axis 2 on a nominal arm."""
    shoulder_m: Array
    elbow_m: Array
    forearm_end_m: Array
    """Point on axis 4 at the level of the shoulder along the lift axis."""
    wrist_m: Array
    """Wrist centre: the point of axis 4 that is on axis 5 or nearest to it."""
    axis_5: Array
    wrist_2_m: Array
    """The point of axis 5 that is on axis 6 or nearest to it."""
    R_base_flange: Array
    """(n, 3, 3) orientation of the flange; the last column is the direction of axis 6."""
    flange_m: Array


def checked_joints(q_rad: ArrayLike) -> Array:
    """Return joint angles as an array (6,); raises `ConfigError` unless all are within one turn of zero."""
    q = np.asarray(q_rad, dtype=np.float64)
    if q.shape != (6,) or not np.all(np.abs(q) <= 2 * np.pi + ALIGNED):
        raise ConfigError(f"joint angles are {np.degrees(q).round(1).tolist()} degrees: give six within ±360")
    return q


def frames(kinematics: Kinematics, q_rad: ArrayLike) -> Frames:
    """Return positions and axes of the joints and the flange at joint vectors (n, 6): the forward kinematics."""
    axes, points, R = _axes_and_flange(kinematics, np.asarray(q_rad, dtype=np.float64).reshape(-1, 6))
    along = kinematics.links_m[:, 2]
    return Frames(
        lift=axes[1],
        lift_3=axes[2],
        lift_4=axes[3],
        shoulder_m=points[1],
        elbow_m=points[2],
        forearm_end_m=points[3],
        wrist_m=points[3] + along[3] * axes[3],
        axis_5=axes[4],
        wrist_2_m=points[4] + along[4] * axes[4],
        R_base_flange=R,
        flange_m=points[6],
    )


def _axes_and_flange(kinematics: Kinematics, q_rad: Array) -> tuple[list[Array], list[Array], Array]:
    """Return directions (n, 3) of the six axes, a point (n, 3) on each and the flange, and R_base_flange (n, 3, 3)."""
    turn = q_rad.T + np.array(kinematics.theta_rad)[:, None]
    cosine, sine = np.cos(turn), np.sin(turn)
    x, y, z = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, len(q_rad)))  # each (3, n), which is faster
    point = np.zeros((3, len(q_rad)))
    axes, points = [], []
    for c, s, alpha, (a, b, d) in zip(cosine, sine, kinematics.alpha_rad, kinematics.links_m.tolist(), strict=True):
        axes.append(z.T)
        points.append(point.T)
        x, y = c * x + s * y, c * y - s * x
        for length_m, direction in ((a, x), (b, y), (d, z)):
            if length_m:
                point = point + length_m * direction
        ca, sa = np.cos(alpha), np.sin(alpha)
        y, z = ca * y + sa * z, ca * z - sa * y
    return axes, [*points, point.T], np.ascontiguousarray(np.transpose([x, y, z], (2, 1, 0)))


def wrist_inverse(kinematics: Kinematics, q_arm_rad: ArrayLike, R_base_flange: Array) -> Array:
    """Return the joint vectors with these flange orientations, for given angles of joints 1 to 3.

    Parameters
    ----------
    kinematics : Kinematics
    q_arm_rad : array_like, shape (3,)
    R_base_flange : array, shape (n, 3, 3)

    Returns
    -------
    array, shape (n, 2, 6)
        Joint vectors with the wrist in (-pi, pi], first with q5 >= 0, then with q5 <= 0. If axes 4 and 6 of a nominal
        arm are parallel, q6 is free and set to zero; a real arm may then miss the orientation by its deviation.
    """
    q_arm = np.asarray(q_arm_rad, dtype=np.float64)
    _, offset = _parallel(kinematics)
    psi, q5, q6 = _wrist_angles(q_arm[0] + offset[0], R_base_flange)
    wrist = np.stack([psi - (q_arm + offset[:3])[1:].sum(), q5, q6], axis=2) - offset[3:]
    q = np.concatenate([np.broadcast_to(q_arm, wrist.shape), wrist], axis=2)
    if not is_exact(kinematics):
        q = wrist_refined(kinematics, q.reshape(-1, 6), np.repeat(R_base_flange, 2, axis=0)).reshape(q.shape)
    q[:, :, [3, 5]] = _wrapped(q[:, :, [3, 5]])
    return q


def wrist_refined(kinematics: Kinematics, q_rad: Array, R_base_flange: Array) -> Array:
    """Return joint vectors (n, 6) whose wrist is corrected so that the flange has these orientations (n, 3, 3)."""
    return _refined(kinematics, np.asarray(q_rad), R_base_flange)


def inverse(kinematics: Kinematics, R_base_flange: Array, p_base_flange_m: Array) -> Array:
    """Return all joint vectors with these flange poses.

    Parameters
    ----------
    kinematics : Kinematics
    R_base_flange : array, shape (n, 3, 3)
    p_base_flange_m : array, shape (n, 3)

    Returns
    -------
    array, shape (n, 8, 6)
        Joint angles in (-pi, pi] for two shoulders, two wrists and two elbows, in this order of nesting; nan if there
        is no solution. Also nan near the stretched arm, if only the real or only the nominal arm has a solution.
    """
    R, p = np.asarray(R_base_flange, dtype=np.float64), np.asarray(p_base_flange_m, dtype=np.float64)
    (d1, a2, a3, d4, d5, d6), offset = _parallel(kinematics)
    crossing = p - d6 * R[:, :, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        swing = np.arccos(d4 / np.hypot(crossing[:, 0], crossing[:, 1]))
    heading = np.arctan2(crossing[:, 1], crossing[:, 0]) + np.pi / 2
    q = np.full((len(R), 2, 2, 2, 6), np.nan)
    for shoulder, q1 in enumerate((heading + swing, heading - swing)):
        psi, q5, q6 = _wrist_angles(q1, R)  # (n, 2)
        c1, s1 = np.cos(q1), np.sin(q1)
        x = (c1 * crossing[:, 0] + s1 * crossing[:, 1])[:, None] - d5 * np.sin(psi)
        y = (crossing[:, 2] - d1)[:, None] + d5 * np.cos(psi)
        with np.errstate(invalid="ignore"):
            bend = np.arccos((x**2 + y**2 - a2**2 - a3**2) / (2 * a2 * a3))
        for elbow, q3 in enumerate((bend, -bend)):
            q2 = np.arctan2(y, x) - np.arctan2(a3 * np.sin(q3), a2 + a3 * np.cos(q3))
            joints = np.stack([np.broadcast_to(q1[:, None], q3.shape), q2, q3, psi - q2 - q3, q5, q6], axis=2)
            q[:, shoulder, :, elbow] = joints - offset
    q = q.reshape(-1, 6)
    reached = np.flatnonzero(~np.isnan(q).any(axis=1))
    pose = reached // 8
    solution = q[reached] if is_exact(kinematics) else _refined(kinematics, q[reached], R[pose], p[pose])
    at = frames(kinematics, solution)
    off = np.maximum(np.abs(at.flange_m - p[pose]).max(axis=1), np.abs(at.R_base_flange - R[pose]).max(axis=(1, 2)))
    q[:] = np.nan
    q[reached] = np.where((off < _REACHED)[:, None], _wrapped(solution), np.nan)
    return q.reshape(len(R), 8, 6)


def _parallel(kinematics: Kinematics) -> tuple[tuple[float, ...], Array]:
    """Return d1, a2, a3, d4, d5, d6 of the arm with the same lengths and exact axes, and the joint offsets (6,).

    The joint angles of that arm are those of the given arm plus the offsets, which are zero for a nominal arm. Exact
    axes are parallel or at right angles.
    """
    links, theta = kinematics.links_m, np.array(kinematics.theta_rad)
    limbs = np.hypot(links[1:3, 0], links[1:3, 1])
    turned = np.arctan2(-links[1:3, 1], -links[1:3, 0])  # a2 and a3 are negative
    lengths = (links[0, 2], -limbs[0], -limbs[1], *links[3:, 2])
    return lengths, _wrapped(theta + np.array([0.0, turned[0], turned[1] - turned[0], -turned[1], 0.0, 0.0]))


def is_exact(kinematics: Kinematics) -> bool:
    """Return whether the joint axes are exactly parallel or at right angles, as in a nominal arm."""
    return all(bool(off.max() < ALIGNED) for off in deviation(kinematics))


def deviation(kinematics: Kinematics) -> tuple[Array, Array]:
    """Return the deviation of each link from an arm with the same lengths and exactly parallel or orthogonal axes.

    Returns
    -------
    shift_m, tilt_rad : array, shape (6,)
        Shift of the point on the next axis, and tilt of that axis.
    """
    links = kinematics.links_m
    shift_m = np.hypot(links[:, 0], links[:, 1])
    shift_m[1:3] = 0.0
    right = np.array([np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0])
    return shift_m, np.abs(np.array(kinematics.alpha_rad) - right)


def _refined(kinematics: Kinematics, q_rad: Array, R_base_flange: Array, p_base_flange_m: Array | None = None) -> Array:
    """Improve joint vectors (n, 6) by Newton's method until they give these poses; without positions, wrist only."""
    first = 3 if p_base_flange_m is None else 0
    q = q_rad.copy()
    for _ in range(_STEPS):
        axes, points, R = _axes_and_flange(kinematics, q)
        J = np.stack(axes[first:], axis=2)
        off = cross(np.swapaxes(R, 1, 2), np.swapaxes(R_base_flange, 1, 2)).sum(axis=1) / 2
        if p_base_flange_m is not None:
            levers = [cross(axis, points[6] - point) for axis, point in zip(axes, points[:6], strict=True)]
            J = np.concatenate([np.stack(levers, axis=2), J], axis=1)
            off = np.concatenate([p_base_flange_m - points[6], off], axis=1)
        JT = np.swapaxes(J, 1, 2)
        # The damping keeps every step below half a radian.
        damping = np.square(off).sum(axis=1)[:, None, None] + _TINY
        step = JT @ np.linalg.solve(J @ JT + damping * np.eye(J.shape[1]), off[:, :, None])
        q[:, first:] += step[:, :, 0]
    return q


def _wrist_angles(q1_rad: Array | float, R_base_flange: Array) -> tuple[Array, Array, Array]:
    """Return psi = q2 + q3 + q4, q5 and q6, each (n, 2), for orientations: first with q5 >= 0, then with q5 <= 0."""
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
    """Return angles shifted by full turns into (-pi, pi]."""
    return np.asarray(np.pi - np.mod(np.pi - angle_rad, 2 * np.pi))
