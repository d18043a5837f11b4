"""The verdict on a fit, with reasons: how well it predicts, whether it is plausible, and which signs look reversed."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc as chi2_sf
from scipy.special import chdtri as chi2_isf
from scipy.special import ndtr as normal_cdf

from ftcalib.assessment.cross_validation import AssessedFit, standardized
from ftcalib.assessment.faults import COLLAPSE, broken_channels, constant_weight, faults, other_poses, units
from ftcalib.assessment.load_shift import lasting_change
from ftcalib.assessment.observability import ACCEPTED_DELTA_CHI2, RECOMMENDED_POSES, wrong_basin_probability
from ftcalib.likelihood.fit import DriftEstimate
from ftcalib.likelihood.gain_and_cross_talk import Response, predicted_covariance
from ftcalib.model import PARAMETER_NAMES, UP_IN_BASE, Array, Parameters
from ftcalib.published.yu import SPECIAL_R_flange_base

Verdict = Literal["good", "usable", "rejected"]

SIGNIFICANT_SIGMAS = 5.0
FARTHEST_COM_M = 0.5
NEAREST_COM_M = 5e-4
LIGHTEST_N, HEAVIEST_N = 0.05, 2000.0
"""Weights beyond these look like forces in another unit: 5 g, and far more than any UR arm carries."""
NOISE_FACTOR = 3.0
USABLE_SHARE, REJECTED_SHARE = 0.02, 0.10
SENSELESS_SHARE = 0.5
"""If residuals reach half the weight, neither gravity nor centre of mass mean anything."""
NOISY_SHARE = 0.01
"""Largest error of a good result whose residuals exceed the measured noise."""
USUAL_LEVER_M = 0.1
"""Torque errors are compared with the weight at this lever, or at the centre of mass if that is farther."""
NOTED_TILT_DEG, REVERSED_TILT_DEG = 10.0, 135.0
INSIDE_M = 0.01
"""A centre of mass may lie this far on the robot's side of the sensor origin, because adapter plates do."""
NOISELESS = 1e-6
"""Below this chi2 per degree of freedom the data are simulated without noise, and equal readings are no copies."""
CORRELATED = 0.9
FEW_LEFT_OUT = 0.1
ENOUGH_FOR_FAULTS, SUCCESSIVE = 2000, 100
"""Poses that show a fault as clearly as all of them, in runs long enough to show a wrong pairing."""
SURE = 1e-3
"""Probability of a false reason."""


@dataclass(frozen=True, slots=True, eq=False)
class Quality:
    """The judgement on a fit."""

    verdict: Verdict
    reasons: tuple[str, ...]
    """Reasons for a verdict below good, most important first, then notes."""
    chi2_p: float | None
    """Probability of a larger chi2 if there is only the measured noise; None if the noise was not measured."""
    noise_factor: float | None
    """Residuals over measured noise; None if the noise was not measured."""
    loo_force_rms_N: float
    """Cross-validated: root mean square error of predicting each used pose from all others."""
    loo_torque_rms_Nm: float
    worst_pose: int
    """Row of the used pose with the largest cross-validated residual."""
    residual_sigma: Array
    """(n,) cross-validated residual of each pose in sigma, root mean square over the channels: 1 expected."""
    lag1: float
    """Correlation of the residuals of successive used poses; near 0 without drift."""
    correlations: tuple[tuple[str, str, float], ...]
    """Pairs of parameters that are correlated by more than 0.9, strongest first."""


