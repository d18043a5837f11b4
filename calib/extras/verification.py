"""Verification: whether new poses agree with a calibration and, if not, what has changed since.

All residuals are tested jointly. Their covariance holds the noise of the readings, the errors of each pose that the fit
found (`components`), the drift of the bias since, and the uncertainty of the calibration, which all poses share:

    S = noise + J C J' + drift,    chi2 = r' S^-1 r
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import chdtrc as chi2_sf
from scipy.special import fdtrc as f_sf

from calib.compensation import Compensator
from calib.data.dataset import finite
from calib.errors import BadDataset, NotObservable
from calib.extras.update import BLOCKS, Update, reestimate
from calib.files import JSON
from calib.likelihood.gain_and_cross_talk import response_columns
from calib.model import BIASES, Array, jacobian, read_only
from calib.result import CalibrationResult

Change = Literal["bias", "payload", "centre of mass", "mounting", "base", "several"]

SINGLE: Mapping[str, Change] = {
    "bias": "bias",
    "weight": "payload",
    "payload": "payload",
    "centre of mass": "centre of mass",
    "mounting": "mounting",
    "base": "base",
}
"""Kind of update that makes up for each change."""
SEVERAL = ("bias and payload", "all")
COST = 8.0
"""Each parameter must lower chi2 by more than this: one in 200 does by chance."""
UNEXPLAINED = 1e-3
"""Probability of the remaining misfit below which a change does not explain the readings."""
INDISTINCT = 9.2
"""Two changes whose chi2 differ by less are not distinguished: odds of 100 to 1."""
FEWEST = 2

_AXES = {name: [k] for k, name in enumerate(("fx_N", "fy_N", "fz_N", "tx_Nm", "ty_Nm", "tz_Nm"))}
_CHANNELS = _AXES | {"force_N": [0, 1, 2], "torque_Nm": [3, 4, 5]}


@dataclass(frozen=True, slots=True, eq=False)
class Verification:
    """Result of a verification; arrays are read-only."""

    residual: Array
    """(n, 6) measured minus predicted, N and N·m, in the sensor frame."""
    predicted_sigma: Array
    """(n, 6) standard deviation of that: noise, drift and uncertainty of the calibration."""
    chi2: float
    """Of all residuals together."""
    dof: int
    p_value: float
    """Probability of a larger chi2 if nothing has changed."""
    passed: bool
    change: Change | None
    """What has changed; None if passed, or if no change explains the readings."""
    reason: str
    alternatives: tuple[Change, ...] = ()
    """Other changes that explain the readings as well."""
    update: Update | None = None
    """The smallest update that makes up for the change; None if passed, or if none does."""

    def __post_init__(self) -> None:
        for name in ("residual", "predicted_sigma"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def to_dict(self) -> dict[str, JSON]:
        """Return the content as JSON; `update` is its kind, chi2 and dof."""
        update = self.update
        return {
            "passed": self.passed,
            "change": self.change,
            "alternatives": list(self.alternatives),
            "reason": self.reason,
            "chi2": self.chi2,
            "dof": self.dof,
            "p_value": self.p_value,
            "residual": self.residual.tolist(),
            "predicted_sigma": self.predicted_sigma.tolist(),
            "update": None if update is None else {"kind": update.kind, "chi2": update.chi2, "dof": update.dof},
        }


@dataclass(frozen=True, slots=True, eq=False)
class _Expected:
    """What unchanged readings scatter by."""

    calibration: Update
    """The calibration, with the drift of the bias since then in its covariance."""
    noise: Array
    """(6n, 6n) of the new readings: measured noise, errors of each pose, drift from the first to each."""
    freedom: float
    """Degrees of freedom from which the fit estimated this noise; infinite if all of it was measured."""

    def p_value(self, chi2: float, dof: int) -> float:
        """Probability of a larger chi2."""
        return float(chi2_sf(dof, chi2) if np.isinf(self.freedom) else f_sf(dof, self.freedom, chi2 / dof))

    def deviance(self, chi2: float, dof: int) -> float:
        """-2 log likelihood: chi2, or that of Student's distribution if the noise was estimated."""
        return chi2 if np.isinf(self.freedom) else (self.freedom + dof) * float(np.log1p(chi2 / self.freedom))


