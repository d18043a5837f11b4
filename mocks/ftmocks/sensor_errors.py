"""Errors of a sensor: gain, cross-talk and non-linearity.

The reading of a load w is ``(I + E) w + b + noise``, plus errors that grow with its square and its cube. Errors are
relative to the ranges of the axes. Mounted sensors have gain errors of 2 to 5 %, and a non-linearity of 0.1 to 0.3 % of
the range.

Not modelled: hysteresis, temperature, saturation.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from ftmocks.arrays import Array

RANGE: Array = np.repeat([150.0, 10.0], 3)
"""(6,) ranges of the axes, N and N·m."""
POWERS: Array = np.array([2, 3])
GAIN_PERCENT, CROSS_TALK_PERCENT = 2.0, 1.0
"""Default errors of the sensor of a cell, which are those of mounted sensors."""


@dataclass(frozen=True)
class SensorErrors:
    """Errors of a sensor, in its axes about its origin.

    Parameters
    ----------
    error
        (6, 6) matrix E, N and N·m.
    nonlinearity
        (6, 2) coefficients of the square and the cube of each axis, as errors at full range relative to the range.
    """

    error: Array
    nonlinearity: Array

    @classmethod
    def drawn(cls, seed: int, gain: float, cross_talk: float, nonlinear: float) -> Self:
        """Draw errors with these standard deviations, relative to the ranges.

        Half of the variance of the gain is common to all axes, as it is if calibration masses, ageing or temperature
        are its cause.
        """
        rng = np.random.default_rng([seed, 12])
        drawn, bent, common = rng.standard_normal((6, 6)), rng.standard_normal((6, 2)), rng.standard_normal()
        np.fill_diagonal(drawn, (np.diag(drawn) + common) / np.sqrt(2))
        sizes = np.where(np.eye(6) > 0, gain, cross_talk) * RANGE[:, None] / RANGE
        return cls(sizes * drawn, nonlinear * bent)

    def of(self, load: Array) -> Array:
        """Return the errors of the readings of loads (6,) or (n, 6), N and N·m, in the same shape."""
        bent = (self.nonlinearity * (load / RANGE)[..., None] ** POWERS).sum(axis=-1)
        errors: Array = load @ self.error.T + RANGE * bent
        return errors


PERFECT = SensorErrors(np.zeros((6, 6)), np.zeros((6, 2)))
