"""The store of results and verifications: an index of run folders. The folders stay the truth.

The database is imported by the first function that needs it: most commands neither look up nor index a result.
"""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ftdrive.cell.config import CellConfig, settings
from ftdrive.errors import BadStore, ConfigError

if TYPE_CHECKING:
    from ftdrive.store.store import Store


def store_url() -> str | None:
    """Return [store] url from environment and files; None is the user's store."""
    url: str | None = settings()["store.url"].value
    return url


def open_store(url: str | None = None) -> "Store":
    """Return the store at an address, else that of environment and files."""
    from ftdrive.store.store import Store

    return Store(url or store_url())


def index_run(folder: Path, say: Callable[[str], object], cell: CellConfig | None = None) -> None:
    """Add a run to the store, and the runs beside it that it lacks; if that fails, `say` gets one sentence.

    The run folder is complete without the store, and the next call adds it. Without a real cell the store is that of
    environment and files.
    """
    from ftdrive.store.store import Store

    try:
        Store(store_url() if cell is None else cell.store.url).index(folder.resolve().parent)
    except (BadStore, ConfigError, OSError) as error:
        say(f" The run is saved but not in the history yet, because {error}.")
