"""Subject of a report: a result, and the data from which it was solved."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any, cast

from ftcalib import CalibrationDataset, CalibrationResult, solve
from ftcalib.errors import BadCalibration
from ftcalib.files import read_object
from ftcalib.result import Method
from ftcalib.routine import PoseRecord
from ftdrive.errors import BadStore, ConfigError
from ftdrive.runs import is_run
from ftdrive.runs.run import Run
from ftdrive.runs.source import RecordedData, SolveOptions, read_source, solve_in_motion
from ftdrive.runs.verification import age_and_check, newest, verification_near

# Message of a report if the store of verifications cannot be read.
MAY_BE_MISSING = "a later verification may be missing, because {}"


def trust_facts(
    result: CalibrationResult, source: Path, store_url: Callable[[], str | None], now: datetime
) -> dict[str, Any]:
    """Return the age and the last verification of a result; `store_error` contains an error from the store.

    `source` is the file or run folder of the result. `store_url` reads `[store] url`; None means the user's store.
    """
    # imported here, because a help text must not wait 0.25 s for the import of SQLAlchemy
    from ftdrive.store.store import Store

    last, error = verification_near(source, result.id), ""
    try:
        # Search both, because a new store may lack a verification, and so may the folder of a moved result.
        last = newest(filter(None, (last, Store(store_url()).last_verification(result.id))))
    except (BadStore, ConfigError) as unreadable:
        error = str(unreadable)
    found = None
    if last is not None:
        found = last.to_dict(("created_utc", "passed", "change", "reason", "path")) | {"reason": last.reason or ""}
    return {"words": age_and_check(result, last, now), "last_verification": found, "store_error": error}


@dataclass(frozen=True, slots=True, eq=False)
class Subject:
    """A result with the data from which it was solved; what the source does not contain is None or empty."""

    source: Path
    result: CalibrationResult
    reproduce: str
    """Command that reproduces the result; empty if the source has no data."""
    dataset: CalibrationDataset | None = None
    run: Run | None = None
    records: Sequence[PoseRecord] = ()
    solved_with: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of `ftcalib.compare` besides the dataset, to compare the methods under the same assumptions."""
    parent: CalibrationResult | None = None
    parent_name: str = ""
    """Name of the result `parent` to compare with, or why it was not found."""


def read_subject(source: Path, options: SolveOptions, parent: Path | None = None) -> Subject:
    """Read a calibration file, a run folder, a dataset.json or a table; solve data that have no result yet.

    The saved result of a run folder is used if it belongs to the current poses and no option requires a new one. A
    calibration file in a run folder is reported with the data of that run. The result is compared with `parent`, by
    default the parent named in the result. Raises `ConfigError`, `DataError`, `NotObservable` or `OSError`.
    """
    if _is_calibration(source):
        if options != SolveOptions():
            raise ConfigError(f"{source} is already solved: give its dataset or run, or leave out the options of solve")
        subject = _of_result(source, CalibrationResult.load(source))
    else:
        subject = _of_data(source, options)
    before, name = _parent(subject.result, source, parent)
    return replace(subject, parent=before, parent_name=name)


def _is_calibration(source: Path) -> bool:
    """Whether a file is a calibration; False if it is no valid JSON, because reading it as data reports that."""
    if source.is_dir() or source.suffix != ".json":
        return False
    try:
        found = read_object(source, BadCalibration, accept_changed=True).get("format")
        return str(found).startswith("ftdrive.calibration/")
    except BadCalibration:
        return False


def _of_result(source: Path, result: CalibrationResult) -> Subject:
    folder = source.absolute().parent
    if is_run(folder) and not Run(folder).in_motion:
        data = read_source(folder, SolveOptions())
        if data.dataset.sha256() == result.provenance.get("dataset_sha256"):
            run = Run(folder)
            return Subject(source, result, run.solve_command, data.dataset, run, data.records, _known_of(data))
    return Subject(source, result, "")


def _of_data(source: Path, options: SolveOptions) -> Subject:
    run, saved = Run(source) if source.is_dir() else None, None
    if run is not None and options == SolveOptions() and run.calibration_path.is_file():
        saved = CalibrationResult.load(run.calibration_path)
    if run is not None and run.in_motion:
        command = " ".join([run.solve_command, *options.words])
        return Subject(source, saved or solve_in_motion(run, options.known), command, run=run)
    data, result = read_source(source, options), saved
    solved_with = {"drift": options.drift, **_known_of(data)}
    method = cast("Method", options.method)
    command = " ".join(["ftdrive solve", shlex.quote(str(source)), *options.words])
    if run is not None and options == SolveOptions():
        method, command = run.method, run.solve_command
    if result is None or result.provenance.get("dataset_sha256") != data.dataset.sha256():
        result = solve(data.dataset, method, **solved_with, provenance=data.provenance)
        solved_with |= {"default": result} if method == "ml" else {}
    return Subject(source, result, command, data.dataset, run, data.records, solved_with)


def _known_of(data: RecordedData) -> dict[str, Any]:
    return {"known": data.known, "g_m_s2": data.g_m_s2, "setup": data.setup}


def _parent(result: CalibrationResult, source: Path, given: Path | None) -> tuple[CalibrationResult | None, str]:
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
    return None, f"The parent {named.get('id')} is not at {path}: give its file with --parent."
