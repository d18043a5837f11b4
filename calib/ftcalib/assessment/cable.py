"""A cable that acts as a spring: how far its torque may have moved mounting, weight and centre of mass.

    torque_Nm = K v,    v = rotation vector of an orientation relative to the one in which the cable is slack

Over orientations within a cone such a torque looks like a shift of the centre of mass, and its rest like white noise.
Where there is such noise, the stiffness K (3, 3) is estimated beside the parameters. These move (the bias of an omitted
variable), and their reported sigma allows for this. Compensation does not need it: the cable pulls in the next use too.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc as f_sf

from ftcalib.likelihood.fit import Fit
from ftcalib.likelihood.session_noise import summed_products
from ftcalib.model import BIASES, Array, jacobian, nearest_rotation, predict

FALSE = 1e-3, 1e-4
"""Probability of a chance finding: slack at the mean orientation, and at the best of about 70."""
FALSE_IN_NOISE = 0.05
"""The same where the torques have more noise than was measured: its cause is unknown, and a cable is a usual one."""
FEWEST, MOST = 8, 1000
"""Poses: fewer leave nothing for a test. More are seldom of a tour."""
STIFFNESS, SLACK = 9, 3
"""Numbers that are estimated."""
STARTS = 24
STEPS_RAD = np.deg2rad([40.0, 20.0, 10.0])
_AROUND = np.array([v for v in product((-1.0, 0.0, 1.0), repeat=3) if np.abs(v).sum() in (1, 3)])
_AROUND /= np.linalg.norm(_AROUND, axis=1, keepdims=True)


@dataclass(frozen=True, slots=True, eq=False)
class Cable:
    """What a cable may do to a calibration."""

    torque_Nm: float
    """Root mean square over the poses."""
    shift: Array
    """(15,) of the estimated parameters, in error coordinates; zero for the biases, which belong to the cell."""


def cable_of(fit: Fit) -> Cable | None:
    """Look for the torque of a spring in what a fit leaves; None if chance explains it."""
    n = len(fit.order)
    dof = fit.dof - STIFFNESS - SLACK
    if not FEWEST <= n <= MOST or dof < 1:
        return None
    R = fit.R_base_flange[fit.order]
    J, r = jacobian(fit.parameters, R), fit.wrench[fit.order] - predict(fit.parameters, R)
    WX = fit.noise.solve(np.concatenate([J, r[..., None]], axis=2))
    WJ, C = WX[..., :15], fit.given_noise
    u = WX[..., 15] - WJ @ (C @ summed_products(J, WX[..., 15:])[:, 0])
    chi2 = float(np.vdot(r, u))

    def best_of(slack: Array) -> tuple[float, Array, Array, Array]:
        """Of orientations (k, 3, 3) with a slack cable: what chi2 falls by, orientation, torques, moved parameters."""
        k = len(slack)
        v = Rotation.from_matrix((np.swapaxes(slack, 1, 2)[:, None] @ R).reshape(-1, 3, 3)).as_rotvec()
        each = np.zeros((n, 6, k, 3, 3))
        for axis in range(3):
            each[:, 3 + axis, :, axis] = v.reshape(k, n, 3).swapaxes(0, 1)
        X = each.reshape(n, 6, 9 * k)
        rows, g = X.reshape(6 * n, k, 9), summed_products(X, u[..., None])[:, 0].reshape(k, 9)
        H = np.einsum("rka,rkb->kab", rows, fit.noise.solve(X).reshape(rows.shape), optimize=True)
        between = summed_products(WJ, X).reshape(15, k, 9).swapaxes(0, 1)
        H -= np.swapaxes(between, 1, 2) @ C @ between
        scale = np.sqrt(np.maximum(np.einsum("kaa->ka", H), 1e-300))
        # Turns about one axis alone leave a part of the stiffness open.
        H = np.asarray(H / scale[:, :, None] / scale[:, None] + 1e-6 * np.eye(9))
        stiffness = np.linalg.solve(H, (g / scale)[..., None])[..., 0] / scale
        gain = np.sum(g * stiffness, axis=1)
        i = int(np.argmax(gain))
        return float(gain[i]), slack[i], rows[:, i] @ stiffness[i], C @ between[i] @ stiffness[i]

    def probability(gain: float, numbers: int) -> float:
        rest = fit.dof - numbers
        return float(f_sf(numbers, rest, gain / numbers / (max(chi2 - gain, 1e-12 * chi2) / rest)))

    best = best_of(nearest_rotation(R.sum(axis=0))[None])
    sure = probability(best[0], STIFFNESS) < FALSE[0]
    measured = bool(np.isfinite(fit.measured_chi2))
    noisy = measured and any(name.startswith("white_t") for name in fit.components)
    if not sure and (noisy or not measured):
        best = max(best, best_of(R[:: max(1, n // STARTS)]), key=lambda found: found[0])
        for angle_rad in STEPS_RAD:
            near = best[1] @ Rotation.from_rotvec(angle_rad * _AROUND).as_matrix()
            best = max(best, best_of(near), key=lambda found: found[0])
        sure = probability(best[0], STIFFNESS + SLACK) < (FALSE_IN_NOISE if noisy else FALSE[1])
    if not sure:
        return None
    shift = best[3].copy()
    shift[BIASES] = 0.0
    return Cable(float(np.sqrt(np.sum(best[2] ** 2) / n)), shift)
