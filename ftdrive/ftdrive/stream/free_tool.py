"""Kalman filter of a free tool: its bias and drift, the local error of the calibration, and a held part.

The state is x = (b, d, c, s): bias (6), its rate (6), error of the calibration in this orientation (6), mass and mass
times centre of mass of the part (4). Over dt seconds and a turn of the arm by phi, with a = exp(-phi / 0.5 rad) and
the covariance S of the prediction of the calibration,

    b <- b + dt d + N(0, dt walk²)    d <- d + N(0, dt q)    c <- a c + N(0, (1 - a²) S)    s <- s

The residual y of a window, measured minus predicted wrench, has with the specific force f at the sensor and the
matrix L of angular acceleration and centripetal terms

    y = b + c + M [[f, -L], [0, -[f - L p]x]] s + e =: H x + e,    e ~ N(0, C)

M is the response of the sensor, p the centre of mass of the part as last known, and C the noise of this state of
motion, learnt from the innovations. The update is that of Kalman, with the innovation v = y - H x:

    T = H P H' + C,    K = P H' T^-1,    x <- x + K v,    P <- P - K H P

A window whose squared distance v' T^-1 v exceeds a gate is no update. Within the gate C is multiplied by
max(1, (4 + v' T^-1 v) / (4 + 6)), the weight of Student's distribution with 4 degrees of freedom. Filters with several
walks run side by side, and are mixed by their likelihoods with exponential forgetting (static multiple models).

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

# What a state has.
_BIAS, _RATE, _LOCAL, _PART = slice(0, 6), slice(6, 12), slice(12, 18), slice(18, 22)
# Force and torque of a usual sensor, N and N·m: what holds for 1 N holds for so much torque.
_UNIT = np.repeat([1.0, 0.03], 3)
ANY_BIAS = np.square(_UNIT)
"""Variance (6,) of a bias that is tracked, when that begins: it is farther from the calibration than drift explains."""
# Random walks of the bias in an hour that are tried, one sigma, N. The last two are sensors that warm up or are worn.
WALKS_N = (0.03, 0.1, 0.3, 1.0, 3.0)
# The likelihood of a walk counts so long, because a sensor walks less when it is warm.
_FORGET_S = 3600.0
# Usual drift of the bias in an hour, one sigma, N; within an hour it may change as much.
_RATE_N = 5.0
_RATE_VARIANCE = np.square(_RATE_N / 3600 * _UNIT)
# The error of a calibration is another one after about so much turning: weights turn with the sine, cables sooner.
_LOCAL_RAD = 0.5
# Squared innovation of a window that the state does not explain: once in an hour for a free tool.
_GATE = float(chdtri(6, 1e-4))
# Degrees of freedom of Student's distribution, by which a far window counts less: vibration has tails.
_TAILS = 4.0
# Squared distance of one part from another, of which mass and moment are estimated.
_SAME = float(chdtri(4, 1e-3))
# So many windows in a row agree on a part; an earlier one counts no more.
_RUN, _LONGEST_RUN = 4, 24
# A new part is known once gravity has turned so far in the sensor, or the arm has gone so far: a contact stays.
# A steady force along gravity that travels with the arm counts as a part, because nothing distinguishes it.
_TURN_RAD, _TRAVEL_M = 0.25, 0.15
# A window counts once so many after it are explained: the begin of a contact may be too small to see.
# So the soft begin of a contact does not reach the bias.
_GUARD = 2
# A bias is trusted to drift this far in an hour, N: four sigmas of a usual drift. Of a sensor that is known to drift or
# to walk more, in proportion.
_TRUSTED_N = 20.0
# Farther from the trusted bias than this, N, or than this many sigmas, a bias may have a slow contact in it: 3 N that
# grow within 300 s are then seen before they have moved the bias by 0.5 N.
_DOUBTFUL_N, _DOUBTFUL_SIGMAS = 0.2, 3.0
# What a new sensor is known to walk in an hour, N. It is that of the last so many seconds: a contact is shorter.
_USUAL_WALK_N, _WALK_KNOWN_S = 1.0, 1800.0
# A tare accepts so much drift, one sigma, N.
_TARED_N = 0.5
# For the contact test a bias is less known only so long, because a long contact is no drift.
_CONTACT_S = 30.0
# A drift is reported beyond so many sigmas.
_WARNED_SIGMAS = 5.0
NOTHING_KG = 0.02
"""A lighter part is none."""
# One sigma of mass and mass times centre of a part that is not known yet, kg and kg m.
_ANY_PART = np.array([5.0, 0.5, 0.5, 0.5])
# Covariance of mass and moment of what an empty gripper may hold; the bias has most of it, so that it is not divided.
_NO_PART = np.diag(np.square([2e-3, 2e-4, 2e-4, 2e-4]))
_EMPTY = _NO_PART / 100
# Relative sigma of what the sensor reads of a part.
_PART_READ = 0.02
# A part whose centre of mass is known so well turns about it.
_PLACED_M = 0.03
# The first noise of a state counts as so many windows, few because vibration is less in a window than in the readings
# that show it; the noise follows within so many.
_FIRST_WINDOWS, _MOST_WINDOWS = 3, 200


class _State(NamedTuple):
    """Mean (22,) and covariance (22, 22) at a time and in an orientation, of the walks together or of each (n, …)."""

    x: Array
    P: Array
    t_s: float
    R_base_flange: Array


class _WindowFit(NamedTuple):
    """A window of a run, and the state and the centre of mass of the part after it."""

    window: Window
    state: _State
    place: Array | None


class FreeToolFilter:
    """Kalman filter of what a free tool reads beyond its calibration, and of a part that it holds.

    The bias walks, and drifts at a rate that walks. The error of the calibration is constant in one orientation and
    becomes another as the arm turns, with the covariance of the prediction there. The weight of a part turns with the
    sensor while a bias does not. Several walks are tried side by side, and count by their likelihood. The noise of a
    window is learnt for each state of motion.

    A window that the state does not explain begins an interruption. From then on the part is unknown. Windows in a row
    that agree on one part, which may be the one before, none or a new one, end it. Meanwhile the bias is as uncertain
    as the random walk makes it, so what grasps and contacts do does not reach it.

    No single window shows a contact that grows slowly. A trusted bias therefore follows the estimate no faster than
    the sensor drifts. The sigma includes the distance between them, and if it is clear, the trusted bias waits for the
    end of the contact or for a tare.

    Mass and centre of mass are those of the tool, because vibration shakes a part as it shakes the tool. `drift_per_h`
    (6,) is what the bias is known to drift, N and N·m.
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
        # Number of windows, and sum of the squares of what they leave.
        self._noise: list[tuple[float, Array]] = [(0.0, np.zeros((6, 6)))] * STATES
        # Explained, but not counted yet.
        self._queue: list[Window] = []
        # Begin of an interruption.
        self._open_s: float | None = None
        self._peak_N = 0.0
        # The state before an interruption, and its part.
        self._held, self._before = self._state, (np.zeros(4), _EMPTY)
        # The last windows of an interruption that agree.
        self._run: list[_WindowFit] = []
        self._drift_N_h = np.maximum(_TRUSTED_N, _force_sizes(drift_per_h))
        self._known_walk_N = _USUAL_WALK_N
        # The bias that no slow contact has changed, and the sigma of the estimate that it was taken from.
        self._trusted, self._trusted_sigma = np.zeros(6), np.zeros(6)
        self._is_doubtful = self._is_warned = False
        self._subtracted = np.zeros(6)
        self.changes = 0
        """How often what is known has changed."""
        # What a tare may have to give back.
        self._untared: list[tuple[_State, Array]] = []

    # ------------------------------------------------------------------------------------------------- what is read

    def offset(self, systematic: Array, R_base_flange: Array) -> tuple[Array, Array]:
        """Return what is left (6,) of a free tool in this orientation, and its covariance (6, 6).

        `systematic` (6, 6) is the covariance of the prediction. Of a bias that may have a slow contact in it no more
        counts than drift explains.
        """
        t_s = self._t_s if self._open_s is None else min(self._t_s, self._open_s + _CONTACT_S)
        x, P, *_ = self._ahead(self._mixed(self._state), t_s, R_base_flange, systematic)
        off = x[_BIAS] - self._trusted
        kept = np.minimum(1.0, self._doubtful(np.diag(P)[_BIAS]) / np.maximum(_force_sizes(off), 1e-12))
        offset = _FREE @ x - (1 - np.repeat(kept, 3)) * off - self._subtracted
        return offset, _FREE @ P @ _FREE.T

    @property
    def force_rate_N_h(self) -> tuple[float, float]:
        """Rate of the force bias, its norm, and one standard deviation along it."""
        x, P, *_ = self._mixed(self._state)
        rate, variance = 3600 * x[_RATE][:3], 3600**2 * np.diag(P)[_RATE][:3]
        norm = float(np.linalg.norm(rate))
        weights = np.square(rate / norm) if norm > 0 else np.full(3, 1 / 3)
        return norm, float(np.sqrt(weights @ variance))

    def warning(self, usual_N_h: float) -> tuple[str, Mapping[str, JSON]] | None:
        """Return text and values of an event, once, when the drift exceeds the usual one and clearly its sigma."""
        rate, sigma = self.force_rate_N_h
        worth = max(usual_N_h, _WARNED_SIGMAS * sigma)
        before = self._is_warned
        # half the limit ends a drift, so that one near the limit is reported once
        self._is_warned = rate > (0.5 if before else 1.0) * worth
        if rate <= worth or before:
            return None
        text = f"the bias drifts by {with_sigma(rate, sigma)} N/h (1 sigma); tare when the tool is free"
        return text, {"drift_N_h": rate, "sigma_N_h": sigma}

    # --------------------------------------------------------------------------------------- what is known otherwise

    def expect(self, variance: Array) -> None:
        """Let the bias be as much farther (6,) from what is known, as after a time without a look."""
        for state in [self._state] if self._open_s is None else [self._state, self._held]:
            _diagonal(state.P)[:, _BIAS] += variance
        self._run = []
        self._trusted_sigma = np.hypot(self._trusted_sigma, np.sqrt(variance))

    def subtract(self, change: Array) -> None:
        """Take note of a change (6,) of what is subtracted beside the bias of the calibration."""
        self._subtracted = self._subtracted + change
        self.changes += 1

    def warm(self, change: Array) -> None:
        """Move the bias (6,) as the temperature of the sensor does, which is subtracted."""
        self._state.x[:, _BIAS] += change
        self._trusted = self._trusted + change
        self.subtract(change)

    def tare(self, change: Array, noise: Array, systematic: Array, R_base_flange: Array) -> None:
        """Take note of a tare: the tool was free and empty. Its reading has this covariance (6, 6) of noise."""
        self._untared.append((self._state._replace(x=self._state.x.copy(), P=self._state.P.copy()), self._trusted))
        self.subtract(change)
        self.hold(np.zeros(4), np.zeros((4, 4)))
        self.expect(np.square(_TARED_N * _UNIT))
        self._state = self._ahead(self._state, self._t_s, R_base_flange, systematic)
        self._state, _ = _corrected(self._state, self._subtracted, noise, _FREE)
        self._trusted, self._is_doubtful = self._mixed(self._state).x[_BIAS], False

    def undo_tare(self, change: Array) -> None:
        """Return to what was known before the last tare."""
        self.subtract(change)
        self._state, self._trusted = self._untared.pop()
        self._open_s, self._queue, self._run, self._is_doubtful = None, [], [], False

    def hold(self, part: Array, covariance: Array) -> None:
        """Take mass and moment (4,) of the part that is held as known; zero for an empty gripper."""
        self._state.x[:, _PART] = part
        self._state.P[:, _PART], self._state.P[:, :, _PART] = 0.0, 0.0
        self._state.P[:, _PART, _PART] = covariance + _EMPTY + np.diag(np.square(_PART_READ * part))
        self._open_s, self._queue, self._run = None, [], []

    # ----------------------------------------------------------------------------------------------------- windows

    def update(self, window: Window) -> Tracked:
        """Add the next window."""
        dt_s, self._t_s = _later(window.t_s, self._t_s), window.t_s
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
        """Return the state at a later time in another orientation."""
        dt_s = _later(t_s, state.t_s)
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
        """Return how far (2,) a bias may be from the trusted one, as `_force_sizes`."""
        return np.maximum(
            _DOUBTFUL_N * max(self._known_walk_N, 1.0), _DOUBTFUL_SIGMAS * _force_sizes(np.sqrt(variance))
        )

    def _trust(self, bias: Array, variance: Array, dt_s: float) -> tuple[Array, list[StreamEvent]]:
        """Let the trusted bias follow by no more than drift and a better estimate; return variance (6,), events."""
        sigma, limit = np.sqrt(variance), self._doubtful(variance)
        off = bias - self._trusted
        if self._is_doubtful and (_force_sizes(off) < limit / 2).all():
            # the end of a slow contact, which has moved the trusted bias by no more
            self._is_doubtful, self._trusted_sigma = False, _DOUBTFUL_N * _UNIT
        if not self._is_doubtful:
            seen = np.minimum(self._trusted_sigma, sigma)
            most = self._drift_N_h * max(self._known_walk_N, 1.0) * dt_s / 3600
            most = most + 3 * _force_sizes(self._trusted_sigma - seen)
            self._trusted_sigma = seen
            # One contact moves all axes.
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
            f"the bias has moved by {force_N:.2f} N and {torque_Nm:.3f} N·m, faster than this sensor drifts, as by a "
            "slow contact: free the tool, then tare"
        )
        values: dict[str, JSON] = {"force_N": force_N, "torque_Nm": torque_Nm}
        return variance + beyond**2, [StreamEvent(round(self._t_s * 1e9), "drift", text, values)]

    def _follow(self, window: Window) -> list[StreamEvent]:
        """Take a window into account whose part is known, or begin an interruption."""
        now = self._at(self._mixed(self._state), window)
        if self._compared(now, window, _place(now))[0] < _GATE:
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
        if self._is_doubtful:  # a slow contact may end at once
            _diagonal(P)[:, _BIAS] += np.square(mean[_BIAS] - self._trusted)
            x[:, _BIAS], x[:, _RATE] = self._trusted, 0.0
            P[:, _RATE], P[:, :, _RATE] = 0.0, 0.0
            _diagonal(P)[:, _RATE] = _RATE_VARIANCE
        self._state = self._state._replace(x=x, P=P)
        self._queue, self._run = [], []
        return self._decide(window)

    def _count(self, window: Window) -> None:
        """Correct the state by a window, and learn its noise."""
        dt_s = _later(window.t_s, self._state.t_s)
        now = self._at(self._state, window)
        mixed = self._mixed(now)
        distance, H, C = self._compared(mixed, window, _place(mixed))
        if (np.diag(H @ mixed.P @ H.T) < np.diag(C)).all():
            n, squares = self._noise[window.state]
            keep = min(1.0, _MOST_WINDOWS / (n + 1))
            left = (window.residual - H @ mixed.x) / self._shaken(window, mixed.x[_PART])
            self._noise[window.state] = (n + 1) * keep, (squares + np.outer(left, left)) * keep
        self._state, likelihood = _corrected(now, window.residual, C * _less(distance), H)
        self._likelihood = self._likelihood * np.exp(-dt_s / _FORGET_S) + likelihood
        weights = np.exp(self._likelihood - self._likelihood.max())
        self._weights = weights / weights.sum()
        self._seen_s = window.t_s

    def _decide(self, window: Window) -> list[StreamEvent]:
        """End an interruption, if the last windows agree on a part."""
        before = self._mixed(self._state).x
        before[_PART] = self._before[0]
        left_N = (window.residual - _observed(window, None) @ before)[:3]
        self._peak_N = max(self._peak_N, float(np.linalg.norm(left_N)))
        # the state before explains them again: a contact is over
        now = self._at(self._mixed(self._held), window)
        is_explained = self._compared(now, window, _place(now))[0] < _GATE
        self._queue = [*self._queue, window] if is_explained else []
        if len(self._queue) > _GUARD + 1:
            return self._end(self._held, self._queue[_GUARD:])
        windows = [*(fit.window for fit in self._run), window]
        run = self._extended(self._run, [window]) if len(windows) <= _LONGEST_RUN else None
        while run is None:
            # half of them at a time, because the newest ones are of the present part
            windows = windows[(len(windows) + 1) // 2 :]
            run = self._extended([], windows)
        self._run = run
        # a contact may end and begin too softly to see
        inner = [fit.window for fit in run][_GUARD:-_GUARD]
        if len(inner) < _RUN or self._decided(run[-1 - _GUARD].state) is None:
            return []
        fits = self._extended([], inner, run[-1].place)
        state = self._decided(fits[-1].state) if fits else None
        return [] if state is None else self._end(state, [fit.window for fit in run[-_GUARD:]])

    def _extended(
        self, run: list[_WindowFit], windows: Sequence[Window], place: Array | None = None
    ) -> list[_WindowFit] | None:
        """Return a run with more windows, or None if one does not agree with those before."""
        run, state = list(run), self._state
        for window in windows:
            if run:
                _, state, place = run[-1]
            state = self._at(state, window)
            distance, H, C = self._compared(self._mixed(state), window, place)
            if distance >= _GATE:
                return None
            state, _ = _corrected(state, window.residual, C * _less(distance), H)
            run.append(_WindowFit(window, state, _place(self._mixed(state)) if run else place))
        return run

    def _decided(self, state: _State) -> _State | None:
        """Return the state after a run with the part before or none, or with a new one that has moved, else None."""
        mean, covariance, *_ = self._mixed(state)
        for part, part_P in (self._before, (np.zeros(4), _EMPTY)):
            off = mean[_PART] - part
            if off @ np.linalg.solve(covariance[_PART, _PART] + part_P + _NO_PART, off) < _SAME:
                return _corrected(state, part, part_P, np.eye(22)[_PART])[0]
        is_new = mean[_PART][0] >= NOTHING_KG and self._moved([fit.window for fit in self._run])
        return state if is_new else None

    def _end(self, state: _State, queue: list[Window]) -> list[StreamEvent]:
        begin_s, self._open_s = self._open_s or 0.0, None
        t_ns = round(begin_s * 1e9)
        self._state, self._queue, self._run, self._seen_s = state, queue, [], queue[0].t_s
        mean, covariance, *_ = self._mixed(state)
        # a slow contact has ended, so far from the trusted bias as it had moved that
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
        return turned or bool(np.linalg.norm(gone - gone[0], axis=1).max() > _TRAVEL_M)  # NaN: not known

    def _mixed(self, state: _State) -> _State:
        """Return the state of the walks together. What is ahead of it is exact, because each step is linear."""
        weights = self._weights
        mean = weights @ state.x
        off = state.x - mean
        # as products of matrices, which take a third of the time of einsum
        P = (weights @ state.P.reshape(len(off), -1)).reshape(state.P.shape[1:]) + (off.T * weights) @ off
        return state._replace(x=mean, P=P)

    def _shaken(self, window: Window, part: Array) -> Array:
        """Return how much larger the noise in motion is with a part, (6,)."""
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
        """Return the squared distance of a window, the matrix from a state to it, and its covariance."""
        H, C = _observed(window, place), self._covariance(window, state.x[_PART])
        left = window.residual - H @ state.x
        return float(left @ np.linalg.solve(H @ state.P @ H.T + C, left)), H, C


def _force_sizes(wrench: Array) -> Array:
    """Return the sizes (2,) of force, and of torque as that of a usual sensor, N."""
    return np.asarray(np.sqrt(np.square(wrench / _UNIT).reshape(2, 3).sum(axis=1)))


def _later(t_s: float, before_s: float) -> float:
    """Return how much later one time is; a first time, and one before a jump within a recording, are not."""
    return t_s - before_s if t_s > before_s else 0.0


def _less(distance: float) -> float:
    """Return how much larger the covariance of a window at this squared distance counts."""
    return max(1.0, (_TAILS + distance) / (_TAILS + 6))


def _corrected(state: _State, y: Array, covariance: Array, H: Array) -> tuple[_State, Array]:
    """Return the state of each walk after a measurement, and its log likelihood (n,)."""
    HP, left = H @ state.P, y - state.x @ H.T
    S = HP @ H.T + covariance
    inverse = np.linalg.inv(S)
    K = np.swapaxes(HP, 1, 2) @ inverse
    P = state.P - K @ HP
    likelihood = -0.5 * (((left[:, None] @ inverse)[:, 0] * left).sum(axis=1) + np.linalg.slogdet(S)[1])
    return state._replace(x=state.x + (K @ left[..., None])[..., 0], P=(P + np.swapaxes(P, 1, 2)) / 2), likelihood


def _diagonal(matrix: Array) -> Array:
    """Return the diagonal (…, n), which may be changed."""
    diagonal: Array = np.einsum("...ii->...i", matrix)
    return diagonal


# From one state to the next: what stays, the rate for each second, and what turning takes away.
_KEPT, _DRIFTS, _TURNS = np.eye(22), np.eye(22, k=6), np.zeros((22, 22))
_DRIFTS[6:] = _KEPT[_LOCAL] = 0.0
_TURNS[_LOCAL, _LOCAL] = np.eye(6)
# From a state to the reading of a free tool.
_FREE = np.zeros((6, 22))
_FREE[:, _BIAS] = _FREE[:, _LOCAL] = np.eye(6)


def _observed(window: Window, p_sensor_m: Array | None) -> Array:
    """Return the matrix (6, 22) from a state to a reading, linear about a part at this place, if it is known."""
    place_m = window.p_sensor_near_m if p_sensor_m is None else p_sensor_m
    of_part = np.zeros((6, 4))
    # A bias is fixed in the sensor and a weight turns with gravity, so only motion distinguishes them.
    of_part[:3, 0], of_part[:3, 1:] = window.felt_m_s2, -window.lever_s2
    of_part[3:, 1:] = -skew(window.felt_m_s2 - window.lever_s2 @ place_m)
    H = _FREE.copy()
    H[:, _PART] = window.as_read @ of_part
    return H


def _place(state: _State) -> Array | None:
    """Return the centre of mass of a part (3,), if it is known well enough to be a centre of turning."""
    mass_kg, moment_kg_m = state.x[_PART][0], state.x[_PART][1:]
    placed = mass_kg > NOTHING_KG and float(np.trace(state.P[_PART, _PART][1:, 1:])) < (_PLACED_M * mass_kg) ** 2
    return moment_kg_m / mass_kg if placed else None


# ---------------------------------------------------------------------------------------------------------- following

# From one event with the tracked values to the next.
_REPORT_S = 1.0


class Following:
    """Follows a free tool and its part through a stream; `growth` is the variance (6,) of the bias at a time, ns."""

    def __init__(self, info: StreamInfo, growth: Callable[[int], Array]) -> None:
        calibration = info.calibration
        self.windows = Windows(info)
        self._growth: Callable[[int], Array] | None = growth
        drift_per_h = 60 * np.abs(calibration.quality.get("bias_growth_per_min", [0.0] * 6))
        self.filter = FreeToolFilter(calibration.mass_kg, calibration.parameters.p_sensor_com_m, drift_per_h)
        self._reported_s = -np.inf
        self.found: list[tuple[Tracked, list[StreamEvent]]] = []
        """What was known after each window, and the events."""
        self._is_tracked = False
        self.tracked: Tracked | None = None
        """None before the first window that is tracked."""

    def add(self, rows: Paired, states: NDArray[np.int8], noise: NoiseEstimator, systematic: Array) -> None:
        """Add samples with their states of motion, and the covariance (6, 6) of the prediction there."""
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
        """Track from now on: an offset that was there before counts as bias and no longer as a contact."""
        if not self._is_tracked:
            self._is_tracked = True
            self.filter.expect(ANY_BIAS)

    def hold(self, weight: Weight | None) -> None:
        """Take note of a part that was weighed; None empties the gripper."""
        if weight is None or not weight.in_motion:  # else it was found here
            self.filter.hold(*((np.zeros(4), np.zeros((4, 4))) if weight is None else weight.moment))


def weight_of(tracked: Tracked, calibration: CalibrationResult) -> Weight:
    """Return what is held, nothing included, as if it had been weighed."""
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
