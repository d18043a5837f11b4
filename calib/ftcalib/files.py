"""Files that are complete or absent, never overwritten, and name their format.

A JSON file also has its `checksum`, which reveals damage and edits.
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

# What `json` can write: numbers, strings, None, and lists and dicts of them.
JSON: TypeAlias = Any
# Largest text that is read whole: 200,000 poses with their covariances.
MOST_BYTES: Final = 200_000_000
# Longest line of a file that is read by lines: a calibration is a thousandth of it.
_LONGEST_LINE: Final = 16_000_000


def write_new(path: str | Path, content: str | bytes) -> None:
    """Write a new file: to `<name>.<process>.partial`, fsynced, then renamed.

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
        The folder is missing, the disk is full, …; no partial file remains.
    """
    path = Path(path)
    require_new(path)
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")  # of another process that writes the same name
    try:
        with partial.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        _give_name(partial, path)
    finally:
        partial.unlink(missing_ok=True)
    if os.name == "posix":  # so that the new name survives a power failure
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
    """Give a file its name; of two processes at once only one succeeds, where the disk has links."""
    try:
        path.hardlink_to(written)
    except FileExistsError:
        _refuse_existing(path)
        raise
    except (OSError, NotImplementedError):  # as on FAT
        _refuse_existing(path)
        written.rename(path)


def _refuse_existing(path: Path) -> None:
    if path.exists():
        raise FileExistsError(f"{path} exists already and is never overwritten: choose another name")


def unused_path(path: Path) -> Path:
    """Return the first of name, name-2 and so on that does not exist."""
    return next(one for one in _numbered_paths(path) if not one.exists())


def newest_path(path: Path) -> Path:
    """Return the last of name, name-2 and so on that exists; the name itself if it does not."""
    return [path, *takewhile(Path.exists, _numbered_paths(path))][-1]


def _numbered_paths(path: Path) -> Iterator[Path]:
    yield path
    yield from (path.with_stem(f"{path.stem}-{number}") for number in count(2))


def open_file(path: str | Path) -> BufferedReader:
    """Open a file for reading; raises `OSError`, also for a pipe or a device, whose reading may never end."""
    path = Path(path)
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):  # of a folder `open` has the words
        raise OSError(f"{path} is a pipe or a device: save its content in a file, and give that")
    return path.open("rb")


def read_file(path: str | Path) -> bytes:
    """Read a file whole; raises `OSError` as `open_file`, and above 200 MB."""
    with open_file(path) as file:
        if (size := os.fstat(file.fileno()).st_size) > MOST_BYTES:
            raise OSError(
                f"{path} has {size / 1e6:.0f} MB, more than {MOST_BYTES / 1e6:.0f} MB: check that it is the file"
            )
        return file.read(MOST_BYTES)


def read_lines(file: BufferedReader, error: type[Exception], first: int = 1) -> Iterator[bytes]:
    """Yield the lines of the rest of a file, with their ends; raise `error`, one sentence, for a line above 16 MB.

    Parameters
    ----------
    file : BufferedReader
    error : type
    first : int
        Number of the first line, for the error.
    """
    # An iteration over the file would read a line of any length, and hide the place in the file.
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
    """Parse JSON; raises `ValueError`, also if it is nested too deeply."""
    try:
        return json.loads(text)
    except RecursionError as exc:
        raise ValueError("its brackets are nested too deeply") from exc


def write_object(
    path: str | Path, document: Mapping[str, JSON], *, indent: int | None = 1, allow_nan: bool = False
) -> None:
    """Write a new JSON file with its checksum. Raises as `write_new`."""
    write_new(path, object_text(document, indent=indent, allow_nan=allow_nan))


def object_text(document: Mapping[str, JSON], *, indent: int | None = 1, allow_nan: bool = False) -> str:
    """Return the content of a JSON file: the document and its checksum."""
    return json.dumps({**document, "checksum": _checksum(document)}, indent=indent, allow_nan=allow_nan) + "\n"


def read_object(path: str | Path, error: type[Exception], *, accept_changed: bool = False) -> dict[str, Any]:
    """Read a JSON file as `object_of` takes its content. Raises `OSError` too."""
    return object_of(read_file(path), error, accept_changed=accept_changed)


def object_of(content: bytes, error: type[Exception], *, accept_changed: bool = False) -> dict[str, Any]:
    """Return the object in a JSON file; raise `error`, one sentence without the file name, if it has none.

    Parameters
    ----------
    content : bytes
        Content of the file. A document without a checksum, as people write it, is accepted.
    error : type
    accept_changed : bool
        Accept a document that its checksum does not fit.
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
            "the content differs from its checksum, so the file is damaged or was edited: take it from a copy. If you "
            "edited it yourself, delete its field 'checksum'."
        )
    return document


def is_changed(document: Mapping[str, JSON]) -> bool:
    """Whether a document differs from its checksum; False if it has none."""
    return "checksum" in document and document["checksum"] != _checksum(document)


def _checksum(document: Mapping[str, JSON]) -> str:
    """Return the SHA-256 of everything but the checksum, as JSON with sorted keys."""
    content = {name: value for name, value in document.items() if name != "checksum"}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def check_format(document: Mapping[str, object], expected: str, error: type[Exception]) -> None:
    """Check the field `format`, for example 'ftdrive.dataset/1'; raise `error` if it differs."""
    found = document.get("format")
    kind, _, version = expected.partition("/")
    if found is None:
        raise error(f"the field 'format' is missing: this is not an {kind} file.")
    if found == expected:
        return
    found_kind, _, found_version = str(found).partition("/")
    if found_kind != kind:
        raise error(f"the format is '{found}', not '{expected}': choose a file of that format.")
    raise error(
        f"version '{found_version}' of {kind} is unknown, this program reads version {version}: use a newer program."
    )
