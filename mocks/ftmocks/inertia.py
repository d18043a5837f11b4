"""The inertia of a payload: a body of one mass, and the wrench that it exerts when it is moved."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ftmocks.arrays import Array
from ftmocks.kinematics import FlangeMotion, rotation

SYMMETRIC = ([0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2])
"""Where the six elements ixx, iyy, izz, ixy, ixz, iyz of an inertia tensor stand."""


class Body(NamedTuple):
    """A body: mass, centre of mass (3,) in the sensor frame, inertia tensor per mass about it, (3, 3), sensor axes."""

    mass_kg: float
    p_sensor_com_m: Array
    gyration_m2: Array

    def joined(self, other: "Body") -> "Body":
        """Return both as one."""
        mass_kg = self.mass_kg + other.mass_kg
        shares = [(body, body.mass_kg / (mass_kg or 1.0)) for body in (self, other)]
        com_m = sum((share * body.p_sensor_com_m for body, share in shares), np.zeros(3))
        gyration_m2 = np.zeros((3, 3))
        for body, share in shares:
            arm_m = body.p_sensor_com_m - com_m
            gyration_m2 += share * (body.gyration_m2 + arm_m @ arm_m * np.eye(3) - np.outer(arm_m, arm_m))
        return Body(mass_kg, com_m, gyration_m2)


def drawn_gyration(rng: np.random.Generator, reach_m: float) -> Array:
    """Draw the inertia tensor per mass of a plausible tool, about its centre of mass, (3, 3) in m².

    The tool is an evenly filled box 50 to 120 mm wide and deep, as long as twice the distance `reach_m` of its centre,
    give or take a third, turned at random.
    """
    x, y = rng.uniform(0.05, 0.12, 2)
    z = 2 * reach_m * rng.uniform(2 / 3, 4 / 3)
    axis = rng.normal(size=3)
    R = rotation(rng.uniform(0.0, np.pi) * axis / np.linalg.norm(axis))
    gyration: Array = R @ np.diag([y * y + z * z, x * x + z * z, x * x + y * y]) @ R.T / 12
    return gyration


def inertia_tensor(elements: Array) -> Array:
    """Return the tensor (3, 3) of its elements ixx, iyy, izz, ixy, ixz, iyz.

    Raises
    ------
    ValueError
        When no body has it: a principal moment is negative, or larger than the sum of the other two.
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
        Of the flange.
    gravity_m_s2
        (3,) in base axes.
    gyration_m2
        Inertia tensor per mass about the centre of mass, (3, 3), sensor axes.

    Returns
    -------
    (6,) N/kg and N·m/kg, sensor axes, about the sensor origin.

    Source: Newton and Euler, as in Craig, "Introduction to Robotics", equations 6.39 and 6.44, with the sign of a
    reaction. Small products of numpy would take three times as long, which counts at 500 Hz.
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
