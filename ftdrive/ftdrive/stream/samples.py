"""Data types of a compensated stream: blocks of samples with their frame and stages, events, and status.

`FrameTransform` transforms a wrench to the axes and reference point of a frame.
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
# The sensor height that a calibration in motion estimated is used if its sigma is smaller than this.
_KNOWN_HEIGHT_M = 3e-3


@dataclass(frozen=True, slots=True)
class WrenchFrame:
    """Axes and reference point of a wrench: a torque has no meaning without its reference point.

    Examples
    --------
    >>> import ftdrive
    >>> print(ftdrive.WrenchFrame("base", "tcp"))
    base axes, about the tcp origin
    """

    axes: Axes = "sensor"
    about: Point | tuple[float, float, float] = "sensor"
    """Reference point of the torque: the origin of a named frame, or a point (3,) in flange axes from the flange, m."""

    def __str__(self) -> str:
        if isinstance(self.about, str):
            point = "the flange" if self.about == "flange" else f"the {self.about} origin"
        else:
            point = "({:g}, {:g}, {:g}) mm from the flange".format(*(1e3 * x for x in self.about))
        return f"{self.axes} axes, about {point}"

    @property
    def id(self) -> str:
        """Name of the frame in messages: `sensor`, `base_at_tcp` `base_at_0_0_0.15_m` (from the flange origin)."""
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
    """Processing steps between raw and compensated wrench, in order of application. Raw samples are kept as well.

    All interfaces and files use these fields. False, None (for a frequency) or 0 switches a step off.

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
    """On by default with a calibration in motion."""
    notch_Hz: float | None = field(default=None, metadata={"text": "Frequency of the notch filter; 0 is off."})
    lowpass_Hz: float | None = field(default=None, metadata={"text": "Frequency of the low-pass filter; 0 is off."})
    deadband_N: float = field(default=0.0, metadata={"text": "Forces below this value become 0."})
    deadband_Nm: float = field(default=0.0, metadata={"text": "Torques below this value become 0."})


@dataclass(frozen=True, slots=True, eq=False)
class Paired(Columns):
    """n consecutive samples from the sensor, each with the arm's pose at the time of the sample."""

    t_host_ns: Ns
    """(n,) time of measurement on the cell's clock: smoothed, and corrected for the delay between the links."""
    t_device_s: Array
    """(n,) time on the sensor's own clock; NaN if it has none."""
    seq: Ns
    """(n,) sample numbers of the sensor; a missing number is a lost sample."""
    status: NDArray[np.uint32]
    """(n,) status word that the sensor sent with the sample."""
    raw: Array
    """(n, 6) wrench as measured, N and N·m, sensor axes, about the sensor origin."""
    q_rad: Array
    """(n, 6) joint angles, interpolated; NaN where unknown."""
    R_base_flange: Array
    """(n, 3, 3) orientation of the flange, interpolated."""
    p_base_flange_m: Array
    """(n, 3) position of the flange, interpolated; NaN where unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class Block(Paired):
    """Processed samples, all in one frame and with the same stages."""

    wrench: Array
    """(n, 6) wrench after all `stages`, N and N·m, in `frame`."""
    chi2: Array
    """(n,) squared Mahalanobis distance of the last 20 ms' mean from a free tool, known inertial wrench subtracted."""
    in_contact: NDArray[np.bool_]
    """(n,) whether in contact; see `Sample.in_contact`."""
    sigma: Array
    """(6,) standard deviation of the newest sample of `wrench`, N and N·m, in `frame`: noise, calibration, and errors
    of the sensor under the current contact."""
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
    """Time of the measurement, on the cell's clock."""
    force_N: Array
    torque_Nm: Array
    force_sigma_N: Array
    torque_sigma_Nm: Array
    raw: Array
    """(6,) wrench as measured, N and N·m, sensor axes, about the sensor origin."""
    in_contact: bool
    """Whether the tool is in contact: from three consecutive readings beyond the limit until three within it.

    A reading is the mean over 20 ms, so a contact begins after 40 to 60 ms. One reading of a free tool in a million
    exceeds the limit (`false_alarm_rate`). The limit follows the noise in the current state of motion, also with
    filtered sensors. A force that grows by less than 20 N within an hour is taken for drift of the bias. In motion,
    inertia that is not subtracted raises the limit, so smaller contacts are not detected."""
    frame: WrenchFrame


def mean_rate_Hz(t_ns: NDArray[np.int64]) -> float:
    """Return the mean rate, Hz, of samples that were measured at these times (n,), n >= 2."""
    return (len(t_ns) - 1) / max(float(t_ns[-1] - t_ns[0]) * 1e-9, 1e-9)


