"""`ftdrive fleet compensate`: compensate many recordings, here or on a Dask cluster."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ftdrive.commands.common import FORCE, FRAME, JSON, read_frame, write_json
from ftdrive.commands.compensate import BIAS, CALIBRATION
from ftdrive.commands.fleet.engine import ENGINE, open_workers, with_progress
from ftdrive.terminal.text import echo

if TYPE_CHECKING:
    from ftdrive.live.samples import Axes


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
@ENGINE
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
    report = _Report(recordings=len(recordings), before=len(recordings) - len(left))
    with open_workers(workers, cluster) as pool:
        folder.mkdir(parents=True, exist_ok=True)
        for recording, found in with_progress("Compensating", compensate_all(left, folder, task, pool), len(left)):
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
class _Report:
    """What became of the recordings."""

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
        """Of the recordings that were compensated now."""
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
