"""A sweep: a smooth motion of the three wrist joints that begins and ends in one posture.

Each wrist joint moves by a windowed sum of sines: ``q(t) = centre + w(t) sum(amplitude sin(frequency t + phase))``.
The ramps of the window ``w`` are quintic polynomials, so speed and acceleration are zero at both ends.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

WRISTS: Final = (3, 4, 5)
"""Indices of the joints that move, counted from 0."""
WAVES: Final = 2
"""Number of sines that are added for each wrist joint."""


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """A planned sweep.

    Parameters
    ----------
    centre_rad : sequence of float
        (6,) posture at the beginning and at the end.
    amplitude_rad, frequency_rad_s, phase_rad : array_like, shape (3, 2)
        Amplitude, angular frequency and phase of each sine of wrists 1 to 3.
    duration_s, ramp_s : float
        Duration of the sweep, and duration of the rise and of the fall of the window.

    Raises
    ------
    ValueError
        A number is missing or not finite, or the ramps do not fit into the duration.
    """

    centre_rad: Sequence[float]
    amplitude_rad: ArrayLike
    frequency_rad_s: ArrayLike
    phase_rad: ArrayLike
    duration_s: float
    ramp_s: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre_rad", tuple(float(angle) for angle in self.centre_rad))
        for name in ("amplitude_rad", "frequency_rad_s", "phase_rad"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        numbers = [*self.centre_rad, *self.waves.ravel(), self.duration_s, self.ramp_s]
        if len(numbers) != 6 + 3 * len(WRISTS) * WAVES + 2 or not np.isfinite(numbers).all():
            raise ValueError(f"the sweep {numbers} lacks finite numbers: give 6 angles and {WAVES} sines for 3 wrists.")
        if not 0 < 2 * self.ramp_s <= self.duration_s:
            raise ValueError(f"ramps of {self.ramp_s} s do not fit into {self.duration_s} s.")

    @property
    def waves(self) -> Array:
        """(3, 2, 3) amplitude, frequency and phase of each sine."""
        return np.stack([self.amplitude_rad, self.frequency_rad_s, self.phase_rad], axis=-1)

    def at(self, t_s: ArrayLike, derivative: int = 0) -> Array:
        """Return the joint angles (n, 6) at times (n,), or a derivative of order 1 to 3; at rest before and after."""
        t = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        within = (t >= 0) & (t <= self.duration_s)
        side = np.where(t <= self.duration_s / 2, 1.0, -1.0)
        x = np.clip(np.where(side > 0, t, self.duration_s - t) / self.ramp_s, 0.0, 1.0)
        amplitude, frequency, phase = np.moveaxis(self.waves, -1, 0)
        angle = t[:, None, None] * frequency + phase
        q = np.zeros((len(t), 6))
        for k, binomial in enumerate(_binomials(derivative)):  # product rule of Leibniz: k derivatives of the window
            window = _window(x, k) * (side / self.ramp_s) ** k
            order = derivative - k
            sines = (amplitude * frequency**order * np.sin(angle + order * np.pi / 2)).sum(axis=2)
            q[:, WRISTS] += binomial * window[:, None] * sines
        q[~within] = 0.0
        return q + np.asarray(self.centre_rad) if derivative == 0 else q

    def bound(self, derivative: int) -> Array:
        """Return an upper bound (6,) on the absolute value of a derivative over the whole sweep."""
        most = np.zeros(6)
        amplitude, frequency = np.abs(self.waves[..., 0]), np.abs(self.waves[..., 1])
        for k, binomial in enumerate(_binomials(derivative)):
            steepest = float(np.abs(_window(np.linspace(0, 1, 1001), k)).max()) * 1.01 / self.ramp_s**k
            most[list(WRISTS)] += binomial * steepest * (amplitude * frequency ** (derivative - k)).sum(axis=1)
        return most

    def largest(self, derivative: int, step_s: float = 5e-3) -> Array:
        """Return the largest absolute value (6,) of a derivative: of samples, plus a bound for times between them."""
        t = np.arange(0.0, self.duration_s + step_s, step_s)
        return np.asarray(np.abs(self.at(t, derivative)).max(axis=0) + self.bound(derivative + 1) * step_s / 2)

    def slower(self, share: float) -> Self:
        """Return a sweep along the same path at this fraction of the speed."""
        return replace(
            self,
            frequency_rad_s=np.asarray(self.frequency_rad_s) * share,
            duration_s=self.duration_s / share,
            ramp_s=self.ramp_s / share,
        )

    def smaller(self, share: ArrayLike) -> Self:
        """Return a sweep with this fraction of the amplitudes: one number, or (3,) with one number per joint."""
        return replace(self, amplitude_rad=np.asarray(self.amplitude_rad) * np.reshape(share, (-1, 1)))

    def to_dict(self) -> dict[str, Any]:
        """Return the sweep as a plan stores it."""
        return {
            "centre_rad": list(self.centre_rad),
            "amplitude_rad": np.asarray(self.amplitude_rad).tolist(),
            "frequency_rad_s": np.asarray(self.frequency_rad_s).tolist(),
            "phase_rad": np.asarray(self.phase_rad).tolist(),
            "duration_s": self.duration_s,
            "ramp_s": self.ramp_s,
        }

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Self:
        """Build a sweep from the dictionary of `to_dict`; a wrong one raises KeyError, TypeError or ValueError."""
        return cls(**document)


def _window(x: Array, derivative: int) -> Array:
    """Return the window's rising ramp at x (n,) from 0 to 1, or a derivative with respect to x, which is 0 outside."""
    polynomial = np.polynomial.Polynomial((0.0, 0.0, 0.0, 10.0, -15.0, 6.0))
    value = np.asarray(polynomial.deriv(derivative)(x) if derivative else polynomial(x))
    return value if derivative == 0 else np.where(x < 1.0, value, 0.0)


def _binomials(order: int) -> list[int]:
    row = [1]
    for _ in range(order):
        row = [1, *(a + b for a, b in pairwise(row)), 1]
    return row
