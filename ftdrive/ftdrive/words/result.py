"""Texts about the result of a calibration, and about a verification."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from ftcalib import CalibrationResult
from ftcalib.accuracy import CONTACT_N, compensation_error, force_sigma_at_tip, uncompensated
from ftcalib.rounding import counted, to_place_of, with_sigma
from ftcalib.routine import DriftCheck, PoseRecord
from ftcalib.sensor_matrix import LEAST_COMMON_GAIN
from ftcalib.shown import shown_estimates, values_of
from ftdrive.runs.pose_hints import find_moved, hints, pose_names
from ftdrive.runs.verification import FALSE_ALARMS, Verified
from ftdrive.words.text import TextLine

# Largest number of findings shown, so that verdict, findings and next command fit on one screen.
_MOST_FINDINGS = 3
# The compensation error in any orientation, or an hour later, is shown if larger by more than this factor.
_WORSE = 1.2
_ELSEWHERE: Sequence[tuple[str, Literal["workspace", "hour"]]] = (
    ("in any orientation", "workspace"),
    ("after an hour", "hour"),
)
# Values below this, in N, N·m or as a fraction of a mass, are rounding errors.
_ROUNDING = 1e-9
SIGMA_OF_THE_TOOL = (
    "that of mounting, weight and centre of mass includes errors of sensor, arm and mounts; the "
    "compensation error does not, because there they cancel"
)


def estimate_rows(
    document: Mapping[str, Any], truth: Mapping[str, Any] | None = None
) -> Iterator[tuple[str, int, str, str, str, str]]:
    """Yield for each estimated number in a result's JSON: key, axis, and as texts name, true value, value, sigma."""
    for one in shown_estimates(document):
        label, scale, unit, key, values, sigmas, fixed = one
        truths = values_of(truth[key], key) * scale if truth is not None and key in truth else None
        for i, axis in enumerate(one.axes):
            sigma = 0.0 if fixed[i] else float(sigmas[i] * scale)
            known = "" if truths is None else to_place_of(truths[i], sigma)
            name, value = f"{label} {axis}".strip() + f", {unit}", to_place_of(values[i] * scale, sigma)
            yield key, i, name, known, value, "fixed" if fixed[i] else to_place_of(sigma, sigma)


def mass_in_words(result: CalibrationResult) -> str | None:
    """Return the mass with its sigma from the sensor's scale and that of the session; None if either sigma is zero."""
    session_kg = result.parameters.weight_sigma_N(result.covariance) / result.g_m_s2
    if session_kg < _ROUNDING * result.mass_kg or result.scale_sigma <= LEAST_COMMON_GAIN:
        return None
    mass, session = (to_place_of(value, session_kg) for value in (result.mass_kg, session_kg))
    return f"{mass} kg ± {100 * result.scale_sigma:.2g} % (scale of the sensor) ± {session} kg (this session)"


def error_in_words(result: CalibrationResult) -> str:
    """Return a text with the expected compensation error of a free tool, and where or when it is larger."""
    likely = result.likely_error()
    words = "{:.4f} N, {:.5f} N·m rms".format(*likely)
    if result.noise_explains and (likely == result.predicted_error()).all():
        return f"{words} (predicted)"
    if result.motion is not None:
        smooth, near = "with smooth errors of arm, cable and load", "near the orientations of the recording"
        kind = near if result.noise_explains else smooth
    else:
        kind = "predicted" if result.noise_explains else "cross-validated"
    larger = ""
    for elsewhere, where in _ELSEWHERE:
        error = result.likely_error(where)
        if error[0] > _WORSE * likely[0]:
            larger += "; {} {} N, {} N·m".format(elsewhere, *map(_two_digits, error))
    return f"{words} ({kind}{larger})"


def error_source(result: CalibrationResult) -> str:
    """Describe how the compensation error was determined, and state the error predicted from noise alone."""
    sources = ["predicted from the noise: {:.4f} N, {:.5f} N·m".format(*result.predicted_error())]
    if result.motion is None and not result.noise_explains:
        why = "the noise was not measured" if result.p_value is None else "the residuals exceed the noise"
        sources.append(f"cross-validated, because {why}")
    if any(result.quality.get("bias_growth_per_min", ())):
        sources.append("a minute after the tour, with the drift")
    return "; ".join(sources)


