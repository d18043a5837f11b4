"""The sensors that a station can start, by name, with the emulator and the address of each.

Addresses have the form of docs/reference/sensors.md. Other clients use the path or port in them.
"""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from ftmocks.arrays import Array
from ftmocks.clock import CellClock
from ftmocks.sensors.kind import Kind
from ftmocks.wires.device import Device

MeasureAt = Callable[[Array], Array]


KINDS: dict[str, Kind] = {
    name: kind
    for module in iter_modules([str(Path(__file__).parent)], f"{__package__}.")
    if module.name != __name__
    for name, kind in getattr(import_module(module.name), "KINDS", {}).items()
}
"""Sensors with a wire of their own, by name: the `KINDS` of all modules beside this one."""

WRIST = "ur-ft"
"""Name of the sensor in the wrist of the arm, whose readings the controller reports."""

CHOICES = (*KINDS, WRIST, "both", "none")
"""Values of --sensor. "both" means can and serial."""


def parse_settings(name: str, settings: list[str]) -> dict[str, Any]:
    """Return the options of an emulator for settings ``NAME=VALUE``.

    Raises
    ------
    ValueError
        The sensor `name` has no such setting, or the value is invalid.
    """
    known = KINDS[name].settings if name in KINDS else {}
    options: dict[str, Any] = {}
    for setting in settings:
        key, sign, value = setting.partition("=")
        if not known:
            raise ValueError(f"the sensor {name} has no settings: leave --sensor-setting out")
        if not sign or key not in known:
            choices = " or ".join(f"{choice}=VALUE" for choice in known)
            raise ValueError(f"{setting!r} is not a setting of the sensor {name}: give {choices}")
        option, parse = known[key]
        options[option] = parse(value)
    return options


class Sensor:
    """One sensor of a running station.

    Parameters
    ----------
    name
        A key of `KINDS`, or `WRIST`.
    measure_at
        Function that returns readings (n, 6), N and N·m, at times (n,) of the cell's clock.
    host
        Loopback address of the station.
    clock
        Clock of the cell.
    options
        Options of the emulator, see `parse_settings`.
    """

    def __init__(
        self,
        name: str,
        measure_at: MeasureAt,
        *,
        seed: int,
        host: str,
        clock: CellClock,
        options: dict[str, Any] | None = None,
    ) -> None:
        self.name = name
        self._kind = KINDS.get(name)
        self._emulator: Device[Any] | None = None
        if self._kind is None:
            self.endpoint = {"url": f"{WRIST}://{host}?counts_per_N=1&counts_per_Nm=1", "host": host}
            return
        given = self._kind.options | (options or {}) | ({"host": host} if self._kind.at_host else {})
        emulator: Device[Any] = self._kind.emulator(
            lambda count: measure_at(emulator.sample_times_s(count)), seed=seed, clock=clock, **given
        )
        self._emulator = emulator
        self.endpoint = self._endpoint(self._kind, emulator.start())

    def _endpoint(self, kind: Kind, where: Any) -> dict[str, Any]:
        """Return the description of the sensor that the station prints for clients; its address is under "url"."""
        if isinstance(where, dict):
            ports = "&".join(f"{key}={port}" for key, port in where.items() if key != "host")
            return {"url": f"{kind.scheme}://{where['host']}?{ports}", **where}
        url = f"{kind.scheme}://{where}" + (f"?{kind.query}" if kind.query else "")
        return {"url": url, "channel" if "interface" in kind.endpoint else "port": where, **kind.endpoint}

    @property
    def carries_nan(self) -> bool:
        """Whether the wire can carry NaN."""
        return self._kind is None or self._kind.floats

    @property
    def emulator(self) -> Device[Any]:
        """The emulator.

        Raises
        ------
        ValueError
            The sensor is the one in the wrist, which has no wire of its own.
        """
        if self._emulator is None:
            raise ValueError(f"{self.name} is part of the arm and has no wire of its own")
        return self._emulator

    def saturate(self, axis: int | None) -> None:
        """Let an axis, or a gauge if the sensor sends gauges, read the end of its range; None ends the saturation."""
        if axis is not None and not 0 <= axis < 6:
            raise ValueError(f"the axis must be 0 to 5, not {axis}")
        self.emulator.saturated_axis = axis

    def stop(self) -> None:
        """Stop the emulator."""
        if self._emulator is not None:
            self._emulator.stop()
