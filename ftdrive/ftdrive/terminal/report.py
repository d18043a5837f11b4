"""A result and a verification as text."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.table import Table
from rich.text import Text
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult
from ftcalib.compare import MethodResult
from ftcalib.estimates import FIXED_BELOW, axes_of, quantities_of, values_of
from ftcalib.likelihood.response import LEAST_COMMON_GAIN
from ftcalib.rounding import counted, to_place_of, with_sigma
from ftcalib.routine import DriftCheck, PoseRecord
from ftdrive.runs.pose_hints import find_moved, hints, names_of
from ftdrive.runs.verification import FALSE_ALARMS, Verified
from ftdrive.terminal.console import answer, hanging, messages
from ftdrivers.interfaces import Array

_STYLE = {"good": "bold green", "usable": "bold yellow", "rejected": "bold red"}
_NO_LIMIT = 10_000
# An error elsewhere or later is named if it is larger by this.
_WORSE = 1.2
_ELSEWHERE: Sequence[tuple[str, Literal["workspace", "hour"]]] = (
    ("in any orientation", "workspace"),
    ("after an hour", "hour"),
)
# A contact whose sigma is named, and where the tip is if no tool is described, from the flange.
CONTACT_N = 100.0
_USUAL_TIP_MM = 200.0
# Orientations over which the error of a calibration is averaged if the truth is known.
_RANDOM = Rotation.random(1000, rng=0).as_matrix()
# N or N·m.
_ROUNDING = 1e-9
# Rows that follow from mass and tilt: printed only with -v.
_DERIVED = {"gravity_force_base_N"}


SIGMA_OF_THE_TOOL = (
    "that of mounting, weight and centre of mass includes what errors of sensor, arm and mounts hide in them; the "
    "compensation error does not, because there they cancel"
)


def print_result(
    result: CalibrationResult,
    *,
    truth: Mapping[str, Any] | None = None,
    drift: DriftCheck | None = None,
    records: Sequence[PoseRecord] = (),
    hinted: bool = True,
    saved: Path | None = None,
) -> None:
    """Print estimates with one sigma, the verdict with the compensation error, hints, and the path of the file.

    Residuals and drift follow if the verdict is not good, if the drift is significant, or with `-v`.

    Parameters
    ----------
    result : CalibrationResult
    truth : mapping, optional
        Same keys as the result: truth and error are printed beside the estimates.
    drift : DriftCheck, optional
    records : sequence of PoseRecord
        Of the result's dataset: poses are named by their orientation, and bad fits are explained.
    hinted : bool
        Print what a user should check in the cell.
    saved : Path, optional
        The calibration file, printed in the last line.
    """
    amount = f"{result.n_poses} poses" if result.motion is None else f"{100 * result.motion.used_share:.0f} % used"
    printed = " as published" if result.provenance.get("as_published") else ""
    answer.print(Text.assemble(("Result", "bold cyan"), f"  {amount}, method {result.method}{printed}"))
    answer.print(_table(result, truth))
    if (mass := mass_in_words(result)) is not None:
        answer.print(hanging(" sigma: ", SIGMA_OF_THE_TOOL, answer))
        answer.print(hanging(" mass as read: ", mass, answer))
    head = Text.assemble(" ", (result.verdict.upper(), _STYLE[result.verdict]), "  ")
    answer.print(hanging(head, f"compensation error {error_in_words(result)}", answer))
    if result.verdict != "rejected":
        answer.print(hanging(" under contact: ", contact_in_words(result), answer))
    if truth is not None:
        raw, left = _free_tool_wrench(truth, _RANDOM), compensation_error(result, truth)
        words = (
            f"a free tool reads {left['force_rms_N']:.4f} N, {left['torque_rms_Nm']:.5f} N·m rms; "
            f"before {_rms(raw[:, :3]):.1f} N, {_rms(raw[:, 3:]):.2f} N·m"
        )
        answer.print(hanging(" truth: ", words, answer))
    for finding in result.findings:
        answer.print(hanging("   ", finding.words, answer))
    for contact in () if result.motion is None else result.motion.contacts:
        words = "{t_s:.1f} s for {duration_s:.1f} s, up to {force_N:.1f} N, {torque_Nm:.2f} N·m".format(**contact)
        answer.print(hanging(" contact: at ", words, answer))
    if result.motion is None and (messages.verbose or result.verdict != "good"):
        _print_fit(result, names_of(records))
    _print_drift(result, drift)
    for hint in hints(result, records) if hinted or messages.verbose else ():
        answer.print(hanging(" ? ", hint.words, answer), style="yellow")
    if saved is not None:
        answer.print(f" Saved {saved}")


def _table(result: CalibrationResult, truth: Mapping[str, Any] | None) -> Table:
    data = result.to_dict()
    errors = {} if truth is None else errors_in_sigma(result, truth)
    fixed_below = FIXED_BELOW * float(np.sqrt(np.diag(result.covariance).max()))
    table = Table(box=None, padding=(0, 1))
    for title in ("", "truth", "estimate", "± 1 sigma", "error / sigma"):
        if truth is not None or title not in {"truth", "error / sigma"}:
            table.add_column(title, justify="right" if title else "left", no_wrap=bool(title))  # names may be folded
    for label, scale, unit, key in quantities_of(data):
        if key in _DERIVED and not messages.verbose:
            continue
        estimates, sigmas = (values_of(source[key], key) * scale for source in (data, data["sigma"]))
        truths = values_of(truth[key], key) * scale if truth is not None and key in truth else None
        fixed = sigmas <= fixed_below * scale
        for i, axis in enumerate(axes_of(len(estimates))):
            sigma = 0.0 if fixed[i] else float(sigmas[i])
            spread = "fixed" if fixed[i] else to_place_of(sigma, sigma)
            known = [] if truth is None else ["" if truths is None else to_place_of(truths[i], sigma)]
            error = [] if truths is None else [Text(f"{errors[key][i]:+.1f}", _error_style(errors[key][i]))]
            name = f"{label} {axis}".strip() + f", {unit}"
            table.add_row(name, *known, to_place_of(estimates[i], sigma), spread, *error)
    return table


def _error_style(error_sigma: float) -> str:
    """Colour of an error: one in 20 is above 2 sigma, one in 16,000 above 4."""
    return "green" if abs(error_sigma) < 2 else "yellow" if abs(error_sigma) < 4 else "bold red"


def _print_fit(result: CalibrationResult, names: Sequence[str]) -> None:
    residual = result.to_dict()["residual"]
    words = (
        f"force {residual['force_rms_N']:.4f} N rms, {residual['force_max_N']:.4f} max; "
        f"torque {residual['torque_rms_Nm']:.5f} N·m rms, {residual['torque_max_Nm']:.5f} max"
    )
    answer.print(hanging(" residuals: ", words, answer))
    if (poses := poses_in_words(result, names)) is not None:
        answer.print(hanging(" worst: ", poses, answer))


def _print_drift(result: CalibrationResult, drift: DriftCheck | None) -> None:
    if drift is not None:
        words, bad = drift_in_words(drift)
        if bad or messages.verbose or result.verdict != "good":
            answer.print(hanging(" drift: ", words, answer), style="yellow" if bad else None)
    if result.drift is not None:
        change, sigma = result.drift.change, result.drift.sigma
        words = (
            f"{with_sigma(np.linalg.norm(change[:3]), np.max(sigma[:3]))} N, "
            f"{with_sigma(np.linalg.norm(change[3:]), np.max(sigma[3:]))} N·m from the first pose to the last"
        )
        answer.print(hanging(" drift in the fit: ", words, answer))
        if (ahead := drift_in_use(result)) is not None:
            answer.print(hanging(" next use: ", f"{ahead}. Tare before use.", answer))


def mass_in_words(result: CalibrationResult) -> str | None:
    """Describe the mass with both parts of its sigma; None if it was known, or the sensor is declared perfect."""
    session_kg = result.parameters.weight_sigma_N(result.covariance) / result.g_m_s2
    if session_kg < FIXED_BELOW * result.mass_kg or result.scale_sigma <= LEAST_COMMON_GAIN:
        return None
    mass, session = (to_place_of(value, session_kg) for value in (result.mass_kg, session_kg))
    return f"{mass} kg ± {100 * result.scale_sigma:.2g} % (scale of the sensor) ± {session} kg (this session)"


def error_in_words(result: CalibrationResult) -> str:
    """Describe the compensation error of a free tool at the next use, N and N·m, and its source."""
    predicted, likely = (
        "{:.4f} N, {:.5f} N·m".format(*error) for error in (result.predicted_error(), result.likely_error())
    )
    if result.noise_explains and likely == predicted:
        return f"{predicted} rms (predicted)"
    sources = []
    if result.motion is not None and not result.noise_explains:
        sources.append("with smooth errors of arm, cable and load")
    elif not result.noise_explains:
        why = "the noise was not measured" if result.p_value is None else "the residuals exceed the noise"
        sources.append(f"cross-validated, as {why}")
    if any(result.quality.get("bias_growth_per_min", ())):
        sources.append("a minute after the tour, with the drift")
    for words, where in _ELSEWHERE:
        error = result.likely_error(where)
        if error[0] > _WORSE * result.likely_error()[0]:
            sources.append("{} {} N, {} N·m".format(words, *map(_in_brief, error)))
    return f"{likely} rms ({'; '.join([*sources, f'predicted: {predicted}'])})"


def _in_brief(value: float) -> str:
    """Write two digits, without an exponent; a drift of one quantity alone is zero in the other but for rounding."""
    return "0" if value < _ROUNDING else to_place_of(value, value)


def tip_of(result: CalibrationResult) -> Array:
    """Return the far end of the tool (3,) from the sensor origin, sensor axes: of its cylinders, else 200 mm out."""
    setup = result.provenance.get("setup")
    given: Mapping[str, Any] = setup if isinstance(setup, dict) else {}
    rows = given.get("cylinders_mm") or [[0.0, _USUAL_TIP_MM, 0.0]]
    far = max(rows, key=lambda row: row[1])
    # From, to, diameter, and perhaps where the axis is.
    x, y = far[3:] if len(far) > 3 else (0.0, 0.0)
    tip_mm = np.array([x, y, far[1] - (given.get("height_mm") or 0.0)])
    return np.asarray(result.R_flange_sensor.T @ tip_mm / 1e3)


def force_sigma_at_tip(result: CalibrationResult, force_N: Array | float = CONTACT_N) -> Array:
    """Return one standard deviation of a force at the tip, as the length of its error, over all directions."""
    share, _ = result.contact.sigma_at(tip_of(result))
    return np.asarray(np.hypot(result.likely_error()[0], share * np.asarray(force_N)))


def sensor_in_words(result: CalibrationResult) -> str:
    """Say on what the errors of the sensor under contact rest."""
    sensor = result.sensor
    if sensor is None or sensor.source == "assumed":
        return "assumed, not measured"
    if sensor.source == "data sheet":
        return "those of the data sheet"
    made = sensor.provenance.get("created_utc")
    return "known from loads" + (f", sensor.json of {made[:16].replace('T', ' ')}" if isinstance(made, str) else "")


def contact_in_words(result: CalibrationResult) -> str:
    """Describe the sigma of a contact at the tip, and on what it rests."""
    sigma_N = float(force_sigma_at_tip(result))
    return f"{CONTACT_N:g} N at the tip ± {sigma_N:.2g} N (1 sigma); errors of the sensor are {sensor_in_words(result)}"


def drift_in_use(result: CalibrationResult) -> str | None:
    """Describe how the bias moves after the last pose, at which the result has it; None without drift, or in motion."""
    growth = np.array(result.quality.get("bias_growth_per_min", ()))
    if result.mean_bias is None or not growth.size:
        return None
    off, grow = (
        "{} N, {} N·m".format(*(_in_brief(float(np.linalg.norm(part))) for part in np.split(values, 2)))
        for values in (result.parameters.bias - result.mean_bias, growth)
    )
    return f"the result has the bias of the last pose, {off} off the mean; it moves {grow} a minute"


def poses_in_words(result: CalibrationResult, names: Sequence[str] = ()) -> str | None:
    """Describe the worst pose and the cross-validation; None for results without these figures.

    Parameters
    ----------
    result : CalibrationResult
    names : sequence of str
        Of the rows of its dataset; their numbers where there are none.
    """
    quality = result.quality
    if not quality:
        return None
    row = int(quality["worst_pose"])
    worst = names[row - 1] if names else f"pose {row}"
    return (
        f"{worst}, {quality['residual_sigma'][row - 1]:.1f} sigma; each pose predicted by the others: "
        f"{quality['loo_force_rms_N']:.4f} N, {quality['loo_torque_rms_Nm']:.5f} N·m rms"
    )


def errors_in_sigma(result: CalibrationResult, truth: Mapping[str, Any]) -> dict[str, Array]:
    """Errors of the estimates, each divided by its standard deviation.

    That of the rotation is the small rotation about the flange axes that leads from the truth to the estimate; that of
    an angle is at most half a turn.
    """
    data = result.to_dict()
    errors = {}
    for _, _, _, key in quantities_of(data):
        if key not in truth:
            continue
        if key == "R_flange_sensor":
            error = Rotation.from_matrix(result.R_flange_sensor @ np.transpose(truth[key])).as_rotvec()
        else:
            error = values_of(data[key], key) - values_of(truth[key], key)
            if key.endswith("_rad"):
                # a ceiling is at both +180 and -180 degrees
                error = np.remainder(error + np.pi, 2 * np.pi) - np.pi
        errors[key] = error / values_of(data["sigma"][key], key)
    return errors


def _free_tool_wrench(truth: Mapping[str, Any], R_base_flange: Array) -> Array:
    """Return what the sensor of a free tool reads, (n, 6): computed from the truth, not with the solver's model."""
    weight = np.einsum(
        "ji,nkj,k->ni", np.asarray(truth["R_flange_sensor"]), R_base_flange, np.asarray(truth["gravity_force_base_N"])
    )
    load = np.hstack([weight, np.cross(truth["p_sensor_com_m"], weight)])
    # Cells of version 0.1.0 and earlier have a perfect sensor.
    load = load + load @ np.array(truth.get("sensor_error", np.zeros((6, 6)))).T
    return np.asarray(load + np.hstack([truth["force_bias_N"], truth["torque_bias_Nm"]]))


