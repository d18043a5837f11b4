"""Modbus RTU as far as two emulated sensors need it: CRC, exceptions, reading holding registers.

Ref: Modbus over Serial Line 1.02, sections 2.5 and 6.2; Modbus Application Protocol 1.1b3, sections 6.3 and 7.
"""

import struct
from collections.abc import Callable, Mapping

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, DEVICE_FAILURE = 1, 2, 3, 4
LONGEST_FRAME = 256


class ModbusError(Exception):
    """A request that is answered with an exception code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"Modbus exception {code}")
        self.code = code


def crc16(data: bytes) -> bytes:
    """Return the CRC-16/MODBUS as sent on the wire, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0xA001 if crc & 1 else 0)
    return crc.to_bytes(2, "little")


def with_crc(body: bytes) -> bytes:
    """Return a frame's body followed by its CRC."""
    return body + crc16(body)


def reply(address: int, frame: bytes, execute: Callable[[int, bytes], bytes]) -> bytes:
    """Return the answer to one frame; nothing if the frame is damaged or for another device.

    Parameters
    ----------
    execute
        Takes the function code and the data of a request; returns the data of the reply or raises `ModbusError`.
    """
    if len(frame) < 4 or len(frame) > LONGEST_FRAME or frame[0] != address or crc16(frame[:-2]) != frame[-2:]:
        return b""
    function = frame[1]
    try:
        return with_crc(bytes((address, function)) + execute(function, frame[2:-2]))
    except ModbusError as refused:
        return with_crc(bytes((address, function | 0x80, refused.code)))


def read_registers(data: bytes, registers: Mapping[int, int], max_count: int) -> bytes:
    """Return the data of the reply to a read of registers, all of which must exist."""
    if len(data) != 4:
        raise ModbusError(ILLEGAL_VALUE)
    first, count = struct.unpack(">2H", data)
    if not 1 <= count <= max_count:
        raise ModbusError(ILLEGAL_VALUE)
    if any(address not in registers for address in range(first, first + count)):
        raise ModbusError(ILLEGAL_ADDRESS)
    values = [registers[address] for address in range(first, first + count)]
    return struct.pack(f">B{count}H", 2 * count, *values)


def written_registers(data: bytes) -> dict[int, int]:
    """Return the addresses and values in a request that writes several registers."""
    if len(data) < 5:
        raise ModbusError(ILLEGAL_VALUE)
    first, count, size = struct.unpack(">2HB", data[:5])
    if count == 0 or size != 2 * count or len(data) != 5 + size:
        raise ModbusError(ILLEGAL_VALUE)
    return dict(zip(range(first, first + count), struct.unpack(f">{count}H", data[5:]), strict=True))
