"""Weighing of the load in the gripper, from half a second of a stream at rest, or while the arm carries the load.

`Scale` weighs once; `Weighing` is a sink that weighs ten times per second.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Final, TypeVar, get_args

import numpy as np

from ftcalib.after import weighing
from ftcalib.after.weighing import Fault, Weight, drift_since
from ftcalib.data.dwell_mean import LEAST_SAMPLES, is_stationary, mean_and_covariance, restless_channels
from ftcalib.errors import AcceptanceError
from ftcalib.files import JSON
from ftcalib.model import angle_between
from ftcalib.rounding import counted, with_sigma
from ftdrive.errors import ConfigError, NotAccepted
from ftdrive.stream.free_tool import weight_of
from ftdrive.stream.noise import unexplained_variance
from ftdrive.stream.samples import Block, Paired, StreamEvent, StreamInfo, gripping_point
from ftdrive.stream.stages import TARE_S, is_still, try_tare
from ftdrive.stream.stream import Sink, Stream, pump
from ftdrivers.interfaces import Array

T = TypeVar("T")

WEIGH_S: Final = TARE_S
"""Averaging time of a weighing, s."""
PATIENCE_S = 10.0
"""Time-out of a zero or a single weighing, s."""
# Time between two weighings, each over the last half second, s.
_STEP_S = 0.1
# Correction for few samples: the variance of a mean that is estimated from n samples is increased by this over n.
_FEW: Final = 10.0
# A weighing in motion fails if the newest window of tracking is older than this, s.
_LATE_S: Final = 1.0
# A pose that differs from another by more than this angle, rad, adds information on the centre of mass.
_NEW_POSE_RAD: Final = 0.17
# Largest deviation of load / mass of one part from a whole number at which parts are counted.
_WHOLE: Final = 0.1

WORDS: Final[Mapping[str, str]] = {
    "samples": "too few samples: wait half a second",
    "moving": "the arm moves: weigh when it has rested for half a second",
    "unsteady": "the reading changes: wait until the part hangs still, and take your hands away",
    "contact": "a horizontal force, from a contact, a hand or a cable: free the part",
    "cable": "a torque that no weight in the gripper exerts, from a cable, hose or contact: let it hang free",
    "changed": "the poses do not agree on one weight: the part slipped, a cable pulls or the load has changed",
    "lifted": "less than the empty tool: contact from below, or the gripper was not empty at the zero; zero again",
    "not-empty": "the reading is too far from that of the empty tool for a zero: empty the gripper, or calibrate again",
    "undecided": "a contact, or a load that is not determined yet: let the arm carry it freely for about 2 s",
    "count": "not a whole number of parts: check the mass of one part, and the gripper",
}
"""Reason and remedy for each `CannotWeigh.code`."""
_FAULTS: Final = *get_args(Fault), "count"


class CannotWeigh(AcceptanceError):
    """Raised when the reading cannot be weighed: it does not correspond to one weight at rest.

    `code` is a key of `WORDS`. `weight` is the weight fitted to a reading at rest in spite of the fault.

    Examples
    --------
    >>> print(CannotWeigh("moving"))
    not weighed: the arm moves: weigh when it has rested for half a second
    """

    def __init__(self, code: str, weight: Weight | None = None) -> None:
        super().__init__(f"not weighed: {WORDS[code]}")
        self.code = code
        self.weight = weight


class Scale:
    """Weighs the load in the gripper of a stream beyond its calibrated tool.

    The reference is the calibration or the last tare of the stream. A recent tare gives the smallest error.
    """

    def __init__(self, stream: Stream) -> None:
        self._stream = stream
        self._readings: list[tuple[Array, Array, Array]] = []
        # Smallest noise estimate at rest so far, because a step of the load increases the estimate for a while.
        self._quietest = np.full(6, np.inf)

    def weigh(self, since_ns: int = 0, *, more: bool = False) -> Weight:
        """Weigh over the last half second, all after `since_ns` on the cell's clock; `more` adds earlier poses.

        Earlier poses must have been taken with the same load. Raises `CannotWeigh` if the arm or the reading is not at
        rest, or the reading does not correspond to one weight.
        """
        stream = self._stream
        reading = self._rest(since_ns)
        kept = [one for one in self._readings if angle_between(one[0], reading[0]) > _NEW_POSE_RAD] if more else []
        self._readings = [*kept, reading]
        reference, since_s = stream.processor.monitor.reference()
        calibration = stream.info.calibration
        contact = calibration.known_contact
        R_base_flange, wrench, noise = self.poses
        weight = weighing.weigh_load(
            reference,
            R_base_flange,
            wrench,
            noise + np.diag(unexplained_variance(calibration)),
            drift=drift_since(since_s),
            g_m_s2=calibration.g_m_s2,
            p_sensor_near_m=gripping_point(stream.info),
            orientation_sigma_rad=calibration.components.get("rotation_rad", 0.0),
            contact=contact,
        )
        if contact is None:
            weight = replace(weight, scale_sigma=calibration.scale_sigma)
        if weight.fault is not None:
            raise CannotWeigh(weight.fault, weight)
        return weight

    @property
    def poses(self) -> tuple[Array, Array, Array]:
        """R_base_flange (n, 3, 3), means (n, 6) and covariances (n, 6, 6) of the poses of the last weighing."""
        R_base_flange, means, covariances = map(np.array, zip(*self._readings, strict=True))
        return R_base_flange, means, covariances

    def zero(self, since_ns: int = 0) -> StreamEvent:
        """Tare the empty gripper over the last half second, which removes the drift of the bias so far.

        Raises `CannotWeigh` if arm or reading is not at rest, or differs too much from the reading of the empty tool.
        """
        self._rest(since_ns)
        # A zero is refused whenever a tare is, because otherwise the contact wrench would keep the old bias.
        event = self._stream.tare()
        if event.kind != "tare":
            raise CannotWeigh("not-empty")
        self._readings = []
        return event

    def warm_up(self) -> None:
        """Run the computations of a weighing and a zero once, because the first run takes ten times as long."""
        rows = self._stream.processor.recent()
        if rows is not None and len(rows) >= LEAST_SAMPLES:
            try_tare(rows, self._stream.processor.monitor.reference()[0])
            with suppress(CannotWeigh):
                self.weigh()

    def _rest(self, since_ns: int) -> tuple[Array, Array, Array]:
        processor = self._stream.processor
        if (rows := processor.recent()) is None:
            raise CannotWeigh("samples")
        rows = rows.rows(rows.t_host_ns >= max(since_ns, int(rows.t_host_ns[-1]) - round(WEIGH_S * 1e9)))
        if processor.rest_sigma is not None:
            self._quietest = np.minimum(self._quietest, processor.rest_sigma)
        return _reading(rows, self._quietest)


def _reading(rows: Paired, rest_sigma: Array) -> tuple[Array, Array, Array]:
    """Return R_base_flange (3, 3), mean (6,) and its covariance (6, 6); raises `CannotWeigh` unless at rest."""
    if len(rows) < LEAST_SAMPLES or rows.t_host_ns[-1] - rows.t_host_ns[0] < 0.95e9 * WEIGH_S:
        raise CannotWeigh("samples")
    if not is_still(rows):
        raise CannotWeigh("moving")
    if not is_stationary(rows.raw) or restless_channels(rows.raw, rest_sigma).any():
        raise CannotWeigh("unsteady")
    dwell = mean_and_covariance(rows.raw)
    return rows.R_base_flange[-1], dwell.mean, dwell.covariance * (1 + _FEW / len(rows))


def weigh_in_motion(stream: Stream, since_ns: int = 0) -> Weight:
    """Weigh the load that the arm carries, tracked by the stream since `since_ns` on the cell's clock.

    Raises `CannotWeigh` during a contact, while the load is undetermined or without samples, and `ConfigError` if the
    stream does not track the load.
    """
    if stream.track == "off":
        raise ConfigError('the stream does not track the load: open it with track="show" to weigh in motion')
    rows, tracked = stream.processor.recent(), stream.processor.monitor.tracked
    if rows is None or tracked is None or not np.isfinite(tracked.last_seen_s):
        # the first windows assume an empty gripper
        raise CannotWeigh("samples")
    if round(1e9 * tracked.t_s) < max(since_ns, int(rows.t_host_ns[-1]) - round(1e9 * _LATE_S)):
        raise CannotWeigh("samples")
    if not tracked.part_known:
        raise CannotWeigh("undecided")
    return weight_of(tracked, stream.info.calibration)


def weigh(stream: Stream, *, poses: int = 1, moving: bool = False, timeout_s: float = 10.0) -> Weight:
    """Wait until the arm and the reading are at rest, then weigh the load in the gripper beyond its calibrated tool.

    Call `stream.tare()` with the empty gripper just before it grasps, to remove the drift of the bias.

    Parameters
    ----------
    stream : Stream
        An open stream, which this function reads.
    poses : int
        One pose gives the mass, and the centre of mass except along gravity. For two or more, another program must turn
        the arm; each rest at least 10° from the others is used.
    moving : bool
        Weigh while the arm moves, from the tracked load. The stream must be opened with `track` while the gripper is
        empty. `poses` is ignored.
    timeout_s : float
        Time-out per pose, s.

    Returns
    -------
    Weight
        The weight, with `mass_kg`, `mass_sigma_kg`, `least_kg`, `p_sensor_com_m`, `com_covariance`, `line`.

    Raises
    ------
    CannotWeigh
        No weighing succeeded in this time; `code` is the reason of the last attempt.
    ConfigError
        With `moving`, the stream does not track the load.
    DeviceError
        The stream has failed.

    Examples
    --------
    >>> import ftdrive
    >>> with ftdrive.open_stream(simulate=True) as stream:
    ...     weight = ftdrive.weigh(stream)
    >>> weight.mass_kg < weight.least_kg  # the gripper is empty
    True
    """
    scale, weight = Scale(stream), None

    def attempt(since_ns: int) -> Weight:
        if moving:
            return weigh_in_motion(stream, since_ns)
        found = scale.weigh(since_ns, more=True)
        if weight is not None and found.poses <= weight.poses:
            raise CannotWeigh("moving")
        return found

    while weight is None or (weight.poses < poses and not moving):
        weight = first_success(stream, attempt, timeout_s)
    return weight


def first_success(stream: Stream, attempt: Callable[[int], T], timeout_s: float) -> T:
    """Read a stream until `attempt`, called with the time of the first sample, succeeds; return its result.

    After the time-out, raise the last `CannotWeigh` of `attempt`.
    """
    end_s, refusal, since_ns = stream.clock.now_s() + timeout_s, CannotWeigh("samples"), 0
    for block in pump(stream, until=lambda: stream.clock.now_s() > end_s, patience_s=0.0):
        try:
            if block:
                since_ns = since_ns or int(block.t_host_ns[-1])
                return attempt(since_ns)
        except CannotWeigh as error:
            refusal = error
    raise refusal


def load_values(weight: Weight, info: StreamInfo) -> dict[str, JSON]:
    """Return a weight as JSON, in sensor and flange axes; unknown values are None."""
    R = info.calibration.R_flange_sensor
    known = weight.is_something
    p_flange_m = info.p_flange_sensor_m + R @ weight.p_sensor_com_m
    C_flange = R @ weight.com_covariance @ R.T
    placed = known and bool(np.isfinite(p_flange_m).all())
    return {
        "mass_kg": weight.mass_kg,
        "mass_sigma_kg": weight.mass_sigma_kg,
        "scale_sigma": weight.scale_sigma,
        "least_kg": weight.least_kg,
        "is_something": known,
        "p_sensor_com_m": weight.p_sensor_com_m.tolist() if known else None,
        "p_sensor_com_sigma_m": weight.com_sigma_m.tolist() if known else None,
        "p_flange_com_m": p_flange_m.tolist() if placed else None,
        "p_flange_com_sigma_m": np.sqrt(np.diag(C_flange)).tolist() if placed else None,
        "line_sensor": weight.line.tolist() if known and weight.line is not None else None,
        "poses": weight.poses,
        "in_motion": weight.in_motion,
        "fault": weight.fault,
    }


def count_of(weight: Weight, part_kg: float) -> int:
    """Return how many parts of `part_kg` are held. Raises `CannotWeigh` if that is no whole number or uncertain."""
    parts = weight.mass_kg / part_kg
    whole = round(parts)
    sigma = float(np.hypot(weight.mass_sigma_kg, weight.scale_sigma * weight.mass_kg)) / part_kg
    if sigma > _WHOLE or abs(parts - whole) > max(_WHOLE, 2 * sigma):
        raise CannotWeigh("count", weight)
    return whole


@dataclass(frozen=True, slots=True)
class ScaleState:
    """What the scale shows now: a weight, or why there is none."""

    weight: Weight | None
    refusal: str | None
    """Why the load is not weighed, as a key of `WORDS`, or None. With faults such as "contact" `weight` is set too."""
    count: int | None = None
    stale: str = ""

    @property
    def measured(self) -> Weight | None:
        """The weight to show; None if weighing failed. If only the count of parts failed, the weight is shown."""
        return self.weight if self.refusal in {None, "count"} else None


class Weighing(Sink):
    """Weighs the load in the gripper of a stream ten times per second, and zeroes on request.

    `joins` combines the poses of one load, `moving` weighs in motion, and `part_kg` is the mass of one part to count.
    `keep` receives each new weight or fault, see `WeighingLog.keep`.
    """

    label, keeps_all = "scale", True
    shown = ScaleState(None, "samples")
    is_new = False
    """Whether a new weight, or a fault that lasts, was found with the last block."""
    note = ""
    """Sentence on the last requested zero: waiting, done or refused."""
    refusal: NotAccepted | None = None
    """Error that says why the last requested zero was refused; None if it was not."""

    def __init__(
        self,
        stream: Stream,
        *,
        joins: bool,
        part_kg: float | None,
        moving: bool = False,
        keep: Callable[[Mapping[str, JSON]], object] = lambda _: None,
    ) -> None:
        self.stream, self.part_kg, self.joins, self.moving = stream, part_kg, joins, moving
        self._scale, self._keep = Scale(stream), keep
        # Weight of the current load; None if nothing has been weighed since the reading came to rest.
        self._last: Weight | None = None
        self._due_s = stream.clock.now_s() + _STEP_S
        # Time of a pending zero request on the cell's clock; None without one. Another thread sets it.
        self._zero_ns: int | None = None
        self._fault: str | None = None
        self._fault_since_s = 0.0

    @property
    def is_zeroing(self) -> bool:
        """Whether a requested zero is pending."""
        return self._zero_ns is not None

    def request_zero(self) -> None:
        """Request a tare of the empty gripper, done by the reading thread after half a second at rest."""
        self.note, self.refusal = "zero: waiting for half a second at rest …", None
        self._zero_ns = self.stream.clock.now_ns()

    def add(self, block: Block | None, _events: Sequence[StreamEvent]) -> None:
        """Weigh, or zero if requested, once per 0.1 s; during a device failure show why."""
        now_s, zero_ns, self.is_new = self.stream.clock.now_s(), self._zero_ns, False
        if block is None:
            self._last = None
            self.shown = ScaleState(None, None, stale=self.stream.status().failure)
        elif now_s < self._due_s:
            return
        elif zero_ns is not None:
            # during a zero an earlier weight would look current
            self.shown = ScaleState(None, "samples")
            self._zero(zero_ns)
        else:
            self.shown = self._weighed()
            self.is_new = self._is_new(self.shown, now_s)
        self._due_s = self.stream.clock.now_s() + _STEP_S

    def _zero(self, since_ns: int) -> None:
        try:
            self._scale.zero(since_ns)
        except CannotWeigh as refusal:
            if refusal.code != "not-empty" and self.stream.clock.now_ns() <= since_ns + 1e9 * PATIENCE_S:
                return
            self.refusal = NotAccepted(f"zero refused: {WORDS[refusal.code]}")
        else:
            self._last = None
        # clear the request first, because the operator may make another one now
        self._zero_ns = None
        self.note = "zero: the empty gripper was tared" if self.refusal is None else str(self.refusal)

    def _weighed(self) -> ScaleState:
        try:
            weight = weigh_in_motion(self.stream) if self.moving else self._scale.weigh(more=self.joins)
            return ScaleState(weight, None, None if self.part_kg is None else count_of(weight, self.part_kg))
        except CannotWeigh as refusal:
            # after these refusals the load may still be the same, so it is not weighed as a new one
            if refusal.code not in ("unsteady", "samples"):
                self._last = None
            return ScaleState(refusal.weight, refusal.code)

    def _is_new(self, shown: ScaleState, now_s: float) -> bool:
        """Pass a new weight, or once a fault that lasts, to `keep`; return whether there was one of the two."""
        if shown.refusal != self._fault:
            self._fault, self._fault_since_s = shown.refusal, now_s
        if shown.refusal in _FAULTS and now_s - self._fault_since_s > WEIGH_S:
            self._fault_since_s = float("inf")
            self._keep({"refused": shown.refusal})
            return True
        weight, last = shown.weight, self._last
        if weight is None or shown.refusal is not None:
            return False
        if last is not None:
            is_same = abs(weight.mass_kg - last.mass_kg) < weight.least_kg
            if is_same and weight.poses == last.poses:
                return False
            if not is_same:
                self._scale = Scale(self.stream)
        self._last = weight
        values = load_values(weight, self.stream.info) | {"count": shown.count}
        self.stream.processor.note("load", format_scale(shown), values)
        self._keep(values)
        return True

    def given_up(self, shown: ScaleState) -> CannotWeigh:
        """Return the error for a single weighing that did not succeed within `PATIENCE_S`."""
        code = shown.refusal or "samples"
        # faults were passed to `keep` when they occurred
        if code not in _FAULTS:
            self._keep({"refused": code})
        return CannotWeigh(code, shown.weight)


def format_scale(shown: ScaleState) -> str:
    """Return the state of the scale as one line for the screen."""
    if shown.stale:
        return f"stale: {shown.stale}"
    if shown.refusal is not None:
        return f"not weighed: {WORDS[shown.refusal]}"
    weight = shown.weight
    assert weight is not None  # noqa: S101 - without a refusal there is a weight
    if not weight.is_something:
        return f"nothing: {with_sigma(weight.mass_kg, weight.mass_sigma_kg)} kg, less than {weight.least_kg:.2g} kg"
    parts = "" if shown.count is None else f"{counted(shown.count, 'part')}, "
    com, mass = ", ".join(weight.com_in_words), with_sigma(weight.mass_kg, weight.mass_sigma_kg)
    return f"{parts}{mass} kg at ({com}) mm from the sensor origin"
