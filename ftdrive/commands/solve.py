"""`ftdrive solve`: from data on disk to a calibration, without any device."""

from pathlib import Path
from typing import Literal

import click

from calib import CalibrationDataset, CalibrationResult, read_csv
from calib import solve as solve_dataset
from calib.result import Method
from ftdrive.commands.common import JSON, stop_unless_accepted, write_json
from ftdrive.errors import ConfigError
from ftdrive.report import print_result, talk
from ftdrive.runs import Run, versions
from ftdrive.session import solve_run

Orientation = Literal["R_base_flange", "R_flange_base"]


@click.command()
@click.argument("source", metavar="DATASET", type=click.Path(exists=True, path_type=Path))
@click.option("--method", type=click.Choice(["srom", "lrom", "ml"]), default="ml", show_default=True)
@click.option(
    "--orientation",
    type=click.Choice(["R_base_flange", "R_flange_base"]),
    default="R_base_flange",
    show_default=True,
    help="What the rotation of a CSV maps: flange to base coordinates, or the other way (as in the papers).",
)
@click.option("--output", "-o", type=click.Path(dir_okay=False, path_type=Path), help="Save the calibration here.")
@JSON
def solve(source: Path, method: Method, orientation: Orientation, output: Path | None, as_json: bool) -> None:
    """Solve DATASET: a run folder, a dataset.json, or a CSV file.

    A CSV has a header with r11..r33 (or the rotation vector rx,ry,rz), fx,fy,fz,tx,ty,tz in N and N·m, and optionally
    t in seconds.
    """
    if output is not None and output.exists():
        raise ConfigError(f"{output} exists and is never overwritten: choose another name")
    result = _solve(source, method, orientation)
    if as_json:
        write_json(result.to_dict())
    else:
        print_result(result)
    stop_unless_accepted(result)
    if output is not None:
        result.save(output)
        talk.print(f" Saved {output}")


def _solve(source: Path, method: Method, orientation: Orientation) -> CalibrationResult:
    if source.is_dir():
        return solve_run(Run(source), method).result
    dataset = CalibrationDataset.load(source) if source.suffix == ".json" else read_csv(source, orientation)
    return solve_dataset(dataset, method, provenance={"source": source.name, "versions": versions()})
