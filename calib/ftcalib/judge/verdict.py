"""All findings about a fit, which give its verdict: how well it predicts, and whether it is plausible."""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc as chi2_sf
from scipy.special import chdtri as chi2_isf
from scipy.special import ndtr as normal_cdf

from ftcalib.data.dwell_mean import RESOLUTION
from ftcalib.files import JSON
from ftcalib.findings import Finding, Severity, Verdict, folded, ordered, verdict_of
from ftcalib.judge import described_cell, units
from ftcalib.judge.cross_validation import DriftAhead, Judged, drift_ahead, standardize
from ftcalib.judge.described_cell import contradictions
from ftcalib.judge.faults import COLLAPSE, ROUNDING, broken_channels, constant_weight, faults, other_poses, written_step
from ftcalib.judge.observability import ACCEPTED_DELTA_CHI2, RECOMMENDED_POSES, wrong_basin_probability
from ftcalib.judge.session_change import cable_of, session_change
from ftcalib.known import NOTHING, Known, Setup
from ftcalib.likelihood.session import FEW_POSES_FOR_GAIN, FEW_POSES_FOR_RESPONSE
from ftcalib.likelihood.structure import error_with_other_joints, hidden_in_any_poses
from ftcalib.model import PARAMETER_NAMES, STANDARD_GRAVITY_M_S2, Array, DriftResult
from ftcalib.sensor_matrix import Response, expected_error

SIGNIFICANT_SIGMAS = 5.0
NOISE_FACTOR = 3.0
USABLE_SHARE, REJECTED_SHARE = 0.02, 0.10
# Mean square of the cross-validated residuals, in sigma, up to which a few poses are as their covariance predicts.
_AS_PREDICTED = 4.0
# If residuals reach half the weight, neither gravity nor centre of mass mean anything.
SENSELESS_SHARE = 0.5
# Largest error of a good result whose residuals exceed the measured noise.
NOISY_SHARE = 0.01
# Largest error of a good result that has a structure, of the weight: its sigmas rest on a few numbers.
STRUCTURED_SHARE = 0.002
# The same in motion, and what is named at rest; and what calibrated arms keep.
SMOOTH_SHARE, CALIBRATED_ARM_RAD = 0.0005, 0.001
# Torque errors are compared with the weight at this lever, or at the centre of mass if that is farther.
USUAL_LEVER_M = 0.1
CORRELATED = 0.9
FEW_LEFT_OUT = 0.1
# Torques of another sensor leave more than this share of their change.
UNRELATED = 0.8
# Poses that show a fault as clearly as all of them, in runs long enough to show a wrong pairing.
ENOUGH_FOR_FAULTS, SUCCESSIVE = 2000, 100
# Probability of a false reason.
SURE = 1e-3

_RMS = "force_rms_N", "torque_rms_Nm"


