"""The wrench of a moving load as a linear function of its motion.

With R = R_base_flange, a the acceleration of the flange origin and Omega = [alpha]x + [omega]x², both in flange axes,
Q = R_flange_sensor, c = p_sensor_com_m, l = (0, 0, height) + Q c from the flange to the centre of mass, m = weight / g,
and S the second moment of mass about the centre, S = tr(J) / 2 - J for the inertia J:

    u         = Q^T (R^T F_b - m (a + Omega l))             the force, in sensor axes
    force_N   = (1 + gain) u + force_bias_N
    torque_Nm = c x u - vee(Q^T Omega Q S) + cross_talk u + torque_bias_Nm

vee(M) = (M21 - M12, M02 - M20, M10 - M01): the sum of r x (Omega r) over the mass is vee(Omega S), which are Euler's
equations. At rest the equations reduce to the static model. A delay of the wrench is applied to the motion: the wrench
at time t depends on the motion at t - delay.
"""

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ftcalib.likelihood.structure import alike
from ftcalib.model import Array, Parameters, cross, skew
from ftcalib.motion.samples import Motion, MotionRows
from ftcalib.sensor_matrix import CROSS_TALK_M, GAIN

INERTIA_NAMES = ("xx", "yy", "zz", "xy", "xz", "yz")
# Names of the coordinates that a recording in motion adds to the 15 static ones.
NAMES = (*(f"inertia_kg_m2.{axes}" for axes in INERTIA_NAMES), "height_m", "delay_s")
# Indices in the error vector of `MovingLoad.moved`.
INERTIA, HEIGHT, DELAY, GAINS, CROSS_TALK = slice(15, 21), 21, 22, slice(23, 28), slice(28, 34)
SIZE = 34

_PLACES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_BASIS = np.zeros((6, 3, 3))
for _k, (_i, _j) in enumerate(_PLACES):
    _BASIS[_k, _i, _j] = _BASIS[_k, _j, _i] = 1.0
SECOND_MOMENTS = np.trace(_BASIS, axis1=1, axis2=2)[:, None, None] / 2 * np.eye(3) - _BASIS
_TURNS = skew(np.eye(3))
# Unit matrices for the nine entries of Omega: a linear function is evaluated once per entry, not once per row.
_UNITS = np.eye(9).reshape(9, 3, 3)


@dataclass(frozen=True, slots=True, eq=False)
class MovingLoad:
    """Parameters of a load that are estimated from a recording in motion."""

    static: Parameters
    g_m_s2: float
    inertia: Array = field(default_factory=lambda: np.zeros(6))
    """(6,) inertia about the centre of mass, in sensor axes, in the order of `INERTIA_NAMES`, kg·m²."""
    height_m: float = 0.0
    """Height of the sensor origin above the flange face, m."""
    delay_s: float = 0.0
    """Delay of the wrench in addition to the delay assumed in the rows, s."""
    response: Array = field(default_factory=lambda: np.zeros(11))
    """(11,) coefficients of the sensor's gain and cross-talk."""

    def moved(self, step: Array) -> Self:
        """Return the load after an error vector (34,): 15 as in `Parameters.moved`, then `NAMES`, then the response."""
        return replace(
            self,
            static=self.static.moved(step[:15]),
            inertia=self.inertia + step[INERTIA],
            height_m=self.height_m + float(step[HEIGHT]),
            delay_s=self.delay_s + float(step[DELAY]),
            response=self.response + step[GAINS.start :],
        )

    @property
    def vector(self) -> Array:
        """(34,) current values of the coordinates with a prior about zero; 0 for the 15 static ones."""
        return np.concatenate([np.zeros(15), self.inertia, [self.height_m, self.delay_s], self.response])

    @property
    def mass_kg(self) -> float:
        """Weight divided by the acceleration of gravity, kg."""
        return self.static.weight_N / self.g_m_s2

    @property
    def lever_m(self) -> Array:
        """(3,) vector from the flange origin to the centre of mass, in flange axes, m."""
        return np.asarray(self.static.R_flange_sensor @ self.static.p_sensor_com_m + [0.0, 0.0, self.height_m])

    @property
    def inertia_kg_m2(self) -> Array:
        """(3, 3) inertia matrix about the centre of mass, in sensor axes, kg·m²."""
        return np.asarray(np.tensordot(self.inertia, _BASIS, 1))


