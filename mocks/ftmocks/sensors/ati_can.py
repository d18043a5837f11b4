"""An emulated ATI force/torque sensor with a CAN interface (NETCANOEM) behind an emulated slcan adapter.

Ref: ATI 9610-05-1030-04 "F/T CAN Bus and Serial Bus Network Interface for OEM", CAN protocol and section 10 (start-up).

Does not model: bus load and arbitration (an answer takes no bus time), the board's internal sampling rate, the power-up
time of `start`, the serial port of the same board, and whether the real board answers malformed requests (this one
ignores them).
"""

import random
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ftmocks.arrays import Array
from ftmocks.sensors.ati_gauges import GAUGE_MAX, REFERENCE, WIRE_ORDER, Calibration
from ftmocks.sensors.kind import Kind
from ftmocks.wires.slcan import CanFrame
from ftmocks.wires.stream import CanSensor

EMPTY_SLOT_STATUS = 0x8040  # status bits of an empty slot: bad active calibration, any error
NO_ARGUMENT, ONE_ARGUMENT = (0, 1), (1,)  # accepted data lengths by opcode; an additional byte is tolerated
REQUEST_DLC = {
    0x0: NO_ARGUMENT,
    0x2: ONE_ARGUMENT,
    0x5: NO_ARGUMENT,
    0x6: ONE_ARGUMENT,
    0x7: NO_ARGUMENT,
    0x8: NO_ARGUMENT,
    0x9: ONE_ARGUMENT,
    0xC: NO_ARGUMENT,
    0xD: ONE_ARGUMENT,
    0xE: ONE_ARGUMENT,
    0xF: NO_ARGUMENT,
}
DIAGNOSTIC_ADC = {0: 0x07FF, 2: 0x0A3C, 3: 0x09C4, 4: 0x0800, 5: 0x0003}


def sg_payloads(status: int, gauges: NDArray[np.int16]) -> list[bytes]:
    """Return the answer to "read SG data": status and the even gauges, then the odd gauges."""
    even_odd = gauges[WIRE_ORDER].tolist()
    return [struct.pack(">H3h", status, *even_odd[:3]), struct.pack(">3h", *even_odd[3:])]


def matrix_row_payloads(row: Array) -> list[bytes]:
    """Return the answer to "read matrix row": three pairs of float32."""
    return [struct.pack(">2f", *row[i : i + 2]) for i in (0, 2, 4)]