@dataclass(frozen=True, slots=True, eq=False)
class Quality:
    """The judgement on a fit, and the numbers that it rests on."""

    used: NDArray[np.bool_]
    """(n,)"""
    is_exact: bool
    """Whether no sensor resolves the residuals, as in simulated data. Equal readings are no copies then."""
    residual_sigma: Array
    """(n,) cross-validated residual of each pose in sigma, root mean square over the channels: 1 expected."""
    worst_pose: int
    """Row of the used pose with the largest cross-validated residual."""
    lag1: float
    """Correlation of the residuals of successive used poses; near 0 without drift."""
    lag1_p: float
    """Probability of a larger correlation by chance."""
    largest_share: float
    """Largest error relative to the weight."""
    errors: list[Finding]
    """Errors of force and torque that are too large."""
    loo_force_rms_N: float
    """Cross-validated: root mean square error of predicting each used pose from all others."""
    loo_torque_rms_Nm: float
    usual_rms: Array
    """(2,) the same, of all poses if many were rejected: what they had may come again."""
    elsewhere: Array
    """(2,) mean square error in any orientation less that in those of the poses."""
    of_arm: Array
    """(2,) mean square error that the arm's orientation adds with other base joints."""
    expected_rms: Array
    """(2,) from noise alone, over all orientations."""
    ahead: DriftAhead
    """The drift from the last pose to the next use."""
    noise_factor: float | None
    """Residuals over measured noise; None if the noise was not measured."""
    chi2_p: float | None
    """Probability of a larger chi2 if there is only the measured noise; None if the noise was not measured."""
    correlations: tuple[tuple[str, str, float], ...]
    """Pairs of parameters that are correlated by more than 0.9, strongest first."""
    findings: tuple[Finding, ...] = ()
    """The first one to be fixed first; notes come last."""
    cable_shift: Array | None = None
    """(15,) by which a cable may have moved the estimates; None: the readings show none."""

    @property
    def verdict(self) -> Verdict:
        """Verdict of the worst finding."""
        return verdict_of(self.findings)

    @property
    def fits_measured_noise(self) -> bool:
        """Whether the measured noise explains the residuals."""
        return self.chi2_p is not None and self.chi2_p >= SURE

    @property
    def _is_noise(self) -> bool:
        return self.fits_measured_noise and _few_rejected(self.used)

    @property
    def next_use_rms(self) -> Array:
        """(2,) N, N·m: error of compensating a free tool a minute after the last pose.

        It is that of noise alone if this explains the residuals, else the cross-validated one, with the drift until
        then.
        """
        error = self.expected_rms if self._is_noise else self.usual_rms
        return np.asarray(np.sqrt(error**2 + self.ahead.square.reshape(2, 3).sum(axis=1)))

    @property
    def hour_rms(self) -> Array:
        """(2,) N, N·m: an hour after the last pose, as the drift that was found goes on."""
        now, then = (square.reshape(2, 3).sum(axis=1) for square in (self.ahead.square, self.ahead.hour_square))
        return np.asarray(np.sqrt(self.next_use_rms**2 + then - now))

    @property
    def workspace_rms(self) -> Array:
        """(2,) N, N·m: the same in any orientation, with any base joints."""
        more = 0.0 if self._is_noise else np.maximum(self.elsewhere, 0.0)
        return np.asarray(np.sqrt(self.next_use_rms**2 + more + self.of_arm))

    def to_dict(self) -> dict[str, JSON]:
        """Return the statistics that a result keeps as its `quality`."""
        later = {"next_use": self.next_use_rms, "workspace": self.workspace_rms}
        if self.ahead.square.any():  # a tour without drift does not show what an hour brings
            later["hour"] = self.hour_rms
        return {
            "loo_force_rms_N": self.loo_force_rms_N,
            "loo_torque_rms_Nm": self.loo_torque_rms_Nm,
            **{f"{when}_{unit}": float(rms[k]) for when, rms in later.items() for k, unit in enumerate(_RMS)},
            "bias_growth_per_min": self.ahead.growth_per_min.tolist(),
            "worst_pose": self.worst_pose + 1,
            "residual_sigma": self.residual_sigma.tolist(),
            "lag1": self.lag1,
            "correlations": [list(pair) for pair in self.correlations],
        }


