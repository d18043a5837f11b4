"""`ftdrive fleet`: many cells, from the store that all of them share."""

import click

from ftdrive.commands.fleet.add import add
from ftdrive.commands.fleet.compensate import compensate
from ftdrive.commands.fleet.index import index
from ftdrive.commands.fleet.remove import remove
from ftdrive.commands.fleet.serve import serve
from ftdrive.commands.fleet.solve import solve
from ftdrive.commands.fleet.status import status
from ftdrive.commands.fleet.verify import verify


@click.group()
def fleet() -> None:
    """Watch many cells: which are due, which sensor drifts, what is wrong in several of them."""


fleet.add_command(add)
fleet.add_command(remove)
fleet.add_command(index)
fleet.add_command(status)
fleet.add_command(solve)
fleet.add_command(compensate)
fleet.add_command(verify)
fleet.add_command(serve)
