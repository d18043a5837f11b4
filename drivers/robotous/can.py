"""Robotous fields over CAN: a command is one frame, a reply or sample two.

Ref: Robotous, "RFT Series Installation and Operation Manual", revision 1.7: 1 Mbit/s, 11-bit identifiers.
"""

from typing import TYPE_CHECKING, Self

from drivers.clock import REAL, Clock
from drivers.robotous import codec
from drivers.robotous.codec import Command, Field
from drivers.robotous.halves import Halves
from drivers.robotous.sensor import RobotousSensor
from drivers.wires.can_bus import CanBus

if TYPE_CHECKING:
    from drivers.registry import Options

COMMAND, FIRST_HALF, SECOND_HALF = 0x64, 0x01, 0x02
BITRATE = 1_000_000
_WAIT_S = 0.05
_HEARD_S = 0.15
"""Since the last half: shorter than `StreamLimits.stale_s`, longer than the slowest sensor's period."""
_LATE_S = 0.03
"""The most that an emulated sensor may be late: more than its cell's time ever runs ahead of it."""
_OVERSLEPT_S = 0.002
"""After a wait that ends this late the host was busy, and frames may have arrived: look once more."""


class CanLink:
    """The CAN bus of a Robotous sensor with the factory's identifiers, 0x64 to it, 0x01 and 0x02 from it.

    `Halves` pairs the frames, because the second half of a field does not identify the first.
    """

    def __init__(self, channel: str, *, interface: str = "socketcan", clock: Clock = REAL) -> None:
        self.name = f"Robotous sensor on {interface} {channel}"
        self.fastest_Hz = 1000
        self.clock = clock
        self._bus = CanBus(self.name, channel, interface, BITRATE, (FIRST_HALF, SECOND_HALF), clock)
        self._halves = Halves()
        self._heard_ns: int | None = None

    @property
    def damaged(self) -> int:
        """Samples that are missing by the clock, or were dropped because their pairing was uncertain."""
        return self._halves.lost

    @property
    def unpaired(self) -> bool:
        """Whether halves arrived lately. Without fields, they could not be paired, as on an overloaded computer."""
        return self._heard_ns is not None and self.clock.now_ns() - self._heard_ns < _HEARD_S * 1e9

    def open(self) -> None:
        """Join the bus."""
        self._halves = Halves()
        self._bus.open()

    def send(self, field: bytes) -> None:
        """Send a command field."""
        self._bus.send(COMMAND, field)

    def stream(self, rate_Hz: int, /) -> None:
        """Start the stream."""
        self._halves = Halves(1 / rate_Hz, _LATE_S if self.clock.emulated else 0.0)
        self.send(codec.encode(Command.START))

    def receive(self) -> list[Field]:
        """Return the next fields, or none after 0.05 s."""
        if self.clock.emulated:
            return self._receive_all()
        overslept = False
        for left_s in self.clock.looks(_WAIT_S):
            begin_s = self.clock.now_s()
            wait_s = left_s if self._halves.quiet else 0.0 if overslept else self._halves.silence_s
            fields: list[Field] = []
            if frame := self._bus.look(wait_s):
                identifier, data = frame
                self._heard_ns = self.clock.now_ns()
                self._halves.take(self._heard_ns, data, second=identifier == SECOND_HALF)
                overslept = False
            elif overslept or self.clock.now_s() - begin_s < wait_s + _OVERSLEPT_S:
                fields = self._halves.silence()
            else:
                overslept = True
            if fields:
                return fields
        return []

    def _receive_all(self) -> list[Field]:
        """Return all that an emulated sensor has sent. A starved program never sees the silence that ends a run.

        The cell's time stands still meanwhile, so the loop ends.
        """
        frame = self._bus.look(self.clock.poll_s)
        now_ns = self.clock.now_ns()
        while frame:
            self._heard_ns = now_ns
            self._halves.take(now_ns, frame[1], second=frame[0] == SECOND_HALF)
            frame = self._bus.look(0.0)
        return self._halves.silence()

    def close(self) -> None:
        """Leave the bus."""
        self._bus.close()


class RobotousCan(RobotousSensor):
    """A Robotous RFT on a CAN bus."""

    @classmethod
    def from_url(cls, address: str, options: "Options", *, sign: int = 1, clock: Clock = REAL) -> Self:
        """Build from ``robotous-can://can0?interface=socketcan&rate=500``."""
        link = CanLink(address, interface=options.text("interface", "socketcan"), clock=clock)
        return cls(link, rate_Hz=options.integer("rate", 0, 0, 1000) or None, sign=sign)
