"""`ftdrive fleet solve`: many runs at once."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime, timedelta
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ftcalib.errors import DataError
from ftcalib.rounding import counted
from ftdrive import __version__
from ftdrive.commands.common import FOLDER, JSON, STORE, open_store, write_json
from ftdrive.errors import ConfigError, NotAccepted
from ftdrive.terminal.text import echo

if TYPE_CHECKING:
    from ftdrive.fleet.resolve import Comparison


def _runs_to_solve(folders: Sequence[Path], url: str | None, since: datetime | None = None) -> list[Path]:
    """Return the calibrations in these folders, or of the store; raises `ConfigError` if both are given.

    Those without a dataset or a recording in motion are left out, and counted on stderr.
    """
    from ftdrive.fleet.resolve import is_calibration, run_folders
    from ftdrive.runs.run import Run, in_motion
    from ftdrive.terminal.console import messages

    if folders and url:
        raise ConfigError("RUNS and --store exclude one another: leave one out")
    found = run_folders(folders) if folders else sorted({Path(one.path).parent for one in open_store(url).results()})
    runs, unfinished = list[Path](), Counter[str]()
    for run in found:
        if is_calibration(run, since):
            if run.is_dir() and not (Run(run).dataset_path.exists() or in_motion(run)):
                unfinished[_how_to_finish(run)] += 1
            else:
                runs.append(run)
    for words, count in unfinished.items():
        messages.print(f"Left out, because they have no data to solve: {count} runs; {words}.")
    if not found:
        messages.print("No runs: name their folders, or add them to the store with `ftdrive fleet index RUNS`.")
    return runs


def _how_to_finish(folder: Path) -> str:
    from ftdrive.runs.run import Run

    try:
        mode = Run(folder).header().get("mode")
    except (DataError, OSError):
        mode = None
    if mode in ("sweep", "passive"):
        return f"start again with `ftdrive calibrate --{mode}`"
    return "`ftdrive calibrate --resume RUN` finishes one"


_UNITS = {"d": timedelta(days=1), "h": timedelta(hours=1)}


@click.command()
@click.argument("folders", metavar="[RUNS]...", nargs=-1, type=FOLDER)
@click.option("--since", metavar="TIME", help="Only runs since then: 90d, 12h or a date (UTC).")
@click.option(
    "--workers", metavar="N", type=click.IntRange(min=1), help="Number of processes.  [default: one per core]"
)
@click.option("--cluster", metavar="dask://HOST:PORT", help="Compute on this Dask cluster instead.")
@STORE
@JSON
def solve(
    folders: Sequence[Path],
    since: str | None,
    workers: int | None,
    cluster: str | None,
    url: str | None,
    as_json: bool,
) -> None:
    """Solve runs again with this version, and compare.

    The results are compared with the calibrations of the runs. RUNS are run folders or folders of runs, by default all
    runs that the store knows. Verifications are left out. Each result is written into its run folder as
    solved-VERSION.json, and no other command uses it. A run that has this file is only compared, so an interrupted
    command continues when it is repeated.

    The exit code is 7 if a run could not be solved.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from ftdrive.fleet.resolve import solve_again, solved_path
    from ftdrive.fleet.workers import cluster_workers, local_workers
    from ftdrive.terminal.console import messages

    runs = _runs_to_solve(folders, url, None if since is None else _time(since))
    report = _Solved(runs=len(runs), solved_before=sum(solved_path(run).exists() for run in runs))
    columns = (TextColumn("Solving"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    progress = Progress(*columns, console=messages, transient=True, disable=not messages.is_terminal)
    if workers and cluster:
        raise ConfigError("--workers and --cluster exclude one another: leave one out")
    with local_workers(workers) if cluster is None else cluster_workers(cluster) as pool, progress:
        for run, found in progress.track(solve_again(runs, pool), total=len(runs)):
            report.add(run, found)
    if as_json:
        write_json(report.to_dict())
    else:
        report.print()
    if report.failed:
        raise NotAccepted(f"{len(report.failed)} of {len(runs)} runs could not be solved: fix the reasons, and repeat")


def _time(since: str) -> datetime:
    """Return the time, UTC, of an age such as 90d or of a date; raises `ConfigError`."""
    try:
        if age := re.fullmatch(r"(\d+)([dh])", since):
            return datetime.now(UTC) - int(age[1]) * _UNITS[age[2]]
        time = datetime.fromisoformat(since)
    except (ValueError, OverflowError):
        raise ConfigError(
            f"--since is '{since}': give an age such as 90d or 12h, or a date such as 2026-08-31"
        ) from None
    return time if time.tzinfo else time.replace(tzinfo=UTC)


@dataclass(slots=True)
class _Solved:
    runs: int
    solved_before: int
    unchanged: int = 0
    changed: list[dict[str, Any]] = field(default_factory=list)
    other_verdict: list[dict[str, Any]] = field(default_factory=list)
    failed: list[dict[str, Any]] = field(default_factory=list)

    def add(self, run: Path, found: "Comparison | str") -> None:
        here = {"run": str(run)}
        if isinstance(found, str):
            self.failed.append({**here, "reason": found})
            return
        if found.has_changed:
            sigmas = found.sigmas if isfinite(found.sigmas) else None
            self.changed.append({**here, "parameter": found.parameter, "sigmas": sigmas})
        if found.has_other_verdict:
            finding = None if found.finding is None else found.finding.to_dict()
            verdicts = {"before": found.verdict_before, "now": found.verdict, "finding": finding}
            self.other_verdict.append({**here, **verdicts})
        self.unchanged += not (found.has_changed or found.has_other_verdict)

    def to_dict(self) -> dict[str, Any]:
        return {"schema_version": 1, "version": __version__, **asdict(self)}

    def print(self) -> None:
        now = self.runs - self.solved_before - len(self.failed)
        echo(
            f"{counted(self.runs, 'run')} with ftdrive {__version__}: {now} solved now, {self.solved_before} before, "
            f"{len(self.failed)} failed."
        )
        echo(
            f"{self.unchanged} unchanged, {len(self.changed)} changed by more than 3 sigmas, "
            f"{len(self.other_verdict)} with another verdict."
        )
        for one in self.changed:
            how = "was known and differs" if one["sigmas"] is None else f"changed by {one['sigmas']:+.1f} sigmas"
            echo(f"changed: {one['run']}: {one['parameter']} {how}")
        for one in self.other_verdict:
            why = f" ({one['finding']['words']})" if one["finding"] else ""
            echo(f"verdict: {one['run']}: {one['before'] or 'no result'} before, now {one['now']}{why}")
        for one in self.failed:
            echo(f"failed: {one['run']}: {one['reason']}")
