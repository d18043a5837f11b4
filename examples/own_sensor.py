"""A driver for a sensor that ftdrive does not know. Its base class has the reader thread, checks and time limits."""

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

import ftdrivers


class AcmeSensor(ftdrivers.StreamingSensor):
    """Reads one wrench after the other; `read_wrench` stands for the client library of the sensor."""

    def __init__(self, read_wrench: Callable[[], ArrayLike]) -> None:
        super().__init__("Acme sensor")  # begins every error message
        self._read_wrench, self._seq = read_wrench, 0

    def _connect(self) -> ftdrivers.DeviceInfo:
        return ftdrivers.DeviceInfo(model="Acme FT", serial="A1", firmware="1.0")

    def _read_block(self) -> ftdrivers.FtSamples:
        self._seq += 1  # counts every sample that the device sent, so a lost one leaves a gap
        return ftdrivers.FtSamples.of(time.monotonic_ns(), self._seq, np.atleast_2d(self._read_wrench()))

    def _disconnect(self) -> None:
        """Close the port here."""


def wrench_of_1_kg() -> ArrayLike:
    """Wait for the next sample: tool down, 1 kg below the sensor, and noise."""
    time.sleep(0.002)
    return np.random.default_rng(time.monotonic_ns()).normal([0, 0, 9.81, 0, 0, 0], 0.005)


with AcmeSensor(wrench_of_1_kg) as sensor:
    print(sensor.identify().model, sensor.identify().serial)
    newest = sensor.latest(timeout_s=10.0)
    print(f"force {newest.wrench[0, :3].round(1) + 0.0} N")
