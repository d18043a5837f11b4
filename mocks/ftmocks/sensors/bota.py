"""An emulated Bota Systems SensONE with serial interface: text commands, and a stream of 37-byte frames.

Ref: Bota Systems, SensONE serial user manual and the vendor's Python example (configuration, frame, CRC).

Does not model: line speed, the filters' effect on the readings (only the sampling time follows from the sinc length),
offsets and tare, raw output.

Chosen here, because the sources leave it open: the text around ``App Init``. Commands need no line ending; CR, LF and
spaces between them are ignored. While the sensor streams, it ignores everything but ``C``. A configuration command with
values out of range, or an unknown one, is answered with error 1. Settings survive `reset`. The CSV format is one line
per sample with the fields of the frame. The sinc length may be 51 to 4096.
"""

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ftmocks.wires.stream import SerialSensor

HEADER = b"\xaa"
LONGEST_COMMAND = len(b"f,4096,0,0,0")
SINC_UNIT_S = 19.53125e-6
SINC_LENGTHS = range(51, 4097)
BANNER = b"Bota Systems AG\r\nSensONE\r\nApp Init\r\n"
OVERRANGE, RAW_OUTPUT = 0x0002, 0x0008
CAPACITY = (500.0, 500.0, 1200.0, 15.0, 15.0, 12.0)
_COMMUNICATION = re.compile(rb"c,([01]),([01]),([01]),([0-4])")
_FILTER = re.compile(rb"f,(\d{1,4}),([01]),([01]),([01])")
_COMMAND = re.compile(rb"[CR]|[cf](?:,\d+){3},\d")


def _x25_entry(byte: int) -> int:
    for _ in range(8):
        byte = (byte >> 1) ^ (0x8408 if byte & 1 else 0)
    return byte


_X25 = [_x25_entry(byte) for byte in range(256)]


def crc16_x25(data: bytes) -> bytes:
    """Return the CRC-16/X-25 as it goes on the wire, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc = (crc >> 8) ^ _X25[(crc ^ byte) & 0xFF]
    return (crc ^ 0xFFFF).to_bytes(2, "little")


def stream_frame(status: int, wrench: list[float], timestamp_us: int, temperature_C: float) -> bytes:
    """One sample: header, 34 bytes of payload, all little-endian, and their CRC."""
    payload = struct.pack("<H6fIf", status, *wrench, timestamp_us & 0xFFFFFFFF, temperature_C)
    return HEADER + payload + crc16_x25(payload)


@dataclass(eq=False, kw_only=True)
class BotaBox(SerialSensor):
    """The sensor on its RS-422 or USB line.

    Parameters
    ----------
    sinc_length
        Of the filter at power-up: a sample takes 19.53125 µs times this.
    capacity
        (6,) in N and N·m: readings are clipped there and marked as overrange.
    temperature_C
        Reported with every sample.
    status
        Status bits set besides those that follow from the readings and the configuration.
    streaming_at_start
        Streams already when the client opens it; else it powers up at `start` and sends its banner first.
    boot_s
        Silence before the banner.
    """

    sinc_length: int = 512
    capacity: Sequence[float] = CAPACITY
    temperature_C: float = 25.5
    status: int = 0
    streaming_at_start: bool = True
    boot_s: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        self.baud_code = 4
        self.csv = False
        self.calibrated = True
        self._line = b""
        self._boots_at_s: float | None = None
        self._powered_s = self._stream_start_us = 0.0

    @property
    def sample_s(self) -> float:
        """Sampling period."""
        return SINC_UNIT_S * self.sinc_length

    def _power_up(self) -> None:
        self._restart()
        if self.streaming_at_start:
            self._boots_at_s = None
            self._run()

    def _restart(self) -> None:
        self._line = b""
        self._fall_silent()
        self._powered_s = self.clock.now_s()
        self._boots_at_s = self.clock.now_s() + self.boot_s

    def _work(self, now_s: float) -> float | None:
        if self._boots_at_s is None:
            return None
        if now_s < self._boots_at_s:
            return self._boots_at_s - now_s
        self._boots_at_s = None
        self._wire.put([BANNER])
        self._run()
        return None

    def _received(self, data: bytes) -> None:
        if self._boots_at_s is not None:
            return
        self._line += data
        while self._line:
            if self.streaming:
                _, found, self._line = self._line.partition(b"C")
                if found:
                    self._pacer.stop()
                    self._answer(b"C")
                continue
            self._line = self._line.lstrip(b"\r\n ")
            command = _COMMAND.match(self._line)
            if command is None:
                self._refuse_what_is_no_command()
                return
            self._line = self._line[command.end() :]
            self._execute(command[0])

    def _refuse_what_is_no_command(self) -> None:
        """Keep the beginning of a command, and answer anything else with an error."""
        if self._line and (self._line[:1] not in b"cf" or len(self._line) > LONGEST_COMMAND):
            self._answer(self._line[:1], error=1)
            self._line = b""

    def _execute(self, command: bytes) -> None:
        communication, filters = _COMMUNICATION.fullmatch(command), _FILTER.fullmatch(command)
        error = 0
        if communication:
            self.calibrated, self.csv = communication[2] == b"1", communication[3] == b"1"
            self.baud_code = int(communication[4])
        elif filters and int(filters[1]) in SINC_LENGTHS:
            self.sinc_length = int(filters[1])
        elif command not in (b"C", b"R"):
            error = 1
        self._answer(command[:1], error=error)
        if command == b"R":
            self._run()

    def _answer(self, letter: bytes, *, error: int = 0) -> None:
        self._wire.put([b"r,%d,%b,0\r\n" % (error, letter)])

    def _samples(self, count: int) -> list[bytes]:
        status = self.status | (0 if self.calibrated else RAW_OUTPUT)
        clipped, overrange = self._readings(count, np.asarray(self.capacity))
        first = self._pacer.made - count
        return [
            self._frame(status | (OVERRANGE if over else 0), row.tolist(), first + i)
            for i, (over, row) in enumerate(zip(overrange, clipped, strict=True))
        ]

    def _frame(self, status: int, wrench: list[float], number: int) -> bytes:
        timestamp_us = int(self._stream_start_us + number * 1e6 * self.sample_s) & 0xFFFFFFFF
        if not self.csv:
            return stream_frame(status, wrench, timestamp_us, self.temperature_C)
        numbers = ",".join(f"{value:.6g}" for value in wrench)
        return f"{status},{numbers},{timestamp_us},{self.temperature_C:.2f}\r\n".encode("ascii")

    def _run(self) -> None:
        """Stream, with the timestamp that counts since power-up."""
        self._stream_start_us = (self.clock.now_s() - self._powered_s) * 1e6
        self._pacer.start(1 / self.sample_s)
