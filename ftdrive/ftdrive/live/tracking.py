"""Bias and held part, followed while a program runs: a step of the load is not drift, and a contact is neither."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from ftcalib import CalibrationResult
from ftcalib.after.state import Update, with_bias_change
from ftcalib.after.weighing import LEAST_SIGMAS, Weight, known_contact, moment_as_read
from ftcalib.compensation import Compensator
from ftcalib.likelihood.response import predicted_covariance
from ftcalib.model import BIASES, Array, skew
from ftcalib.rounding import with_sigma
from ftdrive.live.contact import GYRATION_M
from ftdrive.live.motion import READING_S, REST, STATES, MovedLoad, wrench_by_acceleration
from ftdrive.live.noise import NoiseEstimator, variance_at_next_use
from ftdrive.live.samples import Paired, StreamEvent, StreamInfo, Tracked, gripping_point

# Squared innovation of a window that bias and part do not explain.
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
# Random walks of the bias in an hour that are tried, one sigma, N; torque in the proportion of `_BIAS`.
_WALKS = np.array([0.1, 0.3, 1.0, 3.0])
# Error of the bias at the beginning, one sigma, N and N·m.
_BIAS = np.repeat([1.0, 0.03], 3)
# The likelihood of a walk counts so long.
_FORGET_S = 3600.0
# A bias is trusted to drift this far in an hour, N and N·m; of a sensor that is known to walk more, in proportion.
_TRUSTED_PER_H = 10.0 * _BIAS
# What a new sensor is known to walk in an hour, N. It is that of the last so many seconds: a contact is shorter.
_USUAL_WALK_N, _WALK_KNOWN_S = 1.0, 1800.0
# A bias farther from the trusted one than what it walks in a quarter of an hour, or than this many sigmas, may have a
# contact in it.
_DOUBTFUL_S, _DOUBTFUL_SIGMAS = 900.0, 4.0
NOTHING_KG = 0.02
"""A lighter part is none."""
# One sigma of mass and mass times centre of a part that is not known yet, kg and kg m.
_ANY_PART = np.array([5.0, 0.5, 0.5, 0.5])
# Sigma of mass and moment of an empty gripper.
_NO_PART = np.array([2e-3, 2e-4, 2e-4, 2e-4])
# Radius of gyration of a part, and what its place that is not known yet adds.
_GYRATION_M = 0.08
# A part whose centre of mass is known so well turns about it.
_PLACED_M = 0.03
# The first noise of a state counts as so many windows, few because vibration is less in a window than in the readings
# that show it; the noise follows within so many.
_FIRST_WINDOWS, _MOST_WINDOWS = 3, 200


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """The weighted mean of a short time."""

    t_s: float
    residual: Array
    """(6,) measured minus predicted wrench of the tool alone, decoded, N and N·m, sensor axes."""
    felt_m_s2: Array
    """(3,) gravity minus the acceleration of the sensor's origin, sensor axes."""
    lever_s2: Array
    """(3, 3) acceleration of a point by its place from there, as the sensor turns."""
    p_sensor_near_m: Array
    """(3,) where the gripper holds parts."""
    noise: Array
    """(6, 6) covariance that is expected before the windows show it."""
    state: int
    """Fastest state of motion, as `MotionTracker.follow` returns it."""
    systematic: Array
    """(6, 6) covariance of the prediction, common to neighbouring windows."""
    turning_rad_s2: float
    """Mean angular acceleration."""
    tensor_Nm: float
    """One sigma of the torque that an unknown inertia of the tool exerts."""
    p_base_flange_m: Array