def verify(
    calibration: CalibrationResult,
    R_base_flange: Array,
    wrench: Array,
    wrench_cov: Array,
    *,
    false_alarms: float = 0.01,
) -> Verification:
    """Test whether new poses agree with a calibration; on an alarm, name the change and propose the smallest update.

    Each change is a model that estimates some parameters again and keeps the others with their uncertainty. It explains
    the readings unless its remaining misfit exceeds that of 999 in 1000 good fits. Of these changes, the one with the
    lowest chi2 plus 8 a parameter is named. If there is none, bias and payload together are tried, then all.

    Parameters
    ----------
    calibration : CalibrationResult
    R_base_flange : array, shape (n, 3, 3)
        n >= 2 poses that were not used in the calibration, in the order of measuring. 6 separate all causes.
    wrench : array, shape (n, 6)
        Mean readings of the free tool as measured, N and N·m, in the sensor frame.
    wrench_cov : array, shape (n, 6, 6)
        Covariance of those means, pooled if they come from fewer than 100 samples (`calib.data.pooling`).
    false_alarms : float
        Share of unchanged sensors that do not pass.

    Raises
    ------
    BadDataset
        Fewer than two poses, or shapes that do not fit each other.
    """
    n = len(wrench)
    if n < FEWEST:
        raise BadDataset(f"{n} {'pose is' if n == 1 else 'poses are'} too few for a verification: record 2 or more.")
    R_base_flange, wrench = finite("R_base_flange", R_base_flange, (n, 3, 3)), finite("wrench", wrench, (n, 6))
    wrench_cov = finite("wrench_cov", wrench_cov, (n, 6, 6))
    if not 0 < false_alarms < 1:
        raise ValueError(f"false_alarms is {false_alarms}, expected a share between 0 and 1")
    expected = _expected(calibration, R_base_flange, wrench_cov)
    p, response = calibration.parameters, expected.calibration.response
    residual = np.asarray(Compensator(p, response=response).batch(wrench, R_base_flange), dtype=np.float64)
    J, C = jacobian(p, R_base_flange), expected.calibration.covariance
    if response is not None:
        J, C = np.concatenate([J, response_columns(p, R_base_flange)], axis=2), response.covariance
    K = J.reshape(6 * n, -1)
    S = expected.noise + K @ C @ K.T
    chi2, dof = float(residual.ravel() @ np.linalg.solve(S, residual.ravel())), 6 * n
    p_value = expected.p_value(chi2, dof)
    unchanged = Verification(
        residual=residual,
        predicted_sigma=np.sqrt(np.diag(S)).reshape(n, 6),
        chi2=chi2,
        dof=dof,
        p_value=p_value,
        passed=p_value >= false_alarms,
        change=None,
        reason=f"the {n} poses agree with the calibration (chi2 {chi2:.0f} for {dof} readings, p {p_value:.2g})",
    )
    if unchanged.passed:
        return unchanged
    return _explained(unchanged, calibration, expected, R_base_flange, wrench)


def _explained(
    alarm: Verification, calibration: CalibrationResult, expected: _Expected, R_base_flange: Array, wrench: Array
) -> Verification:
    """Name the change, with the update that makes up for it."""
    misfit = f"chi2 {alarm.chi2:.0f} for {alarm.dof} readings"
    found: dict[str, tuple[float, Update]] = {}
    for kind in (*SINGLE, *SEVERAL):
        try:
            update = reestimate(expected.calibration, R_base_flange, wrench, expected.noise, kind)
        except NotObservable:
            continue
        cost = expected.deviance(update.chi2, alarm.dof) + COST * (alarm.dof - update.dof)
        if cost < expected.deviance(alarm.chi2, alarm.dof) and expected.p_value(update.chi2, update.dof) > UNEXPLAINED:
            found[kind] = cost, update
    single = sorted((kind for kind in found if kind in SINGLE), key=lambda kind: found[kind][0])
    if single:
        least, update = found[single[0]]
        change = SINGLE[single[0]]
        near = [kind for kind in single if found[kind][0] < least + INDISTINCT and not _nested(kind, single[0])]
        others = tuple(dict.fromkeys(SINGLE[kind] for kind in near))
        reason = f"{_in_words(calibration, update)} ({misfit}, {update.chi2:.0f} after the update)"
        if others:
            reason += (
                f"; these poses do not distinguish it from a change of {' or '.join(others)}: verify with more poses"
            )
        return replace(alarm, change=change, alternatives=others, update=update, reason=reason)
    for kind in SEVERAL:
        if kind in found:
            update = found[kind][1]
            what = "bias and payload" if kind == "bias and payload" else "several quantities"
            reason = f"{what} have changed: {_in_words(calibration, update)} ({misfit})"
            return replace(alarm, change="several", update=update, reason=reason)
    worst = int(np.argmax(np.linalg.norm(alarm.residual / alarm.predicted_sigma, axis=1)))
    force_N, torque_Nm = (float(np.linalg.norm(alarm.residual[worst, c])) for c in (slice(3), slice(3, 6)))
    return replace(
        alarm,
        reason=f"no change of bias, payload, mounting or base explains the readings ({misfit}; the farthest is pose "
        f"{worst + 1} with {force_N:.2g} N and {torque_Nm:.2g} N·m): free tool and cables and verify again with 6 "
        "poses or more, or calibrate again",
    )


def _nested(a: str, b: str) -> bool:
    """Whether one kind of update estimates all that the other does."""
    return set(BLOCKS[a]) <= set(BLOCKS[b]) or set(BLOCKS[b]) <= set(BLOCKS[a])


