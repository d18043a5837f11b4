"""Stand-in with the interface of the verification."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.special import chdtrc as chi2_sf

from calib.errors import NotObservable
from calib.extras.update import Update, reestimate
from calib.files import JSON
from calib.model import Array, jacobian
from calib.result import CalibrationResult


@dataclass(frozen=True, slots=True, eq=False)
class Verification:
    """Result of a verification."""

    residual: Array
    predicted_sigma: Array
    chi2: float
    dof: int
    p_value: float
    passed: bool
    change: str | None
    reason: str
    update: Update | None = None

    def to_dict(self) -> dict[str, JSON]:
        """Return the content as JSON."""
        return {
            "passed": self.passed,
            "change": self.change,
            "reason": self.reason,
            "chi2": self.chi2,
            "dof": self.dof,
            "p_value": self.p_value,
        }


def verify(
    calibration: CalibrationResult,
    R_base_flange: Array,
    wrench: Array,
    wrench_cov: Array,
    *,
    false_alarms: float = 0.01,
) -> Verification:
    """Compare."""
    n = len(wrench)
    residual = calibration.compensate(wrench, R_base_flange)
    J = jacobian(calibration.parameters, R_base_flange).reshape(6 * n, 15)
    noise = block_diag(*wrench_cov)
    S = noise + J @ calibration.covariance @ J.T
    chi2 = float(residual.ravel() @ np.linalg.solve(S, residual.ravel()))
    p = float(chi2_sf(6 * n, chi2))
    sigma = np.sqrt(np.diag(S)).reshape(n, 6)
    if p >= false_alarms:
        return Verification(residual, sigma, chi2, 6 * n, p, True, None, "the calibration holds")
    for kind in ("bias", "payload", "bias and payload", "all"):
        try:
            update = reestimate(calibration, R_base_flange, wrench, noise, kind)
        except NotObservable:
            continue
        if update.dof and chi2_sf(update.dof, update.chi2) > 1e-3:
            change = kind if kind in ("bias", "payload") else "several"
            return Verification(residual, sigma, chi2, 6 * n, p, False, change, f"{change} has changed", update)
    return Verification(residual, sigma, chi2, 6 * n, p, False, None, "no change explains the readings")


def choose_verification_poses(candidates: Array, fitted: Array, n: int) -> NDArray[np.intp]:
    """Farthest first."""
    near = np.full(len(candidates), np.inf)
    if len(fitted):
        trace = np.einsum("mij,kij->mk", candidates, fitted).max(axis=1)
        near = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    chosen: list[int] = []
    for _ in range(n):
        best = int(near.argmax())
        chosen.append(best)
        trace = np.einsum("mij,ij->m", candidates, candidates[best])
        near = np.minimum(near, np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    return np.array(chosen, dtype=np.intp)
