"""Poses that belong to no rigid tool at rest: bumped, touched, or taken while something slipped.

Graduated non-convexity with the Geman-McClure cost (Yang, Antonante, Tzoumas, Carlone 2020), from every minimum of the
plain cost, then a plain fit of the poses that remain. The basin with the lowest truncated cost wins.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri as chi2_isf

from calib.likelihood.sufficient_statistics import Statistics, coefficients
from calib.model import Array, Parameters

Kept = NDArray[np.bool_]
Solver = Callable[[Statistics, Parameters, int], Parameters]
"""Goes down from a start, at most so many steps."""

FALSE_REJECTION = 1e-3
"""Share of good poses that are rejected."""
FARTHEST = float(chi2_isf(6, FALSE_REJECTION))
"""Squared distance, in noise, beyond which a pose is rejected: 22.5."""
FEWEST_TO_REJECT_FROM = 8
"""With fewer poses, one that disagrees with the others and others that disagree with it look alike."""
ANNEALING = 1.6


def fewest_kept(n: int) -> int:
    """Give the number of poses that must agree with each other before the rest may be called wrong."""
    return n if n < FEWEST_TO_REJECT_FROM else max(FEWEST_TO_REJECT_FROM - 1, int(np.ceil(0.6 * n)))


def agreeing_poses(
    phi: Array, wrench: Array, weights: Array, starts: Sequence[Parameters], solver: Solver
) -> tuple[Parameters, Kept] | None:
    """Find the largest set of poses that one calibration explains.

    Parameters
    ----------
    phi : array, shape (n, 10)
        Features of the orientations.
    wrench : array, shape (n, 6)
    weights : array, shape (n, 6, 6)
        Inverse noise covariances.
    starts : sequence of Parameters
    solver : callable

    Returns
    -------
    parameters : Parameters
    kept : bool array, shape (n,)
        Or None when fewer than `fewest_kept` agree, from every start.
    """
    best: tuple[float, Parameters, Kept] | None = None
    for start in starts:
        p = start
        d2 = _squared_distances(phi, wrench, weights, p)
        softness = max(1.0, 2 * float(d2.max()) / FARTHEST)
        while softness > 1:
            soft = softness * FARTHEST
            p = _weighted(phi, wrench, weights, (soft / (d2 + soft)) ** 2, p, solver, 1)
            d2 = _squared_distances(phi, wrench, weights, p)
            softness /= ANNEALING
        kept = d2 < FARTHEST
        for _ in range(10):
            if kept.sum() < fewest_kept(len(kept)):
                break
            p = _weighted(phi, wrench, weights, kept.astype(np.float64), p, solver, 5)
            d2 = _squared_distances(phi, wrench, weights, p)
            before, kept = kept, d2 < FARTHEST
            if (before == kept).all():
                break
        cost = float(np.minimum(d2, FARTHEST).sum())
        if kept.sum() >= fewest_kept(len(kept)) and (best is None or cost < best[0]):
            best = cost, p, kept
    return best and best[1:]


def _squared_distances(phi: Array, wrench: Array, weights: Array, p: Parameters) -> Array:
    e = wrench - phi @ coefficients(p).T
    return np.asarray(((weights @ e[..., None])[..., 0] * e).sum(axis=1))


def _weighted(
    phi: Array, wrench: Array, weights: Array, w: Array, p: Parameters, solver: Solver, steps: int
) -> Parameters:
    return solver(Statistics.of(phi, wrench, w[:, None, None] * weights, coefficients(p)), p, steps)
