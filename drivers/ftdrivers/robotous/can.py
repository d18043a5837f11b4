"""Robotous fields over CAN: a command is one frame, a reply or sample two.

Ref: Robotous, "RFT Series Installation and Operation Manual", revision 1.8: 1 Mbit/s, 11-bit identifiers, configurable.
"""

from typing import Self

from ftdrivers.clock import REAL, Clock
from ftdrivers.registry import Options
from ftdrivers.robotous.codec import Field
from ftdrivers.robotous.halves import Halves
from ftdrivers.robotous.sensor import RobotousSensor
from ftdrivers.wires.can_bus import CanBus

IDS = (0x64, 0x01, 0x02)
"""The factory's identifiers of commands, and of the first and second half of a field."""
BITRATE = 1_000_000
_WAIT_S = 0.05
_HEARD_S = 0.15
"""Since the last half: shorter than `StreamLimits.stale_s`, longer than the slowest sensor's period."""
_MOST_FRAMES = 50
"""After so many without a silence the reader looks at its other tasks."""


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
