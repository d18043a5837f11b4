"""Rules for configuration keys, in the metadata of the fields: description, unit, range, option and condition."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field
from math import isfinite
from typing import Any

from ftdrive.errors import ConfigError
from ftdrivers.ur.control import CONTROL_SETTINGS

Rows = tuple[tuple[float, ...], ...]
# Function that returns the remedy for a value of a key that cannot be used, and None for one that can.
Reject = Callable[[Any], str | None]

# Smallest dimension that is accepted in mm, because values given in metres or inches are usually smaller.
_THINNEST_MM = 5.0


@dataclass(frozen=True, slots=True)
class Rule:
    """Meaning and allowed values of a configuration key."""

    help: str
    unit: str
    between: tuple[float, float] | None
    option: str
    """Option of `ftdrive init` for this key; empty if `init` does not ask for the key."""
    reject: Reject

    @property
    def range(self) -> str:
        """The allowed range with its unit, such as "0.5 to 60 deg/s"; the unit alone if there is no range."""
        span = "" if self.between is None else "{:g} to {:g}".format(*self.between)
        return f"{span} {self.unit}".strip()

    @property
    def description(self) -> str:
        """Range, unit and meaning, as configuration files show them."""
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
    """Return a dataclass field with a rule; without a default the key must be set."""
    return field(default=default, metadata={"rule": Rule(help, unit, between, option, reject)})


def rule_of(item: Field[Any]) -> Rule:
    """Return the rule in the metadata of a configuration field."""
    rule: Rule = item.metadata["rule"]
    return rule


def require_type(where: str, item: Field[Any], value: Any) -> Any:
    """Return the value converted to the type of the field; raises `ConfigError` if its type is wrong."""
    wanted, fits = _TYPES[item.type]
    if not fits(value) and not (value is None and item.default is None):
        raise ConfigError(f"{where} is not {wanted}")
    if value is not None and item.type in {float, float | None}:
        return float(value)
    return tuple(tuple(map(float, row)) for row in value) if item.type == Rows else value


def ruled(where: str, item: Field[Any], value: Any) -> Any:
    """Return the value converted to the type of the field; raises `ConfigError` if it violates type or rule."""
    rule, result = rule_of(item), require_type(where, item, value)
    if rule.between is not None and not rule.between[0] <= result <= rule.between[1]:
        raise ConfigError(f"{where} is out of range: give {rule.range}")
    if fix := rule.reject(value):
        raise ConfigError(f"{where} cannot be used: {fix}")
    return result


def is_number(value: Any) -> bool:
    """Return whether a value is a finite number; a bool does not count as one."""
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)


def _is_rows(value: Any) -> bool:
    return isinstance(value, list | tuple) and all(
        isinstance(row, list | tuple) and all(map(is_number, row)) for row in value
    )


_TYPES: Mapping[Any, tuple[str, Callable[[Any], bool]]] = {
    str: ("a string: put it in quotes", lambda value: isinstance(value, str)),
    float: ("a number: give one such as 1.5, without quotes or unit", is_number),
    int: (
        "a whole number: give one such as 1, without quotes or decimal point",
        lambda value: isinstance(value, int) and not isinstance(value, bool),
    ),
    bool: ("true or false: give one of them, without quotes", lambda value: isinstance(value, bool)),
    Rows: ("a list of lists of numbers: give one such as [[0, 60, 90]], also for a single row", _is_rows),
}
_TYPES = {**_TYPES, str | None: _TYPES[str], float | None: _TYPES[float]}


# Conditions other than a range. -----------------------------------------------------------------------------------


def _unless(fits: Callable[[Any], bool], fix: str) -> Reject:
    return lambda value: None if fits(value) else fix


reject_empty = _unless(lambda text: bool(text.strip()), "it is empty; give a value, or leave the key out")
reject_sign = _unless({-1, 1}.__contains__, "give 1, or -1 for a sensor that reports the reaction")
reject_height = _unless(lambda mm: not 0 < mm < 1, "the unit is mm: give the height in mm, such as 33, or 0")
reject_store = _unless(lambda url: "://" in url, "it is not an address; give one such as sqlite:////data/store.sqlite")
reject_control = _unless(CONTROL_SETTINGS.__contains__, f"give one of {', '.join(CONTROL_SETTINGS)}")
reject_record = _unless(lambda s: s == 0 or s >= 3, "give 3 or more, or 0 for none: a shorter record is useless")


def reject_host(value: str) -> str | None:
    """Return the remedy for a URL in place of a host; None for a host."""
    is_url = "/" in value and not value.startswith("ros2:")
    return "give only a name or an IPv4 address, such as 192.168.0.10" if is_url else reject_empty(value)


def reject_model(value: str) -> str | None:
    """Return the remedy for an unknown model; None for a known one."""
    from ftdrivers.ur.kinematics import MODELS, model_named

    return None if model_named(value, controller_major=0) else f"the models are {', '.join(MODELS)}"


def reject_mounting(value: str) -> str | None:
    """Return the remedy for a value that is neither a mounting nor an angle; None for a valid one."""
    try:
        usable = value in {"floor", "wall", "ceiling"} or abs(float(value)) <= 180
    except ValueError:
        usable = False
    return None if usable else "give floor, wall, ceiling, or the tilt of the base towards -x, -180 to 180 degrees"


def reject_cylinders(rows: Sequence[Sequence[float]]) -> str | None:
    """Return the remedy for impossible cylinders, or for cylinders in other units; None for valid ones."""
    for row in rows:
        if len(row) not in {3, 5} or not (0 <= row[0] < row[1] <= 2000 and 0 < row[2] <= 1000):
            return (
                f"{list(row)} is not a cylinder: give [from, to, diameter] or [from, to, diameter, x, y] in mm "
                "from the flange face, with from at least 0, to at most 2000, and a diameter of at most 1000"
            )
        if min(row[1] - row[0], row[2]) < _THINNEST_MM:
            return (
                f"{list(row)} is shorter or thinner than {_THINNEST_MM:g} mm: give from, to and diameter in mm; use "
                f"{_THINNEST_MM:g} mm for a thinner part"
            )
    return None


def reject_planes(rows: Sequence[Sequence[float]]) -> str | None:
    """Return the remedy for planes without a direction; None for valid ones."""
    for row in rows:
        if len(row) != 4:
            return f"{list(row)} is not a plane: give [nx, ny, nz, mm], such as [-1, 0, 0, -800]"
        if not any(row[:3]):
            return f"the normal of {list(row)} is zero: give for example [-1, 0, 0, -800]"
    return None


def reject_boxes(rows: Sequence[Sequence[float]]) -> str | None:
    """Return the remedy for flat boxes, or for boxes in other units; None for valid ones."""
    for row in rows:
        if len(row) != 6 or any(row[i] == row[i + 3] for i in range(3)):
            return f"{list(row)} is not a box: give two opposite corners [x, y, z, x, y, z] in mm"
        if min(abs(row[i] - row[i + 3]) for i in range(3)) < _THINNEST_MM:
            return (
                f"{list(row)} is thinner than {_THINNEST_MM:g} mm: give two opposite corners in mm; use "
                f"{_THINNEST_MM:g} mm for a thinner box"
            )
    return None
