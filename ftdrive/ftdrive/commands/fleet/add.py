"""`ftdrive fleet add`: cells from a cells.toml into the store."""

from pathlib import Path

import click

from ftdrive.commands.common import FILE, STORE, open_store


@click.command()
@click.argument("file", metavar="CELLS.TOML", type=FILE)
@STORE
def add(file: Path, url: str | None) -> None:
    """Add the cells of CELLS.TOML to the store.

    Cells of the same name are replaced. Each has a table [cells.NAME] with `config`, the path of its ftdrive.toml, and
    `verify_every_days`. Its runs are found by the serial number of the arm (`arm_serial`, or [robot] serial), else by
    [robot] host.
    """
    from ftdrive.fleet.cells import read_cells, refuse_ambiguous
    from ftdrive.terminal.console import answer

    found = open_store(url)
    cells = read_cells(file)
    names = {cell.name for cell in cells}
    known = found.cells()
    refuse_ambiguous([*cells, *(cell for cell in known if cell.name not in names)])
    found.put_cells(cells)
    replaced = len(names & {cell.name for cell in known})
    answer.print(f" {len(cells) - replaced} added, {replaced} replaced in {found.name}")