@dataclass(frozen=True, slots=True, eq=False)
class PoseError:
    """Error of recorded poses: they belong to a point beside the flange, or their times or positions are scaled.

    The acceleration of the flange axis is `scale` times the recorded one, plus the acceleration due to the lateral
    offset `aside_m`. A rotation of the recorded frame is absorbed by the mounting, an offset along z by the height.
    """

    scale: float = 1.0
    aside_m: Array = field(default_factory=lambda: np.zeros(2))
    """(2,) offset from the recorded point to the axis through the sensor origin, in the axes of the poses, m."""
    turning: float = 1.0
    """Scale of `Motion.Omega_rad2_s2`: equal to `scale` if the times are wrong, 1 if only the positions are wrong."""

    def undone(self, motion: Motion) -> Motion:
        """Return a motion, or the rate of change of a motion, without the error of the poses."""
        Omega = self.turning * motion.Omega_rad2_s2
        acceleration = self.scale * motion.acceleration_m_s2 + Omega[:, :, :2] @ self.aside_m
        return Motion(motion.R_base_flange, acceleration, Omega)

    def corrected(self, rows: MotionRows) -> MotionRows:
        """Return the rows of a motion with the error of the poses removed."""
        return replace(rows, motion=self.undone(rows.motion), rate=self.undone(rows.rate))

    @staticmethod
    def jacobian(load: MovingLoad, motion: Motion) -> Array:
        """Return the derivative (n, 6, 3) of the wrench by `scale` and `aside_m`, for the motion as recorded."""
        static, Omega = load.static, motion.Omega_rad2_s2
        moved = np.concatenate([motion.acceleration_m_s2[:, :, None], Omega[:, :, :2]], axis=2)
        dU = -load.mass_kg * static.R_flange_sensor.T @ moved
        return np.concatenate([dU, skew(static.p_sensor_com_m) @ dU], axis=1)


def wrench_of(load: MovingLoad, motion: Motion, *, bias: bool = True) -> Array:
    """Return the wrench (n, 6) that the sensor reads without contact, N and N·m.

    Parameters
    ----------
    load : MovingLoad
        The delay of the load is not applied here; use `Motion.earlier`.
    bias : bool
        Whether to add the bias.
    """
    static, Q = load.static, load.static.R_flange_sensor
    u = _force(load, motion) @ Q
    second = np.tensordot(load.inertia, SECOND_MOMENTS, 1)
    torque = cross(static.p_sensor_com_m, u) - motion.Omega_rad2_s2.reshape(-1, 9) @ _vee(Q.T @ _UNITS @ Q @ second)
    K, X = np.tensordot(load.response[:5], GAIN, 1), np.tensordot(load.response[5:], CROSS_TALK_M, 1)
    wrench = np.hstack([u + u @ K, torque + u @ X])
    return wrench + static.bias if bias else wrench


def turn_columns(load: MovingLoad, motion: Motion) -> Array:
    """Return the derivative (n, 6, 3) of the wrench with respect to a small rotation of gravity about the flange axes.

    An error of a joint angle rotates pose and acceleration together, so the acceleration in flange axes is unchanged.
    """
    static = load.static
    dU = static.R_flange_sensor.T @ skew(static.gravity_force_base_N @ motion.R_base_flange)
    return np.concatenate([dU, skew(static.p_sensor_com_m) @ dU], axis=1)


def lever_columns(load: MovingLoad, motion: Motion) -> Array:
    """Return the derivative (n, 6, 3) of the inertial wrench with respect to the centre of mass, in sensor axes.

    Antisymmetric cross-talk shifts the centre of mass seen in the torques of the weight, not that of inertial forces.
    """
    static = load.static
    dU = -load.mass_kg * static.R_flange_sensor.T @ motion.Omega_rad2_s2 @ static.R_flange_sensor
    return np.concatenate([dU, skew(static.p_sensor_com_m) @ dU], axis=1)


# A principal component with a smaller share of the variance is dropped; largest number of orientations of the kernel.
_NEGLIGIBLE, _RESTING_ON = 1e-3, 200


