"""ATI NETCANOEM force/torque sensor over CAN.

Ref: ATI Industrial Automation, "F/T CAN Bus and Serial Bus Network Interface for OEM", 9610-05-1030 revision 04.
Checked on hardware: no. Verified against: tests/unit/test_ati_codec.py and the emulator (tests/wire).

The sensor is polled; it has no stream, no clock and no bias command. It keeps sending data in critical error, does not
report saturation, and falls back to calibration slot 0 after every reset: all three are judged here.
"""

import contextlib
import logging
import time
from typing import TYPE_CHECKING, Self

import can
import numpy as np
from can.interfaces.slcan import slcanBus

from drivers._can import BUS_ERRORS, close_bus, open_bus
from drivers._stream import LINK_ERRORS, NOTHING, StreamingSensor, scale_facts
from drivers.ati import codec
from drivers.ati.calibration import NEWTON, NEWTON_METRE, Calibration, saturated_gauges
from drivers.ati.codec import Op
from drivers.errors import ConnectError, DeviceFault, DeviceTimeout, ProtocolError, StreamBroken
from drivers.interfaces import DeviceInfo, FtSamples

if TYPE_CHECKING:
    from drivers.registry import Options

log = logging.getLogger(__name__)

_TRANSACTION_S = 0.1
_ATTEMPTS = 3
_POLL_S = 0.05
"""A poll takes 1 to 3 ms, more on a busy computer; a lost frame must not make the stream stale."""
_GRACE_S = 0.002
"""A last look after the deadline: on a busy host it is often this process that was late, not the answer."""
_QUIET_S = 0.01
_STRAGGLER_S = 0.004
"""How long a reading in the wrong order waits for a frame that would contradict it."""
_PERIOD_S = 1e-3
"""About what a 250 kbit/s bus carries; polling a faster one, or an emulator, for all it gives would eat a CPU core."""


