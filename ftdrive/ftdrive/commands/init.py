"""`ftdrive init`: ask for a description of the cell and write it to a file. Nothing moves."""

from pathlib import Path
from shlex import quote
from typing import Any

import click

from ftcalib.files import write_new
from ftdrive.cell.config import clock_in_force, settings
from ftdrive.cell.emulated import EMULATED, Station, sensor_name
from ftdrive.commands.options import (
    JSON,
    MODEL,
    NewFile,
    ViewOptions,
    check_simulate,
    simulate,
    view_options,
    write_json,
)
from ftdrive.errors import ConfigError
from ftdrive.terminal.console import message_console, messages


@click.command()
@click.option("--robot", metavar="HOST", help="Address of the controller.")
@MODEL
@click.option("--sensor", metavar="URL|PLACE", help="Address of the sensor, or a PLACE of `ftdrive devices --probe`.")
@click.option("--height", metavar="MM", help="Height of the sensor above the flange face. Measure it.")
@click.option("--sensor-mass", metavar="KG", help="Mass of sensor and adapter.")
@click.option("--tool-name", metavar="NAME", help="Name of the tool.")
@click.option(
    "--tool",
    multiple=True,
    metavar="FROM:TO:DIAMETER[:X:Y]",
    help="Cylinder around sensor or tool, mm from the flange face. Repeatable.",
)
@click.option("--tool-mass", metavar="KG", help="Approximate mass below the sensor.")
@click.option(
    "--mounting",
    help="Mounting of the base: floor, wall, ceiling, or its tilt towards -x in degrees (wall: 90).",
)
@click.option(
    "--plane",
    multiple=True,
    metavar="SIDE:MM|NX:NY:NZ:MM",
    help="Wall: side (+x, -x, +y, -y, above, below) and distance from the base, or normal and offset: "
    "the arm stays where N·p >= MM, base axes. Repeatable.",
)
@click.option("--box", multiple=True, metavar="X:Y:Z:X:Y:Z", help="Block: two corners in mm, base axes. Repeatable.")
@click.option("--speed", metavar="DEG/S", help="Speed of the fastest joint.")
@click.option(
    "-o",
    "--output",
    type=NewFile(),
    default="ftdrive.toml",
    show_default=True,
    help="Save the configuration as this new file.",
)
@view_options
@simulate("Emulate robot and sensor while this command runs; --sensor emulated://NAME selects the sensor.")
@click.option("--yes", is_flag=True, help="Do not ask: use the options and the defaults.")
@JSON
def init(output: Path, simulate: bool, yes: bool, view: ViewOptions, as_json: bool, **given: Any) -> None:
    """Describe a cell: read robot and sensor, ask for the rest, write ftdrive.toml.

    The arm is only read; nothing moves. An existing file is never overwritten. Values that must be measured have no
    default, and `measured = false` stays in the file until you change it. Lengths are in mm and masses in kg unless you
    write a unit. With --view, the questions are a form in the browser, next to a view of the described cell.
    """
    from ftdrive.checks.description import ROBOT, SENSOR, Description
    from ftdrive.terminal.interview import Interview, say

    if yes and view.wanted:
        raise ConfigError("--yes and --view are mutually exclusive: leave one of them out")
    check_simulate(simulate, real={"--robot": given["robot"]})
    in_force = {key: setting.value for key, setting in settings().items()}
    described = Description(clock_in_force(), in_force, simulate=simulate)
    # The draft file keeps the answers until the configuration file is written.
    draft = output.with_name(f".{output.name}.draft")
    again = "ftdrive init" + ("" if str(output) == "ftdrive.toml" else f" -o {quote(str(output))}")
    interview = Interview(described, None if yes else draft, again + " --simulate" * simulate)
    with view.page(f"ftdrive init, {output}") as page:
        interview.take_draft(asked=page is None)
        if simulate:
            emulated = sensor_name(given.pop("sensor"))
            with Station(emulated, ["--time-scale", "1"]) as station:
                described.clock = station.clock
                interview.look(ROBOT, station.cell.robot.host)
                interview.look(SENSOR, station.cell.sensor.url)
            # store addresses that stay valid: those of the emulated devices exist only while they run
            described.texts |= {ROBOT: ["emulated"], SENSOR: [EMULATED + emulated]}
        interview.take_options(given)
        if page is None:
            interview.run()
        else:
            from ftdrive.view.init_page import InitPage

            messages.print(f"Fill in the form there. Press Ctrl-C to stop; the answers are kept in {draft}.")
            form = InitPage(page, described, draft, output.name, say)
            form.run()
        cell = described.cell()
        write_new(output, described.file())
        words, end = ". Measure tool, planes and boxes, then set measured = true in it: until then, nothing moves.", ""
        if simulate:
            words, end = " for an emulated cell: commands with --simulate use it, all others refuse it.", " --simulate"
        if page is not None:
            form.conclude(f"Wrote {output}{words}", f"Next: ftdrive doctor{end}")
    draft.unlink(missing_ok=True)
    if as_json:
        write_json({"schema_version": 1, "file": str(output), **described.found(), "config": cell.to_dict()})
    message_console(as_json).print(f"Wrote {output}{words}")
    messages.print_next(f"ftdrive doctor{end}", f"ftdrive plan{end}")
