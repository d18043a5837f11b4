"""Robotous over CAN: a sample comes in two halves, which are paired by order and clock.

Pure: halves go in with their time of receipt, fields come out whose halves belong to one sample.

Ref: Robotous, "RFT Series Installation and Operation Manual", revision 1.8: 1 Mbit/s, 11-bit identifiers, configurable.
"""

import math
from collections.abc import Sequence
from typing import Self

from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import ProtocolError
from ftdrivers.registry import Options, join_url
from ftdrivers.robotous import codec
from ftdrivers.robotous.codec import Command, Field
from ftdrivers.robotous.sensor import RobotousSensor
from ftdrivers.wires.can_bus import CanBus, CanFrame, CanProbe, join_frames, request_message

# The halves of a field follow each other directly. Between two fields lies this silence, or half a period.
_SILENCE_S = 0.002
# The sensor may be slower than its rate by this fraction: manual and vendor's header differ by 0.1 on one rate.
_DRIFT = 0.12
# Fraction of a period by which the host may be late when it has all fields.
_LATE = 0.5
# Fraction of a period by which the clock may be late when it counts missing fields.
_EARLY = 0.25
_MOST_WAITING = 1000


class Halves:
    """Pairs halves, and drops every pair that may be of two samples.

    Halves must take turns. That is not enough: when a second half and the next first one are lost, the others still
    take turns, but one field is missing by the clock. So a run of fields is accepted in the first silence after it, and
    only if all fields due since the last run have arrived. A late host reads all of them together. So after a deficit
    the fields wait, and the next run shows whether the host was late or a field was lost. After a half out of turn, all
    fields up to the next silence are dropped. The run that follows only sets the clock, as do the first two.

    Parameters
    ----------
    period_s : float
        Between two samples; NaN for replies to requests.
    late_s : float
        How late the sensor itself may be: `Clock.lead_s`. A shorter deficit then counts as late, so two neighbouring
        losses are not detected.
    """

    def __init__(self, period_s: float = math.nan, late_s: float = 0.0) -> None:
        self.silence_s = _SILENCE_S if math.isnan(period_s) else min(_SILENCE_S, period_s / 2)
        """Call `silence` after this time without a half."""
        self.lost = 0
        """Fields that were due and were not accepted."""
        self.quiet = True
        """Whether nothing arrived since a silence."""
        self._period_ns = period_s * 1e9
        self._late_ns = late_s * 1e9
        self._number = 0
        # Arrival of the field `_number`.
        self._clock_ns: float | None = None
        self._first = b""
        # Fields since then, which the clock has not confirmed yet.
        self._waiting: list[Field] = []
        # How many of them arrived late or after a loss.
        self._doubtful = 0
        self._in_turn = True
        # Whether the clock is valid for these fields: none was out of turn since it was set.
        self._in_step = False

    def take(self, t_host_ns: int, data: bytes, *, second: bool) -> None:
        """Add a received half."""
        self.quiet = False
        if second != bool(self._first) or len(data) != codec.REPLY_SIZE // 2 or len(self._waiting) == _MOST_WAITING:
            self._in_turn = False
        if second:
            self._waiting.append(Field(self._number + len(self._waiting) + 1, t_host_ns, self._first + data))
            self._first = b""
        else:
            self._first = data

    def silence(self) -> list[Field]:
        """Return the accepted fields, after `silence_s` without a half."""
        # In every silence the count is compared with the clock, so two neighbouring losses are found.
        if self.quiet:
            return []
        self.quiet = True
        if not self._in_turn:
            # a first half at the end may belong to the next field, or have lost its second half
            self._first, self._waiting, self._doubtful = b"", [], 0
            self._in_turn, self._in_step = True, False
        if self._first or not self._waiting:
            return []
        if not self._in_step and not math.isnan(self._period_ns):
            self._set_clock(len(self._waiting))
        elif self._complete():
            return self._accept()
        elif not self._doubtful:
            self._doubtful = len(self._waiting)
        else:
            self._set_clock(self._doubtful)
            if self._complete():
                return self._accept()
            self._set_clock(len(self._waiting), by_period=False)  # twice: the sensor's clock has shifted
        return []

    def _complete(self) -> bool:
        """Return whether all fields that were due since the clock was set have arrived."""
        if self._clock_ns is None:
            return True
        # more fields than due mean that the clock was set late
        due_ns = (len(self._waiting) + _LATE) * self._period_ns + self._late_ns
        return self._waiting[-1].t_host_ns - self._clock_ns < due_ns

    def _accept(self) -> list[Field]:
        # After any irregularity the next sample is dropped, because neighbouring values prove nothing.
        fields, self._waiting, self._doubtful = self._waiting, [], 0
        self._number = fields[-1].number
        if self._clock_ns is not None:
            latest_ns = self._clock_ns + len(fields) * self._period_ns * (1 + _DRIFT)
            self._clock_ns = min(latest_ns, fields[-1].t_host_ns)
        return fields

    def _set_clock(self, fields: int, *, by_period: bool = True) -> None:
        """Set the clock by the last of the oldest `fields`, and drop them.

        The host may be late, so a clock that was set before moves by whole periods.
        """
        clock_ns: float = self._waiting[fields - 1].t_host_ns
        self._in_step = by_period and self._clock_ns is not None  # else it may be late, so the next run sets it again
        if self._clock_ns is not None:
            missed = max(1, math.floor((clock_ns - self._clock_ns) / self._period_ns + _EARLY))
            if by_period:
                clock_ns = min(clock_ns, self._clock_ns + missed * self._period_ns)
            if self._number:  # the stream begins with the first accepted field
                self._number += missed
                self.lost += missed
        self._clock_ns = clock_ns
        self._waiting = [
            field._replace(number=self._number + place) for place, field in enumerate(self._waiting[fields:], 1)
        ]
        self._doubtful = 0


