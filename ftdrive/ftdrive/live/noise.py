"""Noise of a sensor in each state of motion of the arm, from its stream."""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ftcalib import CalibrationResult
from ftcalib.data.dwell_mean import RESOLUTION
from ftcalib.files import JSON
from ftcalib.rounding import with_sigma
from ftdrive.live.motion import READING_S, REST, STATES, samples_in_reading
from ftdrive.live.samples import Ns
from ftdrivers.interfaces import Array

# Successive readings of a window at rest, and of one in motion or of a short rest.
_WINDOW, _SHORT = 25, 8
# Readings before a motion is seen: they do not count for the rest before it.
_UNSEEN = 4
_WINDOWS = 60
# A window this many times louder than the median holds a touch or a jolt, and does not count.
_LOUD = {True: 1.5, False: 4.0}
# A larger step between the means of two windows is the begin or the end of a contact.
_STEP_SIGMAS = 5.0
# Until the noise of a state of motion is known, it counts as so many times that at rest, and as an acceleration.
_FIRST_MOTION, _FIRST_M_S2 = 10.0, 1.0
_ENOUGH_DOF = 25.0
# Degrees of freedom per reading: low-pass filters of sensors make neighbours alike.
_INDEPENDENT = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class SensorNoise:
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
        # Mean (6), scatter (6, 6) and state of the readings since the last window or change of rest and motion.
        self._open = np.empty((0, 43))
        self._mean_before: Array | None = None
        # Scatter of its readings, scatter of their samples, and step from the window before.
        self._windows: list[deque[tuple[Array, Array, Array]]] = [deque(maxlen=_WINDOWS) for _ in range(STATES)]
        self._known: dict[int, SensorNoise] = {}
        self._first = _FIRST_M_S2**2 * accelerated @ accelerated.T

    def of(self, state: int) -> SensorNoise | None:
        """Return the noise in a state, or what is assumed until a second of it; None before the first half second."""
        known, rest = self._known.get(state), self._known.get(REST)
        other = rest or next(iter(self._known.values()), None)
        if state == REST or other is None:
            return other
        # A new class of motion counts as a loud one, for about 2 s of its motion.
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

    def _estimated(self, state: int) -> SensorNoise:
        at_rest = state == REST
        reading, within, steps = (np.array([window[i] for window in self._windows[state]]) for i in range(3))
        floor = RESOLUTION**2 / self._size
        variances = np.diagonal(reading, axis1=1, axis2=2)
        loudness = (variances / (np.median(variances, axis=0) + floor)).mean(axis=1)
        quiet = loudness <= _LOUD[at_rest] * np.median(loudness)
        mean = reading[quiet].mean(axis=0) + np.diag(floor)
        steps = steps[np.isfinite(steps[:, 0])]
        if len(steps):
            # the same quantile of chi²
            smallest = np.quantile(np.square(steps), 0.25, axis=0) / 0.1015
            usual = np.sqrt(smallest + np.diag(mean) / _WINDOW)
            steps = steps[(np.abs(steps) < _STEP_SIGMAS * usual).all(axis=1)]
        wander = steps.T @ steps / max(len(steps), 1)
        dof = _INDEPENDENT * (_WINDOW if at_rest else _SHORT) * float(quiet.sum())
        return SensorNoise(mean + within[quiet].mean(axis=0), mean, wander, dof)


@lru_cache
def _about_line(n: int) -> Array:
    """Return the matrix (n, n) that subtracts the straight line through n values."""
    basis = np.stack([np.ones(n), np.linspace(-1, 1, n)], axis=1)
    return np.asarray(np.eye(n) - basis @ np.linalg.pinv(basis))


_MEAN_NS = 1_000_000_000
# Largest motion during a mean.
_STILL_RAD = 1e-3

# Usual drift, one standard deviation, N/h and N·m/h; it may change as much within an hour.
_RATE_PER_H = np.repeat([5.0, 0.15], 3)
# Usual error of the bias at the beginning, N and N·m.
_BIAS = np.repeat([1.0, 0.03], 3)
# Random walk of the bias in a minute, relative to the noise of one sample.
_WANDER = 0.1
# A squared innovation of six channels beyond the limit of one in a thousand is a contact and not drift.
_GATE = 22.5
_WARNED_SIGMAS = 5.0
# After so many rejected means the bias is taken as unknown again.
_PERMANENT = 30
# Between poses farther apart than this the error of the calibration differs.
_TURN_RAD = 0.03


