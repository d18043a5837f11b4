"""The calibration routine at one pose: wait until still, average, again if need be; and what many poses become.

It knows the outside world only through `calib.ports`, prints nothing, and can be driven by a cell or by a recording of
one: what it decides depends only on what the arm and the sensor tell it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from calib.data.dataset import CalibrationDataset
from calib.data.dwell_mean import LEAST_SAMPLES, PoseMean, is_quiet, is_stationary, mean_and_covariance
from calib.errors import CalibError, TooFewSamples
from calib.model import Array
from calib.ports import Arm, ArmReading, Sensor, WrenchSamples

Stage = Literal["settle", "sample"]

MOVED_RAD = float(np.radians(0.05))
"""The flange may turn this much while a pose is averaged: a tenth of the noise of a good sensor at 1 kg."""


LONGER = (1, 2, 4)
"""How many times as long to average until there are enough samples: a sensor that is asked for each may be slow."""


@dataclass(frozen=True, slots=True, eq=False)
class TourPose:
    """One stop of a tour."""

    number: int
    """Of the orientation: 1 to 24 as in Yu et al., Fig. 3; above 100 for one that was chosen otherwise."""
    q_rad: Array
    """(6,) joint angles."""


@dataclass(frozen=True, slots=True)
class Sampling:
    """How long to look at each pose."""

    average_s: float = 2.0
    still_timeout_s: float = 10.0
    attempts: int = 2
    """A pose that moves or drifts while it is averaged is averaged again, this often in all, and then kept as noisy."""
    noise_record_s: float = 12.0
    """Before a tour, listen to the sensor so long and choose from it how long to average; 0 takes `average_s`."""


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
    clock_offset_ns: int = 0
    """From the host's clock to one that all parts of a run share: a resumed run may have seen a restart between."""
    mean: PoseMean = field(init=False)
    """Mean wrench and the covariance of the mean."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "mean", mean_and_covariance(self.samples.wrench))

    @property
    def t_mid_ns(self) -> int:
        """Time in the middle of the samples, on the clock of the run."""
        return (int(self.samples.t_host_ns[0]) + int(self.samples.t_host_ns[-1])) // 2 + self.clock_offset_ns


@dataclass(frozen=True, slots=True, eq=False)
class DriftCheck:
    """The first pose seen again at the end of the tour: from it to its return."""

    change: Array
    """(6,) N and N·m."""
    sigma: Array
    """(6,) standard deviation of the change expected from the noise alone."""
    elapsed_s: float
    """Negative where the first pose was taken anew after the return."""


def take_pose(
    arm: Arm,
    sensor: Sensor,
    stop: int,
    pose: TourPose,
    sampling: Sampling,
    *,
    guard: Callable[[], None] | None = None,
    on_stage: Callable[[Stage], None] = lambda _: None,
    quiet_std: Array | None = None,
) -> PoseRecord:
    """Wait until arm and sensor are still where the arm was moved to, and average; again if something moved meanwhile.

    Parameters
    ----------
    stop : int
        Place in the tour.
    pose : TourPose
        Where the arm was moved to.
    guard : callable
        Called between two looks at the arm; raises to break off. Default: the sensor's own check.
    on_stage : callable
        Is told of each stage as it begins.
    quiet_std : array, shape (6,), optional
        Standard deviation of the samples of an arm at rest: twice that is not steady.

    Raises
    ------
    TooFewSamples
        The sensor is too slow for the time given to a pose.
    Exception
        Whatever the arm, the sensor or the guard raises.
    """
    guard = guard or sensor.check
    for _ in range(sampling.attempts):
        on_stage("settle")
        arm.wait_until_still(timeout_s=sampling.still_timeout_s, guard=guard)
        on_stage("sample")
        before = arm.state()
        samples = collect_enough(sensor, sampling.average_s)
        after = arm.state()
        guard()
        steady = turned_rad(before, after) < MOVED_RAD
        if steady:
            wrench = samples.wrench
            steady = is_stationary(wrench) if quiet_std is None else is_quiet(wrench, quiet_std)
        if steady:
            break
    return PoseRecord(stop, pose, before, after, samples, steady)


def collect_enough(sensor: Sensor, average_s: float) -> WrenchSamples:
    """Collect for `average_s` seconds; where that gives too few samples, again and for longer.

    Raises
    ------
    TooFewSamples
        It never gave enough.
    """
    for times in LONGER:
        samples = sensor.collect(times * average_s)
        if len(samples.wrench) >= LEAST_SAMPLES:
            break
    require_enough(samples, times * average_s)
    return samples


def require_enough(samples: WrenchSamples, average_s: float) -> None:
    """Raise `TooFewSamples` where this many of them are no average."""
    if len(samples.wrench) < LEAST_SAMPLES:
        raise TooFewSamples(
            f"the sensor gave {len(samples.wrench)} samples in {average_s} s, at least {LEAST_SAMPLES} are needed: "
            "check its rate, or average longer"
        )


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
