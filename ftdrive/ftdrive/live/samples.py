"""The values of a compensated stream: blocks of samples, the frame they are given in, the stages applied, events."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from ftcalib import CalibrationResult
from ftcalib.files import JSON
from ftcalib.motion.model import HEIGHT
from ftcalib.rounding import with_sigma
from ftdrive.runs.verification_record import VerificationRecord, marks_of
from ftdrivers.interfaces import Array, Columns, DeviceInfo

Axes = Literal["sensor", "flange", "base", "tcp"]
Point = Literal["sensor", "flange", "tcp"]
Ns = NDArray[np.int64]
# One sigma.
_KNOWN_HEIGHT_M = 3e-3


@dataclass(frozen=True, slots=True)
class WrenchFrame:
    """Axes and reference point of a wrench, which belong together: a torque without its point means nothing.

    Examples
    --------
    >>> import ftdrive
    >>> print(ftdrive.WrenchFrame("base", "tcp"))
    base axes, about the tcp origin
    """

    axes: Axes = "sensor"
    about: Point | tuple[float, float, float] = "sensor"
    """The origin of a frame, or a point in flange axes from the flange, m."""

    def __str__(self) -> str:
        if isinstance(self.about, str):
            point = "the flange" if self.about == "flange" else f"the {self.about} origin"
        else:
            point = "({:g}, {:g}, {:g}) mm from the flange".format(*(1e3 * x for x in self.about))
        return f"{self.axes} axes, about {point}"

    @property
    def id(self) -> str:
        """Name in messages: `sensor`, `base_at_tcp` or `base_at_0_0_0.15_m` (a point from the flange)."""
        if self.axes == self.about:
            return self.axes
        if isinstance(self.about, str):
            return f"{self.axes}_at_{self.about}"
        return f"{self.axes}_at_{'_'.join(f'{x:g}' for x in self.about)}_m"

    def to_dict(self) -> dict[str, JSON]:
        """Return the fields as JSON; a point is a list."""
        return {"axes": self.axes, "about": self.about if isinstance(self.about, str) else list(self.about)}


@dataclass(frozen=True, slots=True)
class Stages:
    """What is done to the raw wrench, in this order. Raw samples are always kept beside the result.

    Examples
    --------
    >>> import ftdrive
    >>> stages = ftdrive.Stages(lowpass_Hz=20.0)  # open_stream(…, stages=stages), or stream.stages = stages at any time
    >>> stages.bias, stages.gravity, stages.inertia
    (True, True, False)
    """

    bias: bool = True
    gravity: bool = True
    inertia: bool = False
    """Subtract the inertial wrench of the load; on by default where the calibration is one in motion."""
    notch_Hz: float | None = None
    lowpass_Hz: float | None = None
    deadband_N: float = 0.0
    deadband_Nm: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Paired(Columns):
    """n consecutive samples of the sensor, each with the pose at its time."""

    t_host_ns: Ns
    """(n,) time of the measurement on the clock of the cell: smoothed, and free of the delay between the links."""
    t_device_s: Array
    """(n,) the sensor's own clock; NaN where it has none."""
    seq: Ns
    """(n,) the sensor's sample numbers; a missing one is a lost sample."""
    status: NDArray[np.uint32]
    """(n,) the sensor's status word."""
    raw: Array
    """(n, 6) as measured, N and N·m, sensor axes, about the sensor origin."""
    q_rad: Array
    """(n, 6) joint angles, interpolated; NaN where unknown."""
    R_base_flange: Array
    """(n, 3, 3) interpolated."""
    p_base_flange_m: Array
    """(n, 3) interpolated; NaN where unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class Block(Paired):
    """Paired samples after processing, all in one frame and with the same stages; sigma is that of the newest."""

    wrench: Array
    """(n, 6) after `stages`, N and N·m, in `frame`."""
    chi2: Array
    """(n,) squared Mahalanobis distance of the last 20 ms from a free tool, beyond what motion explains."""
    in_contact: NDArray[np.bool_]
    """(n,) see `Sample`."""
    sigma: Array
    """(6,) standard deviation of one sample of `wrench`: noise and calibration, N and N·m, in `frame`."""
    frame: WrenchFrame
    stages: Stages

    _COMMON: ClassVar = frozenset({"sigma", "frame", "stages"})

    def __iter__(self) -> Iterator["Sample"]:
        force_sigma, torque_sigma = self.sigma[:3], self.sigma[3:]
        for i, t_ns in enumerate(self.t_host_ns.tolist()):
            yield Sample(
                t_s=t_ns * 1e-9,
                force_N=self.wrench[i, :3],
                torque_Nm=self.wrench[i, 3:],
                force_sigma_N=force_sigma,
                torque_sigma_Nm=torque_sigma,
                raw=self.raw[i],
                in_contact=bool(self.in_contact[i]),
                frame=self.frame,
            )


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One compensated sample."""

    t_s: float
    """On the clock of the cell."""
    force_N: Array
    torque_Nm: Array
    force_sigma_N: Array
    torque_sigma_Nm: Array
    raw: Array
    """(6,) as measured, sensor axes, about the sensor origin."""
    in_contact: bool
    """Whether three readings in a row exceed the limit; it ends when three do not.

    A reading is the mean over 20 ms, so a contact begins after 40 to 60 ms. One reading of a free tool in a million
    exceeds the limit (`false_alarm_rate`). The limit follows the noise in the present state of motion, also behind a
    filter of the sensor. At rest, a force that grows by less than the limit in 2 s counts as drift, up to 0.5 N and
    15 mN·m. In motion, inertia that is not subtracted counts as unknown, so a smaller contact is not found.
    """
    frame: WrenchFrame