class AtiCanSensor(StreamingSensor):
    """An ATI NETCANOEM sensor on any CAN interface python-can knows.

    `seq` counts polls, `t_device_s` is NaN, `counts` are the six gauges. A poll that is not answered counts as lost.

    Parameters
    ----------
    channel : str
        The bus as python-can names it: ``can0``, or the serial port of an slcan adapter.
    interface : str
        python-can's interface name.
    bitrate : int
        Bit/s; on socketcan it is set with ``ip link`` and this value is not used.
    base : int
        Base identifier, 0x00 to 0x7F; factory setting 0x20 (identifiers 0x200 to 0x20F).
    slot : int
        Calibration slot, 0 to 15.
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
        sign: int = 1,
    ) -> None:
        super().__init__(f"ATI CAN sensor 0x{base:02X} on {interface} {channel}", sign=sign)
        self._channel = channel
        self._interface = interface
        self._bitrate = bitrate
        self._base = base
        self._slot = slot
        self._bus: can.BusABC | None = None
        self._echoes = self._asked = False
        self._polls = self._missed = self._seen_status = 0
        self._next_poll_s = 0.0

    @classmethod
    def from_url(cls, address: str, options: "Options", *, sign: int = 1) -> Self:
        """Build from ``ati-can://can0?bitrate=250000&base=0x20&slot=0&interface=socketcan``."""
        return cls(
            address,
            interface=options.text("interface", "socketcan"),
            bitrate=options.integer("bitrate", 250_000, 1, 1_000_000),
            base=options.integer("base", 0x20, 0, 0x7F),
            slot=options.integer("slot", 0, 0, 15),
            sign=sign,
        )

    def _connect(self) -> DeviceInfo:
        self._bus = open_bus(
            self.name,
            self._channel,
            self._interface,
            self._bitrate,
            [{"can_id": self._base << 4, "can_mask": 0x7F0, "extended": False}],
        )
        self._echoes = self._asked = False
        self._polls = self._missed = self._seen_status = 0
        serial = codec.decode_serial(*self._ask(Op.SERIAL))
        firmware = codec.decode_firmware(*self._ask(Op.FIRMWARE))
        self._select_slot()
        self._calibration = self._read_calibration(firmware)
        self._judge(codec.decode_gauges(*self._ask(Op.GAUGES)))
        return DeviceInfo(
            model="ATI F/T (NETCANOEM, CAN)",
            serial=serial,
            firmware=f"{firmware.major}.{firmware.minor} build {firmware.build}",
            facts=scale_facts(
                self._calibration.counts_per_N,
                self._calibration.counts_per_Nm,
                "device" if firmware >= codec.COUNTS_PER_UNIT_SINCE else "assumed",
            ),
        )

    def _read_block(self) -> FtSamples:
        if not self._asked:
            time.sleep(max(0.0, self._next_poll_s - time.monotonic()))
            self._poll()
        self._asked = False
        try:
            first, second = self._answer(Op.GAUGES, b"", _POLL_S)
        except (DeviceTimeout, ProtocolError):
            self._lost += 1
            self._missed += 1
            self._drain(_QUIET_S)  # a late half must not pair up with the next reading
            if self._missed > 1:
                self._select_slot()  # it may have restarted, and would be back at slot 0
            return NOTHING
        t_host_ns, seq = time.monotonic_ns(), self._polls
        self._missed = 0
        if time.monotonic() >= self._next_poll_s:
            self._poll()  # the sensor works on the next reading while we work on this one
        reading = codec.decode_gauges(first, second)
        self._judge(reading)
        gauges = reading.gauges[np.newaxis]
        return FtSamples(
            t_host_ns=np.array([t_host_ns], np.int64),
            t_device_s=np.array([np.nan]),
            seq=np.array([seq], np.int64),
            counts=gauges,
            wrench=self._calibration.wrench(gauges),
            status=np.array([reading.status], np.uint32),
        )

    def _poll(self) -> None:
        self._next_poll_s = max(self._next_poll_s + _PERIOD_S, time.monotonic())
        self._polls += 1
        self._request(Op.GAUGES, b"", _POLL_S)
        self._asked = True

    def _disconnect(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            close_bus(bus)

    def _select_slot(self) -> None:
        echo = codec.decode_slot(*self._ask(Op.SELECT_SLOT, self._slot))
        if echo != self._slot:
            raise ConnectError(f"{self.name}: asked for calibration slot {self._slot}, the sensor answered {echo}")

    def _read_calibration(self, firmware: codec.Firmware) -> Calibration:
        matrix = np.array([codec.decode_matrix_row(*self._ask(Op.MATRIX_ROW, axis)) for axis in range(6)])
        if not matrix.any():
            raise DeviceFault(f"{self.name}: calibration slot {self._slot} is empty; select another slot")
        if firmware >= codec.COUNTS_PER_UNIT_SINCE:
            counts = codec.decode_counts_per_unit(*self._ask(Op.COUNTS_PER_UNIT))
            units = codec.decode_unit_codes(*self._ask(Op.UNIT_CODES))
        else:
            counts, units = (1_000_000, 1_000_000), (NEWTON, NEWTON_METRE)
            log.warning(
                "%s: firmware %d.%d does not tell its units; 1 000 000 counts per N and N·m assumed, "
                "compare with the calibration certificate",
                self.name,
                *firmware[:2],
            )
        return Calibration.from_vendor(matrix, counts, units)

    def _judge(self, reading: codec.GaugeReading) -> None:
        """Raise on what makes a reading unusable, log the rest of a status word once."""
        status = reading.status
        if status & codec.CRITICAL:
            raise DeviceFault(f"{self.name}: status {codec.describe_status(status)}; its data must not be used")
        if self._polls and status & ~self._seen_status & codec.WATCHDOG_RESET:
            raise StreamBroken(
                f"{self.name}: the sensor has reset itself and may be back at calibration slot 0; open it again"
            )
        if new := status & ~self._seen_status:
            log.warning("%s: status %s; measuring goes on", self.name, codec.describe_status(new))
            self._seen_status |= new
        if gauges := saturated_gauges(reading.gauges[np.newaxis]):
            names = ", ".join(f"G{g}" for g in gauges)
            raise DeviceFault(f"{self.name}: gauge {names} at the end of its range; take the load off, check the cable")

    def _ask(self, op: Op, *args: int) -> list[bytes]:
        """Exchange with retries, for the start-up sequence."""
        for _ in range(_ATTEMPTS):
            with contextlib.suppress(DeviceTimeout, ProtocolError):
                return self._exchange(op, bytes(args), _TRANSACTION_S)
        raise DeviceTimeout(
            f"{self.name}: no answer to {op.name} after {_ATTEMPTS} attempts of {_TRANSACTION_S} s; check bit rate, "
            "base identifier, supply and termination"
        )

    def _exchange(self, op: Op, data: bytes, timeout_s: float) -> list[bytes]:
        """Send one request and return the payloads of its reply. One thread at a time: the opening one, or the reader.

        Raises as `_answer`.
        """
        self._request(op, data, timeout_s)
        return self._answer(op, data, timeout_s)

    def _request(self, op: Op, data: bytes, timeout_s: float) -> None:
        """Send a request, after throwing away what belongs to earlier ones; `_answer` must follow."""
        if self._bus is None:
            raise StreamBroken(f"{self.name}: closed")
        self._drain()
        message = can.Message(arbitration_id=self._base << 4 | op, data=data, is_extended_id=False)
        try:
            self._bus.send(message, timeout=timeout_s)
        except BUS_ERRORS as exc:
            raise self._broken(exc) from exc

    def _answer(self, op: Op, data: bytes, timeout_s: float) -> list[bytes]:
        """Return the payloads of the reply to the request just sent, or raise `DeviceTimeout`: never half a reply.

        Frames are matched by identifier and length, not by order of arrival. They carry no number: when two differing
        ones answer, or come in the wrong order with another behind, one belongs to an earlier request, nobody knows
        which, and that is a `ProtocolError`.
        """
        expected = codec.REPLIES[op]
        request_id = self._base << 4 | op
        parts: dict[int, bytes] = {}
        # only the reply to SELECT_SLOT looks like its request: on a bus that echoes, the first one is ours
        skip_echo = self._echoes and op is Op.SELECT_SLOT
        deadline = time.monotonic() + timeout_s
        while len(parts) < len(expected) or list(parts) != sorted(parts):
            whole = len(parts) == len(expected)
            left_s = deadline - time.monotonic()
            message = None
            if left_s > -timeout_s:
                message = self._receive(_STRAGGLER_S if whole else max(left_s, _GRACE_S))
            if message is None and whole:
                break
            if message is None:
                raise DeviceTimeout(f"{self.name}: no answer to {op.name} within {timeout_s} s")
            opcode = message.arbitration_id & 0xF
            payload = bytes(message.data)
            if opcode in expected and len(payload) == expected[opcode]:
                if skip_echo:
                    skip_echo = False
                elif parts.setdefault(opcode, payload) != payload:
                    self._malformed += 1
                    raise ProtocolError(f"{self.name}: two different answers to {op.name}")
            elif message.arbitration_id == request_id and payload == data:
                self._echoes = True
        return [parts[opcode] for opcode in expected]

    def _drain(self, quiet_s: float = 0.0) -> None:
        """Throw away what has arrived, until nothing comes for `quiet_s`; at most for a transaction."""
        if not quiet_s and isinstance(self._bus, slcanBus):
            with contextlib.suppress(can.CanError):
                self._bus.flush()  # its `recv` sits out 1 ms before it says that there is nothing
            return
        deadline = time.monotonic() + _TRANSACTION_S
        while self._receive(quiet_s) is not None and time.monotonic() < deadline:
            pass

    def _receive(self, timeout_s: float) -> can.Message | None:
        """Wait for a data frame with one of our identifiers."""
        if self._bus is None:
            raise StreamBroken(f"{self.name}: closed")
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                message = self._bus.recv(timeout=max(0.0, deadline - time.monotonic()))
            except (ValueError, LookupError):
                self._malformed += 1  # an slcan line that is no frame
                if time.monotonic() < deadline:
                    continue
                return None
            except (can.CanError, *LINK_ERRORS) as exc:
                raise self._broken(exc) from exc
            if message is None:
                return None
            strange = message.is_extended_id or message.is_remote_frame or message.is_error_frame or message.is_fd
            if not strange and message.arbitration_id >> 4 == self._base:
                return message

    def _broken(self, exc: Exception) -> StreamBroken:
        return StreamBroken(f"{self.name}: the CAN interface is gone ({exc}); plug it in and open it again")
