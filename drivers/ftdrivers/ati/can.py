"""ATI NETCANOEM force/torque sensor over CAN.

Ref: ATI Industrial Automation, "F/T CAN Bus and Serial Bus Network Interface for OEM", 9610-05-1030 revision 04.
Checked on hardware: no. Verified against: tests/unit/drivers/ati/test_codec.py and the emulator (tests/wire).

The sensor is polled; it has no stream, no clock and no bias command. It keeps sending data after a critical error, does
not report saturation, and selects calibration slot 0 after a reset. The driver checks for all three.
"""

import contextlib
import logging
from collections.abc import Sequence
from typing import Literal, Self

import numpy as np

from ftdrivers.ati import codec
from ftdrivers.ati.codec import NEWTON, NEWTON_METRE, Calibration, Op, parse_units, refuse_saturated, unit_names
from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import UNUSABLE, ConnectError, DeviceFault, DeviceTimeout, ProtocolError, StreamBroken
from ftdrivers.interfaces import Array, DeviceInfo, FtSamples
from ftdrivers.registry import Options, join_url
from ftdrivers.streaming.sensor import NOTHING, StreamingSensor, scale_facts
from ftdrivers.wires.can_bus import CanBus, CanFrame, CanProbe, join_frames
from ftdrivers.wires.framing import ENOUGH_FRAMES, describe_status

log = logging.getLogger(__name__)

_TRANSACTION_S = 0.1
_ATTEMPTS = 3
# Time-out of a poll, which takes 1 to 3 ms. It is short, so one lost frame does not make the stream stale.
_POLL_S = 0.05
# Number of frames that are still read after the time-out: on a busy computer the process is late, not the reply.
_LATE_FRAMES = 32
# Silence required after a missed poll, so that a late half of its reading is not paired with the next reading.
_QUIET_S = 0.01
# Time for which further frames are awaited if the two halves of a reading arrive in the wrong order.
_STRAGGLER_S = 0.004
_ANOTHER_SLOT = "choose another slot, with slot=0 to 15 in its address"
# Counts per unit of firmware that does not report them, according to the manual.
_MILLION = (1_000_000, 1_000_000)
# Shortest poll period: about the capacity of a bus at 250 kbit/s. Faster polls would only load the CPU.
_PERIOD_S = 1e-3
# Identifiers of heartbeats of CANopen nodes. On a bus with CANopen, any lower identifier may be a command.
_HEARTBEATS = frozenset(range(0x701, 0x780))