class Tracker:
    """Kalman filter of the bias and of a part, whose weight turns with the sensor while a bias does not.

    A window that they do not explain begins an interruption. From then on the part is unknown. Windows in a row that
    agree on one part, which may be the one before, none or a new one, end it. Meanwhile the bias is as uncertain as
    the random walk makes it, so what grasps and contacts do does not reach it. Several walks are tried side by side,
    and count by their likelihood. The noise of a window is learnt for each state of motion.

    No single window shows a contact that grows slowly. A trusted bias therefore follows the estimate no faster than
    the sensor drifts. The sigma includes the distance between them, and if it is clear, the trusted bias waits for the
    end of the contact or for a tare.

    Parameters
    ----------
    mass_kg : float
    p_sensor_com_m : array, shape (3,)
        Of the tool: vibration shakes a part as it shakes the tool.
    drift_per_h : array, shape (6,)
        What the bias is known to drift, N and N·m.
    """

    def __init__(self, mass_kg: float, p_sensor_com_m: Array, drift_per_h: Array | float = 0.0) -> None:
        self._tool = mass_kg, mass_kg * float(np.linalg.norm(p_sensor_com_m))
        n = len(_WALKS)
        # For each walk bias (6,), mass, and mass times centre (3,).
        self._x = np.zeros((n, 10))
        self._P = np.tile(np.diag(np.square([*_BIAS, *_NO_PART])), (n, 1, 1))
        self._walk = np.square(_WALKS[:, None] * _BIAS) / 3600.0
        self._likelihood = np.zeros(n)
        self._t_s: float | None = None
        self._seen_s = -np.inf
        # Number of windows, and sum of the squares of what they leave.
        self._noise: list[tuple[float, Array]] = [(0.0, np.zeros((6, 6)))] * STATES
        # Explained, but not counted yet.
        self._queue: list[Window] = []
        # Begin of an interruption.
        self._open_s: float | None = None
        self._peak_N = 0.0
        # The part before an interruption.
        self._before = np.zeros(4), np.diag(_NO_PART**2)
        # The last windows of an interruption that agree.
        self._run: list[Window] = []
        # The centre of mass of their part, as far as it is known.
        self._place: Array | None = None
        self._drift_per_h = np.maximum(_TRUSTED_PER_H, drift_per_h)
        self._known_walk_N = _USUAL_WALK_N
        # The bias that no slow contact has changed, and the sigma of the estimate that it was taken from.
        self._trusted, self._trusted_sigma = np.zeros(6), _BIAS
        self._is_doubtful = False

    def update(self, window: Window) -> Tracked:
        """Add the next window."""
        events: list[StreamEvent] = []
        dt_s = 0.0 if self._t_s is None else window.t_s - self._t_s
        self._t_s = window.t_s
        self._P[:, range(6), range(6)] += self._walk * dt_s
        self._likelihood *= np.exp(-dt_s / _FORGET_S)
        if self._open_s is None:
            self._follow(window)
        else:
            events += self._decide(window)
        x, P = self._mixed(self._x, self._P)
        variance, doubts = self._trust(x[:6], np.diag(P)[:6], np.diag(window.systematic), dt_s)
        events += doubts
        known = self._open_s is None
        part, part_P = (x[6:], P[6:, 6:]) if known else self._before
        return Tracked(
            t_s=window.t_s,
            bias=x[:6],
            sigma=np.sqrt(variance),
            part_kg=float(part[0]),
            part_sigma_kg=float(np.sqrt(part_P[0, 0])),
            part_known=known,
            last_seen_s=window.t_s - self._seen_s,
            walk_N=float(self._weights @ _WALKS),
            moment=(part.copy(), part_P.copy()),
            events=tuple(events),
        )

    def trust(self) -> None:
        """Take the bias as that of a free tool."""
        self._trusted, self._is_doubtful = self._mixed(self._x, self._P)[0][:6], False

    def _trust(self, bias: Array, variance: Array, systematic: Array, dt_s: float) -> tuple[Array, list[StreamEvent]]:
        """Let the trusted bias follow by no more than drift and a better estimate explain; report when it waits.

        Return the variance (6,) of the bias, and events.
        """
        sigma = np.sqrt(variance + systematic)
        limit = np.maximum(_BIAS * self._known_walk_N * np.sqrt(_DOUBTFUL_S / 3600), _DOUBTFUL_SIGMAS * sigma)
        off = bias - self._trusted
        self._is_doubtful &= bool((np.abs(off) > limit / 2).any())
        if not self._is_doubtful:
            seen = np.minimum(self._trusted_sigma, np.sqrt(variance))
            most = self._drift_per_h * max(self._known_walk_N, 1.0) * dt_s / 3600 + 3 * (self._trusted_sigma - seen)
            self._trusted_sigma = seen
            # One contact moves all axes.
            self._trusted = self._trusted + off / max(1.0, float((np.abs(off) / np.maximum(most, 1e-12)).max()))
            off = bias - self._trusted
            self._known_walk_N += (float(self._weights @ _WALKS) - self._known_walk_N) * -np.expm1(
                -dt_s / _WALK_KNOWN_S
            )
        beyond = np.maximum(np.abs(off) - sigma, 0.0)
        if self._is_doubtful or (np.abs(off) < limit).all():
            return sigma**2 + beyond**2, []
        self._is_doubtful = True
        force_N, torque_Nm = float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:]))
        text = (
            f"the bias has moved by {force_N:.2f} N and {torque_Nm:.3f} N·m, faster than this sensor drifts, as by a "
            "slow contact: free the tool, then tare"
        )
        values = {"force_N": force_N, "torque_Nm": torque_Nm}
        return sigma**2 + beyond**2, [StreamEvent(round((self._t_s or 0.0) * 1e9), "drift", text, values)]

    def _follow(self, window: Window) -> None:
        """Take a window into account whose part is known, or begin an interruption."""
        if self._distance(self._x, self._P, window, _place(*self._mixed(self._x, self._P))) < _GATE:
            self._queue.append(window)
            if len(self._queue) > _GUARD:
                self._count(self._queue.pop(0))
            return
        self._open_s, self._peak_N = (self._queue[0] if self._queue else window).t_s, 0.0
        x, P = self._mixed(self._x, self._P)
        self._before = x[6:].copy(), P[6:, 6:].copy()
        self._x[:, 6:] = 0.0
        self._P[:, 6:], self._P[:, :, 6:] = 0.0, 0.0
        if self._is_doubtful:  # a slow contact may end at once
            self._P[:, range(6), range(6)] += np.square(x[:6] - self._trusted)
            self._x[:, :6] = self._trusted
        self._P[:, 6:, 6:] = np.diag(_ANY_PART**2)
        self._queue, self._run = [], []
        self._decide(window)

    def _count(self, window: Window) -> None:
        """Correct bias and part by a window, and learn its noise."""
        x, P = self._mixed(self._x, self._P)
        place = _place(x, P)
        H, C = _observed(window, place), self._covariance(window, float(x[6]), x[7:])
        left = window.residual - H @ x
        if (np.diag(H @ P @ H.T) < np.diag(C)).all():
            n, squares = self._noise[window.state]
            keep = min(1.0, _MOST_WINDOWS / (n + 1))
            left = left / self._shaken(window, float(x[6]), x[7:])
            self._noise[window.state] = (n + 1) * keep, (squares + np.outer(left, left)) * keep
        C = C * _less(self._distance(self._x, self._P, window, place))
        self._likelihood += _log_likelihood(self._x, self._P, window.residual, C, H)
        self._x, self._P = _corrected(self._x, self._P, window.residual, C, H)
        self._seen_s = window.t_s

    def _decide(self, window: Window) -> list[StreamEvent]:
        """End an interruption, if the last windows agree on a part."""
        self._run = [*self._run, window][-_LONGEST_RUN:]
        while self._agreed(self._run) is None:
            del self._run[0]
        before = np.concatenate([self._mixed(self._x, self._P)[0][:6], self._before[0]])
        H = _observed(window, None)
        self._peak_N = max(self._peak_N, float(np.linalg.norm((window.residual - H @ before)[:3])))
        # a contact may end and begin too softly to see
        inner = self._run[_GUARD:-_GUARD]
        if len(inner) < _RUN or (found := self._agreed(inner)) is None:
            return []
        x, P = found
        mean, covariance = self._mixed(x, P)
        for part, part_P in (self._before, (np.zeros(4), np.diag(_NO_PART**2))):
            off = mean[6:] - part
            if off @ np.linalg.solve(covariance[6:, 6:] + part_P, off) < _SAME:
                return self._end(*_corrected(x, P, part, part_P, np.eye(10)[6:]))
        if mean[6] < NOTHING_KG or not self._moved(self._run):
            return []
        return self._end(x, P)

    def _agreed(self, run: list[Window]) -> tuple[Array, Array] | None:
        """Return the states after windows of one unknown part, or None if one does not agree with those before."""
        x, P, place = self._x, self._P, self._place
        for one in run:
            if (distance := self._distance(x, P, one, place)) >= _GATE:
                return None
            mean = self._mixed(x, P)[0]
            C = self._covariance(one, mean[6], mean[7:]) * _less(distance)
            x, P = _corrected(x, P, one.residual, C, _observed(one, place))
        self._place = _place(*self._mixed(x, P)) if len(run) > 1 else None
        return x, P

    def _end(self, x: Array, P: Array) -> list[StreamEvent]:
        begin_s, self._open_s = self._open_s or 0.0, None
        t_ns = round(begin_s * 1e9)
        self._x, self._P = x, P
        self._seen_s = self._run[-_GUARD].t_s
        self._queue, self._run = self._run[-_GUARD:], []
        mean, covariance = self._mixed(x, P)
        change_kg = float(mean[6] - self._before[0][0])
        sigma_kg = float(np.sqrt(covariance[6, 6] + self._before[1][0, 0]))
        if abs(change_kg) > max(NOTHING_KG, 4 * sigma_kg):
            text = f"the load has changed by {with_sigma(change_kg, sigma_kg)} kg (1 sigma)"
            return [StreamEvent(t_ns, "load-step", text, {"mass_kg": change_kg, "mass_sigma_kg": sigma_kg})]
        values = {"peak_N": self._peak_N, "duration_s": (self._t_s or begin_s) - begin_s}
        return [StreamEvent(t_ns, "contact", f"contact {self._peak_N:.1f} N while a part is held", values)]

    @staticmethod
    def _moved(run: list[Window]) -> bool:
        down = np.array([one.felt_m_s2 / np.linalg.norm(one.felt_m_s2) for one in run])
        gone = np.array([one.p_base_flange_m for one in run])
        turned = float((down @ down[0]).min()) < np.cos(_TURN_RAD)
        return turned or bool(np.linalg.norm(gone - gone[0], axis=1).max() > _TRAVEL_M)  # NaN: not known

    @property
    def _weights(self) -> Array:
        weights = np.exp(self._likelihood - self._likelihood.max())
        return np.asarray(weights / weights.sum())

    def _mixed(self, x: Array, P: Array) -> tuple[Array, Array]:
        weights = self._weights
        mean = weights @ x
        off = x - mean
        return mean, np.einsum("k,kij->ij", weights, P) + np.einsum("k,ki,kj->ij", weights, off, off)

    def _shaken(self, window: Window, mass_kg: float, moment_kg_m: Array) -> Array:
        """Return how much larger the noise in motion is with a part, (6,)."""
        if window.state == REST:
            return np.ones(6)
        held = abs(mass_kg) / self._tool[0], float(np.linalg.norm(moment_kg_m)) / max(self._tool[1], 1e-6)
        return 1.0 + np.repeat(held, 3)

    def _covariance(self, window: Window, mass_kg: float, moment_kg_m: Array) -> Array:
        n, squares = self._noise[window.state]
        scale = self._shaken(window, mass_kg, moment_kg_m)
        C = (squares + _FIRST_WINDOWS * window.noise) / (n + _FIRST_WINDOWS) * np.outer(scale, scale)
        C[range(3, 6), range(3, 6)] += (mass_kg * _GYRATION_M**2 * window.turning_rad_s2) ** 2 + window.tensor_Nm**2
        return np.asarray(C)

    def _distance(self, x: Array, P: Array, window: Window, place: Array | None) -> float:
        mean, covariance = self._mixed(x, P)
        H = _observed(window, place)
        left = window.residual - H @ mean
        S = H @ covariance @ H.T + self._covariance(window, mean[6], mean[7:]) + window.systematic
        return float(left @ np.linalg.solve(S, left))


