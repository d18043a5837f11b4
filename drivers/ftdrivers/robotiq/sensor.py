"""Robotiq FT 300 and FT 300-S force/torque sensor on a serial port, or through Robotiq's URCap on the controller.

On a serial port the sensor is set up by Modbus RTU and then sends a stream at 100 Hz, which may run directly after
boot. Only 50 bytes of 0xFF stop the stream. The sensor has no command for zeroing; other programs zero on the host.

The URCap sends readings such as ``( 1.5 , -2.0 , 30.0 , 0.1 , 0.2 , 0.3 )`` in N and N·m to every client of port 63351,
about 100 per second, without separators. The URCap subtracts its zero, which it does not report. The driver sends
nothing.

Ref: Robotiq, "FT 300 Force Torque Sensor" instruction manual, control over Modbus RTU and data stream; Robotiq's Linux
driver (the format), and public clients of the URCap (port, rate).
Checked on hardware: no. Verified against: tests/unit/drivers/robotiq and the emulators (tests/wire).
"""

import socket
from urllib.parse import urlsplit

import numpy as np

from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import DeviceFault, StreamBroken, Unreachable
from ftdrivers.interfaces import NOT_REPORTED, DeviceInfo, Fact, FtSamples
from ftdrivers.registry import Options
from ftdrivers.robotiq import codec
from ftdrivers.streaming.sensor import NOTHING, StreamingSensor, scale_facts
from ftdrivers.wires.framing import is_stream
from ftdrivers.wires.modbus import ask
from ftdrivers.wires.serial_port import SerialPort, SerialProbe

PORT = 63351
_CONNECT_S = 2.0
_RECEIVE_BYTES = 65536
# (6,) largest value of 16 bits, N and N·m. The zero of the URCap may hide that a value has reached it.
_END = 32_767 / np.array(codec.COUNTS_PER_UNIT)
# Longest reading, bytes.
_MOST_BYTES = 512


class Readings:
    """Finds readings in a stream of text that arrives in pieces of any length."""

    def __init__(self) -> None:
        self.number = 0
        """Number of the last reading. Damaged readings are counted as well."""
        self.damaged = 0
        self._rest = b""

    def feed(self, data: bytes) -> list[tuple[int, list[float]]]:
        """Add received text; return the completed readings as (number, six values in N and N·m)."""
        *pieces, rest = (self._rest + data).split(b")")
        self._rest = rest[-_MOST_BYTES:]
        found = []
        for piece in pieces:
            self.number += 1
            try:
                values = [float(text) for text in piece.rpartition(b"(")[2].split(b",")]
            except ValueError:
                values = []
            if len(values) == 6 and b"(" in piece:
                found.append((self.number, values))
            else:
                self.damaged += 1
        return found


class RobotiqUrcap(StreamingSensor):
    """A Robotiq FT 300 or FT 300-S that is read through the URCap of the controller, about 100 Hz.

    `counts` are empty, because the URCap sends N and N·m. `t_device_s` is NaN and `status` is 0, because it reports
    neither. Readings carry no number: `seq` counts received readings, including damaged ones.

    Parameters
    ----------
    host : str
        Address of the controller.
    port : int
        TCP port of the URCap.
    sign : int
        -1 for a sensor that reports the reaction.
    """

    def __init__(self, host: str, *, port: int = PORT, sign: int = 1, clock: Clock = REAL) -> None:
        super().__init__(f"Robotiq FT 300 at {host}", sign=sign, clock=clock)
        self._address = host, port
        self._socket: socket.socket | None = None

    def _connect(self) -> DeviceInfo:
        try:
            with self._clock.away():
                self._socket = socket.create_connection(self._address, self._clock.patience_s(_CONNECT_S))
        except OSError as exc:
            raise Unreachable(
                f"{self.name}: port {self._address[1]} does not answer ({exc})",
                "check the address, and that Robotiq's URCap with the sensor's stream is installed on the controller",
            ) from exc
        self._socket.settimeout(self._clock.poll_s)
        self._readings = Readings()
        self._nominal_Hz = codec.NOMINAL_RATE_Hz
        return DeviceInfo(
            model="Robotiq FT 300 (URCap)",
            serial=NOT_REPORTED,
            firmware=NOT_REPORTED,
            facts=scale_facts(1.0, 1.0, "documented") | {"range": Fact(codec.RANGE, "documented")},
        )

    def _read_block(self) -> FtSamples:
        if self._socket is None:
            raise StreamBroken(f"{self.name}: the sensor is closed", "open it first")
        try:
            data = self._socket.recv(_RECEIVE_BYTES)
        except TimeoutError:
            return NOTHING
        except OSError as exc:
            raise self._broken(str(exc)) from exc
        if not data:
            raise self._broken("the controller closed it")
        t_host_ns = self._clock.now_ns()
        readings = self._readings.feed(data)
        self._lost = self._malformed = self._readings.damaged
        if not readings:
            return NOTHING
        wrench = np.array([values for _, values in readings])
        if (np.abs(wrench) >= _END).any():
            raise DeviceFault(f"{self.name}: a value is at the end of its range", "remove the load and check the cable")
        return FtSamples.of(t_host_ns, [number for number, _ in readings], wrench)

    def _disconnect(self) -> None:
        connection, self._socket = self._socket, None
        if connection is not None:
            connection.close()

    def _broken(self, why: str) -> StreamBroken:
        return StreamBroken(
            f"{self.name}: the connection was lost ({why})", "check the robot and the cable, then open it again"
        )


