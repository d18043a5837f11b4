"""The surroundings of the arm, and the mounting of its base."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from ftdrive.errors import ConfigError
from ftdrivers.ur.kinematics import Array

MOUNTINGS = {"floor": 0.0, "wall": np.pi / 2, "ceiling": np.pi}


@dataclass(frozen=True, slots=True)
class Plane:
    """A wall or a table: the whole arm must stay where `normal · x >= offset_m`, base axes."""

    normal: tuple[float, float, float]
    offset_m: float

    def __post_init__(self) -> None:
        if not abs(float(np.linalg.norm(self.normal)) - 1) < 1e-6:
            raise ConfigError(f"the normal of a plane is {self.normal}: its length must be 1")


@dataclass(frozen=True, slots=True)
class Box:
    """A box with edges along the base axes."""

    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.low_m, self.high_m, strict=True)):
            raise ConfigError(f"a box from {self.low_m} to {self.high_m} m is empty: give the low corner first")


# The surface to which the base is bolted.
BASE_PLANE = Plane((0.0, 0.0, 1.0), 0.0)


@dataclass(frozen=True, slots=True)
class Scene:
    """Planes and boxes in base axes, and the lean of the base from upright towards -x."""

    planes: Sequence[Plane] = field(default=(BASE_PLANE,))
    boxes: Sequence[Box] = ()
    lean_rad: float = 0.0
    """Lean of the base: 0 on a floor, pi/2 on a wall (gravity along -x), pi under a ceiling."""

    @property
    def down_base(self) -> Array:
        """(3,) unit vector along gravity, base axes."""
        return np.array([-np.sin(self.lean_rad), 0.0, -np.cos(self.lean_rad)])

    def describe(self) -> dict[str, Any]:
        """Return the planes, boxes and lean for the hash of a plan, which depends on them."""
        return asdict(self)


def down_of(mounting: str | None) -> Array:
    """Return the unit vector (3,) along gravity, base axes, for a mounting such as "wall"."""
    return Scene(lean_rad=lean_of(mounting)).down_base


def lean_of(mounting: str | None) -> float:
    """Return the lean of the base, rad, for a mounting: "floor", "wall", "ceiling" or degrees; None means a floor."""
    mounting = mounting or "floor"
    if mounting in MOUNTINGS:
        return MOUNTINGS[mounting]
    try:
        return float(np.radians(float(mounting)))
    except ValueError:
        raise ConfigError(
            f"mounting is '{mounting}': give {', '.join(MOUNTINGS)} or the tilt of the base towards -x in degrees"
        ) from None
