"""JSON over UDP for PlotJuggler before 3.16."""

import json
import socket
from collections.abc import Sequence
from contextlib import suppress
from math import isfinite

from ftdrive.errors import ConfigError
from ftdrive.stream.samples import Block, Picked, StreamEvent, StreamInfo
from ftdrive.stream.stream import Sink

RATE_HZ = 200.0
"""Sending rate, Hz: a plot of 5 s is about 1000 pixels wide, so a higher rate is not visible. PlotJuggler parses
datagrams in its GUI thread, and the system drops datagrams that are not read in time."""


class UdpSender(Sink):
    """Sends the raw and the compensated wrench at `RATE_HZ`, one sample per datagram, with UTC seconds as `timestamp`.

    Parameters
    ----------
    host, port : str, int
        Address of the receiver; PlotJuggler listens on port 9870.

    Raises
    ------
    ConfigError
        The host is unknown.
    """

    label = "UDP"

    def __init__(self, info: StreamInfo, host: str, port: int) -> None:
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except OSError as error:
            raise ConfigError(f"--udp {host}:{port}: {error.strerror}: give the address of the viewer") from error
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)
        self._address = address
        self._offset_ns = info.utc_offset_ns
        self._picked = Picked(RATE_HZ)

    def add(self, block: Block | None, _events: Sequence[StreamEvent]) -> None:
        """Send the selected samples of a block without waiting; PlotJuggler only plots numbers, so no events."""
        if not block:
            return
        few = block.rows(self._picked.rows(block.t_host_ns))
        compensated = f"compensated_{block.frame.id}"
        for i, t_ns in enumerate((few.t_host_ns + self._offset_ns).tolist()):
            values = {
                "timestamp": t_ns * 1e-9,
                "raw_sensor": _by_component(few.raw[i].tolist()),
                compensated: _by_component(few.wrench[i].tolist()),
                "chi2": chi2 if isfinite(chi2 := float(few.chi2[i])) else None,
                "in_contact": int(few.in_contact[i]),
            }
            with suppress(OSError):  # buffer full or no route: the next one follows soon
                self._socket.sendto(json.dumps(values).encode(), self._address)

    def end(self) -> None:
        """Close the socket."""
        self._socket.close()


def _by_component(wrench: list[float]) -> dict[str, dict[str, float]]:
    return {
        "force_N": dict(zip("xyz", wrench[:3], strict=True)),
        "torque_Nm": dict(zip("xyz", wrench[3:], strict=True)),
    }