def conclusion(
    result: CalibrationResult,
    *,
    drift: DriftCheck | None = None,
    records: Sequence[PoseRecord] = (),
    hinted: bool = True,
    every: bool = False,
) -> list[TextLine]:
    """Return the lines of text about a result: compensation error, findings and what to do.

    Without `every`, include at most three findings that need an action, one per code, so that verdict and next command
    stay on one screen.

    Parameters
    ----------
    result : CalibrationResult
    drift : DriftCheck, optional
    records : sequence of PoseRecord
        Records of the solved poses, to name the poses and to explain those that fit badly.
    hinted : bool
        Include hints about what to check in the cell.
    every : bool
        Include everything: all findings, the residuals, what sigma includes.
    """
    lines = [TextLine("", f"compensation error {error_in_words(result)}")]
    if every:
        lines.append(TextLine(" its source: ", error_source(result)))
        if (mass := mass_in_words(result)) is not None:
            lines += [TextLine(" sigma: ", SIGMA_OF_THE_TOOL), TextLine(" mass as read: ", mass)]
    if result.verdict != "rejected":
        lines.append(TextLine(" under contact: ", contact_in_words(result)))
    first = {one.code: one for one in reversed(result.findings) if one.fix or one.severity != "note"}
    pressing = [one for one in result.findings if first.get(one.code) is one]
    shown = result.findings if every else pressing[:_MOST_FINDINGS]
    for one in shown:
        lines.append(TextLine("   ", one.found))
        lines += [TextLine("     fix: ", one.fix)] if one.fix else []
    if others := len(result.findings) - len(shown):
        lines.append(TextLine("   ", f"{counted(others, 'more finding')}: add --all", "dim"))
    for contact in () if result.motion is None else result.motion.contacts:
        words = "{t_s:.1f} s for {duration_s:.1f} s, up to {force_N:.1f} N, {torque_Nm:.2f} N·m".format(**contact)
        lines.append(TextLine(" contact: at ", words))
    if every and result.motion is None:
        lines.append(TextLine(" residuals: ", residuals_in_words(result)))
        if (poses := _poses_in_words(result, pose_names(records))) is not None:
            lines.append(TextLine(" worst: ", poses))
    lines += _drift_lines(result, drift, every=every)
    return lines + [TextLine(" ? ", one.words, "yellow") for one in hints(result, records) if hinted or every]


def _first_pose_again(drift: DriftCheck | None, *, every: bool) -> list[TextLine]:
    if drift is None:
        return []
    words, bad = drift_in_words(drift)
    return [TextLine(" drift: ", words, "yellow" if bad else "")] if bad or every else []


def _drift_lines(result: CalibrationResult, drift: DriftCheck | None, *, every: bool) -> list[TextLine]:
    lines = _first_pose_again(drift, every=every)
    if result.drift is not None:
        change, sigma = result.drift.change, result.drift.sigma
        words = (
            f"{with_sigma(np.linalg.norm(change[:3]), np.max(sigma[:3]))} N, "
            f"{with_sigma(np.linalg.norm(change[3:]), np.max(sigma[3:]))} N·m from the first pose to the last"
        )
        lines.append(TextLine(" drift in the fit: ", words))
        if (ahead := drift_in_use(result)) is not None:
            lines.append(TextLine(" next use: ", f"{ahead}. Tare before use."))
    return lines


def _two_digits(value: float) -> str:
    return "0" if value < _ROUNDING else to_place_of(value, value)


def sensor_in_words(result: CalibrationResult) -> str:
    """Return a text about the source of the sensor errors under contact: assumed, data sheet, or known loads."""
    sensor = result.sensor
    if sensor is None or sensor.source == "assumed":
        return "assumed, not measured"
    if sensor.source == "data sheet":
        return "from the data sheet"
    made = sensor.provenance.get("created_utc")
    return "known from loads" + (f", sensor.json of {made[:16].replace('T', ' ')}" if isinstance(made, str) else "")


def contact_in_words(result: CalibrationResult) -> str:
    """Return a text with the sigma of a contact force at the tool tip, and the source of the sensor errors in it."""
    sigma_N = float(force_sigma_at_tip(result))
    return f"{CONTACT_N:g} N at the tip ± {sigma_N:.2g} N (1 sigma); errors of the sensor are {sensor_in_words(result)}"


