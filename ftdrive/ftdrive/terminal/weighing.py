"""What `ftdrive weigh` shows: the state of the scale, ten times a second, and in words."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ftcalib.after.weighing import Weight
from ftcalib.rounding import counted, with_sigma
from ftdrive.errors import NotAccepted
from ftdrive.live.samples import Block
from ftdrive.live.stream import RECOVER_S, BlockReader, CompensatedStream
from ftdrive.live.weighing import FAULTS, WEIGH_S, WORDS, CannotWeigh, Scale, count_of, load_values, weigh_in_motion
from ftdrive.recording import Recorder

if TYPE_CHECKING:
    from ftdrive.store.weighing_log import WeighingLog

PATIENCE_S = 10.0
"""So long a zero, or the only weight, may take."""
# Between two weighings, each of the last half second.
_STEP_S = 0.1


@dataclass(frozen=True, slots=True)
class Shown:
    """The present state of the scale."""

    weight: Weight | None
    refusal: str | None
    """A key of `WORDS`; "contact" and the like have a weight too."""
    count: int | None = None
    stale: str = ""


class Weighing:
    """Reads a stream, records it, and weighs ten times a second.

    Parameters
    ----------
    stream : CompensatedStream
    recorder : Recorder, optional
    joins : bool
        Join the poses of one load.
    moving : bool
        Weigh what the arm carries, in motion too.
    part_kg : float, optional
        Mass of one part.
    log : WeighingLog, optional
        Keeps each new weight or fault.
    """

    def __init__(
        self,
        stream: CompensatedStream,
        recorder: Recorder | None,
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

    def _read_for(self, seconds: float) -> None:
        end_s = self.stream.clock.now_s() + seconds
        while self.stream.clock.now_s() < end_s:
            self._record(self.stream.read())

    def _record(self, block: Block) -> None:
        if self._recorder is not None:
            self._recorder.write(block)
            for event in self.stream.take_events():
                self._recorder.event(event)

    def states(self, *, raises: bool = False) -> Iterator[tuple[Shown, bool]]:
        """Yield the state ten times a second, and whether it is a new weight or fault.

        Raises `DeviceError` if a device has failed for some seconds, or at once with `raises`.
        """
        clock, reader = self.stream.clock, BlockReader(self.stream, 0.0 if raises else RECOVER_S)
        fault_since_s = 0.0
        fault: str | None = None
        due_s = clock.now_s() + _STEP_S
        for block in reader:
            if block is None:
                self._last = None
                yield Shown(None, None, stale=str(reader.failure)), False
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

    def _weighed(self) -> Shown:
        try:
            weight = weigh_in_motion(self.stream) if self.moving else self._scale.weigh(more=self.joins)
            return Shown(weight, None, None if self.part_kg is None else count_of(weight, self.part_kg))
        except CannotWeigh as refusal:
            # then it may be the same load as before
            if refusal.code not in ("unsteady", "samples"):
                self._last = None
            return Shown(refusal.weight, refusal.code)

    def _is_new(self, shown: Shown) -> bool:
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

    def given_up(self, shown: Shown) -> CannotWeigh:
        """Return the error of the only weight that was wanted, after `PATIENCE_S`."""
        code = shown.refusal or "samples"
        # these are kept already
        if self._log is not None and code not in (*FAULTS, "count"):
            self._log.refused(code)
        return CannotWeigh(code, shown.weight)


def line_of(shown: Shown) -> str:
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
