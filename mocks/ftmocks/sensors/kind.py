"""What a station has to know about a sensor: `KINDS` in the module of its emulator, by the name of the sensor."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from ftmocks.wires.device import Device


@dataclass(frozen=True)
class Kind:
    """One kind of sensor.

    Parameters
    ----------
    emulator
        Class of the emulator.
    scheme, query
        Scheme and options of the address; the path of the pseudo-terminal is between them.
    endpoint
        Settings with which a client that does not use such addresses can connect.
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

    emulator: Callable[..., Device[Any]]
    scheme: str
    query: str = ""
    endpoint: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, tuple[str, Callable[[str], Any]]] = field(default_factory=dict)
    at_host: bool = False
    bias_scale: tuple[float, float] = (1.0, 1.0)
    floats: bool = False
