"""The sensors that a station can start, by name, with the emulator and the address of each.

Addresses have the form of docs/reference/sensors.md. Other clients use the path or port in them.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np

from ftmocks.arrays import Array
from ftmocks.clock import CellClock
from ftmocks.sensors import bota, robotous
from ftmocks.wires.device import Device

MeasureAt = Callable[[Array], Array]


@dataclass(frozen=True)
class Kind:
    """One kind of sensor.

    Parameters
    ----------
    emulator
        Module and class of the emulator.
    scheme, query
        Scheme and options of the address; the path of the pseudo-terminal is between them.
    endpoint
        Settings for a client that does not use such addresses.
    options
        Options of the emulator.
    settings
        Settings of `--sensor-setting`: the option of the emulator, and the function that converts the text.
    at_host
        Whether the emulator listens at the address of the station instead of using a pseudo-terminal.
    bias_scale
        Factors on force and torque of the random bias, which has up to 15 N and 1 N·m.
    floats
        Whether the wire can carry NaN.
    """

    emulator: str
    scheme: str
    query: str = ""
    endpoint: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, tuple[str, Callable[[str], Any]]] = field(default_factory=dict)
    at_host: bool = False
    bias_scale: tuple[float, float] = (1.0, 1.0)
    floats: bool = False


def _slcan(bitrate: int, **more: Any) -> dict[str, Any]:
    return {"interface": "slcan", "bitrate": bitrate, **more}


def _numbers(text: str) -> list[float]:
    numbers = [float(part) for part in text.split(",")]
    if len(numbers) != 6 or not np.isfinite(numbers).all():
        raise ValueError(f"expected 6 numbers separated by commas, got {text!r}")
    return numbers


def _identifiers(text: str) -> tuple[int, ...]:
    numbers = tuple(int(part, 0) for part in text.split(","))
    if len(set(numbers)) != 3 or not all(0 <= number < 0x800 for number in numbers):
        raise ValueError(f"expected 3 different CAN identifiers from 0 to 0x7FF, got {text!r}")
    return numbers


def _bota_baud_code(text: str) -> int:
    if not text.isdecimal() or int(text) not in bota.BAUD_RATES:
        raise ValueError(f"unknown baud rate {text!r}; known: {', '.join(map(str, bota.BAUD_RATES))}")
    return bota.BAUD_RATES.index(int(text))


def _seconds(text: str) -> float:
    if not 0.0 <= float(text) < np.inf:
        raise ValueError(f"expected a time in s, got {text!r}")
    return float(text)


def _model(name: str) -> robotous.Model:
    if name not in robotous.MODELS:
        raise ValueError(f"unknown model {name!r}; known: {', '.join(robotous.MODELS)}")
    return robotous.MODELS[name]


FT300_BIAS_SCALE = (3.3, 1.2)
"""One at rest reads (-20.7, 22.0, -48.7) N and (-0.10, 1.17, -0.32) N·m: ros-industrial-attic/robotiq, request 215."""
NETFT_BIAS_SCALE = (1.1, 2.1)
"""A real sensor has a bias of (15.4, -12.2, -1.7) N and (-1.2, -2.1, 0.05) N·m: philip-long/FoamCutting_kukalwr."""

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
        "ftmocks.sensors.robotous:RobotousCanNode",
        "robotous-can",
        "interface=slcan&rate=1000",
        _slcan(1_000_000),
        settings={"model": ("model", _model), "ids": ("ids", _identifiers)},
    ),
    "robotous-serial": Kind(
        "ftmocks.sensors.robotous:RobotousSerialBox",
        "robotous-serial",
        "baud=115200&rate=200",
        {"baud": 115_200},
        settings={"model": ("model", _model)},
    ),
    "robotiq": Kind("ftmocks.sensors.robotiq:RobotiqBox", "robotiq-ft300", bias_scale=FT300_BIAS_SCALE),
    "robotiq-urcap": Kind(
        "ftmocks.sensors.robotiq_urcap:RobotiqUrcap", "robotiq-ft300", at_host=True, bias_scale=FT300_BIAS_SCALE
    ),
    "bota": Kind(
        "ftmocks.sensors.bota:BotaBox",
        "bota",
        settings={"baud": ("baud_code", _bota_baud_code), "boot-s": ("boot_s", _seconds)},
        floats=True,
    ),
    "netft": Kind(
        "ftmocks.sensors.netft:NetFtBox",
        "ati-netft",
        options={"rdt_port": 0, "rate_hz": 1000},
        settings={"tool-transform": ("tool_transform", _numbers), "bias": ("bias", _numbers)},
        at_host=True,
        bias_scale=NETFT_BIAS_SCALE,
    ),
}
"""Sensors with a wire of their own, by name."""

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
        module, _, class_name = self._kind.emulator.partition(":")
        given = self._kind.options | (options or {}) | ({"host": host} if self._kind.at_host else {})
        make: Callable[..., Device[Any]] = getattr(import_module(module), class_name)
        emulator: Device[Any] = make(
            lambda count: measure_at(emulator.sample_times_s(count)), seed=seed, clock=clock, **given
        )
        self._emulator = emulator
        self.endpoint = self._endpoint(self._kind, emulator.start())

    def _endpoint(self, kind: Kind, where: Any) -> dict[str, Any]:
        """Return the description that the station prints; the address is under "url"."""
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
