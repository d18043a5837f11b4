"""`ftdrive export`: plans and calibrations as files of other programs."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ftdrive.commands.common import (
    EMULATED_SENSOR,
    FILE,
    FORCE,
    JSON,
    NewFile,
    Number,
    check_simulate,
    numbers,
    simulate,
    write_json,
)
from ftdrive.errors import ConfigError
from ftdrive.exports.formats import FORMATS, MAX_FORCE_ERROR_N
from ftdrive.terminal.text import Group, echo

if TYPE_CHECKING:
    from ftdrive.planning.plan import Plan


@click.group(cls=Group)
def export() -> None:
    """Write a plan or a calibration for another program. Files are never overwritten."""


@export.command()
@click.argument("path", metavar="PLAN.json", required=False, type=FILE)
@click.option(
    "--format",
    "target",
    required=True,
    type=click.Choice(["urscript", "csv"]),
    help="Format: a program for the pendant or a table of joint targets.",
)
@click.option("-o", "--output", type=NewFile(), help="Save as a new file instead of printing to stdout.")
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
    from ftdrive.exports import urscript
    from ftdrive.planning.plan import Plan

    check_simulate(simulate, real={"PLAN.json": path})
    if simulate:
        made = _emulated()
    elif path is not None:
        made = Plan.load(path)
    else:
        raise ConfigError("which plan? Give the file that `ftdrive plan --output` has written, or --simulate")
    text = urscript.program(made, dwell_s=dwell_s) if target == "urscript" else urscript.table(made)
    _deliver(text, output, {"format": target, "plan": made.sha256}, as_json=as_json)


@export.command()
@click.argument("source", metavar="RESULT|RUN", required=False, type=click.Path(exists=True, path_type=Path))
@click.option(
    "--format",
    "target",
    metavar="NAME",
    required=True,
    type=click.Choice(list(FORMATS)),
    help="Format, one of those that `ftdrive export formats` lists.",
)
@click.option("-o", "--output", type=NewFile(), help="Save as a new file instead of printing to stdout.")
@click.option(
    "--height",
    "height_mm",
    type=Number(0, 500),
    metavar="MM",
    help="Height of the sensor's origin above the flange face. [default: as configured in the run]",
)
@click.option(
    "--sensor-mass",
    "sensor_mass_kg",
    type=Number(0, 20),
    metavar="KG",
    help="Mass of sensor and adapter. [default: as configured in the run]",
)
@click.option(
    "--sensor-com",
    metavar="X,Y,Z",
    help="Centre of mass of sensor and adapter, mm from the flange face along its axes. [default: half way up]",
)
@click.option(
    "--base-frame",
    default="base",
    show_default=True,
    help="Name of the controller's base frame; with base_link, vectors are turned by 180° about z, as in ROS.",
)
@click.option(
    "--flange-frame",
    default="tool0",
    show_default=True,
    help="Name of the flange frame, z out; with flange, x points out, as in ROS-Industrial.",
)
@click.option("--sensor-frame", default="ft_sensor", show_default=True, help="Name of the sensor and its frame.")
@click.option("--tool-frame", default="tool", show_default=True, help="Name of the tool and its frame.")
@click.option(
    "--max-force-error",
    "max_force_error_N",
    type=Number(0),
    metavar="N",
    default=MAX_FORCE_ERROR_N,
    show_default=True,
    help="Accept a target that cannot express everything if its force differs by no more, in any orientation.",
)
@FORCE
@simulate("Export a calibration of an emulated cell.")
@EMULATED_SENSOR
@JSON
def calibration(
    source: Path | None,
    target: str,
    output: Path | None,
    height_mm: float | None,
    sensor_mass_kg: float | None,
    sensor_com: str | None,
    base_frame: str,
    flange_frame: str,
    sensor_frame: str,
    tool_frame: str,
    max_force_error_N: float,
    force: bool,
    simulate: bool,
    sensor: str | None,
    as_json: bool,
) -> None:
    """Write a calibration for another program: RESULT is a calibration.json, RUN its folder.

    Signs, units, order and frames are those of the target. Notes on stderr say what must be set elsewhere, and what the
    target cannot express. The text is not written if the force would be wrong by more than --max-force-error.
    """
    from ftdrive.exports import registry
    from ftdrive.exports.shared import Settings, recorded_sensor
    from ftdrive.runs.source import read_calibration
    from ftdrive.runs.verification import marks_of, verification_near
    from ftdrive.terminal.console import hanging, messages

    check_simulate(simulate, real={"RESULT": source}, emulated={"--sensor": sensor})
    with _calibrated(source, sensor, simulate=simulate) as path:
        result = read_calibration(path, accept_edited=force)
        recorded_height_mm, recorded_mass_kg = recorded_sensor(path, result)
        verification = verification_near(path, result.id)
    settings = Settings(
        base_frame=base_frame,
        flange_frame=flange_frame,
        sensor_frame=sensor_frame,
        tool_frame=tool_frame,
        height_mm=recorded_height_mm if height_mm is None else height_mm,
        sensor_mass_kg=recorded_mass_kg if sensor_mass_kg is None else sensor_mass_kg,
        sensor_com_mm=None if sensor_com is None else tuple(numbers("--sensor-com", sensor_com, ",", [3])),
        verification=verification,
    )
    made = registry.export(result, target, settings, max_force_error_N=max_force_error_N)
    for note in made.notes:
        messages.print(hanging(" note: ", note))
    if verification is not None and not verification.passed:
        messages.print(hanging(" note: ", f"the last verification of this calibration failed: {verification.reason}"))
    about = {"format": target, "calibration": result.id, "marks": list(marks_of(result))}
    facts = {name: getattr(made, name) for name in ("max_force_error_N", "max_torque_error_Nm", "notes", "elsewhere")}
    _deliver(made.text, output, about, facts, as_json=as_json)


@export.command()
@click.option("--first", type=click.IntRange(24, 33), default=24, show_default=True, help="As `serve-load --first`.")
@click.option("--example", is_flag=True, help="Append a program that weighs a part and sets the payload.")
@click.option("-o", "--output", type=NewFile(), help="Save as a new file instead of printing to stdout.")
@simulate("Accepted for symmetry: the functions are the same.")
@JSON
def urscript(first: int, example: bool, output: Path | None, simulate: bool, as_json: bool) -> None:  # noqa: ARG001
    """Write the functions with which a UR program uses `ftdrive serve-load`.

    ftd_zero, ftd_weigh, ftd_wrench, ftd_bias, ftd_alive, ftd_status and ftd_payload. Each waits with a time limit and
    returns a state, never an old number.
    """
    from ftdrive.exports.program_functions import functions

    _deliver(functions(first, example=example), output, as_json=as_json)


@export.command()
@JSON
def formats(as_json: bool) -> None:
    """List the formats of `ftdrive export calibration`."""
    if as_json:
        found = [
            {
                "name": name,
                "description": one.description,
                "file": one.file,
                "subtracts": list(one.subtracts),
                "expresses": list(one.expresses),
            }
            for name, one in FORMATS.items()
        ]
        write_json({"schema_version": 1, "formats": found})
        return
    from ftdrive.terminal.console import answer, hanging

    width = max(map(len, FORMATS))
    for name, one in FORMATS.items():
        answer.print(hanging(f"{name:{width}}  ", one.description, answer))


def _deliver(
    text: str,
    output: Path | None,
    about: Mapping[str, object] = {},
    facts: Mapping[str, object] = {},
    *,
    as_json: bool,
) -> None:
    """Save a text, or print it; `about` and `facts` stand before and after the name of the file in the JSON."""
    from ftcalib.files import write_new
    from ftdrive.terminal.console import beside

    if output is not None:
        write_new(output, text)
        beside(as_json).print(f" Saved {output}")
    if as_json:
        file = None if output is None else str(output)
        write_json({"schema_version": 1, **about, "file": file, **facts, "text": text})
    elif output is None:
        echo(text, nl=False, fold=False)


@contextmanager
def _calibrated(source: Path | None, sensor: str | None, *, simulate: bool) -> Iterator[Path]:
    """Give the calibration file or run folder to export; that of an emulated cell is temporary."""
    if simulate:
        from ftdrive.commands.common import rehearsed_run

        with rehearsed_run(sensor) as folder:
            yield folder
    elif source is not None:
        yield source
    else:
        raise ConfigError("which calibration? Give a calibration.json or its run folder, or --simulate")


def _emulated() -> "Plan":
    from ftdrive.cell.emulated import Station
    from ftdrive.planning.planner import USUAL_POSTURE_RAD, certifier_for, plan_for

    with Station.of(None) as station:
        cell = station.cell
    return plan_for(cell, certifier_for(cell, cell.robot.model), USUAL_POSTURE_RAD)