def _less(distance: float) -> float:
    """Return how much larger the covariance of a window at this squared distance counts."""
    return max(1.0, (_TAILS + distance) / (_TAILS + 6))


def _corrected(x: Array, P: Array, y: Array, covariance: Array, H: Array) -> tuple[Array, Array]:
    S = H @ P @ H.T + covariance
    K = np.swapaxes(np.linalg.solve(S, H @ P), 1, 2)
    P = P - K @ S @ np.swapaxes(K, 1, 2)
    return x + np.einsum("nij,nj->ni", K, y - x @ H.T), (P + np.swapaxes(P, 1, 2)) / 2


def _log_likelihood(x: Array, P: Array, y: Array, covariance: Array, H: Array) -> Array:
    S = H @ P @ H.T + covariance
    left = y - x @ H.T
    distance = np.einsum("ni,ni->n", left, np.linalg.solve(S, left[..., None])[..., 0])
    return np.asarray(-0.5 * (distance + np.linalg.slogdet(S)[1]))


def _observed(window: Window, p_sensor_m: Array | None) -> Array:
    """Return the matrix (6, 10) from bias and part to a wrench, linear about a part at this place, if it is known."""
    place_m = window.p_sensor_near_m if p_sensor_m is None else p_sensor_m
    H = np.zeros((6, 10))
    H[:, :6] = np.eye(6)
    # A bias is fixed in the sensor and a weight turns with gravity, so only motion distinguishes them.
    H[:3, 6], H[:3, 7:] = window.felt_m_s2, -window.lever_s2
    H[3:, 7:] = -skew(window.felt_m_s2 - window.lever_s2 @ place_m)
    return H


