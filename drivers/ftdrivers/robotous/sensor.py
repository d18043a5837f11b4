"""Robotous RFT force/torque sensor: the common part of both wires, and the driver for a serial port.

Ref: Robotous, "RFT Series Installation and Operation Manual", revision 1.8: 8N1, 115200 baud from the factory.
Checked on hardware: no. Verified against: tests/unit/drivers/robotous/test_codec.py and the emulator (tests/wire).

A streaming sensor only accepts the commands stop and bias. A reply to any other command shows that it has stopped. This
driver never sends the bias command.
"""

from abc import abstractmethod
from typing import Self

import numpy as np

from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import DeviceFault, DeviceTimeout, ProtocolError
from ftdrivers.interfaces import DeviceInfo, FtSamples
from ftdrivers.registry import Options
from ftdrivers.robotous import codec
from ftdrivers.robotous.codec import Command, Field
from ftdrivers.streaming.sensor import NOTHING, StreamingSensor, scale_facts
from ftdrivers.wires.framing import is_stream
from ftdrivers.wires.serial_port import SerialPort, SerialProbe, other_baud

_REPLY_S = 0.15
_ATTEMPTS = 3


class RobotousSensor(StreamingSensor):
    """A Robotous RFT. A subclass sends and receives fields on one wire.

    `counts` are the six raw values, `t_device_s` is NaN, and `status` holds the overload bits (5 for Fx to 0 for Tz).
    Any overload raises `DeviceFault`. Samples carry no number. On a UART, `seq` counts received frames, including
    damaged ones, so a lost sample is only visible in the rate. On CAN, lost samples are detected by the clock.

    Parameters
    ----------
    name : str
        Name of the device, with which every error message begins.
    fastest_Hz : int
        Highest output rate of the wire.
    rate_Hz : int, optional
        Output rate: 10, 20, 50, 100, 200, 333, 500 or 1000. By default the rate that is set in the sensor.
    counts_per_unit : (int, int), optional
        Counts per N and per N·m, for a model whose scale this driver does not know.
    sign : int
        -1 for a sensor that reports the reaction.
    """

    def __init__(
        self,
        name: str,
        fastest_Hz: int,
        *,
        rate_Hz: int | None,
        counts_per_unit: tuple[int, int] | None,
        sign: int,
        clock: Clock,
    ) -> None:
        super().__init__(name, sign=sign, clock=clock)
        if rate_Hz is not None and rate_Hz not in codec.RATE_CODES:
            raise ValueError(f"rate is {rate_Hz} Hz; choose one of {', '.join(map(str, codec.RATE_CODES))}")
        if rate_Hz is not None and rate_Hz > fastest_Hz:
            raise ValueError(f"rate is {rate_Hz} Hz; choose at most {fastest_Hz} Hz, or a higher baud rate")
        self._rate_Hz = rate_Hz
        self._configured_counts = counts_per_unit

    @abstractmethod
    def _open(self) -> None: ...

    @abstractmethod
    def _close(self) -> None: ...

    @abstractmethod
    def _send(self, field: bytes) -> None:
        """Send a command field (8 bytes)."""

    @abstractmethod
    def _receive(self) -> list[Field]:
        """Return the fields that arrive within about 0.05 s."""

    @abstractmethod
    def _damaged(self) -> int:
        """Return a counter of damaged or incomplete fields, which never decreases."""

    def _start_stream(self, _rate_Hz: int) -> None:
        self._send(codec.encode(Command.START))

    def _connect(self) -> DeviceInfo:
        self._open()
        model = codec.decode_text(self._ask(Command.MODEL))
        force, torque = self._configured_counts or codec.counts_per_unit(model)
        self._unit_per_count = 1 / np.array([force] * 3 + [torque] * 3)
        serial = codec.decode_text(self._ask(Command.SERIAL))
        firmware = codec.decode_text(self._ask(Command.FIRMWARE))
        rate_Hz = codec.decode_rate(self._ask(Command.GET_RATE))
        if self._rate_Hz is not None and rate_Hz != self._rate_Hz:
            codec.check_set(self._ask(Command.SET_RATE, codec.RATE_CODES[self._rate_Hz]))
            rate_Hz = self._rate_Hz
        self._start_stream(rate_Hz)
        self._damaged_before = self._damaged()
        self._nominal_Hz = rate_Hz
        return DeviceInfo(
            model=f"Robotous {model}",
            serial=serial,
            firmware=firmware,
            facts=scale_facts(force, torque, "configured" if self._configured_counts else "documented"),
        )

    def _read_block(self) -> FtSamples:
        received = self._receive()
        self._lost = self._malformed = self._damaged() - self._damaged_before
        fields = [field for field in received if field.data[0] == Command.START]  # other fields are late replies
        if not fields:
            return NOTHING
        samples = [codec.decode_sample(field.data) for field in fields]
        overload = np.array([sample.overload for sample in samples], np.uint32)
        if axes := codec.overloaded_axes(int(np.bitwise_or.reduce(overload))):
            raise DeviceFault(
                f"{self.name}: overload of {', '.join(axes)}", "remove the load, then check the zero of the sensor"
            )
        counts = np.array([sample.counts for sample in samples], np.int32)
        return FtSamples.of(
            [field.t_host_ns for field in fields],
            [field.number for field in fields],
            counts * self._unit_per_count,
            counts=counts,
            status=overload,
        )

    def _disconnect(self) -> None:
        try:
            self._send(codec.encode(Command.STOP))
        finally:
            self._close()

    def _ask(self, command: Command, *parameters: int) -> bytes:
        """Stop any stream, send a command and return the reply."""
        for _ in range(_ATTEMPTS):
            self._send(codec.encode(Command.STOP))
            self._send(codec.encode(command, *parameters))
            for _ in self._clock.looks(_REPLY_S):
                for field in self._receive():
                    if field.data[0] == command:
                        return field.data
        raise DeviceTimeout(
            f"{self.name}: no reply to {command.name} after {_ATTEMPTS} attempts of {_REPLY_S} s",
            "check supply, wiring, bit rate and, on CAN, the option ids in its address",
        )


