"""An emulated Robotiq FT 300 or FT 300-S: Modbus RTU, and a 100 Hz stream of 16-byte frames.

Ref: Robotiq FT 300 instruction manual, section "Control" (registers, data stream).

Does not model: parity and baud mismatch, accelerometer readings (they report gravity along the sensor's z axis).

Chosen here, because the sources leave it open: requests during a stream are not answered. Only 50 bytes FF in a row end
the stream. Access to a missing register gives exception 2. Only register 410 can be written: 0x0200 starts the stream,
any other value has no effect. The stream has neither status nor overload.
"""

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ftmocks.arrays import Array
from ftmocks.sensors.kind import Kind
from ftmocks.wires import modbus
from ftmocks.wires.stream import ModbusSensor

STREAM_HZ = 100.0
HEADER = b"\x20\x4e"
STOP_BYTE, STOP_COUNT = 0xFF, 50
MAX_READ = 125
WRENCH, ACCELERATION, OUTPUT, FIRMWARE, SERIAL, YEAR = 180, 190, 410, 500, 510, 514
STREAM_OUTPUT = 0x0200
COUNTS_PER_SI = np.array([100.0] * 3 + [1000.0] * 3)
ONE_G = (0, 0, 1000)


def raw_values(wrench: Array) -> NDArray[np.int16]:
    """Return counts (n, 6) of wrenches (n, 6): hundredths of N and thousandths of N·m, clipped."""
    counts: Array = np.rint(wrench * COUNTS_PER_SI)
    return counts.clip(-32768, 32767).astype(np.int16)


def stream_frame(raw: list[int]) -> bytes:
    """Return the frame of a sample: header, six little-endian int16, CRC-16/MODBUS over both."""
    return modbus.with_crc(HEADER + struct.pack("<6h", *raw))


@dataclass(eq=False, kw_only=True)
class RobotiqBox(ModbusSensor):
    """The sensor on its RS-485 or USB line.

    Parameters
    ----------
    firmware
        Three letters, of which the first is F, then three numbers.
    serial
        Three letters and a number, which is 0 if the sensor does not know it.
    year
        Year of production.
    streaming_at_start
        Whether the sensor streams after power-up, as some sensors do, or as after a crash of the last client.
    """

    address = 0x09
    frame_gap_s = 2e-3  # pause that ends a request: 3.5 characters at 19200 baud

    firmware: tuple[str, int, int, int] = ("FTS", 2, 0, 1)
    serial: tuple[str, int] = ("FTS", 1234)
    year: int = 2022
    streaming_at_start: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        self._output = 0
        self._stop_bytes = 0

    def power_up(self) -> None:
        """Set the state after power-up, see `Device.power_up`."""
        self._burst.clear()
        self._fall_silent()
        self._output = self._stop_bytes = 0
        if self.streaming_at_start:
            self._pacer.start(STREAM_HZ)

    def _received(self, data: bytes) -> None:
        self._last_byte_s = self.clock.now_s()
        for byte in data:
            if not self.streaming:
                self._remember(bytes([byte]))
                continue
            self._stop_bytes = self._stop_bytes + 1 if byte == STOP_BYTE else 0
            if self._stop_bytes == STOP_COUNT:
                self._stop_bytes = 0
                self._pacer.stop()  # bytes that follow without a pause are not a request: their CRC is wrong

    def _work(self, now_s: float) -> float | None:
        wait_s = super()._work(now_s)
        if self._output == STREAM_OUTPUT:
            self._output = 0
            self._pacer.start(STREAM_HZ)
        return wait_s

    def _execute(self, function: int, data: bytes) -> bytes:
        match function:
            case 0x03:
                return modbus.read_registers(data, self._registers(), MAX_READ)
            case 0x10:
                written = modbus.written_registers(data)
                if written.keys() != {OUTPUT}:
                    raise modbus.ModbusError(modbus.ILLEGAL_ADDRESS)
                self._output = written[OUTPUT]
                return data[:4]
        raise modbus.ModbusError(modbus.ILLEGAL_FUNCTION)

    def _registers(self) -> dict[int, int]:
        letters, *numbers = self.firmware
        firmware = struct.unpack(">3H", letters.encode("ascii") + bytes(numbers))
        series, number = self.serial
        third_letter = series.encode("ascii")[2] << 8
        first_letters = int.from_bytes(series.encode("ascii")[:2], "big")
        serial = (first_letters, third_letter, number & 0xFFFF, number >> 16)
        blocks = {
            WRENCH: [value & 0xFFFF for value in self._raw(1)[0].tolist()],
            ACCELERATION: ONE_G,
            OUTPUT: (self._output,),
            FIRMWARE: firmware,
            SERIAL: serial,
            YEAR: (self.year,),
        }
        return {first + i: value for first, values in blocks.items() for i, value in enumerate(values)}

    def _raw(self, count: int) -> NDArray[np.int16]:
        raw = raw_values(self.measure(count))
        if self.saturated_axis is not None:
            raw[:, self.saturated_axis] = 32767
        return raw

    def _samples(self, count: int) -> list[bytes]:
        return [stream_frame(raw) for raw in self._raw(count).tolist()]


BIAS_SCALE = (3.3, 1.2)
"""One at rest reads (-20.7, 22.0, -48.7) N and (-0.10, 1.17, -0.32) N·m: ros-industrial-attic/robotiq, request 215."""

KINDS = {"robotiq": Kind(RobotiqBox, "robotiq-ft300", bias_scale=BIAS_SCALE)}
