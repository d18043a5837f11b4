"""Noise of a sensor in each state of motion of the arm, from its stream."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ftcalib.data.dwell_mean import RESOLUTION
from ftdrive.live.motion import REST, STATES, samples_in_reading
from ftdrivers.interfaces import Array

_WINDOW, _SHORT = 25, 8
"""Successive readings of a window at rest, and of one in motion or of a short rest."""
_UNSEEN = 4
"""Readings before a motion is seen: they do not count for the rest before it."""
_WINDOWS = 60
_LOUD = {True: 1.5, False: 4.0}
"""A window this many times louder than the median holds a touch or a jolt, and does not count."""
_STEP_SIGMAS = 5.0
"""A larger step between the means of two windows is the begin or the end of a contact."""
_FIRST_MOTION, _FIRST_M_S2 = 10.0, 1.0
"""Until the noise of a state of motion is known, it counts as so many times that at rest, and as an acceleration."""
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
    """Covariances over the last windows of each state of motion; older ones are forgotten.

    Readings are taken about a straight line through a window, and at rest the means of these windows from one to the
    next, so that bias, drift, a constant contact and slow errors of a calibration do not count. A window counts for the
    fastest state that it holds, and not for rest just before motion, which is felt before it is seen.

    Parameters
    ----------
    rate_Hz : float
    accelerated : array, shape (6, 3)
        Wrench of the load by its acceleration: what vibrates before the noise in motion is known.
    """

    def __init__(self, rate_Hz: float, accelerated: Array) -> None:
        self._size = samples_in_reading(rate_Hz)
        self._unread = np.empty((0, 7))
        self._at_rest = True
        self._open = np.empty((0, 43))
        """Mean (6), scatter (6, 6) and state of the readings since the last window or change of rest and motion."""
        self._mean_before: Array | None = None
        self._windows: list[deque[tuple[Array, Array, Array]]] = [deque(maxlen=_WINDOWS) for _ in range(STATES)]
        """Scatter of its readings, scatter of their samples, and step from the window before."""
        self._known: dict[int, Noise] = {}
        self._first = _FIRST_M_S2**2 * accelerated @ accelerated.T

    def of(self, state: int) -> Noise | None:
        """Return the noise in a state, or what is assumed until a second of it; None before the first half second."""
        known, rest = self._known.get(state), self._known.get(REST)
        other = rest or next(iter(self._known.values()), None)
        if state == REST or other is None:
            return other
        if known is None or known.dof < _ENOUGH_DOF:
            learnt = (one for k, one in sorted(self._known.items()) if k > state and one.dof >= _ENOUGH_DOF)
            if (faster := next(learnt, None)) is not None:
                return faster
            reading = _FIRST_MOTION**2 * other.reading if rest else other.reading
            return replace(other, sample=other.sample + self._first, reading=reading + self._first)
        return known if rest is None else replace(known, wander=rest.wander)

    def add(self, residual: Array, states: NDArray[np.int8]) -> None:
        """Add samples (n, 6) of which the wrench of a free tool is subtracted, and the states of motion (n,)."""
        rows = np.concatenate([self._unread, np.column_stack([residual, states])])
        n = len(rows) // self._size
        self._unread = rows[n * self._size :]
        if not n:
            return
        groups = rows[: n * self._size].reshape(n, self._size, 7)
        means = groups[:, :, :6].mean(axis=1)
        inside = groups[:, :, :6] - means[:, None]
        within = np.einsum("nsi,nsj->nij", inside, inside).reshape(n, 36) / self._size
        readings = np.column_stack([means, within, groups[:, :, 6].max(axis=1)])
        at_rest = readings[:, 42] == REST
        edges = np.flatnonzero(np.diff(at_rest)) + 1
        for run, rest in zip(np.split(readings, edges), np.split(at_rest, edges), strict=True):
            self._collect(run, at_rest=bool(rest[0]))

    def _collect(self, readings: Array, *, at_rest: bool) -> None:
        """Add readings (n, 43), all at rest or all in motion."""
        if at_rest is not self._at_rest:
            short = self._open[: max(len(self._open) - _UNSEEN, 0)]
            if self._at_rest and len(short) >= _SHORT:
                self._add_windows([short])
            self._at_rest, self._open, self._mean_before = at_rest, self._open[:0], None
        self._open = np.concatenate([self._open, readings])
        size, later = (_WINDOW, _UNSEEN) if at_rest else (_SHORT, 0)
        full = max(len(self._open) - later, 0) // size
        self._add_windows(list(self._open[: full * size].reshape(full, size, 43)[-_WINDOWS - 1 :]))
        self._open = self._open[full * size :]

    def _add_windows(self, windows: Sequence[Array]) -> None:
        changed = set()
        for window in windows:
            size = len(window)
            left = _about_line(size) @ window[:, :6]
            mean = window[:, :6].mean(axis=0)
            step = np.full(6, np.nan) if self._mean_before is None else mean - self._mean_before
            self._mean_before = mean
            state = int(window[:, 42].max())
            within = window[:, 6:42].mean(axis=0).reshape(6, 6)
            self._windows[state].append((left.T @ left / (size - 2), within, step))
            changed.add(state)
        for state in changed:
            self._known[state] = self._estimated(state)

    def _estimated(self, state: int) -> Noise:
        at_rest = state == REST
        reading, within, steps = (np.array([window[i] for window in self._windows[state]]) for i in range(3))
        floor = RESOLUTION**2 / self._size
        variances = np.diagonal(reading, axis1=1, axis2=2)
        loudness = (variances / (np.median(variances, axis=0) + floor)).mean(axis=1)
        quiet = loudness <= _LOUD[at_rest] * np.median(loudness)
        mean = reading[quiet].mean(axis=0) + np.diag(floor)
        steps = steps[np.isfinite(steps[:, 0])]
        if len(steps):
            smallest = np.quantile(np.square(steps), 0.25, axis=0) / 0.1015  # the same quantile of chi²
            usual = np.sqrt(smallest + np.diag(mean) / _WINDOW)
            steps = steps[(np.abs(steps) < _STEP_SIGMAS * usual).all(axis=1)]
        wander = steps.T @ steps / max(len(steps), 1)
        dof = _INDEPENDENT * (_WINDOW if at_rest else _SHORT) * float(quiet.sum())
        return Noise(mean + within[quiet].mean(axis=0), mean, wander, dof)


@lru_cache
def _about_line(n: int) -> Array:
    """Return the matrix (n, n) that subtracts the straight line through n values."""
    basis = np.stack([np.ones(n), np.linspace(-1, 1, n)], axis=1)
    return np.asarray(np.eye(n) - basis @ np.linalg.pinv(basis))
