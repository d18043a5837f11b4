"""A bundle: a run in one zip file, without addresses and names, which `replay` and `solve` read like the run folder.

bundle.json         ftdrive.bundle/1: name of the run, whether it is emulated, what was redacted, what was left out
environment.json    versions of all packages, and the checks of the computer that need no device
<run>/...           the files of the run folder; texts are redacted, poses are copied byte for byte
transcripts/...     the files of `ftdrive transcript record`, redacted
"""

import io
import json
import os
import platform
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from errno import EINVAL
from importlib.metadata import distributions
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any, Final

from ftcalib.errors import BadDataset, UsageError
from ftcalib.files import check_format, open_file, read_file, read_object, write_new
from ftdrive.cell.config import recorded_cell
from ftdrive.checks.computer import SensorAddress, can_interfaces, check_disk, check_permissions, check_workcell
from ftdrive.errors import BadBundle
from ftdrive.runs.redaction import Redaction
from ftdrive.runs.run import LOCK, ZIP_DAMAGE, Run, versions

FORMAT: Final = "ftdrive.bundle/1"
MOST_BYTES: Final = 4_000_000_000
"""Of all files of a bundle together, unpacked. An hour at 7 kHz is 3 GB."""
MOST_FILES: Final = 20_000
_COPY_AGAIN: Final = "copy the bundle again, or ask for a new one"


@dataclass(frozen=True, slots=True)
class Bundled:
    """What `write_bundle` did."""

    redacted: dict[str, int]
    """Different values of each kind."""
    left_out: list[str]
    """Files of the run that are neither text nor poses, which cannot be redacted."""


