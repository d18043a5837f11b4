"""`ftdrive export`: write plans and calibrations for other programs."""

from pathlib import Path

import click

from ftcalib.files import write_new
from ftdrive.cell.emulated import Station
from ftdrive.commands.export.calibration import Made, calibration
from ftdrive.commands.options import FILE, JSON, NewFile, Number, check_simulate, simulate, write_json
from ftdrive.errors import ConfigError
from ftdrive.exports.formats import FORMATS
from ftdrive.terminal.console import answer, indented, message_console
from ftdrive.terminal.text import Group, echo

_OUTPUT = click.option("-o", "--output", type=NewFile(), help="Save as a new file instead of printing to stdout.")


@click.group(cls=Group)
def export_group() -> None:
    """Write a plan or a calibration for another program. Files are never overwritten."""


@export_group.result_callback()
def _deliver(made: Made | None) -> None:
    if made is None:
        return
    text, output, about, facts, as_json = made
    if output is not None:
        write_new(output, text)
        message_console(as_json).print(f" Saved {output}")
    if as_json:
        write_json({"schema_version": 1, **about, "file": output and str(output), **facts, "text": text})
    elif output is None:
        echo(text, nl=False, fold=False)


@export_group.command("plan")
@click.argument("path", metavar="PLAN.json", required=False, type=FILE)
@click.option(
    "--format",
    "target",
    required=True,
    type=click.Choice(["urscript", "csv"]),
    help="Format: a program for the pendant or a table of joint targets.",
)
@_OUTPUT
@click.option(
    "--dwell", "dwell_s", type=Number(0, 600), default=4.0, show_default=True, help="Dwell at each pose, s (urscript)."
)
@simulate("Export the plan of an emulated cell in the default posture of `ftdrive plan`.")
@JSON
def export_plan(
    path: Path | None, target: str, output: Path | None, dwell_s: float, simulate: bool, as_json: bool
) -> Made:
    """Write a plan of `ftdrive plan --output` as a URScript program or as a table.

    The program asks before it moves, and stops unless the arm is near the first pose, because the approach is not
    planned. Unlike `ftdrive calibrate`, it has no guards.
    """
    from ftdrive.exports.urscript import plan_table, program
    from ftdrive.planning.plan import Plan
    from ftdrive.planning.planner import USUAL_POSTURE_RAD, certifier_for, plan_for

    check_simulate(simulate, real={"PLAN.json": path})
    if path is None and not simulate:
        raise ConfigError("no plan: give a file of `ftdrive plan --output`, or --simulate")
    if path is not None:
        made = Plan.load(path)
    else:
        with Station.of(None) as station:
            cell = station.cell
        made = plan_for(cell, certifier_for(cell, cell.robot.model), USUAL_POSTURE_RAD)
    text = program(made, dwell_s=dwell_s) if target == "urscript" else plan_table(made)
    return text, output, {"format": target, "plan": made.sha256}, {}, as_json


@export_group.command()
@click.option("--first", type=click.IntRange(24, 33), default=24, show_default=True, help="As in `serve-load --first`.")
@click.option("--example", is_flag=True, help="Append a program that weighs a part and sets the payload.")
@_OUTPUT
@simulate("Accepted for consistency; the functions do not change.")
@JSON
def urscript(first: int, example: bool, output: Path | None, simulate: bool, as_json: bool) -> Made:  # noqa: ARG001
    """Write the URScript functions through which a UR program uses `ftdrive serve-load`.

    The functions are ftd_zero, ftd_weigh, ftd_wrench, ftd_bias, ftd_alive, ftd_status and ftd_payload. Each has a
    time-out and returns a state, never an old value.
    """
    from ftdrive.exports.urscript import functions

    return functions(first, example=example), output, {}, {}, as_json


@export_group.command()
@JSON
def formats(as_json: bool) -> None:
    """List the formats of `ftdrive export calibration`."""
    if as_json:
        keys = ("description", "file", "subtracts", "expresses")
        found = [{"name": name} | {key: getattr(one, key) for key in keys} for name, one in FORMATS.items()]
        write_json({"schema_version": 1, "formats": found})
        return
    width = max(map(len, FORMATS))
    for name, one in FORMATS.items():
        answer.print(indented(f"{name:{width}}  ", one.description, answer))


export_group.add_command(calibration)
