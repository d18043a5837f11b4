"""Kalman filter for the residual of a free tool: bias, drift, local error of the calibration, and a held part.

The state is x = (b, d, c, s): bias (6), drift rate of the bias (6), error of the calibration in the current orientation
(6), mass of the part and mass times its centre of mass (4). Over dt seconds and a turn of the arm by phi, with a =
exp(-phi / 0.5 rad) and the covariance S of the prediction of the calibration,

b <- b + dt d + N(0, dt walk²) d <- d + N(0, dt q) c <- a c + N(0, (1 - a²) S) s <- s

The residual y of a window is the measured minus the predicted wrench. With the specific force f at the sensor and the
matrix L of angular acceleration and centripetal terms:

y = b + c + M [[f, -L], [0, -[f - L p]x]] s + e =: H x + e, e ~ N(0, C)

M is the response of the sensor, p the last estimate of the centre of mass of the part, and C the noise covariance in
this state of motion, estimated from the innovations. The Kalman update with the innovation v = y - H x is

T = H P H' + C, K = P H' T^-1, x <- x + K v, P <- P - K H P

A window whose squared distance v' T^-1 v exceeds a gate is not used. Within the gate, C is multiplied by max(1, (4 + v'
T^-1 v) / (4 + 6)), the weight of Student's distribution with 4 degrees of freedom. Filters with different random walks
run in parallel. Their estimates are weighted by their likelihoods with exponential forgetting (static multiple models).

Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, chapters 5
(filter, gate) and 11 (multiple models); Lange, Little and Taylor, JASA 84, 1989 (Student's distribution).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from ftcalib import CalibrationResult
from ftcalib.after.weighing import LEAST_SIGMAS, Weight, moment_as_read
from ftcalib.files import JSON
from ftcalib.model import Array, skew
from ftcalib.rounding import with_sigma
from ftdrive.stream.noise import GYRATION_M, REST, STATES, NoiseEstimator, Window, Windows
from ftdrive.stream.samples import Paired, StreamEvent, StreamInfo, Tracked

# Slices of the state vector: bias, its drift rate, local error of the calibration, held part.
_BIAS, _RATE, _LOCAL, _PART = slice(0, 6), slice(6, 12), slice(12, 18), slice(18, 22)
# Scales of force and torque of a typical sensor, N and N·m, which convert limits in N to torques.
_UNIT = np.repeat([1.0, 0.03], 3)
ANY_BIAS = np.square(_UNIT)
"""Variance (6,) added when tracking begins, because the bias may have changed by more than the drift explains."""
# Candidate sizes of the bias's random walk within an hour, one sigma, N; the last two for warming or worn sensors.
WALKS_N = (0.03, 0.1, 0.3, 1.0, 3.0)
# Time constant, s, with which the walks' likelihoods are forgotten, because a sensor that has warmed up walks less.
_FORGET_S = 3600.0
# Typical drift of the bias within an hour, one sigma, N. Within an hour the drift rate may change by this per hour.
_RATE_N = 5.0
_RATE_VARIANCE = np.square(_RATE_N / 3600 * _UNIT)
# Turn of the arm, rad, over which the local error of the calibration decorrelates to 1/e.
_LOCAL_RAD = 0.5
# Gate: largest squared Mahalanobis innovation of an accepted window; a free tool exceeds it about once an hour.
_GATE = float(chdtri(6, 1e-4))
# Degrees of freedom of the noise's Student distribution: outliers weigh less, because vibration has heavy tails.
_TAILS = 4.0
# Below this squared Mahalanobis distance two estimates (mass and moment, four numbers) count as the same part.
_SAME = float(chdtri(4, 1e-3))
# Smallest and largest number of consecutive windows from which a held part is determined; older ones are dropped.
_RUN, _LONGEST_RUN = 4, 24
# A new part is accepted after gravity has turned by this angle in sensor axes, or the arm has moved this far: a contact
# stays in place. A steady force along gravity that moves with the arm looks like a part.
_TURN_RAD, _TRAVEL_M = 0.25, 0.15
# A window is used only after this many further windows fit the state, because the start of a contact may be too small
# to detect. A contact that begins slowly therefore does not change the bias.
_GUARD = 2
# Most by which the trusted bias follows the estimate within an hour, N: four sigmas of a typical drift. For sensors
# with a known larger drift or walk it is larger in proportion.
_TRUSTED_N = 20.0
# A bias farther from the trusted bias than both this, N, and this many sigmas may contain a slow contact: 3 N that grow
# within 300 s are then detected before they have changed the trusted bias by 0.5 N.
_DOUBTFUL_N, _DOUBTFUL_SIGMAS = 0.2, 3.0
# Random walk within an hour, N, assumed before it is known; and time constant, s, with which its estimate replaces it.
_USUAL_WALK_N, _WALK_KNOWN_S = 1.0, 1800.0
# Drift of the bias up to a tare, one sigma, N, so that the tare may change the bias by more than tracked.
_TARED_N = 0.5
# In the contact test, the uncertainty of the bias grows for this time, s, of a contact only: a long one is no drift.
_CONTACT_S = 30.0
# A drift rate of the bias is reported if it exceeds this many of its sigmas.
_WARNED_SIGMAS = 5.0
NOTHING_KG = 0.02
"""Below this mass, kg, the gripper counts as empty."""
# Sigma of mass and of mass times centre of mass of an unknown part, kg and kg m.
_ANY_PART = np.array([5.0, 0.5, 0.5, 0.5])
# Covariance of mass and moment that an empty gripper seems to hold. The state has 1 % of it; the bias takes the rest.
_NO_PART = np.diag(np.square([2e-3, 2e-4, 2e-4, 2e-4]))
_EMPTY = _NO_PART / 100
# Relative sigma of the mass and moment of a held part, for the error of the sensor that weighed it.
_PART_READ = 0.02
# The torque of a part is linearised about its centre of mass if the sigma of that is below this, m.
_PLACED_M = 0.03
# Weight of the expected noise in the estimate, in windows: small, because a window shows less vibration than the
# readings from which that noise is predicted. The estimate averages over at most the second number of windows.
_FIRST_WINDOWS, _MOST_WINDOWS = 3, 200


class _State(NamedTuple):
    """Filter state at a time and orientation: mean (22,) and covariance (22, 22), or one of each per walk (n, …)."""

    x: Array
    P: Array
    t_s: float
    R_base_flange: Array


class _WindowFit(NamedTuple):
    window: Window
    state: _State
    place: Array | None


class FreeToolFilter:
    """Kalman filter for the bias of a free tool beyond its calibration, and for a part that it holds.

    The bias follows a random walk and a drift whose rate is a random walk too. The error of the calibration is constant
    in one orientation and decorrelates as the arm turns, with the covariance of the prediction. The weight of a part
    turns in sensor axes, a bias does not. Several walks run in parallel, weighted by their likelihoods. The noise of a
    window is estimated per state of motion.

    A window outside the gate begins an interruption, during which the part is unknown. The interruption ends after
    consecutive windows that agree on one part: the previous one, none, or a new one. Meanwhile only the random walk
    changes the uncertainty of the bias, so grasps and contacts do not alter the bias.

    No single window reveals a contact that grows slowly. Therefore a trusted bias follows the estimate no faster than
    the sensor drifts, and the reported sigma includes the distance between the two. If this distance is significant,
    the trusted bias stays until the contact ends or the tool is tared.

    `mass_kg` and `p_sensor_com_m` are those of the tool: the vibration of a part is scaled from them. `drift_per_h`
    (6,) is the known drift of the bias, N and N·m.
    """

    def __init__(
        self, mass_kg: float, p_sensor_com_m: Array, drift_per_h: Array, walks_N: Sequence[float] = WALKS_N
    ) -> None:
        self._tool = mass_kg, mass_kg * float(np.linalg.norm(p_sensor_com_m))
        self._walks_N = np.array(walks_N)
        n = len(walks_N)
        first = np.diag([*np.zeros(6), *_RATE_VARIANCE, *np.zeros(6), *np.diag(_EMPTY)])
        self._state = _State(np.zeros((n, 22)), np.tile(first, (n, 1, 1)), np.nan, np.full((3, 3), np.inf))
        self._walk = np.square(self._walks_N[:, None] * _UNIT) / 3600.0
        self._likelihood, self._weights = np.zeros(n), np.full(n, 1 / n)
        self._t_s, self._seen_s = np.nan, -np.inf
        # Noise per state of motion: number of windows, and sum of the outer products of their residuals.
        self._noise: list[tuple[float, Array]] = [(0.0, np.zeros((6, 6)))] * STATES
        # Windows that fit the state, but wait until further windows fit too.
        self._queue: list[Window] = []
        # Time at which the current interruption (an undecided contact or grasp) began; None without one.
        self._open_s: float | None = None
        self._peak_N = 0.0
        # Filter state before an interruption, and mean and covariance of the part held before it.
        self._held, self._before = self._state, (np.zeros(4), _EMPTY)
        # Latest windows of an interruption that agree on one held part.
        self._run: list[_WindowFit] = []
        self._drift_N_h = np.maximum(_TRUSTED_N, _force_sizes(drift_per_h))
        self._known_walk_N = _USUAL_WALK_N
        # The bias without slow contacts, and the smallest sigma of the estimates that it followed.
        self._trusted, self._trusted_sigma = np.zeros(6), np.zeros(6)
        self._is_doubtful = self._is_warned = False
        self._subtracted = np.zeros(6)
        self.changes = 0
        """Number of changes of the filter state so far: values computed from the state depend on it."""
        # Filter state and trusted bias before each tare, to undo the tare.
        self._untared: list[tuple[_State, Array]] = []

    # ------------------------------------------------------------------------------------------- prediction

    def offset(self, systematic: Array, R_base_flange: Array) -> tuple[Array, Array]:
        """Return the expected residual (6,) of a free tool in this orientation, and its covariance (6, 6).

        `systematic` (6, 6) is the covariance of the prediction. If the bias may contain a slow contact, only the part
        that drift explains is included.
        """
        t_s = self._t_s if self._open_s is None else min(self._t_s, self._open_s + _CONTACT_S)
        x, P, *_ = self._ahead(self._mixed(self._state), t_s, R_base_flange, systematic)
        off = x[_BIAS] - self._trusted
        kept = np.minimum(1.0, self._doubtful(np.diag(P)[_BIAS]) / np.maximum(_force_sizes(off), 1e-12))
        offset = _FREE @ x - (1 - np.repeat(kept, 3)) * off - self._subtracted
        return offset, _FREE @ P @ _FREE.T

    @property
    def force_rate_N_h(self) -> tuple[float, float]:
        """Norm of the drift rate of the force bias and its standard deviation along the drift, N/h."""
        x, P, *_ = self._mixed(self._state)
        rate, variance = 3600 * x[_RATE][:3], 3600**2 * np.diag(P)[_RATE][:3]
        norm = float(np.linalg.norm(rate))
        weights = np.square(rate / norm) if norm > 0 else np.full(3, 1 / 3)
        return norm, float(np.sqrt(weights @ variance))

    def warning(self, usual_N_h: float) -> tuple[str, Mapping[str, JSON]] | None:
        """Return text and values of a drift event, once, if the drift exceeds both `usual_N_h` and five sigmas."""
        rate, sigma = self.force_rate_N_h
        worth = max(usual_N_h, _WARNED_SIGMAS * sigma)
        before = self._is_warned
        # the drift counts as over at half the limit, so that one that stays near the limit is reported only once
        self._is_warned = rate > (0.5 if before else 1.0) * worth
        if rate <= worth or before:
            return None
        text = f"the bias drifts by {with_sigma(rate, sigma)} N/h (1 sigma); tare when the tool is free"
        return text, {"drift_N_h": rate, "sigma_N_h": sigma}

    # -------------------------------------------------------------------------------------- other information

    def expect(self, variance: Array) -> None:
        """Add `variance` (6,) to the variance of the bias, as after a time without measurements."""
        for state in [self._state] if self._open_s is None else [self._state, self._held]:
            _diagonal(state.P)[:, _BIAS] += variance
        self._run = []
        self._trusted_sigma = np.hypot(self._trusted_sigma, np.sqrt(variance))

    def subtract(self, change: Array) -> None:
        """Register a change (6,) of the bias that the stream subtracts from now on, besides that of the calibration."""
        self._subtracted = self._subtracted + change
        self.changes += 1

    def warm(self, change: Array) -> None:
        """Add the change (6,) of the bias with the sensor's temperature, which the stream subtracts."""
        self._state.x[:, _BIAS] += change
        self._trusted = self._trusted + change
        self.subtract(change)

    def tare(self, change: Array, noise: Array, systematic: Array, R_base_flange: Array) -> None:
        """Register a tare of the free, empty tool by `change` (6,); `noise` (6, 6) is the covariance of its reading."""
        self._untared.append((self._state._replace(x=self._state.x.copy(), P=self._state.P.copy()), self._trusted))
        self.subtract(change)
        self.hold(np.zeros(4), np.zeros((4, 4)))
        self.expect(np.square(_TARED_N * _UNIT))
        self._state = self._ahead(self._state, self._t_s, R_base_flange, systematic)
        self._state, _ = _correct(self._state, self._subtracted, noise, _FREE)
        self._trusted, self._is_doubtful = self._mixed(self._state).x[_BIAS], False

    def undo_tare(self, change: Array) -> None:
        """Restore the state before the last tare."""
        self.subtract(change)
        self._state, self._trusted = self._untared.pop()
        self._open_s, self._queue, self._run, self._is_doubtful = None, [], [], False

    def hold(self, part: Array, covariance: Array) -> None:
        """Set mass, and mass times centre of mass, of the held part (4,) as known; zeros for an empty gripper."""
        self._state.x[:, _PART] = part
        self._state.P[:, _PART], self._state.P[:, :, _PART] = 0.0, 0.0
        self._state.P[:, _PART, _PART] = covariance + _EMPTY + np.diag(np.square(_PART_READ * part))
        self._open_s, self._queue, self._run = None, [], []

    # ----------------------------------------------------------------------------------------------------- windows

    def update(self, window: Window) -> Tracked:
        """Update the filter with the next window, and return the estimated bias and held part."""
        dt_s, self._t_s = _time_step_s(window.t_s, self._t_s), window.t_s
        if np.isnan(self._state.t_s):
            self._state = self._state._replace(t_s=window.t_s)
        self.changes += 1
        events = self._follow(window) if self._open_s is None else self._decide(window)
        x, P, *_ = self._at(self._mixed(self._state), window)
        variance, doubts = self._trust(x[_BIAS], np.diag(P)[_BIAS], dt_s)
        known = self._open_s is None
        part, part_P = (x[_PART], P[_PART, _PART]) if known else self._before
        part_P = part_P + (_NO_PART if part[0] < NOTHING_KG else 0.0)
        return Tracked(
            t_s=window.t_s,
            bias=x[_BIAS],
            sigma=np.sqrt(variance),
            part_kg=float(part[0]),
            part_sigma_kg=float(np.sqrt(part_P[0, 0])),
            part_known=known,
            last_seen_s=window.t_s - self._seen_s,
            walk_N=float(self._weights @ self._walks_N),
            moment=(part.copy(), part_P.copy()),
            events=(*events, *doubts),
        )

    def _ahead(self, state: _State, t_s: float, R_base_flange: Array, systematic: Array) -> _State:
        dt_s = _time_step_s(t_s, state.t_s)
        turned_rad = float(np.linalg.norm(R_base_flange - state.R_base_flange)) / np.sqrt(2)
        alike = np.exp(-turned_rad / _LOCAL_RAD)
        F = _KEPT + dt_s * _DRIFTS + alike * _TURNS
        P = F @ state.P @ F.T
        variance = _diagonal(P)
        variance[..., _BIAS] += dt_s * (self._walk if state.x.ndim == 2 else self._weights @ self._walk)
        variance[..., _RATE] += dt_s / 3600 * _RATE_VARIANCE
        P[..., _LOCAL, _LOCAL] += (1 - alike**2) * systematic
        return _State(state.x @ F.T, P, t_s, R_base_flange)

    def _at(self, state: _State, window: Window) -> _State:
        return self._ahead(state, window.t_s, window.R_base_flange, window.systematic)

    def _doubtful(self, variance: Array) -> Array:
        """Return limits (2,) for the distance of the bias from the trusted bias: force, and torque scaled to N."""
        return np.maximum(
            _DOUBTFUL_N * max(self._known_walk_N, 1.0), _DOUBTFUL_SIGMAS * _force_sizes(np.sqrt(variance))
        )

    def _trust(self, bias: Array, variance: Array, dt_s: float) -> tuple[Array, list[StreamEvent]]:
        """Move the trusted bias towards the estimate, as fast as drift allows; return bias variance (6,) and events."""
        sigma, limit = np.sqrt(variance), self._doubtful(variance)
        off = bias - self._trusted
        if self._is_doubtful and (_force_sizes(off) < limit / 2).all():
            # the slow contact has ended, and has moved the trusted bias by less than this
            self._is_doubtful, self._trusted_sigma = False, _DOUBTFUL_N * _UNIT
        if not self._is_doubtful:
            seen = np.minimum(self._trusted_sigma, sigma)
            most = self._drift_N_h * max(self._known_walk_N, 1.0) * dt_s / 3600
            most = most + 3 * _force_sizes(self._trusted_sigma - seen)
            self._trusted_sigma = seen
            # All axes move by the same fraction, because a contact acts on several of them.
            self._trusted = self._trusted + off / max(1.0, float((_force_sizes(off) / np.maximum(most, 1e-12)).max()))
            off = bias - self._trusted
            walk_N = float(self._weights @ self._walks_N)
            self._known_walk_N += (walk_N - self._known_walk_N) * -np.expm1(-dt_s / _WALK_KNOWN_S)
        beyond = np.maximum(np.abs(off) - sigma, 0.0)
        if self._is_doubtful or (_force_sizes(off) < limit).all():
            return variance + beyond**2, []
        self._is_doubtful = True
        force_N, torque_Nm = float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:]))
        text = (
            f"the bias has changed by {force_N:.2f} N and {torque_Nm:.3f} N·m, faster than this sensor drifts. A "
            "slow contact may be the cause: free the tool, then tare"
        )
        values: dict[str, JSON] = {"force_N": force_N, "torque_Nm": torque_Nm}
        return variance + beyond**2, [StreamEvent(round(self._t_s * 1e9), "drift", text, values)]

    def _follow(self, window: Window) -> list[StreamEvent]:
        """Queue a window that fits the state, and use an earlier one; a window that does not begins an interruption."""
        now = self._at(self._mixed(self._state), window)
        if self._compared(now, window, _part_com(now))[0] < _GATE:
            self._queue.append(window)
            if len(self._queue) > _GUARD:
                self._count(self._queue.pop(0))
            return []
        self._open_s, self._peak_N = (self._queue[0] if self._queue else window).t_s, 0.0
        self._held, x, P = self._state, self._state.x.copy(), self._state.P.copy()
        mean, covariance, *_ = self._mixed(self._state)
        self._before = mean[_PART].copy(), covariance[_PART, _PART].copy()
        x[:, _PART] = 0.0
        P[:, _PART], P[:, :, _PART] = 0.0, 0.0
        P[:, _PART, _PART] = np.diag(_ANY_PART**2)
        if self._is_doubtful:  # the bias may contain a slow contact, which may end suddenly
            _diagonal(P)[:, _BIAS] += np.square(mean[_BIAS] - self._trusted)
            x[:, _BIAS], x[:, _RATE] = self._trusted, 0.0
            P[:, _RATE], P[:, :, _RATE] = 0.0, 0.0
            _diagonal(P)[:, _RATE] = _RATE_VARIANCE
        self._state = self._state._replace(x=x, P=P)
        self._queue, self._run = [], []
        return self._decide(window)

    def _count(self, window: Window) -> None:
        """Update the filter with a window that was accepted, and the noise of the window's state of motion."""
        dt_s = _time_step_s(window.t_s, self._state.t_s)
        now = self._at(self._state, window)
        mixed = self._mixed(now)
        distance, H, C = self._compared(mixed, window, _part_com(mixed))
        if (np.diag(H @ mixed.P @ H.T) < np.diag(C)).all():
            n, squares = self._noise[window.state]
            keep = min(1.0, _MOST_WINDOWS / (n + 1))
            left = (window.residual - H @ mixed.x) / self._shaken(window, mixed.x[_PART])
            self._noise[window.state] = (n + 1) * keep, (squares + np.outer(left, left)) * keep
        self._state, likelihood = _correct(now, window.residual, C * _inflation(distance), H)
        self._likelihood = self._likelihood * np.exp(-dt_s / _FORGET_S) + likelihood
        weights = np.exp(self._likelihood - self._likelihood.max())
        self._weights = weights / weights.sum()
        self._seen_s = window.t_s

    def _decide(self, window: Window) -> list[StreamEvent]:
        """Add a window to an interruption; end it if the latest windows agree on what the gripper holds."""
        before = self._mixed(self._state).x
        before[_PART] = self._before[0]
        left_N = (window.residual - _observation(window, None) @ before)[:3]
        self._peak_N = max(self._peak_N, float(np.linalg.norm(left_N)))
        # if the state before the interruption fits again, the contact is over
        now = self._at(self._mixed(self._held), window)
        is_explained = self._compared(now, window, _part_com(now))[0] < _GATE
        self._queue = [*self._queue, window] if is_explained else []
        if len(self._queue) > _GUARD + 1:
            return self._end(self._held, self._queue[_GUARD:])
        windows = [*(fit.window for fit in self._run), window]
        run = self._extended(self._run, [window]) if len(windows) <= _LONGEST_RUN else None
        while run is None:
            # drop the older half, because the newest windows belong to the current part
            windows = windows[(len(windows) + 1) // 2 :]
            run = self._extended([], windows)
        self._run = run
        # the first and last windows are left out: they may contain a contact too small to detect
        inner = [fit.window for fit in run][_GUARD:-_GUARD]
        if len(inner) < _RUN or self._decided(run[-1 - _GUARD].state) is None:
            return []
        fits = self._extended([], inner, run[-1].place)
        state = self._decided(fits[-1].state) if fits else None
        return [] if state is None else self._end(state, [fit.window for fit in run[-_GUARD:]])

    def _extended(
        self, run: list[_WindowFit], windows: Sequence[Window], place: Array | None = None
    ) -> list[_WindowFit] | None:
        """Return the run of agreeing windows with more windows, or None if one of them does not agree."""
        run, state = list(run), self._state
        for window in windows:
            if run:
                _, state, place = run[-1]
            state = self._at(state, window)
            distance, H, C = self._compared(self._mixed(state), window, place)
            if distance >= _GATE:
                return None
            state, _ = _correct(state, window.residual, C * _inflation(distance), H)
            run.append(_WindowFit(window, state, _part_com(self._mixed(state)) if run else place))
        return run

    def _decided(self, state: _State) -> _State | None:
        """Return the state if a run shows the previous part, no part, or a new part that was moved; otherwise None."""
        mean, covariance, *_ = self._mixed(state)
        for part, part_P in (self._before, (np.zeros(4), _EMPTY)):
            off = mean[_PART] - part
            if off @ np.linalg.solve(covariance[_PART, _PART] + part_P + _NO_PART, off) < _SAME:
                return _correct(state, part, part_P, np.eye(22)[_PART])[0]
        is_new = mean[_PART][0] >= NOTHING_KG and self._moved([fit.window for fit in self._run])
        return state if is_new else None

    def _end(self, state: _State, queue: list[Window]) -> list[StreamEvent]:
        begin_s, self._open_s = self._open_s or 0.0, None
        t_ns = round(begin_s * 1e9)
        self._state, self._queue, self._run, self._seen_s = state, queue, [], queue[0].t_s
        mean, covariance, *_ = self._mixed(state)
        # a slow contact has ended if the bias is within twice its limit of the trusted bias again
        if (
            self._is_doubtful
            and (_force_sizes(mean[_BIAS] - self._trusted) < 2 * self._doubtful(np.diag(covariance)[_BIAS])).all()
        ):
            self._trusted, self._is_doubtful = mean[_BIAS], False
        change_kg = float(mean[_PART][0] - self._before[0][0])
        sigma_kg = float(np.sqrt(covariance[_PART, _PART][0, 0] + self._before[1][0, 0]))
        if abs(change_kg) > max(NOTHING_KG, 4 * sigma_kg):
            text = f"the load has changed by {with_sigma(change_kg, sigma_kg)} kg (1 sigma)"
            return [StreamEvent(t_ns, "load-step", text, {"mass_kg": change_kg, "mass_sigma_kg": sigma_kg})]
        values: dict[str, JSON] = {"peak_N": self._peak_N, "duration_s": self._t_s - begin_s}
        return [StreamEvent(t_ns, "contact", f"contact {self._peak_N:.1f} N while a part is held", values)]

    @staticmethod
    def _moved(run: list[Window]) -> bool:
        down = np.array([one.felt_m_s2 / np.linalg.norm(one.felt_m_s2) for one in run])
        gone = np.array([one.p_base_flange_m for one in run])
        turned = float((down @ down[0]).min()) < np.cos(_TURN_RAD)
        return turned or bool(np.linalg.norm(gone - gone[0], axis=1).max() > _TRAVEL_M)  # NaN: unknown position

    def _mixed(self, state: _State) -> _State:
        """Combine the states of all walks into their weighted mean. Prediction from it is exact, as it is linear."""
        weights = self._weights
        mean = weights @ state.x
        off = state.x - mean
        # matrix products take a third of the time of einsum
        P = (weights @ state.P.reshape(len(off), -1)).reshape(state.P.shape[1:]) + (off.T * weights) @ off
        return state._replace(x=mean, P=P)

    def _shaken(self, window: Window, part: Array) -> Array:
        """Return the factor (6,) by which a held part increases the noise in motion."""
        if window.state == REST:
            return np.ones(6)
        held = abs(part[0]) / self._tool[0], float(np.linalg.norm(part[1:])) / max(self._tool[1], 1e-6)
        return 1.0 + np.repeat(held, 3)

    def _covariance(self, window: Window, part: Array) -> Array:
        n, squares = self._noise[window.state]
        scale = self._shaken(window, part)
        C = (squares + _FIRST_WINDOWS * window.noise) / (n + _FIRST_WINDOWS) * np.outer(scale, scale)
        _diagonal(C)[3:] += (part[0] * GYRATION_M**2 * window.turning_rad_s2) ** 2 + window.tensor_Nm**2
        return np.asarray(C)

    def _compared(self, state: _State, window: Window, place: Array | None) -> tuple[float, Array, Array]:
        """Return a window's squared distance from the prediction, its observation matrix H and its noise covariance."""
        H, C = _observation(window, place), self._covariance(window, state.x[_PART])
        left = window.residual - H @ state.x
        return float(left @ np.linalg.solve(H @ state.P @ H.T + C, left)), H, C


def _force_sizes(wrench: Array) -> Array:
    """Return the norms (2,) of force and torque, N; 0.03 N·m, as of a typical sensor, count as 1 N."""
    return np.asarray(np.sqrt(np.square(wrench / _UNIT).reshape(2, 3).sum(axis=1)))


def _time_step_s(t_s: float, before_s: float) -> float:
    """Return the time since `before_s`, s; 0 if that is NaN, or after a jump back within a recording."""
    return t_s - before_s if t_s > before_s else 0.0


def _inflation(distance: float) -> float:
    """Return the factor on a window's noise covariance that gives it the weight of Student's distribution."""
    return max(1.0, (_TAILS + distance) / (_TAILS + 6))


def _correct(state: _State, y: Array, covariance: Array, H: Array) -> tuple[_State, Array]:
    """Return the state of each walk after a Kalman update by measurement `y`, and its log likelihood (n,)."""
    HP, left = H @ state.P, y - state.x @ H.T
    S = HP @ H.T + covariance
    inverse = np.linalg.inv(S)
    K = np.swapaxes(HP, 1, 2) @ inverse
    P = state.P - K @ HP
    likelihood = -0.5 * (((left[:, None] @ inverse)[:, 0] * left).sum(axis=1) + np.linalg.slogdet(S)[1])
    return state._replace(x=state.x + (K @ left[..., None])[..., 0], P=(P + np.swapaxes(P, 1, 2)) / 2), likelihood


def _diagonal(matrix: Array) -> Array:
    diagonal: Array = np.einsum("...ii->...i", matrix)
    return diagonal


# Transition matrices of the state: its constant part, drift per second, and the part that decays with rotation.
_KEPT, _DRIFTS, _TURNS = np.eye(22), np.eye(22, k=6), np.zeros((22, 22))
_DRIFTS[6:] = _KEPT[_LOCAL] = 0.0
_TURNS[_LOCAL, _LOCAL] = np.eye(6)
# Matrix (6, 22) from the filter state to the residual of a free tool without a held part.
_FREE = np.zeros((6, 22))
_FREE[:, _BIAS] = _FREE[:, _LOCAL] = np.eye(6)


def _observation(window: Window, p_sensor_m: Array | None) -> Array:
    """Return the matrix (6, 22) from filter state to residual, linear about the part's centre of mass if known."""
    place_m = window.p_sensor_near_m if p_sensor_m is None else p_sensor_m
    of_part = np.zeros((6, 4))
    # A bias is constant in sensor axes and a weight turns with gravity, so only motion distinguishes the two.
    of_part[:3, 0], of_part[:3, 1:] = window.felt_m_s2, -window.lever_s2
    of_part[3:, 1:] = -skew(window.felt_m_s2 - window.lever_s2 @ place_m)
    H = _FREE.copy()
    H[:, _PART] = window.as_read @ of_part
    return H


def _part_com(state: _State) -> Array | None:
    """Return the held part's centre of mass (3,); None if too uncertain for linearising the part's torque about it."""
    mass_kg, moment_kg_m = state.x[_PART][0], state.x[_PART][1:]
    placed = mass_kg > NOTHING_KG and float(np.trace(state.P[_PART, _PART][1:, 1:])) < (_PLACED_M * mass_kg) ** 2
    return moment_kg_m / mass_kg if placed else None


# ---------------------------------------------------------------------------------------------------------- following

# Time between two events with the tracked values, s.
_REPORT_S = 1.0


class Following:
    """Runs the free-tool filter over a stream; `growth` returns the variance (6,) of the bias at a time in ns."""

    def __init__(self, info: StreamInfo, growth: Callable[[int], Array]) -> None:
        calibration = info.calibration
        self.windows = Windows(info)
        self._growth: Callable[[int], Array] | None = growth
        drift_per_h = 60 * np.abs(calibration.quality.get("bias_growth_per_min", [0.0] * 6))
        self.filter = FreeToolFilter(calibration.mass_kg, calibration.parameters.p_sensor_com_m, drift_per_h)
        self._reported_s = -np.inf
        self.found: list[tuple[Tracked, list[StreamEvent]]] = []
        """Estimate and events of each window, kept until the tool's monitor fetches them."""
        self._is_tracked = False
        self.tracked: Tracked | None = None
        """Newest estimate; None until tracking has begun and a window is complete."""

    def add(self, rows: Paired, states: NDArray[np.int8], noise: NoiseEstimator, systematic: Array) -> None:
        """Add samples with their states of motion, and the covariance (6, 6) of the prediction."""
        for window in self.windows.add(rows, states, noise, systematic):
            if self._growth is not None:
                self.filter.expect(self._growth(round(window.t_s * 1e9)))
                self._growth = None
            tracked = self.filter.update(window)
            events = list(tracked.events)
            self.tracked = tracked if self._is_tracked else None
            if self._is_tracked and tracked.t_s - self._reported_s >= _REPORT_S:
                self._reported_s = tracked.t_s
                events.append(StreamEvent(round(tracked.t_s * 1e9), "tracked", tracked.in_words(), tracked.to_dict()))
            self.found.append((tracked, events))

    def begin(self) -> None:
        """Start tracking: an offset that exists now is taken for a change of the bias, not for a contact."""
        if not self._is_tracked:
            self._is_tracked = True
            self.filter.expect(ANY_BIAS)

    def hold(self, weight: Weight | None) -> None:
        """Set the held part to a weighed load; None means that the gripper is empty."""
        if weight is None or not weight.in_motion:  # a weighing in motion comes from this filter itself
            self.filter.hold(*((np.zeros(4), np.zeros((4, 4))) if weight is None else weight.moment))


def weight_of(tracked: Tracked, calibration: CalibrationResult) -> Weight:
    """Return the tracked mass and centre of mass of the held part as a `Weight`, even if the mass is zero."""
    (x, covariance), mass_kg = tracked.moment, tracked.part_kg
    as_read, of_sensor, scale_sigma = tracked.moment, np.zeros((4, 4)), calibration.scale_sigma
    if (contact := calibration.known_contact) is not None:
        as_read, of_sensor = moment_as_read(tracked.moment, contact)
        scale_sigma = float(np.sqrt(of_sensor[0, 0])) / max(abs(mass_kg), 1e-9)
    com_m = x[1:] / (mass_kg or 1.0)
    T = np.column_stack([-com_m, np.eye(3)]) / max(abs(mass_kg), 1e-9)
    return Weight(
        mass_kg=mass_kg,
        mass_sigma_kg=tracked.part_sigma_kg,
        least_kg=LEAST_SIGMAS * tracked.part_sigma_kg,
        p_sensor_com_m=com_m,
        com_covariance=T @ (covariance + of_sensor) @ T.T,
        line=None,
        fault=None,
        chi2=0.0,
        dof=0,
        poses=0,
        scale_sigma=scale_sigma,
        in_motion=True,
        moment=as_read,
    )