def compensation_error(result: CalibrationResult, truth: Mapping[str, Any]) -> dict[str, float]:
    """Rms of the wrench that remains of a free tool after compensation, over `_RANDOM` orientations."""
    left = result.compensate(_free_tool_wrench(truth, _RANDOM), _RANDOM)
    return {"force_rms_N": _rms(left[:, :3]), "torque_rms_Nm": _rms(left[:, 3:])}


def _rms(vectors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def print_comparison(compared: Sequence[MethodResult]) -> None:
    """Print all methods side by side without cutting a number: a narrow terminal gets no vectors, a pipe long lines."""
    table = _comparison(compared, vectors=True)
    if answer.is_terminal and table.width is not None and table.width > answer.width:
        table = _comparison(compared, vectors=False)
    answer.print(table, soft_wrap=True)
    for one in compared:
        if one.reason is not None:
            answer.print(hanging(f" {one.method}: ", one.reason, answer))


def print_tests(titles: Sequence[str], rows: Sequence[tuple[Sequence[str], MethodResult]], heading: str) -> None:
    """Print the columns of Yu's Table III: the largest errors on a test set, and those of weight and centre of mass.

    Parameters
    ----------
    titles : sequence of str
        Of the columns with the names of a row.
    rows : sequence of (names, MethodResult)
        The names of a row: the method, or the case, its method and its sets.
    heading : str
        What the methods were tested on, and what they are compared with.
    """
    answer.print(hanging(" ", heading, answer))
    table = Table(box=None, padding=(0, 0, 0, 1), pad_edge=True)
    for title in titles:
        table.add_column(title, justify="right" if title == "case" else "left", no_wrap=True)
    for title in ("Fx\nmN", "Fy", "Fz", "F", "Tx\nmN·m", "Ty", "Tz", "T", "mg\n%", "centre\n%"):
        table.add_column(title, justify="right", no_wrap=True)
    for names, one in rows:
        if one.largest_errors is not None:
            shares = 100 * one.mass_error, 100 * one.centre_error
            values = *(1e3 * one.largest_errors).tolist(), *shares
            table.add_row(*names, *map(_to_digits, values))
    answer.print(table, soft_wrap=True)


def print_cases(cases: Sequence[tuple[int, str, str, MethodResult]], *, known: bool) -> None:
    """Print Yu's Table III; `known` says that the errors of weight and centre are those from an emulated truth."""
    reference = "the truth of the emulated cell" if known else "ml with all poses but those of D"
    heading = f"Table III of Yu et al. 2021: largest errors on the test set; mg and centre against {reference}:"
    every = max((data for _, data, _, _ in cases), key=len)
    rows = [((str(n), one.method, "all" if data == every else data, test), one) for n, data, test, one in cases]
    print_tests(("case", "method", "data", "test"), rows, heading)


def _to_digits(value: float) -> str:
    """Write a positive number with three digits, at most three of them after the point; NaN as "-"."""
    if np.isnan(value):
        return "-"
    return f"{value:.{0 if value >= 100 else 1 if value >= 10 else 2 if value >= 1 else 3}f}"


def _comparison(compared: Sequence[MethodResult], *, vectors: bool) -> Table:
    table = Table(box=None, padding=(0, 1))
    for title, shown in (
        *(("method", True), ("mass\nkg", True)),
        *(("centre of mass\nmm", vectors), ("force bias\nN", vectors), ("torque bias\nN·m", vectors)),
        *(("mounting\ndiffers", True), ("residual\nrms N", True), ("residual\nrms N·m", True)),
        *(("left out\nrms N", True), ("left out\nrms N·m", True)),
    ):
        if shown:
            table.add_column(title, justify="left" if title == "method" else "right", no_wrap=True)
    for one in compared:
        if one.parameters is None:
            continue
        p = one.parameters
        three = ((1e3 * p.p_sensor_com_m, 1), (p.force_bias_N, 3), (p.torque_bias_Nm, 4)) if vectors else ()
        triples = (", ".join(f"{value:.{digits}f}" for value in vector) for vector, digits in three)
        angle = f"{np.degrees(one.rotation_difference_rad):.3f}°"
        rms = (one.force_rms_N, one.torque_rms_Nm, one.cv_force_rms_N, one.cv_torque_rms_Nm)
        cells = ("-" if np.isnan(value) else f"{value:.5f}" for value in rms)
        table.add_row(one.method, f"{one.mass_kg:.5f}", *triples, angle, *cells)
    table.width = answer.measure(table, options=answer.options.update(width=_NO_LIMIT)).maximum
    return table


def drift_in_words(drift: DriftCheck) -> tuple[str, bool]:
    """Describe the change of the first pose at the end; True if it exceeds the noise."""
    worst = float(np.max(np.abs(drift.change) / drift.sigma))
    force_N, torque_Nm = np.linalg.norm(drift.change[:3]), np.linalg.norm(drift.change[3:])
    apart_s = abs(drift.elapsed_s)
    again = f"first pose again after {apart_s:.0f} s"
    if drift.elapsed_s < 0:  # --redo 1
        again = f"first pose, repeated {apart_s:.0f} s after the return to it"
    words = f"{again}, {force_N:.3f} N, {torque_Nm:.4f} N·m away: "
    if worst < 4:
        return words + "none seen", False
    minutes = max(apart_s, 1.0) / 60
    in_force = np.max(np.abs(drift.change[:3]) / drift.sigma[:3]) >= 4
    rate = f"{force_N / minutes:.2g} N/min" if in_force else f"{torque_Nm / minutes:.2g} N·m/min"
    return words + rate, True


def print_verification(verified: Verified) -> None:
    """Print measured and predicted wrench of each pose, the verdict with its limits, and what has changed."""
    found, count = verified.verification, counted(len(verified.records), "pose")
    answer.print(Text.assemble(("Verification", "bold cyan"), f"  {count}, calibration {verified.calibration.id[:6]}"))
    for mark in verified.marks:
        answer.print(f" {mark}", style="yellow")
    answer.print(_verification_table(verified))
    verdict = ("PASS", "bold green") if verified.passed else ("FAILED", "bold red")
    answer.print(hanging(Text.assemble(" ", verdict, "  "), verdict_in_words(verified), answer))
    if not found.passed:
        answer.print(hanging("   ", found.reason, answer), style="yellow")
    for finding in find_moved(verified.records):
        answer.print(hanging(" ? ", finding.words, answer), style="yellow")
    if verified.drift is not None:
        words, bad = drift_in_words(verified.drift)
        if bad or messages.verbose:
            answer.print(hanging(" drift: ", words, answer), style="yellow" if bad else None)
    if not verified.passed and found.passed:
        words = "Nothing has changed: the differences agree with their sigma. Average longer, or raise the limit."
        answer.print(hanging("   ", words, answer), style="yellow")
    elif not verified.passed and verified.update is None:
        answer.print(hanging("   ", "No update makes up for the change: calibrate again.", answer), style="yellow")
    answer.print(f" Saved {verified.path}")


def verdict_in_words(verified: Verified) -> str:
    """Describe the largest differences, and the limits that decide."""
    limits = verified.limits
    words = f"largest difference {_in_brief(verified.force_N.max())} N, {_in_brief(verified.torque_Nm.max())} N·m"
    if limits.given:
        given = ((limits.force_N, "N"), (limits.torque_Nm, "N·m"))
        return f"{words}; limit {', '.join(f'{limit:g} {unit}' for limit, unit in given if limit is not None)}"
    found = verified.verification
    alarms = f"false alarms: {100 * FALSE_ALARMS:g} in 100, near the poses of the fit"
    return f"{words}; chi2 {found.chi2:.0f} for {found.dof} degrees of freedom, p {found.p_value:.2g} ({alarms})"


def _verification_table(verified: Verified) -> Table:
    table = Table(box=None, padding=(0, 1))
    for title in ("", "measured x, y, z", "predicted x, y, z", "differs", "± 1 sigma"):
        table.add_column(title, justify="right" if title else "left", no_wrap=True)
    found, wrench = verified.verification, verified.dataset.wrench
    for row, record in enumerate(verified.records):
        for axes, unit, digits in ((slice(3), "N", 3), (slice(3, 6), "N·m", 4)):
            measured, residual = wrench[row, axes], found.residual[row, axes]
            sigma = float(np.linalg.norm(found.predicted_sigma[row, axes]))
            size = float(np.linalg.norm(residual))
            style = "bold yellow" if size > 3 * sigma else ""
            name = f"R{record.pose.number:02d} {unit}" if axes.start is None else f"    {unit}"
            values = (_vector(measured, digits), _vector(measured - residual, digits))
            table.add_row(name, *values, Text(to_place_of(size, sigma), style), to_place_of(sigma, sigma))
    return table


def _vector(values: Array, digits: int) -> str:
    return " ".join(f"{value:7.{digits}f}" for value in values)
