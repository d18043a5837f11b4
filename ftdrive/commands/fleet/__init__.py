"""`ftdrive fleet`: many cells, from the store that all of them share."""

import click

from ftdrive.commands.fleet.solve import solve


@click.group()
def fleet() -> None:
    """Watch many cells: which are due, which sensor drifts, what is wrong in several of them."""


fleet.add_command(solve)
