"""`ftdrive demo`: the whole job on an emulated cell, truth beside estimate."""

import os
from pathlib import Path
from shlex import quote
from typing import Any

import click
import numpy as np

from ftdrive.cell.emulated import SENSORS, Station
from ftdrive.cell.emulated_run import rehearse
from ftdrive.commands.common import JSON, runs, stop_unless_accepted, write_json
from ftdrive.terminal.console import talk
from ftdrive.terminal.report import errors_in_sigma, print_result


@click.command()
@click.option("--sensor", type=click.Choice(list(SENSORS)), default="can", show_default=True, help="Which one.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Draws the truth and the noise.")
@click.option("--simulate", is_flag=True, expose_value=False, help="As every command has it; a demo always is.")
@runs()
@JSON
def demo(sensor: str, seed: int, runs: Path, as_json: bool) -> None:
    """Calibrate an emulated cell: nothing is connected, nothing real moves.

    A UR5e and a sensor are emulated in a process of their own, down to the bytes on their wires; the arm lives 20 times
    faster. Everything on this side is what a real cell gets.
    """
    with Station(sensor, ["--seed", str(seed)]) as station:
        truth = station.truth
        talk.print(
            f"An emulated UR5e, {SENSORS[sensor]}, tool of {truth['mass_kg']:.3f} kg. Nothing real is connected."
        )
        outcome = rehearse(station, runs, "demo")
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
        print_result(outcome.result, truth=truth, drift=outcome.drift, records=outcome.run.records())
        uv = "uv run " if "UV_RUN_RECURSION_DEPTH" in os.environ else ""  # which uv run sets
        talk.print(
            "\n Try next:"
            f"\n   {uv}ftdrive live --calibration {quote(str(outcome.run.calibration_path))} --simulate"
            f"\n   {uv}ftdrive replay {quote(str(outcome.run.folder))}"
            f"\n   {uv}{outcome.run.solve_command} --method lrom"
            f"\n Saved {outcome.run.calibration_path}"
        )
    stop_unless_accepted(outcome.result, to_be_saved=True)


def compensation_error(result: Any, truth: Any) -> dict[str, float]:
    """Rms of what is left of a free tool's wrench after compensation, over 1000 random orientations.

    The wrench is computed here from the truth, not with the solver's model.
    """
    from scipy.spatial.transform import Rotation

    R_base_flange = Rotation.random(1000, rng=0).as_matrix()
    weight = np.einsum(
        "ji,nkj,k->ni", np.asarray(truth["R_flange_sensor"]), R_base_flange, np.asarray(truth["gravity_force_base_N"])
    )
    force = weight + truth["force_bias_N"]
    torque = np.cross(truth["p_sensor_com_m"], weight) + truth["torque_bias_Nm"]
    left = result.compensate(np.hstack([force, torque]), R_base_flange)
    rms = [float(np.sqrt(np.mean(np.sum(part**2, axis=1)))) for part in (left[:, :3], left[:, 3:])]
    return {"force_rms_N": rms[0], "torque_rms_Nm": rms[1]}
