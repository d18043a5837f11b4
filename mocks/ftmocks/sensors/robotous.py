"""An emulated Robotous RFT force/torque sensor: one device, on a CAN bus or on a UART.

Ref: Robotous RFT series installation and operation manual, revision 1.7 (commands, data field, CAN and UART packets).
Revision 1.8 as transcribed in ItsLP18/robotous-ft-pipeline (divisors of each model, rates of each baud rate, overload
from 120 % of the rated load). In revision 1.7 the divisors of RFT64-6A01 were (50, 2000).

Does not model: the low-pass filter (its type and code are stored and reported), storage wear, line speed.

Chosen here, because the manual leaves it open: an unknown command or a damaged packet gets no answer. A setting of the
other wire is answered as unsupported, and a rate the line does not allow as out of range. If the line becomes slower
later, it limits the rate. A reading at the end of the int16 range also sets the overload bit of its axis. The
overload counters count the beginnings of overloads up to 255. CAN identifiers and the baud rate need a reboot; `reset`
is one. All other settings survive it, except bias and streaming. The rated loads are those of the data sheets for
RFT40-SA01 and RFT60-HA01, and those of RFT60-HA01 for the others.
"""

import random
import struct
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from enum import IntEnum
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ftmocks.arrays import Array
from ftmocks.sensors.kind import Kind
from ftmocks.wires.faults import Frame
from ftmocks.wires.pty import PtyDevice
from ftmocks.wires.slcan import CanFrame
from ftmocks.wires.stream import CanSensor, SerialSensor

COMMAND_BYTES, RESPONSE_BYTES = 8, 16
START_OF_PACKET, END_OF_PACKET = 0x55, 0xAA
RATES_HZ = (200, 10, 20, 50, 100, 200, 333, 500, 1000)
BAUD_RATES = (115_200, 921_600, 460_800, 230_400, 115_200, 57_600)
FASTEST_HZ = {57_600: 200, 115_200: 333, 230_400: 500, 460_800: 500, 921_600: 1000}
OVERLOAD = 1.2
FILTER_TYPES, FILTER_CODES = (0, 1), range(15)
SUCCESS, FAILURE = 1, 0
UNSUPPORTED, OUT_OF_RANGE = 1, 2


class Command(IntEnum):
    """First bytes of command fields and of their responses."""

    MODEL_NAME = 0x01
    SERIAL_NUMBER = 0x02
    FIRMWARE_VERSION = 0x03
    SET_IDS = 0x04
    GET_IDS = 0x05
    SET_BAUD = 0x06
    GET_BAUD = 0x07
    SET_FILTER = 0x08
    GET_FILTER = 0x09
    ONE_SAMPLE = 0x0A
    START = 0x0B
    STOP = 0x0C
    SET_RATE = 0x0F
    GET_RATE = 0x10
    BIAS = 0x11
    OVERLOAD_COUNTS = 0x12


@dataclass(frozen=True)
class Model:
    """A model of the series.

    Parameters
    ----------
    force_divisor, torque_divisor
        Counts per N and per N·m.
    capacity
        (6,) rated load, N and N·m. An axis is overloaded from 120 % of it.
    """

    name: str = "RFT60-HA01"
    force_divisor: float = 50.0
    torque_divisor: float = 2000.0
    capacity: Sequence[float] = (200.0, 200.0, 200.0, 8.0, 8.0, 8.0)


MODELS = {
    model.name: model
    for model in (
        Model("RFT40-SA01", capacity=(100.0, 100.0, 150.0, 2.5, 2.5, 2.5)),
        Model("RFT44-SB01"),
        Model("RFT60-HA01"),
        Model("RFT64-SB01"),
        Model("RFT64-6A01", torque_divisor=1000.0),
        Model("RFT80-6A01", torque_divisor=1000.0),
        Model("RFT80-6A02", torque_divisor=1000.0),
        Model("RFT82-HA02", torque_divisor=1000.0),
    )
}
"""Models by the name that the sensor reports."""


def raw_values(wrench: Array, model: Model) -> NDArray[np.int16]:
    """Return rounded and clipped counts of wrenches.

    Parameters
    ----------
    wrench
        (n, 6) wrenches, N and N·m.
    """
    counts = np.rint(wrench * ([model.force_divisor] * 3 + [model.torque_divisor] * 3))
    return np.clip(counts, -32768, 32767).astype(np.int16)


def sample_field(response: int, raw: Sequence[int], overload: int) -> bytes:
    """Return the response field of a sample: identifier, six big-endian int16, overload bits, two padding bytes."""
    return struct.pack(">B6hB2x", response, *raw, overload)