def judge(
    fit: AssessedFit,
    *,
    t_s: Array | None = None,
    measured_sigma: Array | None = None,
    up_in_base: ArrayLike = UP_IN_BASE,
    unconstrained: AssessedFit | None = None,
    contradicted: Sequence[str] = (),
    other_unit: Sequence[str] = (),
) -> Quality:
    """Judge a fit.

    Errors count relative to the weight, torques at a lever: the residual, the cross-validated error, which few poses
    cannot make look small, and the error expected over all orientations. Residuals up to three times the measured noise
    are good if the errors stay below 1 %, because orientations and cables always add to the noise of a good sensor.

    Parameters
    ----------
    fit : AssessedFit
    t_s : array, shape (n,), optional
        When each pose was measured; the order of rows counts if it is missing or not finite.
    measured_sigma : array, shape (6,), optional
        Measured noise of a pose. With it, a load that shifted during the tour is detected.
    up_in_base : array_like, shape (3,)
        Expected up direction in base: +z for a robot on a table.
    unconstrained : AssessedFit, optional
        The best fit to the same poses without known values, if `fit` used some.
    contradicted : sequence of str
        That the unconstrained fit contradicts known values, from `ftcalib.assessment.contradictions`.
    other_unit : sequence of str
        That the controller's payload agrees with forces in another unit, from the same module.
    """
    at = _statistics(fit, t_s)
    parameters, weight_N, n = fit.parameters, at.weight_N, int(at.used.sum())
    few_rejected = n >= (1 - FEW_LEFT_OUT) * len(at.used)
    inexact = [words for words, share in at.shares if share > USABLE_SHARE]
    suspect = inexact or not few_rejected or "cross_talk" in fit.components  # which hides axes that almost agree
    explanation = _faults(fit, at.used, t_s, up_in_base) if suspect else []
    plausible = not explanation and at.largest_share < SENSELESS_SHARE
    com_too_far = _com_too_far(parameters)
    noise, left_out = _noise_reasons(fit, at), _left_out_reasons(at.used)
    noise_is_minor = (at.noise_factor or 0) <= NOISE_FACTOR and at.largest_share <= NOISY_SHARE
    changed = _change_reasons(fit, at, measured_sigma, t_s)
    drifted = _drift_reasons(fit.drift)

    broken = broken_channels(fit.wrench, fit.R_base_flange) if fit.chi2 > NOISELESS * fit.dof else []

    rejected = [
        *broken,
        *explanation,
        *_weight_reasons(fit, weight_N, up_in_base),
        *_second_solution_reasons(fit),
        *(_force_unit(parameters) if weight_N > HEAVIEST_N else []),
        *com_too_far,
        *(inexact if at.largest_share > REJECTED_SHARE else []),
        *changed,
    ]
    usable = [
        *(_force_unit(parameters) if weight_N < LIGHTEST_N else []),
        *([] if com_too_far else _com_too_near(parameters)),
        *(inexact if at.largest_share <= REJECTED_SHARE else []),
        *([] if contradicted or at.largest_share <= NOISY_SHARE else _contradiction_reasons(fit, unconstrained)),
        *(reversed_signs(parameters, fit.covariance, up_in_base) if plausible else []),
        *([] if noise_is_minor else noise),
        *([] if few_rejected else left_out),
        *([] if n >= RECOMMENDED_POSES else [f"there are only {n} poses: take {RECOMMENDED_POSES} or more"]),
        *_unchecked_pose_reasons(fit, at.used, weight_N),
    ]
    notes = [
        *(noise if noise_is_minor else []),
        *(left_out if few_rejected else []),
        *([f"{fit.response.in_words()}: the calibration corrects this for its own weight"] if fit.response else []),
        *_pose_notes(at),
        *(_tilt_notes(parameters, up_in_base) if plausible else []),
        *([] if at.chi2_p is not None else ["the noise was estimated from the residuals: chi2 does not test the fit"]),
    ]
    drift_matters = fit.drift is not None and _drift_share(fit.drift.change, weight_N) > USABLE_SHARE
    if drift_matters and not (broken or explanation or changed):
        (rejected or usable)[:0] = drifted  # before its consequences
    else:
        notes += drifted
    if other_unit and plausible and not broken:
        (rejected or usable)[:0] = other_unit  # before its consequences
    if not (broken or explanation or at.fits_measured_noise):
        (rejected or usable or notes)[:0] = contradicted  # before its consequences
    return Quality(
        verdict="rejected" if rejected else "usable" if usable else "good",
        reasons=(*rejected, *usable, *notes),
        chi2_p=at.chi2_p,
        noise_factor=at.noise_factor,
        loo_force_rms_N=at.loo_force_rms_N,
        loo_torque_rms_Nm=at.loo_torque_rms_Nm,
        worst_pose=at.worst_pose,
        residual_sigma=at.residual_sigma,
        lag1=at.lag1,
        correlations=strong_correlations(fit.covariance),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Statistics:
    """The numbers that the reasons rest on; those with the names of `Quality` have its meaning."""

    used: NDArray[np.bool_]
    weight_N: float
    residual_sigma: Array
    worst_pose: int
    lag1: float
    lag1_p: float
    """Probability of a larger correlation by chance."""
    shares: list[tuple[str, float]]
    """Errors relative to the weight, each with its sentence, largest first."""
    loo_force_rms_N: float
    loo_torque_rms_Nm: float
    noise_factor: float | None
    chi2_p: float | None

    @property
    def largest_share(self) -> float:
        return self.shares[0][1]

    @property
    def fits_measured_noise(self) -> bool:
        return self.chi2_p is not None and self.chi2_p >= SURE


def _statistics(fit: AssessedFit, t_s: Array | None) -> _Statistics:
    used = fit.weights > 0.5
    weight_N = float(np.linalg.norm(fit.parameters.gravity_force_base_N))
    residuals = standardized(fit.left_out_residuals, fit.left_out_cov)
    residual_sigma = np.sqrt(np.mean(residuals**2, axis=1))
    shares, left_out_rms = _shares(fit, used, weight_N)
    measured = bool(np.isfinite(fit.measured_chi2))
    return _Statistics(
        used,
        weight_N,
        residual_sigma,
        int(np.argmax(np.where(used, residual_sigma, -1.0))),
        *successive_correlation(residuals[used], None if t_s is None else t_s[used]),
        shares,
        *left_out_rms,
        noise_factor=float(np.sqrt(fit.measured_chi2 / fit.dof)) if measured else None,
        chi2_p=float(chi2_sf(fit.dof, fit.measured_chi2)) if measured else None,
    )


def _faults(fit: AssessedFit, used: NDArray[np.bool_], t_s: Array | None, up_in_base: ArrayLike) -> list[str]:
    """Look for faults in all poses, or of many in evenly spread runs, and if there are none, in the used poses.

    A wrong pose or two were rejected; only the used poses show whether most of them are wrong.
    """
    n = len(used)
    order = np.arange(n) if t_s is None or not np.isfinite(t_s).all() else np.argsort(t_s, kind="stable")
    order = order[np.arange(n) // SUCCESSIVE % max(n // ENOUGH_FOR_FAULTS, 1) == 0]
    found = faults(fit.R_base_flange[order], fit.wrench[order], up_in_base)
    order = order[used[order]]
    if not found and not used.all():
        found = faults(fit.R_base_flange[order], fit.wrench[order], up_in_base)
    return found or other_poses(fit.R_base_flange[order], fit.wrench[order])


def successive_correlation(standardized: Array, t_s: Array | None = None) -> tuple[float, float]:
    """Correlation of the residuals of successive poses, and the probability of a larger one by chance.

    Parameters
    ----------
    standardized : array, shape (n, 6)
        Residuals with unit variance.
    t_s : array, shape (n,), optional
        Order of the poses; rows in order if missing or not finite.
    """
    if t_s is not None and np.isfinite(t_s).all():
        standardized = standardized[np.argsort(t_s, kind="stable")]
    products = np.einsum("ni,ni->n", standardized[:-1], standardized[1:])
    correlation = float(products.mean() / (np.mean(standardized**2) * 6 or 1.0))
    return correlation, float(normal_cdf(-correlation * np.sqrt(6 * len(products))))


def strong_correlations(covariance: Array, least: float = CORRELATED) -> tuple[tuple[str, str, float], ...]:
    """Name the pairs of parameters whose estimates are correlated by more than `least`, strongest first."""
    sigma = np.sqrt(np.diag(covariance))
    sigma[sigma == 0] = 1.0  # exactly known
    correlation = covariance / np.outer(sigma, sigma)
    pairs = [(float(correlation[i, j]), i, j) for i, j in combinations(range(len(sigma)), 2)]
    strong = sorted((pair for pair in pairs if abs(pair[0]) > least), key=lambda pair: -abs(pair[0]))
    return tuple((PARAMETER_NAMES[i], PARAMETER_NAMES[j], value) for value, i, j in strong)


def expected_error(parameters: Parameters, covariance: Array, response: Response | None = None) -> tuple[float, float]:
    """Root mean square error of the predicted wrench over all orientations, N and N·m.

    It is of second degree in the orientation, so its mean over the rotations of the cube is the mean over all.
    """
    over = predicted_covariance(parameters, covariance, response, np.swapaxes(SPECIAL_R_flange_base, 1, 2))
    variance = np.diagonal(over, axis1=1, axis2=2).mean(axis=0)
    return float(np.sqrt(variance[:3].sum())), float(np.sqrt(variance[3:].sum()))


def reversed_signs(parameters: Parameters, covariance: Array, up_in_base: ArrayLike = UP_IN_BASE) -> list[str]:
    """Explain a weight that pulls upwards, and a centre of mass on the robot's side of the sensor."""
    angle_deg, inside_m = _tilt_deg(parameters, up_in_base), _inside_m(parameters, covariance)
    if angle_deg < REVERSED_TILT_DEG:
        if not 0 < inside_m <= FARTHEST_COM_M:
            return []
        return [
            f"the centre of mass lies {1e3 * inside_m:.0f} mm on the robot's side of the sensor: the torques are "
            "reversed, unless the tool reaches back that far"
        ]
    if inside_m:
        return [
            f"the weight pulls upwards ({angle_deg:.0f}° from down) and the centre of mass lies on the robot's side of "
            "the sensor: the forces are reversed and the torques are not, or the orientations are mirrored "
            "(left-handed axes)"
        ]
    return [
        f"the weight pulls upwards ({angle_deg:.0f}° from down): the sensor reports the reaction (set sign = -1), or "
        "one axis is reversed or two are swapped in forces and torques alike, or the robot hangs from the ceiling"
    ]


def _tilt_notes(parameters: Parameters, up_in_base: ArrayLike) -> list[str]:
    angle_deg = _tilt_deg(parameters, up_in_base)
    if not NOTED_TILT_DEG < angle_deg < REVERSED_TILT_DEG:
        return []
    x, y, z = parameters.gravity_force_base_N / np.linalg.norm(parameters.gravity_force_base_N)
    return [
        f"gravity is {angle_deg:.0f}° off, along ({x:.2f}, {y:.2f}, {z:.2f}) in base: right for a robot on a "
        "wall or a slope, otherwise check the base frame and the orientations"
    ]


def _drift_share(change: Array, weight_N: float) -> float:
    """Drift of the force relative to the weight, or of the torque to the weight at the usual lever."""
    return _drift_size_N(change) / weight_N if weight_N else float("inf")


def _drift_size_N(change: Array) -> float:
    return float(max(np.linalg.norm(change[:3]), np.linalg.norm(change[3:]) / USUAL_LEVER_M))


def _drift_reasons(drift: DriftEstimate | None) -> list[str]:
    if drift is None:
        return []
    rounding = 1e-9 * _drift_size_N(drift.change)  # of a group without drift, whose sigma is as small
    found = [
        f"{np.linalg.norm(drift.change[part]):.2g} {unit}"
        for unit, part in (("N", slice(0, 3)), ("N·m", slice(3, 6)))
        if (np.abs(drift.change[part]) > np.maximum(3 * drift.sigma[part], rounding)).any()
    ]
    return [
        f"the bias drifted by {' and '.join(found)} from the first pose to the last: let the sensor warm up and "
        "calibrate again"
    ] * bool(found)


def _tilt_deg(parameters: Parameters, up_in_base: ArrayLike) -> float:
    """Angle between the weight and the expected down direction."""
    up, F_b = np.asarray(up_in_base, dtype=np.float64), parameters.gravity_force_base_N
    cosine = -float(F_b @ up) / float(np.linalg.norm(F_b) * np.linalg.norm(up) or 1.0)
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))))


