"""Findings about estimates and their verdict: how well they predict, and whether they are plausible.

Cross-validation interpolates a drift, but a calibration is used after its tour, so `drift_ahead` extrapolates it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
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
from ftcalib.judge.described_cell import contradictions
from ftcalib.judge.faults import COLLAPSE, ROUNDING, broken_channels, constant_weight, faults, other_poses, written_step
from ftcalib.judge.observability import ACCEPTED_DELTA_CHI2, RECOMMENDED_POSES
from ftcalib.judge.session_change import CHANGES, cable_of
from ftcalib.known import NOTHING, Known, Setup
from ftcalib.likelihood.fit import Estimate, Fit, standardize
from ftcalib.likelihood.session import FEW_POSES_FOR_GAIN, FEW_POSES_FOR_RESPONSE
from ftcalib.likelihood.structure import error_with_other_joints, hidden_in_any_poses
from ftcalib.likelihood.variance_components import FORCE, TORQUE, channel_component
from ftcalib.model import PARAMETER_NAMES, STANDARD_GRAVITY_M_S2, Array
from ftcalib.sensor_matrix import Response

SIGNIFICANT_SIGMAS = 5.0
NOISE_FACTOR = 3.0
USABLE_SHARE, REJECTED_SHARE = 0.02, 0.10
# Few poses count as agreeing with their covariance up to this mean square of the normalised leave-one-out residuals.
_AS_PREDICTED = 4.0
# If residuals reach half the weight, estimates of gravity and centre of mass are meaningless.
SENSELESS_SHARE = 0.5
# Largest error, as a share of the weight, of a good result whose residuals exceed the measured noise.
NOISY_SHARE = 0.01
# Largest structured error of a good result, as a share of the weight.
STRUCTURED_SHARE = 0.002
# Structured error above which a result in motion is not good, and a static result gets a note; and the orientation
# error of a calibrated arm, which is accepted in motion.
SMOOTH_SHARE, CALIBRATED_ARM_RAD = 0.0005, 0.001
# Torque errors are compared with the weight at this lever, or at the centre of mass if that is farther.
USUAL_LEVER_M = 0.1
CORRELATED = 0.9
FEW_LEFT_OUT = 0.1
# Torque residual, as a share of the change of the torques, above which the torques do not follow the weight.
UNRELATED = 0.8
# Largest number of poses searched for mistakes, and the number of successive poses in each group of them.
ENOUGH_FOR_FAULTS, SUCCESSIVE = 2000, 100
# False-alarm probability of a finding.
SURE = 1e-3

# Assumed interval between poses, s, if their times are unknown.
USUAL_INTERVAL_S = 10.0
# Assumed time from the last pose of a tour to the next use of its calibration.
NEXT_USE_S = 60.0
HOUR = 3600.0 / NEXT_USE_S
# Time constant of a warm-up of 10 to 30 min, of which a linear drift is usually the beginning.
WARM_UP = 1200.0 / NEXT_USE_S

_RMS = "force_rms_N", "torque_rms_Nm"


@dataclass(frozen=True, slots=True, eq=False)
class DriftAhead:
    """Expected change of the bias from the last pose to the next use, a minute later; zero without drift."""

    growth_per_min: Array
    """(6,) change of the bias in the next minute for a linear drift, or its standard deviation for a random walk."""
    square: Array
    """(6,) expected squared change of the bias at the next use."""
    hour_square: Array
    """(6,) expected squared change of the bias an hour after the last pose."""


def drift_ahead(found: Estimate, t_s: Array | None = None) -> DriftAhead:
    """Return the extrapolated drift; without finite times `t_s` (n,) an interval of 10 s between poses is assumed."""
    if found.drift is None or found.drift.course is None:
        return DriftAhead(*np.zeros((3, 6)))
    n = len(found.weights)
    timed = t_s is not None and np.isfinite(t_s).all() and np.ptp(t_s) > 0
    time = np.asarray(t_s if timed else USUAL_INTERVAL_S * np.arange(n), dtype=np.float64)
    used = np.flatnonzero(found.weights > 0)
    first, last = used[np.argmin(time[used])], used[np.argmax(time[used])]
    intervals = NEXT_USE_S * (n - 1) / np.ptp(time)
    walk = np.zeros(6)
    for channels in (FORCE, TORQUE, *([c] for c in range(6))):
        # A random walk has mean zero; only its variance grows until the next use.
        walk[channels] += intervals * found.components.get(channel_component("walk", channels).name, 0.0) ** 2
    linear = np.where(walk > 0, 0.0, found.drift.change * NEXT_USE_S / (time[last] - time[first]))
    # The variance of the change from first to last pose contains the errors of both ends.
    known = found.drift.sigma**2 / 2
    square = linear**2 + walk + known
    hour = (WARM_UP * (1 - np.exp(-HOUR / WARM_UP)) * linear) ** 2 + HOUR * walk + known
    return DriftAhead(np.sqrt(walk + linear**2), square, hour)


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """Estimates to be judged, with information about their data and the cell."""

    found: Estimate
    t_s: Array | None = None
    """(n,) times of the poses; the order of rows is used if times are missing or not finite."""
    setup: Setup = NOTHING
    """Description of the cell, with which the estimates are compared."""
    known: Known | None = None
    """Known values used by the estimates."""
    free: Estimate | None = None
    """Maximum likelihood fit without known values, if the estimates used known values or another method."""
    g_m_s2: float = STANDARD_GRAVITY_M_S2
    written: str = ""
    """Form in which the orientations were given, see `faults`."""

    @property
    def freest(self) -> Estimate:
        """Estimates without known values if available, because wrong known values would look like a change."""
        return self.free or self.found


@dataclass(frozen=True, slots=True, eq=False)
class Quality:
    """Judgement of estimates: statistics, findings and verdict."""

    used: NDArray[np.bool_]
    """(n,) whether each pose was used in the fit; the others were rejected."""
    finest: Array
    """(6,) smallest residual that a sensor, or readings that were written rounded, can resolve."""
    is_exact: bool
    """Whether all residuals are below `finest`, as in simulated data. Equal readings are then no copies."""
    accidents: bool
    """Whether the rejected poses are isolated outliers; rounding alone may also reject poses."""
    suspect: bool
    """Whether there are large errors, rejected poses or cross-talk that a mistake in the data may have caused."""
    residual_sigma: Array
    """(n,) leave-one-out residual of each pose in standard deviations, rms over the six channels; 1 is expected."""
    worst_pose: int
    """Row, counted from 0, of the used pose with the largest leave-one-out residual."""
    lag1: float
    """Correlation of the residuals of successive used poses; near 0 without drift."""
    lag1_p: float
    """p-value of `lag1`: probability of a larger correlation by chance."""
    largest_share: float
    """Largest error of force or torque relative to the weight."""
    errors: list[Finding]
    """Findings about errors of force and torque that exceed the limits of the verdict."""
    loo_force_rms_N: float
    """Leave-one-out rms error of force over the used poses, N."""
    loo_torque_rms_Nm: float
    """Leave-one-out rms error of torque over the used poses, N·m."""
    ahead: DriftAhead
    """Expected drift of the bias from the last pose to the next use."""
    noise_factor: float | None
    """Ratio of residuals to measured noise; None if the noise was not measured."""
    chi2_p: float | None
    """Probability of a larger chi2 under the measured noise alone; None if the noise was not measured."""
    correlations: tuple[tuple[str, str, float], ...]
    """Pairs of parameters with a correlation above 0.9, strongest first."""
    findings: tuple[Finding, ...] = ()
    """Findings in the order in which to fix them; notes come last."""
    uses: Mapping[str, JSON] = field(default_factory=dict)
    """Errors of compensating a free tool after a tour, by name and unit: see `_errors_of_uses`."""
    cable_shift: Array | None = None
    """(15,) possible shift of the estimates by a cable; None if the readings show no cable."""

    @property
    def verdict(self) -> Verdict:
        """Verdict (good, usable or rejected) of the worst finding."""
        return verdict_of(self.findings)

    @property
    def fits_measured_noise(self) -> bool:
        """Whether the measured noise explains the residuals."""
        return self.chi2_p is not None and self.chi2_p >= SURE

    def to_dict(self) -> dict[str, JSON]:
        """Return the statistics that a result stores as `quality`."""
        return {
            "loo_force_rms_N": self.loo_force_rms_N,
            "loo_torque_rms_Nm": self.loo_torque_rms_Nm,
            **self.uses,
            "worst_pose": self.worst_pose + 1,
            "residual_sigma": self.residual_sigma.tolist(),
            "lag1": self.lag1,
            "correlations": [list(pair) for pair in self.correlations],
        }


def statistics(case: Case) -> Quality:
    """Return the statistics of a judgement, without findings.

    Residuals, leave-one-out errors and expected errors are compared with the weight, those of torque with its moment.
    """
    found, t_s = case.found, case.t_s
    used, finest = found.weights > 0.5, _finest(found.wrench)
    residuals = standardize(found.left_out_residuals, found.left_out_cov)
    residual_sigma = np.sqrt(np.mean(residuals**2, axis=1))
    # With few poses, leave-one-out errors are large, which is accepted if they agree with their covariance.
    few = used.sum() < RECOMMENDED_POSES and np.mean(residual_sigma[used] ** 2) < _AS_PREDICTED
    largest_share, errors, left_out_rms = _error_findings(found, used, few=bool(few))
    unresolved = np.abs(found.residuals) <= finest
    accidents = _few_rejected(used) or bool(unresolved.all())
    measured = bool(np.isfinite(found.measured_chi2))
    return Quality(
        used,
        finest,
        bool(unresolved[used].all()),
        accidents,
        bool(errors) or not accidents or "cross_talk" in found.components,  # cross-talk may hide slightly wrong axes
        residual_sigma,
        int(np.argmax(np.where(used, residual_sigma, -1.0))),
        *_successive_correlation(residuals[used], None if t_s is None else t_s[used]),
        largest_share,
        errors,
        *left_out_rms,
        drift_ahead(found, t_s),
        noise_factor=float(np.sqrt(found.measured_chi2 / found.dof)) if measured else None,
        chi2_p=float(chi2_sf(found.dof, found.measured_chi2)) if measured else None,
        correlations=strong_correlations(found.covariance),
    )


def judge(case: Case, quality: Quality, causes: Sequence[Finding]) -> Quality:
    """Return the judgement of a tour with findings, given mistakes or a change that explain the data better.

    Residuals up to three times the measured noise are good if the errors are below 1 %, because orientations and cables
    always add to the noise of a good sensor.
    """
    found, free = case.found, case.free
    mistaken, broken = any(cause.code not in CHANGES for cause in causes), _broken(found, quality, causes)
    contradicted = list[Finding]()
    if case.known is not None and free is not None:
        at_its_best = free.parameters, free.covariance
        contradicted = contradictions(case.known, *at_its_best, case.g_m_s2, SIGNIFICANT_SIGMAS, case.setup.up)
    gain = [] if causes else _gain_not_modelled(found, free)
    needs_no_misfit = gain or contradicted or quality.largest_share <= NOISY_SHARE
    explained = quality.is_exact or quality.fits_measured_noise or causes
    cable = cable_of(found) if isinstance(found, Fit) and not explained else None
    findings = [
        *broken,
        *causes,
        *(replace(each, severity="limit") if gain and each.severity == "reject" else each for each in quality.errors),
        *_weight_findings(found, case.setup),
        *_second_solution(found, free),
        *_unit_findings(case, quality, contradicted),
        *gain,
        *([] if needs_no_misfit else _misfit_of_known_values(found, free)),
        *_noise_findings(found, quality),
        *_pose_findings(found, quality, case.setup),
        *_structure_findings(found),
        *_drift_findings(found, quality.ahead, is_cause=verdict_of([*broken, *causes]) == "good"),
        *_response_findings(found.response, found.parameters.weight_N, assumed=len(quality.used) < FEW_POSES_FOR_GAIN),
        *([] if cable is None else cable[:1]),
    ]
    findings += _cell_findings(case, quality, findings, mistaken=mistaken, broken=bool(broken))
    # Contradictions with known values are reported only if the data have no mistake and do not fit the measured noise.
    if not (broken or mistaken or quality.fits_measured_noise):
        harmless = verdict_of(findings) == "good"
        findings += [replace(each, severity="note") if harmless else each for each in contradicted]
    return replace(
        quality,
        findings=tuple(folded(ordered(findings))),
        uses=_errors_of_uses(case, quality),
        cable_shift=None if cable is None else cable[1],
    )


def judge_motion(case: Case) -> Quality:
    """Return the judgement of a recording in motion, whose rows are treated like static poses."""
    found, quality = case.found, statistics(case)
    # Neighbouring rows differ too little to show whether the sensor was zeroed at each.
    mistakes = [mistake for mistake in find_mistakes(case, quality) if mistake.code != "zeroed_each_pose"]
    mistakes = mistakes or find_other_poses(case, quality)
    broken = _broken(found, quality, mistakes)
    findings = [
        *broken,
        *mistakes,
        *quality.errors,
        *_weight_findings(found, case.setup),
        *_second_solution(found),
        *_unit_findings(case, quality),
        *_structure_in_motion(found),
    ]
    findings += _cell_findings(case, quality, findings, mistaken=bool(mistakes), broken=bool(broken))
    return replace(quality, findings=tuple(folded(ordered(findings))))


def find_mistakes(case: Case, quality: Quality) -> list[Finding]:
    """Return mistakes in all poses (a subset of many) or, if there are none, in the used poses.

    Isolated wrong poses were rejected, so the used poses are examined too. Good data are examined only for torques that
    do not follow the weight.
    """
    found, order, mistakes = case.found, _some_runs(case.t_s, len(quality.used)), list[Finding]()
    kept = order[quality.used[order]]
    for rows in [order] if quality.used.all() else [order, kept]:
        if quality.suspect and not mistakes:
            mistakes = faults(found.R_base_flange[rows], found.wrench[rows], case.setup.up, case.written)
    return mistakes or _unrelated_torques(found, quality)


def find_other_poses(case: Case, quality: Quality) -> list[Finding]:
    """Return a finding if wrenches fit other poses than their own and no other mistake or change fits better."""
    if not quality.suspect:
        return []
    found, order = case.found, _some_runs(case.t_s, len(quality.used))
    kept = order[quality.used[order]]
    named = other_poses(found.R_base_flange[kept], found.wrench[kept])
    # Poses that happen to fit do not show how large the error of the other poses is.
    if named and not _few_rejected(quality.used):
        named = other_poses(found.R_base_flange[order], found.wrench[order]) or named
    return named


def _errors_of_uses(case: Case, quality: Quality) -> dict[str, JSON]:
    """Return the errors of compensating a free tool after a tour, N and N·m, including drift.

    "next_use", a minute after the last pose, is the error due to noise if this explains the residuals, otherwise the
    leave-one-out error, of all poses if many were rejected. "workspace" is the same over all orientations and base
    joint angles, and "hour" an hour after the last pose.
    """
    found, few_rejected, more = case.found, _few_rejected(quality.used), np.zeros(2)
    if quality.fits_measured_noise and few_rejected:
        error = found.predicted_error()
    else:
        error = _left_out_rms(found, quality.used if few_rejected else np.ones_like(quality.used))
        more = np.maximum(found.elsewhere.reshape(2, 3).sum(axis=1), 0.0)
    ahead = quality.ahead
    now, then = (square.reshape(2, 3).sum(axis=1) for square in (ahead.square, ahead.hour_square))
    next_use = np.sqrt(np.array(error) ** 2 + now)
    of_arm = error_with_other_joints(found.parameters, case.setup.orientation_rad) ** 2
    rms = {"next_use": next_use, "workspace": np.sqrt(next_use**2 + more + of_arm)}
    if ahead.square.any():  # without a drift in the tour the error after an hour is unknown
        rms["hour"] = np.sqrt(next_use**2 + then - now)
    uses = {f"{when}_{unit}": float(each[k]) for when, each in rms.items() for k, unit in enumerate(_RMS)}
    return {**uses, "bias_growth_per_min": ahead.growth_per_min.tolist()}


def _broken(found: Estimate, quality: Quality, causes: Sequence[Finding]) -> list[Finding]:
    """Return findings for broken channels; not for simulated data without noise, whose readings may repeat."""
    if quality.is_exact or any(_leaves_nothing(cause, quality.finest) for cause in causes):
        return []
    return broken_channels(found.wrench, found.R_base_flange)


def _unit_findings(case: Case, quality: Quality, contradicted: Sequence[Finding] = ()) -> list[Finding]:
    """Return findings for a bias, weight or centre of mass that wrong units would explain."""
    found, setup = case.found, case.setup
    # The finding of a contradicted mass already states the unit of force.
    by_mass = any(each.code == "known_mass" for each in contradicted)
    return units.implausible(
        found.parameters,
        _rms_norm(found.residuals[quality.used, :3]),
        described=bool(setup.cylinders_m),
        any_bias=setup.sensor_has_arbitrary_zero,
        unit_N=None if by_mass else described_cell.force_unit_of_cell(case.freest, case.known, setup, case.g_m_s2),
    )


def _cell_findings(
    case: Case, quality: Quality, findings: Sequence[Finding], *, mistaken: bool, broken: bool
) -> list[Finding]:
    """Return contradictions with the described cell, unless other findings make the estimates meaningless."""
    parameters, covariance, setup = case.found.parameters, case.found.covariance, case.setup
    load_kg, named = parameters.weight_N / case.g_m_s2, list[Finding]()
    payload = described_cell.payload(setup.payload_kg, load_kg, setup.sensor_mass_kg, parameters)
    # With a mistake or very large errors the estimates of signs and mounting are meaningless.
    if not mistaken and quality.largest_share < SENSELESS_SHARE:
        hidden = hidden_in_any_poses(parameters, setup.orientation_rad)
        named += described_cell.directions(parameters, covariance + hidden, setup, case.written)
        named += [each for each in payload if each.code == "payload_units" and not broken]
    if verdict_of([*findings, *named]) != "rejected":  # else these follow from a cause
        named += [each for each in payload if each not in named]
        named += described_cell.tool(parameters, covariance, setup, case.g_m_s2)
    return named


def _few_rejected(used: NDArray[np.bool_]) -> bool:
    """Whether so few of the poses were rejected that the rejected ones are isolated outliers."""
    return bool(used.sum() >= (1 - FEW_LEFT_OUT) * len(used))


def _finest(wrench: Array) -> Array:
    """Return the smallest residual (6,) that a sensor, or readings (n, 6) that were written rounded, can resolve."""
    largest = np.abs(wrench).max(axis=0).reshape(2, 3).max(axis=1)
    return np.asarray(np.maximum(np.maximum(RESOLUTION, ROUNDING * np.repeat(largest, 3)), written_step(wrench)))


def _leaves_nothing(mistake: Finding, finest: Array) -> bool:
    """Whether the data corrected for a mistake have no noise, which happens only in simulations."""
    left_N, left_Nm = (mistake.values.get(name, np.inf) for name in ("corrected_N", "corrected_Nm"))
    return bool(left_N <= finest[0] or left_Nm <= finest[3])


def _unrelated_torques(found: Estimate, quality: Quality) -> list[Finding]:
    """Return a finding for torques that do not follow the weight although the forces do."""
    torque_Nm, codes = found.wrench[quality.used, 3:], {error.code: error.severity for error in quality.errors}
    is_near = float(np.linalg.norm(found.parameters.p_sensor_com_m)) < units.NEAREST_COM_M
    left = _rms_norm(found.residuals[quality.used, 3:]) / (_rms_norm(torque_Nm - torque_Nm.mean(axis=0)) or 1.0)
    if left < UNRELATED or "force_error" in codes or not (is_near or codes.get("torque_error") == "reject"):
        return []
    return [Finding.of("torques_unrelated", "limit", left_percent=100 * min(left, 1.0))]


def _some_runs(t_s: Array | None, n: int) -> NDArray[np.intp]:
    """Return the rows in the order of time: all of them, or evenly spread runs if there are many poses."""
    order = np.arange(n) if t_s is None or not np.isfinite(t_s).all() else np.argsort(t_s, kind="stable")
    return np.asarray(order[np.arange(n) // SUCCESSIVE % max(n // ENOUGH_FOR_FAULTS, 1) == 0])


def _successive_correlation(standardized: Array, t_s: Array | None = None) -> tuple[float, float]:
    """Return the correlation of standardized residuals (n, 6) of successive poses, and its p-value.

    The poses are sorted by the times `t_s`, or by row if times are missing or not finite.
    """
    if t_s is not None and np.isfinite(t_s).all():
        standardized = standardized[np.argsort(t_s, kind="stable")]
    products = np.einsum("ni,ni->n", standardized[:-1], standardized[1:])
    correlation = float(products.mean() / (np.mean(standardized**2) * 6 or 1.0))
    return correlation, float(normal_cdf(-correlation * np.sqrt(6 * len(products))))


def strong_correlations(covariance: Array, least: float = CORRELATED) -> tuple[tuple[str, str, float], ...]:
    """Return the pairs of parameters whose absolute correlation exceeds `least`, the strongest first."""
    sigma = np.sqrt(np.diag(covariance))
    sigma[sigma == 0] = 1.0  # exactly known
    correlation = covariance / np.outer(sigma, sigma)
    pairs = [(float(correlation[i, j]), i, j) for i, j in combinations(range(len(sigma)), 2)]
    strong = sorted((pair for pair in pairs if abs(pair[0]) > least), key=lambda pair: -abs(pair[0]))
    return tuple((PARAMETER_NAMES[i], PARAMETER_NAMES[j], value) for value, i, j in strong)


def _error_findings(
    found: Estimate, used: NDArray[np.bool_], *, few: bool
) -> tuple[float, list[Finding], tuple[float, float]]:
    """Return the largest error relative to the weight, findings for large errors, and the leave-one-out rms errors.

    Of residual, leave-one-out error and expected error, the first that exceeds the highest limit is reported. With
    `few` poses the leave-one-out error limits a result, but does not reject it.
    """
    weight_N, lever_m = found.parameters.weight_N, _lever_m(found)
    expected = found.predicted_error()
    left_out = _left_out_rms(found, used)
    largest, findings = 0.0, []
    for k, scale, unit in ((0, weight_N, "N"), (1, weight_N * lever_m, "Nm")):
        errors = (
            ("residuals", _rms_norm(found.residuals[used, 3 * k : 3 * k + 3])),
            ("cross-validation", left_out[k]),
            ("uncertainty over all orientations", expected[k]),
        )
        # Of the three errors, the one that exceeds most limits is reported; if several do, the first of them.
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


def _weight_findings(found: Estimate, setup: Setup) -> list[Finding]:
    weight_N, sigma_N = found.parameters.weight_N, found.parameters.weight_sigma_N(found.covariance)
    if weight_N > SIGNIFICANT_SIGMAS * sigma_N:
        return []
    if given_in_base := constant_weight(found.wrench, setup.up):
        return given_in_base
    return [Finding.of("weight_insignificant", weight_N=weight_N, sigma_N=sigma_N, least_sigmas=SIGNIFICANT_SIGMAS)]


def _second_solution(found: Estimate, free: Estimate | None = None) -> list[Finding]:
    if found.second_basin_chi2 is None:
        return []
    # Effects that a published method does not model, such as a gain, increase chi2 of both solutions.
    fitted = free if free is not None and not isinstance(found, Fit) else found
    delta = found.second_basin_chi2 / max(1.0, fitted.chi2 / fitted.dof)
    if delta >= ACCEPTED_DELTA_CHI2:
        return []
    # This probability agrees with its frequency in 8954 simulated calibrations.
    probability = float(1 / (1 + np.exp(max(delta, 0.0) / 2)))
    return [Finding.of("second_solution", probability_percent=100 * probability)]


def _gain_not_modelled(found: Estimate, free: Estimate | None) -> list[Finding]:
    """Return a finding if the gain of the sensor explains most of the residuals of a method that ignores it."""
    if isinstance(found, Fit) or free is None or free.response is None:
        return []
    used = free.weights > 0.5
    ours, best = (_rms_norm(estimate.residuals[used, :3]) for estimate in (found, free))
    reads = free.response.wrench(free.parameters, found.R_base_flange[used])[:, :3]
    if best > COLLAPSE * ours or _rms_norm(reads - reads.mean(axis=0)) < ours / 2:
        return []
    gain_percent = 100 * float(np.abs(free.response.force_gain).max())
    return [Finding.of("gain_not_modelled", gain_percent=gain_percent, residual_N=ours, free_N=best)]


def _misfit_of_known_values(found: Estimate, free: Estimate | None) -> list[Finding]:
    if free is None:
        return []
    used = free.weights > 0.5
    return [
        Finding.of(f"known_values_misfit_{kind}", **{f"residual_{unit}": ours, f"free_{unit}": best})
        for kind, unit, columns in (("force", "N", slice(0, 3)), ("torque", "Nm", slice(3, 6)))
        for ours, best in [(_rms_norm(found.residuals[used, columns]), _rms_norm(free.residuals[used, columns]))]
        if best < COLLAPSE * ours
    ][:1]


def _noise_findings(found: Estimate, quality: Quality) -> list[Finding]:
    if quality.chi2_p is None or quality.noise_factor is None:
        return [Finding.of("noise_unknown")]
    if quality.fits_measured_noise:
        return []
    minor = quality.noise_factor <= NOISE_FACTOR and quality.largest_share <= NOISY_SHARE and not found.may_bend
    components = {name: value for name, value in found.components.items() if value > 0}
    severity: Severity = "note" if minor else "limit"
    return [Finding.of("noise_exceeded", severity, factor=quality.noise_factor, components=components)]


def _left_out_rms(found: Estimate, poses: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the leave-one-out rms errors of poses; the predicted error if no pose can be predicted from the others."""
    checked = poses & ~_is_unchecked(found)
    if not checked.any():
        return found.predicted_error()
    return _rms_norm(found.left_out_residuals[checked, :3]), _rms_norm(found.left_out_residuals[checked, 3:])


