"""`ftdrive loads`: known loads to check a sensor, and to correct its matrix."""

from contextlib import ExitStack
from functools import partial
from math import isfinite
from pathlib import Path

import click

from ftcalib.sensor_matrix import SensorMatrix
from ftdrive.cell.emulated import TOOL_MM
from ftdrive.commands.options import JSON, PATH, SOURCE, Number, SourceOptions, write_json
from ftdrive.errors import ConfigError, NotAccepted
from ftdrive.library import check_known_load, solve_load_runs
from ftdrive.recording.replay import open_replay
from ftdrive.runs.calibration import next_sensor_file, sensor_files
from ftdrive.runs.load import Load, mass_of
from ftdrive.stream.processing import SENSOR_FRAME
from ftdrive.stream.weighing import Scale, first_success
from ftdrive.terminal.text import Group, echo
from ftdrive.words.loads import check_lines, matrix_lines, solution_lines
from ftdrive.words.text import visible


@click.group(cls=Group)
def loads() -> None:
    """Check a sensor with a known weight, or correct its matrix with several."""


@loads.command("check")
@click.argument("mass", metavar="MASS")
@click.option("--at", metavar="NAME=X,Y,Z", help="Point where the load hangs, mm from the flange face in flange axes.")
@SOURCE
@click.option("--replay", type=PATH, help="Check a recording instead of a cell.")
@click.option("--zero", is_flag=True, help="Tare the free tool first, which removes the drift since the calibration.")
@click.option("--poses", type=click.IntRange(1, 24), default=1, show_default=True, help="Number of poses to combine.")
@click.option("--wait", "wait_s", type=Number(1, 600), default=60.0, show_default=True, help="Longest wait, s.")
@JSON
def loads_check(
    mass: str,
    at: str | None,
    source: SourceOptions,
    replay: Path | None,
    zero: bool,
    poses: int,
    wait_s: float,
    as_json: bool,
) -> None:
    """Hang one known MASS (kg, such as 1.000) on a string, and compare it with the reading.

    The arm is only read. Let the load hang still. With --poses, turn the arm by hand or by another program between the
    rests. The output is the scale and the line of action with one sigma each, and whether the error is within the
    accuracy stated for the sensor. The exit code is 7 if not.
    """
    load = Load("load", *mass_of(mass)) if at is None else Load.of(mass, at, gripped=False)
    with ExitStack() as stack:
        if replay is not None:
            stream = open_replay(replay, source.path, SENSOR_FRAME, speed=float("inf"), force=source.force)
        else:
            stream = source.open(stack, SENSOR_FRAME)
        if zero and replay is None:
            first_success(stream, Scale(stream).zero, wait_s)
            echo("Tared. Hang the load, and let it hang still.", err=True)
        if source.simulate and replay is None:
            x, y, z = hook_mm = load.p_flange_mm or (0.0, 0.0, TOOL_MM[1])
            stream.station.control(do="hang", mass_kg=load.mass_kg, at_mm=hook_mm, string_mm=250, swing_deg=0)
            echo(f"{load.mass_kg:g} kg hangs on the emulated tool, {x:g}, {y:g}, {z:g} mm from the flange.", err=True)
        found, joined, tare_age_s = check_known_load(stream, load, poses, wait_s, replayed=replay is not None)
    if as_json:
        head = {"schema_version": 1, "calibration_id": stream.info.calibration.id, "given_kg": load.mass_kg}
        write_json({**head, **found.to_dict(), "poses": joined, "tared": isfinite(tare_age_s)})
    else:
        echo("\n".join(check_lines(found, load)))
    if not isfinite(tare_age_s):
        drifted = f"Not tared: the sigma of {100 * found.scale_sigma:.1f} % includes the drift since the calibration."
        free = "Record the free tool at rest for a second, and then hang the load."
        echo(f"{drifted} {'Use --zero.' if replay is None else free}", err=True)
    if not found.is_within:
        raise NotAccepted("the reading is outside the accuracy stated for the sensor: check mass and mounting")


@loads.command("solve")
@click.argument("runs", nargs=-1, required=True, type=PATH)
@click.option(
    "--tool-mass",
    metavar="KG",
    help="Weighed mass of the tool, such as 1.300 or 1.300±0.002; default: [tool] mass_kg with mass_sigma_kg.",
)
@click.option("--accept", is_flag=True, help="Save the matrix even if it differs much from the previous one.")
@JSON
def loads_solve(runs: tuple[Path, ...], tool_mass: str | None, accept: bool, as_json: bool) -> None:
    """Fit the sensor matrix to RUNS: one with the tool alone, and runs of `calibrate --load`.

    If the runs agree, the matrix is saved as sensor.json in this folder. Commands in this folder then use it to decode
    contacts of this sensor with any tool. Further loads improve the matrix.
    """
    solution, prior = solve_load_runs(runs, tool_mass, partial(echo, err=True))
    hindering = [one for one in solution.findings if one.severity == "reject"]
    saved = None
    if not hindering or (accept and {one.code for one in hindering} == {"matrix_changed"}):
        saved = next_sensor_file()
        solution.sensor.save(saved)
    if as_json:
        write_json({"schema_version": 1, **solution.to_dict(), "saved": None if saved is None else str(saved)})
    else:
        echo("\n".join(solution_lines(solution, prior)))
        if saved is not None:
            echo(f"The runs agree. Saved {saved}: commands in this folder decode contacts with it.")
    if saved is None:
        raise NotAccepted("the runs do not agree on a matrix: see the findings")


@loads.command()
@JSON
def show(as_json: bool) -> None:
    """Show the sensor matrix in this folder: sensor.json, or the newest sensor-N.json."""
    path = _newest()
    sensor = SensorMatrix.load(path)
    if as_json:
        write_json({"schema_version": 1, "file": str(path), **sensor.to_dict()})
        return
    known = sensor.provenance
    echo(f"{path.name}: sensor {known.get('serial') or 'without serial number'}, {known.get('created_utc')}")
    echo(f"runs: {', '.join(map(str, known.get('runs', ())))}")
    echo("\n".join(matrix_lines(sensor, 0.2, f"; nonlinearity {100 * sensor.floor:.2g} % of the load")))


@loads.command()
@click.option("--yes", is_flag=True, help="Do not ask.")
def drop(yes: bool) -> None:
    """Delete the newest sensor matrix in this folder, so that the previous one, if any, is used."""
    path = _newest()
    if yes or click.confirm(visible(f"Delete {path.name}?"), err=True):
        path.unlink()
        echo(f"Deleted {path.name}.")


def _newest() -> Path:
    if not (files := sensor_files()):
        raise ConfigError("this folder has no sensor.json: create it with `ftdrive loads solve RUN RUN …`")
    return files[-1]
