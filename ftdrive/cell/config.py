"""One cell: which arm, sensor, tool and surroundings; where each value comes from, and whether it can be used.

A value is taken from the first of these that tells it: an option of the command; the environment, where
FTDRIVE_ROBOT_HOST is the key `host` of `[robot]`; the project's file, `ftdrive.toml` where the command is run, or
`--config`; the user's file, `$XDG_CONFIG_HOME/ftdrive/ftdrive.toml`; the default. What must be measured has none. How
long to average at a pose is chosen from a record of the sensor at rest, unless `average_s` is said and no
`noise_record_s` is.
"""

import json
import os
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, asdict, dataclass, field, fields
from math import isfinite
from pathlib import Path
from typing import Any

from calib.routine import Sampling
from drivers.clock import REAL, Clock
from ftdrive.errors import ConfigError

FORMAT = "ftdrive.config/1"
FILE = "ftdrive.toml"
PREFIX = "FTDRIVE_"

Rows = tuple[tuple[float, ...], ...]

USUAL_KG = 1.0
"""What a tool is expected to weigh that nobody has weighed."""


@dataclass(frozen=True, slots=True)
class RobotConfig:
    """The arm."""

    host: str
    """Name or IPv4 address of the controller; empty where no arm is needed."""
    model: str | None = None
    """Such as "ur5e"; checked against the controller where it can tell."""
    speed_deg_s: float = 60.0
    """Of the fastest joint in a move; 60 at most."""
    acceleration_deg_s2: float = 80.0
    tip_speed_mm_s: float = 250.0
    """Of the tool's farthest points; 250 at most, the reduced speed of ISO 10218-1."""
    driver: str = "ur"
    """Of another package, by its entry point: drivers/README."""
    serial: str | None = None
    """Of the arm, as its controller tells it; where it is said, nothing moves on another."""


@dataclass(frozen=True, slots=True)
class SensorConfig:
    """The force/torque sensor."""

    url: str
    """Such as "ati-can://can0?bitrate=250000"; empty where no sensor is needed."""
    sign: int = 1
    """-1 for a sensor that reports the reaction."""
    height_mm: float | None = None
    """Of the sensor's origin above the flange face; gravity cannot tell it."""
    mass_kg: float | None = None
    """Of sensor and adapter, which the sensor cannot weigh."""


@dataclass(frozen=True, slots=True)
class ToolConfig:
    """Everything mounted on the flange, the sensor included."""

    name: str = "tool"
    cylinders_mm: Rows = ()
    """(from, to, diameter[, x, y]) along the flange z axis from the flange face; x, y put the axis aside."""
    mass_kg: float | None = None
    """Of what hangs on the sensor, about. The payload told by the controller and the sensor's range are checked against
    it, and until six poses are taken a change by more than it can weigh counts as contact."""


@dataclass(frozen=True, slots=True)
class WorkcellConfig:
    """What stands around the arm, base axes."""

    mounting: str = "floor"
    """floor, wall, ceiling, or degrees the base leans towards its -x: 90 is wall."""
    planes_mm: Rows = ()
    """(nx, ny, nz, place): the arm stays where normal times point is place or more."""
    boxes_mm: Rows = ()
    """(x, y, z, x, y, z): two opposite corners."""
    measured: bool = False
    """Whether a person has measured the tool, planes and boxes; nothing moves before."""


@dataclass(frozen=True, slots=True)
class SiteConfig:
    """Where the cell stands."""

    g_m_s2: float = 9.80665
    """Local gravity; it scales the mass and nothing else."""


@dataclass(frozen=True, slots=True)
class CellConfig:
    """Everything a calibration needs to know before it starts."""

    robot: RobotConfig
    sensor: SensorConfig
    tool: ToolConfig = field(default_factory=ToolConfig)
    workcell: WorkcellConfig = field(default_factory=WorkcellConfig)
    sampling: Sampling = field(default_factory=Sampling)
    site: SiteConfig = field(default_factory=SiteConfig)
    clock: Clock = field(default=REAL, compare=False, repr=False)
    """By which everything in the cell is timed; an emulated cell has its own. It is in no file."""

    def to_dict(self) -> dict[str, Any]:
        """Give the sections as files have them."""
        return {name: asdict(getattr(self, name)) for name in _SECTIONS}


@dataclass(frozen=True, slots=True)
class Setting:
    """One value of the configuration."""

    value: Any
    """None where nothing was said and there is no default."""
    origin: str
    """The option, variable or file that says it; "default" or "not set"."""


