"""Something that changed for good between two poses: a load that shifted, a sensor that was tared."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.model import Array, Parameters, jacobian

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

    def in_words(self, since: str) -> str:
        """Say what changed from a pose on, and what to do."""
        step, size = self.step, float(np.linalg.norm(self.step))
        tared = "was the sensor tared, or does a cable pull? Check it"
        what = {
            "centre of mass": f"the centre of mass is {1e3 * size:.2g} mm elsewhere: did the load shift? Fix it",
            "load": f"the load weighs {abs(step[0]):.2g} N {'less' if step[0] < 0 else 'more'}: was something lost or "
            "picked up? Check the tool",
            "force": f"the force reads {size:.2g} N otherwise: {tared}",
            "torque": f"the torque reads {size:.2g} N·m otherwise: {tared}",
            "force and torque": f"force and torque read {np.linalg.norm(step[:3]):.2g} N and "
            f"{np.linalg.norm(step[3:]):.2g} N·m otherwise: {tared}",
            "mounting": f"the sensor sits {np.degrees(size):.2g}° otherwise: is a screw loose? Fasten it",
        }[self.what]
        return f"from {since} on {what} and calibrate again"


def lasting_change(
    parameters: Parameters,
    R_base_flange: Array,
    residuals: Array,
    sigma: ArrayLike,
    t_s: Array,
    suspect: Sequence[int] = (),
) -> Change | None:
    """Find what changed for good between two poses, if that explains the residuals far better than anything else.

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
    sigma = np.asarray(sigma, dtype=np.float64)
    y = residuals / sigma
    J = jacobian(parameters, R_base_flange) / sigma[:, None]
    everything = np.ones(n, bool)

    def fit(columns: Array, rows: NDArray[np.bool_] = everything) -> tuple[float, Array]:
        """Mean square misfit per degree of freedom, and the estimates of the added columns."""
        X = np.concatenate([J, columns], axis=2)[rows].reshape(6 * int(rows.sum()), -1)
        scale = np.linalg.norm(X, axis=0)
        scale[scale == 0] = 1.0
        x, *_ = np.linalg.lstsq(X / scale, y[rows].ravel(), rcond=1e-10)
        left = y[rows].ravel() - X / scale @ x
        return float(left @ left) / max(len(X) - X.shape[1], 1), (x / scale)[15:]

    ramp = ((t_s - t_s.mean()) / (np.ptp(t_s) or 1.0))[:, None, None] * (np.eye(6) / sigma[:, None])
    others = [fit(np.zeros((n, 6, 0)))[0], fit(ramp)[0]]
    used = everything.copy()
    used[list(suspect)] = False
    at_one_end = np.count_nonzero(np.diff(used)) == 1 and np.count_nonzero(~used) >= FEWEST_ON_A_SIDE
    if not at_one_end and not used.all() and used.sum() > FEWEST_ON_A_SIDE:
        others.append(fit(np.zeros((n, 6, 0)), used)[0])

    changes = _changes(parameters)
    found = []
    for position in range(FEWEST_ON_A_SIDE, n - FEWEST_ON_A_SIDE + 1):
        after = (np.arange(n) >= position)[:, None, None]
        for what, directions in changes.items():
            misfit, step = fit(J @ directions * after)
            criterion = 6 * n * np.log(misfit) + directions.shape[1] * np.log(6 * n)
            found.append(Change(what, position, step, misfit, float(criterion)))
    best = min(found, key=lambda change: change.criterion)
    return best if max(best.misfit, 1.0) < CLEARLY * min(others) else None


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
