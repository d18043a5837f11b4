"""A verification as text."""

import numpy as np
from rich.table import Table
from rich.text import Text

from ftcalib.rounding import to_place_of
from ftdrive.runs.pose_hints import moved
from ftdrive.runs.verified import FALSE_ALARMS, Verified
from ftdrive.terminal.console import answer, hanging, messages
from ftdrive.terminal.report import drift_in_words
from ftdrivers.interfaces import Array


def print_verification(verified: Verified) -> None:
    """Print measured and predicted wrench of each pose, the verdict with its limits, and what has changed."""
    found, n = verified.verification, len(verified.records)
    count = f"{n} poses" if n > 1 else "1 pose"
    answer.print(Text.assemble(("Verification", "bold cyan"), f"  {count}, calibration {verified.calibration.id[:6]}"))
    for mark in verified.marks:
        answer.print(f" {mark}", style="yellow")
    answer.print(_table(verified))
    verdict = ("PASS", "bold green") if verified.passed else ("FAILED", "bold red")
    answer.print(hanging(Text.assemble(" ", verdict, "  "), verdict_in_words(verified), answer))
    if not found.passed:
        answer.print(hanging("   ", found.reason, answer), style="yellow")
    for finding in moved(verified.records):
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
    words = f"largest difference {verified.force_N.max():.3f} N, {verified.torque_Nm.max():.4f} N·m"
    if limits.given:
        given = ((limits.force_N, "N"), (limits.torque_Nm, "N·m"))
        return f"{words}; limit {', '.join(f'{limit:g} {unit}' for limit, unit in given if limit is not None)}"
    found = verified.verification
    alarms = f"{100 * FALSE_ALARMS:g} % of unchanged cells fail"
    return f"{words}; chi2 {found.chi2:.0f} for {found.dof} degrees of freedom, p {found.p_value:.2g} ({alarms})"


def _table(verified: Verified) -> Table:
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
