"""Verification: whether new poses agree with a calibration and, if not, what has changed since.

All residuals are tested jointly. Their covariance holds the noise of the readings, the errors of each pose that the fit
found (`components`), the drift of the bias since, and the uncertainty of the calibration, which all poses share:

    S = noise + J C J' + drift,    chi2 = r' S^-1 r

`ftcalib.after.expected_readings` has its limit, which allows for noise that was estimated from the fit.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ftcalib.after.expected_readings import (
    BiasChange,
    Expected,
    bias_change,
    expected_as_found,
    expected_with_smooth_errors,
)
from ftcalib.after.state import BLOCKS, Update, reestimate
from ftcalib.data.dataset import CalibrationDataset, finite
from ftcalib.errors import BadDataset, NotObservable
from ftcalib.files import JSON
from ftcalib.model import BIASES, Array, Parameters, angle_between_vectors, gravity_wrench, read_only, skew
from ftcalib.result import CalibrationResult

Change = Literal["bias", "payload", "centre of mass", "mounting", "base", "several"]

# Kind of update that makes up for each change.
SINGLE: Mapping[str, Change] = {
    "bias": "bias",
    "weight": "payload",
    "payload": "payload",
    "centre of mass": "centre of mass",
    "mounting": "mounting",
    "base": "base",
}
SEVERAL = ("bias and payload", "all")
# Each parameter must lower chi2 by more than this: one in 200 does by chance.
COST = 8.0
# Probability of the remaining misfit below which a change does not explain the readings.
UNEXPLAINED = 1e-3
# Two changes whose chi2 differ by less are not distinguished: odds of 100 to 1.
INDISTINCT = 9.2
FEWEST = 2


@dataclass(frozen=True, slots=True, eq=False)
class Verification:
    """Result of a verification; arrays are read-only."""

    residual: Array
    """(n, 6) measured minus predicted, N and N·m, in the sensor frame."""
    predicted_sigma: Array
    """(n, 6) standard deviation of that: noise, drift and uncertainty of the calibration."""
    chi2: float
    """Chi2 of all residuals together."""
    dof: int
    p_value: float
    """Probability of a larger chi2 if nothing has changed."""
    passed: bool
    change: Change | None
    """What has changed; None if passed, or if no change explains the readings."""
    reason: str
    bias_change: BiasChange
    """Change of the six biases, as if nothing else had changed."""
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
            "bias_change": self.bias_change.to_dict(),
            "update": None if update is None else {"kind": update.kind, "chi2": update.chi2, "dof": update.dof},
        }


def verify(
    calibration: CalibrationResult,
    R_base_flange: Array,
    wrench: Array,
    wrench_cov: Array,
    *,
    fitted: CalibrationDataset | None = None,
    false_alarms: float = 0.01,
) -> Verification:
    """Test whether new poses agree with a calibration; on an alarm, name the change and propose the smallest update.

    An alarm is a p-value below `false_alarms` under both explanations of what acted on the fit: the components that it
    found, and smooth errors of sensor, arm and cable. The change is named under the one that makes the new readings
    likeliest.

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
        Covariance of those means, pooled if they come from fewer than 100 samples (`ftcalib.data.dataset`).
    fitted : CalibrationDataset, optional
        The poses of the calibration. They show how uncertain the noise is that a fit of few poses found, see
        `ftcalib.after.expected_readings`.
    false_alarms : float
        Share of unchanged sensors that do not pass, in poses like those of the calibration. In others it is about
        three times as large where arm, cable or sensor do more than usual.

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
    if fitted is not None and len(fitted) != calibration.n_poses:
        raise BadDataset(f"{len(fitted)} poses are not those of the calibration, which has {calibration.n_poses}.")
    explanations = [[expected_as_found(calibration, R_base_flange, wrench_cov)]]

    def probability(kind: list[Expected]) -> float:
        return sum(one.weight * one.p_value(one.distance(R_base_flange, wrench)[2], 6 * n) for one in kind)

    p_values = [probability(explanations[0])]
    # The second explanation has the larger sigma, so it is asked only where the first fails.
    if fitted is not None and p_values[0] < false_alarms:
        smooth = expected_with_smooth_errors(calibration, fitted, R_base_flange, wrench_cov)
        if smooth:
            explanations.append(smooth)
            p_values.append(probability(smooth))
    likeliest = [max(kind, key=lambda one: one.weight) for kind in explanations]
    # An alarm needs both explanations to fail: the sensor that passes under one of them may be unchanged.
    p_value = max(p_values)
    if p_value >= false_alarms:
        return _compare(likeliest[p_values.index(p_value)], p_value, R_base_flange, wrench, passed=True)
    changes = [_changes(calibration, one, R_base_flange, wrench) for one in likeliest]
    best = min(range(len(changes)), key=lambda k: min((cost for cost, _ in changes[k].values()), default=np.inf))
    alarm = _compare(likeliest[best], p_value, R_base_flange, wrench, passed=False)
    return _explain(alarm, calibration, changes[best])


