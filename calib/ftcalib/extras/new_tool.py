"""A new tool from few poses, and several runs as one fit: mounting, base and gain belong to the cell, not to the tool.

`new_tool` keeps mounting, direction of gravity, gain and cross-talk of an earlier result. Their covariance counts as an
error common to all readings, so generalised least squares gives weight, centre of mass and bias the estimate and the
sigmas that a prior would. The misfit of the poses tests whether what was kept still holds.

`together` joins runs of one tool whose bias has moved between them: each is solved by itself, and what they share is
the mean weighted by information.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtrc as chi2_sf

from ftcalib.data.dataset import CalibrationDataset
from ftcalib.data.pooling import pooled_covariance
from ftcalib.errors import NotObservable
from ftcalib.extras.update import Update, reestimate, updated
from ftcalib.findings import Finding
from ftcalib.model import BIASES, Array, angle_between
from ftcalib.result import CalibrationResult

FALSE_ALARMS = 1e-4
"""Share of good runs that the test of what was kept rejects."""
_SHARED = np.array([0, 1, 2, 3, 4, 5, 9, 10, 11])
"""Rows of the error coordinates that runs of one tool share."""


def new_tool(
    earlier: CalibrationResult, dataset: CalibrationDataset, provenance: Mapping[str, Any] | None = None
) -> CalibrationResult:
    """Estimate weight, centre of mass and bias of a tool; take the rest from an earlier result with its covariance.

    Parameters
    ----------
    earlier : CalibrationResult
        Accepted, of the same sensor, mounting and base.
    dataset : CalibrationDataset
        3 poses or more whose noise was measured; 4 for a test worth its name.
    provenance : mapping, optional
        Of the dataset.

    Returns
    -------
    CalibrationResult
        Its `provenance` names the earlier result as `parent`.

    Raises
    ------
    NotObservable
        The poses do not determine the tool, or what was kept holds no more: the message names mounting or base.
    """
    if dataset.wrench_cov is None:
        raise NotObservable(
            "the noise of the poses was not measured, so nothing tests the earlier result: leave --from out."
        )
    noise = block_diag(*(pooled_covariance(dataset.wrench_cov, dataset.n_samples) + np.diag(_beyond(earlier))))
    poses = dataset.R_base_flange, dataset.wrench, noise
    found = reestimate(earlier, *poses, "bias and payload")
    if found.dof and chi2_sf(found.dof, found.chi2) < FALSE_ALARMS:
        raise NotObservable(_changed(earlier, found, poses))
    sha256 = {"dataset_sha256": dataset.sha256()}
    result = updated(earlier, found, {**(provenance or {}), **sha256})
    return replace(result, quality={}, weights=None, components=_kept_noise(earlier))


def _kept_noise(earlier: CalibrationResult) -> dict[str, float]:
    """Return the components that belong to the cell: errors of the arm and of the sensor, not of one session."""
    return {name: value for name, value in earlier.components.items() if name in ("rotation_rad", "hysteresis")}


def _beyond(earlier: CalibrationResult) -> Array:
    """Variance (6,) of a pose beyond its noise, where noise alone did not explain the residuals of the earlier fit."""
    if earlier.noise_explains:
        return np.zeros(6)
    excess = np.square(earlier.likely_error()) - np.square(earlier.predicted_error())
    return np.repeat(np.maximum(excess, 0.0) / 3, 3)


def _changed(earlier: CalibrationResult, kept: Update, poses: tuple[Array, Array, Array]) -> str:
    """Name what does not hold any more: what explains the poses when it is estimated too."""
    words = {
        "tool and mounting": ("the sensor is mounted otherwise", "R_flange_sensor"),
        "tool and base": ("the base leans otherwise", "gravity"),
    }
    explained = list[tuple[float, str]]()
    for kind, (what, _) in words.items():
        try:
            found = reestimate(earlier, *poses, kind)
        except NotObservable:
            continue
        if not found.dof or chi2_sf(found.dof, found.chi2) >= FALSE_ALARMS:
            old, new = earlier.parameters, found.parameters
            if kind == "tool and mounting":
                turned = float(angle_between(old.R_flange_sensor, new.R_flange_sensor))
            else:
                a, b = old.gravity_force_base_N, new.gravity_force_base_N
                turned = float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
            explained.append((found.chi2, f"{what}, by {np.degrees(turned):.2g}°"))
    misfit = f"chi2 {kept.chi2:.0f} for {kept.dof} degrees of freedom"
    if not explained:
        return (
            f"the poses do not fit mounting and base of {earlier.id} ({misfit}): check for contact, or calibrate alone."
        )
    explained.sort()
    cause = " or ".join(text for chi2, text in explained if chi2 < explained[0][0] + 10)
    return f"{cause} since {earlier.id} ({misfit}): calibrate this tool alone, from 12 poses or more."


def together(results: Sequence[CalibrationResult], provenance: Mapping[str, Any] | None = None) -> CalibrationResult:
    """Join results of one tool on one cell; the bias is that of the last run.

    Parameters
    ----------
    results : sequence of CalibrationResult
        Of runs that were solved by themselves, the oldest first.
    provenance : mapping, optional

    Returns
    -------
    CalibrationResult
        Verdict, findings and residuals are those of the last run.

    Raises
    ------
    NotObservable
        The runs contradict each other in more than the bias, or a run shows gain and cross-talk.
    """
    if any(one.response is not None for one in results):
        raise NotObservable("a run shows gain or cross-talk of the sensor, and these are not joined: use --from.")
    if any((np.diag(one.covariance)[_SHARED] <= 0).any() for one in results):
        raise NotObservable("a run takes a value as exactly known: solve its runs without known values.")
    last = results[-1]
    difference = np.array([last.parameters.difference(one.parameters)[_SHARED] for one in results])
    information = np.array([np.linalg.inv(one.covariance[np.ix_(_SHARED, _SHARED)]) for one in results])
    C = np.linalg.inv(information.sum(axis=0))
    x = C @ np.einsum("kij,kj->i", information, difference)
    rest = difference - x
    chi2, dof = float(np.einsum("ki,kij,kj->", rest, information, rest)), 9 * (len(results) - 1)
    if dof and chi2_sf(dof, chi2) < FALSE_ALARMS:
        raise NotObservable(
            f"the runs contradict each other in more than the bias (chi2 {chi2:.0f} for {dof} degrees of freedom): "
            "`ftdrive diff` shows in what; tool, sensor or base has changed."
        )
    shared, own = np.ix_(_SHARED, _SHARED), np.arange(15)[BIASES]
    G = last.covariance[np.ix_(own, _SHARED)] @ np.linalg.inv(last.covariance[shared])
    step = np.zeros(15)
    step[_SHARED], step[own] = x, G @ x
    covariance = np.zeros((15, 15))
    covariance[shared] = C
    covariance[np.ix_(own, _SHARED)] = G @ C
    covariance[np.ix_(_SHARED, own)] = (G @ C).T
    alone = last.covariance[np.ix_(own, own)] - G @ last.covariance[np.ix_(_SHARED, own)]
    covariance[np.ix_(own, own)] = alone + G @ C @ G.T
    note = Finding.of("together", n_runs=len(results))
    return replace(
        last,
        parameters=last.parameters.moved(step),
        covariance=(covariance + covariance.T) / 2,
        findings=(*last.findings, note),
        provenance={
            **last.provenance,
            **(provenance or {}),
            "together": [one.id for one in results],
            "between_chi2": chi2,
            "between_dof": dof,
        },
    )
