"""`ftdrive history`: results and verifications of the store, with trends and warnings."""

from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import click

from ftcalib.rounding import counted, with_sigma
from ftdrive.commands.common import FOLDER, JSON, STORE, open_store, write_json
from ftdrive.errors import ConfigError
from ftdrive.runs.verification import VerificationRecord
from ftdrive.store.history import age_days, drifts, warnings
from ftdrive.store.records import StoredResult, StoredWeighings, read_records, record_paths
from ftdrive.terminal.text import GLUE, echo, print_table


@click.command()
@click.argument("folders", metavar="[RUNS]...", nargs=-1, type=FOLDER)
@click.option("--tool", metavar="NAME", help="Only results of this tool.")
@click.option("--index", metavar="FOLDER", multiple=True, type=FOLDER, help="First add the runs in FOLDER. Repeatable.")
@click.option("--rebuild", is_flag=True, help="First read all runs again, and forget those that were deleted.")
@click.option("--weighings", is_flag=True, help="List the last days with weighings instead.")
@STORE
@JSON
def history(
    folders: Sequence[Path],
    tool: str | None,
    index: Sequence[Path],
    rebuild: bool,
    weighings: bool,
    url: str | None,
    as_json: bool,
) -> None:
    """List results with their date and last verification, how bias and payload change, and the last weighings.

    They come from the store, where `calibrate` and `verify` add theirs, or from the run folders in RUNS. A trend is
    significant if the uncertainty of the results explains it in less than one case of 100, and so does their scatter.
    Where a sensor reports its temperature, its bias is fitted against that too. Runs within hours show how far the bias
    moves in an hour.
    """
    left_out: tuple[str, ...] = ()
    weighed: Sequence[StoredWeighings] = ()
    name = None
    if folders:
        if option := (
            "--index" if index else "--rebuild" if rebuild else "--weighings" if weighings else "--store" if url else ""
        ):
            raise ConfigError(f"RUNS and {option} exclude one another: leave one out")
        records, left_out = read_records(record_paths(folders))
        results = [one for one in records if isinstance(one, StoredResult) and tool in {None, one.tool}]
        results.sort(key=lambda one: (one.created_utc or "", one.id))
        checks = [one for one in records if isinstance(one, VerificationRecord)]
        checks.sort(key=lambda one: one.to_store_dict()["created_utc"] or "")
    else:
        store = open_store(url)
        name = store.name
        if index or rebuild:
            left_out = (store.rebuild(*index) if rebuild else store.index(*index)).unreadable
        if weighings:
            _show_weighings(store.weighings(_MOST_DAYS, tool), name, left_out, as_json)
            return
        results, checks = store.results(tool), store.verifications()
        weighed = store.last_weighings((datetime.now(UTC) - _RECENT).date().isoformat(), tool)
    _print_left_out(left_out)
    now = datetime.now(UTC)
    found, advice = drifts(results), list(warnings(results, checks, now))
    warmth = []
    if any(one.temperature_C is not None for one in results):
        from ftdrive.store.trends import temperatures

        warmth = temperatures(results, checks)
    moved = _hour_changes(results, checks)
    last = {check.calibration_id: check for check in checks}
    if as_json:
        rows = [_as_json(one, last.get(one.id), now) for one in results]
        about = {
            "trends": [one.to_dict() for one in found],
            "temperature": [one.to_dict() for one in warmth],
            "hour_changes": moved,
            "warnings": advice,
            "last_weighings": [asdict(one) for one in weighed],
        }
        write_json({"schema_version": 1, "store": name, "results": rows, **about})
        return
    if not results:
        _say("No results. `ftdrive calibrate` adds them, `ftdrive history --index runs` adds those of a folder.")
        return
    _print_table([_row(one, last.get(one.id), now) for one in results])
    trend_lines = (f"trend: {drift}" for drift in found)
    warmth_lines = (line for one in warmth for line in one.lines())
    weighing_lines = (f"last weighing: {_weighing_in_words(one)}" for one in weighed if one.mass_kg is not None)
    hour_lines = (
        "bias, {sensor_serial}: moves by {force_N:.2g} N, {torque_Nm:.2g} N·m an axis in an hour (1 sigma)".format(
            **one
        )
        for one in moved
    )
    for line in (*trend_lines, *warmth_lines, *hour_lines, *weighing_lines):
        echo(line)
    if advice:
        from ftdrive.terminal.console import answer, hanging

        for words in advice:
            answer.print(hanging(" ! ", words, answer), style="yellow")


