"""An arm with seven joints and a sensor with a load, written apart from the drivers: kinematics, URDF, truth."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

JOINTS = [f"joint{number}" for number in range(1, 8)]
"""Axes z, y, z, -y, z, y, z, links of 0.2 m along z: as in `URDF`."""
AXES = ["0 0 1", "0 1 0", "0 0 1", "0 -1 0", "0 0 1", "0 1 0", "0 0 1"]
_LINK = '<link name="link{n}"/><joint name="joint{n}" type="revolute"><parent link="link{p}"/><child link="link{n}"/>'
URDF = (
    '<robot name="seven"><link name="link0"/>'
    + "".join(
        _LINK.format(n=n, p=n - 1) + f'<origin xyz="0 0 0.2" rpy="0 0 0"/><axis xyz="{AXES[n - 1]}"/></joint>'
        for n in range(1, 8)
    )
    + '<link name="flange"/><joint name="fixed" type="fixed"><parent link="link7"/><child link="flange"/>'
    '<origin xyz="0 0 0.1" rpy="3.141592653589793 0 0"/></joint></robot>'
)
TRUTH: dict[str, Any] = {
    "mass_kg": 1.3,
    "p_sensor_com_m": [0.012, -0.008, 0.055],
    "force_bias_N": [4.0, -7.0, 12.0],
    "torque_bias_Nm": [0.2, -0.1, 0.3],
    "R_flange_sensor": Rotation.from_euler("zx", [35, 4], degrees=True).as_matrix().tolist(),
    "noise": [0.05, 0.05, 0.05, 0.002, 0.002, 0.002],
}
_G = np.array([0.0, 0.0, -9.80665])

Array = NDArray[np.float64]


def posture(number: int) -> Array:
    """Joint angles of an orientation, far from the others."""
    return np.random.default_rng(number).uniform(-1.4, 1.4, 7) * [1, 1, 1, 1, 1, 1, 2]


def sway(t_s: Array) -> Array:
    """Joint angles (n, 7) in slow motion, which turns the flange about all axes."""
    k = np.arange(7)
    return np.asarray(0.8 * np.sin(2 * np.pi * (0.11 + 0.035 * k) * t_s[:, None] + k))


def flange(q_rad: Array) -> tuple[Array, Array]:
    """Poses of the flange at joint angles (n, 7): its own forward kinematics."""
    n = len(q_rad)
    R, p = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    for angle, text in zip(q_rad.T, AXES, strict=True):
        axis = np.array([float(x) for x in text.split()])
        p = p + R @ [0, 0, 0.2]
        c, s, i = np.cos(angle), axis.sum() * np.sin(angle), int(np.argmax(np.abs(axis)))
        j, k = (i + 1) % 3, (i + 2) % 3
        turn = np.zeros((n, 3, 3))
        turn[:, i, i] = 1.0
        turn[:, j, j] = turn[:, k, k] = c
        turn[:, k, j], turn[:, j, k] = s, -s
        R = R @ turn
    p = p + R @ [0, 0, 0.1]
    return R @ np.diag([1.0, -1.0, -1.0]), p


def wrench(t_s: Array, joints: Any) -> Array:
    """What a sensor at the flange measures of a point mass (n, 6), inertia included, by differences of its path."""
    h = 1e-3
    com_base = []
    for dt in (-h, 0.0, h):
        R, p = flange(joints(t_s + dt))
        R_sensor = R @ np.array(TRUTH["R_flange_sensor"])
        com_base.append(p + R_sensor @ TRUTH["p_sensor_com_m"])
    acceleration = (com_base[0] - 2 * com_base[1] + com_base[2]) / h**2
    R_sensor = flange(joints(t_s))[0] @ np.array(TRUTH["R_flange_sensor"])
    force = TRUTH["mass_kg"] * np.einsum("nji,nj->ni", R_sensor, _G - acceleration)
    torque = np.cross(TRUTH["p_sensor_com_m"], force)
    return np.hstack([force + TRUTH["force_bias_N"], torque + TRUTH["torque_bias_Nm"]])