def judge(  # noqa: PLR0913 - one for each thing that may be known
    fit: Judged,
    *,
    t_s: Array | None = None,
    measured_sigma: Array | None = None,
    setup: Setup = NOTHING,
    known: Known | None = None,
    unconstrained: Judged | None = None,
    g_m_s2: float = STANDARD_GRAVITY_M_S2,
    single_poses: bool = True,
    written: str = "",
) -> Quality:
    """Judge a fit.

    Errors count relative to the weight, torques at a lever: the residual, the cross-validated error, which few poses
    cannot make look small, and the error expected over all orientations. Residuals up to three times the measured noise
    are good if the errors stay below 1 %, because orientations and cables always add to the noise of a good sensor.

    Parameters
    ----------
    fit : Judged
    t_s : array, shape (n,), optional
        When each pose was measured; the order of rows counts if it is missing or not finite.
    measured_sigma : array, shape (6,), optional
        Measured noise of a pose. With it, a load that shifted during the tour is detected.
    setup : Setup
        The described cell.
    known : Known, optional
        That `fit` used.
    unconstrained : Judged, optional
        The best fit to the same poses without known values, if `fit` used some.
    g_m_s2 : float
    single_poses : bool
        Whether each row is a pose of its own, with findings about single poses; rows of a motion are not.
    written : str
        As what the orientations were written, as of `faults`.
    """
    quality = _statistics(fit, t_s, setup)
    parameters, weight_N = fit.parameters, fit.parameters.weight_N
    # Uneven rounding alone also rejects poses.
    accidents = _few_rejected(quality.used) or bool((np.abs(fit.residuals) <= _finest(fit.wrench)).all())
    suspect = quality.errors or not accidents or "cross_talk" in fit.components  # which hides axes that almost agree
    mistakes = _mistakes(fit, quality.used, t_s, setup, written) if suspect else []
    mistakes = mistakes or _unrelated_torques(fit, quality)
    # Neighbouring rows of a motion differ too little to show a bias that changes with each.
    mistakes = [one for one in mistakes if single_poses or one.code != "zeroed_each_pose"]
    # Simulated readings without noise repeat themselves by right, also in other poses than given.
    finest = _finest(fit.wrench)
    is_simulated = quality.is_exact or any(_leaves_nothing(one, finest) for one in mistakes)
    broken = [] if is_simulated else broken_channels(fit.wrench, fit.R_base_flange)
    # Known values that are wrong would look like a change: the fit without them is searched.
    changed = [] if mistakes else _change(unconstrained or fit, quality, measured_sigma, t_s)
    if suspect and not (mistakes or changed):
        mistakes = _other_poses(fit, quality.used, t_s)
    explained = quality.is_exact or quality.fits_measured_noise or mistakes or changed
    cable = None if fit.fit is None or explained else cable_of(fit.fit)
    contradicted: list[Finding] = []
    if known is not None and unconstrained is not None:
        at_its_best = unconstrained.parameters, unconstrained.covariance
        contradicted = contradictions(known, *at_its_best, g_m_s2, SIGNIFICANT_SIGMAS, setup.up)
    # A contradicted mass has it already.
    by_mass = any(one.code == "known_mass" for one in contradicted)
    unit_N = None if by_mass else described_cell.unit_of_force(unconstrained or fit, known, setup, g_m_s2)
    gain = [] if mistakes or changed else _gain_not_modelled(fit, unconstrained)
    needs_no_misfit = gain or contradicted or quality.largest_share <= NOISY_SHARE

    findings = [
        *broken,
        *mistakes,
        *changed,
        *(replace(one, severity="limit") if gain and one.severity == "reject" else one for one in quality.errors),
        *_weight(fit, weight_N, setup),
        *_second_solution(fit, unconstrained),
        *units.implausible(
            parameters,
            _rms(fit.residuals[quality.used, :3]),
            described=bool(setup.cylinders_m),
            any_bias=setup.sensor_has_arbitrary_zero,
            unit_N=unit_N,
        ),
        *gain,
        *([] if needs_no_misfit else _misfit_of_known_values(fit, unconstrained)),
        *(_noise(fit, quality) if single_poses else []),
        *(_poses(fit, quality, "note" if accidents else "limit", setup) if single_poses else []),
        *_structure(fit, weight_N, in_motion=not single_poses),
        *_drift(fit.drift, quality.ahead, weight_N, is_cause=verdict_of([*broken, *mistakes, *changed]) == "good"),
        *_response(fit.response, weight_N, assumed=len(quality.used) < FEW_POSES_FOR_GAIN),
        *([] if cable is None else [cable[0]]),
    ]
    payload = described_cell.payload(setup.payload_kg, weight_N / g_m_s2, setup.sensor_mass_kg, parameters)
    # Signs and mounting follow from the estimates, which mean nothing beside a mistake or such errors.
    if not mistakes and quality.largest_share < SENSELESS_SHARE:
        hidden = hidden_in_any_poses(parameters, setup.orientation_rad)
        findings += described_cell.directions(parameters, fit.covariance + hidden, setup, written)
        findings += [one for one in payload if one.code == "payload_units" and not broken]
    if verdict_of(findings) != "rejected":  # its contradictions would be consequences
        findings += [one for one in payload if one not in findings]
        findings += described_cell.tool(parameters, fit.covariance, setup, g_m_s2)
    # Data with a mistake, or that fit as they are, say nothing against a known value.
    if not (broken or mistakes or quality.fits_measured_noise):
        harmless = verdict_of(findings) == "good"
        findings += [replace(one, severity="note") if harmless else one for one in contradicted]
    return replace(quality, findings=tuple(folded(ordered(findings))), cable_shift=None if cable is None else cable[1])


