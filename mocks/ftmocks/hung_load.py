"""A load that hangs on a string from a hook of the tool, and swings when the hook moves.

The load is a point mass on a massless string that is always taut. The damping ratio of the pendulum is 0.5 %. The load
uses the time of the arm, which `--time-scale` makes faster.

Not modelled: twist of the string, contacts of the load, vibration of the tool.
"""

import math

import numpy as np

from ftmocks.arrays import Array
from ftmocks.kinematics import Vector6, cross

DAMPING_RATIO = 0.005
STEPS = 125
"""Least number of integration steps per period, which gives a relative error of 1e-4."""


class HungLoad:
    """A load on a string, see `Contact`.

    Parameters
    ----------
    mass_kg
        Mass of the load.
    p_flange_hook_m, p_sensor_hook_m
        (3,) position of the hook in flange and in sensor coordinates.
    string_m
        Length of the string from the hook to the centre of mass.
    gravity_m_s2
        (3,) gravitational acceleration in base axes.
    hook_m
        (3,) position of the hook in the base.
    aside
        (3,) initial deflection: a horizontal vector in the base whose norm is the angle, rad.
    """

    def __init__(
        self,
        mass_kg: float,
        p_flange_hook_m: Array,
        p_sensor_hook_m: Array,
        string_m: float,
        gravity_m_s2: Array,
        hook_m: Array,
        aside: Array,
    ) -> None:
        self.mass_kg = mass_kg
        self.p_flange_hook_m = p_flange_hook_m
        self._p_sensor_hook_m = p_sensor_hook_m
        self._string_m = string_m
        self._gravity_m_s2 = gravity_m_s2
        g_m_s2 = float(np.linalg.norm(gravity_m_s2))
        self._down = gravity_m_s2 / g_m_s2
        self._rate_rad_s = math.sqrt(g_m_s2 / string_m)
        angle = float(np.linalg.norm(aside))
        self._string = string_m * (math.cos(angle) * self._down + math.sin(angle) * aside / (angle or 1.0))
        self._hook = (hook_m, np.zeros(3))
        self._velocity_m_s: Array = np.zeros(3)
        self.force_base_N: Array = mass_kg * math.cos(angle) * g_m_s2 / string_m * self._string
        """(3,) force of the string on the hook in the last control cycle, in base axes."""

    @property
    def swing_deg(self) -> float:
        """Angle between the string and the vertical, degrees."""
        along = float(self._string @ self._down)
        return math.degrees(math.atan2(float(np.linalg.norm(self._string - along * self._down)), along))

    def follow(self, seconds: float, hook_m: Array, hook_m_s: Array) -> None:
        """Integrate the motion up to a new position and velocity of the hook, (3,) each, in the base.

        Source: Ryckaert, Ciccotti, Berendsen, "Numerical integration of the cartesian equations of motion of a system
        with constraints", 1977 (SHAKE). The method conserves energy and does not need the acceleration of the hook.
        """
        steps = math.ceil(seconds * self._rate_rad_s * STEPS / (2 * math.pi))
        (before_m, before_m_s), self._hook = self._hook, (hook_m, hook_m_s)
        dt, hook = seconds / steps, before_m
        lost = -math.expm1(-2 * DAMPING_RATIO * self._rate_rad_s * dt)
        for k in range(1, steps + 1):
            s = k / steps
            after = hook_m if k == steps else _between(before_m, before_m_s, hook_m, hook_m_s, seconds, s)
            moved = after - hook
            velocity = (1.0 - lost) * self._velocity_m_s + lost * moved / dt + dt * self._gravity_m_s2
            free = self._string + dt * velocity - moved
            pulled = self._pulled(free)
            self.force_base_N = self.mass_kg * pulled / dt**2 * self._string
            self._velocity_m_s = velocity - pulled / dt * self._string
            self._string = free - pulled * self._string
            hook = after

    def _pulled(self, free: Array) -> float:
        """Return the fraction of the string vector by which to correct a position (3,) to keep the string's length."""
        square = self._string_m**2
        along = float(free @ self._string)
        return (along - math.sqrt(along * along - square * (float(free @ free) - square))) / square

    def wrench(self, _now_s: float, _q: Vector6, R_base_sensor: Array) -> Array | None:
        """Return the wrench of this contact on the sensor, see `Contact.wrench`."""
        force_N = R_base_sensor.T @ self.force_base_N
        return np.concatenate((force_N, cross(self._p_sensor_hook_m, force_N)))


def _between(p0: Array, v0: Array, p1: Array, v1: Array, seconds: float, share: float) -> Array:
    """Return the position (3,) of the hook after a fraction of the time, by cubic Hermite interpolation."""
    s, left = share, 1.0 - share
    point: Array = left * left * ((1 + 2 * s) * p0 + s * seconds * v0) + s * s * (
        (1 + 2 * left) * p1 - left * seconds * v1
    )
    return point
