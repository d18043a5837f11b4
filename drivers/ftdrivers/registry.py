"""Builds drivers from addresses such as ``ati-can://can0?bitrate=250000``.

The part before ``://`` selects the driver, which is imported only then. The middle is the port, bus or host of the
device. The options of the driver follow the question mark. Unknown schemes and options are errors.

Another package adds drivers by entry points: ``scheme = "package.module:Class"`` in the group ``ftdrive.sensors``,
where the class has a `from_url` like those of this project, and ``name = "package.module:Class"`` in the group
``ftdrive.arms``. An entry point cannot replace a driver of this project.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from importlib.metadata import EntryPoint, entry_points
from math import isfinite
from typing import Any, cast
from urllib.parse import parse_qsl, quote, unquote, urlsplit

from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import BadUrl
from ftdrivers.installation import install_command
from ftdrivers.interfaces import Fact, ForceTorqueSensor, RobotArm
from ftdrivers.sensors import SENSORS
from ftdrivers.streaming.sensor import StreamingSensor

ARMS: Mapping[str, str] = {"ros2": "ftdrivers.ros2.arm:Ros2Arm", "ur": "ftdrivers.ur.arm:UrArm"}

# The extra of ftdrive that installs a library for a driver; the keys are the names of the libraries.
_EXTRAS: Mapping[str, str] = {"pynetft": "netft"}

_EXAMPLES = (
    "ati-can://can0?bitrate=250000&base=0x20",
    "ati-can:///dev/ttyACM0?interface=slcan",
    "ati-serial:///dev/serial/by-id/NAME?calibration=1",
    "robotiq-ft300://192.168.1.10:63351",
)


class Options:
    """The options of one address. It records which options a driver has read, to reject all others."""

    def __init__(self, url: str, query: str) -> None:
        self._url = url
        self._asked: set[str] = set()
        try:
            pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True) if query else []
        except ValueError as exc:
            raise BadUrl(f"{url}: the options cannot be read; write them as key=value, joined by &") from exc
        self._given = dict(pairs)
        if len(self._given) < len(pairs):
            raise BadUrl(f"{url}: an option is given twice; remove one")

    def text(self, key: str, default: str) -> str:
        """Return the value of an option of the address as text."""
        self._asked.add(key)
        value = self._given.get(key, default)
        if not value:
            raise BadUrl(f"{self._url}: option '{key}' is empty; give it a value or leave it out")
        return value

    def optional(self, key: str) -> str | None:
        """Return an option as text, or None if the address does not have it."""
        self._asked.add(key)
        return self.text(key, "") if key in self._given else None

    def integer(self, key: str, default: int, lowest: int, highest: int) -> int:
        """Return an option as an integer, written as a decimal or a 0x hexadecimal number."""
        text = self.text(key, str(default))
        try:
            value = int(text, 0)
        except ValueError as exc:
            raise BadUrl(f"{self._url}: option '{key}' is '{text}'; it must be a whole number") from exc
        if not lowest <= value <= highest:
            raise BadUrl(f"{self._url}: option '{key}' is {text}; allowed are {lowest} to {highest}")
        return value

    def counts(self) -> tuple[int, int] | None:
        """Return the option `counts`: counts per unit of force and per unit of torque; None without this option."""
        if (text := self.optional("counts")) is None:
            return None
        force, _, torque = text.partition(",")
        if not (force.isdecimal() and torque.isdecimal() and int(force) and int(torque)):
            raise BadUrl(
                f"{self._url}: option 'counts' is '{text}'; give two whole numbers, per unit of force and of torque, "
                "such as 1000000,1000000"
            )
        return int(force), int(torque)

    def positive(self, key: str, why: str) -> float:
        """Return a required option as a positive number. The error message ends with `why`: where to find the value."""
        if key not in self._given:
            raise BadUrl(f"{self._url}: option '{key}' is missing: {why}")
        text = self.text(key, "")
        try:
            value = float(text)
        except ValueError:
            value = 0.0
        if not (isfinite(value) and value > 0):
            raise BadUrl(f"{self._url}: option '{key}' is '{text}'; it must be a positive number")
        return value

    def configured(self) -> dict[str, Fact]:
        """Return what the address gives as `serial` and `range`, options of every sensor, as facts about the device."""
        facts = {}
        if "serial" in self._given:
            facts["serial"] = Fact(self.text("serial", ""), "configured")
        if "range" in self._given:
            text = self.text("range", "")
            try:
                numbers = [float(number) for number in text.split(",")]
            except ValueError:
                numbers = []
            if len(numbers) == 2:
                numbers = [numbers[0]] * 3 + [numbers[1]] * 3
            if len(numbers) != 6 or not all(isfinite(number) and number > 0 for number in numbers):
                raise BadUrl(
                    f"{self._url}: option 'range' is '{text}'; give the largest force in N and torque in N·m, such as "
                    "300,30 or 300,300,500,30,30,20"
                )
            facts["range"] = Fact(tuple(numbers), "configured")
        self._asked |= {"serial", "range"}
        return facts

    def reject_others(self) -> None:
        """Reject options that the driver has not read."""
        if unknown := sorted(self._given.keys() - self._asked):
            known = ", ".join(sorted(self._asked)) or "none"
            raise BadUrl(f"{self._url}: unknown option {', '.join(unknown)}; known: {known}")


@dataclass(frozen=True, slots=True)
class _UrlParts:
    """The parts of an address, before they are checked."""

    scheme: str
    address: str
    """Port, bus or host of the device, percent-decoded."""
    query: str
    """The options after the question mark, still percent-encoded."""
    fragment: str


def split_url(url: str) -> _UrlParts:
    """Split an address into its parts. Raises `BadUrl` if the address is not a valid URL."""
    try:
        parts = urlsplit(url)
    except ValueError as exc:
        raise BadUrl(f"{url}: {exc}; write it like {', '.join(_EXAMPLES)}") from exc
    return _UrlParts(parts.scheme, unquote(parts.netloc + parts.path), parts.query, parts.fragment)


def in_url(address: str) -> str:
    """Quote the name of a port, bus or host for an address; it may contain a space or a question mark."""
    return quote(address, safe="/:@")


def join_url(scheme: str, address: str, options: Mapping[str, str]) -> str:
    """Return the address of a sensor with these options."""
    query = "&".join(f"{key}={value}" for key, value in options.items())
    return f"{scheme}://{in_url(address)}" + (f"?{query}" if query else "")


def sensor_from_url(url: str, *, sign: int = 1, clock: Clock = REAL) -> ForceTorqueSensor:
    """Build the driver of the sensor at an address, without opening the device.

    Parameters
    ----------
    url : str
        Such as ``ati-can://can0?bitrate=250000&base=0x20``, ``ati-can:///dev/ttyACM0?interface=slcan`` or
        ``ati-serial:///dev/serial/by-id/NAME?calibration=1``; all are in docs/reference/sensors.md.
    sign : int
        -1 for a sensor that reports the reaction.
    clock : Clock
        Clock of an emulated cell. A driver of another package gets no clock.

    Raises
    ------
    BadUrl
        The scheme or an option is unknown, a value is out of range, the device is missing, or the driver cannot be
        imported.
    """
    parts = split_url(url)
    own = {scheme: kind.driver for scheme, kind in SENSORS.items()}
    entry = _find("ftdrive.sensors", own, parts.scheme)
    if entry is None:
        known = ", ".join(names := _names("ftdrive.sensors", own))
        if not parts.scheme:
            raise BadUrl(f"{url} is not an address of a sensor: write it like {', '.join(_EXAMPLES)}")
        close = [f"did you mean {name}://?" for name in get_close_matches(parts.scheme, names, 1)]
        fix = close[0] if close else f"install the package of its driver, or give one of {known}"
        raise BadUrl(f"{url}: unknown sensor '{parts.scheme}': {fix}")
    begins = (f"{parts.scheme}://", "ros2:/")  # a topic is a path, without a host
    if not parts.address.strip("/") or parts.fragment or not url.lower().startswith(begins):
        examples = [example for example in _EXAMPLES if example.startswith(f"{parts.scheme}:")] or _EXAMPLES
        raise BadUrl(f"{url} names no device; write it like {', '.join(examples)}")
    driver = _load(entry)
    if not hasattr(driver, "from_url"):
        raise BadUrl(f"{url}: {entry.value} has no from_url, so it is not a driver; reinstall {_package(entry)}")
    options = Options(url, parts.query)
    recover, configured = bool(options.integer("recover", 0, 0, 1)), options.configured()
    own_time = {} if clock is REAL else {"clock": clock}
    try:
        sensor: ForceTorqueSensor = driver.from_url(parts.address, options, sign=sign, **own_time)
    except ValueError as exc:
        raise BadUrl(f"{url}: {exc}") from exc
    options.reject_others()
    if isinstance(sensor, StreamingSensor):
        sensor.recover, sensor.configured = recover, configured
    elif recover or configured:
        raise BadUrl(f"{url}: this driver has no options recover, serial and range; leave them out")
    return sensor


def arm_class(name: str = "ur") -> type[RobotArm]:
    """Return the class of an arm by its name.

    The constructor of the class takes these arguments of `ftdrivers.ur.arm.UrArm`: the host, and as keywords `model`,
    `speed_rad_s` and `acceleration_rad_s2`.

    Raises
    ------
    BadUrl
        The name is unknown, or the driver cannot be imported.
    """
    entry = _find("ftdrive.arms", ARMS, name)
    if entry is None:
        raise BadUrl(f"unknown arm '{name}'; known: {', '.join(_names('ftdrive.arms', ARMS))}")
    return cast("type[RobotArm]", _load(entry))


def _find(group: str, own: Mapping[str, str], name: str) -> EntryPoint | None:
    """Look up the entry point of a name in this project, then in other packages; None if there is none."""
    if name in own:
        return EntryPoint(name, own[name], group)
    found = sorted(entry_points(group=group, name=name), key=lambda entry: entry.value)
    if len(found) > 1:
        packages = " and ".join(_package(entry) for entry in found)
        raise BadUrl(f"'{name}' is provided by {packages}; uninstall one of them")
    return found[0] if found else None


def _names(group: str, own: Mapping[str, str]) -> list[str]:
    return [*own, *sorted({entry.name for entry in entry_points(group=group)} - own.keys())]


def _load(entry: EntryPoint) -> Any:
    try:
        return entry.load()
    except Exception as exc:  # a module of another package may raise anything
        missing = (isinstance(exc, ImportError) and exc.name) or ""
        if missing in _EXTRAS:
            fix = f"install it with `{install_command(_EXTRAS[missing])}`"
        elif missing in sys.stdlib_module_names:
            fix = "use Linux, because this system lacks that module"
        else:
            fix = f"reinstall {_package(entry)}"
        raise BadUrl(f"the driver '{entry.name}' cannot be imported ({type(exc).__name__}: {exc}): {fix}") from exc


def _package(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else "ftdrive"
