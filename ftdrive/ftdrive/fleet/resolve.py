"""Solve runs again with this version, and compare each result with the calibration of the run.

solved-<version>.json   ftdrive.calibration/2, in the run folder: the result of that version, which never replaces the
                        calibration of the run.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from math import isfinite
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from ftcalib import CalibrationDataset, CalibrationResult, Finding, solve
from ftcalib.after.series import calibration_difference
from ftcalib.errors import BadCalibration, BadDataset
from ftcalib.files import read_object, write_new
from ftcalib.model import PARAMETER_NAMES
from ftcalib.rounding import counted
from ftdrive import __version__
from ftdrive.fleet.workers import (
    SAME,
    Call,
    OtherVersion,
    Workers,
    answers,
    describe_error,
    folder_of_worker,
    require_version,
)
from ftdrive.runs.calibration import versions
from ftdrive.runs.run import IN_MOTION, Run
from ftdrive.runs.source import circumstances_of, solve_in_motion

CHANGED_SIGMAS: Final = 3.0
# Patterns of the files of a run that are needed to solve it.
_FILES: Final = ("run.json", "events.ndjson", "dataset*.json", "calibration*.json", "motion*.npz", "motion/*.npz")


def solved_path(folder: Path) -> Path:
    """Return the path in a run folder where the result of this version of ftdrive is saved."""
    return folder / f"solved-{__version__}.json"


def is_calibration(folder: Path, since: datetime | None) -> bool:
    """Return whether a run is a calibration made since a time; also True for a damaged run, so that it is reported."""
    try:
        header = Run(folder).header()
        recent = since is None or datetime.fromisoformat(header["created_utc"]) >= since
    except (BadDataset, OSError, TypeError, ValueError):
        return True
    return recent and header.get("command") != "verify"


def runs_to_solve(folders: Iterable[Path], since: datetime | None, say: Callable[[str], object]) -> list[Path]:
    """Return those runs that are calibrations with data; `say` receives how many have none, and how to finish them."""
    runs, unfinished = list[Path](), Counter[str]()
    for run in folders:
        if is_calibration(run, since):
            if run.is_dir() and not (Run(run).dataset_path.exists() or Run(run).in_motion):
                finish = "finish each with `ftdrive calibrate --resume RUN`"
                with suppress(BadDataset, OSError):
                    if (mode := Run(run).mode) in IN_MOTION:
                        finish = f"start again with `ftdrive calibrate --{mode}`"
                unfinished[finish] += 1
            else:
                runs.append(run)
    for words, count in unfinished.items():
        say(f"Runs left out because they have no data to solve: {count}; {words}.")
    return runs


def solve_run(folder: Path, version: str = __version__) -> bytes:
    """Return the calibration file of a run, which depends only on the files of the run and the installed versions.

    Raises `OtherVersion` in a worker with another version; `BadDataset`, `BadCalibration` or `OSError` for a damaged or
    missing file of the run; and `NotObservable`.
    """
    require_version(version)
    run = Run(folder)
    same = {name: version for name, version in versions().items() if name in SAME}
    if run.in_motion:
        result, created_utc = solve_in_motion(run), run.header().get("created_utc")
        origin = {name: value for name, value in result.provenance.items() if name != "argv"}
        result = replace(result, provenance={**origin, "created_utc": created_utc, "versions": same})
    else:
        known, own = circumstances_of(run), run.header()
        if run.calibration_path.is_file():
            own = CalibrationResult.load(run.calibration_path).provenance
        provenance = {"created_utc": own.get("created_utc"), **known.origin, "versions": same}
        poses = CalibrationDataset.from_dict(read_object(run.dataset_path, BadDataset))
        result = solve(poses, run.method, g_m_s2=known.g_m_s2, setup=known.setup, provenance=provenance)
    return (json.dumps(result.to_dict(), allow_nan=False, indent=1) + "\n").encode()


def _solve_files(name: str, files: Mapping[str, bytes], version: str) -> bytes:
    """Solve a run from the contents of its files, on another computer; otherwise like `solve_run`."""
    with TemporaryDirectory(prefix="ftdrive-solve-", dir=folder_of_worker()) as place:
        for path, content in files.items():
            file = Path(place, name, path)
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
        return solve_run(Path(place, name), version)


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison of the result that this version solved with the calibration that the run has."""

    verdict_before: str | None
    """Verdict of the calibration of the run; None if none was saved, because it was rejected or not observable."""
    verdict: str
    finding: Finding | None
    """First finding that this version reports on the result; None if its verdict is good."""
    parameter: str
    """Parameter with the largest change between the results, of `ftcalib.model.PARAMETER_NAMES`."""
    sigmas: float
    """Change of `parameter`, in sigmas of both results; infinite if both results take this parameter as known."""

    @property
    def has_changed(self) -> bool:
        """Whether a parameter changed by more than `CHANGED_SIGMAS`."""
        return abs(self.sigmas) > CHANGED_SIGMAS

    @property
    def has_other_verdict(self) -> bool:
        """Whether the two verdicts differ; a run without a calibration counts as rejected."""
        return self.verdict != (self.verdict_before or "rejected")


