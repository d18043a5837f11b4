"""`ftdrive replay`: repeat a recorded run with the same routine and solver, without drivers."""

from dataclasses import replace
from pathlib import Path

import click
import numpy as np

from ftcalib import CalibrationResult
from ftcalib.routine import PoseRecord, take_pose
from ftcalib.sampling import Sampling
from ftdrive.commands.options import ALL, EMULATED_SENSOR, JSON, PATH, check_simulate, simulate, write_json
from ftdrive.errors import ConfigError, NotAccepted
from ftdrive.runs.bundle import unpack
from ftdrive.runs.calibration import require_accepted
from ftdrive.runs.run import Run
from ftdrive.runs.source import RecordedRun, solve_records
from ftdrive.session.rehearsal import rehearsed_run
from ftdrive.terminal.console import answer, indented, messages, working
from ftdrive.terminal.report import print_result
from ftdrive.terminal.screen import open_operator

# Results may differ by this many sigmas, because linear algebra rounds differently on different processors.
_ROUNDING_SIGMA = 1e-6


@click.command()
@click.argument("source", metavar="RUN", required=False, type=PATH)
@simulate("Record a short run of an emulated cell, then repeat it.")
@EMULATED_SENSOR
@ALL
@JSON
def replay(source: Path | None, simulate: bool, sensor: str | None, every: bool, as_json: bool) -> None:
    """Repeat the recorded RUN, and compare the result with the saved one.

    The results must be equal to the last digit on the same kind of processor, and within 1e-6 sigma on another one.

    RUN is a run folder, or the file of `ftdrive bundle`.
    """
    check_simulate(simulate, real={"RUN": source}, emulated={"--sensor": sensor})
    if simulate:
        with rehearsed_run(open_operator(), sensor) as recorded:
            _repeat_run(Run(recorded), recorded, every, as_json)
    elif source is not None:
        with unpack(source) as folder:
            _repeat_run(Run(folder), source, every, as_json)
    else:
        raise ConfigError("no run: give its folder or bundle, or --simulate")


def _repeat_run(run: Run, source: Path, every: bool, as_json: bool) -> None:
    recorded = RecordedRun(run.records())
    records: list[PoseRecord] = []
    sampling = Sampling(**run.header()["config"]["sampling"])
    for kept in run.records():
        recorded.go_on_to(kept.pose.q_rad)
        again = take_pose(recorded, recorded, kept.stop, kept.pose, sampling)
        records.append(replace(again, clock_offset_ns=kept.clock_offset_ns))
        if messages.verbose:
            messages.print(f"{kept.stop:2d}  R{kept.pose.number:02d}  {len(kept.samples.t_host_ns)} samples")
    with working("Solving"):
        outcome = solve_records(run, records)
    if as_json:
        write_json(outcome.result.to_dict())
    else:
        print_result(outcome.result, drift=outcome.drift, records=records, every=every)
    require_accepted(outcome.result)
    if run.calibration_path.exists():
        equal = compare_results(outcome.result, CalibrationResult.load(run.calibration_path))
        if not as_json:
            answer.print(indented(" ✔ ", f"{equal}: {run.calibration_path.name} of {source}", answer))


def compare_results(again: CalibrationResult, saved: CalibrationResult) -> str:
    """Return how well two results agree; raise `NotAccepted` if they differ by more than rounding."""
    one, other = again.to_dict(), saved.to_dict()
    keys = [key for key in one if key != "provenance" and one[key] != other[key]]
    if not keys:
        return "equal to the last digit"
    sigma = np.sqrt(np.diag(saved.covariance))
    off = np.abs(saved.parameters.difference(again.parameters)) / np.where(sigma > 0, sigma, 1.0)
    alike = [[(finding.code, finding.severity) for finding in result.findings] for result in (again, saved)]
    if off.max() > _ROUNDING_SIGMA or alike[0] != alike[1]:
        raise NotAccepted(f"the replay differs from the saved calibration in {', '.join(keys)}")
    return f"equal except for rounding, within {off.max():.1g} sigma, as on another kind of processor"
