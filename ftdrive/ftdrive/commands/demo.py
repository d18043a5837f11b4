"""`ftdrive demo`: calibrate an emulated cell, and compare each estimate with the truth."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Any

import click
import numpy as np

from ftcalib.accuracy import CONTACT_N, compensation_error, errors_in_sigma
from ftcalib.loads.solve import LoadSolution
from ftdrive.cell.config import CellConfig
from ftdrive.cell.emulated import REAL_PACE, SENSORS, Station
from ftdrive.commands.options import ALL, CONTROL, JSON, METHOD, SETS, runs_option, write_json
from ftdrive.errors import ConfigError, NotAccepted
from ftdrive.planning.drawing import draw_plan
from ftdrive.planning.plan import Plan
from ftdrive.planning.planner import certifier_for
from ftdrive.runs.calibration import require_accepted
from ftdrive.runs.run import Run
from ftdrive.runs.source import Outcome
from ftdrive.session.rehearsal import contact_errors, rehearse, rehearse_loads
from ftdrive.session.session import method_of_poses
from ftdrive.terminal.console import answer, messages
from ftdrive.terminal.report import print_result
from ftdrive.terminal.screen import open_operator


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
    help="Version of the emulated controller, such as 10.11.0 (without dashboard server).",
)
@SETS
@METHOD
@click.option("--sweep", is_flag=True, help="Calibrate in one smooth motion, and draw it (needs ftdrive[viz]).")
@click.option(
    "--loads",
    is_flag=True,
    help="Correct a sensor with 2 % errors by two known loads, and compare a contact before and after.",
)
@click.option("--simulate", is_flag=True, expose_value=False, help="Use an emulated cell; always on for this command.")
@runs_option()
@ALL
@JSON
def demo(
    sensor: str,
    seed: int,
    control: str | None,
    polyscope: str | None,
    sets: str | None,
    method: str,
    sweep: bool,
    loads: bool,
    runs: Path,
    every: bool,
    as_json: bool,
) -> None:
    """Calibrate an emulated cell: no real device is connected or moved. Takes about 25 s, with --loads 75 s.

    Another process emulates a UR5e and a sensor, including the bytes on their wires. The arm moves 20 times faster than
    a real one. Drivers, session and solver are the same as for a real cell.
    """
    if sweep and (sets is not None or method != "ml"):
        raise ConfigError("--sweep has no poses: leave out --set and --method")
    if loads and (sweep or sets is not None or method != "ml"):
        raise ConfigError("--loads has its own poses: leave out --sweep, --set and --method")
    solved_by = method_of_poses(method)
    options = ["--seed", str(seed), *(["--polyscope", polyscope] if polyscope else [])]
    options += REAL_PACE if sweep else ()
    with Station(sensor, options, control_path=control or "auto") as station:
        truth = station.truth
        messages.print(f"Emulated UR5e, {SENSORS[sensor]}, tool of {truth['mass_kg']:.3f} kg. No real device is used.")
        mode = "sweep" if sweep else "auto"
        with open_operator() as operator:
            outcome = rehearse(station, runs, "demo", operator, mode=mode, sets=sets, method=solved_by)
        if sweep:
            _draw(station.cell, outcome.run)
        solution = rehearse_loads(station, runs, outcome, open_operator, messages.print) if loads else None
    if solution is not None:
        _show_loads(outcome, solution, truth, as_json=as_json)
        return
    if as_json:
        errors = {key: np.asarray(one).tolist() for key, one in errors_in_sigma(outcome.result, truth).items()}
        document = {"schema_version": 1, "run": str(outcome.run.folder), "truth": truth}
        document |= {"result": outcome.result.to_dict(), "error_in_sigma": errors}
        write_json({**document, "compensation_error": compensation_error(outcome.result, truth)})
    else:
        records = outcome.run.records()
        print_result(outcome.result, truth=truth, drift=outcome.drift, records=records, hinted=False, every=every)
        messages.print_next(
            f"ftdrive live --calibration {quote(str(outcome.run.folder))} --simulate",
            f"ftdrive solve {quote(str(outcome.run.folder))}" + ("" if sweep else " --method all"),
            "ftdrive init   (describe your own cell)",
        )
    require_accepted(outcome.result, to_be_saved=True)


def _show_loads(outcome: Outcome, solution: LoadSolution, truth: Mapping[str, Any], *, as_json: bool) -> None:
    before = contact_errors(outcome.result, truth)
    after = contact_errors(replace(outcome.result, sensor=solution.sensor), truth)
    if as_json:
        write_json({
            "schema_version": 1, "run": str(outcome.run.folder), "truth": truth, "verdict": solution.verdict,
            "findings": [one.to_dict() for one in solution.findings], "sensor": solution.sensor.to_dict(),
            "contact_error": {"before": before, "after": after},
        })  # fmt: skip
    else:
        answer.print(f"Force error for a contact of {CONTACT_N:g} N at the tip:")
        answer.print(f"  as read by the sensor        {before['as_read_N']:.2f} N")
        for words, found in (("calibrated with the tool", before), ("and with two known loads", after)):
            answer.print(f"  {words:26}  {found['decoded_N']:.2f} N, sigma {found['sigma_N']:.2f} N")
        for finding in solution.findings:
            answer.print(f"{finding.severity.upper()} {finding.words}")
    if solution.verdict == "rejected":
        raise NotAccepted("the runs with loads do not agree on a sensor matrix. Run the demo again with another --seed")


def _draw(cell: CellConfig, run: Run) -> None:
    path = run.folder / "sweep.png"
    try:
        plan = Plan.load(run.plan_path)
        draw_plan(plan, certifier_for(cell, cell.robot.model, plan.kinematics), path)
        messages.print(f"The sweep is drawn in {path}.")
    except ConfigError as error:
        messages.print(f"The sweep is not drawn: {error}.")
