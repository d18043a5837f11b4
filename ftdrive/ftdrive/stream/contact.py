"""Contact detection: readings that differ from the prediction for a free tool, joined into contacts."""

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

# Rotation of the tool, rad, after which the covariance of the predicted wrench is evaluated again.
_TURN_RAD = 0.02
# Sigmas assumed for the acceleration of a moving arm: linear if unknown; linear if it comes from past poses; angular.
_UNKNOWN_M_S2, _COARSE_M_S2, _UNKNOWN_RAD_S2 = 1.0, 0.3, 2.5
# Timing error of a predicted wrench, in addition to the delay error, because accelerations are means over some time.
_INEXACT_S = 0.005
# Friction torque of wrist 3, one sigma; the force/torque sensor inside the arm measures it with the contact torque.
_FRICTION_NM = 0.15
# A contact begins after this many consecutive readings beyond the limit, and ends after as many within it. One mean
# over their whole time would detect the contact later.
_IN_A_ROW = 3
# Time between two readings that count; shorter if inertia is subtracted, as the stream is late then already.
_LAG_S, _SHORT_LAG_S = READING_S, READING_S / 2


class Inertia(Enum):
    """Accuracy of the inertial wrench in the prediction for a free tool."""

    UNKNOWN = 0
    COARSE = 1
    """Acceleration from earlier poses only."""
    EXACT = 2
    """Acceleration from poses before and after the sample."""


class ContactTest:
    """Squared Mahalanobis distance of each reading from the prediction for a free tool.

    A reading is the mean of the samples of the last `READING_S` seconds. Every sample completes a reading; only
    readings without common samples are independent. The covariance contains the noise in the current state of motion
    and the uncertainty of the calibration. In motion it also contains the error of the delay and, if inertia is not
    subtracted, an unknown acceleration. The limit follows Hotelling's T² distribution, because the noise is estimated
    from data.

    The mean reading of a free tool comes from the free-tool filter, which estimates drift and the local error of the
    calibration. `beyond` (6,) is added to the variance of the prediction, N² and (N·m)². `friction_axis` (3,) is the
    axis of wrist 3 in sensor axes, if the sensor measures its friction torque.
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
        # Covariance of the part of the inertial wrench that is not predicted, by accuracy of the prediction.
        self._unknown = dict.fromkeys(Inertia, np.zeros((6, 6)))
        self.uncertainty = np.zeros((6, 6))
        """(6, 6) covariance of the wrench predicted for a free tool at the newest orientation, sensor axes."""
        self.limit = float(chdtri(6, false_alarm_rate))
        """Limit for the squared Mahalanobis distance of the newest reading from the prediction for a free tool."""
        self.restart()

    def restart(self) -> None:
        """Discard earlier samples, because the next one does not continue them."""
        self._earlier = np.zeros((self._size - 1, 6))
        # Predicted wrenches of the last `READING_S` seconds.
        self._predicted: Array | None = None
        self._R: Array | None = None
        self._whitening: tuple[tuple[SensorNoise, int, Inertia | None], Array, Array] | None = None

    def expect(self, calibration: Calibrated, mass_kg: float, *, tensor_known: bool) -> None:
        """Set the free tool from now on: its calibration, its mass, and whether its inertia tensor is known."""
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
        """Return readings (n, 6), squared distances (n,), NaN while noise is unknown, and which are too far (n,).

        `residual` is the measured minus the predicted wrench (n, 6), `motion` the result of `MotionTracker.follow`, and
        `inertia` the accuracy of the predicted inertial wrench. Pass the samples to the free-tool filter as well.
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
        """Return the change (n, 6) of the predicted wrench over one standard deviation of its timing error."""
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
        known = self._calibration
        if known is None or (self._R is not None and np.abs(R_base_flange - self._R).max() < _TURN_RAD):
            return
        self._R = R_base_flange
        predicted = known.wrench_covariance(R_base_flange)
        self.uncertainty = predicted + self._beyond
        self._whitening = None

    def _whiten(self, noise: SensorNoise, state: int, inertia: Inertia, free: Following) -> tuple[Array, Array]:
        """Return the matrix (6, 6) that whitens the readings of a free tool, and their expected mean (6,)."""
        key = noise, free.filter.changes, None if state == REST else inertia
        if self._whitening is None or self._whitening[0] != key:
            offset, covariance = free.filter.offset(self.uncertainty, np.eye(3) if self._R is None else self._R)
            covariance = covariance + noise.reading + noise.wander
            if state != REST:
                covariance = covariance + self._friction + self._unknown[inertia]
            self._whitening = key, np.linalg.inv(np.linalg.cholesky(covariance)), offset
            self.limit = _hotelling_limit(self.false_alarm_rate, noise.dof)
        return self._whitening[1:]