class DriftFilter:
    """Kalman filter of bias and rate of each channel: random walk plus integrated random walk.

    Measured is the residual of a free tool at rest. The error of the calibration is constant in one pose, and becomes
    another at the next. The filter never corrects anything.
    """

    def __init__(self) -> None:
        self._x = np.zeros((6, 2))
        rate = _RATE_PER_H / 3600
        self._P = np.zeros((6, 2, 2))
        self._P[:, 0, 0], self._P[:, 1, 1] = _BIAS**2, rate**2
        self._rate_walk = rate**2 / 3600
        self._rejected = 0
        self._begin: tuple[int, Array] | None = None
        self._sum, self._n, self._moved = np.zeros(6), 0, False
        self._t_ns: int | None = None
        self._R: Array | None = None
        self._warned = False

    def follow(self, t_ns: Ns, residual: Array, R_base_flange: Array, noise: SensorNoise, uncertainty: Array) -> bool:
        """Add the mean of each second in which the arm rests; return whether there was one.

        Parameters
        ----------
        t_ns : array, shape (n,)
        residual : array, shape (n, 6)
            Measured minus predicted wrench, N and N·m, sensor axes.
        R_base_flange : array, shape (n, 3, 3)
        noise : Noise
        uncertainty : array, shape (6,)
            Variance of the prediction.
        """
        start, added = 0, False
        while start < len(t_ns):
            if self._begin is None:
                self._begin = int(t_ns[start]), R_base_flange[start]
                self._sum, self._n, self._moved = np.zeros(6), 0, False
            begin_ns, R = self._begin
            stop = max(start + 1, int(np.searchsorted(t_ns, begin_ns + _MEAN_NS)))
            self._sum = self._sum + residual[start:stop].sum(axis=0)
            self._n += stop - start
            self._moved |= bool(np.abs(R_base_flange[stop - 1] - R).max() > _STILL_RAD)
            if t_ns[stop - 1] - begin_ns >= _MEAN_NS * 0.99 or stop < len(t_ns):
                if not self._moved:
                    readings = max((t_ns[stop - 1] - begin_ns) * 1e-9 / READING_S, 1.0)
                    variance = np.diag(noise.reading) / readings
                    mean = self._sum / self._n
                    self._add(int(t_ns[stop - 1]), mean, variance, np.diag(noise.sample), R, uncertainty)
                    added = True
                self._begin = None
            start = stop
        return added

    def _add(
        self, t_ns: int, residual: Array, variance: Array, sample_variance: Array, R: Array, uncertainty: Array
    ) -> None:
        """Add a mean (6,) with its variance (6,), and the variance (6,) of the prediction in this pose."""
        if self._t_ns is not None:
            dt_s = (t_ns - self._t_ns) * 1e-9
            F = np.array([[1.0, dt_s], [0.0, 1.0]])
            self._x = self._x @ F.T
            self._P = F @ self._P @ F.T
            self._P[:, 0, 0] += _WANDER**2 * sample_variance * dt_s / 60
            self._P[:, 1, 1] += self._rate_walk * dt_s
        if self._R is not None and np.abs(R - self._R).max() > _TURN_RAD:
            self._P[:, 0, 0] += 2 * uncertainty
        self._t_ns, self._R = t_ns, R
        innovation, S = residual - self._x[:, 0], self._P[:, 0, 0] + variance
        if float((innovation**2 / S).sum()) > _GATE:
            self._rejected += 1
            # a step of the bias, or a load that stays
            if self._rejected >= _PERMANENT:
                self._P[:, 0, 0], self._rejected = _BIAS**2, 0
            return
        self._rejected = 0
        K = self._P[:, :, 0] / S[:, None]
        self._x = self._x + K * innovation[:, None]
        self._P = self._P - K[:, :, None] * self._P[:, :1, :]

    def shift(self, change: Array) -> None:
        """Account for a change (6,) of the subtracted bias."""
        self._x[:, 0] -= change

    def warning(self, usual_N_h: float) -> tuple[str, Mapping[str, JSON]] | None:
        """Return text and values of an event, once, when the drift exceeds the usual one and clearly its sigma."""
        rate, sigma = self.force_rate_N_h
        worth = max(usual_N_h, _WARNED_SIGMAS * sigma)
        before = self._warned
        # half the limit ends a drift, so that one near the limit is reported once
        self._warned = rate > (0.5 if before else 1.0) * worth
        if rate <= worth or before:
            return None
        text = f"the bias drifts by {with_sigma(rate, sigma)} N/h (1 sigma); tare when the tool is free"
        return text, {"drift_N_h": rate, "sigma_N_h": sigma}

    @property
    def force_rate_N_h(self) -> tuple[float, float]:
        """Rate of the force bias, its norm, and one standard deviation along it."""
        rate, variance = 3600 * self._x[:3, 1], 3600**2 * self._P[:3, 1, 1]
        norm = float(np.linalg.norm(rate))
        weights = np.square(rate / norm) if norm > 0 else np.full(3, 1 / 3)
        return norm, float(np.sqrt(weights @ variance))


def variance_at_next_use(calibration: CalibrationResult) -> Array:
    """Return the variance (6,) of an axis in any orientation beyond the prediction: what residuals leave, and drift."""
    excess = np.square(calibration.likely_error("workspace")) - np.square(calibration.predicted_error())
    return np.repeat(excess.clip(0.0) / 3, 3)


def unexplained_variance(calibration: CalibrationResult) -> Array:
    """Return the same (6,) without drift, where that counts on its own: zero where the noise explains the residuals."""
    return np.zeros(6) if calibration.noise_explains else variance_at_next_use(calibration)
