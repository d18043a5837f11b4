"""Forward kinematics of Universal Robots arms, and the algebra of their poses.

Ref: Universal Robots, "DH parameters for calculations of kinematics and dynamics"; ROS 2 description of the arms,
`default_kinematics.yaml` of each model, version 2.4.5.

A real arm differs from the nominal one by up to 7.5 mm and 1.3 degrees, and its controller uses measured parameters.
Flange poses are those that the controller reports. Kinematics are used for checking these poses and for planning.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import asin, cos, pi, sin, sqrt

import numpy as np
from scipy.spatial.transform import Rotation

from ftdrivers.interfaces import Array, DeviceInfo

__all__ = ["MODELS", "Array", "Kinematics", "Pose", "flange_poses", "forward", "kinematics_of", "model_named"]


_ROUNDED = 1e-9
_ALPHA_RAD = (pi / 2, 0.0, 0.0, pi / 2, -pi / 2, 0.0)


@dataclass(frozen=True)
class Kinematics:
    """Standard Denavit-Hartenberg parameters of one arm, (6,) each. Those of `MODELS` are nominal.

    The axes of joints 2, 3 and 4 are nearly parallel. The measured `d_m` of these joints may therefore be hundreds of
    metres long, and cancel each other. The lengths in `links_m` are those of the real links.
    """

    theta_rad: tuple[float, ...]
    a_m: tuple[float, ...]
    d_m: tuple[float, ...]
    alpha_rad: tuple[float, ...]

    @classmethod
    def of(cls, numbers: Sequence[float]) -> "Kinematics":
        """Build kinematics from theta, a, d and alpha of all joints, (24,), in the order of `numbers`.

        Raises `ValueError` if a number is not finite, or if the last axis is not that of the flange.
        """
        theta, a, d, alpha = np.array(numbers, np.float64).reshape(4, 6)
        if not np.isfinite([theta, a, d, alpha]).all() or max(abs(a[5]), abs(alpha[5])) > _ROUNDED:
            raise ValueError(f"theta, a, d and alpha are {[*numbers]}: give finite numbers, with a6 and alpha6 zero.")
        a[5] = alpha[5] = 0.0
        for joint, right in enumerate(_ALPHA_RAD):
            if alpha[joint] * right < 0:  # reverses the x axis of the frame, which describes the same arm
                theta[joint : joint + 2] += pi, -pi
                a[joint], alpha[joint] = -a[joint], -alpha[joint]
        return cls(*(tuple(values.tolist()) for values in (theta, a, d, alpha)))

    @property
    def numbers(self) -> tuple[float, ...]:
        """(24,) theta, a, d and alpha of all joints, rad and m."""
        return (*self.theta_rad, *self.a_m, *self.d_m, *self.alpha_rad)

    @cached_property
    def links_m(self) -> Array:
        """(6, 3) vectors from a point on each joint axis to a point on the next one, in axes that turn with the joint.

        The points on axes 3 and 4 are chosen level with the shoulder along the lift axis, as in the nominal arm. The
        next axis is rotated by alpha about x.
        """
        a, d, alpha = np.array([self.a_m, self.d_m, self.alpha_rad])
        # Distance from the origin of each Denavit-Hartenberg frame to the chosen point, along the joint axis.
        along = np.zeros(7)
        for joint in (1, 2):
            along[joint + 1] = (along[joint] - d[joint]) / np.cos(alpha[joint])
        sideways = -along[1:] * np.sin(alpha)
        level = d - along[:-1] + along[1:] * np.cos(alpha)
        level[1:3] = 0.0  # zero by the choice of the points; a sum of large numbers would have rounding errors
        return np.stack([a, sideways, level], axis=1)


def _nominal(d1_m: float, a2_m: float, a3_m: float, d4_m: float, d5_m: float, d6_m: float) -> Kinematics:
    a_m, d_m = (0.0, a2_m, a3_m, 0.0, 0.0, 0.0), (d1_m, 0.0, 0.0, d4_m, d5_m, d6_m)
    return Kinematics((0.0,) * 6, a_m, d_m, _ALPHA_RAD)


MODELS = {
    "UR3": _nominal(0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819),
    "UR5": _nominal(0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823),
    "UR10": _nominal(0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922),
    "UR3e": _nominal(0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
    "UR5e": _nominal(0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "UR7e": _nominal(0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "UR10e": _nominal(0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
    "UR12e": _nominal(0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
    "UR16e": _nominal(0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655),
    "UR8long": _nominal(0.2186, -0.8989, -0.7149, 0.1824, 0.1361, 0.1434),
    "UR15": _nominal(0.2186, -0.6475, -0.5164, 0.1824, 0.1361, 0.1434),
    "UR18": _nominal(0.2186, -0.475, -0.3389, 0.1824, 0.1361, 0.1434),
    "UR20": _nominal(0.2363, -0.862, -0.7287, 0.201, 0.1593, 0.1543),
    "UR30": _nominal(0.2363, -0.637, -0.5037, 0.201, 0.1593, 0.1543),
}


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Pose of a frame b in a frame a: `p_a = R @ p_b + p_m`."""

    R: Array
    """(3, 3) rotation matrix that maps coordinates in b to a."""
    p_m: Array
    """(3,) origin of b in a, m."""

    def __matmul__(self, other: "Pose") -> "Pose":
        return Pose(self.R @ other.R, self.R @ other.p_m + self.p_m)

    def angle_to_rad(self, other: "Pose") -> float:
        """Return the angle between the two orientations, rad."""
        chord = float(np.linalg.norm(self.R - other.R)) / sqrt(8.0)
        return 2.0 * asin(min(1.0, chord))


