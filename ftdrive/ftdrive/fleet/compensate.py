"""Compensate many recordings, each in a call of its own.

FOLDER/<name of the recording>   the result, in the format of the recording
"""

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from os import fsdecode
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir, mkdtemp
from typing import Any

from ftcalib import CalibrationResult
from ftcalib.files import write_new
from ftdrive import __version__
from ftdrive.errors import BadRecording, ConfigError
from ftdrive.fleet.workers import OtherVersion, Workers, answers, describe_error, folder_of_worker, require_version
from ftdrive.live.samples import WrenchFrame
from ftdrive.recording.compensation import compensate_recording, read_with_calibration
from ftdrive.recording.files import ENDINGS, format_of
from ftdrive.recording.growing_file import publish
from ftdrive.recording.recording import frame_of
from ftdrive.runs.source import read_calibration


def recordings_of(paths: Iterable[Path]) -> list[Path]:
    """Return the recordings among these paths, and those directly in these folders, each once and by name.

    Raises
    ------
    ConfigError
        A file has another ending or is incomplete, a folder contains no recording, or a package is missing.
    """
    found = set[Path]()
    for path in paths:
        if path.suffix == ".partial":
            raise ConfigError(f"{path} is incomplete: save it with `ftdrive convert`, and name the new file")
        files = [one for one in path.iterdir() if one.suffix in ENDINGS and one.is_file()] if path.is_dir() else [path]
        if not files:
            raise ConfigError(f"{path} contains no .mcap, .csv or .parquet file: name a folder of recordings")
        for one in files:
            format_of(one)
            found.add(one.parent.resolve() / one.name)
    return sorted(found)


def require_own_results(recordings: Iterable[Path], folder: Path) -> None:
    """Raise `ConfigError` if two results would have the same path, or a result that of its recording."""
    seen = dict[str, Path]()
    for one in recordings:
        if (other := seen.setdefault(one.name, one)) is not one:
            raise ConfigError(f"{other} and {one} have the same name: compensate them into two folders")
        if one.parent == folder.resolve():
            raise ConfigError(f"the result of {one} would have the path of the recording: choose another folder")


def task_of(calibration: Path | None, frame: WrenchFrame, bias: str, *, accept_edited: bool = False) -> bytes:
    """Return what `compensated_file` needs beside the recording, as JSON.

    Parameters
    ----------
    calibration : Path, optional
        A calibration.json or its run folder; without it each recording uses its own.
    frame : WrenchFrame
        Of the results.
    bias : str
        "keep", or "estimate" from each recording.
    accept_edited : bool
        Of the calibration, as in `read_calibration`.

    Raises
    ------
    BadCalibration, OSError
        The calibration cannot be read.
    """
    found = None if calibration is None else read_calibration(calibration, accept_edited=accept_edited)
    document = None if found is None else found.to_dict()
    given = {"calibration": document, "calibration_name": str(calibration), "bias": bias, **frame.to_dict()}
    return json.dumps({"version": __version__, **given}).encode()


def compensated_file(source: Path, folder: Path, task: bytes) -> bytes:
    """Compensate a recording into a new file below a folder, in blocks; return its path and a line of JSON.

    The line has the numbers of `ftdrive.recording.compensation.compensate_recording`.

    Raises
    ------
    OtherVersion
        The task was made by another version.
    ConfigError, DataError
        The recording cannot be compensated in this way.
    OSError
        The result cannot be written.
    """
    # Written into a folder .unfinished-…: a result gets its name when it is complete.
    given: dict[str, Any] = json.loads(task)
    require_version(given["version"])
    document = given["calibration"]
    calibration = None if document is None else CalibrationResult.from_dict(document)
    try:
        reader = read_with_calibration(source, calibration, given["calibration_name"])
        output = Path(mkdtemp(dir=folder)) / f"result{source.suffix}"
        estimate = given["bias"] == "estimate"
        numbers, _ = compensate_recording(reader, frame_of(given), output, estimate_bias=estimate, overlap=False)
    # The report names the recording, which here may be a temporary file.
    except BadRecording as error:
        raise BadRecording(error.problem) from error
    return f"{output}\n{json.dumps(numbers)}".encode()


def compensated_bytes(recording: bytes, name: str, task: bytes) -> bytes:
    """Return the file of the result and a line of JSON, on a computer that does not have the recording.

    A pure function of its arguments and the installed versions. Raises as `compensated_file`.
    """
    # A cluster needs no shared disk, so recordings travel as bytes.
    try:
        with TemporaryDirectory(prefix="ftdrive-compensate-", dir=folder_of_worker()) as folder:
            source = Path(folder) / name
            source.write_bytes(recording)
            output, _, line = compensated_file(source, Path(folder), task).rpartition(b"\n")
            return Path(fsdecode(output)).read_bytes() + b"\n" + line
    except OSError as error:
        place = folder_of_worker() or gettempdir()
        raise OSError(f"{place} on the worker: {error}: make room there, or set TMPDIR") from error


def compensate_all(
    recordings: Sequence[Path], folder: Path, task: bytes, workers: Workers
) -> Iterator[tuple[Path, dict[str, Any] | str]]:
    """Compensate recordings into a folder; yield each as it comes with its numbers, or why it failed.

    A file is written whole or not at all, so everything that was yielded remains when the caller stops. Processes of
    this computer read and write the files themselves; to a cluster they travel as bytes, two for each worker at a time.

    Raises
    ------
    OtherVersion
        A worker has another version.
    """
    # A recording is large.
    alone = replace(workers, group=1)
    with TemporaryDirectory(prefix=".unfinished-", dir=folder) as unfinished:

        def paths(recording: Path) -> tuple[Path, Path, bytes]:
            return recording, Path(unfinished), task

        def content(recording: Path) -> tuple[bytes, str, bytes]:
            return recording.read_bytes(), recording.name, task

        found = (
            answers(compensated_file, paths, recordings, alone)
            if workers.share_files
            else answers(compensated_bytes, content, recordings, alone)
        )
        for recording, answer in found:
            if isinstance(answer, OtherVersion):
                raise answer
            if isinstance(answer, BaseException):
                yield recording, describe_error(answer)
            else:
                yield recording, _saved(folder / recording.name, answer, is_path=workers.share_files)


def _saved(path: Path, answer: bytes, *, is_path: bool) -> dict[str, Any] | str:
    """Give a result its name, or write it; return its numbers, or why that is impossible."""
    content, _, line = answer.rpartition(b"\n")
    try:
        if is_path:
            publish(Path(fsdecode(content)), path)
        else:
            write_new(path, content)
    except OSError as error:
        return f"{path} is not written ({error.strerror or error}): make room in {path.parent}, then repeat"
    numbers: dict[str, Any] = json.loads(line)
    return numbers
