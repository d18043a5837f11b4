"""Interfaces of sensor and arm for the calibration routine: drivers, recordings and fakes implement them."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ftcalib.model import Array


class WrenchSamples(Protocol):
    """n samples of a force/torque sensor, as measured: before any bias, tare, filter or compensation."""

    @property
    def t_host_ns(self) -> NDArray[np.int64]:
        """(n,) host clock at receipt."""

    @property
    def t_device_s(self) -> Array:
        """(n,) device clock, NaN where there is none."""

    @property
    def seq(self) -> NDArray[np.int64]:
        """(n,) sequence number; gaps are lost samples."""

    @property
    def counts(self) -> NDArray[np.int32]:
        """(n, k) raw device counts."""

    @property
    def wrench(self) -> Array:
        """(n, 6) N and N·m, in the sensor frame."""

    @property
    def status(self) -> NDArray[np.uint32]:
        """(n,) vendor status word."""


class Sensor(Protocol):
    """A source of wrenches."""

    def collect(self, duration_s: float, /) -> WrenchSamples:
        """Return every sample of the next `duration_s` seconds, or raise."""

    def check(self) -> None:
        """Raise if the stream has failed."""


class ArmReading(Protocol):
    """State of the arm at one moment."""

    @property
    def t_host_ns(self) -> int:
        """Host clock at receipt."""

    @property
    def q_rad(self) -> Array:
        """(6,) joint angles."""

    @property
    def R_base_flange(self) -> Array:
        """(3, 3) flange coordinates to base coordinates."""


class Arm(Protocol):
    """An arm at a pose, or about to come to rest there."""

    def state(self) -> ArmReading:
        """Read a fresh state, or raise."""

    def wait_until_still(self, *, timeout_s: float, guard: Callable[[], None]) -> None:
        """Return when the arm has come to rest, or raise."""
