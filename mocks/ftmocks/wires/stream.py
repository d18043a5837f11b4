"""Kinds of sensors on a pseudo-terminal: on a serial line, with or without Modbus, and on a CAN bus with an adapter."""

import random
from abc import abstractmethod
from dataclasses import KW_ONLY, dataclass

from ftmocks.wires import modbus
from ftmocks.wires.pty import PtyDevice
from ftmocks.wires.slcan import CanFrame, SlcanAdapter


class SerialSensor(PtyDevice[bytes]):
    """A sensor on a serial line."""

    def _encode(self, frames: list[bytes]) -> bytes:
        return b"".join(frames)


class ModbusSensor(SerialSensor):
    """A sensor with Modbus RTU, where a pause ends a request. While it streams, it does not answer requests."""

    address = 0
    frame_gap_s = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._burst = bytearray()
        """Bytes received since the last pause; not more than show that they are too long for a frame."""
        self._last_byte_s = 0.0

    @abstractmethod
    def _execute(self, function: int, data: bytes) -> bytes:
        """Carry out a request and return the data of the reply, as in `modbus.reply`."""

    def _remember(self, data: bytes) -> None:
        self._burst += data[: modbus.LONGEST_FRAME + 1 - len(self._burst)]

    def _work(self, now_s: float) -> float | None:
        """Answer the bytes that arrived before a pause; return the time until the pause is long enough, s."""
        if self.streaming or not self._burst:
            return None
        wait_s = self._last_byte_s + self.frame_gap_s - now_s
        if wait_s > 0:
            return wait_s
        answer = self.reply(bytes(self._burst))
        self._burst.clear()
        if answer:
            self._wire.put([answer])
        return None

    def reply(self, frame: bytes) -> bytes:
        """Return the reply to a frame, or nothing if the frame is damaged or for another device."""
        return modbus.reply(self.address, frame, self._execute)


@dataclass(eq=False)
class CanSensor(PtyDevice[CanFrame]):
    """A sensor on a CAN bus, and the adapter that a client opens.

    Parameters
    ----------
    bitrate
        Bit rate of the sensor; a client at another bit rate gets no answer.
    """

    _: KW_ONLY
    bitrate: int = 1_000_000

    def __post_init__(self) -> None:
        super().__post_init__()
        self._wire.foreign = self._foreign_frame
        self._adapter = SlcanAdapter()
        self._answers = b""

    @abstractmethod
    def _boot(self) -> None:
        """Set the state of the sensor after power-up."""

    @abstractmethod
    def answer(self, request: CanFrame) -> list[CanFrame]:
        """Return the answer to a frame on the bus; nothing if the frame is not a request."""

    @abstractmethod
    def _foreign_frame(self, rng: random.Random) -> CanFrame:
        """Return another node's frame, which a careless client could take for a frame of the sensor."""

    def power_up(self) -> None:
        """Set the state after power-up, see `Device.power_up`."""
        self._adapter = SlcanAdapter()
        self._answers = b""
        self._wire.clear()
        self._boot()

    def _restart(self) -> None:
        self._wire.clear()
        self._boot()

    def _received(self, data: bytes) -> None:
        answers, frames = self._adapter.feed(data)
        self._answers += answers
        for frame in frames:
            if self._adapter.bitrate == self.bitrate:
                self._wire.put(self.answer(frame))
            else:
                self._adapter.bus_error = True

    def _encode(self, frames: list[CanFrame]) -> bytes:
        data = self._answers
        self._answers = b""
        if self._adapter.bitrate == self.bitrate:
            data += b"".join(self._adapter.line(frame) for frame in frames)
        return data
