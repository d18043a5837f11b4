"""An emulated Bota Systems SensONE with a serial interface: text commands, and a stream of 37-byte frames.

Ref: Bota Systems, SensONE serial user manual and the vendor's Python example (configuration, frame, CRC), which uses
460800 baud and opens the port before it waits for ``App Init``. The vendor's driver rokubimini_serial:

* Its version for ROS 1 waits for 3 s after it has opened the port, because the sensor boots (init).
* Its version for ROS 2 has 230400 baud as default and 460800 as maximum (DEFAULT_BAUD_RATE_OPTION). It sends ``#`` for
  a restart at every speed. Then it finds ``c,D,D,D,D`` at 230400 baud, and at the speed of the sensor ``App Init``,
  ``name: NAME``, ``S/N: NUMBER`` and ``FW version: VERSION``, each ended by CR. ``s`` stores the configuration.

Does not model: the filters' effect on the readings (only the sampling time follows from the sinc length), offsets and
tare, raw output, and two openings within 5 ms, which count as one.

Chosen here, because the sources leave it open: the sensor restarts whenever a client opens the port, as with an adapter
that supplies it, and prints its configuration after half of `boot_s`. At another speed, both sides receive noise.
Commands need no line ending; CR, LF and spaces between them are ignored. While the sensor streams, it ignores
all but ``C``, ``I`` and ``#``. A configuration command with values out of range, or an unknown one, is answered
with error 1. A restart brings back what was stored; a new speed needs one. The CSV format is one line per sample with
the fields of the frame. The sinc length may be 64 (800 Hz, the fastest of the data sheet) to 2048. ``p?`` is answered
with ``p,0,NUMBER,1,0,NAME`` and ``r,0,p,0``.
"""

import random
import re
import struct
import termios
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ftmocks.sensors.kind import Kind
from ftmocks.wires.stream import SerialSensor

HEADER = b"\xaa"
LONGEST_COMMAND = len(b"f,2048,0,0,0")
SINC_UNIT_S = 19.53125e-6
SINC_LENGTHS = range(64, 2049)
BAUD_RATES = (9600, 57_600, 115_200, 230_400, 460_800)
BOOT_BAUD_CODE = 3
NAME = b"SensONE"
OVERRANGE, RAW_OUTPUT = 0x0002, 0x0008
CAPACITY = (500.0, 500.0, 1200.0, 15.0, 15.0, 12.0)
_SPEEDS = (termios.B9600, termios.B57600, termios.B115200, termios.B230400, termios.B460800)
_COMMUNICATION = re.compile(rb"c,([01]),([01]),([01]),([0-4])")
_FILTER = re.compile(rb"f,(\d{1,4}),([01]),([01]),([01])")
_COMMAND = re.compile(rb"[CRIs#]|p\?|[cf](?:,\d+){3},\d")
_WHILE_STREAMING = re.compile(rb"[CI#]")


def _x25_entry(byte: int) -> int:
    for _ in range(8):
        byte = (byte >> 1) ^ (0x8408 if byte & 1 else 0)
    return byte


_X25 = [_x25_entry(byte) for byte in range(256)]