Flag = tuple[str, Any]
"""An option of a command as it is called there, and its value; None where it was not given."""

_SECTIONS: Mapping[str, Any] = {
    "robot": RobotConfig,
    "sensor": SensorConfig,
    "tool": ToolConfig,
    "workcell": WorkcellConfig,
    "sampling": Sampling,
    "site": SiteConfig,
}
_KEYS = {f"{name}.{item.name}": item for name, kind in _SECTIONS.items() for item in fields(kind)}


def load(config: Path | None = None, flags: Mapping[str, Flag] | None = None, *, devices: bool = True) -> CellConfig:
    """Put a cell together from all that is said about it.

    Parameters
    ----------
    config : Path, optional
        Read in place of the project's file.
    flags : mapping
        Options of the command by key, such as ``{"robot.host": ("--robot", "10.0.0.2")}``.
    devices : bool
        Whether arm and sensor must be named; where not, their addresses may be empty.

    Raises
    ------
    ConfigError
        With the place, the section, the key, the value and what to do.
    """
    return cell_of(settings(config, flags), devices=devices)


def settings(
    config: Path | None = None, flags: Mapping[str, Flag] | None = None, *, cell: CellConfig | None = None
) -> dict[str, Setting]:
    """Every key, such as "robot.host", with its value and where it comes from; errors as `load`.

    Parameters
    ----------
    config, flags
        As in `load`.
    cell : CellConfig, optional
        An emulated one, which counts in place of all files and variables.
    """
    found: dict[str, Setting] = {}
    if cell is not None:
        found = _from_cell(cell)
    else:
        for path in _files(config):
            found |= _from_file(path)
        found |= _from_environment()
    for key, (option, value) in (flags or {}).items():
        if value is not None:
            found[key] = Setting(checked(option, key, value), option)
    if "sampling.average_s" in found:  # who says how long to average does not want it chosen
        found.setdefault("sampling.noise_record_s", Setting(0.0, found["sampling.average_s"].origin))
    return {key: found.get(key) or _default(key) for key in _KEYS}


def cell_of(values: Mapping[str, Setting], *, devices: bool = True) -> CellConfig:
    """Turn settings into a cell; raises `ConfigError` when a device is needed and not named."""
    missing = [key for key in ("robot.host", "sensor.url") if values[key].value is None]
    if missing and devices:
        section, key = missing[0].split(".")
        raise ConfigError(
            f"[{section}] {key} is not set: write it into {FILE} (`ftdrive init` asks for it), set "
            f"{variable(missing[0])} or give --{section}; --simulate takes an emulated cell"
        )
    said = {key: setting.value for key, setting in values.items()} | dict.fromkeys(missing, "")
    return CellConfig(
        **{
            name: kind(**{item.name: said[f"{name}.{item.name}"] for item in fields(kind)})
            for name, kind in _SECTIONS.items()
        }
    )


def variable(key: str) -> str:
    """Name of the environment variable of a key."""
    return PREFIX + key.replace(".", "_").upper()