def _hotelling_limit(rate: float, dof: float) -> float:
    """Return the limit, exceeded at this rate, of Hotelling's T² of six channels with `dof` degrees of freedom."""
    if dof <= 6:
        return float("inf")
    return float(6 * dof / (dof - 5) * fdtri(6, dof - 5, 1 - rate))


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """A contact from its start to its end, or to the newest reading while it lasts.

    Examples
    --------
    `open_stream` passes a `Contact` to `on_contact`:

    >>> import ftdrive, numpy as np
    >>> contact = ftdrive.Contact(begin_ns=0, last_ns=10**9, peak_N=5.0, peak=np.array([0, 0, -5.0, 0, 0, 0]))
    >>> contact.over, contact.duration_s, contact.direction
    (False, 1.0, array([ 0.,  0., -1.]))
    """

    begin_ns: int
    """Time of the first reading beyond the limit, on the cell's clock."""
    last_ns: int
    """Time of the newest reading beyond the limit."""
    peak_N: float
    peak: Array
    """(6,) reading with the largest force, a mean over `READING_S`, N and N·m, in the `frame` of the stream."""
    over: bool = False

    @property
    def t_s(self) -> float:
        """Start of the contact, on the clock of `Sample.t_s`."""
        return self.begin_ns * 1e-9

    @property
    def duration_s(self) -> float:
        """Time from the first to the last reading beyond the limit."""
        return (self.last_ns - self.begin_ns) * 1e-9

    @property
    def direction(self) -> Array:
        """(3,) unit vector of the force of `peak`; zeros if the contact exerts a torque only."""
        return self.peak[:3] / (np.linalg.norm(self.peak[:3]) or 1.0)

    @property
    def line_m(self) -> Array:
        """(3,) point on the force's line of action that is nearest to the reference point, axes of the frame, m."""
        force_N = self.peak[:3]
        return np.cross(force_N, self.peak[3:]) / (float(force_N @ force_N) or np.inf)

    def to_dict(self) -> dict[str, JSON]:
        """Return the values of the contact's event in a stream, except for its frame."""
        return {
            "duration_s": self.duration_s,
            "peak_N": self.peak_N,
            "peak_wrench": self.peak.tolist(),
            "direction": self.direction.tolist(),
            "line_point_m": self.line_m.tolist(),
            "line_distance_m": float(np.linalg.norm(self.line_m)),
        }


class ContactTracker:
    """Joins readings into contacts: three in a row beyond the limit begin a contact, three within the limit end it."""

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
        """Return a mask of the samples in contact (n,), and the contacts that begin or end in these samples.

        One of `readings` (n, 6), in the frame of the stream, ends at each sample; `beyond` is true where it exceeds the
        limit. `soon` marks samples at which a contact may begin after the shorter lag, because later poses show rest.
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
            first = start + before - (0 if self.open is not None else (_IN_A_ROW - 1) * lag)
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
        """End an open contact, at the end of a recording or when frame or bias change."""
        over = self._over()
        self._forget()
        return over
