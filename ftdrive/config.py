"""One cell, described in a TOML file: which arm, which sensor, how long to look."""

import tomllib
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from calib.routine import Sampling
from ftdrive.errors import ConfigError

FORMAT = "ftdrive.config/1"


@dataclass(frozen=True, slots=True)
class RobotConfig:
    """The arm."""

    host: str
    """Name or IPv4 address of the controller."""
    model: str | None = None
    """Such as "ur5e"; checked against the controller where it can tell."""
    speed_deg_s: float = 30.0
    """Of the fastest joint in a move."""
    acceleration_deg_s2: float = 40.0


@dataclass(frozen=True, slots=True)
class SensorConfig:
    """The force/torque sensor."""

    url: str
    """Such as "ati-can://can0?bitrate=250000" or "ati-serial:///dev/serial/by-id/..."."""
    sign: int = 1
    """-1 for a sensor that reports the reaction."""


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
    sampling: Sampling = field(default_factory=Sampling)
    site: SiteConfig = field(default_factory=SiteConfig)


def load(path: Path) -> CellConfig:
    """Read a configuration file; raises `ConfigError` with the key and what is wrong with it."""
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not a TOML file: {error}") from error
    if (found := document.pop("format", None)) != FORMAT:
        raise ConfigError(f'{path}: the first line must be format = "{FORMAT}", found {found!r}')
    sections: dict[str, Any] = {
        "robot": RobotConfig,
        "sensor": SensorConfig,
        "sampling": Sampling,
        "site": SiteConfig,
    }
    if unknown := sorted(document.keys() - sections.keys()):
        raise ConfigError(f"{path}: unknown section [{unknown[0]}]: the sections are {', '.join(sections)}")
    return CellConfig(**{name: _section(path, name, kind, document.get(name, {})) for name, kind in sections.items()})


def _section(path: Path, name: str, kind: Any, values: Any) -> Any:
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: [{name}] must be a section, found {values!r}")
    known = {item.name: item for item in fields(kind)}
    for key, value in values.items():
        if key not in known:
            raise ConfigError(f"{path}: [{name}] has no key '{key}': the keys are {', '.join(known)}")
        wanted = known[key].type
        number = isinstance(value, int | float) and not isinstance(value, bool)
        fits = {float: number, int: number and isinstance(value, int), str: isinstance(value, str)}.get(
            wanted if isinstance(wanted, type) else str, isinstance(value, str)
        )
        if not fits:
            raise ConfigError(f"{path}: [{name}] {key} = {value!r} is not a {getattr(wanted, '__name__', 'str')}")
    try:
        return kind(**values)
    except TypeError as error:
        raise ConfigError(f"{path}: [{name}] is incomplete: {error}") from error