def sensor_origin_m(height_mm: float | None, calibration: CalibrationResult | None = None) -> Array:
    """Return the sensor's origin (3,), flange axes, m, for its height above the flange face; NaN if unknown.

    If no height is configured, the height from a calibration in motion is used if accurate.
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
    """An event at one time of a stream."""

    t_host_ns: int
    kind: EventKind
    text: str
    """One sentence for the user."""
    values: Mapping[str, JSON] = field(default_factory=dict)


Tracking = Literal["off", "show", "apply"]
"""Whether changes of the bias and a held part are tracked, and whether they are applied."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Tracked(Displayed):
    """Changes of the bias and the held part, tracked while the arm works.

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
    """(6,) standard deviation of `bias`; it grows while the bias cannot be observed."""
    part_kg: float
    """Mass of the part in the gripper."""
    part_sigma_kg: float
    part_known: bool
    """Whether the held part is known; during a contact or an undetermined new part, `part_kg` is that before it."""
    last_seen_s: float
    """Time since the last observation of the bias; infinite before the first."""
    walk_N: float
    """Estimated random walk of the force bias within an hour, one sigma."""
    moment: tuple[Array, Array]
    """The part's mass and mass times centre of mass (4,), kg and kg m, sensor axes, and their covariance (4, 4)."""
    events: tuple[StreamEvent, ...] = ()
    """Grasps, releases and contacts decided since the last update, with their start times."""

    def to_dict(self) -> dict[str, JSON]:
        """Return the tracked values as JSON; `last_seen_s` is None before the first observation."""
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
        """Return the bias and the part with their sigmas as one line."""
        force_N = float(np.linalg.norm(self.bias[:3]))
        sigma_N = float(np.linalg.norm(self.sigma[:3]) / np.sqrt(3))
        seen = f", seen {self.last_seen_s:.0f} s ago" if self.last_seen_s >= 1 else ""
        part = f"{with_sigma(self.part_kg, self.part_sigma_kg)} kg" if self.part_known else "not known yet"
        return f"bias {with_sigma(force_N, sigma_N)} N{seen}, part {part}"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class StreamInfo(Displayed):
    """Constant description of a stream with one calibration, for every file and client."""

    result: CalibrationResult | None
    """The calibration; None for a sensor alone."""
    calibration_name: str
    """File of the calibration."""
    arm: DeviceInfo
    """Arm; without a model for a sensor alone."""
    sensor: DeviceInfo
    tool: str
    utc_offset_ns: int
    """UTC minus the cell's clock: `t_host_ns + utc_offset_ns` is the time since 1970, UTC, in ns."""
    sensor_rate_Hz: float
    arm_rate_Hz: float
    p_flange_sensor_m: Array
    """(3,) origin of the sensor, flange axes, m, from the configuration, because gravity cannot determine it."""
    R_flange_tcp: Array
    """(3, 3) orientation of the TCP in the flange."""
    p_flange_tcp_m: Array
    """(3,) position of the TCP, flange axes, m."""
    versions: Mapping[str, str]
    verification: VerificationRecord | None = None
    """Last verification of the calibration before the stream was opened."""
    calibration_state: str = ""
    """Id, verdict, marks, age and last verification of the calibration when the stream was opened, as text."""
    emulated: bool = False
    """Whether the arm and the sensor are emulated."""
    foreign: bool = False
    """Whether the calibration belongs to another arm, sensor or mount and was applied with --force."""
    hour_change: Array | None = None
    """(6,) standard deviation of the change of the bias within an hour in earlier runs of the sensor, N and N·m."""

    @property
    def marks(self) -> tuple[str, ...]:
        """Marks of cell and calibration that every output shows, see `ftdrive.runs.calibration.MARKS`."""
        if self.result is None:
            return (EMULATED,) if self.emulated else ()
        return marks_of(self.result, emulated=self.emulated, foreign=self.foreign)

    @property
    def is_raw(self) -> bool:
        """Whether the stream has a sensor alone, without arm and calibration."""
        return self.result is None

    @property
    def calibration(self) -> CalibrationResult:
        """The calibration. Raises `ConfigError` for a sensor alone, which has none."""
        if self.result is None:
            raise ConfigError("a sensor alone has no calibration: give --calibration PATH or --tool NAME")
        return self.result


@dataclass(frozen=True, slots=True)
class LinkStatus:
    """Status of the connection to one device of the stream, sensor or arm."""

    rate_Hz: float
    """Rate of the device's samples over the last second."""
    nominal_rate_Hz: float
    lost: int
    age_s: float
    """Time since the newest sample of the device."""
    error: str = ""
    """Why no samples of the device arrive; empty while they do."""


