"""The cell as it is described: what a result is compared with."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ftcalib.model import UP_IN_BASE, Array


@dataclass(frozen=True, slots=True)
class Setup:
    """A described cell; None where nothing is declared. A result that contradicts it is usable at best.

    Examples
    --------
    >>> import ftdrive
    >>> ftdrive.Setup(up_in_base=(1.0, 0.0, 0.0), tool_mass_kg=1.2).up
    array([1., 0., 0.])

    Raises
    ------
    ValueError
        A direction of length zero, or a cylinder that is none.
    """

    up_in_base: Sequence[float] | None = None
    """(3,) declared up direction in base, of any length: (0, 0, 1) for a robot on a floor. If it is not declared, a
    robot that would have to hang on a wall or a ceiling is not good, because wrong rotations look like that too."""
    tool_mass_kg: float | None = None
    """Of what hangs on the sensor, about."""
    cylinders_m: Sequence[Sequence[float]] = ()
    """Tool and sensor as cylinders along flange z: from, to, diameter, and optionally x and y of the axis."""
    sensor_height_m: float | None = None
    """Of the sensor's origin above the flange face."""
    sensor_mass_kg: float | None = None
    """Of sensor and adapter, which the sensor cannot weigh."""
    payload_kg: float | None = None
    """As set in the controller: of all that hangs on the flange."""

    def __post_init__(self) -> None:
        if self.up_in_base is not None:
            up = np.array(self.up_in_base, dtype=np.float64)
            if up.shape != (3,) or not 0 < np.linalg.norm(up) < np.inf:
                raise ValueError(f"up_in_base is {self.up_in_base}, expected three numbers that are not all 0")
            object.__setattr__(self, "up_in_base", tuple(up.tolist()))
        for row in self.cylinders_m:
            if len(row) not in {3, 5} or not np.isfinite(row).all():
                raise ValueError(f"the cylinder {list(row)} is none: give from, to, diameter, and optionally x and y")

    @property
    def up(self) -> Array:
        """(3,) unit vector up in base, as declared; +z if it is not."""
        up = UP_IN_BASE if self.up_in_base is None else np.array(self.up_in_base)
        return np.asarray(up / np.linalg.norm(up))


NOTHING: Final = Setup()
"""Nothing is described."""
