"""Kinematics of the UR arms: Denavit-Hartenberg tables, forward and inverse kinematics, UR poses.

Standard DH, one row per joint: ``T_i = Rz(theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i)``. A UR pose is
``[x, y, z, rx, ry, rz]``: metres and a rotation vector.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ftmocks.arrays import Array

Vector3 = tuple[float, float, float]
Vector6 = tuple[float, float, float, float, float, float]
"""Six joint values or a UR pose, as floats instead of an array, because the 500 Hz loop uses scalar arithmetic."""

ZERO6: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class JointState(NamedTuple):
    """Joint angles (rad), speeds (rad/s) and accelerations (rad/s²) at one instant."""

    q: Vector6
    qd: Vector6 = ZERO6
    qdd: Vector6 = ZERO6


class FlangeMotion(NamedTuple):
    """Motion of the flange at one instant, in base axes and SI units: orientation (3, 3), the other fields (3,)."""

    R_base_flange: Array
    angular_velocity: Array
    angular_acceleration: Array
    acceleration: Array
    """(3,) acceleration of the origin of the flange, m/s²."""


@dataclass(frozen=True)
class Dh:
    """Denavit-Hartenberg parameters (m, rad) and joint speed limits (rad/s) of one arm, six values each.

    ``theta`` are offsets of the joint angles, which are zero for a nominal arm. The frames of a real arm may be far
    away from its links, see `factory_kinematics`.
    """

    model: str
    """Name of the nominal arm in `MODELS`."""
    theta: Vector6
    a: Vector6
    d: Vector6
    alpha: Vector6
    max_speed: Vector6

    @cached_property
    def links(self) -> list[tuple[float, float, float, float, float]]:
        """For each link: theta, a, d, cosine of alpha, sine of alpha."""
        rows = zip(self.theta, self.a, self.d, self.alpha, strict=True)
        return [(theta, a, d, math.cos(alpha), math.sin(alpha)) for theta, a, d, alpha in rows]


def vector6(values: Sequence[float] | Array) -> Vector6:
    """Return a tuple of six floats."""
    a, b, c, d, e, f = map(float, values)
    return (a, b, c, d, e, f)


def vector3(values: Sequence[float] | Array) -> Vector3:
    """Return a tuple of three floats."""
    x, y, z = map(float, values)
    return (x, y, z)


def _nominal(model: str, lengths: Vector6, speeds_deg_s: Sequence[float]) -> Dh:
    d1, a2, a3, d4, d5, d6 = lengths
    return Dh(
        model,
        theta=ZERO6,
        a=(0.0, a2, a3, 0.0, 0.0, 0.0),
        d=(d1, 0.0, 0.0, d4, d5, d6),
        alpha=(math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0),
        max_speed=vector6([math.radians(v) for v in speeds_deg_s]),
    )


_SMALL = (180, 180, 180, 360, 360, 360)
_MIDDLE = (180, 180, 180, 180, 180, 180)
_LARGE = (120, 120, 180, 180, 180, 180)
_HEAVY = (120, 120, 150, 210, 210, 210)

_ARMS: dict[str, tuple[Vector6, Sequence[float]]] = {
    "UR3": ((0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819), _SMALL),
    "UR5": ((0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823), _MIDDLE),
    "UR10": ((0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922), _LARGE),
    "UR3e": ((0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921), _SMALL),
    "UR5e": ((0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996), _MIDDLE),
    "UR10e": ((0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655), _LARGE),
    "UR16e": ((0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655), _LARGE),
    "UR20": ((0.2363, -0.862, -0.7287, 0.201, 0.1593, 0.1543), _HEAVY),
    "UR30": ((0.2363, -0.637, -0.5037, 0.201, 0.1593, 0.1543), _HEAVY),
}

MODELS = {model: _nominal(model, lengths, speeds) for model, (lengths, speeds) in _ARMS.items()}
"""Nominal arms by model name. Source: Universal Robots ROS 2 description, default_kinematics and joint_limits."""


def forward(dh: Dh, q: Sequence[float], joints: int = 6) -> Array:
    """Return the pose (4, 4) of the flange, or of the frame after joint `joints`, in the base."""
    return _stack(_chain(dh, q)[joints])


_Rows = tuple[float, float, float, float, float, float, float, float, float, float, float, float]
"""The first three rows of a homogeneous matrix in row-major order."""
_IDENTITY: _Rows = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)


def _chain(dh: Dh, q: Sequence[float]) -> list[_Rows]:
    """Return frames 0 to 6 in the base. Scalar arithmetic takes a tenth of the time of twelve small matrix products."""
    frames = [_IDENTITY]
    m = _IDENTITY
    for angle, (offset, a, d, ca, sa) in zip(q, dh.links, strict=True):
        c, s = math.cos(angle + offset), math.sin(angle + offset)
        x1, y1, z1, p1, x2, y2, z2, p2, x3, y3, z3, p3 = m
        u1, v1 = x1 * c + y1 * s, y1 * c - x1 * s
        u2, v2 = x2 * c + y2 * s, y2 * c - x2 * s
        u3, v3 = x3 * c + y3 * s, y3 * c - x3 * s
        first = u1, v1 * ca + z1 * sa, z1 * ca - v1 * sa, u1 * a + z1 * d + p1
        second = u2, v2 * ca + z2 * sa, z2 * ca - v2 * sa, u2 * a + z2 * d + p2
        third = u3, v3 * ca + z3 * sa, z3 * ca - v3 * sa, u3 * a + z3 * d + p3
        m = first + second + third
        frames.append(m)
    return frames


def _stack(m: _Rows) -> Array:
    return np.array([m[0:4], m[4:8], m[8:12], (0.0, 0.0, 0.0, 1.0)])


def elbow(dh: Dh, q: Sequence[float]) -> Array:
    """Return the position (3,) of the elbow in the base: the point of joint axis 3 in the plane of the upper arm."""
    frame = forward(dh, q, joints=2)
    return np.asarray(frame[:3, 3] - dh.d[1] * frame[:3, 2])  # undo the offset d, often many metres in a real arm


def jacobian(dh: Dh, q: Sequence[float]) -> Array:
    """Return the geometric Jacobian (6, 6) of the flange in base axes: ``[v; omega] = J qd``."""
    frames = _chain(dh, q)
    tip_x, tip_y, tip_z = frames[6][3::4]
    columns = []
    for frame in frames[:6]:
        ax, ay, az = frame[2::4]
        x, y, z = tip_x - frame[3], tip_y - frame[7], tip_z - frame[11]
        columns.append((ay * z - az * y, az * x - ax * z, ax * y - ay * x, ax, ay, az))
    return np.array(columns).T


def flange_motion(dh: Dh, state: JointState) -> FlangeMotion:
    """Return the motion of the flange by outward iterations from joint to joint.

    Source: Craig, "Introduction to Robotics", section 6.5 (outward iterations), in base axes.
    """
    frames = _chain(dh, state.q)
    wx = wy = wz = bx = by = bz = ax = ay = az = 0.0  # angular velocity, angular acceleration, acceleration
    for below, above, v, c in zip(frames[:6], frames[1:], state.qd, state.qdd, strict=True):
        x, y, z = below[2::4]
        bx += x * c + (wy * z - wz * y) * v
        by += y * c + (wz * x - wx * z) * v
        bz += z * c + (wx * y - wy * x) * v
        wx, wy, wz = wx + x * v, wy + y * v, wz + z * v
        x, y, z = above[3] - below[3], above[7] - below[7], above[11] - below[11]
        along, square = wx * x + wy * y + wz * z, wx * wx + wy * wy + wz * wz  # w x (w x r) = w (w.r) - r (w.w)
        ax += by * z - bz * y + wx * along - x * square
        ay += bz * x - bx * z + wy * along - y * square
        az += bx * y - by * x + wz * along - z * square
    m = frames[6]
    R_base_flange = np.array([m[0:3], m[4:7], m[8:11]])
    return FlangeMotion(R_base_flange, np.array([wx, wy, wz]), np.array([bx, by, bz]), np.array([ax, ay, az]))


def closed_form(dh: Dh, target: Array, free_q6: float = 0.0) -> Iterator[Vector6]:
    """Return all joint vectors in (-pi, pi], at most eight, with which a nominal arm has its flange at `target` (4, 4).

    They differ in shoulder, wrist and elbow. If ``sin q5 = 0``, joint 6 is free and set to `free_q6`.
    """
    a2, a3 = dh.a[1], dh.a[2]
    d4, d6 = dh.d[3], dh.d[5]
    R, p = target[:3, :3], target[:3, 3]
    wrist = p - d6 * R[:, 2]
    radius = math.hypot(wrist[0], wrist[1])
    if radius < abs(d4):
        return
    for shoulder in (1.0, -1.0):
        q1 = math.atan2(wrist[1], wrist[0]) + shoulder * math.acos(d4 / radius) + math.pi / 2
        c1, s1 = math.cos(q1), math.sin(q1)
        cos_q5 = (p[0] * s1 - p[1] * c1 - d4) / d6
        if abs(cos_q5) > 1.0 + 1e-9:
            continue
        for flip in (1.0, -1.0):
            q5 = flip * math.acos(max(-1.0, min(1.0, cos_q5)))
            s5 = math.sin(q5)
            if abs(s5) < 1e-9:
                q6 = free_q6
            else:
                q6 = math.atan2((R[1, 1] * c1 - R[0, 1] * s1) / s5, (R[0, 0] * s1 - R[1, 0] * c1) / s5)
            X_1_4 = (
                inverse_matrix(_link(dh, 0, q1))
                @ target
                @ inverse_matrix(_link(dh, 5, q6))
                @ inverse_matrix(_link(dh, 4, q5))
            )
            x, y = (X_1_4[:3, 3] - d4 * X_1_4[:3, 1])[:2]
            reach = math.hypot(x, y)
            cos_q3 = (reach * reach - a2 * a2 - a3 * a3) / (2 * a2 * a3)
            if abs(cos_q3) > 1.0 + 1e-9:
                continue
            for bend in (1.0, -1.0):
                q3 = bend * math.acos(max(-1.0, min(1.0, cos_q3)))
                q2 = math.atan2(y, x) - math.atan2(a3 * math.sin(q3), a2 + a3 * math.cos(q3))
                X_3_4 = inverse_matrix(_link(dh, 1, q2) @ _link(dh, 2, q3)) @ X_1_4
                q4 = math.atan2(X_3_4[1, 0], X_3_4[0, 0])
                yield vector6([_wrap(v) for v in (q1, q2, q3, q4, q5, q6)])


def _link(dh: Dh, i: int, angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    ca, sa = math.cos(dh.alpha[i]), math.sin(dh.alpha[i])
    a, d = dh.a[i], dh.d[i]
    return np.array(
        [
            [c, -s * ca, s * sa, a * c],
            [s, c * ca, -c * sa, a * s],
            [0.0, sa, ca, d],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _wrap(angle: float) -> float:
    return math.remainder(angle, 2 * math.pi)


def inverse(dh: Dh, target: Array, near: Sequence[float]) -> Vector6 | None:
    """Return the joint vector nearest to `near` with which the flange is at `target` (4, 4), or None if there is none.

    The closed-form solution of the nominal arm is refined by Newton steps with the real parameters. The joints differ
    by at most one revolution from `near`, and are within two pi.
    """

    def distance(q: Vector6) -> float:
        return sum(abs(v - n) for v, n in zip(q, near, strict=True))

    branches = closed_form(MODELS[dh.model], target, near[5])
    seeds = [vector6([_nearest_turn(v, n) for v, n in zip(q, near, strict=True)]) for q in branches]
    seeds.sort(key=distance)
    if not seeds:  # the nominal arm just misses the target; this arm may still reach it
        seeds = [vector6(near)]
    for seed in seeds:
        q = refine(dh, target, seed)
        if q is not None:
            return q
    return None


def _nearest_turn(angle: float, near: float) -> float:
    turned = near + _wrap(angle - near)
    return turned if abs(turned) <= 2 * math.pi else angle


def refine(dh: Dh, target: Array, seed: Sequence[float], tolerance: float = 1e-11) -> Vector6 | None:
    """Return the solution of Newton's method from `seed` on the same branch, or None if it does not converge."""
    q = np.array(seed, dtype=float)
    for _ in range(12):
        here = forward(dh, q.tolist())
        error = np.concatenate((target[:3, 3] - here[:3, 3], rotvec(target[:3, :3] @ here[:3, :3].T)))
        if float(np.abs(error).max()) < tolerance:
            return vector6(q)
        try:
            step = np.linalg.solve(jacobian(dh, q.tolist()), error)
        except np.linalg.LinAlgError:
            return None
        if float(np.abs(step).max()) > 1.0:  # singular or out of reach
            return None
        q += step
    return None


