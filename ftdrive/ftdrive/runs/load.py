"""A load of known mass on the tool during a run, as given by options, run.json or a dataset."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import isfinite, radians, sin
from typing import Any, Final, Self

from ftcalib.loads.model import KnownLoad
from ftcalib.model import STANDARD_GRAVITY_M_S2
from ftcalib.sampling import Sampling
from ftdrive.errors import ConfigError
from ftdrive.planning.geometry.arm_model import STRING_M, WEIGHT_HEIGHT_M, WEIGHT_RADIUS_M

# Relative standard deviation of a mass given without one: that of a mass weighed on a kitchen scale.
MASS_SHARE: Final = 1e-3
_FARTHEST_MM: Final = 2000.0
_HEAVIEST_KG: Final = 100.0
_MOST_SWING_RAD: Final = radians(5)
_SWING_S: Final = 4.0
_SWING_ATTEMPTS: Final = 6


class Load(KnownLoad):
    """A known load in a session, which hangs on a string from the tool, or is gripped at an unknown position."""

    __slots__ = ()

    @property
    def gripped(self) -> bool:
        """Whether the gripper holds the load at an unknown position."""
        return self.p_flange_m is None

    @property
    def p_flange_mm(self) -> tuple[float, float, float] | None:
        """Position (3,) of the load's hook from the flange face, flange axes, mm; None if the load is gripped."""
        if self.p_flange_m is None:
            return None
        x, y, z = (round(1e3 * value, 6) for value in self.p_flange_m)
        return x, y, z

    @property
    def most_swing_N(self) -> float | None:
        """Force amplitude, N, of a 5-degree swing of the load, above which a pose is repeated; None if gripped."""
        return None if self.gripped else self.mass_kg * STANDARD_GRAVITY_M_S2 * sin(_MOST_SWING_RAD)

    def sampling(self, usual: Sampling) -> Sampling:
        """Return how to sample a pose: as `usual`, but longer for a hanging load, to average over its swing."""
        return usual if self.gripped else replace(usual, average_s=_SWING_S, attempts=_SWING_ATTEMPTS)

    @property
    def questions(self) -> tuple[str, ...]:
        """Safety questions about the load, asked before the arm moves."""
        if self.gripped:
            what = f"Does the gripper hold {self.mass_kg:g} kg firmly"
            return (f"{what}, and does [tool] cylinders_mm describe that load too?",)
        return (
            f"A weight of {self.mass_kg:g} kg at {self.name} moves with the arm in the tour, which is a hazard. Is the "
            f"space below and beside it free of people and objects, is its string at most {1e3 * STRING_M:.0f} mm "
            f"long, and is the weight at most {2e3 * WEIGHT_RADIUS_M:.0f} mm wide and {1e3 * WEIGHT_HEIGHT_M:.0f} mm "
            "high?",
        )

    def __str__(self) -> str:
        return f"a load of {self.mass_kg:g} kg {'in the gripper' if self.gripped else f'at {self.name}'}"

    @classmethod
    def of(cls, mass: str, place: str | None, *, gripped: bool) -> Self:
        """Return the load given by `--load`, `--at` and `--gripped`. Invalid options raise `ConfigError`."""
        mass_kg, sigma_kg = mass_of(mass)
        if (place is None) != gripped:
            raise ConfigError("--load needs a position: give its hook, such as --at tip=0,0,200, or --gripped")
        if place is None:
            return cls("gripper", mass_kg, sigma_kg)
        name, p_flange_m = place_of(place)
        return cls(name, mass_kg, sigma_kg, p_flange_m)

    @classmethod
    def of_header(cls, header: Mapping[str, Any]) -> Self | None:
        """Return the load recorded in run.json or in a dataset's `meta`; None if there is none."""
        stored = header.get("load")
        if stored is None:
            return None
        place_mm = stored["p_flange_mm"]
        p_flange_m = None if place_mm is None else _in_m(place_mm)
        sigma_m = stored["place_sigma_mm"] / 1e3
        return cls(stored["name"], stored["mass_kg"], stored["mass_sigma_kg"], p_flange_m, sigma_m)

    def to_dict(self) -> dict[str, Any]:
        """Return the entry `load` of run.json."""
        return {
            "name": self.name,
            "mass_kg": self.mass_kg,
            "mass_sigma_kg": self.mass_sigma_kg,
            "p_flange_mm": None if self.p_flange_mm is None else list(self.p_flange_mm),
            "place_sigma_mm": round(1e3 * self.place_sigma_m, 6),
            "gripped": self.gripped,
        }


def mass_of(text: str) -> tuple[float, float]:
    """Return mass and standard deviation, kg, from a text such as 2.0 or 2.0±0.002. Others raise `ConfigError`."""
    try:
        mass_kg, *rest = (float(part) for part in re.split(r"±|\+/?-", text))
        sigma_kg = rest[0] if rest else MASS_SHARE * mass_kg
    except ValueError:
        raise ConfigError(f"the mass '{text}' is not a number of kg: give one such as 2.0 or 2.0±0.002") from None
    if len(rest) > 1 or not 0 < mass_kg <= _HEAVIEST_KG or not 0 < sigma_kg < mass_kg:
        raise ConfigError(
            f"the mass '{text}' is out of range: give above 0 to {_HEAVIEST_KG:g} kg, and a sigma below the mass"
        )
    return mass_kg, sigma_kg


def place_of(text: str) -> tuple[str, tuple[float, float, float]]:
    """Return name and position, m, from a text NAME=x,y,z in mm from the flange face. Others raise `ConfigError`."""
    name, given, numbers = text.partition("=")
    if not re.fullmatch(r"[\w-]+", name):
        raise ConfigError(f"the place '{text}' has no name: give one such as tip=0,0,200")
    if not given:
        raise ConfigError(f"--at {name} has no position: give mm from the flange face, such as --at {name}=0,0,200")
    try:
        place_mm = [float(number) for number in numbers.split(",")]
    except ValueError:
        place_mm = []
    if len(place_mm) != 3:
        raise ConfigError(f"the place '{text}' is not three numbers in mm: give one such as {name}=0,0,200")
    if not all(map(isfinite, place_mm)) or max(map(abs, place_mm)) > _FARTHEST_MM:
        raise ConfigError(f"the place '{text}' is more than {_FARTHEST_MM / 1e3:g} m from the flange: give it in mm")
    return name, _in_m(place_mm)


def _in_m(place_mm: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = (value / 1e3 for value in place_mm)
    return x, y, z
