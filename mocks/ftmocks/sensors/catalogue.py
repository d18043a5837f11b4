"""The sensors a station can start, by name, with the emulator and the address of each.

The addresses have the form of docs/reference/sensors.md; another client takes the path or port from them.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

from ftmocks.arrays import Array
from ftmocks.clock import CellClock
from ftmocks.wires.device import Device

MeasureAt = Callable[[Array], Array]


@dataclass(frozen=True)
class Kind:
    """One kind of sensor.

    Parameters
    ----------
    emulator
        Module and class.
    scheme, query
        Of its address, around the path of its pseudo-terminal.
    endpoint
        Settings for a client that does not know such addresses.
    options
        Of the emulator.
    floats
        Whether its wire can carry NaN.
    """

    emulator: str
    scheme: str
    query: str = ""
    endpoint: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    floats: bool = False


def _slcan(bitrate: int, **more: Any) -> dict[str, Any]:
    return {"interface": "slcan", "bitrate": bitrate, **more}


KINDS = {
    "can": Kind(
        "ftmocks.sensors.ati_can:AtiCanNode",
        "ati-can",
        "interface=slcan&bitrate=250000&base=32",
        _slcan(250_000, base=0x20),
        {"base": 0x20, "bitrate": 250_000},
    ),
    "serial": Kind("ftmocks.sensors.ati_serial:AtiSerialBox", "ati-serial"),
    "robotous-can": Kind(
        "ftmocks.sensors.robotous:RobotousCanNode", "robotous-can", "interface=slcan&rate=1000", _slcan(1_000_000)
    ),
    "robotous-serial": Kind(
        "ftmocks.sensors.robotous:RobotousSerialBox", "robotous-serial", "baud=115200&rate=200", {"baud": 115_200}
    ),
    "robotiq": Kind("ftmocks.sensors.robotiq:RobotiqBox", "robotiq-ft300"),
    "bota": Kind("ftmocks.sensors.bota:BotaBox", "bota", floats=True),
    "netft": Kind("ftmocks.sensors.netft:NetFtBox", "ati-netft", options={"rdt_port": 0, "rate_hz": 1000}),
}
"""Sensors on a wire of their own."""

WRIST = "ur-ft"
"""The sensor in the arm's wrist, which the controller reports."""

CHOICES = (*KINDS, WRIST, "both", "none")
"""Values of --sensor; "both" is can and serial."""


class Sensor:
    """One sensor of a running station.

    Parameters
    ----------
    name
        One of `KINDS`, or `WRIST`.
    measure_at
        Readings (n, 6) in N and N·m at times (n,) of the cell's clock.
    host
        Loopback address of the station.
    clock
        Of the cell.
    """

    def __init__(self, name: str, measure_at: MeasureAt, *, seed: int, host: str, clock: CellClock) -> None:
        self.name = name
        self._kind = KINDS.get(name)
        self._emulator: Device[Any] | None = None
        if self._kind is None:
            self.endpoint = {"url": f"{WRIST}://{host}?counts_per_N=1&counts_per_Nm=1", "host": host}
            return
        module, _, class_name = self._kind.emulator.partition(":")
        options = self._kind.options | ({"host": host} if name == "netft" else {})
        make: Callable[..., Device[Any]] = getattr(import_module(module), class_name)
        emulator: Device[Any] = make(
            lambda count: measure_at(emulator.sample_times_s(count)), seed=seed, clock=clock, **options
        )
        self._emulator = emulator
        self.endpoint = self._endpoint(self._kind, emulator.start())

    def _endpoint(self, kind: Kind, where: Any) -> dict[str, Any]:
        """Return what the station reports about it, its address under "url"."""
        if isinstance(where, dict):
            ports = "&".join(f"{key}={where[key]}" for key in ("rdt_port", "http_port"))
            return {"url": f"{kind.scheme}://{where['host']}?{ports}", **where}
        url = f"{kind.scheme}://{where}" + (f"?{kind.query}" if kind.query else "")
        return {"url": url, "channel" if "interface" in kind.endpoint else "port": where, **kind.endpoint}

    @property
    def carries_nan(self) -> bool:
        """Whether its wire can carry NaN."""
        return self._kind is None or self._kind.floats

    @property
    def emulator(self) -> Device[Any]:
        """The emulator behind the wire.

        Raises
        ------
        ValueError
            For the sensor in the wrist, which has no wire.
        """
        if self._emulator is None:
            raise ValueError(f"{self.name} is part of the arm and has no wire of its own")
        return self._emulator

    def saturate(self, axis: int | None) -> None:
        """Let an axis, or a gauge where the sensor sends gauges, read the end of its range; None ends it."""
        if axis is not None and not 0 <= axis < 6:
            raise ValueError(f"axis {axis} is not 0 to 5")
        self.emulator.saturated_axis = axis

    def stop(self) -> None:
        """Stop the emulator."""
        if self._emulator is not None:
            self._emulator.stop()
