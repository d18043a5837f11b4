"""`ftdrive replay`: a recorded run once more, through the same routine and solver, without any driver."""

from pathlib import Path

import click

from calib import CalibrationResult
from calib.routine import PoseRecord, Sampling, run_tour
from ftdrive.commands.common import JSON, stop_unless_accepted, write_json
from ftdrive.errors import NotAccepted
from ftdrive.recorded import EndOfRecording, RecordedRun
from ftdrive.report import describe, print_result, talk
from ftdrive.runs import Run
from ftdrive.session import solve_records


@click.command()
@click.argument("folder", metavar="RUN", type=click.Path(exists=True, file_okay=False, path_type=Path))
@JSON
def replay(folder: Path, as_json: bool) -> None:
    """Repeat the recorded RUN and compare the result with the one it saved: they must agree to the last digit."""
    run = Run(folder)
    recorded = RecordedRun(run.records())
    records: list[PoseRecord] = []
    sampling = Sampling(**run.header()["config"]["sampling"])
    try:
        for progress in run_tour(recorded, recorded, recorded.tour, sampling, records.append):
            if progress.stage == "taken":
                talk.print(describe(progress))
    except EndOfRecording:
        talk.print(f"the run was broken off after {len(records)} poses")
    outcome = solve_records(run, records)
    if as_json:
        write_json(outcome.result.to_dict())
    else:
        print_result(outcome.result, drift=outcome.drift)
    stop_unless_accepted(outcome.result)
    if run.calibration_path.exists():
        _compare(outcome.result, CalibrationResult.load(run.calibration_path))
        talk.print(f" Equal to {run.calibration_path}, to the last digit")


def _compare(again: CalibrationResult, saved: CalibrationResult) -> None:
    one, other = again.to_dict(), saved.to_dict()
    keys = [key for key in one if key != "provenance" and one[key] != other[key]]
    if keys:
        raise NotAccepted(f"the replay differs from the saved calibration in {', '.join(keys)}")
