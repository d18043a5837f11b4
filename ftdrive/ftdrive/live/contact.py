"""Contact: which readings a free tool does not explain, and what touched it from when to when."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, fdtri

from ftcalib.likelihood.gain_and_cross_talk import Response, predicted_covariance
from ftcalib.model import Array, Parameters
from ftdrive.live.noise import Noise, samples_in_reading
from ftdrive.live.samples import Ns

_TURN_RAD = 0.02
"""The covariance of a calibration is evaluated again after so much turning."""
_LEAST_NS = 60_000_000
"""A shorter contact is no event: three readings in a row beyond the limit are no false alarm. So short a pause does
not end one."""


class ContactTest:
    """Squared Mahalanobis distance of each reading from a free tool, with noise and calibration in the covariance.

    A reading is the mean of the samples of the last `READING_S` seconds, so each sample ends one; independent are those
    without common samples. The distance of a free tool follows Hotelling's T², because the noise is estimated too.

    Parameters
    ----------
    rate_Hz : float
        Of the sensor.
    false_alarm_rate : float
        Share of independent readings of a free tool that exceed `limit`.
    beyond : array, shape (6,)
        Variance beyond what the calibration predicts, N² and (N·m)².
    """

    def __init__(self, rate_Hz: float, false_alarm_rate: float, beyond: Array) -> None:
        self.false_alarm_rate = false_alarm_rate
        self._size = samples_in_reading(rate_Hz)
        self._beyond = np.diag(beyond)
        self._noise: Noise | None = None
        self._calibration: tuple[Parameters, Array, Response | None] | None = None
        self._known: tuple[Array, Array] | None = None
        """Orientation and the matrix that makes its readings white."""
        self.uncertainty = np.zeros((6, 6))
        """Covariance of the prediction at the newest orientation, sensor axes."""
        self.limit = float(chdtri(6, false_alarm_rate))
        """Of the squared distance."""
        self.restart()

    def restart(self) -> None:
        """Forget earlier samples."""
        self._earlier = np.zeros((self._size - 1, 6))

    def expect(self, noise: Noise | None, calibration: tuple[Parameters, Array, Response | None]) -> None:
        """Set what a free tool scatters by: noise, and parameters, covariance and response of the calibration."""
        if noise is not self._noise or self._calibration is None or calibration[0] is not self._calibration[0]:
            self._known = None
        if noise is not None and noise is not self._noise:
            self.limit = _hotelling(self.false_alarm_rate, noise.dof)
        self._noise, self._calibration = noise, calibration

    def judge(self, residual: Array, R_base_flange: Array) -> tuple[Array, Array]:
        """Return the readings (n, 6) and their squared distances (n,); those are NaN until the noise is known."""
        rows = np.concatenate([self._earlier, residual])
        self._earlier = rows[len(residual) :]
        sums = np.cumsum(np.concatenate([np.zeros((1, 6)), rows]), axis=0)
        readings = (sums[self._size :] - sums[: -self._size]) / self._size
        if self._noise is None or self._calibration is None:
            return readings, np.full(len(readings), np.nan)
        chi2 = np.empty(len(readings))
        starts, whiten = self._whitening(R_base_flange, self._noise, self._calibration)
        for start, stop, W in zip(starts, [*starts[1:], len(chi2)], whiten, strict=True):
            white = readings[start:stop] @ W.T
            chi2[start:stop] = np.einsum("ij,ij->i", white, white)
        return readings, chi2

    def _whitening(
        self, R_base_flange: Array, noise: Noise, calibration: tuple[Parameters, Array, Response | None]
    ) -> tuple[list[int], list[Array]]:
        """Return where the orientation has changed, and the whitening matrix from there on."""
        if self._known is not None and np.abs(R_base_flange - self._known[0]).max() < _TURN_RAD:
            return [0], [self._known[1]]
        turned = np.sqrt(np.square(np.diff(R_base_flange, axis=0)).sum(axis=(1, 2)) / 2)
        cell = np.floor(np.cumsum(turned) / _TURN_RAD)
        starts = [0, *(np.flatnonzero(np.diff(cell, prepend=0.0)) + 1).tolist()]
        R = R_base_flange[starts]
        uncertainty = predicted_covariance(*calibration, R) + self._beyond
        whiten = np.linalg.inv(np.linalg.cholesky(uncertainty + noise.reading))
        self.uncertainty = uncertainty[-1]
        self._known = R[-1], whiten[-1]
        return starts, list(whiten)


def _hotelling(rate: float, dof: float) -> float:
    """Limit of the squared distance of six channels whose covariance was estimated with `dof` degrees of freedom."""
    if dof <= 6:
        return float("inf")
    return float(6 * dof / (dof - 5) * fdtri(6, dof - 5, 1 - rate))


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """A contact, up to now or to its end.

    Examples
    --------
    `open_stream` passes it to `on_contact`:

    >>> import ftdrive, numpy as np
    >>> contact = ftdrive.Contact(begin_ns=0, last_ns=10**9, peak_N=5.0, peak=np.array([0, 0, -5.0, 0, 0, 0]))
    >>> contact.over, contact.duration_s, contact.direction
    (False, 1.0, array([ 0.,  0., -1.]))
    """

    begin_ns: int
    """Clock of the cell."""
    last_ns: int
    """The newest reading beyond the limit."""
    peak_N: float
    peak: Array
    """(6,) mean over `READING_S` at the largest force, N and N·m, in `frame` of the stream."""
    over: bool = False

    @property
    def t_s(self) -> float:
        """When it began, as `Sample.t_s`."""
        return self.begin_ns * 1e-9

    @property
    def duration_s(self) -> float:
        """From the first to the last reading beyond the limit."""
        return (self.last_ns - self.begin_ns) * 1e-9

    @property
    def direction(self) -> Array:
        """(3,) unit vector of the force at the peak; zero for a pure torque."""
        return self.peak[:3] / (np.linalg.norm(self.peak[:3]) or 1.0)

    @property
    def line_m(self) -> Array:
        """(3,) point of the line of force nearest to the reference point, along the axes of the frame."""
        force_N = self.peak[:3]
        return np.cross(force_N, self.peak[3:]) / (float(force_N @ force_N) or np.inf)


class ContactTracker:
    """Joins readings beyond the limit to contacts. A shorter one than `_LEAST_NS` is none."""

    def __init__(self) -> None:
        self.open: Contact | None = None
        self._is_confirmed = False

    def follow(self, t_ns: Ns, in_contact: NDArray[np.bool_], readings: Array) -> list[Contact]:
        """Return each contact once it has lasted long enough, and again when it is over.

        `readings` (n, 6) are in the frame of the stream.
        """
        changes = list[Contact]()
        if in_contact.any():
            edges = np.flatnonzero(np.diff(in_contact, prepend=False, append=False)).reshape(-1, 2)
            pauses = t_ns[edges[1:, 0]] - t_ns[edges[:-1, 1] - 1]
            first = np.flatnonzero(np.concatenate([[True], pauses > _LEAST_NS]))
            for start, stop in zip(edges[first, 0], edges[np.append(first[1:], len(edges)) - 1, 1], strict=True):
                if self.open is not None and t_ns[start] - self.open.last_ns > _LEAST_NS:
                    changes += self.end()
                contact = self.open or Contact(int(t_ns[start]), 0, -1.0, readings[start])
                force_N = np.linalg.norm(readings[start:stop, :3], axis=1)
                k = int(np.argmax(force_N))
                if force_N[k] > contact.peak_N:
                    contact = replace(contact, peak_N=float(force_N[k]), peak=readings[start + k])
                self.open = contact = replace(contact, last_ns=int(t_ns[stop - 1]))
                if not self._is_confirmed and contact.last_ns - contact.begin_ns >= _LEAST_NS:
                    self._is_confirmed = True
                    changes.append(contact)
        if self.open is not None and len(t_ns) and t_ns[-1] - self.open.last_ns > _LEAST_NS:
            changes += self.end()
        return changes

    def end(self) -> list[Contact]:
        """End an open contact, as at the end of a recording or when frame or bias change."""
        contact, was_confirmed = self.open, self._is_confirmed
        self.open, self._is_confirmed = None, False
        return [replace(contact, over=True)] if contact is not None and was_confirmed else []
