"""`ftdrive fleet solve`: solve many runs."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import click
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ftdrive.commands.options import FOLDER, JSON, STORE, write_json
from ftdrive.errors import ConfigError, NotAccepted
from ftdrive.fleet.resolve import SolvedAgain, runs_to_solve, solve_again, solved_path
from ftdrive.fleet.workers import cluster_workers, local_workers
from ftdrive.runs import run_folders
from ftdrive.store import open_store
from ftdrive.terminal.console import messages
from ftdrive.terminal.text import echo

_UNITS = {"d": timedelta(days=1), "h": timedelta(hours=1)}


@click.command("solve")
@click.argument("folders", metavar="[RUNS]...", nargs=-1, type=FOLDER)
@click.option("--since", metavar="TIME", help="Solve only runs since this age or date (UTC), such as 90d or 12h.")
@click.option(
    "--workers", metavar="N", type=click.IntRange(min=1), help="Number of processes.  [default: one per core]"
)
@click.option("--cluster", metavar="dask://HOST:PORT", help="Compute on this Dask cluster instead.")
@STORE
@JSON
def fleet_solve(
    folders: Sequence[Path],
    since: str | None,
    workers: int | None,
    cluster: str | None,
    url: str | None,
    as_json: bool,
) -> None:
    """Solve runs again with this version, and compare.

    The results are compared with the calibrations of the runs. RUNS are run folders or folders of runs; the default is
    all runs in the store. Verifications are left out. Each result is written to its run folder as solved-VERSION.json,
    which no other command uses. Runs with this file are only compared, so an interrupted command continues when
    repeated.

    The exit code is 7 if a run could not be solved.
    """
    if folders and url:
        raise ConfigError("RUNS and --store are mutually exclusive: leave one out")
    after = None if since is None else _parse_since(since)
    found = run_folders(folders) if folders else sorted({Path(one.path).parent for one in open_store(url).results()})
    if not found:
        messages.print("No runs: give their folders, or add them to the store with `ftdrive fleet index RUNS`.")
    runs = runs_to_solve(found, after, messages.print)
    report = SolvedAgain(runs=len(runs), solved_before=sum(solved_path(run).exists() for run in runs))
    columns = (TextColumn("Solving"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    progress = Progress(*columns, console=messages, transient=True, disable=not messages.is_terminal)
    if workers and cluster:
        raise ConfigError("--workers and --cluster are mutually exclusive: leave one out")
    with local_workers(workers) if cluster is None else cluster_workers(cluster) as pool, progress:
        for run, outcome in progress.track(solve_again(runs, pool), total=len(runs)):
            report.add(run, outcome)
    if as_json:
        write_json(report.to_dict())
    else:
        echo("\n".join(report.lines()))
    if report.failed:
        raise NotAccepted(f"{len(report.failed)} of {len(runs)} runs could not be solved: fix the causes, and repeat")


def _parse_since(since: str) -> datetime:
    try:
        if age := re.fullmatch(r"(\d+)([dh])", since):
            return datetime.now(UTC) - int(age[1]) * _UNITS[age[2]]
        time = datetime.fromisoformat(since)
    except (ValueError, OverflowError):
        raise ConfigError(
            f"--since is '{since}': give an age such as 90d or 12h, or a date such as 2026-08-31"
        ) from None
    return time if time.tzinfo else time.replace(tzinfo=UTC)