@dataclass(eq=False, kw_only=True)
class AtiCanNode(CanSensor):
    """The sensor's CAN node and the adapter that a client opens.

    `base` and `bitrate` show the active values.

    Parameters
    ----------
    base, bitrate
        Base identifier (7 bits) and bit rate; a client at another bit rate gets no answer.
    calibrations
        Calibration in each slot, 0 to 15. Slots that are not named are empty.
    serial
        At most 8 ASCII characters, padded with NUL.
    firmware
        Major, minor, build. Versions before 3.7 do not report counts and units; before 3.8, no diagnostics.
    status
        Status bits that are sent unchanged, in addition to those of an empty slot.
    gauge_offset
        (6,) or scalar offset that is added to the gauges, in counts.
    boot_s
        Silence after a reset.
    reset_applies_settings
        Whether a reset counts as power-up for a new base identifier and bit rate.
    wrong_echo
        Slot number that is echoed instead of the selected one.
    """

    base: int = 0x20
    bitrate: int = 250_000
    calibrations: Mapping[int, Calibration] = field(default_factory=lambda: {0: REFERENCE})
    serial: str = "FT12345"
    firmware: tuple[int, int, int] = (3, 8, 2)
    status: int = 0
    gauge_offset: float | Sequence[float] = 0.0
    boot_s: float = 0.2
    reset_applies_settings: bool = True
    wrong_echo: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._next_base, self._next_bitrate = self.base, self.bitrate
        self._slot = 0
        self._booted_s = 0.0

    def power_up(self) -> None:
        """Set the state after power-up, see `Device.power_up`."""
        super().power_up()
        self._booted_s = 0.0

    def _boot(self) -> None:
        self._reset(applies_settings=True)

    def _reset(self, *, applies_settings: bool) -> None:
        self._slot = 0
        self._wire.clear()
        self._booted_s = self.clock.now_s() + self.boot_s
        if applies_settings:
            self.base, self.bitrate = self._next_base, self._next_bitrate

    def _samples(self, _count: int) -> list[CanFrame]:
        return []  # no stream: this sensor only answers requests

    def answer(self, request: CanFrame) -> list[CanFrame]:
        """Return the frames that answer a request; none if the frame is not a request."""
        opcode = request.identifier & 0xF
        if self.clock.now_s() < self._booted_s:
            return []
        if request.extended or request.remote or request.identifier >> 4 != self.base:
            return []
        if len(request.data) not in REQUEST_DLC.get(opcode, ()):
            return []
        identifier = request.identifier  # kept here, because a reset below may change the base identifier
        payloads = self._payloads(opcode, request.data[0] if request.data else 0)
        return [CanFrame(identifier + i, payload) for i, payload in enumerate(payloads)]

    def _payloads(self, opcode: int, argument: int) -> list[bytes]:
        calibration = self.calibrations.get(self._slot)
        match opcode:
            case 0x0:
                return sg_payloads(self.status | (0 if calibration else EMPTY_SLOT_STATUS), self._gauges())
            case 0x2 if argument < 6:
                return matrix_row_payloads(calibration.matrix[argument] if calibration else np.zeros(6))
            case 0x5:
                return [self.serial.encode("ascii").ljust(8, b"\0")]
            case 0x6 if argument < 16:
                self._slot = argument
                return [bytes([argument if self.wrong_echo is None else self.wrong_echo])]
            case 0x7 if self.firmware >= (3, 7):
                counts = (calibration.counts_per_force, calibration.counts_per_torque) if calibration else (0, 0)
                return [struct.pack(">2I", *counts)]
            case 0x8 if self.firmware >= (3, 7):
                return [bytes((calibration.force_unit, calibration.torque_unit) if calibration else (0, 0))]
            case 0x9 if self.firmware >= (3, 8) and argument in DIAGNOSTIC_ADC:
                return [struct.pack(">H", DIAGNOSTIC_ADC[argument])]
            case 0xC:
                self._reset(applies_settings=self.reset_applies_settings)
            case 0xD:
                self._next_base = argument & 0x7F
                return [b""]
            case 0xE:
                self._next_bitrate = 2_000_000 // (argument + 1)
                return [b""]
            case 0xF:
                return [struct.pack(">2BH", *self.firmware)]
        return []

    def _gauges(self) -> NDArray[np.int16]:
        calibration = self.calibrations.get(self._slot, REFERENCE)  # the converter runs on, even with an empty slot
        gauges: NDArray[np.int16] = calibration.gauges(self.measure(1), shift=np.asarray(self.gauge_offset))[0]
        if self.saturated_axis is not None:
            gauges[self.saturated_axis] = GAUGE_MAX
        return gauges

    def _foreign_frame(self, rng: random.Random) -> CanFrame:
        """Return another node's frame: with a foreign standard identifier, or an extended one that looks like ours."""
        data = rng.randbytes(rng.randrange(9))
        if rng.random() < 0.5:
            return CanFrame((self.base << 4) + rng.randrange(16), data, extended=True)
        other_base = (self.base + rng.randrange(1, 0x80)) % 0x80
        return CanFrame((other_base << 4) + rng.randrange(16), data)


KINDS = {
    "can": Kind(
        AtiCanNode,
        "ati-can",
        "interface=slcan&bitrate=250000&base=32",
        {"interface": "slcan", "bitrate": 250_000, "base": 0x20},
        {"base": 0x20, "bitrate": 250_000},
    )
}
