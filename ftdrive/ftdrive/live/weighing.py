"""Weigh what the gripper holds, from half a second of a stream at rest, or while the arm carries it.

`Scale` weighs once, `Weighing` reads a stream and weighs ten times a second.
"""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, get_args

import numpy as np

from ftcalib.after import weighing
from ftcalib.after.weighing import Fault, Weight, drift_since
from ftcalib.data.dwell_mean import LEAST_SAMPLES, PoseMean, is_stationary, mean_and_covariance, restless_channels
from ftcalib.errors import AcceptanceError
from ftcalib.files import JSON
from ftcalib.model import angle_between
from ftcalib.rounding import counted, to_place_of, with_sigma
from ftdrive.errors import ConfigError, NotAccepted
from ftdrive.live.noise import unexplained_variance
from ftdrive.live.replay import ReplayedStream
from ftdrive.live.samples import Block, Paired, Sink, StreamEvent, StreamInfo, gripping_point
from ftdrive.live.stages import TARE_S, is_still, try_tare
from ftdrive.live.stream import RECOVER_S, BlockReader, CompensatedStream, ProcessedStream
from ftdrive.live.tracking import weight_of
from ftdrivers.clock import Clock
from ftdrivers.interfaces import Array

if TYPE_CHECKING:
    from ftdrive.store.weighing_log import WeighingLog

WEIGH_S: Final = TARE_S
"""A weighing averages so long."""
PATIENCE_S = 10.0
"""So long a zero, or the only weight, may take."""
UNZEROED_KG: Final = 0.1
"""With a larger smallest mass the drift since the calibration decides, and a zero helps."""
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
FAULTS: Final[tuple[Fault, ...]] = get_args(Fault)


