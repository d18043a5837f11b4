"""Read and write files. A file is written completely or not at all, is never overwritten, and states its format.

A JSON file has a `checksum`, which reveals damage and edits.
"""

import hashlib
import json
import os
import stat
from collections.abc import Iterator, Mapping
from io import BufferedReader
from itertools import count, takewhile
from pathlib import Path
from typing import Any, Final, TypeAlias

# Type of values that `json` can write: numbers, strings, None, and lists and dicts of these.
JSON: TypeAlias = Any
# Largest file that is read as a whole: 200,000 poses with covariances.
MOST_BYTES: Final = 200_000_000
# Longest accepted line of a file that is read line by line: a thousand times the size of a calibration.
_LONGEST_LINE: Final = 16_000_000


def write_new(path: str | Path, content: str | bytes) -> None:
    """Write a new file: first to `<name>.<process>.partial`, which is fsynced and then renamed.

    Parameters
    ----------
    path : str or Path
        A file that does not exist yet, in a folder that does.
    content : str or bytes
        Text is written as UTF-8.

    Raises
    ------
    FileExistsError
        The file exists.
    OSError
        The folder is missing or the disk is full, for example; no partial file remains.
    """
    path = Path(path)
    require_new(path)
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")  # each process writes a partial file of its own
    try:
        with partial.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        _give_name(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    if os.name == "posix":  # syncing the folder lets the new name survive a power failure
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def require_new(path: Path) -> None:
    """Raise an `OSError` if the file exists or its folder does not."""
    _refuse_existing(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"the folder {path.parent} does not exist: create it first")


def _give_name(written: Path, path: Path) -> None:
    """Rename a written file; if two processes do so at once, only one succeeds on file systems with hard links."""
    try:
        path.hardlink_to(written)
    except FileExistsError:
        _refuse_existing(path)
        raise
    except (OSError, NotImplementedError):  # a file system without hard links, such as FAT
        _refuse_existing(path)
        written.rename(path)


def _refuse_existing(path: Path) -> None:
    if path.exists():
        raise FileExistsError(f"{path} exists already and is never overwritten: choose another name")


def unused_path(path: Path) -> Path:
    """Return the first path among name, name-2, name-3, … that does not exist."""
    return next(numbered for numbered in _numbered_paths(path) if not numbered.exists())


def newest_path(path: Path) -> Path:
    """Return the last existing path of the sequence name, name-2, name-3, …; `path` itself if none exists."""
    return [path, *takewhile(Path.exists, _numbered_paths(path))][-1]


def _numbered_paths(path: Path) -> Iterator[Path]:
    yield path
    yield from (path.with_stem(f"{path.stem}-{number}") for number in count(2))


def open_file(path: str | Path) -> BufferedReader:
    """Open a file for reading; raise `OSError` also for a pipe or a device, from which reading may never end."""
    path = Path(path)
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):  # a folder is left to `open`, whose error is clear
        raise OSError(f"{path} is a pipe or a device: save its content in a file, and give that file")
    return path.open("rb")


def read_file(path: str | Path) -> bytes:
    """Return the content of a file; raise `OSError` as `open_file` does, and for a file larger than 200 MB."""
    with open_file(path) as file:
        if (size := os.fstat(file.fileno()).st_size) > MOST_BYTES:
            raise OSError(
                f"{path} has {size / 1e6:.0f} MB, and the limit is {MOST_BYTES / 1e6:.0f} MB: check that it is the "
                "right file"
            )
        return file.read(MOST_BYTES)


def read_lines(file: BufferedReader, error: type[Exception], first: int = 1) -> Iterator[bytes]:
    """Yield the remaining lines of a file with their line ends; raise `error` for a line longer than 16 MB.

    Parameters
    ----------
    first : int
        Number of the first line, for the error message.
    """
    # Iterating over the file would read a line of any length and disable `tell`.
    for number in count(first):
        line = file.readline(_LONGEST_LINE)
        if len(line) == _LONGEST_LINE:
            raise error(
                f"line {number} is longer than {_LONGEST_LINE / 1e6:.0f} MB: the file is damaged or of another kind"
            )
        if not line:
            return
        yield line


def parsed_json(text: str | bytes) -> JSON:
    """Return parsed JSON; raise `ValueError` for invalid JSON, also if it is nested too deeply."""
    try:
        return json.loads(text)
    except RecursionError as exc:
        raise ValueError("its brackets are nested too deeply") from exc


def write_object(
    path: str | Path, document: Mapping[str, JSON], *, indent: int | None = 1, allow_nan: bool = False
) -> None:
    """Write a new JSON file with a checksum. Raises whatever `write_new` raises."""
    write_new(path, object_text(document, indent=indent, allow_nan=allow_nan))


def object_text(document: Mapping[str, JSON], *, indent: int | None = 1, allow_nan: bool = False) -> str:
    """Return the text of a JSON file: the document with its checksum."""
    return json.dumps({**document, "checksum": _checksum(document)}, indent=indent, allow_nan=allow_nan) + "\n"


def read_object(path: str | Path, error: type[Exception], *, accept_changed: bool = False) -> dict[str, Any]:
    """Return the object in a JSON file; raise `error` as `object_of` does, or `OSError`."""
    return object_of(read_file(path), error, accept_changed=accept_changed)


def object_of(content: bytes, error: type[Exception], *, accept_changed: bool = False) -> dict[str, Any]:
    """Return the object in the content of a JSON file; raise `error`, without the file name, if there is none.

    Parameters
    ----------
    content : bytes
        Content of the file. A document without a checksum, such as a hand-written one, is accepted.
    accept_changed : bool
        Whether to accept a document that differs from its checksum.
    """
    try:
        text = content.decode()
    except UnicodeDecodeError as exc:
        raise error(f"this is not a text file (byte {exc.start} is not UTF-8): is it the right file?") from exc
    if not text.strip():
        raise error("the file is empty: repeat the run that wrote it.")
    try:
        document = parsed_json(text)
    except ValueError as exc:
        raise error(f"this is not valid JSON ({exc}): the file is damaged or of another kind.") from exc
    if not isinstance(document, dict):
        raise error(f"the file contains a JSON {type(document).__name__}, not an object: is it the right file?")
    if not accept_changed and is_changed(document):
        raise error(
            "the content differs from its checksum, so the file is damaged or was edited: restore it from a copy. If "
            "you edited it yourself, delete its field 'checksum'."
        )
    return document


def is_changed(document: Mapping[str, JSON]) -> bool:
    """Whether a document differs from its checksum; False if it has none."""
    return "checksum" in document and document["checksum"] != _checksum(document)


def _checksum(document: Mapping[str, JSON]) -> str:
    """Return the SHA-256 of a document without its checksum, as JSON with sorted keys."""
    content = {name: value for name, value in document.items() if name != "checksum"}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def check_format(document: Mapping[str, object], expected: str, error: type[Exception]) -> None:
    """Raise `error` if the field `format` of a document, such as 'ftdrive.dataset/1', is not the expected one."""
    actual = document.get("format")
    kind, _, version = expected.partition("/")
    if actual is None:
        raise error(f"the field 'format' is missing: this is not an {kind} file.")
    if actual == expected:
        return
    actual_kind, _, actual_version = str(actual).partition("/")
    if actual_kind != kind:
        raise error(f"the format is '{actual}', not '{expected}': choose a file of that format.")
    raise error(
        f"version '{actual_version}' of {kind} is unknown, this program reads version {version}: use a newer program."
    )