def rotation(rotation_vector: Sequence[float] | Array) -> Array:
    """Return the rotation matrix (3, 3) of a rotation vector (3,), rad."""
    x, y, z = map(float, rotation_vector)
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-12:
        return np.array([[1.0, -z, y], [z, 1.0, -x], [-y, x, 1.0]])
    x, y, z = x / angle, y / angle, z / angle
    c, s = math.cos(angle), math.sin(angle)
    t = 1.0 - c
    return np.array(
        [
            [t * x * x + c, t * x * y - s * z, t * x * z + s * y],
            [t * x * y + s * z, t * y * y + c, t * y * z - s * x],
            [t * x * z - s * y, t * y * z + s * x, t * z * z + c],
        ]
    )


def rotvec(R: Array) -> Array:
    """Return the rotation vector (3,) of a rotation matrix, with an angle of at most pi."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    x, y, z = h - f, c - g, d - b
    sin2 = math.sqrt(x * x + y * y + z * z)  # 2 sin(angle)
    angle = math.atan2(sin2, a + e + i - 1.0)
    if angle < 1e-6:
        return np.array([x, y, z]) / 2
    if math.pi - angle < 1e-4:  # near 180° the antisymmetric part vanishes: use the symmetric one
        S = (R + R.T) / 2 + np.eye(3)
        column = S[:, int(np.argmax(np.diag(S)))]
        axis = column / np.linalg.norm(column)
        if float(axis @ np.array([x, y, z])) < 0.0:
            axis = -axis
        return np.asarray(angle * axis)
    return np.array([x, y, z]) * (angle / sin2)


def cross(a: Sequence[float] | Array, b: Sequence[float] | Array) -> Array:
    """Return the vector product (3,), four times as fast as `numpy.cross`."""
    (ax, ay, az), (bx, by, bz) = a, b
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def pose_of(X: Array) -> Vector6:
    """Return the UR pose of a homogeneous matrix (4, 4)."""
    return vector6(np.concatenate((X[:3, 3], rotvec(X[:3, :3]))))


def matrix_of(pose: Sequence[float]) -> Array:
    """Return the homogeneous matrix (4, 4) of a UR pose."""
    X = np.eye(4)
    X[:3, :3] = rotation(pose[3:6])
    X[:3, 3] = pose[0:3]
    return X


def inverse_matrix(X: Array) -> Array:
    """Return the inverse of a homogeneous matrix (4, 4)."""
    out = np.eye(4)
    out[:3, :3] = X[:3, :3].T
    out[:3, 3] = -X[:3, :3].T @ X[:3, 3]
    return out
