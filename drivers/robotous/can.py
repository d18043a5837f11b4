"""Robotous fields over CAN: a command is one frame, a reply or sample two.

Ref: Robotous, "RFT Series Installation and Operation Manual", revision 1.7: 1 Mbit/s, 11-bit identifiers.
"""

from typing import TYPE_CHECKING, Self

from drivers._can import CanBus
from drivers.robotous import codec
from drivers.robotous.sensor import RobotousSensor

if TYPE_CHECKING:
    from drivers.registry import Options

_COMMAND, _FIRST_HALF, _SECOND_HALF = 0x64, 0x01, 0x02
_BITRATE = 1_000_000
_WAIT_S = 0.05


class CanLink:
    """The wire of a Robotous sensor with the identifiers of the factory, 0x64 to it, 0x01 and 0x02 from it.

    The second half of a field says nothing about the first: a half without its other is thrown away and counted.
    """

    def __init__(self, channel: str, *, interface: str = "socketcan") -> None:
        self.name = f"Robotous sensor on {interface} {channel}"
        self.fastest_Hz = 1000
        self._bus = CanBus(self.name, channel, interface, _BITRATE, (_FIRST_HALF, _SECOND_HALF))
        self._first: bytes | None = None
        self._number = self._halves_lost = 0

    @property
    def damaged(self) -> int:
        """Fields of which only a part arrived."""
        return self._halves_lost + self._bus.malformed

    def open(self) -> None:
        """Join the bus."""
        self._first = None
        self._bus.open()

    def send(self, field: bytes) -> None:
        """Send a command field."""
        self._bus.send(_COMMAND, field)

    def receive(self) -> list[tuple[int, bytes]]:
        """Take the next field, or none after 0.05 s."""
        while (frame := self._bus.receive(_WAIT_S)) is not None:
            identifier, data = frame
            first, self._first = self._first, None
            if identifier == _FIRST_HALF:
                self._first = data
                if first is not None:
                    self._count_lost()
            elif first is None or len(first + data) != codec.REPLY_SIZE:
                self._count_lost()
            else:
                self._number += 1
                return [(self._number, first + data)]
        return []

    def close(self) -> None:
        """Leave the bus."""
        self._bus.close()

    def _count_lost(self) -> None:
        self._halves_lost += 1
        self._number += 1


class RobotousCan(RobotousSensor):
    """A Robotous RFT on a CAN bus."""

    @classmethod
    def from_url(cls, address: str, options: "Options", *, sign: int = 1) -> Self:
        """Build from ``robotous-can://can0?interface=socketcan&rate=500``."""
        link = CanLink(address, interface=options.text("interface", "socketcan"))
        return cls(link, rate_Hz=options.integer("rate", 0, 0, 1000) or None, sign=sign)