def as_toml(value: Any) -> str:
    """Write a value as it stands in a file."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return json.dumps(value)


def user_file() -> Path:
    """Where a user keeps what holds for all projects; it need not exist."""
    home = os.environ.get("XDG_CONFIG_HOME", "")
    folder = Path(home) if Path(home).is_absolute() else Path("~/.config").expanduser()
    return folder / "ftdrive" / FILE


def project_file() -> Path:
    """Where a project keeps its cell; it need not exist."""
    return Path(FILE)


def _files(config: Path | None) -> list[Path]:
    """The later one wins."""
    found = [path for path in (user_file(), project_file()) if path.is_file()]
    if config is None:
        return found
    return [*(path for path in found if path == user_file()), config]


def _from_cell(cell: CellConfig) -> dict[str, Setting]:
    values = {key: getattr(getattr(cell, section), name) for key in _KEYS for section, name in [key.split(".")]}
    return {key: Setting(value, "emulated cell") for key, value in values.items() if value is not None}


def _from_file(path: Path) -> dict[str, Setting]:
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not a TOML file: {error}; mend it there") from error
    if (found := document.pop("format", None)) != FORMAT:
        instead = "" if found is None else f", found {found!r}"
        raise ConfigError(f'{path}: the first line must be format = "{FORMAT}"{instead}')
    if unknown := sorted(document.keys() - _SECTIONS.keys()):
        raise ConfigError(f"{path}: unknown section [{unknown[0]}]: the sections are {', '.join(_SECTIONS)}")
    values: dict[str, Setting] = {}
    for section, content in document.items():
        if not isinstance(content, dict):
            raise ConfigError(
                f"{path}: {section} = {content!r} is not a section: write [{section}] alone on a line, its keys below"
            )
        for key, value in content.items():
            if f"{section}.{key}" not in _KEYS:
                raise ConfigError(f"{path}: [{section}] has no key '{key}': {_known(section)}")
            values[f"{section}.{key}"] = Setting(checked(str(path), f"{section}.{key}", value), str(path))
    return values


def _from_environment() -> dict[str, Setting]:
    values: dict[str, Setting] = {}
    names = {variable(key): key for key in _KEYS}
    for name, text in os.environ.items():
        if name in names:
            values[names[name]] = Setting(checked(name, names[name], _parsed(name, names[name], text)), name)
            continue
        for section in _SECTIONS:
            if name.startswith(variable(section) + "_"):
                raise ConfigError(f"{name} is set, but [{section}] has no such key: {_known(section)}; unset it")
    return values


def _parsed(name: str, key: str, text: str) -> Any:
    """Texts stand as they are; everything else is written as in the file."""
    if not text:
        raise ConfigError(f"{name} is empty: give [{key.replace('.', '] ')} a value, or unset it")
    if _KEYS[key].type in {str, str | None}:
        return text
    try:
        document = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        document = {}
    return document["value"] if document.keys() == {"value"} else text


def _default(key: str) -> Setting:
    item = _KEYS[key]
    if item.default is MISSING or item.default is None:
        return Setting(None, "not set")
    return Setting(item.default, "default")


def _known(section: str) -> str:
    return f"the keys are {', '.join(item.name for item in fields(_SECTIONS[section]))}"


# What a value may be. ----------------------------------------------------------------------------------------------


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)


def _rows(value: Any) -> bool:
    return isinstance(value, list | tuple) and all(
        isinstance(row, list | tuple) and all(map(_number, row)) for row in value
    )


_TYPES: Mapping[Any, tuple[str, Callable[[Any], bool]]] = {
    str: ("a text: put it in quotes", lambda value: isinstance(value, str)),
    float: ("a number: give one such as 1.5, without quotes and unit", _number),
    int: (
        "a whole number: give one such as 1, without quotes and point",
        lambda value: isinstance(value, int) and not isinstance(value, bool),
    ),
    bool: ("true or false: give one of them, without quotes", lambda value: isinstance(value, bool)),
    Rows: ("a list of lists of numbers: give one such as [[0, 60, 90]], also for a single row", _rows),
}
_TYPES = {**_TYPES, str | None: _TYPES[str], float | None: _TYPES[float]}

_RANGES: Mapping[str, tuple[float, float]] = {
    "robot.speed_deg_s": (0.5, 60),
    "robot.acceleration_deg_s2": (1, 300),
    "robot.tip_speed_mm_s": (1, 250),
    "sensor.height_mm": (0, 500),
    "sensor.mass_kg": (0, 20),
    "tool.mass_kg": (0.001, 100),
    "sampling.average_s": (0.05, 600),
    "sampling.still_timeout_s": (1, 600),
    "sampling.attempts": (1, 100),
    "sampling.noise_record_s": (0, 600),
    "site.g_m_s2": (9.7, 9.9),
}


def recorded(config: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return what a run has kept of its cell; raises `ConfigError` for a value of a wrong type.

    What this version does not know is left out. Ranges are not looked at: those were of another version, too.
    """
    return {
        section: {
            item.name: _as_kept(
                item, _typed(f"[{section}] {item.name} = {values[item.name]!r}", item, values[item.name])
            )
            for item in fields(_SECTIONS[section])
            if item.name in values
        }
        for section, values in config.items()
        if section in _SECTIONS
    }


def recorded_cell(config: Mapping[str, Mapping[str, Any]]) -> CellConfig:
    """Put the cell of a run together from what `recorded` returns."""
    return CellConfig(**{name: kind(**config.get(name, {})) for name, kind in _SECTIONS.items()})


def _typed(said: str, item: Field[Any], value: Any) -> Any:
    words, fits = _TYPES[item.type]
    if not fits(value) and not (value is None and item.default is None):
        raise ConfigError(f"{said} is not {words}")
    return value


def _as_kept(item: Field[Any], value: Any) -> Any:
    if value is not None and item.type in {float, float | None}:
        return float(value)
    return tuple(tuple(map(float, row)) for row in value) if item.type == Rows else value


