"""The values of a compensated stream: blocks of samples, the frame they are given in, the stages applied, events.

`FrameTransform` turns a wrench to the axes and the point of a frame.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationResult
from ftcalib.display import Displayed
from ftcalib.files import JSON
from ftcalib.model import skew
from ftcalib.motion.model import HEIGHT
from ftcalib.rounding import with_sigma
from ftdrive.errors import ConfigError
from ftdrive.runs.calibration import EMULATED, marks_of
from ftdrive.runs.verification import VerificationRecord
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

    All interfaces and files take the settings from these fields; a default is a bool, None for a frequency, a number
    or a count, and False, None or 0 is off.

    Examples
    --------
    >>> import ftdrive
    >>> stages = ftdrive.Stages(lowpass_Hz=20.0)  # open_stream(…, stages=stages), or stream.stages = stages at any time
    >>> stages.bias, stages.gravity, stages.inertia
    (True, True, False)
    """

    bias: bool = field(default=True, metadata={"text": "Subtract the bias."})
    gravity: bool = field(default=True, metadata={"text": "Subtract the weight of the load."})
    inertia: bool = field(
        default=False, metadata={"text": "Subtract the inertial wrench of the load; needs [sensor] height_mm."}
    )
    """On by default where the calibration is one in motion."""
    notch_Hz: float | None = field(default=None, metadata={"text": "Frequency of the notch filter; 0 is off."})
    lowpass_Hz: float | None = field(default=None, metadata={"text": "Frequency of the low-pass filter; 0 is off."})
    deadband_N: float = field(default=0.0, metadata={"text": "Forces below it are 0."})
    deadband_Nm: float = field(default=0.0, metadata={"text": "Torques below it are 0."})


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
    """(6,) standard deviation of one sample of `wrench`, N and N·m, in `frame`: noise, calibration, and errors of the
    sensor under the present contact."""
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


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Sample(Displayed):
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
    filter of the sensor. A force that grows by less than 20 N in an hour counts as drift of the bias. In motion,
    inertia that is not subtracted counts as unknown, so a smaller contact is not found.
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


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Tracked(Displayed):
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


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class StreamInfo(Displayed):
    """What does not change while a stream runs with one calibration; every file and every client gets it."""

    result: CalibrationResult | None
    """The calibration; None of a sensor alone."""
    calibration_name: str
    """The file it was read from."""
    arm: DeviceInfo
    """Without a model of a sensor alone."""
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
    hour_change: Array | None = None
    """(6,) how far earlier runs of the sensor show its bias to move in an hour, one standard deviation, N and N·m."""

    @property
    def marks(self) -> tuple[str, ...]:
        """What every output says of the cell and the calibration, see `ftdrive.runs.calibration.MARKS`."""
        if self.result is None:
            return (EMULATED,) if self.emulated else ()
        return marks_of(self.result, emulated=self.emulated, foreign=self.foreign)

    @property
    def is_raw(self) -> bool:
        """Whether these are readings of a sensor alone, without arm and calibration."""
        return self.result is None

    @property
    def calibration(self) -> CalibrationResult:
        """The calibration; only a sensor alone has none, see `is_raw`. Raises `ConfigError` then."""
        if self.result is None:
            raise ConfigError("a sensor alone has no calibration: give --calibration PATH or --tool NAME")
        return self.result


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


