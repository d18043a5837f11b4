"""`ftdrive fleet index`: run folders into the store."""

from collections.abc import Sequence
from pathlib import Path

import click

from ftdrive.commands.common import FOLDER, STORE, open_store


@click.command()
@click.argument("folders", metavar="RUNS...", nargs=-1, required=True, type=FOLDER)
@STORE
def index(folders: Sequence[Path], url: str | None) -> None:
    """Add the runs in the folders RUNS to the store. A run that is known is not read again.

    If cells were added, arms that belong to none of them are listed.
    """
    from ftcalib.rounding import counted
    from ftdrive.fleet.cells import Owners
    from ftdrive.fleet.words import listed
    from ftdrive.store.records import record_paths
    from ftdrive.terminal.console import answer, hanging, messages

    found = open_store(url)
    indexed = found.index(*folders)
    for words in indexed.unreadable:
        messages.print(hanging(" left out: ", words))
    added = f"{counted(indexed.results, 'result')} and {counted(indexed.verifications, 'verification')}"
    if indexed.weighings:
        added += f" and {counted(indexed.weighings, 'day')} of weighings"
    answer.print(f" {added} added to {found.name}")
    for folder in folders:
        if not record_paths([folder]):
            messages.print(f" No results in {folder}: name a run folder, or the folder that contains run folders.")
    if cells := found.cells():
        owners = Owners(cells)
        strange = {one.arm_serial or one.robot_host or "?" for one in found.results() if owners.cell_of(one) is None}
        if strange:
            arms, them = ("arm", "it") if len(strange) == 1 else ("arms", "them")
            words = (
                f"no cell has the {arms} {listed(sorted(strange))}: add {them} to cells.toml, then `ftdrive fleet add`"
            )
            answer.print(hanging(" ! ", words, answer), style="yellow")