def _hour_changes(results: Sequence[StoredResult], checks: Sequence[VerificationRecord]) -> list[dict[str, Any]]:
    """Give how far the bias of each sensor moves in an hour, one standard deviation of an axis, where runs show it."""
    if len(results) + len(checks) < _FEWEST_RUNS:
        return []
    from ftdrive.store.trends import hour_changes

    return [
        {
            "sensor_serial": serial,
            "arm_serial": arm,
            "mount": mount,
            "force_N": float(change[0]),
            "torque_Nm": float(change[3]),
        }
        for (serial, arm, mount), change in hour_changes(results, checks).items()
    ]


def _print_left_out(left_out: Sequence[str]) -> None:
    if left_out:
        from ftdrive.terminal.console import hanging, messages

        for words in left_out:
            messages.print(hanging(" left out: ", words))


def _say(words: str) -> None:
    from ftdrive.terminal.console import messages

    messages.print(words)


# Fewer records have no three pairs of runs, and numpy is not needed.
_FEWEST_RUNS = 4
# Most days of weighings that are listed.
_MOST_DAYS = 20
# An earlier weighing is not the last one of a list.
_RECENT = timedelta(days=90)


def _show_weighings(days: Sequence[StoredWeighings], name: str, left_out: Sequence[str], as_json: bool) -> None:
    _print_left_out(left_out)
    if as_json:
        write_json({"schema_version": 1, "store": name, "weighings": [asdict(one) for one in days]})
    elif not days:
        _say("No weighings. `ftdrive weigh` and `ftdrive serve-load` add them.")
    else:
        print_table(_DAY_TITLES, [_day_row(one) for one in days], folding={"arm", "tool", "refused"})


_DAY_TITLES = ("day", "arm", "tool", "parts", "refused", "last, UTC", "mass", "file")


def _day_row(one: StoredWeighings) -> tuple[str, ...]:
    return (
        one.day,
        one.arm_serial or one.robot_host or "-",
        one.tool_in_words,
        f"{one.weighings}",
        ", ".join(f"{number} {code}" for code, number in one.refusals.items() if number) or "-",
        "-" if one.last_utc is None else one.last_utc[11:19],
        _mass_in_words(one),
        Path(one.path).name,
    )


def _weighing_in_words(one: StoredWeighings) -> str:
    refused = sum(one.refusals.values())
    counts = f"{counted(one.weighings, 'part')}, {refused} refused on this day"
    time = one.day if one.last_utc is None else one.last_utc[:16].replace("T", " ")
    return f"{one.tool_in_words}, {time}: {_mass_in_words(one)}; {counts}"


def _mass_in_words(one: StoredWeighings) -> str:
    if one.mass_kg is None or one.mass_sigma_kg is None:
        return "-"
    return f"{with_sigma(one.mass_kg, one.mass_sigma_kg)} kg"


_TITLES = ("id", "date", "arm", "tool", "verdict", "kg", "verified", "force bias, N", "run", "°C", "parent")
# Shown if a result has one.
_OPTIONAL = {"°C", "parent"}


def _row(one: StoredResult, check: VerificationRecord | None, now: datetime) -> tuple[str, ...]:
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
        one.tool_in_words,
        one.verdict,
        f"{one.mass_kg:.4f}",
        verified,
        " ".join(f"{value:.2f}" for value in one.numbers["force_bias_N"]),
        one.run,
        "" if one.temperature_C is None else f"{one.temperature_C:.0f}",
        f"{one.parent[:6]} ({one.update})" if one.parent else "",
    )


def _print_table(rows: Sequence[Sequence[str]]) -> None:
    shown = [n for n, title in enumerate(_TITLES) if title not in _OPTIONAL or any(row[n] for row in rows)]
    print_table(
        [_TITLES[n] for n in shown],
        [[row[n] for n in shown] for row in rows],
        folding={"arm", "tool", "verified", "run", "parent"},
    )


def _as_json(one: StoredResult, check: VerificationRecord | None, now: datetime) -> dict[str, Any]:
    import numpy as np

    from ftcalib.model import BIASES

    kept = {name: value for name, value in asdict(one).items() if name != "numbers"}
    bias = {name: one.numbers[name] for name in ("force_bias_N", "torque_bias_Nm", "p_sensor_com_m")}
    sigma = np.sqrt(np.diag(one.covariance))[BIASES].tolist()
    return {
        **kept,
        "age_days": age_days(one.created_utc, now),
        "mass_sigma_kg": one.mass_sigma_kg,
        **bias,
        "bias_sigma": {"force_N": sigma[:3], "torque_Nm": sigma[3:]},
        "last_verification": None if check is None else check.to_store_dict(),
    }
