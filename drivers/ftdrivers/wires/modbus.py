"""A Modbus RTU master for sensors that use Modbus until they stream: frames, requests and replies.

Ref: Modbus over Serial Line 1.02, section 2.5; Modbus Application Protocol 1.1b3, sections 6.3, 6.12 and 7.
"""

import struct
from collections.abc import Callable, Sequence
from typing import TypeVar

from ftdrivers.clock import Clock
from ftdrivers.errors import DeviceTimeout, ProtocolError
from ftdrivers.wires.framing import crc16_modbus
from ftdrivers.wires.serial_port import SerialPort

T = TypeVar("T")

READ_HOLDING, WRITE_MULTIPLE = 0x03, 0x10

_ATTEMPTS = 3
_EXCEPTIONS = {1: "illegal function", 2: "illegal register", 3: "illegal value", 4: "device failure or locked"}


class Refused(ProtocolError):
    """The device refuses a request with a Modbus exception; repeating the request does not help."""


def frame(address: int, function: int, payload: bytes) -> bytes:
    """Return the bytes of a frame to or from the device at `address`."""
    body = bytes([address, function]) + payload
    return body + crc16_modbus(body).to_bytes(2, "little")


def read_registers(address: int, register: int, count: int) -> bytes:
    """Return the request to read `count` holding registers."""
    return frame(address, READ_HOLDING, struct.pack(">HH", register, count))


def write_registers(address: int, register: int, values: Sequence[int]) -> bytes:
    """Return the request to write holding registers."""
    n = len(values)
    return frame(address, WRITE_MULTIPLE, struct.pack(f">HHB{n}H", register, n, 2 * n, *values))


def reply_size(request: bytes) -> int:
    """Return the length of the normal reply to `request`, in bytes. A Modbus exception always has 5 bytes.

    Replies to vendor-specific functions are expected to have one byte of data.
    """
    match request[1]:
        case 0x03:
            return 5 + 2 * int.from_bytes(request[4:6], "big")
        case 0x10:
            return 8
        case _:
            return 5


def check_reply(request: bytes, reply: bytes) -> bytes:
    """Check a complete reply to a request and return its data: the registers of a read request, nothing for a write.

    Raises
    ------
    ProtocolError
        The reply is damaged, belongs to another request, or is a Modbus exception (`Refused`).
    """
    text = reply.hex(" ")
    if len(reply) < 5 or crc16_modbus(reply[:-2]) != int.from_bytes(reply[-2:], "little"):
        raise ProtocolError(f"the reply is damaged ({text or 'empty'})")
    address, function = request[:2]
    if len(reply) == 5 and reply[:2] == bytes([address, function | 0x80]):
        reason = _EXCEPTIONS.get(reply[2], "unknown reason")
        raise Refused(f"the sensor refused function 0x{function:02X} with Modbus exception {reply[2]} ({reason})")
    foreign = f"the reply {text} does not belong to the request {request.hex(' ')}"
    if reply[:2] != request[:2] or len(reply) != reply_size(request):
        raise ProtocolError(foreign)
    payload = reply[2:-2]
    if function == READ_HOLDING:
        if payload[0] != len(payload) - 1:
            raise ProtocolError(f"the reply announces {payload[0]} bytes and contains {len(payload) - 1}")
        return payload[1:]
    if function == WRITE_MULTIPLE:
        if payload != request[2:6]:
            raise ProtocolError(f"{foreign}: it confirms other registers")
        return b""
    return payload


def ask(
    port: SerialPort,
    name: str,
    request: bytes,
    check: Callable[[bytes, bytes], T],
    clock: Clock,
    timeout_s: float,
    before_again: Callable[[], object],
) -> T:
    """Send a request up to three times and return the result of `check` for its reply; call `before_again` in between.

    Raises
    ------
    DeviceTimeout
        The last reply is not complete after `timeout_s`.
    ProtocolError
        The error that `check` raised, with the name of the device and a fix. A `Refused` is raised at once.
    """
    # Modbus libraries cannot be used, because the same port later carries a stream without Modbus frames.
    for _ in range(_ATTEMPTS - 1):
        try:
            return _exchange(port, name, request, check, clock, timeout_s)
        except Refused:
            raise
        except (DeviceTimeout, ProtocolError):
            before_again()
    return _exchange(port, name, request, check, clock, timeout_s)


def _exchange(
    port: SerialPort, name: str, request: bytes, check: Callable[[bytes, bytes], T], clock: Clock, timeout_s: float
) -> T:
    port.write(request, discard=True)
    reply, wanted = b"", 5  # bytes of a Modbus exception
    for _ in clock.looks(timeout_s):
        while len(reply) < wanted and (more := port.read(wanted - len(reply))):
            reply += more
            if len(reply) == 5 and not reply[1] & 0x80:
                wanted = reply_size(request)
        if len(reply) == wanted:
            break
    else:
        raise DeviceTimeout(
            f"{name}: no reply within {timeout_s} s ({len(reply)} of {wanted} bytes)", "check supply and wiring"
        )
    try:
        return check(request, reply)
    except ProtocolError as exc:
        fix = "check that the address names this sensor, check its wiring, power it off and on"
        raise type(exc)(f"{name}: {exc.found}", fix) from exc
