"""Noise of a sensor, from its stream while the arm rests."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from ftcalib.data.dwell_mean import RESOLUTION
from ftdrivers.interfaces import Array

READING_S = 0.02
"""A reading is the mean of the samples of this time: contact is judged by readings."""

_STILL_RAD, _STILL_M = 1e-4, 1e-4
"""Largest motion of the flange between two readings at rest."""
_WINDOW = 25
"""Differences of successive readings."""
_WINDOWS = 60
_LOUD = 1.5
"""A window this many times louder than the median holds a touch or a jolt, and does not count."""
_INDEPENDENT = 2 / 3
"""Degrees of freedom per difference, because neighbours share a reading."""


def samples_in_reading(rate_Hz: float) -> int:
    """Return how many samples of a sensor make one reading."""
    return max(1, round(READING_S * rate_Hz))


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Covariances of white and coloured noise alike, N and N·m, sensor axes."""

    sample: Array
    """(6, 6) of one sample."""
    reading: Array
    """(6, 6) of the mean over `READING_S`."""
    dof: float
    """Independent differences behind it."""


class NoiseEstimator:
    """Covariance of samples and readings over the last half minute at rest.

    Half the mean square of the difference of successive readings is their variance, whatever bias or constant contact
    there is. Until the arm rests once, its motion counts too, so that the noise is then rather too large.

    Parameters
    ----------
    rate_Hz : float
    """

    def __init__(self, rate_Hz: float) -> None:
        self._size = samples_in_reading(rate_Hz)
        self._unread = np.empty((0, 18))
        self._before: tuple[Array, Array] | None = None
        """Mean and last pose of the reading before."""
        self._open: dict[bool, list[Array]] = {True: [], False: []}
        self._windows: dict[bool, deque[tuple[Array, Array]]] = {
            still: deque(maxlen=_WINDOWS) for still in (True, False)
        }
        self.noise: Noise | None = None
        """None until the first window is full."""

    def add(self, residual: Array, R_base_flange: Array, p_base_flange_m: Array) -> None:
        """Add samples (n, 6) of which the wrench of a free tool is subtracted, and their poses."""
        rows = np.concatenate([residual, R_base_flange.reshape(-1, 9), p_base_flange_m], axis=1)
        rows = np.concatenate([self._unread, rows])
        n = len(rows) // self._size
        self._unread = rows[n * self._size :]
        if not n:
            return
        groups = rows[: n * self._size].reshape(n, self._size, 18)
        means = groups[:, :, :6].mean(axis=1)
        inside = groups[:, :, :6] - means[:, None]
        within = np.einsum("nsi,nsj->nij", inside, inside) / self._size
        poses = groups[:, -1, 6:]
        if self._before is None:
            self._before = means[0], poses[0]
            means, poses, within, groups = means[1:], poses[1:], within[1:], groups[1:]
        self._collect(
            np.concatenate([self._before[0][None], means]), np.concatenate([self._before[1][None], poses]), within
        )
        if len(means):
            self._before = means[-1], poses[-1]

    def _collect(self, means: Array, poses: Array, within: Array) -> None:
        """Add the differences of n + 1 successive readings to the windows."""
        moved = np.abs(np.diff(poses, axis=0))
        # as `not >`, so that an unknown position is still
        still = (moved[:, :9].max(axis=1, initial=0.0) < _STILL_RAD) & ~(moved[:, 9:] > _STILL_M).any(axis=1)
        steps = np.diff(means, axis=0)
        changed = False
        for kind in (True, False):
            alike = still == kind
            if not alike.any():
                continue
            self._open[kind].append(np.concatenate([steps[alike], within[alike].reshape(-1, 36)], axis=1))
            if sum(map(len, self._open[kind])) >= _WINDOW:
                rows = np.concatenate(self._open[kind])
                full = len(rows) // _WINDOW
                for window in rows[: full * _WINDOW].reshape(full, _WINDOW, 42)[-_WINDOWS:]:
                    D = window[:, :6]
                    self._windows[kind].append((D.T @ D / (2 * _WINDOW), window[:, 6:].mean(axis=0).reshape(6, 6)))
                self._open[kind] = [rows[full * _WINDOW :]]
                changed = True
        if changed:
            self._estimate()

    def _estimate(self) -> None:
        windows = self._windows[True] or self._windows[False]
        reading, within = (np.array([window[i] for window in windows]) for i in (0, 1))
        floor = RESOLUTION**2 / self._size
        variances = np.diagonal(reading, axis1=1, axis2=2)
        loudness = (variances / (np.median(variances, axis=0) + floor)).mean(axis=1)
        quiet = loudness <= _LOUD * np.median(loudness)
        mean = reading[quiet].mean(axis=0) + np.diag(floor)
        dof = _INDEPENDENT * _WINDOW * float(quiet.sum())
        self.noise = Noise(mean + within[quiet].mean(axis=0), mean, dof)
