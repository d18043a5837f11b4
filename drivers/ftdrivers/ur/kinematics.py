"""Nominal forward kinematics of Universal Robots arms, and the algebra of their poses.

Ref: Universal Robots, "DH parameters for calculations of kinematics and dynamics"; ROS 2 description of the arms,
`default_kinematics.yaml` of each model, version 2.4.5.

The calibrated pose of a real arm differs from the nominal one by 1 to 2 mm. So this checks the model and the active
TCP, and is never a source of flange poses.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import asin, cos, pi, sin, sqrt

import numpy as np
from scipy.spatial.transform import Rotation

from ftdrivers.interfaces import Array

__all__ = ["MODELS", "Array", "Geometry", "Pose", "flange_poses", "forward", "model_named"]

_ALPHA_RAD = (pi / 2, 0.0, 0.0, pi / 2, -pi / 2, 0.0)


@dataclass(frozen=True, slots=True)
class Geometry:
    """Standard Denavit-Hartenberg lengths of one model; those not named are zero."""

    d1_m: float
    a2_m: float
    a3_m: float
    d4_m: float
    d5_m: float
    d6_m: float


MODELS = {
    "UR3": Geometry(0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819),
    "UR5": Geometry(0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823),
    "UR10": Geometry(0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922),
    "UR3e": Geometry(0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
    "UR5e": Geometry(0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "UR7e": Geometry(0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "UR10e": Geometry(0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
    "UR12e": Geometry(0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
    "UR16e": Geometry(0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655),
    "UR8long": Geometry(0.2186, -0.8989, -0.7149, 0.1824, 0.1361, 0.1434),
    "UR15": Geometry(0.2186, -0.6475, -0.5164, 0.1824, 0.1361, 0.1434),
    "UR18": Geometry(0.2186, -0.475, -0.3389, 0.1824, 0.1361, 0.1434),
    "UR20": Geometry(0.2363, -0.862, -0.7287, 0.201, 0.1593, 0.1543),
    "UR30": Geometry(0.2363, -0.637, -0.5037, 0.201, 0.1593, 0.1543),
}


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Pose of a frame b in a frame a: `p_a = R @ p_b + p_m`."""

    R: Array
    """(3, 3)"""
    p_m: Array
    """(3,)"""

    def __matmul__(self, other: "Pose") -> "Pose":
        return Pose(self.R @ other.R, self.R @ other.p_m + self.p_m)

    def angle_to_rad(self, other: "Pose") -> float:
        """Return the angle between the two orientations."""
        chord = float(np.linalg.norm(self.R - other.R)) / sqrt(8.0)
        return 2.0 * asin(min(1.0, chord))


def flange_poses(tcp_poses: Array, tcp_offsets: Array) -> tuple[Array, Array]:
    """Return n flanges in base, R (n, 3, 3) and p in metres (n, 3), from UR poses (n, 6).

    `tcp_poses` are those of the active TCP in base, `tcp_offsets` those of the TCP in the flange.
    """
    rotvec_rad = np.concatenate([tcp_poses[:, 3:], tcp_offsets[:, 3:]])
    R_base_tcp, R_flange_tcp = Rotation.from_rotvec(rotvec_rad).as_matrix().reshape(2, -1, 3, 3)
    R_base_flange = R_base_tcp @ R_flange_tcp.transpose(0, 2, 1)
    return R_base_flange, tcp_poses[:, :3] - np.einsum("nij,nj->ni", R_base_flange, tcp_offsets[:, :3])


def forward(geometry: Geometry, q_rad: Sequence[float] | Array) -> Pose:
    """Return the flange in base for the joint angles `q_rad` (6,), by the nominal lengths."""
    d_m = (geometry.d1_m, 0.0, 0.0, geometry.d4_m, geometry.d5_m, geometry.d6_m)
    a_m = (0.0, geometry.a2_m, geometry.a3_m, 0.0, 0.0, 0.0)
    flange = Pose(np.eye(3), np.zeros(3))
    for q, alpha, d, a in zip(q_rad, _ALPHA_RAD, d_m, a_m, strict=True):
        link = np.array(
            [
                [cos(q), -sin(q) * cos(alpha), sin(q) * sin(alpha)],
                [sin(q), cos(q) * cos(alpha), -cos(q) * sin(alpha)],
                [0.0, sin(alpha), cos(alpha)],
            ]
        )
        flange = flange @ Pose(link, np.array([a * cos(q), a * sin(q), d]))
    return flange


def model_named(name: str, controller_major: int) -> str | None:
    """Find the key of `MODELS` for the name of an arm in a configuration or on the dashboard, or None.

    The dashboard drops the e of e-Series arms ("UR5" may be a UR5e), so the controller's generation decides.
    """
    key = name.strip().lower()
    names = {name.lower(): name for name in MODELS}
    if controller_major >= 5 and key + "e" in names:
        key += "e"
    return names.get(key)
