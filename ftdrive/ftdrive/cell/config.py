# ruff: noqa: RUF009 - `entry` returns a new field for each key
"""Configuration of a cell: keys with their rules, the source of each value, and the configuration file.

A value comes from the first of these sources that sets it: an option of the command; the environment, where
FTDRIVE_ROBOT_HOST is the key `host` of `[robot]`; the project's file, which is `ftdrive.toml` in the working directory
or `--config`; the user's file, `$XDG_CONFIG_HOME/ftdrive/ftdrive.toml`; the default. Values that must be measured have
no default. The averaging time is chosen from a noise record, unless `average_s` is set and `noise_record_s` is not.
"""

import json
import os
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields
from difflib import get_close_matches
from inspect import getdoc
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from textwrap import wrap
from typing import Any

from ftcalib.files import read_file
from ftcalib.sampling import Sampling
from ftdrive.cell import rules
from ftdrive.cell.rules import Rows, Rule, entry, rule_of
from ftdrive.errors import ConfigError
from ftdrivers.clock import REAL, Clock

FORMAT = "ftdrive.config/1"
FILE = "ftdrive.toml"
PREFIX = "FTDRIVE_"
CLOCK = "FTDRIVE_CLOCK"
_HOMES = {"config": "~/.config", "data": "~/.local/share", "state": "~/.local/state"}

# Assumed mass of a tool whose mass is not configured.
USUAL_KG = 1.0
# Standard deviation per axis of a flange orientation from nominal kinematics; 20 real arms are off by 0.13° to 1.04°.
NOMINAL_ORIENTATION_DEG = 0.3


# The rule of a key is defined at its field, so that type, range and text stay consistent.
@dataclass(frozen=True, slots=True)
class RobotConfig:
    """The arm."""

    host: str = entry(
        "name or IPv4 address of the controller, or ROS 2 topics such as ros2:/pose",
        option="--robot",
        reject=rules.reject_host,
    )
    model: str | None = entry(
        'model of the arm, such as "ur5e"; compared with the model that the controller reports',
        None,
        option="--model",
        reject=rules.reject_model,
    )
    speed_deg_s: float = entry(
        "speed of the fastest joint; the first run of a plan is slower", 60.0, "deg/s", (0.5, 60), option="--speed"
    )
    acceleration_deg_s2: float = entry("acceleration of the fastest joint", 80.0, "deg/s²", (1, 300))
    stop_deceleration_deg_s2: float = entry(
        "deceleration of the fastest joint in a stop; lower it if a stop with a heavy tool causes a protective stop",
        300.0,
        "deg/s²",
        (60, 300),
    )
    tip_speed_mm_s: float = entry(
        "speed of the tool's farthest point; 250 is the reduced speed of ISO 10218-1", 250.0, "mm/s", (1, 250)
    )
    orientation_accuracy_deg: float | None = entry(
        "standard deviation per axis of the flange orientation; if it is not set, 0.06 is assumed, which is typical of "
        "factory-calibrated kinematics; 0 declares an exact arm with rigid mounts",
        None,
        "deg",
        (0, 5),
    )
    driver: str = entry("driver of the arm: ur, or an entry point of another package", "ur", reject=rules.reject_empty)
    control: str = entry(
        "control path: auto, ur-rtde or script; auto takes ur-rtde if it is installed and the controller supports it; "
        "script starts to brake within 0.3 s when this computer or the network fails",
        "auto",
        reject=rules.reject_control,
    )
    api_port: int = entry("port of the Robot API of PolyScope X", 80, between=(1, 65535))
    serial: str | None = entry("serial number; if set, no other arm is moved", None, reject=rules.reject_empty)
    simulate: bool = entry(
        "true for an emulated cell: commands with --simulate use its tool, masses, surroundings and speed; other "
        "commands refuse it",
        False,
    )


