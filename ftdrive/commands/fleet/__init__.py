"""`ftdrive fleet`: many cells, from the store that all of them share."""

import click


@click.group()
def fleet() -> None:
    """Watch many cells: which are due, which sensor drifts, what is wrong in several of them."""
