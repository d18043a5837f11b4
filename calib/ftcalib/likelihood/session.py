"""Data of one session: poses sorted by time, priors, and the variance components that may act on the poses.

`SessionData.linearise` returns the mixed model of `variance_components` at parameters p. With the wrench h of
`ftcalib.model` and its derivative J_i, the residual of pose i at time t_i is

    r_i = wrench_i - h(p, R_i) = J_i Z x + b(t_i) + T_i u + J_i[:, :3] d_i + e_i,    e_i ~ N(0, D_i)

    x    step of the free parameters; Z is a basis of the directions without exact constraints, tolerances are priors
    b    drift of the bias: random walk, or linear in time
    u    coefficients of gain, cross-talk, hysteresis and structured errors
    d_i  orientation error, which adds size² J J' to D_i (effective variance: Orear, Am. J. Phys. 50, 1982)

D_i is the measured covariance of the mean. If it was not measured, white noise is a further component.
"""

from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeVar

import numpy as np

from ftcalib.data.dwell_mean import RESOLUTION
from ftcalib.known import RANGE_LEVER_M, USUAL_GAIN, Constraints
from ftcalib.likelihood.descent import Descent, Kept, Minimum, Statistics, coefficients, column_scale, features
from ftcalib.likelihood.session_noise import Noise, pose_times
from ftcalib.likelihood.structure import MOST_POSES as STRUCTURED_POSES
from ftcalib.likelihood.structure import hysteresis_columns, structure_columns
from ftcalib.likelihood.variance_components import (
    FORCE,
    HYSTERESIS,
    RESPONSE,
    ROTATION,
    STRUCTURE,
    TORQUE,
    Component,
    Linearised,
    channel_component,
)
from ftcalib.model import Array, Parameters, jacobian, predict
from ftcalib.sensor_matrix import GAIN, own_variances, sensor_columns, shown_by

_T = TypeVar("_T")
Drift = Literal["auto", "none", "linear", "random-walk"]

RANK_TOLERANCE = 1e-9
# Usual ratio of torque noise to force noise.
LEVER_M = 0.025
# With fewer poses than this, the ratio of torque noise to force noise is assumed.
FEW_POSES = 6
# With fewer poses than this, gain and cross-talk are not separated from noise.
FEW_POSES_FOR_RESPONSE = 7
# With fewer poses than this, the variances of gain and cross-talk are at least those of usual sensors.
FEW_POSES_FOR_GAIN = 12
# With fewer poses than this, drift is not separated from noise that was not measured.
FEW_POSES_WITHOUT_NOISE = 12
# With fewer poses than this, hysteresis is not separated from gain and noise.
FEW_POSES_FOR_HYSTERESIS = 12
# With fewer poses than this, the three axes of force share one drift variance, and so do those of torque.
POSES_FOR_EACH_AXIS = 50
# Residuals up to this multiple of the rounding error mean that the data have no noise.
EXACT = 100
# Constant of the low-discrepancy sequence with which a subset of the poses is selected.
GOLDEN_RATIO = (1 + 5**0.5) / 2
# Neither force nor torque residuals are assumed smaller than this share of what the usual ratio to the other gives.
UNEQUAL = 0.01
# Smallest white noise, as a share of the residuals, if the noise was not measured.
FLOOR = 1e-3


def _rounding(wrench: Array) -> Array:
    """Return the noise (2,) of force and torque that is assumed for wrenches (n, 6) without noise."""
    largest_N, largest_Nm = np.abs(wrench).reshape(-1, 2, 3).max(axis=(0, 2))
    return 1e-12 * np.array([largest_N, max(largest_Nm, LEVER_M * largest_N)])


