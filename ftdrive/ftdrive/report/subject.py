"""What a report is about: a result, as much of its data as its source holds, and whether the data are as they were."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

from ftcalib import CalibrationDataset, CalibrationResult, solve
from ftcalib.errors import BadCalibration
from ftcalib.files import read_object
from ftcalib.result import Method
from ftcalib.routine import PoseRecord
from ftdrive.errors import BadStore, ConfigError
from ftdrive.runs.run import Run, in_motion, is_run
from ftdrive.runs.source import SolveOptions, read_source, solve_in_motion
from ftdrive.runs.verification import VerificationRecord, age_of, newest, verification_near


def trust(
    result: CalibrationResult, source: Path, store_url: Callable[[], str | None], now: datetime
) -> dict[str, Any]:
    """Return age and last verification of a result; a store that cannot be read is named in `store_error`.

    Parameters
    ----------
    result : CalibrationResult
    source : Path
        Its file or run folder.
    store_url : callable
        Reads `[store] url`; None is the user's store.
    now : datetime
    """
    kept, error = _of_store(result.id, store_url)
    last = newest(one for one in (verification_near(source, result.id), kept) if one is not None)
    words = ", ".join([*age_of(result, now), "not verified" if last is None else last.in_words(now)])
    return {"words": words, "last_verification": None if last is None else _plain(last), "store_error": error}


def _of_store(calibration_id: str, url: Callable[[], str | None]) -> tuple[VerificationRecord | None, str]:
    """Return what the store has, and why it cannot be read."""
    from ftdrive.store.store import Store

    try:
        return Store(url()).last_verification(calibration_id), ""
    except (BadStore, ConfigError) as error:
        return None, str(error)


def _plain(one: VerificationRecord) -> dict[str, Any]:
    return {
        "created_utc": None if one.created_utc is None else one.created_utc.astimezone(UTC).isoformat(),
        "passed": one.passed,
        "change": one.change,
        "reason": one.reason or "",
        "path": str(one.path),
    }


@dataclass(frozen=True, slots=True, eq=False)
class Subject:
    """A result with its data; what the source does not hold is None or empty."""

    source: Path
    result: CalibrationResult
    reproduce: str
    """Command that gives the result again; empty if the data are not here."""
    dataset: CalibrationDataset | None = None
    run: Run | None = None
    records: Sequence[PoseRecord] = ()
    solved_with: Mapping[str, Any] = field(default_factory=dict)
    """What `ftcalib.compare` takes beside the dataset."""
    parent: CalibrationResult | None = None
    parent_name: str = ""
    """Name of the result to compare with, or why there is none."""
    trust: Mapping[str, Any] | None = None
    """Age and last verification, from `ftdrive.report.subject`; None if nothing was looked up."""


def read_subject(source: Path, options: SolveOptions, parent: Path | None = None) -> Subject:
    """Read a calibration file, a run folder, a dataset.json or a CSV file; solve what is not solved.

    A run folder keeps its saved result if that rests on its present poses and no option asks for another one. A
    calibration file in a run folder is reported with the data of that run.

    Parameters
    ----------
    source : Path
    options : SolveOptions
    parent : Path, optional
        Calibration file or run folder of the result to compare with. Default: the parent that the result names.

    Raises
    ------
    ConfigError, DataError, NotObservable, OSError
    """
    if _is_calibration(source):
        if options != SolveOptions():
            raise ConfigError(f"{source} is solved already: give its dataset or run, or leave out the options of solve")
        subject = _of_result(source, CalibrationResult.load(source))
    else:
        subject = _of_data(source, options)
    before, name = _parent(subject.result, source, parent)
    return replace(subject, parent=before, parent_name=name)


def _is_calibration(source: Path) -> bool:
    """Check whether a file says that it is a calibration; False if it is no JSON, which reading it as data reports."""
    if source.is_dir() or source.suffix != ".json":
        return False
    try:
        return str(read_object(source, BadCalibration, accept_changed=True).get("format", "")).startswith(
            "ftdrive.calibration/"
        )
    except BadCalibration:
        return False


def _of_result(source: Path, result: CalibrationResult) -> Subject:
    folder = source.absolute().parent
    if is_run(folder) and not in_motion(folder):
        data = read_source(folder, SolveOptions())
        if data.dataset.sha256() == result.provenance.get("dataset_sha256"):
            run = Run(folder)
            return Subject(source, result, run.solve_command, data.dataset, run, data.records, data.circumstances)
    return Subject(source, result, "")


def _in_motion(source: Path, options: SolveOptions) -> Subject:
    """Return the subject of a run in motion, which has no dataset."""
    run = Run(source)
    if options == SolveOptions() and run.calibration_path.is_file():
        result = CalibrationResult.load(run.calibration_path)
    else:
        result = solve_in_motion(run, options.known)
    return Subject(source, result, " ".join([run.solve_command, *options.words]), run=run)


def _of_data(source: Path, options: SolveOptions) -> Subject:
    if in_motion(source):
        return _in_motion(source, options)
    data = read_source(source, options)
    solved_with = {"drift": options.drift, **data.circumstances}
    run = Run(source) if source.is_dir() else None
    result, method = None, cast("Method", options.method)
    command = " ".join(["ftdrive solve", shlex.quote(str(source)), *options.words])
    if run is not None and options == SolveOptions():
        method, command = run.method, run.solve_command
    if run is not None and options == SolveOptions() and run.calibration_path.is_file():
        result = CalibrationResult.load(run.calibration_path)
    if result is None or result.provenance.get("dataset_sha256") != data.dataset.sha256():
        result = solve(data.dataset, method, **solved_with, provenance=data.provenance)
        solved_with |= {"default": result} if method == "ml" else {}
    return Subject(source, result, command, data.dataset, run, data.records, solved_with)


def _parent(result: CalibrationResult, source: Path, given: Path | None) -> tuple[CalibrationResult | None, str]:
    """Load the result to compare with; also return its name, or the reason why there is none."""
    if given is not None:
        path = Run(given).calibration_path if given.is_dir() else given
        return CalibrationResult.load(path), str(given)
    named = result.provenance.get("parent")
    if not isinstance(named, Mapping):
        return None, ""
    path = Path(str(named.get("path", "")))
    for at in (path, source.absolute().parent / path):
        if at.is_file():
            found = CalibrationResult.load(at)
            if found.id == named.get("id"):
                return found, f"{path}, its parent"
    return None, f"The parent {named.get('id')} is not at {path}: name its file with --parent."
