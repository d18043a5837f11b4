"""`ftdrive demo`: a calibration of an emulated cell, with the truth beside each estimate."""

from pathlib import Path
from shlex import quote

import click
import numpy as np

from ftdrive.cell.config import CellConfig
from ftdrive.cell.emulated import REAL_PACE, SENSORS, Station
from ftdrive.commands.common import CONTROL, JSON, METHOD, SETS, rehearse, runs, stop_unless_accepted, write_json
from ftdrive.errors import ConfigError
from ftdrive.runs.run import Run
from ftdrive.session.options import method_of_poses
from ftdrive.terminal.console import messages
from ftdrive.terminal.report import compensation_error, errors_in_sigma, print_result


@click.command()
@click.option(
    "--sensor",
    type=click.Choice(list(SENSORS)),
    metavar="NAME",
    default="can",
    show_default=True,
    help=f"Emulated sensor: {', '.join(SENSORS)}.",
)
@click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the emulated truth and noise."
)
@CONTROL
@click.option(
    "--polyscope",
    metavar="VERSION",
    help="Version of the emulated controller, such as 10.11.0, which has no dashboard server.",
)
@SETS
@METHOD
@click.option("--sweep", is_flag=True, help="Calibrate in one smooth motion, and draw it (needs ftdrive[viz]).")
@click.option(
    "--simulate", is_flag=True, expose_value=False, help="Emulate the cell: always on here, accepted by every command."
)
@runs()
@JSON
def demo(
    sensor: str,
    seed: int,
    control: str | None,
    polyscope: str | None,
    sets: str | None,
    method: str,
    sweep: bool,
    runs: Path,
    as_json: bool,
) -> None:
    """Calibrate an emulated cell: no real device is connected or moved. Takes about 25 s, a sweep 40 s.

    A UR5e and a sensor are emulated in another process, down to the bytes on their wires. The arm moves 20 times faster
    than a real one. The drivers, the session and the solver are those of a real cell.
    """
    if sweep and (sets is not None or method != "ml"):
        raise ConfigError("--sweep has no poses: leave out --set and --method")
    solved_by = method_of_poses(method)
    options = ["--seed", str(seed), *(["--polyscope", polyscope] if polyscope else []), *(REAL_PACE if sweep else ())]
    with Station(sensor, options, control_path=control or "auto") as station:
        truth = station.truth
        messages.print(f"Emulated UR5e, {SENSORS[sensor]}, tool of {truth['mass_kg']:.3f} kg. No real device is used.")
        mode = "sweep" if sweep else "auto"
        outcome = rehearse(station, runs, "demo", mode=mode, sets=sets, method=solved_by)
        if sweep:
            _draw(station.cell, outcome.run)
    if as_json:
        write_json(
            {
                "schema_version": 1,
                "run": str(outcome.run.folder),
                "truth": truth,
                "result": outcome.result.to_dict(),
                "error_in_sigma": {
                    key: np.asarray(values).tolist() for key, values in errors_in_sigma(outcome.result, truth).items()
                },
                "compensation_error": compensation_error(outcome.result, truth),
            }
        )
    else:
        print_result(outcome.result, truth=truth, drift=outcome.drift, records=outcome.run.records(), hinted=False)
        messages.print_next(
            f"ftdrive live --calibration {quote(str(outcome.run.folder))} --simulate",
            f"ftdrive solve {quote(str(outcome.run.folder))}" + ("" if sweep else " --method all"),
            "ftdrive init   (describe your own cell)",
        )
    stop_unless_accepted(outcome.result, to_be_saved=True)


def _draw(cell: CellConfig, run: Run) -> None:
    """Draw the sweep into its run, where matplotlib is installed."""
    from ftdrive.planning.drawing import draw
    from ftdrive.planning.plan import Plan
    from ftdrive.planning.planner import certifier_for

    path = run.folder / "sweep.png"
    try:
        plan = Plan.load(run.plan_path)
        draw(plan, certifier_for(cell, cell.robot.model, plan.kinematics), path)
        messages.print(f"The sweep is drawn in {path}.")
    except ConfigError as error:
        messages.print(f"The sweep is not drawn: {error}.")
