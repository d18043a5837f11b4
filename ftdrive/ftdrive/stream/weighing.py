"""Weigh what the gripper holds, from half a second of a stream at rest, or while the arm carries it.

`Scale` weighs once, `Weighing` is a sink that weighs ten times a second.
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
"""A weighing averages so long."""
PATIENCE_S = 10.0
"""So long a zero, or the only weight, may take."""
# Between two weighings, each of the last half second.
_STEP_S = 0.1
# The variance of a mean comes from its own samples. With n of them it is raised by this over n.
_FEW: Final = 10.0
# In motion the last window may be so old.
_LATE_S: Final = 1.0
# Poses farther apart than this show more of the centre of mass.
_NEW_POSE_RAD: Final = 0.17
# So far from a whole number of parts is no number of parts.
_WHOLE: Final = 0.1

WORDS: Final[Mapping[str, str]] = {
    "samples": "too few samples: wait half a second",
    "moving": "the arm moves: weigh when it has rested for half a second",
    "unsteady": "the reading changes: wait until the part hangs still, and take hands away",
    "contact": "a force across gravity: contact, hand or cable; free the part",
    "cable": "a torque that no weight in the gripper exerts: cable, hose or contact; let it hang free",
    "changed": "the poses do not agree on one weight: the part slipped, a cable pulls, or the load has changed",
    "lifted": "less than the empty tool: contact from below, or the gripper was not empty at the zero",
    "not-empty": "the reading is too far from that of the empty tool for a zero: empty the gripper, or calibrate again",
    "undecided": "a contact, or a load that is not decided yet: let the arm carry it freely for about 2 s",
    "count": "no whole number of parts: check the mass of one part, and the gripper",
}
"""Why nothing was weighed, and what to do, by `CannotWeigh.code`."""
_FAULTS: Final = *get_args(Fault), "count"


class CannotWeigh(AcceptanceError):
    """The reading is not that of one weight at rest.

    `code` is one of `WORDS`, and `weight` is what was found all the same, of a reading at rest.

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
    """Weighs what the gripper of a stream holds beyond its calibrated tool.

    The reference is the calibration, or the last tare of the stream, which is the better the younger it is.
    """

    def __init__(self, stream: Stream) -> None:
        self._stream = stream
        self._readings: list[tuple[Array, Array, Array]] = []
        # Noise of a sample at rest: steps of the load make it look louder for a while.
        self._quietest = np.full(6, np.inf)

    def weigh(self, since_ns: int = 0, *, more: bool = False) -> Weight:
        """Weigh the last half second from `since_ns` on, clock of the cell; `more` joins the poses before of one load.

        Raises `CannotWeigh` if arm or reading is not at rest, or the reading is not that of one weight.
        """
        stream = self._stream
        reading = self._rest(since_ns)
        kept = [one for one in self._readings if angle_between(one[0], reading[0]) > _NEW_POSE_RAD] if more else []
        self._readings = [*kept, reading]
        reference, since_s = stream.processor.monitor.reference()
        calibration = stream.info.calibration
        contact = calibration.known_contact
        R_base_flange, wrench, noise = self.poses
        weight = weighing.weigh(
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
        """R_base_flange (n, 3, 3), means (n, 6) and covariances (n, 6, 6) of the poses that were joined last."""
        R_base_flange, means, covariances = map(np.array, zip(*self._readings, strict=True))
        return R_base_flange, means, covariances

    def zero(self, since_ns: int = 0) -> StreamEvent:
        """Tare the empty gripper by the last half second: the drift of the bias up to now is no error any more.

        Raises `CannotWeigh` if arm or reading is not at rest, or the reading is too far from that of the empty tool.
        """
        self._rest(since_ns)
        # A zero is a tare, so it is refused where a tare is: else the contact wrench would keep the old bias.
        event = self._stream.tare()
        if event.kind != "tare":
            raise CannotWeigh("not-empty")
        self._readings = []
        return event

    def warm_up(self) -> None:
        """Compute once what a weighing and a zero compute: the first time takes ten times as long as later ones."""
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
    """Return R_base_flange (3, 3), mean (6,) and covariance (6, 6) of a rest; raises `CannotWeigh`."""
    if len(rows) < LEAST_SAMPLES or rows.t_host_ns[-1] - rows.t_host_ns[0] < 0.95e9 * WEIGH_S:
        raise CannotWeigh("samples")
    if not is_still(rows):
        raise CannotWeigh("moving")
    if not is_stationary(rows.raw) or restless_channels(rows.raw, rest_sigma).any():
        raise CannotWeigh("unsteady")
    dwell = mean_and_covariance(rows.raw)
    return rows.R_base_flange[-1], dwell.mean, dwell.covariance * (1 + _FEW / len(rows))


def weigh_in_motion(stream: Stream, since_ns: int = 0) -> Weight:
    """Weigh what the arm carries, by the load that the stream follows from `since_ns` on, clock of the cell.

    Raises `CannotWeigh` if there is a contact, a load that is not decided yet, or no sample, and `ConfigError` if the
    stream does not follow the load.
    """
    if stream.track == "off":
        raise ConfigError('the stream does not follow the load: open it with track="show" to weigh in motion')
    rows, tracked = stream.processor.recent(), stream.processor.monitor.tracked
    if rows is None or tracked is None or not np.isfinite(tracked.last_seen_s):
        # the first windows are no answer: an empty gripper is assumed
        raise CannotWeigh("samples")
    if round(1e9 * tracked.t_s) < max(since_ns, int(rows.t_host_ns[-1]) - round(1e9 * _LATE_S)):
        raise CannotWeigh("samples")
    if not tracked.part_known:
        raise CannotWeigh("undecided")
    return weight_of(tracked, stream.info.calibration)


def weigh(stream: Stream, *, poses: int = 1, moving: bool = False, timeout_s: float = 10.0) -> Weight:
    """Wait until arm and reading rest, and weigh what the gripper holds beyond its calibrated tool.

    Call `stream.tare()` at the empty gripper just before it grasps: that cancels the drift of the bias.

    Parameters
    ----------
    stream : Stream
        Open; it is read here.
    poses : int
        One gives the mass, and the centre of mass but for its place along gravity. From two on, another program turns
        the arm meanwhile, and each rest that is 10° from the others counts.
    moving : bool
        Do not wait for rest: take what the arm carries as the stream follows it, once it is decided. The stream was
        opened with `track`, while the gripper was empty. `poses` does not count then.
    timeout_s : float
        For each pose.

    Returns
    -------
    Weight
        With `mass_kg`, `mass_sigma_kg`, `least_kg`, `p_sensor_com_m`, `com_covariance`, `line`.

    Raises
    ------
    CannotWeigh
        Nothing could be weighed in this time; its `code` is the reason of the last attempt.
    ConfigError
        With `moving`, the stream does not follow the load.
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
    """Read a stream until `attempt` succeeds with the samples from now on; it gets their first time.

    After the time-out raise its last `CannotWeigh`.
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
    """Return a weight as JSON, in the axes of sensor and flange; what is not known is None."""
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
    """Return how many parts of `part_kg` are held. Raises `CannotWeigh`."""
    parts = weight.mass_kg / part_kg
    whole = round(parts)
    sigma = float(np.hypot(weight.mass_sigma_kg, weight.scale_sigma * weight.mass_kg)) / part_kg
    if sigma > _WHOLE or abs(parts - whole) > max(_WHOLE, 2 * sigma):
        raise CannotWeigh("count", weight)
    return whole


@dataclass(frozen=True, slots=True)
class ScaleState:
    """The present state of the scale."""

    weight: Weight | None
    refusal: str | None
    """A key of `WORDS`; "contact" and the like have a weight too."""
    count: int | None = None
    stale: str = ""

    @property
    def measured(self) -> Weight | None:
        """The weight that is a mass to show: what cannot be counted has one too."""
        return self.weight if self.refusal in {None, "count"} else None


class Weighing(Sink):
    """Weighs ten times a second what the gripper of a stream holds, and zeroes on request.

    It `joins` the poses of one load, weighs what is `moving` too, and counts parts of `part_kg`. `keep` takes each new
    weight or fault, see `WeighingLog.keep`.
    """

    label, keeps_all = "scale", True
    shown = ScaleState(None, "samples")
    is_new = False
    """Whether the last block has brought a new weight, or a fault that lasts."""
    note = ""
    """Outcome of the last requested zero."""
    refusal: NotAccepted | None = None
    """The error if it was refused."""

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
        # Weight of the load that is held; None since the reading was not at rest.
        self._last: Weight | None = None
        self._due_s = stream.clock.now_s() + _STEP_S
        # When a zero was requested, on the clock of the cell; set by another thread.
        self._zero_ns: int | None = None
        self._fault: str | None = None
        self._fault_since_s = 0.0

    @property
    def is_zeroing(self) -> bool:
        """Whether a zero is requested, and neither done nor refused."""
        return self._zero_ns is not None

    def request_zero(self) -> None:
        """Let the thread that reads tare the empty gripper, when it has rested for half a second."""
        self.note, self.refusal = "zero: waits for half a second at rest …", None
        self._zero_ns = self.stream.clock.now_ns()

    def add(self, block: Block | None, _events: Sequence[StreamEvent]) -> None:
        """Weigh or zero if it is time to."""
        now_s, zero_ns, self.is_new = self.stream.clock.now_s(), self._zero_ns, False
        if block is None:
            self._last = None
            self.shown = ScaleState(None, None, stale=self.stream.status().failure)
        elif now_s < self._due_s:
            return
        elif zero_ns is not None:
            # the number of before would look live
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
            self.refusal = NotAccepted(f"no zero: {WORDS[refusal.code]}")
        else:
            self._last = None
        # first, because the operator may request another one now
        self._zero_ns = None
        self.note = "zero: the empty gripper was tared" if self.refusal is None else str(self.refusal)

    def _weighed(self) -> ScaleState:
        try:
            weight = weigh_in_motion(self.stream) if self.moving else self._scale.weigh(more=self.joins)
            return ScaleState(weight, None, None if self.part_kg is None else count_of(weight, self.part_kg))
        except CannotWeigh as refusal:
            # then it may be the same load as before
            if refusal.code not in ("unsteady", "samples"):
                self._last = None
            return ScaleState(refusal.weight, refusal.code)

    def _is_new(self, shown: ScaleState, now_s: float) -> bool:
        """Keep another weight than the last, or once a fault that lasts; return whether there is one."""
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
        """Return the error of the only weight that was wanted, after `PATIENCE_S`."""
        code = shown.refusal or "samples"
        # these are kept already
        if code not in _FAULTS:
            self._keep({"refused": code})
        return CannotWeigh(code, shown.weight)


def format_scale(shown: ScaleState) -> str:
    """Return a state as one line."""
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