def _in_words(calibration: CalibrationResult, update: Update) -> str:
    """Describe how much has changed."""
    old, new = calibration.parameters, update.parameters
    error = old.difference(new)
    words = []
    before_N, after_N = (float(np.linalg.norm(p.gravity_force_base_N)) for p in (old, new))
    if before_N != after_N and update.kind != "base":
        words.append(f"the payload has changed by {1e3 * (after_N - before_N) / calibration.g_m_s2:+.0f} g")
    if error[9:12].any():
        words.append(f"the centre of mass has moved by {1e3 * np.linalg.norm(error[9:12]):.1f} mm")
    if error[BIASES].any():
        force_N, torque_Nm = np.linalg.norm(error[6:9]), np.linalg.norm(error[12:15])
        words.append(f"the bias has changed by {force_N:.2g} N and {torque_Nm:.2g} N·m")
    if error[:3].any():
        words.append(f"the sensor has turned on the flange by {np.rad2deg(np.linalg.norm(error[:3])):.2g}°")
    if update.kind in ("base", "all"):
        across = float(np.linalg.norm(np.cross(old.gravity_force_base_N, new.gravity_force_base_N)))
        along = float(old.gravity_force_base_N @ new.gravity_force_base_N)
        words.append(f"gravity has turned in the base by {np.rad2deg(np.arctan2(across, along)):.2g}°")
    return ", ".join(words)


def _expected(calibration: CalibrationResult, R_base_flange: Array, wrench_cov: Array) -> _Expected:
    """Add up what the fit found beyond the measured noise, as if the new poses continued the tour.

    A random walk of variance q² a pose moves the bias by q² (N / 3 + 1) from its mean over the N poses of the tour to
    the first new pose. A linear drift goes on for as long as the tour.
    """
    n, later = len(wrench_cov), np.arange(len(wrench_cov), dtype=np.float64)
    n_used = calibration.n_poses - len(calibration.rejected_poses)
    measured = np.zeros((n, 6, n, 6))
    measured[range(n), :, range(n)] = wrench_cov
    parts, gap = [], np.zeros(6)
    for name, sigma in _components(calibration).items():
        kind, _, channels = name.partition("_")
        part, since = np.zeros((n, 6, n, 6)), np.zeros(6)
        c = _CHANNELS.get(channels, [])
        freedom = len(c) * calibration.dof / 6
        if kind == "walk":
            part[:, c, :, c], since[c] = sigma**2 * np.minimum.outer(later, later), sigma**2 * (n_used / 3 + 1)
            freedom = len(c) * (n_used - 1) / 2  # the other half is that of the white noise
        elif kind == "slope":
            part[:, c, :, c], since[c] = sigma**2 * np.outer(later, later) / n_used**2, sigma**2
            freedom = len(c)
        elif kind == "rotation":  # turns about gravity do not show
            turn = jacobian(calibration.parameters, R_base_flange)[..., :3]
            part[range(n), :, range(n)] = sigma**2 * turn @ np.swapaxes(turn, 1, 2)
            freedom = max(2 * n_used - 6, 2)
        elif kind == "white":  # with unmeasured noise all of it
            known = np.zeros_like(wrench_cov) if calibration.noise_source == "measured" else wrench_cov
            for k in c:
                part[range(n), k, range(n), k] = np.maximum(sigma**2 - known[:, k, k], 0.0)
        else:  # gain and cross-talk act through the response
            continue
        gap += since
        part[:, range(6), :, range(6)] += since[:, None, None]
        parts.append((part.reshape(6 * n, 6 * n), freedom))
    # Satterthwaite: the variances of independent estimates add up, each by its share of the noise
    total = measured.reshape(6 * n, 6 * n) + sum((part for part, _ in parts), np.zeros((6 * n, 6 * n)))
    inverse = np.linalg.inv(total)
    spread = sum((float(np.vdot(inverse, part)) / (6 * n)) ** 2 / freedom for part, freedom in parts)
    noise = total - np.kron(np.ones((n, n)), np.diag(gap))
    return _Expected(_drifted(calibration, gap), noise, 1 / spread if spread else np.inf)


def _components(calibration: CalibrationResult) -> Mapping[str, float]:
    """Components of the noise, and a linear drift that was part of the model."""
    found = dict(calibration.components)
    if calibration.drift is not None and not any(name.startswith(("walk", "slope")) for name in found):
        found |= {f"slope_{name}": float(abs(calibration.drift.change[c[0]])) for name, c in _AXES.items()}
    return found


def _drifted(calibration: CalibrationResult, gap: Array) -> Update:
    """Add variances (6,) of the bias to the covariance of a calibration."""
    covariance, response = calibration.covariance.copy(), calibration.response
    covariance[BIASES, BIASES] += gap
    if response is not None:
        joint = response.covariance.copy()
        joint[BIASES, BIASES] += gap
        response = replace(response, covariance=joint)
    return Update(calibration.parameters, covariance, 0.0, 0, response=response)
