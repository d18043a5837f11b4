"""Drift of the bias while nothing touches the tool."""

import numpy as np

from ftdrive.live.motion import READING_S
from ftdrive.live.noise import Noise
from ftdrive.live.samples import Ns
from ftdrivers.interfaces import Array

_MEAN_NS = 1_000_000_000
_STILL_RAD = 1e-3
"""Largest motion during a mean."""

_RATE_PER_H = np.repeat([5.0, 0.15], 3)
"""Usual drift, one standard deviation, N/h and N·m/h; it may change as much within an hour."""
_BIAS = np.repeat([1.0, 0.03], 3)
"""Usual error of the bias at the beginning, N and N·m."""
_WANDER = 0.1
"""Random walk of the bias in a minute, relative to the noise of one sample."""
_GATE = 22.5
"""A squared innovation of six channels beyond the limit of one in a thousand is a contact and not drift."""
_PERMANENT = 30
"""After so many rejected means the bias is taken as unknown again."""
_TURN_RAD = 0.03
"""Between poses farther apart than this the error of the calibration differs."""


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

    def follow(self, t_ns: Ns, residual: Array, R_base_flange: Array, noise: Noise, uncertainty: Array) -> bool:
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
                    pose = R, uncertainty
                    self._add(int(t_ns[stop - 1]), self._sum / self._n, variance, np.diag(noise.sample), pose)
                    added = True
                self._begin = None
            start = stop
        return added

    def _add(
        self, t_ns: int, residual: Array, variance: Array, sample_variance: Array, pose: tuple[Array, Array]
    ) -> None:
        """Add a mean (6,) with its variance (6,), and the variance (6,) of the prediction in this pose."""
        if self._t_ns is not None:
            dt_s = (t_ns - self._t_ns) * 1e-9
            F = np.array([[1.0, dt_s], [0.0, 1.0]])
            self._x = self._x @ F.T
            self._P = F @ self._P @ F.T
            self._P[:, 0, 0] += _WANDER**2 * sample_variance * dt_s / 60
            self._P[:, 1, 1] += self._rate_walk * dt_s
        if self._R is not None and np.abs(pose[0] - self._R).max() > _TURN_RAD:
            self._P[:, 0, 0] += 2 * pose[1]
        self._t_ns, self._R = t_ns, pose[0]
        innovation, S = residual - self._x[:, 0], self._P[:, 0, 0] + variance
        if float((innovation**2 / S).sum()) > _GATE:
            self._rejected += 1
            if self._rejected >= _PERMANENT:  # a step of the bias, or a load that stays
                self._P[:, 0, 0], self._rejected = _BIAS**2, 0
            return
        self._rejected = 0
        K = self._P[:, :, 0] / S[:, None]
        self._x = self._x + K * innovation[:, None]
        self._P = self._P - K[:, :, None] * self._P[:, :1, :]

    def shift(self, change: Array) -> None:
        """Account for a change (6,) of the subtracted bias."""
        self._x[:, 0] -= change

    @property
    def force_rate_N_h(self) -> tuple[float, float]:
        """Rate of the force bias, its norm, and one standard deviation along it."""
        rate, variance = 3600 * self._x[:3, 1], 3600**2 * self._P[:3, 1, 1]
        norm = float(np.linalg.norm(rate))
        weights = np.square(rate / norm) if norm > 0 else np.full(3, 1 / 3)
        return norm, float(np.sqrt(weights @ variance))