def _statistics(fit: Judged, t_s: Array | None, setup: Setup) -> Quality:
    used = fit.weights > 0.5
    weight_N = fit.parameters.weight_N
    residuals = standardize(fit.left_out_residuals, fit.left_out_cov)
    residual_sigma = np.sqrt(np.mean(residuals**2, axis=1))
    # The others predict one of a few poses badly, as the covariance of the prediction says.
    few = used.sum() < RECOMMENDED_POSES and np.mean(residual_sigma[used] ** 2) < _AS_PREDICTED
    largest_share, errors, left_out_rms = _errors(fit, used, weight_N, few=bool(few))
    measured = bool(np.isfinite(fit.measured_chi2))
    return Quality(
        used,
        bool((np.abs(fit.residuals[used]) <= _finest(fit.wrench)).all()),
        residual_sigma,
        int(np.argmax(np.where(used, residual_sigma, -1.0))),
        *successive_correlation(residuals[used], None if t_s is None else t_s[used]),
        largest_share,
        errors,
        *left_out_rms,
        np.array(left_out_rms if _few_rejected(used) else _left_out_rms(fit, np.ones_like(used))),
        fit.elsewhere.reshape(2, 3).sum(axis=1),
        error_with_other_joints(fit.parameters, setup.orientation_rad) ** 2,
        np.array(expected_error(fit.parameters, fit.covariance, fit.response)),
        drift_ahead(fit, t_s),
        noise_factor=float(np.sqrt(fit.measured_chi2 / fit.dof)) if measured else None,
        chi2_p=float(chi2_sf(fit.dof, fit.measured_chi2)) if measured else None,
        correlations=strong_correlations(fit.covariance),
    )


def _few_rejected(used: NDArray[np.bool_]) -> bool:
    """Whether so few poses were rejected that something happened to them alone."""
    return bool(used.sum() >= (1 - FEW_LEFT_OUT) * len(used))


def _finest(wrench: Array) -> Array:
    """(6,) residual that no sensor resolves, or none of readings (n, 6) that were written rounded."""
    largest = np.abs(wrench).max(axis=0).reshape(2, 3).max(axis=1)
    return np.asarray(np.maximum(np.maximum(RESOLUTION, ROUNDING * np.repeat(largest, 3)), written_step(wrench)))


def _leaves_nothing(mistake: Finding, finest: Array) -> bool:
    """Whether the data without a mistake fit without noise, as only simulated ones do."""
    left_N, left_Nm = (mistake.values.get(name, np.inf) for name in ("corrected_N", "corrected_Nm"))
    return bool(left_N <= finest[0] or left_Nm <= finest[3])