def write_bundle(folder: Path, path: Path, transcripts: Sequence[Path] = ()) -> Bundled:
    """Write a run folder and transcripts to a new zip file, complete or not at all.

    Raises
    ------
    BadDataset
        The folder is no run folder.
    OSError
        `path` exists or cannot be written.
    """
    folder = folder.resolve()
    if not (folder / "run.json").is_file():
        raise BadDataset(f"{folder} is not a run folder: it has no run.json")
    redaction, left_out = Redaction(), []
    texts = {"environment.json": json.dumps(_environment(folder))}
    poses: dict[str, bytes] = {}
    for file in sorted(one for one in folder.rglob("*") if (not one.is_dir() or one.is_symlink()) and one.name != LOCK):
        name = file.relative_to(folder.parent).as_posix()
        content = file.read_bytes() if file.is_file() and not file.is_symlink() else None  # a pipe has no end
        if content is not None and file.suffix == ".npz":
            poses[name] = content
        elif content is not None and (text := _text(content)) is not None:
            texts[name] = text
        else:
            left_out.append(file.relative_to(folder).as_posix())
    for number, file in enumerate(transcripts, 1):
        if (text := _text(read_file(file))) is None:
            raise BadBundle(f"{file} is not a text file: give a file of `ftdrive transcript record`")
        texts[f"transcripts/{number}-{file.name}"] = text
    for text in texts.values():
        redaction.learn(text)
    clean = {name: redaction.file(text) for name, text in texts.items()}
    bundled = Bundled(redaction.counts, left_out)
    about = {
        "format": FORMAT,
        "created_utc": datetime.now(UTC).isoformat(),
        "run": folder.name,
        "emulated": _is_emulated(folder),
        **asdict(bundled),
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("bundle.json", json.dumps(about, indent=1))
        for name, text in clean.items():
            archive.writestr(name, text)
        for name, content in poses.items():  # compressed already
            archive.writestr(name, content, zipfile.ZIP_STORED)
    write_new(path, buffer.getvalue())
    return bundled


@contextmanager
def unpacked(source: Path) -> Iterator[Path]:
    """Yield the run folder in a bundle, which is deleted afterwards; any source but a .zip file as it is.

    Raises
    ------
    BadBundle
        The file is damaged, no bundle, too large, or has names that lead out of its folder.
    """
    if source.suffix.lower() != ".zip" or source.is_dir():
        yield source
        return
    with TemporaryDirectory(prefix="ftdrive-") as folder:
        yield _unpack(source, Path(folder))


def _unpack(source: Path, folder: Path) -> Path:
    try:
        with open_file(source) as file, zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            _require_harmless(members)
            archive.extractall(folder)
        for poses in folder.rglob("*.npz"):
            _require_small(poses)
        return _run_in(folder)
    except BadBundle as error:
        raise BadBundle(f"{source}: {error}") from error
    except FileNotFoundError as error:
        raise BadBundle(f"{source} is not a bundle, it has no bundle.json: {_COPY_AGAIN}") from error
    except (*ZIP_DAMAGE, OSError) as error:
        if isinstance(error, OSError) and error.errno not in (None, EINVAL):  # such as a full disk
            raise
        raise BadBundle(f"{source} is not a zip file or is damaged ({error}): {_COPY_AGAIN}") from error


def _run_in(folder: Path) -> Path:
    about = read_object(folder / "bundle.json", BadBundle)
    check_format(about, FORMAT, BadBundle)
    run = folder / str(about.get("run"))
    if run.parent != folder or not (run / "run.json").is_file():
        raise BadBundle(f"it has no run {about.get('run')!r}: {_COPY_AGAIN}")
    return run


def _require_harmless(members: Sequence[zipfile.ZipInfo]) -> None:
    """Check names and sizes before anything is written; `zipfile` reads no more than the size stated for a file."""
    if len(members) > MOST_FILES or sum(member.file_size for member in members) > MOST_BYTES:
        limits = f"{MOST_BYTES / 1e9:g} GB or {MOST_FILES} files"
        raise BadBundle(f"it unpacks to more than {limits}: do not use this file, or unpack it by hand")
    for member in members:
        path = PurePosixPath(member.filename)
        if path.is_absolute() or ".." in path.parts or "\\" in member.filename or ":" in member.filename:
            raise BadBundle(f"the name {member.filename!r} leads out of its folder: do not use this file")
    if len({member.filename for member in members}) < len(members):
        raise BadBundle(f"two files have the same name: {_COPY_AGAIN}")


def _require_small(poses: Path) -> None:
    """Check what the arrays of a pose unpack to. A damaged pose is left to `Run`, which names it."""
    try:
        with zipfile.ZipFile(poses) as arrays:
            size = sum(one.file_size for one in arrays.infolist())
    except (*ZIP_DAMAGE, OSError):
        return
    if size > MOST_BYTES:
        raise BadBundle(f"{poses.name} unpacks to {size / 1e9:.0f} GB: do not use this file")


def _text(content: bytes) -> str | None:
    try:
        text = content.decode()
    except UnicodeDecodeError:
        return None
    return None if "\0" in text else text


def _is_emulated(folder: Path) -> bool | None:
    try:
        return Run(folder).header().get("station") is not None
    except BadDataset:  # a damaged run is worth a report too
        return None


def _environment(folder: Path) -> dict[str, Any]:
    """Return versions, and the checks of this computer and of the described cell."""
    packages = {about["Name"]: about["Version"] for about in (each.metadata for each in distributions())}
    facts: dict[str, Any] = {
        "versions": versions(),
        "packages": dict(sorted(packages.items(), key=lambda item: item[0].lower())),
        "machine": platform.machine(),
        "cpus": os.cpu_count(),
        "can_interfaces": can_interfaces(),
    }
    try:
        cell = recorded_cell(Run(folder).header()["config"])
        checks = [check_disk(folder), check_workcell(cell, cell.robot.model)]
        checks += check_permissions(SensorAddress.of(cell.sensor.url))
    except (BadDataset, UsageError, TypeError) as error:  # a damaged run is worth a report too
        return facts | {"error": str(error)}
    return facts | {"checks": [asdict(check) for check in checks]}
