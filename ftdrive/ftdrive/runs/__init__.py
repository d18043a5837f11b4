"""Run folders: the data of sessions, and the results and verifications from them."""

from collections.abc import Iterable
from pathlib import Path


def is_run(folder: Path) -> bool:
    """Return whether a folder is a run folder, which has a run.json."""
    return (folder / "run.json").is_file()


def run_folders(folders: Iterable[Path]) -> list[Path]:
    """Return the run folders among these folders and directly in them, sorted by name without duplicates."""
    names = ("run.json", "*/run.json")
    return sorted({run.parent for folder in folders for name in names for run in folder.resolve().glob(name)})
