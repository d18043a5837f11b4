"""Parsing of quantities as people write them: `33 mm`, `33,5`, `1.3 in`, `0:60:90`, `+x 800`."""

import re
from collections.abc import Callable, Mapping, Sequence
from decimal import Decimal
from math import isfinite
from typing import Final

from ftdrive.errors import ConfigError

# Decimal factors, so that 1.1 cm are 11 mm, not 11.000000000000002.
MM: Final = {"mm": "1", "cm": "10", "m": "1000", "in": "25.4"}
KG: Final = {"kg": "1", "g": "0.001", "lb": "0.45359237"}
DEG_S: Final = {"deg/s": "1", "°/s": "1"}

# Normals of walls by their side; a normal points towards the arm.
SIDES: Final = {
    "+x": (-1, 0, 0),
    "-x": (1, 0, 0),
    "+y": (0, -1, 0),
    "-y": (0, 1, 0),
    "above": (0, 0, -1),
    "below": (0, 0, 1),
}

_NUMBER = re.compile(r"([+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+))\s*([a-z°/]*)", re.ASCII)
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}", re.ASCII)
_BEFORE_UNIT = re.compile(r"(?<=\d)\s+(?=(?:mm|cm|m|in)\b)")
_BETWEEN = re.compile(r"\s*[:;]\s*|,\s+|\s+")
_WALL = re.compile(rf"({'|'.join(map(re.escape, SIDES))})[:\s]*(\S.*)")


def parse_quantity(what: str, text: str, units: Mapping[str, str]) -> float:
    """Return a number with a decimal point or comma, with or without a unit; messages name it as `what`.

    `units` have factors; the first one is the unit of the result, and of a number without a unit. Raises `ConfigError`
    if the text is not a number, or if its comma may separate thousands.
    """
    value = _parse_value(what, text, units)
    if value is None:
        unit, *others = units
        raise ConfigError(
            f"{what} is '{text}', which is not a number: give one such as 1.5 or 1,5, in {unit} or with another unit "
            f"such as {others[0]}"
        )
    return value


def row(what: str, text: str, counts: Sequence[int]) -> list[float]:
    """Return lengths in mm, separated by colons, semicolons or spaces; raises `ConfigError` as `parse_quantity`."""
    parts = _BETWEEN.split(_BEFORE_UNIT.sub("", text.strip()))
    values = [_parse_value(what, part, MM) for part in parts]
    lengths = [value for value in values if value is not None]
    if len(lengths) != len(values) or len(values) not in counts:
        wanted = " or ".join(map(str, counts))
        raise ConfigError(f"{what} is '{text}': give {wanted} numbers separated by ':' or spaces, in mm or with a unit")
    return lengths


def rows_reader(*counts: int) -> Callable[[str, str], list[float]]:
    """Return a function that parses a row as `row` does, with any of these counts of lengths."""
    return lambda what, text: row(what, text, counts)


def wall(what: str, text: str) -> list[float]:
    """Return a wall as a row of `[workcell] planes_mm`, from side and distance, or from normal and offset in mm.

    Raises `ConfigError` if the text is neither, or if the distance is negative.
    """
    found = _WALL.fullmatch(text.strip().lower())
    if found is None:
        try:
            return row(what, text, (4,))
        except ConfigError:
            raise ConfigError(
                f"{what} is '{text}': give a side and a distance such as +x 800 (sides: {', '.join(SIDES)}), or "
                "NX:NY:NZ:MM for a slanting wall"
            ) from None
    distance_mm = parse_quantity(what, found[2], MM)
    if distance_mm < 0:
        raise ConfigError(f"{what} is '{text}': give a distance of 0 or more, and the side on which the wall is")
    return [*map(float, SIDES[found[1]]), 0.0 - distance_mm]


def side_of(plane_mm: Sequence[float]) -> str:
    """Return side and distance of a wall, such as "+x 800 mm"; empty for a wall on none of the `SIDES`."""
    *normal, offset_mm = plane_mm
    side = next((name for name, towards_arm in SIDES.items() if list(towards_arm) == normal), "")
    return f"{side} {0.0 - offset_mm:g} mm" if side and offset_mm <= 0 else ""


def _parse_value(what: str, text: str, units: Mapping[str, str]) -> float | None:
    found = _NUMBER.fullmatch(text.strip().lower().replace("−", "-"))
    if found is None or (found[2] and found[2] not in units):
        return None
    if _THOUSANDS.fullmatch(found[1]):
        whole, point = found[1].replace(",", ""), found[1].replace(",", ".")
        raise ConfigError(f"{what} is '{text}', where the comma is ambiguous: write {whole} or {point}")
    return float(Decimal(found[1].replace(",", ".")) * Decimal(units.get(found[2], "1")))


def parse_numbers(option: str, text: str, separator: str, counts: Sequence[int]) -> list[float]:
    """Return the numbers in the value of an option; raises `ConfigError` unless their count is in `counts`."""
    try:
        values = [float(part) for part in text.split(separator)]
    except ValueError:
        values = []
    if len(values) not in counts or not all(map(isfinite, values)):
        wanted = " or ".join(map(str, counts))
        raise ConfigError(f"{option} is '{text}': give {wanted} numbers separated by '{separator}'")
    return values


def rows(option: str, texts: Sequence[str], counts: Sequence[int]) -> list[list[float]] | None:
    """Return the rows of a repeatable option, each of numbers separated by colons; None if it was not given."""
    return [parse_numbers(option, text, ":", counts) for text in texts] or None