def _inside_m(parameters: Parameters, covariance: Array) -> float:
    """Distance of the centre of mass behind the sensor, towards the robot; 0 if it is not significant."""
    outwards = parameters.R_flange_sensor[2]  # flange z in the sensor frame
    inside_m = -float(outwards @ parameters.p_sensor_com_m)
    sigma_m = float(np.sqrt(outwards @ covariance[9:12, 9:12] @ outwards))
    return inside_m if inside_m > max(INSIDE_M, 3 * sigma_m) else 0.0


def _weight_reasons(fit: AssessedFit, weight_N: float, up_in_base: ArrayLike) -> list[str]:
    along = fit.parameters.gravity_force_base_N / (weight_N or 1.0)
    variance = float(along @ fit.covariance[3:6, 3:6] @ along)
    sigma_N = np.sqrt(max(variance, 0.0))  # below 0 only by rounding, if the weight is exactly known
    if weight_N > SIGNIFICANT_SIGMAS * sigma_N:
        return []
    if given_in_base := constant_weight(fit.wrench, up_in_base):
        return given_in_base
    return [
        f"the weight, {weight_N:.3g} N, is not {SIGNIFICANT_SIGMAS:g} times its uncertainty of {sigma_N:.2g} N: "
        "hang something heavier on the sensor, or record longer and in more orientations"
    ]


