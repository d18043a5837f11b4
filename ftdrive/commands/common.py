"""What several commands share: options, the progress bar, JSON on stdout."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from calib import CalibrationResult
    from calib.routine import Progress as RoutineProgress
    from ftdrive.config import CellConfig
    from ftdrive.runs import Run

JSON = click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout.")
RUNS = click.option(
    "--runs",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("runs"),
    show_default=True,
    help="Folder in which the run's own folder is made.",
)


CONFIG = click.option(
    "--config",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="The cell, in TOML, in place of ftdrive.toml here.",
)


def numbers(option: str, text: str, separator: str, counts: Sequence[int]) -> list[float]:
    """Read the numbers in the value of an option; raises `ConfigError` unless there are as many as asked for."""
    from math import isfinite

    from ftdrive.errors import ConfigError

    try:
        values = [float(part) for part in text.split(separator)]
    except ValueError:
        values = []
    if len(values) not in counts or not all(map(isfinite, values)):
        wanted = " or ".join(map(str, counts))
        raise ConfigError(f"{option} is '{text}': give {wanted} numbers separated by '{separator}'")
    return values


def rows(option: str, texts: Sequence[str], counts: Sequence[int]) -> list[list[float]] | None:
    """Read an option that may be repeated, numbers separated by colons; None where it was not given."""
    return [numbers(option, text, ":", counts) for text in texts] or None


def write_json(value: Mapping[str, Any]) -> None:
    """Write one JSON object to stdout, on one line."""
    click.echo(json.dumps(value))


def read_cell(config: Path | None, robot: str | None, sensor: str | None) -> "CellConfig":
    """Take the cell from options, environment and files, in this order of precedence."""
    from ftdrive.config import load

    return load(config, {"robot.host": ("--robot", robot), "sensor.url": ("--sensor", sensor)})


@contextmanager
def progress_bar() -> Iterator[tuple[Callable[["RoutineProgress"], None], Callable[["Run"], None]]]:
    """Show the routine's progress on stderr; when it fails, say where the poses taken so far are kept.

    Yields what to call with every step, and with the run as soon as it exists: the bar appears then, after questions.
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from ftdrive.report import describe, talk

    runs: list[Run] = []
    bar = Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=talk)
    task = bar.add_task("", total=None)

    def on_run(run: "Run") -> None:
        runs.append(run)
        bar.start()

    def on_progress(progress: "RoutineProgress") -> None:
        done = progress.stop - (progress.stage != "taken")
        bar.update(task, description=describe(progress), completed=done, total=progress.stops)

    try:
        yield on_progress, on_run
    except BaseException:
        for run in runs:
            bar.stop()
            poses = len(list((run.folder / "poses").glob("*.npz")))
            talk.print(f"{poses} poses are kept in {run.folder}")
        raise
    if runs:
        bar.stop()


def stop_unless_accepted(result: "CalibrationResult") -> None:
    """Raise `NotAccepted` for a rejected result."""
    from ftdrive.errors import NotAccepted

    if result.verdict == "rejected":
        raise NotAccepted("the result is rejected and was not saved: " + "; ".join(result.reasons))
