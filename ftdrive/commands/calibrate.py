"""`ftdrive calibrate`: the job on a real cell."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ftdrive.commands.common import JSON, RUNS, read_cell, stop_unless_accepted, write_json

if TYPE_CHECKING:
    from ftdrive.config import CellConfig


@click.command()
@click.option("--config", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="The cell, in TOML.")
@click.option("--robot", metavar="HOST", help="Address of the controller.")
@click.option("--sensor", metavar="URL", help="Such as ati-can://can0?bitrate=250000 or ati-serial:///dev/ttyUSB0.")
@click.option(
    "--tool",
    multiple=True,
    metavar="FROM:TO:DIAMETER[:X:Y]",
    help="A cylinder of what is mounted, sensor included, in mm from the flange face; instead of [tool]. Repeatable.",
)
@click.option("--simulate", is_flag=True, help="An emulated cell; --sensor emulated://NAME chooses its sensor.")
@click.option("--quick", is_flag=True, help="12 poses instead of 24.")
@click.option("--minimal", is_flag=True, help="6 poses.")
@click.option("--step", is_flag=True, help="Wait for Enter before each move.")
@click.option("--fast", is_flag=True, help="At the plan's speed, up to 60 °/s, once it has run to its end slowly.")
@click.option("--manual", is_flag=True, help="No motion at all: you move the arm, ftdrive tells where to.")
@click.option("--listen", is_flag=True, help="No motion at all: a program on the pendant moves the arm.")
@click.option("--dry-run", is_flag=True, help="Plan, show and check everything; nothing moves.")
@click.option("--output", type=click.Path(dir_okay=False, path_type=Path), help="Save the plan as a new JSON file.")
@click.option("--png", type=click.Path(dir_okay=False, path_type=Path), help="Save stick figures (needs ftdrive[viz]).")
@click.option("--view", is_flag=True, help="Show the plan in the browser first, until you answer (needs ftdrive[viz]).")
@click.option("--plan", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="A plan made before.")
@click.option(
    "--resume", type=click.Path(exists=True, file_okay=False, path_type=Path), help="Go on with a run that was ended."
)
@click.option("--redo", type=int, multiple=True, metavar="N", help="With --resume: take pose N again. Repeatable.")
@click.option("--yes", is_flag=True, help="Answer what may be answered without a person; never the first motion.")
@RUNS
@JSON
def calibrate(
    config: Path | None,
    robot: str | None,
    sensor: str | None,
    tool: tuple[str, ...],
    simulate: bool,
    quick: bool,
    minimal: bool,
    step: bool,
    fast: bool,
    manual: bool,
    listen: bool,
    dry_run: bool,
    output: Path | None,
    png: Path | None,
    view: bool,
    plan: Path | None,
    resume: Path | None,
    redo: tuple[int, ...],
    yes: bool,
    runs: Path,
    as_json: bool,
) -> None:
    """Take the arm through 24 orientations, average the sensor at each, and solve.

    Every move is proven clear and shown before it happens; a first motion needs a typed word and is slow. Where the arm
    has room only the three wrist joints move. Ctrl-C stops the arm; what was taken is kept and --resume goes on.
    """
    from ftdrive.errors import ConfigError, Declined
    from ftdrive.report import print_result
    from ftdrive.screen import open_operator
    from ftdrive.session.guided import Options
    from ftdrive.session.guided import calibrate as guide
    from ftdrive.simulation import Station, sensor_name
    from ftdrive.talk import talk

    if sum((step, manual, listen)) > 1 or (quick and minimal) or (plan and (quick or minimal or resume)):
        raise ConfigError(
            "--step, --manual and --listen exclude one another; so do --quick, --minimal, --plan, --resume"
        )
    if (manual or listen) and (output or png or view):
        raise ConfigError("--manual and --listen have no plan: leave --output, --png and --view out")
    for path in (output, png):
        if path is not None and path.exists():
            raise ConfigError(f"{path} exists already and is never overwritten: choose another name")
    with ExitStack() as stack:
        description: dict[str, Any] = {}
        if simulate:
            station = stack.enter_context(Station(sensor_name(sensor)))
            cell = station.cell
            description = {"station": {"sensor": station.sensor, "options": station.options, "truth": station.truth}}
        else:
            cell = _cell(config, robot, sensor, tool, resume)
        options = Options(
            runs,
            poses=6 if minimal else 12 if quick else 24,
            mode="step" if step else "manual" if manual else "listen" if listen else "auto",
            dry_run=dry_run,
            fast=fast,
            output=output,
            png=png,
            view=view,
            plan=plan,
            resume=resume,
            redo=redo,
            real=not simulate,
            description=description,
        )
        try:
            with open_operator(as_json=as_json, yes=yes) as operator:
                outcome = guide(cell, operator, options)
        except Declined as error:
            talk.print(str(error))
            raise click.Abort from error
    if outcome is None:
        talk.print("A dry run: nothing has moved.")
        return
    if as_json:
        write_json({"run": str(outcome.run.folder), **outcome.result.to_dict()})
    else:
        saved = None if outcome.result.verdict == "rejected" else outcome.run.calibration_path
        print_result(outcome.result, drift=outcome.drift, records=outcome.run.records(), saved=saved)
    stop_unless_accepted(outcome.result)


def _cell(
    config: Path | None, robot: str | None, sensor: str | None, tool: tuple[str, ...], resume: Path | None
) -> "CellConfig":
    """Put the cell together; a run that is resumed brings its own unless another is named."""
    from ftdrive.config import ToolConfig, WorkcellConfig
    from ftdrive.errors import ConfigError
    from ftdrive.runs import Run
    from ftdrive.session import cell_of

    if resume is not None and not (config or robot or sensor):
        cell = cell_of(Run(resume).header())
    else:
        cell = read_cell(config, robot, sensor)
    if tool:
        try:
            cylinders = tuple(tuple(float(part) for part in text.split(":")) for text in tool)
        except ValueError:
            raise ConfigError(f"--tool is {' '.join(tool)}: give numbers in mm, such as 0:200:100") from None
        cell = replace(cell, tool=ToolConfig("tool", cylinders), workcell=replace(cell.workcell))
        if config is None and cell.workcell == WorkcellConfig():
            cell = replace(cell, workcell=WorkcellConfig(measured=True))  # said here and now, and nothing else is there
    return cell
