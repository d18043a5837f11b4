"""From a dataset to a calibration."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib.dataset import CalibrationDataset
from calib.errors import NotObservable
from calib.evidence import IndependentFit
from calib.model import PARAMETER_NAMES, Array, Parameters, predict
from calib.quality import judge
from calib.refine import column_scale, refine
from calib.result import CalibrationResult, Method
from calib.yu import lrom, special_numbers, srom_numbered

STANDARD_GRAVITY_M_S2 = 9.80665

SAME_ORIENTATION_RAD = np.deg2rad(0.5)
RANK_TOLERANCE = 1e-9
SIMULATIONS = 400

Estimator = Callable[[Array], Parameters]


def solve(
    dataset: CalibrationDataset,
    method: Method = "ml",
    *,
    g_m_s2: float = STANDARD_GRAVITY_M_S2,
    provenance: Mapping[str, Any] | None = None,
) -> CalibrationResult:
    """Calibrate.

    Parameters
    ----------
    dataset : CalibrationDataset
    method : {"ml", "srom", "lrom"}
        Maximum likelihood from 4 poses on; or Yu's closed forms, for comparison: SROM for the 24 special orientations,
        LROM for 5 or more of any kind.
    g_m_s2 : float
        Gravity, by which the weight is divided to give the mass.
    provenance : mapping, optional
        Kept with the result, beside the hash of the dataset. Must be writable as JSON.

    Raises
    ------
    NotObservable
        The poses do not determine the parameters; the message says what is missing and what to add.
    """
    if method not in ("ml", "srom", "lrom"):
        raise ValueError(f"method is '{method}', expected 'ml', 'srom' or 'lrom'")
    if not (np.isfinite(g_m_s2) and g_m_s2 > 0):
        raise ValueError(f"g_m_s2 is {g_m_s2}, expected about 9.8")
    R_base_flange, wrench = dataset.R_base_flange, dataset.wrench
    _require_orientations(dataset, 5 if method == "lrom" else 4)

    estimator = _closed_form(dataset, method)
    # The fit also tells whether the poses are enough, and how large the noise is where it was not measured.
    fit = refine(R_base_flange, wrench, dataset.wrench_cov, _starts(dataset))
    covariance = _covariance(fit.information)
    parameters = fit.parameters
    if estimator:
        parameters = estimator(wrench)
        covariance = _simulated_covariance(estimator, parameters, R_base_flange, fit.wrench_cov)

    residuals = wrench - predict(parameters, R_base_flange)
    result = CalibrationResult(
        parameters=parameters,
        covariance=covariance,
        residuals=residuals,
        chi2=float(np.einsum("ni,ni->", residuals, np.linalg.solve(fit.wrench_cov, residuals[..., None])[..., 0])),
        dof=6 * len(dataset) - 15,
        noise_source="residuals" if dataset.wrench_cov is None else "measured",
        g_m_s2=g_m_s2,
        method=method,
        verdict="rejected",
        reasons=(),
        provenance={**(provenance or {}), "dataset_sha256": dataset.sha256()},
    )
    evidence = IndependentFit(
        parameters=parameters,
        covariance=covariance,
        R_base_flange=R_base_flange,
        wrench=wrench,
        wrench_cov=fit.wrench_cov,
        measured=dataset.wrench_cov is not None,
        weights=np.ones(len(dataset)),
        second_basin_chi2=fit.second_chi2 - result.chi2,
    )
    quality = judge(evidence, t_s=dataset.t_s)
    return replace(result, verdict=quality.verdict, reasons=quality.reasons)


def _closed_form(dataset: CalibrationDataset, method: Method) -> Estimator | None:
    if method == "srom":
        number, Y = special_numbers(dataset.R_base_flange)
        return partial(srom_numbered, dataset.R_base_flange, number=number, Y=Y)
    if method == "lrom":
        return partial(lrom, dataset.R_base_flange)
    return None


def _starts(dataset: CalibrationDataset) -> list[Parameters]:
    """SROM's result where the 24 orientations are there, else LROM's where it has one."""
    methods: tuple[Method, ...] = ("srom", "lrom")
    for method in methods:
        try:
            estimator = _closed_form(dataset, method)
            return [estimator(dataset.wrench)] if estimator else []
        except NotObservable:
            continue
    return []


def _require_orientations(dataset: CalibrationDataset, least: int) -> None:
    """Refuse what no fit can save, in terms of poses."""
    n = len(dataset)
    if n < least:
        raise NotObservable(f"{n} poses are too few, at least {least} are needed: add {max(6 - n, 1)} or more.")
    kept: list[Array] = []
    for R in dataset.R_base_flange:
        if all(Rotation.from_matrix(R @ other.T).magnitude() > SAME_ORIENTATION_RAD for other in kept):
            kept.append(R)
            if len(kept) == least:
                break
    if len(kept) == 1:
        raise NotObservable(f"all {n} poses have the same orientation: turn and tilt the tool between poses.")
    if len(kept) < least:
        raise NotObservable(
            f"the {n} poses have only {len(kept)} different orientations, at least {least} are needed: "
            "turn and tilt the tool to others."
        )
    if np.ptp(dataset.wrench[:, :3], axis=0).max() == 0:
        raise NotObservable("the force is exactly the same in all poses: the sensor is stuck, or nothing hangs on it.")


def _covariance(information: Array) -> Array:
    """Invert the Fisher information, or name the parameters that trade off against each other."""
    scale = column_scale(information)
    eigenvalues, V = np.linalg.eigh(information / np.outer(scale, scale))
    free = eigenvalues < RANK_TOLERANCE * eigenvalues[-1]
    if free.any():
        share = (V[:, free] ** 2).sum(axis=1).reshape(5, 3).sum(axis=1) / free.sum()
        names = [PARAMETER_NAMES[3 * k].partition(".")[0] for k in np.flatnonzero(share > 0.05)]
        raise NotObservable(
            f"the poses leave {free.sum()} of 15 parameters free, mixing {', '.join(names)}: add poses that tilt the "
            "tool about two different horizontal axes, and turn it about its own."
        )
    return np.asarray(V / eigenvalues @ V.T / np.outer(scale, scale))


def _simulated_covariance(estimator: Estimator, truth: Parameters, R_base_flange: Array, wrench_cov: Array) -> Array:
    """Mean square error of a closed form around its own estimate, by repeating it with simulated noise.

    SROM's cube roots have no derivative where a component of the gravity force vanishes, so errors are not propagated
    linearly. The seed is fixed: the same data give the same numbers.
    """
    rng = np.random.default_rng(20210)
    L = np.linalg.cholesky(wrench_cov)
    exact = predict(truth, R_base_flange)
    errors = [
        truth.difference(estimator(exact + (L @ rng.standard_normal((*exact.shape, 1)))[..., 0]))
        for _ in range(SIMULATIONS)
    ]
    return np.asarray(np.mean([np.outer(error, error) for error in errors], axis=0))
