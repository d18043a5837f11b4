"""ATI Digital F/T and NETCANOEM force/torque sensors over RS-485.

Ref: ATI "Digital F/T" Modbus interface (sections 8.1, 8.3, 8.4 of 9620-05-Digital FT, as cited by public drivers).
Checked on hardware: no. Verified against: tests/unit/drivers/ati/test_modbus.py and the emulator (tests/wire).

The sensor is set up by Modbus RTU and then sends a stream of 13-byte records at 7 kHz. The stream continues after the
program that started it has ended; only a jamming sequence stops it. Gains and offsets of the gauges are volatile: after
power-up they are those of the lowest stored calibration. The driver writes them if they differ from its calibration.
"""

import logging
import struct
from collections.abc import Callable, Sequence
from typing import Self

import numpy as np

from ftdrivers.ati import modbus
from ftdrivers.ati.codec import Calibration, decode_text, refuse_saturated, units
from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import UNUSABLE, DeviceFault, DeviceTimeout, ProtocolError, StreamBroken
from ftdrivers.interfaces import NOT_REPORTED, DeviceInfo, Fact, FtSamples
from ftdrivers.registry import Options
from ftdrivers.streaming.sensor import StreamingSensor, scale_facts
from ftdrivers.wires.framing import describe_status
from ftdrivers.wires.modbus import ask
from ftdrivers.wires.serial_port import SerialPort, SerialProbe

log = logging.getLogger(__name__)

_BAUD = 1_250_000
# Time-out of one read, s, and the silence, s, after which the stream counts as stopped.
_READ_S = 0.02
_REPLY_S = 0.1
_SILENCE_S = 0.2
# Bytes for which one read waits, 4 ms of stream. Larger batches need less CPU but delay the guards. The records of a
# batch share one time stamp, because evenly spread stamps would suggest a precision that they do not have.
_BATCH_BYTES = 28 * modbus.RECORD_SIZE
# An error bit without a bit in the status word means a damaged byte; this many in a row are a fault.
_MAX_RESTARTS = 3


