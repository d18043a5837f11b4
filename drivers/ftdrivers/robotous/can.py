"""Robotous fields over CAN: a command is one frame, a reply or sample two.

Ref: Robotous, "RFT Series Installation and Operation Manual", revision 1.7: 1 Mbit/s, 11-bit identifiers.
"""

from typing import Self

from ftdrivers.clock import REAL, Clock
from ftdrivers.registry import Options
from ftdrivers.robotous.codec import Field
from ftdrivers.robotous.halves import Halves
from ftdrivers.robotous.sensor import RobotousSensor
from ftdrivers.wires.can_bus import CanBus

COMMAND, FIRST_HALF, SECOND_HALF = 0x64, 0x01, 0x02
BITRATE = 1_000_000
_WAIT_S = 0.05
_HEARD_S = 0.15
"""Since the last half: shorter than `StreamLimits.stale_s`, longer than the slowest sensor's period."""
_MOST_FRAMES = 50
"""After so many without a silence the reader looks at its other tasks."""


class RobotousCan(RobotousSensor):
    """A Robotous RFT on a CAN bus; the other parameters are those of `RobotousSensor`.

    The identifiers are the factory's, 0x64 to the sensor, 0x01 and 0x02 from it. `Halves` pairs the frames, because the
    second half of a field does not identify the first.
    """

    def __init__(
        self,
        channel: str,
        *,
        interface: str = "socketcan",
        rate_Hz: int | None = None,
        sign: int = 1,
        clock: Clock = REAL,
    ) -> None:
        super().__init__(f"Robotous sensor on {interface} {channel}", 1000, rate_Hz=rate_Hz, sign=sign, clock=clock)
        self._bus = CanBus(self.name, channel, interface, BITRATE, (FIRST_HALF, SECOND_HALF), clock)
        self._halves = Halves()
        self._heard_ns: int | None = None

    @classmethod
    def from_url(cls, address: str, options: Options, *, sign: int = 1, clock: Clock = REAL) -> Self:
        """Build from ``robotous-can://can0?interface=socketcan&rate=500``."""
        return cls(
            address,
            interface=options.text("interface", "socketcan"),
            rate_Hz=options.integer("rate", 0, 0, 1000) or None,
            sign=sign,
            clock=clock,
        )

    def _open(self) -> None:
        self._halves = Halves()
        self._bus.open()

    def _close(self) -> None:
        self._bus.close()

    def _send(self, field: bytes) -> None:
        self._bus.send(COMMAND, field)

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
                self._halves.take(self._heard_ns, data, second=identifier == SECOND_HALF)
                frame = self._clock.hear(self._bus.look, self._halves.silence_s)
        return []
