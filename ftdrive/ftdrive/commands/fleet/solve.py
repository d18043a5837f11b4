"""`ftdrive fleet solve`: solve many runs again with this version, here or on a Dask cluster."""

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime, timedelta
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ftdrive import __version__
from ftdrive.commands.common import FOLDER, JSON, STORE, write_json
from ftdrive.commands.fleet.engine import ENGINE, open_workers, runs_to_solve, with_progress
from ftdrive.terminal.text import echo

if TYPE_CHECKING:
    from ftdrive.fleet.resolve import Comparison

_UNITS = {"d": timedelta(days=1), "h": timedelta(hours=1)}


@click.command()
@click.argument("folders", metavar="[RUNS]...", nargs=-1, type=FOLDER)
@click.option("--since", metavar="TIME", help="Only runs since then: 90d, 12h or a date (UTC).")
@ENGINE
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

    runs = runs_to_solve(folders, url, None if since is None else _time(since))
    report = _Report(runs=len(runs), solved_before=sum(solved_path(run).exists() for run in runs))
    with open_workers(workers, cluster) as pool:
        for run, found in with_progress("Solving", solve_again(runs, pool), len(runs)):
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
class _Report:
    """What became of the runs."""

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
            f"{self.runs} runs with ftdrive {__version__}: {now} solved now, {self.solved_before} before, "
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
