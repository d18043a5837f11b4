"""Disturbances: contacts, cables that pull on the tool, and drift of the bias.

Not modelled: masses on springs, friction, forces that depend on the speed of the arm.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ftmocks.arrays import Array
from ftmocks.kinematics import Vector6, cross

FOREVER_S = math.inf


class Contact(Protocol):
    """A contact of the tool, or another force on it: it returns its wrench on the sensor."""

    def wrench(self, now_s: float, q: Vector6, R_base_sensor: Array) -> Array | None:
        """Return the wrench (6,) of the contact on the sensor, in sensor axes about its origin; None after its end."""


@dataclass(frozen=True)
class Push:
    """A constant wrench about the sensor's origin, for a limited time.

    Parameters
    ----------
    given
        (6,) wrench, N and N·m, in base axes, or in sensor axes if `in_sensor`.
    until_s
        End of the contact on the cell's clock, s.
    """

    given: Array
    in_sensor: bool = False
    until_s: float = FOREVER_S

    def wrench(self, now_s: float, _q: Vector6, R_base_sensor: Array) -> Array | None:
        """Return the wrench of this contact on the sensor, see `Contact.wrench`."""
        if now_s >= self.until_s:
            return None
        if self.in_sensor:
            return self.given
        return np.concatenate((R_base_sensor.T @ self.given[:3], R_base_sensor.T @ self.given[3:]))


@dataclass(frozen=True)
class Ramp:
    """A force at a point of the tool that changes linearly and then remains constant.

    Parameters
    ----------
    before_N, after_N
        (3,) force before and after the change, in base axes.
    p_sensor_m
        (3,) point of the tool in sensor coordinates.
    start_s, seconds
        Start of the change on the cell's clock, and duration of the change.
    """

    before_N: Array
    after_N: Array
    p_sensor_m: Array
    start_s: float
    seconds: float

    def wrench(self, now_s: float, _q: Vector6, R_base_sensor: Array) -> Array | None:
        """Return the wrench of this contact on the sensor, see `Contact.wrench`."""
        share = min(1.0, max(0.0, (now_s - self.start_s) / self.seconds))
        force_N = R_base_sensor.T @ (self.before_N + share * (self.after_N - self.before_N))
        return np.concatenate((force_N, cross(self.p_sensor_m, force_N)))


@dataclass(frozen=True)
class Cable:
    """A cable that pulls on a point of the tool while it is taut.

    Parameters
    ----------
    force_base_N
        (3,) force in base axes: per degree of `joint` beyond its threshold, or constant with `towards`.
    p_sensor_m
        (3,) point in sensor coordinates at which the cable is fixed.
    joint, beyond_rad
        Index of a joint, 0 to 5, and the angle beyond which the cable is taut. The cable is taut above a positive angle
        and below a negative one.
    towards, within_rad
        Alternative to a joint: the cable is taut while the angle between the sensor's z axis and this direction (3,) in
        the base is smaller than `within_rad`.
    """

    force_base_N: Array
    p_sensor_m: Array
    joint: int | None = None
    beyond_rad: float = 0.0
    towards: Array | None = None
    within_rad: float = 0.0

    def wrench(self, _now_s: float, q: Vector6, R_base_sensor: Array) -> Array | None:
        """Return the wrench of this contact on the sensor, see `Contact.wrench`."""
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
    """A drift of the bias by `total` (6,), N and N·m in sensor axes, which is linear and lasts `seconds`."""

    total: Array
    start_s: float
    seconds: float

    def at(self, now_s: float) -> Array:
        """Return the current drift (6,), N and N·m."""
        share = (now_s - self.start_s) / self.seconds if self.seconds > 0.0 else 1.0
        return self.total * min(1.0, share)
