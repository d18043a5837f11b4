"""Disturbances: pushes and cables that touch the tool, and drift of the sensor's zero.

Does not model: masses on springs, friction, anything that depends on how fast the arm moves.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ftmocks.arrays import Array
from ftmocks.kinematics import Vector6, cross

FOREVER_S = math.inf


class Contact(Protocol):
    """Something that touches the tool."""

    def wrench(self, now_s: float, q: Vector6, R_base_sensor: Array) -> Array | None:
        """Wrench (6,) on the sensor at this moment, sensor axes about its origin; None when it is over."""


@dataclass(frozen=True)
class Push:
    """A constant wrench about the sensor's origin, for a limited time.

    Parameters
    ----------
    given
        (6,) N and N·m, in the axes of the base, or of the sensor when `in_sensor`.
    until_s
        On the cell's clock.
    """

    given: Array
    in_sensor: bool = False
    until_s: float = FOREVER_S

    def wrench(self, now_s: float, _q: Vector6, R_base_sensor: Array) -> Array | None:
        """See `Contact`."""
        if now_s >= self.until_s:
            return None
        if self.in_sensor:
            return self.given
        return np.concatenate((R_base_sensor.T @ self.given[:3], R_base_sensor.T @ self.given[3:]))


@dataclass(frozen=True)
class Ramp:
    """A force at a point of the tool that changes evenly, and then stays.

    Parameters
    ----------
    before_N, after_N
        (3,) in base axes.
    p_sensor_m
        The point, (3,) in the sensor frame.
    start_s, seconds
        When it changes, on the cell's clock.
    """

    before_N: Array
    after_N: Array
    p_sensor_m: Array
    start_s: float
    seconds: float

    def wrench(self, now_s: float, _q: Vector6, R_base_sensor: Array) -> Array | None:
        """See `Contact`."""
        share = min(1.0, max(0.0, (now_s - self.start_s) / self.seconds))
        force_N = R_base_sensor.T @ (self.before_N + share * (self.after_N - self.before_N))
        return np.concatenate((force_N, cross(self.p_sensor_m, force_N)))


@dataclass(frozen=True)
class Cable:
    """A cable that pulls at a point of the tool when it is taut.

    Parameters
    ----------
    force_base_N
        (3,) in base axes: per degree of `joint` beyond its threshold; constant with `towards`.
    p_sensor_m
        Where the cable is fixed, (3,) in the sensor frame.
    joint, beyond_rad
        Number 0 to 5 of a joint, and the angle at which the cable becomes taut: beyond it upwards for a positive one,
        downwards for a negative one.
    towards, within_rad
        Instead of a joint: taut while the sensor's z axis is so near to this direction in base, (3,).
    """

    force_base_N: Array
    p_sensor_m: Array
    joint: int | None = None
    beyond_rad: float = 0.0
    towards: Array | None = None
    within_rad: float = 0.0

    def wrench(self, _now_s: float, q: Vector6, R_base_sensor: Array) -> Array | None:
        """See `Contact`."""
        force_N = R_base_sensor.T @ self.force_base_N * self._tension(q, R_base_sensor)
        return np.concatenate((force_N, cross(self.p_sensor_m, force_N)))

    def _tension(self, q: Vector6, R_base_sensor: Array) -> float:
        if self.joint is not None:
            side = math.copysign(1.0, self.beyond_rad)
            return math.degrees(max(0.0, side * (q[self.joint] - self.beyond_rad)))
        if self.towards is None:
            return 1.0
        along = float(R_base_sensor[:, 2] @ self.towards / np.linalg.norm(self.towards))
        return float(along >= math.cos(self.within_rad))


@dataclass(frozen=True)
class SensorDrift:
    """A zero that moves linearly by `total` (6,), N and N·m in sensor axes, in `seconds`, and stays there."""

    total: Array
    start_s: float
    seconds: float

    def at(self, now_s: float) -> Array:
        """Return the drift so far, (6,)."""
        share = (now_s - self.start_s) / self.seconds if self.seconds > 0.0 else 1.0
        return self.total * min(1.0, share)
