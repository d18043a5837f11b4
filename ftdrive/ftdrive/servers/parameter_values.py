"""What clients may set of a stream: the values of frame and stages, whichever protocol brings them."""

from math import isfinite
from typing import Any, get_args

from ftcalib.files import JSON
from ftdrive.errors import ConfigError
from ftdrive.live.samples import Axes, Point

_EXPECTED = {
    "axes": f"set one of {', '.join(get_args(Axes))}",
    "about": f"set one of {', '.join(get_args(Point))}, or x, y, z in metres from the flange",
    **dict.fromkeys(("bias", "gravity", "inertia"), "set true or false"),
    **dict.fromkeys(("notch_Hz", "lowpass_Hz"), "set a frequency; 0 switches the filter off"),
    **dict.fromkeys(("deadband_N", "deadband_Nm"), "set a number from 0"),
}


def checked_value(name: str, value: Any) -> JSON:
    """Return the value as the frame or the stages have it; raises `ConfigError`."""
    match name, value:
        case "axes", str() if value in get_args(Axes):
            return value
        case "about", str() if value in get_args(Point):
            return value
        case "about", [_, _, _] if all(map(_is_number, value)):
            return tuple(float(x) for x in value)
        case (("bias" | "gravity" | "inertia"), bool()):
            return value
        case (("notch_Hz" | "lowpass_Hz"), _) if _is_number(value) and value >= 0:
            return float(value) or None
        case (("deadband_N" | "deadband_Nm"), _) if _is_number(value) and value >= 0:
            return float(value)
    raise ConfigError(f"{name} cannot be {value!r}: {_EXPECTED.get(name, 'there is no such parameter')}")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