def _is_unchecked(found: Estimate) -> NDArray[np.bool_]:
    """Return which poses (n,) cannot be checked, because the others do not determine their prediction."""
    return np.asarray(np.trace(found.left_out_cov[:, :3, :3], axis1=1, axis2=2) > found.parameters.weight_N**2)


def _lever_m(found: Estimate) -> float:
    return max(USUAL_LEVER_M, float(np.linalg.norm(found.parameters.p_sensor_com_m)))


def _structure_findings(found: Estimate) -> list[Finding]:
    """Return findings for structured errors; large ones limit the result."""
    load, pull = (
        _component_sizes(found, "load_force", "load_torque"),
        _component_sizes(found, "cable_force_N", "cable_torque_Nm"),
    )
    limits = (STRUCTURED_SHARE,) * 3
    return _smooth_error_findings(
        found, load, pull, _component_sizes(found, "kinematics_rad"), limits, least=SMOOTH_SHARE
    )


def _structure_in_motion(found: Estimate) -> list[Finding]:
    """Return findings for smooth errors in motion, with lower limits because averaging leaves little noise."""
    load, pull = (_component_sizes(found, f"{name}_N", f"{name}_Nm") for name in ("load", "cable"))
    # In motion, orientation errors up to those of calibrated arms are accepted.
    limits = SMOOTH_SHARE, SMOOTH_SHARE, np.array([SMOOTH_SHARE, CALIBRATED_ARM_RAD])
    return _smooth_error_findings(
        found, load / _per_N(found), pull, _component_sizes(found, "yielding_rad", "rotation_rad"), limits
    )


