"""Noise of the rows, from their residuals: by state of motion, correlated between channels and in time."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ftcalib.model import Array

REST_RAD_S = 0.02
CLASSES = 3
"""Of speed, beside rest."""
FEWEST = 40
"""Rows that show the noise of a state; fewer count with the next faster one."""
ORDER = 6
"""Of the autoregression, in rows."""
_ROWS_PER_ORDER = 25
_MOST = 0.98
"""Of a partial correlation."""


def states(speed_rad_s: Array, kept: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the state of motion (n,) of each row: rest, then classes of speed that have as many kept rows each."""
    moving = speed_rad_s[kept & (speed_rad_s > REST_RAD_S)]
    limits = [REST_RAD_S]
    if len(moving) >= 2 * FEWEST:
        classes = min(CLASSES, len(moving) // FEWEST)
        limits += np.quantile(moving, np.arange(1, classes) / classes).tolist()
    state = np.searchsorted(limits, speed_rad_s)
    if np.count_nonzero(kept & (state == 0)) < FEWEST:
        state = np.maximum(state - 1, 0)
    return np.asarray(state if (state[kept] == state.max()).sum() >= FEWEST else np.zeros_like(state))


def runs(t_s: Array, row_s: float) -> NDArray[np.intp]:
    """Return the place (n,) of each row in its run of rows without a gap, from 0."""
    breaks = np.flatnonzero(np.diff(t_s, prepend=-np.inf) > 1.5 * row_s)
    return np.asarray(np.arange(len(t_s)) - np.repeat(breaks, np.diff(np.append(breaks, len(t_s)))))


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """A model of the noise that makes rows independent and of unit variance."""

    scale: Array
    """(states, 6) standard deviation of a row."""
    filters: Array
    """(order + 1, 6, order + 1) by rows before in the run, channel, and lag: predictors divided by their error."""
    root: Array
    """(6, 6) inverse root of the correlation between channels of what they leave."""

    @classmethod
    def of(
        cls,
        residuals: Array,
        absorbed: Array,
        state: NDArray[np.intp],
        place: NDArray[np.intp],
        *,
        bursts: bool = False,
    ) -> Self:
        """Estimate from kept rows.

        Parameters
        ----------
        residuals : array, shape (n, 6)
        absorbed : array, shape (n, 6, k)
            A root of the covariance of what the fit predicts: so much noise it has taken from the residuals.
        state, place : array, shape (n,)
            As `states` and `runs` return them.
        bursts : bool
            Whether noise that seems weaker at the frequencies of the motion than above them counts as white: gears
            shake the tool quickly where a joint reverses, but unequal weights let that reach low frequencies.
        """
        X = np.concatenate([residuals[:, :, None], absorbed], axis=2)
        common = np.sqrt(np.mean(np.sum(X**2, axis=2), axis=0)) + 1e-12
        square = (np.sum(X**2, axis=2) / common**2).reshape(-1, 2, 3).mean(axis=2)
        counts = np.maximum(np.bincount(state), 1)[:, None]
        by_state = np.stack([np.bincount(state, group) for group in square.T], axis=1) / counts
        scale = np.sqrt(np.repeat(by_state, 3, axis=1)) * common
        unit = X / scale[state][:, :, None]
        channels = [_filters(channel, place, bursts=bursts) for channel in np.moveaxis(unit, 1, 0)]
        noise = cls(scale, _of_equal_order(channels), np.eye(6))
        left = noise.whitened(X, state, place)
        correlation = np.einsum("nik,njk->ij", left, left) / len(left)
        return cls(scale, noise.filters, np.linalg.inv(np.linalg.cholesky(correlation + 1e-9 * np.eye(6))))

    def whitened(self, X: Array, state: NDArray[np.intp], place: NDArray[np.intp]) -> Array:
        """Return values (n, 6, k) of rows as independent ones of unit variance.

        A row is predicted from the rows before it in its run, as many as the order, fewer at the beginning.
        """
        X = X / self.scale[state][:, :, None]
        order = self.filters.shape[0] - 1
        filters = self.filters[np.minimum(place, order)]
        result = filters[:, :, 0, None] * X
        for lag in range(1, order + 1):
            result[lag:] += filters[lag:, :, lag, None] * X[:-lag]
        return np.asarray(self.root @ result)


def _filters(unit: Array, place: NDArray[np.intp], *, bursts: bool) -> Array:
    """Predictors (order + 1, order + 1) of a channel by Levinson's recursion, of the order of least BIC."""
    most, size = min(ORDER, len(unit) // _ROWS_PER_ORDER), len(unit)
    lags = np.empty(most + 1)
    for lag in range(most + 1):
        paired = place >= lag
        lags[lag] = np.sum(unit[paired] * unit[np.flatnonzero(paired) - lag]) / max(paired.sum(), 1)
    r, a, error = lags / lags[0], np.zeros(0), 1.0
    filters, criteria = np.zeros((most + 1, most + 1)), [0.0]
    filters[0, 0] = 1.0
    for k in range(1, most + 1):
        partial = float(np.clip((r[k] - a @ r[k - 1 : 0 : -1]) / error, -_MOST, _MOST))
        a, error = np.append(a - partial * a[::-1], partial), error * (1 - partial**2)
        filters[k, : k + 1] = np.append(1.0, -a) / np.sqrt(error)
        criteria.append(size * np.log(error) + np.log(size) * k)
    best = int(np.argmin(criteria)) + 1
    if bursts and filters[best - 1, :best].sum() > 1:
        best = 1
    return filters[:best, :best]


def _of_equal_order(channels: list[Array]) -> Array:
    """Stack filters (order + 1, channels, order + 1): beyond its order a channel keeps its last one."""
    size = max(len(one) for one in channels)
    padded = [np.pad(one, ((0, size - len(one)), (0, size - len(one))), mode="constant") for one in channels]
    for one, wide in zip(channels, padded, strict=True):
        wide[len(one) :, : len(one)] = one[-1]
    return np.stack(padded, axis=1)
