"""A question and its answer in Modbus RTU, for sensors that speak it until they stream."""

import time
from collections.abc import Callable
from typing import TypeVar

from drivers._serial import SerialPort
from drivers.errors import DeviceTimeout, ProtocolError

T = TypeVar("T")


def exchange(
    port: SerialPort, name: str, request: bytes, size: int, check: Callable[[bytes, bytes], T], timeout_s: float
) -> T:
    """Send a request, and return what `check` finds in the reply of `size` bytes; a refusal has 5.

    Raises
    ------
    DeviceTimeout
        The reply is not whole within `timeout_s`.
    ProtocolError
        What `check` raises, with the name of the device before it and what to do behind.
    """
    port.write(request, discard=True)
    deadline = time.monotonic() + timeout_s
    reply, wanted = b"", 5
    while len(reply) < wanted:
        reply += port.read(wanted - len(reply))
        if len(reply) == 5 and not reply[1] & 0x80:
            wanted = size
        if len(reply) < wanted and time.monotonic() > deadline:
            raise DeviceTimeout(
                f"{name}: no reply within {timeout_s} s ({len(reply)} of {wanted} bytes); check supply and wiring"
            )
    try:
        return check(request, reply)
    except ProtocolError as exc:
        cure = "is it the sensor that its address names? Check its wiring, power it off and on"
        raise type(exc)(f"{name}: {exc}; {cure}") from exc