def _second_solution_reasons(fit: AssessedFit) -> list[str]:
    if fit.second_basin_chi2 is None:
        return []
    delta = fit.second_basin_chi2 / max(1.0, fit.chi2 / fit.dof)
    if delta >= ACCEPTED_DELTA_CHI2:
        return []
    odds = 100 * wrong_basin_probability(max(delta, 0.0))
    return [
        f"a very different mounting of the sensor explains the data almost as well (probability {odds:.2g} %): "
        "add poses with another angle between the tool and the vertical"
    ]


def out_of_line(residual_sigma: Array, used: NDArray[np.bool_]) -> list[int]:
    """Rows of poses that were rejected, or that the others predict badly."""
    typical = max(float(np.median(residual_sigma[used] ** 2)), 1.0)
    limit = chi2_isf(6, SURE / len(residual_sigma)) / 6 * typical
    return np.flatnonzero(~used | (residual_sigma**2 > limit)).tolist()


def _change_reasons(fit: AssessedFit, at: _Statistics, measured_sigma: Array | None, t_s: Array | None) -> list[str]:
    """Report poses of two different loads, which no white noise explains: all poses after the change deviate alike.

    If all poses before the change were rejected, the others describe the present load, and nothing is reported.
    """
    if measured_sigma is None or at.chi2_p is None or (at.fits_measured_noise and at.used.all()):
        return []
    n = len(fit.wrench)
    times = np.arange(n, dtype=np.float64) if t_s is None or not np.isfinite(t_s).all() else t_s
    order = np.argsort(times, kind="stable")
    change = lasting_change(
        fit.parameters,
        fit.R_base_flange[order],
        fit.residuals[order],
        measured_sigma,
        times[order],
        np.flatnonzero(np.isin(order, out_of_line(at.residual_sigma, at.used))).tolist(),
    )
    if change is None or not change.of_the_tool or not at.used[order[: change.position]].any():
        return []
    return [f"the poses do not belong to one tool: {change.in_words(f'pose {order[change.position] + 1}')}"]