def _place(x: Array, P: Array) -> Array | None:
    """Return the centre of mass of a part (3,), if it is known well enough to be a centre of turning."""
    placed = x[6] > NOTHING_KG and float(np.trace(P[7:, 7:])) < (_PLACED_M * x[6]) ** 2
    return x[7:] / x[6] if placed else None


# Ringing at 8 to 20 Hz leaves 0.06 N in plain means at the end of a move, and 0.01 N with Hann weights.
WINDOW_S = 0.3
"""Each begins in the middle of the one before. The weights, a Hann window, suppress the ringing of the links."""
# Poses of this spacing give the acceleration, with so many neighbours on each side.
_KNOT_S, _REACH = 0.004, 5
# Error of a tool's inertia that was calibrated, of what it is without.
_TENSOR = 0.5
# A window that took so many times as long has lost samples.
_LATE = 1.2
# Acceleration in motion of an arm that reports no positions, one sigma.
_UNKNOWN_M_S2 = 1.0
# Variance of such a mean over that of a reading, if the noise is white: vibration leaves less.
_LIKE_WHITE = 1.5 * READING_S / WINDOW_S


class Windows:
    """Collects samples of a stream to windows.

    Parameters
    ----------
    info : StreamInfo
    """

    def __init__(self, info: StreamInfo) -> None:
        calibration = info.calibration
        self._calibration, self._tool = calibration, calibration.parameters
        self._compensator = Compensator(self._tool, response=calibration.response)
        self._inertia = None if calibration.motion is None else calibration.motion.inertia_kg_m2
        self._beyond = np.diag(variance_at_next_use(calibration))
        self._near_m = gripping_point(info)
        self._load = MovedLoad(self._tool, calibration.g_m_s2, np.nan_to_num(info.p_flange_sensor_m), _REACH)
        # the bias is what is tracked: its error in the calibration does not count
        self._covariance = _without_bias(calibration.covariance)
        response = calibration.response
        self._response = response and replace(response, covariance=_without_bias(response.covariance))
        self._decoder = _decoder_of(calibration)
        self._size = round(WINDOW_S * info.sensor_rate_Hz)
        self._stride = max(1, round(_KNOT_S * info.sensor_rate_Hz))
        self._weights = np.hanning(self._size + 2)[1:-1] / (np.hanning(self._size + 2).sum())
        self._unknown = wrench_by_acceleration(calibration.mass_kg, self._tool.p_sensor_com_m) * _UNKNOWN_M_S2
        self.restart()

    def restart(self) -> None:
        """Forget the samples before an interruption."""
        self._rows: list[Paired] = []
        self._states: list[NDArray[np.int8]] = []

    def add(self, rows: Paired, states: NDArray[np.int8], noise: NoiseEstimator) -> Iterator[Window]:
        """Add samples with their states of motion; yield the windows that are complete."""
        if len(rows):
            self._rows.append(rows)
            self._states.append(states)
        margin = self._stride * _REACH
        needed = self._size + 2 * margin
        while sum(map(len, self._states)) >= needed:
            buffer, all_states = Paired.concatenate(self._rows), np.concatenate(self._states)
            window = self._window(buffer.rows(slice(0, needed)), all_states[margin : margin + self._size], noise)
            rest = slice(self._size // 2, None)
            self._rows, self._states = [buffer.rows(rest)], [all_states[rest]]
            if window is not None:
                yield window

    def _window(self, rows: Paired, states: NDArray[np.int8], noise: NoiseEstimator) -> Window | None:
        state = int(states.max())
        known = noise.of(state)
        t_s = (rows.t_host_ns - rows.t_host_ns[0]) * 1e-9
        knots = np.arange(0, len(rows), self._stride)
        if known is None or t_s[-1] > _LATE * WINDOW_S * len(rows) / self._size or (np.diff(t_s[knots]) <= 0).any():
            return None
        tool, mass_kg = self._tool, self._calibration.mass_kg
        motion = self._load.motion(t_s[knots], rows.R_base_flange[knots], rows.p_base_flange_m[knots])
        margin = self._stride * _REACH
        inner = rows.rows(slice(margin, margin + self._size))
        weights = np.interp(motion.t_s, t_s[margin : margin + self._size], self._weights)
        weights /= weights.sum()
        residual = self._weights @ self._compensator.batch(inner.raw, inner.R_base_flange)
        if state != REST:
            residual -= weights @ self._load.wrench(motion, self._inertia)
        R_base_sensor = np.einsum("n,nij->ij", self._weights, inner.R_base_flange) @ tool.R_flange_sensor
        omega, alpha = motion.angular_velocity_rad_s, motion.angular_acceleration_rad_s2
        lever = np.einsum("n,nij->ij", weights, skew(alpha) + skew(omega) @ skew(omega))
        felt = tool.gravity_force_base_N / mass_kg @ R_base_sensor - weights @ motion.linear_acceleration_m_s2
        covariance = _LIKE_WHITE * known.reading
        if state != REST and not np.isfinite(rows.p_base_flange_m).all():
            covariance = covariance + self._unknown @ self._unknown.T
        turning = float(weights @ np.linalg.norm(alpha, axis=1))
        R = inner.R_base_flange[self._size // 2]
        error = predicted_covariance(tool, self._covariance, self._response, R)
        return Window(
            t_s=float(inner.t_host_ns[self._size // 2]) * 1e-9,
            residual=self._decoder @ residual,
            felt_m_s2=felt,
            lever_s2=lever,
            p_sensor_near_m=self._near_m,
            noise=covariance,
            state=state,
            systematic=error + self._beyond,
            turning_rad_s2=turning,
            tensor_Nm=(1.0 if self._inertia is None else _TENSOR) * mass_kg * GYRATION_M**2 * turning,
            p_base_flange_m=inner.p_base_flange_m[self._size // 2],
        )


def _without_bias(covariance: Array) -> Array:
    kept = np.ones(len(covariance))
    kept[BIASES] = 0.0
    return covariance * np.outer(kept, kept)


# From one event with the tracked values to the next.
_REPORT_S = 1.0
# A bias that is known less well is not applied, N and N·m, one sigma.
_APPLIED = np.repeat([0.1, 0.003], 3)


class Following:
    """Follows bias and part of a stream.

    Parameters
    ----------
    info : StreamInfo
    """

    def __init__(self, info: StreamInfo) -> None:
        calibration = info.calibration
        self._windows, self._as_read = Windows(info), np.asarray(np.linalg.inv(_decoder_of(calibration)))
        self._tracker = Tracker(calibration.mass_kg, calibration.parameters.p_sensor_com_m, _drift_per_h(calibration))
        self._reported_s = -np.inf
        self.tracked: Tracked | None = None
        """None before the first window."""

    def restart(self) -> None:
        """Forget the samples before an interruption."""
        self._windows.restart()

    def trust(self) -> None:
        """Take the bias as that of a free tool, as a tare has found."""
        self._tracker.trust()

    def add(
        self, rows: Paired, states: NDArray[np.int8], noise: NoiseEstimator
    ) -> Iterator[tuple[Tracked, list[StreamEvent]]]:
        """Add samples with their states of motion; yield what is known after each window, and the events."""
        for window in self._windows.add(rows, states, noise):
            tracked = self._tracker.update(window)
            # A bias is added to the reading, which is not decoded.
            tracked = self.tracked = replace(tracked, bias=self._as_read @ tracked.bias)
            events = list(tracked.events)
            if tracked.t_s - self._reported_s >= _REPORT_S:
                self._reported_s = tracked.t_s
                events.append(StreamEvent(round(tracked.t_s * 1e9), "tracked", tracked.in_words(), tracked.to_dict()))
            yield tracked, events


def _decoder_of(calibration: CalibrationResult) -> Array:
    """Return the matrix (6, 6) that decodes what the sensor reads of a part, if known loads have shown it."""
    contact = known_contact(calibration)
    return np.eye(6) if contact is None else contact.decode(np.eye(6)).T


def _drift_per_h(calibration: CalibrationResult) -> Array:
    """Return how fast the bias drifted in the tour (6,), N and N·m."""
    growth: list[float] = calibration.quality.get("bias_growth_per_min", [0.0] * 6)
    return 60 * np.abs(growth)


def update_by(calibration: CalibrationResult, tracked: Tracked) -> Update | None:
    """Return the calibration with the tracked bias; None while that is not known well."""
    if not (tracked.sigma < _APPLIED).all():
        return None
    return with_bias_change(calibration, tracked.bias, tracked.sigma, measured=True)


def part_of(tracked: Tracked, calibration: CalibrationResult) -> Weight | None:
    """Return the part as if it had been weighed; None for an empty gripper."""
    return None if tracked.part_kg < NOTHING_KG else weight_of(tracked, calibration)


def weight_of(tracked: Tracked, calibration: CalibrationResult) -> Weight:
    """Return what is held, nothing included, as if it had been weighed."""
    (x, covariance), mass_kg = tracked.moment, tracked.part_kg
    as_read, of_sensor, scale_sigma = tracked.moment, np.zeros((4, 4)), calibration.scale_sigma
    if (contact := known_contact(calibration)) is not None:
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
