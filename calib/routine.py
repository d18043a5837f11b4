"""The calibration routine: for each pose move, wait until still, average, commit to disk, next.

It knows the outside world only through `calib.ports`, prints nothing, and can be driven by a cell or by a recording of
one: what it decides depends only on what the arm and the sensor tell it.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from calib.dataset import CalibrationDataset
from calib.errors import CalibError, TooFewSamples
from calib.noise import LEAST_SAMPLES, PoseMean, is_stationary, mean_and_covariance
from calib.ports import Arm, ArmReading, Sensor, WrenchSamples
from calib.tour import TourPose

Array = NDArray[np.float64]

_MOVED_RAD = np.radians(0.05)
"""The flange may turn this much while a pose is averaged: a tenth of the noise of a good sensor at 1 kg."""


@dataclass(frozen=True, slots=True)
class Sampling:
    """How long to look at each pose."""

    average_s: float = 2.0
    move_timeout_s: float = 30.0
    still_timeout_s: float = 10.0
    attempts: int = 3
    """A pose that moves or drifts while it is averaged is averaged again, this often in all."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseRecord:
    """Everything that was seen at one pose; raw means raw."""

    stop: int
    """Position in the tour, from 1; the return to the first pose comes last."""
    pose: TourPose
    before: ArmReading
    after: ArmReading
    samples: WrenchSamples
    steady: bool
    """Neither the flange nor the mean wrench moved while the samples were taken."""
    mean: PoseMean = field(init=False)
    """Mean wrench and the covariance of the mean."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "mean", mean_and_covariance(self.samples.wrench))

    @property
    def t_mid_ns(self) -> int:
        """Host time in the middle of the samples."""
        return int((int(self.samples.t_host_ns[0]) + int(self.samples.t_host_ns[-1])) // 2)


@dataclass(frozen=True, slots=True, eq=False)
class Progress:
    """What the routine does now."""

    stage: Literal["moving", "settling", "averaging", "taken"]
    stop: int
    stops: int
    pose: TourPose
    record: PoseRecord | None = None
    """Only with stage "taken": already committed."""


@dataclass(frozen=True, slots=True, eq=False)
class DriftCheck:
    """The first pose seen again at the end of the tour."""

    change: Array
    """(6,) N and N·m."""
    sigma: Array
    """(6,) standard deviation of the change expected from the noise alone."""
    elapsed_s: float


def run_tour(
    arm: Arm, sensor: Sensor, tour: Sequence[TourPose], sampling: Sampling, commit: Callable[[PoseRecord], None]
) -> Iterator[Progress]:
    """Visit every pose of the tour, then the first once more.

    Parameters
    ----------
    commit : callable
        Takes each record and returns when it is safe on disk; only then does the arm move on.

    Yields
    ------
    Progress
        Before each step and after each pose taken.

    Raises
    ------
    TooFewSamples
        The sensor is too slow for the time given to a pose.
    Exception
        Whatever the arm or the sensor raises; the records committed so far stand.
    """
    stops = [*tour, tour[0]]
    for stop, pose in enumerate(stops, start=1):
        yield Progress("moving", stop, len(stops), pose)
        arm.move_to([float(angle) for angle in pose.q_rad], timeout_s=sampling.move_timeout_s, guard=sensor.check)
        for _ in range(sampling.attempts):
            yield Progress("settling", stop, len(stops), pose)
            arm.wait_until_still(timeout_s=sampling.still_timeout_s, guard=sensor.check)
            yield Progress("averaging", stop, len(stops), pose)
            before = arm.state()
            samples = sensor.collect(sampling.average_s)
            after = arm.state()
            enough = len(samples.wrench) >= LEAST_SAMPLES
            steady = enough and turned_rad(before, after) < _MOVED_RAD and is_stationary(samples.wrench)
            if steady:
                break
        if not enough:
            raise TooFewSamples(
                f"the sensor gave {len(samples.wrench)} samples in {sampling.average_s} s, at least {LEAST_SAMPLES} "
                "are needed: check its rate, or average longer"
            )
        record = PoseRecord(stop, pose, before, after, samples, steady)
        commit(record)
        yield Progress("taken", stop, len(stops), pose, record)


def turned_rad(before: ArmReading, after: ArmReading) -> float:
    """Angle between the flange orientations of two readings."""
    change = before.R_base_flange.T @ after.R_base_flange
    sine = np.linalg.norm([change[2, 1] - change[1, 2], change[0, 2] - change[2, 0], change[1, 0] - change[0, 1]]) / 2
    return float(np.arctan2(sine, (np.trace(change) - 1) / 2))


def is_return(record: PoseRecord, records: Sequence[PoseRecord]) -> bool:
    """Tell whether a record is the return to the first pose of its tour."""
    return record.stop != records[0].stop and record.pose.number == records[0].pose.number


def dataset_from(records: Sequence[PoseRecord], meta: Mapping[str, Any]) -> CalibrationDataset:
    """Turn the records of a tour, whole or broken off, into the solver's input.

    The return to the first pose is left out: it serves `drift_check`.
    """
    if not records:
        raise CalibError("the run holds no pose yet: nothing to solve")
    kept = [record for record in records if not is_return(record, records)]
    t_ns = np.array([record.t_mid_ns for record in kept])
    return CalibrationDataset(
        R_base_flange=np.stack([record.before.R_base_flange for record in kept]),
        wrench=np.stack([record.mean.mean for record in kept]),
        wrench_cov=np.stack([record.mean.covariance for record in kept]),
        n_samples=np.array([len(record.samples.t_host_ns) for record in kept]),
        t_s=(t_ns - t_ns[0]) * 1e-9,
        meta=meta,
    )


def drift_check(records: Sequence[PoseRecord]) -> DriftCheck | None:
    """Compare the first pose with its repetition at the end; None when the tour was broken off before."""
    if len(records) < 2 or not is_return(records[-1], records):
        return None
    first, last = records[0], records[-1]
    return DriftCheck(
        change=last.mean.mean - first.mean.mean,
        sigma=np.sqrt(np.diag(first.mean.covariance) + np.diag(last.mean.covariance)),
        elapsed_s=(last.t_mid_ns - first.t_mid_ns) * 1e-9,
    )