def solve_again(folders: Iterable[Path], workers: Workers) -> Iterator[tuple[Path, Comparison | str]]:
    """Solve runs and save each result when it is ready; yield each folder with the comparison, or the error text.

    Runs that already have a result of this version come first and are only compared. All yielded results are saved,
    even if the caller stops. Raises `OtherVersion` if a worker has another version.
    """
    rest = list[Path]()
    for folder in folders:
        if solved_path(folder).exists():
            yield folder, _compared(folder)
        else:
            rest.append(folder)

    def call_of(folder: Path) -> Call:
        if workers.share_files:
            return solve_run, folder, __version__
        circumstances_of(Run(folder))  # report damage here, because the paths of the worker mean nothing to the user
        paths = {file for pattern in _FILES for file in folder.glob(pattern)}
        files = {file.relative_to(folder).as_posix(): file.read_bytes() for file in sorted(paths)}
        return _solve_files, folder.name, files, __version__

    for folder, answer in answers(call_of, rest, workers):
        if isinstance(answer, OtherVersion):
            raise answer
        yield folder, describe_error(answer) if isinstance(answer, BaseException) else _compared(folder, answer)


def _compared(folder: Path, document: bytes | None = None) -> Comparison | str:
    """Save a new result, and compare it with the newest calibration of the run if that has the same data."""
    try:
        if document is not None:
            write_new(solved_path(folder), document)
        new, path = CalibrationResult.load(solved_path(folder)), Run(folder).calibration_path
        old = CalibrationResult.load(path) if path.is_file() else None
    except (BadCalibration, OSError) as error:
        return describe_error(error)
    finding = None if new.verdict == "good" else new.findings[0]
    if old is None or _data_hash(old) != _data_hash(new):
        return Comparison(None, new.verdict, finding, PARAMETER_NAMES[0], 0.0)
    change = calibration_difference(old, new).in_sigmas
    most = int(np.argmax(np.abs(change)))
    return Comparison(old.verdict, new.verdict, finding, PARAMETER_NAMES[most], float(change[most]))


def _data_hash(result: CalibrationResult) -> object:
    """Return the hash of the data from which a result was solved: its poses, or its recording in motion."""
    return result.provenance.get("dataset_sha256") or result.provenance.get("recording_sha256")


@dataclass(slots=True)
class SolvedAgain:
    """Summary of solving runs again."""

    runs: int
    solved_before: int
    unchanged: int = 0
    changed: list[dict[str, Any]] = field(default_factory=list)
    other_verdict: list[dict[str, Any]] = field(default_factory=list)
    failed: list[dict[str, Any]] = field(default_factory=list)

    def add(self, run: Path, outcome: Comparison | str) -> None:
        """Count an outcome that `solve_again` yielded."""
        here = {"run": str(run)}
        if isinstance(outcome, str):
            self.failed.append({**here, "reason": outcome})
            return
        if outcome.has_changed:
            sigmas = outcome.sigmas if isfinite(outcome.sigmas) else None
            self.changed.append({**here, "parameter": outcome.parameter, "sigmas": sigmas})
        if outcome.has_other_verdict:
            finding = None if outcome.finding is None else outcome.finding.to_dict()
            verdicts = {"before": outcome.verdict_before, "now": outcome.verdict, "finding": finding}
            self.other_verdict.append({**here, **verdicts})
        self.unchanged += not (outcome.has_changed or outcome.has_other_verdict)

    def to_dict(self) -> dict[str, Any]:
        """Return the summary as a dictionary for JSON."""
        return {"schema_version": 1, "version": __version__, **asdict(self)}

    def lines(self) -> Iterator[str]:
        """Yield the counts, and one line per run that changed, has another verdict, or failed."""
        now = self.runs - self.solved_before - len(self.failed)
        yield (
            f"{counted(self.runs, 'run')} with ftdrive {__version__}: {now} solved now, {self.solved_before} before, "
            f"{len(self.failed)} failed."
        )
        yield (
            f"{self.unchanged} unchanged, {len(self.changed)} changed by more than 3 sigma, "
            f"{len(self.other_verdict)} with another verdict."
        )
        for entry in self.changed:
            how = "is no longer as known" if entry["sigmas"] is None else f"changed by {entry['sigmas']:+.1f} sigma"
            yield f"changed: {entry['run']}: {entry['parameter']} {how}"
        for entry in self.other_verdict:
            why = f" ({entry['finding']['words']})" if entry["finding"] else ""
            yield f"verdict: {entry['run']}: {entry['before'] or 'no result'} before, now {entry['now']}{why}"
        for entry in self.failed:
            yield f"failed: {entry['run']}: {entry['reason']}"