def _mistakes(fit: Judged, used: NDArray[np.bool_], t_s: Array | None, setup: Setup, written: str) -> list[Finding]:
    """Look for mistakes in all poses, or of many in evenly spread runs, and if there are none, in the used poses.

    A wrong pose or two were rejected; only the used poses show whether most of them are wrong.
    """
    order = _some_runs(t_s, len(used))
    findings = faults(fit.R_base_flange[order], fit.wrench[order], setup.up, written)
    order = order[used[order]]
    if not findings and not used.all():
        findings = faults(fit.R_base_flange[order], fit.wrench[order], setup.up, written)
    return findings


def _unrelated_torques(fit: Judged, quality: Quality) -> list[Finding]:
    """Recognise torques that do not follow the weight while the forces do: another sensor's, or of one without load."""
    torque_Nm, codes = fit.wrench[quality.used, 3:], {one.code: one.severity for one in quality.errors}
    is_near = float(np.linalg.norm(fit.parameters.p_sensor_com_m)) < units.NEAREST_COM_M
    left = _rms(fit.residuals[quality.used, 3:]) / (_rms(torque_Nm - torque_Nm.mean(axis=0)) or 1.0)
    if left < UNRELATED or "force_error" in codes or not (is_near or codes.get("torque_error") == "reject"):
        return []
    return [Finding.of("torques_unrelated", "limit", left_percent=100 * min(left, 1.0))]


def _other_poses(fit: Judged, used: NDArray[np.bool_], t_s: Array | None) -> list[Finding]:
    order = _some_runs(t_s, len(used))
    kept = order[used[order]]
    named = other_poses(fit.R_base_flange[kept], fit.wrench[kept])
    # Those that fit by chance do not show how far off the poses are.
    if named and not _few_rejected(used):
        named = other_poses(fit.R_base_flange[order], fit.wrench[order]) or named
    return named


