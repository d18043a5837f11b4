"""Datasets drawn with a result as the truth, and solved: what a worker does for `ftdrive.fleet.accuracy`."""

import json

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult
from ftcalib.data.pooling import pooled_covariance
from ftcalib.errors import BadCalibration, NotObservable
from ftcalib.likelihood.gain_and_cross_talk import response_columns
from ftcalib.likelihood.session import LEVER_M
from ftcalib.likelihood.session_noise import centred, pose_times, steps
from ftcalib.likelihood.variance_components import FORCE, TORQUE, Kind, component
from ftcalib.model import Array, predict
from ftdrive.fleet.resolve import solver
from ftdrive.store.records import mass_sigma_kg

DRAW = np.dtype([("outcome", "i1"), ("error", "f8", 16), ("sigma", "f8", 16), ("chi2", "f8")])
"""What became of a draw: estimate minus truth, the sigma that the draw itself states, and its normalised square."""
ACCEPTED, REJECTED, NOT_OBSERVABLE = range(3)

_KINDS: tuple[Kind, ...] = ("white", "walk", "slope")
_CHANNELS = {
    component(kind, channels).name: (kind, channels)
    for kind in _KINDS
    for channels in (FORCE, TORQUE, *(range(k, k + 1) for k in range(6)))
}
"""Components of single channels by their name."""
_OF_POSES = {"rotation_rad", "gain", "cross_talk"}


def drawn(dataset: CalibrationDataset, result: CalibrationResult, rng: np.random.Generator) -> CalibrationDataset:
    """Draw a dataset with the result as the truth.

    Drawn are the measured noise and every component that the result states. Poses, times and measured covariances
    stay. Rejected poses are left out, because the result does not state what disturbed them.
    """
    n, found = len(dataset), result.components
    used = np.ones(n, bool) if result.weights is None else result.weights > 0
    cov, variance = _noise(dataset, result)
    gain, cross_talk = (
        found.get(name, 0.0) * rng.standard_normal(size) for name, size in (("gain", 5), ("cross_talk", 6))
    )
    turn_rad = found.get("rotation_rad", 0.0) * rng.standard_normal((n, 3))
    white, walk = rng.standard_normal((n, 6, 1)), np.sqrt(variance["walk"]) * rng.standard_normal((n, 6))
    slope = np.sqrt(variance["slope"]) * rng.standard_normal(6)

    R, p = dataset.R_base_flange @ Rotation.from_rotvec(turn_rad).as_matrix(), result.parameters
    wrench = predict(p, R) + response_columns(p, R) @ np.append(gain, cross_talk)
    wrench += (np.linalg.cholesky(cov) @ white)[..., 0]
    time = pose_times(dataset.t_s)
    order = np.flatnonzero(used)[np.argsort(time[used], kind="stable")]
    bias = centred(time)[:, None] * slope
    bias[order] += np.cumsum(np.sqrt(steps(time[order]))[:, None] * walk[order], axis=0)
    wrench += bias - bias[used].mean(axis=0)  # the bias of a calibration is the mean over its poses
    return CalibrationDataset(
        dataset.R_base_flange[used],
        wrench[used],
        None if dataset.wrench_cov is None else dataset.wrench_cov[used],
        dataset.n_samples[used],
        dataset.t_s[used],
    )


def _noise(dataset: CalibrationDataset, result: CalibrationResult) -> tuple[Array, dict[Kind, Array]]:
    """Return the covariance (n, 6, 6) of the white noise of each pose, and the variances (6,) of walk and slope."""
    found, variance = result.components, {kind: np.zeros(6) for kind in _KINDS}
    if unknown := found.keys() - _CHANNELS.keys() - _OF_POSES:
        raise BadCalibration(f"the calibration has the component {min(unknown)}, which this version does not know")
    for name in found.keys() - _OF_POSES:
        kind, channels = _CHANNELS[name]
        variance[kind][channels] = found[name] ** 2
    white = variance["white"]
    if dataset.wrench_cov is not None:
        return pooled_covariance(dataset.wrench_cov, dataset.n_samples) + np.diag(white), variance
    if "white_torque_Nm" not in found:  # from few poses one sigma was estimated for both
        white[3:] = LEVER_M**2 * white[:3]
    if not white.all():
        raise BadCalibration("the calibration states no noise, because its readings have none: nothing can be drawn")
    return np.broadcast_to(np.diag(white), (len(dataset), 6, 6)), variance


def solved_draws(dataset: bytes, calibration: bytes, task: bytes, seed: int, first: int, count: int) -> bytes:
    """Draw and solve some datasets: a pure function of its arguments and of the installed versions.

    Draw i has its own random numbers, from `seed` and i, so that they do not depend on the grouping.

    Raises
    ------
    OtherVersion
        The task was made by another version.
    NotObservable
    """
    solve_as_the_run = solver(task)
    given = CalibrationDataset.from_dict(json.loads(dataset))
    result = CalibrationResult.from_dict(json.loads(calibration))
    draws = np.zeros(count, DRAW)
    for k in range(count):
        try:
            found = solve_as_the_run(drawn(given, result, np.random.default_rng([seed, first + k])))
        except NotObservable:
            draws["outcome"][k] = NOT_OBSERVABLE
            continue
        draws["outcome"][k] = REJECTED if found.verdict == "rejected" else ACCEPTED
        error = result.parameters.difference(found.parameters)
        draws["error"][k] = *error, found.weight_N / found.g_m_s2 - result.mass_kg
        draws["sigma"][k] = sigma = stated_sigma(found)
        scale = sigma[:15]
        z = error / scale
        draws["chi2"][k] = z @ np.linalg.solve(found.covariance / np.outer(scale, scale), z)
    return draws.tobytes()


def stated_sigma(result: CalibrationResult) -> Array:
    """Return the stated sigmas (16,); that of the mass without a gain common to all axes, which is not drawn."""
    mass_kg = mass_sigma_kg(result.parameters, result.covariance, result.g_m_s2)
    return np.asarray(np.sqrt(np.append(np.diag(result.covariance), mass_kg**2)))
