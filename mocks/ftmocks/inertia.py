"""Rigid bodies: mass, centre of mass and inertia of a payload, and the wrench that a moved payload exerts."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ftmocks.arrays import Array
from ftmocks.kinematics import FlangeMotion, rotation

SYMMETRIC = ([0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2])
"""Row and column indices of the elements ixx, iyy, izz, ixy, ixz, iyz of an inertia tensor."""


class Body(NamedTuple):
    """A rigid body: mass, centre of mass (3,), and inertia tensor per mass (3, 3) about it, in sensor coordinates."""

    mass_kg: float
    p_sensor_com_m: Array
    gyration_m2: Array

    def joined(self, other: "Body") -> "Body":
        """Return the body that consists of both bodies."""
        mass_kg = self.mass_kg + other.mass_kg
        shares = [(body, body.mass_kg / (mass_kg or 1.0)) for body in (self, other)]
        com_m = sum((share * body.p_sensor_com_m for body, share in shares), np.zeros(3))
        gyration_m2 = np.zeros((3, 3))
        for body, share in shares:
            arm_m = body.p_sensor_com_m - com_m
            gyration_m2 += share * (body.gyration_m2 + arm_m @ arm_m * np.eye(3) - np.outer(arm_m, arm_m))
        return Body(mass_kg, com_m, gyration_m2)


def drawn_gyration(rng: np.random.Generator, reach_m: float) -> Array:
    """Draw the inertia tensor per mass (3, 3), m², of a plausible tool about its centre of mass.

    The tool is a homogeneous box in a random orientation, 50 to 120 mm wide and deep. Its length is twice the distance
    `reach_m` of its centre, plus or minus a third.
    """
    x, y = rng.uniform(0.05, 0.12, 2)
    z = 2 * reach_m * rng.uniform(2 / 3, 4 / 3)
    axis = rng.normal(size=3)
    R = rotation(rng.uniform(0.0, np.pi) * axis / np.linalg.norm(axis))
    gyration: Array = R @ np.diag([y * y + z * z, x * x + z * z, x * x + y * y]) @ R.T / 12
    return gyration


def inertia_tensor(elements: Array) -> Array:
    """Return the tensor (3, 3) with the elements ixx, iyy, izz, ixy, ixz, iyz.

    Raises
    ------
    ValueError
        No body has this tensor: a principal moment is negative, or larger than the sum of the other two.
    """
    tensor = np.zeros((3, 3))
    tensor[SYMMETRIC] = elements
    tensor.T[SYMMETRIC] = elements
    moments = np.linalg.eigvalsh(tensor)
    if moments[0] < -1e-12 or moments[2] > moments[0] + moments[1] + 1e-9 * moments[2]:
        raise ValueError(f"no body has the principal moments of inertia {moments.tolist()} kg m²")
    return tensor


def moved_load(
    motion: FlangeMotion,
    gravity_m_s2: Array,
    R_flange_sensor: Array,
    p_flange_sensor_m: Array,
    p_sensor_com_m: Array,
    gyration_m2: Array,
) -> Array:
    """Return the wrench of gravity and inertia that a moved payload exerts on the sensor, per mass.

    Parameters
    ----------
    motion
        Motion of the flange.
    gravity_m_s2
        (3,) gravitational acceleration in base axes.
    gyration_m2
        (3, 3) inertia tensor per mass about the centre of mass, in sensor axes.

    Returns
    -------
    (6,) wrench per mass, N/kg and N·m/kg, in sensor axes about the sensor origin.

    Source: Newton-Euler equations, Craig, "Introduction to Robotics", equations 6.39 and 6.44, with the sign of a
    reaction. Written in scalars, because small products of numpy take three times as long in the 500 Hz loop.
    """
    in_base = np.array([motion.angular_velocity, motion.angular_acceleration, gravity_m_s2 - motion.acceleration])
    in_sensor = in_base @ motion.R_base_flange @ R_flange_sensor
    turning, turned, falling = in_sensor.tolist()
    spin, change = (in_sensor[:2] @ gyration_m2).tolist()
    lever = (p_flange_sensor_m @ R_flange_sensor + p_sensor_com_m).tolist()
    inner, outer = _cross(turning, _cross(turning, lever)), _cross(turned, lever)
    force = [f - i - o for f, i, o in zip(falling, inner, outer, strict=True)]
    bend, whirl = _cross(p_sensor_com_m.tolist(), force), _cross(turning, spin)
    return np.array([*force, *(b - c - w for b, c, w in zip(bend, change, whirl, strict=True))])


def _cross(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float]:
    (ax, ay, az), (bx, by, bz) = a, b
    return (ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)
