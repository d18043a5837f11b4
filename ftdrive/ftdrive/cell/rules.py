"""The rule of a configuration key, kept in the metadata of its field: description, unit, range, option, condition."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field
from math import isfinite
from typing import Any

from ftdrive.errors import ConfigError
from ftdrivers.ur.control import CONTROL_SETTINGS

Rows = tuple[tuple[float, ...], ...]
# Returns what to do about a value that cannot be used; None for one that can.
Reject = Callable[[Any], str | None]

# Values in metres or inches are thinner.
_THINNEST_MM = 5.0


@dataclass(frozen=True, slots=True)
class Rule:
    """What a key means and which values it takes, beside its type."""

    help: str
    unit: str
    between: tuple[float, float] | None
    option: str
    """Option of `ftdrive init`, which asks for it."""
    reject: Reject

    @property
    def range(self) -> str:
        """The range with its unit, such as "0.5 to 60 deg/s"; only the unit where there is no range."""
        span = "" if self.between is None else "{:g} to {:g}".format(*self.between)
        return f"{span} {self.unit}".strip()

    @property
    def description(self) -> str:
        """Range, unit and meaning, as files and documents show them."""
        return f"{self.range}, {self.help}" if self.range else self.help


def entry(
    help: str,
    default: Any = MISSING,
    unit: str = "",
    between: tuple[float, float] | None = None,
    *,
    option: str = "",
    reject: Reject = lambda _: None,
) -> Any:
    """Return a field with its rule; without a default it must be set."""
    return field(default=default, metadata={"rule": Rule(help, unit, between, option, reject)})


def rule_of(item: Field[Any]) -> Rule:
    """Return the rule of a field."""
    found: Rule = item.metadata["rule"]
    return found


def require_type(where: str, item: Field[Any], value: Any) -> Any:
    """Return a value of the field's type; raises `ConfigError` for another type."""
    wanted, fits = _TYPES[item.type]
    if not fits(value) and not (value is None and item.default is None):
        raise ConfigError(f"{where} is not {wanted}")
    if value is not None and item.type in {float, float | None}:
        return float(value)
    return tuple(tuple(map(float, row)) for row in value) if item.type == Rows else value


def ruled(where: str, item: Field[Any], value: Any) -> Any:
    """Return a value of the field's type that follows its rule; raises `ConfigError`."""
    rule, result = rule_of(item), require_type(where, item, value)
    if rule.between is not None and not rule.between[0] <= result <= rule.between[1]:
        raise ConfigError(f"{where} is out of range: give {rule.range}")
    if fix := rule.reject(value):
        raise ConfigError(f"{where} cannot be used: {fix}")
    return result


def is_number(value: Any) -> bool:
    """Return whether a value is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)


def _is_rows(value: Any) -> bool:
    return isinstance(value, list | tuple) and all(
        isinstance(row, list | tuple) and all(map(is_number, row)) for row in value
    )


_TYPES: Mapping[Any, tuple[str, Callable[[Any], bool]]] = {
    str: ("a text: put it in quotes", lambda value: isinstance(value, str)),
    float: ("a number: give one such as 1.5, without quotes and unit", is_number),
    int: (
        "a whole number: give one such as 1, without quotes and point",
        lambda value: isinstance(value, int) and not isinstance(value, bool),
    ),
    bool: ("true or false: give one of them, without quotes", lambda value: isinstance(value, bool)),
    Rows: ("a list of lists of numbers: give one such as [[0, 60, 90]], also for a single row", _is_rows),
}
_TYPES = {**_TYPES, str | None: _TYPES[str], float | None: _TYPES[float]}


# Conditions that are not a range. ----------------------------------------------------------------------------------


def _unless(fits: Callable[[Any], bool], fix: str) -> Reject:
    return lambda value: None if fits(value) else fix


reject_empty = _unless(lambda text: bool(text.strip()), "it is empty, give one or leave it out")
reject_sign = _unless({-1, 1}.__contains__, "give 1, or -1 for a sensor that reports the reaction")
reject_height = _unless(lambda mm: not 0 < mm < 1, "is it mm? Give the height in mm, such as 33, or 0")
reject_store = _unless(lambda url: "://" in url, "it is no address, give one such as sqlite:////data/store.sqlite")
reject_control = _unless(CONTROL_SETTINGS.__contains__, f"give one of {', '.join(CONTROL_SETTINGS)}")
reject_record = _unless(lambda s: s == 0 or s >= 3, "give 3 or more, or 0 for none: a shorter record is of no use")


def reject_host(value: str) -> str | None:
    """Reject a URL where a host is meant."""
    is_url = "/" in value and not value.startswith("ros2:")
    return "give name or IPv4 address alone, such as 192.168.0.10" if is_url else reject_empty(value)


def reject_model(value: str) -> str | None:
    """Reject an unknown model."""
    from ftdrivers.ur.kinematics import MODELS, model_named

    return None if model_named(value, controller_major=0) else f"the models are {', '.join(MODELS)}"


def reject_mounting(value: str) -> str | None:
    """Reject what is neither a mounting nor an angle."""
    try:
        usable = value in {"floor", "wall", "ceiling"} or abs(float(value)) <= 180
    except ValueError:
        usable = False
    return None if usable else "give floor, wall, ceiling, or degrees the base leans to -x, -180 to 180"


def reject_cylinders(rows: Sequence[Sequence[float]]) -> str | None:
    """Reject impossible cylinders, and those in other units."""
    for row in rows:
        if len(row) not in {3, 5} or not (0 <= row[0] < row[1] <= 2000 and 0 < row[2] <= 1000):
            return (
                f"{list(row)} is not a cylinder: give [from, to, diameter] or [from, to, diameter, x, y] in mm from "
                "the flange face, from 0 up, to at most 2000, diameter at most 1000"
            )
        if min(row[1] - row[0], row[2]) < _THINNEST_MM:
            return (
                f"{list(row)} is shorter or thinner than {_THINNEST_MM:g} mm, are these mm? Give from, to and diameter "
                f"in mm, and {_THINNEST_MM:g} mm for what is thinner"
            )
    return None


def reject_planes(rows: Sequence[Sequence[float]]) -> str | None:
    """Reject planes without a direction."""
    for row in rows:
        if len(row) != 4:
            return f"{list(row)} is not a plane: give [nx, ny, nz, mm], such as [-1, 0, 0, -800]"
        if not any(row[:3]):
            return f"the normal of {list(row)} has no direction: give for example [-1, 0, 0, -800]"
    return None


def reject_boxes(rows: Sequence[Sequence[float]]) -> str | None:
    """Reject flat boxes, and those in other units."""
    for row in rows:
        if len(row) != 6 or any(row[i] == row[i + 3] for i in range(3)):
            return f"{list(row)} is not a box: give two opposite corners [x, y, z, x, y, z] in mm"
        if min(abs(row[i] - row[i + 3]) for i in range(3)) < _THINNEST_MM:
            return (
                f"{list(row)} is thinner than {_THINNEST_MM:g} mm, are these mm? Give two opposite corners in mm, "
                f"{_THINNEST_MM:g} mm apart for what is thinner"
            )
    return None