@dataclass(frozen=True, slots=True)
class SensorConfig:
    """The force/torque sensor."""

    url: str = entry("address, such as ati-can://can0?bitrate=250000", option="--sensor", reject=rules.reject_empty)
    sign: int = entry(
        "1, or -1 for a sensor that reports the reaction; `ftdrive doctor --push` finds it", 1, reject=rules.reject_sign
    )
    height_mm: float | None = entry(
        "height of the sensor's origin above the flange face; gravity does not determine it",
        None,
        "mm",
        (0, 500),
        option="--height",
        reject=rules.reject_height,
    )
    mass_kg: float | None = entry(
        "mass of sensor and adapter, from a scale or data sheet; the sensor cannot measure it",
        None,
        "kg",
        (0, 20),
        option="--sensor-mass",
    )
    accuracy_percent: float | None = entry(
        "accuracy under load (95 % of readings), from the data sheet or a check; 4 is assumed if it is not set",
        None,
        "%",
        (0, 20),
    )
    range_N: float | None = entry("measuring range of the forces, from the data sheet", None, "N", (0, 1e5))
    range_Nm: float | None = entry("measuring range of the torques", None, "N·m", (0, 1e4))
    delay_ms: float | None = entry(
        "delay of the wrench relative to the pose; estimated from motion if it is not set", None, "ms", (-100, 100)
    )
    mount: str | None = entry(
        "label of the mounting, such as adapter-a; a calibration is valid for one label: change it when the sensor is "
        "remounted",
        None,
        reject=rules.reject_empty,
    )


@dataclass(frozen=True, slots=True)
class ToolConfig:
    """Everything mounted on the flange, including the sensor. Parts that are not described here may collide."""

    name: str = entry(
        "name of the tool; `live --tool NAME` uses its newest calibration",
        "tool",
        option="--tool-name",
        reject=rules.reject_empty,
    )
    cylinders_mm: Rows = entry(
        "[from, to, diameter] along the flange z axis from the flange face; [from, to, diameter, x, y] shifts the axis "
        "sideways; include cables, cameras and screws",
        (),
        "mm",
        option="--tool",
        reject=rules.reject_cylinders,
    )
    mass_kg: float | None = entry(
        "approximate mass below the sensor; compared with the controller's payload and the sensor's range; until six "
        "poses are taken, it sets the limit on changes in the wrench",
        None,
        "kg",
        (0.001, 100),
        option="--tool-mass",
    )
    mass_sigma_kg: float | None = entry(
        "standard deviation of mass_kg, if the tool was weighed on a scale; the mass then calibrates the gain of the "
        "sensor; 0.2 % of the mass is typical",
        None,
        "kg",
        (0, 1),
    )


@dataclass(frozen=True, slots=True)
class WorkcellConfig:
    """Base and surroundings, in base axes, mm from the centre of the base. PLACEHOLDERS until measured."""

    mounting: str | None = entry(
        "floor, wall, ceiling, or the tilt of the base towards -x in degrees, 90 for a wall; if it is not set, a floor "
        "is assumed, and results with another gravity direction are not rated good",
        None,
        option="--mounting",
        reject=rules.reject_mounting,
    )
    planes_mm: Rows = entry(
        "[nx, ny, nz, offset]: the arm stays where normal · point is at least the offset; [-1, 0, 0, -800] is a wall "
        "at +x 800 mm; the plane under the base is always included",
        (),
        "mm",
        option="--plane",
        reject=rules.reject_planes,
    )
    boxes_mm: Rows = entry(
        "[x, y, z, x, y, z], two opposite corners of a box", (), "mm", option="--box", reject=rules.reject_boxes
    )
    measured: bool = entry("set it to true once tool, planes and boxes are measured; until then nothing moves", False)


_ROUTINE = {item.name: item.default for item in fields(Sampling)}


@dataclass(frozen=True, slots=True)
class _SamplingConfig(Sampling):
    """Averaging of each pose."""

    average_s: float = entry(
        "averaging time of each pose; if only this key is set, no noise record is taken",
        _ROUTINE["average_s"],
        "s",
        (0.05, 600),
    )
    still_timeout_s: float = entry("time-out until the arm rests at a pose", _ROUTINE["still_timeout_s"], "s", (1, 600))
    attempts: int = entry(
        "number of averages tried at a pose with motion or drift; the last one is kept and marked as noisy",
        _ROUTINE["attempts"],
        between=(1, 100),
    )
    noise_record_s: float = entry(
        "noise record of the resting sensor before the tour, which sets the averaging time; 0 for none",
        _ROUTINE["noise_record_s"],
        "s",
        (0, 600),
        reject=rules.reject_record,
    )


@dataclass(frozen=True, slots=True)
class _SiteConfig:
    """Location of the cell."""

    g_m_s2: float = entry("local gravity; it only scales the mass", 9.80665, "m/s²", (9.7, 9.9))


