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


for _command in (add, remove, index, status, solve, verify, serve):
    fleet.add_command(_command)
