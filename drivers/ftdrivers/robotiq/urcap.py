"""Robotiq FT 300 wired to the controller of a UR: the text that Robotiq's URCap streams.

The URCap owns the serial line. It sends readings such as ``( 1.5 , -2.0 , 30.0 , 0.1 , 0.2 , 0.3 )`` in N and N·m to
every client of port 63351, about 100 a second, without a separator between them.

Ref: Robotiq's Linux driver (the format), and public clients of the URCap (port, rate).
Checked on hardware: no. Verified against: tests/unit/drivers/robotiq/test_urcap.py and the emulator (tests/wire).

The readings are after the zero that the URCap has set, and the URCap does not report it. This driver sends nothing.
"""

import socket

import numpy as np

from ftdrivers.clock import REAL, Clock
from ftdrivers.errors import DeviceFault, StreamBroken, Unreachable
from ftdrivers.interfaces import NOT_REPORTED, DeviceInfo, Fact, FtSamples
from ftdrivers.robotiq import codec
from ftdrivers.streaming.sensor import NOTHING, StreamingSensor, scale_facts

PORT = 63351
_CONNECT_S = 2.0
_RECEIVE_BYTES = 65536
# (6,) N and N·m: the end of the sensor's 16 bits. The URCap's zero may hide it.
_END = 32_767 / np.array(codec.COUNTS_PER_UNIT)
# No reading is longer.
_MOST_BYTES = 512


class Readings:
    """Readings in a stream of text, whose parts arrive in any pieces."""

    def __init__(self) -> None:
        self.number = 0
        """Number of the last reading, damaged ones included."""
        self.damaged = 0
        self._rest = b""

    def feed(self, data: bytes) -> list[tuple[int, list[float]]]:
        """Return the readings that are complete now: their number, and six values in N and N·m."""
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
    """A Robotiq FT 300 or FT 300-S behind the URCap of the controller, about 100 Hz, read-only.

    `counts` are empty, because the URCap sends N and N·m. `t_device_s` is NaN and `status` is 0, as it reports neither.
    Readings carry no number: `seq` counts arrived ones, including damaged ones.

    Parameters
    ----------
    host : str
        Address of the controller.
    port : int
        Port of the URCap.
    sign : int
        -1 for a sensor mounted or wired to report the reaction.
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
            raise DeviceFault(f"{self.name}: a value is at the end of its range", "take the load off, check the cable")
        return FtSamples.of(t_host_ns, [number for number, _ in readings], wrench)

    def _disconnect(self) -> None:
        connection, self._socket = self._socket, None
        if connection is not None:
            connection.close()

    def _broken(self, why: str) -> StreamBroken:
        return StreamBroken(
            f"{self.name}: the connection was lost ({why})", "check the robot and the cable, then open it again"
        )
