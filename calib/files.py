"""Files that are whole or absent, never overwritten, and say what they are."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

JSON: TypeAlias = Any
"""What `json` can write: numbers, strings, None, and lists and dicts of them."""


def write_new(path: Path, content: str | bytes) -> None:
    """Write a new file: to `<name>.partial`, fsynced, then renamed.

    Parameters
    ----------
    path : Path
        A file that does not exist yet, in a folder that does.
    content : str or bytes
        Text is written as UTF-8.

    Raises
    ------
    FileExistsError
        The file is there already.
    OSError
        The folder is missing, the disk is full, …; nothing is left behind.
    """
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
    if os.name == "posix":  # the new name must survive a power cut too
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def require_new(path: Path) -> None:
    """Raise an `OSError` unless the file is not there yet, and its folder is."""
    _refuse_existing(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"the folder {path.parent} does not exist: create it first")


def _refuse_existing(path: Path) -> None:
    if path.exists():
        raise FileExistsError(f"{path} exists already and is never overwritten: choose another name")


def read_object(path: Path, error: type[Exception]) -> dict[str, Any]:
    """Read a JSON file that holds one object; raise `error`, one sentence without the file's name, when it does not."""
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as exc:
        raise error(f"this is not a text file (byte {exc.start} is not UTF-8): is it the right file?") from exc
    if not text.strip():
        raise error("the file is empty: the run that wrote it left nothing to read.")
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as exc:  # the latter from thousands of brackets in brackets
        raise error(f"this is not valid JSON ({exc}): the file is damaged or of another kind.") from exc
    if not isinstance(document, dict):
        raise error(f"the file holds a JSON {type(document).__name__}, not an object: is it the right file?")
    return document


def check_format(document: Mapping[str, object], expected: str, error: type[Exception]) -> None:
    """Check the field `format`, for example 'ftdrive.dataset/1'; raise `error` when it is another one."""
    found = document.get("format")
    kind, _, version = expected.partition("/")
    if found is None:
        raise error(f"the field 'format' is missing: this is not an {kind} file.")
    if found == expected:
        return
    found_kind, _, found_version = str(found).partition("/")
    if found_kind != kind:
        raise error(f"the format is '{found}', not '{expected}': this is another kind of file.")
    raise error(
        f"version '{found_version}' of {kind} is unknown, this program reads version {version}: use a newer program."
    )