@dataclass(frozen=True, slots=True)
class _StoreConfig:
    """Store of results and verifications, an index of run folders."""

    url: str | None = entry(
        "address of the database, such as sqlite:////data/store.sqlite; without it, a file in the user's data folder",
        None,
        reject=rules.reject_store,
    )


@dataclass(frozen=True, slots=True)
class CellConfig:
    """Configuration of a cell."""

    robot: RobotConfig
    sensor: SensorConfig
    tool: ToolConfig = field(default_factory=ToolConfig)
    workcell: WorkcellConfig = field(default_factory=WorkcellConfig)
    sampling: Sampling = field(default_factory=_SamplingConfig)
    site: _SiteConfig = field(default_factory=_SiteConfig)
    store: _StoreConfig = field(default_factory=_StoreConfig)
    clock: Clock = field(default=REAL, compare=False, repr=False)
    """Clock of the cell; an emulated cell has its own clock. Files do not contain it."""

    @property
    def is_emulated(self) -> bool:
        """Whether the cell is emulated, and therefore has its own clock."""
        return self.clock is not REAL

    def to_dict(self) -> dict[str, Any]:
        """Return the sections as in a file, without the password in the store's address."""
        sections = {name: asdict(getattr(self, name)) for name in SECTIONS}
        if self.store.url is not None:
            sections["store"]["url"] = without_password(self.store.url)
        return sections


@dataclass(frozen=True, slots=True)
class Setting:
    """A value of the configuration and its origin."""

    value: Any
    """The value; None if no source sets it and it has no default."""
    origin: str
    """The option, variable or file that sets it; "default" or "not set"."""


def without_password(text: str) -> str:
    """Return an address, or an argument of a command line, without its password."""
    return re.sub(r"(://[^:/@]*):.*@", r"\1@", text)


# An option of a command, such as "--robot", and its value, which is None if the option was not given.
Flag = tuple[str, Any]

SECTIONS: Mapping[str, Any] = {
    "robot": RobotConfig,
    "sensor": SensorConfig,
    "tool": ToolConfig,
    "workcell": WorkcellConfig,
    "sampling": _SamplingConfig,
    "site": _SiteConfig,
    "store": _StoreConfig,
}
_KEYS = {f"{name}.{item.name}": item for name, kind in SECTIONS.items() for item in fields(kind)}

RULES: Mapping[str, Rule] = {key: rule_of(item) for key, item in _KEYS.items()}


def clock_in_force() -> Clock:
    """Return the clock of the emulated cell that FTDRIVE_CLOCK names, else the computer's clock.

    An emulated cell in another process looks like a real one, but only its own clock waits for a busy computer.
    """
    if page := os.environ.get(CLOCK):
        from ftdrive.cell.emulated_clock import EmulatedClock

        return EmulatedClock(page)
    return REAL


def load(config: Path | None = None, flags: Mapping[str, Flag] | None = None, *, devices: bool = True) -> CellConfig:
    """Return the cell from all sources (see `settings`); with `devices` false, arm and sensor may lack an address."""
    return cell_of(settings(config, flags), devices=devices)


def settings(
    config: Path | None = None, flags: Mapping[str, Flag] | None = None, *, cell: CellConfig | None = None
) -> dict[str, Setting]:
    """Return every key, such as "robot.host", with its value and origin.

    `config` replaces the project's file. `flags` are options of the command by key, such as
    ``{"robot.host": ("--robot", "10.0.0.2")}``. An emulated `cell` replaces all files and variables. Raises
    `ConfigError`, whose message names source, section, key and value, and the remedy.
    """
    found: dict[str, Setting] = {}
    if cell is not None:
        values = {key: attrgetter(key)(cell) for key in _KEYS}
        found = {key: Setting(value, "emulated cell") for key, value in values.items() if value is not None}
    else:
        for path in (user_folder("config") / FILE, config or Path(FILE)):
            if path == config or path.is_file():
                found |= _from_file(path)
        found |= _from_environment()
    for key, (option, value) in (flags or {}).items():
        if value is not None:
            found[key] = Setting(check_value(option, key, value), option)
    # If an averaging time is set, no noise is recorded to choose one.
    if "sampling.average_s" in found:
        found.setdefault("sampling.noise_record_s", Setting(0.0, found["sampling.average_s"].origin))
    defaults = {key: None if item.default is MISSING else item.default for key, item in _KEYS.items()}
    unset = {key: Setting(value, "not set" if value is None else "default") for key, value in defaults.items()}
    return unset | found