class AtiCanSensor(StreamingSensor):
    """An ATI NETCANOEM sensor on any CAN interface of python-can.

    `seq` counts polls, `t_device_s` is NaN, `counts` are the six gauge values. A poll without a reply is a lost sample.

    Parameters
    ----------
    channel : str
        Channel of python-can: ``can0``, or the serial port of an slcan adapter.
    interface : str
        Interface of python-can, such as ``socketcan`` or ``slcan``.
    bitrate : int
        Bit rate, bit/s. It is ignored on socketcan, where ``ip link`` sets it.
    base : int
        Base identifier, 0x00 to 0x7F; factory setting 0x20 (identifiers 0x200 to 0x20F).
    slot : int
        Calibration slot, 0 to 15.
    unit_codes, counts_per_unit : (int, int), optional
        Values for force and torque from the calibration certificate, for firmware before 3.7, which does not report
        them. A sensor that reports other values is rejected. By default N, N·m and 1 000 000 counts are assumed, and a
        warning is logged.
    sign : int
        -1 for a sensor that reports the reaction.
    """

    def __init__(
        self,
        channel: str,
        *,
        interface: str = "socketcan",
        bitrate: int = 250_000,
        base: int = 0x20,
        slot: int = 0,
        unit_codes: tuple[int, int] | None = None,
        counts_per_unit: tuple[int, int] | None = None,
        sign: int = 1,
        clock: Clock = REAL,
    ) -> None:
        super().__init__(f"ATI CAN sensor 0x{base:02X} on {interface} {channel}", sign=sign, clock=clock)
        replies = {base << 4 | opcode for reply in codec.REPLIES.values() for opcode in reply}
        self._bus = CanBus(self.name, channel, interface, bitrate, replies, clock)
        self._base = base
        self._slot = slot
        self._unit_codes = unit_codes
        self._counts_per_unit = counts_per_unit
        self._echoes = self._asked = False
        self._polls = self._missed = self._seen_status = 0
        self._next_poll_s = 0.0

    @classmethod
    def from_url(cls, address: str, options: Options, *, sign: int = 1, clock: Clock = REAL) -> Self:
        """Build the driver from an address such as ``ati-can://can0?bitrate=250000&base=0x20&slot=0``.

        Firmware before 3.7 needs the options ``units=lbf,lbf-in`` and ``counts=1000000,1000000`` if the certificate
        differs from the defaults.
        """
        units = options.optional("units")
        return cls(
            address,
            interface=options.text("interface", "socketcan"),
            bitrate=options.integer("bitrate", 250_000, 1, 1_000_000),
            base=options.integer("base", 0x20, 0, 0x7F),
            slot=options.integer("slot", 0, 0, 15),
            unit_codes=parse_units(units) if units else None,
            counts_per_unit=options.counts(),
            sign=sign,
            clock=clock,
        )

    @staticmethod
    def probe(channel: str, interface: str, bitrate: int | None, base: int) -> CanProbe:
        """Return the `CanProbe` of a NETCANOEM with this base identifier; the parameters are those of `probe_can`."""
        first = base << 4
        own = frozenset(range(first, first + 16))
        options = {} if interface == "socketcan" else {"interface": interface}
        options |= {"bitrate": str(bitrate)} if bitrate else {}
        options |= {"base": f"0x{base:02X}"} if base != 0x20 else {}

        def replies(op: Op) -> dict[int, int]:
            return {first | opcode: size for opcode, size in codec.REPLIES[op].items()}

        def recognize(heard: Sequence[CanFrame]) -> str | None:
            request = (first | Op.GAUGES, b"")
            ours = [frame for frame in heard if frame[0] in own and frame != request]
            return "another host reads it" if len(join_frames(ours, replies(Op.GAUGES))) >= ENOUGH_FRAMES else None

        def ask(bus: CanBus) -> str | None:
            serial = bus.request(first | Op.SERIAL, b"", replies(Op.SERIAL))
            firmware = serial and bus.request(first | Op.FIRMWARE, b"", replies(Op.FIRMWARE))
            if serial is None or firmware is None:
                return None
            major, minor, build = codec.decode_firmware(firmware)
            return f"ATI NETCANOEM, serial {codec.decode_serial(serial)}, firmware {major}.{minor} build {build}"

        return CanProbe(
            f"an ATI NETCANOEM at base 0x{base:02X}",
            join_url("ati-can", channel, options),
            own | _HEARTBEATS if first < min(_HEARTBEATS) else own,
            recognize,
            ask,
        )

    def _connect(self) -> DeviceInfo:
        self._bus.open()
        self._echoes = self._asked = False
        self._polls = self._missed = self._seen_status = 0
        serial = codec.decode_serial(*self._ask(Op.SERIAL))
        firmware = codec.decode_firmware(*self._ask(Op.FIRMWARE))
        self._select_slot()
        try:
            matrix = self._read_matrix()
            counts, unit_codes, source = self._read_scale(firmware)
            self._calibration = Calibration.from_vendor(matrix, counts, unit_codes)
        except ProtocolError as exc:
            raise ProtocolError(f"{self.name}: calibration slot {self._slot}: {exc.found}", _ANOTHER_SLOT) from exc
        self._judge(codec.decode_gauges(*self._ask(Op.GAUGES)))
        return DeviceInfo(
            model="ATI F/T (NETCANOEM, CAN)",
            serial=serial,
            firmware=f"{firmware.major}.{firmware.minor} build {firmware.build}",
            facts=scale_facts(self._calibration.counts_per_N, self._calibration.counts_per_Nm, source),
        )

    def _read_block(self) -> FtSamples:
        # The next poll is sent before this reply is decoded, so that the NETCANOEM can already prepare its next reply.
        if not self._asked:
            self._clock.sleep(self._next_poll_s - self._clock.now_s())
            self._poll()
        self._asked = False
        try:
            first, second = self._answer(Op.GAUGES, b"", _POLL_S)
        except (DeviceTimeout, ProtocolError):
            self._lost += 1
            self._missed += 1
            self._await_quiet()  # so that a late half is not paired with the next reading
            if self._missed > 1:
                self._select_slot()  # if the sensor has restarted, slot 0 is selected
            return NOTHING
        finally:
            self._malformed = self._bus.malformed
        t_host_ns, seq = self._clock.now_ns(), self._polls
        self._missed = 0
        if t_host_ns >= self._next_poll_s * 1e9:
            self._poll()
        reading = codec.decode_gauges(first, second)
        self._judge(reading)
        counts = reading.gauges[np.newaxis]
        return FtSamples.of(t_host_ns, seq, self._calibration.wrench(counts), counts=counts, status=reading.status)

    def _poll(self) -> None:
        self._next_poll_s = max(self._next_poll_s + _PERIOD_S, self._clock.now_s())
        self._polls += 1
        self._request(Op.GAUGES, b"")
        self._asked = True

    def _disconnect(self) -> None:
        self._bus.close()

    def _select_slot(self) -> None:
        # A watchdog reset selects slot 0. Two missed polls in a row may be such a reset.
        echo = codec.decode_slot(*self._ask(Op.SELECT_SLOT, self._slot))
        if echo != self._slot:
            raise ConnectError(
                f"{self.name}: requested calibration slot {self._slot}, but the sensor selected {echo}",
                f"end other programs that use the sensor, or {_ANOTHER_SLOT}",
            )

    def _read_matrix(self) -> Array:
        matrix = np.array([codec.decode_matrix_row(*self._ask(Op.MATRIX_ROW, axis)) for axis in range(6)])
        if not matrix.any():
            raise DeviceFault(f"{self.name}: calibration slot {self._slot} is empty", _ANOTHER_SLOT)
        return matrix

    def _read_scale(
        self, firmware: codec.Firmware
    ) -> tuple[tuple[int, int], tuple[int, int], Literal["device", "configured", "assumed"]]:
        """Return counts per unit, unit codes and their source. Raises `ConnectError` if sensor and address differ."""
        if firmware < codec.COUNTS_PER_UNIT_SINCE:
            counts = self._counts_per_unit or _MILLION
            if self._unit_codes is not None:
                return counts, self._unit_codes, "configured"
            log.warning(
                "%s: firmware %d.%d does not report its units; assuming %d counts per N and %d per N·m; compare with "
                "the calibration certificate and set units and counts in the address, such as "
                "units=lbf,lbf-in&counts=1000000,1000000",
                self.name,
                *firmware[:2],
                *counts,
            )
            return counts, (NEWTON, NEWTON_METRE), "assumed"
        counts = codec.decode_counts_per_unit(*self._ask(Op.COUNTS_PER_UNIT))
        unit_codes = codec.decode_unit_codes(*self._ask(Op.UNIT_CODES))
        configured = self._counts_per_unit or counts, self._unit_codes or unit_codes
        if configured != (counts, unit_codes):
            raise ConnectError(
                f"{self.name}: the sensor reports {_scale_text(counts, unit_codes)}, but {_scale_text(*configured)} "
                "are configured",
                "check slot, units and counts in its address",
            )
        return counts, unit_codes, "device"

    def _judge(self, reading: codec.GaugeReading) -> None:
        """Raise `DeviceFault` if a reading is unusable; log other status bits once."""
        # Bits 0, 8, 14 and 15 are not faults: a healthy unit on a shared bus had bit 14 set.
        status = reading.status
        if status & codec.CRITICAL:
            raise DeviceFault(f"{self.name}: status {describe_status(status, codec.STATUS_BITS)}", UNUSABLE)
        if self._polls and status & ~self._seen_status & codec.WATCHDOG_RESET:
            raise StreamBroken(
                f"{self.name}: the sensor has reset itself and may be back at calibration slot 0", "open it again"
            )
        if new := status & ~self._seen_status:
            log.warning("%s: status %s; measurement continues", self.name, describe_status(new, codec.STATUS_BITS))
            self._seen_status |= new
        refuse_saturated(self.name, reading.gauges[np.newaxis])

    def _ask(self, op: Op, *args: int) -> list[bytes]:
        """Send a request of the start-up sequence, repeat it if there is no reply, and return the reply."""
        for _ in range(_ATTEMPTS):
            with contextlib.suppress(DeviceTimeout, ProtocolError):
                self._request(op, bytes(args))
                return self._answer(op, bytes(args), _TRANSACTION_S)
        raise DeviceTimeout(
            f"{self.name}: no reply to {op.name} after {_ATTEMPTS} attempts of {_TRANSACTION_S} s",
            "check bit rate, base identifier, supply and termination",
        )

    def _request(self, op: Op, data: bytes) -> None:
        """Drop replies to earlier requests, and send a new request; `_answer` must follow."""
        self._bus.discard()
        self._bus.send(self._base << 4 | op, data)

    def _answer(self, op: Op, data: bytes, timeout_s: float) -> list[bytes]:
        """Return the payloads of the complete reply to the last request, or raise `DeviceTimeout`.

        Frames carry no number, and are matched by identifier and length. Two different frames with one identifier raise
        `ProtocolError`, because one of them belongs to an earlier request.
        """
        expected = codec.REPLIES[op]
        request_id = self._base << 4 | op
        parts: dict[int, bytes] = {}
        # the reply to SELECT_SLOT equals its request: on a bus with echo, the first of the two frames is the request
        skip_echo = self._echoes and op is Op.SELECT_SLOT
        deadline_s = self._clock.now_s() + timeout_s
        late = 0
        while len(parts) < len(expected) or list(parts) != sorted(parts):
            whole = len(parts) == len(expected)
            left_s = max(0.0, deadline_s - self._clock.now_s())
            late += not left_s
            frame = None
            if late <= _LATE_FRAMES:
                frame = self._bus.receive(_STRAGGLER_S if whole else left_s)
            if frame is None and whole:
                break
            if frame is None:
                raise DeviceTimeout(
                    f"{self.name}: no reply to {op.name} within {timeout_s} s", "check supply and wiring"
                )
            identifier, payload = frame
            opcode = identifier & 0xF
            if opcode in expected and len(payload) == expected[opcode]:
                if skip_echo:
                    skip_echo = False
                elif parts.setdefault(opcode, payload) != payload:
                    self._bus.malformed += 1
                    raise ProtocolError(f"{self.name}: two different replies to {op.name}")
            elif identifier == request_id and payload == data:
                self._echoes = True
        return [parts[opcode] for opcode in expected]

    def _await_quiet(self) -> None:
        """Drop received frames until the bus is silent, at most for the duration of one transaction."""
        for _ in self._clock.looks(_TRANSACTION_S):
            if self._bus.receive(_QUIET_S) is None:
                return


def _scale_text(counts: tuple[int, int], unit_codes: tuple[int, int]) -> str:
    force, torque = unit_names(unit_codes)
    return f"{counts[0]} counts per {force} and {counts[1]} per {torque}"