class Links(NamedTuple):
    """Status of the devices of a stream, or of the recording that replaces them, and the delay between them."""

    sensor: LinkStatus
    arm: LinkStatus
    delay_s: float
    """Delay of the sensor's samples after the arm's poses."""
    delay_sigma_s: float
    """Standard deviation of `delay_s`; 0 if the delay is configured."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class StreamStatus(Displayed):
    """Status of a stream; for devices and delay see `Links`."""

    sensor: LinkStatus
    arm: LinkStatus
    delay_s: float
    delay_sigma_s: float
    tare: Array | None
    """(6,) change of the bias by tares, N and N·m, sensor axes; None without a tare."""
    tare_t_host_ns: int | None
    drift_N_h: float
    """Estimated drift rate of the force bias, norm."""
    drift_sigma_N_h: float
    contact_limit: float
    """Readings with a larger `Block.chi2` count towards a contact."""
    false_alarm_rate: float
    tracked: Tracked | None = None
    """Tracked bias and part; None unless the stream tracks them."""

    @property
    def failure(self) -> str:
        """Why no samples arrive from a device; empty while both devices send."""
        return self.sensor.error or self.arm.error


def find_gaps(rows: Paired, seq_before: int | None) -> list[StreamEvent]:
    """Return an event per gap in the sample numbers of rows; `seq_before` is the number of the sample before them."""
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

    f' = R f and t' = R (t + p x f), with rotation R and sensor origin p relative to the new reference point. Raises
    `ConfigError` if the frame needs a point that is not configured.
    """

    def __init__(self, frame: WrenchFrame, info: StreamInfo) -> None:
        # for a sensor alone, only the sensor frame is known
        is_alone = info.is_raw and frame == WrenchFrame()
        R_flange_sensor = np.eye(3) if is_alone else info.calibration.R_flange_sensor
        lever_m = R_flange_sensor.T @ _sensor_from(frame, info)
        if frame.axes == "tcp":
            _require_tcp(info)
        # for base axes, this matrix goes to flange axes, and `__call__` applies the rotation of each sample
        R_axes_flange = {"sensor": R_flange_sensor.T, "tcp": info.R_flange_tcp.T}.get(frame.axes, np.eye(3))
        R = R_axes_flange @ R_flange_sensor
        self._matrix = np.block([[R, np.zeros((3, 3))], [R @ skew(lever_m), R]])
        self._is_identity = frame.axes == "sensor" and frame.about == "sensor"
        self._turns = frame.axes == "base"

    def __call__(self, wrench: Array, R_base_flange: Array) -> Array:
        """Transform wrenches (n, 6) from sensor axes to the frame; `R_base_flange` is (n, 3, 3)."""
        if self._is_identity:
            return wrench
        wrench = wrench @ self._matrix.T
        if not self._turns:
            return wrench
        return (wrench.reshape(-1, 2, 3) @ np.swapaxes(R_base_flange, 1, 2)).reshape(-1, 6)

    def matrix(self, R_base_flange: Array) -> Array:
        """Return the matrix (6, 6) of the transform at one flange orientation (3, 3)."""
        if not self._turns:
            return self._matrix
        return np.asarray((R_base_flange @ self._matrix.reshape(2, 3, 6)).reshape(6, 6))


def frames_in_flange(frame: WrenchFrame, info: StreamInfo, R_base_flange: Array) -> dict[str, tuple[Array, Array]]:
    """Return, by `frame_id`, orientation and origin in the flange of: sensor, tcp and the frame of a wrench.

    If the sensor height is unknown, the sensor is placed at the flange. For base axes the orientation of the wrench
    frame has the shape of `R_base_flange` (..., 3, 3).
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
    """Return the point at which the gripper holds parts, (3,) sensor frame: the TCP, else the tool's centre of mass."""
    p_flange_m = info.p_flange_tcp_m - info.p_flange_sensor_m
    if np.isfinite(p_flange_m).all() and info.p_flange_tcp_m.any():
        return np.asarray(info.calibration.R_flange_sensor.T @ p_flange_m)
    return info.calibration.p_sensor_com_m


def _sensor_from(frame: WrenchFrame, info: StreamInfo) -> Array:
    """Return the sensor origin relative to the frame's reference point, in flange axes."""
    if frame.about == "sensor":
        return np.zeros(3)
    if not np.isfinite(info.p_flange_sensor_m).all():
        raise ConfigError(
            f"a torque {str(frame).partition(', ')[2]} needs the position of the sensor: set [sensor] height_mm, "
            "the height of its origin above the flange face, or choose --about sensor"
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
    # checking that the matrices are rotations would take ten times as long
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
    """Selects at most `rate_Hz` samples per second: the first of each period, also across blocks.

    Samples are not averaged, so every sent value was measured. The low-pass stage of the stream limits aliasing.
    """

    def __init__(self, rate_Hz: float) -> None:
        self._period_ns = round(1e9 / rate_Hz)
        self._last = -1

    def rows(self, t_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return a mask (n,) of the samples to send, from their times (n,) in order of measurement."""
        period = t_ns // self._period_ns
        chosen = np.asarray(np.diff(period, prepend=self._last) != 0)
        if len(period):
            self._last = int(period[-1])
        return chosen
