"""Calibration from a dataset of static poses."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any, get_args

import numpy as np

from ftcalib.data.dataset import CalibrationDataset, pooled_covariance
from ftcalib.errors import BadDataset, NotObservable
from ftcalib.findings import Finding, ordered
from ftcalib.judge.described_cell import contradictions
from ftcalib.judge.faults import CORRECTED, faults, no_weight, other_poses
from ftcalib.judge.observability import ACCEPTED_DELTA_CHI2, require_observable, require_orientations
from ftcalib.judge.session_change import SessionChange, possible_changes
from ftcalib.judge.verdict import SIGNIFICANT_SIGMAS, Case, Quality, find_mistakes, find_other_poses, judge, statistics
from ftcalib.known import NOTHING, Known, Setup
from ftcalib.likelihood.descent import column_scale
from ftcalib.likelihood.fit import Estimate, Fit, fit
from ftcalib.likelihood.session import RANK_TOLERANCE, Drift
from ftcalib.model import PARAMETER_NAMES, STANDARD_GRAVITY_M_S2, Array, Parameters, predict
from ftcalib.published.methods import BASELINES, PUBLISHED, SPECIAL, Estimator, published, require_printed_form
from ftcalib.published.yu import ROUNDING_RAD, special_deviation_rad, special_numbers
from ftcalib.result import CalibrationResult, Method, require_positive_definite
from ftcalib.sensor_matrix import SensorMatrix

# Number of simulations for the covariance of a published method.
SIMULATIONS = 400
# Differences of the force below this value, N, are below the resolution of any sensor.
UNRESOLVED_N = 1e-12
# Largest plausible ratio of a force to the standard error of its mean.
_RESOLVED = 3e6

# Published methods that need the direction of gravity or the weight.
_NEED_GRAVITY = ("carlson-relaxation", "carlson-cayley")


@contextmanager
def _finite() -> Iterator[None]:
    """Ignore overflow warnings; raise `BadDataset` if an overflow makes the fit fail."""
    try:
        with np.errstate(all="ignore"):
            yield
    except np.linalg.LinAlgError as error:
        raise BadDataset(
            f"the fit failed because of numbers that are not finite ({error}): check the units of the wrench and of "
            "its standard errors, and that each row has one orientation and its own reading"
        ) from error


@_finite()
def solve(
    dataset: CalibrationDataset,
    method: Method = "ml",
    *,
    drift: Drift = "auto",
    known: Known | None = None,
    g_m_s2: float = STANDARD_GRAVITY_M_S2,
    setup: Setup = NOTHING,
    provenance: Mapping[str, Any] | None = None,
    as_published: bool = False,
) -> CalibrationResult:
    """Return the calibration from a dataset of static poses.

    Parameters
    ----------
    dataset : CalibrationDataset
    method : Method
        "ml": maximum likelihood from 4 or more poses; "known-rotation", "yaw-only": the same for a known mounting
        (`known`, default: axes of sensor and flange agree), or a mounting known up to a rotation about flange z.
        For comparison, one of `ftcalib.published.methods.PUBLISHED`.
    drift : {"auto", "none", "linear", "random-walk"}
        Model of the bias during the session; "auto": chosen from the data. Poses without times count as equally spaced.
    known : Known, optional
        Known mounting, direction of gravity and mass. Published methods use the values that they need as exactly known:
        Carlson's methods gravity, "vougioukas" the mounting (default: axes of sensor and flange agree) and the
        direction of gravity (default: the up direction of `setup`), "wang" the mounting, "yang" the same without yaw.
    g_m_s2 : float
        Acceleration of gravity; the mass is the weight divided by it.
    setup : Setup
        Description of the cell, for the verdict. Methods that need gravity use its up direction, by default the known.
    provenance : mapping, optional
        Stored with the result, together with the hash of the dataset. Must be valid JSON.
    as_published : bool
        Whether to run one of Carlson's methods as printed, without biases (`ftcalib.published.methods.published`). The
        `provenance` then contains `as_published`.

    Raises
    ------
    NotObservable
        The poses do not determine the parameters; the message names what is missing and what to add.
    ValueError
        An unknown method, known values that the method cannot use, or `as_published` for another method.

    Examples
    --------
    >>> import ftdrive
    >>> dataset = ftdrive.read_dataset("poses.csv")
    >>> result = ftdrive.solve(dataset)
    >>> result.verdict, result.n_poses
    ('good', 24)
    >>> contact = result.compensate(dataset.wrench, dataset.R_base_flange)
    >>> contact.shape
    (24, 6)
    """
    known, setup = _choose(dataset, method, drift, known, g_m_s2, setup, as_published=as_published)
    estimator = None
    if method in PUBLISHED:
        estimator = estimator_of(method, dataset.R_base_flange, known, g_m_s2, setup, as_published=as_published)
    wrench_cov = dataset.wrench_cov
    if wrench_cov is not None:
        wrench_cov = pooled_covariance(wrench_cov, dataset.n_samples)
    # Yu's and Carlson's methods assume no mounting, so neither does the maximum likelihood fit for comparison.
    assumed = known if estimator is None or method in BASELINES else None
    poses = dataset.R_base_flange, dataset.wrench, wrench_cov
    fit_poses = partial(fit, *poses, t_s=dataset.t_s, drift=drift, gain_sigma=setup.gain_sigma)
    best = _fit_ml(fit_poses, dataset, known, assumed, g_m_s2, setup)
    found = best if estimator is None else _fit_published(method, estimator, dataset, wrench_cov, best)
    free = best if estimator else None
    if assumed is not None:
        free = _fit_freely(fit_poses, dataset)
    measured_sigma = None if wrench_cov is None else np.sqrt(np.einsum("nii->ni", wrench_cov).mean(axis=0))
    cell = replace(setup, sensor_has_arbitrary_zero=setup.sensor_has_arbitrary_zero or _zero_is_arbitrary(dataset))
    quality = _judge(Case(found, dataset.t_s, cell, known, free, g_m_s2, _written(dataset)), measured_sigma)
    deviation = _deviation_findings(method, estimator, best.parameters, dataset.R_base_flange) if estimator else []
    printed = {"as_published": True} if as_published else {}
    declares_sensor = setup.sensor_accuracy_percent is not None or setup.sensor_range is not None
    return CalibrationResult(
        parameters=found.parameters,
        mean_bias=None if found.drift is None else best.on_average.bias,
        covariance=found.covariance,
        hidden_covariance=best.hidden_covariance(setup.orientation_rad),
        residuals=found.residuals,
        chi2=found.chi2 if wrench_cov is None else found.measured_chi2,
        dof=found.dof,
        noise_source="residuals" if wrench_cov is None else "measured",
        g_m_s2=g_m_s2,
        method=method,
        findings=ordered([*quality.findings, *deviation]),
        provenance={**(provenance or {}), **printed, "dataset_sha256": dataset.sha256()},
        p_value=quality.chi2_p,
        measured_sigma=measured_sigma,
        weights=found.weights,
        components=found.components,
        drift=None if found.drift is None else replace(found.drift, course=None),
        response=found.response,
        gain_sigma=0.0 if found.response is None else found.response.gain_sigma,
        cable_shift=quality.cable_shift,
        second_basin_chi2=best.second_basin_chi2,
        quality=quality.to_dict(),
        sensor=SensorMatrix.declared(setup) if declares_sensor else None,
        weighed_kg=setup.weighed_kg,
    )


def _choose(
    dataset: CalibrationDataset,
    method: Method,
    drift: Drift,
    known: Known | None,
    g_m_s2: float,
    setup: Setup,
    *,
    as_published: bool,
) -> tuple[Known | None, Setup]:
    """Check the arguments; return the known values for the method, and the description of the cell."""
    for name, value, choices in (("method", method, get_args(Method)), ("drift", drift, get_args(Drift))):
        if value not in choices:
            raise ValueError(f"{name} is '{value}', expected one of {', '.join(choices)}")
    if not (np.isfinite(g_m_s2) and g_m_s2 > 0):
        raise ValueError(f"g_m_s2 is {g_m_s2}, expected about 9.8")
    _require_usable(method, known, as_published)
    if setup.up_in_base is None and known is not None and known.gravity_direction_base is not None:
        setup = replace(setup, up_in_base=(-np.asarray(known.gravity_direction_base)).tolist())
    known = _constrain(method, known, setup)
    # Three orientations have 4 or 8 exact solutions; known values or a fourth orientation make the solution unique.
    require_orientations(dataset.R_base_flange, 5 if method == "lrom" else 4 if known is None else 3)
    if np.ptp(dataset.wrench[:, :3], axis=0).max() < UNRESOLVED_N:
        raise NotObservable("the force is the same in all poses: check that the sensor works and carries a load.")
    _require_sense(dataset)
    return known, setup


def _require_sense(dataset: CalibrationDataset) -> None:
    """Raise `BadDataset` if all torques are zero, or if raw counts are combined with standard errors in other units."""
    if not dataset.wrench[:, 3:].any():
        raise BadDataset(
            "all torques are zero, as from a three-axis sensor, which cannot measure a centre of mass and is not "
            "supported: use a six-axis sensor, or give its torques"
        )
    if dataset.wrench_cov is None or (dataset.wrench != np.round(dataset.wrench)).any():
        return
    sigma_N = float(np.sqrt(np.einsum("nii->ni", dataset.wrench_cov)[:, :3].mean()))
    if (largest := float(np.abs(dataset.wrench[:, :3]).max())) > _RESOLVED * sigma_N:
        raise BadDataset(
            f"the wrench looks like raw counts, up to {largest:.3g}, with standard errors of {sigma_N:.2g}, which no "
            "sensor resolves: give wrench and standard errors in N and N·m, or leave the standard errors out"
        )


def _fit_ml(
    fit_poses: Callable[..., Fit],
    dataset: CalibrationDataset,
    known: Known | None,
    assumed: Known | None,
    g_m_s2: float,
    setup: Setup,
) -> Fit:
    """Return the maximum likelihood fit with the known values `assumed`.

    Published methods use this fit too: to check observability, and for the noise if it was not measured.
    """
    try:
        best = fit_poses(known=assumed, g_m_s2=g_m_s2)
        _require_determined(best, known)
    except NotObservable as exc:
        # A mistake in the data often makes the parameters undetermined; report it instead of asking for more poses.
        if named := _mistakes(fit_poses, dataset, known, g_m_s2, setup):
            raise NotObservable(f"{named[0].words}.", named[0]) from exc
        raise
    return best


def _judge(case: Case, measured_sigma: Array | None) -> Quality:
    """Return the judgement of estimates, with a mistake or a change that explains the data better, the simplest first.

    `measured_sigma` (6,) is the measured standard deviation of a pose.
    """
    try:
        require_positive_definite(case.found.covariance)
        require_positive_definite(case.found.joint_covariance)
    except ValueError as exc:
        raise NotObservable(f"{exc}. Add poses with other orientations.") from exc
    quality = statistics(case)
    causes = find_mistakes(case, quality) or _find_change(case, quality, measured_sigma)
    return judge(case, quality, causes or find_other_poses(case, quality))


def _find_change(case: Case, quality: Quality, measured_sigma: Array | None) -> list[Finding]:
    """Return the finding of a change during the session, if one explains the data better than the fit.

    The search is made only if the fit has components or rejected poses that could hide a change.
    """
    fitted, t_s = case.freest, case.t_s
    kinds = ("walk", "slope") if quality.chi2_p is None else ("walk", "slope", "white")
    drifts = any(name.startswith(kinds) for name in fitted.components)
    drifts |= bool(quality.errors) or not quality.used.all()
    # Noise estimated from the residuals can hide a rotation of the sensor too.
    if not isinstance(fitted, Fit) or not (drifts or (fitted.components and not quality.is_exact)):
        return []
    if t_s is None or not np.isfinite(t_s).all():
        t_s = np.arange(len(fitted.wrench), dtype=np.float64)
    rows, changes = possible_changes(fitted, t_s, steps=drifts)
    R, cov = fitted.R_base_flange[rows], None if measured_sigma is None else np.diag(measured_sigma**2)
    costs = [_cost(change, R, cov, t_s[rows]) for change in changes]
    if not np.isfinite(least := min(costs, default=np.inf)):
        return []
    # Refit only if poses or noise differ from those of the fit.
    again = cov is not None or len(rows) < len(fitted.wrench)
    unchanged = fit(R, fitted.wrench[rows], cov, t_s=t_s[rows]) if again else fitted
    change = changes[costs.index(least)]
    return [change.finding(rows, fitted.weights)] if least < unchanged.minus_two_log_likelihood else []


def _cost(change: SessionChange, R: Array, cov: Array | None, t_s: Array) -> float:
    """Return -2 log likelihood of the data corrected for a change, plus its penalty; infinite if they fit badly."""
    try:
        without = fit(R, change.corrected, cov, t_s=t_s)
    except NotObservable:
        return np.inf
    left_N = np.sqrt(np.mean(np.sum(without.residuals[without.weights > 0.5, :3] ** 2, axis=1)))
    if left_N > CORRECTED * without.parameters.weight_N:
        return np.inf
    return without.minus_two_log_likelihood + change.cost


def _zero_is_arbitrary(dataset: CalibrationDataset) -> bool:
    """Whether the sensor reported an arbitrary zero when the dataset was recorded."""
    place: Any = dataset.meta
    for key in ("devices", "sensor", "facts"):
        place = place.get(key) if isinstance(place, Mapping) else None
    return isinstance(place, Mapping) and "zero" in place


def _written(dataset: CalibrationDataset) -> str:
    """Return the form in which orientations were given: a name, the order of Euler angles, or "" if unknown."""
    form = str(dataset.meta.get("form", ""))
    return str(dataset.meta.get("euler", "")) if form == "euler" else form


def _require_usable(method: Method, known: Known | None, as_published: bool) -> None:
    """Raise `ValueError` for known values that a published method cannot use, or for a missing printed form."""
    if as_published:
        require_printed_form(method)
    if known is None or method not in PUBLISHED or method in _NEED_GRAVITY:
        return
    if method not in BASELINES:
        raise ValueError(f"{method} cannot use known values: use 'ml'")
    unused = ["mass"] if known.mass_kg is not None else []
    unused += ["direction of gravity"] if method != "vougioukas" and known.gravity_direction_base is not None else []
    if unused:
        raise ValueError(f"{method} cannot use a known {' or '.join(unused)}: leave it out, or use 'ml'")


def _fit_published(
    method: Method, estimator: Estimator, dataset: CalibrationDataset, wrench_cov: Array | None, best: Fit
) -> Estimate:
    """Return the estimate of a published method; `best` provides degrees of freedom and second solution."""
    parameters = estimator(dataset.wrench)
    noise = wrench_cov
    if noise is None:  # noise from the residuals of the method
        residuals = dataset.wrench - predict(parameters, dataset.R_base_flange)
        square = (residuals**2).reshape(-1, 2, 3).mean(axis=(0, 2)) * 6 * len(dataset) / best.dof
        noise = np.broadcast_to(np.diag(np.repeat(np.maximum(square, 1e-24), 3)), (len(dataset), 6, 6))
    # The cube roots of SROM are worst near a zero component of the gravity force, which their own estimate hides.
    truth = best.parameters if method in SPECIAL else parameters
    return Estimate.independent(
        parameters,
        _simulated_covariance(estimator, truth, dataset.R_base_flange, noise),
        dataset.R_base_flange,
        dataset.wrench,
        noise,
        np.ones(len(dataset)),
        measured=wrench_cov is not None,
        second_basin_chi2=best.second_basin_chi2,
        free=best.free,
    )


def _constrain(method: Method, known: Known | None, setup: Setup) -> Known | None:
    """Return the known values of the caller, plus those that the method assumes."""
    if method in ("known-rotation", "vougioukas", "wang") and (known is None or known.R_flange_sensor is None):
        known = replace(known or Known(), R_flange_sensor=np.eye(3))
    if method in ("yaw-only", "yang"):
        known = replace(known or Known(), yaw_only=True)
    if known is not None and method in BASELINES:
        direction = -setup.up if known.gravity_direction_base is None else known.gravity_direction_base
        known = replace(
            known,
            yaw_only=method == "yang",
            gravity_direction_base=direction if method == "vougioukas" else None,
            R_tolerance_rad=0.0,
            direction_tolerance_rad=0.0,
        )
    return known


def _fit_freely(fit_poses: Callable[..., Fit], dataset: CalibrationDataset) -> Fit | None:
    """Return the fit without known values; None if the poses do not determine all parameters."""
    try:
        require_orientations(dataset.R_base_flange, 4)
        best = fit_poses()
        _require_determined(best, None)
    except NotObservable:
        return None
    return best


def _mistakes(
    fit_poses: Callable[..., Fit], dataset: CalibrationDataset, known: Known | None, g_m_s2: float, setup: Setup
) -> list[Finding]:
    """Return findings that explain undetermined parameters: mistakes in the data, or wrong known values."""
    poses = dataset.R_base_flange, dataset.wrench
    findings = faults(*poses, setup.up, _written(dataset)) or other_poses(*poses) or no_weight(*poses)
    if not findings and known is not None and (free := _fit_freely(fit_poses, dataset)) is not None:
        findings = contradictions(known, free.parameters, free.covariance, g_m_s2, SIGNIFICANT_SIGMAS, setup.up)
    return findings


def estimator_of(
    method: Method,
    R_base_flange: Array,
    known: Known | None,
    g_m_s2: float,
    setup: Setup,
    *,
    as_published: bool = False,
) -> Estimator:
    """Return the estimator of a published method, given `known`. Raises `NotObservable` for unsuitable poses."""
    known = known or Known()
    direction = -setup.up if known.gravity_direction_base is None else known.gravity_direction_base
    return published(
        method,
        R_base_flange,
        gravity_direction_base=np.asarray(direction),
        weight_N=None if known.mass_kg is None else known.mass_kg * g_m_s2,
        R_flange_sensor=None if known.R_flange_sensor is None else np.asarray(known.R_flange_sensor),
        as_published=as_published,
    )


def _deviation_findings(method: Method, estimator: Estimator, truth: Parameters, R_base_flange: Array) -> list[Finding]:
    """Return a finding if poses deviate from the special orientations of the method, with the resulting force error."""
    if method not in SPECIAL:
        return []
    deviation_rad = special_deviation_rad(R_base_flange, *special_numbers(R_base_flange, others=True))
    if deviation_rad <= ROUNDING_RAD:
        return []
    without_noise = estimator(predict(truth, R_base_flange))
    off_N = np.linalg.norm(without_noise.gravity_force_base_N - truth.gravity_force_base_N)
    return [Finding.of("orientations_deviate", off_deg=np.degrees(deviation_rad), force_N=off_N)]


def _require_determined(best: Fit, known: Known | None) -> None:
    """Raise `NotObservable` for undetermined parameters, with advice if only the poses are the reason."""
    Z = best.free
    information = Z.T @ best.information @ Z
    scale = column_scale(information)
    eigenvalues, V = np.linalg.eigh(information / np.outer(scale, scale))
    # Scaled to a unit diagonal, the eigenvalues do not depend on units.
    free = eigenvalues < RANK_TOLERANCE * eigenvalues[-1]
    ambiguous = best.second_basin_chi2 is not None and best.second_basin_chi2 < ACCEPTED_DELTA_CHI2
    if known is None and (free.any() or ambiguous):
        require_observable(best.R_base_flange, best.parameters, best.wrench_cov)
    if free.any():
        share = ((Z @ V[:, free]) ** 2).sum(axis=1).reshape(5, 3).sum(axis=1) / free.sum()
        names = [PARAMETER_NAMES[3 * k].partition(".")[0] for k in np.flatnonzero(share > 0.05)]
        raise NotObservable(
            f"the poses do not determine {free.sum()} of {len(free)} combinations of {', '.join(names)}: add poses "
            "that tilt the tool about two different horizontal axes and turn it about its own axis."
        )


def _simulated_covariance(estimator: Estimator, truth: Parameters, R_base_flange: Array, wrench_cov: Array) -> Array:
    """Return the mean square error (15, 15) of a closed-form method around `truth`, from simulated noise.

    Linear propagation fails, because the cube roots of SROM have no derivative at a zero component of the gravity
    force. The seed is fixed, so the same data always give the same result.
    """
    rng = np.random.default_rng(20210)
    L = np.linalg.cholesky(wrench_cov)
    exact = predict(truth, R_base_flange)
    errors = [
        truth.difference(estimator(exact + (L @ rng.standard_normal((*exact.shape, 1)))[..., 0]))
        for _ in range(SIMULATIONS)
    ]
    return np.asarray(np.mean([np.outer(error, error) for error in errors], axis=0))
