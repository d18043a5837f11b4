"""One row per emulated sensor: what the tests that every driver must pass have to know about it."""

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Kind:
    """One kind of sensor. Its driver passes `test_sensor_drivers.py` and `test_sensor_faults.py`."""

    scheme: str
    emulator: str
    """Module and class."""
    query: str = ""
    """Options of the address."""
    options: dict[str, Any] = field(default_factory=dict)
    """Options of the emulator."""
    resolution: tuple[float, float] = (0.0, 0.0)
    """Step of a reading, N and N·m."""
    rate_Hz: float = 0.0
    counts: int = 6
    """Number of raw counts in a sample."""
    serial: str = ""
    """Beginning of the serial number."""
    fast: tuple[str, dict[str, Any]] | None = None
    """Query and options of the emulator at its highest rate; None if they are the usual ones."""
    numbered: bool = False
    """Whether samples carry a number or a time or are polled, so that duplicates are detected."""


KINDS = {
    "ati-can": Kind(
        "ati-can", "ftmocks.sensors.ati_can:AtiCanNode", "interface=slcan",
        resolution=(0.02, 0.001), rate_Hz=1000, serial="FT", numbered=True,
    ),
    "ati-serial": Kind(
        "ati-serial", "ftmocks.sensors.ati_serial:AtiSerialBox", resolution=(0.02, 0.001), rate_Hz=7000, serial="FT"
    ),
    "robotous-can": Kind(
        "robotous-can", "ftmocks.sensors.robotous:RobotousCanNode", "interface=slcan",
        resolution=(0.02, 0.0005), rate_Hz=200, serial="A60HA00123",
    ),
    "robotous-serial": Kind(
        "robotous-serial", "ftmocks.sensors.robotous:RobotousSerialBox",
        resolution=(0.02, 0.0005), rate_Hz=200, serial="A60HA00123", fast=("baud=921600&rate=1000", {"baud_code": 1}),
    ),
    "robotiq-ft300": Kind(
        "robotiq-ft300", "ftmocks.sensors.robotiq:RobotiqBox", resolution=(0.01, 0.001), rate_Hz=100, serial="FTS-1234"
    ),
    "robotiq-urcap": Kind(
        "robotiq-ft300", "ftmocks.sensors.robotiq_urcap:RobotiqUrcap", options={"port": 0},
        resolution=(0.01, 0.001), rate_Hz=100, counts=0, serial="not reported",
    ),
    "bota": Kind(
        "bota", "ftmocks.sensors.bota:BotaBox", options={"boot_s": 0.05},
        resolution=(1e-5, 1e-6), rate_Hz=100, counts=0, serial="1",
        fast=("baud=460800&sinc=64", {"boot_s": 0.05}), numbered=True,
    ),
    "ati-netft": Kind(
        "ati-netft", "ftmocks.sensors.netft:NetFtBox", options={"rdt_port": 0, "rate_hz": 1000},
        resolution=(1e-6, 1e-6), rate_Hz=1000, serial="FT12345", numbered=True,
    ),
    "ur-ft": Kind(
        "ur-ft", "tests.wire.emulated_wrist:EmulatedWrist", "counts_per_N=1&counts_per_Nm=1",
        resolution=(1e-6, 1e-6), rate_Hz=500, numbered=True,
    ),
}  # fmt: skip
"""By the name of the emulator. The sensor in the wrist is part of an arm: it has no wire of its own."""