def mean_rate_Hz(t_ns: NDArray[np.int64]) -> float:
    """Return the mean rate of samples at these times (n,), n >= 2."""
    return (len(t_ns) - 1) / max(float(t_ns[-1] - t_ns[0]) * 1e-9, 1e-9)


def sensor_origin_m(height_mm: float | None, calibration: CalibrationResult | None = None) -> Array:
    """Return `p_flange_sensor_m` (3,) of a sensor whose origin is so high above the flange face; NaN where unknown.

    A calibration in motion that knows the height well replaces one that is not configured.
    """
    motion = None if calibration is None else calibration.motion
    if height_mm is None and motion is not None and float(motion.covariance[HEIGHT, HEIGHT]) < _KNOWN_HEIGHT_M**2:
        height_mm = 1e3 * motion.height_m
    return np.full(3, np.nan) if height_mm is None else np.array([0.0, 0.0, height_mm / 1e3])


EventKind = Literal[
    "contact",
    "tare",
    "tare-refused",
    "tare-undone",
    "stages",
    "frame",
    "drift",
    "gap",
    "delay",
    "stale",
    "recovered",
    "tool",
    "load",
    "load-step",
    "tracked",
    "temperature",
    "mark",
]


@dataclass(frozen=True, slots=True)
class StreamEvent:
    """Something that happened at one moment of a stream."""

    t_host_ns: int
    kind: EventKind
    text: str
    """One sentence for people."""
    values: Mapping[str, JSON] = field(default_factory=dict)


