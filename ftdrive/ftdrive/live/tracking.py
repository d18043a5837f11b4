"""Bias and held part, followed while a program runs: a step of the load is not drift, and a contact is neither."""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from ftcalib.model import Array, skew
from ftdrive.live.motion import REST, STATES
from ftdrive.live.samples import LoadEvent, Tracked

_GATE = float(chdtri(6, 1e-4))
"""Squared innovation of a window that bias and part do not explain."""
_TAILS = 4.0
"""Degrees of freedom of Student's distribution, by which a far window counts less: vibration has tails."""
_SAME = float(chdtri(4, 1e-3))
"""Squared distance of one part from another, of which mass and moment are estimated."""
_RUN, _LONGEST_RUN = 4, 24
"""So many windows in a row agree on a part; an earlier one counts no more."""
_TURN_RAD, _TRAVEL_M = 0.25, 0.15
"""A new part is known once gravity has turned so far in the sensor, or the arm has gone so far: a contact stays."""
_GUARD = 2
"""A window counts once so many after it are explained: the begin of a contact may be too small to see."""
_WALKS = np.array([0.1, 0.3, 1.0, 3.0])
"""Random walks of the bias in an hour that are tried, one sigma, N; torque in the proportion of `_BIAS`."""
_BIAS = np.repeat([1.0, 0.03], 3)
"""Error of the bias at the beginning, one sigma, N and N·m."""
_FORGET_S = 3600.0
"""The likelihood of a walk counts so long."""
NOTHING_KG = 0.02
"""A lighter part is none."""
_ANY_PART = np.array([5.0, 0.5, 0.5, 0.5])
"""One sigma of mass and mass times centre of a part that is not known yet, kg and kg m."""
_NO_PART = np.array([2e-3, 2e-4, 2e-4, 2e-4])
"""The same of an empty gripper."""
_GYRATION_M = 0.08
"""Radius of gyration of a part, and what its place that is not known yet adds."""
_PLACED_M = 0.03
"""A part whose centre of mass is known so well turns about it."""
_FIRST_WINDOWS, _MOST_WINDOWS = 3, 200
"""The first noise of a state counts as so many windows, few because vibration is less in a window than in the readings
that show it; the noise follows within so many."""


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """The weighted mean of a short time."""

    t_s: float
    residual: Array
    """(6,) measured minus predicted wrench of the tool alone, N and N·m, sensor axes."""
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
    the random walk makes it, so what grasps and contacts do never reaches it. Several walks are tried side by side, and
    count by their likelihood. The noise of a window is learnt for each state of motion.

    Parameters
    ----------
    mass_kg : float
    p_sensor_com_m : array, shape (3,)
        Of the tool: vibration shakes a part as it shakes the tool.
    """

    def __init__(self, mass_kg: float, p_sensor_com_m: Array) -> None:
        self._tool = mass_kg, mass_kg * float(np.linalg.norm(p_sensor_com_m))
        n = len(_WALKS)
        self._x = np.zeros((n, 10))
        """For each walk bias (6,), mass, and mass times centre (3,)."""
        self._P = np.tile(np.diag(np.square([*_BIAS, *_NO_PART])), (n, 1, 1))
        self._walk = np.square(_WALKS[:, None] * _BIAS) / 3600.0
        self._likelihood = np.zeros(n)
        self._t_s: float | None = None
        self._seen_s = -np.inf
        self._noise: list[tuple[float, Array]] = [(0.0, np.zeros((6, 6)))] * STATES
        """Number of windows, and sum of the squares of what they leave."""
        self._queue: list[Window] = []
        """Explained, but not counted yet."""
        self._open_s: float | None = None
        """Begin of an interruption."""
        self._peak_N = 0.0
        self._before = np.zeros(4), np.diag(_NO_PART**2)
        """The part before an interruption."""
        self._run: list[Window] = []
        """The last windows of an interruption that agree."""
        self._place: Array | None = None
        """The centre of mass of their part, as far as it is known."""

    def update(self, window: Window) -> Tracked:
        """Add the next window."""
        events: list[LoadEvent] = []
        if self._t_s is not None:
            self._grow(self._P, window.t_s - self._t_s)
            self._likelihood *= np.exp(-(window.t_s - self._t_s) / _FORGET_S)
        self._t_s = window.t_s
        if self._open_s is None:
            self._follow(window)
        else:
            events += self._decide(window)
        x, P = self._mixed(self._x, self._P)
        known = self._open_s is None
        part, part_P = (x[6:], P[6:, 6:]) if known else self._before
        sigma = np.sqrt(np.diag(P)[:6] + np.diag(window.systematic))
        walk_N = float(self._weights @ _WALKS)
        seen_s = window.t_s - self._seen_s
        part_sigma_kg = float(np.sqrt(part_P[0, 0]))
        return Tracked(
            window.t_s,
            x[:6],
            sigma,
            float(part[0]),
            part_sigma_kg,
            known,
            seen_s,
            walk_N,
            (part.copy(), part_P.copy()),
            tuple(events),
        )

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

    def _decide(self, window: Window) -> list[LoadEvent]:
        """End an interruption, if the last windows agree on a part."""
        self._run = [*self._run, window][-_LONGEST_RUN:]
        while self._agreed(self._run) is None:
            del self._run[0]
        before = np.concatenate([self._mixed(self._x, self._P)[0][:6], self._before[0]])
        H = _observed(window, None)
        self._peak_N = max(self._peak_N, float(np.linalg.norm((window.residual - H @ before)[:3])))
        inner = self._run[_GUARD:-_GUARD]  # a contact may end and begin too softly to see
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

    def _end(self, x: Array, P: Array) -> list[LoadEvent]:
        """End an interruption with the part that the windows agree on."""
        begin_s, self._open_s = self._open_s or 0.0, None
        self._x, self._P = x, P
        self._seen_s = self._run[-_GUARD].t_s
        self._queue, self._run = self._run[-_GUARD:], []
        mean, covariance = self._mixed(x, P)
        change_kg = float(mean[6] - self._before[0][0])
        sigma_kg = float(np.sqrt(covariance[6, 6] + self._before[1][0, 0]))
        if abs(change_kg) > max(NOTHING_KG, 4 * sigma_kg):
            return [LoadEvent("load", begin_s, change_kg, sigma_kg)]
        return [LoadEvent("contact", begin_s, self._peak_N)]

    @staticmethod
    def _moved(run: list[Window]) -> bool:
        down = np.array([one.felt_m_s2 / np.linalg.norm(one.felt_m_s2) for one in run])
        gone = np.array([one.p_base_flange_m for one in run])
        turned = float((down @ down[0]).min()) < np.cos(_TURN_RAD)
        return turned or bool(np.linalg.norm(gone - gone[0], axis=1).max() > _TRAVEL_M)  # NaN: not known

    def _grow(self, P: Array, dt_s: float) -> None:
        P[:, range(6), range(6)] += self._walk * dt_s

    @property
    def _weights(self) -> Array:
        weights = np.exp(self._likelihood - self._likelihood.max())
        return np.asarray(weights / weights.sum())

    def _mixed(self, x: Array, P: Array) -> tuple[Array, Array]:
        """Return mean and covariance over the walks."""
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
        """Return the covariance of a window with a part."""
        n, squares = self._noise[window.state]
        scale = self._shaken(window, mass_kg, moment_kg_m)
        C = (squares + _FIRST_WINDOWS * window.noise) / (n + _FIRST_WINDOWS) * np.outer(scale, scale)
        C[range(3, 6), range(3, 6)] += (mass_kg * _GYRATION_M**2 * window.turning_rad_s2) ** 2 + window.tensor_Nm**2
        return np.asarray(C)

    def _distance(self, x: Array, P: Array, window: Window, place: Array | None) -> float:
        """Return the squared Mahalanobis distance of a window."""
        mean, covariance = self._mixed(x, P)
        H = _observed(window, place)
        left = window.residual - H @ mean
        S = H @ covariance @ H.T + self._covariance(window, mean[6], mean[7:]) + window.systematic
        return float(left @ np.linalg.solve(S, left))


def _less(distance: float) -> float:
    """Return how much larger the covariance of a window at this squared distance counts."""
    return max(1.0, (_TAILS + distance) / (_TAILS + 6))


def _corrected(x: Array, P: Array, y: Array, covariance: Array, H: Array) -> tuple[Array, Array]:
    """Return states (n, 10) and covariances after an observation."""
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
    H[:3, 6], H[:3, 7:] = window.felt_m_s2, -window.lever_s2
    H[3:, 7:] = -skew(window.felt_m_s2 - window.lever_s2 @ place_m)
    return H


def _place(x: Array, P: Array) -> Array | None:
    """Return the centre of mass of a part (3,), if it is known well enough to be a centre of turning."""
    placed = x[6] > NOTHING_KG and float(np.trace(P[7:, 7:])) < (_PLACED_M * x[6]) ** 2
    return x[7:] / x[6] if placed else None
