"""A new tool from few poses, and several runs as one fit: mounting, base and gain belong to the cell, not to the tool.

`new_tool` takes mounting, direction of gravity, gain and cross-talk of an earlier result with their covariance as a
prior. Weight, centre of mass and bias have none. The misfit of poses and prior tests whether they still hold.

`together` joins runs of one tool whose bias has moved between them: each is solved by itself, and what they share is
the mean weighted by information.
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
from ftcalib.sensor_matrix import (
    LOAD,
    SIZE,
    Response,
    response_columns,
    sensor_error_columns,
)

# Share of good runs that the test of what was kept rejects.
FALSE_ALARMS = 1e-4
# Rows of a prior: three of the mounting, two of the base.
WHOLE = (0, 1, 2, 3, 4)
_MOUNTING, _BASE = WHOLE[:3], WHOLE[3:]

# From the rows of the prior that count to the misfit, its degrees of freedom, and the parameters.
_Refit = Callable[[Sequence[int]], tuple[float, int, Parameters]]


class CellPrior:
    """A Gaussian prior of mounting and direction of gravity, and of gain and cross-talk where the result has them.

    Parameters
    ----------
    earlier : CalibrationResult
        A result of the same sensor, mounting and base, with any tool.
    """

    def __init__(self, earlier: CalibrationResult) -> None:
        self.earlier, gain = earlier, earlier.response
        self.coefficients = np.zeros(0) if gain is None else np.array(gain.coefficients)
        """(11,) of gain and cross-talk, or none."""
        self._covariance = np.array(earlier.joint_covariance)
        self._across = np.linalg.svd(skew(earlier.parameters.gravity_force_base_N))[0][:, :2]  # gravity

    @property
    def has_response(self) -> bool:
        """Whether gain and cross-talk are known."""
        return len(self.coefficients) > 0

    def count(self, kept: Sequence[int]) -> int:
        """Return the number of rows; `kept` as of `rows`."""
        return len(kept) + len(self.coefficients) * bool(kept)

    def rows(self, p: Parameters, coefficients: Array, kept: Sequence[int] = WHOLE) -> tuple[Array, Array]:
        """Return the derivative (k, 15 or 26) and the residual (k,), earlier minus present, in standard deviations.

        Parameters
        ----------
        p : Parameters
            The present ones.
        coefficients : array, shape (11,) or (0,)
            Coefficients of gain and cross-talk.
        kept : sequence of int
            Which count: 0 to 2 mounting, 3 and 4 base. Gain and cross-talk do unless it is empty.
        """
        rows = [*kept, *range(len(WHOLE), len(WHOLE) + len(self.coefficients))] if kept else []
        old = self.earlier.parameters
        before = self._derivative(old)[rows]
        V = before @ self._covariance @ before.T
        # Exactly known values have no variance: the ridge keeps the root finite.
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

    def contradiction(self, chi2: float, dof: int, refit: _Refit, what: str, alone: str) -> str:
        """Name what does not hold any more; empty where the prior fits.

        Parameters
        ----------
        chi2, dof : float, int
            Misfit with the whole prior.
        refit : callable
            Fits without a part of it. May raise `NotObservable`.
        what, alone : str
            Name of the data, and how to calibrate without the earlier result.
        """
        if not dof or chi2_sf(len(_BASE), chi2) >= FALSE_ALARMS:  # no part of the prior can lower it by enough
            return ""
        explained, old = list[tuple[float, str]](), self.earlier.parameters
        for cause, kept in (("the sensor is mounted otherwise", _BASE), ("the base leans otherwise", _MOUNTING)):
            try:
                left, freedom, new = refit(kept)
            except NotObservable:
                continue
            # The sum over all readings hides a turn that lowers it clearly.
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
                f"{what} do not fit mounting and base of {self.earlier.id} ({misfit}): check for contact, or solve "
                "alone."
            )
        explained.sort()
        found = " or ".join(text for left, text in explained if left < explained[0][0] + 10)
        return f"{found} since {self.earlier.id} ({misfit}): {alone}."


# Share of a load by which a sensor responds to it otherwise than to a smaller one, at most: usually, and rarely.
_LOADS = (LOAD, 0.02)
_MOST_STEPS = 30
# Squared step in standard deviations.
_SETTLED = 1e-12
_SINGULAR = 1e12
_SIGNIFICANT = 5.0
# Rows of the error coordinates that runs of one tool share.
_SHARED = np.array([0, 1, 2, 3, 4, 5, 9, 10, 11])


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
        Where the dataset comes from.

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
    start = _start(earlier.parameters, dataset.R_base_flange, dataset.wrench)
    noise = pooled_covariance(dataset.wrench_cov, dataset.n_samples)
    prior, poses_in_words = CellPrior(earlier), "the poses"
    alone = "calibrate this tool alone, from 12 poses or more"
    # A response that depends on the load shows at a larger one: in full where no change of the cell explains the poses.
    for load in _LOADS:
        weights: Array = np.linalg.inv(noise + np.diag(_beyond(earlier, start, load))).astype(np.float64)
        poses = dataset.R_base_flange, dataset.wrench, weights
        found = _fit_tool(prior, *poses, WHOLE)

        def refit(kept: Sequence[int], poses: tuple[Array, Array, Array] = poses) -> tuple[float, int, Parameters]:
            again = _fit_tool(prior, *poses, kept)
            return again.chi2, again.dof, again.parameters

        changed = prior.contradiction(found.chi2, found.dof, refit, poses_in_words, alone)
        if not changed.startswith(poses_in_words):
            break
    if changed:
        raise NotObservable(changed)
    # Only the components that belong to the cell are kept: errors of the arm and of the sensor, not of one session.
    kept = {name: value for name, value in earlier.components.items() if name in ("rotation_rad", "hysteresis")}
    result = apply_update(earlier, found, {**(provenance or {}), "dataset_sha256": dataset.sha256()})
    return replace(result, quality={}, weights=None, components=kept)


def _fit_tool(prior: CellPrior, R_base_flange: Array, wrench: Array, weights: Array, kept: Sequence[int]) -> Update:
    """Fit all parameters; `kept` as of `CellPrior.rows`."""
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
        raise NotObservable(f"the fit has not settled in {_MOST_STEPS} steps: check the poses, or solve alone.")
    covariance = np.linalg.inv(H)[: 15 + k, : 15 + k]
    weight_N, sigma_N = new.weight_N, new.weight_sigma_N(covariance)
    if weight_N < _SIGNIFICANT * sigma_N:
        raise NotObservable(f"the weight of the tool is {weight_N:.2g} N, sigma {sigma_N:.2g} N: check the sensor.")
    chi2 = float(np.einsum("ni,nij,nj->", left, weights, left) + r @ r)
    dof = 6 * n + len(r) - len(H)
    response = Response(coefficients, covariance) if prior.has_response else None
    return Update(new, covariance[:15, :15], chi2, dof, "tool", left, response)


def _start(old: Parameters, R_base_flange: Array, wrench: Array) -> Parameters:
    """Take weight, centre of mass and bias by linear least squares with the earlier mounting and base."""
    u = old.down @ (R_base_flange @ old.R_flange_sensor)
    A = np.zeros((len(u), 6, 10))
    A[:, :3, 0], A[:, :3, 1:4] = u, np.eye(3)
    A[:, 3:, 4:7], A[:, 3:, 7:] = -skew(u), np.eye(3)
    x: Array = np.linalg.lstsq(A.reshape(-1, 10), wrench.ravel(), rcond=None)[0].astype(np.float64)
    weight_N = max(float(x[0]), 1e-3)
    return Parameters(old.R_flange_sensor, weight_N * old.down, x[1:4], x[4:7] / weight_N, x[7:])


def _beyond(earlier: CalibrationResult, new: Parameters, most: float = LOAD) -> Array:
    """Variance (6,) of a pose beyond its noise: what noise did not explain, or may have hidden, in the earlier fit.

    What depends on the load grows with its third power, at `most` to this share of the load.
    """
    measured = np.square(np.zeros(6) if earlier.measured_sigma is None else earlier.measured_sigma)
    # One sigma of chi2.
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
    """Join results of one tool on one cell; the bias is that of the last run.

    Parameters
    ----------
    results : sequence of CalibrationResult
        Results of runs that were solved by themselves, the oldest first.
    provenance : mapping, optional

    Returns
    -------
    CalibrationResult
        Verdict, findings and residuals are those of the last run.

    Raises
    ------
    NotObservable
        The runs contradict each other in more than the bias.
    """
    if any((np.diag(one.covariance)[_SHARED] <= 0).any() for one in results):
        raise NotObservable("a run takes a value as exactly known: solve its runs without known values.")
    last = results[-1]
    covariances = [one.covariance for one in results]
    differences = [last.parameters.difference(one.parameters) for one in results]
    responses = []
    if any(one.response is not None for one in results):
        responses = [one.shown_response for one in results]
        covariances = [one.covariance for one in responses]
        differences = [
            np.append(off, one.coefficients - responses[-1].coefficients)
            for off, one in zip(differences, responses, strict=True)
        ]
    n = len(differences[-1])
    alike = np.append(_SHARED, np.arange(15, n))
    # What was not looked for has no variance.
    alike = alike[np.all([np.diag(one)[alike] > 0 for one in covariances], axis=0)]
    difference = np.array(differences)[:, alike]
    information = np.array([np.linalg.inv(one[np.ix_(alike, alike)]) for one in covariances])
    C = np.linalg.inv(information.sum(axis=0))
    x = C @ np.einsum("kij,kj->i", information, difference)
    rest = difference - x
    chi2, dof = float(np.einsum("ki,kij,kj->", rest, information, rest)), len(alike) * (len(results) - 1)
    if dof and chi2_sf(dof, chi2) < FALSE_ALARMS:
        raise NotObservable(
            f"the runs contradict each other in more than the bias (chi2 {chi2:.0f} for {dof} degrees of freedom): "
            "`ftdrive diff` shows in what; tool, sensor or base has changed."
        )
    shared, own = np.ix_(alike, alike), np.arange(n)[BIASES]
    # The bias belongs to the last run: it moves as far as the shared values correlate with it.
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
            "together": [one.id for one in results],
            "between_chi2": chi2,
            "between_dof": dof,
        },
    )
