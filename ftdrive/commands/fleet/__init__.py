"""`ftdrive fleet`: many cells, from the store that all of them share."""

import click

from ftdrive.commands.fleet.serve import serve
from ftdrive.commands.fleet.verify import verify


@click.group()
def fleet() -> None:
    """Watch many cells: which are due, which sensor drifts, what is wrong in several of them."""


fleet.add_command(serve)
fleet.add_command(verify)
