"""Robotous fields over RS-232, RS-422 or USB: each in a frame with a sum.

Ref: Robotous, "RFT Series Installation and Operation Manual", revision 1.7: 8N1, 115200 baud from the factory.
"""

from typing import TYPE_CHECKING, Self

from drivers.clock import REAL, Clock
from drivers.robotous import codec
from drivers.robotous.codec import Command, Field
from drivers.robotous.sensor import RobotousSensor
from drivers.wires.serial_port import SerialPort

if TYPE_CHECKING:
    from drivers.registry import Options

BAUDS = (57_600, 115_200, 230_400, 460_800, 921_600)


class SerialLink:
    """The serial port of a Robotous sensor."""

    def __init__(self, path: str, *, baud: int = 115_200, clock: Clock = REAL) -> None:
        if baud not in BAUDS:
            raise ValueError(f"baud is {baud}; choose one of {', '.join(map(str, BAUDS))}")
        self.name = f"Robotous sensor on {path}"
        self.clock = clock
        # 1 kHz needs 921600 baud (manual); below, a frame of 19 bytes takes 190 bits
        self.fastest_Hz = 1000 if baud == 921_600 else min(500, baud // 190)
        self._port = SerialPort(self.name, path, baud, clock=clock)
        self._frames = codec.deframer()

    @property
    def damaged(self) -> int:
        """Frames dropped."""
        return self._frames.damaged

    @property
    def unpaired(self) -> bool:
        """Never: a frame holds a whole field."""
        return False

    def open(self) -> None:
        """Open the port."""
        self._frames = codec.deframer()
        self._port.open()

    def send(self, field: bytes) -> None:
        """Send a command field."""
        self._port.write(codec.encode_frame(field))

    def stream(self, _rate_Hz: int, /) -> None:
        """Start the stream; on a UART the rate is not needed."""
        self.send(codec.encode(Command.START))

    def receive(self) -> list[Field]:
        """Return the fields that have arrived; wait up to 0.05 s for the first."""
        frames = self._frames.feed(self._port.read_all(codec.FRAME_SIZE))
        t_host_ns = self.clock.now_ns()
        return [Field(number, t_host_ns, frame[1:-2]) for number, frame in frames]

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class RobotousSerial(RobotousSensor):
    """A Robotous RFT on a serial port."""

    @classmethod
    def from_url(cls, address: str, options: "Options", *, sign: int = 1, clock: Clock = REAL) -> Self:
        """Build from ``robotous-serial:///dev/serial/by-id/…?baud=921600&rate=1000``."""
        link = SerialLink(address, baud=options.integer("baud", 115_200, BAUDS[0], BAUDS[-1]), clock=clock)
        return cls(link, rate_Hz=options.integer("rate", 0, 0, 1000) or None, sign=sign)