def drift_in_use(result: CalibrationResult) -> str | None:
    """Return a text about the bias's change after the last pose; None without drift, or for a calibration in motion."""
    growth = np.array(result.quality.get("bias_growth_per_min", ()))
    if result.mean_bias is None or not growth.size:
        return None
    off, grow = (
        "{} N, {} N·m".format(*(_two_digits(float(np.linalg.norm(part))) for part in np.split(values, 2)))
        for values in (result.parameters.bias - result.mean_bias, growth)
    )
    return f"the result has the bias of the last pose, {off} from the mean; it changes by {grow} per minute"


def _poses_in_words(result: CalibrationResult, names: Sequence[str] = ()) -> str | None:
    quality = result.quality
    if not quality:
        return None
    row = int(quality["worst_pose"])
    worst = names[row - 1] if names else f"pose {row}"
    return (
        f"{worst}, {quality['residual_sigma'][row - 1]:.1f} sigma; each pose predicted by the others: "
        f"{quality['loo_force_rms_N']:.4f} N, {quality['loo_torque_rms_Nm']:.5f} N·m rms"
    )


def truth_in_words(result: CalibrationResult, truth: Mapping[str, Any]) -> str:
    """Return a text with the readings of a free tool after and before compensation, computed from the truth."""
    left = compensation_error(result, truth)
    return (
        f"a free tool reads {left['force_rms_N']:.4f} N, {left['torque_rms_Nm']:.5f} N·m rms; "
        "before {:.1f} N, {:.2f} N·m".format(*uncompensated(truth))
    )


def residuals_in_words(result: CalibrationResult) -> str:
    """Return a text with the residuals of the fit."""
    residual = result.to_dict()["residual"]
    return (
        f"force {residual['force_rms_N']:.4f} N rms, {residual['force_max_N']:.4f} max; "
        f"torque {residual['torque_rms_Nm']:.5f} N·m rms, {residual['torque_max_Nm']:.5f} max"
    )


def drift_in_words(drift: DriftCheck) -> tuple[str, bool]:
    """Return a text about the change of the first pose when repeated at the end; True if it exceeds the noise."""
    worst = float(np.max(np.abs(drift.change) / drift.sigma))
    force_N, torque_Nm = np.linalg.norm(drift.change[:3]), np.linalg.norm(drift.change[3:])
    apart_s = abs(drift.elapsed_s)
    again = f"first pose again after {apart_s:.0f} s"
    if drift.elapsed_s < 0:  # `--redo 1` takes the first pose last
        again = f"first pose, repeated {apart_s:.0f} s after the return to it"
    words = f"{again}, {force_N:.3f} N, {torque_Nm:.4f} N·m away: "
    if worst < 4:
        return words + "none seen", False
    minutes = max(apart_s, 1.0) / 60
    in_force = np.max(np.abs(drift.change[:3]) / drift.sigma[:3]) >= 4
    rate = f"{force_N / minutes:.2g} N/min" if in_force else f"{torque_Nm / minutes:.2g} N·m/min"
    return words + rate, True


def verification_in_lines(verified: Verified, *, every: bool = False) -> list[TextLine]:
    """Return lines of text about a verification: largest differences with the limits, changes, and what to do."""
    found = verified.verification
    lines = [TextLine("", _verdict_in_words(verified))]
    lines += [] if found.passed else [TextLine("   ", found.reason, "yellow")]
    lines += [TextLine(" ? ", finding.words, "yellow") for finding in find_moved(verified.records)]
    lines += _first_pose_again(verified.drift, every=every)
    if not verified.passed and found.passed:
        words = "No significant change: the differences agree with their sigma. Average longer, or raise the limit."
        lines.append(TextLine("   ", words, "yellow"))
    elif not verified.passed and verified.update is None:
        lines.append(TextLine("   ", "No update corrects the change: calibrate again.", "yellow"))
    return [*lines, TextLine(" Saved ", str(verified.path))]


def _verdict_in_words(verified: Verified) -> str:
    words = f"largest difference {_two_digits(verified.force_N.max())} N, {_two_digits(verified.torque_Nm.max())} N·m"
    limits = zip(verified.limits, ("N", "N·m"), strict=True)
    if given := [f"{limit:g} {unit}" for limit, unit in limits if limit is not None]:
        return f"{words}; limit {', '.join(given)}"
    found = verified.verification
    alarms = f"false alarms: {100 * FALSE_ALARMS:g} in 100, near the poses of the fit"
    return f"{words}; chi2 {found.chi2:.0f} for {found.dof} degrees of freedom, p {found.p_value:.2g} ({alarms})"
