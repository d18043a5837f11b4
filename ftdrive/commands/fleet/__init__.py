"""`ftdrive fleet`: many cells, from the store that all of them share."""

import click

from ftdrive.commands.fleet.add import add
from ftdrive.commands.fleet.index import index
from ftdrive.commands.fleet.remove import remove
from ftdrive.commands.fleet.status import status


@click.group()
def fleet() -> None:
    """Watch many cells: which are due, which sensor drifts, what is wrong in several of them."""


fleet.add_command(add)
fleet.add_command(remove)
fleet.add_command(index)
fleet.add_command(status)
