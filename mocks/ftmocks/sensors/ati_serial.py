"""An emulated ATI Digital F/T sensor: Modbus RTU over RS-485, and a 7 kHz stream of 13-byte records.

Ref: ATI 9620-05-Digital FT, sections 8.1, 8.3, 8.4; ATI 9610-05-1030-04, section 9 (the same port on a NETCANOEM).

Gains and offsets of the gauges in force (registers 0 to 11): four public programs write them from the calibration block
at every start, and one of them calls them volatile: KITrobotics/ati_force_torque, a Win32 driver for two Gamma Digital
F/T, one with minimalmodbus, and the header of a Teensy program for a NETCANOEM. The code of that Teensy program, and
another one for a real device, stream without writing them and receive good readings. Both are right only if the
registers are loaded at power-up. So the emulator loads those of the lowest calibration. A client that uses another
calibration reads wrong gauges unless it writes its gains. No source says that a client should not write them.

Does not model: baud mismatch (a pty has no speed), parity of what the client sends, collisions of a half-duplex line,
writing calibrations to storage, the power-up time.

Chosen here, because the sources leave it open: an empty calibration slot reads zeros. The 23 registers between two
slots do not exist. A read of more than 64 registers is answered with exception 3.
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ftmocks.arrays import Array
from ftmocks.sensors.ati_gauges import GAUGE_MAX, REFERENCE, WIRE_ORDER, Calibration
from ftmocks.sensors.kind import Kind
from ftmocks.wires.modbus import (
    DEVICE_FAILURE,
    ILLEGAL_ADDRESS,
    ILLEGAL_FUNCTION,
    ILLEGAL_VALUE,
    ModbusError,
    read_registers,
    written_registers,
)
from ftmocks.wires.stream import ModbusSensor

STREAM_HZ = 7000.0
RECORD_BYTES = 13
CHARACTER_BITS = 11
JAM_BYTES = 14
JAM_PAUSE_S = 0.050  # s; a longer pause restarts the jamming sequence
MAX_READ = 64

GAINS, OFFSETS, SESSION, STATUS, BAUD_STORE, BAUD = 0x0000, 0x0006, 0x000C, 0x001D, 0x001E, 0x001F
WRITABLE = {*range(GAINS, SESSION + 1), BAUD_STORE, BAUD}
CALIBRATION, CALIBRATION_STRIDE, CALIBRATION_SLOTS, CALIBRATION_REGISTERS = 0x00E3, 192, 16, 169
DIAGNOSTICS = dict(enumerate((0x07FF, 0x0000, 0x0A3C, 0x09C4, 0x0800, 0x0003), start=0x0027))
BAUD_RATES = (1_250_000, 19_200, 115_200)


def stream_records(gauges: NDArray[np.int16], *, error: bool = False) -> NDArray[np.uint8]:
    """Return stream records of gauge counts.

    Parameters
    ----------
    gauges
        (n, 6) gauge counts in natural order.
    error
        Error bit, which is bit 7 of the checksum byte.

    Returns
    -------
    (n, 13) bytes: gauges 0 2 4 1 3 5 as big-endian int16, then the 7-bit sum of these twelve bytes.
    """
    records = np.empty((len(gauges), RECORD_BYTES), dtype=np.uint8)
    records[:, :12] = gauges[:, WIRE_ORDER].astype(">i2", order="C").view(np.uint8)
    checksum = np.add.reduce(records[:, :12], axis=1, dtype=np.uint8)
    records[:, 12] = (checksum & 0x7F) | (0x80 if error else 0)
    return records


def calibration_block(calibration: Calibration) -> bytes:
    """Return the 338 bytes of a calibration slot. Resolution, range, scale factors, user and spare fields are zero."""
    block = b"".join(
        (
            calibration.serial.encode("ascii").ljust(8, b"\0"),
            calibration.part_number.encode("ascii").ljust(32, b"\0"),
            b"Net\0",
            calibration.date.encode("ascii").ljust(20, b"\0"),
            calibration.matrix.astype(">f4").tobytes(),
            bytes((calibration.force_unit, calibration.torque_unit)),
            struct.pack(">6f", *calibration.max_rating),
            struct.pack(">2i", calibration.counts_per_force, calibration.counts_per_torque),
            struct.pack(">6H", *calibration.gauge_gains),
            struct.pack(">6H", *calibration.gauge_offsets),
        )
    )
    return block.ljust(2 * CALIBRATION_REGISTERS, b"\0")


@dataclass(eq=False, kw_only=True)
class AtiSerialBox(ModbusSensor):
    """The RS-485 interface of the sensor.

    A frame is a reply or a record. The stream has no sync byte: without noise of at least one gauge count, shifted
    records would have correct checksums.

    Parameters
    ----------
    calibrations
        Calibrations by slot, 1 to 16. The lowest one describes the transducer.
    loads_gains
        Whether gains and offsets of the lowest calibration are active after power-up; otherwise they are 0.
    status
        Status word; its bit 15 is the error bit of every record.
    gauge_offset
        (6,) or scalar offset of the gauges, counts.
    streaming_at_start
        Whether the sensor streams after power-up, as after a crash of the last client.
    refuse_start
        Whether the sensor refuses the start command.
    bad_checksum
        Probability that a record has a wrong checksum and correct data.
    """

    address = 0x0A
    frame_gap_s = 1.75e-3  # pause that ends a Modbus RTU frame; fixed above 19 200 baud
    has_parity = True

    calibrations: Mapping[int, Calibration] = field(default_factory=lambda: {1: REFERENCE})
    loads_gains: bool = True
    status: int = 0
    gauge_offset: float | Sequence[float] = 0.0
    streaming_at_start: bool = False
    refuse_start: bool = False
    bad_checksum: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._random = np.random.default_rng(self.seed)
        self._stored_baud_code = 0
        self._registers: dict[int, int] = {}
        self._unlocked = False

    def power_up(self) -> None:
        """Set the state after power-up, see `Device.power_up`."""
        self._registers = dict.fromkeys(range(GAINS, SESSION + 1), 0)
        self._registers |= {BAUD_STORE: 0, BAUD: self._stored_baud_code}
        for slot in range(1, CALIBRATION_SLOTS + 1):
            calibration = self.calibrations.get(slot)
            block = calibration_block(calibration) if calibration else bytes(2 * CALIBRATION_REGISTERS)
            words = struct.unpack(f">{CALIBRATION_REGISTERS}H", block)
            self._registers |= dict(enumerate(words, start=CALIBRATION + (slot - 1) * CALIBRATION_STRIDE))
        if self.loads_gains:
            gains_offsets = (*self._transducer.gauge_gains, *self._transducer.gauge_offsets)
            self._registers |= dict(enumerate(gains_offsets, start=GAINS))
        self._unlocked = False
        self._burst.clear()
        self._fall_silent()
        if self.streaming_at_start:
            self._start_streaming()

    def _received(self, data: bytes) -> None:
        now_s = self.clock.now_s()
        if self.streaming and now_s - self._last_byte_s > JAM_PAUSE_S:
            self._burst.clear()
        self._last_byte_s = now_s
        self._remember(data)
        if self.streaming and len(self._burst) >= JAM_BYTES:
            self._fall_silent()  # bytes that follow without a pause belong to the jamming sequence

    def _deliver(self, frames: list[bytes]) -> None:
        for data in frames:
            self.dropped_frames += self._send(data, RECORD_BYTES if self.streaming else len(data))

    def _execute(self, function: int, data: bytes) -> bytes:
        match function:
            case 0x03:
                return read_registers(data, self._registers | {STATUS: self.status}, MAX_READ)
            case 0x04:
                return read_registers(data, DIAGNOSTICS, MAX_READ)
            case 0x10:
                return self._write_registers(data)
            case 0x46 | 0x6A if len(data) != 1:
                raise ModbusError(ILLEGAL_VALUE)
            case 0x46:
                accepted = data == b"\x55" and not self.refuse_start
                if accepted:
                    self._start_streaming()
                return bytes([accepted])
            case 0x6A:
                accepted = data in (b"\xaa", b"\x18")
                if accepted:
                    self._unlocked = data == b"\xaa"
                return bytes([accepted])
        raise ModbusError(ILLEGAL_FUNCTION)

    def _write_registers(self, data: bytes) -> bytes:
        values = written_registers(data)
        if not values.keys() <= WRITABLE:
            raise ModbusError(ILLEGAL_ADDRESS)
        if min(values) < SESSION and not self._unlocked:
            raise ModbusError(DEVICE_FAILURE)
        if values.get(BAUD, 0) >= len(BAUD_RATES):
            raise ModbusError(ILLEGAL_VALUE)
        self._registers |= values
        if BAUD in values and self._registers[BAUD_STORE] == 1:
            self._stored_baud_code = values[BAUD]
        return data[:4]

    def _start_streaming(self) -> None:
        self.dropped_frames = 0
        self._pacer.start(min(STREAM_HZ, BAUD_RATES[self._registers[BAUD]] / (CHARACTER_BITS * RECORD_BYTES)))

    def _samples(self, count: int) -> list[bytes]:
        records = stream_records(self.gauges(count), error=bool(self.status & 0x8000))
        if self.bad_checksum:
            records[self._random.random(count) < self.bad_checksum, 12] ^= 0x01
        data = records.tobytes()
        size = RECORD_BYTES if self.faults.harm_frames else len(data)
        return [data[i : i + size] for i in range(0, len(data), size)]

    @property
    def _transducer(self) -> Calibration:
        return self.calibrations[min(self.calibrations)]

    def gauges(self, count: int) -> NDArray[np.int16]:
        """Return gauges (count, 6) with the active gains and offsets, which may not be those of the calibration."""
        calibration = self._transducer
        active = np.array([self._registers[address] for address in range(GAINS, SESSION)], dtype=np.float64)
        gain: Array = active[:6] / calibration.gauge_gains
        shift = gain * np.asarray(self.gauge_offset) + (active[6:] - calibration.gauge_offsets) / 4
        gauges = calibration.gauges(self.measure(count), gain=gain, shift=shift)
        if self.saturated_axis is not None:
            gauges[:, self.saturated_axis] = GAUGE_MAX
        return gauges


KINDS = {"serial": Kind(AtiSerialBox, "ati-serial")}
