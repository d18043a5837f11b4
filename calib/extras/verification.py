"""Stand-in with the interface of the verification."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import chi2 as chi2_distribution

from calib.model import Array


@dataclass(frozen=True, eq=False)
class Verification:
    """Result."""

    residual: Array
    predicted_sigma: Array
    chi2: float
    dof: int
    p_value: float
    passed: bool
    change: str | None
    reason: str
    update: Any

    def to_dict(self) -> dict[str, Any]:
        """Return JSON."""
        return {
            "residual": self.residual.tolist(),
            "predicted_sigma": self.predicted_sigma.tolist(),
            "chi2": self.chi2,
            "dof": self.dof,
            "p_value": self.p_value,
            "passed": self.passed,
            "change": self.change,
            "reason": self.reason,
        }


def verify(
    calibration: Any, R_base_flange: Array, wrench: Array, wrench_cov: Array, *, false_alarms: float = 0.01
) -> Verification:
    """Compare."""
    from calib.extras.update import NotObservable, Update, _gain, _update, update_payload  # type: ignore[attr-defined]
    from calib.model import Parameters, jacobian

    n = len(wrench)
    residual = calibration.compensate(wrench, R_base_flange)
    J = jacobian(calibration.parameters, R_base_flange)
    predicted = np.einsum("nij,jk,nlk->nil", J, calibration.covariance, J)
    sigma = np.sqrt(np.einsum("nii->ni", wrench_cov + predicted))
    noise = block_diag(*wrench_cov)

    def misfit(x: Array, covariance: Array) -> float:
        return float(x.ravel() @ np.linalg.solve(covariance, x.ravel()))

    K = J.reshape(6 * n, 15)
    chi2 = misfit(residual, noise + K @ calibration.covariance @ K.T)
    p = float(chi2_distribution.sf(chi2, 6 * n))
    if p >= false_alarms:
        return Verification(residual, sigma, chi2, 6 * n, p, True, None, "the calibration still holds", None)
    kept = np.eye(15)
    biases = np.r_[6:9, 12:15]
    kept[biases, biases] = 0
    K = K @ kept
    H = np.tile(np.eye(6), (n, 1))
    G = _gain(H, noise + K @ calibration.covariance @ K.T)
    change = G @ residual.ravel()
    old = calibration.parameters
    new = Parameters(
        old.R_flange_sensor,
        old.gravity_force_base_N,
        old.force_bias_N + change[:3],
        old.p_sensor_com_m,
        old.torque_bias_Nm + change[3:],
    )
    estimated = np.zeros((15, 6))
    estimated[biases, np.arange(6)] = 1
    found: Update | None = _update(
        new, calibration.covariance, estimated @ G, kept, K, noise, (residual - change).ravel(), 6 * n - 6
    )
    if found is not None and chi2_distribution.sf(found.chi2, found.dof) >= false_alarms:
        words = f"the bias has changed by {np.linalg.norm(change[:3]):.2f} N"
        return Verification(residual, sigma, chi2, 6 * n, p, False, "bias", words, found)
    try:
        found = update_payload(calibration, R_base_flange, wrench, wrench_cov, retare=n > 2)
    except NotObservable:
        found = None
    if found is not None and chi2_distribution.sf(found.chi2, max(found.dof, 1)) < false_alarms:
        found = None
    words = "the payload has changed" if found else "several quantities have changed"
    return Verification(residual, sigma, chi2, 6 * n, p, False, "payload" if found else "several", words, found)


def choose_verification_poses(candidates: Array, fitted: Array, n: int) -> Any:
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
    return np.array(chosen)