def checked(place: str, key: str, value: Any) -> Any:
    """Return the value of a key such as "robot.host" as its section takes it, or raise `ConfigError`."""
    said = f"{place}: [{key.replace('.', '] ')} = {value!r}"
    if key == "workcell.mounting" and _number(value):  # degrees
        value = str(value)
    _typed(said, _KEYS[key], value)
    if key in _RANGES:
        low, high = _RANGES[key]
        if not low <= value <= high:
            raise ConfigError(f"{said} is out of range: give {low:g} to {high:g}")
    if cure := _WRONG.get(key, lambda _: None)(value):
        raise ConfigError(f"{said} cannot be used: {cure}")
    return _as_kept(_KEYS[key], value)


def _wrong_text(value: str) -> str | None:
    return None if value.strip() else "it is empty, give one or leave it out"


def _wrong_model(value: str) -> str | None:
    from drivers.ur.kinematics import MODELS, model_named

    return None if model_named(value, controller_major=0) else f"the models are {', '.join(MODELS)}"


def _wrong_sign(value: int) -> str | None:
    return None if value in {-1, 1} else "give 1, or -1 for a sensor that reports the reaction"


def _wrong_record(value: float) -> str | None:
    return None if value == 0 or value >= 3 else "give 3 or more, or 0 for none: a shorter one judges no average"


def _wrong_mounting(value: str) -> str | None:
    try:
        usable = value in {"floor", "wall", "ceiling"} or abs(float(value)) <= 180
    except ValueError:
        usable = False
    return None if usable else "give floor, wall, ceiling, or degrees the base leans to -x, -180 to 180"


def _wrong_host(value: str) -> str | None:
    return "give name or IPv4 address alone, such as 192.168.0.10" if "/" in value else _wrong_text(value)


def _wrong_height(value: float) -> str | None:
    return "is it mm? Give the height in mm, such as 33, or 0" if 0 < value < 1 else None


_THINNEST_MM = 5.0
"""What is given in metres or inches is thinner."""


def _wrong_cylinders(rows: Sequence[Sequence[float]]) -> str | None:
    for row in rows:
        if len(row) not in {3, 5} or not (0 <= row[0] < row[1] <= 2000 and 0 < row[2] <= 1000):
            return (
                f"{list(row)} is no cylinder of the tool: give [from, to, diameter] or [from, to, diameter, x, y], mm "
                "from the flange face, from 0 up, to at most 2000, diameter at most 1000"
            )
        if min(row[1] - row[0], row[2]) < _THINNEST_MM:
            return (
                f"{list(row)} is shorter or thinner than {_THINNEST_MM:g} mm, are these mm? Give from, to and diameter "
                f"in mm, and {_THINNEST_MM:g} mm for what is thinner"
            )
    return None


def _wrong_planes(rows: Sequence[Sequence[float]]) -> str | None:
    for row in rows:
        if len(row) != 4:
            return f"{list(row)} is no plane: give [nx, ny, nz, mm], such as [-1, 0, 0, -800]"
        if not any(row[:3]):
            return f"the normal of {list(row)} has no direction: give for example [-1, 0, 0, -800]"
    return None


def _wrong_boxes(rows: Sequence[Sequence[float]]) -> str | None:
    for row in rows:
        if len(row) != 6 or any(row[i] == row[i + 3] for i in range(3)):
            return f"{list(row)} is no box: give two opposite corners [x, y, z, x, y, z] in mm"
        if min(abs(row[i] - row[i + 3]) for i in range(3)) < _THINNEST_MM:
            return (
                f"{list(row)} is thinner than {_THINNEST_MM:g} mm, are these mm? Give two opposite corners in mm, "
                f"{_THINNEST_MM:g} mm apart for what is thinner"
            )
    return None


_WRONG: Mapping[str, Callable[[Any], str | None]] = {
    "robot.host": _wrong_host,
    "robot.model": _wrong_model,
    "robot.driver": _wrong_text,
    "robot.serial": _wrong_text,
    "sensor.url": _wrong_text,
    "sensor.sign": _wrong_sign,
    "sensor.height_mm": _wrong_height,
    "sampling.noise_record_s": _wrong_record,
    "tool.name": _wrong_text,
    "tool.cylinders_mm": _wrong_cylinders,
    "workcell.mounting": _wrong_mounting,
    "workcell.planes_mm": _wrong_planes,
    "workcell.boxes_mm": _wrong_boxes,
}