def _component_sizes(found: Estimate, *names: str) -> Array:
    return np.array([found.components.get(name, 0.0) for name in names])


def _per_N(found: Estimate) -> Array:
    """Return the force and torque (2,) to which errors are related: weight, and weight times lever."""
    return np.array([1.0, _lever_m(found)]) * found.parameters.weight_N


def _smooth_error_findings(
    found: Estimate, load: Array, pull: Array, turn_rad: Array, limits: Sequence[Array | float], least: float = np.inf
) -> list[Finding]:
    """Return findings on nonlinear response (2,), cable (2,), orientation (k,); notes from `least` to `limits`."""
    findings = []
    for code, share, limit, values in (
        ("response_not_linear", load, limits[0], {"share_percent": 100 * float(load.max())}),
        ("cable_acts", pull / _per_N(found), limits[1], {"force_N": float(pull[0]), "torque_Nm": float(pull[1])}),
        ("orientations_smoothly_off", turn_rad, limits[2], {"turn_deg": float(np.degrees(turn_rad.max()))}),
    ):
        too_large = bool((share > limit).any())
        if too_large or (share > least).any():
            findings.append(Finding.of(code, "limit" if too_large else "note", **values))
    return findings


def _pose_findings(found: Estimate, quality: Quality, setup: Setup) -> list[Finding]:
    """Return findings for rejected, unchecked and deviating poses, few poses, and correlated residuals."""
    findings, n = list[Finding](), int(quality.used.sum())
    if not quality.used.all():
        rows = np.flatnonzero(~quality.used) + 1
        values = {"count": len(rows), "n_poses": len(quality.used), "poses": rows}
        findings.append(Finding.of("poses_rejected", "note" if quality.accidents else "limit", **values))
    if n < RECOMMENDED_POSES:
        findings.append(Finding.of("few_poses", n_poses=n, recommended=RECOMMENDED_POSES))
    elif n < FEW_POSES_FOR_RESPONSE and setup.sensor_accuracy_percent is None and not quality.is_exact:
        values = {"gain_percent": 100 * setup.gain_sigma, "recommended": FEW_POSES_FOR_GAIN}
        findings.append(Finding.of("gain_unknown", n_poses=n, **values))
    rows = np.flatnonzero(_is_unchecked(found) & quality.used) + 1
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


