"""Run folders: what a session leaves, and what is solved and verified from it."""

from collections.abc import Iterable
from pathlib import Path


def is_run(folder: Path) -> bool:
    """Whether a folder is that of a run."""
    return (folder / "run.json").is_file()


def run_folders(folders: Iterable[Path]) -> list[Path]:
    """Return the runs among these folders, and those directly in them, each once and by name."""
    found = {run.parent for one in folders for name in ("run.json", "*/run.json") for run in one.resolve().glob(name)}
    return sorted(found)
