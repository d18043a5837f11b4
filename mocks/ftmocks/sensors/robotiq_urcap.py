"""An emulated Robotiq FT 300 that is wired to the UR controller: the text stream of Robotiq's URCap over TCP.

Ref: get_data in main.c of Robotiq's driver for the sensor (robotiq_force_torque_sensor of ros-industrial/robotiq)
makes the text of a reading: ``( FX , FY , FZ , TX , TY , TZ )`` with six decimals, in N and N·m. Public clients read
this text at port 63351 of the controller: MobMonRob/PacketCut (ur_cut/scripts/forceTorque.py), the driver
aist_ftsensor, which expects 100 Hz, and UniversalRobots/Universal_Robots_ROS_Driver issue 621.

Does not model: port 63350, where the URCap takes ``SET ZRO`` and ``GET`` commands.

Chosen here, because the sources leave it open: nothing separates two readings, so a client that reads slowly receives
several at once, or a part of one. What a client sends is ignored. A client that does not read loses whole readings.
"""

import contextlib
import socket
from dataclasses import dataclass
from typing import TypedDict

from ftmocks.sensors.kind import Kind
from ftmocks.sensors.robotiq import BIAS_SCALE, COUNTS_PER_SI, STREAM_HZ, raw_values
from ftmocks.wires.device import Device

PORT = 63351


class Endpoint(TypedDict):
    """Address at which a client reaches the stream of the URCap."""

    host: str
    port: int


def reading_text(wrench: list[float]) -> bytes:
    """Return the text of a wrench (6,), N and N·m."""
    return f"( {' , '.join(f'{value:f}' for value in wrench)} )".encode("ascii")


@dataclass(eq=False, kw_only=True)
class RobotiqUrcap(Device[bytes]):
    """The stream of the URCap, for any number of clients.

    Parameters
    ----------
    host, port
        Address on which the URCap listens; port 0 selects a free one.
    """

    host: str = "127.0.0.1"
    port: int = PORT

    def __post_init__(self) -> None:
        super().__post_init__()
        self._clients: dict[socket.socket, bytes] = {}
        """For each client, the remaining bytes of a reading of which its socket accepted only a part."""

    def start(self) -> Endpoint:
        """Start the URCap.

        Raises
        ------
        RuntimeError
            The URCap is running already.
        OSError
            The port is not available.
        """
        self._require_stopped()
        self._socket = socket.create_server((self.host, self.port))
        self._socket.setblocking(False)
        self._file = self._socket.fileno()
        self._launch()
        return {"host": self.host, "port": self._socket.getsockname()[1]}

    def _close(self) -> None:
        for client in (*self._clients, self._socket):
            client.close()
        self._clients.clear()

    def power_up(self) -> None:
        """Set the state after power-up, see `Device.power_up`."""
        self._wire.clear()
        self._pacer.start(STREAM_HZ)

    def _receive(self) -> None:
        with contextlib.suppress(OSError):  # the client may have closed the connection
            client, _ = self._socket.accept()
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._clients[client] = b""

    def _sample(self, count: int) -> None:
        raw = raw_values(self.measure(count))
        if self.saturated_axis is not None:
            raw[:, self.saturated_axis] = 32767
        self._wire.put([reading_text(wrench) for wrench in (raw / COUNTS_PER_SI).tolist()])

    def _deliver(self, frames: list[bytes]) -> None:
        for frame in frames:
            for client, rest in tuple(self._clients.items()):
                try:
                    self._clients[client] = _sent(client, rest, frame)
                except OSError:  # the client has closed the connection
                    client.close()
                    del self._clients[client]


def _sent(client: socket.socket, rest: bytes, frame: bytes) -> bytes:
    """Send a client the rest of the last reading, then a new one; return the bytes that were not accepted."""
    with contextlib.suppress(BlockingIOError):
        while rest:
            rest = rest[client.send(rest) :]
        return frame[client.send(frame) :]
    return rest


KINDS = {"robotiq-urcap": Kind(RobotiqUrcap, "robotiq-ft300", at_host=True, bias_scale=BIAS_SCALE)}
