"""`ftdrive demo`: a calibration of an emulated cell, with the truth beside each estimate."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from ftdrive.cell.config import CellConfig
from ftdrive.cell.emulated import REAL_PACE, SENSORS, Station
from ftdrive.commands.common import CONTROL, JSON, METHOD, SETS, rehearse, runs, stop_unless_accepted, write_json
from ftdrive.errors import ConfigError, NotAccepted
from ftdrive.runs.run import Run
from ftdrive.session.options import method_of_poses
from ftdrive.terminal.console import answer, messages
from ftdrive.terminal.report import compensation_error, errors_in_sigma, print_result

if TYPE_CHECKING:
    from ftcalib import CalibrationResult
    from ftcalib.loads.solve import LoadSolution
    from ftdrive.runs.source import Outcome

_LOAD_KG, _LOAD_SIGMA_KG, _PLACE_SIGMA_MM = 2.0, 0.002, 0.5
_HOOKS_MM = {"side": (100.0, 0.0, 50.0), "tip": (0.0, 0.0, 200.0)}
_LOAD_POSES = 12
_CONTACT_N, _DIRECTIONS = 100.0, 300


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
    "--loads",
    is_flag=True,
    help="Correct a sensor with errors of 2 % by two known loads, and compare a contact before and after.",
)
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
    loads: bool,
    runs: Path,
    as_json: bool,
) -> None:
    """Calibrate an emulated cell: no real device is connected or moved. Takes about 25 s, with loads 75 s.

    A UR5e and a sensor are emulated in another process, down to the bytes on their wires. The arm moves 20 times faster
    than a real one. The drivers, the session and the solver are those of a real cell.
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
        outcome = rehearse(station, runs, "demo", mode=mode, sets=sets, method=solved_by)
        if sweep:
            _draw(station.cell, outcome.run)
        solution = _with_loads(station, runs, outcome) if loads else None
    if solution is not None:
        _show_loads(outcome, solution, truth, as_json=as_json)
        return
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


def _with_loads(station: Station, runs: Path, tool: "Outcome") -> "LoadSolution":
    """Hang a load at two places, take poses with each, and solve the sensor's matrix with those of the tool."""
    from ftcalib.loads.model import KnownLoad, LoadRun
    from ftcalib.loads.solve import solve_loads

    truth = station.truth
    taken: list[tuple[Outcome, KnownLoad | None]] = [(tool, None)]
    for name, hook_mm in _HOOKS_MM.items():
        messages.print(
            f"A load of {_LOAD_KG:.3f} kg hangs on a string at {name}, {hook_mm} mm from the flange. It swings because "
            "this quick tour moves its hook; `calibrate --load` turns the tool about it."
        )
        station.control(do="hang", mass_kg=_LOAD_KG, at_mm=hook_mm, swing_deg=0)
        whole_kg = truth["payload_kg"] + _LOAD_KG
        moment = truth["payload_kg"] * np.array(truth["payload_cog_m"]) + _LOAD_KG * np.array(hook_mm) / 1e3
        station.control(do="set-payload", payload_kg=whole_kg, payload_cog_m=(moment / whole_kg).tolist())
        outcome = rehearse(station, runs, f"demo-{name}", poses=_LOAD_POSES)
        x, y, z = (value / 1e3 for value in hook_mm)
        load = KnownLoad(name, _LOAD_KG, _LOAD_SIGMA_KG, (x, y, z), _PLACE_SIGMA_MM / 1e3)
        taken.append((outcome, load))
    station.control(do="unhang")
    sets = [LoadRun(one.run.folder.name, one.dataset, load) for one, load in taken if one.dataset is not None]
    return solve_loads(sets, p_flange_sensor_m=np.array(truth["p_flange_sensor_m"]), g_m_s2=truth["g_m_s2"])


def contact_errors(result: "CalibrationResult", truth: Mapping[str, Any]) -> dict[str, float]:
    """Return the error of a contact of 100 N at the tip: as the sensor reads it, decoded, and the sigma of that.

    Root mean square of the length of the force over all directions, N. The reading is computed from the truth, not with
    the solver's model.
    """
    directions = np.random.default_rng(0).normal(size=(_DIRECTIONS, 3))
    force = _CONTACT_N * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    torque = np.cross(np.array(_HOOKS_MM["tip"]) / 1e3 - truth["p_flange_sensor_m"], force)
    R_flange_sensor = np.array(truth["R_flange_sensor"])
    exerted = np.concatenate([force @ R_flange_sensor, torque @ R_flange_sensor], axis=1)
    reading = exerted @ (np.eye(6) + truth["sensor_error"]).T
    decoded = result.contact.decode(reading)
    sigma = result.contact_sigma(decoded, np.eye(3))[:, :3]
    errors = {
        "as_read_N": reading[:, :3] @ R_flange_sensor.T - force,
        "decoded_N": decoded[:, :3] @ result.R_flange_sensor.T - force,
        "sigma_N": sigma,
    }
    return {name: float(np.sqrt((error**2).sum(axis=1).mean())) for name, error in errors.items()}


def _show_loads(outcome: "Outcome", solution: "LoadSolution", truth: Mapping[str, Any], *, as_json: bool) -> None:
    before = contact_errors(outcome.result, truth)
    after = contact_errors(replace(outcome.result, sensor=solution.sensor), truth)
    if as_json:
        write_json({
            "schema_version": 1, "run": str(outcome.run.folder), "truth": truth, "verdict": solution.verdict,
            "findings": [one.to_dict() for one in solution.findings], "sensor": solution.sensor.to_dict(),
            "contact_error": {"before": before, "after": after},
        })  # fmt: skip
    else:
        answer.print(f"A contact of {_CONTACT_N:g} N at the tip, error of the force:")
        answer.print(f"  as the sensor reads it      {before['as_read_N']:.2f} N")
        for words, found in (("calibrated with the tool", before), ("and with two known loads", after)):
            answer.print(f"  {words:26}  {found['decoded_N']:.2f} N, sigma {found['sigma_N']:.2f} N")
        for finding in solution.findings:
            answer.print(f"{finding.severity.upper()} {finding.words}")
    if solution.verdict == "rejected":
        raise NotAccepted("the runs with loads do not agree on a matrix of the sensor")


def _draw(cell: CellConfig, run: Run) -> None:
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
