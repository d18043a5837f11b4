"""How far readings of an unchanged cell may be from their prediction if the sensor has hysteresis.

Each channel is then off by a share of the last change of its load, one share for each channel. The model is the one of
`ftcalib.extras.expected_readings`: the residuals of the fit give each standard deviation of these shares its restricted
likelihood, and the probability of the new readings is averaged over them. A fit without hysteresis takes a part of it
for weight, because the load changes most towards the poses that load a channel most. That part is in the covariance of
the calibration, and what it predicts for the new poses is in their noise.
"""

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from ftcalib.data.dataset import CalibrationDataset
from ftcalib.data.pooling import pooled_covariance
from ftcalib.extras.expected_readings import LEAST_FACTOR, MANY_POSES, Expected
from ftcalib.extras.update import Update
from ftcalib.likelihood.descent import column_scale
from ftcalib.likelihood.gain_and_cross_talk import SIZE, Response, response_columns
from ftcalib.likelihood.session_noise import pose_times
from ftcalib.model import Array, Parameters, jacobian, predict
from ftcalib.result import CalibrationResult

USUAL_SHARES = np.geomspace(1e-4, 5e-3, 9)
"""Of the last change of load, over which the average is taken. Before the fit, each is as likely as any other."""


def expected_with_hysteresis(
    calibration: CalibrationResult, fitted: CalibrationDataset, R_base_flange: Array, wrench_cov: Array
) -> list[Expected]:
    """Explain the fit by scaled measured noise and hysteresis, for each size of it; weights sum to 1.

    Drift is not part of it. Gain and cross-talk have the variance that the fit found. Empty where the residuals of the
    fit cannot show it, as in `ftcalib.extras.expected_readings.expected_with_inexact_orientations`.

    Parameters
    ----------
    calibration : CalibrationResult
    fitted : CalibrationDataset
        Poses of the fit, with measured noise.
    R_base_flange : array, shape (n, 3, 3)
        New poses, in the order of measuring.
    wrench_cov : array, shape (n, 6, 6)
        Of the new readings.
    """
    p, response = calibration.parameters, calibration.response
    kept = np.ones(len(fitted), bool) if calibration.weights is None else calibration.weights > 0
    dof = 6 * int(kept.sum()) - 15
    if fitted.wrench_cov is None or calibration.method != "ml" or calibration.dof != dof or len(kept) > MANY_POSES:
        return []
    order = np.argsort(pose_times(fitted.t_s), kind="stable")
    R, D, kept = fitted.R_base_flange[order], pooled_covariance(fitted.wrench_cov, fitted.n_samples)[order], kept[order]
    swing, first = _swings(p, R)
    new_swing, _ = _swings(p, R_base_flange)
    e = fitted.wrench[order] - predict(p, R)
    J = np.concatenate([jacobian(p, R), response_columns(p, R), swing[..., None] * np.eye(6)], axis=2)[kept]
    size = np.zeros(15 + SIZE)
    size[:15] = np.inf
    if response is not None:
        size[15:] = np.repeat([calibration.components.get(name, 0.0) for name in ("gain", "cross_talk")], [5, 6])
    coefficients = np.zeros(15 + SIZE) if response is None else np.append(np.zeros(15), response.coefficients)
    found, likelihood = [], []
    for share in USUAL_SHARES:
        V = D.copy()
        V[0] += share**2 * np.diag(first**2)
        V, sigma = V[kept], np.append(size, np.full(6, share))
        seen = np.flatnonzero(sigma)
        W = np.linalg.inv(V)
        WJ = W @ J[..., seen]
        H = np.einsum("nij,nik->jk", J[..., seen], WJ) + np.diag(sigma[seen] ** -2.0)
        g = np.einsum("nij,ni->j", WJ, e[kept])
        scale = np.outer(column_scale(H), column_scale(H))
        C, x = np.zeros((len(sigma), len(sigma))), np.zeros(len(sigma))
        C[np.ix_(seen, seen)] = np.linalg.inv(H / scale) / scale
        x[seen] = C[np.ix_(seen, seen)] @ g
        rest = float(np.einsum("ni,nij,nj->", e[kept], W, e[kept]) - g @ x[seen])
        logdet = float(np.linalg.slogdet(V)[1].sum() + np.linalg.slogdet(H)[1] + 12 * np.log(share))
        likelihood.append(-0.5 * (logdet + dof * np.log(rest)))
        factor = max(rest / dof, LEAST_FACTOR)
        # The calibration as stored is off by what the hysteresis moves its estimates.
        moved = x[: 15 + SIZE] - coefficients
        known = C[: 15 + SIZE, : 15 + SIZE] + np.outer(moved, moved) / factor
        shares = C[15 + SIZE :, 15 + SIZE :] + np.outer(x[15 + SIZE :], x[15 + SIZE :]) / factor
        noise = np.asarray(block_diag(*wrench_cov))
        along = (new_swing[..., None] * np.eye(6)).reshape(-1, 6)
        noise += along @ shares @ along.T
        noise[:6, :6] += np.diag(first**2 * np.diag(shares))
        joint = None if response is None else Response(response.coefficients, known)
        found.append(Expected(Update(p, known[:15, :15], 0.0, 0, response=joint), noise, dof, factor))
    weights = np.exp(np.array(likelihood) - max(likelihood))
    return [replace(one, weight=weight) for one, weight in zip(found, weights / weights.sum(), strict=True)]


def _swings(p: Parameters, R_base_flange: Array) -> tuple[Array, Array]:
    """Change (n, 6) of the load since the pose before, 0 for the first; and its size (6,) where it is unknown."""
    load = predict(p, R_base_flange)
    swing = np.diff(load, axis=0, prepend=load[:1])
    return swing, np.sqrt(np.mean(swing[1:] ** 2, axis=0))
