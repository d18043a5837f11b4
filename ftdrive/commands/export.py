"""`ftdrive export`: plans as files of other programs."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ftdrive.commands.common import FILE, JSON, NewFile, Number, check_simulate, simulate, write_json

if TYPE_CHECKING:
    from ftdrive.planning.plan import Plan


@click.group()
def export() -> None:
    """Write a plan for another program. Files are never overwritten."""


@export.command()
@click.argument("path", metavar="PLAN.json", required=False, type=FILE)
@click.option(
    "--format",
    "target",
    required=True,
    type=click.Choice(["urscript", "csv"]),
    help="A program for the pendant or a table of joint targets.",
)
@click.option("-o", "--output", type=NewFile(), help="A new file instead of stdout.")
@click.option(
    "--dwell", "dwell_s", type=Number(0, 600), default=4.0, show_default=True, help="Rest at each pose, s (urscript)."
)
@simulate("Export the plan of an emulated cell in the default posture of `ftdrive plan`.")
@JSON
def plan(path: Path | None, target: str, output: Path | None, dwell_s: float, simulate: bool, as_json: bool) -> None:
    """Write a plan of `ftdrive plan --output` as a URScript program or as a table.

    The program asks before it moves, and stops unless the arm is near the first pose, because the approach is not
    planned. Unlike `ftdrive calibrate`, it has no guards.
    """
    from calib.files import write_new
    from ftdrive.errors import ConfigError
    from ftdrive.exports import targets_csv, urscript
    from ftdrive.planning.plan import Plan
    from ftdrive.terminal.console import talk

    check_simulate(simulate, real={"PLAN.json": path})
    if simulate:
        made = _emulated()
    elif path is not None:
        made = Plan.load(path)
    else:
        raise ConfigError("which plan? Give the file that `ftdrive plan --output` has written, or --simulate")
    text = urscript.program(made, dwell_s=dwell_s) if target == "urscript" else targets_csv.table(made)
    if output is not None:
        write_new(output, text)
        talk.print(f" Wrote {output}")
    if as_json:
        about = {"format": target, "plan": made.sha256, "file": None if output is None else str(output)}
        write_json({"schema_version": 1, **about, "text": text})
    elif output is None:
        click.echo(text, nl=False)


def _emulated() -> "Plan":
    from ftdrive.cell.emulated import Station
    from ftdrive.planning.cell_plan import certifier_for, plan_for
    from ftdrive.planning.planner import USUAL_POSTURE_RAD

    with Station() as station:
        cell = station.cell
    return plan_for(cell, certifier_for(cell, cell.robot.model), USUAL_POSTURE_RAD)