def flange_poses(tcp_poses: Array, tcp_offsets: Array) -> tuple[Array, Array]:
    """Return orientations (n, 3, 3) and positions (n, 3), m, of the flange in the base.

    `tcp_poses` (n, 6) are UR poses of the active TCP in the base, `tcp_offsets` (n, 6) those of the TCP in the flange.
    """
    rotvec_rad = np.concatenate([tcp_poses[:, 3:], tcp_offsets[:, 3:]])
    R_base_tcp, R_flange_tcp = Rotation.from_rotvec(rotvec_rad).as_matrix().reshape(2, -1, 3, 3)
    R_base_flange = R_base_tcp @ R_flange_tcp.transpose(0, 2, 1)
    return R_base_flange, tcp_poses[:, :3] - np.einsum("nij,nj->ni", R_base_flange, tcp_offsets[:, :3])


def forward(kinematics: Kinematics, q_rad: Sequence[float] | Array) -> Pose:
    """Return the pose of the flange in the base for the joint angles `q_rad` (6,)."""
    flange = Pose(np.eye(3), np.zeros(3))
    turned = zip(q_rad, kinematics.theta_rad, kinematics.alpha_rad, kinematics.links_m, strict=True)
    for q, theta, alpha, link_m in turned:
        c, s, ca, sa = cos(q + theta), sin(q + theta), cos(alpha), sin(alpha)
        R_joint = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        R_next = np.array([[1.0, 0.0, 0.0], [0.0, ca, -sa], [0.0, sa, ca]])
        flange = flange @ Pose(R_joint @ R_next, R_joint @ link_m)
    return flange


def kinematics_of(info: DeviceInfo) -> Kinematics | None:
    """Return the kinematics in the facts of an arm, or None if it reports none."""
    fact = info.facts.get("kinematics")
    return Kinematics.of(fact.value) if fact is not None and isinstance(fact.value, tuple) else None


def model_named(name: str, controller_major: int) -> str | None:
    """Return the key of `MODELS` for the name of an arm in a configuration or on the dashboard, or None.

    The dashboard omits the e of e-Series arms: "UR5" may be a UR5e. The controller's generation distinguishes them.
    """
    key = name.strip().lower()
    names = {name.lower(): name for name in MODELS}
    if controller_major >= 5 and key + "e" in names:
        key += "e"
    return names.get(key)