def _host_and_port(address: str) -> tuple[str, int | None]:
    """Split the address of a controller into host and port. Raises `ValueError` with an example of a valid address."""
    try:
        parts = urlsplit(f"//{address}")
        if parts.hostname and parts.netloc == address:
            return parts.hostname, parts.port
    except ValueError:
        pass
    raise ValueError(
        f"'{address}' is not a host with a port: write robotiq-ft300://HOST:{PORT} for the controller, or "
        "robotiq-ft300:///dev/ttyUSB0 for a serial port"
    )


_BAUD = 19_200
_REPLY_S = 0.2
# Silence after which the stream counts as stopped, and the time-out for stopping it, s.
_SILENCE_S, _STOP_S = 0.05, 1.0
# Rates around 62.5 Hz, at which an FTDI adapter with a latency timer of 16 ms delivers data.
_LATENT_RATE_Hz = (55.0, 70.0)


class RobotiqFt300(StreamingSensor):
    """A Robotiq FT 300 or FT 300-S, 100 Hz.

    `counts` are the six raw values (0.01 N and 0.001 N·m). `t_device_s` is NaN and `status` is 0, because the sensor
    reports neither. A value at the end of its 16 bits raises `DeviceFault`. Frames carry no number: `seq` counts
    received frames, including damaged ones, so a lost frame is only visible in the rate.

    Parameters
    ----------
    port : str
        Serial port. A path such as ``/dev/serial/by-id/…`` remains valid after replugging.
    sign : int
        -1 for a sensor that reports the reaction.
    """

    def __init__(self, port: str, *, sign: int = 1, clock: Clock = REAL) -> None:
        super().__init__(f"Robotiq FT 300 on {port}", sign=sign, clock=clock)
        self._port = SerialPort(self.name, port, _BAUD, clock=clock)

    @classmethod
    def from_url(
        cls, address: str, options: Options, *, sign: int = 1, clock: Clock = REAL
    ) -> "RobotiqFt300 | RobotiqUrcap":
        """Build from ``robotiq-ft300:///dev/serial/by-id/…``; from ``robotiq-ft300://HOST:63351`` a `RobotiqUrcap`."""
        if address.startswith("/"):
            return cls(address, sign=sign, clock=clock)
        host, written = _host_and_port(address)
        port = options.integer("port", PORT if written is None else written, 1, 65535)
        if written not in {None, port}:
            raise ValueError(f"the address has two ports, {written} and {port}; leave one out")
        return RobotiqUrcap(host, port=port, sign=sign, clock=clock)

    def _connect(self) -> DeviceInfo:
        self._port.open()
        self._stop_stream()
        serial = codec.decode_serial(self._ask(codec.read_registers(codec.SERIAL, 4)))
        try:
            firmware = codec.decode_firmware(self._ask(codec.read_registers(codec.FIRMWARE, 3)))
        except codec.Refused:
            firmware = NOT_REPORTED
        self._ask(codec.START_STREAM)
        self._frames = codec.deframer()
        self._nominal_Hz = codec.NOMINAL_RATE_Hz
        return DeviceInfo(
            model="Robotiq FT 300",
            serial=serial,
            firmware=firmware,
            facts=scale_facts(100, 1000, "documented") | {"range": Fact(codec.RANGE, "documented")},
        )

    def _read_block(self) -> FtSamples:
        frames = self._frames.feed(self._port.read_all(codec.FRAME_SIZE))
        t_host_ns = self._clock.now_ns()
        self._lost = self._malformed = self._frames.damaged
        if not frames:
            return NOTHING
        counts = np.array([codec.decode_frame(frame) for _, frame in frames], np.int32)
        if (np.abs(counts + 0.5) > 32767).any():
            raise DeviceFault(f"{self.name}: a value is at the end of its range", "remove the load and check the cable")
        return FtSamples.of(t_host_ns, [number for number, _ in frames], counts / codec.COUNTS_PER_UNIT, counts=counts)

    def _disconnect(self) -> None:
        if not self._port.is_open:
            return
        try:
            self._port.write(codec.STOP)
        finally:
            self._port.close()

    def _stop_stream(self) -> None:
        self._port.write(codec.STOP)
        self._port.drain(_SILENCE_S, _STOP_S)

    def _ask(self, request: bytes) -> tuple[int, ...]:
        """Send a request and return the reply; stop the stream again before each retry, because it may still run."""
        return ask(self._port, self.name, request, codec.check_reply, self._clock, _REPLY_S, self._stop_stream)

    def _rate_fix(self, rate_Hz: float) -> str:
        if not _LATENT_RATE_Hz[0] < rate_Hz < _LATENT_RATE_Hz[1]:
            return super()._rate_fix(rate_Hz)
        return (
            "reduce the 16 ms latency of the USB adapter: "
            "echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer (with the name of your port)"
        )


_SERIAL_NUMBER_REQUEST = codec.read_registers(codec.SERIAL, 4)


def _identify(data: bytes) -> str:
    registers = codec.check_reply(_SERIAL_NUMBER_REQUEST, data[: codec.reply_size(_SERIAL_NUMBER_REQUEST)])
    return f"Robotiq FT 300, serial {codec.decode_serial(registers)}"


SERIAL_PROBES = (
    SerialProbe("robotiq-ft300://{port}", _BAUD, is_stream(codec.deframer), _SERIAL_NUMBER_REQUEST, _identify),
)