@dataclass(frozen=True, slots=True, eq=False)
class SmoothFunctions:
    """Principal components of a Gaussian process over the orientations of a recording, with zero mean there.

    A sum of the components with independent coefficients of unit variance is a random smooth function of the
    orientation, with the correlation `alike`. The Nyström method extends it to other orientations.
    """

    R_base_flange: Array
    """(m, 3, 3) orientations of the kernel matrix."""
    weights: Array
    """(m, k) weights of the orientations `R_base_flange` in each component."""
    mean: Array
    """(m,) mean of the kernel over the recording, which is subtracted before the weights are applied."""

    @classmethod
    def of(cls, R_base_flange: Array) -> Self:
        """Return the principal components for the orientations (n, 3, 3) of a recording."""
        at = R_base_flange[:: -(-len(R_base_flange) // _RESTING_ON)]
        correlated = alike(at, at)
        centred = correlated - correlated.mean(axis=0)
        value, vector = np.linalg.eigh(centred - centred.mean(axis=1, keepdims=True))
        large = value > _NEGLIGIBLE * len(at)
        return cls(at, vector[:, large] / np.sqrt(value[large]), correlated.mean(axis=0))

    def __len__(self) -> int:
        return int(self.weights.shape[1])

    def __call__(self, R_base_flange: Array) -> Array:
        """Return the values (n, k) of the k components at orientations (n, 3, 3)."""
        return np.asarray((alike(R_base_flange, self.R_base_flange) - self.mean) @ self.weights)


def motion_jacobian(load: MovingLoad, motion: Motion, rate: Motion) -> Array:
    """Return the derivative (n, 6, 34) of the wrench with respect to the error vector of `MovingLoad.moved`.

    `motion` is the motion after the delay of the load was applied, and `rate` its rate of change.
    """
    static, m, Q = load.static, load.mass_kg, load.static.R_flange_sensor
    Qt, F_b, c = Q.T, static.gravity_force_base_N, static.p_sensor_com_m
    second = np.tensordot(load.inertia, SECOND_MOMENTS, 1)
    force = _force(load, motion)
    R, Omega = motion.R_base_flange, motion.Omega_rad2_s2
    accelerated = motion.acceleration_m_s2 + Omega @ load.lever_m
    u = force @ Q
    direction = F_b / max(static.weight_N, 1e-12) / load.g_m_s2

    J = np.zeros((len(R), 6, SIZE))
    dU, dT = J[:, :3], J[:, 3:]
    dU[:, :, 0:3] = -Qt @ skew(force) - m * Qt @ Omega @ skew(Q @ c)
    dU[:, :, 3:6] = Qt @ np.swapaxes(R, 1, 2) - (accelerated @ Q)[:, :, None] * direction
    dU[:, :, 9:12] = -m * Qt @ Omega @ Q
    dU[:, :, HEIGHT] = -m * Omega[:, :, 2] @ Q
    dT[:] = skew(c) @ dU
    for k, turn in enumerate(_TURNS):
        dT[:, :, k] -= Omega.reshape(-1, 9) @ _vee(Qt @ (turn @ _UNITS - _UNITS @ turn) @ Q @ second)
    dT[:, :, 9:12] -= skew(u)
    for k, basis in enumerate(SECOND_MOMENTS):
        dT[:, :, 15 + k] = -Omega.reshape(-1, 9) @ _vee(Qt @ _UNITS @ Q @ basis)
    K, X = np.tensordot(load.response[:5], GAIN, 1), np.tensordot(load.response[5:], CROSS_TALK_M, 1)
    dT += X @ dU
    dU += K @ dU
    dU[:, :, 6:9] = dT[:, :, 12:15] = np.eye(3)
    J[:, :, DELAY] = -wrench_of(load, rate, bias=False)
    dU[:, :, GAINS] = np.einsum("kij,nj->nik", GAIN, u)
    dT[:, :, CROSS_TALK] = np.einsum("kij,nj->nik", CROSS_TALK_M, u)
    return J


def _force(load: MovingLoad, motion: Motion) -> Array:
    """Return the force (n, 3) of weight and inertia in flange axes, N."""
    weight = load.static.gravity_force_base_N @ motion.R_base_flange
    return np.asarray(weight - load.mass_kg * (motion.acceleration_m_s2 + motion.Omega_rad2_s2 @ load.lever_m))


def _vee(M: Array) -> Array:
    return np.stack([M[..., 2, 1] - M[..., 1, 2], M[..., 0, 2] - M[..., 2, 0], M[..., 1, 0] - M[..., 0, 1]], axis=-1)


# Noise model of the rows: autoregressive, correlated between channels, one scale for each state of motion.

REST_RAD_S = 0.02
# Number of speed classes of moving rows.
CLASSES = 3
# Minimum number of rows of a state of motion; a state with fewer rows is merged with the next faster one.
FEWEST = 40
# Largest order of the autoregression.
ORDER = 6
_ROWS_PER_ORDER = 25
# Upper bound of a partial autocorrelation, which keeps the filter stable.
_MOST = 0.98


def motion_states(speed_rad_s: Array, kept: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the state of motion (n,) of each row: at rest, or one of several speed classes with equal numbers of rows.

    `kept` (n,) selects the rows without contact, from which the limits of the classes are computed.
    """
    moving = speed_rad_s[kept & (speed_rad_s > REST_RAD_S)]
    limits = [REST_RAD_S]
    if len(moving) >= 2 * FEWEST:
        classes = min(CLASSES, len(moving) // FEWEST)
        limits += np.quantile(moving, np.arange(1, classes) / classes).tolist()
    state = np.searchsorted(limits, speed_rad_s)
    if np.count_nonzero(kept & (state == 0)) < FEWEST:
        state = np.maximum(state - 1, 0)
    return np.asarray(state if (state[kept] == state.max()).sum() >= FEWEST else np.zeros_like(state))


def places_in_runs(t_s: Array, row_s: float) -> NDArray[np.intp]:
    """Return the index (n,) of each row within its run of rows without a gap, from 0."""
    breaks = np.flatnonzero(np.diff(t_s, prepend=-np.inf) > 1.5 * row_s)
    return np.asarray(np.arange(len(t_s)) - np.repeat(breaks, np.diff(np.append(breaks, len(t_s)))))


@dataclass(frozen=True, slots=True, eq=False)
class RowNoise:
    """Autoregressive noise model. Its filter makes the residuals of rows independent, with unit variance.

    With z_t the residual divided by the scale of the row's state, for each channel, and a_k of the order of least BIC,

        e_t = root (z_t - sum_k a_k z_(t-k)) / sigma_a
    """

    scale: Array
    """(states, 6) standard deviation of a row in each state, N and N·m."""
    filters: Array
    """(order + 1, 6, order + 1) prediction-error filters (1, -a_1, …) / sigma_a: earlier rows, channel, lag."""
    root: Array
    """(6, 6) inverse square root of the correlation between the channels of the innovations."""

    @classmethod
    def of(
        cls,
        residuals: Array,
        absorbed: Array,
        state: NDArray[np.intp],
        place: NDArray[np.intp],
        *,
        bursts: bool = False,
        order: int = ORDER,
    ) -> Self:
        """Return the noise model estimated from the residuals of kept rows.

        Parameters
        ----------
        residuals : array, shape (n, 6)
        absorbed : array, shape (n, 6, k)
            Root of the covariance of the prediction, by which the fit has reduced the variance of the residuals.
        state, place : array, shape (n,)
            Results of `motion_states` and `places_in_runs`.
        bursts : bool
            Whether to treat noise whose spectrum rises with frequency as white. Gears shake the tool quickly where a
            joint reverses, and unequal weights of the rows would alias these vibrations to low frequencies.
        order : int
            Largest order of the autoregression.
        """
        X = np.concatenate([residuals[:, :, None], absorbed], axis=2)
        common = np.sqrt(np.mean(np.sum(X**2, axis=2), axis=0)) + 1e-12
        square = (np.sum(X**2, axis=2) / common**2).reshape(-1, 2, 3).mean(axis=2)
        counts = np.maximum(np.bincount(state), 1)[:, None]
        by_state = np.stack([np.bincount(state, group) for group in square.T], axis=1) / counts
        scale = np.sqrt(np.repeat(by_state, 3, axis=1)) * common
        unit = X / scale[state][:, :, None]
        channels = [_filters(channel, place, bursts=bursts, order=order) for channel in np.moveaxis(unit, 1, 0)]
        noise = cls(scale, _of_equal_order(channels), np.eye(6))
        left = noise.whiten(X, state, place)
        correlation = np.einsum("nik,njk->ij", left, left) / len(left)
        return cls(scale, noise.filters, np.linalg.inv(np.linalg.cholesky(correlation + 1e-9 * np.eye(6))))

    def whiten(self, X: Array, state: NDArray[np.intp], place: NDArray[np.intp]) -> Array:
        """Return the innovations (n, 6, k) of values (n, 6, k); the filter order is lower at the start of a run."""
        X = X / self.scale[state][:, :, None]
        order = self.filters.shape[0] - 1
        filters = self.filters[np.minimum(place, order)]
        result = filters[:, :, 0, None] * X
        for lag in range(1, order + 1):
            result[lag:] += filters[lag:, :, lag, None] * X[:-lag]
        return np.asarray(self.root @ result)


def _filters(unit: Array, place: NDArray[np.intp], *, bursts: bool, order: int = ORDER) -> Array:
    """Return prediction-error filters (order + 1, order + 1) of one channel: Levinson recursion, order of least BIC."""
    most, size = min(order, len(unit) // _ROWS_PER_ORDER), len(unit)
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
    """Stack the filters of all channels to (order + 1, channels, order + 1), each padded with its last filter."""
    size = max(len(filters) for filters in channels)
    padded = [np.pad(filters, (0, size - len(filters)), mode="constant") for filters in channels]
    for filters, wide in zip(channels, padded, strict=True):
        wide[len(filters) :, : len(filters)] = filters[-1]
    return np.stack(padded, axis=1)
