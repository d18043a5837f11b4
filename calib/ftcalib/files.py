"""Files that are complete or absent, never overwritten, and name their format."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

JSON: TypeAlias = Any
"""What `json` can write: numbers, strings, None, and lists and dicts of them."""


def write_new(path: str | Path, content: str | bytes) -> None:
    """Write a new file: to `<name>.partial`, fsynced, then renamed.

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
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        _refuse_existing(path)
        partial.rename(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
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


def _refuse_existing(path: Path) -> None:
    if path.exists():
        raise FileExistsError(f"{path} exists already and is never overwritten: choose another name")


def read_object(path: str | Path, error: type[Exception]) -> dict[str, Any]:
    """Read a JSON file with one object; raise `error`, one sentence without the file name, if it has none."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except UnicodeDecodeError as exc:
        raise error(f"this is not a text file (byte {exc.start} is not UTF-8): is it the right file?") from exc
    if not text.strip():
        raise error("the file is empty: repeat the run that wrote it.")
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as exc:  # RecursionError from deeply nested brackets
        raise error(f"this is not valid JSON ({exc}): the file is damaged or of another kind.") from exc
    if not isinstance(document, dict):
        raise error(f"the file contains a JSON {type(document).__name__}, not an object: is it the right file?")
    return document


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