def cell_of(values: Mapping[str, Setting], *, devices: bool = True) -> CellConfig:
    """Return the cell of these settings; raises `ConfigError` if a needed device has no address or is emulated."""
    if devices and values["robot.simulate"].value:
        origin = values["robot.simulate"].origin
        raise ConfigError(
            f"{origin} describes an emulated cell ([robot] simulate = true): add --simulate, or describe your cell "
            "with `ftdrive init -o NEW.toml`"
        )
    missing = [key for key in ("robot.host", "sensor.url") if values[key].value is None]
    if missing and devices:
        section, key = missing[0].split(".")
        raise ConfigError(
            f"[{section}] {key} is not set: write it into {FILE} (`ftdrive init` asks for it), set "
            f"{variable(missing[0])} or give {RULES[missing[0]].option}; --simulate uses an emulated cell"
        )
    found = {key: setting.value for key, setting in values.items()} | dict.fromkeys(missing, "")
    return CellConfig(
        **{
            name: kind(**{item.name: found[f"{name}.{item.name}"] for item in fields(kind)})
            for name, kind in SECTIONS.items()
        },
        clock=clock_in_force(),
    )


def variable(key: str) -> str:
    """Return the environment variable of a key."""
    return PREFIX + key.replace(".", "_").upper()


def as_toml(value: Any) -> str:
    """Return a value as TOML."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return json.dumps(value)


def user_folder(kind: str) -> Path:
    """Return the user's folder for "config", "data" or "state", which may not exist."""
    home = os.environ.get(f"XDG_{kind.upper()}_HOME", "")
    return (Path(home) if Path(home).is_absolute() else Path(_HOMES[kind]).expanduser()) / "ftdrive"


def _from_file(path: Path) -> dict[str, Setting]:
    document = read_toml(path)
    if (version := document.pop("format", None)) != FORMAT:
        instead = "" if version is None else f", but it is {version!r}"
        raise ConfigError(f'{path}: the first line must be format = "{FORMAT}"{instead}')
    if unknown := sorted(document.keys() - SECTIONS.keys()):
        raise ConfigError(f"{path}: unknown section [{unknown[0]}]: {_suggestion(unknown[0], 'sections', SECTIONS)}")
    values: dict[str, Setting] = {}
    for section, content in document.items():
        if not isinstance(content, dict):
            raise ConfigError(
                f"{path}: {section} = {content!r} is not a section: write [{section}] on its own line, and the keys "
                "below"
            )
        for key, value in content.items():
            if f"{section}.{key}" not in _KEYS:
                raise ConfigError(
                    f"{path}: [{section}] has no key '{key}': {_suggestion(key, 'keys', _key_names(section))}"
                )
            values[f"{section}.{key}"] = Setting(check_value(str(path), f"{section}.{key}", value), str(path))
    return values


