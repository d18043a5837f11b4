"""Contact: which readings a free tool does not explain, and what touched it from when to when."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, fdtri

from ftcalib.files import JSON
from ftcalib.model import Array
from ftcalib.sensor_matrix import Calibrated
from ftdrive.stream.free_tool import Following
from ftdrive.stream.noise import (
    GYRATION_M,
    READING_S,
    REST,
    NoiseEstimator,
    SensorNoise,
    samples_in_reading,
    wrench_by_acceleration,
)
from ftdrive.stream.samples import Ns, Paired

# The covariance of a calibration is evaluated again after so much turning.
_TURN_RAD = 0.02
# Acceleration of an arm in motion, one sigma, without positions; its error without the poses that follow; rotation.
_UNKNOWN_M_S2, _COARSE_M_S2, _UNKNOWN_RAD_S2 = 1.0, 0.3, 2.5
# Error of the time of a predicted wrench, beside that of the delay: accelerations are means over as long.
_INEXACT_S = 0.005
# Friction of wrist 3, which the arm's own sensor feels.
_FRICTION_NM = 0.15
# So many readings begin or end a contact.
# Rules with one mean as long begin a contact later.
_IN_A_ROW = 3
# From one of them to the next; the shorter one where inertia is subtracted, which needs the poses that follow.
_LAG_S, _SHORT_LAG_S = READING_S, READING_S / 2


class Inertia(Enum):
    """How well the prediction of a free tool has its inertia."""

    UNKNOWN = 0
    COARSE = 1
    """From the poses before."""
    EXACT = 2
    """From poses on both sides."""


class ContactTest:
    """Squared Mahalanobis distance of each reading from a free tool, with noise and calibration in the covariance.

    A reading is the mean of the samples of the last `READING_S` seconds, so each sample ends one; independent are those
    without common samples. The distance of a free tool follows Hotelling's T², because the noise is estimated too.
    Noise is that of the present state of motion. In motion, the error of the delay and, where inertia is not
    subtracted, an unknown acceleration are in the covariance too.

    The offset of the free tool, which drift and the error of the calibration in this orientation make, is that of its
    filter. `beyond` (6,) is the variance beyond what the calibration predicts, N² and (N·m)², and `friction_axis` (3,)
    the axis of wrist 3 in sensor axes, if the sensor feels its friction.
    """

    def __init__(
        self, rate_Hz: float, false_alarm_rate: float, beyond: Array, friction_axis: Array | None = None
    ) -> None:
        self.false_alarm_rate = false_alarm_rate
        self._size = samples_in_reading(rate_Hz)
        self._beyond = np.diag(beyond)
        self._friction = np.zeros((6, 6))
        if friction_axis is not None:
            self._friction[3:, 3:] = _FRICTION_NM**2 * np.outer(friction_axis, friction_axis)
        self._calibration: Calibrated | None = None
        # Covariance of what inertia leaves.
        self._unknown = dict.fromkeys(Inertia, np.zeros((6, 6)))
        self.uncertainty = np.zeros((6, 6))
        """Covariance of the prediction at the newest orientation, sensor axes."""
        self.limit = float(chdtri(6, false_alarm_rate))
        """Limit of the squared distance of the newest reading."""
        self.restart()

    def restart(self) -> None:
        """Forget earlier samples."""
        self._earlier = np.zeros((self._size - 1, 6))
        # The predictions of the last `READING_S` seconds.
        self._predicted: Array | None = None
        self._R: Array | None = None
        self._whitening: tuple[tuple[SensorNoise, int, Inertia | None], Array, Array] | None = None

    def expect(self, calibration: Calibrated, mass_kg: float, *, tensor_known: bool) -> None:
        """Set the calibration of a free tool, its mass, and whether its inertia tensor is known."""
        if self._calibration is None or calibration.parameters is not self._calibration.parameters:
            self._R = None
            B = wrench_by_acceleration(mass_kg, calibration.parameters.p_sensor_com_m)
            turned = np.diag(np.repeat([0.0, (mass_kg * GYRATION_M**2 * _UNKNOWN_RAD_S2) ** 2], 3))
            self._unknown = {
                Inertia.UNKNOWN: _UNKNOWN_M_S2**2 * B @ B.T + turned,
                Inertia.COARSE: _COARSE_M_S2**2 * B @ B.T + turned,
                Inertia.EXACT: np.zeros((6, 6)) if tensor_known else turned,
            }
        self._calibration = calibration

    def judge(
        self,
        residual: Array,
        predicted: Array,
        rows: Paired,
        motion: tuple[NDArray[np.int8], Array],
        noise: NoiseEstimator,
        free: Following,
        *,
        delay_sigma_s: float,
        inertia: Inertia,
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return readings (n, 6), their chi2 (n,), NaN until the noise is known, and which are beyond the limit (n,).

        `residual` is the measured minus the predicted wrench (n, 6), `motion` is that of `MotionTracker.follow`, and
        `inertia` is how well the prediction has it. The samples are added to what is known of the free tool.
        """
        states, felt = motion
        n = len(residual)
        residuals = np.concatenate([self._earlier, residual])
        self._earlier = residuals[n:]
        sums = np.cumsum(np.concatenate([np.zeros((1, 6)), residuals]), axis=0)
        readings = (sums[self._size :] - sums[: -self._size]) / self._size
        inexact = np.where((states == REST)[:, None], felt, self._change(predicted, delay_sigma_s))
        chi2, beyond = np.full(n, np.nan), np.zeros(n, np.bool_)
        for part in self._parts(rows.R_base_flange, states, free.windows.steps(n)):
            self._turn(rows.R_base_flange[part.start])
            state = int(states[part.start])
            if (known := noise.of(state)) is not None:
                W, offset = self._whiten(known, state, inertia, free)
                distance = (readings[part] - offset) @ W.T
                direction = inexact[part] @ W.T
                along, length = (distance * direction).sum(axis=1), np.square(direction).sum(axis=1)
                chi2[part] = np.square(distance).sum(axis=1) - along**2 / (1 + length)
                beyond[part] = chi2[part] > self.limit
            free.add(rows if part.stop - part.start == n else rows.rows(part), states[part], noise, self.uncertainty)
        return readings, chi2, beyond

    def _change(self, predicted: Array, delay_sigma_s: float) -> Array:
        """Return the change of the prediction (n, 6) within one sigma of its time."""
        if not len(predicted):
            return predicted
        if self._predicted is None:
            self._predicted = np.repeat(predicted[:1], self._size, axis=0)
        rows = np.concatenate([self._predicted, predicted])
        self._predicted = rows[len(predicted) :]
        share = np.hypot(delay_sigma_s, _INEXACT_S) / READING_S
        return np.asarray(share * (rows[self._size :] - rows[: -self._size]))

    @staticmethod
    def _parts(R_base_flange: Array, states: NDArray[np.int8], step: NDArray[np.int64]) -> Iterator[slice]:
        turned = np.sqrt(np.square(R_base_flange[1:] - R_base_flange[:-1]).sum(axis=(1, 2)) / 2)
        cell = np.concatenate([[0.0], np.floor(np.cumsum(turned) / _TURN_RAD)])
        is_edge = [column[1:] != column[:-1] for column in (cell, step, states)]
        edges = np.flatnonzero(np.logical_or.reduce(is_edge)) + 1
        for start, stop in pairwise([0, *edges.tolist(), len(states)] if len(states) else []):
            yield slice(start, stop)

    def _turn(self, R_base_flange: Array) -> None:
        """Evaluate the covariance of the prediction at another orientation, where its error is another one."""
        known = self._calibration
        if known is None or (self._R is not None and np.abs(R_base_flange - self._R).max() < _TURN_RAD):
            return
        self._R = R_base_flange
        predicted = known.wrench_covariance(R_base_flange)
        self.uncertainty = predicted + self._beyond
        self._whitening = None

    def _whiten(self, noise: SensorNoise, state: int, inertia: Inertia, free: Following) -> tuple[Array, Array]:
        """Return the matrix that makes the readings of a free tool white, and their mean."""
        key = noise, free.filter.changes, None if state == REST else inertia
        if self._whitening is None or self._whitening[0] != key:
            offset, covariance = free.filter.offset(self.uncertainty, np.eye(3) if self._R is None else self._R)
            covariance = covariance + noise.reading + noise.wander
            if state != REST:
                covariance = covariance + self._friction + self._unknown[inertia]
            self._whitening = key, np.linalg.inv(np.linalg.cholesky(covariance)), offset
            self.limit = _hotelling(self.false_alarm_rate, noise.dof)
        return self._whitening[1:]


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

    def to_dict(self) -> dict[str, JSON]:
        """Return the values of its event, but for the frame."""
        return {
            "duration_s": self.duration_s,
            "peak_N": self.peak_N,
            "peak_wrench": self.peak.tolist(),
            "direction": self.direction.tolist(),
            "line_point_m": self.line_m.tolist(),
            "line_distance_m": float(np.linalg.norm(self.line_m)),
        }