def _left_out_reasons(used: NDArray[np.bool_]) -> list[str]:
    if used.all():
        return []
    listed = ", ".join(str(k + 1) for k in np.flatnonzero(~used))
    return [
        f"{np.count_nonzero(~used)} of {len(used)} poses were rejected because they do not fit the others: "
        f"repeat {listed}"
    ]


def _pose_notes(at: _Statistics) -> list[str]:
    """Name drift from pose to pose, and the pose that deviates most from the others."""
    notes = []
    if at.lag1_p < SURE:
        notes.append(
            f"successive poses have similar residuals (correlation {at.lag1:.2f}): most likely the bias drifted, so "
            "let the sensor warm up and mix the order of the poses"
        )
    n, worst = int(at.used.sum()), float(at.residual_sigma[at.worst_pose])
    typical = float(np.median(at.residual_sigma[at.used] ** 2))
    if n >= RECOMMENDED_POSES and worst**2 > chi2_isf(6, SURE / n) / 6 * max(typical, 1.0):
        notes.append(f"pose {at.worst_pose + 1} deviates from the others by {worst:.1f} sigma: consider repeating it")
    return notes


def _force_unit(parameters: Parameters) -> list[str]:
    """Name the unit of force that makes an implausible weight usual."""
    weight_N, com_m = (float(np.linalg.norm(v)) for v in (parameters.gravity_force_base_N, parameters.p_sensor_com_m))
    unit = "mN" if weight_N > HEAVIEST_N else "kN"
    like = " or ".join(units(com_m, (unit,)) or [f"forces in {unit}"])
    return [f"the weight is {weight_N:.5g} N, as with {like}: check the units of force and torque"]


