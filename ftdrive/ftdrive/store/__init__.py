"""The store of results and verifications: an index of run folders, which remain the source of the data.

Functions import the database only when needed, because most commands do not use the store.
"""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ftdrive.cell.config import CellConfig, settings
from ftdrive.errors import BadStore, ConfigError

if TYPE_CHECKING:
    from ftdrive.store.store import Store


def store_url() -> str | None:
    """Return `[store] url` from the environment or a file; None if it is not set, for the user's default store."""
    url: str | None = settings()["store.url"].value
    return url


def open_store(url: str | None = None) -> "Store":
    """Return the store at an address, by default the address from `store_url`."""
    from ftdrive.store.store import Store

    return Store(url or store_url())


def index_run(folder: Path, say: Callable[[str], object], cell: CellConfig | None = None) -> None:
    """Add a run, and other new runs in its parent folder, to the store of `cell`, or without a cell of `store_url`.

    An error is only reported, by one call to `say`, because the run folder is complete without the store, and a later
    call adds it.
    """
    from ftdrive.store.store import Store

    try:
        Store(store_url() if cell is None else cell.store.url).index(folder.resolve().parent)
    except (BadStore, ConfigError, OSError) as error:
        say(f" The run is saved, but not yet in the history, because {error}.")
