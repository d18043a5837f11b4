"""A weighed load on the tool during a run: as options describe it, and as run.json and the dataset keep it."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isfinite, radians, sin
from typing import TYPE_CHECKING, Any, Final, Self

from ftcalib.model import STANDARD_GRAVITY_M_S2
from ftcalib.sampling import Sampling
from ftdrive.errors import ConfigError

if TYPE_CHECKING:
    from ftcalib.loads.model import KnownLoad

# Of a mass without a sigma of its own: a kitchen scale.
MASS_SHARE: Final = 1e-3
PLACE_SIGMA_MM: Final = 0.5
_FARTHEST_MM: Final = 2000.0
_HEAVIEST_KG: Final = 100.0
_MOST_SWING_RAD: Final = radians(5)
_SWING_S: Final = 4.0
_SWING_ATTEMPTS: Final = 6


@dataclass(frozen=True, slots=True)
class Load:
    """A weighed load: hung on a string from a point of the tool, or gripped at an unknown place."""

    name: str
    """Of its place."""
    mass_kg: float
    mass_sigma_kg: float
    p_flange_mm: tuple[float, float, float] | None
    """(3,) where it hangs, from the centre of the flange face in flange axes; None if it is gripped."""
    place_sigma_mm: float = PLACE_SIGMA_MM
    gripped: bool = False

    @property
    def p_flange_m(self) -> tuple[float, float, float] | None:
        """(3,) where it hangs, m."""
        if self.p_flange_mm is None:
            return None
        x, y, z = (value / 1e3 for value in self.p_flange_mm)
        return x, y, z

    @property
    def known(self) -> "KnownLoad":
        """The same for the fit of the sensor's matrix."""
        from ftcalib.loads.model import KnownLoad

        return KnownLoad(self.name, self.mass_kg, self.mass_sigma_kg, self.p_flange_m, self.place_sigma_mm / 1e3)

    @property
    def most_swing_N(self) -> float | None:
        """Amplitude of the force of a swing of 5 degrees, above which a pose is repeated; None if it cannot swing."""
        return None if self.gripped else self.mass_kg * STANDARD_GRAVITY_M_S2 * sin(_MOST_SWING_RAD)

    def sampling(self, usual: Sampling) -> Sampling:
        """Return how a pose is sampled: a swing needs several periods, and time to decay."""
        return usual if self.gripped else replace(usual, average_s=_SWING_S, attempts=_SWING_ATTEMPTS)

    def __str__(self) -> str:
        return f"a load of {self.mass_kg:g} kg {'in the gripper' if self.gripped else f'at {self.name}'}"

    @classmethod
    def of(cls, mass: str, place: str | None, *, gripped: bool) -> Self:
        """Read the options `--load`, `--at` and `--gripped`; raises `ConfigError`."""
        mass_kg, sigma_kg = mass_of(mass)
        if (place is None) != gripped:
            raise ConfigError("--load needs one of two: where it hangs, such as --at tip=0,0,200, or --gripped")
        if place is None:
            return cls("gripper", mass_kg, sigma_kg, None, gripped=True)
        name, p_flange_mm = place_of(place)
        if p_flange_mm is None:
            raise ConfigError(
                f"--at {name} has no place: give it in mm from the flange face, such as --at {name}=0,0,200"
            )
        return cls(name, mass_kg, sigma_kg, p_flange_mm)

    @classmethod
    def of_header(cls, header: Mapping[str, Any]) -> Self | None:
        """Return the load of run.json or of a dataset's `meta`; None without one."""
        found = header.get("load")
        if found is None:
            return None
        place = found["p_flange_mm"]
        p_flange_mm = None if place is None else (float(place[0]), float(place[1]), float(place[2]))
        return cls(**{**found, "p_flange_mm": p_flange_mm})

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as run.json has them."""
        place = None if self.p_flange_mm is None else list(self.p_flange_mm)
        return {
            "name": self.name,
            "mass_kg": self.mass_kg,
            "mass_sigma_kg": self.mass_sigma_kg,
            "p_flange_mm": place,
            "place_sigma_mm": self.place_sigma_mm,
            "gripped": self.gripped,
        }


def mass_of(text: str) -> tuple[float, float]:
    """Read a mass and its sigma in kg, such as 2.0 or 2.0±0.002; raises `ConfigError`."""
    try:
        mass_kg, *rest = (float(part) for part in re.split(r"±|\+/?-", text))
        sigma_kg = rest[0] if rest else MASS_SHARE * mass_kg
    except ValueError:
        raise ConfigError(f"the mass '{text}' is not a number of kg: give one such as 2.0 or 2.0±0.002") from None
    if len(rest) > 1 or not 0 < mass_kg <= _HEAVIEST_KG or not 0 < sigma_kg < mass_kg:
        raise ConfigError(
            f"the mass '{text}' cannot be used: give more than 0 to {_HEAVIEST_KG:g} kg, and a sigma below the mass"
        )
    return mass_kg, sigma_kg


def place_of(text: str) -> tuple[str, tuple[float, float, float] | None]:
    """Read a place, NAME=x,y,z in mm from the flange face or NAME alone; raises `ConfigError`."""
    name, given, numbers = text.partition("=")
    if not re.fullmatch(r"[\w-]+", name):
        raise ConfigError(f"the place '{text}' has no name: give one such as tip=0,0,200")
    if not given:
        return name, None
    try:
        x, y, z = map(float, numbers.split(","))
    except ValueError:
        raise ConfigError(f"the place '{text}' is not three numbers in mm: give one such as {name}=0,0,200") from None
    if not all(map(isfinite, (x, y, z))) or max(abs(x), abs(y), abs(z)) > _FARTHEST_MM:
        raise ConfigError(f"the place '{text}' is more than {_FARTHEST_MM / 1e3:g} m from the flange: is it in mm?")
    return name, (x, y, z)
