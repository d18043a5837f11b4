"""Results and verifications as tables and texts on the terminal."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from ftcalib import CalibrationResult
from ftcalib.accuracy import errors_in_sigma
from ftcalib.compare import MethodResult
from ftcalib.rounding import counted, to_place_of
from ftcalib.routine import DriftCheck, PoseRecord
from ftdrive.runs.verification import Verified
from ftdrive.terminal.console import answer, indented, messages
from ftdrive.words.result import conclusion, estimate_rows, truth_in_words, verification_in_lines
from ftdrivers.interfaces import Array

_STYLE = {"good": "bold green", "usable": "bold yellow", "rejected": "bold red"}
_NO_LIMIT = 10_000
# Estimates that are printed only with --all, because they follow from the mass and the tilt.
_DERIVED = {"gravity_force_base_N"}


def print_result(
    result: CalibrationResult,
    *,
    truth: Mapping[str, Any] | None = None,
    drift: DriftCheck | None = None,
    records: Sequence[PoseRecord] = (),
    hinted: bool = True,
    saved: Path | None = None,
    every: bool = False,
) -> None:
    """Print estimates with sigma, the verdict with the compensation error, hints, and the name of the file.

    Parameters
    ----------
    result : CalibrationResult
    truth : mapping, optional
        True values, with keys as in the JSON of a result; they and the errors are printed next to the estimates.
    drift : DriftCheck, optional
    records : sequence of PoseRecord
        Records of the solved poses, to name the poses and to explain those that fit badly.
    hinted : bool
        Print hints about what to check in the cell.
    saved : Path, optional
        Name of the calibration file, printed in the last line.
    every : bool
        Print everything: all findings, the residuals, what sigma includes. `-v` implies this.
    """
    every |= messages.verbose
    amount = f"{result.n_poses} poses" if result.motion is None else f"{100 * result.motion.used_share:.0f} % used"
    printed = " as published" if result.provenance.get("as_published") else ""
    answer.print(Text.assemble(("Result", "bold cyan"), f"  {amount}, method {result.method}{printed}"))
    answer.print(_result_table(result, truth, every=every))
    first, *lines = conclusion(result, drift=drift, records=records, hinted=hinted, every=every)
    head = Text.assemble(" ", (result.verdict.upper(), _STYLE[result.verdict]), "  ")
    answer.print(indented(head, first.words, answer))
    if truth is not None:
        answer.print(indented(" truth: ", truth_in_words(result, truth), answer))
    for line in lines:
        answer.print(indented(line.head, line.words, answer), style=line.style)
    if saved is not None:
        answer.print(f" Saved {saved}")


def _result_table(result: CalibrationResult, truth: Mapping[str, Any] | None, *, every: bool) -> Table:
    data = result.to_dict()
    errors = {} if truth is None else errors_in_sigma(result, truth)
    table = Table(box=None, padding=(0, 1))
    for title in ("", "truth", "estimate", "± 1 sigma", "error / sigma"):
        if truth is not None or title not in {"truth", "error / sigma"}:
            table.add_column(title, justify="right" if title else "left", no_wrap=bool(title))  # wrap only the names
    for key, axis, *texts in estimate_rows(data, truth):
        if key in _DERIVED and not every:
            continue
        name, known, estimate, spread = texts
        error = errors[key][axis] if key in errors else None
        beside = [] if truth is None else [known]
        off = [] if error is None else [Text(f"{error:+.1f}", _error_style(error))]
        table.add_row(name, *beside, estimate, spread, *off)
    return table


def _error_style(error_sigma: float) -> str:
    """Return the colour of an error in sigmas: green below 2 (1 in 20 is larger), red from 4 (1 in 16,000)."""
    return "green" if abs(error_sigma) < 2 else "yellow" if abs(error_sigma) < 4 else "bold red"


def print_comparison(compared: Sequence[MethodResult]) -> None:
    """Print a comparison of calibration methods; on a narrow terminal without vectors, so that no number is cut."""
    table = _comparison_table(compared, vectors=True)
    if answer.is_terminal and table.width is not None and table.width > answer.width:
        table = _comparison_table(compared, vectors=False)
    answer.print(table, soft_wrap=True)
    for one in compared:
        if one.reason is not None:
            answer.print(indented(f" {one.method}: ", one.reason, answer))


def print_tests(titles: Sequence[str], rows: Sequence[tuple[Sequence[str], MethodResult]], heading: str) -> None:
    """Print a table as Yu's Table III: the largest errors on a test set, and the errors of weight and centre of mass.

    `titles` are the headings of the first columns: the method, or case, method and sets of poses. `heading` is printed
    above the table; it names the test set and the reference.
    """
    answer.print(indented(" ", heading, answer))
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
    """Print the cases of Yu's Table III; `known` is true if weight and centre of mass are compared with the truth."""
    reference = "the truth of the emulated cell" if known else "ml with all poses but those of D"
    heading = f"Table III of Yu et al. 2021: largest errors on the test set; mg and centre against {reference}:"
    every = max((data for _, data, _, _ in cases), key=len)
    rows = [((str(n), one.method, "all" if data == every else data, test), one) for n, data, test, one in cases]
    print_tests(("case", "method", "data", "test"), rows, heading)


def _to_digits(value: float) -> str:
    if np.isnan(value):
        return "-"
    return f"{value:.{0 if value >= 100 else 1 if value >= 10 else 2 if value >= 1 else 3}f}"


def _comparison_table(compared: Sequence[MethodResult], *, vectors: bool) -> Table:
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


def print_verification(verified: Verified) -> None:
    """Print a verification: measured and predicted wrench per pose, verdict with limits, changes, and the file name."""
    count = counted(len(verified.records), "pose")
    answer.print(Text.assemble(("Verification", "bold cyan"), f"  {count}, calibration {verified.calibration.id[:6]}"))
    for mark in verified.marks:
        answer.print(f" {mark}", style="yellow")
    answer.print(_verification_table(verified))
    verdict = ("PASS", "bold green") if verified.passed else ("FAILED", "bold red")
    first, *lines = verification_in_lines(verified, every=messages.verbose)
    answer.print(indented(Text.assemble(" ", verdict, "  "), first.words, answer))
    for line in lines:
        answer.print(indented(line.head, line.words, answer), style=line.style)


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
