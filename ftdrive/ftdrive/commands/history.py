"""`ftdrive history`: results and verifications in the store, with trends and warnings."""

from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import click

from ftdrive.commands.options import FOLDER, JSON, STORE, write_json
from ftdrive.errors import ConfigError
from ftdrive.runs.verification import VerificationRecord
from ftdrive.runs.weighings import WeighingDay
from ftdrive.store import open_store
from ftdrive.store.history import age_days, drifts, warnings
from ftdrive.store.records import StoredResult, read_records, record_paths
from ftdrive.terminal.console import answer, indented, messages
from ftdrive.terminal.text import echo, print_table
from ftdrive.words.history import DAY_TITLES, day_row, last_weighing_in_words, result_table, temperature_lines

# Fewer runs make no three pairs for the bias's change per hour, so it is skipped to avoid the slow import of numpy.
_FEWEST_RUNS = 4
_HOUR = "bias, {sensor_serial}: changes by {force_N:.2g} N, {torque_Nm:.2g} N·m per axis within an hour (1 sigma)"
_MOUNTED = ("sensor_serial", "arm_serial", "mount")
# Largest number of days with weighings that are listed.
_MOST_DAYS = 20
# The last weighings are shown only if they are younger than this.
_RECENT = timedelta(days=90)


@click.command()
@click.argument("folders", metavar="[RUNS]...", nargs=-1, type=FOLDER)
@click.option("--tool", metavar="NAME", help="List only results of this tool.")
@click.option("--index", metavar="FOLDER", multiple=True, type=FOLDER, help="Add the runs in FOLDER first. Repeatable.")
@click.option("--rebuild", is_flag=True, help="Read all runs again first, and remove deleted ones.")
@click.option("--weighings", is_flag=True, help="List the last days with weighings.")
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
    """List results with date and last verification, trends of bias and payload, and the last weighings.

    The results come from the store, to which `calibrate` and `verify` add them, or from the run folders in RUNS. A
    trend is reported if it is significant at 1 %, both with the uncertainty of the results and with their scatter. If
    the sensor reports its temperature, the bias is also fitted against the temperature. Runs within a few hours give
    the change of the bias within an hour.
    """
    left_out: tuple[str, ...] = ()
    weighed: Sequence[WeighingDay] = ()
    name = None
    if folders:
        if option := (
            "--index" if index else "--rebuild" if rebuild else "--weighings" if weighings else "--store" if url else ""
        ):
            raise ConfigError(f"RUNS and {option} are mutually exclusive: leave one out")
        records, left_out = read_records(record_paths(folders))
        results = [one for one in records if isinstance(one, StoredResult) and tool in {None, one.tool}]
        results.sort(key=lambda one: (one.created_utc or "", one.id))
        checks = [one for one in records if isinstance(one, VerificationRecord)]
        checks.sort(key=lambda one: one.created_utc or "")
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
    warmth, moved = list[Any](), list[dict[str, Any]]()
    if len(results) + len(checks) >= _FEWEST_RUNS or any(one.temperature_C is not None for one in results):
        from ftdrive.store.trends import sensor_biases

        for key, (fit, change) in sensor_biases(results, checks).items():
            mounted = dict(zip(_MOUNTED, key, strict=True))
            warmth += [] if fit is None else [(mounted, fit)]
            if change is not None:
                moved.append(mounted | {"force_N": float(change[0]), "torque_Nm": float(change[3])})
    last = {check.calibration_id: check for check in checks}
    if as_json:
        rows = [one.to_dict(age_days(one.created_utc, now), last.get(one.id)) for one in results]
        about = {
            "trends": [one.to_dict() for one in found],
            "temperature": [mounted | _fit_json(fit) for mounted, fit in warmth],
            "hour_changes": moved,
            "warnings": advice,
            "last_weighings": [asdict(one) for one in weighed],
        }
        write_json({"schema_version": 1, "store": name, "results": rows, **about})
        return
    if not results:
        messages.print(
            "No results. Add them with `ftdrive calibrate`, or those of a folder with `ftdrive history --index runs`."
        )
        return
    titles, shown = result_table(results, last, now)
    print_table(titles, shown, folding={"arm", "tool", "verified", "run", "parent"})
    trend_lines = (f"trend: {drift}" for drift in found)
    warmth_lines = (line for mounted, fit in warmth for line in temperature_lines(mounted["sensor_serial"], fit))
    weighing_lines = (f"last weighing: {last_weighing_in_words(one)}" for one in weighed if one.mass_kg is not None)
    for line in (*trend_lines, *warmth_lines, *map(_HOUR.format_map, moved), *weighing_lines):
        echo(line)
    for words in advice:
        answer.print(indented(" ! ", words, answer), style="yellow")


def _fit_json(fit: Any) -> dict[str, Any]:
    return {
        "slope_per_K": fit.slope.tolist(),
        "sigma_per_K": fit.sigma.tolist(),
        "n": fit.n,
        "coldest_C": fit.coldest_C,
        "warmest_C": fit.warmest_C,
        "left_out_error": fit.error.tolist(),
        "left_out_error_without": fit.error_without.tolist(),
        "p_value": fit.p_value.tolist(),
        "applied": list(fit.predicts),
    }


def _print_left_out(left_out: Sequence[str]) -> None:
    for words in left_out:
        messages.print(indented(" left out: ", words))


def _show_weighings(days: Sequence[WeighingDay], name: str, left_out: Sequence[str], as_json: bool) -> None:
    _print_left_out(left_out)
    if as_json:
        write_json({"schema_version": 1, "store": name, "weighings": [asdict(one) for one in days]})
    elif not days:
        messages.print("No weighings. Add them with `ftdrive weigh` or `ftdrive serve-load`.")
    else:
        print_table(DAY_TITLES, [day_row(one) for one in days], folding={"arm", "tool", "refused"})