def _some_runs(t_s: Array | None, n: int) -> NDArray[np.intp]:
    """Rows by time: all, or of many poses evenly spread runs."""
    order = np.arange(n) if t_s is None or not np.isfinite(t_s).all() else np.argsort(t_s, kind="stable")
    return np.asarray(order[np.arange(n) // SUCCESSIVE % max(n // ENOUGH_FOR_FAULTS, 1) == 0])


def successive_correlation(standardized: Array, t_s: Array | None = None) -> tuple[float, float]:
    """Correlation of standardized residuals (n, 6) of successive poses, and the probability of a larger one by chance.

    The times `t_s` order the poses; rows are in order if they are missing or not finite.
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


def _errors(
    fit: Judged, used: NDArray[np.bool_], weight_N: float, *, few: bool
) -> tuple[float, list[Finding], tuple[float, float]]:
    """Return the largest error relative to the weight, errors that are too large, and the cross-validated rms.

    Of residual, cross-validated and expected error the first is named that exceeds the highest limit. With a `few`
    poses the cross-validated error limits the use of a result, and does not reject it.
    """
    lever_m = max(USUAL_LEVER_M, float(np.linalg.norm(fit.parameters.p_sensor_com_m)))
    expected = expected_error(fit.parameters, fit.covariance, fit.response)
    left_out = _left_out_rms(fit, used)
    largest, findings = 0.0, []
    for k, scale, unit in ((0, weight_N, "N"), (1, weight_N * lever_m, "Nm")):
        errors = (
            ("residuals", _rms(fit.residuals[used, 3 * k : 3 * k + 3])),
            ("cross-validation", left_out[k]),
            ("uncertainty over all orientations", expected[k]),
        )
        # The largest number of limits; of equal ones the first: residual, cross-validated, then expected error.
        limits = [sum(error > limit * scale for limit in (USABLE_SHARE, REJECTED_SHARE)) for _, error in errors]
        source, error = errors[int(np.argmax(limits))] if max(limits) else max(errors, key=lambda pair: pair[1])
        share = error / scale if scale else float("inf")
        largest = max(largest, share)
        if share > USABLE_SHARE:
            rejects = share > REJECTED_SHARE and not (few and source == "cross-validation")
            severity: Severity = "reject" if rejects else "limit"
            limit_percent = 100 * (REJECTED_SHARE if severity == "reject" else USABLE_SHARE)
            values = {f"error_{unit}": error, "share_percent": 100 * share, "limit_percent": limit_percent}
            code = ("force_error", "torque_error")[k]
            findings.append(Finding.of(code, severity, source=source, **values, **({"lever_m": lever_m} if k else {})))
    return largest, findings, left_out


def _weight(fit: Judged, weight_N: float, setup: Setup) -> list[Finding]:
    sigma_N = fit.parameters.weight_sigma_N(fit.covariance)
    if weight_N > SIGNIFICANT_SIGMAS * sigma_N:
        return []
    if given_in_base := constant_weight(fit.wrench, setup.up):
        return given_in_base
    return [Finding.of("weight_insignificant", weight_N=weight_N, sigma_N=sigma_N, least_sigmas=SIGNIFICANT_SIGMAS)]


def _second_solution(fit: Judged, unconstrained: Judged | None = None) -> list[Finding]:
    if fit.second_basin_chi2 is None:
        return []
    # What a published method does not model, such as a gain, makes both of its solutions worse.
    fitted = unconstrained if fit.fit is None and unconstrained is not None else fit
    delta = fit.second_basin_chi2 / max(1.0, fitted.chi2 / fitted.dof)
    if delta >= ACCEPTED_DELTA_CHI2:
        return []
    return [Finding.of("second_solution", probability_percent=100 * wrong_basin_probability(max(delta, 0.0)))]


def _gain_not_modelled(fit: Judged, unconstrained: Judged | None) -> list[Finding]:
    """Name the gain of the sensor if it explains most of the residuals of a method that does not model it."""
    if fit.fit is not None or unconstrained is None or unconstrained.response is None:
        return []
    used = unconstrained.weights > 0.5
    ours, best = (_rms(one.residuals[used, :3]) for one in (fit, unconstrained))
    reads = unconstrained.response.wrench(unconstrained.parameters, fit.R_base_flange[used])[:, :3]
    if best > COLLAPSE * ours or _rms(reads - reads.mean(axis=0)) < ours / 2:
        return []
    gain_percent = 100 * float(np.abs(unconstrained.response.force_gain).max())
    return [Finding.of("gain_not_modelled", gain_percent=gain_percent, residual_N=ours, free_N=best)]


def _misfit_of_known_values(fit: Judged, unconstrained: Judged | None) -> list[Finding]:
    if unconstrained is None:
        return []
    used = unconstrained.weights > 0.5
    return [
        Finding.of(f"known_values_misfit_{kind}", **{f"residual_{unit}": ours, f"free_{unit}": best})
        for kind, unit, columns in (("force", "N", slice(0, 3)), ("torque", "Nm", slice(3, 6)))
        for ours, best in [(_rms(fit.residuals[used, columns]), _rms(unconstrained.residuals[used, columns]))]
        if best < COLLAPSE * ours
    ][:1]


def _noise(fit: Judged, quality: Quality) -> list[Finding]:
    if quality.chi2_p is None or quality.noise_factor is None:
        return [Finding.of("noise_unknown")]
    if quality.fits_measured_noise:
        return []
    minor = quality.noise_factor <= NOISE_FACTOR and quality.largest_share <= NOISY_SHARE
    minor = minor and not (fit.fit is not None and fit.fit.may_bend)
    components = {name: value for name, value in fit.components.items() if value > 0}
    severity: Severity = "note" if minor else "limit"
    return [Finding.of("noise_exceeded", severity, factor=quality.noise_factor, components=components)]


def _left_out_rms(fit: Judged, poses: NDArray[np.bool_]) -> tuple[float, float]:
    """Root mean square error of predicting these poses from the others; over all orientations if they cannot."""
    checked = poses & ~_is_unchecked(fit)
    if not checked.any():
        return expected_error(fit.parameters, fit.covariance, fit.response)
    return _rms(fit.left_out_residuals[checked, :3]), _rms(fit.left_out_residuals[checked, 3:])


def _is_unchecked(fit: Judged) -> NDArray[np.bool_]:
    """(n,) whether the other poses determine too little to predict this one."""
    return np.asarray(np.trace(fit.left_out_cov[:, :3, :3], axis1=1, axis2=2) > fit.parameters.weight_N**2)


def _structure(fit: Judged, weight_N: float, *, in_motion: bool = False) -> list[Finding]:
    """Name errors that are smooth over the poses; large ones limit the result.

    Less limits in motion than at rest, because little noise is left of so many rows.
    """
    sizes, findings = fit.components, list[Finding]()
    lever_m = max(USUAL_LEVER_M, float(np.linalg.norm(fit.parameters.p_sensor_com_m)))
    per_N = np.array([1.0, lever_m]) * weight_N

    def shares(*names: str) -> Array:
        return np.array([sizes.get(name, 0.0) for name in names])

    if in_motion:
        load, pull = (shares(f"{name}_N", f"{name}_Nm") for name in ("load", "cable"))
        load = load / per_N
        # An orientation of the arm may be off by as much as calibrated arms are.
        turn_rad = shares("yielding_rad", "rotation_rad")
        limits = SMOOTH_SHARE, SMOOTH_SHARE, np.array([SMOOTH_SHARE, CALIBRATED_ARM_RAD])
    else:
        load, pull = shares("load_force", "load_torque"), shares("cable_force_N", "cable_torque_Nm")
        turn_rad = shares("kinematics_rad")
        limits = STRUCTURED_SHARE, STRUCTURED_SHARE, np.array([STRUCTURED_SHARE])
    for code, share, limit, values in (
        ("response_not_linear", load, limits[0], {"share_percent": 100 * float(load.max())}),
        ("cable_acts", pull / per_N, limits[1], {"force_N": float(pull[0]), "torque_Nm": float(pull[1])}),
        ("orientations_smoothly_off", turn_rad, limits[2], {"turn_deg": float(np.degrees(turn_rad.max()))}),
    ):
        too_large = bool((share > limit).any())
        if too_large or (not in_motion and (share > SMOOTH_SHARE).any()):
            findings.append(Finding.of(code, "limit" if too_large else "note", **values))
    return findings


def _poses(fit: Judged, quality: Quality, severity_of_rejected: Severity, setup: Setup) -> list[Finding]:
    """Name poses that were rejected, that nothing checks, or that deviate most, and drift from pose to pose."""
    findings, n = list[Finding](), int(quality.used.sum())
    if not quality.used.all():
        rows = np.flatnonzero(~quality.used) + 1
        values = {"count": len(rows), "n_poses": len(quality.used), "poses": rows}
        findings.append(Finding.of("poses_rejected", severity_of_rejected, **values))
    if n < RECOMMENDED_POSES:
        findings.append(Finding.of("few_poses", n_poses=n, recommended=RECOMMENDED_POSES))
    elif n < FEW_POSES_FOR_RESPONSE and setup.sensor_accuracy_percent is None and not quality.is_exact:
        values = {"gain_percent": 100 * setup.gain_sigma, "recommended": FEW_POSES_FOR_GAIN}
        findings.append(Finding.of("gain_unknown", n_poses=n, **values))
    rows = np.flatnonzero(_is_unchecked(fit) & quality.used) + 1
    if 0 < rows.size <= n / 2:
        findings.append(Finding.of("poses_unchecked", poses=rows))
    if quality.is_exact:
        return findings
    if quality.lag1_p < SURE:
        findings.append(Finding.of("residuals_alike", correlation=quality.lag1))
    worst = float(quality.residual_sigma[quality.worst_pose])
    typical = float(np.median(quality.residual_sigma[quality.used] ** 2))
    if n >= RECOMMENDED_POSES and worst**2 > chi2_isf(6, SURE / n) / 6 * max(typical, 1.0):
        findings.append(Finding.of("pose_deviates", pose=quality.worst_pose + 1, sigmas=worst))
    return findings


def _drift(drift: DriftResult | None, ahead: DriftAhead, weight_N: float, *, is_cause: bool) -> list[Finding]:
    """Name a significant drift, 0 where it is not.

    It limits the result if it is no consequence, and large from the first pose to the last or up to the next use.
    """
    if drift is None:
        return []
    force_N, torque_Nm = (float(np.linalg.norm(drift.change[part])) for part in (slice(0, 3), slice(3, 6)))
    size_N = max(force_N, torque_Nm / USUAL_LEVER_M)
    channels = np.abs(drift.change) > np.maximum(3 * drift.sigma, RESOLUTION)
    significant = np.array([channels[:3].any(), channels[3:].any()])
    if not significant.any():
        return []
    next_N, next_Nm = np.sqrt(ahead.square.reshape(2, 3).sum(axis=1))
    matters = is_cause and max(size_N, next_N, next_Nm / USUAL_LEVER_M) > USABLE_SHARE * weight_N
    values = {"force_N": force_N * significant[0], "torque_Nm": torque_Nm * significant[1]}
    return [Finding.of("drift", "limit" if matters else "note", **values)]


def _response(response: Response | None, weight_N: float, *, assumed: bool = False) -> list[Finding]:
    """Name the axes along which the sensor reads high or low, and how much force leaks into torque."""
    if response is None:
        return []
    gain, cross_talk, sigma = response.force_gain, response.cross_talk_m, response.sigma
    certain = np.abs(gain) > 3 * sigma["force_gain"]
    certain &= (sigma["force_gain"] > 0) & (np.abs(gain) * weight_N > RESOLUTION[0])
    findings = [
        Finding.of(f"gain_{axis}", gain_percent=100 * gain[k, k]) for k, axis in enumerate("xyz") if certain[k, k]
    ]
    findings += [
        Finding.of("axes_mixed", axes=f"{'xyz'[i]} and {'xyz'[j]}", share_percent=100 * abs(gain[i, j]))
        for i, j in combinations(range(3), 2)
        if certain[i, j]
    ]
    if (np.abs(cross_talk) > 3 * sigma["cross_talk_m"]).any():
        findings.append(Finding.of("cross_talk", torque_mNm=1e3 * np.abs(cross_talk).max()))
    return findings or ([] if assumed else [Finding.of("response_small")])


def out_of_line(residual_sigma: Array, used: NDArray[np.bool_]) -> list[int]:
    """Rows of poses that were rejected, or that the others predict badly."""
    typical = max(float(np.median(residual_sigma[used] ** 2)), 1.0)
    limit = chi2_isf(6, SURE / len(residual_sigma)) / 6 * typical
    return np.flatnonzero(~used | (residual_sigma**2 > limit)).tolist()


def _change(fit: Judged, quality: Quality, measured_sigma: Array | None, t_s: Array | None) -> list[Finding]:
    """Name a lasting change, where the fit needs what could hide one: components of the noise, or poses left out."""
    kinds = ("walk", "slope") if quality.chi2_p is None else ("walk", "slope", "white")
    drifts = any(name.startswith(kinds) for name in fit.components)
    drifts |= bool(quality.errors) or not quality.used.all()
    # Noise from the residuals hides a turn too.
    if fit.fit is None or not (drifts or (fit.components and not quality.is_exact)):
        return []
    if t_s is None or not np.isfinite(t_s).all():
        t_s = np.arange(len(fit.wrench), dtype=np.float64)
    return session_change(fit.fit, np.argsort(t_s, kind="stable"), t_s, measured_sigma, steps=drifts)


def _rms(vectors: Array) -> float:
    """Root mean square of the lengths of (n, 3) vectors."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))
