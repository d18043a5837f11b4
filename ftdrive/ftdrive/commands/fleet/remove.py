"""`ftdrive fleet remove`: cells out of the store; their runs stay."""

from collections.abc import Sequence

import click

from ftdrive.commands.common import STORE, open_store


@click.command()
@click.argument("names", metavar="CELL...", nargs=-1, required=True)
@STORE
def remove(names: Sequence[str], url: str | None) -> None:
    """Remove cells from the store. Their runs and results stay."""
    from ftdrive.errors import ConfigError
    from ftdrive.fleet.words import listed
    from ftdrive.terminal.console import answer

    found = open_store(url)
    known = [cell.name for cell in found.cells()]
    if unknown := [name for name in names if name not in known]:
        instead = f"the cells are {listed(known)}" if known else "it has no cells"
        raise ConfigError(f"the store {found.name} has no cell {unknown[0]}: {instead}")
    found.remove_cells(names)
    answer.print(f" {len(set(names))} removed from {found.name}")
