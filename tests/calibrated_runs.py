"""Run folders as `ftdrive calibrate` leaves them, but without the poses: a dataset and its calibration."""

import json
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset, CalibrationResult, Parameters
from ftcalib.errors import NotObservable
from ftcalib.model import predict
from ftdrive.fleet.resolve import solve_run
from ftdrive.runs.motion import MotionRecording
from ftdrive.runs.run import RUN_FORMAT
from ftdrivers.interfaces import ArmStates, FtSamples
from tests.moving_load import Truth, record, sweep

FIRST = datetime(2026, 8, 1, tzinfo=UTC)
NOISE = np.repeat([0.005, 0.0002], 3)
"""Standard error of a pose's mean."""


@lru_cache(maxsize=256)
def dataset(seed: int, poses: int = 8) -> CalibrationDataset:
    """A tour with random orientations and a bias that drifts a little."""
    rng = np.random.default_rng(seed)
    truth = Parameters(
        Rotation.from_rotvec(0.3 * rng.normal(size=3)).as_matrix(),
        np.array([0.1, -0.2, -12.0]),
        3 * rng.normal(size=3),
        np.array([0.005, -0.003, 0.07]),
        0.1 * rng.normal(size=3),
    )
    R = Rotation.random(poses, rng=rng).as_matrix()
    walk = np.cumsum(NOISE * rng.normal(size=(poses, 6)), axis=0)
    wrench = predict(truth, R) + walk + NOISE * rng.normal(size=(poses, 6))
    covariance = np.tile(np.diag(NOISE**2), (poses, 1, 1))
    return CalibrationDataset(R, wrench, covariance, np.full(poses, 200), np.linspace(0, 5 * poses, poses))


def calibrated_run(
    runs: Path, name: str, seed: int = 1, *, poses: int = 8, day: float = 0.0, header: Mapping[str, Any] = {}
) -> Path:
    """Make the folder of a calibration; without its result if it is rejected or not observable, as `calibrate` does."""
    folder = runs / name
    folder.mkdir(parents=True)
    created_utc = (FIRST + timedelta(days=day)).isoformat()
    about = {
        "format": RUN_FORMAT,
        "created_utc": created_utc,
        "command": "calibrate",
        "config": {"robot": {"host": "192.0.2.1"}, "site": {"g_m_s2": 9.80665}, "tool": {"name": "gripper"}},
        "devices": {"arm": {"serial": "arm-1"}, "sensor": {"serial": "ft-1"}},
        **header,
    }
    (folder / "run.json").write_text(json.dumps(about))
    dataset(seed, poses).save(folder / "dataset.json")
    try:
        result = _own(folder, seed, poses)
    except NotObservable:
        return folder
    document = result.to_dict()
    document["provenance"] |= {"created_utc": created_utc, "run": name}
    if result.verdict != "rejected":
        (folder / "calibration.json").write_text(json.dumps(document))
    return folder


def swept_run(runs: Path, name: str, header: Mapping[str, Any] = {}) -> Path:
    """Make the folder of a run with a recording in motion of 12 s, and without its result."""
    folder = runs / name
    folder.mkdir(parents=True)
    created = {"format": RUN_FORMAT, "created_utc": FIRST.isoformat(), "command": "calibrate", "mode": "sweep"}
    config = {"robot": {"host": "192.0.2.1"}, "site": {"g_m_s2": 9.80665}, "tool": {"name": "gripper"}}
    (folder / "run.json").write_text(json.dumps({**created, "config": config, **header}))
    recorded = record(Truth(), sweep(12.0), 12.0, 1, rates_Hz=(100.0, 100.0))
    nothing = np.zeros((len(recorded.t_pose_s), 6))
    received_ns = ((1e9 * t_s).astype(np.int64) for t_s in (recorded.t_pose_s, recorded.t_s))
    t_pose_ns, t_ns = received_ns
    R, p = recorded.R_base_flange, recorded.p_base_flange_m
    states = ArmStates(t_pose_ns, recorded.t_pose_s, nothing, nothing, R, p)
    samples = FtSamples.of(t_ns, np.arange(len(t_ns)), recorded.wrench)
    MotionRecording(samples, states, 100.0).save(folder / "motion.npz")
    return folder


_solved = dict[tuple[int, int], CalibrationResult]()


def _own(folder: Path, seed: int, poses: int) -> CalibrationResult:
    if (seed, poses) not in _solved:
        _solved[seed, poses] = CalibrationResult.from_dict(json.loads(solve_run(folder)))
    return _solved[seed, poses]