def _com_too_far(parameters: Parameters) -> list[str]:
    com_m = float(np.linalg.norm(parameters.p_sensor_com_m))
    if com_m <= FARTHEST_COM_M:
        return []
    like = f", as with {', or '.join(found)}" if (found := units(com_m)) else ""
    return [
        f"the centre of mass is {com_m:.2f} m from the sensor, farther than {FARTHEST_COM_M:g} m{like}: "
        "check the units of force and torque"
    ]


def _com_too_near(parameters: Parameters) -> list[str]:
    com_m = float(np.linalg.norm(parameters.p_sensor_com_m))
    if com_m >= NEAREST_COM_M:
        return []
    return [
        f"the centre of mass is only {1e3 * com_m:.2g} mm from the sensor, as if torques were 1000 times too small or "
        "forces were in mN: check the units"
    ]


def _shares(
    fit: AssessedFit, used: NDArray[np.bool_], weight_N: float
) -> tuple[list[tuple[str, float]], tuple[float, float]]:
    """Errors relative to the weight, each with a sentence, largest first, and the cross-validated rms.

    Of residual, cross-validated and expected error the sentence names the first that exceeds the highest limit.
    """
    lever_m = max(USUAL_LEVER_M, float(np.linalg.norm(fit.parameters.p_sensor_com_m)))
    left_out = _rms(fit.left_out_residuals[used, :3]), _rms(fit.left_out_residuals[used, 3:])
    expected = expected_error(fit.parameters, fit.covariance, fit.response)
    kinds = (
        ("force", 0, weight_N, "N", "the weight"),
        ("torque", 1, weight_N * lever_m, "N·m", f"the weight at {lever_m:.2g} m"),
    )
    shares = []
    for kind, k, scale, unit, of in kinds:
        errors = (
            (f"the {kind} residual", _rms(fit.residuals[used, 3 * k : 3 * k + 3])),
            (f"the cross-validated {kind} error", left_out[k]),
            (f"the expected {kind} error over all orientations", expected[k]),
        )
        limits = [sum(error > limit * scale for limit in (USABLE_SHARE, REJECTED_SHARE)) for _, error in errors]
        what, error = errors[int(np.argmax(limits))] if max(limits) else max(errors, key=lambda pair: pair[1])
        share = error / scale if scale else float("inf")
        limit = REJECTED_SHARE if share > REJECTED_SHARE else USABLE_SHARE
        shares.append(
            (f"{what} is {100 * share:.1f} % of {of} ({error:.2g} {unit}), more than {100 * limit:g} %", share)
        )
    return sorted(shares, key=lambda pair: -pair[1]), left_out


def _contradiction_reasons(fit: AssessedFit, unconstrained: AssessedFit | None) -> list[str]:
    if unconstrained is None:
        return []
    used = unconstrained.weights > 0.5
    return [
        f"without known values the {kind}s fit to {best:.2g} {unit} instead of {ours:.2g} {unit} (method ml): "
        "check the known mass and the assumption of a level base"
        for kind, unit, columns in (("force", "N", slice(0, 3)), ("torque", "N·m", slice(3, 6)))
        for ours, best in [(_rms(fit.residuals[used, columns]), _rms(unconstrained.residuals[used, columns]))]
        if best < COLLAPSE * ours
    ][:1]


def _noise_reasons(fit: AssessedFit, at: _Statistics) -> list[str]:
    if at.chi2_p is None or at.fits_measured_noise:
        return []
    found = ", ".join(f"{name} {value:.2g}" for name, value in fit.components.items() if value > 0)
    included = f": found {found}" if found else ", and the stated uncertainties do not include them"
    return [
        f"residuals are {at.noise_factor:.1f} times the measured noise: drift, cables, contact or inexact orientations "
        f"add to it{included}"
    ]


def _unchecked_pose_reasons(fit: AssessedFit, used: NDArray[np.bool_], weight_N: float) -> list[str]:
    uncertain = np.trace(fit.left_out_cov[:, :3, :3], axis1=1, axis2=2) > weight_N**2
    rows = np.flatnonzero(uncertain & used)
    if not 0 < rows.size <= used.sum() / 2:
        return []
    listed = ", ".join(str(k + 1) for k in rows)
    return [f"pose {listed} cannot be checked because the others do not determine all parameters: add similar poses"]


def _rms(vectors: Array) -> float:
    """Root mean square of the lengths of (n, 3) vectors."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))
