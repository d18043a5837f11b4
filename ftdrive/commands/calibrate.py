"""`ftdrive calibrate`: the job on a real cell."""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from ftdrive.commands.common import JSON, RUNS, progress_bar, read_cell, stop_unless_accepted, write_json
from ftdrive.report import print_plan, print_result, talk
from ftdrive.session import Plan, calibrate_cell
from ftdrive.simulation import Station

_WORD = "MOVE"


@click.command()
@click.option("--config", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="The cell, in TOML.")
@click.option("--robot", metavar="HOST", help="Address of the controller.")
@click.option("--sensor", metavar="URL", help="Such as ati-can://can0?bitrate=250000 or ati-serial:///dev/ttyUSB0.")
@click.option("--simulate", is_flag=True, help="An emulated cell.")
@RUNS
@JSON
def calibrate(
    config: Path | None, robot: str | None, sensor: str | None, simulate: bool, runs: Path, as_json: bool
) -> None:
    """Take the arm through 24 orientations, average the sensor at each, and solve.

    Shows the plan and asks for a typed word before anything moves. Only the three wrist joints move. Ctrl-C stops the
    arm and keeps the poses taken so far.
    """
    with ExitStack() as stack:
        description: dict[str, Any] = {}
        if simulate:
            station = stack.enter_context(Station())
            cell = station.cell
            description = {"station": {"sensor": "can", "options": station.options, "truth": station.truth}}
        else:
            cell = read_cell(config, robot, sensor)
        on_progress, on_run = stack.enter_context(progress_bar())
        outcome = calibrate_cell(
            cell,
            runs,
            "calibrate",
            confirm=_confirm,
            on_progress=on_progress,
            on_run=on_run,
            description=description,
        )
    if as_json:
        write_json({"run": str(outcome.run.folder), **outcome.result.to_dict()})
    else:
        print_result(outcome.result, drift=outcome.drift)
    stop_unless_accepted(outcome.result)
    talk.print(f" Saved {outcome.run.calibration_path}")


def _confirm(plan: Plan) -> None:
    print_plan(plan)
    word = click.prompt(f"Type {_WORD} to let the arm move", err=True, default="", show_default=False)
    if word != _WORD:
        raise click.Abort
