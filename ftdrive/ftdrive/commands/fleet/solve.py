"""`ftdrive fleet solve` and `compensate`: many runs and recordings at once."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime, timedelta
from math import isfinite
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from ftcalib.rounding import counted
from ftdrive import __version__
from ftdrive.commands.common import FOLDER, FORCE, FRAME, JSON, STORE, open_store, read_frame, write_json
from ftdrive.commands.compensate import BIAS, CALIBRATION
from ftdrive.terminal.text import echo

if TYPE_CHECKING:
    from ftdrive.fleet.resolve import Comparison
    from ftdrive.fleet.workers import Workers
    from ftdrive.live.samples import Axes


T = TypeVar("T")


def _ENGINE(command: Callable[..., Any]) -> Callable[..., Any]:
    for option in (
        click.option("--cluster", metavar="dask://HOST:PORT", help="Compute on this Dask cluster instead."),
        click.option(
            "--workers", metavar="N", type=click.IntRange(min=1), help="Number of processes.  [default: one per core]"
        ),
    ):
        command = option(command)
    return command


def _open_workers(workers: int | None, cluster: str | None) -> AbstractContextManager["Workers"]:
    """Start processes, or connect to a cluster; raises `ConfigError` if both are given."""
    from ftdrive.errors import ConfigError
    from ftdrive.fleet.workers import cluster_workers, local_workers

    if workers and cluster:
        raise ConfigError("--workers and --cluster exclude one another: leave one out")
    return local_workers(workers) if cluster is None else cluster_workers(cluster)


def _with_progress(title: str, found: Iterator[T], total: int) -> Iterator[T]:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from ftdrive.terminal.console import messages

    columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=messages, transient=True, disable=not messages.is_terminal) as progress:
        yield from progress.track(found, total=total)


def _runs_to_solve(folders: Sequence[Path], url: str | None, since: datetime | None = None) -> list[Path]:
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


@click.command()
@click.argument("paths", metavar="RECORDINGS...", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option(
    "-o",
    "--output",
    "folder",
    metavar="FOLDER",
    required=True,
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder for the results; it is created if it is missing.",
)
@CALIBRATION
@FORCE
@BIAS
@FRAME
@_ENGINE
@JSON
def compensate(
    paths: Sequence[Path],
    folder: Path,
    calibration: Path | None,
    force: bool,
    bias: str,
    axes: "Axes",
    about: str,
    workers: int | None,
    cluster: str | None,
    as_json: bool,
) -> None:
    """Compensate many recordings with a calibration; no device is needed.

    RECORDINGS are files of `ftdrive record` or folders of them. Each result becomes a new file of the same name in
    FOLDER. Without --calibration each recording uses its own. A recording whose result exists is left out, whatever its
    options were, so an interrupted command continues when it is repeated.

    The exit code is 7 if a recording could not be compensated.
    """
    from ftdrive.errors import NotAccepted
    from ftdrive.fleet.compensate import compensate_all, recordings_of, require_own_results, task_of

    recordings = recordings_of(paths)
    require_own_results(recordings, folder)
    _mention_incomplete(paths)
    task = task_of(calibration, read_frame(axes, about), bias, accept_edited=force)
    left = [one for one in recordings if not (folder / one.name).exists()]
    report = _Compensated(recordings=len(recordings), before=len(recordings) - len(left))
    with _open_workers(workers, cluster) as pool:
        folder.mkdir(parents=True, exist_ok=True)
        for recording, found in _with_progress("Compensating", compensate_all(left, folder, task, pool), len(left)):
            report.add(recording, found)
    if as_json:
        write_json(report.to_dict())
    else:
        echo("\n".join(report.words()))
    if report.failed:
        count = f"{len(report.failed)} of {len(recordings)} recordings"
        raise NotAccepted(f"{count} could not be compensated: fix the reasons, and repeat")


def _mention_incomplete(paths: Sequence[Path]) -> None:
    """Print how many recordings of these folders were interrupted."""
    from ftdrive.recording.files import ENDINGS
    from ftdrive.terminal.console import messages

    inside = [one for path in paths if path.is_dir() for one in path.glob("*.partial")]
    if count := sum(Path(one.stem).suffix in ENDINGS for one in inside):
        messages.print(f"Left out, because they are incomplete: {count} recordings; `ftdrive convert` saves one.")


@dataclass(slots=True)
class _Compensated:
    recordings: int
    before: int
    compensated: list[dict[str, Any]] = field(default_factory=list)
    failed: list[dict[str, Any]] = field(default_factory=list)

    def add(self, recording: Path, found: dict[str, Any] | str) -> None:
        """Add a recording."""
        here = {"recording": str(recording)}
        if isinstance(found, str):
            self.failed.append({**here, "reason": found})
        else:
            self.compensated.append({**here, **found})

    @property
    def samples(self) -> int:
        """Samples of the recordings that were compensated now."""
        return sum(one["samples"] for one in self.compensated)

    def to_dict(self) -> dict[str, Any]:
        """Return all as JSON, by recording."""
        return {
            "schema_version": 1,
            "recordings": self.recordings,
            "compensated_before": self.before,
            "samples": self.samples,
            "compensated": sorted(self.compensated, key=itemgetter("recording")),
            "failed": sorted(self.failed, key=itemgetter("recording")),
        }

    def words(self) -> Iterator[str]:
        """Give the numbers, then one line for each recording with contacts or gaps, and for each that failed."""
        from ftcalib.rounding import counted

        found = self.to_dict()
        yield (
            f"{counted(self.recordings, 'recording')}: {len(self.compensated)} compensated now, {self.before} before, "
            f"{len(self.failed)} failed; {counted(self.samples, 'sample')}."
        )
        for one in found["compensated"]:
            facts = list(map(str, one["marks"]))
            if contacts := one["contacts"]:
                facts.append(f"contacts: {len(contacts)}, largest {max(each['peak_N'] for each in contacts):.2f} N")
            if one["gaps"]:
                facts.append(f"gaps: {one['gaps']}")
            if one["cut"]:
                facts.append(f"incomplete: {one['duration_s']:.1f} s of it are used")
            if facts:
                yield f"{one['recording']}: {'; '.join(facts)}"
        for one in found["failed"]:
            yield f"failed: {one['recording']}: {one['reason']}"


_UNITS = {"d": timedelta(days=1), "h": timedelta(hours=1)}


@click.command()
@click.argument("folders", metavar="[RUNS]...", nargs=-1, type=FOLDER)
@click.option("--since", metavar="TIME", help="Only runs since then: 90d, 12h or a date (UTC).")
@_ENGINE
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
    from ftdrive.errors import NotAccepted
    from ftdrive.fleet.resolve import solve_again, solved_path

    runs = _runs_to_solve(folders, url, None if since is None else _time(since))
    report = _Solved(runs=len(runs), solved_before=sum(solved_path(run).exists() for run in runs))
    with _open_workers(workers, cluster) as pool:
        for run, found in _with_progress("Solving", solve_again(runs, pool), len(runs)):
            report.add(run, found)
    if as_json:
        write_json(report.to_dict())
    else:
        report.print()
    if report.failed:
        raise NotAccepted(f"{len(report.failed)} of {len(runs)} runs could not be solved: fix the reasons, and repeat")


def _time(since: str) -> datetime:
    """Return the time, UTC, of an age such as 90d or of a date; raises `ConfigError`."""
    from ftdrive.errors import ConfigError

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
        """Add a run."""
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
        """Return the fields as JSON."""
        return {"schema_version": 1, "version": __version__, **asdict(self)}

    def print(self) -> None:
        """Print the numbers, then one line for each run that changed or failed."""
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