def packet(field: bytes) -> bytes:
    """Return the UART packet of a command or response field."""
    return bytes((START_OF_PACKET, *field, sum(field) & 0xFF, END_OF_PACKET))


def fields(stream: bytearray) -> list[bytes]:
    """Remove received bytes and return the complete command packets in them."""
    found = []
    size = COMMAND_BYTES + 3
    while (start := stream.find(START_OF_PACKET)) >= 0 and len(stream) >= start + size:
        candidate = bytes(stream[start : start + size])
        valid = packet(candidate[1:-2]) == candidate
        if valid:
            found.append(candidate[1:-2])
        del stream[: start + (size if valid else 1)]
    if start < 0:
        stream.clear()
    return found


@dataclass(eq=False)
class RobotousSensor(PtyDevice[Frame]):
    """The device, independent of the wire: it converts command fields to response fields.

    Parameters
    ----------
    model
        Name, divisors and capacity.
    serial, firmware
        At most 15 ASCII characters each.
    baud_code
        Index of the active baud rate in `BAUD_RATES`. A pseudo-terminal does not show the baud rate of the client.
    ids
        Active CAN identifiers: of commands, and of the first and second frame of a response.
    overload
        Overload bits in addition to those of the readings; bits 5 to 0 are Fx to Tz.
    streaming_at_start
        Whether the sensor streams after power-up, as after a crash of the last client.
    """

    unsupported: ClassVar[frozenset[Command]] = frozenset()
    _: KW_ONLY
    model: Model = Model()
    serial: str = "A60HA00123"
    firmware: str = "VER 1.7"
    baud_code: int = 0
    ids: tuple[int, int, int] = (0x64, 0x01, 0x02)
    overload: int = 0
    streaming_at_start: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        self.rate_code = 0
        self.filter = (0, 0)
        self.stored_ids = self.ids
        self.stored_baud_code = self.baud_code
        self.overload_counts = [0] * 6
        self._overloaded = 0
        self._bias = np.zeros(6)

    @property
    def rate_hz(self) -> float:
        """Sample rate of a stream, Hz."""
        return RATES_HZ[self.rate_code]

    def boot(self) -> None:
        """Set the state after power-up."""
        self.ids, self.baud_code = self.stored_ids, self.stored_baud_code
        self._bias = np.zeros(6)
        self._pacer.stop()
        if self.streaming_at_start:
            self._pacer.start(self.rate_hz)

    def execute(self, command: bytes) -> list[bytes]:
        """Return the responses to a command field: one or none."""
        code, *arguments = command
        if self._pacer.running and code not in (Command.STOP, Command.BIAS):
            return []
        settings: dict[int, Sequence[int]] = {
            Command.MODEL_NAME: self.model.name.encode("ascii"),
            Command.SERIAL_NUMBER: self.serial.encode("ascii"),
            Command.FIRMWARE_VERSION: self.firmware.encode("ascii"),
            Command.GET_IDS: (*self.ids, *self.stored_ids),
            Command.GET_BAUD: (self.baud_code, self.stored_baud_code),
            Command.GET_FILTER: self.filter,
            Command.GET_RATE: (self.rate_code,),
            Command.OVERLOAD_COUNTS: self.overload_counts,
        }
        if code in settings:
            return [self._response(code, *settings[code])]
        match code:
            case Command.SET_IDS | Command.SET_BAUD | Command.SET_FILTER | Command.SET_RATE:
                error = self._set(code, *arguments[:3])
                return [self._response(code, FAILURE if error else SUCCESS, error)]
            case Command.ONE_SAMPLE:
                return self.samples(1, code)
            case Command.START:
                self._pacer.start(self.rate_hz)
            case Command.STOP:
                self._pacer.stop()
            case Command.BIAS if arguments[0] in (0, 1):
                self._bias = self.measure(1)[0] if arguments[0] else np.zeros(6)
        return []

    def samples(self, count: int, response: int = Command.START) -> list[bytes]:
        """Return the response fields of the next samples."""
        wrench = self.measure(count)
        raw = raw_values(wrench - self._bias, self.model)
        if self.saturated_axis is not None:
            raw[:, self.saturated_axis] = 32767
        limit = OVERLOAD * np.asarray(self.model.capacity)
        overloaded = (np.abs(wrench) >= limit) | (raw == 32767) | (raw == -32768)
        bits = (overloaded @ (1 << np.arange(5, -1, -1))).tolist()
        sent = []
        for values, overload in zip(raw.tolist(), bits, strict=True):
            self._count_overload(overload | self.overload)
            sent.append(sample_field(response, values, overload | self.overload))
        return sent

    def _count_overload(self, overload: int) -> None:
        if overload & ~self._overloaded:
            for axis in range(6):
                if overload & ~self._overloaded & (0x20 >> axis):
                    self.overload_counts[axis] = min(self.overload_counts[axis] + 1, 255)
        self._overloaded = overload

    def _set(self, code: int, first: int, second: int, third: int) -> int:
        """Change a setting; return the error code, which is 0 after success."""
        if code in self.unsupported:
            return UNSUPPORTED
        match code:
            case Command.SET_FILTER if first in FILTER_TYPES and second in FILTER_CODES:
                self.filter = (first, second)
            case Command.SET_RATE if first < len(RATES_HZ) and RATES_HZ[first] <= self._fastest_hz:
                self.rate_code = first
            case Command.SET_BAUD if first < len(BAUD_RATES):
                self.stored_baud_code = first
            case Command.SET_IDS if len({first, second, third}) == 3:
                self.stored_ids = (first, second, third)
            case _:
                return OUT_OF_RANGE
        return 0

    @property
    def _fastest_hz(self) -> float:
        """Highest sample rate that the line allows to be set, Hz."""
        return max(RATES_HZ)

    def _response(self, code: int, *values: int) -> bytes:
        return bytes((code, *values)).ljust(RESPONSE_BYTES, b"\0")


