"""Noise of a sensor in each state of motion of the arm, from its stream."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ftcalib.data.dwell_mean import RESOLUTION
from ftdrive.live.motion import Motion, samples_in_reading
from ftdrivers.interfaces import Array

_WINDOW = 25
"""Successive readings in one state of motion."""
_WINDOWS = 60
_LOUD = {Motion.REST: 1.5, Motion.MOVING: 4.0}
"""A window this many times louder than the median holds a touch or a jolt, and does not count."""
_STEP_SIGMAS = 5.0
"""A larger step between the means of two windows is the begin or the end of a contact."""
_FIRST_MOTION = 10.0
"""Until the noise in motion is known, it counts as so many times that at rest."""
_ENOUGH_DOF = 25.0
_INDEPENDENT = 0.25
"""Degrees of freedom per reading: low-pass filters of sensors make neighbours alike."""


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Covariances of white and coloured noise alike, N and N·m, sensor axes."""

    sample: Array
    """(6, 6) of one sample."""
    reading: Array
    """(6, 6) of the mean over `READING_S`, about its course over half a second."""
    wander: Array
    """(6, 6) of what changes more slowly, from one half second to the next."""
    dof: float
    """Independent readings behind it."""


class NoiseEstimator:
    """Covariances over the last half minute of each state of motion.

    Readings are taken about a straight line of half a second, and the means of these half seconds from one to the next,
    so that bias, drift and a constant contact do not count.

    Parameters
    ----------
    rate_Hz : float
    """

    def __init__(self, rate_Hz: float) -> None:
        self._size = samples_in_reading(rate_Hz)
        self._unread = np.empty((0, 7))
        self._state = Motion.REST
        self._open = np.empty((0, 42))
        """Mean (6) and scatter (6, 6) of the readings since the last window or change of state."""
        self._mean_before: Array | None = None
        self._windows: Mapping[Motion, deque[tuple[Array, Array, Array]]] = {
            state: deque(maxlen=_WINDOWS) for state in Motion
        }
        """Scatter of its readings, scatter of their samples, and step from the window before."""
        self._known: dict[Motion, Noise] = {}

    def of(self, state: Motion) -> Noise | None:
        """Return the noise in a state, or what is assumed until a second of it; None before the first half second."""
        known, other = self._known.get(state), next(iter(self._known.values()), None)
        if state is Motion.REST or other is None or (known is not None and known.dof >= _ENOUGH_DOF):
            return known or other
        return replace(other, reading=_FIRST_MOTION**2 * other.reading)

    def add(self, residual: Array, moving: NDArray[np.bool_]) -> None:
        """Add samples (n, 6) of which the wrench of a free tool is subtracted, and whether the arm moves (n,)."""
        rows = np.concatenate([self._unread, np.column_stack([residual, moving])])
        n = len(rows) // self._size
        self._unread = rows[n * self._size :]
        if not n:
            return
        groups = rows[: n * self._size].reshape(n, self._size, 7)
        means = groups[:, :, :6].mean(axis=1)
        inside = groups[:, :, :6] - means[:, None]
        within = np.einsum("nsi,nsj->nij", inside, inside).reshape(n, 36) / self._size
        readings, moves = np.concatenate([means, within], axis=1), groups[:, :, 6].any(axis=1)
        edges = np.flatnonzero(np.diff(moves)) + 1
        for run, alike in zip(np.split(readings, edges), np.split(moves, edges), strict=True):
            self._collect(Motion.MOVING if alike[0] else Motion.REST, run)

    def _collect(self, state: Motion, readings: Array) -> None:
        """Add readings (n, 42) in one state of motion."""
        if state is not self._state:
            self._state, self._open, self._mean_before = state, self._open[:0], None
        self._open = np.concatenate([self._open, readings])
        full = len(self._open) // _WINDOW
        for window in self._open[: full * _WINDOW].reshape(full, _WINDOW, 42)[-_WINDOWS - 1 :]:
            about_line = _ABOUT_LINE @ window[:, :6]
            mean = window[:, :6].mean(axis=0)
            step = np.full(6, np.nan) if self._mean_before is None else mean - self._mean_before
            self._mean_before = mean
            scatter = about_line.T @ about_line / (_WINDOW - 2)
            self._windows[state].append((scatter, window[:, 6:].mean(axis=0).reshape(6, 6), step))
        if full:
            self._open = self._open[full * _WINDOW :]
            self._known[state] = self._estimated(state)

    def _estimated(self, state: Motion) -> Noise:
        reading, within, steps = (np.array([window[i] for window in self._windows[state]]) for i in range(3))
        floor = RESOLUTION**2 / self._size
        variances = np.diagonal(reading, axis1=1, axis2=2)
        loudness = (variances / (np.median(variances, axis=0) + floor)).mean(axis=1)
        quiet = loudness <= _LOUD[state] * np.median(loudness)
        mean = reading[quiet].mean(axis=0) + np.diag(floor)
        steps = steps[np.isfinite(steps[:, 0])]
        if len(steps):
            smallest = np.quantile(np.square(steps), 0.25, axis=0) / 0.1015  # the same quantile of chi²
            usual = np.sqrt(smallest + np.diag(mean) / _WINDOW)
            steps = steps[(np.abs(steps) < _STEP_SIGMAS * usual).all(axis=1)]
        wander = steps.T @ steps / max(len(steps), 1)
        dof = _INDEPENDENT * _WINDOW * float(quiet.sum())
        return Noise(mean + within[quiet].mean(axis=0), mean, wander, dof)


def _about_line(n: int) -> Array:
    """Return the matrix (n, n) that subtracts the straight line through n values."""
    basis = np.stack([np.ones(n), np.linspace(-1, 1, n)], axis=1)
    return np.asarray(np.eye(n) - basis @ np.linalg.pinv(basis))


_ABOUT_LINE = _about_line(_WINDOW)
