"""Contents of the store as table rows and lines of text: results, their trends, weighings."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from ftcalib.rounding import counted, with_sigma
from ftdrive.runs.calibration import EMULATED
from ftdrive.runs.verification import VerificationRecord
from ftdrive.runs.weighings import WeighingDay
from ftdrive.store.history import age_days
from ftdrive.store.records import StoredResult
from ftdrive.words.text import GLUE

if TYPE_CHECKING:  # listing results must not import numpy, which takes long
    from ftcalib.after.series import BiasTemperature

DAY_TITLES = ("day", "arm", "tool", "parts", "refused", "last, UTC", "mass", "file")
_TITLES = ("id", "date", "arm", "tool", "verdict", "kg", "verified", "force bias, N", "run", "°C", "parent")
# Columns of the table of results that are shown only if a result has a value in them.
_OPTIONAL = {"°C", "parent"}


def tool_in_words(tool: str | None, *, emulated: bool) -> str:
    """Return the name of a tool, with the mark EMULATED for one in an emulated cell."""
    if not emulated:
        return tool or "-"
    return EMULATED if tool in (None, "emulated") else f"{tool} {EMULATED}"


def last_weighing_in_words(one: WeighingDay) -> str:
    """Return a text about a day of weighings: tool, time and mass of the last part, and the number of parts."""
    counts = f"{counted(one.weighings, 'part')}, {sum(one.refusals.values())} refused on this day"
    time = one.day if one.last_utc is None else one.last_utc[:16].replace("T", " ")
    return f"{tool_in_words(one.tool, emulated=one.emulated)}, {time}: {_mass_in_words(one)}; {counts}"


def temperature_lines(serial: str, fit: "BiasTemperature") -> Iterator[str]:
    """Yield the temperature dependence of a sensor's bias: one line for the force and one for the torque."""
    for k, (quantity, unit) in enumerate((("force bias", "N"), ("torque bias", "N·m"))):
        pairs = zip(fit.slope[3 * k : 3 * k + 3], fit.sigma[3 * k : 3 * k + 3], strict=True)
        slopes = ", ".join(with_sigma(slope, sigma, "+") for slope, sigma in pairs)
        use = "applied by --tool" if fit.predicts[k] else "not applied"
        yield (
            f"temperature, {serial}, {quantity}: {slopes} {unit}/K (1 sigma, {fit.n} runs, "
            f"{fit.coldest_C:.0f} to {fit.warmest_C:.0f} °C); leave-one-out error {fit.error[k]:.2g} {unit} "
            f"with the correction, {fit.error_without[k]:.2g} {unit} without: {use}"
        )


def _mass_in_words(one: WeighingDay) -> str:
    if one.mass_kg is None or one.mass_sigma_kg is None:
        return "-"
    return f"{with_sigma(one.mass_kg, one.mass_sigma_kg)} kg"


def day_row(one: WeighingDay) -> tuple[str, ...]:
    """Return a day of weighings as a row of the table whose titles are `DAY_TITLES`."""
    return (
        one.day,
        one.arm_serial or one.robot_host or "-",
        tool_in_words(one.tool, emulated=one.emulated),
        f"{one.weighings}",
        ", ".join(f"{number} {code}" for code, number in one.refusals.items() if number) or "-",
        "-" if one.last_utc is None else one.last_utc[11:19],
        _mass_in_words(one),
        Path(one.path).name,
    )


def result_table(
    results: Iterable[StoredResult], last: Mapping[str, VerificationRecord], now: datetime
) -> tuple[Sequence[str], Sequence[Sequence[str]]]:
    """Return the titles and rows of a table of results; `last` maps the id of a result to its last verification."""
    rows = [_history_row(one, last.get(one.id), now) for one in results]
    shown = [n for n, title in enumerate(_TITLES) if title not in _OPTIONAL or any(row[n] for row in rows)]
    return [_TITLES[n] for n in shown], [[row[n] for n in shown] for row in rows]


def _history_row(one: StoredResult, check: VerificationRecord | None, now: datetime) -> tuple[str, ...]:
    verified = "-"
    if check is not None:
        since = age_days(check.created_utc, now)
        age = "" if since is None else f" {since:.0f}{GLUE}d"
        verified = ("passed" if check.passed else "FAILED") + age
        verified += f", {check.change}" if check.change else ""
    return (
        one.id[:6],
        "-" if one.created_utc is None else one.created_utc[:10],
        one.arm_serial or one.arm_model or "-",
        tool_in_words(one.tool, emulated=one.emulated),
        one.verdict,
        f"{one.mass_kg:.4f}",
        verified,
        " ".join(f"{value:.2f}" for value in one.numbers["force_bias_N"]),
        one.run,
        "" if one.temperature_C is None else f"{one.temperature_C:.0f}",
        f"{one.parent[:6]} ({one.update})" if one.parent else "",
    )
