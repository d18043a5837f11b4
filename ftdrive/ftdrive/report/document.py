"""A report as sections of sentences, tables and figures, and the words that all formats share."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True)
class Table:
    """Cells as text; the first of each row is its heading."""

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    folded: bool = False
    """A long one, which a page shows on request."""

    @property
    def narrow(self) -> bool:
        """Whether it fits beside a figure."""
        return 2 < len(self.columns) <= 4


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure by its name, with what a reader sees in it and what good looks like."""

    name: str
    alt: str
    caption: str


@dataclass(frozen=True, slots=True)
class Section:
    """One heading; `name` is its anchor."""

    name: str
    title: str
    text: Sequence[str] = ()
    figures: Sequence[Figure] = ()
    tables: Sequence[Table] = ()


_LABELS = {
    "R_flange_sensor": "mounting",
    "gravity_force_base_N": "weight",
    "force_bias_N": "force bias",
    "p_sensor_com_m": "centre of mass",
    "torque_bias_Nm": "torque bias",
}


def label_of(parameter: str) -> str:
    """Name an error coordinate, such as "force bias x" for "force_bias_N.x"."""
    name, _, axis = parameter.partition(".")
    return f"{_LABELS[name]} {axis}"


def rounded(value: float | None, digits: int = 3) -> str:
    """Write a number with this many significant digits, without an exponent; "-" for None."""
    if value is None:
        return "-"
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    places = max(digits - 1 - math.floor(math.log10(abs(value))), 0)
    return f"{value:.{min(places, 9)}f}"


def capital(words: str) -> str:
    """Begin a sentence with a capital letter."""
    return words[:1].upper() + words[1:]


def shown_poses(poses: Sequence[Any], most: int = 200) -> list[Any]:
    """Choose the poses to list and draw, in their order: all, or the worst quarter and evenly spread others."""
    if len(poses) <= most:
        return list(poses)
    size = np.array([pose["sigmas"] or pose["force_N"] for pose in poses])
    worst = np.argsort(-size)[: most // 4]
    even = np.linspace(0, len(poses) - 1, most - len(worst)).astype(int)
    return [poses[row] for row in np.unique([*worst, *even])]
