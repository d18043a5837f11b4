"""A writer of a store, for processes that write at once."""

from pathlib import Path

from ftdrive.store.store import Store


def write(url: str, folder: Path) -> None:
    """Index the runs of a folder one after the other."""
    for run in sorted(folder.iterdir()):
        Store(url, wait_s=60).index(run)
