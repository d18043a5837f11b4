"""ATI NETCANOEM force/torque sensor over CAN.

Ref: ATI Industrial Automation, "F/T CAN Bus and Serial Bus Network Interface for OEM", 9610-05-1030 revision 04.
Checked on hardware: no. Verified against: tests/unit/drivers/ati/test_codec.py and the emulator (tests/wire).

The sensor is polled; it has no stream, no clock and no bias command. In a critical error it keeps sending data. It does
not report saturation. A reset selects calibration slot 0. The driver checks all three.
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
from ftdrivers.wires.can_bus import CanBus, CanFrame, CanProbe, join_frames, request_message
from ftdrivers.wires.framing import describe_status

log = logging.getLogger(__name__)

_TRANSACTION_S = 0.1
_ATTEMPTS = 3
# A poll takes 1 to 3 ms, more on a busy computer. A lost frame must not make the stream stale.
_POLL_S = 0.05
# Read after the deadline, because on a busy host often this process is late, not the reply.
_LATE_FRAMES = 32
# After a missed poll the bus must be silent, so that a late half is not paired with the next reading.
_QUIET_S = 0.01
# How long a reading whose halves came in the wrong order waits for a contradicting frame.
_STRAGGLER_S = 0.004
_ANOTHER_SLOT = "choose another slot, slot=0 to 15 in its address"
# The manual fixes 1 000 000 counts per unit for firmware that does not report them.
_MILLION = (1_000_000, 1_000_000)
# About what a 250 kbit/s bus carries; faster polls of a faster bus or an emulator would load a CPU core.
_PERIOD_S = 1e-3


class AtiCanSensor(StreamingSensor):
    """An ATI NETCANOEM sensor on any CAN interface of python-can.

    `seq` counts polls, `t_device_s` is NaN, `counts` are the six gauges. A poll without a reply counts as lost.

    Parameters
    ----------
    channel : str
        As python-can names it: ``can0``, or the serial port of an slcan adapter.
    interface : str
        python-can's interface name.
    bitrate : int
        Bit/s; not used on socketcan, where ``ip link`` sets it.
    base : int
        Base identifier, 0x00 to 0x7F; factory setting 0x20 (identifiers 0x200 to 0x20F).
    slot : int
        Calibration slot, 0 to 15.
    unit_codes, counts_per_unit : (int, int), optional
        For force, for torque, as on the calibration certificate: for firmware before 3.7, which does not report them.
        A sensor that reports others is rejected. The default is N, N·m and 1 000 000 counts, logged as assumed.
    sign : int
        -1 for a sensor mounted or wired to report the reaction.
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
        """Build from ``ati-can://can0?bitrate=250000&base=0x20&slot=0&interface=socketcan``.

        Firmware before 3.7 needs ``units=lbf,lbf-in``, and ``counts=1000000,1000000`` if the certificate differs.
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
        # The next poll leaves before this reply is decoded: a slow NETCANOEM is then polled as fast as it can reply.
        if not self._asked:
            self._clock.sleep(self._next_poll_s - self._clock.now_s())
            self._poll()
        self._asked = False
        try:
            first, second = self._answer(Op.GAUGES, b"", _POLL_S)
        except (DeviceTimeout, ProtocolError):
            self._lost += 1
            self._missed += 1
            self._await_quiet()  # a late half must not be paired with the next reading
            if self._missed > 1:
                self._select_slot()  # a restart would have selected slot 0
            return NOTHING
        finally:
            self._malformed = self._bus.malformed
        t_host_ns, seq = self._clock.now_ns(), self._polls
        self._missed = 0
        if t_host_ns >= self._next_poll_s * 1e9:
            self._poll()  # the sensor prepares the next reading while this one is decoded
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
        # After a watchdog reset the sensor is back at slot 0, and two missed polls in a row may be such a reset.
        echo = codec.decode_slot(*self._ask(Op.SELECT_SLOT, self._slot))
        if echo != self._slot:
            raise ConnectError(
                f"{self.name}: requested calibration slot {self._slot}, the sensor selected {echo}",
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
        """Return counts per unit, unit codes and their source. Raises `ConnectError` where two sources differ."""
        if firmware < codec.COUNTS_PER_UNIT_SINCE:
            counts = self._counts_per_unit or _MILLION  # fixed by the manual for this firmware
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
                f"{self.name}: the sensor reports {_scale_text(counts, unit_codes)}, configured are "
                f"{_scale_text(*configured)}",
                "check slot, units and counts in its address",
            )
        return counts, unit_codes, "device"

    def _judge(self, reading: codec.GaugeReading) -> None:
        """Raise when a reading is unusable; log other status bits once."""
        # A healthy unit on a shared bus had bit 14 set, so bits 0, 8, 14 and 15 are logged once and no fault.
        status = reading.status
        if status & codec.CRITICAL:
            raise DeviceFault(f"{self.name}: status {describe_status(status, codec.STATUS_BITS)}", UNUSABLE)
        if self._polls and status & ~self._seen_status & codec.WATCHDOG_RESET:
            raise StreamBroken(
                f"{self.name}: the sensor has reset itself and may be back at calibration slot 0", "open it again"
            )
        if new := status & ~self._seen_status:
            log.warning("%s: status %s; measuring continues", self.name, describe_status(new, codec.STATUS_BITS))
            self._seen_status |= new
        refuse_saturated(self.name, reading.gauges[np.newaxis])

    def _ask(self, op: Op, *args: int) -> list[bytes]:
        """Exchange with retries, for the start-up sequence."""
        for _ in range(_ATTEMPTS):
            with contextlib.suppress(DeviceTimeout, ProtocolError):
                self._request(op, bytes(args))
                return self._answer(op, bytes(args), _TRANSACTION_S)
        raise DeviceTimeout(
            f"{self.name}: no reply to {op.name} after {_ATTEMPTS} attempts of {_TRANSACTION_S} s",
            "check bit rate, base identifier, supply and termination",
        )

    def _request(self, op: Op, data: bytes) -> None:
        """Drop what belongs to earlier requests, and send one; `_answer` must follow."""
        self._bus.discard()
        self._bus.send(self._base << 4 | op, data)

    def _answer(self, op: Op, data: bytes, timeout_s: float) -> list[bytes]:
        """Return the payloads of the reply to the request just sent, or raise `DeviceTimeout`: never half a reply.

        Frames are matched by identifier and length, not by order of arrival, as they carry no number. Two differing
        frames for one part are a `ProtocolError`: one of them belongs to an earlier request.
        """
        expected = codec.REPLIES[op]
        request_id = self._base << 4 | op
        parts: dict[int, bytes] = {}
        # only the reply to SELECT_SLOT equals its request: on a bus that echoes, the first one is ours
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
        """Drop what arrives until nothing does, at most for a transaction."""
        for _ in self._clock.looks(_TRANSACTION_S):
            if self._bus.receive(_QUIET_S) is None:
                return


def _scale_text(counts: tuple[int, int], unit_codes: tuple[int, int]) -> str:
    force, torque = unit_names(unit_codes)
    return f"{counts[0]} counts per {force} and {counts[1]} per {torque}"


# Nodes of CANopen. On their bus every lower identifier may be a command, also one that nobody sends at the moment.
_HEARTBEATS = frozenset(range(0x701, 0x780))


def can_probe(channel: str, interface: str, bitrate: int | None, base: int) -> CanProbe:
    """Return how to recognize a NETCANOEM with this base identifier; the parameters are those of `probe_can`."""
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
        return "another host reads it" if len(join_frames(ours, replies(Op.GAUGES))) >= 5 else None

    def ask(bus: CanBus, clock: Clock) -> str | None:
        serial = request_message(bus, clock, first | Op.SERIAL, b"", replies(Op.SERIAL))
        firmware = serial and request_message(bus, clock, first | Op.FIRMWARE, b"", replies(Op.FIRMWARE))
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
