"""One calibration session on one cell: open, plan, confirm, move and average, solve, save."""

import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from calib import CalibrationDataset, CalibrationResult, solve
from calib.routine import DriftCheck, PoseRecord, Progress, dataset_from, drift_check, run_tour
from calib.tour import TourPose, wrist_tour
from drivers.interfaces import DeviceInfo, ForceTorqueSensor, RobotArm
from ftdrive.config import CellConfig
from ftdrive.errors import ConfigError
from ftdrive.runs import Run, versions
from ftdrive.wiring import build_arm, build_sensor


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """What the arm is going to do, for the user to see before it moves."""

    arm: DeviceInfo
    sensor: DeviceInfo
    speed_deg_s: float
    tour: tuple[TourPose, ...]
    approach_deg: float
    """Largest turn of a joint on the way from here to the first pose."""
    ranges_deg: tuple[tuple[float, float], ...]
    """Lowest and highest angle of each joint, the approach included."""
    duration_s: float
    """Of moves and averages, about."""


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What a session leaves."""

    run: Run
    dataset: CalibrationDataset
    result: CalibrationResult
    drift: DriftCheck | None


def calibrate_cell(
    cell: CellConfig,
    runs: Path,
    name: str,
    *,
    confirm: Callable[[Plan], None],
    on_progress: Callable[[Progress], None],
    on_run: Callable[[Run], None],
    description: Mapping[str, Any],
) -> Outcome:
    """Calibrate one cell.

    Parameters
    ----------
    confirm : callable
        Is shown the plan before anything moves; raises to refuse.
    on_progress, on_run : callable
        Are told of every step, and of the run folder as soon as it exists.
    description : mapping
        Goes into run.json beside the configuration, the devices and the tour.
    """
    with build_sensor(cell) as sensor, closing(build_arm(cell)) as arm:
        arm.open(control=True)
        plan = _plan(cell, arm, sensor)
        confirm(plan)
        run = Run.create(
            runs,
            name,
            {
                "config": asdict(cell),
                "devices": {"arm": asdict(plan.arm), "sensor": asdict(plan.sensor)},
                "tour": [{"number": pose.number, "q_rad": pose.q_rad.tolist()} for pose in plan.tour],
                **description,
            },
        )
        on_run(run)
        for progress in run_tour(arm, sensor, plan.tour, cell.sampling, run.commit):
            on_progress(progress)
    # Solved from the files, not from memory: what is on disk is then enough to repeat it.
    outcome = solve_records(run, run.records())
    outcome.dataset.save(run.folder / "dataset.json")
    if outcome.result.verdict != "rejected":
        outcome.result.save(run.calibration_path)
    return outcome


def dataset_of(run: Run) -> tuple[CalibrationDataset, float, dict[str, Any]]:
    """Read a run as a dataset, with the local gravity it was made at and where a result of it comes from."""
    return _prepared(run, run.records())


def solve_records(run: Run, records: Sequence[PoseRecord]) -> Outcome:
    """Solve records of a run, as they are on disk or as a replay gives them."""
    dataset, g_m_s2, provenance = _prepared(run, records)
    result = solve(dataset, g_m_s2=g_m_s2, provenance=provenance)
    return Outcome(run, dataset, result, drift_check(records))


def _prepared(run: Run, records: Sequence[PoseRecord]) -> tuple[CalibrationDataset, float, dict[str, Any]]:
    header = run.header()
    devices = header.get("devices", {})
    dataset = dataset_from(records, {"run": run.folder.name, "devices": devices})
    provenance = {
        "created_utc": datetime.now(UTC).isoformat(),
        "argv": sys.argv,
        "versions": versions(),
        "devices": devices,
        "run": run.folder.name,
        "station": header.get("station"),
    }
    return dataset, float(header["config"]["site"]["g_m_s2"]), provenance


def _plan(cell: CellConfig, arm: RobotArm, sensor: ForceTorqueSensor) -> Plan:
    q_rad = arm.state().q_rad
    try:
        tour = wrist_tour(q_rad)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    for stop, pose in enumerate(tour, start=1):
        if not arm.within_safety_limits([float(angle) for angle in pose.q_rad]):
            raise ConfigError(
                f"the controller's safety limits forbid stop {stop} of the tour (orientation {pose.number:02d}, joints "
                f"{np.round(np.degrees(pose.q_rad)).astype(int).tolist()} deg): bring joints 1 to 3 to another posture"
            )
    path_deg = np.degrees([q_rad, *(pose.q_rad for pose in tour), tour[0].q_rad])
    turns_deg = np.abs(np.diff(path_deg, axis=0)).max(axis=1)
    speed, acceleration = cell.robot.speed_deg_s, cell.robot.acceleration_deg_s2
    ramp_deg = speed**2 / acceleration
    moves_s = np.where(
        turns_deg > ramp_deg, turns_deg / speed + speed / acceleration, 2 * np.sqrt(turns_deg / acceleration)
    )
    return Plan(
        arm=arm.identify(),
        sensor=sensor.identify(),
        speed_deg_s=speed,
        tour=tour,
        approach_deg=float(turns_deg[0]),
        ranges_deg=tuple(zip(path_deg.min(axis=0).tolist(), path_deg.max(axis=0).tolist(), strict=True)),
        duration_s=float(moves_s.sum() + len(turns_deg) * cell.sampling.average_s),
    )
