"""`ftdrive fleet add`, `remove` and `index`: the cells and runs in the store."""

from collections.abc import Sequence
from pathlib import Path

import click

from ftcalib.rounding import counted
from ftdrive.commands.options import FILE, FOLDER, STORE
from ftdrive.errors import ConfigError
from ftdrive.fleet.cells import Owners, read_cells, refuse_ambiguous
from ftdrive.fleet.state import join_names
from ftdrive.store import open_store
from ftdrive.store.records import record_paths
from ftdrive.terminal.console import answer, indented, messages


@click.command()
@click.argument("file", metavar="CELLS.TOML", type=FILE)
@STORE
def add(file: Path, url: str | None) -> None:
    """Add the cells of CELLS.TOML to the store.

    Existing cells with the same name are replaced. Each cell has a table [cells.NAME] with `config`, the path of its
    ftdrive.toml, and `verify_every_days`. The runs of a cell are found by the serial number of the arm (`arm_serial`,
    or [robot] serial), else by [robot] host.
    """
    found = open_store(url)
    cells = read_cells(file)
    names = {cell.name for cell in cells}
    known = found.cells()
    refuse_ambiguous([*cells, *(cell for cell in known if cell.name not in names)])
    found.put_cells(cells)
    replaced = len(names & {cell.name for cell in known})
    answer.print(f" {len(cells) - replaced} added, {replaced} replaced in {found.name}")


@click.command()
@click.argument("names", metavar="CELL...", nargs=-1, required=True)
@STORE
def remove(names: Sequence[str], url: str | None) -> None:
    """Remove cells from the store. Their runs and results stay."""
    found = open_store(url)
    known = [cell.name for cell in found.cells()]
    if unknown := [name for name in names if name not in known]:
        instead = f"the cells are {join_names(known)}" if known else "it has no cells"
        raise ConfigError(f"the store {found.name} has no cell {unknown[0]}: {instead}")
    found.remove_cells(names)
    answer.print(f" {len(set(names))} removed from {found.name}")


@click.command()
@click.argument("folders", metavar="RUNS...", nargs=-1, required=True, type=FOLDER)
@STORE
def index(folders: Sequence[Path], url: str | None) -> None:
    """Add the runs in the folders RUNS to the store. Known runs are not read again.

    If the store has cells, arms that belong to none of them are listed.
    """
    found = open_store(url)
    indexed = found.index(*folders)
    for words in indexed.unreadable:
        messages.print(indented(" left out: ", words))
    added = f"{counted(indexed.results, 'result')} and {counted(indexed.verifications, 'verification')}"
    if indexed.weighings:
        added += f" and {counted(indexed.weighings, 'day')} of weighings"
    answer.print(f" {added} added to {found.name}")
    for folder in folders:
        if not record_paths([folder]):
            messages.print(f" No results in {folder}: give a run folder, or the folder that contains run folders.")
    if cells := found.cells():
        owners = Owners(cells)
        strange = {one.arm_serial or one.robot_host or "?" for one in found.results() if owners.cell_of(one) is None}
        if strange:
            arms, them = ("arm", "it") if len(strange) == 1 else ("arms", "them")
            names = join_names(sorted(strange))
            words = f"no cell has the {arms} {names}: add {them} to cells.toml, then `ftdrive fleet add`"
            answer.print(indented(" ! ", words, answer), style="yellow")
