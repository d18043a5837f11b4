"""`ftdrive export calibration`: write a calibration with the signs, units, order and frames of another program."""

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import click

from ftdrive.cell.units import parse_numbers
from ftdrive.commands.options import EMULATED_SENSOR, FORCE, JSON, NewFile, Number, check_simulate, simulate
from ftdrive.errors import ConfigError
from ftdrive.exports.formats import FORMATS, MAX_FORCE_ERROR_N
from ftdrive.session.rehearsal import rehearsed_run
from ftdrive.terminal.console import indented, messages
from ftdrive.terminal.screen import open_operator

# An export to print or save: text, new file or None, JSON entries before and after the file's name, whether JSON.
Made = tuple[str, Path | None, Mapping[str, object], Mapping[str, object], bool]


def _measured(option: str, name: str, most: float, unit: str, words: str) -> Callable[[Any], Any]:
    words += " [default: as configured in the run]"
    return click.option(option, name, type=Number(0, most), metavar=unit, help=words)


def _frame_option(option: str, usual: str, words: str) -> Callable[[Any], Any]:
    return click.option(option, default=usual, show_default=True, help=words)


@click.command()
@click.argument("source", metavar="RESULT|RUN", required=False, type=click.Path(exists=True, path_type=Path))
@click.option(
    "--format",
    "target",
    metavar="NAME",
    required=True,
    type=click.Choice(list(FORMATS)),
    help="Format, as listed by `ftdrive export formats`.",
)
@click.option("-o", "--output", type=NewFile(), help="Save as a new file instead of printing to stdout.")
@_measured("--height", "height_mm", 500, "MM", "Height of the sensor's origin above the flange face.")
@_measured("--sensor-mass", "sensor_mass_kg", 20, "KG", "Mass of sensor and adapter.")
@click.option(
    "--sensor-com",
    metavar="X,Y,Z",
    help="Centre of mass of sensor and adapter, mm from the flange face along its axes. [default: halfway up]",
)
@_frame_option(
    "--base-frame",
    "base",
    "Name of the controller's base frame; for base_link, vectors are turned by 180° about z, as in ROS.",
)
@_frame_option(
    "--flange-frame", "tool0", "Name of the flange frame, z out; for flange, x is out, as in ROS-Industrial."
)
@_frame_option("--sensor-frame", "ft_sensor", "Name of the sensor and its frame.")
@_frame_option("--tool-frame", "tool", "Name of the tool and its frame.")
@click.option(
    "--max-force-error",
    "max_force_error_N",
    type=Number(0),
    metavar="N",
    default=MAX_FORCE_ERROR_N,
    show_default=True,
    help="Largest accepted force error, in any orientation, of a target that cannot express everything.",
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
    max_force_error_N: float,
    force: bool,
    simulate: bool,
    sensor: str | None,
    as_json: bool,
    **frames: str,
) -> Made:
    """Write a calibration for another program; RESULT is a calibration.json, RUN its folder.

    Signs, units, order and frames follow the target. Notes on stderr list what you must set elsewhere, and what the
    target cannot express. The text is not written if the force would be wrong by more than --max-force-error.
    """
    from ftdrive.exports import registry
    from ftdrive.exports.registry import Settings, recorded_sensor
    from ftdrive.runs.calibration import marks_of, read_calibration
    from ftdrive.runs.verification import verification_near

    check_simulate(simulate, real={"RESULT": source}, emulated={"--sensor": sensor})
    if source is None and not simulate:
        raise ConfigError("no calibration: give a calibration.json or its run folder, or --simulate")
    with rehearsed_run(open_operator(), sensor) if source is None else nullcontext(source) as path:
        result = read_calibration(path, accept_edited=force)
        recorded_height_mm, recorded_mass_kg = recorded_sensor(path, result)
        verification = verification_near(path, result.id)
    settings = Settings(
        height_mm=recorded_height_mm if height_mm is None else height_mm,
        sensor_mass_kg=recorded_mass_kg if sensor_mass_kg is None else sensor_mass_kg,
        sensor_com_mm=None if sensor_com is None else tuple(parse_numbers("--sensor-com", sensor_com, ",", [3])),
        verification=verification,
        **frames,
    )
    made = registry.export_calibration(result, target, settings, max_force_error_N=max_force_error_N)
    notes = [*made.notes]
    if verification is not None and not verification.passed:
        notes.append(f"the last verification of this calibration failed: {verification.reason}")
    for note in notes:
        messages.print(indented(" note: ", note))
    about = {"format": target, "calibration": result.id, "marks": list(marks_of(result))}
    facts = {name: getattr(made, name) for name in ("max_force_error_N", "max_torque_error_Nm", "notes", "elsewhere")}
    return made.text, output, about, facts, as_json
