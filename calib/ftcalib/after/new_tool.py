"""Calibration of a new tool from few poses, and combination of several runs: both reuse parameters of the cell.

`new_tool` uses mounting, direction of gravity, gain and cross-talk of an earlier result, with their covariance, as a
prior. Weight, centre of mass and bias have no prior. The misfit of poses and prior tests whether the prior still holds.

`together` combines runs that were solved separately, each with its own bias, by information-weighted averaging.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtrc as chi2_sf

from ftcalib.after.state import Update, apply_update
from ftcalib.data.dataset import CalibrationDataset, pooled_covariance
from ftcalib.errors import NotObservable
from ftcalib.findings import Finding
from ftcalib.known import RANGE_LEVER_M
from ftcalib.model import BIASES, Array, Parameters, angle_between, angle_between_vectors, predict, skew
from ftcalib.result import CalibrationResult
from ftcalib.sensor_matrix import LOAD, SIZE, Response, response_columns, sensor_error_columns

# False-alarm probability of the test whether the earlier cell parameters still hold.
FALSE_ALARMS = 1e-4
# Indices of the rows of a `CellPrior`: three for the mounting, two for the tilt of the base.
WHOLE = (0, 1, 2, 3, 4)
_MOUNTING, _BASE = WHOLE[:3], WHOLE[3:]

# Function that fits with the given rows of the prior; returns misfit, its degrees of freedom, and parameters.
_Refit = Callable[[Sequence[int]], tuple[float, int, Parameters]]


class CellPrior:
    """Gaussian prior of mounting, direction of gravity and, if the result has them, gain and cross-talk.

    Parameters
    ----------
    earlier : CalibrationResult
        Result of the same sensor, mounting and base, with any tool.
    """

    def __init__(self, earlier: CalibrationResult) -> None:
        self.earlier, gain = earlier, earlier.response
        self.coefficients = np.zeros(0) if gain is None else np.array(gain.coefficients)
        """(11,) coefficients of gain and cross-talk; empty if the earlier result has none."""
        self._covariance = np.array(earlier.joint_covariance)
        # (3, 2) two directions perpendicular to gravity.
        self._across = np.linalg.svd(skew(earlier.parameters.gravity_force_base_N))[0][:, :2]

    @property
    def has_response(self) -> bool:
        """Whether the prior contains gain and cross-talk."""
        return len(self.coefficients) > 0

    def count(self, kept: Sequence[int]) -> int:
        """Return the number of rows of the prior that are used; `kept` has the meaning that it has in `rows`."""
        return len(kept) + len(self.coefficients) * bool(kept)

    def rows(self, p: Parameters, coefficients: Array, kept: Sequence[int] = WHOLE) -> tuple[Array, Array]:
        """Return the derivative (k, 15 or 26) and residual (k,), earlier minus current, in standard deviations.

        Parameters
        ----------
        p : Parameters
            Current parameters.
        coefficients : array, shape (11,) or (0,)
            Current coefficients of gain and cross-talk.
        kept : sequence of int
            Rows of the prior that are used: 0 to 2 for the mounting, 3 and 4 for the base. Gain and cross-talk are
            always used, unless `kept` is empty.
        """
        rows = [*kept, *range(len(WHOLE), len(WHOLE) + len(self.coefficients))] if kept else []
        old = self.earlier.parameters
        before = self._derivative(old)[rows]
        V = before @ self._covariance @ before.T
        # Exactly known values have zero variance; the ridge term keeps the root finite.
        root = np.linalg.inv(np.linalg.cholesky(V + 1e-12 * np.diag(np.diag(V)) + 1e-24 * np.eye(len(V))))
        apart = [p.difference(old)[:3], self._across.T @ (old.down - p.down), self.coefficients - coefficients]
        return root @ self._derivative(p)[rows], root @ np.concatenate(apart)[rows]

    def _derivative(self, p: Parameters) -> Array:
        size = len(self._covariance)
        F, u = p.weight_N, p.down
        rows = np.zeros((len(WHOLE) + size - 15, size))
        rows[:3, :3] = np.eye(3)
        rows[3:5, 3:6] = self._across.T @ (np.eye(3) - np.outer(u, u)) / F
        rows[5:, 15:] = np.eye(size - 15)
        return rows

    def contradiction(self, chi2: float, dof: int, refit: _Refit, data: str, alone: str) -> str:
        """Return a sentence about the part of the prior that contradicts the data; empty if the prior fits.

        Parameters
        ----------
        chi2, dof : float, int
            Misfit with the whole prior, and its degrees of freedom.
        refit : callable
            Function that fits with a part of the prior. May raise `NotObservable`.
        data, alone : str
            Name of the data, and advice for calibrating without the earlier result.
        """
        if not dof or chi2_sf(len(_BASE), chi2) >= FALSE_ALARMS:  # leaving out a part cannot reduce chi2 significantly
            return ""
        explained, old = list[tuple[float, str]](), self.earlier.parameters
        for cause, kept in (("the mounting of the sensor has changed", _BASE), ("the base has tilted", _MOUNTING)):
            try:
                left, freedom, new = refit(kept)
            except NotObservable:
                continue
            # The difference of chi2 is tested, because chi2 over all readings can hide a significant rotation.
            fits = not freedom or chi2_sf(freedom, left) >= FALSE_ALARMS
            if fits and chi2_sf(dof - freedom, chi2 - left) < FALSE_ALARMS:
                turned = float(angle_between(old.R_flange_sensor, new.R_flange_sensor))
                if kept == _MOUNTING:
                    turned = angle_between_vectors(old.down, new.down)
                explained.append((left, f"{cause}, by {np.degrees(turned):.2g}°"))
        if not explained and chi2_sf(dof, chi2) >= FALSE_ALARMS:
            return ""
        misfit = f"chi2 {chi2:.0f} for {dof} degrees of freedom"
        if not explained:
            return (
                f"{data} do not fit mounting and base of {self.earlier.id} ({misfit}): check for contact, or solve "
                "without the earlier result."
            )
        explained.sort()
        causes = " or ".join(text for left, text in explained if left < explained[0][0] + 10)
        return f"{causes} since {self.earlier.id} ({misfit}): {alone}."


# Errors of a sensor whose gain depends on the load, relative to the load: the usual and the largest assumed size.
_LOADS = (LOAD, 0.02)
_MOST_STEPS = 30
# Convergence: squared step in standard deviations.
_SETTLED = 1e-12
_SINGULAR = 1e12
_SIGNIFICANT = 5.0
# Indices of the error coordinates that several runs of one tool share: all except the bias.
_SHARED = np.array([0, 1, 2, 3, 4, 5, 9, 10, 11])


def new_tool(
    earlier: CalibrationResult, dataset: CalibrationDataset, provenance: Mapping[str, Any] | None = None
) -> CalibrationResult:
    """Return the calibration of a tool from few poses, with mounting, base and gain from an earlier result.

    Parameters
    ----------
    earlier : CalibrationResult
        Accepted result of the same sensor, mounting and base.
    dataset : CalibrationDataset
        3 or more poses whose noise was measured; 4 for a meaningful test of the earlier result.
    provenance : mapping, optional
        Origin of the dataset.

    Returns
    -------
    CalibrationResult
        Calibration whose `provenance` names the earlier result as `parent`.

    Raises
    ------
    NotObservable
        The poses do not determine the tool, or contradict the earlier result. The message names mounting or base.
    """
    if dataset.wrench_cov is None:
        raise NotObservable(
            "the noise of the poses was not measured, so the earlier result cannot be tested: leave --from out."
        )
    start = _start(earlier.parameters, dataset.R_base_flange, dataset.wrench)
    noise = pooled_covariance(dataset.wrench_cov, dataset.n_samples)
    prior, data = CellPrior(earlier), "the poses"
    alone = "calibrate this tool alone, with 12 poses or more"
    # The larger load-dependent error of the sensor is assumed only if no change of the cell explains the poses.
    for load in _LOADS:
        weights: Array = np.linalg.inv(noise + np.diag(_beyond(earlier, start, load))).astype(np.float64)
        poses = dataset.R_base_flange, dataset.wrench, weights
        fitted = _fit_tool(prior, *poses, WHOLE)

        def refit(kept: Sequence[int], poses: tuple[Array, Array, Array] = poses) -> tuple[float, int, Parameters]:
            again = _fit_tool(prior, *poses, kept)
            return again.chi2, again.dof, again.parameters

        changed = prior.contradiction(fitted.chi2, fitted.dof, refit, data, alone)
        if not changed.startswith(data):
            break
    if changed:
        raise NotObservable(changed)
    # Variance components of arm and sensor are kept; those of one session, such as drift, are not.
    kept = {name: value for name, value in earlier.components.items() if name in ("rotation_rad", "hysteresis")}
    result = apply_update(earlier, fitted, {**(provenance or {}), "dataset_sha256": dataset.sha256()})
    return replace(result, quality={}, weights=None, components=kept)


def _fit_tool(prior: CellPrior, R_base_flange: Array, wrench: Array, weights: Array, kept: Sequence[int]) -> Update:
    """Return the fit of all parameters with a part of the prior; `kept` as in `CellPrior.rows`."""
    n, k = len(wrench), len(prior.coefficients)
    new, coefficients = _start(prior.earlier.parameters, R_base_flange, wrench), prior.coefficients
    seen = prior.earlier.shown_response
    sigma, unseen = np.sqrt(np.diag(seen.covariance)[15:]), np.zeros(38 if k else 38 + SIZE)
    for _ in range(_MOST_STEPS):
        errors = sensor_error_columns(prior.earlier.parameters, seen, new, R_base_flange)
        if not k:
            errors = np.concatenate([errors, response_columns(new, R_base_flange) * sigma], axis=2)
        J = np.concatenate([prior.earlier.jacobian(R_base_flange, new), errors], axis=2)
        left = wrench - predict(new, R_base_flange) - J[..., 15:] @ np.concatenate([coefficients, unseen])
        known, of_known = prior.rows(new, coefficients, kept)
        A = block_diag(known, np.eye(len(unseen)))
        r = np.concatenate([of_known, -unseen])
        WJ = weights @ J
        H = np.einsum("nij,nik->jk", J, WJ) + A.T @ A
        scale = np.sqrt(np.diag(H))
        if not (scale > 0).all() or np.linalg.cond(H / np.outer(scale, scale)) > _SINGULAR:
            raise NotObservable(f"{n} poses do not determine the tool: add poses with other tilts of the tool.")
        step = np.linalg.solve(H, np.einsum("nij,ni->j", WJ, left) + A.T @ r)
        new, coefficients, unseen = new.moved(step[:15]), coefficients + step[15 : 15 + k], unseen + step[15 + k :]
        if float(step @ H @ step) < _SETTLED:
            break
    else:
        raise NotObservable(f"the fit has not converged in {_MOST_STEPS} steps: check the poses, or solve alone.")
    covariance = np.linalg.inv(H)[: 15 + k, : 15 + k]
    weight_N, sigma_N = new.weight_N, new.weight_sigma_N(covariance)
    if weight_N < _SIGNIFICANT * sigma_N:
        raise NotObservable(f"the tool weighs {weight_N:.2g} N (sigma {sigma_N:.2g} N), too little: check the sensor.")
    chi2 = float(np.einsum("ni,nij,nj->", left, weights, left) + r @ r)
    dof = 6 * n + len(r) - len(H)
    response = Response(coefficients, covariance) if prior.has_response else None
    return Update(new, covariance[:15, :15], chi2, dof, "tool", left, response)


def _start(old: Parameters, R_base_flange: Array, wrench: Array) -> Parameters:
    """Return parameters with weight, centre of mass and bias by linear least squares, for earlier mounting and base."""
    u = old.down @ (R_base_flange @ old.R_flange_sensor)
    A = np.zeros((len(u), 6, 10))
    A[:, :3, 0], A[:, :3, 1:4] = u, np.eye(3)
    A[:, 3:, 4:7], A[:, 3:, 7:] = -skew(u), np.eye(3)
    x: Array = np.linalg.lstsq(A.reshape(-1, 10), wrench.ravel(), rcond=None)[0].astype(np.float64)
    weight_N = max(float(x[0]), 1e-3)
    return Parameters(old.R_flange_sensor, weight_N * old.down, x[1:4], x[4:7] / weight_N, x[7:])


def _beyond(earlier: CalibrationResult, new: Parameters, most: float = LOAD) -> Array:
    """Return the variance (6,) of a pose in excess of its noise, from earlier residuals and their uncertainty.

    It is scaled with the third power of the load, up to the share `most` of the load.
    """
    measured = np.square(np.zeros(6) if earlier.measured_sigma is None else earlier.measured_sigma)
    # Standard deviation of the ratio chi2 / dof.
    hidden = np.sqrt(2 / max(earlier.dof, 1))
    if earlier.noise_explains:
        variance = (max(earlier.chi2 / max(earlier.dof, 1) - 1, 0.0) + hidden) * measured
    else:
        error, names = earlier.likely_error(), ("loo_force_rms_N", "loo_torque_rms_Nm")
        left_out = np.array([earlier.quality.get(name, error[k]) for k, name in enumerate(names)], dtype=np.float64)
        excess = left_out**2 - measured.reshape(2, 3).sum(axis=1)
        variance = np.repeat(np.maximum(excess, 0.0) / 3, 3) + hidden * measured
    level = np.sqrt(variance)
    before_m, now_m = (float(np.linalg.norm(p.p_sensor_com_m)) for p in (earlier.parameters, new))
    forces = earlier.weight_N, new.weight_N
    torques = forces[0] * before_m, forces[1] * max(now_m, RANGE_LEVER_M)
    for channels, (before, now) in ((slice(3), forces), (slice(3, 6), torques)):
        ratio = max(1.0, now / before) if before else 1.0
        level[channels] = np.maximum(level[channels], np.minimum(level[channels] * ratio**3, most * now))
    return np.asarray(level**2)


def together(results: Sequence[CalibrationResult], provenance: Mapping[str, Any] | None = None) -> CalibrationResult:
    """Return the combined result of several runs of one tool on one cell, with the bias of the last run.

    Parameters
    ----------
    results : sequence of CalibrationResult
        Results of runs that were solved separately, the oldest first.

    Returns
    -------
    CalibrationResult
        Combined estimates, with verdict, findings and residuals of the last run.

    Raises
    ------
    NotObservable
        The runs contradict each other in more than the bias.
    """
    if any((np.diag(result.covariance)[_SHARED] <= 0).any() for result in results):
        raise NotObservable("a run has exactly known values: solve the runs without known values.")
    last = results[-1]
    covariances = [result.covariance for result in results]
    differences = [last.parameters.difference(result.parameters) for result in results]
    responses = []
    if any(result.response is not None for result in results):
        responses = [result.shown_response for result in results]
        covariances = [response.covariance for response in responses]
        differences = [
            np.append(off, response.coefficients - responses[-1].coefficients)
            for off, response in zip(differences, responses, strict=True)
        ]
    n = len(differences[-1])
    alike = np.append(_SHARED, np.arange(15, n))
    # Coefficients that were not estimated have no variance.
    alike = alike[np.all([np.diag(C)[alike] > 0 for C in covariances], axis=0)]
    difference = np.array(differences)[:, alike]
    information = np.array([np.linalg.inv(C[np.ix_(alike, alike)]) for C in covariances])
    C = np.linalg.inv(information.sum(axis=0))
    x = C @ np.einsum("kij,kj->i", information, difference)
    rest = difference - x
    chi2, dof = float(np.einsum("ki,kij,kj->", rest, information, rest)), len(alike) * (len(results) - 1)
    if dof and chi2_sf(dof, chi2) < FALSE_ALARMS:
        raise NotObservable(
            f"the runs contradict each other in more than the bias (chi2 {chi2:.0f} for {dof} degrees of freedom): "
            "tool, sensor or base has changed. `ftdrive diff` shows which values differ."
        )
    shared, own = np.ix_(alike, alike), np.arange(n)[BIASES]
    # The bias is that of the last run, corrected by its correlation with the shared parameters.
    before = covariances[-1]
    G = before[np.ix_(own, alike)] @ np.linalg.inv(before[shared])
    step = np.zeros(n)
    step[alike], step[own] = x, G @ x
    covariance = np.zeros((n, n))
    covariance[shared] = C
    covariance[np.ix_(own, alike)] = G @ C
    covariance[np.ix_(alike, own)] = (G @ C).T
    alone = before[np.ix_(own, own)] - G @ before[np.ix_(alike, own)]
    covariance[np.ix_(own, own)] = alone + G @ C @ G.T
    covariance = (covariance + covariance.T) / 2
    response = Response(responses[-1].coefficients + step[15:], covariance) if responses else None
    note = Finding.of("together", n_runs=len(results))
    return replace(
        last,
        parameters=last.parameters.moved(step[:15]),
        covariance=covariance[:15, :15],
        response=response,
        findings=(*last.findings, note),
        provenance={
            **last.provenance,
            **(provenance or {}),
            "together": [result.id for result in results],
            "between_chi2": chi2,
            "between_dof": dof,
        },
    )
