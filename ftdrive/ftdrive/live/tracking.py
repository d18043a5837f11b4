"""Bias and held part, followed while a program runs: a step of the load is not drift, and a contact is neither."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import chdtri

from ftcalib.model import Array, skew

GATE = float(chdtri(6, 1e-4))
"""Squared innovation of a window that bias and part do not explain."""
LEAST_WINDOWS, LEAST_TURN_RAD = 6, 0.25
"""A step of the load is known from so many windows, in which gravity has turned so far in the sensor."""
LONGEST_WINDOWS = 60
_BIAS = np.repeat([1.0, 0.03], 3)
"""Error of the bias at the beginning, one sigma, N and N·m."""
_WALK_S = np.repeat([0.3, 0.01], 3) / 60.0
"""Random walk of the bias in a second, one sigma: .3 N and 10 mN·m in an hour."""
_NOTHING_KG = 0.02
"""A lighter part is none."""
_ANY_PART, _NO_PART = np.array([5.0, 0.5, 0.5, 0.5]), np.full(4, 1e-12)
"""One sigma of mass and mass times centre of a new part, kg and kg m; variance of none."""


@dataclass(frozen=True, slots=True)
class LoadEvent:
    """A grasp or a release, or a contact that is over."""

    kind: Literal["load", "contact"]
    t_s: float
    """When it began."""
    size: float
    """Change of the mass, kg, or the largest force, N."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """What is followed."""

    bias: Array
    """(6,) change of the bias since the calibration, N and N·m, sensor axes."""
    sigma: Array
    """(6,) one standard deviation; it grows while the bias cannot be seen."""
    part_kg: float
    """Mass that is held beside the tool."""
    part_sigma_kg: float
    last_seen_s: float
    """Since the bias was seen."""
    events: tuple[LoadEvent, ...] = ()
    """Since the last update."""


class Tracker:
    """Kalman filter of the bias and of a part, whose weight turns with the sensor while a bias does not.

    A window that they do not explain waits. If an empty gripper or a new part explains the windows that wait, the load
    has changed; if the old load explains a later window, they were a contact. Neither changes the bias.
    """

    def __init__(self) -> None:
        self._x = np.zeros(10)
        """Bias (6,), mass, and mass times centre (3,)."""
        self._P = np.diag(np.concatenate([_BIAS**2, _NO_PART]))
        self._walk = _WALK_S**2
        self._t_s: float | None = None
        self._seen_s = -np.inf
        self._waiting: list[tuple[float, Array, Array, Array]] = []

    def update(self, t_s: float, residual: Array, covariance: Array, gravity_m_s2: Array) -> Tracked:
        """Add the mean of a short window in which the motion hardly changes.

        Parameters
        ----------
        t_s : float
        residual : array, shape (6,)
            Measured minus predicted wrench of the tool alone, N and N·m, sensor axes.
        covariance : array, shape (6, 6)
            Of that mean: noise of the state of motion and uncertainty of the calibration.
        gravity_m_s2 : array, shape (3,)
            Specific force in sensor axes: gravity, in motion minus the acceleration of the sensor.
        """
        dt_s = 0.0 if self._t_s is None else t_s - self._t_s
        self._t_s = t_s
        self._P[range(6), range(6)] += self._walk * dt_s
        H = _observed(gravity_m_s2)
        events: list[LoadEvent] = []
        if _distance(self._x, self._P, residual, covariance, H) < GATE:
            if self._waiting:
                force_N = max(float(np.linalg.norm(one[1][:3] - (one[3] @ self._x)[:3])) for one in self._waiting)
                events.append(LoadEvent("contact", self._waiting[0][0], force_N))
                self._waiting = []
            self._x, self._P = _corrected(self._x, self._P, residual, covariance, H)
            self._seen_s = t_s
        else:
            self._waiting = [*self._waiting, (t_s, residual, covariance, H)][-LONGEST_WINDOWS:]
            events += self._load_step()
        sigma = np.sqrt(np.diag(self._P))
        return Tracked(
            self._x[:6].copy(), sigma[:6], float(self._x[6]), float(sigma[6]), t_s - self._seen_s, tuple(events)
        )

    def _load_step(self) -> list[LoadEvent]:
        """Explain the last windows that wait by another part; the bias keeps its value and its uncertainty."""
        recent = self._waiting[-LEAST_WINDOWS:]
        down = np.array([H[:3, 6] / np.linalg.norm(H[:3, 6]) for _, _, _, H in recent])
        if len(recent) < LEAST_WINDOWS or float((down @ down[0]).min()) > np.cos(LEAST_TURN_RAD):
            return []
        x, P = _with_part(self._x, self._P, _ANY_PART**2)
        distance = 0.0
        for _, y, covariance, H in recent:
            distance += _distance(x, P, y, covariance, H)
            x, P = _corrected(x, P, y, covariance, H)
        if distance > float(chdtri(6 * len(recent), 1e-4)) or x[6] < -_NOTHING_KG:
            return []
        change_kg = float(x[6] - self._x[6])
        if abs(x[6]) < max(_NOTHING_KG, 3 * float(np.sqrt(P[6, 6]))):
            x, P = _with_part(x, P, _NO_PART)
        self._x, self._P, self._waiting = x, P, []
        return [LoadEvent("load", recent[0][0], change_kg)]


def _with_part(x: Array, P: Array, variance: Array) -> tuple[Array, Array]:
    """Return state and covariance with a part that is unknown by these variances (4,) about none."""
    x, P = x.copy(), P.copy()
    x[6:], P[6:], P[:, 6:] = 0.0, 0.0, 0.0
    P[6:, 6:] = np.diag(variance)
    return x, P


def _distance(x: Array, P: Array, y: Array, covariance: Array, H: Array) -> float:
    """Return the squared Mahalanobis distance of an observation."""
    left = y - H @ x
    return float(left @ np.linalg.solve(H @ P @ H.T + covariance, left))


def _corrected(x: Array, P: Array, y: Array, covariance: Array, H: Array) -> tuple[Array, Array]:
    """Return state and covariance after an observation."""
    S = H @ P @ H.T + covariance
    K = np.linalg.solve(S, H @ P).T
    P = P - K @ S @ K.T
    return x + K @ (y - H @ x), (P + P.T) / 2


def _observed(gravity_m_s2: Array) -> Array:
    """Return the matrix (6, 10) from bias and part to a wrench."""
    H = np.zeros((6, 10))
    H[:, :6] = np.eye(6)
    H[:3, 6] = gravity_m_s2
    H[3:, 7:] = -skew(gravity_m_s2)
    return H