IDS = (0x64, 0x01, 0x02)
"""The factory's identifiers of commands, and of the first and second half of a field."""
BITRATE = 1_000_000
_WAIT_S = 0.05
# The silence after the last half: shorter than `StreamLimits.stale_s`, longer than the slowest sensor's period.
_HEARD_S = 0.15
# After so many without a silence the reader looks at its other tasks.
_MOST_FRAMES = 50


class RobotousCan(RobotousSensor):
    """A Robotous RFT on a CAN bus; the other parameters are those of `RobotousSensor`.

    `ids` are the identifiers to the sensor and the two from it. `Halves` pairs the frames, because the second half of a
    field does not identify the first.
    """

    def __init__(
        self,
        channel: str,
        *,
        interface: str = "socketcan",
        ids: tuple[int, int, int] = IDS,
        rate_Hz: int | None = None,
        counts_per_unit: tuple[int, int] | None = None,
        sign: int = 1,
        clock: Clock = REAL,
    ) -> None:
        super().__init__(
            f"Robotous sensor on {interface} {channel}",
            1000,
            rate_Hz=rate_Hz,
            counts_per_unit=counts_per_unit,
            sign=sign,
            clock=clock,
        )
        self._command, *answers = ids
        self._second_half = answers[1]
        self._bus = CanBus(self.name, channel, interface, BITRATE, answers, clock)
        self._halves = Halves()
        self._heard_ns: int | None = None

    @classmethod
    def from_url(cls, address: str, options: Options, *, sign: int = 1, clock: Clock = REAL) -> Self:
        """Build from ``robotous-can://can0?interface=socketcan&ids=0xF0,0xF1,0xF2&rate=500``."""
        return cls(
            address,
            interface=options.text("interface", "socketcan"),
            ids=_parse_ids(options.text("ids", ",".join(map(hex, IDS)))),
            rate_Hz=options.integer("rate", 0, 0, 1000) or None,
            counts_per_unit=options.counts(),
            sign=sign,
            clock=clock,
        )

    def _open(self) -> None:
        self._halves = Halves()
        self._bus.open()

    def _close(self) -> None:
        self._bus.close()

    def _send(self, field: bytes) -> None:
        self._bus.send(self._command, field)

    def _start_stream(self, rate_Hz: int) -> None:
        self._halves = Halves(1 / rate_Hz, self._clock.lead_s)
        super()._start_stream(rate_Hz)

    def _damaged(self) -> int:
        """Return the fields that are missing by the clock, or were dropped because their pairing was uncertain."""
        return self._halves.lost

    def _silence_fix(self) -> str:
        if self._heard_ns is not None and self._clock.now_ns() - self._heard_ns < _HEARD_S * 1e9:
            return "give this computer less to do, because frames arrive too late to be paired"
        return super()._silence_fix()

    def _receive(self) -> list[Field]:
        """Return the fields of a run of frames, which ends with a silence."""
        # The adapter's time stamps differ between adapters or are missing, so they are not used.
        wait_s = min(_WAIT_S, self._clock.poll_s) if self._halves.quiet else self._halves.silence_s
        frame = self._bus.look(wait_s)
        with self._clock.held():  # else an emulated sensor might send as fast as a starved program reads
            for _ in range(_MOST_FRAMES):
                if frame is None:
                    return self._halves.silence()
                identifier, data = frame
                self._heard_ns = self._clock.now_ns()
                self._halves.take(self._heard_ns, data, second=identifier == self._second_half)
                frame = self._clock.hear(self._bus.look, self._halves.silence_s)
        return []


def _parse_ids(text: str) -> tuple[int, int, int]:
    """Find the identifiers of commands and of both halves in an option such as ``0xF0,0xF1,0xF2``."""
    try:
        command, first, second = (int(number, 0) for number in text.split(","))
    except ValueError:
        command = first = second = 0
    if not all(0 <= number <= 0x7FF for number in (command, first, second)) or len({command, first, second}) < 3:
        raise ValueError(
            f"ids are '{text}'; give three identifiers, of commands and of both response frames, such as 0xF0,0xF1,0xF2"
        )
    return command, first, second


def can_probe(channel: str, interface: str, bitrate: int | None, _base: int) -> CanProbe | None:
    """Return how to recognize a Robotous, which needs a bus at 1 Mbit/s. The parameters are those of `probe_can`."""
    if bitrate not in {None, BITRATE}:
        return None
    command, *answers = IDS
    reply = dict.fromkeys(answers, 8)

    def recognize(heard: Sequence[CanFrame]) -> str | None:
        fields = join_frames([frame for frame in heard if frame[0] in reply], reply)
        try:
            samples = [codec.decode_sample(field) for field in fields]
        except ProtocolError:
            return None
        plausible = all(sample.overload < 0x40 for sample in samples)
        return "it streams" if plausible and len(samples) >= 5 else None

    def ask(bus: CanBus, clock: Clock) -> str | None:
        field = request_message(bus, clock, command, codec.encode(Command.MODEL), reply)
        try:
            model = field and field[0] == Command.MODEL and codec.decode_text(field)
        except ProtocolError:
            return None
        return f"Robotous {model}" if model else None

    options = {} if interface == "socketcan" else {"interface": interface}
    url = join_url("robotous-can", channel, options)
    return CanProbe("a Robotous", url, reply.keys() | {command}, recognize, ask)