def _compare(expected: Expected, p_value: float, R_base_flange: Array, wrench: Array, *, passed: bool) -> Verification:
    residual, sigma, chi2 = expected.distance(R_base_flange, wrench)
    n = len(wrench)
    return Verification(
        residual=residual,
        predicted_sigma=sigma,
        chi2=chi2,
        dof=6 * n,
        p_value=p_value,
        passed=passed,
        change=None,
        reason=f"the {n} poses agree with the calibration (chi2 {chi2:.0f} for {6 * n} readings, p {p_value:.2g})",
        bias_change=bias_change(expected, R_base_flange, wrench),
    )


def _changes(
    calibration: CalibrationResult, expected: Expected, R_base_flange: Array, wrench: Array
) -> dict[str, tuple[float, Update]]:
    """Find the changes that explain the readings: -2 log likelihood plus the cost of the parameters, and the update."""
    dof = wrench.size
    unchanged = expected.deviance(expected.distance(R_base_flange, wrench)[2], dof)
    logdet = float(np.linalg.slogdet(expected.noise + expected.common(R_base_flange))[1])
    logdet += dof * float(np.log(expected.factor))
    found = {}
    for kind in (*SINGLE, *SEVERAL):
        try:
            update = reestimate(expected.calibration, R_base_flange, wrench, expected.noise, kind)
            if "centre of mass" in BLOCKS[kind] and calibration.gain_sigma:
                noise = expected.noise + _turned_shift(calibration, update.parameters, R_base_flange)
                update = reestimate(expected.calibration, R_base_flange, wrench, noise, kind)
        except NotObservable:
            continue
        cost = expected.deviance(update.chi2, dof) + COST * (dof - update.dof)
        if cost < unchanged and expected.p_value(update.chi2, update.dof) > UNEXPLAINED:
            found[kind] = logdet + cost, update
    return found


def _explain(
    alarm: Verification, calibration: CalibrationResult, found: Mapping[str, tuple[float, Update]]
) -> Verification:
    """Name the change, with the update that makes up for it."""
    misfit = f"chi2 {alarm.chi2:.0f} for {alarm.dof} readings"
    single = sorted((kind for kind in found if kind in SINGLE), key=lambda kind: found[kind][0])
    if single:
        least, update = found[single[0]]
        change = SINGLE[single[0]]
        blocks = set(BLOCKS[single[0]])
        # A payload includes its weight: such a pair is no alternative, but more of the same.
        apart = [kind for kind in single if not (blocks <= set(BLOCKS[kind]) or blocks >= set(BLOCKS[kind]))]
        others = tuple(dict.fromkeys(SINGLE[kind] for kind in apart if found[kind][0] < least + INDISTINCT))
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


def _turned_shift(calibration: CalibrationResult, new: Parameters, R_base_flange: Array) -> Array:
    """Give the covariance (6n, 6n) of what the gain makes of a shift of the centre of mass.

    The antisymmetric part a of the gain turns all forces as the mounting does, which the calibration cannot separate.
    The torque does not turn with them: of a shift d it is d x (u - a x u), if u is the weight as the forces show it.
    """
    shift = skew(new.p_sensor_com_m - calibration.p_sensor_com_m)
    columns = np.zeros((len(R_base_flange), 6, 3))
    columns[:, 3:] = shift @ skew(gravity_wrench(new, R_base_flange)[:, :3])
    columns = calibration.gain_sigma * columns.reshape(-1, 3)
    return np.asarray(columns @ columns.T)


def _in_words(calibration: CalibrationResult, update: Update) -> str:
    old, new = calibration.parameters, update.parameters
    error = old.difference(new)
    words = []
    before_N, after_N = old.weight_N, new.weight_N
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
        turned_rad = angle_between_vectors(old.gravity_force_base_N, new.gravity_force_base_N)
        words.append(f"gravity has turned in the base by {np.rad2deg(turned_rad):.2g}°")
    return ", ".join(words)
