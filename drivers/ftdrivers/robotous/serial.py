"""Robotous fields over RS-232, RS-422 or USB: each in a frame with a sum.

Ref: Robotous, "RFT Series Installation and Operation Manual", revision 1.8: 8N1, 115200 baud from the factory.
"""

from typing import Self

from ftdrivers.clock import REAL, Clock
from ftdrivers.registry import Options
from ftdrivers.robotous import codec
from ftdrivers.robotous.codec import Field
from ftdrivers.robotous.sensor import RobotousSensor
from ftdrivers.wires.serial_port import SerialPort


class RobotousSerial(RobotousSensor):
    """A Robotous RFT on a serial port.

    `baud` is one of `codec.FASTEST_Hz`; the other parameters are those of `RobotousSensor`.
    """

    def __init__(
        self,
        port: str,
        *,
        baud: int = 115_200,
        rate_Hz: int | None = None,
        counts_per_unit: tuple[int, int] | None = None,
        sign: int = 1,
        clock: Clock = REAL,
    ) -> None:
        if baud not in codec.FASTEST_Hz:
            raise ValueError(f"baud is {baud}; choose one of {', '.join(map(str, codec.FASTEST_Hz))}")
        super().__init__(
            f"Robotous sensor on {port}",
            codec.FASTEST_Hz[baud],
            rate_Hz=rate_Hz,
            counts_per_unit=counts_per_unit,
            sign=sign,
            clock=clock,
        )
        self._port = SerialPort(self.name, port, baud, clock=clock)

    @classmethod
    def from_url(cls, address: str, options: Options, *, sign: int = 1, clock: Clock = REAL) -> Self:
        """Build from ``robotous-serial:///dev/serial/by-id/…?baud=921600&rate=1000``."""
        return cls(
            address,
            baud=options.integer("baud", 115_200, 57_600, 921_600),
            rate_Hz=options.integer("rate", 0, 0, 1000) or None,
            counts_per_unit=options.counts(),
            sign=sign,
            clock=clock,
        )

    def _open(self) -> None:
        self._frames = codec.deframer()
        self._port.open()

    def _close(self) -> None:
        self._port.close()

    def _send(self, field: bytes) -> None:
        self._port.write(codec.encode_frame(field))

    def _receive(self) -> list[Field]:
        frames = self._frames.feed(self._port.read_all(codec.FRAME_SIZE))
        t_host_ns = self._clock.now_ns()
        return [Field(number, t_host_ns, frame[1:-2]) for number, frame in frames]

    def _damaged(self) -> int:
        # Frames carry no number: only damaged ones are counted, and one lost as a whole shows in the rate.
        return self._frames.damaged