class ContactTracker:
    """Joins readings beyond the limit to contacts: three in a row begin one, and three that are not end it."""

    def __init__(self, rate_Hz: float) -> None:
        self._lag, self._short_lag = (max(1, round(lag_s * rate_Hz)) for lag_s in (_LAG_S, _SHORT_LAG_S))
        self._forget()

    def _forget(self) -> None:
        n = (_IN_A_ROW - 1) * self._lag
        self.open: Contact | None = None
        self._earlier = np.zeros(n, np.int64), np.zeros(n, np.bool_), np.zeros((n, 6))

    def follow(
        self, t_ns: Ns, beyond: NDArray[np.bool_], readings: Array, soon: NDArray[np.bool_]
    ) -> tuple[NDArray[np.bool_], list[Contact]]:
        """Return in which samples (n,) there is a contact, and each contact that has begun or is over.

        A reading (n, 6), in the frame of the stream, ends at each sample, and `beyond` is whether it is beyond the
        limit. `soon` is whether a contact may begin sooner, because the poses that follow show rest.
        """
        n, before = len(t_ns), len(self._earlier[0])
        t_ns = np.concatenate([self._earlier[0], t_ns])
        beyond = np.concatenate([self._earlier[1], beyond])
        readings = np.concatenate([self._earlier[2], readings])
        self._earlier = t_ns[n:], beyond[n:], readings[n:]
        in_a_row, at_once = (
            np.array([beyond[before - k * lag :][:n] for k in range(_IN_A_ROW)]) for lag in (self._lag, self._short_lag)
        )
        begins, ends = in_a_row.all(axis=0) | (at_once.all(axis=0) & soon), ~in_a_row.any(axis=0)
        newest = np.maximum.accumulate(np.where(begins | ends, np.arange(n), -1))
        in_contact = np.where(newest < 0, self.open is not None, begins[newest])
        changes = list[Contact]()
        if n and self.open is not None and not in_contact[0]:
            changes += self._over()
        edges = np.flatnonzero(np.diff(in_contact, prepend=False, append=False)).tolist() if in_contact.any() else []
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            lag = self._short_lag if soon[start] else self._lag
            first = start + before - (0 if self.open is not None else (_IN_A_ROW - 1) * lag)  # it has begun before
            at = first + np.flatnonzero(beyond[first : before + stop])
            if not len(at):
                continue
            contact = self.open or Contact(int(t_ns[at[0]]), 0, -1.0, readings[at[0]])
            force_N = np.linalg.norm(readings[at, :3], axis=1)
            k = int(np.argmax(force_N))
            if force_N[k] > contact.peak_N:
                contact = replace(contact, peak_N=float(force_N[k]), peak=readings[at[k]])
            contact = replace(contact, last_ns=int(t_ns[at[-1]]))
            changes += [] if self.open is not None else [contact]
            self.open = contact
            if stop < n:
                changes += self._over()
        return in_contact, changes

    def _over(self) -> list[Contact]:
        contact, self.open = self.open, None
        return [] if contact is None else [replace(contact, over=True)]

    def end(self) -> list[Contact]:
        """End an open contact, as at the end of a recording or when frame or bias change."""
        over = self._over()
        self._forget()
        return over