class Links(NamedTuple):
    """The devices of a stream, or of the recording that replaces them."""

    sensor: LinkStatus
    arm: LinkStatus
    delay_s: float
    """Delay of the wrench after the pose."""
    delay_sigma_s: float
    """0 if the delay is configured."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class StreamStatus(Displayed):
    """The state of a stream beside its samples; the devices and the delay are those of `Links`."""

    sensor: LinkStatus
    arm: LinkStatus
    delay_s: float
    delay_sigma_s: float
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

    @property
    def failure(self) -> str:
        """Why a device is silent or has failed; empty while both deliver."""
        return self.sensor.error or self.arm.error


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


class FrameTransform:
    """Maps wrenches from sensor axes, about the sensor origin, to a frame.

    f' = R f and t' = R (t + p x f), with R the axes and p the sensor origin seen from the new point. Raises
    `ConfigError` if the frame needs a point that is not configured.
    """

    def __init__(self, frame: WrenchFrame, info: StreamInfo) -> None:
        # of a sensor alone only its own frame is known
        is_alone = info.is_raw and frame == WrenchFrame()
        R_flange_sensor = np.eye(3) if is_alone else info.calibration.R_flange_sensor
        lever_m = R_flange_sensor.T @ _sensor_from(frame, info)
        if frame.axes == "tcp":
            _require_tcp(info)
        # base axes: to flange axes here, the rest differs from sample to sample
        R_axes_flange = {"sensor": R_flange_sensor.T, "tcp": info.R_flange_tcp.T}.get(frame.axes, np.eye(3))
        R = R_axes_flange @ R_flange_sensor
        self._matrix = np.block([[R, np.zeros((3, 3))], [R @ skew(lever_m), R]])
        self._is_identity = frame.axes == "sensor" and frame.about == "sensor"
        self._turns = frame.axes == "base"

    def __call__(self, wrench: Array, R_base_flange: Array) -> Array:
        """Return wrenches (n, 6) in the frame; `R_base_flange` is (n, 3, 3)."""
        if self._is_identity:
            return wrench
        wrench = wrench @ self._matrix.T
        if not self._turns:
            return wrench
        return (wrench.reshape(-1, 2, 3) @ np.swapaxes(R_base_flange, 1, 2)).reshape(-1, 6)

    def matrix(self, R_base_flange: Array) -> Array:
        """Return the matrix (6, 6) of the transform at one orientation (3, 3)."""
        if not self._turns:
            return self._matrix
        return np.asarray((R_base_flange @ self._matrix.reshape(2, 3, 6)).reshape(6, 6))


def frames_in_flange(frame: WrenchFrame, info: StreamInfo, R_base_flange: Array) -> dict[str, tuple[Array, Array]]:
    """Return orientation and origin in the flange frame of sensor, tcp and the frame of a wrench, by their `frame_id`.

    The sensor is at the flange if its height is unknown. With base axes the orientation of the wrench's frame has the
    shape of `R_base_flange` (..., 3, 3).
    """
    sensor = info.calibration.R_flange_sensor, np.nan_to_num(info.p_flange_sensor_m)
    tcp = info.R_flange_tcp, info.p_flange_tcp_m
    found = {"sensor": sensor, "tcp": tcp} if np.isfinite(info.p_flange_tcp_m).all() else {"sensor": sensor}
    if (name := frame.id) not in ("base", "flange", *found):
        flange, base = (np.eye(3), np.zeros(3)), (np.swapaxes(R_base_flange, -1, -2), np.zeros(3))
        known = {"sensor": sensor, "flange": flange, "base": base, "tcp": tcp}
        origin = known[frame.about][1] if isinstance(frame.about, str) else np.array(frame.about)
        found[name] = known[frame.axes][0], np.nan_to_num(origin)
    return found


def gripping_point(info: StreamInfo) -> Array:
    """Return where the gripper holds parts, (3,) sensor frame: the TCP, or the tool's centre of mass without one."""
    p_flange_m = info.p_flange_tcp_m - info.p_flange_sensor_m
    if np.isfinite(p_flange_m).all() and info.p_flange_tcp_m.any():
        return np.asarray(info.calibration.R_flange_sensor.T @ p_flange_m)
    return info.calibration.p_sensor_com_m


def _sensor_from(frame: WrenchFrame, info: StreamInfo) -> Array:
    """Position of the sensor origin from the frame's point, in flange axes."""
    if frame.about == "sensor":
        return np.zeros(3)
    if not np.isfinite(info.p_flange_sensor_m).all():
        raise ConfigError(
            f"a torque {str(frame).partition(', ')[2]} needs the position of the sensor: set [sensor] height_mm, the "
            "height of its origin above the flange face, or choose --about sensor"
        )
    if frame.about == "tcp":
        _require_tcp(info)
    points = {"flange": np.zeros(3), "tcp": info.p_flange_tcp_m}
    point_m = points[frame.about] if isinstance(frame.about, str) else np.array(frame.about)
    return np.asarray(info.p_flange_sensor_m - point_m)


def _require_tcp(info: StreamInfo) -> None:
    if not np.isfinite(info.p_flange_tcp_m).all():
        raise ConfigError("the controller does not report its active TCP: choose another frame than tcp")


def quaternions(R: Array) -> Array:
    """Return unit quaternions x y z w (n, 4) of rotations (n, 3, 3)."""
    # to check them takes ten times as long
    return Rotation.from_matrix(R, assume_valid=True).as_quat()


def matrices(quat: Array) -> Array:
    """Return rotation matrices (n, 3, 3) of unit quaternions x y z w (n, 4)."""
    x, y, z, w = quat.T
    x2, y2, z2 = x + x, y + y, z + z
    xx, yy, zz = x * x2, y * y2, z * z2
    xy, xz, yz, wx, wy, wz = x * y2, x * z2, y * z2, w * x2, w * y2, w * z2
    columns = (1 - yy - zz, xy - wz, xz + wy, xy + wz, 1 - xx - zz, yz - wx, xz - wy, yz + wx, 1 - xx - yy)
    return np.stack(columns, axis=1).reshape(-1, 3, 3)


class Picked:
    """Picks at most `rate_Hz` samples a second, also across the limits of blocks: the first of each period.

    A sample is picked, never averaged: what is sent was measured. The low-pass stage of the stream limits aliasing.
    """

    def __init__(self, rate_Hz: float) -> None:
        self._period_ns = round(1e9 / rate_Hz)
        self._last = -1

    def rows(self, t_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which samples (n,) to send, by their times in the order of measurement."""
        period = t_ns // self._period_ns
        chosen = np.asarray(np.diff(period, prepend=self._last) != 0)
        if len(period):
            self._last = int(period[-1])
        return chosen