Tracking = Literal["off", "show", "apply"]
"""Whether bias and held part are followed beside the calibration, and whether they are applied."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """Bias and held part, as followed while the arm works.

    Examples
    --------
    >>> import ftdrive
    >>> with ftdrive.open_stream(simulate=True, track="show") as stream:
    ...     while (tracked := stream.status().tracked) is None:
    ...         block = stream.read()
    >>> tracked.bias.shape, tracked.part_kg
    ((6,), 0.0)
    """

    t_s: float
    bias: Array
    """(6,) change of the bias since the calibration, N and N·m, sensor axes."""
    sigma: Array
    """(6,) one standard deviation; it grows while the bias cannot be seen."""
    part_kg: float
    """Mass that is held beside the tool."""
    part_sigma_kg: float
    part_known: bool
    """Whether the load is decided; else a contact or a new part is not yet, and the part is that before."""
    last_seen_s: float
    """Since the bias was seen; infinite before the first time."""
    walk_N: float
    """Random walk of the force bias in an hour, one sigma, as learnt."""
    moment: tuple[Array, Array]
    """Mass and mass times centre of mass of the part (4,), kg and kg m, sensor axes, and their covariance."""
    events: tuple[StreamEvent, ...] = ()
    """Grasps, releases and contacts that were decided since the last update, at the time of their begin."""

    def to_dict(self) -> dict[str, JSON]:
        """Return what is followed as JSON; the age of the last look is None before the first."""
        return {
            "bias": self.bias.tolist(),
            "sigma": self.sigma.tolist(),
            "part_kg": self.part_kg,
            "part_sigma_kg": self.part_sigma_kg,
            "part_known": self.part_known,
            "last_seen_s": self.last_seen_s if np.isfinite(self.last_seen_s) else None,
            "walk_N": self.walk_N,
        }

    def in_words(self) -> str:
        """Return size and sigma of the bias and the part, as one line."""
        force_N = float(np.linalg.norm(self.bias[:3]))
        sigma_N = float(np.linalg.norm(self.sigma[:3]) / np.sqrt(3))
        seen = f", seen {self.last_seen_s:.0f} s ago" if self.last_seen_s >= 1 else ""
        part = f"{with_sigma(self.part_kg, self.part_sigma_kg)} kg" if self.part_known else "not known yet"
        return f"bias {with_sigma(force_N, sigma_N)} N{seen}, part {part}"


@dataclass(frozen=True, slots=True, eq=False)
class StreamInfo:
    """What does not change while a stream runs with one calibration; every file and every client gets it."""

    calibration: CalibrationResult
    calibration_name: str
    """The file it was read from."""
    arm: DeviceInfo
    sensor: DeviceInfo
    tool: str
    utc_offset_ns: int
    """UTC minus the clock of the cell: `t_host_ns + utc_offset_ns` is nanoseconds since 1970."""
    sensor_rate_Hz: float
    arm_rate_Hz: float
    p_flange_sensor_m: Array
    """(3,) origin of the sensor, configured: gravity cannot identify it."""
    R_flange_tcp: Array
    """(3, 3)"""
    p_flange_tcp_m: Array
    """(3,)"""
    versions: Mapping[str, str]
    verification: VerificationRecord | None = None
    """The last one of the calibration, when the stream was opened."""
    calibration_state: str = ""
    """Id, verdict, marks, age and last verification of the calibration, when the stream was opened; for people."""
    emulated: bool = False
    """Whether arm and sensor are emulated."""
    foreign: bool = False
    """Whether the calibration is of another arm, sensor or mount, and was applied all the same."""

    @property
    def marks(self) -> tuple[str, ...]:
        """What every output says of the cell and the calibration, see `ftdrive.runs.verification_record.MARKS`."""
        return marks_of(self.calibration, emulated=self.emulated, foreign=self.foreign)


@dataclass(frozen=True, slots=True)
class LinkStatus:
    """One device of the stream."""

    rate_Hz: float
    """Over the last second."""
    nominal_rate_Hz: float
    lost: int
    age_s: float
    """Since its newest sample."""
    error: str = ""
    """Why it is silent or has failed; empty while it delivers."""


@dataclass(frozen=True, slots=True, eq=False)
class StreamStatus:
    """The state of a stream beside its samples."""

    sensor: LinkStatus
    arm: LinkStatus
    delay_s: float
    """Delay of the wrench after the pose."""
    delay_sigma_s: float
    """0 if the delay is configured."""
    tare: Array | None
    """(6,) what was subtracted from the bias, N and N·m, sensor axes; None without a tare."""
    tare_t_host_ns: int | None
    drift_N_h: float
    """Drift of the force bias while nothing touches the tool."""
    drift_sigma_N_h: float
    contact_limit: float
    """Limit of `Block.chi2`."""
    false_alarm_rate: float
    tracked: Tracked | None = None
    """Bias and held part beside the calibration; None unless the stream follows them."""


def find_gaps(rows: Paired, seq_before: int | None) -> list[StreamEvent]:
    """Return an event for each gap in the sample numbers; `seq_before` is that of the sample before these."""
    before = int(rows.seq[0]) - 1 if seq_before is None else seq_before
    if int(rows.seq[-1]) - before == len(rows):
        return []
    events = []
    missing = np.diff(rows.seq, prepend=before) - 1
    for i in np.flatnonzero(missing > 0):
        lost, seq = int(missing[i]), int(rows.seq[i])
        text = f"{lost} sample{'s' if lost > 1 else ''} lost before sample {seq}"
        events.append(StreamEvent(int(rows.t_host_ns[i]), "gap", text, {"lost": lost, "seq": seq}))
    return events
