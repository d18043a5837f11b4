"""Run folders, and what stands at a place of a document that any version or hand may have written."""

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from typing import Any


def is_run(folder: Path) -> bool:
    """Whether a folder is that of a run."""
    return (folder / "run.json").is_file()


def run_folders(folders: Iterable[Path]) -> list[Path]:
    """Return the runs among these folders, and those directly in them, each once and by name."""
    found = {run.parent for one in folders for name in ("run.json", "*/run.json") for run in one.resolve().glob(name)}
    return sorted(found)


def at(document: Any, *keys: str) -> Any:
    """Return the value below these keys; None if there is no such place."""
    for key in keys:
        document = document.get(key) if isinstance(document, Mapping) else None
    return document


def text_at(document: Any, *keys: str) -> str | None:
    """Return a text that every database takes: without zero characters and halves of a surrogate pair."""
    found = at(document, *keys)
    return found.encode(errors="replace").decode().replace("\0", "\ufffd") if isinstance(found, str) and found else None


def number_at(document: Any, *keys: str) -> float | None:
    """Return a finite number; None for anything else."""
    found = at(document, *keys)
    usable = isinstance(found, int | float) and not isinstance(found, bool) and isfinite(found)
    return float(found) if usable else None


def numbers_at(document: Any, n: int, *keys: str) -> list[float] | None:
    """Return a list of n finite numbers; None for anything else."""
    found = at(document, *keys)
    known = [one for one in map(number_at, found) if one is not None] if isinstance(found, list) else []
    return known if len(known) == n == len(found or ()) else None


def time_at(document: Any, *keys: str) -> str | None:
    """Return a time as UTC in ISO 8601 with microseconds, so that texts sort as times; None for anything else."""
    try:
        return datetime.fromisoformat(at(document, *keys)).astimezone(UTC).isoformat(timespec="microseconds")
    except (TypeError, ValueError):
        return None
