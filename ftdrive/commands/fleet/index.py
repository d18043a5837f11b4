"""`ftdrive fleet index`: run folders into the store."""

from collections.abc import Sequence
from pathlib import Path

import click

from ftdrive.commands.common import FOLDER, store_url, upgrade_store


@click.command()
@click.argument("folders", metavar="RUNS...", nargs=-1, required=True, type=FOLDER)
@click.option("--store", metavar="URL", help="Store to write, instead of [store] url.")
def index(folders: Sequence[Path], store: str | None) -> None:
    """Add the runs in the folders RUNS to the store. A run that is known is not read again.

    A store of an earlier version is upgraded first.
    """
    from ftdrive.store.store import Store
    from ftdrive.terminal.console import hanging, talk

    found = Store(store or store_url())
    upgrade_store(found)
    indexed = found.index(*folders)
    for words in indexed.unreadable:
        talk.print(hanging(" left out: ", words))
    talk.print(f" {indexed.results} results and {indexed.verifications} verifications added to {found.name}")
