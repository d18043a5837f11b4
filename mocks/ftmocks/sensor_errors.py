"""Errors of a sensor that is not perfect: gain, cross-talk and a response that is not linear.

The sensor reads ``(I + E) w + b + noise`` of a load w, with errors that grow as its square and its cube. They are
relative to the ranges of the axes. Mounted sensors have 2 to 5 % of gain, and .1 to .3 % of range that is not linear.

Does not model: hysteresis, temperature, the end of the range.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from ftmocks.arrays import Array

RANGE: Array = np.repeat([150.0, 10.0], 3)
"""N and N·m: a torque of full range is a force of full range with a lever of 67 mm."""
POWERS: Array = np.array([2, 3])
GAIN_PERCENT, CROSS_TALK_PERCENT = 2.0, 1.0
"""Of the sensor of a cell, unless the command line says otherwise: as of mounted sensors."""


@dataclass(frozen=True)
class SensorErrors:
    """What a sensor adds to a load, in its axes about its origin.

    Parameters
    ----------
    error
        E, (6, 6), N and N·m.
    nonlinearity
        (6, 2) error of each axis at the end of its range that grows as the square and as the cube of its load,
        relative to the range.
    """

    error: Array
    nonlinearity: Array

    @classmethod
    def drawn(cls, seed: int, gain: float, cross_talk: float, nonlinear: float) -> Self:
        """Draw errors of these sizes: one standard deviation each, relative to the ranges.

        Half of the variance of the gain is common to all axes, as of calibration masses, ageing and temperature.
        """
        rng = np.random.default_rng([seed, 12])
        drawn, bent, common = rng.standard_normal((6, 6)), rng.standard_normal((6, 2)), rng.standard_normal()
        np.fill_diagonal(drawn, (np.diag(drawn) + common) / np.sqrt(2))
        sizes = np.where(np.eye(6) > 0, gain, cross_talk) * RANGE[:, None] / RANGE
        return cls(sizes * drawn, nonlinear * bent)

    def of(self, load: Array) -> Array:
        """Return the errors of readings, with the shape of the loads (6,) or (n, 6), N and N·m."""
        bent = (self.nonlinearity * (load / RANGE)[..., None] ** POWERS).sum(axis=-1)
        errors: Array = load @ self.error.T + RANGE * bent
        return errors


PERFECT = SensorErrors(np.zeros((6, 6)), np.zeros((6, 2)))
