"""`ftdrive fleet`: many cells, from the store that all of them share."""

import click

from ftdrive.commands.fleet.cells import add, index, remove
from ftdrive.commands.fleet.solve import solve
from ftdrive.commands.fleet.status import serve, status
from ftdrive.commands.fleet.verify import verify
from ftdrive.terminal.text import Group


@click.group(cls=Group)
def fleet() -> None:
    """Watch many cells: which are due, which sensor drifts, what is wrong in several of them."""


fleet.add_command(add)
fleet.add_command(remove)
fleet.add_command(index)
fleet.add_command(status)
fleet.add_command(solve)
fleet.add_command(verify)
fleet.add_command(serve)
