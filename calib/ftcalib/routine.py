"""The calibration routine at one pose (wait for rest, average, repeat if necessary) and the dataset of a tour.

Tours, hand-guided poses, verifications and replays all use this routine. It accesses devices only through the
protocols below and prints nothing. Its decisions depend only on the readings of arm and sensor.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from ftcalib.data.dataset import CalibrationDataset
from ftcalib.data.dwell_mean import LEAST_SAMPLES, PoseMean, is_quiet, is_stationary, mean_and_covariance, without_swing
from ftcalib.errors import NotObservable, TooFewSamples
from ftcalib.model import Array
from ftcalib.sampling import Sampling

# Interfaces of sensor and arm for the calibration routine, implemented by drivers, recordings and test doubles.


class WrenchSamples(Protocol):
    """n samples from a force/torque sensor, as measured: before any bias, tare, filter or compensation."""

    @property
    def t_host_ns(self) -> NDArray[np.int64]:
        """(n,) times of receipt on the host clock, ns."""

    @property
    def t_device_s(self) -> Array:
        """(n,) times on the device clock, s; NaN without a device clock."""

    @property
    def seq(self) -> NDArray[np.int64]:
        """(n,) sequence numbers; a gap means lost samples."""

    @property
    def counts(self) -> NDArray[np.int32]:
        """(n, k) raw device counts."""

    @property
    def wrench(self) -> Array:
        """(n, 6) wrenches in the sensor frame, N and N·m."""

    @property
    def status(self) -> NDArray[np.uint32]:
        """(n,) status words of the device, with the bits of its vendor."""


class Sensor(Protocol):
    """A source of wrenches."""

    def collect(self, duration_s: float, /) -> WrenchSamples:
        """Return all samples of the next `duration_s` seconds; raise if the stream fails."""

    def check(self) -> None:
        """Raise an error if the stream has failed; else return at once."""


class ArmReading(Protocol):
    """State of the arm at one time."""

    @property
    def t_host_ns(self) -> int:
        """Time of receipt on the host clock, ns."""

    @property
    def q_rad(self) -> Array:
        """(6,) joint angles, rad."""

    @property
    def R_base_flange(self) -> Array:
        """(3, 3) orientation of the flange: maps flange coordinates to base coordinates."""


class Arm(Protocol):
    """An arm at a pose, at rest or about to come to rest."""

    def state(self) -> ArmReading:
        """Return a fresh state; raise if the arm sends none."""

    def wait_until_still(self, *, timeout_s: float, guard: Callable[[], None]) -> None:
        """Return when the arm is at rest; raise after the time-out or if the guard raises."""


Stage = Literal["settle", "sample"]

# Largest rotation of the flange during a dwell: it changes the force of 1 kg by a tenth of the noise of a good sensor.
MOVED_RAD = float(np.radians(0.05))

# Factors of the averaging time, tried in turn until there are enough samples, because polled sensors may be slow.
LONGER = (1, 2, 4)


@dataclass(frozen=True, slots=True, eq=False)
class TourPose:
    """Planned pose at one stop of a tour."""

    number: int
    """Orientation number: 1 to 24 as in Yu et al., Fig. 3; above 100 for all others."""
    q_rad: Array
    """(6,) joint angles, rad."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseRecord:
    """Raw readings of arm and sensor at one pose."""

    stop: int
    """Position of the pose in the tour, counted from 1; the return to the first pose is the last position."""
    pose: TourPose
    before: ArmReading
    after: ArmReading
    samples: WrenchSamples
    steady: bool
    """Whether neither the flange nor the mean wrench changed during the dwell."""
    attempts: int = 1
    """Number of dwells at this pose, including this one."""
    clock_offset_ns: int = 0
    """Clock of the run minus clock of the host, ns: not zero if the computer was restarted during the run."""
    swings: bool = False
    """Whether a weight hangs on a string from the tool. Its swing is then removed from the mean."""
    mean: PoseMean = field(init=False)
    """Mean wrench and the covariance of the mean."""

    def __post_init__(self) -> None:
        wrench = _without_swing(self.samples)[0] if self.swings else self.samples.wrench
        object.__setattr__(self, "mean", mean_and_covariance(wrench))

    @property
    def t_mid_ns(self) -> int:
        """Mean of the times of the first and last sample, on the clock of the run, ns."""
        return (int(self.samples.t_host_ns[0]) + int(self.samples.t_host_ns[-1])) // 2 + self.clock_offset_ns


