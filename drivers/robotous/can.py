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
"""Since the last half: shorter than the silence that is an error, longer than the slowest sensor's period."""
_LATE_S = 0.03
"""By how much an emulated sensor may be late: more than an emulated cell's time ever runs ahead of it."""
_OVERSLEPT_S = 0.002
"""Where a wait ends so much too late the host was busy, and frames may be there: it has to look once more."""


class CanLink:
    """The wire of a Robotous sensor with the identifiers of the factory, 0x64 to it, 0x01 and 0x02 from it.

    The second half of a field says nothing about the first; `Halves` says which belong together.
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
        """Samples that are missing, by the clock, or were not certain to be whole."""
        return self._halves.lost

    @property
    def unpaired(self) -> bool:
        """Whether halves come: where no fields do, they are not believed, as on a computer that is too busy."""
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
        """Take the next fields, or none after 0.05 s."""
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
        """Take what an emulated sensor has sent so far, in place of a silence, which a starved program never sees.

        The cell's time stands still meanwhile, so there is an end of it.
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
