"""`ftdrive replay`: a recorded run, repeated by the same routine and solver without a driver."""

from dataclasses import replace
from pathlib import Path

import click

from ftcalib import CalibrationResult
from ftcalib.routine import PoseRecord, take_pose
from ftcalib.sampling import Sampling
from ftdrive.commands.common import (
    EMULATED_SENSOR,
    JSON,
    check_simulate,
    rehearsed_run,
    simulate,
    stop_unless_accepted,
    write_json,
)
from ftdrive.errors import ConfigError, NotAccepted
from ftdrive.runs.bundle import unpack
from ftdrive.runs.run import Run
from ftdrive.runs.source import RecordedRun, solve_records
from ftdrive.terminal.console import answer, hanging, messages, working
from ftdrive.terminal.report import print_result


@click.command()
@click.argument("source", metavar="RUN", required=False, type=click.Path(exists=True, path_type=Path))
@simulate("Record a short run of an emulated cell, then repeat it.")
@EMULATED_SENSOR
@JSON
def replay(source: Path | None, simulate: bool, sensor: str | None, as_json: bool) -> None:
    """Repeat the recorded RUN and compare the result with the saved one: they must be equal to the last digit.

    RUN is a run folder, or the file of `ftdrive bundle`.
    """
    check_simulate(simulate, real={"RUN": source}, emulated={"--sensor": sensor})
    if simulate:
        with rehearsed_run(sensor) as recorded:
            _repeat(Run(recorded), recorded, as_json)
    elif source is not None:
        with unpack(source) as folder:
            _repeat(Run(folder), source, as_json)
    else:
        raise ConfigError("no run: give its folder or bundle, or --simulate")


def _repeat(run: Run, source: Path, as_json: bool) -> None:
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
        print_result(outcome.result, drift=outcome.drift, records=records)
    stop_unless_accepted(outcome.result)
    if run.calibration_path.exists():
        _compare(outcome.result, CalibrationResult.load(run.calibration_path))
        if not as_json:
            words = f"equal to the last digit: {run.calibration_path.name} of {source}"
            answer.print(hanging(" ✔ ", words, answer))


def _compare(again: CalibrationResult, saved: CalibrationResult) -> None:
    one, other = again.to_dict(), saved.to_dict()
    keys = [key for key in one if key != "provenance" and one[key] != other[key]]
    if keys:
        raise NotAccepted(f"the replay differs from the saved calibration in {', '.join(keys)}")
