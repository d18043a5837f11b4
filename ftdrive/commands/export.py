"""`ftdrive export`: what ftdrive knows, in the languages of others."""

from pathlib import Path

import click


@click.group()
def export() -> None:
    """Write a plan in the language of another program. Files are never overwritten."""


@export.command()
@click.argument("path", metavar="PLAN.json", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option(
    "--format",
    "target",
    required=True,
    type=click.Choice(["urscript", "csv"]),
    help="A program for the pendant, or a table of joint targets.",
)
@click.option("-o", "--output", type=click.Path(dir_okay=False, path_type=Path), help="A new file; without it, stdout.")
@click.option(
    "--dwell",
    "dwell_s",
    type=click.FloatRange(0, 600),
    default=4.0,
    show_default=True,
    help="Rest at each pose, seconds (urscript).",
)
def plan(path: Path, target: str, output: Path | None, dwell_s: float) -> None:
    """Write a plan of `ftdrive plan --output` as a URScript program, or as a table.

    The program asks before it moves, and stops unless the arm is near its first pose: the way there is not planned. It
    has no guards of ours; `ftdrive calibrate` has.
    """
    from calib.files import write_new
    from ftdrive.exports import targets_csv, urscript
    from ftdrive.planning.plan import Plan

    made = Plan.load(path)
    text = urscript.program(made, dwell_s=dwell_s) if target == "urscript" else targets_csv.table(made)
    if output is None:
        click.echo(text, nl=False)
    else:
        write_new(output, text)
        click.echo(f" Wrote {output}", err=True)
