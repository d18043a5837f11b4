"""What the commands of a fleet that compute share: which runs, where, and the progress bar."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from ftdrive.commands.common import open_store

if TYPE_CHECKING:
    from ftdrive.fleet.workers import Workers

T = TypeVar("T")


def ENGINE(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options `workers` and `cluster`."""
    for option in (
        click.option("--cluster", metavar="dask://HOST:PORT", help="Compute on this Dask cluster instead."),
        click.option(
            "--workers", metavar="N", type=click.IntRange(min=1), help="Number of processes.  [default: one per core]"
        ),
    ):
        command = option(command)
    return command


def open_workers(workers: int | None, cluster: str | None) -> AbstractContextManager["Workers"]:
    """Start processes, or connect to a cluster; raises `ConfigError` if both are given."""
    from ftdrive.errors import ConfigError
    from ftdrive.fleet.workers import cluster_workers, local_workers

    if workers and cluster:
        raise ConfigError("--workers and --cluster exclude one another: leave one out")
    return local_workers(workers) if cluster is None else cluster_workers(cluster)


def with_progress(title: str, found: Iterator[T], total: int) -> Iterator[T]:
    """Show a progress bar on stderr."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from ftdrive.terminal.console import messages

    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=messages, transient=True, disable=not messages.is_terminal) as progress:
        yield from progress.track(found, total=total)


def runs_to_solve(folders: Sequence[Path], url: str | None, since: datetime | None = None) -> list[Path]:
    """Return the calibrations in these folders, or of the store; raises `ConfigError` if both are given.

    Those without a dataset or a recording in motion are left out, and counted on stderr.
    """
    from ftdrive.errors import ConfigError
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
    from ftcalib.errors import DataError
    from ftdrive.runs.run import Run

    try:
        mode = Run(folder).header().get("mode")
    except (DataError, OSError):
        mode = None
    if mode in ("sweep", "passive"):
        return f"start again with `ftdrive calibrate --{mode}`"
    return "`ftdrive calibrate --resume RUN` finishes one"