class AtiSerialSensor(StreamingSensor):
    """An ATI Digital F/T (or the RS-485 port of a NETCANOEM) on a serial port, 7 kHz.

    Records carry neither time nor number. `t_host_ns` is the time at which a batch of at least 28 records was received,
    `t_device_s` is NaN. `seq` counts records, including damaged ones (wrong sum or parity) and, estimated from the
    clock, those lost during a restart of the stream. `counts` are the six gauges. `status` is the last status word: a
    record only has an error bit, and if it is set, the driver stops the stream and reads the word. If the word explains
    the bit and is not critical, the stream continues.

    Parameters
    ----------
    port : str
        Serial port. A path such as ``/dev/serial/by-id/…`` remains valid after replugging.
    calibration : int
        Number of the stored calibration, 1 to 16.
    sign : int
        -1 for a sensor that reports the reaction.
    """

    def __init__(self, port: str, *, calibration: int = 1, sign: int = 1, clock: Clock = REAL) -> None:
        super().__init__(f"ATI serial sensor on {port}", sign=sign, clock=clock)
        self._calibration_index = calibration
        self._port = SerialPort(self.name, port, _BAUD, even_parity=True, read_s=_READ_S, clock=clock)
        self._buffer = bytearray()
        # Indices of the bytes in the buffer that arrived with wrong parity.
        self._damaged: list[int] = []
        self._seq = self._status = self._restarts = 0
        self._slipped = False
        # Time of the last record before a restart, ns; None after the first record of the restarted stream.
        self._last_good_ns: int | None = None

    @classmethod
    def from_url(cls, address: str, options: Options, *, sign: int = 1, clock: Clock = REAL) -> Self:
        """Build the driver from an address such as ``ati-serial:///dev/serial/by-id/…?calibration=1``."""
        return cls(address, calibration=options.integer("calibration", 1, 1, 16), sign=sign, clock=clock)

    def _connect(self) -> DeviceInfo:
        self._seq = self._restarts = self._status = 0
        self._slipped, self._last_good_ns = False, None
        self._nominal_Hz = modbus.NOMINAL_RATE_Hz
        self._port.open()
        self._judge_status(self._stop_stream())
        stored = b"".join(
            self._ask(modbus.read_registers(register, count))
            for register, count in modbus.calibration_reads(self._calibration_index)
        )
        try:
            block = modbus.decode_calibration_block(stored)
            self._calibration = Calibration.from_vendor(block.matrix, block.counts_per_unit, block.unit_codes)
        except ProtocolError as exc:
            raise ProtocolError(
                f"{self.name}: calibration slot {self._calibration_index}: {exc.found}",
                "choose another slot, with calibration=1 to 16 in its address",
            ) from exc
        self._set_gauges(block.gains, block.offsets)
        self._start_stream()
        facts = scale_facts(self._calibration.counts_per_N, self._calibration.counts_per_Nm, "device")
        rating = np.array(block.max_rating) * np.repeat(units(block.unit_codes), 3)
        if np.isfinite(rating).all() and (rating > 0).all():
            facts["range"] = Fact(tuple(rating.tolist()), "device")
        return DeviceInfo(
            model=f"ATI Digital F/T {block.part_number}".strip(),
            serial=block.serial,
            firmware=NOT_REPORTED,
            facts=facts,
        )

    def _set_gauges(self, gains: Sequence[int], offsets: Sequence[int]) -> None:
        """Write gains and offsets of the calibration in use, unless they are active already."""
        active = self._ask(modbus.read_registers(modbus.GAINS, len(gains) + len(offsets)))
        if active == struct.pack(f">{len(gains) + len(offsets)}H", *gains, *offsets):
            return
        self._ask(modbus.UNLOCK)
        try:
            self._ask(modbus.write_registers(modbus.GAINS, gains))
            self._ask(modbus.write_registers(modbus.OFFSETS, offsets))
        finally:
            self._ask(modbus.LOCK)

    def _read_block(self) -> FtSamples:
        if self._slipped:
            self._restart()
        data, damaged = self._port.read_marked(_BATCH_BYTES)
        t_host_ns = self._clock.now_ns()
        self._damaged += [len(self._buffer) + place for place in damaged]
        self._buffer += data
        whole = len(self._buffer) // modbus.RECORD_SIZE * modbus.RECORD_SIZE
        records = modbus.decode_records(bytes(self._buffer[:whole]), self._damaged)
        keep, settled, slipped = modbus.keep_records(records.intact)
        keep &= records.parity[:settled]
        used = settled * modbus.RECORD_SIZE
        del self._buffer[:used]
        self._damaged = [place - used for place in self._damaged if place >= used]
        flagged = keep & records.error[:settled]
        suspect = bool(flagged.any()) and not self._status & modbus.ANY_ERROR
        if suspect:
            keep &= ~flagged
        elif keep.any() and not flagged.any():
            self._status &= ~modbus.ANY_ERROR  # the error has ended; log the next one again
        gauges = records.gauges[:settled][keep]
        seq = self._seq + 1 + np.flatnonzero(keep)
        if self._last_good_ns is not None and len(gauges):
            missed = max(0, round((t_host_ns - self._last_good_ns) * 1e-9 * modbus.NOMINAL_RATE_Hz) - settled)
            seq += missed
            self._seq += missed
            self._lost += missed
            self._last_good_ns = None
        if len(gauges) and not suspect:
            self._restarts = 0
        # the records after a slip are lost
        done = len(records.intact) if slipped else settled
        self._seq += done
        self._malformed += done - len(gauges)
        self._lost += done - len(gauges)
        if slipped:
            self._slipped = True
            self._last_good_ns = self._last_good_ns or t_host_ns
        if suspect:
            self._look_at_status(t_host_ns)
        refuse_saturated(self.name, gauges)
        return FtSamples.of(t_host_ns, seq, self._calibration.wrench(gauges), counts=gauges, status=self._status)

    def _discard_backlog(self) -> None:
        """Drop buffered bytes and restart the stream, because the start of the next record is unknown."""
        self._buffer.clear()
        self._slipped = True
        self._last_good_ns = self._last_good_ns or self._newest_ns

    def _look_at_status(self, t_host_ns: int) -> None:
        """Stop the stream and read the status word, because the checksum does not cover the error bit."""
        self._judge_status(self._stop_stream())
        if not self._status & modbus.ANY_ERROR:
            text = describe_status(self._status, modbus.STATUS_BITS)
            self._restarts += 1
            if self._restarts > _MAX_RESTARTS:
                raise ProtocolError(
                    f"{self.name}: records have the error bit set, but the status is {text}, {self._restarts} times in "
                    "a row",
                    "check parity and wiring, power it off and on",
                )
            log.warning(
                "%s: a record with its error bit set, but the status is %s; measurement continues", self.name, text
            )
        self._start_stream()
        self._slipped = False
        self._last_good_ns = self._last_good_ns or t_host_ns

    def _disconnect(self) -> None:
        if not self._port.is_open:
            return
        try:
            self._jam()
        finally:
            self._port.close()

    def _stop_stream(self) -> int:
        """Stop the stream and read the status word; the reply to this request shows that the stream has stopped."""
        self._jam()
        try:
            return int.from_bytes(self._ask(modbus.read_registers(modbus.STATUS, 1), self._jam), "big")
        except (DeviceTimeout, ProtocolError) as exc:
            raise DeviceTimeout(exc.found, f"{exc.fix}, check termination and address") from exc

    def _start_stream(self) -> None:
        self._ask(modbus.START, self._jam)  # the stream runs already if only the reply was lost
        self._buffer.clear()
        self._damaged.clear()

    def _restart(self) -> None:
        # A restart of the stream takes 40 ms. The number of records lost meanwhile is estimated from the clock.
        self._restarts += 1
        if self._restarts > _MAX_RESTARTS:
            raise ProtocolError(
                f"{self.name}: no intact record after {_MAX_RESTARTS} restarts of the stream", "check parity and wiring"
            )
        log.warning("%s: the stream has lost its alignment; restarting it", self.name)
        self._judge_status(self._stop_stream())
        self._start_stream()
        self._slipped = False

    def _jam(self) -> None:
        """Stop any stream and wait until the line is silent."""
        self._port.write(modbus.JAM, discard=True)
        self._port.drain(_READ_S, _SILENCE_S)

    def _ask(self, request: bytes, before_again: Callable[[], object] | None = None) -> bytes:
        """Send a request up to three times and return the reply. By default a late reply is dropped in between."""
        again = before_again or (lambda: self._port.read(_BATCH_BYTES))
        return ask(self._port, self.name, request, modbus.check_reply, self._clock, _REPLY_S, again)

    def _judge_status(self, status: int) -> None:
        """Raise `DeviceFault` if the data are unusable; log other status bits once."""
        # On the RS-485 port of a NETCANOEM without CAN, bit 15 ("any error") is always set.
        new, self._status = status & ~self._status, status
        text = describe_status(status, modbus.STATUS_BITS)
        if status & modbus.CRITICAL:
            raise DeviceFault(f"{self.name}: status {text}", UNUSABLE)
        if self._seq and new & modbus.WATCHDOG_RESET:
            raise StreamBroken(f"{self.name}: the sensor has reset itself and lost its gains", "open it again")
        if new:
            log.warning("%s: status %s; measurement continues", self.name, text)


def _streams(data: bytes) -> bool:
    """Return whether 20 records in a row have a correct checksum; records have neither header nor number."""
    data = data[-100 * modbus.RECORD_SIZE :]
    if not data.strip(b"\0"):
        return False
    for start in range(modbus.RECORD_SIZE):
        whole = (len(data) - start) // modbus.RECORD_SIZE * modbus.RECORD_SIZE
        if whole >= 20 * modbus.RECORD_SIZE and modbus.decode_records(data[start : start + whole]).intact.all():
            return True
    return False


# Read request for serial number and part number of the first stored calibration.
_IDENTITY_REQUEST = modbus.read_registers(modbus.calibration_reads(1)[0][0], 20)


def _identify(data: bytes) -> str:
    registers = modbus.check_reply(_IDENTITY_REQUEST, data[: modbus.reply_size(_IDENTITY_REQUEST)])
    return f"ATI Digital F/T {decode_text(registers[8:])}, serial {decode_text(registers[:8])}"


SERIAL_PROBES = (SerialProbe("ati-serial://{port}", _BAUD, _streams, _IDENTITY_REQUEST, _identify, even_parity=True),)