def read_toml(path: Path) -> dict[str, Any]:
    """Return the contents of a TOML file; raises `ConfigError` if it is not TOML, `OSError` if it cannot be read."""
    try:
        return tomllib.loads(read_file(path).decode("utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not a TOML file: {error}; correct it") from error
    except RecursionError as error:
        raise ConfigError(f"{path} is not a TOML file: its brackets are nested too deeply; correct it") from error


def _from_environment() -> dict[str, Setting]:
    values: dict[str, Setting] = {}
    names = {variable(key): key for key in _KEYS}
    for name, text in os.environ.items():
        if name in names:
            values[names[name]] = Setting(
                check_value(name, names[name], _parse_variable(name, names[name], text)), name
            )
            continue
        for section in SECTIONS:
            if name.startswith(start := variable(section) + "_"):
                known = _suggestion(name.removeprefix(start).lower(), "keys", _key_names(section))
                raise ConfigError(f"{name} is set, but [{section}] has no such key: {known}; unset the variable")
    return values


def _parse_variable(name: str, key: str, text: str) -> Any:
    """Return the value of an environment variable: a string unchanged, other types parsed as TOML."""
    if not text:
        raise ConfigError(f"{name} is empty: give it a value for [{key.replace('.', '] ')}, or unset it")
    if _KEYS[key].type in {str, str | None}:
        return text
    try:
        document = tomllib.loads(f"value = {text}")
    except (tomllib.TOMLDecodeError, RecursionError):
        document = {}
    return document["value"] if document.keys() == {"value"} else text


def _key_names(section: str) -> list[str]:
    return [item.name for item in fields(SECTIONS[section])]


def _suggestion(unknown: str, kind: str, names: Iterable[str]) -> str:
    near = get_close_matches(unknown, names, 1)
    return f"{f'did you mean {near[0]}? ' if near else ''}the {kind} are {', '.join(names)}"


def read_recorded(config: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the sections that a run has recorded; raises `ConfigError` for a value of the wrong type.

    Unknown keys are left out. Ranges are not checked, because another version may have had other ranges.
    """
    return {
        section: {
            item.name: rules.require_type(f"[{section}] {item.name} = {values[item.name]!r}", item, values[item.name])
            for item in fields(SECTIONS[section])
            if item.name in values
        }
        for section, values in config.items()
        if section in SECTIONS
    }


def recorded_cell(config: Mapping[str, Mapping[str, Any]]) -> CellConfig:
    """Return the cell that a run recorded, from its sections as `read_recorded` returns them."""
    return CellConfig(**{name: kind(**config.get(name, {})) for name, kind in SECTIONS.items()}, clock=clock_in_force())


def orientation_accuracy_deg(host: str | None, declared: float | None) -> float | None:
    """Return the declared accuracy; if None, that of nominal kinematics for an arm known by URDF only, or None."""
    nominal = NOMINAL_ORIENTATION_DEG if host is not None and "urdf=" in host else None
    return nominal if declared is None else declared


def check_value(place: str, key: str, value: Any) -> Any:
    """Return the value of a key such as "robot.host" converted to its type; raises `ConfigError` if it is invalid."""
    where = f"{place}: [{key.replace('.', '] ')} = {value!r}"
    if key == "workcell.mounting" and rules.is_number(value):  # degrees
        value = str(value)
    return rules.ruled(where, _KEYS[key], value)


# Longest line of a configuration file.
WIDTH = 120


def cell_file(cell: CellConfig, reports: Sequence[str]) -> str:
    """Return the configuration file of a cell, with comments about its devices; `workcell.measured` is always false.

    Keys that `init` does not ask for are commented out, so that the user's file still sets them.
    """
    values = {f"{section}.{key}": value for section, keys in cell.to_dict().items() for key, value in keys.items()}
    values["workcell.measured"] = False
    asked = {key for key, rule in RULES.items() if rule.option} | {"workcell.measured"}
    asked |= {"robot.simulate"} if cell.robot.simulate else set()
    lines = [
        *(f"# {''.join(c if c.isprintable() else '?' for c in words)}" for words in reports),
        "# To print all values and their origins: ftdrive config show --origin",
    ]
    return document(values, lambda key: RULES[key].description, head=["", *lines], active=lambda key: key in asked)


def document(
    values: Mapping[str, Any],
    comment: Callable[[str], str],
    *,
    head: Sequence[str] = (),
    active: Callable[[str], bool] = lambda _: True,
    width: int = WIDTH,
) -> str:
    """Return values by key, such as "robot.host", as a file; values that are None or not active are commented out."""
    lines = [f'format = "{FORMAT}"', *head]
    for section, keys in groupby(values, lambda key: key.split(".")[0]):
        about = wrap(getdoc(SECTIONS[section]) or "", width - 2)
        lines += ["", *(f"# {part}" for part in about), f"[{section}]"]
        for key in keys:
            lines += _entry(key.split(".")[1], values[key], comment(key), active(key), width)
    return "".join(f"{line}\n" for line in lines)


def _entry(name: str, value: Any, comment: str, active: bool, width: int) -> Iterator[str]:
    """Yield the lines of a value in a configuration file; its comment follows if there is room, or else precedes it."""
    text = f"{name} =" if value is None else f"{name} = {as_toml(value)}"
    line = f"{text if active and value is not None else f'# {text}':<32} # {comment}".removesuffix(" # ").rstrip()
    if len(line) <= width:
        yield line
        return
    yield from (f"# {part}" for part in wrap(comment, width - 2))
    if len(text) > width and isinstance(value, tuple | list):
        yield from (f"{name} = [", *(f"  {as_toml(row)}," for row in value), "]")
    else:
        yield line.removesuffix(f" # {comment}").rstrip()