@dataclass(eq=False)
class RobotousCanNode(RobotousSensor[CanFrame], CanSensor):
    """The sensor on a CAN bus. A command has 8 bytes, a response two frames of 8 bytes."""

    unsupported = frozenset({Command.SET_BAUD})

    def _boot(self) -> None:
        self.boot()

    def answer(self, request: CanFrame) -> list[CanFrame]:
        """Return the frames that answer a request; none if the frame is not a request."""
        if request != CanFrame(self.ids[0], request.data) or len(request.data) != COMMAND_BYTES:
            return []
        return self._frames(self.execute(request.data))

    def _samples(self, count: int) -> list[CanFrame]:
        return self._frames(self.samples(count))

    def _frames(self, responses: list[bytes]) -> list[CanFrame]:
        _receive, first, second = self.ids
        halves = [((first, field[:8]), (second, field[8:])) for field in responses]
        return [CanFrame(identifier, data) for pair in halves for identifier, data in pair]

    def _foreign_frame(self, rng: random.Random) -> CanFrame:
        identifier = rng.choice([i for i in (0x000, 0x003, 0x080, 0x101, 0x701) if i not in self.ids])
        extended = rng.random() < 0.5
        return CanFrame(self.ids[1] if extended else identifier, rng.randbytes(8), extended)


@dataclass(eq=False)
class RobotousSerialBox(RobotousSensor[bytes], SerialSensor):
    """The sensor on a UART, with packets of start byte, field, checksum and end byte."""

    unsupported = frozenset({Command.SET_IDS})

    def __post_init__(self) -> None:
        super().__post_init__()
        self._line = bytearray()

    @property
    def rate_hz(self) -> float:
        """Sample rate of a stream, Hz, at most what the line can transmit."""
        return min(super().rate_hz, BAUD_RATES[self.baud_code] / (10 * (RESPONSE_BYTES + 3)))

    @property
    def _fastest_hz(self) -> float:
        return FASTEST_HZ[BAUD_RATES[self.baud_code]]

    def power_up(self) -> None:
        """Set the state after power-up, see `Device.power_up`."""
        self._line.clear()
        self._fall_silent()
        self.boot()

    def _received(self, data: bytes) -> None:
        self._line += data
        for field in fields(self._line):
            self._wire.put([packet(response) for response in self.execute(field)])

    def _samples(self, count: int) -> list[bytes]:
        return [packet(field) for field in self.samples(count)]


def _identifiers(text: str) -> tuple[int, ...]:
    numbers = tuple(int(part, 0) for part in text.split(","))
    if len(set(numbers)) != 3 or not all(0 <= number < 0x800 for number in numbers):
        raise ValueError(f"expected 3 different CAN identifiers from 0 to 0x7FF, got {text!r}")
    return numbers


def _model(name: str) -> Model:
    if name not in MODELS:
        raise ValueError(f"unknown model {name!r}; known: {', '.join(MODELS)}")
    return MODELS[name]


KINDS = {
    "robotous-can": Kind(
        RobotousCanNode,
        "robotous-can",
        "interface=slcan&rate=1000",
        {"interface": "slcan", "bitrate": 1_000_000},
        settings={"model": ("model", _model), "ids": ("ids", _identifiers)},
    ),
    "robotous-serial": Kind(
        RobotousSerialBox,
        "robotous-serial",
        "baud=115200&rate=200",
        {"baud": 115_200},
        settings={"model": ("model", _model)},
    ),
}