class SessionData:
    """Poses, noise, times and constraints of one session; arguments as in `ftcalib.likelihood.fit.fit`."""

    def __init__(
        self,
        R_base_flange: Array,
        wrench: Array,
        wrench_cov: Array | None,
        t_s: Array | None,
        drift: Drift,
        constraints: Constraints,
        gain_sigma: float = USUAL_GAIN,
    ) -> None:
        self.n = len(wrench)
        self.gain_sigma, self.structured = gain_sigma, True
        # Components that were found in a subset of the poses; no other random walk or structured error is searched for.
        self.shown: Sequence[Component] | None = None
        self.given = R_base_flange, wrench
        self.drift, self.constraints = drift, constraints
        self.measured = wrench_cov is not None
        time = np.arange(self.n, dtype=np.float64) if t_s is None else pose_times(t_s)
        self.order = np.argsort(time, kind="stable")
        self.time = time[self.order]
        ordered = bool((self.order[1:] > self.order[:-1]).all())
        self.R, self.wrench = (x if ordered else x[self.order] for x in self.given)
        cov = white(*_rounding(self.wrench)) if wrench_cov is None else np.asarray(wrench_cov, dtype=np.float64)
        self.cov = np.broadcast_to(cov, (self.n, 6, 6)) if cov.ndim == 2 else cov if ordered else cov[self.order]
        self.descent = Descent(self.R, self.wrench, constraints)
        self.everything = np.ones(self.n, bool)
        self._done = dict[object, Any]()

    def once(self, key: object, call: Callable[[], _T]) -> _T:
        """Return the result of `call`. It is cached if a second fit, without structured errors, may repeat the call."""
        value: _T = self._done[key] if key in self._done else call()
        if self.structure():
            self._done[key] = value
        return value

    def dof(self, kept: Kept) -> int:
        """Return the degrees of freedom of chi2 for the kept poses."""
        return 6 * int(kept.sum()) - 15 + self.constraints.dof - (6 if self.drift == "linear" else 0)

    def lacks_rank(self, minimum: Minimum) -> bool:
        """Whether the poses leave a combination of parameters undetermined."""
        Z = self.constraints.free(minimum.parameters)
        H = Z.T @ minimum.information @ Z
        scale = column_scale(H)
        eigenvalues = np.linalg.eigvalsh(H / np.outer(scale, scale))
        return bool(eigenvalues[0] < RANK_TOLERANCE * eigenvalues[-1]) or self.dof(np.ones(self.n, bool)) <= 0

    def is_exact(self, p: Parameters) -> bool:
        """Whether the residuals are only rounding errors or, if the noise is unknown, below the sensor's resolution."""
        first_poses, all_poses = slice(1000), slice(None)  # the first poses usually decide, and are checked faster
        return self._fits_exactly(p, first_poses) and self._fits_exactly(p, all_poses)

    def _fits_exactly(self, p: Parameters, poses: slice) -> bool:
        wrench = self.wrench[poses]
        residuals = np.abs(wrench - predict(p, self.R[poses])).max(axis=0).reshape(2, 3).max(axis=1)
        rounding = EXACT * _rounding(wrench)
        return bool((residuals < (rounding if self.measured else np.maximum(rounding, RESOLUTION[::3]))).all())

    def noise_left(self, p: Parameters) -> Array:
        """Return white noise (n, 6, 6) as large as the residuals."""
        return self._white(self._rms(p) * np.sqrt(6 * self.n / self.dof(self.everything)))

    def least_noise(self, p: Parameters) -> Array:
        """Return white noise (n, 6, 6) of a small share of the residuals, so that a walk never explains them all."""
        return self._white(FLOOR * self._rms(p))

    def _white(self, sigma: Array) -> Array:
        return np.broadcast_to(white(*np.maximum(sigma, _rounding(self.wrench))), self.cov.shape)

    def _rms(self, p: Parameters) -> Array:
        """Return the rms residuals (2,) of force and torque; each is at least a small multiple of the other."""
        e = (self.wrench - predict(p, self.R)).reshape(-1, 2, 3)
        rms = np.sqrt(np.mean(e**2, axis=(0, 2)))
        return np.asarray(np.maximum(rms, UNEQUAL * rms[::-1] * [1 / LEVER_M, LEVER_M]))

    def start(self, problem: Linearised, components: Sequence[Component]) -> Array:
        """Return an initial variance per component: mean square residual of its channels, or their noise if larger."""
        if not components:
            return np.zeros(0)
        noise = np.diagonal(problem.D, axis1=1, axis2=2)
        size = np.maximum(problem.r**2, noise)[problem.kept]

        def variance(c: Component) -> float:
            if c in RESPONSE:
                return problem.smallest(c)
            return float(np.mean(size[:, np.array(c.share) > 0])) / (10 * self.n if c.kind == "walk" else 1)

        return np.array([variance(c) for c in components])

    def statistics(self, noise: Noise, p: Parameters) -> Statistics:
        """Return the sufficient statistics for a noise model, with the parameters as reference."""
        return Statistics.of_noise(features(self.R), self.wrench, noise, coefficients(p))

    def linearise(self, p: Parameters, kept: Kept) -> Linearised:
        """Return the mixed model linearised at parameters, for the kept poses."""
        J = jacobian(p, self.R)
        turn = J[..., :3]
        r = self.wrench - predict(p, self.R)
        H, g = np.zeros((15, 15)), np.zeros(15)
        if self.constraints.any:
            A, residual = self.constraints.measurements(p)
            Z = self.constraints.free(p)
            J, H, g = J @ Z, Z.T @ A.T @ A @ Z, Z.T @ A.T @ residual
        lever = float(np.linalg.norm(p.p_sensor_com_m)) / RANGE_LEVER_M
        effects = sensor_columns(p, self.R) | {"hysteresis": hysteresis_columns(p, self.R)}
        if kinds := {c.kind for c in (STRUCTURE if self.n <= STRUCTURED_POSES else self.structure())}:
            structure = structure_columns(p, self.R, self.R.mean(axis=0))
            effects |= {kind: columns for kind, columns in structure.items() if kind in kinds}
        least = {}
        if self.assumes_response:
            shown = shown_by(p.p_sensor_com_m) ** 2 @ own_variances(self.gain_sigma)
            least = {"gain": float(shown[: len(GAIN)].mean()), "cross_talk": float(shown[len(GAIN) :].mean())}
        linear = self.drift == "linear"
        return Linearised(J, r, (H, g), turn, self.cov, self.time, kept, linear, effects, lever, least)

    @property
    def assumes_response(self) -> bool:
        """Whether usual values are lower bounds of gain and cross-talk, because too few poses determine them."""
        return self.gain_sigma > 0 and self.n < FEW_POSES_FOR_GAIN

    def always(self) -> list[Component]:
        """Return the variance components that are part of the noise model whatever the data show."""
        always = []
        if not self.measured and self.n < FEW_POSES:
            always = [Component("white_force_N", "white", (1.0, 1.0, 1.0, *[LEVER_M**2] * 3))]
        elif not self.measured:
            always = [channel_component("white", FORCE), channel_component("white", TORQUE)]
        if self.drift == "random-walk":
            always += [channel_component("walk", group) for group in (FORCE, TORQUE)]
        if self.assumes_response:
            always += RESPONSE
        return always

    def candidates(self) -> list[Component]:
        """Return the variance components that are added to the model if they increase the likelihood enough."""
        found = list(RESPONSE) if self.n >= FEW_POSES_FOR_RESPONSE and not self.assumes_response else []
        if self.n >= (FEW_POSES if self.measured else FEW_POSES_WITHOUT_NOISE):
            white = [channel_component("white", FORCE), channel_component("white", TORQUE)] if self.measured else []
            groups = [range(c, c + 1) for c in range(6)] if self.n >= POSES_FOR_EACH_AXIS else [FORCE, TORQUE]
            walks = [channel_component("walk", group) for group in groups] if self.drift == "auto" else []
            walks = walks if self.shown is None else [c for c in walks if c in self.shown]
            found += [*white, ROTATION, *walks]
        if self.n >= FEW_POSES_FOR_HYSTERESIS:
            found.append(HYSTERESIS)
        return found

    def structure(self) -> tuple[Component, ...]:
        """Return the structured errors that are added to the model if they increase the likelihood enough."""
        if not self.structured or self.n < FEW_POSES_FOR_HYSTERESIS:
            return ()
        return STRUCTURE if self.n <= STRUCTURED_POSES else tuple(c for c in STRUCTURE if c in (self.shown or ()))

    def some(self, count: int) -> "SessionData":
        """Return a session with `count` of the poses: one from each of `count` successive parts of equal length."""
        # The position within the parts varies, because a tour may have been repeated with the period of the parts.
        k = np.arange(count)
        places = ((k + k * GOLDEN_RATIO % 1) * self.n / count).astype(np.intp)
        R, wrench = (x[self.order[places]] for x in self.given)
        cov = self.cov[places] if self.measured else None
        some = SessionData(R, wrench, cov, self.time[places], self.drift, self.constraints, self.gain_sigma)
        some.structured = self.structured
        return some


def white(sigma_N: float, sigma_Nm: float) -> Array:
    """Return the covariance (6, 6) of white noise."""
    return np.diag(np.repeat([sigma_N**2, sigma_Nm**2], 3))


def inverses(cov: Array) -> Array:
    """Return the inverses of matrices (n, 6, 6); a broadcast matrix is inverted once."""
    if cov.strides[0] == 0:
        return np.broadcast_to(np.linalg.inv(cov[:1]), cov.shape)
    return np.asarray(np.linalg.inv(cov))