class RobotousSerial(RobotousSensor):
    """A Robotous RFT on a serial port.

    `baud` is a key of `codec.FASTEST_Hz`; the other parameters are those of `RobotousSensor`.
    """

    def __init__(
        self,
        port: str,
        *,
        baud: int = codec.DEFAULT_BAUD,
        rate_Hz: int | None = None,
        counts_per_unit: tuple[int, int] | None = None,
        sign: int = 1,
        clock: Clock = REAL,
    ) -> None:
        if baud not in codec.FASTEST_Hz:
            raise ValueError(f"baud is {baud}; choose one of {', '.join(map(str, codec.FASTEST_Hz))}")
        self._baud = baud
        super().__init__(
            f"Robotous sensor on {port}",
            codec.FASTEST_Hz[baud],
            rate_Hz=rate_Hz,
            counts_per_unit=counts_per_unit,
            sign=sign,
            clock=clock,
        )
        self._port = SerialPort(self.name, port, baud, clock=clock)

    @classmethod
    def from_url(cls, address: str, options: Options, *, sign: int = 1, clock: Clock = REAL) -> Self:
        """Build the driver from an address such as ``robotous-serial:///dev/serial/by-id/…?baud=921600&rate=1000``."""
        return cls(
            address,
            baud=options.integer("baud", codec.DEFAULT_BAUD, 57_600, 921_600),
            rate_Hz=options.integer("rate", 0, 0, 1000) or None,
            counts_per_unit=options.counts(),
            sign=sign,
            clock=clock,
        )

    def _open(self) -> None:
        self._frames = codec.deframer()
        self._port.open()

    def _close(self) -> None:
        self._port.close()

    def _send(self, field: bytes) -> None:
        self._port.write(codec.encode_frame(field))

    def _ask(self, command: Command, *parameters: int) -> bytes:
        try:
            return super()._ask(command, *parameters)
        except DeviceTimeout as exc:
            if not self._frames.has_noise:
                raise
            found = f"{exc.found}: {self._frames.arrived} at {self._baud} baud"
            raise DeviceTimeout(found, other_baud(codec.DEFAULT_BAUD)) from exc

    def _receive(self) -> list[Field]:
        frames = self._frames.feed(self._port.read_all(codec.FRAME_SIZE))
        t_host_ns = self._clock.now_ns()
        return [Field(number, t_host_ns, frame[1:-2]) for number, frame in frames]

    def _damaged(self) -> int:
        # Frames carry no number: damaged frames are counted, but lost ones are only visible in the rate.
        return self._frames.damaged


def _identify(data: bytes) -> str:
    for _, frame in codec.deframer().feed(data):
        if frame[1] == Command.MODEL:
            return f"Robotous {codec.decode_text(frame[1:-2])}"
    raise ProtocolError("the bytes contain no reply of a Robotous sensor")


SERIAL_PROBES = tuple(
    SerialProbe(url, baud, is_stream(codec.deframer), codec.encode_frame(codec.encode(Command.MODEL)), _identify)
    for url, baud in (("robotous-serial://{port}", 115_200), ("robotous-serial://{port}?baud=921600", 921_600))
)