def crc16_x25(data: bytes) -> bytes:
    """Return the CRC-16/X-25, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc = (crc >> 8) ^ _X25[(crc ^ byte) & 0xFF]
    return (crc ^ 0xFFFF).to_bytes(2, "little")


def stream_frame(status: int, wrench: list[float], timestamp_us: int, temperature_C: float) -> bytes:
    """Return the frame of a sample: header, 34 bytes of data (little-endian), and their CRC."""
    payload = struct.pack("<H6fIf", status, *wrench, timestamp_us & 0xFFFFFFFF, temperature_C)
    return HEADER + payload + crc16_x25(payload)


def banner(serial: int) -> bytes:
    """Return the text that the sensor prints after it has booted."""
    return b"App Init\r\nname: %b\r\nS/N: %d\r\nFW version: 1.2.0\r\n" % (NAME, serial)


@dataclass(eq=False, kw_only=True)
class BotaBox(SerialSensor):
    """The sensor on its RS-422 or USB line.

    Parameters
    ----------
    sinc_length
        Length of the filter at power-up. The sample period is 19.53125 µs times this.
    baud_code
        Index of the active baud rate in `BAUD_RATES`.
    serial
        Serial number.
    capacity
        (6,) largest force and torque, N and N·m, at which readings are clipped and marked as overrange.
    temperature_C
        Temperature that is sent with every sample.
    status
        Status bits in addition to those that follow from readings and configuration.
    streaming_at_start
        Whether the sensor has its own supply and streams, so it does not restart when a client opens the port.
    boot_s
        Time from the opening of the port, or a restart, to the end of the banner and the first sample.
    """

    sinc_length: int = 512
    baud_code: int = 4
    serial: int = 12345
    capacity: Sequence[float] = CAPACITY
    temperature_C: float = 25.5
    status: int = 0
    streaming_at_start: bool = False
    boot_s: float = 3.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.sees_openings = not self.streaming_at_start
        self.csv = False
        self.calibrated = True
        self._next_baud_code = self.baud_code
        self._stored = self._settings
        self._noise = random.Random(self.seed)
        self._line = b""
        self._was_open = False
        self._boot_texts: list[tuple[float, bytes, int]] = []
        """Texts that the sensor prints before it streams: time, text, and code of the baud rate."""
        self._powered_s = self._stream_start_us = 0.0

    @property
    def sample_s(self) -> float:
        """Sample period, s."""
        return SINC_UNIT_S * self.sinc_length

    @property
    def _settings(self) -> tuple[int, int, bool, bool]:
        return self.sinc_length, self._next_baud_code, self.csv, self.calibrated

    def power_up(self) -> None:
        """Set the state after power-up, see `Device.power_up`."""
        self._was_open = False
        self._restart()
        if self.streaming_at_start:
            self._boot_texts.clear()
            self._run()

    def _restart(self) -> None:
        self._line = b""
        self._fall_silent()
        self.sinc_length, self._next_baud_code, self.csv, self.calibrated = self._stored
        self.baud_code = self._next_baud_code
        self._powered_s = now_s = self.clock.now_s()
        setup = b"c,0,%d,%d,%d\r\n" % (self.calibrated, self.csv, self.baud_code)
        self._boot_texts = [
            (now_s + self.boot_s / 2, setup, BOOT_BAUD_CODE),
            (now_s + self.boot_s, banner(self.serial), self.baud_code),
        ]

    def _work(self, now_s: float) -> float | None:
        was_open, self._was_open = self._was_open, self._is_open
        if not self._was_open:
            self._fall_silent()
            self._boot_texts.clear()
            return None
        if self.sees_openings and not was_open:
            self._restart()
        while self._boot_texts and self._boot_texts[0][0] <= now_s:
            _, text, baud_code = self._boot_texts.pop(0)
            self._wire.put(self._as_received([text], baud_code))
            if not self._boot_texts:
                self._run()
        return self._boot_texts[0][0] - now_s if self._boot_texts else None

    def _received(self, data: bytes) -> None:
        if self._boot_texts or not self._client_has(self.baud_code):
            return
        self._line += data
        while self._line:
            if self.streaming:
                heard = _WHILE_STREAMING.search(self._line)
                self._line = self._line[heard.end() :] if heard else b""
                if heard:
                    self._execute(heard[0])
                continue
            self._line = self._line.lstrip(b"\r\n ")
            command = _COMMAND.match(self._line)
            if command is None:
                self._refuse_what_is_no_command()
                return
            self._line = self._line[command.end() :]
            self._execute(command[0])

    def _refuse_what_is_no_command(self) -> None:
        """Answer bytes that cannot begin a command with an error; keep the beginning of a command."""
        if self._line and (self._line[:1] not in b"cfp" or len(self._line) > LONGEST_COMMAND):
            self._answer(self._line[:1], error=1)
            self._line = b""

    def _execute(self, command: bytes) -> None:
        communication, filters = _COMMUNICATION.fullmatch(command), _FILTER.fullmatch(command)
        error = 0
        if communication:
            self.calibrated, self.csv = communication[2] == b"1", communication[3] == b"1"
            self._next_baud_code = int(communication[4])
        elif filters and int(filters[1]) in SINC_LENGTHS:
            self.sinc_length = int(filters[1])
        elif command == b"#":
            self._restart()
            return
        elif command in (b"C", b"I"):
            self._pacer.stop()
        elif command == b"s":
            self._stored = self._settings
        elif command == b"p?":
            self._print(b"p,0,%d,1,0,%b\r\n" % (self.serial, NAME))
        elif command != b"R":
            error = 1
        self._answer(command[:1], error=error)
        if command == b"R":
            self._run()

    def _answer(self, letter: bytes, *, error: int = 0) -> None:
        self._print(b"r,%d,%b,0\r\n" % (error, letter))

    def _print(self, text: bytes) -> None:
        self._wire.put(self._as_received([text], self.baud_code))

    def _client_has(self, baud_code: int) -> bool:
        """Return whether the client's port is set to this baud rate; True if there is no terminal to show it."""
        return self._file < 0 or termios.tcgetattr(self._file)[5] == _SPEEDS[baud_code]

    def _as_received(self, frames: list[bytes], baud_code: int) -> list[bytes]:
        """Return what the client receives of frames at this baud rate: noise if the client has another one."""
        if self._client_has(baud_code):
            return frames
        return [self._noise.randbytes(len(frame) // 2) for frame in frames]

    def _samples(self, count: int) -> list[bytes]:
        status = self.status | (0 if self.calibrated else RAW_OUTPUT)
        clipped, overrange = self._readings(count, np.asarray(self.capacity))
        first = self._pacer.made - count
        frames = [
            self._frame(status | (OVERRANGE if over else 0), row.tolist(), first + i)
            for i, (over, row) in enumerate(zip(overrange, clipped, strict=True))
        ]
        return self._as_received(frames, self.baud_code)

    def _frame(self, status: int, wrench: list[float], number: int) -> bytes:
        timestamp_us = int(self._stream_start_us + number * 1e6 * self.sample_s) & 0xFFFFFFFF
        if not self.csv:
            return stream_frame(status, wrench, timestamp_us, self.temperature_C)
        numbers = ",".join(f"{value:.6g}" for value in wrench)
        return f"{status},{numbers},{timestamp_us},{self.temperature_C:.2f}\r\n".encode("ascii")

    def _run(self) -> None:
        """Start the stream of samples; its time stamps count from power-up."""
        self._stream_start_us = (self.clock.now_s() - self._powered_s) * 1e6
        self._pacer.start(1 / self.sample_s)


def _baud_code(text: str) -> int:
    if not text.isdecimal() or int(text) not in BAUD_RATES:
        raise ValueError(f"unknown baud rate {text!r}; known: {', '.join(map(str, BAUD_RATES))}")
    return BAUD_RATES.index(int(text))


def _seconds(text: str) -> float:
    if not 0.0 <= float(text) < np.inf:
        raise ValueError(f"expected a time in s, got {text!r}")
    return float(text)


KINDS = {
    "bota": Kind(
        BotaBox, "bota", settings={"baud": ("baud_code", _baud_code), "boot-s": ("boot_s", _seconds)}, floats=True
    )
}
