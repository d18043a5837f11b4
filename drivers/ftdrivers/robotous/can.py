"""Robotous over CAN: a sample consists of two frames, here called halves, which are paired by order and time.

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
from ftdrivers.wires.can_bus import CanBus, CanFrame, CanProbe, join_frames
from ftdrivers.wires.framing import ENOUGH_FRAMES

# Silence between two fields, s, at most half a period. The halves of one field follow each other directly.
_SILENCE_S = 0.002
# Largest relative deviation of a sensor's rate: manual and the vendor's header file differ by 0.1 for one rate.
_DRIFT = 0.12
# Fraction of a sample period by which the last field may be late if all fields have arrived.
_LATE = 0.5
# Fraction of a sample period by which the clock may be late when missing fields are counted.
_EARLY = 0.25
_MOST_WAITING = 1000


class Halves:
    """Pairs first and second halves into fields, and drops every pair that may belong to two samples.

    First and second halves must alternate. This condition is not sufficient: if a second half and the next first half
    are lost, the others still alternate, but one field is missing. Therefore fields are accepted in the first silence
    after them, and only if as many fields have arrived as are due by the clock. If some are missing, the fields wait,
    because the host may be late; the next fields show whether it was late or a field was lost. After two first or two
    second halves in a row, all fields up to the next silence are dropped, and the following ones only set the clock,
    as do the first two fields of a stream.

    Parameters
    ----------
    period_s : float
        Time between two samples, s; NaN for replies to requests.
    late_s : float
        Largest lag of the sensor itself, s: `Clock.lead_s`. If it is not zero, the loss of two neighbouring halves may
        remain undetected.
    """

    def __init__(self, period_s: float = math.nan, late_s: float = 0.0) -> None:
        self.silence_s = _SILENCE_S if math.isnan(period_s) else min(_SILENCE_S, period_s / 2)
        """Time, s, without a received half after which the reader must call `silence`."""
        self.lost = 0
        """Number of fields that were due by the clock but were lost or not accepted."""
        self.quiet = True
        """Whether no half of a field has arrived since the last call of `silence`."""
        self._period_ns = period_s * 1e9
        self._late_ns = late_s * 1e9
        self._number = 0
        # Estimated time of arrival of the last accepted field, whose number is `_number`.
        self._clock_ns: float | None = None
        self._first = b""
        # Fields that arrived later and are not accepted yet, because the clock has not confirmed them.
        self._waiting: list[Field] = []
        # Number of waiting fields that were fewer than due: they arrived late, or a field was lost.
        self._doubtful = 0
        self._in_turn = True
        # Whether the clock is valid for the waiting fields, because all halves have alternated since it was set.
        self._in_step = False

    def take(self, t_host_ns: int, data: bytes, *, second: bool) -> None:
        """Add a received half of a field: the first one, or the `second` one."""
        self.quiet = False
        if second != bool(self._first) or len(data) != codec.REPLY_SIZE // 2 or len(self._waiting) == _MOST_WAITING:
            self._in_turn = False
        if second:
            self._waiting.append(Field(self._number + len(self._waiting) + 1, t_host_ns, self._first + data))
            self._first = b""
        else:
            self._first = data

    def silence(self) -> list[Field]:
        """Return the accepted fields. It is called after `silence_s` without a half."""
        if self.quiet:
            return []
        self.quiet = True
        if not self._in_turn:
            # a first half at the end belongs to the next field, or its second half was lost
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
            self._set_clock(len(self._waiting), by_period=False)  # fields missing twice: the sensor's clock has shifted
        return []

    def _complete(self) -> bool:
        """Return whether all fields have arrived that are due since the clock was set."""
        if self._clock_ns is None:
            return True
        # more fields than due mean that the clock was set too late
        due_ns = (len(self._waiting) + _LATE) * self._period_ns + self._late_ns
        return self._waiting[-1].t_host_ns - self._clock_ns < due_ns

    def _accept(self) -> list[Field]:
        # After an irregularity the next sample is dropped, because its values do not show whether its halves match.
        fields, self._waiting, self._doubtful = self._waiting, [], 0
        self._number = fields[-1].number
        if self._clock_ns is not None:
            latest_ns = self._clock_ns + len(fields) * self._period_ns * (1 + _DRIFT)
            self._clock_ns = min(latest_ns, fields[-1].t_host_ns)
        return fields

    def _set_clock(self, fields: int, *, by_period: bool = True) -> None:
        """Set the clock to the arrival of the last of the oldest `fields` waiting fields, and drop these.

        A clock that was set before is moved by whole periods, because the host may be late.
        """
        clock_ns: float = self._waiting[fields - 1].t_host_ns
        self._in_step = by_period and self._clock_ns is not None  # the first may be late: the next confirm
        if self._clock_ns is not None:
            missed = max(1, math.floor((clock_ns - self._clock_ns) / self._period_ns + _EARLY))
            if by_period:
                clock_ns = min(clock_ns, self._clock_ns + missed * self._period_ns)
            if self._number:  # losses before the first accepted field do not count
                self._number += missed
                self.lost += missed
        self._clock_ns = clock_ns
        self._waiting = [
            field._replace(number=self._number + place) for place, field in enumerate(self._waiting[fields:], 1)
        ]
        self._doubtful = 0


IDS = (0x64, 0x01, 0x02)
"""Factory settings of the identifiers: of commands, and of the first and second half of a field."""
BITRATE = 1_000_000
_WAIT_S = 0.05
# Silence without any half, s: shorter than `StreamLimits.stale_s`, longer than the period of the slowest sensor.
_HEARD_S = 0.15
# Number of frames after which the reader returns to its other tasks if there is no silence.
_MOST_FRAMES = 50


class RobotousCan(RobotousSensor):
    """A Robotous RFT on a CAN bus. Parameters that are not described here are those of `RobotousSensor`.

    `ids` are the identifiers of commands and of the two halves of a field. `Halves` pairs the frames, because a second
    half does not show to which first half it belongs.
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
        """Build the driver from an address such as ``robotous-can://can0?ids=0xF0,0xF1,0xF2&rate=500``."""
        return cls(
            address,
            interface=options.text("interface", "socketcan"),
            ids=_parse_ids(options.text("ids", ",".join(map(hex, IDS)))),
            rate_Hz=options.integer("rate", 0, 0, 1000) or None,
            counts_per_unit=options.counts(),
            sign=sign,
            clock=clock,
        )

    @staticmethod
    def probe(channel: str, interface: str, bitrate: int | None, _base: int) -> CanProbe | None:
        """Return the `CanProbe` of a Robotous, on a bus at 1 Mbit/s only. The parameters are those of `probe_can`."""
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
            return "it streams" if plausible and len(samples) >= ENOUGH_FRAMES else None

        def ask(bus: CanBus) -> str | None:
            field = bus.request(command, codec.encode(Command.MODEL), reply)
            try:
                model = field and field[0] == Command.MODEL and codec.decode_text(field)
            except ProtocolError:
                return None
            return f"Robotous {model}" if model else None

        options = {} if interface == "socketcan" else {"interface": interface}
        url = join_url("robotous-can", channel, options)
        return CanProbe("a Robotous", url, reply.keys() | {command}, recognize, ask)

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
        """Return the number of fields that were missing, or were dropped because their pairing was uncertain."""
        return self._halves.lost

    def _silence_fix(self) -> str:
        if self._heard_ns is not None and self._clock.now_ns() - self._heard_ns < _HEARD_S * 1e9:
            return "reduce the load on this computer, because frames are read too late to be paired"
        return super()._silence_fix()

    def _receive(self) -> list[Field]:
        """Return the fields of the frames up to the next silence."""
        # Time stamps of adapters are not used, because they differ between adapters or are missing.
        wait_s = min(_WAIT_S, self._clock.poll_s) if self._halves.quiet else self._halves.silence_s
        frame = self._bus.look(wait_s)
        with self._clock.held():  # otherwise an emulated sensor could send as fast as a slow program reads
            for _ in range(_MOST_FRAMES):
                if frame is None:
                    return self._halves.silence()
                identifier, data = frame
                self._heard_ns = self._clock.now_ns()
                self._halves.take(self._heard_ns, data, second=identifier == self._second_half)
                frame = self._clock.hear(self._bus.look, self._halves.silence_s)
        return []


def _parse_ids(text: str) -> tuple[int, int, int]:
    """Return the identifiers of commands and of both halves from an option such as ``0xF0,0xF1,0xF2``."""
    try:
        command, first, second = (int(number, 0) for number in text.split(","))
    except ValueError:
        command = first = second = 0
    if not all(0 <= number <= 0x7FF for number in (command, first, second)) or len({command, first, second}) < 3:
        raise ValueError(
            f"ids are '{text}'; give three identifiers, for commands and both response frames, such as 0xF0,0xF1,0xF2"
        )
    return command, first, second