def _drift_findings(found: Estimate, ahead: DriftAhead, *, is_cause: bool) -> list[Finding]:
    """Return a finding for a significant drift; it limits the result if it is large and not a consequence."""
    if (drift := found.drift) is None:
        return []
    force_N, torque_Nm = (float(np.linalg.norm(drift.change[part])) for part in (slice(0, 3), slice(3, 6)))
    size_N = max(force_N, torque_Nm / USUAL_LEVER_M)
    channels = np.abs(drift.change) > np.maximum(3 * drift.sigma, RESOLUTION)
    significant = np.array([channels[:3].any(), channels[3:].any()])
    if not significant.any():
        return []
    next_N, next_Nm = np.sqrt(ahead.square.reshape(2, 3).sum(axis=1))
    matters = is_cause and max(size_N, next_N, next_Nm / USUAL_LEVER_M) > USABLE_SHARE * found.parameters.weight_N
    values = {"force_N": force_N * significant[0], "torque_Nm": torque_Nm * significant[1]}
    return [Finding.of("drift", "limit" if matters else "note", **values)]


def _response_findings(response: Response | None, weight_N: float, *, assumed: bool = False) -> list[Finding]:
    """Return notes on gain errors along and between axes, and on cross-talk from force to torque."""
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
    """Return the rows of poses that were rejected, or that have large leave-one-out residuals."""
    typical = max(float(np.median(residual_sigma[used] ** 2)), 1.0)
    limit = chi2_isf(6, SURE / len(residual_sigma)) / 6 * typical
    return np.flatnonzero(~used | (residual_sigma**2 > limit)).tolist()


def _rms_norm(vectors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))
