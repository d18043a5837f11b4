"""Where the commands of a fleet compute: the options that choose it, and the progress bar."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from ftdrive.fleet.workers import Workers

T = TypeVar("T")


def ENGINE(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options `workers` and `cluster`."""
    for option in (
        click.option("--cluster", metavar="dask://HOST:PORT", help="Compute on this Dask cluster instead."),
        click.option("--workers", metavar="N", type=click.IntRange(min=1), help="Processes.  [default: one per core]"),
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

    from ftdrive.terminal.console import talk

    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=talk, transient=True, disable=not talk.is_terminal) as progress:
        yield from progress.track(found, total=total)
