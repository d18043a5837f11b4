"""From the address of a sensor to its driver: ``ati-can://can0?bitrate=250000``.

The part before ``://`` chooses the driver, which is imported only then; the middle says where the device is; what
follows the question mark are the driver's options. Anything unknown is an error.
"""

from importlib import import_module
from typing import Protocol, cast
from urllib.parse import parse_qsl, unquote, urlsplit

from drivers.interfaces import ForceTorqueSensor

SENSORS = {
    "ati-can": "drivers.ati.can:AtiCanSensor",
    "ati-serial": "drivers.ati.serial:AtiSerialSensor",
}

_EXAMPLES = (
    "ati-can://can0?bitrate=250000&base=0x20",
    "ati-can:///dev/ttyACM0?interface=slcan",
    "ati-serial:///dev/serial/by-id/NAME?calibration=1",
)


class BadUrl(ValueError):
    """An address no driver understands: a mistake in the configuration, not of the device."""


class Options:
    """The options of one address; remembers which ones a driver asked for."""

    def __init__(self, url: str, query: str) -> None:
        self._url = url
        self._asked: set[str] = set()
        try:
            pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True) if query else []
        except ValueError as exc:
            raise BadUrl(f"{url}: options are key=value, joined by &") from exc
        self._given = dict(pairs)
        if len(self._given) < len(pairs):
            raise BadUrl(f"{url}: an option is given twice")

    def text(self, key: str, default: str) -> str:
        """Take an option as it stands."""
        self._asked.add(key)
        value = self._given.get(key, default)
        if not value:
            raise BadUrl(f"{self._url}: option '{key}' is empty")
        return value

    def integer(self, key: str, default: int, lowest: int, highest: int) -> int:
        """Take an option as a number, decimal or 0x hexadecimal."""
        text = self.text(key, str(default))
        try:
            value = int(text, 0)
        except ValueError as exc:
            raise BadUrl(f"{self._url}: option '{key}' is '{text}'; it must be a whole number") from exc
        if not lowest <= value <= highest:
            raise BadUrl(f"{self._url}: option '{key}' is {text}; allowed are {lowest} to {highest}")
        return value

    def reject_others(self) -> None:
        """Refuse options that nobody asked for."""
        if unknown := sorted(self._given.keys() - self._asked):
            raise BadUrl(f"{self._url}: unknown option {', '.join(unknown)}; known: {', '.join(sorted(self._asked))}")


class _FromUrl(Protocol):
    def from_url(self, address: str, options: Options, *, sign: int = 1) -> ForceTorqueSensor: ...


def sensor_from_url(url: str, *, sign: int = 1) -> ForceTorqueSensor:
    """Build the sensor an address names; nothing is opened.

    Parameters
    ----------
    url : str
        Such as ``ati-can://can0?bitrate=250000&base=0x20``, ``ati-can:///dev/ttyACM0?interface=slcan`` or
        ``ati-serial:///dev/serial/by-id/NAME?calibration=1``.
    sign : int
        -1 for a sensor that reports the reaction.

    Raises
    ------
    BadUrl
        Unknown scheme or option, a value out of range, or no device.
    """
    try:
        parts = urlsplit(url)
    except ValueError as exc:
        raise BadUrl(f"{url}: {exc}; write it like {', '.join(_EXAMPLES)}") from exc
    if parts.scheme not in SENSORS:
        raise BadUrl(f"{url}: unknown sensor '{parts.scheme}'; known: {', '.join(SENSORS)}, as in {_EXAMPLES[0]}")
    address = unquote(parts.netloc + parts.path)
    if not address or parts.fragment or not url.lower().startswith(f"{parts.scheme}://"):
        raise BadUrl(f"{url}: which device? Write it like {', '.join(_EXAMPLES)}")
    module, name = SENSORS[parts.scheme].split(":")
    driver = cast("_FromUrl", getattr(import_module(module), name))
    options = Options(url, parts.query)
    sensor = driver.from_url(address, options, sign=sign)
    options.reject_others()
    return sensor