@dataclass(frozen=True, slots=True, eq=False)
class DriftCheck:
    """Change of the reading from the first pose to its repetition at the end of the tour."""

    change: Array
    """(6,) change of the mean wrench, N and N·m."""
    sigma: Array
    """(6,) standard deviation of the change due to noise alone, N and N·m."""
    elapsed_s: float
    """Time from the first pose to its repetition, s; negative if the first pose was retaken after the return."""

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as a JSON object."""
        return {"change": self.change.tolist(), "sigma": self.sigma.tolist(), "elapsed_s": self.elapsed_s}


def take_pose(  # noqa: PLR0913 - the limits for a steady pose
    arm: Arm,
    sensor: Sensor,
    stop: int,
    pose: TourPose,
    sampling: Sampling,
    *,
    guard: Callable[[], None] | None = None,
    on_stage: Callable[[Stage], None] = lambda _: None,
    quiet_std: Array | None = None,
    most_swing_N: float | None = None,
) -> PoseRecord:
    """Wait until the arm is at rest, then average; repeat if the arm or the wrench changed during the dwell.

    Parameters
    ----------
    stop : int
        Position in the tour.
    pose : TourPose
        Pose of the arm.
    guard : callable
        Called between readings of the arm, and raises to abort. Default: the check of the sensor.
    on_stage : callable
        Called at the start of each stage.
    quiet_std : array, shape (6,), optional
        Standard deviation of the samples with the arm at rest. A dwell with more than twice this noise is not steady.
    most_swing_N : float, optional
        Largest amplitude of the force of a weight on a string in a steady dwell. Default: no weight on a string.

    Raises
    ------
    TooFewSamples
        The sensor is too slow even for the longest averaging time (`LONGER`).
    Exception
        Whatever the arm, the sensor or the guard raises.
    """
    guard = guard or sensor.check
    for attempt in range(1, sampling.attempts + 1):
        on_stage("settle")
        arm.wait_until_still(timeout_s=sampling.still_timeout_s, guard=guard)
        on_stage("sample")
        before = arm.state()
        samples = _collect_enough(sensor, sampling.average_s)
        after = arm.state()
        guard()
        steady = turned_rad(before, after) < MOVED_RAD
        wrench = samples.wrench
        if most_swing_N is not None:
            wrench, amplitude = _without_swing(samples)
            steady = steady and bool(np.linalg.norm(amplitude[:3]) <= most_swing_N)
        if steady:
            steady = is_stationary(wrench) if quiet_std is None else is_quiet(wrench, quiet_std)
        # The last attempt is kept even if it is not steady, because a tour needs every pose. Its covariance is large.
        record = PoseRecord(stop, pose, before, after, samples, steady, attempt, swings=most_swing_N is not None)
        if steady:
            break
    return record


def _without_swing(samples: WrenchSamples) -> tuple[Array, Array]:
    return without_swing(samples.wrench, float(samples.t_host_ns[-1] - samples.t_host_ns[0]) * 1e-9)


def _collect_enough(sensor: Sensor, average_s: float) -> WrenchSamples:
    """Collect for `average_s` seconds; if that gives too few samples, repeat for longer."""
    for times in LONGER:
        samples = sensor.collect(times * average_s)
        if len(samples.wrench) >= LEAST_SAMPLES:
            return samples
    raise TooFewSamples(
        f"the sensor sent only {len(samples.wrench)} samples in {times * average_s} s, at least {LEAST_SAMPLES} are "
        "needed: check the sampling rate, or average longer"
    )


def turned_rad(before: ArmReading, after: ArmReading) -> float:
    """Return the angle between the flange orientations of two readings, rad."""
    change = before.R_base_flange.T @ after.R_base_flange
    sine = np.linalg.norm([change[2, 1] - change[1, 2], change[0, 2] - change[2, 0], change[1, 0] - change[0, 1]]) / 2
    return float(np.arctan2(sine, (np.trace(change) - 1) / 2))


def is_return(record: PoseRecord, records: Sequence[PoseRecord]) -> bool:
    """Return whether a record is the return to the first pose of its tour."""
    return record.stop != records[0].stop and record.pose.number == records[0].pose.number


def dataset_from(records: Sequence[PoseRecord], meta: Mapping[str, Any]) -> CalibrationDataset:
    """Return the dataset of a complete or aborted tour.

    The return to the first pose is left out; it is used by `drift_check`.
    """
    if not records:
        raise NotObservable("the run contains no pose: record poses first")
    poses = [record for record in records if not is_return(record, records)]
    t_ns = np.array([record.t_mid_ns for record in poses])
    return CalibrationDataset(
        R_base_flange=np.stack([record.before.R_base_flange for record in poses]),
        wrench=np.stack([record.mean.mean for record in poses]),
        wrench_cov=np.stack([record.mean.covariance for record in poses]),
        n_samples=np.array([len(record.samples.t_host_ns) for record in poses]),
        t_s=(t_ns - t_ns[0]) * 1e-9,
        meta=meta,
    )


def drift_check(records: Sequence[PoseRecord]) -> DriftCheck | None:
    """Return the change from the first pose to its repetition; None if the tour was aborted before the repetition."""
    if len(records) < 2 or not is_return(records[-1], records):
        return None
    first, last = records[0], records[-1]
    return DriftCheck(
        change=last.mean.mean - first.mean.mean,
        sigma=np.sqrt(np.diag(first.mean.covariance) + np.diag(last.mean.covariance)),
        elapsed_s=(last.t_mid_ns - first.t_mid_ns) * 1e-9,
    )
