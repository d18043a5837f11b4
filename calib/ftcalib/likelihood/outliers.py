"""Poses that belong to no rigid tool at rest: bumped, touched, or taken while something slipped.

Graduated non-convexity with the Geman-McClure cost (Yang, Antonante, Tzoumas, Carlone 2020), from every minimum of the
plain cost, then a plain fit of the poses that remain. The basin with the lowest truncated cost wins.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri as chi2_isf

from ftcalib.likelihood.descent import Descent
from ftcalib.likelihood.sufficient_statistics import Statistics, coefficients, features
from ftcalib.model import Array, Parameters

Kept = NDArray[np.bool_]

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


def agreeing_poses(descent: Descent, weights: Array, starts: Sequence[Parameters]) -> tuple[Parameters, Kept] | None:
    """Find the largest set of poses that one calibration explains.

    Parameters
    ----------
    descent : Descent
        Of these poses.
    weights : array, shape (n, 6, 6)
        Inverse noise covariances.
    starts : sequence of Parameters

    Returns
    -------
    parameters : Parameters
    kept : bool array, shape (n,)
        Or None when fewer than `fewest_kept` agree, from every start.
    """
    phi, wrench = features(descent.R), descent.wrench

    def squared_distances(p: Parameters) -> Array:
        e = wrench - phi @ coefficients(p).T
        return np.asarray(((weights @ e[..., None])[..., 0] * e).sum(axis=1))

    def down(w: Array, p: Parameters, steps: int) -> Parameters:
        statistics = Statistics.of(phi, wrench, w[:, None, None] * weights, coefficients(p))
        return descent.down(statistics, p, steps).parameters

    best: tuple[float, Parameters, Kept] | None = None
    for start in starts:
        p = start
        d2 = squared_distances(p)
        softness = max(1.0, 2 * float(d2.max()) / FARTHEST)
        while softness > 1:
            soft = softness * FARTHEST
            p = down((soft / (d2 + soft)) ** 2, p, 1)
            d2 = squared_distances(p)
            softness /= ANNEALING
        kept = d2 < FARTHEST
        for _ in range(10):
            if kept.sum() < fewest_kept(len(kept)):
                break
            p = down(kept.astype(np.float64), p, 5)
            d2 = squared_distances(p)
            before, kept = kept, d2 < FARTHEST
            if (before == kept).all():
                break
        cost = float(np.minimum(d2, FARTHEST).sum())
        if kept.sum() >= fewest_kept(len(kept)) and (best is None or cost < best[0]):
            best = cost, p, kept
    return best and best[1:]
