"""A lasting change between two poses: a load that shifted, or a sensor that was tared."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftcalib.findings import Finding, Severity
from ftcalib.likelihood.descent import column_scale
from ftcalib.likelihood.gain_and_cross_talk import response_columns
from ftcalib.likelihood.session_noise import summed_products
from ftcalib.model import Array, Parameters, jacobian

MOST_POSITIONS = 200
"""Of a change that are tried at first; then all near the best one."""
FEWEST_ON_A_SIDE = 3
"""Poses before and after."""
CLEARLY = 0.5
"""A change must bring the mean square misfit below this share of what any other explanation leaves."""


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """One change."""

    what: str
    """centre of mass, load, force, torque, force and torque, or mounting."""
    position: int
    """How many poses were taken before it."""
    step: Array
    """Of the load: N and metres; of mass centre and mounting: metres, rad; of a bias: N, N·m."""
    misfit: float
    """Mean square of what it leaves, in measured noise."""
    criterion: float

    @property
    def of_the_tool(self) -> bool:
        """Whether the poses before and after have no calibration in common, whatever the bias does."""
        return self.what in {"centre of mass", "load"}

    def finding(self, pose: int, severity: Severity) -> Finding:
        """Return what changed from a pose on, given by its row from 1."""
        step, size = self.step, float(np.linalg.norm(self.step))
        code, values = {
            "centre of mass": ("com_shifted", {"shift_mm": 1e3 * size}),
            "load": ("load_changed", {"change_N": step[0], "shift_mm": 1e3 * np.linalg.norm(step[1:])}),
            "force": ("bias_stepped", {"force_N": size, "torque_Nm": 0.0}),
            "torque": ("bias_stepped", {"force_N": 0.0, "torque_Nm": size}),
            "force and torque": (
                "bias_stepped",
                {"force_N": np.linalg.norm(step[:3]), "torque_Nm": np.linalg.norm(step[3:])},
            ),
            "mounting": ("sensor_turned", {"turn_deg": np.degrees(size)}),
        }[self.what]
        return Finding.of(code, severity, pose=pose, **values)


def lasting_change(
    parameters: Parameters,
    R_base_flange: Array,
    residuals: Array,
    sigma: ArrayLike,
    t_s: Array,
    suspect: Sequence[int] = (),
) -> Change | None:
    """Find a lasting change between two poses that explains the residuals far better than anything else.

    Linear least squares of the residuals with the parameters free, and some of them different from a pose on. It must
    beat no change, a steady drift, and single poses that are off, unless those are all at one end of the tour.

    Parameters
    ----------
    parameters : Parameters
        Estimated from all poses.
    R_base_flange : array, shape (n, 3, 3)
        In the order in which they were taken, as all the rest.
    residuals : array, shape (n, 6)
        N and N·m.
    sigma : array_like, shape (6,)
        Measured noise of a pose.
    t_s : array, shape (n,)
    suspect : sequence of int
        Poses that were left out, or that the others predict badly.
    """
    n = len(residuals)
    if n < 2 * FEWEST_ON_A_SIDE + 2:
        return None
    # A fit may have taken a part of the change for gain and cross-talk: these are free too.
    free = [jacobian(parameters, R_base_flange), response_columns(parameters, R_base_flange), residuals[..., None]]
    X = np.concatenate(free, axis=2) / np.asarray(sigma, dtype=np.float64)[:, None]
    ramp = ((t_s - t_s.mean()) / (np.ptp(t_s) or 1.0))[:, None, None] * np.eye(6)
    others = [_misfit(X), _misfit(np.concatenate([ramp, X], axis=2))]
    used = np.ones(n, bool)
    used[list(suspect)] = False
    at_one_end = np.count_nonzero(np.diff(used)) == 1 and np.count_nonzero(~used) >= FEWEST_ON_A_SIDE
    if not at_one_end and not used.all() and used.sum() > FEWEST_ON_A_SIDE:
        others.append(_misfit(X[used]))

    positions = np.arange(FEWEST_ON_A_SIDE, n - FEWEST_ON_A_SIDE + 1)
    step = -(-len(positions) // MOST_POSITIONS)
    best = _best_change(parameters, X, positions[::step])
    if step > 1:
        near = np.abs(positions - best.position) < step
        best = _best_change(parameters, X, positions[near])
    return best if max(best.misfit, 1.0) < CLEARLY * min(others) else None


def _misfit(X: Array) -> float:
    """Mean square of what all columns but the last leave of the last, for X (n, 6, m), per degree of freedom."""
    gram = summed_products(X, X)
    scale = column_scale(gram[:-1, :-1])
    inverse = np.linalg.pinv(gram[:-1, :-1] / np.outer(scale, scale), rcond=1e-12, hermitian=True)
    moment = gram[:-1, -1] / scale
    return float((gram[-1, -1] - moment @ inverse @ moment) / max(6 * len(X) - len(moment), 1))


def _best_change(parameters: Parameters, X: Array, positions: NDArray[np.intp]) -> Change:
    """Find the likeliest change at one of these positions, ascending; all sums over poses are cumulative."""
    n, columns = len(X), X.shape[2] - 1
    parts = [X[first:last] for first, last in pairwise([0, *positions, n])]
    gram = np.array([summed_products(part, part) for part in parts])
    information, moment, square = gram[:, :-1, :-1], gram[:, :-1, -1], float(gram[:, -1, -1].sum())
    scale = column_scale(information.sum(axis=0))
    information, moment = information / np.outer(scale, scale), moment / scale
    after, moment_after = (np.cumsum(x[:0:-1], axis=0)[::-1] for x in (information, moment))
    inverse = np.linalg.pinv(information.sum(axis=0), rcond=1e-12, hermitian=True)
    rest = float(square - moment.sum(axis=0) @ inverse @ moment.sum(axis=0))
    # What a change can still explain beside the parameters.
    seen = (after - after @ inverse @ after)[:, :15, :15]
    asked = (moment_after - after @ (inverse @ moment.sum(axis=0)))[:, :15]
    found = []
    for what, directions in _changes(parameters).items():
        D = directions * scale[:15, None]
        gain = np.linalg.pinv(D.T @ seen @ D, rcond=1e-10, hermitian=True)
        x = (gain @ (asked @ D)[..., None])[..., 0]
        size = directions.shape[1]
        misfit = (rest - np.sum(x * (asked @ D), axis=1)) / max(6 * n - columns - size, 1)
        misfit = np.maximum(misfit, 1e-12 * square / n)
        criterion = 6 * n * np.log(misfit) + size * np.log(6 * n)
        k = int(np.argmin(criterion))
        found.append(Change(what, int(positions[k]), x[k], float(misfit[k]), float(criterion[k])))
    return min(found, key=lambda change: change.criterion)


def _changes(parameters: Parameters) -> dict[str, Array]:
    """What can change between two poses: directions (15, k) in the error coordinates of the model."""
    e = np.eye(15)
    down = parameters.gravity_force_base_N / (np.linalg.norm(parameters.gravity_force_base_N) or 1.0)
    return {
        "centre of mass": e[:, 9:12],
        "load": np.column_stack([e[:, 3:6] @ down, e[:, 9:12]]),
        "force": e[:, 6:9],
        "torque": e[:, 12:15],
        "force and torque": e[:, [6, 7, 8, 12, 13, 14]],
        "mounting": e[:, 0:3],
    }