class CannotWeigh(AcceptanceError):
    """The reading is not that of one weight at rest.

    Parameters
    ----------
    code : str
        One of `WORDS`.
    weight : Weight, optional
        What was found all the same, of a reading at rest.

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

    Parameters
    ----------
    stream : CompensatedStream or ReplayedStream
    """

    def __init__(self, stream: ProcessedStream) -> None:
        self._stream = stream
        self._readings: list[tuple[Array, PoseMean]] = []
        # Noise of a sample at rest: steps of the load make it look louder for a while.
        self._quietest = np.full(6, np.inf)

    def weigh(self, since_ns: int = 0, *, more: bool = False) -> Weight:
        """Weigh the last half second.

        Parameters
        ----------
        since_ns : int
            Earlier samples do not count, clock of the cell.
        more : bool
            Join this pose to those before, of the same load.

        Raises
        ------
        CannotWeigh
            The arm or the reading is not at rest, or the reading is not that of one weight.
        """
        stream = self._stream
        R, mean = self._rest(since_ns)
        kept = [one for one in self._readings if angle_between(one[0], R) > _NEW_POSE_RAD] if more else []
        self._readings = [*kept, (R, mean)]
        reference, since_s = stream.reference()
        calibration = stream.info.calibration
        contact = weighing.known_contact(calibration)
        weight = weighing.weigh(
            reference,
            np.array([one[0] for one in self._readings]),
            np.array([one[1].mean for one in self._readings]),
            np.array([one[1].covariance for one in self._readings]) + np.diag(unexplained_variance(calibration)),
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
        means = [mean for _, mean in self._readings]
        R_base_flange = np.array([R for R, _ in self._readings])
        return R_base_flange, np.array([one.mean for one in means]), np.array([one.covariance for one in means])

    def zero(self, since_ns: int = 0) -> StreamEvent:
        """Tare the empty gripper by the last half second: the drift of the bias up to now is no error any more.

        Raises
        ------
        CannotWeigh
            The arm or the reading is not at rest, or too far from that of the empty tool.
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
        rows = self._stream.recent()
        if rows is not None and len(rows) >= LEAST_SAMPLES:
            try_tare(rows, self._stream.reference()[0])
            with suppress(CannotWeigh):
                self.weigh()

    def _rest(self, since_ns: int) -> tuple[Array, PoseMean]:
        rows = self._stream.recent()
        if rows is None:
            raise CannotWeigh("samples")
        rows = rows.rows(rows.t_host_ns >= max(since_ns, int(rows.t_host_ns[-1]) - round(WEIGH_S * 1e9)))
        if self._stream.rest_sigma is not None:
            self._quietest = np.minimum(self._quietest, self._stream.rest_sigma)
        return _reading(rows, self._quietest)


def _reading(rows: Paired, rest_sigma: Array) -> tuple[Array, PoseMean]:
    if len(rows) < LEAST_SAMPLES or rows.t_host_ns[-1] - rows.t_host_ns[0] < 0.95e9 * WEIGH_S:
        raise CannotWeigh("samples")
    if not is_still(rows):
        raise CannotWeigh("moving")
    if not is_stationary(rows.raw) or restless_channels(rows.raw, rest_sigma).any():
        raise CannotWeigh("unsteady")
    dwell = mean_and_covariance(rows.raw)
    return rows.R_base_flange[-1], PoseMean(dwell.mean, dwell.covariance * (1 + _FEW / len(rows)))


def weigh_in_motion(stream: ProcessedStream, since_ns: int = 0) -> Weight:
    """Weigh what the arm carries, by the load that the stream follows.

    Parameters
    ----------
    stream : CompensatedStream or ReplayedStream
        Its `track` is not "off".
    since_ns : int
        Earlier samples do not count, clock of the cell.

    Raises
    ------
    CannotWeigh
        A contact, a load that is not decided yet, or no samples.
    ConfigError
        The stream does not follow the load.
    """
    if stream.track == "off":
        raise ConfigError('the stream does not follow the load: open it with track="show" to weigh in motion')
    rows, tracked = stream.recent(), stream.tracked
    if rows is None or tracked is None or not np.isfinite(tracked.last_seen_s):
        # the first windows are no answer: an empty gripper is assumed
        raise CannotWeigh("samples")
    t_ns = round(1e9 * tracked.t_s)
    if t_ns < max(since_ns, int(rows.t_host_ns[-1]) - round(1e9 * _LATE_S)):
        raise CannotWeigh("samples")
    if not tracked.part_known:
        raise CannotWeigh("undecided")
    return weight_of(tracked, stream.info.calibration)


def weigh(
    stream: CompensatedStream | ReplayedStream, *, poses: int = 1, moving: bool = False, timeout_s: float = 10.0
) -> Weight:
    """Wait until arm and reading rest, and weigh what the gripper holds beyond its calibrated tool.

    Call `stream.tare()` at the empty gripper just before it grasps: that cancels the drift of the bias.

    Parameters
    ----------
    stream : CompensatedStream
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
    clock: Clock = stream.clock
    scale, since_ns = Scale(stream), 0
    weight: Weight | None = None
    while weight is None or weight.poses < poses:
        refusal = CannotWeigh("samples")
        before = 0 if weight is None else weight.poses
        for _ in clock.looks(timeout_s):
            rows = stream.read()
            since_ns = since_ns or int(rows.t_host_ns[-1])
            try:
                if moving:
                    return weigh_in_motion(stream, since_ns)
                weight = scale.weigh(since_ns, more=True)
            except CannotWeigh as error:
                refusal = error
            else:
                if weight.poses > before:
                    break
                refusal = CannotWeigh("moving")
        else:
            raise refusal
    return weight


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


class Weighing:
    """Reads a stream, records it, and weighs ten times a second.

    Parameters
    ----------
    stream : CompensatedStream
    recorder : Sink, optional
    joins : bool
        Join the poses of one load.
    moving : bool
        Weigh what the arm carries, in motion too.
    part_kg : float, optional
        Mass of one part.
    log : WeighingLog, optional
        Keeps each new weight or fault.

    Attributes
    ----------
    shown : ScaleState
        The present state.
    note : str
        What has become of the last requested zero.
    """

    shown = ScaleState(None, "samples")
    note = ""
    _zero_requested = False

    def __init__(
        self,
        stream: CompensatedStream,
        recorder: Sink | None,
        *,
        joins: bool,
        part_kg: float | None,
        moving: bool = False,
        log: "WeighingLog | None" = None,
    ) -> None:
        self.stream, self.part_kg = stream, part_kg
        self._log = log
        self.joins, self.moving = joins, moving
        self._recorder = recorder
        self._scale = Scale(stream)
        # Weight of the load that is held; None since the reading was not at rest.
        self._last: Weight | None = None

    def zero(self) -> None:
        """Tare the empty gripper, within some seconds. Raises `NotAccepted`."""
        end_s = self.stream.clock.now_s() + PATIENCE_S
        while True:
            self._read_for(WEIGH_S)
            try:
                self._scale.zero()
            except CannotWeigh as refusal:
                if refusal.code == "not-empty" or self.stream.clock.now_s() > end_s:
                    raise NotAccepted(f"no zero: {WORDS[refusal.code]}") from None
            else:
                self._last = None
                return

    def request_zero(self) -> None:
        """Let the thread that takes the states tare the empty gripper."""
        self.note = "zero: waits for half a second at rest …"
        self._zero_requested = True

    def _zero_as_requested(self) -> None:
        self._zero_requested = False
        # the number of before would look live
        self.shown = ScaleState(None, "samples")
        try:
            self.zero()
        except NotAccepted as error:
            self.note = str(error)
        else:
            self.note = "zero: the empty gripper was tared"

    def _read_for(self, seconds: float) -> None:
        end_s = self.stream.clock.now_s() + seconds
        while self.stream.clock.now_s() < end_s:
            self._record(self.stream.read())

    def _record(self, block: Block) -> None:
        if self._recorder is not None:
            self._recorder.write(block)
            for event in self.stream.take_events():
                self._recorder.event(event)

    def states(self, *, raises: bool = False) -> Iterator[tuple[ScaleState, bool]]:
        """Yield the state ten times a second, and whether it is a new weight or fault.

        Between two of them a requested zero is done. Raises `DeviceError` if a device has failed for some seconds, or
        at once with `raises`.
        """
        for shown, is_new in self._states(raises=raises):
            self.shown = shown
            yield shown, is_new
            if self._zero_requested:
                self._zero_as_requested()

    def _states(self, *, raises: bool) -> Iterator[tuple[ScaleState, bool]]:
        clock, reader = self.stream.clock, BlockReader(self.stream, 0.0 if raises else RECOVER_S)
        fault_since_s = 0.0
        fault: str | None = None
        due_s = clock.now_s() + _STEP_S
        for block in reader:
            if block is None:
                self._last = None
                yield ScaleState(None, None, stale=str(reader.failure)), False
                due_s = clock.now_s() + _STEP_S
                continue
            self._record(block)
            if clock.now_s() < due_s:
                continue
            shown = self._weighed()
            now_s = clock.now_s()
            if shown.refusal != fault:
                fault, fault_since_s = shown.refusal, now_s
            lasts = shown.refusal in (*FAULTS, "count") and now_s - fault_since_s > WEIGH_S
            if lasts:
                fault_since_s = float("inf")  # reported once
                if self._log is not None and shown.refusal is not None:
                    self._log.refused(shown.refusal)
            yield shown, lasts or (shown.refusal is None and self._is_new(shown))
            due_s = clock.now_s() + _STEP_S

    def _weighed(self) -> ScaleState:
        try:
            weight = weigh_in_motion(self.stream) if self.moving else self._scale.weigh(more=self.joins)
            return ScaleState(weight, None, None if self.part_kg is None else count_of(weight, self.part_kg))
        except CannotWeigh as refusal:
            # then it may be the same load as before
            if refusal.code not in ("unsteady", "samples"):
                self._last = None
            return ScaleState(refusal.weight, refusal.code)

    def _is_new(self, shown: ScaleState) -> bool:
        """Note a weight as an event if it is another one than the last; the same one is followed."""
        weight, last = shown.weight, self._last
        if weight is None:
            return False
        if last is not None:
            if abs(weight.mass_kg - last.mass_kg) < weight.least_kg and weight.poses == last.poses:
                return False
            if abs(weight.mass_kg - last.mass_kg) >= weight.least_kg:
                self._scale = Scale(self.stream)  # another load
        self._last = weight
        values = load_values(weight, self.stream.info) | {"count": shown.count}
        self.stream.note("load", line_of(shown), values)
        if self._log is not None:
            self._log.weighed(values)
        return True

    def given_up(self, shown: ScaleState) -> CannotWeigh:
        """Return the error of the only weight that was wanted, after `PATIENCE_S`."""
        code = shown.refusal or "samples"
        # these are kept already
        if self._log is not None and code not in (*FAULTS, "count"):
            self._log.refused(code)
        return CannotWeigh(code, shown.weight)


def worth_of(weight: Weight) -> str:
    """Return the sigma and the smallest mass of a weight as words."""
    sigma_g, least_g = (to_place_of(1e3 * kg, 1e3 * kg) for kg in (weight.mass_sigma_kg, weight.least_kg))
    return f"sigma {sigma_g} g, smallest mass {least_g} g"


def line_of(shown: ScaleState) -> str:
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
    com = ", ".join(
        with_sigma(1e3 * x, 1e3 * s) for x, s in zip(weight.p_sensor_com_m, weight.com_sigma_m, strict=True)
    )
    return f"{parts}{with_sigma(weight.mass_kg, weight.mass_sigma_kg)} kg at ({com}) mm from the sensor origin"
